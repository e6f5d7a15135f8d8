"""Recall and precision of the unlabelled-movers test, on exact truth and on real labels.

    python benchmarks/movers.py                      ten embedded streets, exact truth
    python benchmarks/movers.py --kitti ROOT         labelled things of real drives, by speed

Counted on the embedded streets: recall over all points (wheels and sills too) of bodies that move at least 0.3 m from
scan to scan,
have at least 10 points in scan 0 and lie within 50 m of the scanner; precision over all flagged points
within 50 m, right where the point is of a body that moves at all, wrong anywhere else (a mixed point of no body too).
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from augkitti.config import Config
from augkitti.drivable import with_headings
from augkitti.frames import box_pose, invert, points_in_box, se3_exp, se3_log, transform_points
from augkitti.ground import fit_ground, standing_points
from augkitti.kitti import open_root, read_pair
from augkitti.movers import find_movers, find_suspects, moves
from augkitti.scan_pair import PreparedScan
from augkitti.scanner import assign_rays, azimuth_time, load_profile
from augkitti.street import body_poses
from augkitti.synthesize import drive_street, synthesize

MIN_MOTION_M, MIN_POINTS, REACH_M = 0.3, 10, 50.0


def prepare(scan, profile, config):
    nowhere = with_headings((0.0, 0.0), 1.0, np.zeros((1, 1), bool), 0.0)
    ground = fit_ground(scan.xyz, config.ground)
    return PreparedScan(scan, assign_rays(scan, profile), ground, nowhere, standing_points(scan.xyz, ground))


def on_streets(root, seed, frames, config, profile, verbose):
    hit = wanted = right = flagged = 0
    bodies_hit = bodies = 0
    times = []
    for index, sequence in enumerate(open_root(root).sequences):
        street = drive_street(seed, index, frames, profile.period_s)
        for frame0, _ in sequence.pairs:
            pair = read_pair(sequence, frame0)
            scan0, scan1 = prepare(pair.scan0, profile, config), prepare(pair.scan1, profile, config)
            start = time.process_time()
            found = find_movers(pair, scan0, scan1, config.movers)
            times.append(time.process_time() - start)
            truth = np.load(sequence.folder / "truth" / f"{frame0:010d}.npz")
            owner = truth["object"][pair.scan0.row]
            moving = truth["moving"][pair.scan0.row]
            near = np.hypot(pair.scan0.xyz[:, 0], pair.scan0.xyz[:, 1]) <= REACH_M
            world = np.array([0.0, pair.scan1.time_s - pair.scan0.time_s]) + frame0 * profile.period_s
            for number in np.unique(owner[owner >= 0]):
                mine = owner == number
                poses = body_poses(street.bodies[number], world)
                step = float(np.sqrt(((poses[1, :3, 3] - poses[0, :3, 3]) ** 2).sum()))
                if step < MIN_MOTION_M or mine.sum() < MIN_POINTS or near[mine].mean() < 0.5 or not moving[mine].any():
                    continue
                share = float(found[mine].mean())
                hit, wanted = hit + int(found[mine].sum()), wanted + int(mine.sum())
                bodies, bodies_hit = bodies + 1, bodies_hit + (share >= 0.5)
                if verbose and share < 0.8:
                    at = pair.scan0.xyz[mine].mean(axis=0).round(1)
                    print(f"  {sequence.name}/{frame0}: {mine.sum()} points at {at}, {step:.2f} m, found {share:.2f}")
            flagged += int((found & near).sum())
            right += int((found & near & moving).sum())
            if verbose:
                for suspect in find_suspects(pair, scan0, scan1, config.movers):
                    if moves(suspect, config.movers) and moving[suspect.points].mean() < 0.5:
                        print(
                            "  wrong:",
                            f"{sequence.name}/{frame0}",
                            len(suspect.points),
                            suspect.visible,
                            suspect.against,
                            suspect.met,
                            suspect.motion_m,
                            round(suspect.misfit_still_m, 2),
                            round(suspect.misfit_moved_m, 2),
                            pair.scan0.xyz[suspect.points].mean(axis=0).round(1),
                            f"moving {moving[suspect.points].mean():.2f}",
                        )
    print(
        f"recall {hit / max(1, wanted):.3f} over {wanted} points ({bodies_hit} of {bodies} bodies), "
        f"precision {right / max(1, flagged):.3f} over {flagged} points, "
        f"{1e3 * np.median(times):.0f} ms a pair (median of {len(times)}, one core, scans prepared)"
    )


def over_ground(pair, first, second):
    """Metres that a labelled box moved between its two moments."""
    interval = pair.scan1.time_s - pair.scan0.time_s
    twist = se3_log(pair.ego_motion) / interval
    places = []
    for start, label, scan in ((0.0, first, pair.scan0), (interval, second, pair.scan1)):
        moment = (
            azimuth_time(float(np.arctan2(label.box[1], label.box[0])), scan.period_s) if scan.kind == "raw" else 0.0
        )
        places.append(transform_points(invert(se3_exp(twist, np.array(start + moment))), label.box[:3]))
    return float(np.hypot(*(places[1] - places[0])[:2]))


def on_labels(root, config, profile):
    classes = {"standing, below 0.1 m": (0.0, 0.1), "0.1 to 0.3 m": (0.1, 0.3), "0.3 m and more": (0.3, 9.0)}
    total = {name: np.zeros(3, dtype=int) for name in classes}
    for sequence in open_root(root).sequences:
        for frame0, _ in sequence.pairs:
            pair = read_pair(sequence, frame0)
            if not pair.labels0:
                continue
            scan0, scan1 = prepare(pair.scan0, profile, config), prepare(pair.scan1, profile, config)
            found = find_movers(pair, scan0, scan1, config.movers)
            by_id = {label.id: label for label in pair.labels1}
            for label in pair.labels0:
                inside = points_in_box(pair.scan0.xyz, box_pose(label.box), label.box[3:6]) & ~scan0.ground.is_ground
                if label.id not in by_id or inside.sum() < MIN_POINTS or np.hypot(*label.box[:2]) > REACH_M:
                    continue
                step = over_ground(pair, label, by_id[label.id])
                for name, (low, high) in classes.items():
                    if low <= step < high:
                        total[name] += [1, inside.sum(), found[inside].sum()]
    for name, (count, points, flagged) in total.items():
        print(f"{name}: {count} boxes, {points} points, flagged {flagged / max(1, points):.3f}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--streets", type=Path, help="made before with the same seed and frames")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--drives", type=int, default=10)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    profile, config = load_profile(), Config()
    if options.kitti:
        on_labels(options.kitti, config, profile)
    elif options.streets:
        on_streets(options.streets, options.seed, options.frames, config, profile, options.verbose)
    else:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "streets"
            synthesize(root, options.drives, options.frames, options.seed, profile)
            on_streets(root, options.seed, options.frames, config, profile, options.verbose)


if __name__ == "__main__":
    main()
