"""Figures of a data set: its pairs in; totals, the motions of its cars beside those labelled in real KITTI, tables out.

Speeds are over ground and unsigned; a reversing car has a positive one. A labelled box jitters by centimetres and by
tenths of a degree from scan to scan, which over 0.1 s looks like 0.3 m/s and some degrees a second. So a labelled
motion is not taken from one pair alone: the displacements and turns of an object over neighbouring pairs of its drive
(up to five, those that the data set holds) are summed and divided by the time that they took; where no neighbour is
there, it is the pair's own. Half turns (a box labelled back to front in one scan) are taken out of the turn.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from augkitti.command_line import signed
from augkitti.dataset import Dataset
from augkitti.draw import CAR_COLOURS, SURFACE_COLOURS, figure_to
from augkitti.frames import F64, compose, invert, se3_exp, se3_log, yaw_of
from augkitti.scan_pair import SURFACE_NAMES, AugmentedPair, ObjectRecord

if TYPE_CHECKING:
    from rich.console import RenderableType

VEHICLES = ("Car", "Van", "Truck")
WANTED_SPREAD = 2.0  # the data set's purpose: spreads of speed and yaw rate at least this many times the labelled ones
_NEIGHBOURS = 2  # pairs before and after that steady a labelled motion
_RANGE_EDGES_M = (0.0, 8.0, 12.0, 18.0, 25.0, 35.0, 45.0, 60.0, 80.0)  # the classes of scanner.md section 3
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True, eq=False)
class Motions:
    """Over-ground motions of cars, one entry a car and pair."""

    speed_mps: F64  # (C,) at least 0
    yaw_rate_rps: F64  # (C,) counter-clockwise


@dataclass(frozen=True, eq=False)
class Info:
    """What `augkitti info` tells."""

    pairs: int
    pairs_of_sequence: dict[str, int]  # by name
    objects: dict[str, int]  # "virtual Car", "labelled Van", ... by name
    points: int  # of both scans of all pairs
    simulated_points: int
    car_points: int  # points of cars, vans and trucks, virtual or labelled
    removed_points: int
    unknown_flow_points: int
    points0: int  # of scan 0 of all pairs
    surfaces: tuple[int, ...]  # points by contract surface
    range_counts: F64  # points by range, 1 m classes from 0 to 80
    car_range_counts: F64  # the same of simulated points
    virtual: Motions
    labelled: Motions  # cars, vans and trucks labelled in real KITTI; empty where there are none
    car_range_m: F64  # (V,) of virtual cars, in scan 0
    car_points0: F64  # (V,) returns in scan 0
    car_rays0: F64  # (V,) rays that would meet it

    def as_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "pairs": self.pairs,
            "pairs_of_sequence": self.pairs_of_sequence,
            "objects": self.objects,
            "points": self.points,
            "simulated_points": self.simulated_points,
            "car_points": self.car_points,
            "car_point_share": _share(self.car_points, self.points),
            "removed_points": self.removed_points,
            "unknown_flow_share": _share(self.unknown_flow_points, self.points0),
            "surfaces": dict(zip(SURFACE_NAMES, self.surfaces, strict=True)),
            "virtual": _motion_dict(self.virtual),
            "labelled": _motion_dict(self.labelled),
            "spread_ratio": self.spread_ratios(),
            "points_by_range": [
                {"from_m": low, "to_m": high, "cars": cars, "points_10_50_90": points, "returned_share": share}
                for low, high, cars, points, share in self.points_by_range()
            ],
            "range_counts_1m": [int(n) for n in self.range_counts],
            "simulated_range_counts_1m": [int(n) for n in self.car_range_counts],
        }

    def spread_ratios(self) -> dict[str, float | None]:
        """Standard deviations of virtual over labelled speeds and yaw rates; None without two of each."""
        pairs = (
            ("speed", self.virtual.speed_mps, self.labelled.speed_mps),
            ("yaw_rate", self.virtual.yaw_rate_rps, self.labelled.yaw_rate_rps),
        )
        return {
            name: float(a.std() / b.std()) if len(a) > 1 and len(b) > 1 and b.std() > 0 else None
            for name, a, b in pairs
        }

    def points_by_range(self) -> list[tuple[float, float, int, list[float], float]]:
        """By range class: from, to (metres), virtual cars, 10/50/90 % of their points, share of rays that returned."""
        rows = []
        for low, high in pairwise(_RANGE_EDGES_M):
            mine = (self.car_range_m >= low) & (self.car_range_m < high)
            if mine.any():
                points = [float(q) for q in np.quantile(self.car_points0[mine], (0.1, 0.5, 0.9))]
                share = float(self.car_points0[mine].sum() / max(1.0, self.car_rays0[mine].sum()))
                rows.append((low, high, int(mine.sum()), points, share))
        return rows


def dataset_info(folder: Path, labelled: Motions | None = None) -> Info:
    """Figures of a finished data set.

    Args:
        folder: what `augkitti generate` wrote.
        labelled: motions of real labelled cars to compare with; None: those that stand in the shards themselves.

    Raises:
        InputError: no data set there, or an unreadable shard.
    """
    return info_of_pairs(Dataset(folder), labelled)


def info_of_pairs(pairs: Iterable[AugmentedPair], labelled: Motions | None = None) -> Info:
    """Figures of pairs, one pass over them; see `dataset_info`."""
    count, points, points0, removed, unknown, car_points = 0, 0, 0, 0, 0, 0
    of_sequence: dict[str, int] = {}
    objects: dict[str, int] = {}
    surfaces = np.zeros(len(SURFACE_NAMES), dtype=np.int64)
    by_range, cars_by_range = np.zeros(80), np.zeros(80)
    cars: list[tuple[float, float, float, float, float]] = []
    tracks: dict[tuple[str, str], dict[int, _Step]] = {}
    for pair in pairs:
        count += 1
        of_sequence[pair.sequence] = of_sequence.get(pair.sequence, 0) + 1
        vehicles = [row for row, item in enumerate(pair.objects) if item.category in VEHICLES]
        for scan in (pair.scan0, pair.scan1):
            points += len(scan)
            removed += len(scan.removed)
            car_points += int(np.isin(scan.instance, vehicles).sum())
            surfaces += np.bincount(scan.surface, minlength=len(SURFACE_NAMES))[: len(SURFACE_NAMES)]
            distance = np.minimum(np.sqrt((scan.xyz.astype(np.float64) ** 2).sum(axis=1)), 79.9).astype(np.int64)
            by_range += np.bincount(distance, minlength=80)
            cars_by_range += np.bincount(distance[scan.source < 0], minlength=80)
        points0 += len(pair.scan0)
        unknown += int((pair.flow_status0 != 0).sum())
        for item in pair.objects:
            name = f"{item.origin} {item.category}"
            objects[name] = objects.get(name, 0) + 1
            if item.origin == "virtual" and item.box0 is not None:
                distance_m = float(np.hypot(item.box0[0], item.box0[1]))
                motion = abs(item.speed or 0.0), item.yaw_rate or 0.0
                cars.append((*motion, distance_m, float(item.points0), float(item.rays0 or 0)))
            elif item.origin == "labelled" and item.category in VEHICLES and item.motion is not None:
                track = tracks.setdefault((pair.sequence, item.id), {})
                track.setdefault(pair.frame0, _step(pair, item))  # other variants of a pair repeat it
    table = np.array(cars, dtype=np.float64).reshape(-1, 5)
    return Info(
        pairs=count,
        pairs_of_sequence=dict(sorted(of_sequence.items())),
        objects=dict(sorted(objects.items())),
        points=points,
        simulated_points=int(surfaces[1:].sum()),
        car_points=car_points,
        removed_points=removed,
        unknown_flow_points=unknown,
        points0=points0,
        surfaces=tuple(int(n) for n in surfaces),
        range_counts=by_range,
        car_range_counts=cars_by_range,
        virtual=Motions(table[:, 0], table[:, 1]),
        labelled=labelled if labelled is not None else _steadied(tracks),
        car_range_m=table[:, 2],
        car_points0=table[:, 3],
        car_rays0=table[:, 4],
    )


# --- labelled motions ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Step:
    """What a labelled box did between its two moments, in the ground plane of the earlier one."""

    moved_m: F64  # (2,) along and across the box's own heading
    turned_rad: float
    elapsed_s: float


def _step(pair: AugmentedPair, item: ObjectRecord) -> _Step:
    """Take the ego-motion between the object's two moments out of its motion; the rest is over ground."""
    assert item.motion is not None
    assert item.box0 is not None
    interval = pair.time1 - pair.time0
    elapsed = interval + item.moment1 - item.moment0
    # Twist of the ego car: T_velo1_velo0 is over one revolution, the object's moments are `elapsed` apart.
    T_moment1_moment0 = se3_exp(se3_log(pair.ego_motion), np.array(elapsed / interval))
    T_over_ground = compose(invert(T_moment1_moment0), item.motion)  # of the object's points, in velo at moment 0
    centre = np.asarray(item.box0[:3], dtype=np.float64)
    moved = T_over_ground[:3, 3] + (T_over_ground[:3, :3] * centre).sum(axis=1) - centre
    c, s = np.cos(item.box0[6]), np.sin(item.box0[6])
    turned = (yaw_of(T_over_ground) + np.pi / 2.0) % np.pi - np.pi / 2.0  # half turns are the label's
    return _Step(np.array([moved[0] * c + moved[1] * s, moved[1] * c - moved[0] * s]), float(turned), float(elapsed))


def _steadied(tracks: dict[tuple[str, str], dict[int, _Step]]) -> Motions:
    """One motion a labelled car and pair, over the run of neighbouring pairs round it."""
    speeds, rates = [], []
    for _, track in sorted(tracks.items()):
        for frame in sorted(track):
            run = [track[frame]]
            for direction in (-1, 1):
                for away in range(1, _NEIGHBOURS + 1):
                    if frame + direction * away not in track:
                        break
                    run.append(track[frame + direction * away])
            elapsed = sum(step.elapsed_s for step in run)
            moved = sum((step.moved_m for step in run), start=np.zeros(2))
            speeds.append(float(np.hypot(moved[0], moved[1])) / elapsed)
            rates.append(sum(step.turned_rad for step in run) / elapsed)
    return Motions(np.array(speeds), np.array(rates))


# --- tables --------------------------------------------------------------------------------------------------------


def info_tables(info: Info) -> list["RenderableType"]:
    """Tables for a terminal."""
    from rich.table import Table

    totals = Table(title=signed("totals"), title_justify="left", show_header=False)
    for name, value in (
        ("pairs", f"{info.pairs:,}"),
        ("points", f"{info.points:,}"),
        ("  simulated", f"{info.simulated_points:,} ({100 * _share(info.simulated_points, info.points):.2f} %)"),
        ("  on cars, vans, trucks", f"{info.car_points:,} ({100 * _share(info.car_points, info.points):.2f} %)"),
        ("measured points removed", f"{info.removed_points:,}"),
        ("flow unknown, of scan 0", f"{100 * _share(info.unknown_flow_points, info.points0):.2f} %"),
        *((f"{name} (car and pair)", f"{number:,}") for name, number in info.objects.items()),
    ):
        totals.add_row(name, value)

    sequences = Table("sequence", "pairs", title="pairs by sequence", title_justify="left")
    for name, number in info.pairs_of_sequence.items():
        sequences.add_row(name, f"{number:,}")

    motions = Table(
        *("cars", "number", "", "mean", "std", *(f"{100 * q:.0f} %" for q in _QUANTILES)),
        title="motions over ground",
        title_justify="left",
        caption=_spread_line(info),
        caption_justify="left",
    )
    for name, cars in (("virtual", info.virtual), ("labelled", info.labelled)):
        speed, rate = cars.speed_mps, np.rad2deg(cars.yaw_rate_rps)
        for what, values in (("speed, m/s", speed), ("yaw rate, deg/s", rate)):
            figures = [f"{v:.2f}" for v in _figures(values)] if len(values) else ["-"] * (2 + len(_QUANTILES))
            motions.add_row(name, f"{len(values):,}", what, *figures)

    ranges = Table(
        *("range, m", "virtual cars", "points 10 %", "50 %", "90 %", "rays returned"),
        title="points of a virtual car in scan 0",
        title_justify="left",
    )
    for low, high, number, quantiles, share in info.points_by_range():
        ranges.add_row(f"{low:.0f} to {high:.0f}", f"{number:,}", *(f"{q:.0f}" for q in quantiles), f"{share:.2f}")

    surfaces = Table("surface", "points", "of simulated", title="surfaces", title_justify="left")
    for name, number in zip(SURFACE_NAMES[1:], info.surfaces[1:], strict=True):
        surfaces.add_row(name, f"{number:,}", f"{100 * _share(number, info.simulated_points):.1f} %")
    return [totals, sequences, motions, ranges, surfaces]


def _spread_line(info: Info) -> str:
    if len(info.labelled.speed_mps) < 2:
        return "no labelled cars with known motion in these pairs to compare the spread with"
    if len(info.virtual.speed_mps) < 2:
        return "no virtual cars to compare"
    ratios = info.spread_ratios()
    parts = []
    for name, unit, scale, a, b in (
        ("speed", "m/s", 1.0, info.virtual.speed_mps, info.labelled.speed_mps),
        ("yaw_rate", "deg/s", 180.0 / np.pi, info.virtual.yaw_rate_rps, info.labelled.yaw_rate_rps),
    ):
        ratio = ratios[name]
        verdict = "-" if ratio is None else f"{ratio:.1f} times{'' if ratio >= WANTED_SPREAD else ', below 2'}"
        spread = f"{a.std() * scale:.2f} and {b.std() * scale:.2f} {unit}"
        parts.append(f"{name.replace('_', ' ')} {spread} ({verdict})")
    return "spread (std), virtual and labelled: " + "; ".join(parts)


def _figures(values: F64) -> Sequence[float]:
    return [float(values.mean()), float(values.std()), *(float(q) for q in np.quantile(values, _QUANTILES))]


def _motion_dict(motions: Motions) -> dict[str, Any]:
    names = ("mean", "std", *(f"q{round(100 * q):02d}" for q in _QUANTILES))
    columns = (("speed_mps", motions.speed_mps), ("yaw_rate_rps", motions.yaw_rate_rps))
    return {
        "cars": len(motions.speed_mps),
        **{key: dict(zip(names, _figures(v), strict=True)) if len(v) else None for key, v in columns},
    }


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def info_json(info: Info) -> str:
    """`as_dict` as indented JSON text."""
    return json.dumps(info.as_dict(), indent=2, allow_nan=False)


# --- picture -------------------------------------------------------------------------------------------------------


def draw_info(info: Info, path: Path) -> None:
    """One PNG of the figures: motions of virtual beside labelled cars, points against range, ranges, surfaces.

    Raises:
        InputError: matplotlib is missing, or the picture cannot be written.
    """
    virtual, real, ground = CAR_COLOURS[0], CAR_COLOURS[1], "#777777"
    with figure_to(path, (15.0, 8.6)) as figure:
        axes = figure.subplots(2, 3)
        figure.subplots_adjust(left=0.055, right=0.985, top=0.86, bottom=0.075, hspace=0.36, wspace=0.3)
        title = f"{info.pairs:,} pairs, {info.points:,} points; sequences: {len(info.pairs_of_sequence)}"
        figure.suptitle(title, x=0.055, ha="left", fontsize=15, fontweight="bold")
        figure.text(0.055, 0.915, _spread_line(info), fontsize=11, color="#444444")

        fastest = max([1.0, *info.virtual.speed_mps, *info.labelled.speed_mps])
        turn = max(
            [5.0, *np.rad2deg(np.abs(info.virtual.yaw_rate_rps)), *np.rad2deg(np.abs(info.labelled.yaw_rate_rps))]
        )
        for panel, edges, label, columns in (
            (axes[0, 0], np.linspace(0.0, fastest, 26), "speed over ground, m/s", "speed_mps"),
            (axes[0, 1], np.linspace(-turn, turn, 42), "yaw rate, deg/s", "yaw_rate_rps"),
        ):
            for name, cars, colour in (("virtual", info.virtual, virtual), ("labelled", info.labelled, real)):
                values = getattr(cars, columns) * (180.0 / np.pi if columns == "yaw_rate_rps" else 1.0)
                if len(values):
                    weights = np.full(len(values), 100.0 / len(values))
                    text = f"{name}: {len(values):,}, std {values.std():.1f}"
                    panel.hist(values, edges, weights=weights, color=colour, alpha=0.25)
                    panel.hist(values, edges, weights=weights, color=colour, histtype="step", lw=1.8, label=text)
            panel.set(xlabel=label, ylabel="% of cars")
            panel.set_ylim(top=1.25 * panel.get_ylim()[1])
            if panel.get_legend_handles_labels()[0]:
                panel.legend(fontsize=9, frameon=False, loc="upper right")

        scatter = axes[0, 2]
        scatter.scatter(info.car_range_m, info.car_points0, s=7, color=virtual, alpha=0.5, linewidths=0)
        rows = info.points_by_range()
        if rows:
            middle = [(low + high) / 2.0 for low, high, *_ in rows]
            scatter.plot(middle, [row[3][1] for row in rows], color="black", lw=1.6, marker="o", ms=4, label="median")
            scatter.legend(fontsize=9, frameon=False)
            scatter.set_yscale("log")
        scatter.set(xlabel="range of a virtual car, m", ylabel="its points in scan 0")

        at = np.arange(80) + 0.5
        ranges = axes[1, 0]
        for counts, colour, name in ((info.range_counts, ground, "all"), (info.car_range_counts, virtual, "simulated")):
            if counts.sum():
                ranges.step(at, np.maximum(counts, 0.5), where="mid", color=colour, lw=1.6, label=name)
        ranges.set_yscale("log")
        ranges.set(xlabel="range of a point, m", ylabel="points in 1 m")
        if ranges.get_legend_handles_labels()[0]:
            ranges.legend(fontsize=9, frameon=False)

        names, counts = SURFACE_NAMES[1:], np.array(info.surfaces[1:], dtype=np.float64)
        shares = 100.0 * counts / max(1.0, counts.sum())
        bars = axes[1, 1].barh(range(len(names)), shares, color=SURFACE_COLOURS[1:])
        axes[1, 1].bar_label(bars, [f"{s:.1f}" for s in shares], padding=3, fontsize=9)
        axes[1, 1].set_yticks(range(len(names)), names)
        axes[1, 1].invert_yaxis()
        axes[1, 1].set(xlabel="% of simulated points", xlim=(0.0, max(1.0, float(shares.max())) * 1.3))

        sequences = sorted(info.pairs_of_sequence.items(), key=lambda entry: -entry[1])
        shown = sequences[:12]
        if len(sequences) > len(shown):
            shown.append((f"{len(sequences) - len(shown)} more", sum(n for _, n in sequences[len(shown) :])))
        if shown:
            bars = axes[1, 2].barh(range(len(shown)), [n for _, n in shown], color=ground)
            axes[1, 2].bar_label(bars, padding=3, fontsize=9)
            axes[1, 2].set_yticks(range(len(shown)), [name.removesuffix("_sync") for name, _ in shown], fontsize=8)
            axes[1, 2].set_ylim(max(len(shown), 6) - 0.4, -0.6)
        axes[1, 2].set(xlabel="pairs")
        for panel in axes.flat:
            panel.spines[["top", "right"]].set_visible(False)
