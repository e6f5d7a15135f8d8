"""Ego-motion: OXTS against a motion known in closed form, poses, registration, and the doubt between them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_drive import CAM_FROM_VELO, CAM_OFFSET_M, T_VELO_IMU, TinyDrive, write_drive

from augkitti import kitti
from augkitti.ego_motion import EgoMotion, find_ego_motion, odometry_motion, oxts_motion, register
from augkitti.frames import compose, invert, pose_from_xyz_yaw, rigid, rotate_vectors, se3_exp, se3_log, yaw_of
from augkitti.scan_pair import Scan

PACKETS_S = np.array([-0.09, 0.017, 0.12, 0.225])


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> tuple[TinyDrive, Scan, Scan]:
    drive = write_drive(tmp_path_factory.mktemp("kitti"), frames=(0, 1), labels="none")
    sequence = kitti.open_root(drive.root).sequences[0]
    return drive, kitti.read_scan(sequence, 0), kitti.read_scan(sequence, 1)


def oxts_rows(twist: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Rows of a car that drives level on an arc: world = velo at time 0."""
    rows = np.zeros((len(times), 30))
    speed_imu = twist[:3] + np.cross(twist[3:], T_VELO_IMU[:3, 3])
    for row, time_s in zip(rows, times, strict=True):
        T = se3_exp(twist, time_s)
        east, north, up = rotate_vectors(T, speed_imu)
        row[5], row[6], row[7], row[10] = yaw_of(T), north, east, up
    return rows


@settings(max_examples=25, deadline=None)
@given(st.floats(-3.0, 30.0), st.floats(-0.6, 0.6), st.floats(0.09, 0.11))
def test_oxts_gives_the_motion_from_middle_to_middle(speed: float, yaw_rate: float, interval_s: float) -> None:
    twist = np.array([speed, 0.0, 0.0, 0.0, 0.0, yaw_rate])
    found = oxts_motion(oxts_rows(twist, PACKETS_S), PACKETS_S, 0.0, interval_s, T_VELO_IMU)
    np.testing.assert_allclose(found, invert(se3_exp(twist, interval_s)), atol=2e-2 * interval_s)


def test_oxts_follows_a_change_of_speed_between_packets() -> None:
    rows = np.zeros((4, 30))
    rows[:, 7] = 10.0 + 5.0 * PACKETS_S  # accelerates eastward, heading east
    found = oxts_motion(rows, PACKETS_S, 0.0, 0.1, T_VELO_IMU)
    np.testing.assert_allclose(invert(found)[:3, 3], [10.0 * 0.1 + 2.5 * 0.01, 0.0, 0.0], atol=1e-9)


def test_two_packets_are_enough() -> None:
    twist = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    found = oxts_motion(oxts_rows(twist, PACKETS_S[1:3]), PACKETS_S[1:3], 0.0, 0.1035, T_VELO_IMU)
    np.testing.assert_allclose(found, invert(se3_exp(twist, 0.1035)), atol=1e-3)


def test_odometry_poses_are_conjugated_with_the_calibration() -> None:
    T_cam_velo = rigid(CAM_FROM_VELO, CAM_OFFSET_M)
    T_world_velo0, T_world_velo1 = pose_from_xyz_yaw(5.0, 1.0, 0.0, 0.3), pose_from_xyz_yaw(6.0, 1.4, 0.1, 0.35)
    found = odometry_motion(
        compose(T_world_velo0, invert(T_cam_velo)), compose(T_world_velo1, invert(T_cam_velo)), T_cam_velo
    )
    np.testing.assert_allclose(found, compose(invert(T_world_velo1), T_world_velo0), atol=1e-12)


@pytest.mark.parametrize("counts", [(0, 500), (500, 0), (0, 0), (19, 500)])
def test_a_scan_with_hardly_a_point_tells_no_motion(counts) -> None:
    scan0, scan1 = (np.random.default_rng(0).normal(size=(count, 3)) for count in counts)
    np.testing.assert_array_equal(register(scan0, scan1), np.eye(4))
    guess = pose_from_xyz_yaw(-1.0, 0.0, 0.0, 0.0)
    np.testing.assert_array_equal(register(scan0, scan1, (guess,)), guess)


def test_registration_finds_the_motion_without_a_guess_and_repeats_its_bytes(scans) -> None:
    drive, scan0, scan1 = scans
    found = register(scan0.xyz, scan1.xyz)
    difference = se3_log(compose(found, invert(drive.T_velo1_velo0)))
    assert np.abs(difference[:3]).max() < 0.02
    assert np.rad2deg(np.abs(difference[3:]).max()) < 0.05
    assert register(scan0.xyz, scan1.xyz).tobytes() == found.tobytes()


@pytest.mark.parametrize(("x", "yaw_deg"), [(0.0, 0.0), (0.02, 0.0), (0.0, 0.05)])
def test_a_motion_that_fits_the_scans_is_kept(scans, x: float, yaw_deg: float) -> None:
    drive, scan0, scan1 = scans
    T = compose(pose_from_xyz_yaw(x, 0.0, 0.0, np.deg2rad(yaw_deg)), drive.T_velo1_velo0)
    found = find_ego_motion(scan0, scan1, EgoMotion(T, "oxts"))
    assert found.source == "oxts"
    assert found.T_velo1_velo0 is T


@pytest.mark.parametrize(("x", "y", "yaw_deg"), [(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 1.0), (-1.5, 0.0, 0.0)])
def test_a_motion_that_the_scans_contradict_gives_way_to_registration(scans, x, y, yaw_deg) -> None:
    drive, scan0, scan1 = scans
    T = compose(pose_from_xyz_yaw(x, y, 0.0, np.deg2rad(yaw_deg)), drive.T_velo1_velo0)
    found = find_ego_motion(scan0, scan1, EgoMotion(T, "oxts"))
    assert found.source == "registration"
    np.testing.assert_allclose(found.T_velo1_velo0, drive.T_velo1_velo0, atol=0.02)


def test_truth_is_never_doubted(scans) -> None:
    _, scan0, scan1 = scans
    assert find_ego_motion(scan0, scan1, EgoMotion(np.eye(4), "truth")).source == "truth"


def test_scans_without_anything_upright_keep_the_known_motion(scans) -> None:
    drive, scan0, _ = scans
    flat = Scan(*(getattr(scan0, name) for name in ("xyz", "reflectance", "row", "rows_in_file", "kind")), 0.0, 0.1)
    low = flat.xyz[:, 2] < -1.5
    flat = Scan(flat.xyz[low], flat.reflectance[low], flat.row[low], flat.rows_in_file, "raw", 0.0, 0.1)
    assert find_ego_motion(flat, flat, EgoMotion(drive.T_velo1_velo0, "oxts")).source == "oxts"


@pytest.mark.kitti
def test_oxts_is_within_4_cm_and_a_tenth_of_a_degree_of_registration(kitti_root: Path) -> None:
    for sequence in kitti.open_root(kitti_root).sequences:
        differences = []
        for frame0, frame1 in sequence.pairs if sequence.layout == "raw" else ():
            known = kitti.known_ego_motion(sequence, frame0)
            assert known is not None
            assert known.source == "oxts"
            scan0, scan1 = kitti.read_scan(sequence, frame0), kitti.read_scan(sequence, frame1)
            registered = register(scan0.xyz, scan1.xyz, (known.T_velo1_velo0,))
            T = compose(invert(known.T_velo1_velo0), registered)
            differences.append((np.linalg.norm(T[:3, 3]), np.linalg.norm(se3_log(T)[3:])))
        if differences:
            rms_m, rms_rad = np.sqrt(np.mean(np.square(differences), axis=0))
            assert rms_m < 0.04, sequence.name
            assert np.rad2deg(rms_rad) < 0.1, sequence.name
