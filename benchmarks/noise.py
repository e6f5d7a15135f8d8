"""The shipped noise profile on real scans, drive by drive, at range steps of virtual cars, and what it costs.

Figures of `augkitti judge-noise` for each recording; range steps of a data set whose near side is a virtual car, beside
labelled vehicles'; milliseconds of `simulate_returns` with and without the learned noise of solid surfaces.

Usage: python benchmarks/noise.py KITTI_ROOT [DATASET]
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import augkitti
from augkitti import kitti, noise_patches, range_noise
from augkitti.config import Config
from augkitti.labelled_views import vehicle_views
from augkitti.parametric_cars import parametric_cars
from augkitti.resimulate import best_model, cast_in_place
from augkitti.scan_pair import NO_TICK, Scan
from augkitti.scanner import fire_rays, load_profile
from augkitti.sensor_noise import CarLook, simulate_returns
from pipelines.judge_noise import drop_classes, figures_of, judge_scans, raw_scans, ray_conditions, table

OUTCOMES = ("clean", "far", "mixed", "nothing")


def judge_drives(root: kitti.KittiRoot) -> None:
    scanner, noise = load_profile(), range_noise.load_noise()
    judged = judge_scans(raw_scans(root), scanner)
    for name in sorted(set(judged.recording)):
        its = judged.of(np.flatnonzero(judged.recording == name))
        print(f"\n{name}")
        print("\n".join(table(figures_of(noise, its))))
        at = ray_conditions(its.rays)
        lost = range_noise.miss_chance(noise, noise.shipped_drop, at)
        for label, expected, seen in drop_classes(lost, ~its.rays.returned, at):
            if not 0.6 <= expected / max(seen, 1) <= 1.7:
                print(f"  {label}: {expected:.0f} foretold, {seen} seen")


def edges_of_cars(folder: Path) -> None:
    """Outcomes at range steps whose near side is simulated."""
    profile, counts = load_profile(), np.zeros(4)
    for pair in augkitti.open(folder):
        if pair.scan_kind != "raw":
            continue
        scan = pair.scan0
        ticks = np.unique(scan.tick[(scan.tick != NO_TICK) & (scan.source >= 0)])
        column = np.full(profile.lattice_size, -1)
        column[ticks] = np.arange(len(ticks))
        known = (scan.tick != NO_TICK) & (column[np.minimum(scan.tick, profile.lattice_size - 1)] >= 0)
        rays = fire_rays(profile, ticks, 0.1035)
        point = rays.ray_point.copy()
        point[scan.ring[known].astype(int) * len(ticks) + column[scan.tick[known]]] = np.flatnonzero(known)
        marked = Scan(
            scan.xyz, (scan.source < 0).astype(np.float32), np.arange(len(scan)), len(scan), "raw", 0.0, 0.1035
        )
        edges = noise_patches.judge_edges(marked, replace(rays, ray_point=point), profile)
        counts += np.bincount(edges.outcome[edges.reflectance_near > 0.5], minlength=4)
    shares = ", ".join(f"{name} {share:.3f}" for name, share in zip(OUTCOMES, counts / counts.sum(), strict=True))
    print(f"\nrange steps from virtual cars ({counts.sum():.0f}): {shares}")


def cost(root: kitti.KittiRoot) -> None:
    """Milliseconds a car and scan, least of five rounds over labelled vehicles' places."""
    profile = load_profile()
    plain_noise = {key: value for key, value in profile.content["noise"].items() if key != "solid"}
    plain = replace(profile, content={**profile.content, "noise": plain_noise})
    models, views = parametric_cars(), list(vehicle_views(root, profile))[::3]
    hits = [(v, cast_in_place(v, best_model(models, v.box, v.category), profile, Config()).hits) for v in views]
    for name, its in (("constants", plain), ("learned", profile)):
        best = np.inf
        for _ in range(6):
            rng, start = np.random.default_rng(0), time.perf_counter()
            for view, met in hits:
                simulate_returns(met, CarLook(0.5, 0.5), view.scan.rays, its, False, rng)
            best = min(best, time.perf_counter() - start)
        rays = np.mean([len(met.ray) for _, met in hits])
        print(f"simulate_returns, {name}: {1e3 * best / len(hits):.2f} ms a car and scan ({rays:.0f} rays)")


def main(root: Path, folder: Path | None) -> None:
    opened = kitti.open_root(root)
    cost(opened)
    if folder is not None:
        edges_of_cars(folder)
    judge_drives(opened)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
