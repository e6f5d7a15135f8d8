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

from augkitti.frames import F32, F64
from augkitti.scan_pair import I64, AugmentedPair, Bool
from training.baselines.followed import boxes_of
from training.baselines.matching import Agreement, Keypoints, by_agreement, by_points, one_a_voxel, standing
from training.baselines.tdf import distance_field, in_reach, patches
from training.predictions import Prediction

if TYPE_CHECKING:
    from training.baselines.descriptor_network import DescriptorNetwork


@dataclass(frozen=True)
class KeypointConfig:
    """Where descriptors are computed."""

    voxel_m: float = 0.6  # a keypoint each
    dense_voxel_m: float | None = None  # the same near detections
    most: int = 2500  # the nearest to the scanner, of either kind


PLAIN = KeypointConfig()
STRONG = KeypointConfig(dense_voxel_m=0.3)
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
    first, second = (described(scan.xyz, network, PLAIN) for scan in (pair.scan0, pair.scan1))
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
    boxes = boxes_of(detections)
    first = described(pair.scan0.xyz, network, STRONG, boxes)
    second = described(pair.scan1.xyz, network, STRONG, boxes, AGREEMENT.window_m + AGREEMENT.object_window_m)
    return by_agreement("3dmatch_strong", pair, detections, first, second, AGREEMENT)


def described(
    xyz: F32, network: "DescriptorNetwork", config: KeypointConfig, boxes: F64 | None = None, farther_m: float = 0.0
) -> Keypoints:
    """Keypoints of a scan with their descriptors.

    Args:
        xyz: (N, 3) points, velo.
        network: of the descriptors.
        config: where they are computed.
        boxes: (n, 7) near which keypoints are dense.
        farther_m: so far from the boxes, too.
    """
    from training.baselines.descriptor_network import describe

    field = network.config.field
    upright = standing(xyz)
    upright = upright[in_reach(xyz[upright], field)]
    sparse = _nearest(xyz, one_a_voxel(xyz, config.voxel_m, upright), config.most)
    rows = [sparse]
    if config.dense_voxel_m is not None and boxes is not None:
        near = upright[_is_near(xyz[upright], boxes, farther_m)]
        rows.append(_nearest(xyz, one_a_voxel(xyz, config.dense_voxel_m, near), config.most))
    place = xyz[np.unique(np.concatenate(rows))].astype(np.float64)
    return Keypoints(place, describe(network, patches(distance_field(xyz, field), place, field.patch)))


def _nearest(xyz: F32, rows: I64, most: int) -> I64:
    """Of some rows of points (N, 3) those nearest to the scanner."""
    return rows[np.argsort((xyz[rows, :2] ** 2).sum(axis=1), kind="stable")[:most]]


def _is_near(xyz: F32, boxes: F64, farther_m: float) -> Bool:
    """Which points (N, 3) stand within a circle round any box (n, 7), or so much farther off."""
    near = np.zeros(len(xyz), dtype=bool)
    for x, y, _, length, width, _, _ in boxes:
        near |= np.hypot(xyz[:, 0] - x, xyz[:, 1] - y) < 0.5 * np.hypot(length, width) + farther_m
    return near


@cache
def _shipped() -> "DescriptorNetwork":
    from training.baselines.descriptor_network import load_network, shipped_network

    return load_network(shipped_network())
