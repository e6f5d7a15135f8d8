"""A surface to descriptors that do not depend on where, or which way round, it lies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from augkitti.frames import rigid, rotate_vectors, transform_points
from training.baselines.shot import LENGTH, describe, reference_frames, shot, support_of, upright_frames

seeds = st.integers(0, 2**32)


def bumpy(rng, count=400):
    """Points and normals of a piece of a surface z = f(x, y) that no turn maps to itself."""
    xy = rng.uniform(-1.0, 1.0, (count, 2))
    a, b, c = rng.uniform(0.2, 0.6, 3)
    points = np.column_stack([xy, a * xy[:, 0] ** 2 + b * xy[:, 1] ** 3 + c * xy[:, 0] * xy[:, 1]])
    slope_x, slope_y = 2 * a * xy[:, 0] + c * xy[:, 1], 3 * b * xy[:, 1] ** 2 + c * xy[:, 0]
    normals = np.column_stack([-slope_x, -slope_y, np.ones(count)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def turned(rng):
    return rigid(Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(0.0, 20.0, 3))


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_a_motion_turns_the_frames_and_leaves_the_descriptors(seed):
    rng = np.random.default_rng(seed)
    points, normals = bumpy(rng)
    keypoints, motion = points[:12], turned(rng)
    frames, said = shot(points, normals, keypoints, 0.7)
    frames_there, said_there = shot(
        transform_points(motion, points), rotate_vectors(motion, normals), transform_points(motion, keypoints), 0.7
    )
    np.testing.assert_allclose(said_there, said, atol=1e-5)
    np.testing.assert_allclose(frames_there, rotate_vectors(motion, frames), atol=1e-6)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_order_of_points_and_keypoints_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    points, normals = bumpy(rng)
    order, some = rng.permutation(len(points)), rng.permutation(12)
    _, said = shot(points, normals, points[:12], 0.7)
    _, said_there = shot(points[order], normals[order], points[:12][some], 0.7)
    np.testing.assert_allclose(said_there, said[some], atol=1e-6)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_frames_are_right_handed_and_descriptors_have_length_one(seed):
    points, normals = bumpy(np.random.default_rng(seed), 60)
    frames, said = shot(points, normals, points, 0.5)
    np.testing.assert_allclose(np.einsum("kab,kcb->kac", frames, frames), np.tile(np.eye(3), (60, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    length = np.linalg.norm(said, axis=1)
    assert said.shape == (60, LENGTH)
    assert (said >= 0.0).all()
    assert (np.isclose(length, 1.0, atol=1e-5) | (length == 0.0)).all()


@given(seeds, st.floats(0.0, 2.0 * np.pi), st.floats(0.05, 0.95), st.floats(0.1, 3.0))
@settings(max_examples=50, deadline=None)
def test_a_point_that_moves_a_little_changes_a_descriptor_little(seed, azimuth, far, inclination):
    rng = np.random.default_rng(seed)
    frame = np.eye(3)[None]
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    away = far * np.array([np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), 0.0])
    away[2] = far * np.cos(inclination)
    said = [
        describe(support_of(np.tile(p, (5, 1)), np.zeros((1, 3)), 1.0), np.tile(normal, (5, 1)), frame)
        for p in (away, away + 1e-6 * rng.normal(size=3))
    ]
    # an azimuth turns the faster the nearer to the axis, and an empty histogram's length the faster
    assert np.abs(said[1] - said[0]).max() < 2e-3


@pytest.mark.parametrize(
    ("away", "normal", "part"),
    [
        # centre of azimuth 4 (just past +x), of the upper half, of the inner shell; normals up, level and down
        ((22.5, 45.0, 0.25), (0.0, 0.0, 1.0), ((4, 0, 0), 10)),
        ((22.5, 45.0, 0.25), (1.0, 0.0, 0.0), ((4, 0, 0), 5)),
        ((22.5, 45.0, 0.25), (0.0, 0.0, -1.0), ((4, 0, 0), 0)),
        ((67.5, 45.0, 0.75), (0.0, 0.0, 1.0), ((5, 0, 1), 10)),
        ((-157.5, 135.0, 0.75), (0.0, 0.0, 1.0), ((0, 1, 1), 10)),
    ],
)
def test_a_point_at_the_centre_of_a_bin_counts_there_alone(away, normal, part):
    azimuth, inclination, far = np.deg2rad(away[0]), np.deg2rad(away[1]), away[2]
    point = far * np.array(
        [np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), np.cos(inclination)]
    )
    support = support_of(np.tile(point, (5, 1)), np.zeros((1, 3)), 1.0)
    said = describe(support, np.tile(normal, (5, 1)), np.eye(3)[None]).reshape(8, 2, 2, 11)
    assert said[(*part[0], part[1])] == pytest.approx(1.0, abs=1e-6)
    assert said.sum() == pytest.approx(1.0, abs=1e-5)


def test_a_point_between_two_bins_counts_half_in_each():
    point = 0.75 * np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])  # azimuth 45 degrees, level
    support = support_of(np.tile(point, (5, 1)), np.zeros((1, 3)), 1.0)
    said = describe(support, np.tile([0.0, 0.0, 1.0], (5, 1)), np.eye(3)[None]).reshape(8, 2, 2, 11)
    np.testing.assert_allclose(said[4:6, :, 1, 10], 0.5, atol=1e-6)
    assert np.count_nonzero(said > 1e-6) == 4


def test_a_keypoint_with_too_few_points_round_it_has_no_descriptor():
    points, normals = bumpy(np.random.default_rng(0), 4)
    frames, said = shot(points, normals, np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]), 5.0)
    np.testing.assert_array_equal(frames, np.tile(np.eye(3), (2, 1, 1)))
    assert not said.any()


@pytest.mark.parametrize(("points", "keypoints"), [(0, 3), (5, 0), (0, 0)])
def test_nothing_there_gives_nothing(points, keypoints):
    frames, said = shot(np.zeros((points, 3)), np.zeros((points, 3)), np.zeros((keypoints, 3)), 1.0)
    assert frames.shape == (keypoints, 3, 3)
    assert said.shape == (keypoints, LENGTH)
    assert not said.any()


def test_upright_frames_stand_and_look_away_from_the_scanner():
    keypoints = np.array([[3.0, 4.0, 1.0], [-2.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    frames = upright_frames(keypoints)
    np.testing.assert_allclose(np.einsum("kab,kcb->kac", frames, frames), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(frames[:2, 0], [[0.6, 0.8, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(frames[:, 2], np.tile([0.0, 0.0, 1.0], (3, 1)))


def test_frames_point_to_where_most_points_are():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.0, -0.5, 0.0], [2.0, 0.5, 0.3], (300, 3))
    frames = reference_frames(support_of(points, np.zeros((1, 3)), 3.0))
    assert frames[0, 0] @ [1.0, 0.0, 0.0] > 0.9
    assert frames[0, 2] @ [0.0, 0.0, 1.0] > 0.9
