"""What the paper's baselines share ("+Det."): detections in, their points; motions of boxes and world in, flow out.

A baseline estimates one motion for the standing world and one for every detection. Where the boxes come from is the
caller's affair: the network's, cut at its score (`sure`), or the true ones (`true_boxes`), so that the quality of
motions and that of detections can be told apart.
"""

from collections.abc import Sequence

import numpy as np

from augkitti.frames import F32, F64, box_pose, points_in_box
from augkitti.scan_pair import I64, AugmentedPair, Bool
from training.baselines.rigid_world import rigid_flow
from training.predictions import Prediction

FEWEST_POINTS = 3  # of an object: with fewer no rigid motion can be told, it is taken to stand
GROWN_M = 0.1  # boxes are grown all round by so much before points are looked for
ABOVE_UNDERSIDE_M = 0.25  # lowest part of a box whose points are left out of an estimate: they may be ground


def true_boxes(pair: AugmentedPair, category: str = "Car") -> Prediction:
    """The boxes of all true objects of a category in scan 0, as detections of score 1."""
    boxes = [item.box0 for item in pair.objects if item.box0 is not None and item.category == category]
    return _detections(pair, np.array(boxes, dtype=np.float64).reshape(-1, 7), np.ones(len(boxes)))


def sure(pair: AugmentedPair, detections: Prediction, score: float) -> Prediction:
    """A network's detections of at least this score, and no more of what it said."""
    if detections.boxes is None or detections.scores is None:
        return _detections(pair, np.zeros((0, 7)), np.zeros(0))
    kept = detections.scores >= score
    return _detections(pair, detections.boxes[kept], detections.scores[kept])


def boxes_of(detections: Prediction | None) -> F64:
    """(n, 7); none where nothing was detected."""
    return np.zeros((0, 7)) if detections is None or detections.boxes is None else detections.boxes


def object_points(xyz: F32, boxes: F64) -> list[I64]:
    """Rows of the points (N, 3) that tell of each box's (n, 7) motion: in it, grown a little, its lowest part not."""
    out = []
    for box in boxes:
        reach = np.float32(0.5 * np.hypot(box[3], box[4]) + GROWN_M)
        near = np.flatnonzero((np.abs(xyz[:, 0] - box[0]) <= reach) & (np.abs(xyz[:, 1] - box[1]) <= reach))
        inside = points_in_box(xyz[near].astype(np.float64), box_pose(box), box[3:6], GROWN_M)
        above = xyz[near, 2] > box[2] - 0.5 * box[5] + ABOVE_UNDERSIDE_M
        out.append(near[inside & above])
    return out


def followed(
    name: str,
    pair: AugmentedPair,
    ego_motion: F64,
    detections: Prediction | None,
    motions: Sequence[F64],
    where: Bool | None = None,
) -> Prediction:
    """The prediction of a baseline that follows detections.

    Points in a box (of several the surest) move with it, all others with the ego-motion.

    Args:
        name: of its flow.
        pair: the scans.
        ego_motion: (4, 4) T_velo1_velo0 of the standing world.
        detections: whose boxes were followed.
        motions: (4, 4) from velo0 to velo1, one a box.
        where: (N0,) points that it has an estimate for; all where not given.
    """
    boxes = boxes_of(detections)
    scores = np.zeros(0) if detections is None or detections.scores is None else detections.scores
    xyz = pair.scan0.xyz
    flow = rigid_flow(ego_motion, xyz)
    for k in np.argsort(scores, kind="stable"):  # the surest last
        rows = _held(xyz, boxes[k])
        flow[rows] = rigid_flow(motions[k], xyz[rows])
    return Prediction(
        pair.pair_id,
        {name: flow},
        np.ones(len(xyz), dtype=bool) if where is None else where,
        ego_motion=ego_motion,
        boxes=boxes,
        scores=scores,
        motions=np.asarray(motions, dtype=np.float64).reshape(-1, 4, 4),
    )


def _held(xyz: F32, box: F64) -> I64:
    reach = np.float32(0.5 * np.hypot(box[3], box[4]))
    near = np.flatnonzero((np.abs(xyz[:, 0] - box[0]) <= reach) & (np.abs(xyz[:, 1] - box[1]) <= reach))
    return near[points_in_box(xyz[near].astype(np.float64), box_pose(box), box[3:6])]


def _detections(pair: AugmentedPair, boxes: F64, scores: F64) -> Prediction:
    return Prediction(pair.pair_id, {}, np.zeros(len(pair.scan0), dtype=bool), boxes=boxes, scores=scores)
