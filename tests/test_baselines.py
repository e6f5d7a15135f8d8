"""Rows that stand beside the network."""

from dataclasses import replace

import numpy as np
import pytest
from pair_factory import make_pair as cast_pair
from scored_pair import EGO, an_object, make_pair

from augkitti.frames import pose_from_xyz_yaw, transform_points
from training.baselines import BASELINES, rigid_flow
from training.metrics import rotation_error, translation_error, yaw_error


@pytest.fixture(scope="module")
def pair():
    return cast_pair(tick_step=8).pair


def test_names_are_those_of_the_rows():
    assert list(BASELINES) == ["zero", "ego_true", "ego_registration"]


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_answers_for_every_point_and_finds_no_objects(name, pair):
    said = BASELINES[name](pair, None)
    assert list(said.flows) == [name]
    assert said.where.all()
    assert len(said.where) == len(pair.scan0)
    assert said.boxes is said.motions is None
    moved = transform_points(said.ego_motion, pair.scan0.xyz) - pair.scan0.xyz
    np.testing.assert_allclose(said.flows[name], moved, atol=1e-5)


def test_zero_motion_is_zero():
    said = BASELINES["zero"](make_pair([an_object(10, 0)]), None)
    assert not said.flows["zero"].any()
    np.testing.assert_array_equal(said.ego_motion, np.eye(4))


def test_true_ego_motion_is_right_where_nothing_moves():
    pair = make_pair([an_object(10, 0, step=0.0), an_object(20, 0, step=2.0)])
    said = BASELINES["ego_true"](pair, None)
    off = np.linalg.norm(said.flows["ego_true"] - pair.flow0, axis=1)
    assert off[pair.scan0.instance != 1] == pytest.approx(0.0, abs=1e-5)
    assert off[pair.scan0.instance == 1] == pytest.approx(2.0, abs=1e-5)
    np.testing.assert_array_equal(said.ego_motion, EGO)


def test_registration_finds_the_ego_motion_of_a_street():
    rng = np.random.default_rng(0)
    street = make_pair([an_object(12, 0)], background=())
    ground = np.column_stack([rng.uniform(-30, 30, (3000, 2)), np.full(3000, -1.73)])
    posts = np.concatenate(
        [
            np.column_stack([np.full((40, 2), place), np.linspace(-1.7, 2.0, 40)])
            for place in rng.uniform(-25, 25, (50, 2))
        ]
    )
    world = np.concatenate([ground, posts]).astype(np.float32)
    true = pose_from_xyz_yaw(-0.8, 0.05, 0.0, 0.02)
    scan0 = replace(street.scan0, xyz=world)
    pair = replace(street, scan0=scan0, scan1=replace(scan0, xyz=transform_points(true, world).astype(np.float32)))
    said = BASELINES["ego_registration"](pair, None)
    assert translation_error(said.ego_motion, true) < 0.05
    assert rotation_error(said.ego_motion, true) < 0.003
    assert yaw_error(said.ego_motion, true) < 0.003


def test_flow_of_a_rigid_motion_keeps_its_digits_far_away():
    T = pose_from_xyz_yaw(0.0, 0.0, 0.0, 1e-6)
    flow = rigid_flow(T, np.array([[80.0, 0.0, 0.0]], np.float32))
    np.testing.assert_allclose(flow, [[0.0, 8e-5, 0.0]], rtol=1e-4, atol=1e-9)
