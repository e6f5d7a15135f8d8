"""Features to matches, matches to motions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from matched_scene import BOX, EGO, corner_and_box

from augkitti.frames import pose_from_xyz_yaw, transform_points
from training.baselines.followed import true_boxes
from training.baselines.matching import (
    Agreement,
    Keypoints,
    best_within,
    by_agreement,
    by_points,
    mutual_within,
    nearest_features,
    one_a_voxel,
    upright_fit,
)
from training.metrics import rotation_error, translation_error

seeds = st.integers(0, 2**32)


def drawn(seed, count0=30, count1=40, bins=5):
    rng = np.random.default_rng(seed)
    return (
        rng.uniform(-5, 5, (count0, 3)),
        rng.normal(size=(count0, bins)),
        rng.uniform(-5, 5, (count1, 3)),
        rng.normal(size=(count1, bins)),
    )


def distances(feature0, feature1):
    return np.linalg.norm(feature0[:, None] - feature1[None], axis=2)


@given(seeds, st.integers(0, 40), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_nearest_features_are_those_of_all_distances(seed, count0, count1):
    _, feature0, _, feature1 = drawn(seed, count0, count1)
    expected = distances(feature0, feature1).argmin(axis=1)
    np.testing.assert_array_equal(nearest_features(feature0, feature1), expected)


@given(seeds, st.floats(0.5, 20.0))
@settings(max_examples=30, deadline=None)
def test_matches_within_a_window_are_mutual_and_within_it(seed, window):
    xyz0, feature0, xyz1, feature1 = drawn(seed)
    apart = distances(feature0, feature1)
    apart[np.linalg.norm(xyz0[:, None] - xyz1[None], axis=2) > window] = np.inf
    expected = [
        (k, int(row.argmin()))
        for k, row in enumerate(apart)
        if np.isfinite(row.min()) and apart[:, row.argmin()].argmin() == k
    ]
    i, j = mutual_within(xyz0, feature0, xyz1, feature1, window)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


@given(seeds, st.integers(1, 10))
@settings(max_examples=30, deadline=None)
def test_the_best_within_a_window_are_the_nearest_features(seed, most):
    xyz0, feature0, xyz1, feature1 = drawn(seed)
    apart = distances(feature0, feature1)
    apart[np.linalg.norm(xyz0[:, None] - xyz1[None], axis=2) > 6.0] = np.inf
    i, j = best_within(xyz0, feature0, xyz1, feature1, 6.0, most)
    for k, row in enumerate(apart):
        found = j[i == k]
        assert len(found) == min(most, np.isfinite(row).sum())
        assert sorted(found) == sorted(np.argsort(row)[: len(found)])


def test_nothing_matches_an_empty_scan():
    xyz0, feature0, xyz1, feature1 = drawn(0)
    for first, second in ((0, 40), (30, 0), (0, 0)):
        i, j = mutual_within(xyz0[:first], feature0[:first], xyz1[:second], feature1[:second], 3.0)
        assert len(i) == len(j) == 0


@given(seeds, st.floats(-0.19, 0.19))
@settings(max_examples=30, deadline=None)
def test_an_upright_motion_is_found_exactly(seed, turn):
    xyz0, *_ = drawn(seed)
    motion = pose_from_xyz_yaw(1.0, -2.0, 0.3, turn)
    np.testing.assert_allclose(upright_fit(xyz0, transform_points(motion, xyz0), 0.2), motion, atol=1e-9)


def test_a_turn_smaller_than_its_uncertainty_is_none():
    rng = np.random.default_rng(0)
    xyz0 = rng.uniform(-1.0, 1.0, (6, 3))
    found = upright_fit(xyz0, xyz0 + rng.normal(0.0, 0.3, xyz0.shape), 0.2)
    np.testing.assert_array_equal(found[:3, :3], np.eye(3))


def test_one_point_of_each_voxel_is_kept():
    xyz = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.6, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    np.testing.assert_array_equal(one_a_voxel(xyz, 0.5, np.arange(4)), [0, 2, 3])
    np.testing.assert_array_equal(one_a_voxel(xyz, 0.5, np.array([1, 3])), [1, 3])


def told_apart(pair, seed=0):
    """Keypoints at all points, each with a feature of its own."""
    feature = np.random.default_rng(seed).normal(size=(len(pair.scan0), 16))
    return tuple(Keypoints(scan.xyz.astype(float), feature) for scan in (pair.scan0, pair.scan1))


def test_true_matches_give_the_motions_exactly_either_way():
    pair, motion = corner_and_box()
    for said in (
        by_points("m", pair, true_boxes(pair), *told_apart(pair)),
        by_agreement("m", pair, true_boxes(pair), *told_apart(pair), Agreement()),
    ):
        np.testing.assert_allclose(said.ego_motion, EGO, atol=1e-5)
        np.testing.assert_allclose(said.motions[0], motion, atol=1e-5)
        np.testing.assert_allclose(said.flows["m"], pair.flow0, atol=1e-4)


def test_agreement_bears_that_six_matches_of_ten_are_wrong():
    pair, motion = corner_and_box()
    first, second = told_apart(pair)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(first.xyz)) < 0.6
    first.feature[wrong] = rng.normal(size=(wrong.sum(), 16))
    said = by_agreement("m", pair, true_boxes(pair), first, second, Agreement())
    assert translation_error(said.ego_motion, EGO) < 0.03
    assert translation_error(said.motions[0], motion, BOX[:3]) < 0.1
    assert rotation_error(said.motions[0], motion) < 0.07
