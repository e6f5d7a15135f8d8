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


def test_range_error_is_beam_bias_and_shot_noise_on_the_scanners_steps() -> None:
    hits, rays, returns = returns_of([PAINT], CarLook(0.9, 0.5), cosine=1.0)
    ring = rays.ray_ring[hits.ray]
    seen = returns.returned
    rest = returns.range_m - hits.range_m[:, 0] - PROFILE.range_bias_m[ring]
    assert abs(np.mean(rest[seen])) < 5e-4
    assert np.std(rest[seen]) == pytest.approx(np.hypot(0.008, 0.004), rel=0.05)
    steps = (returns.range_m - PROFILE.range_phase_m[ring]) / PROFILE.range_quantum_m
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_noise_grows_at_grazing_incidence() -> None:
    def spread(cosine: float) -> float:
        hits, rays, returns = returns_of([PAINT], CarLook(0.9, 0.5), cosine=cosine)
        return float(np.std(returns.range_m - hits.range_m[:, 0] - PROFILE.range_bias_m[rays.ray_ring[hits.ray]]))

    assert spread(0.15) > 2.0 * spread(1.0)


def test_bright_cars_return_more_than_dark_ones_and_faces_seen_straight_on_more_than_grazing_ones() -> None:
    def share(paint: float, cosine: float) -> float:
        return float(
            np.mean([returns_of([PAINT], CarLook(paint, 0.5), s, cosine=cosine)[2].returned.mean() for s in range(4)])
        )

    assert share(0.9, 0.9) > share(0.5, 0.9) > share(0.1, 0.9)
    assert share(0.5, 0.95) > share(0.5, 0.3) + 0.2


def test_misses_come_in_clumps_along_the_ring_and_less_so_over_beams() -> None:
    hits, rays, returns = returns_of([PAINT], CarLook(0.35, 0.5), cosine=0.5)
    rings = rays.ray_ring[hits.ray]
    grid = returns.returned.reshape(len(np.unique(rings)), -1).astype(float)
    next_firing = np.corrcoef(grid[:, :-1].ravel(), grid[:, 1:].ravel())[0, 1]
    four_on = np.corrcoef(grid[:, :-4].ravel(), grid[:, 4:].ravel())[0, 1]
    assert next_firing > 0.5
    assert 0.2 < four_on < next_firing


def test_pane_before_a_seat_reflects_some_swallows_most_and_shows_the_seat_sometimes() -> None:
    hits, _, returns = returns_of([GLASS, PAINT], CarLook(0.5, 0.5))
    assert (returns.stop_m < np.inf).all()  # a seat lets nothing through
    surface = returns.returned & (returns.surface == GLASS)
    inside = returns.returned & (returns.surface == THROUGH_GLASS)
    assert 0.05 < surface.mean() < 0.35
    assert 0.05 < inside.mean() < 0.40
    assert (1.0 - returns.returned.mean()) > 0.35
    assert (returns.stop_m[inside] == hits.range_m[inside, 1]).all()


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
    assert 0.3 < np.mean(values == 0) < 0.6


def test_nothing_returns_from_beyond_the_longest_range() -> None:
    _, _, returns = returns_of([PAINT], CarLook(0.9, 0.5), range_m=81.0)
    assert not returns.returned.any()


def test_profile_without_noise_names_the_key() -> None:
    content = {key: value for key, value in PROFILE.content.items() if key != "noise"}
    with pytest.raises(InputError, match="noise"):
        sensor_noise.noise_model(dataclasses.replace(PROFILE, content=content))
