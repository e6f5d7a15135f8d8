"""The cars beside the real ones: a labelled car in, what stands in its place by the full model or an ablation out.

An ablation changes what the sensor model is given (`CarHits`, the car's look, its motion) or what it answers
(`CarReturns`), never the model itself.
"""

import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from augkitti import kitti as kitti_disk
from augkitti import realism_features as rf
from augkitti.frames import F64, Array, invert
from augkitti.labelled_views import GROW_M, VehicleView, rays_at
from augkitti.raycast import CarHits, cast_car
from augkitti.resimulate import best_model, cast_fitted, nearest_in_place, pose_in_box, stretched
from augkitti.scan_pair import GLASS, MEASURED, AugmentedPair, CarModel, ScanRays
from augkitti.scanner import ScannerProfile, fire_rays, lines_of_rays, profile_from_content
from augkitti.sensor_noise import CarLook, CarReturns, quantise_range, simulate_returns

COLUMNS = {  # what stands beside the real cars: name, and what it says in the report
    "full": ("full model", "what generation does"),
    "no_noise": ("no learned noise", "true ranges, every solid surface returns, one reflectance"),
    "independent": ("independent drops", "as many drops, each by itself"),
    "opaque": ("opaque windows", "panes return like paint"),
    "all_pass": ("windows let all pass", "panes are not there"),
    "one_paint": ("one paint for all", "no trait of the car"),
    "snapshot": ("no rolling shutter", "all rays at one moment"),
    "common": (
        "common recipe",
        "even beams from the origin, 1 cm noise, 10 % drops, random reflectance, opaque windows",
    ),
}
MIN_POINTS, MAX_COVERED, RANGE_M = 20, 0.15, (4.0, 45.0)  # of a view; fewer rays than that are left


def look_of(car: int, seed: int) -> CarLook:
    """Paint and tint of the k-th car: spread evenly however many cars there are, so that a few hold all paints.

    The two run through a lattice of Roberts' R2 sequence from a place that the seed draws.
    """
    start = np.random.default_rng([seed, 4]).random(2)
    paint, tint = (start + (car + 1) * np.array([0.7548776662466927, 0.5698402909980532])) % 1.0
    return CarLook(paint=float(paint), tint=float(tint))


def seed_of(*words: object) -> int:
    """The same number for the same words."""
    return zlib.crc32("/".join(map(str, words)).encode())


def relative_velocity(root: kitti_disk.KittiRoot, view: VehicleView) -> F64:
    """Velocity (3,) of a labelled car against the scanner, in metres a second, from its box a scan before or after.

    Zeros where the label stands alone: then nothing is sheared.
    """
    sequence = root.sequence(view.sequence)
    mine = [b.id for b in kitti_disk.read_labels(sequence, view.frame) if np.array_equal(b.box, view.box)]
    time = kitti_disk.scan_time(sequence, view.frame)[0]
    for other in (view.frame + 1, view.frame - 1):
        if mine and other in sequence.frames and sequence.layout != "object":
            for label in kitti_disk.read_labels(sequence, other):
                interval_s = kitti_disk.scan_time(sequence, other)[0] - time
                if label.id == mine[0] and 0.02 < abs(interval_s) < 0.5:
                    return np.asarray((label.box[:3] - view.box[:3]) / interval_s * (1.0, 1.0, 0.0))
    return np.zeros(3)


def common_rays(profile: ScannerProfile) -> tuple[ScannerProfile, ScanRays]:
    """The rays of the recipe that is common elsewhere: even elevations and azimuths, all from the frame's origin."""
    beams, zero = profile.beams, [0.0] * profile.beams
    content = {
        **profile.content,
        "name": "common recipe",
        "elevation_rad": np.linspace(profile.elevation_rad[0], profile.elevation_rad[-1], beams).tolist(),
        **dict.fromkeys(("height_m", "side_m", "azimuth_rad", "tick_offset"), zero),
        **dict.fromkeys(("range_phase_mm", "range_bias_mm"), zero),
        "never_returned_ticks": [[] for _ in range(beams)],
    }
    even = profile_from_content(content, "common recipe")
    return even, fire_rays(even, np.arange(0, even.lattice_size, 2, dtype=np.uint16), 0.1)


def simulate(
    view: VehicleView,
    column: str,
    models: Sequence[CarModel],
    profile: ScannerProfile,
    look: CarLook,
    velocity: F64,
    common: tuple[ScannerProfile, ScanRays],
    seed: int,
) -> rf.CarRays:
    """A car of one of `COLUMNS` in a labelled car's place, as the view's rays (or the common recipe's) see it.

    All columns of a view draw from the same generator.
    """
    rng = np.random.default_rng([seed, seed_of(view.track, view.frame)])
    model = stretched(best_model(models, view.box, view.category), view.box[3:6])
    if column == "common":
        return _common_car(view, model, *common, rng)
    opaque = column == "opaque"
    cast = cast_fitted(view, model, profile, opaque, velocity * (column != "snapshot"))
    if column == "all_pass":
        cast = replace(cast, hits=without_panes(cast.hits))
        cast = replace(cast, row=np.isin(view.ray, cast.hits.ray))
    if column == "one_paint":
        look = CarLook(paint=0.5, tint=0.5)
    returns = simulate_returns(cast.hits, look, view.scan.rays, profile, opaque, rng)
    if column == "no_noise":
        returns = without_noise(cast.hits, returns, view.scan.rays, profile)
    if column == "independent":
        returns = with_independent_drops(cast.hits, returns, rng)
    measured, reflectance, _ = nearest_in_place(cast, returns)
    return rf.car_rays(view.scan.rays, view.ray, measured, reflectance, view.box, profile)


def without_panes(hits: CarHits) -> CarHits:
    """Hits as if the model had no glass: surfaces behind a pane move up, rays that met glass alone are left out."""
    solid = (hits.surface != GLASS) & (hits.surface != MEASURED)
    order = np.argsort(~solid, axis=1, kind="stable")

    def moved(values: Array, nothing: float) -> Any:
        return np.take_along_axis(np.where(solid, values, nothing), order, axis=1).astype(values.dtype)

    there = solid.any(axis=1)
    return CarHits(
        hits.ray[there],
        moved(hits.range_m, np.inf)[there],
        moved(hits.face, -1)[there],
        moved(hits.surface, MEASURED)[there],
        moved(hits.cos_incidence, 0.0)[there],
    )


def without_noise(hits: CarHits, returns: CarReturns, rays: ScanRays, profile: ScannerProfile) -> CarReturns:
    """Returns at their true range with one reflectance, from every solid surface met first; panes do as they do."""
    solid = (hits.surface[:, 0] != GLASS) & (hits.surface[:, 0] != MEASURED)
    stop = np.where(solid, hits.range_m[:, 0], returns.stop_m)
    exact = quantise_range(np.where(np.isfinite(stop), stop, 0.0), rays.ray_ring[hits.ray], profile)
    return CarReturns(stop, returns.returned | solid, exact, np.full(len(stop), 0.30), returns.surface)


def with_independent_drops(hits: CarHits, returns: CarReturns, rng: np.random.Generator) -> CarReturns:
    """As many returns from each kind of surface as before, but each ray's luck its own: drops are shuffled."""
    returned = returns.returned.copy()
    ended = np.isfinite(returns.stop_m)
    for surface in np.unique(hits.surface[:, 0]):
        mine = np.flatnonzero(ended & (hits.surface[:, 0] == surface))
        returned[mine] = rng.permutation(returned[mine])
    return replace(returns, returned=returned)


def _common_car(
    view: VehicleView, model: CarModel, even: ScannerProfile, rays: ScanRays, rng: np.random.Generator
) -> rf.CarRays:
    """The recipe that is common elsewhere."""
    ray = rays_at(rays, view.box, even, GROW_M)
    T_car_velo = np.broadcast_to(invert(pose_in_box(model, view.box)), (len(ray), 4, 4))
    hits = cast_car(model, T_car_velo, rays, ray, even, True)
    measured, shine = np.full(len(ray), np.inf), np.zeros(len(ray))
    seen = rng.random(len(hits.ray)) >= 0.10
    rows = np.searchsorted(ray, hits.ray[seen])
    measured[rows] = hits.range_m[seen, 0] + 0.01 * rng.standard_normal(int(seen.sum()))
    shine[rows] = np.rint(rng.random(len(rows)) * 99.0) / 100.0
    return rf.car_rays(rays, ray, measured, shine, view.box, even)


@dataclass(frozen=True)
class SetView:
    """Whose view it is, named as a `VehicleView` names it."""

    track: str
    sequence: str
    frame: int
    category: str


def cars_of_pair(pair: AugmentedPair, profile: ScannerProfile) -> Iterator[tuple[SetView, rf.CarRays]]:
    """Views of a pair's virtual cars that are seen as the labelled ones are: whole, within 45 m."""
    if pair.scan_kind != "raw":
        return
    for scan, frame, boxes in (
        (pair.scan0, pair.frame0, [o.box0 for o in pair.objects]),
        (pair.scan1, pair.frame1, [o.box1 for o in pair.objects]),
    ):
        on_lattice = scan.tick < profile.lattice_size
        fired = np.flatnonzero(np.bincount(scan.tick[on_lattice], minlength=profile.lattice_size) >= 4)
        rays = fire_rays(profile, fired.astype(np.uint16), 0.1)
        column = np.full(profile.lattice_size, -1)
        column[fired] = np.arange(len(fired))
        points = np.flatnonzero(on_lattice)
        points = points[column[scan.tick[points]] >= 0]
        point_of = np.full(len(rays), -1)
        point_of[scan.ring[points].astype(np.int64) * len(fired) + column[scan.tick[points]]] = points
        for item, box in zip(pair.objects, boxes, strict=True):
            if item.origin != "virtual" or box is None or item.category not in ("Car", "Van"):
                continue
            if not RANGE_M[0] <= math.hypot(box[0], box[1]) <= RANGE_M[1]:
                continue
            ray = rays_at(rays, box, profile, GROW_M)
            origin, direction = lines_of_rays(profile, rays, ray)
            at = scan.xyz[np.maximum(point_of[ray], 0)].astype(np.float64)
            there = point_of[ray] >= 0
            measured = np.where(there, ((at - origin) * direction).sum(axis=1), np.inf)
            shine = np.where(there, scan.reflectance[np.maximum(point_of[ray], 0)], 0.0)
            view = rf.car_rays(rays, ray, measured, shine, box, profile)
            uncovered = len(view) >= (1.0 - MAX_COVERED) * len(ray)
            if uncovered and view.on_car.sum() >= MIN_POINTS:
                named = SetView(f"{pair.pair_id}/{item.id}", pair.sequence, frame, item.category)
                yield named, view
