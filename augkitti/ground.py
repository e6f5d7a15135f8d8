"""Ground under a scan: points (N, 3) in, one plane and a local height map with each point's ground flag out.

Three steps, each surface the starting point of the next: a plane by RANSAC near the car, where the road is; a surface
in rings and sectors, grown outwards from the plane so that it follows slopes but never climbs a wall; a height map in
square cells, robust against all that stands on the ground. Heights in steps two and three are above the plane.
"""

import numpy as np
from scipy import ndimage

from augkitti import same_math as sm
from augkitti._bev_grid import cell_centres, cell_of, fill_smoothly, interpolate, mean_by_cell
from augkitti.config import GroundConfig
from augkitti.frames import F32, F64, Array
from augkitti.scan_pair import I32, Bool, GroundMap
from augkitti.seeds import generator

_RING_EDGES_M = np.array(
    [2.5, 4.0, 5.5, 7.0, 9.0, 11.0, 13.0, 15.5, 18.0, 21.0, 24.5, 28.5, 33.0, 38.0, 44.0, 51.0, 59.0, 68.0, 80.0]
)  # widths grow with the distance between beams on the ground
_SECTORS = 72
_BIN_M = 0.05  # of height histograms
_SLOPE_MEMORY = 0.5  # of the new slope against that of the rings before
STANDING_M = 0.1
_STEEPEST = 0.25  # rise over run beyond which no ground is looked for


def fit_ground(xyz: F32, config: GroundConfig) -> GroundMap:
    """Plane, height map and ground points of one scan; the same bytes for the same points.

    Args:
        xyz: (N, 3) metres, velo.
        config: bounds and cell sizes.

    Returns:
        The ground; without enough points near the car, a level plane at `config.usual_height_m`.
    """
    p = np.asarray(xyz, dtype=np.float64)
    plane = _fit_plane(p, config)
    above_plane = (plane[0] * p[:, 0] + plane[1] * p[:, 1] + plane[3]) / plane[2] + p[:, 2]
    ring_surface = _grow_outwards(p, above_plane, config)
    above_rings = above_plane - _ring_height(ring_surface, p[:, 0], p[:, 1])
    cells = int(np.ceil(2.0 * config.reach_m / config.cell_m))
    origin = (-0.5 * cells * config.cell_m, -0.5 * cells * config.cell_m)
    above_ground, height, observed = _refine(p, above_rings, origin, cells, config)
    x, y = cell_centres(origin, config.cell_m, (cells, cells))
    height = height + _ring_height(ring_surface, *np.broadcast_arrays(x, y))
    height = height - (plane[0] * x + plane[1] * y + plane[3]) / plane[2]
    allowed = np.clip(config.above_m + 0.002 * sm.hypot(p[:, 0], p[:, 1]), 0.0, 2.0 * config.above_m)
    return GroundMap(
        plane=plane,
        origin_m=origin,
        cell_m=config.cell_m,
        height_m=height.astype(np.float32),
        observed=observed,
        is_ground=(above_ground < allowed) & (above_ground > -config.below_m),
    )


def standing_points(xyz: F32, ground: GroundMap) -> I32:
    """Points (M,), ascending, that stand on the ground or hang over it: more than 0.1 m above."""
    return np.flatnonzero(xyz[:, 2] - height_at(ground, xyz) > STANDING_M).astype(np.int32)


def height_at(ground: GroundMap, xy: Array) -> F64:
    """Height z (M,) metres of the ground at places (M, 2): bilinear, held constant beyond the map's edge."""
    xy = np.atleast_2d(np.asarray(xy, dtype=np.float64))[:, :2]
    x0, y0 = ground.origin_m
    return interpolate(ground.height_m, (xy[:, 0] - x0) / ground.cell_m, (xy[:, 1] - y0) / ground.cell_m)


def normal_at(ground: GroundMap, xy: Array, base_m: float = 1.5) -> F64:
    """Unit normals (M, 3) of the ground at places (M, 2), from heights `base_m` to each side, as wheels feel them."""
    xy = np.atleast_2d(np.asarray(xy, dtype=np.float64))[:, :2]
    x0, y0 = ground.origin_m
    margin = base_m + ground.cell_m  # beyond the edge the slope is that of the edge
    size = np.array(ground.height_m.shape) * ground.cell_m
    inside = np.clip(xy, np.array([x0, y0]) + margin, np.array([x0, y0]) + size - margin)
    slope = [
        (height_at(ground, inside + step) - height_at(ground, inside - step)) / (2.0 * base_m)
        for step in (np.array([base_m, 0.0]), np.array([0.0, base_m]))
    ]
    normal = np.stack([-slope[0], -slope[1], np.ones(len(xy))], axis=1)
    return np.asarray(normal / np.sqrt((normal * normal).sum(axis=1))[:, None])


def _fit_plane(p: F64, config: GroundConfig) -> F64:
    """RANSAC in z = a x + b y + c on one point a cell, weighted to the road beside and before the car.

    Candidates outside of the bounds on tilt and height are no candidates, so no wall or bank can win. The fixed seed
    makes it a function of the points. The winner is refitted with weights that fall to zero at the inlier distance.
    """
    r2 = p[:, 0] ** 2 + p[:, 1] ** 2
    lowest, highest = -config.max_height_m - 0.7, -config.min_height_m + 0.7
    near = (r2 < config.plane_radius_m * config.plane_radius_m) & (p[:, 2] > lowest) & (p[:, 2] < highest)
    q = p[near]
    cells = int(np.ceil(config.plane_radius_m / 0.5)) * 2
    flat, inside = cell_of(q, (-0.25 * cells, -0.25 * cells), 0.5, (cells, cells))
    flat, q = flat[inside], q[inside]
    lowest_z = np.full(cells * cells, np.inf)
    np.minimum.at(lowest_z, flat, q[:, 2])
    low = q[:, 2] < lowest_z[flat] + 0.08  # of each cell the points at its floor
    q, flat = q[low], flat[low]
    level = np.array([0.0, 0.0, -config.usual_height_m])
    if len(q) >= 10:
        seen = np.bincount(flat, minlength=cells * cells) > 0
        x, y, z = (mean_by_cell(flat, q[:, k], cells * cells)[0][seen] for k in range(3))
        weight = sm.exp(-0.5 * ((x / 10.0) ** 2 + (y / 4.0) ** 2))
        level = _ransac(x, y, z, weight, level, config)
    normal = np.array([-level[0], -level[1], 1.0])
    plane = np.append(normal, -level[2]) / np.sqrt((normal * normal).sum())
    return np.asarray(plane, dtype=np.float64)


def _ransac(x: F64, y: F64, z: F64, weight: F64, level: F64, config: GroundConfig) -> F64:
    rng = generator(0, "ground plane")
    chance = np.cumsum(weight) / weight.sum()
    picks = np.minimum(np.searchsorted(chance, rng.random((config.ransac_tries, 3))), len(x) - 1)
    px, py, pz = x[picks], y[picks], z[picks]
    ux, uy, uz = px[:, 1] - px[:, 0], py[:, 1] - py[:, 0], pz[:, 1] - pz[:, 0]
    vx, vy, vz = px[:, 2] - px[:, 0], py[:, 2] - py[:, 0], pz[:, 2] - pz[:, 0]
    area = ux * vy - uy * vx
    wide = np.abs(area) > 4.0  # square metres: of narrower triples the tilt says nothing
    area = np.where(wide, area, 1.0)
    a, b = (uz * vy - uy * vz) / area, (ux * vz - uz * vx) / area
    c = pz[:, 0] - a * px[:, 0] - b * py[:, 0]
    steepest = sm.tan(config.max_tilt_rad)
    fits = wide & (sm.hypot(a, b) < steepest) & (-c > config.min_height_m) & (-c < config.max_height_m)
    candidates = np.concatenate([level[None], np.stack([a, b, c], axis=1)[fits]])
    residual = z[None, :] - candidates[:, :1] * x - candidates[:, 1:2] * y - candidates[:, 2:]
    cost = (np.minimum((residual / config.inlier_m) ** 2, 1.0) * weight).sum(axis=1)
    best = candidates[int(np.argmin(cost))]
    for _ in range(5):
        error = z - best[0] * x - best[1] * y - best[2]
        trust = weight * np.maximum(1.0 - (error / config.inlier_m) ** 2, 0.0) ** 2
        best = _weighted_plane(x, y, z, trust, best)
    steep = float(sm.hypot(best[0], best[1]))
    bounded = steep < steepest and config.min_height_m < -best[2] < config.max_height_m
    return np.asarray(best if bounded else level, dtype=np.float64)


def _weighted_plane(x: F64, y: F64, z: F64, weight: F64, otherwise: F64) -> F64:
    total = weight.sum()
    if total < 1e-3:
        return otherwise
    mx, my, mz = (weight * x).sum() / total, (weight * y).sum() / total, (weight * z).sum() / total
    dx, dy, dz = x - mx, y - my, z - mz
    xx, xy, yy = (weight * dx * dx).sum(), (weight * dx * dy).sum(), (weight * dy * dy).sum()
    xz, yz = (weight * dx * dz).sum(), (weight * dy * dz).sum()
    det = xx * yy - xy * xy
    if det < 1e-6 * total * total:
        return otherwise
    a, b = (xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det
    return np.array([a, b, mz - a * mx - b * my])


def _grow_outwards(p: F64, above_plane: F64, config: GroundConfig) -> F64:
    """Heights above the plane (rings, sectors), each ring sought near what the ring inside of it leads to expect."""
    r = sm.hypot(p[:, 0], p[:, 1])
    rings = len(_RING_EDGES_M) - 1
    ring = np.searchsorted(_RING_EDGES_M, r, side="right") - 1
    sector = _sector_units(p[:, 0], p[:, 1]).astype(np.int64) % _SECTORS
    span = 6.0  # metres of height each way, as far as slopes lead over the map
    bins = int(2 * span / _BIN_M)
    height_bin = np.floor((above_plane + span) / _BIN_M)
    use = (ring >= 0) & (ring < rings) & (height_bin >= 0) & (height_bin < bins)
    flat = (ring[use] * _SECTORS + sector[use]) * bins + height_bin[use].astype(np.int64)
    count = np.bincount(flat, minlength=rings * _SECTORS * bins).reshape(rings, _SECTORS, bins)
    level = (np.arange(bins) + 0.5) * _BIN_M - span
    middle = 0.5 * (_RING_EDGES_M[1:] + _RING_EDGES_M[:-1])
    surface = np.zeros((rings, _SECTORS))
    height, slope, trust = np.zeros(_SECTORS), np.zeros(_SECTORS), np.ones(_SECTORS)
    for k in range(rings):
        step = middle[k] - (middle[k - 1] if k else 0.0)
        expected = _over_sectors(height + slope * step, trust)
        gate = 0.12 + 0.07 * step
        window = np.abs(level[None, :] - expected[:, None]) < gate
        inside = count[k] * window
        enough = np.maximum(4, 0.06 * inside.sum(axis=1))
        three = inside[:, :-2] + inside[:, 1:-1] + inside[:, 2:]
        good = three >= enough[:, None]
        found = good.any(axis=1)
        first = np.argmax(good, axis=1)
        pick = np.take_along_axis(inside, first[:, None] + np.arange(3), axis=1)
        seen = (pick * level[first[:, None] + np.arange(3)]).sum(axis=1) / np.maximum(pick.sum(axis=1), 1)
        new = np.where(found, seen, expected)
        trust = np.where(found, 1.0, 0.3 * trust)
        new = _over_sectors(new, np.maximum(trust, 1e-3))
        new_slope = np.clip((new - height) / step, -_STEEPEST, _STEEPEST)
        slope = np.where(found, _SLOPE_MEMORY * new_slope + (1.0 - _SLOPE_MEMORY) * slope, 0.7 * slope)
        slope = _over_sectors(slope, np.maximum(trust, 1e-3))
        height = new
        surface[k] = new
    return surface


def _over_sectors(values: F64, trust: F64) -> F64:
    """Smoothed round the circle, trusted sectors first."""
    kernel = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    weighted = ndimage.convolve1d(values * trust, kernel, mode="wrap")
    return np.asarray(weighted / ndimage.convolve1d(trust, kernel, mode="wrap"))


def _sector_units(x: F64, y: F64) -> F64:
    return np.asarray((sm.arctan2(y, x) + np.pi) * (_SECTORS / (2.0 * np.pi)))


def _ring_height(surface: F64, x: F64, y: F64) -> F64:
    """The ring surface at places, bilinear in range and azimuth; 0 under the car."""
    middle = np.concatenate([[0.0], 0.5 * (_RING_EDGES_M[1:] + _RING_EDGES_M[:-1])])
    r = sm.hypot(x, y)
    ring_units = np.interp(r, middle, np.arange(len(middle)) + 0.5)
    padded = np.concatenate([np.zeros((1, _SECTORS)), surface])
    padded = np.concatenate([padded[:, -1:], padded, padded[:, :1]], axis=1)
    return interpolate(padded, ring_units, _sector_units(x, y) + 1.0)


def _refine(
    p: F64, above_rings: F64, origin: tuple[float, float], cells: int, config: GroundConfig
) -> tuple[F64, F64, Bool]:
    """Each point's height above the ground (N,), the map's height above the ring surface, and where it was seen."""
    shape = (cells, cells)
    flat, inside = cell_of(p, origin, config.cell_m, shape)
    coarse_of = _coarse_index(flat, cells)
    half = (cells + 1) // 2
    candidate = inside & (np.abs(above_rings) < 0.6)
    low = _low_of_cells(coarse_of[candidate], above_rings[candidate], half * half).reshape(half, half)
    seen = np.isfinite(low)
    floor = ndimage.minimum_filter(np.where(seen, low, np.inf), size=5)
    seen &= low < floor + config.step_m  # what is higher all over its cell stands on the ground
    first = fill_smoothly(np.where(seen, low, 0.0), seen.astype(np.float64), 0.1, 5)
    u, v = (p[:, 0] - origin[0]) / config.cell_m, (p[:, 1] - origin[1]) / config.cell_m
    above = above_rings - interpolate(first, 0.5 * u, 0.5 * v)
    keep = inside & (above < 0.15) & (above > -0.25)
    mean, count = mean_by_cell(flat[keep], above_rings[keep], cells * cells)
    support = np.minimum(count, 20.0).reshape(shape)
    height = fill_smoothly(mean.reshape(shape), support, 2.0, 6)
    height = sm.gaussian_filter(height, 0.7)
    observed = ndimage.binary_dilation(support > 0, iterations=2)
    return above_rings - interpolate(height, u, v), height, np.asarray(observed)


def _coarse_index(flat: Array, cells: int) -> Array:
    """Flat index in cells of twice the size."""
    return np.asarray((flat // cells // 2) * ((cells + 1) // 2) + (flat % cells) // 2)


def _low_of_cells(flat: Array, value: F64, cells: int) -> F64:
    """Height (cells,) of the lowest layer of each cell that holds its share of points; infinite where there is none."""
    bins = int(1.2 / _BIN_M)
    b = np.clip(((value + 0.6) / _BIN_M).astype(np.int64), 0, bins - 1)
    count = np.bincount(flat * bins + b, minlength=cells * bins).reshape(cells, bins)
    total = count.sum(axis=1)
    pair = count[:, :-1] + count[:, 1:]
    good = pair >= np.maximum(1.0, 0.1 * total)[:, None]
    first = np.argmax(good, axis=1)
    rows = np.arange(cells)
    n0, n1 = count[rows, first], count[rows, first + 1]
    level = (first + 0.5) * _BIN_M - 0.6 + _BIN_M * n1 / np.maximum(n0 + n1, 1)
    return np.where(total > 0, level, np.inf)
