"""Virtual cars of a pair and its prepared scans in; their returns in both scans, and the finished pair, out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from augkitti.config import Config
from augkitti.frames import (
    F64,
    Array,
    compose,
    invert,
    move_lines,
    points_in_box,
    pose_from_xyz_yaw,
    rotate_vectors,
    transform_points,
)
from augkitti.labelled_objects import pair_interval
from augkitti.occlusion import Occluded, keep_nearest, measured_range
from augkitti.pair_motion import T_world_car, T_world_scanner, ego_twist
from augkitti.placement import car_box
from augkitti.raycast import CarHits, bearings_of, box_corners, cast_mesh, cross_box, rays_near
from augkitti.scan_pair import (
    I16,
    MEASURED,
    MIXED,
    NO_TICK,
    AugmentedPair,
    AugmentedScan,
    ObjectRecord,
    PreparedPair,
    PreparedScan,
    ScanPair,
    VirtualCar,
)
from augkitti.scanner import ScannerProfile, lines_of_rays
from augkitti.scene_flow import scene_flow
from augkitti.sensor_noise import CarLook, CarReturns, simulate_returns

_BODY_MIDDLE = (0.70, 0.25, 0.50)  # contract, invariant 8: share of length and width; of height from, to
_OPEN_SHARE = 0.005  # half of what the contract allows: the sweep shears what is judged here in one moment
_SHEAR_M = 0.24  # contract: 0.25 m; less the rounding of coordinates
_NEAR_M = 0.05  # rays are tried this far round the car's box, beside what it moves within the sweep


@dataclass(frozen=True, eq=False)
class Cast:
    """One car as both scans meet it."""

    hits: tuple[CarHits, CarHits]
    returns: tuple[CarReturns, CarReturns]


def cast_and_measure(
    car: VirtualCar,
    pair: ScanPair,
    scan0: PreparedScan,
    scan1: PreparedScan,
    profile: ScannerProfile,
    config: Config,
    rng: np.random.Generator,
) -> Cast:
    """Cast a car into both scans, each ray at its own firing time, and send the pulses."""
    opaque = config.glass == "opaque"
    look = CarLook(paint=car.paint, tint=float(rng.random()))
    hits, returns = [], []
    for k, prepared in enumerate((scan0, scan1)):
        its_hits = cast_into_scan(car, k, pair, prepared, profile, config)
        hits.append(its_hits)
        returns.append(simulate_returns(its_hits, look, prepared.rays, profile, opaque, rng))
    return Cast((hits[0], hits[1]), (returns[0], returns[1]))


def cast_into_scan(
    car: VirtualCar, k: int, pair: ScanPair, prepared: PreparedScan, profile: ScannerProfile, config: Config
) -> CarHits:
    """What the rays of scan k meet on a car, each at its own firing time."""
    rays, start = prepared.rays, k * pair_interval(pair)
    pose, moment = (car.pose1, car.moment1_s) if k else (car.pose0, car.moment0_s)
    twist = ego_twist(pair.ego_motion, pair_interval(pair))
    rolling = prepared.scan.kind == "raw" and config.shutter == "rolling"
    drift = _sweep_drift(car, pose, twist, prepared) if rolling else 0.0
    near = rays_near(rays, pose, car.model.size_m, _NEAR_M + drift)
    times = rays.ray_time_s[near] if rolling else np.full(len(near), moment)
    moments, which = np.unique(times, return_inverse=True)
    T_car_scanner = compose(invert(T_world_car(car, start + moments)), T_world_scanner(twist, start + moments))
    origin, direction = lines_of_rays(profile, rays, near)
    origin, direction = move_lines(T_car_scanner, which, origin, direction)
    return cast_mesh(car.model, near, origin, direction, config.glass == "opaque")


def _sweep_drift(car: VirtualCar, pose: F64, twist: F64, prepared: PreparedScan) -> float:
    """How far the car and the scanner move against each other between its moment and its rays, at most (metres).

    Rays that meet the car pass it within half of its window of bearings, and the drift itself widens that by less than
    a third, at the speeds and distances of cars on roads.
    """
    speed = abs(car.speed_mps) + float(np.sqrt((twist[:3] * twist[:3]).sum()))
    first, last = bearings_of(transform_points(pose, box_corners(car.model.size_m)))
    return speed * prepared.scan.period_s * min(0.25, 0.65 * (last - first) / (2.0 * np.pi))


def occlude_both(
    casts: Sequence[Cast], scan0: PreparedScan, scan1: PreparedScan, profile: ScannerProfile
) -> tuple[Occluded, Occluded]:
    """Both scans with all cars in them."""
    return occlude(casts, 0, scan0, profile), occlude(casts, 1, scan1, profile)


def seen_well_enough(occluded: tuple[Occluded, Occluded], cars: int, min_points: int) -> bool:
    """Whether every car keeps at least `min_points` returns in both scans once all hide each other."""
    own = [scan.simulated.car[scan.simulated.surface != MIXED] for scan in occluded]
    counts = [np.bincount(its, minlength=cars) for its in own]
    return all(int(count.min(initial=min_points)) >= min_points for count in counts)


def keeps_its_shape(
    car: VirtualCar, cast: Cast, scan0: PreparedScan, scan1: PreparedScan, profile: ScannerProfile
) -> bool:
    """Whether all returns stay by the car's box: the sweep shears a fast car beside the scanner out of it.

    The contract (invariant 4) allows 0.25 m; a car that would be sheared more is no use as a box label either.
    """
    for prepared, pose, hits, returns in zip(
        (scan0, scan1), (car.pose0, car.pose1), cast.hits, cast.returns, strict=True
    ):
        ray, rays = hits.ray[returns.returned], prepared.rays
        origin, direction = lines_of_rays(profile, rays, ray)
        points = origin + returns.range_m[returns.returned, None] * direction
        if not points_in_box(points, pose, car.model.size_m, _SHEAR_M).all():
            return False
    return True


def hides_what_is_behind(
    car: VirtualCar, cast: Cast, scan0: PreparedScan, scan1: PreparedScan, profile: ScannerProfile
) -> bool:
    """Whether the middle of the car's body is closed to the rays, as real bodies are (contract, invariant 8).

    A model with open wheel arches or no floor lets pulses through from some sides; the car is then put elsewhere.
    """
    share, low, high = _BODY_MIDDLE
    size = car.model.size_m * (share, share, high - low)
    T_car_middle = pose_from_xyz_yaw(0.0, 0.0, (0.5 * (low + high) - 0.5) * float(car.model.size_m[2]), 0.0)
    for prepared, pose, hits, returns in zip(
        (scan0, scan1), (car.pose0, car.pose1), cast.hits, cast.returns, strict=True
    ):
        rays = prepared.rays
        T_velo_middle = compose(pose, T_car_middle)
        near = rays_near(rays, T_velo_middle, size, 0.0)
        origin, direction = lines_of_rays(profile, rays, near)
        T_middle_velo = invert(T_velo_middle)
        origin, direction = transform_points(T_middle_velo, origin), rotate_vectors(T_middle_velo, direction)
        enter, leave = cross_box(origin, direction, -0.5 * size, 0.5 * size)
        through = (enter < leave) & (enter > 0.0)
        stopped = np.isin(near, hits.ray[np.isfinite(returns.stop_m)])
        measured = measured_range(prepared, near, profile)
        open_rays = through & ~stopped & np.isfinite(measured) & (measured > enter)
        if open_rays.sum() > _OPEN_SHARE * through.sum():
            return False
    return True


def occlude(casts: Sequence[Cast], k: int, prepared: PreparedScan, profile: ScannerProfile) -> Occluded:
    """Scan k with all cars in it."""
    return keep_nearest(prepared, [(cast.hits[k].ray, cast.returns[k]) for cast in casts], profile)


def finish_pair(
    pair: ScanPair,
    prepared: PreparedPair,
    cars: Sequence[VirtualCar],
    casts: Sequence[Cast],
    occluded: tuple[Occluded, Occluded],
    seed: int,
    pair_id: str,
) -> AugmentedPair:
    """Hide what the cars hide, label every point, and fill the contract's columns."""
    scan0, scan1, labelled = prepared.scan0, prepared.scan1, prepared.labelled
    occluded0, occluded1 = occluded
    first_car = len(labelled.objects)
    columns0 = _columns(scan0, occluded0, labelled.instance0, first_car)
    columns1 = _columns(scan1, occluded1, labelled.instance1, first_car)
    objects = [
        *labelled.objects,
        *(_virtual_object(i, *item, scan0, scan1) for i, item in enumerate(zip(cars, casts, strict=True))),
    ]
    counts0 = np.bincount(columns0.instance[columns0.instance >= 0], minlength=len(objects))
    counts1 = np.bincount(columns1.instance[columns1.instance >= 0], minlength=len(objects))
    counted = tuple(
        replace(item, points0=int(counts0[row]), points1=int(counts1[row])) for row, item in enumerate(objects)
    )
    open_flow = labelled.unknown0 | (prepared.movers0 & (labelled.instance0 < 0))
    unknown0 = np.concatenate([open_flow[occluded0.kept], occluded0.simulated.surface == MIXED])
    flow0, status0 = scene_flow(columns0, pair.ego_motion, counted, unknown0)
    return AugmentedPair(
        pair_id=pair_id,
        sequence=pair.sequence,
        recording=pair.recording,
        frame0=pair.frame0,
        frame1=pair.frame1,
        time0=pair.scan0.time_s,
        time1=pair.scan1.time_s,
        scan_kind=pair.scan0.kind,
        seed=seed,
        ego_motion=pair.ego_motion,
        ego_source=pair.ego_source,
        label_coverage=pair.label_coverage,
        label_azimuth=pair.label_azimuth,
        scan0=columns0,
        scan1=columns1,
        flow0=flow0,
        flow_status0=status0,
        objects=counted,
    )


def _columns(prepared: PreparedScan, occluded: Occluded, instance: I16, first_car: int) -> AugmentedScan:
    scan, rays, new = prepared.scan, prepared.rays, occluded.simulated
    edges = np.flatnonzero(np.diff(occluded.kept, prepend=False, append=False)).reshape(-1, 2)
    kept = [slice(int(first), int(last)) for first, last in edges]  # a car hides runs of each ring
    measured = sum(run.stop - run.start for run in kept)

    def joined(column: Array, simulated: Array) -> Array:
        return np.concatenate([*(column[run] for run in kept), simulated.astype(column.dtype, copy=False)])

    return AugmentedScan(
        xyz=joined(scan.xyz, new.xyz),
        reflectance=joined(scan.reflectance, new.reflectance),
        ring=joined(rays.ring, new.ring),
        tick=joined(rays.tick, new.tick),
        source=joined(scan.row, np.full(len(new.xyz), -1, dtype=np.int32)),
        instance=joined(instance, np.where(new.surface == MIXED, -1, new.car + first_car)),
        surface=np.concatenate([np.full(measured, MEASURED, dtype=np.uint8), new.surface]),
        removed=scan.row[~occluded.kept],
    )


def _virtual_object(index: int, car: VirtualCar, cast: Cast, scan0: PreparedScan, scan1: PreparedScan) -> ObjectRecord:
    on_lattice = [
        int((p.rays.ray_tick[h.ray] != NO_TICK).sum()) if p.scan.kind == "raw" else len(h.ray)
        for p, h in zip((scan0, scan1), cast.hits, strict=True)
    ]
    return ObjectRecord(
        id=f"virtual_{index}",
        category=car.model.category,
        origin="virtual",
        model=car.model.name,
        box0=car_box(car.model, car.pose0),
        box1=car_box(car.model, car.pose1),
        pose0=car.pose0,
        pose1=car.pose1,
        moment0=car.moment0_s,
        moment1=car.moment1_s,
        motion=compose(car.pose1, invert(car.pose0)),
        rays0=on_lattice[0],
        rays1=on_lattice[1],
        speed=car.speed_mps,
        yaw_rate=car.yaw_rate_rps,
        steering=car.steering_rad,
    )
