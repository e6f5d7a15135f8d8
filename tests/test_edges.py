"""Range steps at the silhouettes of virtual cars: mixed points and losses, within the contract."""

import dataclasses

import numpy as np
import pytest
from plane_scans import PROFILE, known_biases, scan_room, white_noise

from augkitti import occlusion
from augkitti.occlusion import measured_range
from augkitti.scan_pair import MIXED, NO_TICK, PAINT, PreparedScan
from augkitti.scanner import ScannerProfile, lines_of_rays
from augkitti.sensor_noise import CarReturns, solid_noise


def with_edges(mixed: float, nothing: float = 0.0) -> ScannerProfile:
    noise = PROFILE.content["noise"]
    arrays = {**noise["solid"]["arrays"], "edge.car": [mixed, nothing]}
    solid = {**noise["solid"], "arrays": arrays}
    return dataclasses.replace(PROFILE, content={**PROFILE.content, "noise": {**noise, "solid": solid}})


@pytest.fixture(scope="module")
def room() -> PreparedScan:
    scan, rays = scan_room(white_noise(0.008, known_biases()))
    return PreparedScan(scan, rays, None, None, None)  # type: ignore[arg-type]


def post(
    room: PreparedScan, half_rad: float = 0.1, range_m: float = 6.0, seed: int = 0
) -> tuple[np.ndarray, CarReturns]:
    """A car that is a flat post to the left, on the beams of the upper block."""
    rays = room.rays
    its = (rays.ray_ring < 40) & (np.abs(rays.ray_azimuth_rad - 1.5) < 0.1) & (rays.ray_tick != NO_TICK)
    ray = np.flatnonzero(its).astype(np.int32)
    n = len(ray)
    stop = np.full(n, range_m)
    luck = np.random.default_rng(seed).random((2, n))
    return ray, CarReturns(stop, np.ones(n, bool), stop, np.full(n, 0.5), np.full(n, PAINT, np.uint8), luck)


def test_mixed_points_stand_on_their_rays_between_car_and_background(room) -> None:
    ray, returns = post(room)
    found = occlusion.keep_nearest(room, [(ray, returns)], with_edges(1.0)).simulated
    mixed = found.surface == MIXED
    rings = len(np.unique(room.rays.ray_ring[ray]))
    assert 1.5 * rings <= mixed.sum() <= 2 * rings  # both sides of the post
    origin, direction = lines_of_rays(PROFILE, room.rays, found.ray[mixed])
    off = found.xyz[mixed].astype(np.float64) - origin
    along = (off * direction).sum(axis=1)
    across = np.linalg.norm(off - along[:, None] * direction, axis=1)
    assert (across < 0.002 + 5e-5 * along).all()
    assert (along > 6.0 + 0.24).all()
    behind = measured_range(room, found.ray[mixed], PROFILE)
    assert (along < behind)[np.isfinite(behind)].all()


def test_what_a_mixed_point_hides_stays_removed_and_nothing_else_is(room) -> None:
    ray, returns = post(room)
    mixed = occlusion.keep_nearest(room, [(ray, returns)], with_edges(1.0))
    clean = occlusion.keep_nearest(room, [(ray, returns)], with_edges(0.0))
    np.testing.assert_array_equal(mixed.kept, clean.kept)
    assert (clean.simulated.surface == PAINT).all()


def test_mixed_points_come_as_often_as_the_profile_says(room) -> None:
    share = []
    for seed in range(12):
        ray, returns = post(room, seed=seed)
        found = occlusion.keep_nearest(room, [(ray, returns)], with_edges(0.2)).simulated
        share.append((found.surface == MIXED).sum() / (2 * len(np.unique(room.rays.ray_ring[ray]))))
    assert np.mean(share) == pytest.approx(0.2, abs=0.05)


def test_a_sliver_behind_the_silhouette_is_lost(room) -> None:
    ray, returns = post(room)
    ring = room.rays.ray_ring[ray]
    last = np.concatenate([np.flatnonzero(np.diff(ring.astype(int))), [len(ring) - 1]])
    far = returns.stop_m.copy()
    far[last] += 0.5
    deeper = dataclasses.replace(returns, stop_m=far, range_m=far)
    found = occlusion.keep_nearest(room, [(ray, deeper)], with_edges(0.0)).simulated
    assert len(found.ray) == len(ray) - len(last)


def test_no_edge_is_made_where_the_step_is_small_or_the_profile_knows_none(room) -> None:
    ray, returns = post(room, range_m=10.8)
    found = occlusion.keep_nearest(room, [(ray, returns)], with_edges(1.0)).simulated
    step = measured_range(room, found.ray, PROFILE) - 10.8
    assert not (found.surface[step < 1.0] == MIXED).any()
    noise = {key: value for key, value in PROFILE.content["noise"].items() if key != "solid"}
    plain = dataclasses.replace(PROFILE, content={**PROFILE.content, "noise": noise})
    assert solid_noise(plain) is None
    found = occlusion.keep_nearest(room, [post(room)], plain).simulated
    assert (found.surface == PAINT).all()
