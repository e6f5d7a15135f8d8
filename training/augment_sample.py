"""Augmentation of training pairs: a sample and a random generator in, a sample with all labels in step out.

VoxelNet's three kinds, for pairs: single objects turned and shifted, then the whole scene scaled, turned about z and
mirrored. A fourth is of pairs alone: the observer, moved before its second scan. Both scans, flow, boxes, motions and
ego-motion change together:

- The scene's map is linear, p' = A p with A = s Q (Q a turn, or a mirror). A motion M = (R, t) becomes (Q R Q^T, A t),
  flow becomes A v, so `flow = M p - p` stays. Scaling scales the translations of all motions, the ego car's too.
- An object's move D (a turn about its own vertical axis, a shift in the plane) holds in the world of scan 0, so it is
  E D E^-1 in scan 1, and its motion becomes E D E^-1 M D^-1: seen from the street it drives the same way along its new
  heading, and what stands goes on standing.
- The observer's move D takes scan 1 to D p, every motion and the ego-motion M to D M: as if it had driven otherwise,
  but for shadows and rings on the ground, which stay those of where it was. A few ego-motions become many.
"""

from dataclasses import replace

import numpy as np

from augkitti.frames import F32, F64, footprint_corners, footprints_overlap, invert, rigid, wrap_angle
from augkitti.scan_pair import I64, Bool
from training.config import TrainConfig
from training.sample import Sample

_WIDE_RAD = 0.5 * np.pi  # takes what the camera sees, and so labels, to every place before the car
_ABOVE_UNDERSIDE_M = 0.3  # of a box: below, what lies in it is ground
_EGO_BOX = np.array([0.0, 0.0, 0.0, 5.5, 2.4, 2.0, 0.0])  # the ego car, roughly: no object is shifted into it


def augment_sample(sample: Sample, config: TrainConfig, rng: np.random.Generator) -> Sample:
    """Objects and observer moved, then the scene scaled, turned and mirrored, as far as `config` allows."""
    count = len(sample.boxes0)
    turns = config.box_rotation_rad * rng.uniform(-1.0, 1.0, count)
    shifts = config.box_shift_m * rng.standard_normal((count, 2))
    ego_turn = config.ego_turn_rad * rng.standard_normal()
    ego_shift = config.ego_shift_m * rng.standard_normal(2)
    factor = 1.0 + config.scale * rng.uniform(-1.0, 1.0)
    widest_rad = _WIDE_RAD if rng.random() < config.wide_share else config.rotation_rad
    angle_rad = widest_rad * rng.uniform(-1.0, 1.0)
    mirror = config.flip and rng.random() < 0.5
    if turns.any() or shifts.any():
        sample = move_objects(sample, turns, shifts)
    A = factor * _about_z(angle_rad)
    if ego_turn or ego_shift.any():
        sample = move_observer(sample, ego_turn, ego_shift)
    if mirror:
        A = _MIRROR @ A
    return _mapped(sample, A, factor, angle_rad, mirror)  # one pass over the points


def scale(sample: Sample, factor: float) -> Sample:
    """The scene `factor` times as large, about the scanner."""
    return _mapped(sample, factor * np.eye(3), factor, 0.0, False)


def turn(sample: Sample, angle_rad: float) -> Sample:
    """The scene turned about the scanner's z axis, counter-clockwise."""
    return _mapped(sample, _about_z(angle_rad), 1.0, angle_rad, False)


def flip(sample: Sample) -> Sample:
    """The scene with left and right exchanged; twice is the scene itself, bit for bit."""
    return _mapped(sample, _MIRROR, 1.0, 0.0, True)


def move_objects(sample: Sample, turns_rad: F64, shifts_m: F64) -> Sample:
    """Single objects turned about their own vertical axis and shifted in the ground plane, in the world of scan 0.

    An object stays as it is where its motion is not known, or where in either scan it would touch another box or the
    ego car, or hold more foreign points above its underside than before. Ground and shadows stay as they were.

    Args:
        sample: not changed.
        turns_rad: (B,) counter-clockwise.
        shifts_m: (B, 2) along x and y of velo0.
    """
    xyz0, xyz1, flow0 = sample.xyz0.copy(), sample.xyz1.copy(), sample.flow0.copy()
    boxes0, motion = sample.boxes0.copy(), sample.motion.copy()
    boxes1 = np.array([_carried(box, M) for box, M in zip(boxes0, motion, strict=True)]).reshape(-1, 7)
    E = sample.ego_motion
    for row in np.flatnonzero(sample.has_motion):
        D0 = _about_box(boxes0[row], float(turns_rad[row]), shifts_m[row])
        D1 = E @ D0 @ invert(E)
        new0, new1 = _carried(boxes0[row], D0), _carried(boxes1[row], D1)
        free0 = _is_free(xyz0, sample.instance0, boxes0, new0, int(row))
        if not (free0 and _is_free(xyz1, sample.instance1, boxes1, new1, int(row))):
            continue
        boxes0[row], boxes1[row] = new0, new1
        motion[row] = D1 @ motion[row] @ invert(D0)
        mine0, mine1 = np.flatnonzero(sample.instance0 == row), np.flatnonzero(sample.instance1 == row)
        xyz0[mine0], xyz1[mine1] = _apply(D0, xyz0[mine0]), _apply(D1, xyz1[mine1])
        known = ~sample.status0[mine0]
        flow0[mine0[known]] = _displacement(motion[row], xyz0[mine0[known]])
        flow0[mine0[~known]] = _displacement(E, xyz0[mine0[~known]])  # contract: where not known, E p - p
    return replace(sample, xyz0=xyz0, xyz1=xyz1, flow0=flow0, boxes0=boxes0, motion=motion)


def move_observer(sample: Sample, turn_rad: float, shift_m: F64) -> Sample:
    """The second scan seen from another place: velo1 after a turn about its z axis, then a shift in its plane.

    Args:
        sample: not changed.
        turn_rad: of the world about the scanner, counter-clockwise.
        shift_m: (2,) of the world along x and y.
    """
    D = rigid(_about_z(turn_rad), np.array([shift_m[0], shift_m[1], 0.0]))
    return replace(
        sample,
        xyz1=_apply(D, sample.xyz1),
        flow0=_apply(D, sample.xyz0 + sample.flow0) - sample.xyz0,
        ego_motion=D @ sample.ego_motion,
        motion=np.where(sample.has_motion[:, None, None], D @ sample.motion, sample.motion),
    )


_MIRROR = np.diag([1.0, -1.0, 1.0])


def _mapped(sample: Sample, A: F64, factor: float, angle_rad: float, mirror: bool) -> Sample:
    """The scene under p' = A p, where A is scaled by `factor`, then turned, then perhaps mirrored."""
    boxes0 = sample.boxes0.copy()
    boxes0[:, :3] = boxes0[:, :3] @ A.T
    boxes0[:, 3:6] *= factor
    azimuth = sample.label_azimuth
    if angle_rad:
        boxes0[:, 6] = wrap_angle(boxes0[:, 6] + angle_rad)
        azimuth = None if azimuth is None else (azimuth[0] + angle_rad, azimuth[1] + angle_rad)
    if mirror:
        boxes0[:, 6] *= -1.0
        azimuth = None if azimuth is None else (-azimuth[1], -azimuth[0])
    small = A.T.astype(np.float32)
    return replace(
        sample,
        xyz0=sample.xyz0 @ small,
        xyz1=sample.xyz1 @ small,
        flow0=sample.flow0 @ small,
        ego_motion=_conjugated(sample.ego_motion, A, factor),
        boxes0=boxes0,
        motion=_conjugated(sample.motion, A, factor),
        label_azimuth=azimuth,
    )


def _conjugated(motion: F64, A: F64, factor: float) -> F64:
    """A M A^-1 of motions (..., 4, 4): the rotation in the new axes, the translation mapped with the points."""
    Q = A / factor
    out = motion.copy()
    out[..., :3, :3] = Q @ motion[..., :3, :3] @ Q.T
    out[..., :3, 3] = motion[..., :3, 3] @ A.T
    return np.asarray(out)


def _about_z(angle_rad: float) -> F64:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_box(box: F64, turn_rad: float, shift_m: F64) -> F64:
    """A turn about a box's vertical axis, then a shift in the plane, as a matrix (4, 4)."""
    R = _about_z(turn_rad)
    return rigid(R, box[:3] - R @ box[:3] + np.array([shift_m[0], shift_m[1], 0.0]))


def _carried(box: F64, motion: F64) -> F64:
    """A box (7,) after a motion (4, 4) that is nearly about a vertical axis."""
    heading = motion[:3, :3] @ np.array([np.cos(box[6]), np.sin(box[6]), 0.0])
    return np.array([*(motion[:3, :3] @ box[:3] + motion[:3, 3]), *box[3:6], np.arctan2(heading[1], heading[0])])


def _apply(motion: F64, xyz: F32) -> F32:
    return np.asarray((xyz @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32))


def _displacement(motion: F64, xyz: F32) -> F32:
    return np.asarray((xyz @ (motion[:3, :3] - np.eye(3)).T + motion[:3, 3]).astype(np.float32))


def _is_free(xyz: F32, instance: I64, boxes: F64, new: F64, row: int) -> bool:
    """Whether an object's new box touches no other one and holds no more foreign points than its old one."""
    corners, reach = footprint_corners(new), float(np.hypot(new[3], new[4]))
    for other in (*np.delete(boxes, row, axis=0), _EGO_BOX):
        apart = np.hypot(other[0] - new[0], other[1] - new[1])
        if apart < 0.5 * (reach + np.hypot(other[3], other[4])) and footprints_overlap(
            corners, footprint_corners(other)
        ):
            return False
    x, y = xyz[:, 0] - np.float32(new[0]), xyz[:, 1] - np.float32(new[1])
    shift = float(np.hypot(*(new[:2] - boxes[row, :2])))
    near = np.flatnonzero(x * x + y * y < np.float32((0.5 * reach + shift) ** 2))  # both boxes lie in here
    foreign = xyz[near[instance[near] != row]]
    return bool(_inside(foreign, new).sum() <= _inside(foreign, boxes[row]).sum())


def _inside(xyz: F32, box: F64) -> Bool:
    """Points (N, 3) in a box, its lowest part left out."""
    offset = xyz - box[:3]
    c, s = np.cos(box[6]), np.sin(box[6])
    along, across = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
    inside = (np.abs(along) <= 0.5 * box[3]) & (np.abs(across) <= 0.5 * box[4])
    return np.asarray(inside & (offset[:, 2] <= 0.5 * box[5]) & (offset[:, 2] >= _ABOVE_UNDERSIDE_M - 0.5 * box[5]))
