"""Occlusion: a real scan and what each virtual car returned in, the scan with cars in it out; the nearest event wins.

Along each ray, the stops of all cars and the source's own return are ordered by true range. A return in front of every
car stays as measured; one behind the nearest stop is removed; the nearest stop gives the new return, if it gave one.
Where a car's silhouette stands before measured background on the next ray of the ring, its last ray may return from
between the two (a mixed point: the pulse is wider than a point), as often as at real cars, or not at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from augkitti.frames import F32, F64, Array
from augkitti.range_noise import MIXED_M, NoiseProfile, mixed_range
from augkitti.scan_pair import I16, I32, MIXED, NO_TICK, THROUGH_GLASS, U8, U16, Bool, PreparedScan
from augkitti.scanner import ScannerProfile, lines_of_rays
from augkitti.sensor_noise import CarReturns, quantise_range, solid_noise


@dataclass(frozen=True, eq=False)
class SimulatedPoints:
    """Returns of virtual cars in one scan, by (ring, tick)."""

    xyz: F32  # (S, 3)
    reflectance: F32
    ring: U8
    tick: U16
    car: I16  # which of the cars; of a mixed point the nearer side's
    surface: U8
    ray: I32  # of the scan's rays, ascending


@dataclass(frozen=True, eq=False)
class Occluded:
    """A scan after the cars went in."""

    kept: Bool  # (N,) measured points that stay
    simulated: SimulatedPoints


def measured_range(prepared: PreparedScan, ray: I32, profile: ScannerProfile) -> F64:
    """Range (K,) metres along given rays of what the real scanner measured; inf where nothing returned."""
    point = prepared.rays.ray_point[ray]
    origin, direction = lines_of_rays(profile, prepared.rays, ray)
    off = (prepared.scan.xyz[point].astype(np.float64) - origin) * direction
    return np.where(point >= 0, off[:, 0] + off[:, 1] + off[:, 2], np.inf)


def keep_nearest(prepared: PreparedScan, cars: Sequence[tuple[I32, CarReturns]], profile: ScannerProfile) -> Occluded:
    """Merge the cars' (rays, returns) with the scan."""
    rays = prepared.rays
    kept = np.ones(len(prepared.scan), dtype=bool)
    if not cars:
        return Occluded(kept, _points(prepared, np.zeros(0, np.int32), [], profile))
    ray = np.concatenate([its_rays for its_rays, _ in cars])
    stop = np.concatenate([returns.stop_m for _, returns in cars])
    car = np.repeat(np.arange(len(cars), dtype=np.int16), [len(its_rays) for its_rays, _ in cars])
    by_ray = np.lexsort((stop, ray))
    first = by_ray[np.concatenate([[True], np.diff(ray[by_ray]) > 0])] if len(ray) else by_ray
    first = first[np.isfinite(stop[first])]
    hidden = stop[first] < measured_range(prepared, ray[first], profile)
    nearest = first[hidden]
    point = rays.ray_point[ray[nearest]]
    kept[point[point >= 0]] = False

    merged = {name: np.concatenate([getattr(r, name) for _, r in cars]) for name in _RETURN_FIELDS}
    on_lattice = (rays.ray_tick[ray[nearest]] != NO_TICK) | (prepared.scan.kind == "compensated")
    seen = nearest[merged["returned"][nearest] & ~rays.ray_blind[ray[nearest]] & on_lattice]
    seen = seen[np.argsort(ray[seen], kind="stable")]  # rays stand by (ring, tick)
    columns = [merged[name][seen] for name in ("range_m", "reflectance", "surface")]
    noise = solid_noise(profile)
    if noise is not None and prepared.scan.kind == "raw" and all(r.edge_luck is not None for _, r in cars):
        luck = np.concatenate([r.edge_luck for _, r in cars if r.edge_luck is not None], axis=1)
        left = _mix_at_edges(prepared, ray, ray[seen], stop[seen], columns, luck[:, seen], noise, profile)
        seen, columns = seen[left], [column[left] for column in columns]
    return Occluded(kept, _points(prepared, ray[seen], [*columns, car[seen]], profile))


def _mix_at_edges(
    prepared: PreparedScan,
    met: I32,
    ray: I32,
    near_m: F64,
    columns: list[Array],
    luck: F64,
    noise: NoiseProfile,
    profile: ScannerProfile,
) -> Bool:
    """Turn some returns at silhouettes into mixed points, in `columns` (range, reflectance, surface); which to keep.

    A silhouette: the next ray of the ring meets no car, and measured something more than the least step farther away.
    There a pulse is half on the car. A last ray that lies more than 0.25 m behind its neighbour on the car (the far
    wheel, a sliver of the other side) would look like a mixed point, three times as often as at real cars: it is lost.
    """
    rays = prepared.rays
    meets_car = np.zeros(len(rays), dtype=bool)
    meets_car[met] = True
    of_ray = np.full(len(rays), np.inf)
    of_ray[ray] = near_m
    ring = rays.ray_ring[ray].astype(np.int64)
    first, last = rays.ring_start[ring], rays.ring_start[ring + 1]
    least = float(noise.arrays["edge"][0, 0])
    far_m, sliver = np.full(len(ray), np.inf), np.zeros(len(ray), dtype=bool)
    for side in (-1, 1):
        beside = first + (ray - first + side) % (last - first)  # a ring closes straight ahead
        at = np.flatnonzero(~meets_car[beside] & (columns[2] != THROUGH_GLASS))
        beyond = measured_range(prepared, beside[at].astype(np.int32), profile)
        stands = beyond - near_m[at] > least
        far_m[at] = np.where(stands, np.minimum(far_m[at], beyond), far_m[at])
        inner = of_ray[first[at] + (ray[at] - first[at] - side) % (last[at] - first[at])]
        sliver[at] |= stands & (near_m[at] - inner > MIXED_M)
    at = np.flatnonzero(np.isfinite(far_m))
    own = measured_range(prepared, ray[at], profile)  # a mixed point stays before what the car hides on its ray
    far, near = np.minimum(far_m[at], own), near_m[at]
    mixed = (luck[0, at] < noise.arrays["edge.car"][0]) & (far - near > least)
    keep = np.ones(len(ray), dtype=bool)
    keep[at[~mixed & sliver[at]]] = False
    at, between = at[mixed], mixed_range(noise, near[mixed], far[mixed], luck[1, at[mixed]])
    its_ring = rays.ray_ring[ray[at]]
    columns[0][at] = np.minimum(quantise_range(between, its_ring, profile), profile.max_range_m)
    columns[2][at] = MIXED
    return keep


_RETURN_FIELDS = ("returned", "range_m", "reflectance", "surface")


def _points(prepared: PreparedScan, ray: I32, columns: list[Array], profile: ScannerProfile) -> SimulatedPoints:
    rays = prepared.rays
    range_m, reflectance, surface, car = columns or [np.zeros(0)] * 4
    origin, direction = lines_of_rays(profile, rays, ray)
    xyz = origin + range_m[:, None] * direction
    step = profile.coordinate_quantum_m
    if prepared.scan.kind == "raw":
        xyz = np.rint(xyz / step) * step
    return SimulatedPoints(
        xyz=xyz.astype(np.float32),
        reflectance=reflectance.astype(np.float32),
        ring=rays.ray_ring[ray],
        tick=rays.ray_tick[ray],
        car=car.astype(np.int16),
        surface=surface.astype(np.uint8),
        ray=ray,
    )
