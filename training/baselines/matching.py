"""Keypoints with features of two scans in, matches and their flow out: what FPFH and 3DMatch share.

`by_points` is the paper's way: the nearest neighbour in feature space anywhere in scan 1, for every point the flow of
the nearest keypoint, and motions fitted to it. `by_agreement` is the careful way: neighbours within a window, mutual ones
only, and the motion that most matches agree on.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from augkitti.config import GroundConfig
from augkitti.frames import F32, F64, Array, compose, transform_points
from augkitti.ground import fit_ground, standing_points
from augkitti.scan_pair import I64, AugmentedPair
from augkitti.seeds import generator
from training.baselines.followed import FEWEST_POINTS, boxes_of, followed, object_points
from training.baselines.rigid_fit import fit_rigid, ransac_rigid
from training.metrics import rotation_error
from training.predictions import Prediction

_BLOCK = 1 << 22  # numbers of a block of distances between features


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Places of one scan with what they look like."""

    xyz: F64  # (K, 3) metres
    feature: F64  # (K, F)


@dataclass(frozen=True)
class Agreement:
    """How careful matching goes about it."""

    window_m: float = 3.0  # of the world: the ego car drives up to 2.5 m between scans
    object_window_m: float = 4.0  # of objects, after the ego-motion: 40 m/s
    world_within_m: float = 0.4  # matches agree with a motion to so much: keypoints of two scans lie side by side
    within_m: float = 0.3
    fewest: int = 4  # matches that agree on an object's motion; with fewer it moves with the world
    most: int = 3000  # matches that have a say in the world's motion
    draws: int = 1000
    largest_turn_rad: float = 0.35  # of an object against the world, between scans


def standing(xyz: F32) -> I64:
    """Rows (M,) of the points (N, 3) of a scan that stand on the ground or hang over it; of an empty scan none."""
    return standing_points(xyz, fit_ground(xyz, GroundConfig())).astype(np.int64) if len(xyz) else np.zeros(0, np.int64)


def one_a_voxel(xyz: Array, voxel_m: float, rows: I64) -> I64:
    """Of the given rows of points (N, 3) the first in each voxel, ascending."""
    cell = np.floor(np.asarray(xyz[rows], dtype=np.float64) / voxel_m).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    return rows[np.sort(first)]


def nearest_features(feature0: F64, feature1: F64) -> I64:
    """For each feature (K0, F) the row of the nearest of (K1, F), K1 at least 1."""
    size1 = (feature1**2).sum(axis=1)
    step = max(1, _BLOCK // len(feature1))
    parts = [
        (size1 - 2.0 * (feature0[k : k + step] @ feature1.T)).argmin(axis=1) for k in range(0, len(feature0), step)
    ]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def mutual_within(xyz0: F64, feature0: F64, xyz1: F64, feature1: F64, window_m: float) -> tuple[I64, I64]:
    """Rows of both sides that are each other's nearest in feature space among all within a window.

    Args:
        xyz0: (K0, 3) where keypoints of scan 0 are looked for in scan 1.
        feature0: (K0, F).
        xyz1: (K1, 3).
        feature1: (K1, F).
        window_m: farthest that a match lies from where it is looked for.
    """
    if not len(xyz0) or not len(xyz1):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    near = cKDTree(xyz0).sparse_distance_matrix(cKDTree(xyz1), window_m, output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))  # of equally near ones the first
    i, j = near["i"][order].astype(np.int64), near["j"][order].astype(np.int64)
    step = max(1, _BLOCK // feature0.shape[1])
    apart = np.concatenate(
        [
            ((feature0[i[k : k + step]] - feature1[j[k : k + step]]) ** 2).sum(axis=1)
            for k in range(0, max(len(i), 1), step)
        ]
    )
    least0, least1 = np.full(len(xyz0), np.inf), np.full(len(xyz1), np.inf)
    np.minimum.at(least0, i, apart)
    np.minimum.at(least1, j, apart)
    mutual = (apart == least0[i]) & (apart == least1[j])
    i, j = i[mutual], j[mutual]
    _, first = np.unique(i, return_index=True)
    return i[first], j[first]


def by_points(
    name: str, pair: AugmentedPair, detections: Prediction | None, first: Keypoints, second: Keypoints
) -> Prediction:
    """Motions from a flow of every point, which is that of its nearest keypoint.

    A detection of under 3 points moves with the world; a world of under 3 points stands, and so does all where a scan
    has no keypoints.
    """
    xyz0 = pair.scan0.xyz
    boxes = boxes_of(detections)
    rows = object_points(xyz0, boxes)
    if not len(first.xyz) or not len(second.xyz):
        return followed(name, pair, np.eye(4), detections, [np.eye(4)] * len(boxes))
    flow = second.xyz[nearest_features(first.feature, second.feature)] - first.xyz
    start = xyz0.astype(np.float64)
    end = start + flow[cKDTree(first.xyz).query(start)[1]]
    world = np.ones(len(start), dtype=bool)
    world[np.concatenate([np.zeros(0, np.int64), *rows])] = False
    ego = fit_rigid(start[world], end[world]) if world.sum() >= FEWEST_POINTS else np.eye(4)
    motions = [fit_rigid(start[mine], end[mine]) if len(mine) >= FEWEST_POINTS else ego for mine in rows]
    return followed(name, pair, ego, detections, motions)


def by_agreement(
    name: str,
    pair: AugmentedPair,
    detections: Prediction | None,
    first: Keypoints,
    second: Keypoints,
    rules: Agreement,
) -> Prediction:
    """Motions that most matches agree on: the world's first, objects' about it.

    A detection of under 3 points, or whose matches do not agree on a motion that a vehicle could make, moves with the
    world; a world of under 3 matches stands.
    """
    rng = generator(0, pair.pair_id)
    boxes = boxes_of(detections)
    points = object_points(pair.scan0.xyz, boxes)
    rows = object_points(first.xyz.astype(np.float32), boxes)
    on_object = np.zeros(len(first.xyz), dtype=bool)
    on_object[np.concatenate([np.zeros(0, np.int64), *rows])] = True
    ego = _world(first, second, ~on_object, rules, rng)
    expected = transform_points(ego, first.xyz)
    i, j = mutual_within(expected, first.feature, second.xyz, second.feature, rules.object_window_m)
    motions = []
    for mine, inside in zip(rows, points, strict=True):
        kept = np.isin(i, mine)
        few = len(inside) < FEWEST_POINTS
        motions.append(ego if few else _object(expected[i[kept]], second.xyz[j[kept]], ego, rules, rng))
    return followed(name, pair, ego, detections, motions)


def _world(first: Keypoints, second: Keypoints, world: Array, rules: Agreement, rng: np.random.Generator) -> F64:
    i, j = mutual_within(first.xyz[world], first.feature[world], second.xyz, second.feature, rules.window_m)
    if len(i) < FEWEST_POINTS:
        return np.eye(4)
    chosen = np.sort(rng.permutation(len(i))[: rules.most])
    motion, _ = ransac_rigid(first.xyz[world][i[chosen]], second.xyz[j[chosen]], rules.world_within_m, rng, rules.draws)
    return motion


def _object(expected: F64, found: F64, ego: F64, rules: Agreement, rng: np.random.Generator) -> F64:
    """Motion of an object whose matches lie at `found` (K, 3), were it to stand at `expected`; else the world's."""
    if len(expected) < rules.fewest:
        return ego
    own, agree = ransac_rigid(expected, found, rules.within_m, rng, rules.draws)
    if agree.sum() < rules.fewest or rotation_error(own, np.eye(4)) > rules.largest_turn_rad:
        return ego
    return compose(own, ego)
