"""Fig. 3b and the two claims behind it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from training.equivariance import (  # noqa: E402
    LARGEST_ROTATIONS_RAD,
    Row,
    draw_chart,
    draw_grids,
    equivariance,
    targets_of,
    train_one,
)
from training.rigid_motion import flow_of, local_to_world  # noqa: E402

metres = st.floats(-35.0, 35.0)
motions = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-1.0, 1.0)).map(np.array)
places = st.tuples(metres, metres).map(np.array)


@given(motion=motions, o_a=places, o_b=places, local=st.tuples(st.floats(-5, 5), st.floats(-5, 5)).map(np.array))
@settings(deadline=None)
def test_one_local_motion_explains_one_flow_wherever_its_origin_is(motion, o_a, o_b, local):
    # claim 2, with Eq. 1's sign: p - o_A = q - o_B
    flows = [flow_of(local_to_world(motion, o), o + local) for o in (o_a, o_b)]
    np.testing.assert_allclose(flows[0], flow_of(motion, local), atol=1e-9)
    np.testing.assert_allclose(flows[1], flow_of(motion, local), atol=1e-9)


@given(motion=motions, o_a=places, o_b=places)
@settings(deadline=None)
def test_the_same_flow_elsewhere_needs_another_world_motion_unless_nothing_turns(motion, o_a, o_b):
    # claim 1: t_W differs by (I - R) (o_A - o_B), which is 0 only without rotation or distance (no real eigenvectors)
    apart = local_to_world(motion, o_a)[:2] - local_to_world(motion, o_b)[:2]
    expected = 2.0 * abs(np.sin(motion[2] / 2.0)) * np.linalg.norm(o_a - o_b)
    assert np.linalg.norm(apart) == pytest.approx(expected, abs=1e-9)


def test_in_space_an_axis_of_rotation_is_a_real_eigenvector():
    # the paper's step fails for origins above each other: the planar restriction is needed
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    up = np.array([0.0, 0.0, 3.0])
    np.testing.assert_array_equal(R @ up, up)


def test_local_targets_are_the_motion_of_each_cell_itself():
    flow, centres, world = draw_grids(4, 0.5, np.random.default_rng(0))
    local = targets_of("local", world, centres)
    np.testing.assert_allclose(local[..., :2], flow, atol=1e-9)  # Eq. 1 at p = o
    np.testing.assert_allclose(local_to_world(local, centres), targets_of("world", world, centres), atol=1e-9)


def test_world_translation_cannot_be_learned_and_local_can():
    rows = {name: train_one(name, 1.0, seed=0, steps=40) for name in ("world", "local")}
    assert rows["world"].translation_m > 8.0
    assert rows["local"].translation_m < 1.0


def test_training_is_repeatable():
    assert train_one("local", 0.1, seed=3, steps=3) == train_one("local", 0.1, seed=3, steps=3)


def test_chart_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    rows = [
        Row(name, rotation, seed, 0.1 + rotation, 0.2 + rotation, 0.01)
        for name in ("world", "local")
        for rotation in LARGEST_ROTATIONS_RAD
        for seed in (0, 1)
    ]
    draw_chart(rows, tmp_path / "fig3b.png")
    assert (tmp_path / "fig3b.png").read_bytes()[:4] == b"\x89PNG"


def test_a_missing_folder_is_told_before_training(tmp_path):
    from augkitti.errors import InputError

    with pytest.raises(InputError, match="its folder does not exist"):
        equivariance(tmp_path / "none" / "fig3b.png")
