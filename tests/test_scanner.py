"""Rays: every measured point finds its beam and tick, in raw, cut-short and compensated scans."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti import scanner
from augkitti.errors import InputError
from augkitti.scan_pair import NO_TICK, Scan

PROFILE = scanner.load_profile()


def scan_of(xyz: np.ndarray, kind: str = "raw") -> Scan:
    n = len(xyz)
    return Scan(xyz.astype(np.float32), np.zeros(n, np.float32), np.arange(n, dtype=np.int32), n, kind, 0.0, 0.1034)


def read(path: Path, kind: str = "raw") -> Scan:
    rows = np.fromfile(path, np.float32).reshape(-1, 4)
    return scan_of(rows[:, :3], kind)


def file_order(ring: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return np.lexsort((np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi), ring))


def simulated(ticks: np.ndarray, range_m: float = 12.0) -> tuple[Scan, np.ndarray, np.ndarray]:
    rays = scanner.fire_rays(PROFILE, ticks, 0.1034)
    origin, direction = scanner.ray_lines(PROFILE, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
    xyz = np.round(origin + range_m * direction, 3)
    order = file_order(rays.ray_ring, xyz)
    return scan_of(xyz[order]), rays.ray_ring[order], rays.ray_tick[order]


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**31), st.floats(4.0, 75.0))
def test_simulated_points_get_back_their_ring_and_tick(seed: int, range_m: float) -> None:
    rng = np.random.default_rng(seed)
    ticks = np.sort(rng.choice(np.arange(0, 4000, 2), 600, replace=False)).astype(np.uint16)
    scan, ring, tick = simulated(ticks, range_m)
    rays = scanner.assign_rays(scan, PROFILE)
    np.testing.assert_array_equal(rays.ring, ring)
    np.testing.assert_array_equal(rays.tick, tick)
    np.testing.assert_array_equal(rays.ray_point[rays.ray], np.arange(len(scan)))


def test_scan_with_eight_rings_missing_keeps_the_names_of_the_others() -> None:
    scan, ring, tick = simulated(np.arange(0, 4000, 2, dtype=np.uint16))
    keep = ~np.isin(ring, [0, 7, 8, 9, 30, 31, 50, 63])
    rays = scanner.assign_rays(scan_of(scan.xyz[keep]), PROFILE)
    np.testing.assert_array_equal(rays.ring, ring[keep])
    np.testing.assert_array_equal(rays.tick, tick[keep])
    assert len(rays) == 64 * 2000  # the rays of the missing rings were fired, too


def test_stray_and_doubled_points_keep_a_ray_without_a_tick() -> None:
    scan, _, _ = simulated(np.arange(0, 4000, 2, dtype=np.uint16))
    xyz = scan.xyz.copy()
    xyz[500] += np.float32([0.0, 0.0, 0.04])  # between two beams
    xyz[901] = xyz[900] * np.float32(1.01)  # nearly on the ray of its neighbour, one tick off the fired ones
    rays = scanner.assign_rays(scan_of(xyz), PROFILE)
    assert rays.tick[500] == NO_TICK
    assert np.count_nonzero(rays.tick == NO_TICK) == 2
    assert len(np.unique(rays.ray)) == len(xyz)
    assert scanner.ray_distance(scan_of(xyz), rays, PROFILE)[500] < 1e-5


def test_time_runs_clockwise_from_the_seam_over_straight_ahead() -> None:
    time = scanner.tick_time(PROFILE, np.array([1999, 1000, 0, 3000, 2000], dtype=np.uint16), 0.1)
    assert (np.diff(time) > 0).all()
    assert time[0] == pytest.approx(-0.05)
    assert time[2] == pytest.approx(0.0, abs=3e-5)
    assert scanner.azimuth_time(np.pi / 2, 0.1) == pytest.approx(-0.025)  # the left comes before straight ahead


@pytest.mark.kitti
def test_real_raw_scans_lie_on_their_rays(kitti_root: Path) -> None:
    paths = sorted(kitti_root.glob("raw/*/*/velodyne_points/data/*.bin"))[::6]
    for path in paths:
        scan = read(path)
        rays = scanner.assign_rays(scan, PROFILE)
        assert np.mean(rays.tick != NO_TICK) >= 0.9999, path
        assert np.median(scanner.ray_distance(scan, rays, PROFILE)) <= 0.5e-3, path
        fired = len(np.unique(rays.ray_tick[rays.ray_tick != NO_TICK]))
        assert 2100 <= fired <= 2200, path
        on_ray = rays.ray[rays.tick != NO_TICK]
        assert len(np.unique(on_ray)) == len(on_ray), path


@pytest.mark.kitti
def test_real_scan_cut_to_56_rings_is_assigned_all_the_same(kitti_root: Path) -> None:
    scan = read(sorted(kitti_root.glob("raw/*/*/velodyne_points/data/*.bin"))[0])
    whole = scanner.assign_rays(scan, PROFILE)
    for keep in (whole.ring < 56, whole.ring >= 8):
        cut = scanner.assign_rays(scan_of(scan.xyz[keep]), PROFILE)
        np.testing.assert_array_equal(cut.ring, whole.ring[keep])
        np.testing.assert_array_equal(cut.tick, whole.tick[keep])


@pytest.mark.kitti
def test_compensated_scan_gets_rays_through_its_points_and_fills_the_gaps(kitti_root: Path) -> None:
    scan = read(sorted(kitti_root.glob("odometry/sequences/*/velodyne/*.bin"))[0], "compensated")
    rays = scanner.assign_rays(scan, PROFILE)
    assert (rays.tick == NO_TICK).all()
    assert scanner.ray_distance(scan, rays, PROFILE).max() < 1e-6
    np.testing.assert_array_equal(rays.ray_point[rays.ray], np.arange(len(scan)))
    assert 0.7 < len(scan) / len(rays) < 0.95  # return rates of scanner.md section 1


def test_profile_with_a_short_column_names_the_key(tmp_path: Path) -> None:
    content = dict(PROFILE.content)
    content["side_m"] = content["side_m"][:5]
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="side_m"):
        scanner.load_profile(path)


def test_profile_that_is_no_json_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text("{")
    with pytest.raises(InputError, match=r"mine\.json"):
        scanner.load_profile(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tick_offset", [1e300] * 64),
        ("height_m", [float("nan")] * 64),
        ("azimuth_rad", [1e6] * 64),
        ("range_quantum_m", 0.0),
        ("max_range_m", float("inf")),
        ("lattice_size", 10**9),
        ("seam_tick", -1),
        ("shadow_first_ring", 65),
        ("version", "A" * 5000),
    ],
)
def test_a_profile_out_of_range_is_refused_in_one_short_line(key, value):
    with pytest.raises(InputError) as caught:
        scanner.profile_from_content({**PROFILE.content, key: value}, "profile.json")
    assert len(str(caught.value)) < 600
