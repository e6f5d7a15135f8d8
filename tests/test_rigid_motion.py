"""Local and world motions: the round trip of Eq. 4, Eq. 1, both claims, and the median over boxes."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from training.rigid_motion import (
    flow_of,
    local_to_world,
    matrix_of,
    motion_of,
    pool_over_boxes,
    world_to_local,
)

torch = pytest.importorskip("torch")

metres = st.floats(-80.0, 80.0)
places = st.tuples(metres, metres).map(np.array)
near = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)).map(np.array)
motions = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0)).map(np.array)


def rotation(theta: float) -> np.ndarray:
    return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])


@given(motions, places)
@settings(deadline=None)
def test_there_and_back_is_the_same_motion(motion, origin):
    np.testing.assert_allclose(world_to_local(local_to_world(motion, origin), origin), motion, rtol=0, atol=1e-6)
    np.testing.assert_allclose(local_to_world(world_to_local(motion, origin), origin), motion, rtol=0, atol=1e-6)


@given(motions, places)
@settings(deadline=None)
def test_there_and_back_in_float32_is_the_same_to_the_rounding_of_80_metres(motion, origin):
    motion, origin = (torch.tensor(array, dtype=torch.float32) for array in (motion, origin))
    torch.testing.assert_close(world_to_local(local_to_world(motion, origin), origin), motion, rtol=0, atol=5e-5)


@given(motions, places)
@settings(deadline=None)
def test_the_conversion_is_the_papers_matrices(motion, origin):
    R = rotation(motion[2])
    world = local_to_world(motion, origin)
    np.testing.assert_allclose(world[:2], (np.eye(2) - R) @ origin + motion[:2], atol=1e-9)  # Eq. 4
    np.testing.assert_allclose(world_to_local(motion, origin)[:2], (R - np.eye(2)) @ origin + motion[:2], atol=1e-9)
    assert world[2] == motion[2]


@given(motions, places, near)
@settings(deadline=None)
def test_the_flow_of_a_point_is_the_same_by_its_local_and_by_its_world_motion(motion, origin, offset):
    p = origin + offset
    expected = rotation(motion[2]) @ offset + motion[:2] - offset  # Eq. 1
    np.testing.assert_allclose(flow_of(motion, p - origin), expected, atol=1e-9)
    np.testing.assert_allclose(flow_of(local_to_world(motion, origin), p), expected, atol=1e-9)


@given(motions, places, places, near)
@settings(deadline=None)
def test_claim_1_one_world_motion_explains_the_same_flow_at_two_places_only_without_rotation(motion, o_a, o_b, offset):
    assume(np.hypot(*(o_a - o_b)) > 0.1)
    world_p, world_q = local_to_world(motion, o_a), local_to_world(motion, o_b)
    np.testing.assert_allclose(flow_of(world_p, o_a + offset), flow_of(world_q, o_b + offset), atol=1e-9)
    apart = np.hypot(*(world_p - world_q)[:2])
    assert apart == pytest.approx(2.0 * abs(np.sin(motion[2] / 2.0)) * np.hypot(*(o_a - o_b)), abs=1e-9)
    if abs(motion[2]) > 1e-3:
        assert apart > 1e-5  # t_W differs wherever R is not I: a turn in the plane leaves no direction as it is
        assert np.abs(flow_of(world_p, o_a + offset) - flow_of(world_p, o_b + offset)).max() > 1e-6


@given(motions, places, places, near)
@settings(deadline=None)
def test_claim_2_one_local_motion_explains_the_same_flow_at_two_places(motion, o_a, o_b, offset):
    v_p, v_q = (flow_of(local_to_world(motion, o), o + offset) for o in (o_a, o_b))
    np.testing.assert_allclose(v_p, flow_of(motion, offset), atol=1e-9)
    np.testing.assert_allclose(v_q, flow_of(motion, offset), atol=1e-9)


@given(motions, places)
@settings(deadline=None)
def test_matrices_move_points_as_their_motions_do(motion, point):
    T = matrix_of(motion)
    moved = T @ np.array([*point, 1.5, 1.0])
    np.testing.assert_allclose(moved, [*(point + flow_of(motion, point)), 1.5, 1.0], atol=1e-9)
    np.testing.assert_allclose(motion_of(T), motion, atol=1e-9)


def test_a_small_rotation_is_not_rounded_away():
    motion = np.float32([0.0, 0.0, 1e-4])
    assert flow_of(motion, np.float32([1.0, 0.0]))[0] == pytest.approx(
        -0.5e-8, rel=1e-3
    )  # cos - 1 in float32 would be 0


@given(st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_tensors_and_arrays_give_the_same(seed):
    rng = np.random.default_rng(seed)
    motion, centres = rng.normal(0, 1, (40, 3)), rng.uniform(-6, 6, (40, 2))
    boxes = np.array([[0, 0, 0, 8, 5, 2, 0.4], [3, 3, 0, 4, 2, 2, -1.0], [50, 50, 0, 4, 2, 2, 0]])
    for function, arguments in (
        (local_to_world, (motion, centres)),
        (world_to_local, (motion, centres)),
        (flow_of, (motion, centres)),
        (matrix_of, (motion,)),
        (motion_of, (matrix_of(motion),)),
        (pool_over_boxes, (motion, centres, boxes)),
    ):
        array = function(*arguments)
        tensor = function(*(torch.from_numpy(argument) for argument in arguments))
        np.testing.assert_allclose(tensor.numpy(), array, atol=1e-12)


def test_a_boxs_motion_is_the_median_over_the_columns_whose_centres_it_holds():
    box = np.array([[10.0, 0.0, -1.0, 4.0, 2.0, 1.5, np.pi / 2]])  # along y
    centres = np.array([[10.0, 0.0], [10.0, 1.9], [10.9, 0.0], [10.0, -1.9], [10.0, 2.1], [11.1, 0.0]])
    motion = np.array([[1, 0, 0.1], [2, 5, 0.3], [3, 6, 0.2], [9, 7, 0.9], [100, 100, 3], [100, 100, 3]])
    # of four the lower of the middle two, number by number
    np.testing.assert_array_equal(pool_over_boxes(motion, centres, box), [[2.0, 5.0, 0.2]])


def test_a_single_wrong_column_does_not_change_a_boxs_motion():
    rng = np.random.default_rng(0)
    centres = rng.uniform(-1, 1, (21, 2))
    motion = np.tile([1.0, 0.5, 0.05], (21, 1))
    motion[3] = 100.0
    box = np.array([[0.0, 0, 0, 4, 4, 2, 0]])
    np.testing.assert_allclose(pool_over_boxes(motion, centres, box), [[1.0, 0.5, 0.05]])


def test_a_box_without_a_column_has_the_motion_that_was_given_for_such_or_none():
    motion, centres, far = np.zeros((2, 3)), np.zeros((2, 2)), np.array([[50.0, 0, 0, 4, 2, 2, 0]])
    assert np.isnan(pool_over_boxes(motion, centres, far)).all()
    ego = np.array([-1.0, 0.0, 0.01])
    np.testing.assert_array_equal(pool_over_boxes(motion, centres, far, ego), [ego])
    np.testing.assert_array_equal(pool_over_boxes(motion[:0], centres[:0], far, ego), [ego])
    assert pool_over_boxes(motion, centres, np.zeros((0, 7))).shape == (0, 3)
    with pytest.raises(ValueError, match="no column at all"):
        pool_over_boxes(motion[:0], centres[:0], far)
