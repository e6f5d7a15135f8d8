"""KITTI on disk: a root folder in, its sequences, scans, labels and scan pairs out.

Layouts found under a root (or when the root is one of them): raw drives `DATE/DATE_drive_NNNN_sync` up to three
folders down, odometry `sequences/NN` with `poses/NN.txt`, object `training/velodyne` (single scans, no pairs), and
tracking `training/label_02`, whose labels are given to the raw drive that is the same recording.

A drive folder may carry a sidecar `augkitti_source.json`, as synthetic drives do, with any of these keys:

    {"label_coverage": "full",            how far the drive's labels reach: none, camera or full
     "velo_poses": "velo_poses.txt"}      exact scanner poses, so that ego-motion is truth

`velo_poses` names a file in the drive folder with one line a frame number (line 0 = frame 0): twelve numbers, the upper
3 x 4 of `T_world_velo` at the scan's middle, row by row; a line may be blank where there is no scan. Numbers are to be
written with 17 digits (`repr`), so that rotations read back exact.
"""

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from augkitti import manifest
from augkitti import same_math as sm
from augkitti.ego_motion import METHOD, EgoMotion, find_ego_motion, odometry_motion, oxts_motion
from augkitti.errors import InputError
from augkitti.frames import F64, Array, compose, invert, is_rigid, orthonormal, rigid, rotate_vectors
from augkitti.kitti_labels import BoxesByFrame, read_object_labels, read_tracking_labels, read_tracklets
from augkitti.remote import as_source
from augkitti.scan_pair import Bool, LabelledBox, Scan, ScanKind, ScanPair

SIDECAR = "augkitti_source.json"
MIN_POINTS = 1000  # fewer valid points are no revolution, be it of 16 beams

_DEFAULT_PERIOD_S = 0.1035  # scanner.md: a revolution takes 103.2 to 103.6 ms
_PACKET_AFTER_MIDDLE_S = 0.017  # scanner.md: the median delay of a scan's OXTS packet; used without OXTS timestamps
_LAST_POINTS = 200
# Rings stand top first, so a file that was cut ends too high up. KITTI's own last scans of a drive can lack rings (56
# and 61 of 64 were seen): beam 48 of 64 looks down by 17.1 degrees.
_LAST_ELEVATION_RAD = math.radians(-17.0)
_MIN_QUADRANT_SHARE = 0.002  # a whole revolution sees ground on every side; a camera-view crop does not
_LARGEST = 1e9  # of numbers in calibration, poses, packets and times: 1e6 is met; far beyond, products overflow
_FETCH = "fetch the file again"
_TREE = (
    "expected ROOT/raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000000.bin (raw drives), "
    "ROOT/odometry/sequences/00/velodyne/000000.bin (odometry), or ROOT/object/training/velodyne/000000.bin (objects)"
)

Coverage = Literal["none", "camera", "full"]


@dataclass(frozen=True)
class Sequence:
    """One recording as it lies on disk: which scans there are, and where the files about them lie."""

    name: str  # the contract's `sequence`
    recording: str  # the contract's `recording`
    layout: Literal["raw", "odometry", "object"]
    kind: ScanKind
    folder: Path
    frames: tuple[int, ...]  # numbers of the scans that are there, ascending
    calib: Path  # raw: the day's folder; odometry: the file; object: the folder of files
    poses: Path | None = None  # odometry: camera poses
    tracking_labels: Path | None = None  # raw: tracking labels of the same recording
    tracking_calib: Path | None = None
    tracking_first_frame: int = 0
    note: str = ""

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Neighbouring scans (n, n + 1) that are both there; none of single scans."""
        if self.layout == "object":
            return ()
        there = set(self.frames)
        return tuple((n, n + 1) for n in self.frames if n + 1 in there)

    def scan_path(self, frame: int) -> Path:
        """The `.bin` of a frame."""
        if self.layout == "raw":
            return self.folder / "velodyne_points" / "data" / f"{frame:010d}.bin"
        return self.folder / "velodyne" / f"{frame:06d}.bin"


@dataclass(frozen=True)
class KittiRoot:
    """A folder with KITTI in it."""

    path: Path
    sequences: tuple[Sequence, ...] = field(default_factory=tuple)  # by name

    @property
    def pairs(self) -> tuple[tuple[Sequence, int, int], ...]:
        """Every scan pair of every sequence, in order."""
        return tuple((sequence, a, b) for sequence in self.sequences for a, b in sequence.pairs)

    def sequence(self, name: str) -> Sequence:
        """The sequence of that name.

        Raises:
            InputError: there is none.
        """
        for sequence in self.sequences:
            if sequence.name == name:
                return sequence
        names = ", ".join(s.name for s in self.sequences)
        raise InputError(self.path, f"holds no sequence `{name}`", f"it holds {names}")


def open_root(root: Path | str) -> KittiRoot:
    """Find every sequence under a root.

    Raises:
        InputError: the root is missing, no folder, or holds no scan in a known layout; names the tree expected.
    """
    path = as_source(root)
    if not path.is_dir():
        problem = "is not a folder" if path.exists() else "does not exist"
        raise InputError(path, problem, _TREE)
    sequences = tuple(sequence for sequence in find_sequences(path) if sequence.frames)
    if not sequences:
        raise InputError(path, "holds no KITTI scans", _TREE)
    return KittiRoot(path, sequences)


def find_sequences(root: Path) -> tuple[Sequence, ...]:
    """Every sequence under a folder by name, those without a scan too; empty where there is none.

    Raises:
        InputError: a folder cannot be listed.
    """
    try:
        found = [*_raw_drives(root), *_odometry_sequences(root), *_object_scans(root)]
    except OSError as err:
        raise InputError(err.filename or root, f"cannot be listed ({err.strerror})", "check its permissions") from err
    by_name: dict[str, Sequence] = {}
    for sequence in found:  # the same name twice: the first in order of path counts
        by_name.setdefault(sequence.name, sequence)
    return tuple(by_name[name] for name in sorted(by_name))


def valid_rows(rows: Array) -> Bool:
    """Which rows (N, 4) of a scan file are measurements: finite, and not all zero (the contract's definition)."""
    valid = np.ones(len(rows), dtype=bool)
    level = np.flatnonzero(rows[:, 2] == 0.0)  # few: only they can be all zero
    valid[level] = (rows[level] != 0.0).any(axis=1)
    finite = np.isfinite(rows)
    return valid if finite.all() else valid & np.asarray(finite.all(axis=1))


def read_scan_rows(path: Path) -> Array:
    """Every row (N, 4) float32 of a scan file as it is: x, y, z (metres), reflectance.

    Raises:
        InputError: not readable, empty, or not a whole number of rows.
    """
    try:
        content = path.read_bytes()
    except OSError as err:
        raise InputError(path, f"not readable ({err.strerror})", _FETCH) from err
    return _rows_of(content, path)


def read_scan(sequence: Sequence, frame: int, elevation_rad: F64 | None = None) -> Scan:
    """One revolution, with rows that are no measurement left out.

    `time_s` is UTC epoch for raw drives: line `frame` of `velodyne_points/timestamps.txt` (blank lines count). Without
    that file it is 17 ms before the scan's OXTS timestamp, and without that too, or for object scans, 0.1 s x frame.
    Odometry: line `frame` of `times.txt`, else 0.1 s x frame. `period_s` is end minus start of a raw scan, else the
    distance to the next line of the times, else 103.5 ms.

    Args:
        sequence: one of `open_root(...).sequences`.
        frame: the scan's number.
        elevation_rad: (beams,) of the scanner, highest first, to tell a file that was cut; without: KITTI's.

    Raises:
        InputError: the file is missing, empty, cut short, too small, a camera-view crop, its reflectance is not within
            0 and 1, or its line of the timestamps is missing or malformed.
    """
    path = sequence.scan_path(frame)
    return _scan_of(read_scan_rows(path), sequence, frame, elevation_rad)


def scan_digest(sequence: Sequence, frame: int) -> str:
    """sha256 over all that `read_scan` depends on: the file's bytes, kind, time and period. A cache key.

    Raises:
        InputError: as `read_scan` for the file and the timestamps.
    """
    path = sequence.scan_path(frame)
    time_s, period_s = scan_time(sequence, frame)
    head = json.dumps([sequence.kind, time_s.hex(), period_s.hex()])
    try:
        return _digest_of(path, _stat(path), head)
    except OSError as err:
        raise InputError(path, f"not readable ({err.strerror})", _FETCH) from err


@lru_cache(maxsize=4096)
def _digest_of(path: Path, stat: tuple[int, int], head: str) -> str:
    return hashlib.sha256(head.encode() + path.read_bytes()).hexdigest()


def scan_files(sequence: Sequence, frame: int) -> tuple[Path, ...]:
    """The files that `read_scan` reads for a frame (those of them that exist), for listing a shard's sources."""
    candidates = [sequence.scan_path(frame)]
    if sequence.layout == "raw":
        stamps = sequence.folder / "velodyne_points"
        candidates += [stamps / f"timestamps{part}.txt" for part in ("", "_start", "_end")]
        candidates += [sequence.folder / "oxts" / "timestamps.txt"]
    elif sequence.layout == "odometry":
        candidates += [sequence.folder / "times.txt"]
    return tuple(path for path in candidates if path.is_file())


def scan_time(sequence: Sequence, frame: int) -> tuple[float, float]:
    """Middle of a scan (seconds, see `read_scan`) and the time of its revolution (seconds).

    Raises:
        InputError: the line of the timestamps is missing or malformed.
    """
    if sequence.layout == "object":
        return frame * 0.1, _DEFAULT_PERIOD_S
    if sequence.layout == "odometry":
        times = _lines(sequence.folder / "times.txt")
        if times is None:
            return frame * 0.1, 0.1
        now = _number_line(sequence.folder / "times.txt", times, frame)
        following = times[frame + 1].strip() if frame + 1 < len(times) else ""
        period_s = _number_line(sequence.folder / "times.txt", times, frame + 1) - now if following else 0.1
        return now, period_s if 0.05 < period_s < 0.2 else 0.1
    stamps = sequence.folder / "velodyne_points"
    middle = _stamp(stamps / "timestamps.txt", frame)
    if middle is None:
        packet = _stamp(sequence.folder / "oxts" / "timestamps.txt", frame)
        return (frame * 0.1 if packet is None else packet - _PACKET_AFTER_MIDDLE_S), _DEFAULT_PERIOD_S
    start, end = _stamp(stamps / "timestamps_start.txt", frame), _stamp(stamps / "timestamps_end.txt", frame)
    if start is None or end is None:
        return middle, _DEFAULT_PERIOD_S
    if not 0.04 < end - start < 0.25:
        raise InputError(
            stamps / "timestamps_end.txt",
            f"line {frame + 1}: {end - start:.3f} s after the start of the scan, a revolution takes 0.05 to 0.2 s",
            _FETCH,
        )
    return middle, end - start


def read_labels(sequence: Sequence, frame: int) -> tuple[LabelledBox, ...]:
    """The real objects that the source labels in one scan; tracklets before tracking labels; none without a file.

    Raises:
        InputError: a label or calibration file is malformed.
    """
    tracklets = sequence.folder / "tracklet_labels.xml"
    if sequence.layout == "object":
        labels = sequence.folder / "label_2" / f"{frame:06d}.txt"
        return read_object_labels(labels, _object_T_velo_cam(sequence, frame)) if labels.is_file() else ()
    if sequence.layout == "raw" and tracklets.is_file():
        return _tracklets(tracklets, _stat(tracklets)).get(frame, ())
    if sequence.tracking_labels is not None and sequence.tracking_calib is not None:
        labels, calib = sequence.tracking_labels, sequence.tracking_calib
        boxes = _tracking(labels, calib, sequence.tracking_first_frame, _stat(labels), _stat(calib))
        return boxes.get(frame, ())
    return ()


def labels_digest(sequence: Sequence, frame0: int) -> str:
    """sha256 over the labels of frame0 and the next frame. A cache key.

    Raises:
        InputError: as `read_labels`.
    """
    labels = [[label.id, label.category, label.box.tobytes().hex()] for label in read_labels(sequence, frame0)]
    others = [[label.id, label.category, label.box.tobytes().hex()] for label in read_labels(sequence, frame0 + 1)]
    return hashlib.sha256(json.dumps([labels, others]).encode()).hexdigest()


def label_reach(sequence: Sequence) -> tuple[Coverage, tuple[float, float] | None]:
    """The contract's `label_coverage` and `label_azimuth` (from, to, radians, velo; for `camera` only).

    The camera's reach is the width of rectified image 2. Where no calibration gives it, that of 2011_09_26 is taken.

    Raises:
        InputError: the sidecar or the calibration is malformed.
    """
    sidecar = _sidecar(sequence)
    tracklets = sequence.layout == "raw" and (sequence.folder / "tracklet_labels.xml").is_file()
    if sequence.layout == "object":
        coverage: Coverage = "camera" if (sequence.folder / "label_2").is_dir() else "none"
    else:
        coverage = "camera" if tracklets or sequence.tracking_labels is not None else "none"
    coverage = sidecar.get("label_coverage", coverage)
    return (coverage, _camera_azimuth(sequence)) if coverage == "camera" else (coverage, None)


def read_ego_motion(sequence: Sequence, frame0: int, scan0: Scan, scan1: Scan) -> EgoMotion:
    """`T_velo1_velo0` from frame0 to the next frame and its source; see `ego_motion.find_ego_motion`.

    Takes 60 ms where the drive's files agree with the scans and up to half a second where the scans must be
    registered, so `prepare` keeps it by `ego_motion_digest`.

    Raises:
        InputError: OXTS, poses, their timestamps or the calibration are malformed.
    """
    return find_ego_motion(scan0, scan1, known_ego_motion(sequence, frame0))


def ego_motion_digest(sequence: Sequence, frame0: int) -> str:
    """sha256 over all that `read_ego_motion` depends on. A cache key.

    Raises:
        InputError: as `read_ego_motion` and `scan_digest`.
    """
    known = known_ego_motion(sequence, frame0)
    parts = [METHOD, scan_digest(sequence, frame0), scan_digest(sequence, frame0 + 1)]
    parts += [] if known is None else [known.source, known.T_velo1_velo0.tobytes().hex()]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def known_ego_motion(sequence: Sequence, frame0: int) -> EgoMotion | None:
    """Ego-motion from frame0 to the next frame as the drive's own files give it; None where they do not.

    Raises:
        InputError: OXTS, poses, their timestamps or the calibration are malformed.
    """
    if sequence.layout == "object":
        return None
    name = _sidecar(sequence).get("velo_poses")
    if name is not None:
        poses = [_pose_line(sequence.folder / name, frame) for frame in (frame0, frame0 + 1)]
        if poses[0] is None or poses[1] is None:
            raise InputError(sequence.folder / name, f"has no pose of frame {frame0} or {frame0 + 1}", _FETCH)
        return EgoMotion(compose(invert(poses[1]), poses[0]), "truth")
    if sequence.layout == "odometry":
        return _odometry_motion(sequence, frame0)
    return _oxts_motion(sequence, frame0)


def read_pair(
    sequence: Sequence, frame0: int, scans: tuple[Scan, Scan] | None = None, ego: EgoMotion | None = None
) -> ScanPair:
    """Two neighbouring scans with ego-motion and labels.

    Args:
        sequence: one of `open_root(...).sequences`.
        frame0: the first frame's number; the second is the next.
        scans: the two scans where they have been read already.
        ego: their ego-motion where it is known already.

    Raises:
        InputError: the two are no pair of the sequence, or a file that they need is unreadable.
    """
    if (frame0, frame0 + 1) not in sequence.pairs:
        problem = f"frames {frame0} and {frame0 + 1} are no pair of {sequence.name}"
        raise InputError(sequence.folder, problem, sequence.note or "both scans must be there")
    scan0, scan1 = scans or (read_scan(sequence, frame0), read_scan(sequence, frame0 + 1))
    motion = ego or read_ego_motion(sequence, frame0, scan0, scan1)
    coverage, azimuth = label_reach(sequence)
    return ScanPair(
        sequence=sequence.name,
        recording=sequence.recording,
        frame0=frame0,
        frame1=frame0 + 1,
        scan0=scan0,
        scan1=scan1,
        ego_motion=motion.T_velo1_velo0,
        ego_source=motion.source,
        labels0=read_labels(sequence, frame0),
        labels1=read_labels(sequence, frame0 + 1),
        label_coverage=coverage,
        label_azimuth=azimuth,
    )


# --- finding sequences -------------------------------------------------------------------------------------------


def _raw_drives(root: Path) -> Iterator[Sequence]:
    tracking: dict[str, tuple[Path, int]] = {}
    for path in _tracking_label_files(root):
        source = manifest.tracking_source(path.stem)
        if source is not None and _calib_beside(path).is_file():  # camera-frame boxes are of no use without it
            tracking.setdefault(source.recording, (path, source.first_frame))
    for folder in _folders_with(root, "velodyne_points", depth=3):
        recording = folder.name.removesuffix("_sync")
        labels, first_frame = tracking.get(recording, (None, 0))
        yield Sequence(
            name=folder.name,
            recording=recording,
            layout="raw",
            kind="raw",
            folder=folder,
            frames=_frames(folder / "velodyne_points" / "data", digits=10),
            calib=folder.parent,
            tracking_labels=labels,
            tracking_calib=None if labels is None else _calib_beside(labels),
            tracking_first_frame=first_frame,
        )


def _odometry_sequences(root: Path) -> Iterator[Sequence]:
    for base in (root, root / "odometry", root / "dataset", root / "odometry" / "dataset"):
        if not (base / "sequences").is_dir():
            continue
        for folder in sorted((base / "sequences").iterdir()):
            if not (folder / "velodyne").is_dir():
                continue
            poses = [path for path in (base / "poses" / f"{folder.name}.txt", folder / "poses.txt") if path.is_file()]
            yield Sequence(
                name=f"odometry_{folder.name}",
                recording=manifest.odometry_recording(folder.name) or f"odometry_{folder.name}",
                layout="odometry",
                kind="compensated",
                folder=folder,
                frames=_frames(folder / "velodyne", digits=6),
                calib=folder / "calib.txt",
                poses=poses[0] if poses else None,
            )


def _object_scans(root: Path) -> Iterator[Sequence]:
    for base in (root, root / "object"):
        folder = base / "training"
        if (folder / "velodyne").is_dir():
            yield Sequence(
                name="object_training",
                recording="object_training",
                layout="object",
                kind="raw",
                folder=folder,
                frames=_frames(folder / "velodyne", digits=6),
                calib=folder / "calib",
                note="object scans are single, for checks only: they make no pairs",
            )


def _tracking_label_files(root: Path) -> list[Path]:
    folders = [base / "training" / "label_02" for base in (root, root / "tracking", root.parent / "tracking")]
    return [path for folder in folders if folder.is_dir() for path in sorted(folder.glob("[0-9]*.txt"))]


def _calib_beside(tracking_labels: Path) -> Path:
    return tracking_labels.parent.parent / "calib" / tracking_labels.name


def _folders_with(folder: Path, name: str, depth: int) -> Iterator[Path]:
    """Folders that hold `name`, in order of path, not looking inside them."""
    if (folder / name).is_dir():
        yield folder
    elif depth > 0:
        for child in sorted(folder.iterdir()):
            if child.is_dir():
                yield from _folders_with(child, name, depth - 1)


def _frames(folder: Path, digits: int) -> tuple[int, ...]:
    if not folder.is_dir():
        return ()
    stems = (path.stem for path in folder.iterdir() if path.suffix == ".bin")
    return tuple(sorted(int(stem) for stem in stems if len(stem) == digits and stem.isdecimal() and stem.isascii()))


# --- scans and times -----------------------------------------------------------------------------------------------


def _rows_of(content: bytes, path: Path) -> Array:
    if not content:
        raise InputError(path, "is empty", _FETCH)
    if len(content) % 16:
        raise InputError(path, f"is cut short: {len(content)} bytes are no whole number of 16-byte points", _FETCH)
    return np.frombuffer(content, dtype="<f4").reshape(-1, 4)


def _scan_of(rows: Array, sequence: Sequence, frame: int, elevation_rad: F64 | None) -> Scan:
    path = sequence.scan_path(frame)
    valid = valid_rows(rows)
    row = np.arange(len(rows), dtype=np.int32) if valid.all() else np.flatnonzero(valid).astype(np.int32)
    kept = rows if len(row) == len(rows) else rows[row]
    if len(kept) < MIN_POINTS:
        raise InputError(path, f"holds {len(kept)} valid points, too few for a scan", _FETCH)
    reflectance = np.ascontiguousarray(kept[:, 3], dtype=np.float32)
    if reflectance.min() < 0.0 or reflectance.max() > 1.0:
        raise InputError(
            path, "holds reflectance outside 0 to 1", "take KITTI's own scans, or divide by the full scale"
        )
    xyz = np.ascontiguousarray(kept[:, :3], dtype=np.float32)
    ahead, left = xyz[:, 0] > 0.0, xyz[:, 1] > 0.0
    both = int(np.count_nonzero(ahead & left))
    before, beside = int(np.count_nonzero(ahead)) - both, int(np.count_nonzero(left)) - both
    if min(both, before, beside, len(xyz) - both - before - beside) < _MIN_QUADRANT_SHARE * len(xyz):
        raise InputError(
            path, "does not see all round: a camera-view crop?", "take the whole scans of the KITTI download"
        )
    last = xyz[-_LAST_POINTS:].astype(np.float64)
    lowest = _LAST_ELEVATION_RAD  # a scanner that looks down less than KITTI's ends higher
    if elevation_rad is not None:
        lowest = max(lowest, float(elevation_rad[3 * len(elevation_rad) // 4]))
    if np.median(sm.arctan2(last[:, 2], sm.hypot(last[:, 0], last[:, 1]))) > lowest:
        raise InputError(
            path, f"is cut short: {len(rows)} points, and the lowest quarter of the beams is missing", _FETCH
        )
    time_s, period_s = scan_time(sequence, frame)
    return Scan(xyz, reflectance, row, len(rows), sequence.kind, time_s, period_s)


def _stat(path: Path) -> tuple[int, int]:
    """What tells a changed file from the one that was parsed."""
    try:
        status = path.stat()
    except OSError as err:
        raise InputError(path, f"not readable ({err.strerror})", _FETCH) from err
    return status.st_mtime_ns, status.st_size


def _lines(path: Path) -> tuple[str, ...] | None:
    """All lines of a file, blank ones too; None where it is missing."""
    return _lines_of(path, _stat(path)) if path.is_file() else None


@lru_cache(maxsize=64)
def _lines_of(path: Path, stat: tuple[int, int]) -> tuple[str, ...]:
    try:
        return tuple(path.read_text(encoding="utf-8").splitlines())
    except (OSError, UnicodeDecodeError) as err:
        raise InputError(path, f"not readable as text ({type(err).__name__})", _FETCH) from err


def _stamp(path: Path, frame: int) -> float | None:
    """UTC epoch (seconds) of line `frame` of a timestamps file; None where the file is missing."""
    lines = _lines(path)
    if lines is None:
        return None
    text = lines[frame].strip() if frame < len(lines) else ""
    try:
        whole, _, fraction = text.partition(".")
        if len(whole) != len("2011-09-26 13:02:25"):
            raise ValueError
        moment = datetime.fromisoformat(whole).replace(tzinfo=UTC)
        return moment.timestamp() + float(f"0.{fraction or 0}")
    except ValueError as err:
        raise InputError(path, f"line {frame + 1}, of frame {frame}, holds no time: `{text}`", _FETCH) from err


def _number_line(path: Path, lines: tuple[str, ...], frame: int) -> float:
    numbers = _numbers(lines[frame] if frame < len(lines) else "", 1, f"{path}:{frame + 1}")
    return float(numbers[0])


def _numbers(text: str, count: int, where: str) -> F64:
    """Exactly `count` finite numbers."""
    try:
        numbers = np.array([float(word) for word in text.split()], dtype=np.float64)
    except ValueError as err:
        raise InputError(where, "holds something that is no number", _FETCH) from err
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(where, f"{count} finite numbers expected, {len(numbers)} found", _FETCH)
    if np.abs(numbers).max() > _LARGEST:
        raise InputError(where, f"holds {numbers[np.argmax(np.abs(numbers))]:g}, which no such file holds", _FETCH)
    return numbers


# --- calibration, poses, labels ------------------------------------------------------------------------------------


def _calib(path: Path) -> dict[str, str] | None:
    """`key: values` of a calibration file; None where it is missing."""
    lines = _lines(path)
    if lines is None:
        return None
    pairs = [line.partition(":") if ":" in line else line.partition(" ") for line in lines if line.strip()]
    return {key.strip(): values for key, _, values in pairs}


def _entry(calib: dict[str, str], path: Path, keys: tuple[str, ...], count: int) -> F64:
    """The values of the first of several spellings of a key."""
    for key in keys:
        if key in calib:
            return _numbers(calib[key], count, f"{path}: {key}")
    raise InputError(path, f"holds no `{keys[0]}`", _FETCH)


def _rigid_of(R: Array, t: Array, where: str) -> F64:
    T = rigid(R.reshape(3, 3), t)
    if not is_rigid(T, 2e-3):
        raise InputError(where, "is no rotation", _FETCH)
    return orthonormal(T)


def _rigid_calib(path: Path) -> F64 | None:
    """The motion in one of the day's files of raw data (`R`, `T`); None where the file is missing."""
    return _rigid_calib_of(path, _stat(path)) if path.is_file() else None


@lru_cache(maxsize=64)
def _rigid_calib_of(path: Path, stat: tuple[int, int]) -> F64:
    calib = _calib(path) or {}
    R, t = _entry(calib, path, ("R",), 9), _entry(calib, path, ("T",), 3)
    return _kept(_rigid_of(R, t, f"{path}: R"))


def _benchmark_T_velo_cam(path: Path) -> F64:
    """Rectified camera 0 to velo, from a tracking or object calibration file."""
    if not path.is_file():
        raise InputError(path, "is missing", "fetch the calibration that goes with the labels")
    return _benchmark_T_velo_cam_of(path, _stat(path))


@lru_cache(maxsize=64)
def _benchmark_T_velo_cam_of(path: Path, stat: tuple[int, int]) -> F64:
    calib = _calib(path) or {}
    tr = _entry(calib, path, ("Tr_velo_to_cam", "Tr_velo_cam"), 12).reshape(3, 4)
    rect = _entry(calib, path, ("R0_rect", "R_rect"), 9)
    T_unrectified_velo = _rigid_of(tr[:, :3], tr[:, 3], f"{path}: Tr_velo_to_cam")
    T_cam_unrectified = _rigid_of(rect, np.zeros(3), f"{path}: R0_rect")
    return _kept(invert(compose(T_cam_unrectified, T_unrectified_velo)))


def _kept(values: F64) -> F64:
    """An array that is handed out more than once."""
    values.setflags(write=False)
    return values


def _object_T_velo_cam(sequence: Sequence, frame: int) -> F64:
    return _benchmark_T_velo_cam(sequence.calib / f"{frame:06d}.txt")


@lru_cache(maxsize=16)
def _tracklets(path: Path, stat: tuple[int, int]) -> BoxesByFrame:
    return read_tracklets(path)


@lru_cache(maxsize=16)
def _tracking(
    labels: Path, calib: Path, first_frame: int, labels_stat: tuple[int, int], calib_stat: tuple[int, int]
) -> BoxesByFrame:
    return read_tracking_labels(labels, _benchmark_T_velo_cam(calib), first_frame)


def _sidecar(sequence: Sequence) -> dict[str, Any]:
    path = sequence.folder / SIDECAR
    return _sidecar_of(path, _stat(path)) if path.is_file() else {}


@lru_cache(maxsize=64)
def _sidecar_of(path: Path, stat: tuple[int, int]) -> dict[str, Any]:
    remedy = 'see the format in the documentation, for example {"label_coverage": "full"}'
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as err:
        raise InputError(path, f"not readable as JSON ({type(err).__name__})", remedy) from err
    if not isinstance(content, dict) or not set(content) <= {"label_coverage", "velo_poses"}:
        raise InputError(path, "holds keys other than `label_coverage` and `velo_poses`", remedy)
    if content.get("label_coverage", "none") not in ("none", "camera", "full"):
        raise InputError(path, "`label_coverage` is none of none, camera, full", remedy)
    name = content.get("velo_poses", "velo_poses.txt")
    if not isinstance(name, str) or Path(name).name != name:
        raise InputError(path, "`velo_poses` is no name of a file in this folder", remedy)
    return content


def _camera_azimuth(sequence: Sequence) -> tuple[float, float]:
    """Azimuths (radians, velo) of the right and the left edge of image 2."""
    R_velo_cam = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    focal, centre, width = 721.5377, 609.5593, 1242.0  # KITTI's calibration of 2011_09_26
    path = sequence.calib / "calib_cam_to_cam.txt"
    calib = _calib(path) if sequence.layout == "raw" else None
    T_cam0_velo = _rigid_calib(sequence.calib / "calib_velo_to_cam.txt") if sequence.layout == "raw" else None
    if calib is not None:
        P = _entry(calib, path, ("P_rect_02",), 12)
        focal, centre = float(P[0]), float(P[2])
        width = float(_entry(calib, path, ("S_rect_02",), 2)[0])
        if focal <= 0.0 or width <= 0.0:
            raise InputError(path, "P_rect_02 or S_rect_02 is no camera", _FETCH)
        if T_cam0_velo is not None:
            R_velo_cam = invert(compose(_R_rect(path, _stat(path)), T_cam0_velo))[:3, :3]
    elif sequence.tracking_calib is not None:
        tracking = _calib(sequence.tracking_calib) or {}
        P = _entry(tracking, sequence.tracking_calib, ("P2",), 12)
        focal, centre = float(P[0]), float(P[2])
        if focal <= 0.0:
            raise InputError(sequence.tracking_calib, "P2 is no camera", _FETCH)
        R_velo_cam = _benchmark_T_velo_cam(sequence.tracking_calib)[:3, :3]
    edges = [np.array([(column - centre) / focal, 0.0, 1.0]) for column in (width, 0.0)]
    right, left = (rotate_vectors(R_velo_cam, edge) for edge in edges)
    return sm.arctan2(right[1], right[0]), sm.arctan2(left[1], left[0])


@lru_cache(maxsize=64)
def _R_rect(path: Path, stat: tuple[int, int]) -> F64:
    return _kept(_rigid_of(_entry(_calib(path) or {}, path, ("R_rect_00",), 9), np.zeros(3), f"{path}: R_rect_00"))


def _pose_line(path: Path, frame: int) -> F64 | None:
    """Line `frame` of a file of 3 x 4 poses as a rigid motion; None where the line is blank or the file ends before."""
    lines = _lines(path)
    if lines is None:
        raise InputError(path, "is missing", _FETCH)
    if frame >= len(lines) or not lines[frame].strip():
        return None
    where = f"{path}:{frame + 1}"
    T = np.vstack([_numbers(lines[frame], 12, where).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    return T if is_rigid(T, 1e-9) else _rigid_of(T[:3, :3], T[:3, 3], where)


def _odometry_motion(sequence: Sequence, frame0: int) -> EgoMotion | None:
    calib = _calib(sequence.calib)
    if sequence.poses is None or calib is None:
        return None
    Tr = _entry(calib, sequence.calib, ("Tr", "Tr_velo_to_cam"), 12).reshape(3, 4)
    T_cam_velo = _rigid_of(Tr[:, :3], Tr[:, 3], f"{sequence.calib}: Tr")
    T_world_cam0, T_world_cam1 = _pose_line(sequence.poses, frame0), _pose_line(sequence.poses, frame0 + 1)
    if T_world_cam0 is None or T_world_cam1 is None:
        return None
    return EgoMotion(odometry_motion(T_world_cam0, T_world_cam1, T_cam_velo), "poses")


def _oxts_motion(sequence: Sequence, frame0: int) -> EgoMotion | None:
    """From the packets of the two scans and, where they are there, of the scan before and after."""
    folder = sequence.folder / "oxts"
    paths = {n: folder / "data" / f"{n:010d}.txt" for n in range(max(0, frame0 - 1), frame0 + 3)}
    T_velo_imu = _rigid_calib(sequence.calib / "calib_imu_to_velo.txt")
    if T_velo_imu is None or not (paths[frame0].is_file() and paths[frame0 + 1].is_file()):
        return None
    time0_s, time1_s = scan_time(sequence, frame0)[0], scan_time(sequence, frame0 + 1)[0]
    rows, times = [], []
    for n, path in paths.items():
        if not path.is_file():
            continue
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as err:
            raise InputError(path, f"not readable as text ({type(err).__name__})", _FETCH) from err
        stamps = _lines(folder / "timestamps.txt")
        if n not in (frame0, frame0 + 1) and (stamps is None or n >= len(stamps) or not stamps[n].strip()):
            continue
        stamp = _stamp(folder / "timestamps.txt", n)
        rows.append(_numbers(text, 30, str(path)))
        times.append(scan_time(sequence, n)[0] + _PACKET_AFTER_MIDDLE_S if stamp is None else stamp)
    if not (np.diff(times) > 0.0).all() or not 0.05 < time1_s - time0_s < 1.0:
        raise InputError(folder / "timestamps.txt", f"times round frame {frame0} do not rise by about 0.1 s", _FETCH)
    return EgoMotion(oxts_motion(np.array(rows), np.array(times), time0_s, time1_s, T_velo_imu), "oxts")
