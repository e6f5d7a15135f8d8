"""FPFH + Det.: a pair of scans and detections in, motions from matched Fast Point Feature Histograms (Open3D's) out.

`fpfh` is the paper's: the nearest histogram anywhere in scan 1. `fpfh_strong` leaves the ground out, all of which looks
alike, looks for matches within a window, keeps mutual ones and takes the motions that most of them agree on.
Histograms do not change when a scan turns about the scanner. Needs Open3D (extra `fit`), imported when called.
"""

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np

from augkitti.errors import InputError
from augkitti.frames import F64, Array
from augkitti.scan_pair import AugmentedPair
from training.baselines.matching import Agreement, Keypoints, by_agreement, by_points, standing
from training.predictions import Prediction


@dataclass(frozen=True)
class FpfhConfig:
    """Open3D's parameters; neighbours are those within a radius, at most so many."""

    voxel_m: float = 0.3  # a keypoint each: the mean of its points
    normal_m: float = 0.9
    normal_most: int = 30
    feature_m: float = 1.5
    feature_most: int = 100


PLAIN = FpfhConfig()
STRONG = FpfhConfig(voxel_m=0.2, normal_m=0.6, feature_m=1.0)


def fpfh(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """The paper's FPFH + Det.

    A detection of under 3 points moves with the world; a world of under 3 points stands, and so does everything where
    a scan is empty. Identical scans give no motion but for keypoints that look exactly alike.
    """
    first, second = (fpfh_keypoints(scan.xyz, PLAIN) for scan in (pair.scan0, pair.scan1))
    return by_points("fpfh", pair, detections, first, second)


def fpfh_strong(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """FPFH + Det. with care.

    A detection of under 3 points, or with under 4 matches that agree, moves with the world; a world of under 3 matches
    stands. Identical scans give no motion.
    """
    first, second = (fpfh_keypoints(scan.xyz[standing(scan.xyz)], STRONG) for scan in (pair.scan0, pair.scan1))
    return by_agreement("fpfh_strong", pair, detections, first, second, Agreement())


def fpfh_keypoints(xyz: Array, config: FpfhConfig) -> Keypoints:
    """Histograms of 33 bins about the points (N, 3) of a scan, one point a voxel; normals look at the scanner."""
    o3d = _open3d()
    if not len(xyz):
        return Keypoints(np.zeros((0, 3)), np.zeros((0, 33)))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(xyz, dtype=np.float64)))
    cloud = cloud.voxel_down_sample(config.voxel_m)
    near = o3d.geometry.KDTreeSearchParamHybrid(config.normal_m, config.normal_most)
    cloud.estimate_normals(near)
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    around = o3d.geometry.KDTreeSearchParamHybrid(config.feature_m, config.feature_most)
    histogram = o3d.pipelines.registration.compute_fpfh_feature(cloud, around)
    feature: F64 = np.nan_to_num(np.asarray(histogram.data).T)
    return Keypoints(np.asarray(cloud.points).copy(), np.ascontiguousarray(feature))


def _open3d() -> Any:
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)  # its wheel wants one, used or not
        import open3d
    except ImportError as err:
        raise InputError("open3d", "is not installed", "pip install 'augkitti[fit]'") from err
    return open3d
