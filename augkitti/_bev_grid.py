"""Bird's-eye grids: points (M, 2) and cell values in, cell indices, interpolated values and filled grids out.

A grid has rows along x and columns along y; cell [0, 0] has its corner at the origin.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti.frames import F64, Array
from augkitti.scan_pair import Bool

I64 = npt.NDArray[np.int64]


def cell_of(xy: Array, origin_m: tuple[float, float], cell_m: float, shape: tuple[int, int]) -> tuple[I64, Bool]:
    """Flat cell index (M,) of points (M, 2) metres (0 outside of the grid), and which (M,) lie in the grid."""
    with np.errstate(invalid="ignore"):
        row = np.floor((xy[:, 0].astype(np.float64) - origin_m[0]) / cell_m)
        column = np.floor((xy[:, 1].astype(np.float64) - origin_m[1]) / cell_m)
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    flat = np.where(inside, row, 0.0).astype(np.int64) * shape[1] + np.where(inside, column, 0.0).astype(np.int64)
    return flat, inside


def cell_centres(origin_m: tuple[float, float], cell_m: float, shape: tuple[int, int]) -> tuple[F64, F64]:
    """x (rows, 1) and y (1, columns) of the cell centres, metres."""
    x = origin_m[0] + (np.arange(shape[0], dtype=np.float64)[:, None] + 0.5) * cell_m
    y = origin_m[1] + (np.arange(shape[1], dtype=np.float64)[None, :] + 0.5) * cell_m
    return np.asarray(x), np.asarray(y)


def interpolate(values: Array, x_cells: Array, y_cells: Array) -> F64:
    """Bilinear values at places in units of cells (0.5 is the first centre); held constant beyond the outer centres."""
    rows, columns = values.shape
    u = np.clip(np.asarray(x_cells, dtype=np.float64) - 0.5, 0.0, rows - 1.0)
    v = np.clip(np.asarray(y_cells, dtype=np.float64) - 0.5, 0.0, columns - 1.0)
    i = np.minimum(u.astype(np.int64), rows - 2)
    j = np.minimum(v.astype(np.int64), columns - 2)
    a, b = u - i, v - j
    flat = np.ascontiguousarray(values).ravel()
    at = i * columns + j
    low = flat[at] * (1.0 - b) + flat[at + 1] * b
    high = flat[at + columns] * (1.0 - b) + flat[at + columns + 1] * b
    return np.asarray(low * (1.0 - a) + high * a, dtype=np.float64)


def mean_by_cell(flat: I64, values: Array, cells: int) -> tuple[F64, F64]:
    """Mean value (0 where there is none) and number of points of every cell (cells,)."""
    count = np.bincount(flat, minlength=cells).astype(np.float64)
    total = np.bincount(flat, weights=values, minlength=cells)
    return np.asarray(total / np.maximum(count, 1.0), dtype=np.float64), count


def fill_smoothly(values: F64, weight: F64, prior_weight: float, levels: int, beyond: float = 0.0) -> F64:
    """Values everywhere from values where there is weight: each cell leans on ever wider surroundings the less it has.

    A pull-push pyramid: cells are averaged in blocks of 2 x 2 up `levels` levels, then each level is blended with the
    coarser one at `prior_weight`. What the coarsest level has not seen leans on `beyond`.
    """
    pyramid = [(values * weight, weight)]
    for _ in range(levels):
        pyramid.append((_halve(pyramid[-1][0]), _halve(pyramid[-1][1])))
    coarse: Any = beyond
    for total, mass in reversed(pyramid):
        if not isinstance(coarse, float):
            coarse = _double(coarse, total.shape)
        coarse = (total + prior_weight * coarse) / (mass + prior_weight)
    return np.asarray(coarse, dtype=np.float64)


def _halve(grid: F64) -> F64:
    rows, columns = grid.shape
    even = np.zeros((rows + rows % 2, columns + columns % 2))
    even[:rows, :columns] = grid
    return even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]


def _double(grid: F64, shape: tuple[int, ...]) -> F64:
    """Bilinear to twice the resolution: fine centres lie a quarter of a coarse cell off the coarse centres."""
    for axis in (0, 1):
        g = np.moveaxis(grid, axis, 0)
        before = np.concatenate([g[:1], g[:-1]])
        after = np.concatenate([g[1:], g[-1:]])
        fine = np.empty((2 * len(g), g.shape[1]))
        fine[0::2] = 0.75 * g + 0.25 * before
        fine[1::2] = 0.75 * g + 0.25 * after
        grid = np.moveaxis(fine[: shape[axis]], 0, axis)
    return grid
