import numpy as np
import pytest

from augkitti import realism_features as rf
from augkitti.labelled_views import GROW_M, rays_at
from augkitti.scanner import fire_rays, lines_of_rays, load_profile

PROFILE = load_profile()
RAYS = fire_rays(PROFILE, np.arange(0, 4000, 2, dtype=np.uint16), 0.1)
BOX = np.array([12.0, 1.0, -1.0, 4.2, 1.8, 1.5, np.pi / 2.0])  # its long side faces the scanner


def seen(measured=None, shine=0.3, box=BOX):
    """A view of a box whose near face returns every ray, or what `measured` makes of its ranges."""
    ray = rays_at(RAYS, box, PROFILE, GROW_M)
    origin, direction = lines_of_rays(PROFILE, RAYS, ray)
    face = (box[0] - 0.5 * box[4] - origin[:, 0]) / direction[:, 0]
    at = origin + face[:, None] * direction
    on_face = (np.abs(at[:, 1] - box[1]) < 0.5 * box[3]) & (np.abs(at[:, 2] - box[2]) < 0.5 * box[5])
    ranges = np.where(on_face, face, np.inf)
    if measured is not None:
        ranges = measured(ranges)
    return rf.car_rays(RAYS, ray, ranges, np.broadcast_to(shine, ranges.shape), box, PROFILE)


def feature(view, name):
    return rf.car_features(view)[list(rf.FEATURES).index(name)]


def test_every_feature_has_a_number_and_a_description():
    values = rf.car_features(seen())
    assert values.shape == (len(rf.FEATURES),)
    assert np.isfinite(values[:4]).all()


def test_a_face_that_returns_all_has_no_holes():
    view = seen()
    assert len(view.points) > 300
    assert feature(view, "return_body") == 1.0
    assert len(rf.holes(view)) == 0


def test_a_view_without_returns_says_so():
    view = seen(lambda ranges: np.full_like(ranges, np.inf))
    assert feature(view, "points_log") == 0.0
    assert feature(view, "return_body") == 0.0
    assert np.isnan(feature(view, "residual_along"))


def test_rays_stopped_before_the_box_are_left_out():
    whole = seen()
    half = seen(lambda ranges: np.where(np.arange(len(ranges)) % 2 == 0, 3.0, ranges))
    assert len(half) == pytest.approx(0.5 * len(whole), abs=2)
    assert feature(half, "return_body") == 1.0


def test_ground_under_the_car_is_trimmed():
    heights = seen().points[:, 2] + 0.5 * BOX[5]
    assert heights.min() > 0.15


def test_noise_shows_as_residuals_of_its_size():
    rng = np.random.default_rng(0)
    view = seen(lambda ranges: ranges + 0.01 * rng.standard_normal(len(ranges)))
    # a point less the mean of its neighbours spreads by the square root of 1.5
    assert np.std(rf.residuals_along(view)) == pytest.approx(0.01 * np.sqrt(1.5), rel=0.1)
    assert np.std(rf.residuals_across(view)) == pytest.approx(0.01 * np.sqrt(1.5), rel=0.25)


def test_planted_holes_are_measured():
    def with_holes(ranges):
        ray = rays_at(RAYS, BOX, PROFILE, GROW_M)
        firing = np.rint((RAYS.ray_azimuth_rad[ray] + np.pi) / (2.0 * np.pi / 2000.0)).astype(int)
        return np.where(firing % 12 < 5, np.inf, ranges)

    holes = rf.holes(seen(with_holes))
    assert np.median(holes) == 5
    assert holes.max() <= 6


@pytest.mark.parametrize(("length", "low", "high"), [(1, -0.1, 0.1), (10, 0.7, 1.0)])
def test_clumps_show_in_the_correlation_to_the_next_firing(length, low, high):
    def dropped(ranges):
        luck = np.random.default_rng(1).random(len(ranges) // length + 1) < 0.5
        return np.where(np.repeat(luck, length)[: len(ranges)], np.inf, ranges)

    view = seen(dropped)
    assert low < feature(view, "clump_next") < high


def test_neighbouring_beams_are_paired_at_the_same_azimuth():
    view = seen()
    upper, lower = rf.beam_pairs(view, view.on_car)
    assert (view.ring[lower].astype(int) - view.ring[upper] == 1).all()
    assert np.abs(view.turn_rad[lower] - view.turn_rad[upper]).max() < 0.5 * rf.FIRING_RAD
    assert len(upper) > 0.7 * view.on_car.sum()


def test_reflectance_of_zero_is_counted():
    ray = rays_at(RAYS, BOX, PROFILE, GROW_M)
    shine = np.where(np.random.default_rng(2).random(len(ray)) < 0.4, 0.0, 0.3)
    view = seen(shine=shine)
    assert feature(view, "zero_body") == pytest.approx(0.4, abs=0.08)
    assert feature(view, "reflectance_middle") == pytest.approx(0.3)
    assert abs(feature(view, "reflectance_smooth")) < 0.2


def test_windows_that_swallow_show_by_height():
    def without_windows(ranges):
        ray = rays_at(RAYS, BOX, PROFILE, GROW_M)
        origin, direction = lines_of_rays(PROFILE, RAYS, ray)
        height = (origin + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * direction)[:, 2] - BOX[2]
        return np.where(height > 0.2 * BOX[5], np.inf, ranges)

    share = rf.returns_by_height(seen(without_windows))
    assert share[2] == pytest.approx(1.0, abs=0.05)
    assert share[-2] < 0.1


def test_occupancy_from_above_sums_to_one():
    assert rf.bev_occupancy(seen()).sum() == pytest.approx(1.0)
    assert rf.bev_occupancy(seen(lambda ranges: np.full_like(ranges, np.inf))).sum() == 0.0


def test_divergence_is_0_for_equal_and_1_for_disjoint_histograms():
    p, q = np.array([1.0, 3.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0, 2.0])
    assert rf.jensen_shannon(p, 5.0 * p) == pytest.approx(0.0, abs=1e-12)
    assert rf.jensen_shannon(p, q) == pytest.approx(1.0)


def test_chamfer_distance_is_0_for_equal_sets_and_near_1_far_off():
    points = seen().points
    assert rf.density_aware_chamfer(points, points, 2.0) == pytest.approx(0.0, abs=1e-12)
    assert rf.density_aware_chamfer(points, points + 5.0, 2.0) > 0.99
    near = rf.density_aware_chamfer(points, points + (0.0, 0.0, 0.02), 2.0)
    far = rf.density_aware_chamfer(points, points + (0.0, 0.0, 0.2), 2.0)
    assert near < far
    assert rf.density_aware_chamfer(points, np.zeros((0, 3)), 2.0) == 1.0
