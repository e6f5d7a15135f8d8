"""How virtual cars drive: the bicycle, its limits, and the shares that drives are drawn with."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.config import MotionConfig, load_config
from augkitti.errors import InputError
from augkitti.frames import pose_from_xyz_yaw, se3_exp, transform_points, yaw_of
from augkitti.vehicle_motion import bicycle_twist, bicycle_yaw_rate, draw_drive, drive_planar, steering_limit

CONFIG = MotionConfig()
seeds = st.integers(0, 2**32 - 1)
wheelbases = st.floats(2.0, 6.0)


@settings(max_examples=60, deadline=None)
@given(seeds, wheelbases, st.booleans())
def test_a_drive_keeps_the_limits_of_tyres_and_wheels(seed, wheelbase, must_move):
    drive = draw_drive(wheelbase, must_move, CONFIG, np.random.default_rng(seed))
    assert abs(drive.steering_rad) <= CONFIG.max_steering_rad
    assert abs(drive.speed_mps * drive.yaw_rate_rps) <= CONFIG.max_lateral_mps2 + 1e-9
    assert abs(drive.speed_mps) <= CONFIG.fast_mps
    assert drive.yaw_rate_rps == bicycle_yaw_rate(drive.speed_mps, drive.steering_rad, wheelbase)
    if must_move:
        assert abs(drive.speed_mps) >= CONFIG.moving_mps


@settings(max_examples=40, deadline=None)
@given(st.floats(-5.0, 30.0), st.floats(-0.6, 0.6), wheelbases, st.floats(0.05, 0.15))
def test_the_rear_axle_keeps_its_turning_radius(speed, steering, wheelbase, elapsed):
    rear_x = -0.45 * wheelbase
    yaw_rate = bicycle_yaw_rate(speed, steering, wheelbase)
    twist = bicycle_twist(speed, yaw_rate, rear_x)
    rear = transform_points(se3_exp(twist, np.linspace(0.0, elapsed, 5)), np.array([rear_x, 0.0, 0.0]))
    if abs(steering) > 1e-3:
        radius = wheelbase / np.tan(steering)
        centre = np.array([rear_x, radius, 0.0])
        distance = np.sqrt(((rear - centre) ** 2).sum(axis=1))
        np.testing.assert_allclose(distance, abs(radius), rtol=1e-9)
    steps = np.sqrt((np.diff(rear, axis=0) ** 2).sum(axis=1)).sum()
    np.testing.assert_allclose(steps, abs(speed) * elapsed, rtol=1e-2, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(-3.0, 3.0), st.floats(0.05, 0.15))
def test_seen_from_above_the_drive_is_the_twist(seed, yaw, elapsed):
    drive = draw_drive(2.7, False, CONFIG, np.random.default_rng(seed))
    start = pose_from_xyz_yaw(3.0, -2.0, 0.0, yaw)
    xy, turned = drive_planar(np.array([[3.0, -2.0]]), np.array([yaw]), np.array([elapsed]), drive, -1.3)
    end = start @ se3_exp(bicycle_twist(drive.speed_mps, drive.yaw_rate_rps, -1.3), elapsed)
    np.testing.assert_allclose(xy[0], end[:2, 3], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * turned[0]), np.exp(1j * yaw_of(end)), atol=1e-9)


def test_shares_of_speeds_and_courses_are_those_asked_for():
    rng = np.random.default_rng(3)
    drives = [draw_drive(2.7, False, CONFIG, rng) for _ in range(4000)]
    speed = np.abs([d.speed_mps for d in drives])
    shares = np.array([CONFIG.standing_share, CONFIG.slow_share, CONFIG.town_share, CONFIG.fast_share])
    edges = np.array([0.0, 1e-12, CONFIG.slow_mps, CONFIG.town_mps, CONFIG.fast_mps + 1e-9])
    np.testing.assert_allclose(np.histogram(speed, edges)[0] / 4000, shares / shares.sum(), atol=0.03)
    for course, share in (("along", 0.60), ("against", 0.25), ("turning", 0.075), ("crossing", 0.075)):
        assert abs(np.mean([d.course == course for d in drives]) - share) < 0.03
    assert min(d.speed_mps for d in drives) < 0.0  # some reverse
    assert all(d.speed_mps >= -CONFIG.slow_mps for d in drives)


def test_fast_cars_steer_less():
    limits = [steering_limit(v, 2.7, CONFIG) for v in (0.0, 3.0, 10.0, 25.0)]
    assert limits[0] == limits[1] == CONFIG.max_steering_rad
    assert limits[1] > limits[2] > limits[3] > 0.0


def test_only_standing_cars_where_only_those_are_wanted():
    config = MotionConfig(slow_share=0.0, town_share=0.0, fast_share=0.0)
    rng = np.random.default_rng(0)
    assert all(draw_drive(2.7, False, config, rng).speed_mps == 0.0 for _ in range(50))
    assert all(abs(draw_drive(2.7, True, config, rng).speed_mps) >= config.moving_mps for _ in range(50))


def test_the_least_speed_may_lie_above_slow_speeds():
    config = MotionConfig(moving_mps=6.0)
    rng = np.random.default_rng(0)
    speeds = [abs(draw_drive(2.7, True, config, rng).speed_mps) for _ in range(300)]
    assert min(speeds) >= 6.0
    assert min(speeds) < 15.0


@pytest.mark.parametrize("values", [{"slow_mps": 20.0}, {"fast_mps": 3.0}, {"moving_mps": 40.0}])
def test_speeds_out_of_order_are_refused(values):
    with pytest.raises(InputError, match="motion"):
        load_config(None, motion=values)
