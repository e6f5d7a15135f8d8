"""How a virtual car drives: chance and limits in; speed, heading, steering and the bicycle's constant twist out.

Kinematic bicycle about the rear axle (PointFlowNet section 4.1 calls it Ackermann): the rear axle's middle moves along
the car's heading at `speed`, and the car turns at `speed * tan(steering) / wheelbase`. Over a tenth of a second speed
and steering are constant, so the motion is one constant twist.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from augkitti import same_math as sm
from augkitti.config import MotionConfig
from augkitti.frames import F64

Course = Literal["along", "against", "turning", "crossing"]


@dataclass(frozen=True)
class Drive:
    """What a driver does between the two scans."""

    speed_mps: float  # of the rear axle over ground; negative when reversing
    steering_rad: float  # positive to the left
    yaw_rate_rps: float  # speed * tan(steering) / wheelbase
    course: Course
    heading_rad: float  # against the road axis, counter-clockwise


def draw_drive(wheelbase_m: float, must_move: bool, config: MotionConfig, rng: np.random.Generator) -> Drive:
    """Draw speed, heading and steering within the limits; `must_move` asks for at least `config.moving_mps`."""
    speed = _draw_speed(must_move, config, rng)
    shares = (config.along_share, config.against_share, config.turning_share / 2.0, config.turning_share / 2.0)
    course: Course = ("along", "against", "turning", "crossing")[_pick(shares, rng)]
    spread, side, anywhere = rng.normal(), 1.0 if rng.random() < 0.5 else -1.0, rng.random()
    heading = {
        "along": config.heading_spread_rad * spread,
        "against": np.pi + config.heading_spread_rad * spread,
        "turning": 2.0 * np.pi * anywhere,
        "crossing": side * np.pi / 2.0 + config.crossing_spread_rad * spread,
    }[course]
    steered, hard = config.steering_spread * rng.normal(), rng.uniform(0.4, 1.0)
    share = side * hard if course == "turning" else float(np.clip(steered, -1.0, 1.0))
    steering = share * steering_limit(speed, wheelbase_m, config)
    return Drive(speed, steering, bicycle_yaw_rate(speed, steering, wheelbase_m), course, float(heading))


def steering_limit(speed_mps: float, wheelbase_m: float, config: MotionConfig) -> float:
    """Largest steering angle (radians) at a speed: the wheels' own limit, or where lateral acceleration ends it."""
    gentlest = config.max_lateral_mps2 * wheelbase_m / max(speed_mps * speed_mps, 1e-9)
    return float(min(config.max_steering_rad, sm.arctan(gentlest)))


def bicycle_yaw_rate(speed_mps: float, steering_rad: float, wheelbase_m: float) -> float:
    """Yaw rate (radians per second) of the kinematic bicycle about its rear axle."""
    return float(speed_mps * sm.tan(steering_rad) / wheelbase_m)


def bicycle_twist(speed_mps: float, yaw_rate_rps: float, rear_axle_x_m: float) -> F64:
    """Constant twist (6,) per second in the car frame, whose origin lies `-rear_axle_x_m` before the rear axle."""
    return np.array([speed_mps, -rear_axle_x_m * yaw_rate_rps, 0.0, 0.0, 0.0, yaw_rate_rps])


def drive_planar(xy: F64, yaw_rad: F64, elapsed_s: F64, drive: Drive, rear_axle_x_m: float) -> tuple[F64, F64]:
    """Places (M, 2) and yaws (M,) of car frames after `elapsed_s` (M,), seen from above on level ground."""
    forward = _unit(yaw_rad)
    turned = drive.yaw_rate_rps * elapsed_s
    half = np.where(turned == 0.0, 1e-20, 0.5 * turned)
    chord = drive.speed_mps * elapsed_s * (sm.sin(half) / half)
    along = yaw_rad + 0.5 * turned
    rear = xy + rear_axle_x_m * forward + chord[:, None] * _unit(along)
    yaw = yaw_rad + turned
    return rear - rear_axle_x_m * _unit(yaw), yaw


def _unit(yaw_rad: F64) -> F64:
    """Unit vectors (M, 2) along headings."""
    sine, cosine = sm.sincos(yaw_rad)
    return np.stack([cosine, sine], axis=-1)


def _draw_speed(must_move: bool, config: MotionConfig, rng: np.random.Generator) -> float:
    shares: tuple[float, ...] = (config.standing_share, config.slow_share, config.town_share, config.fast_share)
    edges = (0.0, 0.0, config.slow_mps, config.town_mps, config.fast_mps)
    least = config.moving_mps if must_move else 0.0
    if must_move:  # no kind of speed that ends below
        shares = (0.0, *(share if edges[k] >= least else 0.0 for k, share in enumerate(shares[1:], start=2)))
    kind = _pick(shares, rng)
    speed = float(rng.uniform(max(edges[kind], least), edges[kind + 1])) if kind else 0.0
    return -speed if rng.random() < config.reversing_share and kind == 1 else speed


def _pick(shares: tuple[float, ...], rng: np.random.Generator) -> int:
    """Index drawn by weight; the last one where all weights are 0."""
    total = np.cumsum(shares)
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(shares) - 1)
