"""Learned range noise: densities, draws and chances of a profile, and fits that recover what was put in."""

import dataclasses
import json

import numpy as np
import pytest
from plane_scans import PROFILE, known_biases, scan_room, white_noise
from scipy.stats import kstest

from augkitti import noise_patches, range_noise
from augkitti.errors import InputError
from augkitti.range_noise import NoiseProfile, ReturnConditions, range_error, shot_error, surface_conditions
from pipelines.judge_noise import Judged, figures_of, return_conditions

SHIPPED = range_noise.load_noise()
COUNT = 40_000


def conditions(count: int = COUNT, cosine: float = 0.6) -> ReturnConditions:
    return surface_conditions(
        SHIPPED, np.full(count, 20, np.uint8), np.full(count, 12.0), np.full(count, cosine), np.full(count, 0.3)
    )


def draws(count: int = COUNT, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal(count), rng.random(count), rng.standard_normal(count)


@pytest.fixture(scope="module")
def judged_rooms() -> Judged:
    """Two rooms with known biases, 8 mm of white noise, and 5 % of rays lost."""
    parts = []
    for number in (0, 1):
        walls = (11.0, 14.0) if number else (8.0, 20.0)
        scan, rays = scan_room(white_noise(0.008, known_biases()), number, walls, drop=0.05)
        parts.append(
            (
                noise_patches.judge_returns(scan, rays, PROFILE, number, share=0.3, rng=np.random.default_rng(number)),
                noise_patches.judge_rays(scan, rays, PROFILE, number),
                noise_patches.judge_edges(scan, rays, PROFILE, number),
                noise_patches.judge_shots(scan, rays, PROFILE, number),
            )
        )
    return Judged(
        (("room_0", "room", 0), ("room_1", "room", 1)),
        sum(part[0][1] for part in parts),
        noise_patches.concatenate(part[0][0] for part in parts),
        noise_patches.concatenate(part[1] for part in parts),
        noise_patches.concatenate(part[2] for part in parts),
        noise_patches.concatenate(part[3] for part in parts),
    )


def test_a_saved_profile_reads_back_and_the_same_profile_gives_the_same_bytes(tmp_path) -> None:
    for name in ("a", "b"):
        range_noise.save_noise(SHIPPED, tmp_path / f"{name}_noise.npz")
    assert (tmp_path / "a_noise.npz").read_bytes() == (tmp_path / "b_noise.npz").read_bytes()
    again = range_noise.load_noise(tmp_path / "a_noise.npz")
    assert again.shipped == SHIPPED.shipped
    for name in range_noise.ARRAYS:
        np.testing.assert_array_equal(again.arrays[name], SHIPPED.arrays[name])


def test_a_damaged_or_foreign_profile_is_refused(tmp_path) -> None:
    (tmp_path / "noise.npz").write_bytes(b"not an archive")
    with pytest.raises(InputError, match="noise profile"):
        range_noise.load_noise(tmp_path)
    np.savez(tmp_path / "other_noise.npz", facts=np.zeros(3, np.uint8))
    with pytest.raises(InputError, match="2 files"):
        range_noise.load_noise(tmp_path)


def test_a_profile_with_bytes_changed_is_read_or_refused_in_one_line(tmp_path) -> None:
    range_noise.save_noise(SHIPPED, tmp_path / "whole_noise.npz")
    whole, rng, said = (tmp_path / "whole_noise.npz").read_bytes(), np.random.default_rng(0), []
    for k in range(60):
        damaged = bytearray(whole[: rng.integers(len(whole))] if k % 3 == 0 else whole)
        for at in rng.integers(max(len(damaged) - 4000, 0) if k % 2 else 0, len(damaged) or 1, 8 * bool(damaged)):
            damaged[at] = rng.integers(256)
        file = tmp_path / f"damaged_{k}.npz"
        file.write_bytes(damaged)
        try:
            range_noise.load_noise(file)
        except InputError as err:
            said.append(str(err))
    assert len(said) > 50  # archives carry sums of their bytes
    assert not any("\n" in line for line in said)


@pytest.mark.parametrize("name", ["drop.network.beam", "network.w1", "shot_m", "features.mean", "bias_m"])
def test_an_array_of_another_size_is_named(tmp_path, name) -> None:
    arrays = {**SHIPPED.arrays, name: SHIPPED.arrays[name][..., :-1]}
    range_noise.save_noise(dataclasses.replace(SHIPPED, arrays=arrays), tmp_path / "cut_noise.npz")
    with pytest.raises(InputError, match="of the noise profile is damaged"):
        range_noise.load_noise(tmp_path)


@pytest.mark.parametrize("model", range_noise.MODELS)
def test_densities_sum_to_one_and_agree_with_the_chances(model) -> None:
    mix = range_noise.mixture(SHIPPED, model, conditions(1))
    grid = np.linspace(-40.0, 40.0, 400_001)
    density = np.concatenate(
        [
            np.exp(range_noise.log_density(range_noise.Mixture(*(np.tile(v, (len(part), 1)) for v in parts)), part))
            for part in np.array_split(grid, 20)
            for parts in [(mix.weight, mix.mean_m, mix.std_m)]
        ]
    )
    assert np.trapezoid(density, grid) == pytest.approx(1.0, abs=2e-3)
    for chance in (0.025, 0.5, 0.84):
        assert range_noise.cumulative(mix, range_noise.quantile(mix, chance))[0] == pytest.approx(chance, abs=1e-3)


def test_shot_noise_of_bodies_has_the_size_that_was_measured_and_heavy_tails() -> None:
    white, luck, _ = draws()
    error = shot_error(SHIPPED, np.full(COUNT, 12.0), white, luck)
    mad = 1.4826 * np.median(np.abs(error - np.median(error)))
    at, spread = SHIPPED.arrays["shot_m"].T
    assert mad == pytest.approx(np.interp(12.0, at, spread), rel=0.05)
    assert abs(np.median(error)) < 2e-4
    assert 0.0035 < np.mean(np.abs(error) > 3.0 * mad) < 0.04  # scanner.md: 1 to 4 % on any surface; a normal: 0.0027


def test_roughness_adds_and_the_share_of_a_patch_is_kept_along_it() -> None:
    white, luck, patch = draws()
    at = conditions()
    alone = shot_error(SHIPPED, at.range_m, white, luck)
    assert np.std(shot_error(SHIPPED, at.range_m, white, luck, 0.02)) > 2.0 * np.std(alone)
    held = range_error(SHIPPED, at, white, luck, np.full(COUNT, 2.0))
    free = range_error(SHIPPED, at, white, luck, patch)
    assert abs(np.mean(held) - np.mean(free)) > 0.002


def test_what_simulation_needs_goes_through_json_and_draws_the_same() -> None:
    content = json.loads(json.dumps(range_noise.solid_part(SHIPPED)))
    read = range_noise.noise_from_content(content, SHIPPED.bias_m, "profile")
    white, luck, _ = draws(2000)
    ours, theirs = (shot_error(profile, np.full(2000, 9.0), white, luck) for profile in (SHIPPED, read))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert len(json.dumps(content)) < 40_000


def test_a_damaged_part_of_a_scanner_profile_names_its_key() -> None:
    content = range_noise.solid_part(SHIPPED)
    with pytest.raises(InputError, match=r"noise\.solid"):
        range_noise.noise_from_content({**content, "shipped": "magic"}, SHIPPED.bias_m, "profile")
    with pytest.raises(InputError, match="shot_m"):
        range_noise.noise_from_content(
            {**content, "arrays": {**content["arrays"], "shot_m": [1.0]}}, SHIPPED.bias_m, "profile"
        )
    for left in ({}, {k: v for k, v in content["arrays"].items() if k != "drop.network.w1"}):
        with pytest.raises(InputError, match="missing"):
            range_noise.noise_from_content({**content, "arrays": left}, SHIPPED.bias_m, "profile")


def test_rays_are_lost_more_often_far_away_and_from_dark_surfaces() -> None:
    ring, cosine, luck = np.full(COUNT, 20, np.uint8), np.full(COUNT, 0.7), draws()[1]

    def lost(range_m: float, shine: float) -> float:
        where = (np.full(COUNT, range_m), cosine, np.full(COUNT, shine))
        return float(range_noise.isolated_misses(SHIPPED, ring, *where, luck).mean())

    assert lost(12.0, 0.0) > lost(12.0, 0.35)
    assert lost(60.0, 0.2) > lost(15.0, 0.2)
    assert lost(12.0, 0.35) < 0.02


def test_mixed_points_stand_between_the_sides_and_small_steps_stay_clean() -> None:
    near, far = np.full(1000, 10.0), np.full(1000, 12.0)
    between = range_noise.mixed_range(SHIPPED, near, far, np.linspace(0.0, 1.0, 1000))
    assert between.min() >= 10.25 - 1e-9
    assert between.max() <= 11.75 + 1e-9
    assert (np.diff(between) >= 0).all()
    mixed, nothing = range_noise.edge_chance(SHIPPED, np.array([0.5, 1.5, 30.0]))
    assert mixed[0] == nothing[0] == 0.0
    assert (mixed[1:] > 0.03).all()
    assert (nothing[1:] > 0.03).all()


def test_a_fit_recovers_biases_scale_and_drops_that_were_put_in(judged_rooms) -> None:
    fit_noise = pytest.importorskip("pipelines.fit_noise")
    pytest.importorskip("torch")
    bias = fit_noise.fit_biases(judged_rooms.returns, 64)
    off = 1e3 * (bias - fit_noise.without_trends(known_biases()))
    assert np.abs(off).max() < 1.0
    profile = fit_noise.fit_profile(judged_rooms, PROFILE, "rooms", ("parametric", "parametric"), 300)
    figures = figures_of(profile, judged_rooms)
    assert figures["coverage68"] == pytest.approx(0.68, abs=0.03)
    assert figures["coverage95"] == pytest.approx(0.95, abs=0.02)
    assert figures["nll.parametric"] < figures["nll.constant"] - 0.3
    assert profile.arrays["constant"][2] == pytest.approx(0.05, abs=0.002)
    assert figures["drop.predicted"] / figures["drop.observed"] == pytest.approx(1.0, abs=0.03)
    for _, spread_m in profile.arrays["shot_m"]:
        assert spread_m == pytest.approx(0.008, rel=0.05)
    at = range_noise.take_conditions(return_conditions(judged_rooms.returns, bias), np.arange(0, 60_000, 30))
    none = np.zeros(len(at.ring))
    mix = range_noise.mixture(profile, "parametric", dataclasses.replace(at, white_gain=none, ring_gain=none))
    half = 0.5 * (range_noise.quantile(mix, 0.8413) - range_noise.quantile(mix, 0.1587))
    assert np.median(half) == pytest.approx(0.008, rel=0.08)  # white and kept shares cannot be told apart here


def simulated_noise(profile: NoiseProfile):
    """A profile's noise as a scene of planes would have it: a share that beams keep over patches, and white noise."""

    def noise(ring, range_m, cosine, rng):
        at = surface_conditions(profile, ring, range_m, cosine, np.full(len(ring), 0.3))
        firing = float(profile.arrays["surface"][2])
        step = rng.standard_normal(len(ring))
        patch = np.empty(len(ring))
        value = 0.0
        for i, fresh in enumerate(step):  # rays stand ring by ring
            value = fresh if i == 0 or ring[i] != ring[i - 1] else firing * value + np.sqrt(1 - firing**2) * fresh
            patch[i] = value
        return profile.bias_m[ring] + range_error(
            profile, at, rng.standard_normal(len(ring)), rng.random(len(ring)), patch
        )

    return noise


def test_simulated_planes_show_the_statistics_that_were_fitted() -> None:
    """Chances of the judged residuals under the profile that drew them: uniform, less what lies elsewhere."""
    scan, rays = scan_room(simulated_noise(SHIPPED), 3)
    returns, _ = noise_patches.judge_returns(scan, rays, PROFILE, share=0.4, rng=np.random.default_rng(0))
    left = returns.residual_m - noise_patches.expected_residual(returns, SHIPPED.bias_m)
    at = return_conditions(returns, SHIPPED.bias_m)
    mix = range_noise.mixture(SHIPPED, SHIPPED.shipped, at)
    walls = at.slope == noise_patches.WALL
    chance = range_noise.cumulative(mix, left)
    for which in (slice(None), walls):
        assert kstest(chance[which], "uniform").statistic < 0.05
