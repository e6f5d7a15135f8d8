"""Keypoints with features of two scans in, matches and their flow out: what FPFH and 3DMatch share.

`by_points` is the paper's way: the nearest neighbour in feature space anywhere in scan 1, for every point the flow of
the nearest keypoint, and motions fitted to it. `by_agreement` is the careful way: neighbours within a window and
motions that most matches agree on.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from augkitti.config import GroundConfig
from augkitti.frames import F32, F64, Array, compose, pose_from_xyz_yaw, rigid, transform_points
from augkitti.ground import fit_ground, standing_points
from augkitti.scan_pair import I64, AugmentedPair
from augkitti.seeds import generator
from training.baselines.followed import FEWEST_POINTS, boxes_of, followed, object_points
from training.baselines.rigid_fit import fit_rigid, ransac_rigid
from training.predictions import Prediction

_BLOCK = 1 << 22  # numbers of a block of distances between features
_REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Places of one scan with what they look like."""

    xyz: F64  # (K, 3) metres
    feature: F64  # (K, F)


@dataclass(frozen=True)
class Agreement:
    """How careful matching goes about it."""

    window_m: float = 3.0  # of the world: the ego car drives up to 2.5 m between scans
    within_m: float = 0.4  # matches agree to so much: keypoints of two scans do not lie on the same spots
    most: int = 3000  # matches that have a say in the world's motion
    draws: int = 1000
    object_window_m: float = 4.0  # of objects, about where they would be if they stood: 40 m/s
    object_best: int = 8  # matches of each of its keypoints that propose a shift
    object_within_m: float = 0.35
    fewest: int = 4  # keypoints that agree on an object's shift; with fewer it moves with the world
    more_than_standing: float = 1.3  # times as many as agree that it stands
    largest_turn_rad: float = 0.2  # of an object against the world, between scans


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
    i, j, apart = _within(xyz0, feature0, xyz1, feature1, window_m)
    least0, least1 = np.full(len(xyz0), np.inf), np.full(len(xyz1), np.inf)
    np.minimum.at(least0, i, apart)
    np.minimum.at(least1, j, apart)
    mutual = (apart == least0[i]) & (apart == least1[j])
    i, j = i[mutual], j[mutual]
    _, first = np.unique(i, return_index=True)
    return i[first], j[first]


def best_within(xyz0: F64, feature0: F64, xyz1: F64, feature1: F64, window_m: float, most: int) -> tuple[I64, I64]:
    """The `most` nearest in feature space within a window of each keypoint; arguments as of `mutual_within`."""
    i, j, apart = _within(xyz0, feature0, xyz1, feature1, window_m)
    order = np.lexsort((apart, i))
    i, j = i[order], j[order]
    kept = np.arange(len(i)) - np.searchsorted(i, i) < most
    return i[kept], j[kept]


def _within(xyz0: F64, feature0: F64, xyz1: F64, feature1: F64, window_m: float) -> tuple[I64, I64, F64]:
    """Rows of all pairs of keypoints within a window, and how far apart their features are (squared)."""
    if not len(xyz0) or not len(xyz1):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    near = cKDTree(xyz0).sparse_distance_matrix(cKDTree(xyz1), window_m, output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))  # of equally good ones the first, whatever the tree's order
    i, j = near["i"][order].astype(np.int64), near["j"][order].astype(np.int64)
    step = max(1, _BLOCK // feature0.shape[1])
    parts = [((feature0[i[k : k + step]] - feature1[j[k : k + step]]) ** 2).sum(axis=1) for k in range(0, len(i), step)]
    return i, j, np.concatenate([np.zeros(0), *parts])


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
    boxes = boxes_of(detections)
    ego = world_motion(pair, boxes, first, second, rules)
    return followed(name, pair, ego, detections, object_motions(pair, boxes, first, second, ego, rules))


def world_motion(pair: AugmentedPair, boxes: F64, first: Keypoints, second: Keypoints, rules: Agreement) -> F64:
    """T_velo1_velo0 (4, 4) on which most mutual matches of keypoints outside of all boxes (n, 7) agree."""
    inside = object_points(first.xyz.astype(np.float32), boxes)
    world = np.ones(len(first.xyz), dtype=bool)
    world[np.concatenate([np.zeros(0, np.int64), *inside])] = False
    xyz0, feature0 = first.xyz[world], first.feature[world]
    i, j = mutual_within(xyz0, feature0, second.xyz, second.feature, rules.window_m)
    if len(i) < FEWEST_POINTS:
        return np.eye(4)
    rng = generator(0, pair.pair_id)
    chosen = np.sort(rng.permutation(len(i))[: rules.most])
    return ransac_rigid(xyz0[i[chosen]], second.xyz[j[chosen]], rules.within_m, rng, rules.draws)[0]


def object_motions(
    pair: AugmentedPair, boxes: F64, first: Keypoints, second: Keypoints, ego: F64, rules: Agreement
) -> list[F64]:
    """Motion (4, 4) from velo0 to velo1 of each box (n, 7): the world's and its own, on which its keypoints agree."""
    points = object_points(pair.scan0.xyz, boxes)
    rows = object_points(first.xyz.astype(np.float32), boxes)
    motions = []
    for mine, inside in zip(rows, points, strict=True):
        if len(inside) < FEWEST_POINTS:
            motions.append(ego)
            continue
        expected = transform_points(ego, first.xyz[mine])
        i, j = best_within(
            expected, first.feature[mine], second.xyz, second.feature, rules.object_window_m, rules.object_best
        )
        motions.append(compose(_own_motion(expected, i, second.xyz[j], rules), ego))
    return motions


def _own_motion(xyz0: F64, row: I64, found: F64, rules: Agreement) -> F64:
    """How an object moves over ground, from what its keypoints (K, 3) may have become: none unless enough agree.

    RANSAC with draws of one match, of which all are tried: each proposes its shift, and the one that most keypoints
    agree on is refined. Draws of three, as for the world, would turn a car of few keypoints at will.

    Args:
        xyz0: (K, 3) keypoints, where they would be if it stood.
        row: (M,) keypoint of each match.
        found: (M, 3) the keypoint of scan 1.
        rules: what is enough.
    """
    if not len(row):
        return np.eye(4)
    shift = found - xyz0[row]
    tree = cKDTree(shift)
    near = tree.sparse_distance_matrix(tree, rules.object_within_m, output_type="ndarray")
    voter = np.unique(near["i"].astype(np.int64) * len(xyz0) + row[near["j"]])  # a keypoint has one voice
    voices = np.bincount(voter // len(xyz0), minlength=len(shift))
    standing_voices = len(np.unique(row[np.linalg.norm(shift, axis=1) < rules.object_within_m]))
    best = int(voices.argmax())
    if voices[best] < max(rules.fewest, rules.more_than_standing * standing_voices):
        return np.eye(4)
    own = rigid(np.eye(3), shift[best])
    for _ in range(_REFINEMENTS):
        off = np.linalg.norm(transform_points(own, xyz0)[row] - found, axis=1)
        order = np.lexsort((off, row))  # of each keypoint the match that fits best
        _, first = np.unique(row[order], return_index=True)
        kept = order[first]
        kept = kept[off[kept] < rules.object_within_m]
        if len(kept) < rules.fewest:
            break
        own = upright_fit(xyz0[row[kept]], found[kept], rules.largest_turn_rad)
    return own


def upright_fit(xyz0: F64, xyz1: F64, largest_turn_rad: float) -> F64:
    """The shift and turn about z (4, 4) that lay points (K, 3) on their partners with the least sum of squares.

    A turn is believed where it is twice its own uncertainty and not larger than allowed; else a shift alone.
    """
    centre0, centre1 = xyz0.mean(axis=0), xyz1.mean(axis=0)
    away0, away1 = xyz0[:, :2] - centre0[:2], xyz1[:, :2] - centre1[:2]
    lever = float((away0 * away1).sum())
    turn = float(np.arctan2((away0[:, 0] * away1[:, 1] - away0[:, 1] * away1[:, 0]).sum(), lever))
    R = pose_from_xyz_yaw(0.0, 0.0, 0.0, turn)[:3, :3]
    stray = float(np.sqrt(((away0 @ R[:2, :2].T - away1) ** 2).sum(axis=1).mean()))
    if abs(turn) > largest_turn_rad or abs(turn) * np.sqrt(max(lever, 0.0)) < 2.0 * stray:
        R = np.eye(3)
    return rigid(R, centre1 - R @ centre0)
