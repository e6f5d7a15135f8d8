"""How well scans fit the beam table: points assigned to a fired ray, their distance from it, and the time it takes.

Usage: python benchmarks/rays.py [KITTI_ROOT]
"""

import sys
import time
from pathlib import Path

import numpy as np

from augkitti import kitti
from augkitti.scan_pair import NO_TICK
from augkitti.scanner import assign_rays, load_profile, ray_distance


def main() -> None:
    profile = load_profile()
    print("| sequence | scans | least share assigned | worst median mm | p99.9 mm | fired ticks | return rate | ms |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for sequence in kitti.open_root(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti")).sequences:
        shares, medians, tails, ticks, rates, times = [], [], [], [], [], []
        for frame in sequence.frames:
            scan = kitti.read_scan(sequence, frame)
            start = time.process_time()
            rays = assign_rays(scan, profile)
            times.append(1e3 * (time.process_time() - start))
            distance = 1e3 * ray_distance(scan, rays, profile)
            shares.append(float(np.mean(rays.tick != NO_TICK)))
            medians.append(float(np.median(distance)))
            tails.append(float(np.quantile(distance, 0.999)))
            ticks.append(len(np.unique(rays.ray_tick[rays.ray_tick != NO_TICK])))
            rates.append(float(np.mean(rays.ray_point >= 0)))
        fired = f"{min(ticks)} to {max(ticks)}" if sequence.kind == "raw" else "not known"
        share = f"{min(shares):.6f}" if sequence.kind == "raw" else "compensated"
        print(
            f"| {sequence.name} | {len(shares)} | {share} | {max(medians):.3f} | {max(tails):.3f} | {fired} "
            f"| {np.mean(rates):.3f} | {np.median(times):.0f} |"
        )


if __name__ == "__main__":
    main()
