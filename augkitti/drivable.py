"""Where a car may stand: a scan, its rays and ground in, a bird's-eye grid of free cells and the road's heading out.

A cell is free when smooth ground was seen in it, or when a ray passed low over it on its way from one stretch of smooth
ground to the next. Things up to car height take cells away, and so do edges of the road: along a ring a kerb is a step
of height and a verge is rough, and what neighbouring rings show of one edge is joined by a line. What is left must be
wide enough for a car and hang together with the road under the ego car.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from augkitti import same_math as sm
from augkitti._bev_grid import I64, cell_centres, cell_of, interpolate
from augkitti.config import DrivableConfig
from augkitti.frames import F64, Array, wrap_angle
from augkitti.ground import height_at
from augkitti.scan_pair import Bool, DrivableRegion, GroundMap, Scan, ScanRays

_COLUMNS = 1440  # azimuth columns in which ground is followed outwards: 0.25 degrees, a little more than a firing
_UNSEEN_M = 4.2  # no beam meets the ground nearer than 4 m, at KITTI's height
_BLIND_M = 7.0  # the first ground seen lies nearer than this, where the ego car does not hide it
_HEADING_REACH_M = 20.0
_HEADING_SPREAD_RAD = 0.6  # the ego car drives along its road, but turns off now and then
_LATERAL_BIN_M = 0.2
_STRAY_LIMIT_M = 0.02  # a single kerb or rail must not make its whole surroundings rough
_NEAR_RINGS_M = 20.0  # farther off, neighbouring rings lie more than a metre apart on the ground
_RELIEF_M = 4.0  # slopes wider than this are no kerbs
LARGEST_BEND_RAD = 0.7  # beyond it is a side street, if the region is long there
_ROAD_WINDOW_M = 7.0  # half of the window in which the region's long axis is the road
_ROAD_CELL_M = 0.8  # coarse is fine enough for an axis
_EGO_ROAD_WEIGHT = 0.15  # of the ego road's axis, against 1 for a line and 0 for a square
_LEAST_LONG = 0.3
_TURN = 10.0  # more than 2 pi: keeps rings apart in one sorted list of azimuths


@dataclass(frozen=True, eq=False)
class _Low:
    """The points close to the ground, sorted by ring and azimuth."""

    xyz: F64  # (L, 3)
    range_m: F64  # (L,) seen from above
    key: F64  # (L,) ring * _TURN + azimuth, ascending
    ring: I64  # (L,)
    above: F64  # (L,) over the ground map
    relief_m: F64  # (L,) over the ground smoothed so far that kerbs stand out of it
    step_m: F64  # (L,) height difference between the two sides, along the ring
    rough_m: F64  # (L,) how far heights stray from their neighbours' mean, along the ring


def find_drivable_region(scan: Scan, rays: ScanRays, ground: GroundMap, config: DrivableConfig) -> DrivableRegion:
    """The free cells round the ego car that a car can stand on, connected with the road under it."""
    p = scan.xyz.astype(np.float64)
    cells = 2 * int(np.ceil(config.reach_m / config.cell_m))
    grid = _Grid((-0.5 * cells * config.cell_m, -0.5 * cells * config.cell_m), config.cell_m, (cells, cells))
    above = p[:, 2] - height_at(ground, p)
    low = _low_points(p, above, rays, ground, config)
    edge = (low.step_m > config.kerb_m) | _rough(low, grid, config)
    free = _seen_or_passed_over(low, edge, ground, grid, config)
    blocked = _standing(p, above, grid, config) | _edge_lines(low, grid, config) | _kerbs(low, grid, config)
    region = _connected(free & ~blocked, grid, config)
    return with_headings(grid.origin_m, grid.cell_m, region, _road_heading(blocked, grid))


def with_headings(
    origin_m: tuple[float, float], cell_m: float, drivable: Bool, road_heading_rad: float
) -> DrivableRegion:
    """A region with the road's heading everywhere, within a right angle of the ego road's: its long axis round there.

    Second moments of the region in a window; an axis and its opposite are one, hence doubled angles. Where the window
    has no long axis (squares, junctions) the ego road's own heading stands.
    """
    step = max(1, round(_ROAD_CELL_M / cell_m))
    window = 2 * int(_ROAD_WINDOW_M / (step * cell_m)) + 1
    whole = -(-np.array(drivable.shape) // step) * step  # the last cells may be cut
    area = np.zeros(whole)
    area[: drivable.shape[0], : drivable.shape[1]] = drivable
    area = area[step // 2 :: step, step // 2 :: step]
    u = np.arange(area.shape[0])[:, None] * step * cell_m
    v = np.arange(area.shape[1])[None, :] * step * cell_m

    def mean(values: F64) -> F64:
        return np.asarray(ndimage.uniform_filter(values, window, mode="constant"), dtype=np.float64)

    total = np.maximum(mean(area), 1e-9)
    mu, mv = mean(area * u) / total, mean(area * v) / total
    uu, vv = mean(area * u * u) / total - mu * mu, mean(area * v * v) / total - mv * mv
    uv = mean(area * u * v) / total - mu * mv
    spread = np.maximum(uu + vv, 1e-9)
    cosine = (uu - vv) / spread + _EGO_ROAD_WEIGHT * sm.cos(2.0 * road_heading_rad)
    sine = 2.0 * uv / spread + _EGO_ROAD_WEIGHT * sm.sin(2.0 * road_heading_rad)
    bend = 0.5 * np.asarray(wrap_angle(sm.arctan2(sine, cosine) - 2.0 * road_heading_rad), dtype=np.float64)
    is_street = (np.abs(bend) < LARGEST_BEND_RAD) | (sm.hypot(uu - vv, 2.0 * uv) / spread > _LEAST_LONG)
    heading = road_heading_rad + np.where(is_street, bend, 0.0)
    return DrivableRegion(origin_m, cell_m, drivable, road_heading_rad, step, heading.astype(np.float32))


def is_drivable(region: DrivableRegion, xy: Array) -> Bool:
    """Which places (M, 2) metres lie in a drivable cell; none beyond the grid."""
    xy = np.atleast_2d(np.asarray(xy, dtype=np.float64))[:, :2]
    rows, columns = region.drivable.shape
    flat, inside = cell_of(xy, region.origin_m, region.cell_m, (rows, columns))
    return np.asarray(inside & region.drivable.ravel()[flat])


@dataclass(frozen=True)
class _Grid:
    origin_m: tuple[float, float]
    cell_m: float
    shape: tuple[int, int]

    def mark(self, xy: F64) -> Bool:
        """Cells with at least one of the places (M, 2) in them."""
        flat, inside = cell_of(xy, self.origin_m, self.cell_m, self.shape)
        return np.asarray(np.bincount(flat[inside], minlength=self.shape[0] * self.shape[1]).reshape(self.shape) > 0)

    def centres(self) -> tuple[F64, F64]:
        return cell_centres(self.origin_m, self.cell_m, self.shape)


def _low_points(p: F64, above: F64, rays: ScanRays, ground: GroundMap, config: DrivableConfig) -> _Low:
    smooth = sm.gaussian_filter(ground.height_m.astype(np.float64), _RELIEF_M / ground.cell_m)
    r = sm.hypot(p[:, 0], p[:, 1])
    near = np.flatnonzero((np.abs(above) < config.low_m + 0.1) & (r < 1.42 * config.reach_m))
    key = rays.ring[near] * _TURN + sm.arctan2(p[near, 1], p[near, 0])
    order = np.argsort(key, kind="stable")
    near, key = near[order], key[order]
    r = np.maximum(r[near], 1.0)
    x, y = (p[near, 0] - ground.origin_m[0]) / ground.cell_m, (p[near, 1] - ground.origin_m[1]) / ground.cell_m
    z = p[near, 2] - interpolate(smooth, x, y)  # beams along a slope keep their height over any kerb
    i = np.arange(len(near))
    total = np.concatenate([[0.0], np.cumsum(z)])
    a, b = np.searchsorted(key, key - config.side_m / r), np.searchsorted(key, key + config.side_m / r)
    both = (i > a) & (b > i + 1)
    left = (total[i] - total[a]) / np.maximum(i - a, 1)
    right = (total[b] - total[np.minimum(i + 1, b)]) / np.maximum(b - i - 1, 1)
    stray = np.where(both, np.minimum(np.abs(z - 0.5 * (left + right)), _STRAY_LIMIT_M), 0.0)
    stray_total = np.concatenate([[0.0], np.cumsum(stray)])
    return _Low(
        xyz=p[near],
        range_m=r,
        key=key,
        ring=rays.ring[near].astype(np.int64),
        above=above[near],
        relief_m=z,
        step_m=np.where(both, np.abs(right - left), 0.0),
        rough_m=(stray_total[b] - stray_total[a]) / np.maximum(b - a, 1),
    )


def _rough(low: _Low, grid: _Grid, config: DrivableConfig) -> Bool:
    """Which low points (L,) lie on rough ground, as grass is; all strays near a point count, so a rail is not."""
    flat, inside = cell_of(low.xyz, grid.origin_m, grid.cell_m, grid.shape)
    mean, _ = _box_mean(flat[inside], low.rough_m[inside], grid.shape, 3)
    return np.asarray(mean.ravel()[flat] > config.rough_m)


def _seen_or_passed_over(low: _Low, edge: Bool, ground: GroundMap, grid: _Grid, config: DrivableConfig) -> Bool:
    """Cells with smooth ground in them, or between two such returns of one azimuth with the ray low over the gap."""
    column = ((low.key - low.ring * _TURN + np.pi) * (_COLUMNS / (2.0 * np.pi))).astype(np.int64)
    order = np.lexsort((low.range_m, column))
    q, r, column, smooth = low.xyz[order], low.range_m[order], column[order], ~edge[order]
    smooth &= np.abs(low.above[order]) < config.low_m
    gap = r[1:] - r[:-1]
    sensor = ground.plane[3] / ground.plane[2]
    passed = sensor * gap / r[1:] < config.pass_m  # how high the farther return's ray is over the nearer return
    bridged = np.flatnonzero((column[1:] == column[:-1]) & passed & smooth[1:] & smooth[:-1])
    between = _along(q[bridged, :2], q[bridged + 1, :2], grid.cell_m)
    first = smooth & (r < _BLIND_M)  # in to the scanner no beam reaches the ground
    first[1:] &= column[1:] != column[:-1]
    inwards = _along(np.zeros((int(first.sum()), 2)), q[first, :2], grid.cell_m)
    return np.asarray(ndimage.binary_closing(grid.mark(np.concatenate([q[smooth, :2], between, inwards]))))


def _along(start: F64, end: F64, step_m: float) -> F64:
    """Places (K, 2) on the straight lines from starts (M, 2) to ends (M, 2), at most `step_m` apart."""
    offset = end - start
    steps = np.ceil(sm.hypot(offset[:, 0], offset[:, 1]) / step_m).astype(np.int64) + 1
    line = np.repeat(np.arange(len(start)), steps)
    nth = np.arange(len(line)) - np.repeat(np.cumsum(steps) - steps, steps)
    share = nth / np.maximum(steps - 1, 1)[line]
    return np.asarray(start[line] + share[:, None] * offset[line])


def _standing(p: F64, above: F64, grid: _Grid, config: DrivableConfig) -> Bool:
    """Cells with something in them between kerb and car height."""
    return grid.mark(p[(above > config.low_m) & (above < config.car_height_m), :2])


def _edge_lines(low: _Low, grid: _Grid, config: DrivableConfig) -> Bool:
    """Cells with a step along a ring in them, and those on the line to the same edge on one of the next two rings."""
    at = np.flatnonzero(low.step_m > config.kerb_m)
    xy, r, ring, key = low.xyz[at, :2], low.range_m[at], low.ring[at], low.key[at]
    lines = [xy]
    if len(at):
        for back in (1, 2):
            found = np.searchsorted(key, key - back * _TURN)
            for nearest in (np.maximum(found - 1, 0), np.minimum(found, len(at) - 1)):
                sideways = np.abs(key - back * _TURN - key[nearest]) * np.minimum(r, r[nearest])
                outwards = np.abs(r[nearest] - r)
                joined = (ring[nearest] == ring - back) & (outwards < config.join_m + 0.005 * r * r)
                joined &= sideways < 0.5 + 0.35 * outwards
                lines.append(_along(xy[joined], xy[nearest[joined]], grid.cell_m))
        lines.append(_past_the_ego_car(xy, r, ring, grid.cell_m))
    return grid.mark(np.concatenate(lines))


def _past_the_ego_car(xy: F64, range_m: F64, ring: I64, step_m: float) -> F64:
    """Lines between edges seen before and behind on one ring, where the kerb between lies too close to be seen."""
    offset = xy[1:] - xy[:-1]
    beside = (ring[1:] == ring[:-1]) & (range_m[1:] < _BLIND_M) & (range_m[:-1] < _BLIND_M)
    beside &= (np.abs(offset[:, 0]) > 1.0) & (np.abs(offset[:, 1]) < 0.4 * np.abs(offset[:, 0]))
    beside &= np.abs(xy[1:, 1] + xy[:-1, 1]) > 2.4  # wider than the ego car itself
    line = _along(xy[:-1][beside], xy[1:][beside], step_m)
    return np.asarray(line[sm.hypot(line[:, 0], line[:, 1]) < _UNSEEN_M])


def _kerbs(low: _Low, grid: _Grid, config: DrivableConfig) -> Bool:
    """Cells over which the ground steps by a kerb's height from ring to ring, near the car, where rings lie close.

    The threshold is higher than along a ring: ranges of different beams differ by centimetres.
    """
    first = max(0, grid.shape[0] // 2 - int(_NEAR_RINGS_M / grid.cell_m))  # only the middle of the grid
    side = grid.shape[0] - 2 * first
    corner = (grid.origin_m[0] + first * grid.cell_m, grid.origin_m[1] + first * grid.cell_m)
    flat, inside = cell_of(low.xyz, corner, grid.cell_m, (side, side))
    height, seen = _box_mean(flat[inside], low.relief_m[inside], (side, side), 3)
    step = np.zeros((side, side))
    for down, right in ((2, 0), (0, 2), (1, 1), (1, -1)):  # from side to side, so that a groove is no step
        both = _shifted(seen, down, right) & _shifted(seen, -down, -right)
        jump = np.abs(_shifted(height, down, right) - _shifted(height, -down, -right))
        step = np.maximum(step, np.where(both, jump, 0.0))
    kerbs = np.zeros(grid.shape, dtype=bool)
    kerbs[first : first + side, first : first + side] = step > config.cross_kerb_m
    return kerbs


def _shifted(values: Array, down: int, right: int) -> Array:
    """The values `down` rows and `right` columns on, 0 beyond the edge."""
    out = np.zeros_like(values)
    rows, columns = values.shape
    out[max(-down, 0) : rows - max(down, 0), max(-right, 0) : columns - max(right, 0)] = values[
        max(down, 0) : rows - max(-down, 0), max(right, 0) : columns - max(-right, 0)
    ]
    return out


def _box_mean(flat: I64, values: F64, shape: tuple[int, int], size: int) -> tuple[F64, Bool]:
    """Mean of the values in the square of `size` cells round each cell, and where there are any."""
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)
    total = np.bincount(flat, weights=values, minlength=shape[0] * shape[1]).reshape(shape)
    ones = np.ones(size)
    for axis in (0, 1):
        count = ndimage.convolve1d(count, ones, axis=axis, mode="constant")
        total = ndimage.convolve1d(total, ones, axis=axis, mode="constant")
    return np.asarray(total / np.maximum(count, 1.0)), np.asarray(count > 0.5)


def _connected(free: Bool, grid: _Grid, config: DrivableConfig) -> Bool:
    """What a disc of half a car's width reaches from the ego car without leaving the free cells."""
    x, y = grid.centres()
    under_ego = (np.abs(x) < 4.5) & (np.abs(y) < 1.2)  # nothing is seen there, but the ego car stands on road
    free = free | under_ego
    radius = config.half_width_m / grid.cell_m
    core = ndimage.distance_transform_edt(free) > radius
    label, _ = ndimage.label(core)
    near = (np.abs(x) < 8.0) & (np.abs(y) < 2.0) & core
    found = np.unique(label[near])
    keep = np.isin(label, found[found > 0])
    return np.asarray((ndimage.distance_transform_edt(~keep) <= radius) & free) if keep.any() else under_ego & free


def _road_heading(blocked: Bool, grid: _Grid) -> float:
    """The direction near straight ahead along which edges and walls beside the ego car line up best; 0 for none.

    Cells are projected across each direction tried; kerbs and walls along it fall into few lateral bins.
    """
    x, y = grid.centres()
    beside = blocked & (x * x + y * y < _HEADING_REACH_M**2) & (np.abs(y) > 1.2)
    rows, columns = np.nonzero(beside)
    if len(rows) < 20:
        return 0.0
    along, across = x[rows, 0], y[0, columns]
    tried = np.deg2rad(np.arange(-45.0, 45.5, 1.0))
    bins = int(2 * (_HEADING_REACH_M + 2.0) / _LATERAL_BIN_M)
    scores = np.empty(len(tried))
    for k, heading in enumerate(tried):
        away = heading / _HEADING_SPREAD_RAD
        lateral = across * sm.cos(heading) - along * sm.sin(heading)
        count = np.bincount((lateral / _LATERAL_BIN_M + bins / 2).astype(np.int64), minlength=bins).astype(np.float64)
        near = sm.gaussian_filter(count, 2.0)  # wider than a cell, or the grid's own rows would line up best
        scores[k] = (near * near).sum() * sm.exp(-0.5 * away * away)
    best = int(np.argmax(scores))
    if 0 < best < len(tried) - 1:  # between the directions tried: the vertex of the parabola through the best three
        before, at, after = scores[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        return float(tried[best] + shift * (tried[1] - tried[0]))
    return float(tried[best])
