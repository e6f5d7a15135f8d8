"""Wheel arches of a body without wheels: its triangles and the wheel's radius in, the places of the four wheels out."""

import numpy as np

from augkitti import same_math as sm
from augkitti.cad_axes import surface_points
from augkitti.frames import F64
from augkitti.scan_pair import I32

_BIN_M = 0.02
_ON_ARC_M = 0.015
_LEAST_SHARE = 0.85  # of the arch's upper 120 degrees that must lie on the circle
_LARGEST_GAP = 1.3  # arch radius over tyre radius, above which nothing tells how high the wheel sits in it
_UNEVEN_M = 0.04  # axles carry equal wheels: arches further apart in height do not tell where the wheels are


def find_arches(vertices: F64, faces: I32, radius_m: float, width_m: float) -> tuple[F64, str]:
    """Wheel centres (4, 3), front left, front right, rear left, rear right; or none (0, 3) and the reason why.

    The lower edge of the body's sides is searched for two circles a little larger than the tyre, half a length apart.
    A wheel sits in the middle of its circle, its outer face level with the body's side.

    Args:
        vertices: (V, 3) metres, x forward, y left, z up, the middle of the body at y = 0.
        faces: (F, 3).
        radius_m: of the tyre.
        width_m: of the wheel.
    """
    edge_x, edge_z, half, length = _lower_edge(vertices, faces)
    circles = _circles(edge_x, edge_z, radius_m)
    best: tuple[float, int, int] | None = None
    for i in range(len(circles)):
        for j in range(len(circles)):
            apart = circles[i, 1] - circles[j, 1]
            if 0.45 * length <= apart <= 0.75 * length and abs(circles[i, 2] - circles[j, 2]) <= _UNEVEN_M:
                score = float(circles[i, 0] + circles[j, 0])
                if best is None or score > best[0]:
                    best = (score, i, j)
    if best is None:
        return np.zeros((0, 3)), "no two round wheel arches that fit its wheels"
    y = half - width_m / 2.0
    centres = [(circles[k, 1], side * y, circles[k, 2]) for k in best[1:] for side in (1.0, -1.0)]
    return np.array(centres), ""


def _lower_edge(vertices: F64, faces: I32) -> tuple[F64, F64, float, float]:
    """The sides' lower edge: x (B,) and z (B,) of 2 cm bins; half the body's width below the mirrors; its length."""
    used = vertices[np.unique(faces)]
    points = np.concatenate([surface_points(vertices, faces, 60000), used])
    low, high = used.min(axis=0), used.max(axis=0)
    points = points[points[:, 2] < low[2] + 0.55 * (high - low)[2]]
    half = float(np.quantile(np.abs(points[:, 1]), 0.99))
    side = points[np.abs(points[:, 1]) > half - 0.14]
    bins = ((side[:, 0] - low[0]) / _BIN_M).astype(np.int64)
    edge = np.full(int(bins.max()) + 1, np.inf)
    np.minimum.at(edge, bins, side[:, 2])
    seen = np.isfinite(edge)
    return low[0] + (np.flatnonzero(seen) + 0.5) * _BIN_M, edge[seen], half, float((high - low)[0])


def _circles(edge_x: F64, edge_z: F64, radius_m: float) -> F64:
    """The best circle (score, x, z) at each place along the edge, those with enough of their arc only: (C, 3)."""
    found = []
    radii = radius_m * np.arange(1.02, _LARGEST_GAP, 0.02)
    for x in edge_x:
        near = np.abs(edge_x - x) <= 0.87 * radii[-1]
        px, pz = edge_x[near] - x, edge_z[near]
        if len(px) < 20:
            continue
        z = np.arange(float(pz.max()) - 1.35 * radius_m, float(pz.max()) - 0.95 * radius_m, 0.01)
        distance = sm.hypot(px, pz - z[:, None])  # (Z, P)
        above = (pz > z[:, None])[:, None, :] & (np.abs(px) <= 0.87 * radii[:, None])
        on_arc = (np.abs(distance[:, None, :] - radii[:, None]) < _ON_ARC_M) & above  # (Z, R, P)
        share = on_arc.sum(axis=2) / (2.0 * 0.87 * radii / _BIN_M)
        k = int(np.argmax(share.max(axis=1)))
        if share[k].max() >= _LEAST_SHARE:
            found.append((float(share[k].max()), float(x), float(z[k])))
    return np.array(found).reshape(-1, 3)
