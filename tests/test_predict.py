"""A network's answer as predictions of pairs and of files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scored_pair import SETTINGS, a_run, an_object, make_pair

from augkitti.errors import InputError
from augkitti.frames import pose_from_xyz_yaw, transform_points
from training import predict as module
from training.detection import anchors, encode
from training.network import Output
from training.point_files import Points
from training.predict import (
    UNSURE,
    Predictor,
    limits_of,
    points_in_boxes,
    predict_files,
    predict_pairs,
    sample_of_scans,
)
from training.rigid_motion import world_to_local
from training.sample import sample_of
from training.team import Team
from training.voxelize import FEWEST_POINTS, column_centres, column_of_points

TEAM = Team(0, 1, torch.device("cpu"), False)
EGO = np.array([-1.0, 0.1, 0.02])
CAR = np.array([1.5, -0.2, 0.1])


class Oracle(torch.nn.Module):
    """Says one flow for all, the car's motion near the car and the ego-motion elsewhere, and the boxes it is given."""

    def __init__(self, boxes=(), logits=(), near=(10.0, 0.0)):
        super().__init__()
        self.boxes, self.logits, self.near = boxes, logits, np.array(near)

    def forward(self, voxels0, voxels1, batch, columns):
        centres = column_centres(columns.numpy(), SETTINGS.grid).astype(np.float64)
        on_car = np.hypot(*(centres - self.near).T) < 5.0
        motion = world_to_local(np.where(on_car[:, None], CAR, EGO), centres)
        at = anchors(SETTINGS)
        scores = torch.full((batch, *at.shape[:3]), -20.0)
        residuals = torch.zeros((batch, at.shape[0], 7, *at.shape[1:3]))
        for box, logit in zip(self.boxes, self.logits, strict=True):
            a, x, y = np.unravel_index(np.hypot(*np.moveaxis(at[..., :2] - box[:2], -1, 0)).argmin(), at.shape[:3])
            scores[:, a, x, y] = logit
            residuals[:, a, :, x, y] = torch.from_numpy(encode(box, at[a, x, y])).float()
        return Output(
            columns=columns,
            flow_columns=torch.tensor([[0.5, 0.25, -0.125]]).expand(len(columns), 3),
            motion_columns=torch.from_numpy(motion).float(),
            ego=torch.from_numpy(EGO).float().expand(batch, 3),
            scores=scores,
            residuals=residuals,
        )


def planar_flow(motion, xyz):
    return transform_points(pose_from_xyz_yaw(motion[0], motion[1], 0.0, motion[2]), xyz) - xyz


@pytest.fixture(scope="module")
def pair():
    return make_pair([an_object(10, 0), an_object(40, 0)], points=[60, 10])


def test_flow_comes_three_ways(pair):
    box = np.array([10.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0])
    one = Predictor(Oracle([box], [3.0]), SETTINGS, TEAM)(pair)
    assert list(one.flows) == ["direct", "dense", "object"]
    np.testing.assert_array_equal(one.where, column_of_points(pair.scan0.xyz, SETTINGS.grid) >= 0)
    assert 0 < one.where.sum() < len(one.where)
    xyz = pair.scan0.xyz[one.where].astype(np.float64)
    np.testing.assert_allclose(one.flows["direct"][one.where], np.broadcast_to([0.5, 0.25, -0.125], xyz.shape))
    in_box = pair.scan0.instance[one.where] == 0
    for name in ("dense", "object"):
        flow = one.flows[name][one.where]
        np.testing.assert_allclose(flow[in_box], planar_flow(CAR, xyz[in_box]), atol=1e-4)
        far = np.hypot(xyz[:, 0] - 10.0, xyz[:, 1]) > 6.0
        np.testing.assert_allclose(flow[far], planar_flow(EGO, xyz[far]), atol=1e-4)


def test_motions_of_boxes_and_ego_motion_are_matrices_in_the_scanners_frames(pair):
    box = np.array([10.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.3])
    one = Predictor(Oracle([box], [3.0]), SETTINGS, TEAM)(pair)
    np.testing.assert_allclose(one.ego_motion, pose_from_xyz_yaw(EGO[0], EGO[1], 0.0, EGO[2]), atol=1e-6)
    np.testing.assert_allclose(one.motions, pose_from_xyz_yaw(CAR[0], CAR[1], 0.0, CAR[2])[None], atol=1e-4)
    np.testing.assert_allclose(one.boxes, box[None], atol=1e-5)
    assert one.scores == pytest.approx([1 / (1 + np.exp(-3.0))])


def test_unsure_boxes_are_kept_for_average_precision_but_move_nothing(pair):
    unsure, none = np.array([10.0, 0, -1, 4, 2, 1.5, 0]), np.array([20.0, -8, -1, 4, 2, 1.5, 0])
    logit = np.log(UNSURE) - 0.1
    one = Predictor(Oracle([unsure, none], [-1.0, logit]), SETTINGS, TEAM)(pair)
    np.testing.assert_allclose(one.boxes[:, :2], [[10, 0]], atol=1e-5)
    assert one.scores[0] < SETTINGS.detection.score
    xyz = pair.scan0.xyz[one.where].astype(np.float64)
    np.testing.assert_allclose(one.flows["object"][one.where], planar_flow(EGO, xyz), atol=1e-4)


def test_a_box_that_holds_hardly_a_point_is_no_car_however_sure(pair):
    empty, held = np.array([25.0, 8, -1, 4, 2, 1.5, 0]), np.array([10.0, 0, -1, 4, 2, 1.5, 0])
    one = Predictor(Oracle([empty, held], [5.0, 1.0]), SETTINGS, TEAM)(pair)
    np.testing.assert_allclose(one.boxes, held[None], atol=1e-5)
    counts = points_in_boxes(pair.scan0.xyz, np.stack([empty, held]))
    assert counts[0] == 0
    assert counts[1] >= FEWEST_POINTS


def test_of_boxes_that_overlap_the_surer_stays(pair):
    box = np.array([10.0, 0, -1, 4, 2, 1.5, 0])
    other = box + [2.0, 0, 0, 0, 0, 0, 0]
    one = Predictor(Oracle([box, other], [0.2, 2.0]), SETTINGS, TEAM)(pair)
    np.testing.assert_allclose(one.boxes, other[None], atol=1e-5)


def test_labels_are_not_looked_at(tmp_path, pair):
    predictor = Predictor(a_run(tmp_path), SETTINGS, TEAM)
    scan = replace(pair.scan0, instance=np.full(len(pair.scan0), -1, np.int16))
    blind = replace(pair, objects=(), scan0=scan, scan1=scan)
    blind = replace(blind, flow0=np.zeros_like(pair.flow0), flow_status0=np.ones_like(pair.flow_status0))
    one, other = predict_pairs(predictor, [pair, blind])
    for name in one.flows:
        np.testing.assert_array_equal(one.flows[name], other.flows[name])
    np.testing.assert_array_equal(one.boxes, other.boxes)
    for part in ("ego_motion", "motions", "columns", "column_motions"):
        np.testing.assert_array_equal(getattr(one, part), getattr(other, part))


def test_several_pairs_at_once_are_as_each_alone(tmp_path, pair):
    predictor = Predictor(a_run(tmp_path), SETTINGS, TEAM)
    other = make_pair([an_object(12, 4)], name="b/0/0")
    both = predictor.of_samples([sample_of(pair), sample_of(other)])
    for one, alone in zip(both, (predictor(pair), predictor(other)), strict=True):
        assert one.pair_id == alone.pair_id
        for name in one.flows:
            np.testing.assert_allclose(one.flows[name], alone.flows[name], atol=1e-4)


def test_a_network_that_went_astray_is_told(tmp_path, pair):
    network = a_run(tmp_path)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(InputError, match="a/0/0: the network's answer is not finite"):
        Predictor(network, SETTINGS, TEAM)(pair)


def test_a_scan_without_a_point_in_the_grid_is_told():
    away = Points(np.full((4, 3), -50.0, np.float32), np.zeros(4, np.float32), np.arange(4))
    near = Points(np.full((4, 3), 0.5, np.float32), np.zeros(4, np.float32), np.arange(4))
    for scans, number in (((away, near), 0), ((near, away), 1)):
        with pytest.raises(InputError, match=f"one, scan {number}: none of its 4 points lies in the grid"):
            Predictor(Oracle(), SETTINGS, TEAM).of_samples([sample_of_scans("one", *scans)])


@pytest.fixture(scope="module")
def files(tmp_path_factory, pair):
    folder = tmp_path_factory.mktemp("files")
    rows = np.column_stack([pair.scan0.xyz, pair.scan0.reflectance]).astype("<f4")
    rows = np.concatenate([np.zeros((1, 4), "<f4"), rows])
    rows.tofile(folder / "0.bin")
    np.save(folder / "1.npy", rows[1:, :3])
    a_run(folder / "run")
    return folder


def test_two_files_give_the_arrays_and_the_picture(files, pair, capsys):
    out, picture = files / "flow.npz", files / "flow.png"
    predict_files(files / "0.bin", files / "1.npy", out, files / "run", picture)
    said = capsys.readouterr().out
    assert "of the voxels of scan 0 are empty" in said
    assert picture.read_bytes().startswith(b"\x89PNG")
    n = len(pair.scan0)
    with np.load(out) as found:
        assert found["xyz0"].shape == found["flow0"].shape == found["flow0_dense"].shape == (n, 3)
        np.testing.assert_array_equal(found["xyz0"], pair.scan0.xyz)
        np.testing.assert_array_equal(found["row0"], np.arange(1, n + 1))
        assert found["ego_motion"].shape == (4, 4)
        k = len(found["scores"])
        assert found["boxes"].shape == (k, 7)
        assert found["motions"].shape == (k, 4, 4)
        assert (found["scores"] >= SETTINGS.detection.score).all()
        outside = ~found["in_grid0"]
        assert 0 < outside.sum() < n
        still = transform_points(found["ego_motion"], found["xyz0"]) - found["xyz0"]
        for name in ("flow0", "flow0_dense", "flow0_object"):
            np.testing.assert_allclose(found[name][outside], still[outside], atol=1e-5)
            assert np.isfinite(found[name]).all()


def test_without_a_run_the_shipped_checkpoint_predicts(files, monkeypatch):
    monkeypatch.setattr(module, "shipped_checkpoint", lambda: files / "run" / "checkpoint.pt")
    one = predict_files(files / "0.bin", files / "1.npy", files / "a.npz")
    other = predict_files(files / "0.bin", files / "1.npy", files / "b.npz", files / "run")
    np.testing.assert_array_equal(one.flows["direct"], other.flows["direct"])


@pytest.mark.kitti
@pytest.mark.parametrize("kind", ["raw", "odometry"])
def test_real_scans_without_labels_are_predicted(kind, kitti_root, tmp_path):
    pattern = {"raw": "raw/*/*/velodyne_points/data/*.bin", "odometry": "odometry/sequences/04/velodyne/*.bin"}[kind]
    first, second = sorted(kitti_root.glob(pattern))[:2]
    a_run(tmp_path)
    one = predict_files(first, second, tmp_path / "flow.npz", tmp_path)
    assert one.where.sum() > 10_000
    with np.load(tmp_path / "flow.npz") as found:
        assert len(found["xyz0"]) == len(found["flow0"]) > 100_000
        assert np.isfinite(found["flow0"]).all()


def test_limits_of_the_picture_are_those_of_the_grid():
    assert limits_of(SETTINGS.grid) == (0.0, 32.0, -16.0, 16.0)
