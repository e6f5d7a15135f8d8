"""Noise patches: what is judged is chosen by its neighbours alone, and planes give back the noise that was put in."""

import dataclasses

import numpy as np
import pytest
from plane_scans import PROFILE, known_biases, scan_room, scan_sphere, white_noise

from augkitti import noise_patches
from augkitti.errors import InputError
from augkitti.scan_pair import NO_TICK
from augkitti.scanner import lines_of_rays

BIAS = known_biases()
NOISE = white_noise(0.008, BIAS)


@pytest.fixture(scope="module")
def room():
    return scan_room(NOISE)


@pytest.fixture(scope="module")
def judged(room):
    return noise_patches.judge_returns(*room, PROFILE, share=0.5, rng=np.random.default_rng(0))


def test_most_returns_of_a_room_lie_on_patches_and_their_incidence_is_the_planes(judged) -> None:
    returns, tried = judged
    assert len(returns.ring) > 0.6 * tried
    ground = returns.slope == noise_patches.GROUND
    sine = np.sin(-PROFILE.elevation_rad[returns.ring[ground]])
    np.testing.assert_allclose(returns.cos_incidence[ground], sine, atol=0.1)  # neighbours' biases tilt a patch
    assert np.mean(returns.slope == noise_patches.SLANTED) < 0.01


def test_residuals_less_what_biases_leave_are_the_white_noise(judged) -> None:
    returns, _ = judged
    left = returns.residual_m - noise_patches.expected_residual(returns, BIAS)
    expected = 0.008 * np.sqrt(1.0 + np.median(returns.white_gain))
    assert 1.4826 * np.median(np.abs(left)) == pytest.approx(expected, rel=0.08)
    assert np.std(returns.residual_m) > 2.0 * np.std(left)


def test_rings_lie_on_the_plane_once_biases_are_out(judged) -> None:
    returns, _ = judged
    with_biases = noise_patches.ring_spread(returns, np.zeros(64))
    assert np.median(noise_patches.ring_spread(returns, BIAS)) < 0.35 * np.median(with_biases)


def test_a_return_far_off_its_patch_is_judged_all_the_same(room, judged) -> None:
    scan, rays = room
    returns, _ = judged
    row = int(np.flatnonzero(returns.slope == noise_patches.WALL)[500])
    ring, step = int(returns.ring[row]), int(returns.step[row])
    steps = (rays.tick.astype(int) + PROFILE.tick_offset[rays.ring]) % PROFILE.lattice_size
    point = int(np.flatnonzero((rays.ring == ring) & (steps == step) & (rays.tick != NO_TICK))[0])
    _, direction = lines_of_rays(PROFILE, rays, rays.ray[point : point + 1])
    xyz = scan.xyz.copy()
    xyz[point] -= (3.0 * direction[0]).astype(np.float32)
    moved = dataclasses.replace(scan, xyz=xyz)
    found, _ = noise_patches.judge_returns(moved, rays, PROFILE)
    its = np.flatnonzero((found.ring == ring) & (found.step == step))
    assert len(its) == 1
    assert found.residual_m[its[0]] == pytest.approx(returns.residual_m[row] - 3.0, abs=0.01)
    assert found.range_m[its[0]] == pytest.approx(returns.range_m[row], abs=1e-9)


def test_shots_on_planes_and_spheres_show_the_noise_of_one_beam(room) -> None:
    for scan, rays in (room, scan_sphere(NOISE, 15.0)):
        shots = noise_patches.judge_shots(scan, rays, PROFILE)
        assert 1.4826 * np.median(np.abs(shots.deviation_m)) == pytest.approx(0.008, rel=0.05)


def test_a_sphere_gives_residuals_round_zero() -> None:
    scan, rays = scan_sphere(white_noise(0.008, np.zeros(64)), 15.0)
    returns, _ = noise_patches.judge_returns(scan, rays, PROFILE, share=0.2, rng=np.random.default_rng(0))
    assert abs(np.median(returns.residual_m)) < 0.004  # the plane cuts the sphere's cap
    assert np.min(returns.cos_incidence) > 0.95


def test_five_in_a_hundred_rays_lost_are_counted_within_two_in_a_thousand() -> None:
    judged = [
        noise_patches.judge_rays(*scan_room(white_noise(0.008, BIAS), seed, drop=0.05), PROFILE) for seed in (0, 1)
    ]
    rays = noise_patches.concatenate(judged)
    assert len(rays.ring) > 100_000
    assert 1.0 - rays.returned.mean() == pytest.approx(0.05, abs=0.002)


def test_no_ray_is_lost_where_none_was_dropped(room) -> None:
    assert noise_patches.judge_rays(*room, PROFILE).returned.all()


def test_edges_of_a_post_before_a_wall_are_found_and_a_point_between_is_mixed(room) -> None:
    scan, rays = room
    origin, direction = lines_of_rays(PROFILE, rays, rays.ray)
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    level = np.abs(PROFILE.elevation_rad[rays.ring]) < 0.05
    post = level & (np.abs(azimuth - 0.8) < 0.05)
    xyz = np.where(post[:, None], origin + 6.0 * direction, scan.xyz).astype(np.float32)
    clean = noise_patches.judge_edges(dataclasses.replace(scan, xyz=xyz), rays, PROFILE)
    assert len(clean.ring) == 2 * len(np.unique(rays.ring[post]))
    assert (clean.outcome == noise_patches.KEPT_NEAR).all()
    ring = int(rays.ring[post][0])
    first = np.flatnonzero(post & (rays.ring == ring))[0]
    xyz[first] = origin[first] + 8.0 * direction[first]
    found = noise_patches.judge_edges(dataclasses.replace(scan, xyz=xyz), rays, PROFILE)
    mixed = found.outcome == noise_patches.MIXED_BETWEEN
    assert mixed.sum() == 1
    assert found.near_m[mixed][0] == pytest.approx(6.0, abs=0.01)
    assert 0.0 < found.share[mixed][0] < 1.0


def test_compensated_scan_is_refused_and_told_why(room) -> None:
    scan, rays = room
    compensated = dataclasses.replace(scan, kind="compensated")
    for judge in (noise_patches.judge_returns, noise_patches.judge_rays, noise_patches.judge_edges):
        with pytest.raises(InputError, match="compensated"):
            judge(compensated, rays, PROFILE)
