"""A small data set of every kind of pair that an export meets, split; and the folder that an export of it fills."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pair_factory import CONFIG, make_pair, metadata, with_object, write_whole_index

from augkitti.dataset import Dataset
from augkitti.dataset_index import read_index, shard_entry
from augkitti.export import FORMATS, export_pairs, open_export
from augkitti.frames import pose_from_xyz_yaw
from augkitti.scanner import load_profile
from augkitti.shards import write_shard
from augkitti.splits import Splits, write_splits

RAW, COMPENSATED, ODD = "2011_09_26_drive_0005_sync", "odometry_04", "my drive.v2"


def write_set(folder: Path, tick_step: int = 8) -> None:
    """Five pairs: one frame with two choices of cars, the next frame, a compensated scan, and a name with odd signs."""
    pairs = [
        [
            tilted(make_pair(RAW, tick_step=tick_step).pair),
            make_pair(
                RAW, variant=1, place=(9.0, 2.0, -0.3), speed_mps=0.0, yaw_rate_rps=0.0, tick_step=tick_step
            ).pair,
            make_pair(RAW, frame0=1, place=(15.0, -2.0, 0.0), tick_step=tick_step).pair,
        ],
        [make_pair(COMPENSATED, kind="compensated", tick_step=tick_step).pair],
        [make_pair(ODD, tick_step=tick_step).pair],
    ]
    entries = []
    for shard in pairs:
        path = folder / "data" / f"{shard[0].sequence}-00000.parquet"
        write_shard(path, shard, metadata())
        entries.append(shard_entry(folder, path, shard[0].sequence, shard[0].recording, len(shard)))
    write_whole_index(folder, entries)
    index = read_index(folder)
    names = {"train": RAW, "validation": COMPENSATED, "test": ODD}
    splits = {part: tuple(s.path for s in index.shards if s.sequence == name) for part, name in names.items()}
    write_splits(folder, index, Splits(splits, (70.0, 10.0, 20.0), 0))


def tilted(pair):
    """The pair with its virtual car on a slope: its pose is turned, its box is not."""
    poses = {}
    for k in (0, 1):
        pose = getattr(pair.objects[2], f"pose{k}").copy()
        lean = pose_from_xyz_yaw(0, 0, 0, 0.05)[:3, :3]
        pose[:3, :3] = (
            pose[:3, :3]
            @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]).T
            @ lean
            @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        )
        poses[f"pose{k}"] = pose
    return with_object(replace(pair), 2, **poses)


def export(source: Path, name: str, out: Path, split: str | None = None, most: int | None = None):
    """Export a set, or begin to: at most so many pairs are made; the records of those."""
    dataset = Dataset(source, split)
    state = open_export(dataset, FORMATS[name], out, split)
    made = export_pairs(dataset, state, CONFIG.ground, load_profile())
    if most is None:
        return list(made)
    records = [next(made) for _ in range(most)]
    made.close()
    return records


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """What changes when a file is written again, even with the same bytes."""
    found = {p.relative_to(folder).as_posix(): p.stat() for p in folder.rglob("*") if p.is_file()}
    return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in found.items()}
