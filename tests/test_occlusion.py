"""Occlusion: along each ray the nearest event wins."""

import numpy as np
import pytest

from augkitti import occlusion, scanner
from augkitti.scan_pair import I32, NO_TICK, PAINT, PreparedScan, Scan
from augkitti.sensor_noise import CarReturns

PROFILE = scanner.load_profile()
WALL_M = 20.0


@pytest.fixture(scope="module")
def wall() -> PreparedScan:
    """A measured sphere of 20 m, with every fifth ray missing."""
    fired = scanner.fire_rays(PROFILE, np.arange(0, 4000, 20, dtype=np.uint16), 0.1)
    ray = np.flatnonzero((np.arange(len(fired)) % 5 > 0) & ~fired.ray_blind)
    origin, direction = scanner.ray_lines(
        PROFILE, fired.ray_ring[ray], fired.ray_azimuth_rad[ray], fired.ray_elevation_rad[ray]
    )
    xyz = origin + WALL_M * direction
    order = np.lexsort((np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi), fired.ray_ring[ray]))
    n = len(order)
    xyz = np.round(xyz[order], 3).astype(np.float32)
    scan = Scan(xyz, np.full(n, 0.3, np.float32), np.arange(n, dtype=np.int32), n, "raw", 0.0, 0.1)
    return PreparedScan(scan, scanner.assign_rays(scan, PROFILE), None, None, None)  # type: ignore[arg-type]


def car(ray: I32, stop_m: float, returned: bool = True) -> tuple[I32, CarReturns]:
    n = len(ray)
    stop = np.full(n, stop_m)
    return ray, CarReturns(stop, np.full(n, returned), stop, np.full(n, 0.5), np.full(n, PAINT, np.uint8))


def some_rays(wall: PreparedScan, first: int = 4000, count: int = 200) -> I32:
    return np.arange(first, first + count, dtype=np.int32)


def test_nearer_car_hides_the_wall_and_takes_its_rays(wall: PreparedScan) -> None:
    ray = some_rays(wall)
    result = occlusion.keep_nearest(wall, [car(ray, 10.0)], PROFILE)
    hidden = wall.rays.ray_point[ray]
    assert not result.kept[hidden[hidden >= 0]].any()
    assert (~result.kept).sum() == (hidden >= 0).sum()
    assert len(result.simulated.xyz) == len(ray)  # rays without a source return can return from a car


def test_car_behind_the_wall_gets_no_returns_where_the_wall_returned(wall: PreparedScan) -> None:
    ray = some_rays(wall)
    result = occlusion.keep_nearest(wall, [car(ray, 30.0)], PROFILE)
    assert result.kept.all()
    assert len(result.simulated.xyz) == (wall.rays.ray_point[ray] < 0).sum()


def test_absorbed_pulse_hides_the_wall_without_a_return(wall: PreparedScan) -> None:
    ray = some_rays(wall)
    result = occlusion.keep_nearest(wall, [car(ray, 10.0, returned=False)], PROFILE)
    assert len(result.simulated.xyz) == 0
    assert (~result.kept).sum() == (wall.rays.ray_point[ray] >= 0).sum()


def test_pulse_that_passes_all_panes_leaves_the_wall_as_measured(wall: PreparedScan) -> None:
    result = occlusion.keep_nearest(wall, [car(some_rays(wall), np.inf, returned=False)], PROFILE)
    assert result.kept.all()
    assert len(result.simulated.xyz) == 0


def test_nearer_of_two_cars_wins_and_an_absorbing_one_hides_the_other(wall: PreparedScan) -> None:
    ray = some_rays(wall)
    both = occlusion.keep_nearest(wall, [car(ray, 12.0), car(ray[:50], 9.0)], PROFILE).simulated
    assert (both.car == 1).sum() == 50
    assert (both.car == 0).sum() == 150
    absorbed = occlusion.keep_nearest(wall, [car(ray, 12.0), car(ray[:50], 9.0, returned=False)], PROFILE).simulated
    assert len(absorbed.xyz) == 150


def test_rays_in_the_ego_cars_shadow_return_from_no_car(wall: PreparedScan) -> None:
    blind = np.flatnonzero(wall.rays.ray_blind).astype(np.int32)
    assert len(blind) > 100
    assert len(occlusion.keep_nearest(wall, [car(blind, 5.0)], PROFILE).simulated.xyz) == 0


def test_simulated_points_lie_on_their_rays_in_millimetres_and_in_ring_and_tick_order(wall: PreparedScan) -> None:
    new = occlusion.keep_nearest(wall, [car(some_rays(wall, 9000, 900)[::-1].copy(), 7.5)], PROFILE).simulated
    order = new.ring.astype(int) * 4000 + new.tick
    assert (np.diff(order) > 0).all()
    assert (new.tick != NO_TICK).all()
    millimetres = new.xyz.astype(np.float64) * 1000
    np.testing.assert_allclose(millimetres, np.rint(millimetres), atol=1e-2)
    azimuth = scanner.tick_azimuth(PROFILE, new.ring, new.tick)
    origin, direction = scanner.ray_lines(PROFILE, new.ring, azimuth, PROFILE.elevation_rad[new.ring])
    off = new.xyz - origin
    along = (off * direction).sum(1)
    assert np.abs(along - 7.5).max() < 1.5e-3
    assert np.linalg.norm(off - along[:, None] * direction, axis=1).max() < 1e-3
