"""How much a procedural street looks like KITTI: return rate by ring, ranges, heights; a picture of both.

Usage: python benchmarks/street_vs_real.py KITTI_ROOT SYNTHETIC_ROOT [PICTURE.png]

Real: every fourth scan of each raw drive. Synthetic: the first and last scan of each drive. Figures are means over
drives of each drive's mean; "between drives" is the standard deviation over the real drives, to judge differences by.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from augkitti import kitti
from augkitti.scan_pair import NO_TICK
from augkitti.scanner import assign_rays, load_profile

PROFILE = load_profile()
RANGES_M = (0, 4, 6, 8, 10, 15, 20, 30, 40, 60, 80)
HEIGHTS_M = (-4, -2.2, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 3.0)


def figures(root: Path, choose):
    """Return rate (64,), range and height shares, share of reflectance 0 and neighbour correlation, one row a drive."""
    drives = []
    for sequence in kitti.open_root(root).sequences:
        if sequence.layout != "raw":
            continue
        rows = []
        for frame in choose(sequence.frames):
            scan = kitti.read_scan(sequence, frame)
            rays = assign_rays(scan, PROFILE)
            on = rays.ray_tick != NO_TICK
            fired = np.bincount(rays.ray_ring[on], minlength=64)
            back = np.bincount(rays.ray_ring[on & (rays.ray_point >= 0)], minlength=64)
            distance = np.sqrt((scan.xyz**2).sum(axis=1))
            near = distance < 40
            returned = (rays.ray_point >= 0)[on].reshape(64, -1)
            reach = np.where(returned, distance[rays.ray_point[on].reshape(64, -1)], np.nan)
            both = np.isfinite(reach[:, 1:]) & np.isfinite(reach[:, :-1])
            steps = np.abs(np.diff(reach, axis=1))[both]
            rows.append(
                np.concatenate(
                    [
                        back / fired,
                        np.histogram(distance, RANGES_M)[0] / len(scan),
                        np.histogram(scan.xyz[near, 2], HEIGHTS_M)[0] / near.sum(),
                        [
                            back.sum() / fired.sum(),
                            len(scan),
                            (scan.reflectance == 0).mean(),
                            scan.reflectance.mean(),
                            np.corrcoef(scan.reflectance[:-1], scan.reflectance[1:])[0, 1],
                            (steps > 0.3).mean(),
                        ],
                    ]
                )
            )
        drives.append(np.mean(rows, axis=0))
        print(f"  {sequence.name}: {len(rows)} scans, return rate {drives[-1][-6]:.3f}, {drives[-1][-5]:.0f} points")
    return np.array(drives)


def table(title: str, names, real, synthetic) -> None:
    print(f"\n{title:26s} {'real':>8s} {'street':>8s} {'between drives':>15s}")
    for i, name in enumerate(names):
        print(f"{name:26s} {real[:, i].mean():8.3f} {synthetic[:, i].mean():8.3f} {real[:, i].std():15.3f}")


def range_image(scan):
    """Ranges (64, fired) with nan where nothing returned, straight ahead in the middle."""
    rays = assign_rays(scan, PROFILE)
    on = rays.ray_tick != NO_TICK
    reach = np.where(rays.ray_point >= 0, np.sqrt((scan.xyz**2).sum(axis=1))[rays.ray_point], np.nan)[on]
    azimuth, ring = rays.ray_azimuth_rad[on], rays.ray_ring[on]
    image = np.full((64, 1600), np.nan)
    image[ring, np.clip(((np.pi - azimuth) / (2 * np.pi) * 1600).astype(int), 0, 1599)] = reach
    return image


def picture(real: Path, synthetic: Path, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    def some(root, count):
        found = [s for s in kitti.open_root(root).sequences if s.layout == "raw"][:count]
        return [(s.name, kitti.read_scan(s, s.frames[len(s.frames) // 2])) for s in found]

    scans = [*some(real, 3), *some(synthetic, 5)]
    grid = plt.figure(figsize=(22, 3.0 * len(scans)), dpi=75)
    for i, (name, scan) in enumerate(scans):
        above = grid.add_axes([0.0, 1 - (i + 1) / len(scans), 0.2, 0.96 / len(scans)])
        above.scatter(scan.xyz[:, 0], scan.xyz[:, 1], s=0.12, c=scan.xyz[:, 2], vmin=-2, vmax=2, cmap="viridis")
        above.set(xlim=(-45, 45), ylim=(-33, 33), xticks=[], yticks=[])
        images = grid.add_axes([0.21, 1 - (i + 0.98) / len(scans), 0.79, 0.90 / len(scans)])
        images.imshow(np.log(range_image(scan)), aspect="auto", cmap="turbo", vmin=1, vmax=4.4, interpolation="nearest")
        images.set(xticks=[], yticks=[], title=name)
    grid.savefig(path)


def main() -> None:
    real_root, synthetic_root = Path(sys.argv[1]), Path(sys.argv[2])
    print("real")
    real = figures(real_root, lambda frames: frames[::4])
    print("street")
    synthetic = figures(synthetic_root, lambda frames: (frames[0], frames[-1]))
    rings, ranges = len(PROFILE.elevation_rad), len(RANGES_M) - 1
    table("return rate, ring", [str(k) for k in range(0, 64, 4)], real[:, :rings:4], synthetic[:, :rings:4])
    difference = np.abs(real[:, :rings].mean(axis=0) - synthetic[:, :rings].mean(axis=0))
    print(f"mean and largest difference over rings: {difference.mean():.3f}, {difference.max():.3f}")
    names = [f"{a} to {b} m" for a, b in pairwise(RANGES_M)]
    at = slice(rings, rings + ranges)
    table("share of points, range", names, real[:, at], synthetic[:, at])
    names = [f"{a} to {b} m" for a, b in pairwise(HEIGHTS_M)]
    at = slice(rings + ranges, rings + ranges + len(names))
    table("share of points, height", names, real[:, at], synthetic[:, at])
    names = ["return rate", "points", "reflectance 0", "mean reflectance", "its lag-1 correlation", "steps over 0.3 m"]
    table("other", names, real[:, -6:], synthetic[:, -6:])
    if len(sys.argv) > 3:
        picture(real_root, synthetic_root, Path(sys.argv[3]))


if __name__ == "__main__":
    main()
