"""Pairs with a car made in code, as a data set on disk: what the viewer's tests look at."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pair_factory import CONFIG, make_pair, write_whole_index

from augkitti.dataset_index import shard_entry
from augkitti.frames import transform_points
from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import THROUGH_GLASS, AugmentedPair, AugmentedScan
from augkitti.scanner import load_profile
from augkitti.shards import shard_metadata, write_shard
from augkitti.viewer.pair_data import rigid_flow

NAME = "2011_09_26_drive_0007_sync"
MODEL = next(model for model in parametric_cars() if model.name == "parametric_sedan")


def write_viewed_set(
    folder: Path, root: Path, pairs: int = 1, tick_step: int = 2, noise_m: float = 0.0
) -> list[AugmentedPair]:
    """Write a finished data set of one sequence, and its source scans under `root`.

    Args:
        folder: of the data set.
        root: of the source.
        pairs: how many; the later, the faster their cars.
        tick_step: every so many firings are kept: 2 gives scans of KITTI's size.
        noise_m: of measured points, so that they are as hard to pack as real ones; the source is left without.

    Returns:
        The pairs.
    """
    made = [
        make_pair(NAME, 2 * n, speed_mps=4.0 + 3.0 * n, place=(12.0 + 2.0 * n, -2.5, 0.1), tick_step=tick_step)
        for n in range(pairs)
    ]
    shown = [_as_shown(one.pair, noise_m) for one in made]
    drive = root / "raw" / NAME[:10] / NAME / "velodyne_points" / "data"
    drive.mkdir(parents=True)
    for one in made:
        for k, rows in enumerate(one.rows):
            rows.astype("<f4").tofile(drive / f"{one.pair.frame0 + k:010d}.bin")
    path = folder / "data" / f"{NAME}-00000.parquet"
    write_shard(path, shown, shard_metadata(CONFIG, load_profile(), [MODEL]))
    write_whole_index(folder, [shard_entry(folder, path, NAME, shown[0].recording, len(shown))])
    return shown


def _as_shown(pair: AugmentedPair, noise_m: float) -> AugmentedPair:
    """The pair with its virtual car said to be a model made in code, something seen in it through its rear window."""
    objects = list(pair.objects)
    objects[2] = replace(objects[2], model=MODEL.name)
    scans = (_with_seats(pair.scan0, objects[2].pose0), pair.scan1)
    if noise_m:
        rng = np.random.default_rng(5)
        scans = (_noisy(scans[0], noise_m, rng), _noisy(scans[1], noise_m, rng))
    known = {} if noise_m else {"flow0": _flow(pair, scans[0])}
    return replace(pair, scan0=scans[0], scan1=scans[1], objects=tuple(objects), **known)


def _with_seats(scan: AugmentedScan, T_velo_car: np.ndarray) -> AugmentedScan:
    """What is seen through glass put where the rear seats' heads are."""
    rows = np.flatnonzero(scan.surface == THROUGH_GLASS)
    across = np.linspace(-0.4, 0.4, len(rows))
    seats = np.stack([np.full(len(rows), -0.6), across, np.full(len(rows), 0.35)], axis=1)
    xyz = scan.xyz.copy()
    xyz[rows] = transform_points(T_velo_car, seats)
    return replace(scan, xyz=xyz)


def _flow(pair: AugmentedPair, scan: AugmentedScan) -> np.ndarray:
    return rigid_flow(replace(pair, scan0=scan)).astype(np.float32)


def _noisy(scan: AugmentedScan, noise_m: float, rng: np.random.Generator) -> AugmentedScan:
    xyz = (scan.xyz + rng.normal(0.0, noise_m, scan.xyz.shape)).astype(np.float32)
    return replace(scan, xyz=xyz, reflectance=rng.integers(0, 100, len(scan)).astype(np.float32) / np.float32(100.0))
