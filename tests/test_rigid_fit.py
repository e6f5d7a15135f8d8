"""Matched points to rigid motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from augkitti.frames import is_rigid, rigid, transform_points
from training.baselines.rigid_fit import fit_rigid, ransac_rigid

seeds = st.integers(0, 2**32)


def drawn(seed: int, count: int = 40):
    rng = np.random.default_rng(seed)
    motion = rigid(Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(0.0, 3.0, 3))
    return rng.uniform(-4.0, 4.0, (count, 3)), motion, rng


@given(seeds, st.integers(4, 60))
@settings(max_examples=50, deadline=None)
def test_a_known_motion_is_found_exactly(seed, count):
    points, motion, _ = drawn(seed, count)
    np.testing.assert_allclose(fit_rigid(points, transform_points(motion, points)), motion, atol=1e-6)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_the_fit_is_that_of_scipy(seed):
    points, motion, rng = drawn(seed)
    other = transform_points(motion, points) + 0.1 * rng.standard_normal(points.shape)
    weight = rng.uniform(0.1, 1.0, len(points))
    found = fit_rigid(points, other, weight)
    centre0, centre1 = np.average(points, 0, weight), np.average(other, 0, weight)
    oracle, _ = Rotation.align_vectors(other - centre1, points - centre0, weight)
    np.testing.assert_allclose(found[:3, :3], oracle.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(transform_points(found, centre0), centre1, atol=1e-9)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_points_in_a_plane_are_turned_not_mirrored(seed):
    points, motion, _ = drawn(seed)
    points[:, 2] = 0.0
    found = fit_rigid(points, transform_points(motion, points))
    assert is_rigid(found)
    np.testing.assert_allclose(transform_points(found, points), transform_points(motion, points), atol=1e-6)


@given(seeds, st.integers(0, 2))
@settings(max_examples=20, deadline=None)
def test_one_or_two_points_are_shifted_and_none_stand(seed, count):
    points, motion, _ = drawn(seed, count)
    found, _ = ransac_rigid(points, transform_points(motion, points), 0.1, np.random.default_rng(0))
    np.testing.assert_array_equal(found[:3, :3], np.eye(3))
    if count:
        np.testing.assert_allclose(
            transform_points(found, points.mean(0)), transform_points(motion, points).mean(0), atol=1e-9
        )
    else:
        np.testing.assert_array_equal(found, np.eye(4))


@given(seeds, st.floats(0.0, 0.6))
@settings(max_examples=30, deadline=None)
def test_wrong_matches_are_left_out(seed, wrong):
    points, motion, rng = drawn(seed, 80)
    other = transform_points(motion, points)
    bad = rng.random(len(points)) < wrong
    other[bad] += rng.uniform(1.0, 5.0, (int(bad.sum()), 3)) * rng.choice([-1.0, 1.0], (int(bad.sum()), 3))
    found, inlier = ransac_rigid(points, other, 0.05, np.random.default_rng(seed))
    np.testing.assert_allclose(found, motion, atol=1e-6)
    np.testing.assert_array_equal(inlier, ~bad)


def test_matches_that_agree_on_nothing_give_a_rigid_motion_all_the_same():
    rng = np.random.default_rng(0)
    found, inlier = ransac_rigid(rng.normal(size=(10, 3)) * 9, rng.normal(size=(10, 3)) * 9, 0.01, rng)
    assert is_rigid(found)
    assert inlier.shape == (10,)
    same = np.ones((5, 3))
    assert fit_rigid(same, same) == pytest.approx(np.eye(4))
