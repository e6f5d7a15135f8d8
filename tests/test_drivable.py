"""Drivable region: road in, pavements and obstacles out, on streets in closed form and on real scans."""

import numpy as np
import pytest
from flat_street import FlatStreet

from augkitti.config import Config
from augkitti.drivable import find_drivable_region, is_drivable
from augkitti.ground import fit_ground
from augkitti.kitti import open_root, read_scan
from augkitti.scan_pair import Scan
from augkitti.scanner import assign_rays, load_profile
from augkitti.synthesize import ROAD, synthesize

CONFIG = Config()
PARKED = (12.0, -2.4, 4.2, 1.8, 0.0, 1.5)
BRIDGE = (20.0, 1.5, 3.0, 3.0, 2.6, 3.5)


def region_of(scan, rays):
    return find_drivable_region(scan, rays, fit_ground(scan.xyz, CONFIG.ground), CONFIG.drivable)


def cells_within(reach_m):
    steps = np.arange(-reach_m + 0.1, reach_m, 0.2)
    xy = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    return xy[np.hypot(xy[:, 0], xy[:, 1]) < reach_m]


@pytest.fixture(scope="module")
def street():
    return FlatStreet(yaw_rad=0.12, boxes=(PARKED, BRIDGE))


@pytest.fixture(scope="module")
def region(street):
    return region_of(*street.scan())


@pytest.mark.parametrize(
    "street",
    [
        FlatStreet(kerb_m=0.08),
        FlatStreet(kerb_m=0.15, grade=0.05),
        FlatStreet(yaw_rad=-0.2, left_m=3.0, right_m=-3.0),
        FlatStreet(houses_m=8.0, crown=0.0),
    ],
    ids=["low kerbs", "uphill", "narrow and turned", "broad flat pavements"],
)
def test_road_is_in_and_pavements_are_out(street):
    region = region_of(*street.scan())
    xy = cells_within(40.0)
    inside, road = is_drivable(region, xy), street.is_road(xy)
    assert road[inside].mean() > 0.97
    assert inside[road].mean() > 0.75


def test_heading_is_that_of_the_street(street, region):
    assert region.road_heading_rad == pytest.approx(street.yaw_rad, abs=np.radians(1.5))


def place(street, along, across):
    c, s = np.cos(street.yaw_rad), np.sin(street.yaw_rad)
    return np.array([[along * c - across * s, along * s + across * c]])


def test_a_parked_car_is_left_out(street, region):
    assert not is_drivable(region, place(street, PARKED[0] - 1.9, PARKED[1]))[0]
    assert not is_drivable(region, place(street, PARKED[0] + 1.0, PARKED[1]))[0]


def test_under_what_hangs_high_one_can_drive(street, region):
    assert is_drivable(region, place(street, BRIDGE[0], BRIDGE[1]))[0]


def test_the_road_beside_the_ego_car_is_drivable(street, region):
    assert is_drivable(region, place(street, 0.0, 3.0))[0]


def test_nothing_is_drivable_beyond_the_grid(region):
    assert not is_drivable(region, np.array([[500.0, 0.0], [-61.0, 900.0]])).any()


def test_a_road_that_a_barrier_closes_ends_there():
    street = FlatStreet(boxes=((15.0, 0.75, 1.0, 8.4, 0.0, 0.9),))
    region = region_of(*street.scan())
    assert is_drivable(region, np.array([[10.0, 1.0]]))[0]
    assert not is_drivable(region, np.array([[15.0, 1.0], [25.0, 1.0], [35.0, 1.0]])).any()


def test_without_any_point_only_the_ego_cars_own_place_is_drivable():
    nothing = np.zeros(0, np.int32)
    scan = Scan(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), nothing, 0, "raw", 0.0, 0.1)
    region = region_of(scan, assign_rays(scan, load_profile()))
    assert is_drivable(region, np.array([[0.0, 0.0]]))[0]
    assert region.drivable.sum() * region.cell_m**2 < 25.0
    assert region.road_heading_rad == 0.0


def test_same_scan_gives_the_same_bytes(street, region):
    again = region_of(*street.scan())
    assert again.drivable.tobytes() == region.drivable.tobytes()
    assert again.road_heading_rad == region.road_heading_rad


def test_region_on_the_embedded_street_holds_its_road_and_no_pavement(tmp_path):
    profile = load_profile()
    synthesize(tmp_path / "streets", 1, 1, 3, profile)
    (sequence,) = open_root(tmp_path / "streets").sequences
    scan = read_scan(sequence, sequence.frames[0])
    (truth,) = sequence.folder.rglob("truth/*.npz")
    ground = np.load(truth)["ground"][scan.row]
    inside = is_drivable(region_of(scan, assign_rays(scan, profile)), scan.xyz[:, :2])
    near = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 40.0
    assert (ground[inside & near & (ground > 0)] == ROAD).mean() > 0.97
    assert inside[near & (ground == ROAD)].mean() > 0.75


@pytest.mark.kitti
def test_real_region_holds_labelled_road(kitti_root):
    sequence = open_root(kitti_root).sequence("odometry_08")
    scan = read_scan(sequence, 1000)
    labels = np.fromfile(sequence.folder / "labels" / "001000.label", dtype="<u4")[scan.row] & 0xFFFF
    region = region_of(scan, assign_rays(scan, load_profile()))
    inside = is_drivable(region, scan.xyz[:, :2])
    far = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])
    road = np.isin(labels, (40, 44, 60))
    ground = np.isin(labels, (40, 44, 48, 49, 60, 72))
    assert road[inside & ground & (far < 40.0)].mean() > 0.96
    assert inside[road & (far < 30.0)].mean() > 0.75


@pytest.mark.kitti
def test_every_real_scan_has_room_for_a_car_on_its_own_lane(kitti_root):
    profile = load_profile()
    for sequence in open_root(kitti_root).sequences:
        scan = read_scan(sequence, sequence.frames[0])
        region = region_of(scan, assign_rays(scan, profile))
        assert region.drivable.sum() * region.cell_m**2 > 150.0, sequence.name
        assert abs(region.road_heading_rad) < np.radians(30.0), sequence.name
