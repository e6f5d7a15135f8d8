"""Rerun: a pair in, the same in the viewer of the package `rerun-sdk` (or in a file that it opens) out."""

from pathlib import Path
from typing import Any

import numpy as np

from augkitti.draw import CAR_COLOURS, SURFACE_COLOURS
from augkitti.errors import InputError
from augkitti.frames import F32, Array, box_pose
from augkitti.scan_pair import AugmentedPair, ObjectRecord

_LABELLED = "#888888"
_STILL_M = 0.05  # what moves less is given no arrow


def send_to_rerun(pair: AugmentedPair, removed: tuple[F32, F32] | None, file: Path | None) -> None:
    """Show a pair: scan 0 at frame 0 with its flow, scan 1 at frame 1, each in its own velo frame.

    Args:
        pair: to show.
        removed: points of the source that cars hide, where the source is at hand.
        file: where to save the recording (`.rrd`); None opens rerun's own window.

    Raises:
        InputError: rerun is not installed, or cannot show or save.
    """
    try:
        import rerun as rr
    except ImportError as err:
        raise InputError("--rerun", "needs the package rerun-sdk", "pip install rerun-sdk") from err
    recording = rr.RecordingStream("augkitti", recording_id=pair.pair_id)
    try:
        if file is None:
            recording.spawn()
        else:
            recording.save(file)
    except (RuntimeError, OSError) as err:
        raise InputError(
            "--rerun", f"cannot show or save ({err})", "give --out file.rrd in a folder that exists"
        ) from err
    recording.log("scan", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        recording.set_time("scan", sequence=k)
        colours = np.array([_rgb(text) for text in SURFACE_COLOURS], np.uint8)[np.minimum(scan.surface, 7)]
        recording.log("scan/points", rr.Points3D(scan.xyz, colors=colours, radii=0.03))
        hidden = np.zeros((0, 3), np.float32) if removed is None else removed[k]
        recording.log("scan/removed", rr.Points3D(hidden, colors=[221, 0, 0], radii=0.02))
        _log_boxes(rr, recording, pair, k)
    recording.set_time("scan", sequence=0)
    moves = np.flatnonzero(np.abs(pair.flow0).max(axis=1) > _STILL_M) if len(pair.flow0) else np.zeros(0, np.int64)
    moves = moves[(pair.scan0.instance[moves] >= 0) | (moves % 40 == 0)]
    recording.log("scan/flow", rr.Arrows3D(origins=pair.scan0.xyz[moves], vectors=pair.flow0[moves], radii=0.01))
    recording.set_time("scan", sequence=1)
    recording.log("scan/flow", rr.Clear(recursive=False))
    recording.disconnect()


def _log_boxes(rr: Any, recording: Any, pair: AugmentedPair, k: int) -> None:
    shown = [item for item in pair.objects if _box(item, k) is not None]
    boxes = [_box(item, k) for item in shown]
    number = {item.id: n for n, item in enumerate(i for i in pair.objects if i.origin == "virtual")}
    recording.log(
        "scan/boxes",
        rr.Boxes3D(
            centers=[box[:3] for box in boxes if box is not None],
            half_sizes=[box[3:6] / 2.0 for box in boxes if box is not None],
            quaternions=[_quaternion(box) for box in boxes if box is not None],
            labels=[f"{item.category} {item.model or item.id}" for item in shown],
            colors=[
                _rgb(CAR_COLOURS[number[i.id] % len(CAR_COLOURS)] if i.origin == "virtual" else _LABELLED)
                for i in shown
            ],
        ),
    )


def _box(item: ObjectRecord, k: int) -> Array | None:
    return (item.box0, item.box1)[k]


def _quaternion(box: Array) -> list[float]:
    """x, y, z, w of a box's turn about z."""
    T = box_pose(box)
    half = 0.5 * float(np.arctan2(T[1, 0], T[0, 0]))
    return [0.0, 0.0, float(np.sin(half)), float(np.cos(half))]


def _rgb(text: str) -> tuple[int, int, int]:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
