"""`augkitti realism`: a data set and labelled real scans in, a report on how real its simulated cars are out.

Every labelled car that nothing hides is compared with simulated cars that stand where it stands, on the same rays, so
both are alike in range, bearing, heading and size. The full model has ablations beside it, and the recipe that is
common elsewhere (`realism_columns`); a data set's own cars are matched to the real ones by the same four. Numbers of a
view: `realism_features`; classifiers: `two_sample`; the page: `realism_report`.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from augkitti import kitti as kitti_disk
from augkitti import realism_features as rf
from augkitti.command_line import aside, counted, is_json, print_json
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.labelled_views import body_return_rate, clump_correlations, clump_sums, vehicle_views, window_shares
from augkitti.scan_pair import Bool, CarModel
from augkitti.scanner import ScannerProfile, load_profile
from augkitti.sensor_noise import CarLook, noise_model
from augkitti.synthesize import DATE as STREET_DATE
from pipelines.realism_columns import (
    COLUMNS,
    MAX_COVERED,
    MIN_POINTS,
    RANGE_M,
    cars_of_pair,
    common_rays,
    look_of,
    relative_velocity,
    seed_of,
    simulate,
)
from pipelines.realism_findings import (
    FEW_TRACKS,
    SET,
    Findings,
    Gathered,
    Summary,
    as_json,
    checks_of,
    per_track,
    verdict_of,
)
from pipelines.two_sample import (
    AtEqualCounts,
    Judged,
    Scorer,
    at_equal_counts,
    bootstrap_auc,
    cross_validate,
    feature_scorer,
    interval,
    mean_known,
    middle_known,
    mmd,
    permuted_drops,
    point_scorer,
    point_sets,
    separations,
    standardised,
    track_weights,
)

RANGE_CLASSES_M = ((4, 8), (8, 12), (12, 18), (18, 25), (25, 35), (35, 45))
MIN_ZONE_RAYS = 20  # of a view, for its window or body figures
GROUPS = {  # of features, by what gives a car away
    "points and returns by height": ("points_log", "rings", "return_low", "return_body", "return_cabin", "return_roof"),
    "what windows do": ("window_surface", "window_inside", "depth_inside"),
    "clumps and holes": (
        "clump_next", "clump_four", "clump_beam", "clump_window", "hole_mean", "hole_longest", "hole_number",
    ),
    "roughness of the surface": ("residual_along", "residual_tail", "residual_across"),
    "reflectance": (
        "zero_body", "zero_window", "reflectance_middle", "reflectance_spread", "reflectance_high",
        "reflectance_smooth", "reflectance_white",
    ),
    "shape in the box": ("depth_spread", "span_along", "span_across", "span_up"),
    "where the rays go": ("step_azimuth", "ring_gap"),
}  # fmt: skip
_SAMPLE = 400  # points kept of a view
_EXAMPLES = 5
_DRAWS = 4  # cars of the full model in each place: one for the classifiers, all for shares and quantiles
_PAINTS = (0.02, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.98)  # tried for resimulation
_STREET_PAIRS = 40  # eight streets, some 20 labelled cars that nothing hides


def realism(
    out_set: Path | None,
    kitti: Path | None,
    cad: Path | None,
    report: Path,
    resimulate: bool = False,
    *,
    profile: Path | None = None,
    seed: int = 0,
    splits: int = 20,
    resamples: int = 1000,
    max_tracks: int | None = None,
    views_of_a_track: int = 12,
    with_points: bool = True,
    columns: Sequence[str] = tuple(COLUMNS),
) -> int:
    """Write `report/index.html`, `report/realism.json` and `report/figures/*.png`, and print the verdict.

    Args:
        out_set: a data set of `augkitti generate`, whose own cars are judged too; None: only cars in real cars' places.
        kitti: root with labelled scans; None: the embedded streets, whose cars are themselves simulated.
        cad: folder of car models; None: cars made in code.
        report: folder to write to; made if absent.
        resimulate: compare ray by ray as well.
        profile: of the scanner; None: the data set's own, else the shipped one.
        seed: of all chance.
        splits: ways to halve the real cars for the floor.
        resamples: of the bootstrap over tracks.
        max_tracks: stop after so many labelled cars.
        views_of_a_track: most views of one car.
        with_points: train the point network too, where torch is installed.
        columns: of `COLUMNS`.

    Returns:
        0; 1 where a check failed or there are too few real cars to tell.

    Raises:
        InputError: no labelled car, a source is unreadable, or scikit-learn or matplotlib is missing.
    """
    from pipelines.realism_report import write_report

    scorer = feature_scorer(seed)
    wanted = [name for name in COLUMNS if name in columns]
    its_profile = _profile_of(out_set, profile)
    root, source = _root_of(kitti, its_profile)
    models = _models_of(cad)
    aside(f"labelled cars of {source}, {len(models)} car models")
    gathered = gather(root, models, its_profile, wanted, seed, max_tracks, views_of_a_track, resimulate)
    if out_set is not None:
        _add_set(gathered, out_set, its_profile, seed)
    is_synthetic = all(s.folder.name.startswith(STREET_DATE) for s in root.sequences)
    found = judge(
        gathered, scorer, source=source, is_synthetic=is_synthetic, resimulate=resimulate, seed=seed, splits=splits,
        resamples=resamples, with_points=with_points,
    )  # fmt: skip
    source_of_noise = noise_model(its_profile).source.rstrip(".")
    held_out = "" if is_synthetic else " Where these same cars are among that, the figures are not held out."
    found.notes.append(f"The sensor model was learned from: {source_of_noise}.{held_out}")
    write_report(found, report)
    if is_json():
        print_json(as_json(found))
    else:
        print(found.verdict)
        print(report / "index.html")
    return 0 if all(check.passed for check in found.checks) else 1


# --- where the views come from -------------------------------------------------------------------------------------


def _profile_of(out_set: Path | None, path: Path | None) -> ScannerProfile:
    if path is None and out_set is not None:
        from augkitti.dataset_index import read_index
        from pipelines.inspect_set import set_profile

        return set_profile(out_set, read_index(out_set))
    return load_profile(path)


def _root_of(kitti: Path | None, profile: ScannerProfile) -> tuple[kitti_disk.KittiRoot, str]:
    if kitti is not None:
        return kitti_disk.open_root(kitti), str(kitti)
    from pipelines.cache import cache_folder
    from pipelines.streets import find_streets, make_streets

    streets = find_streets(_STREET_PAIRS, 0, profile, cache_folder())
    make_streets(streets, profile, 1)
    return kitti_disk.open_root(streets.folder), "the embedded streets"


def _models_of(cad: Path | None) -> tuple[CarModel, ...]:
    if cad is None:
        from augkitti.parametric_cars import parametric_cars

        models: Sequence[CarModel] = parametric_cars()
    else:
        from augkitti.cad_models import load_cad_folder
        from pipelines.cache import cache_folder

        models = load_cad_folder(cad, cache_dir=cache_folder() / "cad").models
    kept = tuple(model for model in models if model.category in ("Car", "Van"))
    if not kept:
        raise InputError(cad or "realism", "holds no car or van", "name a folder with some")
    return kept


def gather(
    root: kitti_disk.KittiRoot,
    models: Sequence[CarModel],
    profile: ScannerProfile,
    columns: Sequence[str],
    seed: int,
    max_tracks: int | None = None,
    views_of_a_track: int = 12,
    resimulate: bool = False,
) -> Gathered:
    """Every labelled car of a root, and the columns' cars in its place, summed up view by view: scans are not kept.

    The full model's car is drawn with other paints too (`more`): shares of a few cars hang on their paints.
    With `resimulate` a car whose paint fits the real one's return rate is compared with it ray by ray.

    Raises:
        InputError: there is no labelled car that can be used.
    """
    gathered = Gathered(columns={name: [] for name in columns})
    per_track: dict[str, list[int]] = {}
    common = common_rays(profile)
    views = vehicle_views(root, profile, min_points=MIN_POINTS, most_covered=MAX_COVERED, range_m=RANGE_M)
    for view in counted(views, None, "views"):
        frames = per_track.setdefault(view.track, [])
        if len(frames) >= views_of_a_track:
            continue
        if max_tracks is not None and len(per_track) > max_tracks:
            break
        frames.append(view.frame)
        real = rf.car_rays(view.scan.rays, view.ray, view.measured_m, view.reflectance, view.box, profile)
        gathered.real.append(summarise(view, real))
        car, velocity = list(per_track).index(view.track), relative_velocity(root, view)

        def simulated(
            name: str, look: CarLook, its_seed: int = seed, view: Any = view, velocity: F64 = velocity
        ) -> Any:
            return simulate(view, name, models, profile, look, velocity, common, its_seed)

        kept = {"real": real}
        for name in columns:
            kept[name] = simulated(name, look_of(car, seed))
            gathered.columns[name].append(summarise(view, kept[name]))
        if "full" in columns:
            for other in range(1, _DRAWS):
                drawn = simulated("full", look_of(car, seed + 1000 * other), seed + 1000 * other)
                gathered.more.append(replace(summarise(view, drawn), track=f"{view.track}#{other}"))
        if resimulate:
            tries = [simulated("full", CarLook(paint=paint, tint=0.5)) for paint in _PAINTS]
            off = [abs(body_return_rate(one.judged) - body_return_rate(real.judged)) for one in tries]
            gathered.ray_by_ray.append(_compare_rays(real, tries[int(np.argmin(np.nan_to_num(off, nan=9.0)))]))
        if len(frames) == 1 and len(gathered.examples) < _EXAMPLES and 300 <= real.on_car.sum() <= 3000:
            gathered.examples.append({name: kept[name] for name in ("real", "full", "common") if name in kept})
    if not gathered.real:
        raise InputError(
            root.path, "holds no labelled car or van that the scanner sees whole within 45 m",
            "labels are read from tracklet_labels.xml, tracking/training/label_02 and object/training/label_2",
        )  # fmt: skip
    return gathered


def summarise(view: Any, rays: rf.CarRays) -> Summary:
    """What is kept of a view; `view` names its track, sequence, frame, category and distance."""
    rng = np.random.default_rng(seed_of(view.track, view.frame))
    points, shine = rays.points, rays.reflectance[rays.on_car]
    chosen = rng.permutation(len(points))[:_SAMPLE]
    along = rf.residuals_along(rays)
    judged, box = rays.judged, rays.box
    bearing = math.atan2(box[1], box[0])
    enough = judged.is_window.sum() >= MIN_ZONE_RAYS, judged.is_body.sum() >= MIN_ZONE_RAYS
    return Summary(
        track=view.track,
        where=f"{view.sequence} {view.frame}",
        category=view.category,
        distance_m=float(math.hypot(box[0], box[1])),
        place=np.array([math.log(math.hypot(box[0], box[1])), bearing, box[6] - bearing, box[3], box[4]]),
        features=rf.car_features(rays),
        window=window_shares(judged) if enough[0] else np.full(4, np.nan),
        body_rate=body_return_rate(judged) if enough[1] else math.nan,
        clumps=clump_sums(judged),
        heights=rf.returns_by_height(rays),
        rings=rf.ring_counts(rays),
        holes=rf.holes(rays),
        residuals=along[rng.permutation(len(along))[:_SAMPLE]],
        reflectance=rf.reflectance_counts(rays),
        bev=rf.bev_occupancy(rays),
        points=points[chosen],
        shine=shine[chosen],
        size_m=box[3:6],
        count=len(points),
    )


def _compare_rays(real: rf.CarRays, full: rf.CarRays) -> F64:
    """(K, 6) a ray of body or window.

    Zone (1 body, 2 window, 3 both), whether the real and the simulated one returned
    from the car, simulated less real range (nan: not both), real and simulated reflectance.

    Rays that either leaves out as covered are left out.
    """
    keys = [view.ring.astype(np.int64) * 10**8 + np.rint(view.turn_rad * 1e6).astype(np.int64) for view in (real, full)]
    _, a, b = np.intersect1d(keys[0], keys[1], return_indices=True)
    zone = real.judged.is_body[a] + 2 * real.judged.is_window[a]
    kept = zone > 0
    a, b, zone = a[kept], b[kept], zone[kept]
    both = real.on_car[a] & full.on_car[b]
    ranges = np.where(both, full.range_m[b] - np.where(np.isfinite(real.range_m[a]), real.range_m[a], 0.0), np.nan)
    return np.stack(
        [zone, real.on_car[a], full.on_car[b], ranges, real.reflectance[a], full.reflectance[b]], axis=1
    ).astype(np.float64)


# --- a data set's own cars -----------------------------------------------------------------------------------------


def _add_set(gathered: Gathered, folder: Path, profile: ScannerProfile, seed: int, most_pairs: int = 400) -> None:
    """Match a data set's virtual cars to the real views, and add those as a column of its own."""
    from augkitti.dataset import open_dataset

    dataset = open_dataset(folder)
    rows = np.sort(np.random.default_rng([seed, 1]).permutation(len(dataset))[:most_pairs])
    found = [
        summarise(*one)
        for row in counted(rows, len(rows), "pairs of the data set")
        for one in cars_of_pair(dataset[int(row)], profile)
    ]
    matches = match(gathered.real, found)
    gathered.set_note = f"{len(found)} views of virtual cars in {len(rows)} pairs of the data set"
    gathered.set_note += f", {len(matches)} matched to real views by range, bearing, heading and size"
    if len({found[b].track for _, b in matches}) < FEW_TRACKS:
        gathered.set_note += ": too few to judge"
    else:
        gathered.columns[SET] = [found[b] for _, b in matches]
        gathered.set_matched = [a for a, _ in matches]
    aside(gathered.set_note)


def match(real: Sequence[Summary], others: Sequence[Summary], most: float = 4.0) -> list[tuple[int, int]]:
    """Pairs (row of real, row of others), each used once, alike in range, bearing, heading and size.

    The cost is the squared difference over 20 % of range, 0.8 rad of bearing, 0.4 rad of heading (against the line of
    sight), 0.6 m of length and 0.25 m of width, summed; pairs over `most` are left out. Cars are symmetric: a heading
    and its mirror image are alike.
    """
    from scipy.optimize import linear_sum_assignment

    if not real or not others:
        return []
    a, b = (np.stack([summary.place for summary in side]) for side in (real, others))
    off = a[:, None] - b[None]
    mirrored = a[:, None, 2] + b[None, :, 2]
    turns = [np.abs((angle + np.pi) % (2.0 * np.pi) - np.pi) for angle in (off[..., 2], mirrored)]
    off[..., 1] = (off[..., 1] + np.pi) % (2.0 * np.pi) - np.pi
    off[..., 2] = np.minimum(*turns)
    cost = ((off / (0.2, 0.8, 0.4, 0.6, 0.25)) ** 2).sum(axis=2)
    rows, columns = linear_sum_assignment(np.minimum(cost, 10.0 * most))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] <= most]


# --- judgement -----------------------------------------------------------------------------------------------------


def judge(
    gathered: Gathered,
    scorer: Scorer,
    *,
    source: str,
    is_synthetic: bool,
    resimulate: bool = False,
    seed: int = 0,
    splits: int = 20,
    resamples: int = 1000,
    with_points: bool = True,
) -> Findings:
    """All figures from the views: classifiers, distances, shares, checks and the verdict."""
    real = gathered.real
    tracks = [summary.track for summary in real]
    count = len(set(tracks))
    rng = np.random.default_rng([seed, 2])
    X = {name: np.stack([s.features for s in views]) for name, views in gathered.columns.items() if views}
    X_real = np.stack([s.features for s in real])
    notes = [f"{gathered.set_note}."] if gathered.set_note else []
    judged: dict[str, Judged] = {}
    points_judged: dict[str, Judged] = {}
    boot: dict[str, F64] = {}
    equal: dict[str, AtEqualCounts] = {}
    drops: dict[str, float] = {}
    if count >= 2:
        columns = counted(X, len(X), "columns judged")
        judged = {name: _told_apart(gathered, name, X_real, X, scorer, seed, 3) for name in columns}
        in_place = {name: one for name, one in judged.items() if name != SET}
        boot = bootstrap_auc(in_place, resamples, rng, sorted(set(tracks)))
        boot |= bootstrap_auc({name: one for name, one in judged.items() if name == SET}, resamples, rng)
        network = point_scorer(seed) if with_points else None
        if network is None:
            notes.append("The point network was left out: torch is not installed, or it was not asked for.")
        else:
            clouds = {name: _clouds(views, rng) for name, views in gathered.columns.items() if views}
            cloud_real = _clouds(real, rng)
            columns = counted(clouds, len(clouds), "point networks")
            points_judged = {n: _told_apart(gathered, n, cloud_real, clouds, network, seed, 1) for n in columns}
    if count >= 4:
        beside: dict[str, F64] = {name: X[name] for name in ("full", "common") if name in X}
        equal = at_equal_counts(X_real, beside, tracks, scorer, splits, rng)
    apart = {name: _separations(gathered, name, X_real, X) for name in X}
    if count >= 2 and "full" in X:
        both, kind = np.concatenate([X_real, X["full"]]), np.repeat([False, True], len(real))
        index = {name: k for k, name in enumerate(rf.FEATURES)}
        groups = {name: [index[f] for f in members] for name, members in GROUPS.items()}
        drops = permuted_drops(both, kind, [*tracks, *tracks], groups, scorer, rng)
    margin = interval(boot["common"] - boot["full"]) if {"full", "common"} <= boot.keys() else (math.nan, math.nan)
    numbers = {"real": _numbers(real, real, X_real, X_real)}
    for name, views in gathered.columns.items():
        if views:
            beside_views = [real[k] for k in gathered.set_matched] if name == SET else real
            x_beside = np.stack([s.features for s in beside_views])
            numbers[name] = _numbers(beside_views, views, x_beside, X[name])
            numbers[name]["separation"] = float(mean_known(apart[name]))
    if gathered.more:
        numbers["full"] |= _shares([*gathered.columns["full"], *gathered.more])
    numbers["real"] |= _floors(real, X_real, rng)
    floor_each = _separation_floor(X_real, tracks, rng, splits)
    separation = {
        name: (float(apart["full"][k]) if "full" in apart else math.nan, float(floor_each[k]))
        for k, name in enumerate(rf.FEATURES)
    }
    classes = _range_classes(gathered)
    checks = checks_of(count, judged, margin, numbers, classes, is_synthetic)
    verdict = verdict_of(count, is_synthetic, judged, equal, drops, margin, checks, source)
    return Findings(
        gathered=gathered, tracks=count, is_synthetic=is_synthetic, source=source, judged=judged,
        points_judged=points_judged, boot=boot, equal=equal, margin=margin, numbers=numbers, drops=drops,
        feature_separation=separation, classes=classes,
        resimulated=_resimulated(gathered) if resimulate else None, checks=checks, verdict=verdict, notes=notes,
    )  # fmt: skip


def _sides(gathered: Gathered, name: str) -> tuple[Any, list[str], Bool]:
    """Rows of the real views beside a column, tracks of both, which are simulated."""
    rows = np.array(gathered.set_matched if name == SET else range(len(gathered.real)), dtype=np.int64)
    views = [gathered.real[k] for k in rows], gathered.columns[name]
    tracks = [s.track for side in views for s in side]
    return rows, tracks, np.repeat([False, True], [len(views[0]), len(views[1])])


def _told_apart(
    gathered: Gathered, name: str, real: Any, columns: Mapping[str, Any], scorer: Scorer, seed: int, repeats: int
) -> Judged:
    rows, tracks, kind = _sides(gathered, name)
    inputs = np.concatenate([real[rows], columns[name]])
    return cross_validate(inputs, kind, tracks, scorer, np.random.default_rng([seed, 3]), repeats=repeats)


def _separations(gathered: Gathered, name: str, real: F64, columns: Mapping[str, F64]) -> F64:
    rows, tracks, kind = _sides(gathered, name)
    return separations(np.concatenate([real[rows], columns[name]]), kind, track_weights(tracks, kind))


def _separation_floor(real: F64, tracks: Sequence[str], rng: np.random.Generator, splits: int) -> F64:
    """(F,) mean separation of one half of the real tracks from the other: what chance alone does."""
    names, of_view = np.array(sorted(set(tracks))), np.asarray(tracks)
    found = []
    for _ in range(splits):
        second = ~np.isin(of_view, rng.permutation(names)[: len(names) // 2])
        if second.any() and not second.all():
            found.append(separations(real, second, track_weights(tracks, second)))
    return mean_known(found) if found and len(names) > 3 else np.full(real.shape[1], np.nan)


def _clouds(views: Sequence[Summary], rng: np.random.Generator) -> Any:
    return point_sets([s.points for s in views], [s.shine for s in views], [s.size_m for s in views], rng)


def _numbers(real: Sequence[Summary], views: Sequence[Summary], x_real: F64, x: F64) -> dict[str, Any]:
    """Figures of one column beside the real views."""
    residual = np.concatenate([s.residuals for s in views])
    matched = views is not real and len(real) == len(views)
    return {
        "views": len(views),
        "cars": len({s.track for s in views}),
        **_shares(views),
        "residual_mm": float(1e3 * 1.4826 * np.median(np.abs(residual))) if len(residual) else math.nan,
        "residual_tail": float((np.abs(residual) > 0.04).mean()) if len(residual) else math.nan,
        "hole_mean": float(np.mean(np.concatenate([[0.0], *(s.holes for s in views)]))),
        "jsd_bits": rf.jensen_shannon(_mean_bev(real), _mean_bev(views)),
        "mmd": mmd(standardised(x_real, x_real), standardised(x, x_real)),
        "chamfer": _chamfer(list(zip(real, views, strict=True))) if matched else math.nan,
        "separation": math.nan,
    }


def _shares(views: Sequence[Summary]) -> dict[str, Any]:
    """Window shares and body return rates as means of cars, clumps, zeros."""
    windows, rates = per_track(views, lambda s: s.window), per_track(views, lambda s: s.body_rate)
    shine = np.sum([s.reflectance / max(s.reflectance.sum(), 1.0) for s in views], axis=0)  # views weigh the same
    return {
        "window": windows.mean(axis=0).tolist() if len(windows) else [math.nan] * 4,
        "body_quantiles": np.quantile(rates, (0.1, 0.5, 0.9)).tolist() if len(rates) else [math.nan] * 3,
        "clumps": clump_correlations([s.clumps for s in views]).tolist(),
        "zero_body": float(shine[0, 0] / max(shine[0].sum(), 1e-12)),
        "zero_window": float(shine[1, 0] / max(shine[1].sum(), 1e-12)),
    }


def _mean_bev(views: Sequence[Summary]) -> F64:
    tracks = [s.track for s in views]
    weight = track_weights(tracks, np.zeros(len(views), dtype=bool))
    return np.asarray(np.tensordot(weight, np.stack([s.bev for s in views]), 1))


def _chamfer(pairs: Sequence[tuple[Summary, Summary]]) -> float:
    """Mean density-aware Chamfer distance over views, in half lengths of the box."""
    found = [rf.density_aware_chamfer(a.points, b.points, 0.5 * float(a.size_m[0])) for a, b in pairs]
    return float(np.mean(found)) if found else math.nan


def _floors(real: Sequence[Summary], x: F64, rng: np.random.Generator) -> dict[str, float]:
    """Real against real: halves of the tracks for distributions, neighbouring views of a car for Chamfer."""
    names, of_view = np.array(sorted({s.track for s in real})), np.array([s.track for s in real])
    jsd, means = [], []
    z = standardised(x, x)
    for _ in range(20 if len(names) >= 4 else 0):
        first = np.isin(of_view, rng.permutation(names)[: len(names) // 2])
        halves = [
            [summary for summary, mine in zip(real, first, strict=True) if bool(mine) is kind] for kind in (True, False)
        ]
        jsd.append(rf.jensen_shannon(_mean_bev(halves[0]), _mean_bev(halves[1])))
        means.append(mmd(z[first], z[~first]))
    by_track: dict[str, list[Summary]] = {}
    for summary in real:
        by_track.setdefault(summary.track, []).append(summary)
    neighbours = [pair for views in by_track.values() for pair in itertools.pairwise(views)]
    return {
        "jsd_bits": float(np.mean(jsd)) if jsd else math.nan,
        "mmd": float(np.mean(means)) if means else math.nan,
        "chamfer": _chamfer(neighbours),
    }


def _range_classes(gathered: Gathered) -> list[dict[str, Any]]:
    """Points a car by range: median of each column inside the real 10 to 90 % band, where there are 5 real cars."""
    rows = []
    for near, far in RANGE_CLASSES_M:
        real = [s for s in gathered.real if near <= s.distance_m < far]
        cars = len({s.track for s in real})
        if not real:
            continue
        low, middle, high = np.quantile([s.count for s in real], (0.1, 0.5, 0.9))
        row: dict[str, Any] = {
            "range_m": [near, far], "cars": cars, "views": len(real),
            "real": [float(low), float(middle), float(high)], "simulated": {},
        }  # fmt: skip
        for name, views in gathered.columns.items():
            drawn = [*views, *gathered.more] if name == "full" else views
            counts = [s.count for s in drawn if near <= s.distance_m < far]
            row["simulated"][name] = float(np.median(counts)) if counts else math.nan
        row["enough"] = cars >= 5
        rows.append(row)
    return rows


def _resimulated(gathered: Gathered) -> dict[str, Any] | None:
    """Ray by ray: body and window rays of every view with the best-fitting model and paint; views weigh the same."""
    if not gathered.ray_by_ray:
        return None
    out: dict[str, Any] = {"views": len(gathered.ray_by_ray)}
    for name, zone in (("body", 1), ("window", 2)):
        views = [rays[(rays[:, 0].astype(int) & zone) > 0] for rays in gathered.ray_by_ray]
        views = [rays for rays in views if len(rays)]
        mine = np.concatenate([np.zeros((0, 6)), *views])
        share = np.concatenate([[], *(np.full(len(rays), 1.0 / len(rays)) for rays in views)])
        share /= max(share.sum(), 1e-12)
        real, simulated = mine[:, 1] > 0, mine[:, 2] > 0
        both, off = mine[real & simulated], mine[:, 3][np.isfinite(mine[:, 3])]
        alike = [float((rays[:, 1] == rays[:, 2]).mean()) for rays in views]
        rates = [(float(rays[:, 1].mean()), float(rays[:, 2].mean())) for rays in views]
        out[name] = {
            "rays": len(mine),
            "both": float(share[real & simulated].sum()),
            "real_only": float(share[real & ~simulated].sum()),
            "simulated_only": float(share[~real & simulated].sum()),
            "neither": float(share[~real & ~simulated].sum()),
            "agree": float(mean_known(alike)),
            "agree_by_chance": float(mean_known([a * b + (1 - a) * (1 - b) for a, b in rates])),
            "range_median_m": middle_known(off),
            "range_mad_m": 1.4826 * middle_known(np.abs(off - middle_known(off))),
            "range_over_20cm": float(mean_known(np.abs(off) > 0.2)),
            "zero_in_both_or_neither": float(mean_known((both[:, 4] == 0) == (both[:, 5] == 0))),
            "reflectance_difference": float(mean_known(np.abs(both[:, 4] - both[:, 5]))),
        }
    return out
