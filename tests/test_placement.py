"""Where virtual cars are put: on the ground at both moments, clear of everything, on a street made of rays."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.config import Config
from augkitti.drivable import with_headings
from augkitti.frames import (
    compose,
    footprint_corners,
    footprints_overlap,
    invert,
    points_in_box,
    pose_from_xyz_yaw,
    rotate_vectors,
    se3_exp,
    transform_points,
    wrap_angle,
    yaw_of,
)
from augkitti.ground import height_at, standing_points
from augkitti.kitti import open_root, read_pair
from augkitti.pair_motion import T_world_car, T_world_scanner, ego_twist
from augkitti.parametric_cars import parametric_cars
from augkitti.placement import car_box, make_scene, propose_car, wheel_contacts
from augkitti.scan_pair import GroundMap, LabelledBox, PreparedScan, Scan, ScanPair
from augkitti.scanner import assign_rays, azimuth_time, fire_rays, load_profile, ray_lines

HEIGHT_M = 1.73
PERIOD_S = 0.1034
CONFIG = Config()
PROFILE = load_profile()
MODELS = tuple(model for model in parametric_cars() if model.category == "Car")[:3]
EGO = (pose_from_xyz_yaw(1.0, 0.02, 0.0, 0.01), PERIOD_S)  # 10 m/s
WALL = np.array([25.0, 4.0, -0.73, 6.0, 1.0, 2.0, 0.0])  # beside the road's middle, in the way of the left lane


def street_pair(
    boxes0=(WALL,),
    boxes1=(WALL,),
    kind="raw",
    labels0=(),
    labels1=(),
    road_m=(-40.0, 60.0, -6.0, 6.0),
    rise=0.0,
    lift1_m=0.0,
):
    """A pair of scans of a plane (rising forward) with boxes, and its prepared scans; poses are exact.

    The maps of ground and road are given, not found: their own tests do that. `lift1_m` raises scan 1's map alone.
    """
    T_world_ego, interval = EGO
    twist = ego_twist(invert(T_world_ego), interval)
    prepared = []
    for middle, boxes in ((0.0, boxes0), (interval, boxes1)):
        scan, is_ground = scan_of(boxes, middle, twist, kind, rise)
        T_scanner_world = invert(T_world_scanner(twist, middle))
        ground = plane_map(is_ground, rise, T_scanner_world, lift1_m if middle else 0.0)
        prepared.append(
            PreparedScan(
                scan=scan,
                rays=assign_rays(scan, PROFILE),
                ground=ground,
                region=road_map(road_m, T_scanner_world),
                standing=standing_points(scan.xyz, ground),
            )
        )
    pair = ScanPair(
        sequence="street",
        recording="street",
        frame0=0,
        frame1=1,
        scan0=prepared[0].scan,
        scan1=prepared[1].scan,
        ego_motion=invert(T_world_ego),
        ego_source="truth",
        labels0=labels0,
        labels1=labels1,
    )
    return pair, prepared[0], prepared[1]


def scan_of(boxes, middle, twist, kind, rise):
    rays = fire_rays(PROFILE, np.arange(0, 4000, 2, dtype=np.uint16), PERIOD_S)
    origin, direction = ray_lines(PROFILE, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
    T_world_then = T_world_scanner(twist, middle + (rays.ray_time_s if kind == "raw" else 0.0 * rays.ray_time_s))
    o, d = transform_points(T_world_then, origin), rotate_vectors(T_world_then, direction)
    falls = d[:, 2] - rise * d[:, 0]
    t = np.where(falls < -1e-6, -(o[:, 2] - rise * o[:, 0] + HEIGHT_M) / np.minimum(falls, -1e-6), np.inf)
    is_ground = np.ones(len(t), dtype=bool)
    for box in boxes:
        low, high = box[:3] - box[3:6] / 2.0, box[:3] + box[3:6] / 2.0
        with np.errstate(divide="ignore"):
            a, b = (low - o) / d, (high - o) / d
        enters, leaves = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        hit = (enters < leaves) & (enters > 0.0) & (enters < t)
        t, is_ground = np.where(hit, enters, t), np.where(hit, False, is_ground)
    keep = (t < 79.0) & ~rays.ray_blind
    order = np.lexsort((rays.ray_azimuth_rad[keep] % (2 * np.pi), rays.ray_ring[keep]))
    xyz = (origin[keep] + t[keep, None] * direction[keep])[order]
    n = len(xyz)
    scan = Scan(
        xyz=np.round(xyz, 3).astype(np.float32),
        reflectance=np.full(n, 0.3, np.float32),
        row=np.arange(n, dtype=np.int32),
        rows_in_file=n,
        kind=kind,
        time_s=100.0 + middle,
        period_s=PERIOD_S,
    )
    return scan, is_ground[keep][order]


def plane_map(is_ground, rise, T_scanner_world, lift):
    cells = np.arange(-70.0, 70.0, 0.5) + 0.25
    x, y = np.meshgrid(cells, cells, indexing="ij")
    world = transform_points(invert(T_scanner_world), np.stack([x, y, 0.0 * x], axis=-1))
    height = (rise * world[..., 0] - HEIGHT_M + lift).astype(np.float32)
    return GroundMap(
        np.array([0.0, 0.0, 1.0, HEIGHT_M]), (-70.0, -70.0), 0.5, height, np.ones(x.shape, bool), is_ground
    )


def road_map(road_m, T_scanner_world):
    cells = np.arange(-65.0, 65.0, 0.2) + 0.1
    x, y = np.meshgrid(cells, cells, indexing="ij")
    world = transform_points(invert(T_scanner_world), np.stack([x, y, 0.0 * x], axis=-1))
    x0, x1, y0, y1 = road_m
    free = (world[..., 0] > x0) & (world[..., 0] < x1) & (world[..., 1] > y0) & (world[..., 1] < y1)
    return with_headings((-65.0, -65.0), 0.2, free, yaw_of(T_scanner_world))


@pytest.fixture(scope="module")
def street():
    pair, scan0, scan1 = street_pair()
    return pair, scan0, scan1, make_scene(pair, scan0, scan1, CONFIG)


def propose(scene, seed, others=(), must_move=False, config=CONFIG):
    return propose_car(scene, others, MODELS, must_move, None, config, np.random.default_rng(seed))


def proposals(scene, count, **named):
    cars = [propose(scene, seed, **named) for seed in range(count)]
    found = [car for car in cars if car is not None]
    assert len(found) > count // 2
    return found


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_body_moment_is_when_the_azimuth_passes_its_centre(street, seed):
    car = propose(street[3], seed)
    if car is None:
        return
    for pose, moment in ((car.pose0, car.moment0_s), (car.pose1, car.moment1_s)):
        assert abs(azimuth_time(np.arctan2(pose[1, 3], pose[0, 3]), PERIOD_S) - moment) < 1e-8


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_twist_leads_from_pose_to_pose(street, seed):
    pair, _, _, scene = street
    car = propose(scene, seed)
    if car is None:
        return
    interval = pair.scan1.time_s - pair.scan0.time_s
    twist = ego_twist(pair.ego_motion, interval)
    for pose, t in ((car.pose0, car.moment0_s), (car.pose1, interval + car.moment1_s)):
        np.testing.assert_allclose(
            compose(T_world_scanner(twist, t), pose), T_world_car(car, t), atol=1e-9, err_msg="world pose"
        )
    np.testing.assert_allclose(car.twist[5], car.yaw_rate_rps, atol=1e-3)
    rear = car.twist[:3] + np.cross(car.twist[3:], [car.model.rear_axle_x_m, 0.0, 0.0])
    np.testing.assert_allclose(rear, [car.speed_mps, 0.0, 0.0], atol=2e-2)


@pytest.mark.parametrize("rise", [0.0, 0.06])
def test_all_four_tyres_touch_the_ground_at_both_moments(rise):
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), rise=rise)
    for car in proposals(make_scene(pair, scan0, scan1, CONFIG), 12):
        for prepared, pose in ((scan0, car.pose0), (scan1, car.pose1)):
            contact = transform_points(pose, wheel_contacts(car.model))
            gap = contact[:, 2] - height_at(prepared.ground, contact[:, :2])
            assert np.abs(gap).max() < 0.01


def test_a_standing_car_stands_though_the_two_ground_maps_differ():
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), lift1_m=0.05)
    standing = Config.model_validate({"motion": {"slow_share": 0, "town_share": 0, "fast_share": 0}})
    for car in proposals(make_scene(pair, scan0, scan1, standing), 8, config=standing):
        assert car.speed_mps == 0.0
        assert not car.twist.any()
        for prepared, pose in ((scan0, car.pose0), (scan1, car.pose1)):
            contact = transform_points(pose, wheel_contacts(car.model))
            gap = contact[:, 2] - height_at(prepared.ground, contact[:, :2])
            assert np.abs(gap).max() < 0.04


def test_no_car_where_the_two_scans_disagree_about_the_ground():
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), lift1_m=0.3)
    scene = make_scene(pair, scan0, scan1, CONFIG)
    assert all(propose(scene, seed) is None for seed in range(5))


def test_no_car_without_a_road():
    pair, scan0, scan1 = street_pair(road_m=(0.0, 0.0, 0.0, 0.0))
    scene = make_scene(pair, scan0, scan1, CONFIG)
    assert propose(scene, 0) is None


def test_footprints_stay_on_the_road_of_both_scans(street):
    pair, _, _, scene = street
    interval = pair.scan1.time_s - pair.scan0.time_s
    for car in proposals(scene, 30):
        for t in (car.moment0_s, interval + car.moment1_s):
            corners = transform_points(T_world_car(car, t), box_corners(car.model))
            assert np.abs(corners[:, 1]).max() < 6.0 + 0.5  # cells of 0.2 m, maps in the frame of the scan's middle


def test_cars_keep_away_from_straight_behind(street):
    pair, _, _, scene = street
    interval = pair.scan1.time_s - pair.scan0.time_s
    twist = ego_twist(pair.ego_motion, interval)
    seen_behind = 0
    for car in proposals(scene, 150):
        times = np.linspace(car.moment0_s, interval + car.moment1_s, 21)
        T_scanner_car = compose(invert(T_world_scanner(twist, times)), T_world_car(car, times))
        for T in T_scanner_car:
            edge = np.concatenate([np.linspace(a, b, 9) for a, b in pairs_of(box_corners(car.model)[:, :3])])
            xyz = transform_points(T, edge)
            from_behind = np.abs(wrap_angle(np.arctan2(xyz[:, 1], xyz[:, 0]) - np.pi))
            assert from_behind.min() > np.deg2rad(15.0)
            seen_behind += bool(xyz[:, 0].max() < 0.0)
    assert seen_behind  # the rule leaves room behind, to the sides


def test_no_measured_point_lies_in_a_car(street):
    pair, scan0, scan1, scene = street
    interval = pair.scan1.time_s - pair.scan0.time_s
    twist = ego_twist(pair.ego_motion, interval)
    for car in proposals(scene, 40):
        for prepared, pose, middle in ((scan0, car.pose0, 0.0), (scan1, car.pose1, interval)):
            t = middle + prepared.rays.ray_time_s[prepared.rays.ray]
            near = np.hypot(*(prepared.scan.xyz[:, :2] - pose[:2, 3]).T) < 6.0
            T_car_scanner = compose(invert(T_world_car(car, t[near])), T_world_scanner(twist, t[near]))
            for local in (
                transform_points(T_car_scanner, prepared.scan.xyz[near]),
                transform_points(invert(pose), prepared.scan.xyz[near]),
            ):
                inside = points_in_box(local, np.eye(4), car.model.size_m)
                assert not (inside & (local[:, 2] > 0.35 - car.model.size_m[2] / 2.0)).any()


def test_a_thing_that_only_scan_1_sees_is_kept_clear_too():
    late = np.array([20.0, 0.0, -0.73, 8.0, 11.0, 2.0, 0.0])  # all over the road
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(late,))
    for car in proposals(make_scene(pair, scan0, scan1, CONFIG), 30):
        centre1 = T_world_car(car, PERIOD_S + car.moment1_s)[:2, 3]
        assert not footprints_overlap(footprint_corners(late), footprint_corners(car_box(car.model, car.pose1)))
        assert not 16.0 < centre1[0] < 24.0


def test_no_car_hides_behind_a_wall():
    wall = np.array([15.0, 0.0, 0.0, 0.5, 60.0, 6.0, 0.0])
    pair, scan0, scan1 = street_pair(boxes0=(wall,), boxes1=(wall,))
    for car in proposals(make_scene(pair, scan0, scan1, CONFIG), 40):
        assert car.pose0[0, 3] < 15.0


def test_cars_keep_clear_of_labelled_boxes_all_the_way():
    oncoming0 = LabelledBox("a", "Car", np.array([22.0, 1.5, -1.0, 4.5, 1.8, 1.5, np.pi]))
    oncoming1 = LabelledBox("a", "Car", np.array([18.5, 1.5, -1.0, 4.5, 1.8, 1.5, np.pi]))  # seen from 1 m farther on
    parked = LabelledBox("b", "Van", np.array([12.0, -1.5, -1.0, 5.5, 1.9, 2.0, 0.1]))  # labelled in scan 0 only
    pair, scan0, scan1 = street_pair(
        boxes0=(), boxes1=(), labels0=(oncoming0, parked), labels1=(oncoming1,), road_m=(5.0, 32.0, -4.0, 4.0)
    )
    for car in proposals(make_scene(pair, scan0, scan1, CONFIG), 40):
        for k, labels in enumerate(((oncoming0, parked), (oncoming1,))):
            mine = footprint_corners(car_box(car.model, car.pose1 if k else car.pose0))
            assert not any(footprints_overlap(mine, footprint_corners(label.box)) for label in labels)
        for share in np.linspace(0.0, 1.0, 11):
            mine = footprint_corners(car_box(car.model, T_world_car(car, share * PERIOD_S)))
            between = oncoming0.box + share * np.array([-2.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            assert not footprints_overlap(mine, footprint_corners(between))
            assert not footprints_overlap(mine, footprint_corners(parked.box))


def test_cars_keep_clear_of_the_ego_car_all_the_way():
    T_world_ego, interval = EGO
    twist = ego_twist(invert(T_world_ego), interval)
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), road_m=(-9.0, 9.0, -5.0, 5.0))
    config = Config.model_validate({"placement": {"min_range_m": 0.0}, "min_points": 1})
    ego = footprint_corners(np.array([-0.45, 0.0, 0.0, 4.9, 1.9, 1.5, 0.0]))
    for car in proposals(make_scene(pair, scan0, scan1, config), 30, config=config):
        for t in np.linspace(0.0, interval, 15):
            T_scanner_car = compose(invert(T_world_scanner(twist, t)), T_world_car(car, t))
            assert not footprints_overlap(footprint_corners(car_box(car.model, T_scanner_car)), ego)


def test_cars_keep_clear_of_each_other_all_the_way():
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), road_m=(5.0, 32.0, -4.0, 4.0))
    scene = make_scene(pair, scan0, scan1, CONFIG)
    for seed in range(5):
        first = propose(scene, seed)
        for car in proposals(scene, 20, others=(first,)):
            for mine, theirs in ((car.pose0, first.pose0), (car.pose1, first.pose1)):
                boxes = car_box(car.model, mine), car_box(first.model, theirs)
                assert not footprints_overlap(*map(footprint_corners, boxes))
            for t in np.linspace(0.0, PERIOD_S, 11):
                boxes = car_box(car.model, T_world_car(car, t)), car_box(first.model, T_world_car(first, t))
                assert not footprints_overlap(*map(footprint_corners, boxes))


def test_a_compensated_scan_has_one_moment():
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=(), kind="compensated")
    config = CONFIG
    for car in proposals(make_scene(pair, scan0, scan1, config), 5, config=config):
        assert car.moment0_s == car.moment1_s == 0.0
        np.testing.assert_allclose(
            compose(T_world_scanner(ego_twist(pair.ego_motion, PERIOD_S), PERIOD_S), car.pose1),
            compose(car.pose0, se3_exp(car.twist, pair.scan1.time_s - pair.scan0.time_s)),
            atol=1e-6,
        )


def test_the_same_chance_gives_the_same_car(street):
    first, second = propose(street[3], 5), propose(street[3], 5)
    assert first is not None
    assert second is not None
    assert first.model.name == second.model.name
    assert first.pose1.tobytes() == second.pose1.tobytes()
    assert first.twist.tobytes() == second.twist.tobytes()


def test_a_car_that_must_move_moves(street):
    for car in proposals(street[3], 20, must_move=True):
        assert abs(car.speed_mps) >= CONFIG.motion.moving_mps


def test_near_and_far_cars_are_proposed(street):
    distance = [np.hypot(*car.pose0[:2, 3]) for car in proposals(street[3], 80)]
    assert min(distance) < 12.0
    assert max(distance) > 30.0
    assert max(distance) <= CONFIG.placement.max_range_m + 1.0


def test_cars_head_along_a_road_that_bends_away():
    pair, scan0, scan1 = street_pair(boxes0=(), boxes1=())
    bent = []
    for prepared in (scan0, scan1):
        centres = np.arange(-65.0, 65.0, 0.2) + 0.1
        x, y = np.meshgrid(centres, centres, indexing="ij")
        off_axis = np.where(x < 10.0, y, (y - 0.5 * (x - 10.0)) * np.cos(np.arctan(0.5)))
        region = prepared.region
        bend = with_headings(region.origin_m, region.cell_m, np.abs(off_axis) < 4.0, region.road_heading_rad)
        bent.append(replace(prepared, region=bend))
    config = Config.model_validate({"motion": {"turning_share": 0, "against_share": 0}})
    scene = make_scene(pair, bent[0], bent[1], config)
    far = [yaw_of(car.pose0) for car in proposals(scene, 40, config=config) if 20.0 < car.pose0[0, 3] < 45.0]
    assert len(far) > 5
    assert abs(np.median(far) - np.arctan(0.5)) < 0.08


def box_corners(model):
    half = model.size_m / 2.0
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return np.column_stack([signs * half[:2], np.zeros(4)])


def pairs_of(corners):
    return zip(corners, np.roll(corners, -1, axis=0), strict=True)


@pytest.mark.kitti
def test_each_real_drive_has_room_for_a_car(kitti_root):
    from augkitti.augmentation import prepare_scan

    drives = [s for s in open_root(kitti_root).sequences if s.name.endswith("_sync")]
    assert drives
    for sequence in drives:
        frame = next(f for f in sequence.frames if f + 1 in sequence.frames)
        pair = read_pair(sequence, frame)
        scene = make_scene(
            pair, prepare_scan(pair.scan0, PROFILE, CONFIG), prepare_scan(pair.scan1, PROFILE, CONFIG), CONFIG
        )
        found = [propose(scene, seed) for seed in range(8)]
        assert any(car is not None for car in found), sequence.name
