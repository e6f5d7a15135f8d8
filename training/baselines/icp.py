"""ICP + Det.: a pair of scans and detections in; motions of detections and of the world by closest points out.

`icp` is the paper's: point-to-point, fitted by singular values, each detection's points against the whole of scan 1,
and what lies in no detection likewise for the ego-motion. `icp_strong` is what careful ICP can do: GICP for the world,
and for each object `object_motion.follow`, which starts from the ego-motion and looks both ways.
"""

import numpy as np
from scipy.spatial import cKDTree

from augkitti.ego_motion import register
from augkitti.scan_pair import AugmentedPair
from training.baselines.followed import FEWEST_POINTS, boxes_of, followed, object_points
from training.baselines.matching import one_a_voxel, standing
from training.baselines.object_motion import SecondScan, follow
from training.baselines.rigid_fit import closest_points
from training.predictions import Prediction

_VOXEL_M = 0.3  # of the background: one point each


def icp(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """The paper's ICP + Det.

    Every motion starts at none. A detection with under 3 points moves with the world; a world with under 3, or without
    a second scan, stands. Identical scans give no motion.
    """
    xyz0 = pair.scan0.xyz
    rows = object_points(xyz0, boxes_of(detections))
    tree1 = cKDTree(pair.scan1.xyz.astype(np.float64))
    world = np.delete(xyz0, np.concatenate([np.empty(0, np.int64), *rows]), axis=0)
    thin = world[one_a_voxel(world, _VOXEL_M, np.arange(len(world)))]
    ego = closest_points(thin.astype(np.float64), tree1)
    motions = [
        ego if len(mine) < FEWEST_POINTS else closest_points(xyz0[mine].astype(np.float64), tree1) for mine in rows
    ]
    return followed("icp", pair, ego, detections, motions)


def icp_strong(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """ICP + Det. with care.

    A detection with under 3 points, or one that scan 1 holds nothing near, moves with the world, and that stands where
    a scan is empty. Identical scans give no motion.
    """
    xyz0 = pair.scan0.xyz
    ego = register(xyz0, pair.scan1.xyz)
    xyz1 = pair.scan1.xyz
    scan1 = SecondScan.of(xyz1[standing(xyz1)].astype(np.float64))
    boxes = boxes_of(detections)
    motions = [
        ego if len(mine) < FEWEST_POINTS else follow(xyz0[mine].astype(np.float64), ego, scan1, float(box[6]))
        for mine, box in zip(object_points(xyz0, boxes), boxes, strict=True)
    ]
    return followed("icp_strong", pair, ego, detections, motions)
