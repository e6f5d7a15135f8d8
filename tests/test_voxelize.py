from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_made_pair import make_pair
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from augkitti.errors import InputError
from augkitti.frames import pose_from_xyz_yaw, transform_points
from training.config import GridConfig, NetworkConfig, Settings, load_settings
from training.detection import LEFT_OUT, NEGATIVE, POSITIVE, anchors
from training.sample import Sample, sample_of
from training.voxelize import (
    FEWEST_POINTS,
    anchor_targets,
    column_centres,
    column_of_points,
    column_targets,
    empty_share,
    is_labelled,
    make_batch,
    voxelize,
)

GRID = GridConfig(x_m=(0.0, 8.0), y_m=(-4.0, 4.0), z_m=(-2.0, 2.0), voxel_m=(1.0, 1.0, 0.5), max_points=4)
TINY = Settings(grid=GRID)
SMALL = load_settings("small")
EGO = pose_from_xyz_yaw(-1.2, 0.1, 0.02, 0.05)
CAR = pose_from_xyz_yaw(0.8, -0.3, 0.01, -0.2)
clouds = arrays(
    np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-5.0, 10.0, width=32), fill=st.nothing()
).map(lambda xyz: np.concatenate([xyz, np.float32([[0.5, 0.5, 0.25]])]))


def draws(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def cells_of(xyz: np.ndarray) -> list[tuple[int, ...] | None]:
    """The voxel of each point, or None, one by one."""
    cells = np.floor((xyz - np.float32([0.0, -4.0, -2.0])) / np.float32([1.0, 1.0, 0.5])).astype(int)
    return [tuple(cell) if ((cell >= 0) & (cell < GRID.shape)).all() else None for cell in cells]


def hand_made(xyz, instance, status=None, motions=(CAR,), has_motion=None) -> Sample:
    """A sample of one scan's points; flow is what the motions say."""
    xyz, instance = np.asarray(xyz, np.float32), np.asarray(instance, np.int64)
    stack = np.stack([*motions, EGO])
    count = len(motions)
    return Sample(
        pair_id="street/0/0",
        xyz0=xyz,
        reflectance0=np.zeros(len(xyz), np.float32),
        xyz1=xyz,
        reflectance1=np.zeros(len(xyz), np.float32),
        flow0=(transform_points(stack[instance], xyz) - xyz).astype(np.float32),
        status0=np.zeros(len(xyz), bool) if status is None else np.asarray(status, bool),
        instance0=instance,
        instance1=instance,
        ego_motion=EGO,
        boxes0=np.tile([4.0, 0.0, -1.0, 4.0, 1.8, 1.5, 0.0], (count, 1)),
        category=("Car",) * count,
        motion=stack[:-1],
        has_motion=np.ones(count, bool) if has_motion is None else np.asarray(has_motion),
        virtual=np.ones(count, bool),
        points0=np.full(count, 50),
        label_coverage="full",
        label_azimuth=None,
    )


@given(clouds, st.integers(0, 100))
@settings(max_examples=60, deadline=None)
def test_voxels_are_those_that_hold_points_each_once_and_in_order(xyz, seed):
    voxels = voxelize(xyz, np.zeros(len(xyz), np.float32), TINY, draws(seed))
    coords = [tuple(row) for row in voxels.coords.tolist()]
    assert coords == sorted({cell for cell in cells_of(xyz) if cell is not None})
    assert (np.diff(voxels.voxel.numpy()) >= 0).all()
    assert sorted(set(voxels.voxel.tolist())) == list(range(len(coords)))


@given(clouds, st.integers(0, 100))
@settings(max_examples=60, deadline=None)
def test_a_voxel_keeps_all_its_points_or_t_different_ones(xyz, seed):
    xyz[:, 0] += np.arange(len(xyz), dtype=np.float32) * 1e-5  # so that points can be told apart
    voxels = voxelize(xyz, np.zeros(len(xyz), np.float32), TINY, draws(seed))
    cells = cells_of(xyz)
    for number, coord in enumerate(voxels.coords.tolist()):
        own = {tuple(point) for point, cell in zip(xyz.tolist(), cells, strict=True) if cell == tuple(coord)}
        kept = [tuple(point) for point in voxels.points[voxels.voxel == number, :3].tolist()]
        assert len(kept) == len(set(kept)) == min(len(own), GRID.max_points)
        assert set(kept) <= own


@given(clouds)
@settings(max_examples=30, deadline=None)
def test_offsets_are_from_the_mean_of_the_voxels_points(xyz):
    voxels = voxelize(xyz, np.zeros(len(xyz), np.float32), TINY, draws())
    for number in range(len(voxels.coords)):
        points = voxels.points[voxels.voxel == number].numpy()
        np.testing.assert_allclose(points[:, -3:], points[:, :3] - points[:, :3].mean(axis=0), atol=1e-5)


def test_points_of_a_crowded_voxel_are_drawn_evenly():
    xyz = np.full((10, 3), 0.25, np.float32)
    xyz[:, 0] = np.linspace(0.1, 0.9, 10)
    rng = draws()
    taken = np.zeros(10)
    for _ in range(2000):
        points = voxelize(xyz, np.zeros(10, np.float32), TINY, rng).points
        taken[np.isin(xyz[:, 0], points[:, 0].numpy())] += 1
    assert np.abs(taken / 2000 - GRID.max_points / 10).max() < 0.05  # 4.6 standard deviations


def test_reflectance_is_an_input_only_where_asked_for():
    xyz, grey = np.float32([[1.5, 0.5, 0.0]]), np.float32([0.7])
    assert voxelize(xyz, grey, TINY, draws()).points.tolist() == [[1.5, 0.5, 0.0, 0.0, 0.0, 0.0]]
    with_it = TINY.model_copy(update={"network": NetworkConfig(reflectance=True)})
    np.testing.assert_array_equal(
        voxelize(xyz, grey, with_it, draws()).points, np.float32([[1.5, 0.5, 0.0, 0.7, 0.0, 0.0, 0.0]])
    )


@given(clouds)
@settings(max_examples=30, deadline=None)
def test_columns_of_points_are_those_of_their_voxels(xyz):
    expected = [-1 if cell is None else cell[0] * GRID.shape[1] + cell[1] for cell in cells_of(xyz)]
    assert column_of_points(xyz, GRID).tolist() == expected


def test_the_far_border_is_outside_the_near_one_inside():
    xyz = np.float32([[0, -4, -2], [8, 0, 0], [0, 4, 0], [0, 0, 2], [np.nextafter(np.float32(8), 0), 0, 0]])
    assert column_of_points(xyz, GRID).tolist() == [0, -1, -1, -1, 7 * 8 + 4]
    paper = load_settings("paper").grid
    edge = np.nextafter(np.float32(70.4), np.float32(0))
    columns = column_of_points(np.float32([[edge, 0, 0], [70.4, 0, 0]]), paper)
    assert (columns < 352 * 400).all()


def test_a_scan_without_a_point_in_the_grid_is_told_in_one_line():
    sample = hand_made([[1.0, 0.0, 0.0]], [-1])
    behind = replace(sample, xyz1=np.float32([[-5.0, 0.0, 0.0]]))
    with pytest.raises(InputError, match="street/0/0, scan 1: none of its 1 points lies in the grid") as error:
        make_batch([behind], TINY)
    assert "\n" not in str(error.value)
    assert "x 0 to 8 m" in str(error.value)
    with pytest.raises(InputError, match="none of its 0 points"):
        make_batch([replace(sample, xyz0=np.zeros((0, 3), np.float32), flow0=np.zeros((0, 3), np.float32))], TINY)


def test_share_of_empty_voxels():
    voxels = voxelize(np.float32([[0.5, 0, 0], [0.6, 0, 0], [5, 0, 0]]), np.zeros(3, np.float32), TINY, draws())
    assert empty_share(voxels, GRID) == 1 - 2 / (8 * 8 * 8)
    assert empty_share(voxels, GRID, scans=2) == 1 - 1 / (8 * 8 * 8)


def target(instance, status=None, **more):
    """Target of one column, whose points are those of `instance`."""
    xyz = draws(1).uniform([2.0, 1.0, -1.0], [3.0, 2.0, 1.0], (len(instance), 3))
    columns, *rest = column_targets(hand_made(xyz, instance, status, **more), GRID)
    assert columns.tolist() == [[2, 5]]
    return xyz, *(part[0] for part in rest)


@pytest.mark.parametrize(
    ("instance", "is_object"),
    [([-1, -1, -1, 0, 0], False), ([-1, -1, 0, 0, 0], True), ([-1, -1, 0, 0], True), ([-1], False), ([0], True)],
)
def test_a_column_is_that_bodys_with_most_points_ties_the_objects(instance, is_object):
    _, _, motion, known, found = target(instance)
    assert (known, found) == (True, is_object)
    assert motion[2] == pytest.approx(-0.2 if is_object else 0.05)


def test_of_two_objects_the_larger_part_counts():
    _, _, motion, _, _ = target([0, 1, 1, -1], motions=(CAR, pose_from_xyz_yaw(0, 0, 0, 0.3)))
    assert motion[2] == pytest.approx(0.3)


def test_only_known_points_vote_and_a_column_without_any_is_left_out():
    _, flow, motion, known, is_object = target([0, 0, 0], status=[1, 1, 1])
    assert not known
    assert not is_object
    assert not flow.any()
    assert not motion.any()
    _, _, motion, known, is_object = target([0, 0, 0, -1], status=[1, 1, 1, 0])
    assert known
    assert not is_object
    assert motion[2] == pytest.approx(0.05)


def test_points_of_an_object_without_a_motion_do_not_vote():
    assert not target([0, 0], has_motion=[False])[3]
    assert target([0, 0, -1], has_motion=[False])[2][2] == pytest.approx(0.05)


def test_a_columns_flow_is_the_mean_over_its_bodys_points():
    xyz, flow, _, _, _ = target([0, 0, -1])
    np.testing.assert_allclose(flow, (transform_points(CAR, xyz[:2]) - xyz[:2]).mean(axis=0), atol=1e-6)


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_local_motion_explains_the_flow_of_every_point_of_the_column(seed):
    rng = draws(seed)
    planar = pose_from_xyz_yaw(*rng.uniform(-3, 3, 2), 0.0, rng.uniform(-1, 1))
    xyz = rng.uniform([0, -4, -2], [8, 4, 2], (40, 3))
    sample = hand_made(xyz, np.zeros(40, int), motions=(planar,))
    columns, _, motion, _, _ = column_targets(sample, GRID)
    flat = column_of_points(sample.xyz0, GRID)
    for column, centre, (t_x, t_y, theta) in zip(columns, column_centres(columns, GRID), motion, strict=True):
        mine = flat == column[0] * GRID.shape[1] + column[1]
        q = sample.xyz0[mine, :2] - centre  # paper, Eq. 1: v = [R (p - o) + t] - (p - o)
        R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        np.testing.assert_allclose(q @ R.T + [t_x, t_y] - q, sample.flow0[mine, :2], atol=1e-5)


def test_a_columns_centre_lies_in_it():
    ix, iy = np.divmod(np.arange(64), 8)
    columns = np.stack([ix, iy], axis=1)
    centres = column_centres(columns, GRID)
    xyz = np.column_stack([centres, np.zeros(64)]).astype(np.float32)
    assert column_of_points(xyz, GRID).tolist() == list(range(64))
    with_sample = torch.from_numpy(np.column_stack([np.full(64, 3), columns]))
    np.testing.assert_allclose(column_centres(with_sample, GRID).numpy(), centres, atol=1e-6)


def test_occupied_columns_are_those_of_the_voxels_of_scan_0():
    batch = make_batch([sample_of(make_pair(k)[0]) for k in range(2)], SMALL)
    from_voxels = np.unique(batch.voxels0.coords[:, :3].numpy(), axis=0)
    np.testing.assert_array_equal(batch.targets.columns.numpy(), from_voxels)


def test_a_batch_is_its_samples_side_by_side():
    samples = [sample_of(make_pair(k)[0]) for k in range(3)]
    batch = make_batch(samples, SMALL)
    for number, sample in enumerate(samples):
        one = make_batch([sample], SMALL)
        for both, single in ((batch.voxels0, one.voxels0), (batch.voxels1, one.voxels1)):
            here = both.coords[:, 0] == number
            assert both.coords[here, 1:].equal(single.coords[:, 1:])
            points = here[both.voxel]
            assert both.points[points].equal(single.points)
            assert both.coords[both.voxel[points], 1:].equal(single.coords[single.voxel, 1:])
        here = batch.targets.columns[:, 0] == number
        for name in ("flow", "motion", "known", "is_object"):
            assert getattr(batch.targets, name)[here].equal(getattr(one.targets, name))
        assert batch.targets.ego[number].equal(one.targets.ego[0])
        assert batch.targets.anchor_labels[number].equal(one.targets.anchor_labels[0])
    assert [sample.pair_id for sample in batch.samples] == [sample.pair_id for sample in samples]


def test_types_and_shapes_of_a_batch():
    batch = make_batch([sample_of(make_pair()[0])] * 2, SMALL, training=True)
    targets = batch.targets
    count = len(targets.columns)
    assert targets.columns.shape == (count, 3)
    assert targets.flow.shape == targets.motion.shape == (count, 3)
    assert targets.ego.shape == (2, 3)
    assert targets.anchor_labels.shape == (2, 2, 44, 50)
    assert targets.anchor_residuals.shape == (2, 2, 7, 44, 50)
    kinds = {"columns": torch.int64, "known": torch.bool, "is_object": torch.bool, "anchor_labels": torch.int8}
    for name in ("columns", "flow", "motion", "known", "is_object", "ego", "anchor_labels", "anchor_residuals"):
        assert getattr(targets, name).dtype == kinds.get(name, torch.float32), name
    for voxels in (batch.voxels0, batch.voxels1):
        assert (voxels.points.dtype, voxels.voxel.dtype, voxels.coords.dtype) == (
            torch.float32,
            torch.int64,
            torch.int64,
        )
        assert voxels.coords.shape[1] == 4


def test_the_egos_target_is_its_part_in_the_plane():
    batch = make_batch([hand_made([[1.0, 0.0, 0.0]], [-1])], TINY)
    np.testing.assert_allclose(batch.targets.ego.numpy(), [[-1.2, 0.1, 0.05]], atol=1e-6)


def test_points_are_drawn_anew_in_training_only():
    crowd = hand_made(draws().uniform(0, 1, (500, 3)), np.full(500, -1))
    one, other = replace(crowd, draw=1), replace(crowd, draw=2)
    points = [make_batch([s], TINY, training=True).voxels0.points for s in (one, other, one)]
    assert not points[0].equal(points[1])
    assert points[0].equal(points[2])
    assert make_batch([one], TINY).voxels0.points.equal(make_batch([other], TINY).voxels0.points)
    assert not make_batch([one], TINY, draws(3), training=True).voxels0.points.equal(points[0])


def test_a_batch_moves_to_a_device_whole():
    batch = make_batch([sample_of(make_pair()[0])], SMALL).to("meta")
    assert batch.voxels0.points.device.type == batch.targets.flow.device.type == "meta"
    assert isinstance(batch.samples[0].xyz0, np.ndarray)


def test_scans_without_labels_make_a_batch_without_targets():
    batch = make_batch([sample_of(make_pair()[0])], SMALL, with_targets=False)
    assert batch.targets is None
    assert batch.to("cpu").targets is None


def labels_at(sample: Sample, x: float, y: float) -> np.ndarray:
    """Labels of both anchors of the cell at a place."""
    labels, _ = anchor_targets(sample, SMALL)
    apart = np.hypot(anchors(SMALL)[0, ..., 0] - x, anchors(SMALL)[0, ..., 1] - y)
    return labels[:, *np.unravel_index(apart.argmin(), apart.shape)]


def car_at(x: float, y: float, **changes) -> Sample:
    sample = hand_made([[1.0, 0.0, 0.0]], [-1])
    return replace(sample, boxes0=np.array([[x, y, -1.0, 3.9, 1.6, 1.56, 0.0]]), **changes)


def test_a_car_has_positive_anchors_and_the_street_negative_ones():
    assert labels_at(car_at(12.0, 3.0), 12.0, 3.0)[0] == POSITIVE
    assert (labels_at(car_at(12.0, 3.0), 12.0, -10.0) == NEGATIVE).all()


@pytest.mark.parametrize("changes", [{"category": ("Van",)}, {"points0": np.array([FEWEST_POINTS - 1])}])
def test_vans_and_cars_of_few_points_are_neither_found_nor_missed(changes):
    assert (labels_at(car_at(12.0, 3.0, **changes), 12.0, 3.0) == LEFT_OUT).all()
    assert (anchor_targets(car_at(12.0, 3.0, **changes), SMALL)[0] != POSITIVE).all()


def test_a_walker_is_street():
    assert (anchor_targets(car_at(12.0, 3.0, category=("Pedestrian",)), SMALL)[0] == NEGATIVE).all()


def test_where_labels_do_not_reach_only_a_car_that_is_there_counts():
    sample = car_at(12.0, 10.0, label_coverage="camera", label_azimuth=(-0.4, 0.4))  # at 0.69
    assert labels_at(sample, 12.0, 10.0)[0] == POSITIVE
    assert (labels_at(sample, 12.0, -10.0) == LEFT_OUT).all()
    assert (labels_at(sample, 12.0, 0.0) == NEGATIVE).all()
    assert NEGATIVE not in anchor_targets(replace(sample, label_coverage="none", label_azimuth=None), SMALL)[0]


def test_reach_of_labels_is_an_arc_that_may_pass_straight_behind():
    xy = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.1], [-1.0, -0.1], [0.0, -1.0]])
    assert is_labelled(xy, "camera", (-0.7, 0.7)).tolist() == [True, False, False, False, False]
    assert is_labelled(xy, "camera", (1.5, 3.5)).tolist() == [False, True, True, True, False]
    assert is_labelled(xy, "camera", (1.5, 3.5 - 2 * np.pi)).tolist() == [False, True, True, True, False]
    assert is_labelled(xy, "full", None).all()
    assert not is_labelled(xy, "none", None).any()
