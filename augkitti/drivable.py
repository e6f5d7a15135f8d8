"""Where a car may stand: a scan, its rays and its ground in, a bird's-eye grid of free cells and the road's heading out.

A cell is free when ground was seen in it, or when a ray passed low over it on its way to the next ground behind. Things
up to car height and kerbs take cells away; what is left must be wide enough for a car and hang together with the road
under the ego car.
"""

import numpy as np
from scipy import ndimage

from augkitti._bev_grid import I64, cell_centres, cell_of, interpolate, mean_by_cell
from augkitti.config import DrivableConfig
from augkitti.frames import F64, Array
from augkitti.ground import height_at
from augkitti.scan_pair import Bool, DrivableRegion, GroundMap, Scan, ScanRays

_COLUMNS = 1440  # azimuth columns in which ground is followed outwards: 0.25 degrees, a little more than a firing


def find_drivable_region(scan: Scan, rays: ScanRays, ground: GroundMap, config: DrivableConfig) -> DrivableRegion:
    """The free cells round the ego car that a car can stand on, connected with the road under it."""
    p = scan.xyz.astype(np.float64)
    cells = 2 * int(np.ceil(config.reach_m / config.cell_m))
    shape = (cells, cells)
    origin = (-0.5 * cells * config.cell_m, -0.5 * cells * config.cell_m)
    flat, inside = cell_of(p, origin, config.cell_m, shape)
    above = p[:, 2] - height_at(ground, p)
    free = _seen_or_passed_over(p, above, inside, origin, shape, ground, config)
    blocked = _standing(flat, above, inside, shape, config) | _kerbs(p, above, flat, inside, shape, ground, config)
    region = _connected(free & ~blocked, origin, config)
    return DrivableRegion(origin, config.cell_m, region, _road_heading(region, origin, config))


def is_drivable(region: DrivableRegion, xy: Array) -> Bool:
    """Which places (M, 2) metres lie in a drivable cell; none beyond the grid."""
    xy = np.atleast_2d(np.asarray(xy, dtype=np.float64))[:, :2]
    rows, columns = region.drivable.shape
    flat, inside = cell_of(xy, region.origin_m, region.cell_m, (rows, columns))
    return np.asarray(inside & region.drivable.ravel()[flat])


def _seen_or_passed_over(
    p: F64,
    above: F64,
    inside: Bool,
    origin: tuple[float, float],
    shape: tuple[int, int],
    ground: GroundMap,
    config: DrivableConfig,
) -> Bool:
    """Cells with ground in them, or between two ground returns of one azimuth column with the ray low over the gap."""
    on_ground = inside & ground.is_ground & (np.abs(above) < config.low_m)
    q = p[on_ground]
    r = np.hypot(q[:, 0], q[:, 1])
    column = ((np.arctan2(q[:, 1], q[:, 0]) + np.pi) * (_COLUMNS / (2.0 * np.pi))).astype(np.int64)
    order = np.lexsort((r, column))
    q, r, column = q[order], r[order], column[order]
    gap = r[1:] - r[:-1]
    sensor = ground.plane[3] / ground.plane[2]
    low = sensor * gap / r[1:] < config.pass_m  # the farther return's ray is at most this high over the nearer one
    bridged = np.flatnonzero((column[1:] == column[:-1]) & low & (gap > 0.0))
    steps = np.ceil(gap[bridged] / config.cell_m).astype(np.int64) + 1
    pair = np.repeat(bridged, steps)
    first = np.cumsum(steps) - steps
    share = (np.arange(len(pair)) - np.repeat(first, steps)) / np.repeat(np.maximum(steps - 1, 1), steps)
    between = q[pair, :2] + share[:, None] * (q[pair + 1, :2] - q[pair, :2])
    flat, there = cell_of(np.concatenate([q[:, :2], between]), origin, config.cell_m, shape)
    free = np.bincount(flat[there], minlength=shape[0] * shape[1]).reshape(shape) > 0
    return np.asarray(ndimage.binary_closing(free, iterations=1))


def _standing(flat: I64, above: F64, inside: Bool, shape: tuple[int, int], config: DrivableConfig) -> Bool:
    """Cells with something in them between kerb and car height."""
    stands = inside & (above > config.low_m) & (above < config.car_height_m)
    return np.asarray(np.bincount(flat[stands], minlength=shape[0] * shape[1]).reshape(shape) > 0)


def _kerbs(
    p: F64, above: F64, flat: I64, inside: Bool, shape: tuple[int, int], ground: GroundMap, config: DrivableConfig
) -> Bool:
    """Cells in whose surroundings the ground steps up or down by more than a kerb's least height."""
    smooth = ndimage.gaussian_filter(ground.height_m.astype(np.float64), 2.0 / ground.cell_m)
    x0, y0 = ground.origin_m
    near = inside & (np.abs(above) < config.low_m)
    q = p[near]
    relief = q[:, 2] - interpolate(smooth, (q[:, 0] - x0) / ground.cell_m, (q[:, 1] - y0) / ground.cell_m)
    mean, count = mean_by_cell(flat[near], relief, shape[0] * shape[1])
    seen = (count > 0).reshape(shape)
    height = mean.reshape(shape)
    highest = ndimage.maximum_filter(np.where(seen, height, -np.inf), size=3)
    lowest = ndimage.minimum_filter(np.where(seen, height, np.inf), size=3)
    with np.errstate(invalid="ignore"):
        return np.asarray(seen & (highest - lowest > config.kerb_m))


def _connected(free: Bool, origin: tuple[float, float], config: DrivableConfig) -> Bool:
    """What a disc of half a car's width reaches from the ego car without leaving the free cells."""
    x, y = cell_centres(origin, config.cell_m, (free.shape[0], free.shape[1]))
    under_ego = (np.abs(x) < 4.5) & (np.abs(y) < 1.2)  # nothing is seen there, but the ego car stands on road
    free = free | under_ego
    radius = config.half_width_m / config.cell_m
    core = ndimage.distance_transform_edt(free) > radius
    label, _ = ndimage.label(core)
    near = (np.abs(x) < 8.0) & (np.abs(y) < 2.0) & core
    found = np.unique(label[near])
    keep = np.isin(label, found[found > 0])
    return np.asarray((ndimage.distance_transform_edt(~keep) <= radius) & free) if keep.any() else under_ego & free


def _road_heading(region: Bool, origin: tuple[float, float], config: DrivableConfig) -> float:
    return 0.0
