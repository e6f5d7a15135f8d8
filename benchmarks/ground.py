"""Measure ground and drivable region: `python benchmarks/ground.py KITTI [STREETS]`, tables to standard output.

STREETS is a folder that `augkitti synthesize` wrote; its truth is exact.

Needs the `odometry/sequences/08` scan 001000 with its SemanticKITTI label file for all but the first table, and
pypatchworkpp (a development dependency) for the comparison. Both run in this process, one thread, the best of five, in
processor time (what other programs do on the machine counts little).
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pypatchworkpp

from augkitti.config import Config
from augkitti.drivable import find_drivable_region, is_drivable
from augkitti.ground import fit_ground, height_at
from augkitti.kitti import KittiRoot, open_root, read_scan
from augkitti.scanner import assign_rays, load_profile

CONFIG = Config()
GROUND = (40, 44, 48, 49, 60, 72)  # road, parking, sidewalk, other ground, lane marking, terrain
ROAD = (40, 44, 60)
VEGETATION, UNLABELLED = 70, 0
RUNS = 5


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kitti", type=Path)
    parser.add_argument("streets", type=Path, nargs="?")
    args = parser.parse_args()
    root = open_root(args.kitti)
    plane_table(root)
    labelled_tables(root)
    if args.streets:
        street_table(open_root(args.streets))


def plane_table(root: KittiRoot) -> None:
    """How far the plane lies under the sensor, and how it changes from scan to scan."""
    print("| sequence | scans | height m | change p95 cm | turn p95 deg | ground ms | region ms | region m2 |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    profile = load_profile()
    for sequence in root.sequences:
        planes, times, areas = [], [], []
        for frame in sequence.frames:
            scan = read_scan(sequence, frame)
            rays = assign_rays(scan, profile)
            start = time.process_time()
            ground = fit_ground(scan.xyz, CONFIG.ground)
            middle = time.process_time()
            region = find_drivable_region(scan, rays, ground, CONFIG.drivable)
            times.append((middle - start, time.process_time() - middle))
            planes.append(ground.plane)
            areas.append(region.drivable.sum() * region.cell_m**2)
        plane = np.array(planes)
        height = plane[:, 3] / plane[:, 2]
        change = turn = "-"
        if len(plane) > 1 and sequence.layout != "object":
            cosine = np.clip((plane[1:, :3] * plane[:-1, :3]).sum(axis=1), -1.0, 1.0)
            change = f"{100 * np.percentile(np.abs(np.diff(height)), 95):.1f}"
            turn = f"{np.percentile(np.degrees(np.arccos(cosine)), 95):.2f}"
        ms = 1000.0 * np.median(times, axis=0)
        print(
            f"| {sequence.name} | {len(plane)} | {height.min():.3f} to {height.max():.3f} | {change} | {turn} "
            f"| {ms[0]:.0f} | {ms[1]:.0f} | {min(areas):.0f} to {max(areas):.0f} |"
        )


def labelled_tables(root: KittiRoot) -> None:
    """Ground beside Patchwork++, heights of the road, and the region against labels, on the one labelled scan."""
    sequence = root.sequence("odometry_08")
    scan = read_scan(sequence, 1000)
    labels = np.fromfile(sequence.folder / "labels" / "001000.label", dtype="<u4")[scan.row] & 0xFFFF
    far = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])
    truth = np.isin(labels, GROUND)

    ground = fit_ground(scan.xyz, CONFIG.ground)
    patchwork = pypatchworkpp.patchworkpp(pypatchworkpp.Parameters())
    points = np.column_stack([scan.xyz, scan.reflectance]).astype(np.float32)
    their_ms = best_ms(lambda: patchwork.estimateGround(points))
    theirs = np.zeros(len(scan), dtype=bool)
    theirs[patchwork.getGroundIndices()] = True
    our_ms = best_ms(lambda: fit_ground(scan.xyz, CONFIG.ground))

    print("\n| ground points | precision | recall | F1 | F1 without vegetation and unlabelled | ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    clear = ~np.isin(labels, (VEGETATION, UNLABELLED))
    for name, found, ms in (("augkitti", ground.is_ground, our_ms), ("pypatchworkpp", theirs, their_ms)):
        precision, recall, f1 = scores(found, truth)
        clear_f1 = scores(found[clear], truth[clear])[2]
        print(f"| {name} | {precision:.4f} | {recall:.4f} | {f1:.4f} | {clear_f1:.4f} | {ms:.0f} |")

    error = scan.xyz[:, 2] - height_at(ground, scan.xyz[:, :2])
    print("\n| road points (40) | median of distance cm | p95 cm |\n| --- | --- | --- |")
    for near, reach in ((0, 15), (15, 30), (0, 30), (30, 60)):
        distance = 100.0 * np.abs(error[(labels == 40) & (far >= near) & (far < reach)])
        print(f"| {near} to {reach} m | {np.median(distance):.2f} | {np.percentile(distance, 95):.1f} |")

    rays = assign_rays(scan, load_profile())
    region = find_drivable_region(scan, rays, ground, CONFIG.drivable)
    ms = best_ms(lambda: find_drivable_region(scan, rays, ground, CONFIG.drivable))
    inside = is_drivable(region, scan.xyz[:, :2])
    road = np.isin(labels, ROAD)
    print("\n| drivable region, within | precision | recall | precision by area | recall by area | ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    cell = np.unique(np.floor(scan.xyz[:, :2] / 0.5).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    for reach in (30, 40, 60):
        here = truth & (far < reach)
        by_area = (area(cell, here & inside & road), area(cell, here & inside), area(cell, here & road))
        print(
            f"| {reach} m | {road[here & inside].mean():.3f} | {inside[here & road].mean():.3f} "
            f"| {by_area[0] / by_area[1]:.3f} | {by_area[0] / by_area[2]:.3f} | {ms:.0f} |"
        )


def street_table(root: KittiRoot) -> None:
    """The region against the exact truth of procedural streets, within 40 m, and the heights of their road."""
    profile = load_profile()
    rows, heights = [], []
    for sequence in root.sequences:
        for frame in sequence.frames:
            scan = read_scan(sequence, frame)
            truth = np.load(sequence.folder / "truth" / f"{frame:010d}.npz")["ground"][scan.row]
            ground = fit_ground(scan.xyz, CONFIG.ground)
            region = find_drivable_region(scan, assign_rays(scan, profile), ground, CONFIG.drivable)
            here = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 40.0
            inside = here & is_drivable(region, scan.xyz[:, :2]) & (truth > 0)
            road = here & (truth == 1)
            rows.append([(inside & road).sum(), inside.sum(), road.sum()])
            heights.append(np.median(np.abs(scan.xyz[road, 2] - height_at(ground, scan.xyz[road, :2]))))
    hits, found, all_road = np.array(rows, dtype=np.float64).T
    print("\n| streets | scans | precision | worst | recall | worst | road height, median cm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    print(
        f"| {len(root.sequences)} | {len(rows)} | {hits.sum() / found.sum():.3f} | {(hits / found).min():.3f} "
        f"| {hits.sum() / all_road.sum():.3f} | {(hits / all_road).min():.3f} | {100 * np.median(heights):.2f} |"
    )


def area(cell: np.ndarray, mask: np.ndarray) -> int:
    """Number of half-metre cells with a masked point in them."""
    return len(np.unique(cell[mask]))


def scores(found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Precision, recall and F1 of two masks."""
    hits = (found & truth).sum()
    precision, recall = hits / found.sum(), hits / truth.sum()
    return precision, recall, 2.0 * precision * recall / (precision + recall)


def best_ms(call: Callable[[], object]) -> float:
    """The shortest of several runs, milliseconds."""
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1000.0 * min(times)


if __name__ == "__main__":
    main()
