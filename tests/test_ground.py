"""Ground: plane, height map, normals and ground points, on streets in closed form and on real scans."""

import numpy as np
import pytest
from flat_street import FlatStreet
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.config import Config
from augkitti.ground import fit_ground, height_at, normal_at
from augkitti.kitti import open_root, read_scan
from augkitti.scan_pair import GroundMap

CONFIG = Config().ground
GROUND_CLASSES = (40, 44, 48, 49, 60, 72)  # SemanticKITTI: road, parking, sidewalk, other ground, marking, terrain


@pytest.fixture(scope="module")
def street():
    return FlatStreet(yaw_rad=0.1, boxes=((12.0, -2.0, 4.2, 1.8, 0.0, 1.5), (-9.0, 3.5, 4.2, 1.8, 0.0, 1.5)))


@pytest.fixture(scope="module")
def scan(street):
    return street.scan()[0]


@pytest.fixture(scope="module")
def ground(scan):
    return fit_ground(scan.xyz, CONFIG)


def sloped_map(a: float, b: float, c: float) -> GroundMap:
    x = -10.0 + (np.arange(40) + 0.5) * 0.5
    height = (a * x[:, None] + b * x[None, :] + c).astype(np.float32)
    return GroundMap(np.array([0.0, 0.0, 1.0, -c]), (-10.0, -10.0), 0.5, height, height > -99, np.zeros(0, bool))


def test_plane_lies_where_the_road_lies(ground):
    height = ground.plane[3] / ground.plane[2]
    assert height == pytest.approx(1.73, abs=0.04)
    assert np.degrees(np.arccos(ground.plane[2])) < 0.7


def test_height_map_follows_crown_and_kerbs(street, ground):
    rng = np.random.default_rng(1)
    xy = rng.uniform(-30.0, 30.0, (4000, 2))
    _, across = street.along_across(xy)
    from_kerb = np.minimum(np.abs(across - street.left_m), np.abs(across - street.right_m))
    seen = (from_kerb > 0.7) & (across < street.left_m + 3.5) & (across > street.right_m - 3.5)
    row, column = (((xy[:, k] - ground.origin_m[k]) / ground.cell_m).astype(int) for k in (0, 1))
    seen &= ground.observed[row, column]
    error = np.abs(height_at(ground, xy[seen]) - street.height(xy[seen]))
    assert np.median(error) < 0.015
    assert np.percentile(error, 95) < 0.05


def test_ground_points_are_those_on_the_ground(street, scan, ground):
    above = scan.xyz[:, 2] - street.height(scan.xyz[:, :2])
    assert ground.is_ground[np.abs(above) < 0.04].mean() > 0.99
    assert ground.is_ground[above > 0.4].mean() < 0.01


def test_a_wall_is_never_the_ground():
    y, z = np.meshgrid(np.linspace(-15.0, 15.0, 300), np.linspace(-1.7, 2.0, 60))
    wall = np.stack([np.full(y.size, 6.0), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    plane = fit_ground(wall, CONFIG).plane
    assert np.arccos(plane[2]) <= CONFIG.max_tilt_rad
    assert CONFIG.min_height_m <= plane[3] / plane[2] <= CONFIG.max_height_m


def test_a_broad_bank_does_not_tilt_the_plane(scan):
    bank = scan.xyz.astype(np.float64)
    beyond = bank[:, 1] > 4.0
    bank[beyond, 2] += 0.4 * (bank[beyond, 1] - 4.0)
    plane = fit_ground(bank.astype(np.float32), CONFIG).plane
    assert np.degrees(np.arccos(plane[2])) < 1.0
    assert plane[3] / plane[2] == pytest.approx(1.73, abs=0.05)


@pytest.mark.parametrize("points", [0, 1, 5])
def test_hardly_any_points_give_a_level_plane_at_the_usual_height(points):
    ground = fit_ground(np.full((points, 3), 9.0, dtype=np.float32), CONFIG)
    np.testing.assert_allclose(ground.plane, [0.0, 0.0, 1.0, CONFIG.usual_height_m])
    np.testing.assert_allclose(ground.height_m, -CONFIG.usual_height_m, atol=1e-6)
    assert not ground.is_ground.any()


def test_same_points_give_the_same_bytes(scan, ground):
    again = fit_ground(scan.xyz, CONFIG)
    assert again.plane.tobytes() == ground.plane.tobytes()
    assert again.height_m.tobytes() == ground.height_m.tobytes()
    assert again.is_ground.tobytes() == ground.is_ground.tobytes()


def test_what_no_ray_reached_is_marked_as_not_observed(street, ground):
    assert np.isfinite(ground.height_m).all()
    behind_houses = np.array([[0.0, 30.0], [10.0, -40.0]])
    on_road = np.array([[10.0, 2.0], [-12.0, -2.5]])
    rows, columns = (
        ((np.concatenate([behind_houses, on_road])[:, k] - ground.origin_m[k]) / 0.5).astype(int) for k in (0, 1)
    )
    assert ground.observed[rows, columns].tolist() == [False, False, True, True]


@settings(max_examples=25, deadline=None)
@given(
    slopes=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    at=st.tuples(st.floats(-9.5, 9.5), st.floats(-9.5, 9.5)),
)
def test_heights_and_normals_of_a_plane_are_exact(slopes, at):
    a, b = slopes
    ground = sloped_map(a, b, -1.7)
    xy = np.array([at])
    np.testing.assert_allclose(height_at(ground, xy), a * at[0] + b * at[1] - 1.7, atol=1e-5)
    expected = np.array([-a, -b, 1.0]) / np.sqrt(a * a + b * b + 1.0)
    np.testing.assert_allclose(normal_at(ground, xy)[0], expected, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(at=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)))
def test_heights_and_normals_are_finite_everywhere(at):
    ground = sloped_map(0.1, -0.05, -1.7)
    assert np.isfinite(height_at(ground, np.array([at]))).all()
    normal = normal_at(ground, np.array([at]))
    assert np.isfinite(normal).all()
    assert np.sqrt((normal**2).sum()) == pytest.approx(1.0)


@pytest.mark.kitti
def test_real_planes_lie_under_the_sensor_and_hardly_change(kitti_root):
    for sequence in open_root(kitti_root).sequences:
        planes = np.array([fit_ground(read_scan(sequence, n).xyz, CONFIG).plane for n in sequence.frames])
        height = planes[:, 3] / planes[:, 2]
        assert height.min() >= 1.6, sequence.name
        assert height.max() <= 1.85, sequence.name
        if sequence.layout == "object" or len(planes) < 2:
            continue
        turned = np.degrees(np.arccos(np.clip((planes[1:, :3] * planes[:-1, :3]).sum(axis=1), -1.0, 1.0)))
        assert np.percentile(np.abs(np.diff(height)), 95) < 0.04, sequence.name
        assert np.percentile(turned, 95) < 0.7, sequence.name


@pytest.mark.kitti
def test_real_height_map_meets_the_labelled_road_and_ground_points(kitti_root):
    sequence = open_root(kitti_root).sequence("odometry_08")
    scan = read_scan(sequence, 1000)
    labels = np.fromfile(sequence.folder / "labels" / "001000.label", dtype="<u4")[scan.row] & 0xFFFF
    ground = fit_ground(scan.xyz, CONFIG)
    road = (labels == 40) & (np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 30.0)
    error = scan.xyz[:, 2] - height_at(ground, scan.xyz[:, :2])
    assert np.median(np.abs(error[road])) < 0.03
    truth = np.isin(labels, GROUND_CLASSES)
    hits = (ground.is_ground & truth).sum()
    assert 2.0 * hits / (ground.is_ground.sum() + truth.sum()) > 0.96
