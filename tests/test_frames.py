"""Rigid motions and boxes: the algebra that everything else rests on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from augkitti import frames

numbers = st.floats(-20.0, 20.0)
twists = st.tuples(numbers, numbers, numbers, *[st.floats(-1.7, 1.7)] * 3).map(np.array)


def hat(twist: np.ndarray) -> np.ndarray:
    v, w = twist[:3], twist[3:]
    return np.array([[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]])


@settings(max_examples=60, deadline=None)
@given(twists, st.floats(-1.0, 1.0))
def test_exponential_equals_the_matrix_exponential_of_scipy(twist: np.ndarray, factor: float) -> None:
    np.testing.assert_allclose(frames.se3_exp(twist, factor), expm(hat(twist) * factor), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(twists)
def test_logarithm_undoes_the_exponential(twist: np.ndarray) -> None:
    T = frames.se3_exp(twist)
    np.testing.assert_allclose(frames.se3_exp(frames.se3_log(T)), T, atol=1e-8)
    assert frames.is_rigid(T)


@settings(max_examples=30, deadline=None)
@given(twists, twists)
def test_inverse_and_product_agree_with_numpy(a: np.ndarray, b: np.ndarray) -> None:
    A, B = frames.se3_exp(a), frames.se3_exp(b)
    np.testing.assert_allclose(frames.compose(A, B), A @ B, atol=1e-9)
    np.testing.assert_allclose(frames.invert(A), np.linalg.inv(A), atol=1e-9)
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_allclose(frames.transform_points(A, points), points @ A[:3, :3].T + A[:3, 3], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_pose_on_a_slope_keeps_its_heading_seen_from_above(yaw: float, slope_x: float, slope_y: float) -> None:
    normal = np.array([-slope_x, -slope_y, 1.0])
    T = frames.pose_on_slope(1.0, 2.0, 3.0, yaw, normal)
    assert frames.is_rigid(T)
    assert frames.yaw_of(T) == pytest.approx(yaw, abs=1e-9)
    np.testing.assert_allclose(T[:3, 2], normal / np.linalg.norm(normal), atol=1e-12)


def test_footprints_overlap_exactly_when_they_touch() -> None:
    a = frames.footprint_corners(np.array([0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]))
    for x, yaw, touches in ((3.9, 0.0, True), (4.1, 0.0, False), (4.1, np.pi / 4, True), (5.2, np.pi / 4, False)):
        b = frames.footprint_corners(np.array([x, 0.0, 0.0, 4.0, 2.0, 1.5, yaw]))
        assert frames.footprints_overlap(a, b) is touches
        assert frames.footprints_overlap(b, a) is touches
