"""Labelled objects and scene flow on the tiny drive, whose motions are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_drive import GROUND_Z_M, SCENE, TinyDrive, write_drive

from augkitti import kitti
from augkitti.frames import invert, se3_exp, transform_points
from augkitti.ground import standing_points
from augkitti.labelled_objects import label_points
from augkitti.scan_pair import AugmentedScan, GroundMap, ObjectRecord, PreparedScan, Scan, ScanPair
from augkitti.scanner import assign_rays, load_profile
from augkitti.scene_flow import scene_flow

PROFILE = load_profile()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TinyDrive:
    return write_drive(tmp_path_factory.mktemp("labelled"))


@pytest.fixture(scope="module")
def pair(drive: TinyDrive) -> ScanPair:
    (sequence,) = kitti.open_root(drive.root).sequences
    return kitti.read_pair(sequence, sequence.pairs[0][0])


def prepared(scan: Scan) -> PreparedScan:
    flat = np.full((2, 2), GROUND_Z_M, np.float32)
    plane = np.array([0.0, 0.0, 1.0, -GROUND_Z_M])
    is_ground = scan.xyz[:, 2] < GROUND_Z_M + 0.05
    ground = GroundMap(plane, (-100.0, -100.0), 100.0, flat, np.ones((2, 2), bool), is_ground)
    standing = standing_points(scan.xyz, ground)
    return PreparedScan(scan, assign_rays(scan, PROFILE), ground, None, standing)  # type: ignore[arg-type]


def test_moving_and_parked_cars_get_their_speed_and_motion_from_their_boxes(pair: ScanPair) -> None:
    found = label_points(pair, prepared(pair.scan0), prepared(pair.scan1))
    speeds = sorted(abs(item.speed) for item in found.objects if item.speed is not None)
    truth = sorted(abs(body.speed_mps) for body in SCENE if body.name in ("parked", "moving"))
    np.testing.assert_allclose(speeds, truth, atol=0.15)
    for row, item in enumerate(found.objects):
        assert item.motion is not None
        mine = pair.scan0.xyz[found.instance0 == row]
        assert len(mine) > 50
        landed = transform_points(item.motion, mine)
        local = np.abs(landed - item.box1[:3])
        assert np.percentile(local, 95) < max(item.box1[3:6])  # its points end in its second box


def test_points_on_the_ground_inside_a_box_stay_background(pair: ScanPair) -> None:
    found = label_points(pair, prepared(pair.scan0), prepared(pair.scan1))
    owned = found.instance0 >= 0
    assert owned.any()
    assert pair.scan0.xyz[owned, 2].min() > GROUND_Z_M + 0.15


def test_object_labelled_in_one_scan_only_has_no_motion_and_unknown_flow(pair: ScanPair) -> None:
    once = replace(pair, labels1=())
    found = label_points(once, prepared(pair.scan0), prepared(pair.scan1))
    assert all(item.motion is None and item.box1 is None for item in found.objects)
    assert found.unknown0[found.instance0 >= 0].all()
    assert (found.instance1 == -1).all()


def test_object_straight_behind_on_a_raw_scan_has_unknown_flow(pair: ScanPair) -> None:
    behind = replace(pair.labels0[0], box=np.array([-9.0, 0.5, GROUND_Z_M + 0.75, 4.0, 1.8, 1.5, 0.0]))
    both = replace(pair, labels0=(behind,), labels1=(behind,))
    found = label_points(both, prepared(pair.scan0), prepared(pair.scan1))
    assert found.unknown0[found.instance0 == 0].all()


def test_shell_round_a_moving_box_is_unknown_and_round_a_parked_one_is_not(pair: ScanPair) -> None:
    found = label_points(pair, prepared(pair.scan0), prepared(pair.scan1))
    for item in found.objects:
        local = np.abs(transform_points(invert(_pose(item)), pair.scan0.xyz))
        half = item.box0[3:6] / 2
        shell = (local <= half + 0.2).all(1) & ~(local <= half).all(1) & (found.instance0 < 0)
        assert shell.any()
        moving = abs(item.speed) > 1.0
        assert found.unknown0[shell].all() if moving else not found.unknown0[shell].any()


def _pose(item: ObjectRecord) -> np.ndarray:
    x, y, z, *_, yaw = item.box0
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3, *[st.floats(-0.3, 0.3)] * 3).map(np.array))
def test_flow_is_the_motion_of_the_points_body_and_of_the_world_elsewhere(twist: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    n = 30
    instance = np.array([-1, 0, 1] * 10, dtype=np.int16)
    xyz = rng.uniform(-40, 40, (n, 3)).astype(np.float32)
    zeros = np.zeros(n)
    scan = AugmentedScan(xyz, zeros, zeros, zeros, zeros, instance, zeros, zeros)  # type: ignore[arg-type]
    ego, moved = se3_exp(twist), se3_exp(-2.0 * twist)
    objects = (ObjectRecord("a", "Car", "virtual", motion=moved), ObjectRecord("b", "Car", "labelled"))
    unknown = np.zeros(n, bool)
    unknown[4] = True
    flow, status = scene_flow(scan, ego, objects, unknown)
    np.testing.assert_array_equal(status == 1, unknown | (instance == 1))
    truth = np.where(
        ((instance == 0) & ~unknown)[:, None],
        xyz @ moved[:3, :3].T + moved[:3, 3] - xyz,
        xyz @ ego[:3, :3].T + ego[:3, 3] - xyz,
    )
    np.testing.assert_allclose(flow, truth, atol=2e-5)


def test_shell_reaches_into_the_corners_of_a_turned_box(pair: ScanPair) -> None:
    here, size = np.array([14.0, 4.0]), np.array([2.0, 2.0, 1.5])
    box = np.concatenate([here, [GROUND_Z_M + 0.75], size, [np.pi / 4]])
    further = box + np.array([3.0, 0, 0, 0, 0, 0, 0])
    corner = np.array([[here[0] - np.sqrt(2) * 1.18, here[1], -1.0]], dtype=np.float32)
    scan0 = replace(pair.scan0, xyz=np.concatenate([corner, pair.scan0.xyz[1:]]))
    labels = [replace(pair.labels0[0], box=b) for b in (box, further)]
    moved = replace(pair, scan0=scan0, labels0=(labels[0],), labels1=(labels[1],))
    found = label_points(moved, replace(prepared(pair.scan0), scan=scan0), prepared(pair.scan1))
    assert found.unknown0[0]
