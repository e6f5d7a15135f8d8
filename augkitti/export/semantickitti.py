"""A pair in, a sequence of SemanticKITTI with two scans out: velodyne, labels, poses, calib, times.

Source of the form: semantic-kitti.org and KITTI's odometry devkit. Sequences are numbered in the order of the export;
poses stand in `sequences/NN/poses.txt` and, as the odometry benchmark has them, in `poses/NN.txt`.
"""

import numpy as np
import numpy.typing as npt

from augkitti.export.target import PROJECTION, T_CAM_VELO, Files, Format, Scene, kitti_order, moves, numbers, of_objects
from augkitti.frames import compose, invert
from augkitti.scan_pair import MIXED, AugmentedPair, AugmentedScan, ObjectRecord

U32 = npt.NDArray[np.uint32]
UNLABELLED, OUTLIER = 0, 1
_CLASSES = {  # standing, moving
    "Car": (10, 252),
    "Van": (10, 252),
    "Truck": (18, 258),
    "Tram": (16, 256),
    "Misc": (20, 259),
    "Pedestrian": (30, 254),
    "Person": (30, 254),
    "Person_sitting": (30, 254),
    "Person (sitting)": (30, 254),
    "Cyclist": (31, 253),
}


def sequence_files(pair: AugmentedPair, scene: Scene) -> Files:
    """All files of one pair."""
    name = f"{scene.number:02d}"
    folder = f"sequences/{name}"
    T_velo0_velo1 = invert(pair.ego_motion)
    T_cam0_cam1 = compose(compose(T_CAM_VELO, T_velo0_velo1), invert(T_CAM_VELO))
    poses = "".join(f"{numbers(T[:3])}\n" for T in (np.eye(4), T_cam0_cam1)).encode()
    calib = "".join(f"P{k}: {numbers(PROJECTION)}\n" for k in range(4)) + f"Tr: {numbers(T_CAM_VELO[:3])}\n"
    files = {
        f"{folder}/calib.txt": calib.encode(),
        f"{folder}/times.txt": f"0.0\n{pair.time1 - pair.time0!r}\n".encode(),
        f"{folder}/poses.txt": poses,
        f"poses/{name}.txt": poses,
    }
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        files[f"{folder}/velodyne/{k:06d}.bin"] = velodyne(scan)
        labels = point_labels(scan, pair.objects)[kitti_order(scan)]
        files[f"{folder}/labels/{k:06d}.label"] = labels.astype("<u4").tobytes()
    return files


def velodyne(scan: AugmentedScan) -> bytes:
    """x, y, z, reflectance of each point as KITTI stores them, in its order."""
    return np.column_stack([scan.xyz, scan.reflectance])[kitti_order(scan)].astype("<f4").tobytes()


def point_labels(scan: AugmentedScan, objects: tuple[ObjectRecord, ...]) -> U32:
    """Label (N,) of each point: class in the lower 16 bits, row in `objects` + 1 in the upper ones.

    Only objects are known: all else is unlabelled, and so is an object of which nobody knows whether it moves. Points
    mixed at an edge are outliers.
    """
    classes = of_objects(scan, [_class_of(item) for item in objects], UNLABELLED)
    classes[scan.surface == MIXED] = OUTLIER
    return (classes | (scan.instance.astype(np.int64) + 1) << 16).astype(np.uint32)


def _class_of(item: ObjectRecord) -> int:
    moving = moves(item)
    if moving is None or item.category not in _CLASSES:
        return UNLABELLED
    return _CLASSES[item.category][moving]


SEMANTICKITTI = Format(
    name="semantickitti",
    reader="SemanticKITTI's tools, KISS-ICP and readers of KITTI's odometry",
    lost="flow and where it is not known, rolling shutter, rings, surfaces, source rows and removed points, boxes, "
    "motions and speeds of objects; what is no object is unlabelled",
    files=sequence_files,
)
