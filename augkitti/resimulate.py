"""Resimulation: a labelled vehicle as a scan saw it in, the same rays' returns from a car model in its place out.

The vehicle's own points are taken out, the model that fits its box best is put in, upright, on the box's floor, with
its heading, and the same fired rays are cast and measured as for a virtual car. Departures from what `add_cars` does:
the car stands still while it is swept (a label gives no motion, and its box fits the points as they were swept); and
where the real vehicle hid what is behind it, the nearest ray of the same ring that misses the vehicle says what a pulse
meets that passes all panes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from augkitti import same_math as sm
from augkitti.config import Config
from augkitti.frames import F32, F64, box_pose, compose, invert, pose_from_xyz_yaw, transform_points
from augkitti.labelled_views import TRIM_M, VehicleView, car_points
from augkitti.raycast import CarHits, cast_car
from augkitti.scan_pair import MEASURED, U8, Bool, CarModel
from augkitti.scanner import ScannerProfile, azimuth_time, lines_of_rays
from augkitti.sensor_noise import CarLook, CarReturns, simulate_returns

MOST_SCALED = 0.08  # a model is stretched by at most this share along each axis: the next body is as far away
_STEP = 0.01  # of scale factors: alike boxes share a mesh
_TAKEN_M = 0.15  # the vehicle's own points are taken out this far round its label box
_BEFORE_M = 0.25  # a return this far before the box is of something else, and stays


@dataclass(frozen=True, eq=False)
class Resimulated:
    """What the rays of a view return from a model in the vehicle's place. K as in the view."""

    model: CarModel  # as cast: stretched to the box
    T_velo_car: F64  # (4, 4)
    look: CarLook
    returned: Bool  # (K,) whether anything came back: of the model, before it or behind it
    range_m: F64  # (K,) as measured; inf where nothing came back
    reflectance: F32  # (K,) nan where nothing came back
    surface: U8  # (K,) of the contract; MEASURED where the return is not of the model, or there is none
    expected_m: F64  # (K,) true range of the model's first surface; inf where the ray misses it
    points: F64  # (N, 3) velo: cropped, trimmed and rounded as `labelled_views.car_points`


def resimulate(
    view: VehicleView,
    models: Sequence[CarModel],
    profile: ScannerProfile,
    config: Config,
    rng: np.random.Generator,
    model: CarModel | None = None,
    look: CarLook | None = None,
) -> Resimulated:
    """Put a model into a labelled vehicle's place and measure it along the view's rays.

    Args:
        models: to choose from by `best_model`.
        model: the one to take instead.
        look: the car's traits; None draws them. The generator is advanced alike in both cases.
    """
    cast = cast_in_place(view, best_model(models, view.box, view.category) if model is None else model, profile, config)
    drawn = CarLook(paint=float(rng.random()), tint=float(rng.random()))
    return measure_in_place(view, cast, look or drawn, profile, config, rng)


@dataclass(frozen=True, eq=False)
class CastInPlace:
    """A model in a vehicle's place and what the rays meet there: all that no chance enters."""

    model: CarModel  # stretched to the box
    T_velo_car: F64  # (4, 4)
    hits: CarHits  # `ray` counts in the scan's rays
    row: Bool  # (K,) which rays of the view meet the model
    without_m: F64  # (K,) range along the view's rays without the vehicle; inf for nothing
    without_reflectance: F32  # (K,)


def cast_in_place(view: VehicleView, model: CarModel, profile: ScannerProfile, config: Config) -> CastInPlace:
    """Stretch a model to a view's box, cast it, and find what the rays measure without the vehicle."""
    return cast_fitted(view, stretched(model, view.box[3:6]), profile, config.glass == "opaque")


def cast_fitted(
    view: VehicleView, model: CarModel, profile: ScannerProfile, opaque_glass: bool, velocity: F64 | None = None
) -> CastInPlace:
    """`cast_in_place` of a model as it is, on its way while it is swept.

    Args:
        velocity: (3,) metres a second against the scanner, velo; None for a car that stands.
    """
    rays = view.scan.rays
    T_velo_car = pose_in_box(model, view.box)
    T_car_velo = np.broadcast_to(invert(T_velo_car), (len(view.ray), 4, 4))
    if velocity is not None:
        period = view.scan.scan.period_s
        moment = azimuth_time(math.atan2(view.box[1], view.box[0]), period)
        late = (rays.ray_time_s[view.ray] - moment + 0.5 * period) % period - 0.5 * period
        ahead = np.broadcast_to(np.eye(4), (len(view.ray), 4, 4)).copy()
        ahead[:, :3, 3] = -late[:, None] * velocity  # the scanner's view of then, carried to the car's moment
        T_car_velo = compose(T_car_velo[0], ahead)
    hits = cast_car(model, T_car_velo, rays, view.ray, profile, opaque_glass)
    without_m, without_reflectance = without_vehicle(view, profile)
    return CastInPlace(model, T_velo_car, hits, np.isin(view.ray, hits.ray), without_m, without_reflectance)


def measure_in_place(
    view: VehicleView,
    cast: CastInPlace,
    look: CarLook,
    profile: ScannerProfile,
    config: Config,
    rng: np.random.Generator,
) -> Resimulated:
    """Send the pulses of a cast model; the nearest event along each ray wins, as in `occlusion`."""
    returns = simulate_returns(cast.hits, look, view.scan.rays, profile, config.glass == "opaque", rng)
    measured, reflectance, surface = nearest_in_place(cast, returns)
    expected = np.full(len(view.ray), np.inf)
    expected[cast.row] = cast.hits.range_m[:, 0]
    return Resimulated(
        model=cast.model,
        T_velo_car=cast.T_velo_car,
        look=look,
        returned=np.isfinite(measured),
        range_m=measured,
        reflectance=reflectance,
        surface=surface,
        expected_m=expected,
        points=car_points(view, profile, measured),
    )


def nearest_in_place(cast: CastInPlace, returns: CarReturns) -> tuple[F64, F32, U8]:
    """Range, reflectance and surface (K,) along a view's rays: the car's where it stops the pulse first.

    As in `Resimulated`.
    """
    measured, reflectance = cast.without_m.copy(), cast.without_reflectance.copy()
    surface = np.full(len(measured), MEASURED, dtype=np.uint8)
    wins = returns.stop_m < measured[cast.row]
    rows, seen = np.flatnonzero(cast.row)[wins], returns.returned[wins]
    measured[rows] = np.where(seen, returns.range_m[wins], np.inf)
    reflectance[rows] = np.where(seen, returns.reflectance[wins], np.nan)
    surface[rows] = np.where(seen, returns.surface[wins], MEASURED)
    return measured, reflectance, surface


def best_model(models: Sequence[CarModel], box: F64, category: str = "Car") -> CarModel:
    """The model whose length, width and height differ least from a box's (7,), in relative terms.

    Models of the box's own category come first, if there are any; of equals the first by name.
    """
    alike = [m for m in models if m.category == category] or list(models)
    return min(alike, key=lambda m: (float((sm.log(body_size(m) / box[3:6]) ** 2).sum()), m.name))


def body_size(model: CarModel) -> F64:
    """Length, width and height (3,) of a model as labels count them: without its mirrors, which stand out higher up."""
    low = model.vertices[model.vertices[:, 2] < 0.0]
    wide = 2.0 * float(np.abs(low[:, 1]).max()) if len(low) else float(model.size_m[1])
    return np.array([model.size_m[0], wide, model.size_m[2]])


def stretched(model: CarModel, size_m: F64) -> CarModel:
    """A model stretched to a size (3,) along each axis, in steps of 1 % and by at most `MOST_SCALED`."""
    scale = np.clip(np.rint((size_m / body_size(model) - 1.0) / _STEP) * _STEP, -MOST_SCALED, MOST_SCALED)
    return _stretched(model, *(1.0 + float(s) for s in scale))


@lru_cache(maxsize=64)
def _stretched(model: CarModel, x: float, y: float, z: float) -> CarModel:
    scale = np.array([x, y, z])
    return replace(
        model,
        vertices=model.vertices * scale,
        size_m=model.size_m * scale,
        wheelbase_m=model.wheelbase_m * x,
        rear_axle_x_m=model.rear_axle_x_m * x,
    )


def pose_in_box(model: CarModel, box: F64) -> F64:
    """`T_velo_car` of a model in a label's box (7,): on its floor, and at the sides that the scanner sees of it."""
    T_velo_box = box_pose(box)
    eye = transform_points(invert(T_velo_box), np.zeros(3))
    spare = 0.5 * (box[3:6] - body_size(model))
    along, across = (
        float(np.sign(eye[axis]) * spare[axis]) if abs(eye[axis]) > 0.5 * box[3 + axis] else 0.0 for axis in (0, 1)
    )
    return compose(T_velo_box, pose_from_xyz_yaw(along, across, -float(spare[2]), 0.0))


def without_vehicle(view: VehicleView, profile: ScannerProfile) -> tuple[F64, F32]:
    """Range (K,) metres and reflectance (K,) along a view's rays as if its vehicle were not there.

    What was measured before or beyond the vehicle stays. Where the vehicle returned or swallowed the pulse, the nearest
    ray of the ring that misses its box stands in, not nearer than the box itself.
    """
    rays = view.scan.rays
    crosses = view.leave_m >= view.enter_m
    own = own_returns(view, profile)
    open_ = ~crosses & ~own
    known = open_ | (np.isfinite(view.measured_m) & ~own)
    measured, reflectance = view.measured_m.copy(), view.reflectance.copy()
    ring = rays.ray_ring[view.ray]
    for beam in np.unique(ring):
        its = np.flatnonzero(ring == beam)
        outside, unknown = its[open_[its]], its[~known[its]]
        if not len(outside):
            measured[unknown], reflectance[unknown] = np.inf, np.nan
            continue
        at = np.minimum(np.searchsorted(outside, unknown), len(outside) - 1)
        before = outside[np.maximum(at - 1, 0)]
        nearer = np.abs(view.ray[before] - view.ray[unknown]) <= np.abs(view.ray[outside[at]] - view.ray[unknown])
        source = np.where(nearer, before, outside[at])
        behind = np.where(crosses[unknown], view.enter_m[unknown], 0.0)
        measured[unknown] = np.maximum(measured[source], behind)
        reflectance[unknown] = reflectance[source]
    return measured, reflectance


def own_returns(view: VehicleView, profile: ScannerProfile) -> Bool:
    """Which rays (K,) of a view returned from its vehicle: in the box grown by 0.15 m, above the ground in it."""
    origin, direction = lines_of_rays(profile, view.scan.rays, view.ray)
    measured = np.where(np.isfinite(view.measured_m), view.measured_m, 0.0)
    local = transform_points(invert(box_pose(view.box)), origin + measured[:, None] * direction)
    half = 0.5 * view.box[3:6] + _TAKEN_M
    inside = (np.abs(local) <= half).all(axis=1) & (local[:, 2] > TRIM_M - 0.5 * view.box[5])
    return np.asarray(np.isfinite(view.measured_m) & inside)
