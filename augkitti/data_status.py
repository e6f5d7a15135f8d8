"""A KITTI root in, one row per drive out: what is there, missing or cut short, and what to download.

Only names and sizes are looked at, so that a whole KITTI takes seconds; a scan's content is checked when it is read.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from augkitti import kitti, manifest
from augkitti.errors import InputError
from augkitti.remote import as_source

State = Literal["complete", "part", "damaged", "missing", "other"]


@dataclass(frozen=True)
class DriveStatus:
    """One drive or sequence on disk against the manifest.

    `complete`: every scan of the stated length is there. `part`: usable, but scans are missing. `damaged`: some scan
    files are no whole number of points. `missing`: nothing there. `other`: there, but not one of the 61 drives.
    """

    name: str
    category: str  # of the manifest; the layout for what is not in it
    state: State
    scans: int
    pairs: int
    expected: int | None  # scans that the whole drive has
    problems: tuple[str, ...]
    download: tuple[str, ...]


def data_status(root: Path | str) -> tuple[DriveStatus, ...]:
    """Compare a disk with the manifest: every drive of data set K by name, then what else is there.

    Raises:
        InputError: the root is no folder.
    """
    path = as_source(root)
    if not path.is_dir():
        raise InputError(path, "is not a folder", "give the folder that KITTI is in or is to be downloaded to")
    found = {sequence.name: sequence for sequence in kitti.find_sequences(path)}
    rows = [_drive_status(drive, found.pop(f"{drive.name}_sync", None)) for drive in manifest.drives()]
    return (*rows, *(_other_status(found[name]) for name in sorted(found)))


def _drive_status(drive: manifest.Drive, sequence: kitti.Sequence | None) -> DriveStatus:
    length = drive.frames or drive.frames_unconfirmed
    expected = None if length is None else length - len(drive.missing_scans)
    if sequence is None or not sequence.frames:
        wanted = [drive.archive, drive.calib_archive, drive.tracklets_archive]
        download = tuple(url for url in wanted if url is not None)
        return DriveStatus(drive.name, drive.category, "missing", 0, 0, expected, (), download)
    problems, damaged = _file_problems(sequence)
    download_set = [drive.archive] if damaged else []
    short = expected is not None and len(sequence.frames) < expected
    if short:
        stated = "" if drive.frames else " (a length that is commonly stated, not confirmed)"
        problems.insert(0, f"{len(sequence.frames)} of {expected} scans{stated}")
        download_set = [drive.archive]
    if (
        not (sequence.calib / "calib_velo_to_cam.txt").is_file()
        or not (sequence.calib / "calib_imu_to_velo.txt").is_file()
    ):
        problems.append("calibration of the day is missing")
        download_set.append(drive.calib_archive)
    if drive.tracklets_archive is not None and not (sequence.folder / "tracklet_labels.xml").is_file():
        problems.append("tracklets are missing" + (", tracking labels stand in" if sequence.tracking_labels else ""))
        download_set.append(drive.tracklets_archive)
    state: State = "damaged" if damaged else "part" if short else "complete"
    return DriveStatus(
        drive.name,
        drive.category,
        state,
        len(sequence.frames),
        len(sequence.pairs),
        expected,
        tuple(problems),
        tuple(download_set),
    )


def _other_status(sequence: kitti.Sequence) -> DriveStatus:
    problems, damaged = _file_problems(sequence)
    if sequence.note:
        problems.append(sequence.note)
    state: State = "damaged" if damaged else "other"
    scans = len(sequence.frames)
    return DriveStatus(sequence.name, sequence.layout, state, scans, len(sequence.pairs), None, tuple(problems), ())


def _file_problems(sequence: kitti.Sequence) -> tuple[list[str], bool]:
    """What is wrong by names and sizes, and whether scan files are damaged."""
    problems = []
    sizes = {frame: sequence.scan_path(frame).stat().st_size for frame in sequence.frames}
    bad = [frame for frame, size in sizes.items() if size == 0 or size % 16]
    if bad:
        problems.append(f"{len(bad)} scan files are empty or cut short, first frame {bad[0]}")
    if sequence.layout != "object" and sequence.frames:
        gaps = sequence.frames[-1] - sequence.frames[0] + 1 - len(sequence.frames)
        if gaps:
            problems.append(f"{gaps} scans are missing between frames {sequence.frames[0]} and {sequence.frames[-1]}")
    if sequence.layout == "raw":
        if not (sequence.folder / "velodyne_points" / "timestamps.txt").is_file():
            problems.append("velodyne timestamps are missing: times are approximate")
        packets = sequence.folder / "oxts" / "data"
        without = [n for n in sequence.frames if not (packets / f"{n:010d}.txt").is_file()]
        if without:
            problems.append(f"{len(without)} scans without OXTS packet: ego-motion by registration")
    if sequence.layout == "odometry" and sequence.poses is None:
        problems.append("no poses: ego-motion by registration")
    return problems, bool(bad)
