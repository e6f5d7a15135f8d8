"""Ego-motion and ICP per cluster: a pair of scans in, flow without any detection out.

In the manner of ICP-Flow (Lin and Caesar, CVPR 2024): the ego-motion by registration, the ground left out, what stands
on it in clusters, and each cluster that a standing world does not explain followed by `object_motion.follow`. Nothing
is learned, and nothing needs a GPU.
"""

import numpy as np
from scipy import ndimage

from augkitti.config import GroundConfig
from augkitti.ego_motion import register
from augkitti.frames import F32, F64, transform_points
from augkitti.ground import fit_ground, height_at, standing_points
from augkitti.scan_pair import I64, AugmentedPair
from training.baselines.object_motion import SecondScan, follow
from training.baselines.rigid_world import rigid_flow
from training.predictions import Prediction

_REACH_M = 60.0  # |x|, |y|: beyond, points are too thin to cluster
_CELL_M = 0.3  # cells that touch, corners too, are one cluster
_HIGHEST_M = 2.6  # above ground: crowns of trees would tie cars together
_FEWEST, _LONGEST_M = 10, 8.0  # points, and extent in the plane, of what may move
_EXPLAINED_M = 0.2  # a point with a partner so near stands
_UNEXPLAINED = 0.15  # share of a cluster's points without one, from which on its motion is looked for


def ego_icp_clusters(pair: AugmentedPair, _: Prediction | None = None) -> Prediction:
    """Flow by the motion of each point's cluster, by the ego-motion elsewhere; detections are not used.

    Where nothing stands on the ground, all moves with the ego-motion, which is none where a scan is empty. Identical
    scans give no motion.
    """
    xyz0 = pair.scan0.xyz
    ego = register(xyz0, pair.scan1.xyz)
    flow = rigid_flow(ego, xyz0)
    ground1 = fit_ground(pair.scan1.xyz, GroundConfig())
    scan1 = SecondScan.of(pair.scan1.xyz[standing_points(pair.scan1.xyz, ground1)].astype(np.float64))
    for rows in clusters(xyz0):
        points = xyz0[rows].astype(np.float64)
        if not _is_explained(transform_points(ego, points), scan1):
            flow[rows] = rigid_flow(follow(points, ego, scan1), xyz0[rows])
    return Prediction(pair.pair_id, {"clusters": flow}, np.ones(len(xyz0), dtype=bool), ego_motion=ego)


def clusters(xyz: F32) -> list[I64]:
    """Rows of a scan's points (N, 3), velo, that stand together and are of a size that may move; one array each."""
    ground = fit_ground(xyz, GroundConfig())
    standing = standing_points(xyz, ground).astype(np.int64)
    near = (np.abs(xyz[standing, :2]) < _REACH_M).all(axis=1)
    standing = standing[near]
    low = xyz[standing, 2] - height_at(ground, xyz[standing, :2]) < _HIGHEST_M
    rows = standing[low]
    cells = int(2 * _REACH_M / _CELL_M)
    at = np.clip(((xyz[rows, :2] + _REACH_M) / _CELL_M).astype(np.int64), 0, cells - 1)
    occupied = np.zeros((cells, cells), dtype=bool)
    occupied[at[:, 0], at[:, 1]] = True
    label, _ = ndimage.label(occupied, np.ones((3, 3)))
    number = label[at[:, 0], at[:, 1]]
    order = np.argsort(number, kind="stable")
    parts = np.split(rows[order], np.flatnonzero(np.diff(number[order])) + 1)
    return [part for part in parts if len(part) >= _FEWEST and _extent(xyz[part]) <= _LONGEST_M]


def _extent(xyz: F32) -> float:
    return float(np.hypot(*np.ptp(xyz[:, :2], axis=0)))


def _is_explained(points: F64, scan1: SecondScan) -> bool:
    """Whether a cluster's points (K, 3), carried by the ego-motion, lie upon scan 1."""
    if not len(scan1.xyz):
        return True
    distance, _ = scan1.tree.query(points, distance_upper_bound=_EXPLAINED_M)
    return bool(np.isinf(distance).mean() < _UNEXPLAINED)
