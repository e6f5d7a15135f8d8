"""Shares of window and body rays on real labelled vehicles, and on car models standing in their place.

Definitions of scanner.md section 3 (`augkitti.labelled_views`), applied to real and simulated returns alike. For each
labelled car or van of the raw and object scans (4 to 45 m, 80 points or more, less than 3 % of its rays covered) the
car models that fit best are put into the box's place and measured on the same rays, three times, each time as another
car: paint and tint drawn anew. Points are counted in the label box grown by 0.1 m, above the lowest 0.15 m of it.

Usage: python benchmarks/window_shares.py [KITTI_ROOT] [CAD_FOLDER]
"""

import sys
import time
from pathlib import Path

import numpy as np

from augkitti import kitti
from augkitti.cad_models import load_cad_folder
from augkitti.config import Config
from augkitti.labelled_views import (
    body_return_rate,
    car_points,
    clump_correlations,
    clump_sums,
    rejudged,
    vehicle_views,
    view_rays,
    window_shares,
)
from augkitti.parametric_cars import parametric_cars
from augkitti.resimulate import best_model, cast_in_place, measure_in_place
from augkitti.scanner import load_profile
from augkitti.sensor_noise import CarLook, simulate_returns

RANGES_M = ((4, 8), (8, 12), (12, 18), (18, 25), (25, 35), (35, 45))
DRAWS = 3


def report(name: str, rows: list, cars: list) -> None:
    """Print the figures of rows (car, window shares, body rate, distance, points, clump sums, clumps of windows)."""
    car = np.array([cars.index(row[0]) for row in rows])
    window = np.array([row[1] for row in rows])
    body, far, points = (np.array([row[k] for row in rows]) for k in (2, 3, 4))
    per_car = np.array([np.nanmean(window[car == c], axis=0) for c in range(len(cars))])
    body_per_car = np.array([body[car == c].mean() for c in range(len(cars))])
    print(f"{name}: {len(cars)} cars, {len(rows)} views")
    print("  window none, surface, inside, beyond, mean over cars:", np.round(np.nanmean(per_car, axis=0), 2))
    for k, kind in enumerate(("none", "surface", "inside", "beyond")):
        print(f"  window {kind} per car, 10/50/90 %:", np.round(np.nanquantile(per_car[:, k], [0.1, 0.5, 0.9]), 2))
    if name == "real":
        print("  body returns per car, 10/50/90 %:", np.round(np.quantile(body_per_car, [0.1, 0.5, 0.9]), 2))
    else:  # each view is a car of its own: every real car weighs the same
        order, weight = np.argsort(body), 1.0 / np.bincount(car)[car]
        share = np.cumsum(weight[order]) / weight.sum()
        print("  body returns per car, 10/50/90 %:", np.round(np.interp([0.1, 0.5, 0.9], share, body[order]), 2))
    print("  clumps, next firing, four on, next beam:", np.round(clump_correlations([r[5] for r in rows]), 2))
    print("  the same of windows:", np.round(clump_correlations([r[6] for r in rows]), 2))
    for near_m, far_m in RANGES_M:
        inside = (far >= near_m) & (far < far_m)
        if inside.any():
            quantiles = np.quantile(points[inside], [0.1, 0.5, 0.9]).round()
            print(
                f"  points {near_m}-{far_m} m, 10/50/90 %: {quantiles}, {inside.sum()} views of {len(set(car[inside]))}"
            )


def main() -> None:
    profile, config = load_profile(), Config()
    root = kitti.open_root(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti"))
    pools = [list(parametric_cars())]
    if len(sys.argv) > 2:
        pools.append(list(load_cad_folder(Path(sys.argv[2])).models))
    rng = np.random.default_rng(0)
    real, simulated, times = [], [], []
    for view in vehicle_views(root, profile):
        box_rays = view_rays(view, profile)
        real.append(row_of(view, box_rays, car_points(view, profile)))
        for pool in pools:
            cast = cast_in_place(view, best_model(pool, view.box, view.category), profile, config)
            for _ in range(DRAWS):
                look = CarLook(float(rng.random()), float(rng.random()))
                seen = measure_in_place(view, cast, look, profile, config, rng)
                simulated.append(row_of(view, rejudged(box_rays, seen.range_m), seen.points))
            before = time.process_time()
            simulate_returns(cast.hits, look, view.scan.rays, profile, False, rng)
            times.append((time.process_time() - before) * 1e3)
    cars = sorted({row[0] for row in real})
    report("real", real, cars)
    report("simulated", simulated, cars)
    print(f"simulate_returns: {np.mean(times):.2f} ms a car and scan, {np.median(times):.2f} in median")


def row_of(view, box_rays, points) -> tuple:
    """What `report` takes of one view."""
    return (
        *(view.track, window_shares(box_rays), body_return_rate(box_rays), view.distance_m, len(points)),
        *(clump_sums(box_rays), clump_sums(box_rays, box_rays.is_window)),
    )


if __name__ == "__main__":
    main()
