"""Boxes (x, y, z, length, width, height, yaw) in, their overlaps out: seen from above, and as volumes."""

import numpy as np
import numpy.typing as npt
import shapely

from augkitti.frames import F64, Array


def rotated_iou_bev(a: Array, b: Array) -> F64:
    """Intersection over union of the footprints of boxes (N, 7) and (M, 7), (N, M), 0 to 1."""
    ones, others = _boxes(a), _boxes(b)
    shared = _shared_area(ones, others)
    return _ratio(shared, (ones[:, 3] * ones[:, 4])[:, None] + (others[:, 3] * others[:, 4])[None] - shared)


def iou_3d(a: Array, b: Array) -> F64:
    """Intersection over union of the volumes of boxes (N, 7) and (M, 7), (N, M); boxes turn about z alone."""
    ones, others = _boxes(a), _boxes(b)
    top = np.minimum((ones[:, 2] + ones[:, 5] / 2)[:, None], (others[:, 2] + others[:, 5] / 2)[None])
    bottom = np.maximum((ones[:, 2] - ones[:, 5] / 2)[:, None], (others[:, 2] - others[:, 5] / 2)[None])
    shared = _shared_area(ones, others) * np.maximum(top - bottom, 0.0)
    return _ratio(shared, ones[:, 3:6].prod(axis=1)[:, None] + others[:, 3:6].prod(axis=1)[None] - shared)


def covered_bev(a: Array, b: Array) -> F64:
    """Which share of each footprint of boxes (N, 7) lies on each of boxes (M, 7): (N, M), 0 to 1."""
    ones = _boxes(a)
    shared = _shared_area(ones, _boxes(b))
    return _ratio(shared, np.broadcast_to((ones[:, 3] * ones[:, 4])[:, None], shared.shape))


def gaps_bev(a: Array, b: Array) -> F64:
    """Distance in metres between the footprints of boxes (N, 7) and (M, 7), (N, M); 0 where they touch."""
    ones, others = _footprints(_boxes(a)), _footprints(_boxes(b))
    return np.asarray(shapely.distance(ones[:, None], others[None]), dtype=np.float64)


def in_boxes_bev(xy: Array, boxes: Array, grow_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which points (N, 2) or (N, 3) stand over or under which boxes (M, 7), grown all round: (N, M)."""
    boxes = _boxes(boxes)
    offset = np.asarray(xy, dtype=np.float64)[:, None, :2] - boxes[None, :, :2]
    c, s = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    along, across = c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]
    inside = (np.abs(along) <= boxes[:, 3] / 2 + grow_m) & (np.abs(across) <= boxes[:, 4] / 2 + grow_m)
    return np.asarray(inside)


def _boxes(boxes: Array) -> F64:
    return np.asarray(boxes, dtype=np.float64).reshape(-1, 7)


def _footprints(boxes: F64) -> npt.NDArray[np.object_]:
    half = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]) * boxes[:, None, 3:5]
    c, s = np.cos(boxes[:, 6])[:, None], np.sin(boxes[:, 6])[:, None]
    corners = np.stack(
        [
            boxes[:, None, 0] + c * half[..., 0] - s * half[..., 1],
            boxes[:, None, 1] + s * half[..., 0] + c * half[..., 1],
        ],
        axis=-1,
    )
    return np.asarray(shapely.polygons(corners), dtype=object)


def _shared_area(a: F64, b: F64) -> F64:
    """Of the footprints; only pairs whose circles meet are cut with each other."""
    out = np.zeros((len(a), len(b)))
    apart = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    reach = np.hypot(a[:, 3], a[:, 4])[:, None] / 2 + np.hypot(b[:, 3], b[:, 4])[None] / 2
    i, j = np.nonzero(apart < reach)
    if len(i):
        out[i, j] = shapely.area(shapely.intersection(_footprints(a)[i], _footprints(b)[j]))
    return out


def _ratio(shared: F64, union: F64) -> F64:
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))
