"""A noise-free pair for methods that match points: a corner of two rough walls and a box, each moved rigidly.

Points lie so far from each other that every voxel holds one at most: both scans have the same keypoints.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scored_pair import an_object, make_pair

from augkitti.frames import box_pose, compose, invert, pose_from_xyz_yaw, transform_points

EGO = pose_from_xyz_yaw(-0.9, 0.05, 0.0, 0.02)
OWN = pose_from_xyz_yaw(1.3, -0.4, 0.0, 0.06)  # of the box over ground, about its centre
BOX = np.array([11.0, 2.0, -0.6, 4.2, 1.9, 1.9, 0.3])


def spaced(rng, low, high, spacing, tries):
    """Points in a box, none nearer to another than `spacing`."""
    points = rng.uniform(low, high, (tries, 3))
    near = cKDTree(points).query_pairs(spacing, output_type="ndarray")
    kept = np.ones(tries, bool)
    for first, second in near[np.lexsort((near[:, 0], near[:, 1]))]:
        kept[second] &= not kept[first]
    return points[kept]


def corner_and_box(seed=0, spacing=0.4, ego=EGO, own=OWN):
    """The pair, and the true motion of the box from velo0 to velo1."""
    rng = np.random.default_rng(seed)
    walls = np.concatenate(
        [
            spaced(rng, [4.0, 7.0, -1.2], [22.0, 8.5, 1.5], spacing, 6000),
            spaced(rng, [20.0, -12.0, -1.2], [21.5, 6.0, 1.5], spacing, 6000),
        ]
    )
    half = BOX[3:6] / 2.0
    body = spaced(rng, -half, half, spacing, 4000)
    body = body[(np.abs(body) > half - 0.45).any(axis=1)]  # its skin
    body = body[body[:, 2] > 0.3 - half[2]]  # what lies low in a box is taken for ground
    pose = box_pose(BOX)
    motion = compose(compose(ego, compose(pose, own)), np.linalg.inv(pose))
    world = walls.astype(np.float32)
    car = transform_points(pose, body).astype(np.float32)
    xyz0 = np.concatenate([world, car])
    xyz1 = np.concatenate([transform_points(ego, world), transform_points(motion, car)]).astype(np.float32)
    item = replace(an_object(0, 0), box0=BOX, motion=motion)
    return _pair(xyz0, xyz1, np.repeat([-1, 0], [len(world), len(car)]), (item,), ego), motion


def along_the_axes(x, y):
    """Own motion of the box that shifts it along the scanner's axes."""
    shift = pose_from_xyz_yaw(x, y, 0.0, 0.0)
    return compose(invert(box_pose(BOX)), compose(shift, box_pose(BOX)))


def with_noise(pair, sigma_m):
    """The pair with normal noise on scan 1."""
    noise = np.random.default_rng(1).normal(0.0, sigma_m, pair.scan1.xyz.shape)
    return replace(pair, scan1=replace(pair.scan1, xyz=pair.scan1.xyz + noise.astype(np.float32)))


def _pair(xyz0, xyz1, instance, objects, ego):
    base = make_pair([])
    n = len(xyz0)
    scan0 = replace(
        base.scan0,
        xyz=xyz0,
        reflectance=np.zeros(n, np.float32),
        ring=np.zeros(n, np.uint8),
        tick=np.zeros(n, np.uint16),
        source=np.arange(n, dtype=np.int32),
        instance=instance.astype(np.int16),
        surface=np.zeros(n, np.uint8),
    )
    return replace(
        base,
        scan0=scan0,
        scan1=replace(scan0, xyz=xyz1),
        ego_motion=ego,
        objects=objects,
        flow0=(xyz1 - xyz0).astype(np.float32),
        flow_status0=np.zeros(n, np.uint8),
    )


def of_points(xyz0, xyz1):
    """A pair of any two scans of equal length without objects."""
    return _pair(xyz0.astype(np.float32), xyz1.astype(np.float32), np.full(len(xyz0), -1), (), np.eye(4))
