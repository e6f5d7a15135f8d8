"""ICP after detections and after clusters, on a street whose motions are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matched_scene import EGO as CORNER_EGO
from matched_scene import corner_and_box
from scored_pair import EGO, an_object
from street_of_boxes import street_pair

from augkitti.frames import pose_from_xyz_yaw, rigid, transform_points
from training.baselines.clusters import clusters, ego_icp_clusters
from training.baselines.followed import sure, true_boxes
from training.baselines.icp import icp, icp_strong
from training.baselines.object_motion import SecondScan, follow
from training.metrics import rotation_error, translation_error

FOLLOWING = [icp, icp_strong]


def centre_error(found, item) -> float:
    return float(translation_error(found[None], item.motion[None], item.box0[None, :3])[0])


@pytest.fixture(scope="module")
def driving():
    return street_pair(
        [an_object(12, 3, step=1.5, turn=0.05), an_object(20, -4, step=-0.8), an_object(16, 6, step=0.0)]
    )


def test_careful_icp_recovers_motions_exactly_where_scans_hold_the_same_points(driving):
    said = icp_strong(driving, true_boxes(driving))
    np.testing.assert_allclose(said.ego_motion, EGO, atol=0.03)  # GICP on means of voxels, beside moving cars
    for item, motion in zip(driving.objects, said.motions, strict=True):
        assert centre_error(motion, item) < 1e-3
        assert rotation_error(motion, item.motion) < 1e-3
    off = np.linalg.norm(said.flows["icp_strong"] - driving.flow0, axis=1)
    assert off[driving.scan0.instance >= 0].max() < 0.01


def test_careful_icp_recovers_motions_within_the_noise():
    pair = street_pair([an_object(12, 3, step=1.5, turn=0.03), an_object(20, -4, step=-1.0)], noise_m=0.02, points=600)
    said = icp_strong(pair, true_boxes(pair))
    for item, motion in zip(pair.objects, said.motions, strict=True):
        assert centre_error(motion, item) < 0.06
        assert rotation_error(motion, item.motion) < 0.02


def test_plain_icp_recovers_a_small_motion_exactly():
    pair = street_pair([an_object(12, 3, step=1.0)])  # as fast as the ego car: it hardly moves in velo
    said = icp(pair, true_boxes(pair))
    assert centre_error(said.motions[0], pair.objects[0]) < 1e-3


def test_plain_icp_stays_within_the_noise_where_little_moves():
    pair = street_pair([an_object(12, 3, step=1.0)], noise_m=0.02, points=600)
    said = icp(pair, true_boxes(pair))
    assert translation_error(said.ego_motion, EGO) < 0.1
    assert centre_error(said.motions[0], pair.objects[0]) < 0.1
    assert rotation_error(said.motions[0], pair.objects[0].motion) < 0.03


def test_careful_icp_recovers_the_motions_of_a_corner_and_a_box():
    pair, motion = corner_and_box()
    said = icp_strong(pair, true_boxes(pair))
    assert translation_error(said.ego_motion, CORNER_EGO) < 0.03
    assert rotation_error(said.ego_motion, CORNER_EGO) < 0.003
    np.testing.assert_allclose(said.motions[0], motion, atol=1e-3)


def test_plain_icp_recovers_small_motions_of_a_corner_and_a_box_exactly():
    ego, own = pose_from_xyz_yaw(-0.05, 0.02, 0.0, 0.004), pose_from_xyz_yaw(0.06, 0.03, 0.0, 0.01)
    pair, motion = corner_and_box(ego=ego, own=own)
    said = icp(pair, true_boxes(pair))
    np.testing.assert_allclose(said.ego_motion, ego, atol=1e-4)
    np.testing.assert_allclose(said.motions[0], motion, atol=1e-3)


def test_plain_icp_is_lost_after_a_large_motion_where_careful_icp_is_not(driving):
    worst = []
    for method in FOLLOWING:
        motions = method(driving, true_boxes(driving)).motions
        worst.append(max(centre_error(m, item) for m, item in zip(motions, driving.objects, strict=True)))
    assert worst[0] > 0.3
    assert worst[1] < 0.01


def test_clusters_need_no_detections(driving):
    said = ego_icp_clusters(driving)
    assert said.boxes is None
    off = np.linalg.norm(said.flows["clusters"] - driving.flow0, axis=1)
    for row in range(3):
        assert np.median(off[driving.scan0.instance == row]) < 0.02
    assert off[driving.scan0.instance < 0].max() < 0.05


def test_clusters_recover_the_motions_of_a_corner_and_a_box():
    pair, _ = corner_and_box()
    said = ego_icp_clusters(pair)
    off = np.linalg.norm(said.flows["clusters"] - pair.flow0, axis=1)
    assert np.median(off[pair.scan0.instance == 0]) < 1e-3
    assert off[pair.scan0.instance < 0].max() < 0.03
    assert translation_error(said.ego_motion, CORNER_EGO) < 0.03


def test_clusters_stay_within_the_noise():
    pair = street_pair([an_object(12, 3, step=1.5, turn=0.03), an_object(20, -4, step=-1.0)], noise_m=0.02, points=600)
    said = ego_icp_clusters(pair)
    off = np.linalg.norm(said.flows["clusters"] - pair.flow0, axis=1)
    for row in range(2):
        assert np.median(off[pair.scan0.instance == row]) < 0.08
    assert np.median(off[pair.scan0.instance < 0]) < 0.03


def test_what_stands_together_is_one_cluster(driving):
    for rows in clusters(driving.scan0.xyz):
        assert len(np.unique(driving.scan0.instance[rows])) == 1
    held = [set(np.unique(driving.scan0.instance[rows])) for rows in clusters(driving.scan0.xyz)]
    assert sum({row} in held for row in range(3)) == 3


@pytest.mark.parametrize("method", FOLLOWING)
def test_without_detections_all_moves_with_the_world(method, driving):
    nothing = replace(true_boxes(driving), boxes=np.zeros((0, 7)), scores=np.zeros(0))
    for detections in (None, nothing, sure(driving, true_boxes(driving), 1.5)):
        said = method(driving, detections)
        assert len(said.motions) == 0
        moved = transform_points(said.ego_motion, driving.scan0.xyz) - driving.scan0.xyz
        np.testing.assert_allclose(next(iter(said.flows.values())), moved, atol=1e-4)


@given(st.integers(0, 2**32), st.floats(-2.5, 2.5), st.floats(-2.5, 2.5), st.floats(-0.15, 0.15))
@settings(max_examples=25, deadline=None)
def test_a_box_is_followed_wherever_it_goes(seed, x, y, turn):
    rng = np.random.default_rng(seed)
    box = rng.uniform(-0.5, 0.5, (300, 3)) * [4.0, 1.8, 1.4]
    box[np.arange(300), rng.integers(0, 2, 300)] = np.where(rng.random(300) < 0.5, 0.7, -0.7)
    here = box + [15.0, 4.0, -1.0]
    R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    motion = rigid(R, here.mean(0) - R @ here.mean(0) + [x, y, 0.0])
    found = follow(here, np.eye(4), SecondScan.of(transform_points(motion, here)))
    true = transform_points(motion, here)
    off = np.abs(transform_points(found, here) - true).max()
    stands = np.abs(true - here).max() < 0.05  # what hardly moves may be taken to stand
    assert off < (0.05 if stands else 1e-3)


def test_nothing_to_follow_stands():
    empty = np.zeros((0, 3))
    some = np.random.default_rng(0).normal(size=(50, 3))
    for points, around in ((empty, some), (some, empty), (some, some + 100.0)):
        np.testing.assert_array_equal(follow(points, EGO, SecondScan.of(around)), EGO)
