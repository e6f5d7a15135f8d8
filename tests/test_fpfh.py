"""FPFH + Det."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matched_scene import BOX, EGO, along_the_axes, corner_and_box, spaced, with_noise
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from augkitti.frames import pose_from_xyz_yaw
from training.baselines.followed import true_boxes
from training.metrics import rotation_error, translation_error

pytest.importorskip("libusb_package", reason="Open3D is not installed (extra `fit`)")

from training.baselines.fpfh import STRONG, fpfh, fpfh_keypoints, fpfh_strong

FINE = replace(STRONG, voxel_m=0.08)  # so that every point has neighbours enough for a normal


def rough_wall(rng):
    """Points of a curved surface in front of the scanner, no two in a voxel of `FINE` however it is turned."""
    y, z = spaced(rng, [-2.0, -1.5, 0.0], [2.0, 1.5, 1e-9], 0.15, 1500).T[:2]
    return np.column_stack([8.0 + 0.5 * np.sin(1.3 * y) + 0.4 * np.cos(2.1 * z), y, z])


@given(st.integers(0, 2**31))
@settings(max_examples=8, deadline=None)
def test_histograms_do_not_change_when_a_scan_turns_about_the_scanner(seed):
    rng = np.random.default_rng(seed)
    xyz = rough_wall(rng)
    R = Rotation.random(random_state=seed).as_matrix()
    one, other = fpfh_keypoints(xyz, FINE), fpfh_keypoints(xyz @ R.T, FINE)
    assert len(one.xyz) == len(other.xyz) == len(xyz)
    distance, partner = cKDTree(other.xyz).query(one.xyz @ R.T)
    assert distance.max() < 1e-9
    off = np.abs(one.feature - other.feature[partner]).max(axis=1)
    assert np.median(off) < 1e-6
    assert (off < 1e-3).mean() > 0.75  # an angle at the edge of two bins falls into either, for all that see the point


def test_matching_with_care_finds_the_motions_of_a_corner_and_a_box_exactly():
    pair, motion = corner_and_box()
    said = fpfh_strong(pair, true_boxes(pair))
    np.testing.assert_allclose(said.ego_motion, EGO, atol=1e-4)
    np.testing.assert_allclose(said.motions[0], motion, atol=1e-3)
    np.testing.assert_allclose(said.flows["fpfh_strong"], pair.flow0, atol=1e-3)


def test_without_care_the_motions_are_right_where_every_match_is():
    pair, _ = corner_and_box(spacing=0.6, ego=np.eye(4), own=np.eye(4))
    said = fpfh(pair, true_boxes(pair))
    np.testing.assert_allclose(said.ego_motion, np.eye(4), atol=1e-6)
    np.testing.assert_allclose(said.motions[0], np.eye(4), atol=1e-6)


def test_without_care_the_shifts_of_a_corner_and_a_box_are_found_exactly():
    ego = pose_from_xyz_yaw(-0.3, 0.0, 0.0, 0.0)
    pair, motion = corner_and_box(spacing=0.6, ego=ego, own=along_the_axes(1.2, 0.0))
    said = fpfh(pair, true_boxes(pair))
    np.testing.assert_allclose(said.ego_motion, ego, atol=1e-5)
    np.testing.assert_allclose(said.motions[0], motion, atol=1e-5)


def test_without_care_millimetres_of_noise_cost_the_world_decimetres():
    ego = pose_from_xyz_yaw(-0.3, 0.0, 0.0, 0.0)
    pair, motion = corner_and_box(spacing=0.6, ego=ego, own=along_the_axes(0.3, 0.0))
    said = fpfh(with_noise(pair, 0.002), true_boxes(pair))
    assert translation_error(said.ego_motion, ego) < 0.3  # the paper's ranks last, too
    assert rotation_error(said.ego_motion, ego) < 0.01
    assert translation_error(said.motions[0], motion, BOX[:3]) < 0.01
    assert rotation_error(said.motions[0], motion) < 0.01


def test_noise_moves_the_answer_no_more_than_itself():
    pair, motion = corner_and_box()
    said = fpfh_strong(with_noise(pair, 0.02), true_boxes(pair))
    assert translation_error(said.ego_motion, EGO) < 0.05
    assert translation_error(said.motions[0], motion, BOX[:3]) < 0.1
    assert rotation_error(said.motions[0], motion) < 0.07
