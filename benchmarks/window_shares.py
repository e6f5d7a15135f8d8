"""Shares of window and body rays on real labelled vehicles, and on car models standing in their place.

Definitions of scanner.md section 3, applied to real and simulated returns alike. For each labelled car or van of the
raw drives (4 to 45 m, 80 points or more) every car model is put into the box's place, upright, and cast on the same
rays of the same scan; what hides the box in the real scan is left out on both sides by leaving out boxes that are
covered: 3 % or more of the body rays stopped more than 0.25 m before the box.

Usage: python benchmarks/window_shares.py [KITTI_ROOT] [CAD_FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from augkitti import kitti
from augkitti.cad_models import load_cad_folder
from augkitti.frames import box_pose, compose, invert, pose_from_xyz_yaw, rotate_vectors, transform_points
from augkitti.occlusion import measured_range
from augkitti.parametric_cars import parametric_cars
from augkitti.raycast import cast_car, cross_box, rays_near
from augkitti.scan_pair import PreparedScan
from augkitti.scanner import assign_rays, load_profile, ray_lines
from augkitti.sensor_noise import CarLook, simulate_returns

PROFILE = load_profile()
WINDOW = ((-0.30, 0.20), (-0.40, 0.40), (0.68, 0.90))
BODY = ((-0.45, 0.45), (-0.44, 0.44), (0.25, 0.50))


def crossing(origin, direction, size, zone):
    """Entry and exit (metres along each ray) of a zone given in shares of length, width and height above the floor."""
    low = np.array([zone[0][0] * size[0], zone[1][0] * size[1], (zone[2][0] - 0.5) * size[2]])
    high = np.array([zone[0][1] * size[0], zone[1][1] * size[1], (zone[2][1] - 0.5) * size[2]])
    return cross_box(origin, direction, low, high)


def shares(T_velo_box, size, rays, ray, measured):
    """(none, surface, inside, beyond) of window rays, return share of body rays, share of body rays covered, counts."""
    origin, direction = ray_lines(PROFILE, rays.ray_ring[ray], rays.ray_azimuth_rad[ray], rays.ray_elevation_rad[ray])
    T = invert(T_velo_box)
    o, d = transform_points(T, origin), rotate_vectors(T, direction)
    whole = ((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0))
    box_in, box_out = crossing(o, d, size, whole)
    win_in, win_out = crossing(o, d, size, WINDOW)
    window = (win_out - win_in > 0.25) & ~(measured < box_in - 0.25)
    none = ~np.isfinite(measured)
    surface = measured < win_in + 0.2
    beyond = np.isfinite(measured) & (measured > box_out + 0.1)
    inside = ~none & ~surface & ~beyond
    body_in, body_out = crossing(o, d, size, BODY)
    body = body_out - body_in > 0.25
    covered = float((measured[body] < box_in[body] - 0.25).mean()) if body.any() else 1.0
    returned = float((measured[body] <= box_out[body] + 0.1).mean()) if body.any() else 0.0
    w = window
    four = [float(x[w].mean()) if w.any() else np.nan for x in (none, surface & ~none, inside, beyond)]
    return four, returned, covered, int(w.sum()), int(body.sum()), (body, window)


def clump(rays, ray, flags, chosen):
    """Correlation of "returned" to the next firing, four on, and the next beam at the same azimuth."""
    ring = rays.ray_ring[ray].astype(int)
    azimuth = rays.ray_azimuth_rad[ray]
    column = np.rint(azimuth * 2150 / (2 * np.pi)).astype(int) + 2000
    grid = np.full((64, 5000), np.nan)
    grid[ring[chosen], column[chosen]] = flags[chosen]
    pairs = []
    for shift_ring, shift in ((0, 1), (0, 4), (1, 0)):
        a = grid[: 64 - shift_ring, : 5000 - shift]
        b = grid[shift_ring:, shift:]
        ok = np.isfinite(a) & np.isfinite(b)
        pairs.append((a[ok], b[ok]))
    return pairs


def main() -> None:
    root = kitti.open_root(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti"))
    models = load_cad_folder(Path(sys.argv[2]), ("Car",)).models if len(sys.argv) > 2 else parametric_cars()
    models = [m for m in models if m.category == "Car"]
    real, simulated = [], []
    lag = {"real": [[], [], []], "simulated": [[], [], []]}
    points_by_range = {"real": [], "simulated": []}
    rng = np.random.default_rng(0)
    for sequence in root.sequences:
        if sequence.kind != "raw":
            continue
        for frame in sequence.frames:
            labels = [b for b in kitti.read_labels(sequence, frame) if b.category in ("Car", "Van")]
            if not labels:
                continue
            scan = kitti.read_scan(sequence, frame)
            prepared = PreparedScan(scan, assign_rays(scan, PROFILE), None, None, None)
            for label in labels:
                T, size = box_pose(label.box), label.box[3:6]
                distance = float(np.hypot(*label.box[:2]))
                ray = rays_near(prepared.rays, T, size, 0.5)
                ray = ray[(prepared.rays.ray_tick[ray] != 65535) & ~prepared.rays.ray_blind[ray]]
                measured = measured_range(prepared, ray, PROFILE)
                four, body, covered, windows, bodies, (is_body, _) = shares(T, size, prepared.rays, ray, measured)
                local = transform_points(invert(T), scan.xyz)
                inside = (np.abs(local) <= size / 2).all(1) & (local[:, 2] > -size[2] / 2 + 0.15)
                if not 4 <= distance <= 45 or inside.sum() < 80 or covered >= 0.03 or windows < 20 or bodies < 20:
                    continue
                key = (sequence.name, label.id)
                real.append((key, four, body, distance))
                points_by_range["real"].append((distance, int(inside.sum())))
                for i, pair in enumerate(clump(prepared.rays, ray, np.isfinite(measured).astype(float), is_body)):
                    lag["real"][i].append(pair)
                for _ in range(3):
                    model = models[int(rng.integers(len(models)))]
                    upright = compose(T, pose_from_xyz_yaw(0, 0, (model.size_m[2] - size[2]) / 2, 0.0))
                    near = rays_near(prepared.rays, upright, model.size_m, 0.3)
                    near = near[(prepared.rays.ray_tick[near] != 65535) & ~prepared.rays.ray_blind[near]]
                    still = np.broadcast_to(invert(upright), (len(near), 4, 4))
                    hits = cast_car(model, still, prepared.rays, near, PROFILE, False)
                    look = CarLook(float(rng.random()), float(rng.random()))
                    returns = simulate_returns(hits, look, prepared.rays, PROFILE, False, rng)
                    outcome = measured_range(prepared, near, PROFILE)
                    behind = (
                        outcome > distance + 4.0
                    )  # the real car is not there any more: what is behind it is unknown
                    outcome = np.where(behind, outcome, np.inf)
                    where = np.searchsorted(near, hits.ray)
                    outcome[where] = np.where(
                        np.isfinite(returns.stop_m), np.where(returns.returned, returns.range_m, np.inf), outcome[where]
                    )
                    passed = np.zeros(len(near), bool)
                    passed[where] = ~np.isfinite(returns.stop_m)
                    outcome[passed] = np.where(rng.random(int(passed.sum())) < 0.7, 60.0, np.inf)
                    four, body, _, _, _, (is_body, _) = shares(upright, model.size_m, prepared.rays, near, outcome)
                    simulated.append((key, four, body, distance, model.name))
                    points_by_range["simulated"].append((distance, int(returns.returned.sum())))
                    for i, pair in enumerate(clump(prepared.rays, near, np.isfinite(outcome).astype(float), is_body)):
                        lag["simulated"][i].append(pair)
    for name, rows in (("real", real), ("simulated", simulated)):
        cars = sorted({row[0] for row in rows})
        per_car = np.array([np.nanmean([row[1] for row in rows if row[0] == car], axis=0) for car in cars])
        body = np.array([np.mean([row[2] for row in rows if row[0] == car]) for car in cars])
        single = np.array([row[2] for row in rows])
        correlations = [
            np.corrcoef(np.concatenate([p[0] for p in lag[name][i]]), np.concatenate([p[1] for p in lag[name][i]]))[
                0, 1
            ]
            for i in range(3)
        ]
        print(f"{name}: {len(cars)} cars, {len(rows)} views")
        print("  window none, surface, inside, beyond:", np.round(np.nanmean(per_car, axis=0), 2))
        print(
            "  window none per view, 10/50/90 %:", np.round(np.nanquantile([r[1][0] for r in rows], [0.1, 0.5, 0.9]), 2)
        )
        print(
            "  body returns per view, 10/25/50/75/90 %:", np.round(np.quantile(single, [0.1, 0.25, 0.5, 0.75, 0.9]), 2)
        )
        print("  body returns per car mean:", round(float(body.mean()), 2))
        print("  clumps, next firing, four on, next beam:", np.round(correlations, 2))
        pts = np.array(points_by_range[name])
        for near_m, far_m in ((4, 8), (8, 12), (12, 18), (18, 25), (25, 35), (35, 45)):
            chosen = pts[(pts[:, 0] >= near_m) & (pts[:, 0] < far_m), 1]
            if len(chosen):
                print(
                    f"  points {near_m}-{far_m} m, 10/50/90 %:",
                    np.quantile(chosen, [0.1, 0.5, 0.9]).round(),
                    len(chosen),
                )
    if simulated:
        by_model = {}
        for row in simulated:
            by_model.setdefault(row[4], []).append([*row[1], row[2]])
        for model, values in sorted(by_model.items()):
            print(f"  {model:24s}", np.round(np.nanmean(values, axis=0), 2))


if __name__ == "__main__":
    main()
