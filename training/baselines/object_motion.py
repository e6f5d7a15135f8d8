"""The points of one object in scan 0, and scan 1, in; the object's rigid motion between the scans out.

A careful ICP for things as small as cars: it starts from the ego-motion (the object stands) and from displacements that
lay many of its points upon points of scan 1, refines the likeliest by GICP (small_gicp), and keeps what fits best both
ways: the object's points have a partner in scan 1, and what scan 1 has where the object should be has one in the
object. One way alone, a side of a car fits any wall. Cars do not tilt against the ground: a motion is the ego-motion,
then a shift and a turn about the vertical.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp
from scipy import ndimage
from scipy.spatial import cKDTree

from augkitti.frames import F64, compose, invert, orthonormal, pose_from_xyz_yaw, transform_points, yaw_of
from augkitti.scan_pair import Bool
from training.baselines.rigid_fit import closest_points

REACH_M = 4.0  # farthest that an object moves over ground between two scans: 40 m/s at 10 Hz
_MOST_POINTS = 250  # of an object that are asked for: more tell the same
_MOST_AROUND = 1500  # points of scan 1 that displacements are counted with
_CELL_M = 0.2  # of the histogram of displacements
_STARTS = 6  # displacements that are tried, beside standing
_CUT_M = 0.4  # distances beyond count as this
_NEAR_M = 0.6  # of correspondences when refining
_POLISH_M = 0.25  # the same of the last step
_FOR_A_TURN = 20  # points: with fewer only a shift is looked for
_ACROSS = 0.3  # cost of a metre sideways
_BETTER = 0.9  # a motion must fit so much better than standing to be believed


@dataclass(frozen=True, eq=False)
class SecondScan:
    """What stands on the ground in scan 1, ready to be asked."""

    xyz: F64  # (M, 3) velo1
    tree: cKDTree
    flat: cKDTree  # of x and y

    @classmethod
    def of(cls, xyz: F64) -> "SecondScan":
        """Points (M, 3) of velo1, ground left out."""
        return cls(xyz, cKDTree(xyz.reshape(-1, 3)), cKDTree(xyz[:, :2].reshape(-1, 2)))


def follow(points0: F64, T_velo1_velo0: F64, scan1: SecondScan, yaw0_rad: float | None = None) -> F64:
    """The motion (4, 4), velo0 to velo1, of an object.

    Args:
        points0: (K, 3) its points in scan 0, metres; with none, or without any in scan 1, it stands.
        T_velo1_velo0: the ego-motion.
        scan1: what to look for it in.
        yaw0_rad: where it heads in velo0, if that is known: cars do not move sideways.
    """
    if not len(points0) or not len(scan1.xyz):
        return T_velo1_velo0
    here = transform_points(T_velo1_velo0, points0)  # where it would be in scan 1, if it stood
    centre = 0.5 * (here.min(axis=0) + here.max(axis=0))
    length = 0.5 * float(np.hypot(*np.ptp(here[:, :2], axis=0)))
    around = scan1.xyz[scan1.flat.query_ball_point(centre[:2], REACH_M + length + 0.5)]
    around = around[(around[:, 2] > here[:, 2].min() - 0.3) & (around[:, 2] < here[:, 2].max() + 0.3)]
    if not len(around):
        return T_velo1_velo0
    few = here[:: max(1, -(-len(here) // _MOST_POINTS))]
    fit = _Fit(few, around)
    still = np.eye(4)
    starts = [still, *(pose_from_xyz_yaw(x, y, 0.0, 0.0) for x, y in likely_shifts(few, around))]
    tried = [motion for start in starts for motion in (start, _shifted(fit, start), _turned(fit, start, centre))]
    heading = None if yaw0_rad is None else yaw0_rad + yaw_of(T_velo1_velo0)
    costs = [fit(motion) + _sideways(motion, centre, heading) for motion in tried]
    best = int(np.argmin(costs))
    moved = min((tried[best], _polished(fit, tried[best], centre)), key=fit)
    return compose(moved, T_velo1_velo0) if fit(moved) < _BETTER * fit(still) else T_velo1_velo0


def likely_shifts(points: F64, around: F64) -> F64:
    """Shifts (S, 2) in the plane that lay many of the points (K, 3) near some of `around` (M, 3), the best first.

    Counted in a histogram of all differences, as voting in a Hough transform, each point's votes weighed down by how
    many it has: where scan 1 is dense it is no more likely.
    """
    around = around[:: max(1, -(-len(around) // _MOST_AROUND))]
    shift = around[None, :, :] - points[:, None, :]
    near = (np.abs(shift[..., 2]) < 0.2) & (np.hypot(shift[..., 0], shift[..., 1]) <= REACH_M)
    cells = 2 * int(np.ceil(REACH_M / _CELL_M)) + 1
    bins = np.rint(shift[..., :2] / _CELL_M).astype(np.int64) + cells // 2
    row = np.broadcast_to(np.arange(len(points))[:, None], near.shape)[near]
    flat = bins[..., 0][near] * cells + bins[..., 1][near]
    once = np.unique(row * cells * cells + flat) % (cells * cells)  # a point votes once for a cell
    votes = ndimage.gaussian_filter(np.bincount(once, minlength=cells * cells).reshape(cells, cells).astype(float), 0.8)
    peaks = (votes == ndimage.maximum_filter(votes, 5)) & (votes > 0.3 * votes.max())
    x, y = np.nonzero(peaks)
    order = np.argsort(-votes[x, y], kind="stable")[:_STARTS]
    return np.asarray((np.stack([x, y], axis=1)[order] - cells // 2) * _CELL_M, dtype=np.float64)


class _Fit:
    """How badly an object's points, moved, fit scan 1: a truncated distance, both ways; metres."""

    def __init__(self, points: F64, around: F64) -> None:
        self.points, self.around = points, around
        self.tree, self._own = cKDTree(around), cKDTree(points)
        self._low, self._high = points.min(axis=0) - 0.15, points.max(axis=0) + 0.15

    def __call__(self, motion: F64) -> float:
        """Of a motion (4, 4) within velo1."""
        there, _ = self.tree.query(transform_points(motion, self.points), distance_upper_bound=_CUT_M)
        back = transform_points(invert(motion), self.around)
        held: Bool = ((back >= self._low) & (back <= self._high)).all(axis=1)
        one_way = float(np.minimum(there, _CUT_M).mean())
        if not held.any():
            return one_way + _CUT_M
        behind, _ = self._own.query(back[held], distance_upper_bound=_CUT_M)
        return one_way + float(np.minimum(behind, _CUT_M).mean())


def _shifted(fit: _Fit, start: F64) -> F64:
    """A motion within velo1 near `start` that fits better: the mean shift to the nearest points, a few times."""
    motion = start.copy()
    for _ in range(8):
        moved = transform_points(motion, fit.points)
        distance, row = fit.tree.query(moved, distance_upper_bound=_NEAR_M)
        met = np.isfinite(distance)
        if not met.any():
            break
        motion[:3, 3] += (fit.around[row[met]] - moved[met]).mean(axis=0)
    return motion


def _turned(fit: _Fit, start: F64, centre: F64) -> F64:
    """The same by GICP, of which shift and turn about the vertical are kept; `start` where points are few."""
    if min(len(fit.points), len(fit.around)) < _FOR_A_TURN:
        return start
    result = small_gicp.align(
        fit.around,
        fit.points,
        init_T_target_source=start,
        registration_type="GICP",
        downsampling_resolution=0.05,
        max_correspondence_distance=_NEAR_M,
        max_iterations=20,
        num_threads=1,
    )
    return _upright(orthonormal(np.asarray(result.T_target_source)), centre)


def _polished(fit: _Fit, start: F64, centre: F64) -> F64:
    """The same point to point among close partners: exact where both scans hold the same points."""
    return _upright(closest_points(fit.points, fit.tree, start, _POLISH_M, 10), centre)


def _upright(motion: F64, centre: F64) -> F64:
    """A motion without its tilt, which carries `centre` to the same place."""
    upright = pose_from_xyz_yaw(0.0, 0.0, 0.0, yaw_of(motion))
    upright[:3, 3] = transform_points(motion, centre) - upright[:3, :3] @ centre
    return upright


def _sideways(motion: F64, centre: F64, heading_rad: float | None) -> float:
    """What a car's move across its heading costs, beyond what a curve or a heading that is a little off explains."""
    if heading_rad is None:
        return 0.0
    shift = transform_points(motion, centre) - centre
    along = shift[0] * np.cos(heading_rad) + shift[1] * np.sin(heading_rad)
    across = shift[1] * np.cos(heading_rad) - shift[0] * np.sin(heading_rad)
    return float(_ACROSS * max(0.0, abs(across) - 0.1 - 0.1 * abs(along)))
