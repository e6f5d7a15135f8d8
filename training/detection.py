"""Anchors and boxes: true boxes in, what each anchor should say out; scores and residuals in, boxes that remain out.

VoxelNet's, as the paper takes it: two anchors a cell at half resolution, along and across. Numpy alone. Boxes are the
contract's, (x, y, z, length, width, height, yaw).

A box's heading is told up to half a turn: the residual of the yaw is brought between -90 and 90 degrees, so front and
rear are one, where VoxelNet regresses the plain difference. Overlap and motion do not depend on it, and points seldom
tell front from rear.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from augkitti.frames import F32, F64, Array
from training.boxes import in_boxes_bev, rotated_iou_bev
from training.config import DetectionConfig, GridConfig, Settings

__all__ = ["anchors", "decode", "encode", "match", "nms", "rotated_iou_bev"]

POSITIVE, NEGATIVE, LEFT_OUT = 1, 0, -1
_YAWS = (0.0, np.pi / 2)
_FIRST = 1000  # most sure anchors that suppression looks at
_HALF_APART = 1.0 / 3.0


def anchors(settings: Settings) -> F64:
    """All anchors (A, X / 2, Y / 2, 7), metres; not to be written to."""
    return _anchors(settings.grid, settings.detection)


@lru_cache(maxsize=8)
def _anchors(grid: GridConfig, config: DetectionConfig) -> F64:
    x, y = (
        low + (np.arange(cells // 2) + 0.5) * 2.0 * size
        for (low, _), cells, size in zip((grid.x_m, grid.y_m), grid.shape[:2], grid.voxel_m[:2], strict=True)
    )
    out = np.empty((len(_YAWS), len(x), len(y), 7))
    out[..., 0], out[..., 1], out[..., 2] = x[:, None], y, config.anchor_z_m
    out[..., 3:6] = config.anchor_m
    out[..., 6] = np.array(_YAWS)[:, None, None]
    out.setflags(write=False)
    return out


def encode(boxes: Array, at: Array) -> F64:
    """Residuals (..., 7) of boxes against anchors (..., 7): VoxelNet's Eq. 1, the yaw's within a quarter turn."""
    diagonal = np.hypot(at[..., 3], at[..., 4])
    out = np.empty(np.broadcast_shapes(boxes.shape, at.shape))
    out[..., 0] = (boxes[..., 0] - at[..., 0]) / diagonal
    out[..., 1] = (boxes[..., 1] - at[..., 1]) / diagonal
    out[..., 2] = (boxes[..., 2] - at[..., 2]) / at[..., 5]
    out[..., 3:6] = np.log(boxes[..., 3:6] / at[..., 3:6])
    out[..., 6] = (boxes[..., 6] - at[..., 6] + np.pi / 2) % np.pi - np.pi / 2
    return out


def decode(residuals: Array, at: Array) -> F64:
    """Boxes (..., 7) of residuals (..., 7) at anchors (..., 7); sizes e^-2 to e^2 of the anchor's, yaw in (-pi, pi]."""
    diagonal = np.hypot(at[..., 3], at[..., 4])
    out = np.empty(np.broadcast_shapes(residuals.shape, at.shape))
    out[..., 0] = residuals[..., 0] * diagonal + at[..., 0]
    out[..., 1] = residuals[..., 1] * diagonal + at[..., 1]
    out[..., 2] = residuals[..., 2] * at[..., 5] + at[..., 2]
    out[..., 3:6] = np.exp(np.clip(residuals[..., 3:6], -2.0, 2.0)) * at[..., 3:6]
    out[..., 6] = -((np.pi - (residuals[..., 6] + at[..., 6])) % (2 * np.pi) - np.pi)
    return out


def match(
    boxes: F64,
    neutral: F64,
    settings: Settings,
    judged: Callable[[F64], npt.NDArray[np.bool_]] | None = None,
) -> tuple[npt.NDArray[np.int8], F32]:
    """What each anchor should say.

    Positive: the best of some box, or above `positive_iou` with one; negative: below `negative_iou` with all, over no
    neutral box and where labels reach. All seen from above.

    Args:
        boxes: (B, 7) to be found.
        neutral: (K, 7) neither to be found nor to be false: anchors that overlap one by `negative_iou`, or whose centre
            is in it, are left out unless positive.
        settings: grid and anchors.
        judged: places (..., 2) to whether labels reach there; everywhere where not given. A positive anchor stays.

    Returns:
        labels (A, X / 2, Y / 2): 1, 0, or -1 for left out; residuals (A, 7, X / 2, Y / 2), 0 but where positive.
    """
    config, at = settings.detection, anchors(settings)
    best_iou, best_box = np.zeros(at.shape[:3]), np.full(at.shape[:3], -1)
    bests: list[tuple[int, int]] = []  # box and its best anchor
    outside: list[npt.NDArray[np.int64]] = []  # anchors on a box that is not asked for: scores take it as neutral, too
    for number, box in enumerate(boxes):
        near, iou = _overlaps(box, at, settings)
        if not _centre_inside(box, settings.grid):
            outside.append(near[iou >= config.negative_iou])
            continue
        if not len(near) or iou.max() <= 0.0:
            continue
        better = iou > best_iou.flat[near]
        best_iou.flat[near[better]], best_box.flat[near[better]] = iou[better], number
        bests.append((number, near[iou.argmax()]))
    labels = np.where(best_iou < config.negative_iou, NEGATIVE, LEFT_OUT).astype(np.int8)
    for near in outside:
        labels.flat[near] = LEFT_OUT
    for box in neutral:
        near, iou = _overlaps(box, at, settings)
        labels.flat[near[iou >= config.negative_iou]] = LEFT_OUT
        labels[:, in_boxes_bev(at[0, ..., :2].reshape(-1, 2), box)[:, 0].reshape(at.shape[1:3])] = LEFT_OUT
    if judged is not None:
        labels[:, ~judged(at[0, ..., :2])] = LEFT_OUT
    labels[best_iou > config.positive_iou] = POSITIVE
    for number, anchor in bests:
        labels.flat[anchor], best_box.flat[anchor] = POSITIVE, number
    residuals = np.zeros((len(_YAWS), 7, *at.shape[1:3]), dtype=np.float32)
    a, x, y = np.nonzero(labels == POSITIVE)
    residuals[a, :, x, y] = encode(np.asarray(boxes).reshape(-1, 7)[best_box[a, x, y]], at[a, x, y])
    return labels, residuals


def nms(boxes: F64, scores: Array, settings: Settings) -> npt.NDArray[np.int64]:
    """Rotated non-maximum suppression: rows of boxes (N, 7) that stay, surest first.

    Left out: scores (N,) below `score` (the paper's tau), overlaps above `nms_iou` (seen from above) with a surer one
    that stays, all beyond the first `most`, and what is not finite.
    """
    config = settings.detection
    fine = (scores >= config.score) & np.isfinite(boxes).all(axis=1)
    order = np.flatnonzero(fine)[np.argsort(-scores[fine], kind="stable")][:_FIRST]
    kept: list[int] = []
    while len(order) and len(kept) < config.most:
        first, order = order[0], order[1:]
        kept.append(int(first))
        order = order[rotated_iou_bev(boxes[order], boxes[first])[:, 0] <= config.nms_iou]
    return np.array(kept, dtype=np.int64)


def _overlaps(box: Array, at: F64, settings: Settings) -> tuple[npt.NDArray[np.int64], F64]:
    """Flat numbers of the anchors near a box, and their overlaps; those left out overlap by less than matter.

    Two centrally symmetric shapes whose centres are farther apart than half the longer diagonal share at most half of
    the smaller: an overlap of a third at most.
    """
    longest = max(np.hypot(box[3], box[4]), np.hypot(*settings.detection.anchor_m[:2]))
    if settings.detection.negative_iou >= _HALF_APART:
        near, iou = _overlaps_within(longest / 2, box, at, settings.grid)
        if len(near) and iou.max() >= _HALF_APART:  # so the best is among them
            return near, iou
    return _overlaps_within(longest, box, at, settings.grid)


def _overlaps_within(radius_m: float, box: Array, at: F64, grid: GridConfig) -> tuple[npt.NDArray[np.int64], F64]:
    ranges = []
    for axis, (low, _) in enumerate((grid.x_m, grid.y_m)):
        cell = 2.0 * grid.voxel_m[axis]
        first, last = np.floor((box[axis] + np.array([-radius_m, radius_m]) - low) / cell - 0.5)
        ranges.append(np.arange(max(int(first), 0), min(int(last) + 2, at.shape[axis + 1])))
    x, y = (side.ravel() for side in np.meshgrid(*ranges, indexing="ij"))
    close = np.hypot(at[0, x, y, 0] - box[0], at[0, x, y, 1] - box[1]) <= radius_m
    x, y = x[close], y[close]
    near = np.concatenate([np.ravel_multi_index((np.full(len(x), a), x, y), at.shape[:3]) for a in range(len(at))])
    return near, rotated_iou_bev(at.reshape(-1, 7)[near], box)[:, 0]


def _centre_inside(box: Array, grid: GridConfig) -> bool:
    return all(low <= place < high for place, (low, high) in zip(box[:2], (grid.x_m, grid.y_m), strict=True))
