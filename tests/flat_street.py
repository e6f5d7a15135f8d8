"""A street in closed form for the ground's tests: crowned road, kerbs, pavements, boxes; points, rays and truth out.

Every ray of the shipped profile is met with the street's planes one by one, so the truth is exact and nothing of the
project's own ray caster is used.
"""

from dataclasses import dataclass

import numpy as np

from augkitti.frames import pose_from_xyz_yaw
from augkitti.scan_pair import Scan, ScanRays
from augkitti.scanner import assign_rays, fire_rays, load_profile, ray_lines

SENSOR_M = 1.73


@dataclass(frozen=True)
class FlatStreet:
    """A straight street turned by `yaw_rad`; lateral positions are from the ego car, left is positive."""

    yaw_rad: float = 0.0
    right_m: float = -3.5
    left_m: float = 5.0
    kerb_m: float = 0.12
    crown: float = 0.02
    grade: float = 0.0
    houses_m: float = 4.0  # from the kerb
    boxes: tuple[tuple[float, float, float, float, float, float], ...] = ()  # along, across, size, size, z from, z to

    @property
    def middle_m(self) -> float:
        return 0.5 * (self.right_m + self.left_m)

    def along_across(self, xy):
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return xy[:, 0] * c + xy[:, 1] * s, -xy[:, 0] * s + xy[:, 1] * c

    def height(self, xy):
        """z of the ground: the road falls from its middle, pavements lie a kerb above the gutter."""
        along, across = self.along_across(xy)
        top = -SENSOR_M + self.crown * abs(self.middle_m)
        edge = np.clip(across, self.right_m, self.left_m)
        road = top - self.crown * np.abs(edge - self.middle_m)
        return road + np.where(self.is_road(xy), 0.0, self.kerb_m) + self.grade * along

    def is_road(self, xy):
        _, across = self.along_across(xy)
        return (across > self.right_m) & (across < self.left_m)

    def scan(self, noise_m: float = 0.008, seed: int = 0) -> tuple[Scan, ScanRays]:
        """One raw scan with white noise and beam biases as large as the real scanner's, standing still."""
        profile = load_profile()
        ticks = np.unique(np.linspace(0, 3999, 2150).astype(np.uint16))
        rays = fire_rays(profile, ticks, 0.1035)
        origin, direction = ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
        T = pose_from_xyz_yaw(0.0, 0.0, 0.0, -self.yaw_rad)
        o, d = origin @ T[:3, :3].T, direction @ T[:3, :3].T
        reach = np.full(len(o), np.inf)
        top = -SENSOR_M + self.crown * abs(self.middle_m)
        half = 0.5 * (self.left_m - self.right_m)
        gutter = top - self.crown * half
        far = self.houses_m
        for across0, across1, z0, z1 in (
            (self.right_m, self.middle_m, gutter, top),
            (self.middle_m, self.left_m, top, gutter),
            (self.left_m, self.left_m + far, gutter + self.kerb_m, gutter + self.kerb_m),
            (self.right_m - far, self.right_m, gutter + self.kerb_m, gutter + self.kerb_m),
        ):
            rise = (z1 - z0) / (across1 - across0)
            falls = d[:, 2] - rise * d[:, 1] - self.grade * d[:, 0]
            starts = o[:, 2] - z0 - rise * (o[:, 1] - across0) - self.grade * o[:, 0]
            with np.errstate(divide="ignore"):
                s = -starts / falls
            across = o[:, 1] + s * d[:, 1]
            reach = np.where((s > 0) & (across >= across0) & (across <= across1), np.minimum(reach, s), reach)
        for across0, z0, z1 in (
            (self.left_m, gutter, gutter + self.kerb_m),
            (self.right_m, gutter, gutter + self.kerb_m),
            (self.left_m + far, gutter, 6.0),
            (self.right_m - far, gutter, 6.0),
        ):
            with np.errstate(divide="ignore"):
                s = (across0 - o[:, 1]) / d[:, 1]
            z = o[:, 2] + s * d[:, 2] - self.grade * (o[:, 0] + s * d[:, 0])
            reach = np.where((s > 0) & (z >= z0) & (z <= z1), np.minimum(reach, s), reach)
        for along, across, length, width, z0, z1 in self.boxes:
            low = np.array([along - length / 2, across - width / 2, z0 - SENSOR_M])
            high = np.array([along + length / 2, across + width / 2, z1 - SENSOR_M])
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (low - o) / d, (high - o) / d
            enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
            reach = np.where((enter < leave) & (enter > 0), np.minimum(reach, enter), reach)
        rng = np.random.default_rng(seed)
        bias = rng.normal(0.0, 0.027, profile.beams)[rays.ray_ring]  # scanner.md section 2
        back = (reach < 80.0) & (reach > 1.5) & ~rays.ray_blind
        s = (reach + bias + rng.normal(0.0, noise_m, len(reach)))[back]
        xyz = np.round(origin[back] + s[:, None] * direction[back], 3).astype(np.float32)
        azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi)
        xyz = xyz[np.lexsort((azimuth, rays.ray_ring[back]))]
        n = len(xyz)
        scan = Scan(xyz, np.full(n, 0.3, np.float32), np.arange(n, dtype=np.int32), n, "raw", 0.0, 0.1035)
        return scan, assign_rays(scan, profile)
