"""Finds how a model stands and where its wheels are: triangles in, axes, unit and wheels out, each with its reason."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from augkitti.frames import F64
from augkitti.scan_pair import I32, Bool

MERGE_M = 1e-5  # vertices closer than this are one


@dataclass(frozen=True)
class Wheel:
    """A wheel in the car frame: the middle of its axle, its tread's radius, its width."""

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    width_m: float


def merge_vertices(vertices: F64, faces: I32, tolerance: float = MERGE_M) -> tuple[F64, I32]:
    """The same triangles with vertices that round to the same place made one; in order of first use."""
    key = np.round(vertices / tolerance).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    used, new = np.unique(first[inverse[faces]], return_inverse=True)
    return vertices[used], new.reshape(-1, 3).astype(np.int32)


def face_components(n_vertices: int, faces: I32) -> I32:
    """The connected component (F,) of each face, over shared vertices."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(n_vertices, n_vertices))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label[faces[:, 0]], dtype=np.int32)


def group_bounds(points: F64, group: I32, count: int) -> tuple[F64, F64]:
    """Lowest and highest corner (count, 3) of each group of points (N, 3)."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group, points)
    np.maximum.at(high, group, points)
    return low, high


def find_wheels(vertices: F64, faces: I32, hint: Bool | None = None) -> tuple[Wheel, ...]:
    """The wheels of a car in its own frame (x forward, y left, z up), sorted front left, front right, ..., rear right.

    A wheel is a connected piece that is as long as it is high (within 8 %), narrower than 0.7 of that, 0.4 to 1.2 m in
    diameter, and stands on the lowest point (within 5 cm); or a group of faces (`hint`, by name) that is so when it is
    parted by the car's four corners. Pieces of one corner are one wheel, the largest of them.
    """
    if not len(faces):
        return ()
    floor = float(vertices[np.unique(faces)][:, 2].min())
    found: list[Wheel] = []
    welded, welded_faces = merge_vertices(vertices, faces, 1e-4)
    component = face_components(len(welded), welded_faces)
    found += _round_pieces(welded, welded_faces, component, floor)
    if hint is not None and hint.any() and len(_corners(found)) < 4:
        chosen = faces[hint]
        middle = vertices[chosen].mean(axis=1)
        low, high = vertices[chosen].min(axis=(0, 1)), vertices[chosen].max(axis=(0, 1))
        centre = (low + high) / 2.0
        corner = (middle[:, 0] > centre[0]).astype(np.int32) * 2 + (middle[:, 1] > 0.0)
        found += _round_pieces(vertices, chosen, corner.astype(np.int32), floor)
    return tuple(sorted(_corners(found), key=lambda w: (-round(w.x_m, 1), -w.y_m)))


def _round_pieces(vertices: F64, faces: I32, group: I32, floor: float) -> list[Wheel]:
    count = int(group.max()) + 1
    corners = vertices[faces].reshape(-1, 3)
    low, high = group_bounds(corners, np.repeat(group, 3), count)
    found = []
    for i in np.flatnonzero(np.isfinite(low[:, 0]) & (low[:, 2] < floor + 0.05)):
        length, width, height = high[i] - low[i]
        if 0.4 <= height <= 1.2 and abs(length - height) <= 0.08 * height and width <= 0.7 * height:
            x, y, z = (high[i] + low[i]) / 2.0
            found.append(Wheel(float(x), float(y), float(z), float(height / 2.0), float(width)))
    return found


def _corners(wheels: list[Wheel]) -> list[Wheel]:
    """One wheel a place: of those with nearly one centre in side view and on one side, the widest."""
    kept: list[Wheel] = []
    for wheel in sorted(wheels, key=lambda w: (-w.radius_m, -w.width_m, w.x_m, w.y_m)):
        if not any(abs(wheel.x_m - k.x_m) < 0.3 and (wheel.y_m > 0) == (k.y_m > 0) for k in kept):
            kept.append(wheel)
    return kept


def axles(wheels: tuple[Wheel, ...]) -> tuple[float, float] | None:
    """x of the front and of the rear axle; None where there are fewer than two axles 1.3 m apart.

    Of two rear axles close together the mean counts: it is where such a car turns about.
    """
    if len(wheels) < 2:
        return None
    x = np.array([w.x_m for w in wheels])
    if np.ptp(x) < 1.3:
        return None
    middle = (x.min() + x.max()) / 2.0
    return float(x[x > middle].mean()), float(x[x <= middle].mean())


def contact_axles(vertices: F64, faces: I32) -> tuple[float, float] | None:
    """x of the front and rear axle from the places where a car touches the ground; None where they are not two.

    A tyre's lowest vertices lie evenly before and behind its axle.
    """
    used = vertices[np.unique(faces)]
    length = float(np.ptp(used[:, 0]))
    low = used[used[:, 2] < used[:, 2].min() + 0.03]
    front, rear = low[low[:, 0] > used[:, 0].mean()], low[low[:, 0] <= used[:, 0].mean()]
    if not len(front) or not len(rear):
        return None
    ends = [(part[:, 0].min(), part[:, 0].max()) for part in (front, rear)]
    if any(high - low > 0.15 * length for low, high in ends):
        return None
    (a, b), (c, d) = ends
    if (a + b) / 2 - (c + d) / 2 < 0.4 * length:
        return None
    return float((a + b) / 2), float((c + d) / 2)
