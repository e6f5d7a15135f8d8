"""How well `augkitti fit-sensor` finds the scanner: each field beside an independent measurement, and drives left out.

Usage: python benchmarks/fit_sensor.py [KITTI_ROOT [REFERENCE_JSON]]
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from augkitti import kitti
from augkitti.fit_sensor import SourceScan, fit_beams, fitted_profile, gather, profile_content, table_profile
from augkitti.scanner import assign_rays, load_profile
from pipelines.fit_sensor import fit, fit_sensor, raw_places, read


def main() -> None:
    root = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti")
    reference = json.loads(Path(sys.argv[2] if len(sys.argv) > 2 else root.parent / REFERENCE).read_text())
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        fit_sensor(root, Path(folder) / "profile")
        print(f"\n{time.process_time() - start:.1f} s\n")
        profile = load_profile(Path(folder) / "profile")
    compare(profile.content, reference)
    leave_out(root)
    few_scans(root, reference)


REFERENCE = "reference/hdl64e_kitti_2011_09_26.json"


def differences(content: dict, reference: dict) -> dict[str, np.ndarray]:
    """Fitted minus reference, a number a beam; ticks may be counted from another one, common to all beams."""
    beams = reference["beams"]

    def column(key: str) -> np.ndarray:
        return np.array(content[key], dtype=float) - np.array([beam[key] for beam in beams], dtype=float)

    step = reference["tick_step_rad"]
    ticks = column("tick_offset")
    total = column("azimuth_rad") + step * ticks
    common = np.rint(np.median(total) / step)
    quantum = 1e3 * reference["range_quantum_m"]
    return {
        "elevation, deg": np.degrees(column("elevation_rad")),
        "height, mm": 1e3 * column("height_m"),
        "side, mm": 1e3 * column("side_m"),
        f"azimuth with ticks, deg (common: {common:g} ticks)": np.degrees(total - common * step),
        "range phase, mm": (column("range_phase_mm") + quantum / 2) % quantum - quantum / 2,
        "tick offset, ticks": ticks - common,
    }


def compare(content: dict, reference: dict) -> None:
    print("| field | largest difference | RMS |")
    print("| --- | --- | --- |")
    found = differences(content, reference)
    for name, off in found.items():
        print(f"| {name} | {np.abs(off).max():.5f} | {np.sqrt((off**2).mean()):.5f} |")
    print(f"\ntick offsets equal: {int((found['tick offset, ticks'] == 0).sum())} of {len(reference['beams'])}")
    for key in ("lattice_size", "seam_tick", "spin", "firing_period_s", "range_quantum_m", "coordinate_quantum_m"):
        print(f"{key}: {content[key]}, reference {reference[key]}")
    silent = fitted_profile(content).blind
    known = np.zeros_like(silent)
    for ring, beam in enumerate(reference["beams"]):
        for first, last in beam["never_returned_ticks"]:
            known[ring, first : last + 1] = True
    print(
        f"rays that never return: {silent.mean():.4f} of all, reference {known.mean():.4f}; "
        f"{(silent & known).sum() / known.sum():.4f} of the reference's found, "
        f"{(silent & known).sum() / silent.sum():.4f} of those found in the reference; rays of the same kind: "
        f"{(silent == known).mean():.4f}; first ring {content['shadow_first_ring']}\n"
    )


def leave_out(root: Path) -> None:
    """Fit on all drives but one; the rest judges rays and silence."""
    places = raw_places(kitti.open_root(root))
    print(
        "| left out | scans | median mm | p99.9 mm | strays of points | silent rays, of all fired | of them returned |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for drive in sorted({sequence.recording for sequence, _ in places}):
        table, evidence, _ = fit([p for p in places if p[0].recording != drive], say=lambda text: None)
        profile = fitted_profile(profile_content(table, evidence, "left out"))
        judged = [s for p in places if p[0].recording == drive if (s := read(p, {})) is not None]
        seen = gather(table, judged)
        median, p999 = 1e3 * np.quantile(seen.distance_m, [0.5, 0.999])
        silent = blind = returned = 0
        for source in judged:
            rays = assign_rays(source.scan, profile)
            silent += int(rays.ray_blind.sum())
            returned += int((rays.ray_blind & (rays.ray_point >= 0)).sum())
            blind += len(rays)
        print(
            f"| {drive} | {len(judged)} | {median:.3f} | {p999:.3f} | {seen.strays} of {seen.points} | "
            f"{silent / blind:.4f} | {returned / max(silent, 1):.4f} |"
        )


def few_scans(root: Path, reference: dict) -> None:
    """Three scans of one drive."""
    places = raw_places(kitti.open_root(root))
    print("\n| three scans of | elevation deg, largest | height mm | side mm | azimuth deg | tick offsets equal |")
    print("| --- | --- | --- | --- | --- | --- |")
    for drive in sorted({sequence.recording for sequence, _ in places}):
        there = [p for p in places if p[0].recording == drive]
        scans: list[SourceScan] = [s for p in there[:3] if (s := read(p, {})) is not None]
        content = table_profile(fit_beams(scans)).content
        off = list(differences(content, reference).values())
        worst = [float(np.abs(values).max()) for values in off[:4]]
        equal = int((off[5] == 0).sum())
        print(f"| {drive} | {worst[0]:.5f} | {worst[1]:.3f} | {worst[2]:.3f} | {worst[3]:.5f} | {equal} |")


if __name__ == "__main__":
    main()
