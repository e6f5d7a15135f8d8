"""Prediction: a network and pairs, or two scan files, in; flow, cars, their motions and the ego-motion out.

Flow comes three ways (the paper's "Direct scene flow vs. object motion"): `direct` is the scene-flow decoder's; `dense`
follows each column's rigid motion, `object` the motion of the box that a point is in, and the ego-motion outside. The
last two are motions in the plane: their third component is 0.
"""

from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.special import expit

import augkitti
from augkitti.command_line import note
from augkitti.errors import InputError, MachineError
from augkitti.frames import F32, F64
from augkitti.scan_pair import I64, AugmentedPair, Bool
from augkitti.shards import replace_whole
from training import detection
from training.baselines import rigid_flow
from training.boxes import in_boxes_bev
from training.checkpoint import load_checkpoint, network_of, shipped_checkpoint
from training.config import GridConfig, Settings
from training.network import Output, PointFlowNet
from training.pictures import draw_flow
from training.point_files import Points, read_points
from training.predictions import Prediction
from training.rigid_motion import flow_of, local_to_world, matrix_of, pool_over_boxes
from training.sample import Sample, sample_of
from training.team import Precision, Team, team_of
from training.voxelize import FEWEST_POINTS, Batch, column_centres, column_of_points, empty_share, make_batch

UNSURE = 0.02  # detections above it are kept for average precision; those that are told have settings.detection.score


class Predictor:
    """A network on its device: pairs in, predictions out."""

    def __init__(self, network: PointFlowNet, settings: Settings, team: Team) -> None:
        self.network, self.settings = network.to(team.device).eval(), settings
        self.team = team.suited_to(settings.network)

    def __call__(self, pair: AugmentedPair) -> Prediction:
        """Of one pair of a data set."""
        return self.of_samples([sample_of(pair)])[0]

    def of_samples(self, samples: list[Sample]) -> list[Prediction]:
        """Of some samples at once.

        Raises:
            InputError: a scan has no point in the grid, or the network gives what is no number.
        """
        return self.of_batch(make_batch(samples, self.settings, with_targets=False))

    def of_batch(self, batch: Batch) -> list[Prediction]:
        """Of a batch, with or without targets; errors as `of_samples`."""
        parts = zip(batch.samples, self._parts(batch), strict=True)
        return [_prediction(sample, part, self.settings) for sample, part in parts]

    def _parts(self, batch: Batch) -> Iterator[dict[str, Any]]:
        count = len(batch.samples)
        columns0 = torch.unique(batch.voxels0.coords[:, :3], dim=0)  # occupied ones, sorted
        batch = batch.to(self.team.device)
        with torch.inference_mode(), self.team.precision():
            output: Output = self.network(batch.voxels0, batch.voxels1, count, columns0.to(self.team.device))
        number = output.columns[:, 0].cpu().numpy()
        arrays = {
            name: getattr(output, name).float().cpu().numpy()
            for name in ("flow_columns", "motion_columns", "ego", "scores", "residuals")
        }
        if not all(np.isfinite(values).all() for values in arrays.values()):
            where = ", ".join(sample.pair_id for sample in batch.samples)
            raise InputError(where, "the network's answer is not finite: its training went astray", "give another run")
        columns = output.columns[:, 1:].cpu().numpy()
        for k in range(count):
            mine = number == k
            yield {
                "columns": columns[mine],
                "flow": arrays["flow_columns"][mine],
                "motion": arrays["motion_columns"][mine],
                "ego": arrays["ego"][k],
                "scores": arrays["scores"][k],
                "residuals": arrays["residuals"][k],
            }


def _prediction(sample: Sample, part: dict[str, Any], settings: Settings) -> Prediction:
    """The network's word on one pair, point by point."""
    grid, xyz = settings.grid, sample.xyz0
    columns, motion = part["columns"], part["motion"].astype(np.float64)
    number = np.full(grid.shape[0] * grid.shape[1], -1, dtype=np.int64)
    number[columns[:, 0] * grid.shape[1] + columns[:, 1]] = np.arange(len(columns))
    of_point = column_of_points(xyz, grid)
    where = of_point >= 0
    row = number[of_point[where]]
    centres = column_centres(columns, grid).astype(np.float64)

    ego = part["ego"].astype(np.float64)
    boxes, scores = _detections(part["scores"], part["residuals"], settings)
    held = points_in_boxes(xyz[where], boxes) >= FEWEST_POINTS  # with fewer it is no example in training, either
    boxes, scores = boxes[held], scores[held]
    world = local_to_world(motion, centres)
    motions = pool_over_boxes(world, centres, boxes, otherwise=ego)
    direct, dense = np.zeros_like(xyz), np.zeros_like(xyz)
    direct[where] = part["flow"][row]
    dense[where, :2] = flow_of(motion[row], xyz[where, :2] - centres[row])
    return Prediction(
        pair_id=sample.pair_id,
        flows={
            "direct": direct,
            "dense": dense,
            "object": _object_flow(xyz, where, ego, boxes, scores, motions, settings.detection.score),
        },
        where=where,
        ego_motion=np.asarray(matrix_of(ego)),
        boxes=boxes,
        scores=scores,
        motions=np.asarray(matrix_of(motions)).reshape(-1, 4, 4),
        columns=columns.astype(np.int32),
        column_motions=part["motion"],
    )


def _detections(logits: F32, residuals: F32, settings: Settings) -> tuple[F64, F64]:
    """Boxes (n, 7) and scores (n,) that are left of all anchors, unsure ones too, surest first."""
    scores = expit(logits.astype(np.float64))
    likely = scores >= UNSURE
    boxes = detection.decode(
        np.moveaxis(residuals, 1, -1)[likely].astype(np.float64), detection.anchors(settings)[likely]
    )
    unsure = settings.detection.model_copy(update={"score": UNSURE})
    kept = detection.nms(boxes, scores[likely], settings.model_copy(update={"detection": unsure}))
    return boxes[kept], scores[likely][kept]


def points_in_boxes(xyz: F32, boxes: F64) -> I64:
    """How many of the points (N, 3) each box (n, 7) holds."""
    counts = np.zeros(len(boxes), dtype=np.int64)
    for k, box in enumerate(boxes):
        reach = np.hypot(box[3], box[4]) / 2
        near = xyz[(np.abs(xyz[:, 0] - box[0]) <= reach) & (np.abs(xyz[:, 2] - box[2]) <= box[5] / 2)]
        counts[k] = in_boxes_bev(near.astype(np.float64), boxes[k : k + 1]).sum()
    return counts


def _object_flow(xyz: F32, where: Bool, ego: F64, boxes: F64, scores: F64, motions: F64, least: float) -> F32:
    """Flow (N, 3) by the motion of the surest box around each point, by the ego-motion elsewhere."""
    places = xyz[where].astype(np.float64)
    owner = np.broadcast_to(ego, (len(places), 3)).copy()
    for k in np.argsort(scores, kind="stable"):  # the surest last
        if scores[k] >= least:
            reach = np.hypot(boxes[k, 3], boxes[k, 4]) / 2
            near = np.flatnonzero(np.abs(places[:, 0] - boxes[k, 0]) <= reach)
            near = near[np.abs(places[near, 2] - boxes[k, 2]) <= boxes[k, 5] / 2]
            owner[near[in_boxes_bev(places[near], boxes[k : k + 1])[:, 0]]] = motions[k]
    flow = np.zeros_like(xyz)
    flow[where, :2] = flow_of(owner, places[:, :2])
    return flow


def load_predictor(run: Path | None, team: Team) -> Predictor:
    """A run's network, or the shipped one, ready.

    Raises:
        InputError: no such run, or its checkpoint is none.
    """
    path = shipped_checkpoint() if run is None else run
    checkpoint = load_checkpoint(path)
    return Predictor(network_of(checkpoint, path), checkpoint.settings, team)


def predict_pairs(predictor: Predictor, pairs: Iterable[AugmentedPair]) -> Iterator[Prediction]:
    """One pair after the other, as paired scans differ in size."""
    for pair in pairs:
        yield predictor(pair)


def sample_of_scans(name: str, scan0: Points, scan1: Points) -> Sample:
    """Two scans without labels as a sample: nothing is known."""
    n0 = len(scan0.xyz)
    return Sample(
        pair_id=name,
        xyz0=scan0.xyz,
        reflectance0=scan0.reflectance,
        xyz1=scan1.xyz,
        reflectance1=scan1.reflectance,
        flow0=np.zeros((n0, 3), np.float32),
        status0=np.ones(n0, dtype=bool),
        instance0=np.full(n0, -1, dtype=np.int64),
        instance1=np.full(len(scan1.xyz), -1, dtype=np.int64),
        ego_motion=np.eye(4),
        boxes0=np.zeros((0, 7)),
        category=(),
        motion=np.zeros((0, 4, 4)),
        has_motion=np.zeros(0, dtype=bool),
        virtual=np.zeros(0, dtype=bool),
        points0=np.zeros(0, dtype=np.int64),
        label_coverage="none",
        label_azimuth=None,
    )


def predict_files(
    scan0: Path,
    scan1: Path,
    out: Path,
    run: Path | None = None,
    picture: Path | None = None,
    threads: int | None = None,
    device: str = "auto",
    precision: Precision = "auto",
) -> Prediction:
    """The command: two scan files in, an `.npz` and a picture out.

    The file holds, for the N points of scan 0 that can be used: xyz0 (N, 3) float32; row0 (N,) their rows in the file;
    flow0 (N, 3) float32 (`direct`), flow0_dense and flow0_object likewise; in_grid0 (N,) bool, where the network has an
    estimate: elsewhere the three flows are that of the ego-motion. Then ego_motion (4, 4) T_velo1_velo0; boxes (n, 7),
    motions (n, 4, 4), scores (n,) of the cars of score settings.detection.score or more.

    Raises:
        InputError: scans that are not readable or lie outside the grid; no such run; folders that do not exist.
    """
    for path in (out, picture):
        if path is not None and not path.parent.is_dir():
            raise InputError(path, "its folder does not exist", "name a file in a folder that exists")
    if picture is not None and find_spec("matplotlib") is None:
        raise InputError("matplotlib", "is not installed", "pip install 'augkitti[view]', or leave --picture out")
    if threads:
        torch.set_num_threads(threads)
    first, second = read_points(scan0), read_points(scan1)
    name = f"{scan0.name} and {scan1.name}"
    with team_of(device, precision) as team:
        predictor = load_predictor(run, team)
        settings = predictor.settings
        batch = make_batch([sample_of_scans(name, first, second)], settings, with_targets=False)
        prediction = predictor.of_batch(batch)[0]
    T = prediction.ego_motion
    assert T is not None
    assert prediction.boxes is not None
    assert prediction.scores is not None
    assert prediction.motions is not None
    sure = prediction.scores >= settings.detection.score
    boxes, scores, motions = prediction.boxes[sure], prediction.scores[sure], prediction.motions[sure]
    where, world = prediction.where, rigid_flow(T, first.xyz)
    flows = {way: np.where(where[:, None], flow, world) for way, flow in prediction.flows.items()}
    arrays: dict[str, Any] = {
        "xyz0": first.xyz,
        "row0": first.row,
        "flow0": flows["direct"],
        "flow0_dense": flows["dense"],
        "flow0_object": flows["object"],
        "in_grid0": where,
        "ego_motion": T,
        "boxes": boxes,
        "motions": motions,
        "scores": scores,
        "program_version": np.array(augkitti.__version__),
    }
    try:
        replace_whole(out, lambda file: np.savez_compressed(file, **arrays))
    except OSError as err:
        raise MachineError(out, f"cannot be written ({err.strerror})", "free space, or give another --out") from err
    share = empty_share(batch.voxels0, settings.grid)
    note(
        f"{out}: {where.sum():,} of {len(where):,} points in the grid, {len(boxes)} cars, ego-motion {T[0, 3]:.2f}, "
        f"{T[1, 3]:.2f} m, {np.arctan2(T[1, 0], T[0, 0]):.4f} rad; {share:.1%} of the voxels of scan 0 are empty "
        '(paper: "more than 90 %")'
    )
    if picture is not None:
        draw_flow(
            picture, first.xyz, flows["direct"], where, limits_of(settings.grid), T, boxes, motions, scores,
            title=f"{name}: {len(boxes)} cars",
        )  # fmt: skip
        note(f"{picture}: the flow from above")
    return prediction


def limits_of(grid: GridConfig) -> tuple[float, float, float, float]:
    """The grid from above: x from, to, y from, to, metres."""
    return (*grid.x_m, *grid.y_m)
