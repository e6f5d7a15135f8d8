"""What a realism report found: views and classifiers' figures in, checks, a verdict and `realism.json` out."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import augkitti
from augkitti import realism_features as rf
from augkitti.frames import F64
from pipelines.two_sample import AtEqualCounts, Judged, interval, mean_known, middle_known

SET = "set"  # the column of a data set's own cars
FEW_TRACKS = 10  # fewer real cars than this cannot tell
MANY_TRACKS = 30  # from here on the real cars at hand are the reference, not scanner.md's
AIM_AUC, COMMON_AUC = 0.75, 0.90  # aims
WINDOW_OF_31_CARS, BODY_OF_31_CARS = (0.62, 0.19, 0.16, 0.03), (0.38, 0.85, 0.97)  # scanner.md section 3
CLUMPS_OF_31_CARS = (0.76, 0.50, 0.29)
WINDOW_TOLERANCE, BODY_TOLERANCE, CLUMP_TOLERANCE = 0.10, 0.12, 0.15
_SHARES = (
    ("window", WINDOW_OF_31_CARS, WINDOW_TOLERANCE, "window rays: nothing, surface, inside, beyond"),
    ("body_quantiles", BODY_OF_31_CARS, BODY_TOLERANCE, "body returns of a car, 10 / 50 / 90 %"),
    ("clumps", CLUMPS_OF_31_CARS, CLUMP_TOLERANCE, "clumps: next firing, four on, next beam"),
)


@dataclass(frozen=True, eq=False)
class Summary:
    """What is kept of one view in one column."""

    track: str
    where: str  # sequence and frame
    category: str
    distance_m: float
    place: F64  # (5,) log range, bearing, heading against the line of sight, length, width
    features: F64  # (F,)
    window: F64  # (4,)
    body_rate: float
    clumps: F64  # (3, 2)
    heights: F64
    rings: F64  # (256, 2)
    holes: F64  # (H,)
    residuals: F64  # at most 400
    reflectance: F64  # (2, 100)
    bev: F64
    points: F64  # at most 400, in the box's frame
    shine: F64
    size_m: F64  # (3,)
    count: int


@dataclass(frozen=True)
class Check:
    """One thing that is asked for, and whether it is so; None: cannot be told."""

    name: str
    passed: bool | None
    detail: str


@dataclass(eq=False)
class Gathered:
    """Views row by row: row k of each column stands where row k of `real` stands (a data set's own cars do not)."""

    real: list[Summary] = field(default_factory=list)
    columns: dict[str, list[Summary]] = field(default_factory=dict)
    more: list[Summary] = field(default_factory=list)  # further cars of the full model; a track each
    examples: list[dict[str, rf.CarRays]] = field(default_factory=list)
    ray_by_ray: list[F64] = field(default_factory=list)  # (K, 6) a view: see `_compare_rays`
    set_matched: list[int] = field(default_factory=list)  # rows of `real` that a data set's cars are matched to
    set_note: str = ""


@dataclass(frozen=True, eq=False)
class Findings:
    """All figures of a report."""

    gathered: Gathered
    tracks: int
    is_synthetic: bool
    source: str
    judged: Mapping[str, Judged]  # features, by column
    points_judged: Mapping[str, Judged]
    boot: Mapping[str, F64]
    equal: Mapping[str, AtEqualCounts]
    margin: tuple[float, float]
    numbers: Mapping[str, Mapping[str, Any]]  # by column
    drops: Mapping[str, float]
    feature_separation: Mapping[str, tuple[float, float]]  # full, floor
    classes: Sequence[Mapping[str, Any]]
    resimulated: Mapping[str, Any] | None
    checks: Sequence[Check]
    verdict: str
    notes: list[str]


def per_track(views: Sequence[Summary], value: Callable[[Summary], Any]) -> F64:
    """Mean over each track's views (T, ...), views that say nothing left out; tracks that say nothing are left out."""
    by_track: dict[str, list[Any]] = {}
    for view in views:
        got = np.asarray(value(view), dtype=np.float64)
        if np.isfinite(got).all():
            by_track.setdefault(view.track, []).append(got)
    return np.array([np.mean(values, axis=0) for values in by_track.values()])


def checks_of(
    count: int,
    judged: Mapping[str, Judged],
    margin: tuple[float, float],
    numbers: Mapping[str, Mapping[str, Any]],
    classes: Sequence[Mapping[str, Any]],
    is_synthetic: bool,
) -> list[Check]:
    """What is asked for, thing by thing; with too few cars nothing can be told."""
    few = count < FEW_TRACKS
    checks = [Check(f"{FEW_TRACKS} labelled cars or more", not few, f"{count} labelled cars")]

    def add(name: str, passed: bool, detail: str) -> None:
        checks.append(Check(name, None if few else passed, detail))

    if "common" in judged:
        value = judged["common"].auc
        add(
            f"the common recipe is told from real cars: AUC {COMMON_AUC:.2f} or more",
            value >= COMMON_AUC, f"{value:.2f}",
        )  # fmt: skip
    if {"common", "full"} <= judged.keys():
        add(
            "the full model is harder to tell than the common recipe: margin above 0",
            margin[0] > 0.0, f"95 % of {margin[0]:+.2f} to {margin[1]:+.2f}",
        )  # fmt: skip
    if "full" in judged:
        value = judged["full"].auc
        add(
            f"the full model is hard to tell from real cars: AUC {AIM_AUC:.2f} or less (an aim)",
            value <= AIM_AUC, f"{value:.2f}",
        )  # fmt: skip
    at_hand = count >= MANY_TRACKS or is_synthetic
    whose = "the real cars here" if at_hand else "scanner.md's 31 real cars"
    real, full = numbers["real"], numbers.get("full")
    for key, constants, tolerance, words in _SHARES if full is not None else ():
        reference, simulated = np.asarray(real[key] if at_hand else constants), np.asarray((full or {})[key])
        passed = bool((np.abs(simulated - reference) <= tolerance).all())
        shown, against = (" / ".join(f"{v:.2f}" for v in side) for side in (simulated, reference))
        add(f"{words}: within {tolerance:.2f} of {whose}", passed, f"{shown} {'beside' if passed else 'not'} {against}")
    for row in classes:
        low, _, high = row["real"]
        value = row["simulated"].get("full", math.nan)
        title = f"points a car at {row['range_m'][0]} to {row['range_m'][1]} m: median within {low:.0f} to {high:.0f}"
        if row["enough"]:
            add(title, low <= value <= high, f"{value:.0f} ({row['cars']} real cars)")
    return checks


def verdict_of(
    count: int,
    is_synthetic: bool,
    judged: Mapping[str, Judged],
    equal: Mapping[str, AtEqualCounts],
    drops: Mapping[str, float],
    margin: tuple[float, float],
    checks: Sequence[Check],
    source: str,
) -> str:
    """The report in some sentences."""
    prefix = (
        f"This compares simulation with simulation: the labelled cars of {source} are simulated themselves. It shows "
        "that the report works, not that cars are real. "
        if is_synthetic
        else ""
    )
    if count < FEW_TRACKS:
        return (
            f"{prefix}Cannot tell: {count} labelled car{'s' if count != 1 else ''} only, {FEW_TRACKS} are needed. "
            "Give a root with more labelled drives."
        )
    failed = [check for check in checks if check.passed is False]
    score = f"{len(failed)} of {len(checks)} checks failed." if failed else f"All {len(checks)} checks passed."
    if not {"full", "common"} <= judged.keys():
        return f"{prefix}{count} labelled cars; the full model or the common recipe was not asked for. {score}"
    full, common = judged["full"].auc, judged["common"].auc
    others = "the street's own" if is_synthetic else "real ones"
    if margin[0] <= 0.0:
        head = f"The simulated cars are no harder to tell from {others} than those of the common recipe."
    elif full <= AIM_AUC:
        head = f"The simulated cars are hard to tell from {others}, as far as these cars can show."
    else:
        head = f"The simulated cars are nearer to {others} than the common recipe's, but can still be told from them."
    words = [
        f"{prefix}{head} With {count} labelled cars, a classifier tells them with AUC {full:.2f} (0.5: not at all, "
        f"1: always), those of the common recipe with {common:.2f}."
    ]
    if {"real", "full"} <= equal.keys():
        floor, at = equal["real"].auc, equal["full"].auc
        words.append(
            f"With half as many cars, {others} are told from each other with {middle_known(floor):.2f} (by chance up "
            f"to {interval(floor, 0.9)[1]:.2f}), from simulated ones with {middle_known(at):.2f}."
        )
    if SET in judged:
        one = judged[SET]
        words.append(
            f"The data set's own cars, {int(one.is_simulated.sum())} views matched to real ones: AUC {one.auc:.2f}."
        )
    seen = [name for name, drop in sorted(drops.items(), key=lambda item: -item[1]) if drop > 0.01][:3]
    if seen:
        words.append(f"What gives the simulated ones away most: {', '.join(seen)}.")
    return " ".join([*words, score])


def as_json(found: Findings) -> dict[str, Any]:
    """What `realism.json` holds; NaN becomes null."""
    full, real = found.numbers.get("full", {}), found.numbers["real"]

    def auc_of(name: str, judged: Mapping[str, Judged]) -> float:
        return judged[name].auc if name in judged else math.nan

    out = {
        "program_version": augkitti.__version__,
        "verdict": found.verdict,
        "tracks": found.tracks,
        "views": len(found.gathered.real),
        "source_is_synthetic": found.is_synthetic,
        "auc.full": auc_of("full", found.judged),
        "auc.common": auc_of("common", found.judged),
        "auc.margin_low": found.margin[0],
        "auc.margin_high": found.margin[1],
        "window": {"real": real["window"], "simulated": full.get("window")},
        "body_quantiles": {"real": real["body_quantiles"], "simulated": full.get("body_quantiles")},
        "clumps": {"real": real["clumps"], "simulated": full.get("clumps")},
        "checks": [{"name": c.name, "passed": c.passed, "detail": c.detail} for c in found.checks],
        "points_by_range": list(found.classes),
        "columns": {
            name: {
                **values,
                "auc": auc_of(name, found.judged),
                "auc_interval": list(interval(found.boot[name])) if name in found.boot else None,
                "auc_points": auc_of(name, found.points_judged),
            }
            for name, values in found.numbers.items()
        },
        "equal_counts": {
            name: {
                "auc_median": middle_known(one.auc),
                "auc_interval": list(interval(one.auc, 0.9)),
                "separation_mean": float(mean_known(one.separation)),
                "splits": len(one.auc),
            }
            for name, one in found.equal.items()
        },
        "seen_by_group": dict(found.drops),
        "separation_by_feature": {name: list(pair) for name, pair in found.feature_separation.items()},
        "resimulated": found.resimulated,
        "notes": list(found.notes),
    }
    return {key: _plain(value) for key, value in out.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    return value


def write_json(found: Findings, path: Path) -> None:
    """Write `realism.json`."""
    path.write_text(json.dumps(as_json(found), indent=1) + "\n", encoding="utf-8")
