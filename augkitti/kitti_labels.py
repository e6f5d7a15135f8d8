"""KITTI's own labels: a tracklet, tracking or object label file in, boxes of every frame in the scanner's frame out.

Tracklets give the bottom centre in velo with yaw about z. Tracking and object labels give the bottom centre in the
rectified camera frame (y down) with `rotation_y`; they need `T_velo_cam`. All boxes leave as contract boxes.
"""

import math
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64, rotate_vectors, transform_points, wrap_angle
from augkitti.scan_pair import LabelledBox

BoxesByFrame = dict[int, tuple[LabelledBox, ...]]

_OUTSIDE_IMAGE = ("2", "3")  # tracklet `truncation`: outside the image, behind it; such poses are extrapolated
_LARGEST_RAD = 1e6  # sines are worked out of angles up to here
_FETCH = "fetch it again, or take it away to go on without labels"


def read_tracklets(path: Path) -> BoxesByFrame:
    """Boxes of `tracklet_labels.xml`, by frame number of the drive.

    Pose k of a tracklet belongs to frame `first_frame + k`. Poses that the annotators marked as outside the image or
    behind the camera are left out: nobody saw them. The id is the tracklet's place in the file.

    Raises:
        InputError: not readable, not XML, entities declared in it, or not the tracklet format.
    """
    try:
        root = ElementTree.parse(BytesIO(path.read_bytes()), forbid_dtd=False).getroot()
    except (DefusedXmlException, ElementTree.ParseError, OSError, ValueError, LookupError) as err:
        raise InputError(path, f"not readable as tracklets ({_one_line(err)})", _FETCH) from err
    boxes: dict[int, list[LabelledBox]] = {}
    tracklets = root.find("tracklets")
    if tracklets is None:
        raise InputError(path, "holds no <tracklets>", _FETCH)
    for index, item in enumerate(tracklets.findall("item")):
        where = f"tracklet {index}"
        category = (item.findtext("objectType") or "").strip()
        if not category:
            raise InputError(path, f"{where} has no objectType", _FETCH)
        height, width, length = (_number(item, tag, path, where, positive=True) for tag in ("h", "w", "l"))
        first_frame = int(_number(item, "first_frame", path, where))
        poses = item.find("poses")
        if poses is None:
            raise InputError(path, f"{where} has no poses", _FETCH)
        for k, pose in enumerate(poses.findall("item")):
            x, y, z, yaw = (_number(pose, tag, path, f"{where}, pose {k}") for tag in ("tx", "ty", "tz", "rz"))
            if (pose.findtext("truncation") or "").strip() in _OUTSIDE_IMAGE:
                continue
            box = np.array([x, y, z + height / 2.0, length, width, height, float(wrap_angle(yaw))])
            boxes.setdefault(first_frame + k, []).append(LabelledBox(f"tracklet_{index:03d}", category, box))
    return {frame: tuple(boxes[frame]) for frame in sorted(boxes)}


def read_tracking_labels(path: Path, T_velo_cam: F64, first_frame: int = 0) -> BoxesByFrame:
    """Boxes of a tracking file (`label_02/NNNN.txt`), by frame number of the raw drive; DontCare rows left out.

    Args:
        path: rows of frame, track id, type, truncation, occlusion, alpha, image box (4), height, width, length,
            x, y, z, rotation_y (rectified camera frame, metres, radians).
        T_velo_cam: rectified camera 0 to velo.
        first_frame: the drive's frame that the tracking sequence calls 0.

    Raises:
        InputError: not readable, or a row that is not such a row.
    """
    boxes: dict[int, list[LabelledBox]] = {}
    for line_number, words in _rows(path):
        where = f"{path}:{line_number}"
        if len(words) < 3:
            raise InputError(where, "not a tracking label row", _FETCH)
        frame, track = _integer(words[0], where), _integer(words[1], where)
        box = _camera_box(words[2], words[10:17], T_velo_cam, where)
        if box is not None:
            name = f"tracking_{path.stem}_{track:03d}"
            boxes.setdefault(first_frame + frame, []).append(LabelledBox(name, words[2], box))
    return {frame: tuple(boxes[frame]) for frame in sorted(boxes)}


def read_object_labels(path: Path, T_velo_cam: F64) -> tuple[LabelledBox, ...]:
    """Boxes of an object file (`label_2/NNNNNN.txt`): the tracking row without its first two words.

    Raises:
        InputError: not readable, or a row that is not such a row.
    """
    boxes = []
    for line_number, words in _rows(path):
        box = _camera_box(words[0], words[8:15], T_velo_cam, f"{path}:{line_number}")
        if box is not None:
            boxes.append(LabelledBox(f"object_{path.stem}_{line_number:03d}", words[0], box))
    return tuple(boxes)


def _camera_box(category: str, words: list[str], T_velo_cam: F64, where: str) -> F64 | None:
    """A contract box (7,) from height, width, length, x, y, z, rotation_y; None where the row has no usable box."""
    if category == "DontCare":
        return None
    try:
        height, width, length, x, y, z, rotation_y = (float(word) for word in words)
    except ValueError as err:
        raise InputError(where, "not a label row: seven numbers of a 3D box expected", _FETCH) from err
    if not all(map(math.isfinite, (height, width, length, x, y, z, rotation_y))):
        raise InputError(where, "a number of the 3D box is not finite", _FETCH)
    if abs(rotation_y) > _LARGEST_RAD:
        raise InputError(where, "rotation_y of the 3D box is no angle", _FETCH)
    if min(height, width, length) <= 0.0:
        return None  # labelled in the image only
    centre = transform_points(T_velo_cam, np.array([x, y - height / 2.0, z]))
    s, c = sm.sincos(rotation_y)
    heading = rotate_vectors(T_velo_cam, np.array([c, 0.0, -s]))
    yaw = sm.arctan2(heading[1], heading[0])
    return np.array([*centre, length, width, height, yaw])


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers from 1 and words of the lines that hold any."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise InputError(path, f"not readable as labels ({_one_line(err)})", _FETCH) from err
    return [(number, line.split()) for number, line in enumerate(lines, start=1) if line.strip()]


def _integer(word: str, where: str) -> int:
    try:
        return int(word)
    except ValueError as err:
        raise InputError(where, f"`{word}` is no whole number", _FETCH) from err


def _number(element: Any, tag: str, path: Path, where: str, positive: bool = False) -> float:
    try:
        value = float(element.findtext(tag))
    except (TypeError, ValueError) as err:
        raise InputError(path, f"{where}: <{tag}> is missing or no number", _FETCH) from err
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise InputError(path, f"{where}: <{tag}> is {value}", _FETCH)
    return value


def _one_line(err: Exception) -> str:
    return " ".join(f"{type(err).__name__}: {err}".split())
