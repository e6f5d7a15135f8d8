"""Matched points in, the rigid motion between them out: what every baseline ends with.

`fit_rigid` is the least-squares fit by singular values (Kabsch); `ransac_rigid` finds the motion that most matches
agree on, for matches many of which are wrong; `closest_points` (ICP) finds matches and motion in turn.
"""

import numpy as np
from scipy.spatial import cKDTree

from augkitti.frames import F64, rigid, transform_points
from augkitti.scan_pair import Bool

_STILL_M = 1e-4  # an iteration of ICP that moves points less is the last


def fit_rigid(xyz0: F64, xyz1: F64, weight: F64 | None = None) -> F64:
    """The motion (4, 4) that takes points (K, 3) to their partners with the least sum of squares.

    With fewer than three points, or none that weigh, rotation is not looked for; with none, it is the identity.
    """
    weight = np.ones(len(xyz0)) if weight is None else weight
    total = float(weight.sum())
    if not total > 0.0:
        return np.eye(4)
    centre0, centre1 = weight @ xyz0 / total, weight @ xyz1 / total
    R = np.eye(3)
    if np.count_nonzero(weight) >= 3:
        away0, away1 = xyz0 - centre0, xyz1 - centre1
        U, _, Vt = np.linalg.svd((away1 * weight[:, None]).T @ away0)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return rigid(R, centre1 - R @ centre0)


def ransac_rigid(xyz0: F64, xyz1: F64, within_m: float, rng: np.random.Generator, draws: int = 500) -> tuple[F64, Bool]:
    """The motion (4, 4) that most matches (K, 3) agree on to `within_m`, fitted to these; and which they are (K,).

    All draws of three matches are fitted at once. With fewer than three matches `fit_rigid` of all.
    """
    count = len(xyz0)
    if count < 3:
        return fit_rigid(xyz0, xyz1), np.ones(count, dtype=bool)
    picked = rng.integers(0, count, (draws, 3))
    picked = picked[(np.diff(np.sort(picked, axis=1), axis=1) > 0).all(axis=1)]
    three0, three1 = xyz0[picked], xyz1[picked]  # (D, 3, 3)
    # sides of equal length: a motion that is none of a rigid body is not worth a fit
    sides0, sides1 = (np.linalg.norm(three - np.roll(three, 1, axis=1), axis=2) for three in (three0, three1))
    fair = (np.abs(sides0 - sides1).max(axis=1) < 2.0 * within_m) & (sides0.min(axis=1) > 0.1)
    three0, three1 = three0[fair], three1[fair]
    if not len(three0):
        motion = fit_rigid(xyz0, xyz1)
        return motion, _agree(motion, xyz0, xyz1, within_m)
    centre0, centre1 = three0.mean(axis=1), three1.mean(axis=1)
    covariance = np.einsum("dki,dkj->dij", three1 - centre1[:, None], three0 - centre0[:, None])
    U, _, Vt = np.linalg.svd(covariance)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    t = centre1 - np.einsum("dij,dj->di", R, centre0)
    off = np.linalg.norm(np.einsum("dij,kj->dki", R, xyz0) + t[:, None] - xyz1, axis=2)
    best = int((off < within_m).sum(axis=1).argmax())
    inlier = np.asarray(off[best] < within_m)
    motion = fit_rigid(xyz0[inlier], xyz1[inlier])
    again = _agree(motion, xyz0, xyz1, within_m)
    return (fit_rigid(xyz0[again], xyz1[again]), again) if again.sum() >= inlier.sum() else (motion, inlier)


def closest_points(
    xyz0: F64, tree1: cKDTree, start: F64 | None = None, within_m: float = np.inf, iterations: int = 30
) -> F64:
    """The motion (4, 4) of points (K, 3) onto those in a tree by point-to-point ICP (Besl and McKay 1992).

    Args:
        xyz0: metres.
        tree1: of points (M, 3).
        start: motion to begin with; none where not given.
        within_m: a point whose nearest one is farther does not count.
        iterations: the most; it ends when points move less than a tenth of a millimetre, or under three count.
    """
    motion = np.eye(4) if start is None else start
    if not tree1.n or not len(xyz0):
        return motion
    moved = transform_points(motion, xyz0)
    for _ in range(iterations):
        before = moved
        distance, nearest = tree1.query(moved, distance_upper_bound=within_m)
        met = np.isfinite(distance)
        if met.sum() < 3:
            break
        motion = fit_rigid(xyz0[met], tree1.data[nearest[met]])
        moved = transform_points(motion, xyz0)
        if np.abs(moved - before).max() < _STILL_M:
            break
    return motion


def _agree(motion: F64, xyz0: F64, xyz1: F64, within_m: float) -> Bool:
    return np.asarray(np.linalg.norm(transform_points(motion, xyz0) - xyz1, axis=1) < within_m)
