"""A street for the baselines: ground, posts and walls, and cars that are boxes; both scans hold the same points.

With `noise_m` both scans' points are off by so much, and every second one is kept in each.
"""

from dataclasses import replace

import numpy as np
from scored_pair import EGO, make_pair

from augkitti.frames import box_pose, transform_points
from augkitti.scan_pair import AugmentedPair


def street_pair(objects, noise_m: float = 0.0, points: int = 300, seed: int = 0, world: bool = True) -> AugmentedPair:
    """The pair; every object's points lie on four sides and the roof of its box."""
    rng = np.random.default_rng(seed)
    parts = [_world(rng)] if world else [np.zeros((0, 3))]
    instance = [np.full(len(parts[0]), -1)]
    for row, item in enumerate(objects):
        parts.append(transform_points(box_pose(item.box0), _skin(rng, points) * item.box0[3:6]))
        instance.append(np.full(points, row))
    xyz, instance = np.concatenate(parts), np.concatenate(instance).astype(np.int16)
    moved = transform_points(EGO, xyz)
    for row, item in enumerate(objects):
        moved[instance == row] = transform_points(item.motion, xyz[instance == row])
    flow = moved - xyz
    kept0 = kept1 = np.ones(len(xyz), dtype=bool)
    if noise_m:
        kept0, kept1 = rng.random((2, len(xyz))) < 0.5
        xyz = xyz + noise_m * rng.standard_normal(xyz.shape)
        moved = moved + noise_m * rng.standard_normal(xyz.shape)
    shape = make_pair(objects, background=())
    return replace(
        shape,
        scan0=_scan(shape.scan0, xyz[kept0], instance[kept0]),
        scan1=_scan(shape.scan0, moved[kept1], instance[kept1]),
        flow0=flow[kept0].astype(np.float32),
        flow_status0=np.zeros(int(kept0.sum()), np.uint8),
    )


def _world(rng):
    ground = np.column_stack([rng.uniform(-25, 45, 6000), rng.uniform(-20, 20, 6000), np.full(6000, -1.9)])
    wall = np.column_stack([rng.uniform(-25, 45, 2500), np.full(2500, 15.0), rng.uniform(-1.9, 2.0, 2500)])
    front = np.column_stack([np.full(800, 44.0), rng.uniform(-15, 15, 800), rng.uniform(-1.9, 2.0, 800)])
    places = np.column_stack([rng.uniform(-20, 40, 25), rng.choice([-9.0, 9.0], 25)])
    feet = np.repeat(places, 40, axis=0) + rng.uniform(-0.1, 0.1, (1000, 2))
    posts = np.column_stack([feet, rng.uniform(-1.9, 2.0, 1000)])
    return np.concatenate([ground, wall, front, posts])


def _skin(rng, points):
    """Points (n, 3) on five sides of a box of size 1, above its lowest fifth."""
    at = rng.uniform(-0.5, 0.5, (points, 3))
    side = rng.integers(0, 5, points)
    at[np.arange(points), side // 2] = np.where(side % 2, -0.5, 0.5)
    at[:, 2] = np.maximum(at[:, 2], -0.3)
    return at


def _scan(like, xyz, instance):
    n = len(xyz)
    return replace(
        like,
        xyz=xyz.astype(np.float32),
        reflectance=np.zeros(n, np.float32),
        ring=np.zeros(n, np.uint8),
        tick=np.zeros(n, np.uint16),
        source=np.arange(n, dtype=np.int32),
        instance=instance,
        surface=np.zeros(n, np.uint8),
    )
