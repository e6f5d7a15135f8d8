"""Occlusion: a real scan and what each virtual car returned in, the scan with cars in it out; the nearest event wins.

Along each ray, the stops of all cars and the source's own return are ordered by true range. A return in front of every
car stays as measured; one behind the nearest stop is removed; the nearest stop gives the new return, if it gave one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from augkitti.frames import F32, F64, Array
from augkitti.scan_pair import I16, I32, NO_TICK, U8, U16, Bool, PreparedScan
from augkitti.scanner import ScannerProfile, lines_of_rays
from augkitti.sensor_noise import CarReturns


@dataclass(frozen=True, eq=False)
class SimulatedPoints:
    """Returns of virtual cars in one scan, by (ring, tick)."""

    xyz: F32  # (S, 3)
    reflectance: F32
    ring: U8
    tick: U16
    car: I16  # which of the cars
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
    return Occluded(kept, _points(prepared, ray[seen], [*columns, car[seen]], profile))


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
