"""Small finished data sets on disk: many pairs of few points, split by recording."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pair_factory import make_pair, metadata, write_whole_index

from augkitti.dataset_index import read_index, shard_entry
from augkitti.shards import write_shard
from augkitti.splits import Splits, write_splits

TRAIN, VALIDATION, TEST = "0001", "0002", "0003"


def write_tiny_set(
    folder: Path,
    shards: Mapping[str, tuple[int, ...]],
    splits: Mapping[str, tuple[str, ...]] | None = None,
    variant: int = 0,
    tick_step: int = 400,
) -> list[str]:
    """Write a data set; the names of its pairs in the order of its index.

    Args:
        folder: of the set.
        shards: pairs of each shard of each recording.
        splits: recordings of each split; none is written where not given.
        variant: of all pairs: another set of the same recordings has another.
        tick_step: only every so many firings are kept.
    """
    base = make_pair(tick_step=tick_step).pair
    entries, names = [], []
    for recording, sizes in shards.items():
        sequence = f"2011_09_26_drive_{recording}_sync"
        frame = 0
        for number, size in enumerate(sizes):
            pairs = [
                replace(
                    base,
                    pair_id=f"{sequence}/{frame + k}/{variant}",
                    sequence=sequence,
                    recording=sequence.removesuffix("_sync"),
                    frame0=frame + k,
                    frame1=frame + k + 1,
                )
                for k in range(size)
            ]
            frame += size
            path = folder / "data" / f"{sequence}-{number:05d}.parquet"
            write_shard(path, pairs, metadata())
            entries.append(shard_entry(folder, path, sequence, pairs[0].recording, len(pairs)))
            names += [pair.pair_id for pair in pairs]
    write_whole_index(folder, entries)
    if splits is not None:
        index = read_index(folder)
        write_splits(
            folder,
            index,
            Splits(
                {
                    name: tuple(s.path for s in index.shards if s.sequence.split("_")[4] in recordings)
                    for name, recordings in splits.items()
                },
                (70.0, 10.0, 20.0),
                0,
            ),
        )
    return names
