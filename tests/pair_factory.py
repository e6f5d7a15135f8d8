"""Small pairs that obey the whole contract, made in code: a flat road between walls, cast ray by ray with a solid car.

Written without the generation code (only frames, profile and records), so that validation has something to agree with.
`make_pair` gives a pair and the rows of its two source scans; `write_data_set` a whole folder and the KITTI root of it.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from augkitti.config import Config
from augkitti.dataset_index import KITTI_LICENCE, make_index, shard_entry, write_card, write_index
from augkitti.frames import (
    compose,
    invert,
    pose_from_xyz_yaw,
    rotate_vectors,
    se3_exp,
    transform_points,
    yaw_of,
)
from augkitti.scan_pair import AugmentedPair, AugmentedScan, ObjectRecord
from augkitti.scanner import fire_rays, load_profile, ray_lines
from augkitti.shards import shard_metadata, write_shard

PERIOD_S = 0.1035
GROUND_Z_M = -1.73
WALL_Y_M = 9.0
SIZE_M = np.array([4.2, 1.8, 1.5])
REAR_AXLE_X_M = -1.2
PARKED = pose_from_xyz_yaw(9.0, 4.5, GROUND_Z_M + 0.75, 0.05)
CONFIG = Config()


@dataclass(frozen=True, eq=False)
class Made:
    pair: AugmentedPair
    rows: tuple[np.ndarray, np.ndarray]  # (M, 4) float32: the source scans


def make_pair(
    sequence: str = "2011_09_26_drive_0005_sync",
    frame0: int = 0,
    variant: int = 0,
    place: tuple[float, float, float] = (12.0, -2.5, 0.1),
    speed_mps: float = 7.0,
    yaw_rate_rps: float = 0.2,
    kind: str = "raw",
    tick_step: int = 4,
) -> Made:
    """A pair with a moving virtual car, a parked labelled one, and a box labelled in scan 0 only."""
    profile = load_profile()
    ego_twist = np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.05])
    twist = np.array([speed_mps, -yaw_rate_rps * REAR_AXLE_X_M, 0.0, 0.0, 0.0, yaw_rate_rps])
    start = pose_from_xyz_yaw(place[0], place[1], GROUND_Z_M + SIZE_M[2] / 2, place[2])
    ticks = np.arange(0, profile.lattice_size, tick_step, dtype=np.uint16)
    rays = fire_rays(profile, ticks, PERIOD_S)
    origin, direction = ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)

    def T_velo_body(time_s, T_world_body):
        return compose(invert(se3_exp(ego_twist, time_s)), T_world_body(time_s))

    def car(time_s):
        return compose(start, se3_exp(twist, time_s))

    def parked(time_s):
        return np.broadcast_to(PARKED, (*np.shape(time_s), 4, 4))

    scans, rows, poses, moments, labelled = [], [], [], [], []
    for k in (0, 1):
        middle = k * PERIOD_S
        pose, moment = _at_its_moment(lambda t: T_velo_body(t, car), middle, kind)
        label, label_moment = _at_its_moment(lambda t: T_velo_body(t, parked), middle, kind)
        time = middle + (rays.ray_time_s if kind == "raw" else np.zeros(len(rays)))
        T_world_velo = se3_exp(ego_twist, time)
        world_origin, world_direction = transform_points(T_world_velo, origin), rotate_vectors(T_world_velo, direction)
        background = _background(world_origin, world_direction)
        T_car_world = invert(car(time))
        hit = _hit_box(transform_points(T_car_world, world_origin), rotate_vectors(T_car_world, world_direction))
        background[rays.ray_blind | (background < 2.0) | (background > 79.0)] = np.inf
        seen = np.flatnonzero(np.isfinite(background))
        measured = np.round(origin[seen] + background[seen, None] * direction[seen], 3)
        in_file = np.lexsort((np.arctan2(measured[:, 1], measured[:, 0]) % (2 * np.pi), rays.ray_ring[seen]))
        seen, measured = seen[in_file], measured[in_file].astype(np.float32)
        grey = np.full(len(seen), np.float32(0.25))
        rows.append(np.column_stack([measured, grey]))

        kept = ~(hit[seen] < background[seen])
        new = np.flatnonzero((hit < background) & ~rays.ray_blind)
        local = transform_points(T_car_world[new], world_origin[new] + hit[new, None] * world_direction[new])
        surface = np.where(local[:, 2] < -0.4, 3, np.where(local[:, 2] > 0.4, 2, 1)).astype(np.uint8)
        surface[np.abs(local[:, 1]) > SIZE_M[1] / 2 - 0.01] = 7
        surface[len(surface) // 2 :: 7] = 6
        simulated = np.round(origin[new] + hit[new, None] * direction[new], 3).astype(np.float32)
        of_label = _in_box(measured[kept], label, SIZE_M) & (measured[kept, 2] > GROUND_Z_M + 0.15)
        no_tick = kind != "raw"
        scans.append(
            AugmentedScan(
                xyz=np.concatenate([measured[kept], simulated]),
                reflectance=np.concatenate([grey[kept], np.full(len(new), np.float32(0.1))]),
                ring=rays.ray_ring[np.concatenate([seen[kept], new])],
                tick=np.full(kept.sum() + len(new), 65535, np.uint16)
                if no_tick
                else rays.ray_tick[np.concatenate([seen[kept], new])],
                source=np.concatenate([np.flatnonzero(kept), np.full(len(new), -1)]).astype(np.int32),
                instance=np.concatenate([np.where(of_label, 0, -1), np.where(surface == 7, -1, 2)]).astype(np.int16),
                surface=np.concatenate([np.zeros(kept.sum(), np.uint8), surface]),
                removed=np.flatnonzero(~kept).astype(np.int32),
            )
        )
        poses.append(pose)
        moments.append(moment)
        labelled.append((label, label_moment))

    ego_motion = invert(se3_exp(ego_twist, PERIOD_S))
    label_motion = compose(labelled[1][0], invert(labelled[0][0]))
    counts = [np.bincount(scan.instance[scan.instance >= 0], minlength=3) for scan in scans]
    objects = (
        ObjectRecord(
            id="tracklet_0",
            category="Car",
            origin="labelled",
            box0=_box(labelled[0][0]),
            box1=_box(labelled[1][0]),
            moment0=labelled[0][1],
            moment1=labelled[1][1],
            motion=label_motion,
            points0=int(counts[0][0]),
            points1=int(counts[1][0]),
            speed=0.0,
            yaw_rate=0.0,
        ),
        ObjectRecord(
            id="tracklet_1",
            category="Pedestrian",
            origin="labelled",
            box0=np.array([-20.0, 5.0, GROUND_Z_M + 0.9, 0.8, 0.6, 1.8, 0.0]),
            moment0=0.0 if kind != "raw" else -float(np.arctan2(5.0, -20.0)) / (2 * np.pi) * PERIOD_S,
        ),
        ObjectRecord(
            id="virtual_0",
            category="Car",
            origin="virtual",
            model="solid_box",
            box0=_box(poses[0]),
            box1=_box(poses[1]),
            pose0=poses[0],
            pose1=poses[1],
            moment0=moments[0],
            moment1=moments[1],
            motion=compose(poses[1], invert(poses[0])),
            points0=int(counts[0][2]),
            points1=int(counts[1][2]),
            rays0=int(counts[0][2]) + 20,
            rays1=int(counts[1][2]) + 20,
            speed=speed_mps,
            yaw_rate=yaw_rate_rps,
            steering=float(np.arctan2(2.6 * yaw_rate_rps, max(speed_mps, 1e-9))),
        ),
    )
    xyz = scans[0].xyz.astype(np.float64)
    moved = transform_points(ego_motion, xyz)
    for row, item in enumerate(objects):
        if item.motion is not None:
            mine = scans[0].instance == row
            moved[mine] = transform_points(item.motion, xyz[mine])
    status = (scans[0].surface == 7).astype(np.uint8)
    pair = AugmentedPair(
        pair_id=f"{sequence}/{frame0}/{variant}",
        sequence=sequence,
        recording=sequence.removesuffix("_sync"),
        frame0=frame0,
        frame1=frame0 + 1,
        time0=1.3e9 + frame0 * PERIOD_S,
        time1=1.3e9 + (frame0 + 1) * PERIOD_S,
        scan_kind=kind,
        seed=variant + 1,
        ego_motion=ego_motion,
        ego_source="truth",
        label_coverage="full",
        label_azimuth=None,
        scan0=scans[0],
        scan1=scans[1],
        flow0=(moved - xyz).astype(np.float32),
        flow_status0=status,
        objects=objects,
    )
    return Made(pair, (rows[0], rows[1]))


def metadata() -> dict:
    return shard_metadata(CONFIG, load_profile(), [])


def write_data_set(folder: Path, root: Path, recordings: int = 1, shards: int = 1, pairs: int = 1) -> dict[str, Made]:
    """A finished data set in `folder`, made from the drives that are written under `root`; the pairs by name."""
    made: dict[str, Made] = {}
    entries = []
    for recording in range(recordings):
        sequence = f"2011_09_26_drive_{9000 + recording}_sync"
        drive = root / "raw" / sequence[:10] / sequence / "velodyne_points" / "data"
        drive.mkdir(parents=True)
        for shard in range(shards):
            here = []
            for pair in range(pairs):
                frame0 = 40 * shard + 2 * pair
                one = make_pair(sequence, frame0, speed_mps=6.0 + pair)
                here.append(one)
                for k, rows in enumerate(one.rows):
                    rows.astype("<f4").tofile(drive / f"{frame0 + k:010d}.bin")
            path = folder / "data" / f"{sequence}-{shard:05d}.parquet"
            write_shard(path, [one.pair for one in here], metadata())
            entries.append(shard_entry(folder, path, sequence, here[0].pair.recording, len(here)))
            made.update({one.pair.pair_id: one for one in here})
    write_whole_index(folder, entries)
    return made


def write_whole_index(folder: Path, entries: list) -> None:
    index = make_index(CONFIG, 7, entries, {}, [], KITTI_LICENCE, {"kind": "kitti"})
    write_card(folder, index)
    write_index(folder, index)


def with_scan(pair: AugmentedPair, k: int, **columns) -> AugmentedPair:
    """The pair with columns of a scan replaced."""
    name = f"scan{k}"
    return replace(pair, **{name: replace(getattr(pair, name), **columns)})


def with_object(pair: AugmentedPair, row: int, **fields) -> AugmentedPair:
    """The pair with fields of an object replaced."""
    objects = list(pair.objects)
    objects[row] = replace(objects[row], **fields)
    return replace(pair, objects=tuple(objects))


def _at_its_moment(T_velo_body, middle_s, kind):
    moment = 0.0
    for _ in range(20 if kind == "raw" else 0):
        T = T_velo_body(middle_s + moment)
        moment = -float(np.arctan2(T[1, 3], T[0, 3])) / (2 * np.pi) * PERIOD_S
    return T_velo_body(middle_s + moment), moment


def _box(T_velo_body):
    return np.array([*T_velo_body[:3, 3], *SIZE_M, yaw_of(T_velo_body)])


def _in_box(points, T_velo_body, size):
    return (np.abs(transform_points(invert(T_velo_body), points)) <= size / 2).all(axis=1)


def _background(origin, direction):
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(direction[:, 2] < 0, (GROUND_Z_M - origin[:, 2]) / direction[:, 2], np.inf)
        left, right = (WALL_Y_M - origin[:, 1]) / direction[:, 1], (-WALL_Y_M - origin[:, 1]) / direction[:, 1]
    wall = np.where(left > 0, left, right)
    high = origin[:, 2] + wall * direction[:, 2] > 4.0
    distance = np.minimum(ground, np.where(high | ~(wall > 0), np.inf, wall))
    T = invert(PARKED)
    return np.minimum(distance, _hit_box(transform_points(T, origin), rotate_vectors(T, direction)))


def _hit_box(origin, direction):
    half = SIZE_M / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - origin) / direction, (half - origin) / direction
    enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((enter > 0) & (enter < leave), enter, np.inf)
