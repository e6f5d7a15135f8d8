"""Ray casting: a car model with its motion and a scan's rays in, every surface that each ray meets on the car out.

Rays are carried into the car's own frame, each at its own firing time; the mesh never moves, so one Embree structure
per model and process serves every pair. Embree works in float32 and only names the triangle; the range is worked out
again in float64 from that triangle.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from augkitti import same_math as sm
from augkitti.frames import F64, Array, invert, rotate_vectors, transform_points, wrap_angle
from augkitti.scan_pair import GLASS, I32, MEASURED, U8, CarModel, ScanRays
from augkitti.scanner import ScannerProfile, lines_of_rays

MAX_LAYERS = 6  # both panes modelled twice, a head-rest between, and the far door
_STEP_M = 1e-4  # past a hit before the next query: above float32 resolution at car size, below any pane's thickness
_SAME_PANE_M = 0.03  # two layers of one pane: counted once
_GRAZING = 1e-4  # cosine below which a ray runs along its triangle
_WITHIN_RING_RAD = 5e-3  # scanner.md: elevations of compensated scans stay within 0.1 degrees of their beam
_SIGNS = np.array([[i, j, k] for i in (-1.0, 1.0) for j in (-1.0, 1.0) for k in (-1.0, 1.0)])
_START_BEFORE_M = 0.5  # rays start this far before the car, so that float32 keeps micrometres


@dataclass(frozen=True, eq=False)
class CarHits:
    """What the rays that meet one car meet on it, in order of depth: panes first, then at most one solid surface."""

    ray: I32  # (K,) index of the ray in the scan's rays, ascending
    range_m: F64  # (K, L) from the ray's origin; inf where there is no further surface
    face: I32  # (K, L) triangle of the model; -1 where none
    surface: U8  # (K, L) PAINT, GLASS, ...; MEASURED where none
    cos_incidence: F64  # (K, L) between 0 (grazing) and 1


class MeshCaster:
    """Embree's acceleration structure of one mesh, and what is needed to work out ranges in float64."""

    def __init__(self, vertices: F64, faces: I32) -> None:
        self.scene = EmbreeScene(robust=True)
        self.mesh = TriangleMesh(self.scene, vertices.astype(np.float32), faces.astype(np.int32))
        corner = vertices[faces]
        self.corner = corner[:, 0]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        self.normal = normal / np.maximum(np.sqrt((normal * normal).sum(axis=1)), 1e-30)[:, None]

    def first_hit(self, origin: F64, direction: F64) -> tuple[I32, F64, F64]:
        """Face (-1: none), range and |cos incidence| of the first triangle on each ray."""
        face = np.asarray(self.scene.run(origin.astype(np.float32), direction.astype(np.float32)), dtype=np.int32)
        hit = face >= 0
        n, c = self.normal[face], self.corner[face]
        falling = (n * direction).sum(axis=1)
        grazing = np.abs(falling) < _GRAZING
        along = (n * (c - origin)).sum(axis=1) / np.where(grazing, 1.0, falling)
        if (grazing & hit).any():  # the plane says nothing along itself; there Embree's own distance is the better one
            g = np.flatnonzero(grazing & hit)
            along[g] = self.scene.run(origin[g].astype(np.float32), direction[g].astype(np.float32), query="DISTANCE")
        return face, np.where(hit, np.maximum(along, 0.0), np.inf), np.where(hit, np.abs(falling), 0.0)


_structures: WeakKeyDictionary[CarModel, MeshCaster] = WeakKeyDictionary()


def _structure(model: CarModel) -> MeshCaster:
    if model not in _structures:
        _structures[model] = MeshCaster(model.vertices, model.faces)
    return _structures[model]


def rays_near(rays: ScanRays, T_velo_car: F64, size_m: Array, grow_m: float) -> I32:
    """Indices of the rays whose bearing and elevation can meet a box of `size_m` at `T_velo_car`, grown all round."""
    half = np.asarray(size_m, dtype=np.float64) / 2.0 + grow_m
    corners = transform_points(T_velo_car, box_corners(2.0 * half))
    distance = sm.hypot(corners[:, 0], corners[:, 1])
    near = float(np.abs(transform_points(invert(T_velo_car), np.zeros(3))[:2] / half[:2]).max())
    if near <= 1.0:  # the scanner stands over the box
        return np.arange(len(rays), dtype=np.int32)
    # Nearest approach of the footprint, not of its corners: a long side can come closer than both its ends.
    closest = max(float(sm.hypot(*T_velo_car[:2, 3])) - float(sm.hypot(half[0], half[1])), 0.5)
    low, high = float(corners[:, 2].min()) - 0.25, float(corners[:, 2].max()) - 0.1
    lowest = float(sm.arctan2(low, closest if low < 0.0 else distance.max()))
    highest = float(sm.arctan2(high, closest if high > 0.0 else distance.max()))
    margin = 0.03 / closest + 1e-3  # beams do not start at the frame's origin
    first, last = bearings_of(corners)
    return rays_between(rays, (first - margin, last + margin), (lowest - margin, highest + margin))


def box_corners(size_m: Array) -> F64:
    """The eight corners (8, 3) of a box of `size_m` (length, width, height) about the origin."""
    return np.asarray(0.5 * _SIGNS * size_m)


def bearings_of(corners: F64) -> tuple[float, float]:
    """From where to where (radians, the first in [-2 pi, pi)) points (K, 3) lie as seen from the scanner."""
    middle = float(sm.arctan2(corners[:, 1].mean(), corners[:, 0].mean()))
    off = wrap_angle(sm.arctan2(corners[:, 1], corners[:, 0]) - middle)
    return middle + float(off.min()), middle + float(off.max())


def rays_between(rays: ScanRays, bearing_rad: tuple[float, float], elevation_rad: tuple[float, float]) -> I32:
    """Indices (K,), ascending, of the rays in a window of bearing and elevation."""
    start = rays.ring_start
    (first, last), (low, high) = bearing_rad, elevation_rad
    there = start[:-1][np.diff(start) > 0]
    of_ring = rays.ray_elevation_rad[there]  # within a ring it hardly changes
    rings = np.flatnonzero((of_ring >= low - _WITHIN_RING_RAD) & (of_ring <= high + _WITHIN_RING_RAD))
    bounds = np.append(there, start[-1])
    chosen = [_in_window(rays, int(bounds[rings[0]]), int(bounds[rings[-1] + 1]), first, last)] if len(rings) else []
    if start[-1] < len(rays):  # stray points have rays of their own
        chosen.append(_in_window(rays, int(start[-1]), len(rays), first, last))
    ray = np.concatenate([np.zeros(0, np.intp), *chosen])
    elevation = rays.ray_elevation_rad[ray]
    return np.asarray(ray[(elevation >= low) & (elevation <= high)], dtype=np.int32)


def _in_window(rays: ScanRays, a: int, b: int, first: float, last: float) -> npt.NDArray[np.intp]:
    azimuth = rays.ray_azimuth_rad[a:b]  # in [-pi, pi): a window over the cut behind is two
    if first < -np.pi or last >= np.pi:
        inside = (azimuth >= float(wrap_angle(first))) | (azimuth <= float(wrap_angle(last)))
    else:
        inside = (azimuth >= first) & (azimuth <= last)
    return a + np.flatnonzero(inside)


def cast_car(
    model: CarModel, T_car_scanner: F64, rays: ScanRays, candidates: I32, profile: ScannerProfile, opaque_glass: bool
) -> CarHits:
    """Meet one car with candidate rays (C,), the scanner standing at `T_car_scanner` (C, 4, 4) when each is fired.

    With `opaque_glass` a pane ends the ray like any other surface.
    """
    origin, direction = lines_of_rays(profile, rays, candidates)
    return cast_mesh(
        model,
        candidates,
        transform_points(T_car_scanner, origin),
        rotate_vectors(T_car_scanner, direction),
        opaque_glass,
    )


def cast_mesh(model: CarModel, ray: I32, origin: F64, direction: F64, opaque_glass: bool) -> CarHits:
    """Meet a model with rays given in the car's frame: origins (C, 3) metres, unit directions (C, 3)."""
    structure = _structure(model)
    start, enters = _enter_box(origin, direction, model.size_m)
    ray, origin, direction, start = ray[enters], origin[enters], direction[enters], start[enters]
    count = len(ray)
    ranges = np.full((count, MAX_LAYERS), np.inf)
    faces = np.full((count, MAX_LAYERS), -1, dtype=np.int32)
    cosines = np.zeros((count, MAX_LAYERS))
    depth = np.zeros(count, dtype=np.int64)
    active, at = np.arange(count), start
    for step in range(4 * MAX_LAYERS):  # twin layers of a pane take a query each without taking a place
        if len(active) == 0:
            break
        o, d = (origin, direction) if step == 0 else (origin[active], direction[active])
        face, further, cosine = structure.first_hit(o + at[:, None] * d, d)
        hit = np.flatnonzero(face >= 0)
        active, face, cosine, reached = active[hit], face[hit], cosine[hit], (at + further)[hit]
        level = depth[active]
        is_glass = model.surface[face] == GLASS
        before = ranges[active, np.maximum(level - 1, 0)]
        new = np.flatnonzero((level == 0) | ~is_glass | (reached - before >= _SAME_PANE_M))
        rows, level = active[new], level[new]
        ranges[rows, level], faces[rows, level], cosines[rows, level] = reached[new], face[new], cosine[new]
        depth[rows] += 1
        goes_on = np.flatnonzero(is_glass & (depth[active] < MAX_LAYERS)) if not opaque_glass else active[:0]
        active, at = active[goes_on], reached[goes_on] + _STEP_M
    met = np.flatnonzero(depth > 0)
    surface = np.where(faces[met] >= 0, model.surface[faces[met]], MEASURED).astype(np.uint8)
    return CarHits(ray[met], ranges[met], faces[met], surface, cosines[met])


def cross_box(origin: F64, direction: F64, lower: Array, upper: Array) -> tuple[F64, F64]:
    """Where (metres along each ray) rays enter and leave a box between two corners (3,); entry after exit: a miss."""
    slope = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    a, b = (lower - origin) / slope, (upper - origin) / slope
    return np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)


def _enter_box(origin: F64, direction: F64, size_m: Array) -> tuple[F64, Any]:
    """Where (metres along the ray) to start just before the model's box, and which rays meet the box at all."""
    half = np.asarray(size_m, dtype=np.float64) / 2.0 + 1e-3
    enter, leave = cross_box(origin, direction, -half, half)
    return np.maximum(enter - _START_BEFORE_M, 0.0), (leave >= np.maximum(enter, 0.0))
