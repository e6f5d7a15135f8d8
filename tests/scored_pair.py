"""A pair of a few hundred points whose every figure can be worked out by hand; and predictions of it."""

from dataclasses import replace

import numpy as np
from pair_factory import metadata, write_whole_index

from augkitti.dataset_index import read_index, shard_entry
from augkitti.frames import box_pose, compose, invert, pose_from_xyz_yaw, transform_points
from augkitti.scan_pair import AugmentedPair, AugmentedScan, ObjectRecord
from augkitti.shards import write_shard
from augkitti.splits import Splits, write_splits
from training.config import GridConfig, NetworkConfig, Settings
from training.predictions import Prediction

EGO = pose_from_xyz_yaw(-1.0, 0.0, 0.0, 0.0)  # the world comes a metre nearer
SIZE = (4.0, 2.0, 1.5)


def an_object(x, y, step=1.0, yaw=0.0, turn=0.0, category="Car", origin="labelled", motion=True, size=SIZE):
    """A box at (x, y) that drives `step` metres along its yaw over ground, and turns."""
    box = np.array([x, y, -1.0, *size, yaw])
    pose0 = box_pose(box)
    pose1 = compose(EGO, compose(pose0, pose_from_xyz_yaw(step, 0.0, 0.0, turn)))
    box1 = np.array([*pose1[:3, 3], *size, yaw + turn])
    M = compose(pose1, invert(pose0)) if motion else None
    return ObjectRecord(f"{x} {y}", category, origin, box0=box, box1=box1 if motion else None, motion=M)


def make_pair(
    objects, points=20, background=((10.0, 12.0), (20.0, -12.0)), coverage="full", azimuth=None, name="a/0/0"
):
    """`points` on each object (a number, or one for each), ten on each background place.

    An object's points stand in a grid in its box; the background's lie at its places. All flow is known.
    """
    counts = [points] * len(objects) if np.isscalar(points) else points
    xyz, instance = [], []
    for row, (item, count) in enumerate(zip(objects, counts, strict=True)):
        along = np.linspace(-0.45, 0.45, count) * item.box0[3]
        local = np.stack([along, np.where(np.arange(count) % 2, 0.3, -0.3), np.zeros(count)], axis=1)
        xyz.append(transform_points(box_pose(item.box0), local))
        instance += [row] * count
    for place in background:
        xyz.append(np.stack([np.full(10, place[0]), np.full(10, place[1]), np.linspace(-1.5, 0.0, 10)], axis=1))
        instance += [-1] * 10
    xyz = np.concatenate(xyz).astype(np.float32)
    instance = np.array(instance, np.int16)
    moved = transform_points(EGO, xyz)
    for row, item in enumerate(objects):
        if item.motion is not None:
            moved[instance == row] = transform_points(item.motion, xyz[instance == row])
    n = len(xyz)
    scan = AugmentedScan(
        xyz=xyz,
        reflectance=np.zeros(n, np.float32),
        ring=np.zeros(n, np.uint8),
        tick=np.zeros(n, np.uint16),
        source=np.arange(n, dtype=np.int32),
        instance=instance,
        surface=np.zeros(n, np.uint8),
        removed=np.zeros(0, np.int32),
    )
    return AugmentedPair(
        pair_id=name,
        sequence="a",
        recording="a",
        frame0=0,
        frame1=1,
        time0=0.0,
        time1=0.1,
        scan_kind="raw",
        seed=0,
        ego_motion=EGO,
        ego_source="truth",
        label_coverage=coverage,
        label_azimuth=azimuth,
        scan0=scan,
        scan1=scan,
        flow0=(moved - xyz).astype(np.float32),
        flow_status0=np.zeros(n, np.uint8),
        objects=tuple(objects),
    )


def right(pair, method="direct", **changes):
    """The truth as a prediction."""
    items = [item for item in pair.objects if item.box0 is not None]
    values = {
        "flows": {method: pair.flow0},
        "where": np.ones(len(pair.scan0), bool),
        "ego_motion": pair.ego_motion,
        "boxes": np.array([item.box0 for item in items]).reshape(-1, 7),
        "scores": np.linspace(0.9, 0.6, len(items)),
        "motions": np.array([np.eye(4) if i.motion is None else i.motion for i in items]).reshape(-1, 4, 4),
    }
    return Prediction(pair.pair_id, **{**values, **changes})


def a_data_set(folder, splits=True, recordings=3, pairs=2):
    """A finished data set of such pairs, a recording a split, each pair a little different; their names."""
    entries, names, places = [], [], {"train": [], "validation": [], "test": []}
    for number in range(recordings):
        sequence = f"2011_09_26_drive_{9000 + number}_sync"
        recording = sequence.removesuffix("_sync")
        made = [
            replace(
                make_pair(
                    [an_object(8, -2, step=2.0 + k), an_object(16, 4, category="Van"), an_object(20, -6, step=0.0)],
                    points=60,
                    background=[(x, y) for x in (6.0, 14.0, 25.0) for y in (-12.0, 9.0)],
                    name=f"{sequence}/{k}/0",
                ),
                sequence=sequence,
                recording=recording,
                frame0=k,
                frame1=k + 1,
            )
            for k in range(pairs)
        ]
        path = folder / "data" / f"{sequence}-00000.parquet"
        write_shard(path, made, metadata())
        entries.append(shard_entry(folder, path, sequence, recording, pairs))
        places[list(places)[(number + 2) % 3]].append(entries[-1].path)
        names += [pair.pair_id for pair in made]
    write_whole_index(folder, entries)
    if splits:
        chosen = Splits({name: tuple(paths) for name, paths in places.items()}, (70.0, 10.0, 20.0), 0)
        write_splits(folder, read_index(folder), chosen)
    return names


SETTINGS = Settings(
    grid=GridConfig(x_m=(0.0, 32.0), y_m=(-16.0, 16.0), z_m=(-3.0, 1.0), voxel_m=(1.0, 1.0, 0.5), max_points=5),
    network=NetworkConfig(
        vfe=(8, 8), middle=(4, 4, 4), blocks=((8, 1), (8, 1), (8, 1)), upsampled=4, upsampled_flow=4, rigid=(4, 2),
        ego=(4, 1),
    ),
)  # fmt: skip


def a_run(folder, seed=0, settings=SETTINGS):
    """A run's folder with the checkpoint of a tiny network that learned nothing; the network."""
    import torch

    from training.checkpoint import NAME, Checkpoint, save_checkpoint
    from training.network import PointFlowNet

    torch.manual_seed(seed)
    network = PointFlowNet(settings).eval()
    save_checkpoint(folder / NAME, Checkpoint(settings, network.state_dict(), step=7))
    return network
