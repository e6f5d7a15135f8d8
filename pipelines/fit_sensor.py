"""KITTI on disk in, the folder of a scanner profile out: `profile.json` and its card, fitted on raw scans alone."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import augkitti
from augkitti import kitti
from augkitti.command_line import as_json, counted, is_json, note, print_json
from augkitti.errors import InputError
from augkitti.fit_sensor import (
    MIN_SCANS,
    MIN_SHADOW_SCANS,
    BeamTable,
    Evidence,
    SourceScan,
    fit_beams,
    fitted_profile,
    gather,
    profile_content,
)
from augkitti.kitti import KittiRoot
from augkitti.kitti import Sequence as Drive
from augkitti.scanner import PROFILE_FILE

MOST_TABLE_SCANS = 32  # of the beam table: 12 give it to 1e-5 rad
MOST_SCANS = 400  # of everything else; two minutes
_HELD_OUT_SCANS = 16  # of each half, fitted on and judged
_RUN = 10  # consecutive scans that stay together, for the seam

Say = Callable[[str], None]
Place = tuple[Drive, int]


@dataclass(frozen=True)
class HeldOut:
    """How well a beam table from some drives fits another's scans."""

    fitted_on: tuple[str, ...]
    judged_on: tuple[str, ...]
    scans: int
    left_out: int  # off the rays altogether
    median_mm: float
    p99_mm: float
    p999_mm: float
    assigned: float


def fit_sensor(root: Path, out: Path, json_file: Path | None = None, say: Say = note) -> dict[str, Any]:
    """Fit a scanner's profile on a root's raw scans and write its folder; the figures, as in `json_file`.

    Args:
        root: KITTI on disk: raw drives and object scans are used, compensated odometry scans never.
        out: folder of the profile, written.
        json_file: the figures are written there, too.
        say: what to do with messages.

    Raises:
        InputError: no raw scans, too few, scans that lie on no encoder lattice, or `out` holds a learned noise.
    """
    check_out(out)
    opened = kitti.open_root(root)
    places = raw_places(opened)
    compensated = sum(len(s.frames) for s in opened.sequences if s.kind == "compensated")
    if compensated:
        say(f"{compensated} compensated scans left out: raw and compensated scans are never mixed")
    table, evidence, unread = fit(places, say)
    content = profile_content(table, evidence, out.resolve().name or "fitted")
    fitted_profile(content)
    content["fit"]["left_out"] = [f"{drive}, frame {frame}: {why}" for (drive, frame), why in sorted(unread.items())]
    held_out = judge_held_out([p for p in places if (p[0].recording, p[1]) not in unread])
    content["fit"]["held_out"] = [vars(part) for part in held_out]
    figures: dict[str, Any] = {
        "program_version": augkitti.__version__,
        "beams": table.beams,
        **{key: value for key, value in content.items() if not isinstance(value, list | dict)},
        "blind_share": round(_blind_share(content), 5),
        **content["fit"],
    }
    if is_json():
        print_json(figures)
    else:
        for line in summary(figures):
            say(line)
    texts = {
        out / PROFILE_FILE: json.dumps(content, indent=1) + "\n",
        out / "README.md": card(content, figures),
    }
    if json_file is not None:
        texts[json_file] = as_json(figures)
    for path, text in texts.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as err:
            raise InputError(path, f"cannot be written ({err.strerror})", "name another folder") from err
    say(f"written: {out}")
    return figures


def check_out(out: Path) -> None:
    """Refuse a folder whose profile has learned noise: fitting anew would lose it.

    Raises:
        InputError: it has.
    """
    path = out / PROFILE_FILE
    try:
        noisy = path.is_file() and "noise" in json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, RecursionError):
        noisy = False
    if noisy or (out / "noise.npz").exists():
        raise InputError(out, "holds a profile with noise that was fitted on its beam table", "name another folder")


def raw_places(root: KittiRoot) -> list[Place]:
    """Drive and frame of each scan that a raw profile can be fitted on.

    Raises:
        InputError: there are too few.
    """
    places = [(s, frame) for s in root.sequences if s.kind == "raw" for frame in s.frames]
    if places:
        if len(places) < MIN_SCANS:
            raise InputError(
                root.path,
                f"{len(places)} raw scans; a beam table needs {MIN_SCANS}",
                f"give more: {MIN_SCANS} for the beam table, consecutive ones for spin and seam, {MIN_SHADOW_SCANS} of "
                "two drives for the rays that never return",
            )
        return places
    compensated = sum(len(s.frames) for s in root.sequences if s.kind == "compensated")
    raise InputError(
        root.path,
        f"all of its {compensated} scans are compensated: their points were moved off the scanner's rays",
        "give raw drives (`raw/DATE/DRIVE_sync`) or object scans; nothing of a raw profile can be fitted from these",
    )


def fit(places: Sequence[Place], say: Say = note) -> tuple[BeamTable, Evidence, dict[tuple[str, int], str]]:
    """Beam table and evidence of scans, and by drive and frame why some of them were left out.

    Scans that turn out to lie off the rays are left out and the table is fitted again.

    Raises:
        InputError: as `augkitti.fit_sensor.fit_beams` and `gather`.
    """
    unread: dict[tuple[str, int], str] = {}
    chosen = evenly(places, MOST_SCANS)
    while True:
        usable = [p for p in chosen if (p[0].recording, p[1]) not in unread]
        table_scans = list(_read_all(_spread(usable, MOST_TABLE_SCANS), unread))
        if not table_scans and unread:
            first = next(iter(unread))
            raise InputError(f"{first[0]}, frame {first[1]}", unread[first], "no scan can be used: fetch them again")
        say(f"beam table: {len(table_scans)} scans of {len({s.drive for s in table_scans})} drives")
        table = fit_beams(table_scans)
        of_table = {(s.drive, s.frame) for s in table_scans}
        del table_scans
        evidence = gather(table, _read_all(usable, unread))
        off = {(drive, frame): reason for drive, frame, reason in evidence.left_out}
        unread |= off
        if not of_table & set(off):
            return table, evidence, unread


def judge_held_out(places: Sequence[Place]) -> list[HeldOut]:
    """Fit on every other drive, judge on the rest, and the other way round; empty where drives or scans are too few."""
    by_drive: dict[str, list[Place]] = {}
    for place in places:
        by_drive.setdefault(place[0].recording, []).append(place)
    names = sorted(by_drive, key=lambda name: -len(by_drive[name]))
    halves = [[name for i, name in enumerate(names) if i % 4 in both] for both in ((0, 3), (1, 2))]
    scans: list[list[SourceScan]] = []
    for half in halves:
        there = _spread([place for name in half for place in by_drive[name]], _HELD_OUT_SCANS)
        scans.append(list(_read_all(there, {})))
    if min(len(half) for half in scans) < MIN_SCANS:
        return []
    found = []
    for fitted, judged in ((0, 1), (1, 0)):
        try:
            evidence = gather(fit_beams(scans[fitted]), scans[judged])
        except InputError:  # a half alone can lack points of a beam
            continue
        median, p99, p999 = (round(1e3 * float(q), 4) for q in np.quantile(evidence.distance_m, [0.5, 0.99, 0.999]))
        found.append(
            HeldOut(
                tuple(sorted(halves[fitted])),
                tuple(sorted(halves[judged])),
                len(scans[judged]),
                len(evidence.left_out),
                median,
                p99,
                p999,
                round(1.0 - evidence.strays / max(evidence.points, 1), 7),
            )
        )
    return found


def evenly(places: Sequence[Place], most: int) -> list[Place]:
    """At most so many scans, in runs of neighbours, spread over all."""
    if len(places) <= most:
        return list(places)
    runs = [places[i : i + _RUN] for i in range(0, len(places), _RUN)]
    picked = np.unique(np.linspace(0, len(runs) - 1, most // _RUN).astype(int))
    return [place for i in picked for place in runs[i]]


def read(place: Place, unread: dict[tuple[str, int], str]) -> SourceScan | None:
    """A scan; None where it is damaged or cut, and why goes into `unread`."""
    drive, frame = place
    try:
        scan = kitti.read_scan(drive, frame)
    except InputError as err:
        unread[drive.recording, frame] = err.problem
        return None
    stamps = drive.folder / "velodyne_points"
    timed = all((stamps / f"timestamps{part}.txt").is_file() for part in ("", "_start", "_end"))
    return SourceScan(scan, drive.recording, frame, timed and drive.layout == "raw")


def _read_all(places: Sequence[Place], unread: dict[tuple[str, int], str]) -> Iterator[SourceScan]:
    for place in counted(places, len(places), "scans"):
        source = read(place, unread)
        if source is not None:
            yield source


def _spread(places: Sequence[Place], most: int) -> list[Place]:
    """At most so many scans, as many of each drive as can be."""
    by_drive: dict[str, list[Place]] = {}
    for place in places:
        by_drive.setdefault(place[0].recording, []).append(place)
    names = list(by_drive)
    taken = dict.fromkeys(names, 0)
    while sum(taken.values()) < min(most, len(places)):
        for name in names:
            if taken[name] < len(by_drive[name]) and sum(taken.values()) < most:
                taken[name] += 1
    return [
        by_drive[name][i]
        for name in names
        for i in np.unique(np.linspace(0, len(by_drive[name]) - 1, taken[name]).astype(int))
    ]


def _blind_share(content: dict[str, Any]) -> float:
    silent = sum(last - first + 1 for runs in content["never_returned_ticks"] for first, last in runs)
    return float(silent / (len(content["never_returned_ticks"]) * content["lattice_size"]))


def summary(figures: dict[str, Any]) -> list[str]:
    """The figures in a few lines."""
    ray = figures["point_to_ray_mm"]
    seam = "measured" if figures["seam_measured_at"] is not None else "assumed"
    lines = [
        f"{figures['beams']} beams, {figures['lattice_size']} encoder steps a turn, {figures['spin']}, "
        f"seam at tick {figures['seam_tick']} ({seam}); {figures['fired_ticks'][1]} firings a scan, "
        f"every {1e6 * figures['firing_period_s']:.2f} us",
        f"point to ray: median {ray['median']:.3f} mm, 99 % {ray['p99']:.3f} mm, 99.9 % {ray['p999']:.3f} mm; "
        f"{100 * figures['points_on_fired_rays']:.4f} % of points on a fired ray",
        f"steps: range {1e3 * figures['range_quantum_m']:g} mm, coordinates "
        f"{1e3 * figures['coordinate_quantum_m']:g} mm, reflectance {figures['reflectance_quantum']:g}; "
        f"range {figures['min_range_m']:g} to {figures['max_range_m']:g} m",
        f"rays that never return: {100 * figures['blind_share']:.2f} %",
    ]
    lines += [
        f"held out ({part['scans']} scans of {', '.join(part['judged_on'])}): median {part['median_mm']:.3f} mm, "
        f"99.9 % {part['p999_mm']:.3f} mm, {100 * part['assigned']:.4f} % on a fired ray"
        for part in figures["held_out"]
    ]
    return lines + [f"note: {text}" for text in figures["cannot_tell"]]


def card(content: dict[str, Any], figures: dict[str, Any]) -> str:
    """The profile's README."""
    scans = "\n".join(f"| {drive} | {count} |" for drive, count in figures["scans"].items())
    gaps = ", ".join(f"{gap} in {100 * share:.1f} %" for gap, share in figures["gaps"].items())
    held = "\n".join(
        f"| {', '.join(p['fitted_on'])} | {', '.join(p['judged_on'])} | {p['scans']} | {p['median_mm']:.3f} | "
        f"{p['p99_mm']:.3f} | {p['p999_mm']:.3f} | {100 * p['assigned']:.4f} |"
        for p in figures["held_out"]
    )
    ray = figures["point_to_ray_mm"]
    lines = "\n".join(f"- {line}" for line in summary({**figures, "held_out": [], "cannot_tell": []}))
    out = "\n".join(f"- {text}" for text in figures["left_out"]) or "- none"
    unknown = "\n".join(f"- {text}" for text in figures["cannot_tell"])
    return f"""# Scanner profile `{content["name"]}`

Fitted by `augkitti fit-sensor` on raw scans alone; read it with `augkitti.scanner.load_profile(folder)`, or give the
folder as `--profile`. Simulation also needs noise: `augkitti fit-noise` adds it.
Scans of KITTI are CC BY-NC-SA 3.0; this profile holds measured figures only.

## Fitted on

| drive | scans |
| --- | --- |
{scans}

Left out:

{out}

## Figures

{lines}
- gaps between fired ticks: {gaps}; {figures["fired_ticks"][0]} to {figures["fired_ticks"][2]} fired ticks a scan
- {figures["consecutive_scans"]} pairs of consecutive scans looked at for spin and seam

| fitted on | judged on | scans | median mm | 99 % | 99.9 % | % on a fired ray |
| --- | --- | --- | --- | --- | --- | --- |
| all | all | {sum(figures["scans"].values())} | {ray["median"]:.3f} | {ray["p99"]:.3f} | {ray["p999"]:.3f} | \
{100 * figures["points_on_fired_rays"]:.4f} |
{held}

## What it cannot know

{unknown}
- Silent rays are a lower bound in length and an upper one in number: the fewer the drives, the more of them are scene.
"""
