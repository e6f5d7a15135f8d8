"""Constant twists of the ego car and of virtual cars: a time from the middle of scan 0 in, poses in the world out.

World is velo0 at the middle of scan 0, held still. `t_s` counts from there in both scans: a ray of scan 1 that fires
`dt` after that scan's middle has `t_s = time1 - time0 + dt`.
"""

import numpy as np
import numpy.typing as npt

from augkitti.frames import F64, compose, invert, se3_exp, se3_log
from augkitti.scan_pair import VirtualCar


def ego_twist(T_velo1_velo0: F64, interval_s: float) -> F64:
    """The scanner's twist (6,) per second, in its own frame, from its motion over `interval_s` between two scans."""
    return np.asarray(se3_log(invert(T_velo1_velo0)) / interval_s, dtype=np.float64)


def T_world_scanner(twist: F64, t_s: npt.ArrayLike) -> F64:
    """Poses S + (4, 4) of the scanner at times of shape S (seconds from time0) under the ego twist (6,) per second."""
    return se3_exp(twist, np.asarray(t_s, dtype=np.float64))


def T_world_car(car: VirtualCar, t_s: npt.ArrayLike) -> F64:
    """Poses S + (4, 4) of a virtual car at times of shape S (seconds from time0)."""
    return compose(car.T_world_car0, se3_exp(car.twist, np.asarray(t_s, dtype=np.float64) - car.moment0_s))
