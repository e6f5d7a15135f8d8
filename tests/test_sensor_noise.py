"""Sensor noise: what comes back from paint and panes, and in which steps."""

import dataclasses

import numpy as np
import pytest

from augkitti import scanner, sensor_noise
from augkitti.errors import InputError
from augkitti.raycast import CarHits
from augkitti.scan_pair import GLASS, PAINT, THROUGH_GLASS, ScanRays
from augkitti.sensor_noise import CarLook, simulate_returns

PROFILE = scanner.load_profile()


def wall_hits(surfaces: list[int], range_m: float = 12.0, cosine: float = 0.7) -> tuple[CarHits, ScanRays]:
    """Every ray of a wide patch meets the same surfaces, half a metre behind each other."""
    rays = scanner.fire_rays(PROFILE, np.arange(0, 800, 2, dtype=np.uint16), 0.1)
    ray = np.flatnonzero((rays.ray_ring >= 8) & (rays.ray_ring < 40)).astype(np.int32)
    layers = 6
    ranges = np.full((len(ray), layers), np.inf)
    kinds = np.zeros((len(ray), layers), dtype=np.uint8)
    for level, surface in enumerate(surfaces):
        ranges[:, level], kinds[:, level] = range_m + 0.5 * level, surface
    faces = np.where(kinds > 0, 0, -1).astype(np.int32)
    return CarHits(ray, ranges, faces, kinds, np.full((len(ray), layers), cosine)), rays


def returns_of(surfaces: list[int], look: CarLook, seed: int = 0, opaque: bool = False, **where: float):
    hits, rays = wall_hits(surfaces, **where)
    return hits, rays, simulate_returns(hits, look, rays, PROFILE, opaque, np.random.default_rng(seed))


def changed(part: str, **values: object) -> scanner.ScannerProfile:
    """The profile with other figures in one part of its noise."""
    noise = PROFILE.content["noise"]
    return dataclasses.replace(
        PROFILE, content={**PROFILE.content, "noise": {**noise, part: {**noise[part], **values}}}
    )


def rest_of(returns: sensor_noise.CarReturns, hits: CarHits, rays: ScanRays) -> np.ndarray:
    """What remains of range errors after the beams' biases."""
    return np.asarray(returns.range_m - hits.range_m[:, 0] - PROFILE.range_bias_m[rays.ray_ring[hits.ray]])


def test_range_error_is_beam_bias_and_shot_noise_on_the_scanners_steps() -> None:
    smooth = changed("relief", rough_m=0.004, std_m=0.0, stray=0.0)
    hits, rays = wall_hits([PAINT], cosine=1.0)
    returns = simulate_returns(hits, CarLook(0.9, 0.5), rays, smooth, False, np.random.default_rng(0))
    ring = rays.ray_ring[hits.ray]
    rest = rest_of(returns, hits, rays)[returns.returned]
    assert abs(np.median(rest)) < 2e-3
    spread = 1.4826 * np.median(np.abs(rest - np.median(rest)))
    assert spread == pytest.approx(np.hypot(0.0075, 0.004), rel=0.1)  # scanner.md section 2: 7.4 to 9 mm
    assert 0.002 < np.mean(np.abs(rest) > 3.0 * spread) < 0.04  # and 1 to 4 % beyond three of it
    steps = (returns.range_m - PROFILE.range_phase_m[ring]) / PROFILE.range_quantum_m
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_roughness_grows_at_grazing_incidence() -> None:
    rough = changed("relief", rough_m=0.004, std_m=0.0, stray=0.0)

    def spread(cosine: float) -> float:
        hits, rays = wall_hits([PAINT], cosine=cosine)
        returns = simulate_returns(hits, CarLook(0.9, 0.5), rays, rough, False, np.random.default_rng(0))
        return float(np.std(rest_of(returns, hits, rays)))

    assert spread(0.15) > 2.0 * spread(1.0)


def test_some_ranges_stray_but_none_leaves_the_box_that_the_contract_allows() -> None:
    hits, rays = wall_hits([PAINT], cosine=0.3)
    returns = simulate_returns(
        hits, CarLook(0.9, 0.5), rays, changed("relief", stray=0.2, std_m=0.05), False, np.random.default_rng(0)
    )
    rest = rest_of(returns, hits, rays)
    assert 0.05 < np.mean(np.abs(rest) > 0.08) < 0.3
    whole = np.abs(returns.range_m - hits.range_m[:, 0])
    assert whole.max() < 0.25


def test_bright_cars_return_more_than_dark_ones_and_faces_seen_straight_on_more_than_grazing_ones() -> None:
    def share(paint: float, cosine: float) -> float:
        return float(
            np.mean([returns_of([PAINT], CarLook(paint, 0.5), s, cosine=cosine)[2].returned.mean() for s in range(4)])
        )

    assert share(0.9, 0.9) > share(0.5, 0.9) > share(0.1, 0.9)
    assert share(0.2, 0.95) > share(0.2, 0.3) + 0.15  # bright cars return from every side


def test_misses_come_in_clumps_along_the_ring_and_less_so_over_beams() -> None:
    hits, rays, returns = returns_of([PAINT], CarLook(0.15, 0.5), cosine=0.5)
    rings = rays.ray_ring[hits.ray]
    grid = returns.returned.reshape(len(np.unique(rings)), -1).astype(float)
    next_firing = np.corrcoef(grid[:, :-1].ravel(), grid[:, 1:].ravel())[0, 1]
    four_on = np.corrcoef(grid[:, :-4].ravel(), grid[:, 4:].ravel())[0, 1]
    next_beam = np.corrcoef(grid[:-1].ravel(), grid[1:].ravel())[0, 1]
    assert next_firing > 0.5
    assert 0.2 < four_on < next_firing
    assert next_beam < next_firing


def test_zeros_stand_round_the_holes_and_dark_cars_show_more_of_them() -> None:
    def zeros(paint: float) -> tuple[float, float]:
        _, _, returns = returns_of([PAINT], CarLook(paint, 0.5), cosine=0.5)
        seen = returns.returned
        beside = np.zeros_like(seen)
        beside[1:] |= ~seen[:-1]
        beside[:-1] |= ~seen[1:]
        zero = returns.reflectance == 0.0
        return float(zero[seen].mean()), float(zero[seen & beside].mean())

    dark, dark_beside = zeros(0.1)
    bright, bright_beside = zeros(0.9)
    assert dark > bright + 0.2
    assert dark_beside > dark
    assert bright_beside > bright + 0.2


def test_paint_near_a_pane_returns_less_than_elsewhere() -> None:
    hits, rays = wall_hits([PAINT], cosine=0.7)
    ring = rays.ray_ring[hits.ray].astype(int)
    kinds = hits.surface.copy()
    kinds[ring == 20, 0] = GLASS
    hits = dataclasses.replace(hits, surface=kinds)
    seen = np.zeros(64)
    for seed in range(4):
        returns = simulate_returns(hits, CarLook(0.5, 0.5), rays, PROFILE, False, np.random.default_rng(seed))
        seen += np.bincount(ring, returns.returned, 64) / np.maximum(np.bincount(ring, minlength=64), 1) / 4
    assert seen[[19, 21]].mean() < seen[[12, 13, 27, 28]].mean() - 0.1


def test_what_stands_in_an_empty_cabin_is_met_before_the_far_door() -> None:
    hits, rays = wall_hits([GLASS, PAINT])
    ranges = hits.range_m.copy()
    ranges[:, 1] = ranges[:, 0] + 3.0
    hits = dataclasses.replace(hits, range_m=ranges)
    full = changed("glass", clutter=0.6, clutter_m={"at": [0.0, 1.0], "value": [0.2, 4.0]})
    found = []
    for seed in range(12):
        returns = simulate_returns(hits, CarLook(0.5, 0.3), rays, full, False, np.random.default_rng(seed))
        found.append((returns.stop_m - ranges[:, 0])[returns.surface == THROUGH_GLASS])
    depth = np.concatenate(found)
    assert np.mean(depth < 2.9) == pytest.approx(0.6 * 2.7 / 3.8, abs=0.15)
    assert depth.min() >= 0.2
    assert depth.max() <= 3.0 + 1e-9


def test_nothing_is_met_behind_a_pane_that_nothing_of_the_car_follows() -> None:
    full = changed("glass", clutter=1.0)
    hits, rays = wall_hits([GLASS])
    returns = simulate_returns(hits, CarLook(0.5, 0.3), rays, full, False, np.random.default_rng(0))
    assert np.isinf(returns.stop_m[returns.surface == THROUGH_GLASS]).all()


def test_pane_before_a_seat_reflects_some_swallows_most_and_shows_the_seat_sometimes() -> None:
    hits, _, returns = returns_of([GLASS, PAINT], CarLook(0.5, 0.3))
    assert (returns.stop_m < np.inf).all()  # a seat lets nothing through
    surface = returns.returned & (returns.surface == GLASS)
    inside = returns.returned & (returns.surface == THROUGH_GLASS)
    assert 0.05 < surface.mean() < 0.35
    assert 0.05 < inside.mean() < 0.40
    assert (1.0 - returns.returned.mean()) > 0.35
    assert (returns.stop_m[inside] > hits.range_m[inside, 0]).all()
    assert (returns.stop_m[inside] <= hits.range_m[inside, 1]).all()


def test_two_panes_with_nothing_behind_let_some_pulses_on_to_the_world() -> None:
    _, _, returns = returns_of([GLASS, GLASS], CarLook(0.5, 0.2))
    beyond = ~np.isfinite(returns.stop_m)
    assert 0.01 < beyond.mean() < 0.5
    assert not returns.returned[beyond].any()


def test_opaque_glass_ends_every_pulse_like_paint() -> None:
    _, _, returns = returns_of([GLASS], CarLook(0.8, 0.5), opaque=True)
    assert np.isfinite(returns.stop_m).all()
    assert returns.returned.mean() > 0.7


def test_reflectance_stands_in_hundredths_with_many_exact_zeros() -> None:
    _, _, returns = returns_of([PAINT], CarLook(0.5, 0.5))
    values = returns.reflectance * 100
    np.testing.assert_allclose(values, np.rint(values), atol=1e-9)
    assert values.min() == 0
    assert values.max() <= 99
    assert 0.1 < np.mean(values[returns.returned] == 0) < 0.7


def test_nothing_returns_from_beyond_the_longest_range() -> None:
    _, _, returns = returns_of([PAINT], CarLook(0.9, 0.5), range_m=81.0)
    assert not returns.returned.any()


def test_no_ray_on_the_car_gives_no_return() -> None:
    hits, rays = wall_hits([PAINT])
    none = CarHits(*(column[:0] for column in (hits.ray, hits.range_m, hits.face, hits.surface, hits.cos_incidence)))
    returns = simulate_returns(none, CarLook(0.5, 0.5), rays, PROFILE, False, np.random.default_rng(0))
    assert len(returns.returned) == len(returns.range_m) == 0


def test_curve_with_a_knot_too_many_names_its_key() -> None:
    broken = changed("body", cosine={"at": [0.0, 1.0], "value": [0.0]})
    with pytest.raises(InputError, match=r"noise\.body\.cosine"):
        sensor_noise.noise_model(broken)


def test_profile_without_noise_says_which_command_adds_it() -> None:
    content = {key: value for key, value in PROFILE.content.items() if key != "noise"}
    with pytest.raises(InputError, match=r"has no `noise`.*augkitti fit-noise --profile FOLDER"):
        sensor_noise.noise_model(dataclasses.replace(PROFILE, content=content))
