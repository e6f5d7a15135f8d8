"""A pair of scans in, the flow of a world that stands as a whole out: the rows that stand beside the network.

`Method` is what a baseline looks like: those that follow objects take detections as the second argument.
"""

from collections.abc import Callable

import numpy as np

from augkitti.ego_motion import register
from augkitti.frames import F32, F64, transform_points
from augkitti.scan_pair import AugmentedPair
from training.predictions import Prediction

Method = Callable[[AugmentedPair, Prediction | None], Prediction]


def zero(pair: AugmentedPair, _: Prediction | None = None) -> Prediction:
    """Nothing moves, the ego car neither: every error is a length of what there was to find."""
    return _rigid_world("zero", pair, np.eye(4))


def ego_true(pair: AugmentedPair, _: Prediction | None = None) -> Prediction:
    """The pair's own ego-motion, and a standing world: what is left is what moves."""
    return _rigid_world("ego_true", pair, pair.ego_motion)


def ego_registration(pair: AugmentedPair, _: Prediction | None = None) -> Prediction:
    """Ego-motion by registration of the two scans (GICP, `augkitti.ego_motion.register`), and a standing world.

    No motion where a scan is empty, has hardly a point, or both are the same.
    """
    return _rigid_world("ego_registration", pair, register(pair.scan0.xyz, pair.scan1.xyz))


def rigid_flow(T_velo1_velo0: F64, xyz0: F32) -> F32:
    """Flow (N, 3) of points (N, 3) that follow one motion (4, 4): `(R - I) p + t`, where no large numbers cancel."""
    T = np.array(T_velo1_velo0, dtype=np.float64)
    T[:3, :3] -= np.eye(3)
    return transform_points(T, xyz0).astype(np.float32)


def _rigid_world(name: str, pair: AugmentedPair, T_velo1_velo0: F64) -> Prediction:
    flow = rigid_flow(T_velo1_velo0, pair.scan0.xyz)
    return Prediction(pair.pair_id, {name: flow}, np.ones(len(flow), dtype=bool), ego_motion=T_velo1_velo0)
