"""Labelled vehicles of a KITTI root in, the vehicle part of a scanner profile's noise out.

A car model stands in for each labelled vehicle (`augkitti.resimulate`), so that every ray has a surface, an incidence
and a range. Counted: how strong echoes are, by kind of surface, incidence, range and car, from what each ray gave
(nothing, a zero, more than zero: an ordered probit with a score a car, whose quantiles are the paint to draw from), and
the reflectance that belongs to a strength. Simulated until alike, with common random numbers: clumps, panes and what
stands behind them, relief. Statistics are means over cars, not over rays: near cars have a hundred times the rays.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr, ndtr

from augkitti.command_line import counted
from augkitti.config import Config
from augkitti.errors import InputError
from augkitti.frames import F32, F64
from augkitti.kitti import KittiRoot
from augkitti.labelled_views import (
    INSIDE,
    SURFACE,
    BoxRays,
    VehicleView,
    body_return_rate,
    clump_correlations,
    clump_sums,
    next_beams,
    next_firings,
    rejudged,
    vehicle_views,
    view_rays,
    window_shares,
)
from augkitti.parametric_cars import parametric_cars
from augkitti.resimulate import CastInPlace, body_size, cast_in_place, measure_in_place, own_returns
from augkitti.scan_pair import GLASS, I32, LAMP, MEASURED, OTHER, PAINT, TYRE, Bool, CarModel
from augkitti.scanner import ScannerProfile, load_profile, profile_from_content
from augkitti.sensor_noise import CarLook, FieldGrid, noise_model

MIN_TRACKS = 5  # fewer cars say nothing of how cars differ
VEHICLE_KEYS = (
    *("body", "body_clump", "paint", "pane", "tyre", "lamp", "other", "glass", "glass_clump", "reflectance", "relief"),
)
_MODELS_A_VIEW = 2  # no model is the car: two err in two ways
_VIEWS_A_TRACK = 6
_FRAME_M = 0.10  # the profile's `body.frame_m`
_FRAME = 8  # a kind of its own here: paint near panes
_KINDS = {"paint": PAINT, "pane": GLASS, "tyre": TYRE, "lamp": LAMP, "other": OTHER, "frame": _FRAME}
_FREE_GAIN = ("pane", "tyre", "other")  # the others follow the car's paint one to one
_COSINES = (0.1, 0.3, 0.5, 0.7, 0.85, 1.0)
_REFERENCE = 2  # the knot at which strength counts from 0
_PAINT_AT = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
_VALUE_AT = (0.01, 0.05, 0.15, 0.25, 0.5, 0.75, 0.95, 0.98, 0.999)
_ON_SURFACE_M = 0.30  # labels and models err by as much
_CLUMP_RAYS = 20.0  # rays of a clump tell the same
_TRACK_WEIGHT = 2000.0  # rays that a car counts for, at most


@dataclass(frozen=True, eq=False)
class FittedView:
    """A labelled vehicle with a model in its place."""

    view: VehicleView
    cast: CastInPlace
    real: BoxRays
    own: Bool  # (K,) returns of the vehicle
    track: int


@dataclass(frozen=True)
class Figures:
    """What is compared: of real vehicles and of simulated ones alike."""

    window: F64  # (4,) mean over cars
    window_spread: F64  # (2, 3) 10, 50, 90 % over cars of "nothing" and "inside"
    body: F64  # (3,) 10, 50, 90 % over cars of the body's return rate
    clumps: F64  # (3,) of bodies
    window_clumps: F64  # (3,)
    zeros: F64  # (3,) share of reflectance 0: body, surface, inside; means over cars
    depth: F64  # (3,) 10, 50, 90 % of inside returns, metres
    along: F64  # (3,) along the ring: MAD in metres, share beyond 4 cm, beyond 10 cm
    over: float  # MAD over rings, metres
    smooth: float  # correlation of reflectance to the next firing
    points: float  # mean over cars of the logarithm of the number of its returns


def fit_vehicles(
    root: KittiRoot,
    profile_content: dict[str, Any],
    models: Sequence[CarModel] = (),
    sequences: Sequence[str] | None = None,
    rounds: int = 8,
    seed: int = 0,
    body_rates: Sequence[float] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """The vehicle keys of a profile's `noise`, learned from a root's labelled cars and vans.

    Args:
        models: car models to put in the vehicles' places, beside the parametric ones.
        sequences: names of sequences to learn from; None for all.
        rounds: of the search by simulation.
        body_rates: 10, 50 and 90 % over cars of the body's return rate that drawn paints shall show, where more cars
            are known than the root holds (scanner.md: 31); None for the root's own.

    With fewer than five cars the keys of the given profile (or the shipped ones) come back as they are, with a message.

    Raises:
        InputError: a scan or a label file is malformed, or the profile is none.
    """
    base: dict[str, Any] = {**load_profile().content["noise"], **profile_content.get("noise", {})}
    profile = profile_from_content({**profile_content, "noise": base}, "profile")
    try:
        noise_model(profile)
    except InputError:  # of an older form
        base = dict(load_profile().content["noise"])
        profile = profile_from_content({**profile_content, "noise": base}, "profile")
    views = fitted_views(root, profile, models, sequences)
    tracks = len({v.track for v in views})
    if tracks < MIN_TRACKS:
        say(f"{tracks} labelled cars and vans that nothing covers; {MIN_TRACKS} are needed: the vehicle part stays")
        return _vehicle_part(base)
    say(f"{tracks} cars and vans, {len({id(v.view) for v in views})} views")
    noise = fit_noise(views, profile, base, rounds, seed, body_rates, say)
    return _vehicle_part(noise)


def _vehicle_part(noise: dict[str, Any]) -> dict[str, Any]:
    return {key: noise[key] for key in VEHICLE_KEYS}


def fitted_views(
    root: KittiRoot, profile: ScannerProfile, models: Sequence[CarModel] = (), sequences: Sequence[str] | None = None
) -> list[FittedView]:
    """Every view of `vehicle_views` with the models that fit it best; at most six views a track, evenly spread."""
    by_track: dict[str, list[VehicleView]] = {}
    for view in counted(vehicle_views(root, profile, sequences), None, "views"):
        by_track.setdefault(view.track, []).append(view)
    pool = [*models, *parametric_cars()]
    config, out = Config(), []
    for track, name in enumerate(counted(sorted(by_track), len(by_track), "vehicles")):
        views = by_track[name]
        for k in np.unique(np.linspace(0, len(views) - 1, _VIEWS_A_TRACK).round().astype(int)):
            view = views[int(k)]
            real, own = view_rays(view, profile), own_returns(view, profile)
            for model in _best_models(pool, view):
                out.append(FittedView(view, cast_in_place(view, model, profile, config), real, own, track))
    return out


def _best_models(pool: Sequence[CarModel], view: VehicleView) -> list[CarModel]:
    alike = [m for m in pool if m.category == view.category] or list(pool)
    misfit = [float((np.log(body_size(m) / view.box[3:6]) ** 2).sum()) for m in alike]
    return [alike[int(i)] for i in np.argsort(misfit, kind="stable")[:_MODELS_A_VIEW]]


def fit_noise(
    views: Sequence[FittedView],
    profile: ScannerProfile,
    base: dict[str, Any],
    rounds: int,
    seed: int,
    body_rates: Sequence[float] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """A whole `noise` part: `base` with its vehicle keys learned from views."""
    strength, scores = fit_strength(views, profile.ring_step_rad)
    noise = _merged(base, strength)
    real = figures_of(views, [_real_returns(v) for v in views])
    drawn = real.body if body_rates is None else np.array(body_rates)
    for k in counted(range(rounds), rounds, "rounds"):
        noise = _fit_reflectance(noise, views, scores, profile, seed)
        noise = _search(noise, views, scores, profile, real, drawn, seed, 0.8**k)
        say(f"round {k + 1}: misfit {_cost(noise, views, scores, profile, real, drawn, seed):.2f}")
    return dict(_rounded(_fit_reflectance(noise, views, scores, profile, seed)))


# --- counted: strength by an ordered probit ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Cells:
    """Rays that are alike, counted together. C cells."""

    track: I32  # (C,)
    kind: I32  # (C,)
    cosine: F64  # (C,)
    range_m: F64  # (C,)
    counts: F64  # (C, 3) nothing, zeros, more; weighted


def fit_strength(views: Sequence[FittedView], ring_step_rad: float) -> tuple[dict[str, Any], F64]:
    """Strengths of echoes as noise keys, and the paint score (T,) of each track; beams lie `ring_step_rad` apart."""
    cells = _cells(views, ring_step_rad)
    tracks = int(cells.track.max()) + 1
    names = list(_KINDS)
    at = {name: i for i, name in enumerate(names)}
    kind = np.searchsorted(np.array(sorted(_KINDS.values())), cells.kind)
    kind = np.array([at[n] for n in sorted(_KINDS, key=lambda n: _KINDS[n])])[kind]
    turns = np.isin(cells.kind, (PAINT, LAMP, _FRAME))
    free = [i for i in range(len(_COSINES)) if i != _REFERENCE]
    sizes = (tracks, len(names), len(_FREE_GAIN), len(free), 1, len(names))

    def parts(x: F64) -> tuple[F64, F64, F64, F64, F64, F64]:
        score, strength, gain, cosine, far, zero = np.split(x, np.cumsum(sizes)[:-1])
        gains = np.ones(len(names))
        gains[[at[n] for n in _FREE_GAIN]] = gain
        curve = np.zeros(len(_COSINES))
        curve[free] = cosine
        return score, strength, gains, curve, far, np.exp(zero)

    def cost(x: F64) -> float:
        score, strength, gains, curve, far, zero = parts(x)
        s = strength[kind] + gains[kind] * score[cells.track] + far * cells.range_m / 50.0
        s = s + np.where(turns, np.interp(cells.cosine, _COSINES, curve), 0.0)
        above = s - zero[kind]
        some = np.log(np.maximum(ndtr(s) - ndtr(above), 1e-12))
        likely = cells.counts * np.stack([log_ndtr(-s), some, log_ndtr(above)], axis=1)
        # Weak beliefs: scores spread by about 2, gains lie near 0.5, incidence has no jumps.
        belief = (score**2).sum() / 8.0 + ((gains[[at[n] for n in _FREE_GAIN]] - 0.5) ** 2).sum() * 8.0
        belief += (np.diff(curve, 2) ** 2).sum() * 5.0 + strength[at["paint"]] ** 2 * 0.02 + float(far[0] ** 2)
        return float(-likely.sum() / _CLUMP_RAYS + belief)

    start = np.zeros(sum(sizes))
    start[tracks : tracks + len(names)] = 0.5
    found = minimize(cost, start, method="L-BFGS-B", options={"maxiter": 400, "maxfun": 400_000}).x
    score, strength, gains, curve, far, zero = parts(found)
    noise: dict[str, Any] = {
        name: {"strength": strength[i], "gain": gains[i], "zero_below": zero[i]}
        for name, i in at.items()
        if name != "frame"
    }
    noise["body"] = {
        "paint": _curve(_PAINT_AT, np.quantile(score, _PAINT_AT)),
        "cosine": _curve(_COSINES, curve),
        "range_per_50m": far[0],
        "frame": strength[at["frame"]] - strength[at["paint"]],
        "frame_m": _FRAME_M,
    }
    return noise, score


def _cells(views: Sequence[FittedView], ring_step_rad: float) -> _Cells:
    keys, weights, outcomes = [], [], []
    rays_of = np.bincount([v.track for v in views], weights=[v.cast.row.sum() for v in views])
    for v in views:
        row, hits = v.cast.row, v.cast.hits
        kind, expected = _kinds_of(v, ring_step_rad), hits.range_m[:, 0]
        measured, own, real = v.view.measured_m[row], v.own[row], v.real
        on = own & (np.abs(np.where(own, measured, 0.0) - expected) < _ON_SURFACE_M)
        window = np.isin(kind, (GLASS, _FRAME))
        crosses = np.where(kind == PAINT, real.is_body[row], (v.view.leave_m - v.view.enter_m)[row] > _ON_SURFACE_M)
        crosses = np.where(window, real.is_window[row], crosses)
        use = crosses & ~real.is_covered[row] & (on | window | ~np.isfinite(measured))
        outcome = np.where(on, 1 + (v.view.reflectance[row] > 0.0), 0)
        cosine = np.digitize(hits.cos_incidence[:, 0], np.linspace(0.05, 0.95, 10))
        far = np.digitize(expected, (6.0, 10.0, 15.0, 22.0, 30.0))
        keys.append(np.stack([np.full(len(kind), v.track), kind, cosine, far], axis=1)[use])
        outcomes.append(outcome[use])
        weights.append(np.full(int(use.sum()), min(1.0, _TRACK_WEIGHT / rays_of[v.track])))
    key, which = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    counts = np.zeros((len(key), 3))
    np.add.at(counts, (which.ravel(), np.concatenate(outcomes)), np.concatenate(weights))
    middle = np.array([4.5, 8.0, 12.5, 18.5, 26.0, 36.0])
    return _Cells(key[:, 0].astype(np.int32), key[:, 1].astype(np.int32), key[:, 2] / 10.0, middle[key[:, 3]], counts)


def _kinds_of(v: FittedView, ring_step_rad: float) -> I32:
    """Kind of the first surface of each ray that meets the model; paint near panes is a kind of its own."""
    rays, hits = v.view.scan.rays, v.cast.hits
    kind = hits.surface[:, 0].astype(np.int32)
    pane = kind == GLASS
    if pane.any():
        grid = FieldGrid(rays.ray_ring[hits.ray], rays.ray_azimuth_rad[hits.ray], ring_step_rad)
        near = grid.near(pane, _FRAME_M / float(np.median(hits.range_m[:, 0])))
        kind[(kind == PAINT) & near] = _FRAME
    return kind


def _curve(at: Any, value: Any) -> dict[str, list[float]]:
    """Knots for the profile; one that does not rise is set apart by a hair."""
    rising = [float(at[0])]
    for knot in at[1:]:
        rising.append(max(float(knot), rising[-1] + 1e-3))
    return {"at": rising, "value": [float(x) for x in value]}


# --- simulated: figures of real and simulated vehicles, and a search ------------------------------------------------


@dataclass(frozen=True, eq=False)
class Returns:
    """What one view's rays gave. K as in the view."""

    box_rays: BoxRays
    reflectance: F32
    own: Bool


def _real_returns(v: FittedView) -> Returns:
    return Returns(v.real, v.view.reflectance, v.own)


def simulate_views(
    noise: dict[str, Any], views: Sequence[FittedView], scores: F64 | None, profile: ScannerProfile, seed: int
) -> list[Returns]:
    """Returns of every view's model; a car's paint is its track's score, or drawn for each view (None).

    Each view has a generator of its own, so two parts of noise meet the same chance.
    """
    config, tracks = Config(), 1 + max(v.track for v in views)
    chance = np.random.default_rng([seed, 1])
    if scores is None:  # a car of its own in each view
        car, cars = np.arange(len(views)), len(views)
    else:
        car, cars = np.array([v.track for v in views]), tracks
        low, high = float(scores.min()), float(scores.max()) + 1e-6
        own = _curve((0.0, 1.0), (low, high))
        noise = {**noise, "body": {**noise["body"], "paint": own}}
    with_noise = replace(profile, content={**profile.content, "noise": noise})
    # Stratified: every paint and tint as often as it should be.
    tint, paint = ((chance.permutation(cars) + 0.5) / cars for _ in range(2))
    if scores is not None:
        paint = (scores - low) / (high - low)
    out = []
    for index, v in enumerate(views):
        look = CarLook(float(paint[car[index]]), float(tint[car[index]]))
        rng = np.random.default_rng([seed, 2, index])
        seen = measure_in_place(v.view, v.cast, look, with_noise, config, rng)
        out.append(Returns(rejudged(v.real, seen.range_m), seen.reflectance, seen.surface != MEASURED))
    return out


def simulate(
    noise: dict[str, Any], views: Sequence[FittedView], scores: F64 | None, profile: ScannerProfile, seed: int
) -> Figures:
    """`figures_of` what a noise part makes of the views."""
    return figures_of(views, simulate_views(noise, views, scores, profile, seed))


def figures_of(views: Sequence[FittedView], returns: Sequence[Returns]) -> Figures:
    """Figures over cars; each car's is the mean over its views."""
    track = np.array([v.track for v in views])

    def over_cars(values: Sequence[Any]) -> F64:
        table = np.array(values, dtype=np.float64).reshape(len(values), -1)
        cars = [_mean(table[track == t]) for t in np.unique(track)]
        return np.array(cars)

    window = over_cars([window_shares(r.box_rays) for r in returns])
    body = over_cars([body_return_rate(r.box_rays) for r in returns])
    zeros = over_cars([_zero_shares(r) for r in returns])
    along = over_cars([_tails(_off_line(r, next_firings)) for r in returns])
    over = over_cars([_tails(_off_line(r, next_beams))[:1] for r in returns])
    depth = over_cars([_quantiles(_inside_depth(r)) for r in returns])
    return Figures(
        window=_mean(window),
        window_spread=np.array([_quantiles(window[:, k]) for k in (0, INSIDE)]),
        body=_quantiles(body[:, 0]),
        clumps=clump_correlations([clump_sums(r.box_rays) for r in returns]),
        window_clumps=clump_correlations([clump_sums(r.box_rays, r.box_rays.is_window) for r in returns]),
        zeros=_mean(zeros),
        depth=_mean(depth),
        along=_mean(along),
        over=float(_mean(over)[0]),
        smooth=float(_mean(over_cars([_smoothness(r) for r in returns]))[0]),
        points=float(_mean(np.log(over_cars([max(int(r.own.sum()), 1) for r in returns])))[0]),
    )


# What a difference of each figure weighs: one over what is meant to be reached.
_TOLERANCE: dict[str, Any] = {
    "window": 0.02,
    "window_spread": 0.10,
    "body": 0.04,
    "clumps": 0.04,
    "window_clumps": 0.08,
    "zeros": 0.05,
    "depth": 0.25,
    "along": np.array([0.0015, 0.015, 0.008]),
    "over": 0.01,
    "smooth": 0.04,
    "points": 0.10,
}


def misfit(found: Figures, wanted: Figures) -> float:
    """Sum of squared differences, each in units of its tolerance."""
    total = 0.0
    for name, tolerance in _TOLERANCE.items():
        off = (np.asarray(getattr(found, name)) - np.asarray(getattr(wanted, name))) / tolerance
        total += float((np.nan_to_num(off) ** 2).mean())
    return total


_PAINT_PARTS = {"low": (0, 3), "middle": (3, 4), "high": (4, 7)}  # knots of `_PAINT_AT`

# What the search turns: key, and whether in logits, in logarithms or as it is; the first step.
_KNOBS: tuple[tuple[str, str, float], ...] = (
    *((f"{part}.{key}", "logit", 0.7) for part in ("body_clump", "glass_clump") for key in ("long", "short")),
    *((f"{part}.{key}", "logit", 0.7) for part in ("body_clump", "glass_clump") for key in ("long_firing", "beam")),
    *((f"{part}.short_firing", "logit", 0.7) for part in ("body_clump", "glass_clump")),
    ("paint.strength", "as it is", 0.25),
    ("body.paint", "low", 0.4),
    ("body.paint", "middle", 0.4),
    ("body.paint", "high", 0.4),
    ("paint.zero_below", "log", 0.2),
    ("pane.zero_below", "log", 0.4),
    ("pane.strength", "as it is", 0.3),
    ("body.frame", "as it is", 0.4),
    ("glass.pass", "logit", 0.5),
    ("glass.tint", "log", 0.4),
    ("glass.inside_return", "logit", 0.5),
    ("glass.second_pass", "logit", 0.5),
    ("glass.clutter", "logit", 0.5),
    ("glass.clutter_m", "scale", 0.3),
    ("reflectance.inside_zero", "logit", 0.5),
    ("relief.rough_m", "log", 0.4),
    ("relief.std_m", "log", 0.4),
    ("relief.firing", "logit", 0.5),
    ("relief.beam", "logit", 0.5),
    ("relief.stray", "logit", 0.6),
)


def _search(
    noise: dict[str, Any],
    views: Sequence[FittedView],
    scores: F64,
    profile: ScannerProfile,
    wanted: Figures,
    drawn: F64,
    seed: int,
    step: float,
) -> dict[str, Any]:
    """One round of coordinate search: each knob a step up, else a step down, as long as the misfit falls."""
    best = _cost(noise, views, scores, profile, wanted, drawn, seed)
    for key, scale, first in _KNOBS:
        for sign in (1.0, -1.0):
            turned = _turned(noise, key, scale, sign * first * step)
            found = _cost(turned, views, scores, profile, wanted, drawn, seed)
            if found < best:
                noise, best = turned, found
                break
    return noise


def _cost(
    noise: dict[str, Any],
    views: Sequence[FittedView],
    scores: F64,
    profile: ScannerProfile,
    wanted: Figures,
    drawn: F64,
    seed: int,
) -> float:
    """Misfit with each car's own paint, and of the body's return rates with paint drawn anew for each view."""
    cost = misfit(simulate(noise, views, scores, profile, seed), wanted)
    rates = [body_return_rate(r.box_rays) for r in simulate_views(noise, views, None, profile, seed)]
    off = (_quantiles(np.array(rates)) - drawn) / _TOLERANCE["body"]
    return cost + float((np.nan_to_num(off) ** 2).mean())


def _turned(noise: dict[str, Any], key: str, scale: str, by: float) -> dict[str, Any]:
    part, name = key.split(".")
    value = noise[part][name]
    if scale == "scale":
        new: Any = {**value, "value": [v * float(np.exp(by)) for v in value["value"]]}
    elif scale in _PAINT_PARTS:
        first, last = _PAINT_PARTS[scale]
        moved = [v + by * (first <= i < last) for i, v in enumerate(value["value"])]
        if moved != sorted(moved):
            return noise
        new = {**value, "value": moved}
    elif scale == "logit":
        inner = min(max(value, 0.003), 0.997)
        new = float(1.0 / (1.0 + np.exp(-(np.log(inner / (1.0 - inner)) + by))))
    else:
        new = value + by if scale == "as it is" else value * float(np.exp(by))
    return {**noise, part: {**noise[part], name: new}}


def _fit_reflectance(
    noise: dict[str, Any], views: Sequence[FittedView], scores: F64, profile: ScannerProfile, seed: int
) -> dict[str, Any]:
    """Reflectance by strength: the two have the same quantiles over the returns of bodies that are not 0."""
    ruler = _curve((0.0, _RULER), (0.0, 1.0))  # reads strength off the reflectance
    probe = {**noise, "reflectance": {**noise["reflectance"], "strength": ruler}}
    found = simulate_views(probe, views, scores, profile, seed)
    strength = _body_quantiles(views, found) * _RULER
    value = _body_quantiles(views, [_real_returns(v) for v in views])
    curve = _curve(strength, value)
    return {**noise, "reflectance": {**noise["reflectance"], "strength": curve}}


_RULER = 6.0  # strengths above 6 standard deviations of chance do not come up


def _body_quantiles(views: Sequence[FittedView], returns: Sequence[Returns]) -> F64:
    """Quantiles of the body's reflectances above 0, every car weighing the same."""
    per_car: dict[int, list[Any]] = {}
    for v, r in zip(views, returns, strict=True):
        value = r.reflectance[r.own & r.box_rays.is_body]
        per_car.setdefault(v.track, []).append(value[value > 0.0])
    values = [np.concatenate(parts) for _, parts in sorted(per_car.items())]
    weight = np.concatenate([np.full(len(v), 1.0 / max(len(v), 200)) for v in values])
    value = np.concatenate(values).astype(np.float64)
    order = np.argsort(value, kind="stable")
    share = (np.cumsum(weight[order]) - 0.5 * weight[order]) / weight.sum()
    return np.asarray(np.interp(_VALUE_AT, share, value[order]))


def _merged(base: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    return {**base, **{key: {**base.get(key, {}), **part} for key, part in new.items()}}


def _rounded(value: Any) -> Any:
    """Four digits: more would be a claim."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _mean(table: F64) -> F64:
    """Mean over rows without what is nan; nan where all is."""
    known = np.isfinite(table)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, table, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _quantiles(values: F64) -> F64:
    known = values[np.isfinite(values)]
    return np.quantile(known, (0.1, 0.5, 0.9)) if len(known) >= _FEW else np.full(3, np.nan)


_FEW = 5


def _zero_shares(r: Returns) -> F64:
    kind, own = r.box_rays.window_class, r.own
    zones = (r.box_rays.is_body & own, (kind == SURFACE) & own, (kind == INSIDE) & own)
    return np.array([np.mean(r.reflectance[z] <= 0.0) if z.sum() >= _FEW else np.nan for z in zones])


def _inside_depth(r: Returns) -> F64:
    return np.asarray(r.box_rays.depth_m[(r.box_rays.window_class == INSIDE) & r.own])


def _off_line(r: Returns, pairs: Callable[[BoxRays, Bool], tuple[Any, Any]]) -> F64:
    """How far body returns lie off the middle of their two neighbours, metres."""
    before, after = pairs(r.box_rays, r.own & r.box_rays.is_body)
    following = np.full(len(r.own), -1)
    following[before] = after
    middle = after[following[after] >= 0]
    first = before[following[after] >= 0]
    range_m = r.box_rays.measured_m
    return np.asarray(range_m[middle] - 0.5 * (range_m[first] + range_m[following[middle]]))


def _tails(off_m: F64) -> F64:
    if len(off_m) < _FEW:
        return np.full(3, np.nan)
    size = np.abs(off_m)
    return np.array([1.4826 * np.median(size), np.mean(size > 0.04), np.mean(size > 0.10)])


def _smoothness(r: Returns) -> float:
    a, b = next_firings(r.box_rays, r.own)
    x, y = r.reflectance[a], r.reflectance[b]
    return float(np.corrcoef(x, y)[0, 1]) if len(x) > 4 * _FEW and x.std() * y.std() > 0.0 else float("nan")
