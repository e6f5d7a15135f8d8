"""A pair in, two scans of KITTI's object benchmark out: velodyne, label_2, calib.

Source of the form: KITTI's object development kit. Pair n becomes scans 2 n and 2 n + 1 of `training`. There are no
images: the camera stands at the scanner, and boxes that do not reach its picture have no image box, truncation 1.
"""

import math
from typing import Literal

import numpy as np

from augkitti.export.semantickitti import velodyne
from augkitti.export.target import CENTRE_PX, FOCAL_PX, IMAGE_PX, PROJECTION, T_CAM_VELO, Files, Format, Scene, numbers
from augkitti.frames import F64, box_pose, transform_points, wrap_angle
from augkitti.scan_pair import AugmentedPair, ObjectRecord

_NEAREST_M = 0.1  # in front of the camera, where boxes are cut before they are projected
_SEEN = (0.5, 0.25)  # share of a virtual car's rays that return, from which it is fully, partly visible
_UNKNOWN = 3
_SITTING = {"Person (sitting)": "Person_sitting", "Person": "Person_sitting"}
_EDGES = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]


def frame_files(pair: AugmentedPair, scene: Scene) -> Files:
    """All files of one pair."""
    matrices = {**{f"P{k}": PROJECTION for k in range(4)}, "R0_rect": np.eye(3), "Tr_velo_to_cam": T_CAM_VELO[:3]}
    calib = "".join(f"{key}: {numbers(value)}\n" for key, value in matrices.items())
    calib += f"Tr_imu_to_velo: {numbers(np.eye(4)[:3])}\n"
    files = {}
    for k, scan in ((0, pair.scan0), (1, pair.scan1)):
        name = f"{2 * scene.number + k:06d}"
        lines = [label_line(item, 0 if k == 0 else 1) for item in pair.objects]
        files[f"training/velodyne/{name}.bin"] = velodyne(scan)
        files[f"training/label_2/{name}.txt"] = "".join(f"{line}\n" for line in lines if line).encode()
        files[f"training/calib/{name}.txt"] = calib.encode()
    return files


def label_line(item: ObjectRecord, k: Literal[0, 1]) -> str | None:
    """An object's row in one scan; None where it has no box there."""
    box, points, rays = (item.box0, item.points0, item.rays0) if k == 0 else (item.box1, item.points1, item.rays1)
    if box is None:
        return None
    x, y, z = transform_points(T_CAM_VELO, box[:3] - np.array([0.0, 0.0, 0.5 * box[5]]))
    turn = float(wrap_angle(-box[6] - 0.5 * math.pi))
    image, truncated = image_box(box)
    bearing = float(wrap_angle(turn - math.atan2(x, z))) if image.any() else -10.0
    occluded = _UNKNOWN
    if rays:
        occluded = sum(points / rays < share for share in _SEEN)
    length, width, height = box[3:6]
    return (
        f"{_SITTING.get(item.category, item.category.replace(' ', '_'))} {truncated:.2f} {occluded} {bearing:.6f} "
        + " ".join(f"{value:.2f}" for value in image)
        + " "
        + " ".join(f"{value:.6f}" for value in (height, width, length, x, y, z, turn))
    )


def image_box(box: F64) -> tuple[F64, float]:
    """Left, top, right, bottom (4,) pixels of a box in the picture, and the share of it that lies outside.

    A box that does not reach the picture: four zeros and 1.
    """
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)]) - 0.5
    in_cam = transform_points(T_CAM_VELO @ box_pose(box), corners * box[3:6])
    ahead = in_cam[:, 2] >= _NEAREST_M
    points = list(in_cam[ahead])
    for a, b in _EDGES:
        if ahead[a] != ahead[b]:
            share = (_NEAREST_M - in_cam[a, 2]) / (in_cam[b, 2] - in_cam[a, 2])
            points.append(in_cam[a] + share * (in_cam[b] - in_cam[a]))
    if not points:
        return np.zeros(4), 1.0
    stack = np.array(points)
    pixels = FOCAL_PX * stack[:, :2] / stack[:, 2:] + np.array(CENTRE_PX)
    whole = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    last = np.array(IMAGE_PX) - 1.0
    cut = np.concatenate([np.clip(whole[:2], 0.0, last), np.clip(whole[2:], 0.0, last)])
    area = float(np.prod(cut[2:] - cut[:2]))
    if area <= 0.0:
        return np.zeros(4), 1.0
    return cut, 1.0 - area / float(np.prod(whole[2:] - whole[:2]))


KITTI_OBJECT = Format(
    name="kitti-object",
    reader="readers of KITTI's object benchmark",
    lost="flow, ego-motion, that two scans are a pair, identities, motions and slopes of objects, rolling shutter, "
    "rings, surfaces, source rows and removed points; image boxes are those of a camera that took no picture",
    files=frame_files,
)
