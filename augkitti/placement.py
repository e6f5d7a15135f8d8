"""Where virtual cars go: a pair and its prepared scans in, one car with poses, moments and twist out, or none.

A drive is drawn first (speed, heading, steering), then places for it: many at once by their footprint on the drivable
region of both scans, then a few of them in full, against measured points, labelled boxes, the ego car and other
virtual cars, at both moments and between. Nothing here casts a ray; whether a car gets enough returns is seen later.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np

from augkitti import same_math as sm
from augkitti.config import Config, PlacementConfig
from augkitti.drivable import LARGEST_BEND_RAD, is_drivable
from augkitti.frames import (
    F32,
    F64,
    Array,
    compose,
    footprint_corners,
    invert,
    pose_on_slope,
    se3_exp,
    se3_log,
    transform_points,
    wrap_angle,
    yaw_of,
)
from augkitti.ground import height_at
from augkitti.occlusion import Occluded
from augkitti.pair_motion import T_world_car, T_world_scanner, ego_twist
from augkitti.raycast import bearings_of, box_corners, rays_between
from augkitti.scan_pair import (
    Bool,
    CarModel,
    DrivableRegion,
    GroundMap,
    LabelledBox,
    PreparedScan,
    ScanPair,
    VirtualCar,
)
from augkitti.scanner import azimuth_time
from augkitti.vehicle_motion import Drive, bicycle_twist, draw_drive, drive_planar

SEAM_RAD = np.deg2rad(15.0)  # contract: no car's azimuth span comes closer to straight behind
_SEAM_MARGIN_RAD = np.deg2rad(0.5)
_EGO_BOX = np.array([-0.45, 0.0, 0.0, 4.9, 1.9, 1.6, 0.0])  # KITTI's car round its scanner, seen from above
_TRACK_SHARE = 0.8  # wheels stand this far apart, in parts of the width (which has the mirrors in it)
_STEEPEST = 0.2  # rise over run: cars stand on roads
_FIRST_PLACES, _PLACES_AT_ONCE = 48, 192
_RETURNED = 0.7  # scanner.md section 3: share of body rays that return, mean over real cars


@dataclass(frozen=True, eq=False)
class SceneScan:
    """One scan as placement asks it. Times count from time0."""

    prepared: PreparedScan
    middle_s: float
    xyz: F32  # (3, M) measured points that stand on the ground, velo at their own firing
    box_quads: F64  # (B, 4, 2) footprints of labelled boxes in this scan, grown by the gap


@dataclass(frozen=True, eq=False)
class PlacementScene:
    """What placement asks of a pair, worked out once."""

    scans: tuple[SceneScan, SceneScan]
    twist: F64  # (6,) of the scanner, per second
    interval_s: float
    raw: bool
    cell_xy: F64  # (C, 2) centres of drivable cells of scan 0 within range, velo0
    cell_heading_rad: F64  # (C,) of the road at these cells, along the ego road rather than against it
    cell_chance: dict[str, F64]  # course to cumulated weights (C,)
    check_times_s: F64  # (K,) from before the first moment to after the last
    label_quads: F64  # (B, K, 4, 2) footprints of labelled boxes in the world, at these times
    ego_quads: F64  # (1, K, 4, 2)


def make_scene(pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan, config: Config) -> PlacementScene:
    """Work out what every proposal in a pair needs."""
    raw = pair.scan0.kind == "raw"
    interval = pair.scan1.time_s - pair.scan0.time_s
    twist = ego_twist(pair.ego_motion, interval)
    scans = (
        _scene_scan(prepared0, 0.0, pair.labels0, config.placement.box_gap_m),
        _scene_scan(prepared1, interval, pair.labels1, config.placement.box_gap_m),
    )
    half = 0.5 * pair.scan0.period_s if raw else 0.0
    times = np.linspace(-half, interval + half, 9)
    T_world_ego = T_world_scanner(twist, times)
    cell_xy, cell_heading = _drivable_cells(prepared0.region, config.placement)
    return PlacementScene(
        scans=scans,
        twist=twist,
        interval_s=interval,
        raw=raw,
        cell_xy=cell_xy,
        cell_heading_rad=cell_heading,
        cell_chance=_cell_chances(cell_xy, cell_heading, prepared0.region.road_heading_rad, config.placement),
        check_times_s=times,
        label_quads=_label_quads(pair, twist, times, raw, config.placement.box_gap_m),
        ego_quads=_quads(compose(T_world_ego, _planar_pose(_EGO_BOX)), _EGO_BOX[3:5], config.placement.box_gap_m)[None],
    )


def propose_car(
    scene: PlacementScene,
    others: Sequence[VirtualCar],
    models: Sequence[CarModel],
    must_move: bool,
    occluded: tuple[Occluded, Occluded] | None,
    config: Config,
    rng: np.random.Generator,
) -> VirtualCar | None:
    """Draw a car, how it drives and where; None where no place of those tried has room for it.

    Args:
        scene: from `make_scene`.
        others: virtual cars already in the pair.
        models: the cars to draw from, each as likely.
        must_move: whether it moves at `config.motion.moving_mps` or more.
        occluded: both scans with these in them, so that no car hides another whole; None without.
        config: limits and shares.
        rng: all chance comes from it; the number of draws depends on the scene.
    """
    model = models[int(rng.integers(len(models)))]
    paint = float(rng.random())
    drive = draw_drive(model.wheelbase_m, must_move, config.motion, rng)
    taken = (_taken(scene, 0, others, config.placement), _taken(scene, 1, others, config.placement))
    places = _likely_places(scene, taken, model, drive, config.placement, rng)
    for xy, yaw in islice(places, config.placement.full_checks):
        car = _stand(scene, model, drive, xy, yaw, paint, config.placement)
        if car is not None and has_room(scene, car, others, occluded, config):
            return car
    return None


def car_box(model: CarModel, T_velo_car: F64) -> F64:
    """The contract's box (7,) of a car: centre, size, heading."""
    return np.concatenate([T_velo_car[:3, 3], model.size_m, [yaw_of(T_velo_car)]])


def wheel_contacts(model: CarModel) -> F64:
    """Where the four tyres touch the ground (4, 3), car frame: front left, front right, rear left, rear right."""
    front, rear = model.rear_axle_x_m + model.wheelbase_m, model.rear_axle_x_m
    side, under = 0.5 * _TRACK_SHARE * float(model.size_m[1]), -0.5 * float(model.size_m[2])
    return np.array([[front, side, under], [front, -side, under], [rear, side, under], [rear, -side, under]])


def has_room(
    scene: PlacementScene,
    car: VirtualCar,
    others: Sequence[VirtualCar],
    occluded: tuple[Occluded, Occluded] | None,
    config: Config,
) -> bool:
    """Whether a car keeps clear of the seam, of all boxes and of all measured points, and can be seen."""
    return (
        (not scene.raw or clear_of_seam(scene, car))
        and _clear_of_boxes(scene, car, others, config.placement)
        and all(_in_sight(scan, car, k, occluded and occluded[k], config) for k, scan in enumerate(scene.scans))
        and all(_clear_of_points(scene, scan, car, k, config.placement) for k, scan in enumerate(scene.scans))
    )


def clear_of_seam(scene: PlacementScene, car: VirtualCar) -> bool:
    """Whether the car's corners keep 15 degrees from straight behind at both moments and between."""
    times = np.linspace(car.moment0_s, scene.interval_s + car.moment1_s, 7)
    T_scanner_car = compose(invert(T_world_scanner(scene.twist, times)), T_world_car(car, times))
    corners = transform_points(T_scanner_car[:, None], box_corners(car.model.size_m))
    from_behind = wrap_angle(sm.arctan2(corners[..., 1], corners[..., 0]) - np.pi)
    nearest = float(np.abs(from_behind).min())
    straddles = (
        (from_behind.max(axis=1) > 0) & (from_behind.min(axis=1) < 0) & (np.ptp(from_behind, axis=1) < np.pi)
    ).any()
    return nearest > SEAM_RAD + _SEAM_MARGIN_RAD and not straddles


def _scene_scan(prepared: PreparedScan, middle_s: float, labels: Sequence[LabelledBox], gap_m: float) -> SceneScan:
    boxes = np.array([label.box for label in labels]).reshape(-1, 7)
    return SceneScan(
        prepared=prepared,
        middle_s=middle_s,
        xyz=prepared.standing_xyz,
        box_quads=_footprints(boxes[:, :2], boxes[:, 6], boxes[:, 3:5], gap_m),
    )


def _drivable_cells(region: DrivableRegion, config: PlacementConfig) -> tuple[F64, F64]:
    """Drivable cells (C, 2) within range and the road's heading (C,) at each."""
    row, column = np.divmod(np.flatnonzero(region.drivable), region.drivable.shape[1])
    xy = np.stack(
        [(at + 0.5) * region.cell_m + start for at, start in zip((row, column), region.origin_m, strict=True)]
    )
    r = sm.hypot(xy[0], xy[1])
    use = (r >= config.min_range_m) & (r <= config.max_range_m)
    heading = region.heading_rad[row[use] // region.heading_cells, column[use] // region.heading_cells]
    return np.ascontiguousarray(xy[:, use].T), heading.astype(np.float64)


def _cell_chances(xy: F64, heading_rad: F64, road_heading_rad: float, config: PlacementConfig) -> dict[str, F64]:
    """Cumulated weights: distances evenly over where there is room, fewer on the wrong side and in side streets."""
    ring = np.floor(sm.hypot(xy[:, 0], xy[:, 1]) / 2.0).astype(np.int64)
    even = 1.0 / np.maximum(np.bincount(ring), 25)[ring] if len(xy) else np.zeros(0)
    on_ego_road = np.abs(heading_rad - road_heading_rad) < LARGEST_BEND_RAD
    left = xy[:, 1] * sm.cos(road_heading_rad) - xy[:, 0] * sm.sin(road_heading_rad)
    anywhere = np.cumsum(even)
    return {
        "along": np.cumsum(
            even * np.where((left < 1.75) & on_ego_road, 1.0, config.wrong_side_weight)
        ),  # beyond is the other lane
        "against": np.cumsum(even * np.where((left > 1.75) & on_ego_road, 1.0, config.wrong_side_weight)),
        "turning": anywhere,
        "crossing": anywhere,
    }


def _taken(scene: PlacementScene, k: int, others: Sequence[VirtualCar], config: PlacementConfig) -> F64:
    """Footprints (B, 4, 2) of labelled boxes and virtual cars, each at its own moment in scan k, grown by the gap."""
    boxes = [car_box(car.model, car.pose1 if k else car.pose0) for car in others]
    quads = [footprint_corners(box, config.box_gap_m)[None] for box in boxes]
    return np.concatenate([scene.scans[k].box_quads, *quads])


def _likely_places(
    scene: PlacementScene,
    taken: tuple[F64, F64],
    model: CarModel,
    drive: Drive,
    config: PlacementConfig,
    rng: np.random.Generator,
) -> Iterator[tuple[F64, float]]:
    """Places (2,) and yaws at the moment in scan 0 whose footprints lie on both regions, as if it were flat."""
    chance = scene.cell_chance[drive.course]
    jitter = rng.random((config.candidates, 2)) - 0.5
    picks = rng.random(config.candidates)
    if not len(chance) or chance[-1] <= 0.0:
        return
    cell = np.minimum(np.searchsorted(chance, picks * chance[-1]), len(chance) - 1)
    xy = scene.cell_xy[cell] + jitter * scene.scans[0].prepared.region.cell_m
    crossing = drive.course == "crossing"  # the ego road, not the side street that the car may stand in
    road = scene.scans[0].prepared.region.road_heading_rad if crossing else scene.cell_heading_rad[cell]
    yaw = np.full(len(xy), drive.heading_rad) + road
    if scene.raw:
        behind = np.abs(wrap_angle(sm.arctan2(xy[:, 1], xy[:, 0]) - np.pi))
        xy, yaw = xy[behind > SEAM_RAD], yaw[behind > SEAM_RAD]
    bounds = [0, _FIRST_PLACES, *range(_PLACES_AT_ONCE, len(xy), _PLACES_AT_ONCE), len(xy)]
    for start, end in pairwise(bounds):  # few are needed, as a rule
        block = slice(start, end)
        yield from zip(*_on_both_regions(scene, taken, model, drive, xy[block], yaw[block]), strict=True)


def _on_both_regions(
    scene: PlacementScene, taken: tuple[F64, F64], model: CarModel, drive: Drive, xy: F64, yaw: F64
) -> tuple[F64, list[float]]:
    inside = _footprint_drivable(scene.scans[0].prepared, model, xy, yaw)
    xy, yaw = xy[inside], yaw[inside]
    free = ~_touches(_footprints(xy, yaw, model.size_m), taken[0])
    xy, yaw = xy[free], yaw[free]
    if len(xy):
        xy1, yaw1 = _planar_at_scan1(scene, model, drive, xy, yaw)
        inside = _footprint_drivable(scene.scans[1].prepared, model, xy1, yaw1)
        inside &= ~_touches(_footprints(xy1, yaw1, model.size_m), taken[1])
        xy, yaw = xy[inside], yaw[inside]
    return xy, yaw.tolist()


def _planar_at_scan1(scene: PlacementScene, model: CarModel, drive: Drive, xy: F64, yaw: F64) -> tuple[F64, F64]:
    """Places and yaws at the moment in scan 1, in the scanner's frame of that moment."""
    moment0 = _moments(scene, 0, xy)
    T_world_then = T_world_scanner(scene.twist, moment0)
    z = height_at(scene.scans[0].prepared.ground, xy)
    xyz_world = transform_points(T_world_then, np.column_stack([xy, z]))
    yaw_world = yaw + sm.arctan2(T_world_then[:, 1, 0], T_world_then[:, 0, 0])
    moment1 = moment0
    for _ in range(2):  # the bearing hardly moves within the correction; `_stand` goes on to the end
        elapsed = scene.interval_s + moment1 - moment0
        xy_world, yaw1_world = drive_planar(xyz_world[:, :2], yaw_world, elapsed, drive, model.rear_axle_x_m)
        T_scanner_world = invert(T_world_scanner(scene.twist, scene.interval_s + moment1))
        xy1 = transform_points(T_scanner_world, np.column_stack([xy_world, xyz_world[:, 2]]))[:, :2]
        moment1 = _moments(scene, 1, xy1)
    return xy1, yaw1_world + sm.arctan2(T_scanner_world[:, 1, 0], T_scanner_world[:, 0, 0])


def _moments(scene: PlacementScene, k: int, xy: F64) -> F64:
    """When (M,) seconds from scan k's middle its azimuth passes places (M, 2)."""
    if not scene.raw:
        return np.zeros(len(xy))
    share = wrap_angle(sm.arctan2(xy[:, 1], xy[:, 0])) / (2.0 * np.pi)  # `azimuth_time` of many
    return np.asarray(-share * scene.scans[k].prepared.scan.period_s, dtype=np.float64)


def _footprint_drivable(prepared: PreparedScan, model: CarModel, xy: F64, yaw: F64) -> Bool:
    """Which footprints (M,) lie wholly on the drivable region."""
    length, width = float(model.size_m[0]), float(model.size_m[1])
    spacing = 2.0 * prepared.region.cell_m
    along = np.linspace(-0.5, 0.5, int(np.ceil(length / spacing)) + 1) * length
    across = np.linspace(-0.5, 0.5, int(np.ceil(width / spacing)) + 1) * width
    grid = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    s, c = (value[:, None] for value in sm.sincos(yaw))
    x = xy[:, :1] + c * grid[:, 0] - s * grid[:, 1]
    y = xy[:, 1:] + s * grid[:, 0] + c * grid[:, 1]
    inside = is_drivable(prepared.region, np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(x.shape)
    return np.asarray(inside.all(axis=1))


def _stand(
    scene: PlacementScene, model: CarModel, drive: Drive, xy: F64, yaw: float, paint: float, config: PlacementConfig
) -> VirtualCar | None:
    """The car on the ground at both moments; None where the two scans' ground disagrees or is not known."""
    moment0 = float(_moments(scene, 0, xy[None])[0])
    pose0 = _pose_on_ground(scene, 0, model, xy, yaw, moment0, config)
    if pose0 is None:
        return None
    T_world_car0 = compose(T_world_scanner(scene.twist, moment0), pose0)
    level_twist = bicycle_twist(drive.speed_mps, drive.yaw_rate_rps, model.rear_axle_x_m)
    moment1 = moment0
    for _ in range(8):  # a contraction by about v T / (2 pi r)
        elapsed = scene.interval_s + moment1 - moment0
        T_world_car1 = compose(T_world_car0, se3_exp(level_twist, elapsed))
        pose1 = compose(invert(T_world_scanner(scene.twist, scene.interval_s + moment1)), T_world_car1)
        before = moment1
        if scene.raw:
            moment1 = azimuth_time(float(sm.arctan2(pose1[1, 3], pose1[0, 3])), scene.scans[1].prepared.scan.period_s)
        if abs(moment1 - before) < 1e-9:
            break
    on_ground = _pose_on_ground(scene, 1, model, pose1[:2, 3], yaw_of(pose1), moment1, config)
    if on_ground is None:
        return None
    twist = np.zeros(6)
    if drive.speed_mps != 0.0:
        pose1 = on_ground
        T_world_car1 = compose(T_world_scanner(scene.twist, scene.interval_s + moment1), pose1)
        elapsed = scene.interval_s + moment1 - moment0
        twist = se3_log(compose(invert(T_world_car0), T_world_car1)) / elapsed
    car = VirtualCar(
        model=model,
        pose0=pose0,
        pose1=pose1,
        moment0_s=moment0,
        moment1_s=moment1,
        T_world_car0=T_world_car0,
        twist=twist,
        speed_mps=drive.speed_mps,
        yaw_rate_rps=drive.yaw_rate_rps,
        steering_rad=drive.steering_rad,
        paint=paint,
    )
    wheels = wheel_contacts(model)
    for scan, pose in zip(scene.scans, (pose0, pose1), strict=True):
        contact = transform_points(pose, wheels)
        gap = contact[:, 2] - height_at(scan.prepared.ground, contact[:, :2])
        if np.abs(gap).max() > config.ground_gap_m:
            return None
    return car


def _pose_on_ground(
    scene: PlacementScene, k: int, model: CarModel, xy: F64, yaw: float, moment_s: float, config: PlacementConfig
) -> F64 | None:
    """Pose in scan k with the tyres on the ground, centre at (x, y), heading kept.

    The height is the mean of what both scans say of this place, so that a standing car does not hop between two maps
    and a moving one does not shake; the caller sees to it that neither map is left by more than `ground_gap_m`.
    """
    wheels = wheel_contacts(model)
    s, c = sm.sincos(yaw)
    at = xy + np.stack([c * wheels[:, 0] - s * wheels[:, 1], s * wheels[:, 0] + c * wheels[:, 1]], axis=1)
    here, there = scene.scans[k], scene.scans[1 - k]
    if not _is_observed(here.prepared.ground, at).any():  # far out beams lie farther apart than axles
        return None
    height = height_at(here.prepared.ground, at)
    contact_world = transform_points(
        T_world_scanner(scene.twist, here.middle_s + moment_s), np.column_stack([at, height])
    )
    other = transform_points(invert(T_world_scanner(scene.twist, there.middle_s)), contact_world)
    if scene.raw:  # the other scan sees the place when its azimuth passes it
        passes = there.middle_s + float(_moments(scene, 1 - k, other[:, :2].mean(axis=0)[None])[0])
        other = transform_points(invert(T_world_scanner(scene.twist, passes)), contact_world)
    if not _is_observed(there.prepared.ground, other[:, :2]).any():
        return None
    height = height + 0.5 * (height_at(there.prepared.ground, other[:, :2]) - other[:, 2])
    along = (height[0] + height[1] - height[2] - height[3]) / (2.0 * model.wheelbase_m)
    across = (height[0] + height[2] - height[1] - height[3]) / (4.0 * wheels[0, 1])
    if sm.hypot(along, across) > _STEEPEST:
        return None
    normal = np.array([-along * c + across * s, -along * s - across * c, 1.0])
    normal /= np.sqrt((normal * normal).sum())
    up = 0.5 * float(model.size_m[2])
    foot = xy - up * normal[:2]  # the underside's centre lies below the box's centre along the normal
    axle_middle = at.mean(axis=0)
    slope = -normal[:2] / normal[2]
    z = float(height.mean() + (slope * (foot - axle_middle)).sum())
    return pose_on_slope(float(xy[0]), float(xy[1]), z + up * float(normal[2]), yaw, normal)


def _is_observed(ground: GroundMap, xy: Array) -> Bool:
    cell = np.floor((xy - np.asarray(ground.origin_m)) / ground.cell_m).astype(np.int64)
    inside = ((cell >= 0) & (cell < np.array(ground.observed.shape))).all(axis=1)
    row, column = np.where(inside, cell[:, 0], 0), np.where(inside, cell[:, 1], 0)
    return np.asarray(ground.observed[row, column] & inside)


def _clear_of_points(scene: PlacementScene, scan: SceneScan, car: VirtualCar, k: int, config: PlacementConfig) -> bool:
    """No measured point in the car: at the moment, at the point's own firing, nor on the way between the moments."""
    pose = car.pose1 if k else car.pose0
    half = 0.5 * car.model.size_m
    reach = float(np.sqrt((half[:2] ** 2).sum())) + config.point_gap_m
    way = abs(car.speed_mps) * scene.interval_s
    ego_way = float(np.sqrt((scene.twist[:3] ** 2).sum())) * 0.25 * scan.prepared.scan.period_s
    near = _within(scan.xyz, pose[:2, 3], reach + 0.5 * way + ego_way)
    xyz, time_s = _points_and_times(scene, scan, near)
    if _any_in_car(transform_points(invert(pose), xyz), car.model, config):
        return False
    T_car_scanner = compose(invert(T_world_car(car, time_s)), T_world_scanner(scene.twist, time_s))
    if _any_in_car(transform_points(T_car_scanner, xyz), car.model, config):
        return False
    times = np.linspace(car.moment0_s, scene.interval_s + car.moment1_s, 6)
    T_world = T_world_car(car, times)
    middle = transform_points(
        invert(T_world_scanner(scene.twist, scan.middle_s)), 0.5 * (T_world[0, :3, 3] + T_world[-1, :3, 3])
    )
    half_turn = 0.5 * scan.prepared.scan.period_s * float(np.abs(scene.twist[3:]).max()) * float(sm.hypot(*middle[:2]))
    near = _within(scan.xyz, middle, reach + 0.5 * way + 0.5 + 2.0 * ego_way + half_turn)
    xyz, time_s = _points_and_times(scene, scan, near)
    xyz_world = transform_points(T_world_scanner(scene.twist, time_s), xyz)
    return not _any_in_car(transform_points(invert(T_world)[:, None], xyz_world), car.model, config)


def _points_and_times(scene: PlacementScene, scan: SceneScan, which: Array) -> tuple[F64, F64]:
    """Some of the scan's standing points (K, 3) and when they were measured (K,), from time0."""
    rays = scan.prepared.rays
    fired = rays.ray_time_s[rays.ray[scan.prepared.standing[which]]] if scene.raw else np.zeros(len(which))
    return scan.xyz[:, which].T.astype(np.float64), scan.middle_s + fired


def _within(xyz: F32, centre: F64, radius_m: float) -> Array:
    near = np.flatnonzero(np.abs(xyz[0] - np.float32(centre[0])) < radius_m)
    return np.asarray(near[np.abs(xyz[1, near] - centre[1]) < radius_m])


def _any_in_car(xyz_car: F64, model: CarModel, config: PlacementConfig) -> bool:
    half = 0.5 * model.size_m
    grown = half + config.point_gap_m
    inside = (np.abs(xyz_car[..., 0]) < grown[0]) & (np.abs(xyz_car[..., 1]) < grown[1])
    inside &= (xyz_car[..., 2] > config.point_height_m - half[2]) & (xyz_car[..., 2] < grown[2])
    return bool(inside.any())


def _in_sight(scan: SceneScan, car: VirtualCar, k: int, occluded: Occluded | None, config: Config) -> bool:
    """Whether enough of the rays towards the car's box reach it, and it leaves enough to the cars behind it."""
    pose = car.pose1 if k else car.pose0
    corners = transform_points(pose, box_corners(car.model.size_m))
    distance = float(sm.hypot(pose[0, 3], pose[1, 3]))
    low, high = float(corners[:, 2].min()) + 0.1, float(corners[:, 2].max()) - 0.3  # not its very edges
    rays = scan.prepared.rays
    elevations = float(sm.arctan2(low, distance)), float(sm.arctan2(high, distance))
    toward = rays_between(rays, bearings_of(corners), elevations)
    point = rays.ray_point[toward]
    squared = (scan.prepared.scan.xyz[point] ** 2).sum(axis=1)
    passes = (point < 0) | (squared > (corners * corners).sum(axis=1).min())
    passes &= ~rays.ray_blind[toward]
    if occluded is not None and len(occluded.simulated.ray):
        others = occluded.simulated
        is_toward = np.zeros(len(rays), dtype=bool)
        is_toward[toward] = True
        crossed = is_toward[others.ray]
        nearer = (others.xyz[:, :2] ** 2).sum(axis=1) < distance * distance
        count = np.bincount(others.car)
        left = np.bincount(others.car[~crossed | nearer], minlength=len(count))
        if (left < config.min_points).any():
            return False
        is_toward[others.ray[crossed & nearer]] = False
        passes &= is_toward[toward]
    free = int(np.count_nonzero(passes))
    return free * _RETURNED >= config.min_points and free >= config.placement.min_free_share * len(toward)


def _clear_of_boxes(
    scene: PlacementScene, car: VirtualCar, others: Sequence[VirtualCar], config: PlacementConfig
) -> bool:
    times = scene.check_times_s
    mine = _quads(T_world_car(car, times), car.model.size_m[:2], 0.0)
    theirs = [scene.label_quads, scene.ego_quads]
    theirs += [_quads(T_world_car(c, times), c.model.size_m[:2], config.box_gap_m)[None] for c in others]
    if _overlap(mine, np.concatenate(theirs)).any():
        return False
    for k, pose in enumerate((car.pose0, car.pose1)):  # as the contract lists them: each in the frame of its own moment
        corners = footprint_corners(car_box(car.model, pose))
        if _touches(corners[None], _taken(scene, k, others, config)).any():
            return False
    return True


def _label_quads(pair: ScanPair, twist: F64, times: F64, rolling: bool, gap_m: float) -> F64:
    """Footprints (B, K, 4, 2) of labelled boxes in the world, moving evenly; labelled in one scan only: standing."""
    interval = pair.scan1.time_s - pair.scan0.time_s
    second = {label.id: label for label in pair.labels1}
    first_ids = {label.id for label in pair.labels0}
    rows: list[tuple[LabelledBox | None, LabelledBox | None]]
    rows = [(label, second.get(label.id)) for label in pair.labels0]
    rows += [(None, label) for label in pair.labels1 if label.id not in first_ids]

    def in_world(label: LabelledBox, middle_s: float, period_s: float) -> tuple[float, F64]:
        t = middle_s
        if rolling:
            t += azimuth_time(float(sm.arctan2(label.box[1], label.box[0])), period_s)
        return t, compose(T_world_scanner(twist, t), _planar_pose(label.box))

    quads = []
    for label0, label1 in rows:
        known = label0 or label1
        assert known is not None
        seen = [in_world(label0, 0.0, pair.scan0.period_s)] if label0 else []
        seen += [in_world(label1, interval, pair.scan1.period_s)] if label1 else []
        (t0, T_world_box0), (t1, T_world_box1) = seen[0], seen[-1]
        step = se3_log(compose(invert(T_world_box0), T_world_box1)) / (t1 - t0) if t1 > t0 else np.zeros(6)
        quads.append(_quads(compose(T_world_box0, se3_exp(step, times - t0)), known.box[3:5], gap_m))
    return np.array(quads).reshape(-1, len(times), 4, 2)


def _planar_pose(box: F64) -> F64:
    s, c = sm.sincos(float(box[6]))
    return np.array([[c, -s, 0.0, box[0]], [s, c, 0.0, box[1]], [0.0, 0.0, 1.0, box[2]], [0.0, 0.0, 0.0, 1.0]])


def _quads(T_world_box: F64, length_width_m: F64, gap_m: float) -> F64:
    """Footprints (..., 4, 2) of boxes at poses (..., 4, 4), seen from above."""
    half_l, half_w = 0.5 * float(length_width_m[0]) + gap_m, 0.5 * float(length_width_m[1]) + gap_m
    corners = np.array([[half_l, half_w, 0.0], [-half_l, half_w, 0.0], [-half_l, -half_w, 0.0], [half_l, -half_w, 0.0]])
    return transform_points(T_world_box[..., None, :, :], corners)[..., :2]


def _footprints(xy: F64, yaw: F64, length_width_m: Array, gap_m: float = 0.0) -> F64:
    """Footprints (M, 4, 2) of boxes at places (M, 2) and yaws (M,), of one size or of (M, 2), grown by the gap."""
    half = 0.5 * np.asarray(length_width_m, dtype=np.float64)[..., None, :2] + gap_m
    local = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * half
    sine, cosine = (value[:, None] for value in sm.sincos(yaw))
    x = xy[:, :1] + cosine * local[..., 0] - sine * local[..., 1]
    return np.stack([x, xy[:, 1:] + sine * local[..., 0] + cosine * local[..., 1]], axis=-1)


def _touches(mine: F64, theirs: F64) -> Bool:
    """Which quadrilaterals (M, 4, 2) touch any of (B, 4, 2)."""
    return np.asarray(_overlap(mine[:, None], theirs).any(axis=1))


def _overlap(mine: F64, theirs: F64) -> Bool:
    """Whether parallelograms (..., 4, 2) touch others that broadcast with them, by the separating axis theorem."""
    apart = np.zeros(np.broadcast_shapes(mine.shape[:-2], theirs.shape[:-2]), dtype=bool)
    for quad in (mine, theirs):
        for first in (0, 1):  # opposite sides are parallel
            edge = quad[..., first + 1, :] - quad[..., first, :]
            nx, ny = -edge[..., 1, None], edge[..., 0, None]
            a = nx * mine[..., 0] + ny * mine[..., 1]
            b = nx * theirs[..., 0] + ny * theirs[..., 1]
            apart |= (a.max(-1) < b.min(-1)) | (b.max(-1) < a.min(-1))
    return np.asarray(~apart)
