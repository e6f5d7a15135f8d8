"""Rigid motions and boxes: 4 x 4 matrices and points in, transformed points, twists and box corners out.

Glossary. `T_a_b` maps coordinates in b to coordinates in a; letters that touch must match.

- velo, velo0, velo1: the scanner's frame (x forward, y left, z up, metres) at some moment, in scan 0, in scan 1.
- world: velo0 at the middle of scan 0, held still; where constant twists are written.
- car: a vehicle's frame, x forward, y left, z up, origin at its box's centre.
- cam: KITTI's rectified camera 0 (x right, y down, z forward). imu: KITTI's OXTS frame.

Products are written out, not handed to BLAS, so that the same numbers come out on every processor.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti import same_math as sm

Array = npt.NDArray[Any]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

_POLAR_STEPS = 8  # twice what a matrix a percent off needs
_FEW = 1500  # numbers up to which one pass over rows is quicker than three over columns


def transform_points(T_a_b: F64, points_b: Array) -> F64:
    """Map points (..., 3) by one matrix (4, 4), or by a stack (..., 4, 4) that broadcasts with them; float64."""
    T = np.asarray(T_a_b, dtype=np.float64)
    out = _rotated(T, np.asarray(points_b, dtype=np.float64))
    out += T[..., :3, 3]
    return out


def rotate_vectors(T_a_b: F64, vectors_b: Array) -> F64:
    """Rotate direction vectors (..., 3) by the rotation part of a matrix (..., 4, 4); float64."""
    return _rotated(np.asarray(T_a_b, dtype=np.float64), np.asarray(vectors_b, dtype=np.float64))


def _rotated(T: F64, v: F64) -> F64:
    """Rotation parts times vectors, summed in the order of the columns, whichever way is quicker."""
    if max(v.size, T.size) <= _FEW:
        out = T[..., :3, 0] * v[..., 0, None]
        out += T[..., :3, 1] * v[..., 1, None]
        out += T[..., :3, 2] * v[..., 2, None]
        return np.asarray(out)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out = np.empty((3, *np.broadcast_shapes(v.shape[:-1], T.shape[:-2])))
    for i in range(3):
        np.multiply(T[..., i, 0], x, out=out[i])
        out[i] += T[..., i, 1] * y
        out[i] += T[..., i, 2] * z
    return np.moveaxis(out, 0, -1)  # columns stay together: they are what is asked for next


def move_lines(T_a_b: F64, which: Array, origin_b: F64, direction_b: F64) -> tuple[F64, F64]:
    """Lines (K, 3), (K, 3) carried into a, each by one of few motions (M, 4, 4): its own is number `which` (K,)."""
    origin, direction = np.empty((3, len(which))), np.empty((3, len(which)))
    for i in range(3):
        row = T_a_b[:, i].T.take(which, axis=1)
        for out, vectors in ((origin[i], origin_b), (direction[i], direction_b)):
            np.multiply(row[0], vectors[:, 0], out=out)
            out += row[1] * vectors[:, 1]
            out += row[2] * vectors[:, 2]
        origin[i] += row[3]
    return origin.T, direction.T


def compose(T_a_b: F64, T_b_c: F64) -> F64:
    """`T_a_c` of two (stacks of) rigid motions (..., 4, 4)."""
    A = np.asarray(T_a_b, dtype=np.float64)
    B = np.asarray(T_b_c, dtype=np.float64)
    if max(A.size, B.size) <= 16 * _FEW:
        out = A[..., :, 0, None] * B[..., None, 0, :]
        out += A[..., :, 1, None] * B[..., None, 1, :]
        out += A[..., :, 2, None] * B[..., None, 2, :]
        out[..., 3] += A[..., :, 3]
        return np.asarray(out)
    out = np.zeros(np.broadcast_shapes(A.shape, B.shape))
    for i in range(3):
        for j in range(4):
            out[..., i, j] = A[..., i, 0] * B[..., 0, j] + A[..., i, 1] * B[..., 1, j] + A[..., i, 2] * B[..., 2, j]
        out[..., i, 3] += A[..., i, 3]
    out[..., 3, 3] = 1.0
    return out


def invert(T_a_b: F64) -> F64:
    """`T_b_a` of a (stack of) rigid motion(s) (..., 4, 4): transposed rotation, no general inverse."""
    T = np.asarray(T_a_b, dtype=np.float64)
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    t = T[..., :3, 3]
    out[..., :3, 3] = -rotate_vectors(out, t)
    out[..., 3, 3] = 1.0
    return out


def rigid(R: Array, t: Array) -> F64:
    """A 4 x 4 matrix from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def orthonormal(T: F64) -> F64:
    """The nearest rigid motion to a matrix (4, 4) whose rotation is a few digits short (files, products of many).

    Newton's iteration for the polar decomposition; a matrix far from any rotation (see `is_rigid`) is no input.
    """
    R = np.array(T, dtype=np.float64)[:3, :3]
    for _ in range(_POLAR_STEPS):
        cofactors = _cofactors(R)
        R = 0.5 * (R + cofactors / _sum3(R[0] * cofactors[0]))
    return rigid(R, np.asarray(T, dtype=np.float64)[:3, 3])


def _cofactors(R: F64) -> F64:
    """The transposed inverse of a matrix (3, 3) times its determinant."""
    next_, last = R[[1, 2, 0]], R[[2, 0, 1]]
    return np.asarray(next_[:, [1, 2, 0]] * last[:, [2, 0, 1]] - next_[:, [2, 0, 1]] * last[:, [1, 2, 0]])


def _sum3(values: F64) -> float:
    return float(values[0] + values[1] + values[2])


def is_rigid(T: Array, tolerance: float = 1e-6) -> bool:
    """Whether a matrix (4, 4) is a proper rigid motion to `tolerance`."""
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3]).max() > 2.0:
        return False
    R = T[:3, :3]
    return bool(
        np.abs(sm.product(R, R.T) - np.eye(3)).max() <= tolerance
        and abs(_sum3(R[0] * _cofactors(R)[0]) - 1.0) <= tolerance
        and np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() <= tolerance
    )


def pose_from_xyz_yaw(x: float, y: float, z: float, yaw_rad: float) -> F64:
    """A pose (4, 4) turned by yaw about z, counter-clockwise from +x."""
    s, c = sm.sincos(float(yaw_rad))
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def pose_on_slope(x: float, y: float, z: float, yaw_rad: float, normal: Array) -> F64:
    """A pose (4, 4) whose z axis is `normal` (3,) and whose x axis projects onto heading `yaw_rad` seen from above."""
    n = np.asarray(normal, dtype=np.float64)
    n = n / np.sqrt((n * n).sum())
    sine, cosine = sm.sincos(yaw_rad)
    heading = np.array([cosine, sine, 0.0])
    heading[2] = -(n[0] * heading[0] + n[1] * heading[1]) / n[2]  # in the plane, same azimuth
    forward = heading / np.sqrt((heading * heading).sum())
    left = n[[1, 2, 0]] * forward[[2, 0, 1]] - n[[2, 0, 1]] * forward[[1, 2, 0]]
    return rigid(np.stack([forward, left, n], axis=1), np.array([x, y, z]))


def yaw_of(T_a_b: Array) -> float:
    """Heading of b's x axis in a, seen from above, radians."""
    return float(sm.arctan2(T_a_b[1, 0], T_a_b[0, 0]))


def wrap_angle(angle_rad: Any) -> Any:
    """Angle(s) mapped into [-pi, pi)."""
    return (np.asarray(angle_rad) + np.pi) % (2.0 * np.pi) - np.pi


def se3_log(T_a_b: F64) -> F64:
    """Twist (6,) = (v, w) with `se3_exp(twist) == T_a_b`, for rotations below pi."""
    T = np.asarray(T_a_b, dtype=np.float64)
    R = T[:3, :3]
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt((axis * axis).sum()))
    angle = float(sm.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))
    w = axis * (angle / sine if sine > 1e-12 else 1.0)
    W = _cross_matrix(w)
    if angle < 1e-6:
        V_inv = np.eye(3) - 0.5 * W + sm.product(W, W) / 12.0
    else:
        s, c = sm.sincos(angle)
        V_inv = np.eye(3) - 0.5 * W + (1.0 / (angle * angle) - (1.0 + c) / (2.0 * angle * s)) * sm.product(W, W)
    return np.concatenate([sm.product(V_inv, T[:3, 3]), w])


def se3_exp(twist: F64, factor: Any = 1.0) -> F64:
    """Rigid motion(s) of `factor` times a twist (6,): a factor of shape S gives S + (4, 4). Constant-twist motion."""
    vx, vy, vz, wx, wy, wz = (float(value) for value in twist)
    tau: Any = float(factor) if np.ndim(factor) == 0 else np.asarray(factor, dtype=np.float64)
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    if rate < 1e-9:
        a, b, c = tau, 0.5 * tau * tau, tau * tau * tau / 6.0
    else:
        angle = rate * tau
        sine, cosine = sm.sincos(angle)
        a, b = sine / rate, (1.0 - cosine) / (rate * rate)
        c = (angle - sine) / (rate * rate * rate)
    # w x v, w x (w x v), and the square of w's cross product matrix
    ux, uy, uz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
    qx, qy, qz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
    xy, xz, yz = wx * wy, wx * wz, wy * wz
    rows = (
        (1.0 - b * (wy * wy + wz * wz), b * xy - a * wz, b * xz + a * wy, tau * vx + b * ux + c * qx),
        (b * xy + a * wz, 1.0 - b * (wx * wx + wz * wz), b * yz - a * wx, tau * vy + b * uy + c * qy),
        (b * xz - a * wy, b * yz + a * wx, 1.0 - b * (wx * wx + wy * wy), tau * vz + b * uz + c * qz),
    )
    if isinstance(tau, float):
        return np.array([*rows, (0.0, 0.0, 0.0, 1.0)])
    out = np.zeros(tau.shape + (4, 4), dtype=np.float64)
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            out[..., i, j] = value
    out[..., 3, 3] = 1.0
    return out


def _cross_matrix(w: F64) -> F64:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def box_pose(box: Array) -> F64:
    """`T_velo_box` (4, 4) of a contract box (x, y, z, length, width, height, yaw)."""
    return pose_from_xyz_yaw(float(box[0]), float(box[1]), float(box[2]), float(box[6]))


def points_in_box(points: Array, T_a_box: F64, size_m: Array, grow_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) in a lie in the box of `size_m` (length, width, height) at `T_a_box`, grown all round."""
    local = transform_points(invert(T_a_box), points)
    half = np.asarray(size_m, dtype=np.float64) / 2.0 + grow_m
    return np.asarray((np.abs(local) <= half).all(axis=-1))


def footprint_corners(box: Array, grow_m: float = 0.0) -> F64:
    """The four ground-plane corners (4, 2) of a contract box, counter-clockwise from front left."""
    x, y, yaw = float(box[0]), float(box[1]), float(box[6])
    half_l, half_w = float(box[3]) / 2.0 + grow_m, float(box[4]) / 2.0 + grow_m
    s, c = sm.sincos(yaw)
    local = np.array([[half_l, half_w], [-half_l, half_w], [-half_l, -half_w], [half_l, -half_w]])
    return np.stack([x + local[:, 0] * c - local[:, 1] * s, y + local[:, 0] * s + local[:, 1] * c], axis=1)


def footprints_overlap(corners_a: F64, corners_b: F64) -> bool:
    """Whether two convex quadrilaterals (4, 2) touch, by the separating axis theorem."""
    for quad in (corners_a, corners_b):
        edges = np.roll(quad, -1, axis=0) - quad
        normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
        along_a = sm.product(normals, corners_a.T)
        along_b = sm.product(normals, corners_b.T)
        if ((along_a.max(1) < along_b.min(1)) | (along_b.max(1) < along_a.min(1))).any():
            return False
    return True
