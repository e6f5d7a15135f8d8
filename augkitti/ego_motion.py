"""How the ego car moved between two scans: OXTS rows, odometry poses or the scans alone in, `T_velo1_velo0` out.

`T_velo1_velo0` maps the coordinates of a standing point from velo0 to velo1, from the middle of one revolution to the
middle of the next. Sources in order of trust: truth of a synthetic drive, OXTS or odometry poses, registration.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from augkitti import same_math as sm
from augkitti.frames import F64, Array, compose, invert, orthonormal, pose_from_xyz_yaw, rigid, se3_exp, se3_log
from augkitti.scan_pair import Scan

EgoSource = Literal["oxts", "poses", "registration", "truth"]
METHOD = "ego-motion 2"  # part of cache keys: raise it when a figure below or the method changes

_FEWEST_POINTS = 20  # of a scan that can be registered; of an empty one the library makes a crash
_ROLL, _PITCH, _YAW, _VN, _VE, _VU = 3, 4, 5, 6, 7, 10  # columns of an OXTS row


@dataclass(frozen=True, eq=False)
class EgoMotion:
    """The ego car's motion between two scans and where it was read."""

    T_velo1_velo0: F64  # (4, 4)
    source: EgoSource


def oxts_motion(rows: Array, packet_time_s: Array, time0_s: float, time1_s: float, T_velo_imu: F64) -> F64:
    """`T_velo1_velo0` (4, 4) from OXTS rows round two scans.

    Translation is the integral of the velocity, which is linear in time between packets, from middle to middle.
    Rotation is the difference of the orientations at the two middles, interpolated between packets. Packets come 5 to
    38 ms after the scans' middles, irregularly: taking the rows of the two scans as they are, or their difference
    scaled to the interval, doubles the rotation error while the car pitches. GPS positions jump by centimetres.

    Args:
        rows: (K, 30) rows in order of time, K >= 2, KITTI's columns (velocities east, north, up; m/s; rad).
        packet_time_s: (K,) their times, rising.
        time0_s: middle of scan 0, in the same clock.
        time1_s: middle of scan 1.
        T_velo_imu: the day's calibration.
    """
    rows = np.asarray(rows, dtype=np.float64)
    times = np.asarray(packet_time_s, dtype=np.float64)
    R_enu_imu0, R_enu_imu1 = (_orientation(rows, times, moment) for moment in (time0_s, time1_s))

    knots = np.concatenate([[time0_s], times[(times > time0_s) & (times < time1_s)], [time1_s]])
    velocity_enu = np.stack([_linear(knots, times, rows[:, column]) for column in (_VE, _VN, _VU)], axis=1)
    travel_enu = (0.5 * (velocity_enu[1:] + velocity_enu[:-1]) * np.diff(knots)[:, None]).sum(axis=0)

    T_imu0_imu1 = rigid(sm.product(R_enu_imu0.T, R_enu_imu1), sm.product(R_enu_imu0.T, travel_enu))
    T_velo0_velo1 = compose(compose(T_velo_imu, T_imu0_imu1), invert(T_velo_imu))
    return invert(orthonormal(T_velo0_velo1))


def odometry_motion(T_world_cam0: F64, T_world_cam1: F64, T_cam_velo: F64) -> F64:
    """`T_velo1_velo0` (4, 4) from two odometry poses of camera 0 and the calibration `Tr`."""
    T_cam1_cam0 = compose(invert(orthonormal(T_world_cam1)), orthonormal(T_world_cam0))
    T_cam_velo = orthonormal(T_cam_velo)
    return orthonormal(compose(compose(invert(T_cam_velo), T_cam1_cam0), T_cam_velo))


def register(xyz0: Array, xyz1: Array, guesses: tuple[F64, ...] | None = None) -> F64:
    """`T_velo1_velo0` (4, 4) from the scans alone: GICP, coarse (1 m voxels) then fine (0.25 m), on one thread.

    Args:
        xyz0: (N, 3) points of scan 0, metres.
        xyz1: (M, 3) points of scan 1.
        guesses: motions to start from; without, driving straight on at 0, 12.5 and 25 m/s. The start whose coarse
            result leaves the smallest distances goes on to the fine step.

    Returns:
        The motion; the first guess, or none, where a scan has under 20 points and so tells nothing.
    """
    if min(len(xyz0), len(xyz1)) < _FEWEST_POINTS:
        return guesses[0] if guesses else np.eye(4)
    starts = guesses or tuple(pose_from_xyz_yaw(-step, 0.0, 0.0, 0.0) for step in (0.0, 1.3, 2.6))
    coarse = [_align(xyz0, xyz1, start, voxel_m=1.0, reach_m=2.0) for start in starts]
    if len(coarse) > 1:
        misfit = Misfit(xyz0, xyz1)
        coarse.sort(key=misfit)
    return _align(xyz0, xyz1, coarse[0], voxel_m=0.25, reach_m=1.0)


class Misfit:
    """How badly a motion lays scan 0 onto scan 1: mean distance to the nearest point, cut at 1 m, over upright things.

    The ground is left out, since it fits whatever the car did along it.
    """

    def __init__(self, xyz0: Array, xyz1: Array) -> None:
        kept0, kept1 = _upright(xyz0), _upright(xyz1)
        step = max(1, len(kept0) // 4000)
        self._points = np.asarray(kept0[::step], dtype=np.float64)
        self._tree = cKDTree(np.asarray(kept1, dtype=np.float64)) if len(kept1) else None

    def __call__(self, T_velo1_velo0: F64) -> float:
        """Metres; 1.0 where the scans hold nothing upright."""
        if self._tree is None or not len(self._points):
            return 1.0
        R, t = T_velo1_velo0[:3, :3], T_velo1_velo0[:3, 3]
        moved = np.stack([(self._points * R[i]).sum(axis=1) + t[i] for i in range(3)], axis=1)
        distance, _ = self._tree.query(moved, distance_upper_bound=1.0)
        return float(np.minimum(distance, 1.0).mean())


def contradicted(T_velo1_velo0: F64, misfit: Misfit) -> bool:
    """Whether the scans speak against a motion: one 0.2 or 1 m, or 0.4 or 2 degrees, beside it fits better by 5 %.

    Cheap (one tree, 13 lookups of 4,000 points), and silent where the scans cannot tell, as between bare walls. On
    real scans a motion good to 3 cm fits better than all its neighbours by 15 % or more; one that is wrong by 0.15 m or
    0.3 degrees fits worse than the best of them by 5 % or more.
    """
    best = min(
        misfit(compose(pose_from_xyz_yaw(sign * x_m, sign * y_m, 0.0, sign * np.deg2rad(yaw_deg)), T_velo1_velo0))
        for x_m, y_m, yaw_deg in ((0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.4), (1.0, 0, 0), (0, 1.0, 0), (0, 0, 2.0))
        for sign in (1.0, -1.0)
    )
    return best < 0.95 * misfit(T_velo1_velo0)


def find_ego_motion(scan0: Scan, scan1: Scan, known: EgoMotion | None) -> EgoMotion:
    """The motion known from the drive's files unless the scans contradict it; else registration.

    Args:
        scan0: first scan.
        scan1: its successor.
        known: from OXTS, poses or truth; None where the drive has neither. Truth is never doubted.
    """
    if known is not None and known.source == "truth":
        return known
    if known is None:
        return EgoMotion(register(scan0.xyz, scan1.xyz), "registration")
    misfit = Misfit(scan0.xyz, scan1.xyz)
    if not contradicted(known.T_velo1_velo0, misfit):
        return known
    starts = (known.T_velo1_velo0, *(pose_from_xyz_yaw(-step, 0.0, 0.0, 0.0) for step in (0.0, 1.3, 2.6)))
    registered = register(scan0.xyz, scan1.xyz, starts)
    if misfit(registered) < 0.95 * misfit(known.T_velo1_velo0):
        return EgoMotion(registered, "registration")
    return known


def _align(xyz0: Array, xyz1: Array, T_velo1_velo0: F64, voxel_m: float, reach_m: float) -> F64:
    result = small_gicp.align(
        np.asarray(xyz1, dtype=np.float64),
        np.asarray(xyz0, dtype=np.float64),
        init_T_target_source=np.asarray(T_velo1_velo0, dtype=np.float64),
        registration_type="GICP",
        downsampling_resolution=voxel_m,
        max_correspondence_distance=reach_m,
        max_iterations=40,
        translation_epsilon=1e-5,
        rotation_epsilon=1e-6,  # the default, 0.1 degrees, stops where rotations are still wrong by more than that
        num_threads=1,  # more threads change the order of sums, and so the last bits
    )
    twist = se3_log(orthonormal(np.asarray(result.T_target_source)))
    return se3_exp(np.round(twist, 9))  # its last bits depend on the processor; a nanometre does not


def _upright(xyz: Array) -> Array:
    """Points between 1 m below the scanner and 2 m above it, within 50 m: cars, walls, poles, trunks."""
    kept: Array = xyz[(xyz[:, 2] > -1.0) & (xyz[:, 2] < 2.0) & (np.abs(xyz[:, :2]).max(axis=1) < 50.0)]
    return kept


def _rotation(row: Array) -> F64:
    """`R_enu_imu` (3, 3) of one OXTS row."""
    cr, sr = sm.cos(row[_ROLL]), sm.sin(row[_ROLL])
    cp, sp = sm.cos(row[_PITCH]), sm.sin(row[_PITCH])
    cy, sy = sm.cos(row[_YAW]), sm.sin(row[_YAW])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(sm.product(sm.product(about_z, about_y), about_x))


def _orientation(rows: Array, times: Array, moment_s: float) -> F64:
    """`R_enu_imu` (3, 3) at a moment, turning evenly between packets and on beyond the ends."""
    low = int(np.clip(np.searchsorted(times, moment_s, side="right") - 1, 0, len(times) - 2))
    before, after = _rotation(rows[low]), _rotation(rows[low + 1])
    turn = se3_log(rigid(sm.product(before.T, after), np.zeros(3)))
    share = (moment_s - times[low]) / (times[low + 1] - times[low])
    return np.asarray(sm.product(before, se3_exp(turn, share)[:3, :3]))


def _linear(at: Array, times: Array, values: Array) -> F64:
    """Linear interpolation that goes on straight beyond the ends."""
    low = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    share = (at - times[low]) / (times[low + 1] - times[low])
    return np.asarray(values[low] + share * (values[low + 1] - values[low]))
