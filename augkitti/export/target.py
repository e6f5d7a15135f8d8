"""What a format is, and what several of them need of a pair: names, moments, ground, who moves.

A scene is a pair: two sweeps. Pairs are never chained into longer sequences, because each pair has virtual cars of its
own: the second scan of one pair and the first of the next are the same real scan with other cars in it.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from augkitti.config import GroundConfig
from augkitti.frames import F64
from augkitti.ground import fit_ground
from augkitti.scan_pair import I64, NO_TICK, AugmentedPair, AugmentedScan, Bool, GroundMap, ObjectRecord
from augkitti.scanner import ScannerProfile, tick_time

# Rectified camera of the KITTI forms: at the scanner, looking forward; x right, y down, z forward. Shards carry no
# calibration, and this one has no rounding: coordinates are only put in another order.
T_CAM_VELO = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
FOCAL_PX, CENTRE_PX, IMAGE_PX = 721.5377, (609.5593, 172.854), (1242, 375)  # KITTI's of 2011_09_26
PROJECTION = np.array([[FOCAL_PX, 0.0, CENTRE_PX[0], 0.0], [0.0, FOCAL_PX, CENTRE_PX[1], 0.0], [0.0, 0.0, 1.0, 0.0]])

_VIRTUAL_MOVES_MPS = 0.1  # its speed is exact
_LABEL_MOVES_MPS = 1.0  # a label slower than this may be one that stands (as in validation)


@dataclass(frozen=True, eq=False)
class Scene:
    """What a format needs beside the pair: its place in the export, and what the data set knows."""

    number: int  # of the pair in the export, from 0
    part: str  # the split's name, or `all`
    ground: GroundConfig
    profile: ScannerProfile


Files = dict[str, bytes]  # path from the export's folder, with forward slashes, to content


@dataclass(frozen=True)
class Done:
    """A pair that is in the export, as its journal knows it."""

    number: int
    pair_id: str
    scene: str  # its name, see `scene_name`
    nanoseconds: tuple[int, int]  # of both sweeps
    files: dict[str, int]  # path to bytes


def _no_more(done: Sequence[Done]) -> Files:
    return {}


@dataclass(frozen=True)
class Format:
    """A form of data that another program reads."""

    name: str
    reader: str  # who reads it
    lost: str  # what of a pair it cannot hold, in one line
    files: Callable[[AugmentedPair, Scene], Files]  # of one pair
    closing: Callable[[Sequence[Done]], Files] = _no_more  # files over all pairs, written last
    module: str | None = None  # one that is not among the core's


def scene_name(pair: AugmentedPair) -> str:
    """A pair's name as a folder or file: `2011_09_26_drive_0005_sync-12-0`; no dots, at which readers cut names."""
    name = pair.pair_id.replace("/", "-")
    return re.sub(r"[^A-Za-z0-9_-]", lambda odd: "".join(f"%{byte:02X}" for byte in odd[0].encode()), name)


def period_of(pair: AugmentedPair) -> float:
    """Seconds of a revolution: from one middle to the next."""
    return (pair.time1 - pair.time0) / max(1, pair.frame1 - pair.frame0)


def nanoseconds(pair: AugmentedPair) -> tuple[int, int]:
    """Whole nanoseconds of the middles of both scans."""
    return round(pair.time0 * 1e9), round(pair.time1 * 1e9)


def firing_times(pair: AugmentedPair, scan: AugmentedScan, profile: ScannerProfile) -> F64:
    """When (N,) each point was fired, seconds from the scan's middle; 0 where not known (compensated, stray points)."""
    return np.where(scan.tick == NO_TICK, 0.0, tick_time(profile, scan.tick, period_of(pair)))


def ground_of(scan: AugmentedScan, scene: Scene) -> tuple[Bool, GroundMap]:
    """Which points (N,) are ground, and the ground under a scan. No point of an object or of a simulation is ground."""
    ground = fit_ground(scan.xyz, scene.ground)
    return ground.is_ground & (scan.instance < 0) & (scan.source >= 0), ground


def moves(item: ObjectRecord) -> bool | None:
    """Whether an object moves over ground; None where that is not known."""
    if item.motion is None or item.speed is None:
        return None
    return abs(item.speed) > (_VIRTUAL_MOVES_MPS if item.origin == "virtual" else _LABEL_MOVES_MPS)


def kitti_order(scan: AugmentedScan) -> I64:
    """Rows (N,) of a scan in the order of KITTI's files: beams from the highest, each from straight ahead to the left.

    Shards have simulated points last; readers that tell beams by the order of points want them in their places.
    """
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(np.float64) % (2.0 * np.pi)
    return np.lexsort((azimuth, scan.ring))


def of_objects(scan: AugmentedScan, values: Sequence[int], otherwise: int) -> I64:
    """A value (N,) of each point: its object's, or `otherwise` for points of none."""
    return np.array([*values, otherwise], dtype=np.int64)[scan.instance]  # instance -1 takes the last


def numbers(values: F64) -> str:
    """Numbers as text, as many digits as it takes to read the same back."""
    return " ".join(repr(float(value) + 0.0) for value in np.asarray(values).reshape(-1))  # no -0.0
