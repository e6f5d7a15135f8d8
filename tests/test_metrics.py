"""Errors of flow and motion, matching, average precision, speed buckets; the last against bucketed-scene-flow-eval."""

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.frames import compose, pose_from_xyz_yaw
from training.boxes import covered_bev, gaps_bev, in_boxes_bev, iou_3d, rotated_iou_bev
from training.metrics import (
    Buckets,
    accuracy,
    average_precision,
    end_point_error,
    match_one_to_one,
    rotation_error,
    spread,
    translation_error,
    yaw_error,
)


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, yaw=0.0):
    return [x, y, z, length, width, height, yaw]


def test_end_point_error_is_the_distance_between_the_ends():
    assert end_point_error([[0, 0, 0], [1, 2, 2]], [[3, 4, 0], [1, 2, 2]]).tolist() == [5.0, 0.0]


def test_accuracy_takes_the_easier_of_absolute_and_relative():
    error = np.array([0.0, 0.04, 0.08, 0.08, 0.2, 0.4])
    length = np.array([0.0, 0.1, 0.1, 2.0, 10.0, 10.0])
    strict, relaxed, outlier = accuracy(error, length)
    assert strict.tolist() == [True, True, False, True, True, True]
    assert relaxed.tolist() == [True, True, True, True, True, True]
    assert outlier.tolist() == [False, True, True, False, False, True]


def test_spread_forgives_a_flow_that_is_wrong_by_one_vector():
    errors = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, -2.0, 0]])
    found = spread(errors, np.array([0, 0, 2, 2]), 3)
    np.testing.assert_allclose(found, [0.0, np.nan, 2.0])


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_rotation_error_is_the_angle_between(one, other):
    a, b = pose_from_xyz_yaw(1, 2, 3, one), pose_from_xyz_yaw(4, 5, 6, other)
    apart = abs((one - other + np.pi) % (2 * np.pi) - np.pi)
    np.testing.assert_allclose(rotation_error(a, b), apart, atol=2e-7)
    np.testing.assert_allclose(yaw_error(a, b), apart, atol=1e-9)


def test_tiny_rotations_keep_their_digits():
    assert rotation_error(np.eye(4), pose_from_xyz_yaw(0, 0, 0, 1e-9)) == pytest.approx(1e-9, rel=1e-6)


def test_a_turn_about_a_far_centre_is_a_translation_in_lidar_coordinates_alone():
    there, back = pose_from_xyz_yaw(28.0, 0, 0, 0.1), pose_from_xyz_yaw(-28.0, 0, 0, 0)
    about_the_car = compose(there, back)
    assert translation_error(about_the_car, np.eye(4)) == pytest.approx(28 * 2 * np.sin(0.05))
    assert translation_error(about_the_car, np.eye(4), np.array([28.0, 0, 0])) == pytest.approx(0, abs=1e-12)


def test_matching_gives_each_truth_to_the_surest_detection():
    overlap = np.array([[0.6, 0.0], [0.9, 0.55], [0.8, 0.7]])
    assert match_one_to_one(overlap, [0.5, 0.9, 0.7], 0.5).tolist() == [-1, 0, 1]
    assert match_one_to_one(overlap, [0.9, 0.5, 0.7], 0.5).tolist() == [0, -1, 1]
    assert match_one_to_one(overlap, [0.9, 0.5, 0.4], 0.5).tolist() == [0, 1, -1]


def test_matching_with_nothing_on_either_side():
    assert match_one_to_one(np.zeros((2, 0)), [0.1, 0.2], 0.5).tolist() == [-1, -1]
    assert match_one_to_one(np.zeros((0, 2)), [], 0.5).tolist() == []


def test_average_precision_of_a_perfect_detector_is_one_and_of_none_zero():
    assert average_precision([0.9, 0.8, 0.7], [True] * 3, 3) == 1.0
    assert average_precision([], [], 3) == 0.0
    assert average_precision([0.9, 0.8], [False, False], 3) == 0.0
    assert average_precision([0.9], [False], 0) is None


def test_average_precision_by_hand():
    # recall 1/2 at precision 1, recall 1 at precision 2/3: 20 recalls of each
    assert average_precision([0.9, 0.8, 0.7], [True, False, True], 2) == pytest.approx((20 * 1 + 20 * 2 / 3) / 40)
    assert average_precision([0.9], [True], 2) == 0.5


def test_average_precision_does_not_depend_on_the_order_of_equals():
    one, other = ([True, False], [False, True])
    assert average_precision([0.5, 0.5], one, 1) == average_precision([0.5, 0.5], other, 1) == 0.5


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 9), st.booleans()), min_size=1, max_size=30), st.integers(0, 5))
def test_average_precision_agrees_with_scikit_learns_curve(found, missed):
    curve = pytest.importorskip("sklearn.metrics").precision_recall_curve
    scores, hits = (np.array(column) for column in zip(*found, strict=True))
    truths = int(hits.sum()) + missed
    if not truths:
        assert average_precision(scores, hits, truths) is None
        return
    precision, recall, least = curve(np.append(hits, [True] * missed), np.append(scores, [-1] * missed))
    precision, recall = precision[:-1][least > 0], recall[:-1][least > 0]
    best = [precision[recall >= k / 40 - 1e-9].max(initial=0.0) for k in range(1, 41)]
    assert average_precision(scores, hits, truths) == pytest.approx(np.mean(best))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_average_precision_depends_on_the_order_of_scores_alone_and_never_rises_with_a_false_one(seed):
    rng = np.random.default_rng(seed)
    scores, hits = rng.random(12), rng.random(12) < 0.5
    truths = int(hits.sum()) + 2
    there = average_precision(scores, hits, truths)
    assert average_precision(np.exp(3 * scores), hits, truths) == pytest.approx(there)
    more = average_precision(np.append(scores, rng.random()), np.append(hits, False), truths)
    assert 0.0 <= more <= there <= 1.0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_matching_is_one_to_one_and_leaves_no_pair_that_would_fit(seed):
    rng = np.random.default_rng(seed)
    overlap, scores = rng.random((5, 4)), rng.random(5)
    found = match_one_to_one(overlap, scores, 0.5)
    taken = found[found >= 0]
    assert len(set(taken)) == len(taken)
    assert all(overlap[row, truth] >= 0.5 for row, truth in enumerate(found) if truth >= 0)
    free = np.setdiff1d(np.arange(4), taken)
    assert (overlap[np.ix_(found < 0, free)] < 0.5).all()


def test_overlaps_by_hand():
    a = [box(), box(yaw=np.pi / 2), box(x=2.0), box(x=9.0), box(z=0.75)]
    np.testing.assert_allclose(rotated_iou_bev(a, [box()])[:, 0], [1, 4 / 12, 4 / 12, 0, 1], atol=1e-12)
    np.testing.assert_allclose(iou_3d(a, [box()])[:, 0], [1, 4 / 12, 4 / 12, 0, 1 / 3], atol=1e-12)
    np.testing.assert_allclose(covered_bev(a, [box(width=1.0)])[:, 0], [0.5, 0.25, 0.25, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(gaps_bev(a, [box()])[:, 0], [0, 0, 0, 5, 0], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_overlap_is_symmetric_and_does_not_change_when_both_move(seed):
    rng = np.random.default_rng(seed)
    boxes = np.column_stack([rng.normal(0, 2, (4, 3)), rng.uniform(1, 5, (4, 3)), rng.uniform(-4, 4, 4)])
    iou = rotated_iou_bev(boxes, boxes)
    np.testing.assert_allclose(iou, iou.T, atol=1e-9)
    np.testing.assert_allclose(np.diag(iou), 1.0, atol=1e-9)
    turned = boxes.copy()
    c, s = np.cos(0.7), np.sin(0.7)
    turned[:, :2] = boxes[:, :2] @ np.array([[c, s], [-s, c]]) + [30.0, -4.0]
    turned[:, 6] += 0.7
    np.testing.assert_allclose(rotated_iou_bev(turned, turned), iou, atol=1e-9)


def test_overlap_agrees_with_counted_points():
    rng = np.random.default_rng(1)
    a, b = np.array([box(yaw=0.4)]), np.array([box(x=0.8, y=0.5, yaw=-0.3)])
    where = rng.uniform(-4, 4, (200_000, 2))
    in_a, in_b = in_boxes_bev(where, a)[:, 0], in_boxes_bev(where, b)[:, 0]
    assert rotated_iou_bev(a, b)[0, 0] == pytest.approx((in_a & in_b).sum() / (in_a | in_b).sum(), abs=0.01)


def test_no_boxes_no_overlaps():
    none = np.zeros((0, 7))
    for overlap in (rotated_iou_bev, iou_3d, covered_bev, gaps_bev):
        assert overlap(none, [box()]).shape == (0, 1)
        assert overlap([box()], none).shape == (1, 0)


def test_buckets_by_hand():
    buckets = Buckets.empty(3, np.array([0.0, 0.05, 1.0, np.inf]))
    kind, speed = np.array([0, 0, 1, 1, 1]), np.array([0.0, 0.01, 0.5, 0.05, 2.0])
    buckets.add(kind[:3], np.array([0.1, 0.3, 0.5]), speed[:3])
    buckets.add(kind[3:], np.array([0.6, 1.0]), speed[3:])
    np.testing.assert_allclose(buckets.mean_error(), [[0.2, np.nan, np.nan], [np.nan, 0.55, 1.0], [np.nan] * 3])
    expected = [[0.2, np.nan], [np.nan, (0.55 / 0.275 + 0.5) / 2], [np.nan, np.nan]]
    np.testing.assert_allclose(buckets.static_and_dynamic(), expected)


@pytest.mark.skipif(
    importlib.util.find_spec("bucketed_scene_flow_eval") is None,
    reason="bucketed-scene-flow-eval is not installed (it pulls in open3d and opencv): pip install it",
)
def test_three_way_and_bucketed_errors_agree_with_bucketed_scene_flow_eval(tmp_path):
    from bucketed_scene_flow_eval import datastructures as ds
    from bucketed_scene_flow_eval.eval import BucketedEPEEvaluator, ThreeWayEPEEvaluator

    rng = np.random.default_rng(0)
    names = {0: "BACKGROUND", 1: "CAR", 2: "PEDESTRIAN", 3: "WHEELED_VRU"}
    ours, three = Buckets.empty(4), Buckets.empty(2, np.array([0.0, 0.05, np.inf]))
    theirs = BucketedEPEEvaluator(names, output_path=tmp_path / "bucketed")
    groups = {"BACKGROUND": ["BACKGROUND"], "FOREGROUND": ["CAR", "PEDESTRIAN", "WHEELED_VRU"]}
    theirs_three = ThreeWayEPEEvaluator(names, groups, output_path=tmp_path / "three")
    for frame in range(3):
        xyz = rng.uniform(-50, 50, (4000, 3))
        kind = rng.choice(3, 4000, p=[0.7, 0.2, 0.1]) if frame else rng.choice(4, 4000)
        speed = np.where(rng.random(4000) < 0.4, 0.0, rng.gamma(1.5, 0.5, 4000)) * (kind > 0)
        flow = speed[:, None] * np.array([0.6, 0.8, 0.0])
        predicted = flow + rng.normal(0, 0.1, (4000, 3)) * (1 + speed[:, None])
        error, length = end_point_error(predicted, flow), np.linalg.norm(flow, axis=1)
        near = np.abs(xyz[:, :2]).max(axis=1) < 35
        ours.add(kind[near], error[near], length[near])
        three.add((kind[near] > 0).astype(np.int64), error[near], length[near])
        everything = np.ones(4000, bool)
        cloud = ds.SupervisedPointCloudFrame(
            ds.PointCloud(xyz), ds.PoseInfo.identity(), everything, kind.astype(ds.SemanticClassId)
        )
        truth = ds.TimeSyncedSceneFlowFrame(
            pc=cloud, auxillary_pc=None, rgbs=None, log_id="a", log_idx=frame, log_timestamp=frame,
            flow=ds.EgoLidarFlow(flow, everything),
        )  # fmt: skip
        for evaluator in (theirs, theirs_three):
            evaluator.eval(ds.EgoLidarFlow(predicted, everything), truth)

    found = theirs.compute_results(save_results=False)
    np.testing.assert_allclose(ours.static_and_dynamic(), [found[name] for name in names.values()], rtol=1e-9)
    found = theirs_three.compute_results(save_results=False)
    print(found)
    np.testing.assert_allclose(three.mean_error()[1], found["FOREGROUND"], rtol=1e-9)
    np.testing.assert_allclose(three.mean_error()[0, 0], found["BACKGROUND"][0], rtol=1e-9)
