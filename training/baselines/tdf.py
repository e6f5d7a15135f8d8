"""Points in, patches of a truncated distance field about keypoints out: what 3DMatch's network sees.

One volume a scan holds the field of the whole scene, and a keypoint's patch is cut out of it: patches overlap so much
that each by itself would compute every distance hundreds of times.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from augkitti.frames import F32, F64, Array
from augkitti.scan_pair import Bool


@dataclass(frozen=True)
class FieldConfig:
    """Of the field and its patches."""

    voxel_m: float = 0.1
    patch: int = 30  # voxels to a side of a patch
    truncation: int = 5  # voxels; from so far off a surface on the field is 0 (3DMatch)
    reach_m: float = 60.0  # the volume goes so far along x and y each way
    low_m: float = -3.5  # and from so far
    high_m: float = 2.5  # to so far along z


@dataclass(frozen=True, eq=False)
class Field:
    """The truncated distance field of a scan: 1 on surfaces, falling to 0 at the truncation and beyond."""

    value: F32  # (X, Y, Z)
    origin_m: F64  # (3,) corner of voxel [0, 0, 0], velo
    voxel_m: float


def distance_field(xyz: Array, config: FieldConfig) -> Field:
    """The field of points (N, 3), metres, velo: `1 - d / truncation` of voxels d off the nearest occupied voxel.

    Distances are between voxel centres, as in 3DMatch. The same numbers as `scipy.ndimage.distance_transform_edt`
    gives, from the occupied voxels outwards: a street fills one voxel in a hundred, and only a few voxels round each
    are wanted.
    """
    margin = config.patch // 2 + config.truncation
    low = np.array([-config.reach_m, -config.reach_m, config.low_m]) - margin * config.voxel_m
    size = np.array([2.0 * config.reach_m, 2.0 * config.reach_m, config.high_m - config.low_m])
    shape = np.ceil(size / config.voxel_m).astype(np.int64) + 2 * margin
    at = np.floor((np.asarray(xyz, dtype=np.float64) - low) / config.voxel_m)
    at = at[((at >= config.truncation) & (at < shape - config.truncation)).all(axis=1)].astype(np.int64)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    occupied = np.unique(at @ strides)
    value = np.zeros(int(shape.prod()), dtype=np.float32)
    for offset, distance in zip(*_ball(config.truncation), strict=True):  # the nearest last, so that it stays
        value[occupied + offset @ strides] = 1.0 - distance / config.truncation
    return Field(value.reshape(shape), low, config.voxel_m)


def in_reach(xyz: Array, config: FieldConfig) -> Bool:
    """About which places (N, 3) a whole patch can be cut out (N,)."""
    flat = np.abs(xyz[:, :2]).max(axis=1, initial=0.0) < config.reach_m
    return np.asarray(flat & (xyz[:, 2] >= config.low_m) & (xyz[:, 2] < config.high_m))


def patches(field: Field, xyz: Array, side: int) -> F32:
    """Patches (K, side, side, side) about places (K, 3) that are `in_reach`; of an even side the middle is a corner."""
    half = 0.0 if side % 2 else 0.5
    middle = np.floor((np.asarray(xyz, dtype=np.float64) - field.origin_m) / field.voxel_m + half).astype(np.int64)
    corner = middle - side // 2
    windows = sliding_window_view(field.value, (side, side, side))
    return np.ascontiguousarray(windows[corner[:, 0], corner[:, 1], corner[:, 2]])


def _ball(radius: int) -> tuple[Array, F64]:
    """Offsets (n, 3) of voxels nearer than `radius`, and their distances (n,), the farthest first."""
    line = np.arange(-radius + 1, radius)
    offset = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.sqrt((offset**2).sum(axis=1))
    offset, distance = offset[distance < radius], distance[distance < radius]
    order = np.argsort(-distance, kind="stable")
    return offset[order], distance[order]
