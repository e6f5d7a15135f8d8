"""3DMatch + Det.: a pair of scans and detections in, motions from matched learned descriptors out.

Keypoints, one a voxel, of what stands on the ground; about each a patch of the scan's truncated distance field, and of
each patch a descriptor by a network (`descriptor_network`): by default the small one that comes with the program.
Matching and motions are FPFH's (`matching`): `three_d_match` the paper's way, `three_d_match_strong` with care, and
with denser keypoints where detections are and may go. Needs torch (extra `train`), imported when called.
"""

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from augkitti.frames import F32, F64, transform_points
from augkitti.scan_pair import I64, AugmentedPair, Bool
from training.baselines.followed import boxes_of, followed
from training.baselines.matching import (
    Agreement,
    Keypoints,
    by_points,
    object_motions,
    one_a_voxel,
    standing,
    world_motion,
)
from training.baselines.tdf import Field, distance_field, in_reach, patches
from training.predictions import Prediction

if TYPE_CHECKING:
    from training.baselines.descriptor_network import DescriptorNetwork


@dataclass(frozen=True)
class KeypointConfig:
    """Where descriptors are computed."""

    voxel_m: float = 0.6  # a keypoint each
    most: int = 2500  # the nearest to the scanner
    object_voxel_m: float = 0.3  # the same in boxes, and in scan 1 where they may have gone
    box_reach_m: float = 3.0  # from its centre a detection's points are looked for


CONFIG = KeypointConfig()
AGREEMENT = Agreement()


def three_d_match(
    pair: AugmentedPair, detections: Prediction | None = None, network: "DescriptorNetwork | None" = None
) -> Prediction:
    """The paper's 3DMatch + Det.

    A detection of under 3 points moves with the world; a world of under 3 points stands, and so does everything where
    a scan has no keypoints. Identical scans give no motion but for keypoints that look exactly alike.

    Args:
        pair: the scans.
        detections: whose boxes are followed.
        network: other than the shipped one.
    """
    network = _shipped() if network is None else network
    first, second = (
        keypoints(scene_of(scan.xyz, network), network, CONFIG.voxel_m, CONFIG.most)
        for scan in (pair.scan0, pair.scan1)
    )
    return by_points("3dmatch", pair, detections, first, second)


def three_d_match_strong(
    pair: AugmentedPair, detections: Prediction | None = None, network: "DescriptorNetwork | None" = None
) -> Prediction:
    """3DMatch + Det. with care.

    A detection of under 3 points, or of whose keypoints too few agree, moves with the world; a world of under 3 matches
    stands. Identical scans give no motion.

    Args:
        pair: the scans.
        detections: whose boxes are followed.
        network: other than the shipped one.
    """
    network = _shipped() if network is None else network
    scene0, scene1 = (scene_of(scan.xyz, network) for scan in (pair.scan0, pair.scan1))
    first, second = (keypoints(scene, network, CONFIG.voxel_m, CONFIG.most) for scene in (scene0, scene1))
    boxes = boxes_of(detections)
    ego = world_motion(pair, boxes, first, second, AGREEMENT)
    on = keypoints(scene0, network, CONFIG.object_voxel_m, CONFIG.most, boxes[:, :2], CONFIG.box_reach_m)
    there = transform_points(ego, boxes[:, :3])[:, :2]
    reach = CONFIG.box_reach_m + AGREEMENT.object_window_m
    after = keypoints(scene1, network, CONFIG.object_voxel_m, CONFIG.most, there, reach)
    motions = object_motions(pair, boxes, on, after, ego, AGREEMENT)
    return followed("3dmatch_strong", pair, ego, detections, motions)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan with all that descriptors are made of."""

    xyz: F32  # (N, 3)
    upright: I64  # (M,) rows of points that stand on the ground, in reach of the field
    field: Field


def scene_of(xyz: F32, network: "DescriptorNetwork") -> Scene:
    """The scene of a scan (N, 3)."""
    config = network.config.field
    upright = standing(xyz)
    return Scene(xyz, upright[in_reach(xyz[upright], config)], distance_field(xyz, config))


def keypoints(
    scene: Scene, network: "DescriptorNetwork", voxel_m: float, most: int, near: F64 | None = None, reach_m: float = 0.0
) -> Keypoints:
    """Keypoints of a scene with their descriptors.

    Args:
        scene: of the scan.
        network: of the descriptors.
        voxel_m: a keypoint each.
        most: of all, those nearest to the scanner.
        near: (n, 2) where they are wanted; everywhere if not given.
        reach_m: from there.
    """
    from training.baselines.descriptor_network import describe

    rows = scene.upright
    if near is not None:
        rows = rows[_is_near(scene.xyz[rows], near, reach_m)]
    rows = one_a_voxel(scene.xyz, voxel_m, rows)
    rows = np.sort(rows[np.argsort((scene.xyz[rows, :2] ** 2).sum(axis=1), kind="stable")[:most]])
    place = scene.xyz[rows].astype(np.float64)
    return Keypoints(place, describe(network, patches(scene.field, place, network.config.field.patch)))


def _is_near(xyz: F32, places: F64, reach_m: float) -> Bool:
    """Which points (N, 3), seen from above, lie within reach of any of few places (n, 2)."""
    near = np.zeros(len(xyz), dtype=bool)
    for x, y in places[:, :2]:
        near |= np.hypot(xyz[:, 0] - x, xyz[:, 1] - y) < reach_m
    return near


@cache
def _shipped() -> "DescriptorNetwork":
    from training.baselines.descriptor_network import load_network, shipped_network

    return load_network(shipped_network())
