"""Planar rigid motions in local and world coordinates: (t_x, t_y, theta) with origins in, the same or matrices out.

A motion is (t_x, t_y, theta): metres in the ground plane and radians about z. In world coordinates it maps p to
R p + t_W, the world's origin being the scanner; in local ones, about an origin o (a voxel's centre), it maps p - o to
R (p - o) + t_L. Rotations are the same in both (Eq. 4). All functions take torch tensors or numpy arrays and keep their
kind; leading axes broadcast.

The paper's slips. Claim 2 prints "+ (p - o)" where Eq. 1 has "- (p - o)": with the plus both of its lines still say the
same thing twice, but neither is a scene flow. The end of claim 1 prints R_W^p = R_W^p for R_W^p = R_W^q. Its step "a
non-zero rotation has no real eigenvectors" holds in the plane only: in space every rotation keeps its axis, so two
origins one above the other do share a world motion. Motions here are planar, so both claims stand.
"""

import importlib
from typing import Any, TypeVar

import numpy as np

Array = TypeVar("Array")  # a numpy array or a torch tensor


def local_to_world(motion: Array, centres: Array) -> Array:
    """Eq. 4, second line: t_W = (I - R) o + t_L.

    Args:
        motion: (..., 3) local.
        centres: (..., 2) metres: each motion's origin in world coordinates.
    """
    x, y = _turned(motion, centres)
    return _stacked(motion, motion[..., 0] - x, motion[..., 1] - y)  # type: ignore[index,no-any-return]


def world_to_local(motion: Array, centres: Array) -> Array:
    """Eq. 4, first line (printed again as Eq. 8): t_L = (R - I) o + t_W. Arguments as in `local_to_world`."""
    x, y = _turned(motion, centres)
    return _stacked(motion, motion[..., 0] + x, motion[..., 1] + y)  # type: ignore[index,no-any-return]


def flow_of(motion: Array, points: Array) -> Array:
    """Eq. 1: the flow (..., 2) of points (..., 2) under motions (..., 3), both in the same coordinates."""
    x, y = _turned(motion, points)
    return _math(motion).stack([x + motion[..., 0], y + motion[..., 1]], -1)  # type: ignore[index,no-any-return]


def matrix_of(motion: Array) -> Array:
    """Motions (..., 3) in world coordinates as matrices (..., 4, 4), T_velo1_velo0; z stays."""
    xp: Any = _math(motion)
    m: Any = motion
    c, s = xp.cos(m[..., 2]), xp.sin(m[..., 2])
    zero, one = xp.zeros_like(c), xp.ones_like(c)
    rows = ((c, -s, zero, m[..., 0]), (s, c, zero, m[..., 1]), (zero, zero, one, zero), (zero, zero, zero, one))
    return xp.stack([xp.stack(row, -1) for row in rows], -2)  # type: ignore[no-any-return]


def motion_of(matrix: Array) -> Array:
    """The planar part (..., 3) of rigid motions (..., 4, 4): t_x, t_y and the yaw."""
    xp: Any = _math(matrix)
    m: Any = matrix
    theta = xp.arctan2(m[..., 1, 0], m[..., 0, 0])
    return xp.stack([m[..., 0, 3], m[..., 1, 3], theta], -1)  # type: ignore[no-any-return]


def pool_over_boxes(motion_world: Array, centres: Array, boxes: Array, otherwise: Array | None = None) -> Array:
    """The object motion decoder: the median world motion, number by number, over the voxels in each box.

    Args:
        motion_world: (C, 3) world motions of the occupied columns of one scan.
        centres: (C, 2) metres: the columns' centres.
        boxes: (n, 7) x, y, z, length, width, height, yaw; a column is in a box when its centre is, seen from above.
        otherwise: (3,) motion of boxes without a column; NaN where not given.

    Returns:
        (n, 3) world motions. Of an even number of columns the lower median, in both kinds alike.
    """
    xp: Any = _math(motion_world)
    motion, centre, box = motion_world, centres, boxes  # type: Any, Any, Any
    if otherwise is None:
        otherwise = xp.full_like(motion[:1], float("nan"))[0] if len(motion) else None
    rows = []
    for one in box:
        away = centre - one[:2]
        c, s = xp.cos(one[6]), xp.sin(one[6])
        along, across = away[:, 0] * c + away[:, 1] * s, away[:, 1] * c - away[:, 0] * s
        inside = motion[(abs(along) <= one[3] / 2.0) & (abs(across) <= one[4] / 2.0)]
        rows.append(_lower_median(inside) if len(inside) else otherwise)
    if not rows:
        return motion[:0]  # type: ignore[no-any-return]
    if any(row is None for row in rows):
        raise ValueError("no column at all and no motion given for boxes without one")
    return xp.stack(rows)  # type: ignore[no-any-return]


def _lower_median(values: Any) -> Any:
    if isinstance(values, np.ndarray):
        return np.sort(values, axis=0)[(len(values) - 1) // 2]
    return values.median(0).values


def _turned(motion: Any, points: Any) -> tuple[Any, Any]:
    """(R - I) p, exact for small angles too: cos - 1 = -2 sin^2(half)."""
    xp: Any = _math(motion)
    half = xp.sin(motion[..., 2] / 2.0)
    c, s = -2.0 * half * half, xp.sin(motion[..., 2])
    x, y = points[..., 0], points[..., 1]
    return c * x - s * y, s * x + c * y


def _stacked(motion: Any, x: Any, y: Any) -> Any:
    theta = motion[..., 2] + 0.0 * x  # broadcast
    return _math(motion).stack([x, y, theta], -1)


def _math(array: Any) -> Any:
    """numpy or torch, whichever made `array`; torch is not imported for numpy's sake."""
    return np if isinstance(array, np.ndarray) else importlib.import_module("torch")
