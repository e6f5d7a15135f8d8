"""3DMatch + Det.: a pair of scans and detections in, motions from matched learned descriptors out.

Keypoints, one a voxel, of what stands on the ground; about each a patch of the scan's truncated distance field, and of
each patch a descriptor by a network (`descriptor_network`). Matching and motions are FPFH's (`matching`).
"""

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from augkitti.frames import F32
from augkitti.scan_pair import AugmentedPair
from training.baselines.matching import Agreement, Keypoints, by_agreement, by_points, one_a_voxel, standing
from training.baselines.tdf import distance_field, in_reach, patches
from training.predictions import Prediction

if TYPE_CHECKING:
    from training.baselines.descriptor_network import DescriptorNetwork


@dataclass(frozen=True)
class KeypointConfig:
    """Where descriptors are computed."""

    voxel_m: float = 0.5
    most: int = 4000  # the nearest to the scanner


PLAIN = KeypointConfig()
STRONG = KeypointConfig()


def three_d_match(
    pair: AugmentedPair, detections: Prediction | None = None, network: "DescriptorNetwork | None" = None
) -> Prediction:
    """The paper's 3DMatch + Det., by the shipped small network where none is given."""
    network = _shipped() if network is None else network
    first, second = (described(scan.xyz, network, PLAIN) for scan in (pair.scan0, pair.scan1))
    return by_points("3dmatch", pair, detections, first, second)


def three_d_match_strong(
    pair: AugmentedPair, detections: Prediction | None = None, network: "DescriptorNetwork | None" = None
) -> Prediction:
    """3DMatch + Det. with care, by the shipped small network where none is given."""
    network = _shipped() if network is None else network
    first, second = (described(scan.xyz, network, STRONG) for scan in (pair.scan0, pair.scan1))
    return by_agreement("3dmatch_strong", pair, detections, first, second, Agreement())


def described(xyz: F32, network: "DescriptorNetwork", config: KeypointConfig) -> Keypoints:
    """Keypoints of a scan (N, 3) with their descriptors."""
    from training.baselines.descriptor_network import describe

    field = network.config.field
    rows = one_a_voxel(xyz, config.voxel_m, standing(xyz))
    rows = rows[in_reach(xyz[rows], field)]
    near = np.argsort((xyz[rows, :2] ** 2).sum(axis=1), kind="stable")[: config.most]
    place = xyz[np.sort(rows[near])].astype(np.float64)
    return Keypoints(place, describe(network, patches(distance_field(xyz, field), place, field.patch)))


@cache
def _shipped() -> "DescriptorNetwork":
    from training.baselines.descriptor_network import load_network, shipped_network

    return load_network(shipped_network())
