from dataclasses import replace

import numpy as np
import pytest
from tiny_drive import SCENE, Body, write_drive

from augkitti.config import Config, MoversConfig
from augkitti.drivable import with_headings
from augkitti.frames import box_pose, compose, points_in_box, pose_from_xyz_yaw
from augkitti.ground import fit_ground, standing_points
from augkitti.kitti import open_root, read_pair
from augkitti.movers import find_movers, find_suspects, moves
from augkitti.scan_pair import PreparedScan
from augkitti.scanner import assign_rays, load_profile

CONFIG = MoversConfig()
MOVING = Body("moving", 16.0, -3.0, 0.0, (4.0, 1.7, 1.5), speed_mps=9.0, reflectance=0.2)


def prepared(scan):
    nowhere = with_headings((0.0, 0.0), 1.0, np.zeros((1, 1), bool), 0.0)
    ground = fit_ground(scan.xyz, Config().ground)
    return PreparedScan(scan, assign_rays(scan, load_profile()), ground, nowhere, standing_points(scan.xyz, ground))


def drive(folder, moving, **options):
    """A pair of the tiny drive with another moving body, its scans prepared, and the box of the body in scan 0."""
    scene = tuple(body for body in SCENE if body.name != "moving") + ((moving,) if moving else ())
    tiny = write_drive(folder, frames=(0, 1), scene=scene, **options)
    sequence = open_root(tiny.root).sequences[0]
    pair = replace(read_pair(sequence, 0), ego_motion=tiny.T_velo1_velo0)
    return pair, prepared(pair.scan0), prepared(pair.scan1), tiny.boxes[0]


def on_body(pair, scan0, box):
    """Points on the body; the ground under it left out. The box grows by what shears while the sweep passes."""
    return points_in_box(pair.scan0.xyz, box_pose(box), box[3:6], 0.1) & ~scan0.ground.is_ground


@pytest.fixture(scope="module")
def ahead(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("ahead"), MOVING)


def test_a_car_that_drives_is_found_whole_and_nothing_else(ahead):
    pair, scan0, scan1, boxes = ahead
    found = find_movers(pair, scan0, scan1, CONFIG)
    mine = on_body(pair, scan0, boxes["moving"])
    assert mine.sum() > 100
    assert found[mine].mean() > 0.95
    assert (found & ~mine).sum() <= 0.02 * mine.sum()


def test_a_parked_car_and_houses_do_not_move(ahead):
    pair, scan0, scan1, boxes = ahead
    found = find_movers(pair, scan0, scan1, CONFIG)
    parked = on_body(pair, scan0, boxes["parked"])
    assert parked.sum() > 100
    assert not found[parked].any()


def test_the_motion_over_ground_is_found(ahead):
    pair, scan0, scan1, _ = ahead
    (suspect,) = (s for s in find_suspects(pair, scan0, scan1, CONFIG) if moves(s, CONFIG))
    assert suspect.motion_m == pytest.approx([0.93, 0.0], abs=0.1)
    assert suspect.misfit_moved_m < suspect.misfit_still_m


@pytest.mark.parametrize(
    "moving",
    [
        Body("moving", 24.0, 4.0, np.pi, (4.2, 1.8, 1.5), speed_mps=14.0),  # towards the ego car: hides its own place
        Body("moving", 3.0, -3.2, 0.0, (4.2, 1.8, 1.5), speed_mps=7.0),  # seen from aside: contradicts at its ends only
        Body("moving", 16.0, -2.0, np.pi / 2, (4.2, 1.8, 1.5), speed_mps=5.0),  # crossing
    ],
    ids=["oncoming", "beside", "crossing"],
)
def test_cars_are_found_however_they_go(tmp_path, moving):
    pair, scan0, scan1, boxes = drive(tmp_path, moving)
    found = find_movers(pair, scan0, scan1, CONFIG)
    mine = on_body(pair, scan0, boxes["moving"])
    assert found[mine].mean() > 0.8
    assert (found & ~mine).sum() <= 0.05 * mine.sum()


def test_nothing_moves_in_a_street_where_nothing_moves(tmp_path):
    pair, scan0, scan1, _ = drive(tmp_path, None)
    assert not find_movers(pair, scan0, scan1, CONFIG).any()


def test_movers_are_found_from_a_standing_ego_car(tmp_path):
    pair, scan0, scan1, boxes = drive(tmp_path, MOVING, speed_mps=0.0, yaw_rate_rps=0.0)
    found = find_movers(pair, scan0, scan1, CONFIG)
    mine = on_body(pair, scan0, boxes["moving"])
    assert found[mine].mean() > 0.95
    assert not (found & ~mine).any()


def test_a_wrong_ego_motion_shows(ahead):
    """The test does look at the ego-motion: half a metre of error, and things that stand contradict it."""
    pair, scan0, scan1, boxes = ahead
    off = replace(pair, ego_motion=compose(pair.ego_motion, pose_from_xyz_yaw(0.5, 0.0, 0.0, 0.0)))
    parked = on_body(pair, scan0, boxes["parked"])
    assert find_movers(off, scan0, scan1, CONFIG)[parked].mean() > 0.5


def test_the_ego_cars_own_body_moves_with_it(ahead):
    pair, _, scan1, _ = ahead
    mirror = np.array([[-1.0, 1.2, -0.6], [-1.0, -1.3, -0.6]], np.float32)
    xyz = pair.scan0.xyz.copy()
    beside = np.flatnonzero((np.abs(xyz[:, 1]) < 6) & (np.abs(xyz[:, 0]) < 6))[:2]
    xyz[beside] = mirror
    scan0 = prepared(replace(pair.scan0, xyz=xyz))
    moved = replace(pair, scan0=scan0.scan)
    assert find_movers(moved, scan0, scan1, CONFIG)[beside].all()
    standing = replace(moved, ego_motion=np.eye(4))
    assert not find_movers(standing, scan0, scan0, CONFIG)[beside].any()


def test_scans_with_nothing_above_the_ground_give_no_movers(ahead):
    pair, scan0, _, _ = ahead
    bare = replace(scan0, ground=replace(scan0.ground, is_ground=np.ones(len(pair.scan0), bool)))
    assert not find_movers(pair, bare, bare, CONFIG).any()


def test_the_same_scans_give_the_same_movers(ahead):
    pair, scan0, scan1, _ = ahead
    first, second = (find_movers(pair, scan0, scan1, CONFIG) for _ in range(2))
    assert (first == second).all()


@pytest.mark.kitti
@pytest.mark.parametrize(("name", "frame", "driving"), [("0013", 26, True), ("0009", 40, False)])
def test_real_labelled_cars_are_found_when_they_drive_and_left_alone_when_parked(kitti_root, name, frame, driving):
    pair = read_pair(open_root(kitti_root).sequence(f"2011_09_26_drive_{name}_sync"), frame)
    scan0, scan1 = prepared(pair.scan0), prepared(pair.scan1)
    found = find_movers(pair, scan0, scan1, CONFIG)
    shares = []
    for label in pair.labels0:
        mine = points_in_box(pair.scan0.xyz, box_pose(label.box), label.box[3:6]) & ~scan0.ground.is_ground
        if mine.sum() >= 200 and np.hypot(*label.box[:2]) < 20.0:
            shares.append(found[mine].mean())
    assert len(shares) >= 2
    assert min(shares) > 0.9 if driving else max(shares) == 0.0
