"""A small augmented pair made by hand: flat ground, a wall, a moving virtual car and a moving labelled one."""

import numpy as np

from augkitti.frames import compose, invert, pose_from_xyz_yaw, transform_points
from augkitti.scan_pair import GLASS, MEASURED, MIXED, PAINT, AugmentedPair, AugmentedScan, ObjectRecord, Scan

EGO = pose_from_xyz_yaw(-1.0, 0.0, 0.0, -0.01)
SIZE = np.array([4.2, 1.8, 1.5])


def _world(rng, n):
    ground = np.column_stack([rng.uniform(-30, 40, n), rng.uniform(-15, 15, n), rng.normal(-1.73, 0.01, n)])
    wall = np.column_stack([rng.uniform(-30, 40, n // 4), np.full(n // 4, 14.0), rng.uniform(-1.7, 3.0, n // 4)])
    return np.concatenate([ground, wall])


def _scan(rng, world, pose, rows_hidden):
    near = transform_points(pose, rng.uniform(-0.5, 0.5, (60, 3)) * SIZE)
    kept = np.setdiff1d(np.arange(len(world)), rows_hidden)
    xyz = np.concatenate([world[kept], near]).astype(np.float32)
    n, m = len(xyz), len(kept)
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    surface = np.zeros(n, np.uint8)
    surface[m:] = PAINT
    surface[m : m + 9] = GLASS
    surface[m + 9] = MIXED
    instance = np.full(n, -1, np.int16)
    instance[m:] = np.where(surface[m:] == MIXED, -1, 0)
    return AugmentedScan(
        xyz=xyz,
        reflectance=np.full(n, 0.25, np.float32),
        ring=np.clip((0.034 - elevation) / 0.47 * 64, 0, 63).astype(np.uint8),
        tick=rng.integers(0, 4000, n).astype(np.uint16),
        source=np.where(surface == MEASURED, np.concatenate([kept, np.zeros(n - m, int)]), -1).astype(np.int32),
        instance=instance,
        surface=surface,
        removed=np.asarray(rows_hidden, np.int32),
    )


def virtual_car(pose0, pose1, speed, yaw_rate, name="virtual_0"):
    """A row of `objects` with nothing but what figures and pictures need."""
    boxes = [np.array([*p[:3, 3], *SIZE, np.arctan2(p[1, 0], p[0, 0])]) for p in (pose0, pose1)]
    motion = compose(pose1, invert(pose0))
    return ObjectRecord(
        name,
        "Car",
        "virtual",
        "hand_made",
        *boxes,
        pose0,
        pose1,
        0.0,
        0.0,
        motion,
        59,
        59,
        80,
        80,
        speed,
        yaw_rate,
        0.0,
    )


def labelled_car(place, speed, yaw_rate=0.0, seconds=0.1, category="Car", name="7"):
    """A labelled box at (x, y, yaw) in velo0 that drives over ground for `seconds` between its moments."""
    T_velo0_car0 = pose_from_xyz_yaw(place[0], place[1], -0.98, place[2])
    T_car0_car1 = pose_from_xyz_yaw(speed * seconds, 0.0, 0.0, yaw_rate * seconds)
    T_velo1_car1 = compose(EGO, compose(T_velo0_car0, T_car0_car1))
    boxes = [np.array([*p[:3, 3], *SIZE, np.arctan2(p[1, 0], p[0, 0])]) for p in (T_velo0_car0, T_velo1_car1)]
    motion = compose(T_velo1_car1, invert(T_velo0_car0))
    return ObjectRecord(name, category, "labelled", None, *boxes, motion=motion, points0=0, points1=0)


def make_pair(frame0=0, virtual_speed=10.0, virtual_yaw_rate=0.3, labelled=None, place=(12.0, -3.0, 0.2)):
    """The pair, and its two source scans."""
    rng = np.random.default_rng(frame0)
    world = _world(rng, 2000)
    pose0 = pose_from_xyz_yaw(place[0], place[1], -0.98, place[2])
    step = pose_from_xyz_yaw(virtual_speed * 0.1, 0.0, 0.0, virtual_yaw_rate * 0.1)
    pose1 = compose(EGO, compose(pose0, step))
    scan0, scan1 = _scan(rng, world, pose0, np.arange(5, 25)), _scan(rng, world, pose1, np.arange(40, 50))
    objects = [virtual_car(pose0, pose1, virtual_speed, virtual_yaw_rate)]
    objects += [labelled_car((20.0, 5.0, 0.0), 4.0)] if labelled is None else labelled
    xyz = scan0.xyz.astype(np.float64)
    flow = transform_points(EGO, xyz)
    flow[scan0.instance == 0] = transform_points(objects[0].motion, xyz[scan0.instance == 0])
    time0 = 1000.0 + 0.1 * frame0
    pair = AugmentedPair(
        pair_id=f"2011_09_26_drive_0005_sync/{frame0}/0",
        sequence="2011_09_26_drive_0005_sync",
        recording="2011_09_26_drive_0005",
        frame0=frame0,
        frame1=frame0 + 1,
        time0=time0,
        time1=time0 + 0.1,
        scan_kind="raw",
        seed=1,
        ego_motion=EGO,
        ego_source="oxts",
        label_coverage="camera",
        label_azimuth=(-0.7, 0.7),
        scan0=scan0,
        scan1=scan1,
        flow0=(flow - xyz).astype(np.float32),
        flow_status0=(scan0.surface == MIXED).astype(np.uint8),
        objects=tuple(objects),
    )
    rows = np.arange(len(world), dtype=np.int32)
    grey = np.full(len(world), 0.25, np.float32)
    sources = [
        Scan(world.astype(np.float32), grey, rows, len(world), "compensated", t, 0.1) for t in (time0, time0 + 0.1)
    ]
    return pair, sources[0], sources[1]
