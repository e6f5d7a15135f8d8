"""Scans of planes and spheres in closed form with noise as told: the scan, its rays and the truth out."""

from collections.abc import Callable

import numpy as np

from augkitti import scanner
from augkitti.frames import F64
from augkitti.scan_pair import U8, Scan, ScanRays

PROFILE = scanner.load_profile()
GROUND_M = -1.73
Noise = Callable[[U8, F64, F64, np.random.Generator], F64]  # ring, range, cosine of incidence -> error in metres


def known_biases(seed: int = 0, std_m: float = 0.025) -> F64:
    """Biases (64,) of beams, metres."""
    return np.random.default_rng(seed).normal(0.0, std_m, PROFILE.beams)


def white_noise(std_m: float, bias_m: F64) -> Noise:
    """The same normal noise everywhere, and a bias of each beam."""
    return lambda ring, range_m, cosine, rng: bias_m[ring] + rng.normal(0.0, std_m, len(ring))


def scan_room(
    noise: Noise, seed: int = 0, walls_m: tuple[float, float] = (11.0, 14.0), drop: float = 0.0
) -> tuple[Scan, ScanRays]:
    """Ground and four walls, so far ahead and behind, and so far to the sides."""

    def surface(origin: F64, direction: F64) -> tuple[F64, F64]:
        planes = [(np.array([0.0, 0.0, 1.0]), GROUND_M)]
        planes += [(np.eye(3)[axis] * sign, -away) for axis, away in enumerate(walls_m) for sign in (-1.0, 1.0)]
        reach, cosine = np.full(len(origin), np.inf), np.zeros(len(origin))
        for normal, at in planes:
            falls = direction @ normal
            with np.errstate(divide="ignore"):
                s = (at - origin @ normal) / falls
            nearer = (s > 0) & (falls < 0) & (s < reach)
            reach, cosine = np.where(nearer, s, reach), np.where(nearer, -falls, cosine)
        return reach, cosine

    return _scan(surface, noise, seed, drop)


def scan_sphere(noise: Noise, radius_m: float, seed: int = 0) -> tuple[Scan, ScanRays]:
    """A sphere round the frame's origin."""

    def surface(origin: F64, direction: F64) -> tuple[F64, F64]:
        along = (origin * direction).sum(axis=1)
        s = -along + np.sqrt(along**2 - (origin**2).sum(axis=1) + radius_m**2)
        return s, ((origin + s[:, None] * direction) * direction).sum(axis=1) / radius_m

    return _scan(surface, noise, seed, 0.0)


def _scan(surface: Callable[[F64, F64], tuple[F64, F64]], noise: Noise, seed: int, drop: float):
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(rng.choice([1, 2], 2500, p=[0.15, 0.85]))  # scanner.md section 1: gaps of the encoder
    rays = scanner.fire_rays(PROFILE, ticks[ticks < 4000].astype(np.uint16), 0.1035)
    origin, direction = scanner.lines_of_rays(PROFILE, rays, np.arange(len(rays), dtype=np.int32))
    reach, cosine = surface(origin, direction)
    back = np.flatnonzero(np.isfinite(reach) & ~rays.ray_blind & (rng.random(len(rays)) >= drop))
    measured = reach[back] + noise(rays.ray_ring[back], reach[back], cosine[back], rng)
    measured = scanner_steps(measured, rays.ray_ring[back])
    xyz = np.round(origin[back] + measured[:, None] * direction[back], 3).astype(np.float32)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi)
    xyz = xyz[np.lexsort((azimuth, rays.ray_ring[back]))]
    n = len(xyz)
    scan = Scan(xyz, np.full(n, 0.3, np.float32), np.arange(n, dtype=np.int32), n, "raw", 0.0, 0.1035)
    return scan, scanner.assign_rays(scan, PROFILE)


def scanner_steps(range_m: F64, ring: U8) -> F64:
    """Ranges on the scanner's quantum."""
    phase = PROFILE.range_phase_m[ring]
    return phase + np.rint((range_m - phase) / PROFILE.range_quantum_m) * PROFILE.range_quantum_m
