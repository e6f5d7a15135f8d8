"""A pair as the network learns it: a record of the shard contract in, plain arrays of points, boxes and motions out.

Only objects that have a box in scan 0 are rows; no torch here, so scores may use it too.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import F32, F64
from augkitti.scan_pair import I64, AugmentedPair, Bool

I16 = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Sample:
    """A pair of scans with its labels; N0, N1 points, B objects with a box in scan 0. Metres, velo0 and velo1."""

    pair_id: str
    xyz0: F32  # (N0, 3) velo0
    reflectance0: F32  # (N0,) 0 to 1
    xyz1: F32  # (N1, 3) velo1
    reflectance1: F32  # (N1,)
    flow0: F32  # (N0, 3) from velo0 to velo1, ego-motion included
    status0: Bool  # (N0,) True where the flow is not known
    instance0: I64  # (N0,) row of the objects below; -1 for none
    instance1: I64  # (N1,)
    ego_motion: F64  # (4, 4) T_velo1_velo0
    boxes0: F64  # (B, 7) centre x, y, z, length, width, height, yaw; velo0
    category: tuple[str, ...]  # (B,) KITTI's
    motion: F64  # (B, 4, 4) from velo0 to velo1; identity where not known
    has_motion: Bool  # (B,)
    virtual: Bool  # (B,)
    points0: I64  # (B,) points in scan 0
    label_coverage: str  # where the source's own labels reach: none, camera or full
    label_azimuth: tuple[float, float] | None  # for camera: from, to, radians, velo
    draw: int = 0  # seed of what is drawn for this sample: augmentation, points of crowded voxels


def sample_of(pair: AugmentedPair) -> Sample:
    """The sample of a pair; per-point arrays are the pair's own where nothing changes.

    Points of objects without a box in scan 0 get instance -1; their flow and its status stay.

    Raises:
        InputError: a point names an object that is not there.
    """
    rows = [row for row, item in enumerate(pair.objects) if item.box0 is not None]
    objects = [pair.objects[row] for row in rows]
    new_row = np.full(len(pair.objects) + 1, -1, dtype=np.int64)  # the last: -1 stays -1
    new_row[rows] = np.arange(len(rows))
    motions = [np.eye(4) if item.motion is None else item.motion for item in objects]
    return Sample(
        pair_id=pair.pair_id,
        xyz0=pair.scan0.xyz,
        reflectance0=pair.scan0.reflectance,
        xyz1=pair.scan1.xyz,
        reflectance1=pair.scan1.reflectance,
        flow0=pair.flow0,
        status0=pair.flow_status0 != 0,
        instance0=_renumbered(pair.scan0.instance, new_row, pair.pair_id),
        instance1=_renumbered(pair.scan1.instance, new_row, pair.pair_id),
        ego_motion=pair.ego_motion,
        boxes0=np.array([item.box0 for item in objects], dtype=np.float64).reshape(-1, 7),
        category=tuple(item.category for item in objects),
        motion=np.array(motions, dtype=np.float64).reshape(-1, 4, 4),
        has_motion=np.array([item.motion is not None for item in objects], dtype=bool),
        virtual=np.array([item.origin == "virtual" for item in objects], dtype=bool),
        points0=np.array([item.points0 for item in objects], dtype=np.int64),
        label_coverage=pair.label_coverage,
        label_azimuth=pair.label_azimuth,
    )


def is_labelled(xy: F64, coverage: str, azimuth: tuple[float, float] | None) -> Bool:
    """Which places (..., 2) in velo0 the source's own labels reach (contract: `label_coverage`, `label_azimuth`)."""
    if coverage == "camera" and azimuth is not None:
        angle, width = np.arctan2(xy[..., 1], xy[..., 0]), (azimuth[1] - azimuth[0]) % (2.0 * np.pi)
        return np.asarray((angle - azimuth[0]) % (2.0 * np.pi) <= width)
    return np.full(np.shape(xy)[:-1], coverage == "full")


def _renumbered(instance: I16, new_row: I64, pair_id: str) -> I64:
    if len(instance) and not -1 <= int(instance.min()) <= int(instance.max()) < len(new_row) - 1:
        raise InputError(pair_id, f"a point names none of its {len(new_row) - 1} objects", "generate it again")
    return np.asarray(new_row[instance])
