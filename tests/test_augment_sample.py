from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.frames import box_pose, compose, footprint_corners, footprints_overlap, invert, is_rigid, transform_points
from tests import hand_made_pair, pair_factory
from training.augment_sample import augment_sample, flip, move_objects, move_observer, scale, turn
from training.config import TrainConfig
from training.sample import Sample, is_labelled, sample_of

WILD = TrainConfig(
    rotation_rad=3.0, scale=0.4, box_rotation_rad=0.8, box_shift_m=1.5, ego_shift_m=0.5, ego_turn_rad=0.05
)
STILL = TrainConfig(rotation_rad=0.0, scale=0.0, flip=False, box_rotation_rad=0.0, box_shift_m=0.0)
MADE = [sample_of(hand_made_pair.make_pair()[0]), sample_of(pair_factory.make_pair(tick_step=8).pair)]
samples = st.sampled_from(MADE)
seeds = st.integers(0, 2**32)
angles = st.floats(-3.2, 3.2)
factors = st.floats(0.6, 1.6)


@pytest.fixture(autouse=True, scope="module")
def read_only_arrays():
    """Nothing may change what came in."""
    for sample in MADE:
        for field in fields(sample):
            if isinstance(getattr(sample, field.name), np.ndarray):
                getattr(sample, field.name).flags.writeable = False


def wild(sample: Sample, seed: int) -> Sample:
    return augment_sample(sample, WILD, np.random.default_rng(seed))


def moved(sample: Sample, seed: int, size: float = 1.0) -> Sample:
    rng = np.random.default_rng(seed)
    count = len(sample.boxes0)
    return move_objects(sample, 0.5 * size * rng.standard_normal(count), size * rng.standard_normal((count, 2)))


def own_motion(sample: Sample) -> np.ndarray:
    """The motion (N0, 4, 4) of each point of scan 0."""
    return np.concatenate([sample.motion, sample.ego_motion[None]])[sample.instance0]


def in_its_box(sample: Sample, k: int) -> np.ndarray:
    """The points of all objects with a known motion, in their box's own axes, as parts of its size."""
    out = []
    for row in np.flatnonzero(sample.has_motion):
        xyz = (sample.xyz0, sample.xyz1)[k][(sample.instance0, sample.instance1)[k] == row]
        T_velo_box = compose(sample.motion[row] if k else np.eye(4), box_pose(sample.boxes0[row]))
        out.append(transform_points(invert(T_velo_box), xyz) / sample.boxes0[row, 3:6])
    return np.concatenate(out)


def same(a: Sample, b: Sample, atol: float = 0.0) -> None:
    for field in fields(a):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if (isinstance(one, np.ndarray) and one.dtype.kind == "f") or (
            field.name == "label_azimuth" and one is not None
        ):
            np.testing.assert_allclose(one, other, rtol=0, atol=atol, err_msg=field.name)
        elif isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)
        else:
            assert one == other, field.name


@given(samples, seeds)
@settings(max_examples=40, deadline=None)
def test_flow_is_what_the_motions_say(sample, seed):
    new = wild(sample, seed)
    xyz = new.xyz0.astype(np.float64)
    expected = transform_points(own_motion(new), xyz) - xyz
    known = ~new.status0
    assert np.abs(new.flow0[known] - expected[known]).max() < 1e-4


@given(samples, seeds)
@settings(max_examples=20, deadline=None)
def test_points_of_unknown_flow_keep_that_of_the_static_world(sample, seed):
    new = wild(replace(sample, status0=np.arange(len(sample.xyz0)) % 3 == 0, flow0=all_static(sample)), seed)
    xyz = new.xyz0[new.status0].astype(np.float64)
    assert np.abs(new.flow0[new.status0] - (transform_points(new.ego_motion, xyz) - xyz)).max() < 1e-4


def all_static(sample: Sample) -> np.ndarray:
    xyz = sample.xyz0.astype(np.float64)
    return (transform_points(sample.ego_motion, xyz) - xyz).astype(np.float32)


@given(samples, seeds)
@settings(max_examples=40, deadline=None)
def test_motions_stay_rigid(sample, seed):
    new = wild(sample, seed)
    assert is_rigid(new.ego_motion)
    assert all(is_rigid(motion) for motion in new.motion)


@given(samples, seeds, st.sampled_from([0, 1]))
@settings(max_examples=40, deadline=None)
def test_boxes_hold_their_points_as_before_in_both_scans(sample, seed, k):
    before, after = in_its_box(sample, k), in_its_box(wild(sample, seed), k)
    assert len(before)
    # a mirror exchanges the sides; boxes are turned by their yaw alone, motions may tilt them a little
    np.testing.assert_allclose(np.abs(after), np.abs(before), rtol=0, atol=2e-3)


@given(samples, seeds)
@settings(max_examples=20, deadline=None)
def test_static_points_keep_their_distances_but_for_one_factor(sample, seed):
    new = wild(sample, seed)
    for k in (0, 1):
        static = np.flatnonzero((sample.instance0, sample.instance1)[k] < 0)[:200]
        old_xyz, new_xyz = ((s.xyz0, s.xyz1)[k][static].astype(np.float64) for s in (sample, new))
        old = np.linalg.norm(old_xyz[1:] - old_xyz[:-1], axis=1)
        ratio = np.linalg.norm(new_xyz[1:] - new_xyz[:-1], axis=1)[old > 1.0] / old[old > 1.0]
        assert np.ptp(ratio) < 1e-4
        assert 0.6 - 1e-4 <= ratio.mean() <= 1.4 + 1e-4


@given(samples, factors)
@settings(max_examples=20, deadline=None)
def test_scale_scales_all_translations_and_no_rotation(sample, factor):
    new = scale(sample, factor)
    np.testing.assert_allclose(new.ego_motion[:3, 3], factor * sample.ego_motion[:3, 3], atol=1e-12)
    np.testing.assert_allclose(new.motion[:, :3, 3], factor * sample.motion[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(new.motion[:, :3, :3], sample.motion[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(new.boxes0[:, 3:6], factor * sample.boxes0[:, 3:6])


@given(samples)
@settings(max_examples=2, deadline=None)
def test_flip_twice_is_the_scene_bit_for_bit(sample):
    same(flip(flip(sample)), sample)


@given(samples, angles, factors)
@settings(max_examples=20, deadline=None)
def test_turn_and_scale_undo_themselves(sample, angle, factor):
    new = scale(turn(scale(turn(sample, angle), factor), -angle), 1 / factor)
    new.boxes0[:, 6] += np.round((sample.boxes0[:, 6] - new.boxes0[:, 6]) / (2 * np.pi)) * 2 * np.pi
    same(new, sample, atol=1e-4)


@given(samples, angles)
@settings(max_examples=20, deadline=None)
def test_flip_turns_the_other_way(sample, angle):
    a, b = flip(turn(sample, angle)), turn(flip(sample), -angle)
    a.boxes0[:, 6] += np.round((b.boxes0[:, 6] - a.boxes0[:, 6]) / (2 * np.pi)) * 2 * np.pi
    same(a, b, atol=1e-4)


def test_a_flipped_left_curve_is_a_right_curve():
    sample = MADE[0]
    assert flip(sample).ego_motion[1, 0] == -sample.ego_motion[1, 0] != 0
    assert flip(sample).boxes0[0, 1] == -sample.boxes0[0, 1]


@given(samples, seeds)
@settings(max_examples=40, deadline=None)
def test_the_same_points_stay_in_the_reach_of_labels(sample, seed):
    sample = replace(sample, label_coverage="camera", label_azimuth=(-0.7, 0.6))
    azimuth = np.arctan2(sample.xyz0[:, 1], sample.xyz0[:, 0])
    static = (sample.instance0 < 0) & (np.abs(azimuth + 0.7) > 1e-3) & (np.abs(azimuth - 0.6) > 1e-3)
    new = wild(sample, seed)
    before, after = (is_labelled(s.xyz0[static, :2], s.label_coverage, s.label_azimuth) for s in (sample, new))
    np.testing.assert_array_equal(before, after)


@given(samples, seeds)
@settings(max_examples=40, deadline=None)
def test_a_moved_object_drives_as_before_along_its_new_heading(sample, seed):
    new = moved(sample, seed)
    for row in np.flatnonzero(sample.has_motion):
        old, now = (
            compose(
                compose(invert(box_pose(s.boxes0[row])), compose(invert(s.ego_motion), s.motion[row])),
                box_pose(s.boxes0[row]),
            )
            for s in (sample, new)
        )
        np.testing.assert_allclose(now, old, atol=1e-9)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_a_standing_object_stands_wherever_it_is_moved(seed):
    sample = replace(MADE[0], motion=np.repeat(MADE[0].ego_motion[None], len(MADE[0].boxes0), axis=0))
    np.testing.assert_allclose(moved(sample, seed).motion, sample.motion, atol=1e-9)


@given(samples, seeds)
@settings(max_examples=40, deadline=None)
def test_moved_objects_touch_no_other_and_only_they_move(sample, seed):
    new = moved(sample, seed, 3.0)
    changed = np.flatnonzero((new.boxes0 != sample.boxes0).any(axis=1))
    assert sample.has_motion[changed].all()
    corners = [footprint_corners(box) for box in new.boxes0]
    assert not any(footprints_overlap(corners[i], corners[j]) for i in changed for j in range(len(corners)) if i != j)
    for old_xyz, new_xyz, instance in (
        (sample.xyz0, new.xyz0, sample.instance0),
        (sample.xyz1, new.xyz1, sample.instance1),
    ):
        still = ~np.isin(instance, changed)
        np.testing.assert_array_equal(old_xyz[still], new_xyz[still])


@given(samples, st.floats(-0.2, 0.2), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
@settings(max_examples=30, deadline=None)
def test_a_moved_observer_sees_the_same_world_from_elsewhere(sample, turn_rad, x_m, y_m):
    new = move_observer(sample, turn_rad, np.array([x_m, y_m]))
    D = compose(new.ego_motion, invert(sample.ego_motion))
    np.testing.assert_allclose(D[:3, 3], [x_m, y_m, 0.0], atol=1e-9)
    assert np.arctan2(D[1, 0], D[0, 0]) == pytest.approx(turn_rad)
    np.testing.assert_allclose(new.xyz1, transform_points(D, sample.xyz1), atol=1e-4)
    for row in np.flatnonzero(sample.has_motion):  # as it moves in the world of scan 0, so it goes on
        old, now = (compose(invert(s.ego_motion), s.motion[row]) for s in (sample, new))
        np.testing.assert_allclose(now, old, atol=1e-9)
    for field in ("xyz0", "boxes0", "reflectance0", "reflectance1"):
        np.testing.assert_array_equal(getattr(new, field), getattr(sample, field))


def test_an_object_can_be_moved():
    new = move_objects(MADE[0], np.array([0.1, 0.0]), np.array([[0.5, 0.2], [0.0, 0.0]]))
    np.testing.assert_allclose(new.boxes0[0, [0, 1, 6]] - MADE[0].boxes0[0, [0, 1, 6]], [0.5, 0.2, 0.1])


def test_an_object_is_not_pushed_into_a_wall():
    new = move_objects(MADE[0], np.zeros(2), np.array([[0.0, 0.0], [0.0, 9.0]]))  # the wall stands at y = 14
    assert (new.boxes0[1] == MADE[0].boxes0[1]).all()


def test_an_object_is_not_pushed_into_another_or_into_the_ego_car():
    sample = MADE[0]
    onto = (sample.boxes0[1, :2] - sample.boxes0[0, :2] + 0.3)[None]
    for shift in (onto, -sample.boxes0[:1, :2]):
        new = move_objects(sample, np.zeros(2), np.concatenate([shift, np.zeros((1, 2))]))
        assert (new.boxes0 == sample.boxes0).all()


def test_without_any_change_asked_for_the_sample_stays():
    for sample in MADE:
        same(augment_sample(sample, STILL, np.random.default_rng(0)), sample)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_pairs_is_turned_by_up_to_a_right_angle(share):
    config = STILL.model_copy(update={"rotation_rad": 0.1, "wide_share": share})
    sample = replace(MADE[0], xyz0=MADE[0].xyz0[:50], xyz1=MADE[0].xyz1[:50], flow0=MADE[0].flow0[:50])
    turns = []
    for seed in range(200):
        heading = augment_sample(sample, config, np.random.default_rng(seed)).boxes0[0, 6]
        turns.append(abs(heading - sample.boxes0[0, 6]))
    assert max(turns) <= (0.5 * np.pi if share else 0.1) + 1e-9
    # of the widely turned ones, all but 0.1 of a right angle's share are turned by more than the others can be
    assert np.mean(np.array(turns) > 0.1) == pytest.approx(share * (1.0 - 0.1 / (0.5 * np.pi)), abs=0.1)


def test_the_same_draws_give_the_same_sample():
    same(wild(MADE[1], 5), wild(MADE[1], 5))
    assert (wild(MADE[1], 5).xyz0 != wild(MADE[1], 6).xyz0).any()


def test_a_pair_without_objects_is_augmented():
    none = np.empty(0)
    sample = replace(
        MADE[0],
        boxes0=none.reshape(0, 7),
        motion=none.reshape(0, 4, 4),
        has_motion=none.astype(bool),
        virtual=none.astype(bool),
        points0=none.astype(np.int64),
        category=(),
        instance0=np.full_like(MADE[0].instance0, -1),
        instance1=np.full_like(MADE[0].instance1, -1),
    )
    assert wild(sample, 1).boxes0.shape == (0, 7)
