"""A pair in, the HDF5 file of a scene as KTH's OpenSceneFlow reads it out; `index_total.pkl`, `index_flow.pkl`.

Source of the form: `dataprocess/extract_av2.py` and `src/dataset.py` of github.com/KTH-RPL/OpenSceneFlow. A file is a
scene, a group (named by nanoseconds) a sweep; flow is in the first sweep and, as in shards, has the ego-motion in it.
"""

import pickle
from collections.abc import Sequence
from io import BytesIO

import numpy as np

from augkitti.export.av2 import category_index
from augkitti.export.target import (
    Done,
    Files,
    Format,
    Scene,
    firing_times,
    ground_of,
    nanoseconds,
    of_objects,
    period_of,
    scene_name,
)
from augkitti.frames import invert
from augkitti.scan_pair import AugmentedPair


def scene_files(pair: AugmentedPair, scene: Scene) -> Files:
    """The HDF5 file of one pair.

    Each group has `lidar` (N, 4: xyz, reflectance), `pose` (4, 4; that of the first sweep is the identity),
    `ground_mask`, `lidar_id` (1), `lidar_dt` (seconds from the start of the revolution); the first has `flow`,
    `flow_is_valid`, `flow_category_indices` (Argoverse 2's, 0 none), `flow_instance_id` (row in `objects` + 1, 0 none)
    and `ego_motion` besides.
    """
    import h5py

    content = BytesIO()
    poses = np.eye(4), invert(pair.ego_motion)
    with h5py.File(content, "w") as file:
        for k, (stamp, scan) in enumerate(zip(nanoseconds(pair), (pair.scan0, pair.scan1), strict=True)):
            group = file.create_group(str(stamp))
            after = firing_times(pair, scan, scene.profile)
            if pair.scan_kind == "raw":
                after += 0.5 * period_of(pair)
            group["lidar"] = np.column_stack([scan.xyz, scan.reflectance])
            group["ground_mask"] = ground_of(scan, scene)[0]
            group["pose"] = poses[k].astype(np.float32)
            group["lidar_id"] = np.ones(len(scan), np.uint8)
            group["lidar_dt"] = after.astype(np.float32)
            if k == 0:
                classes = [category_index(item.category) + 1 for item in pair.objects]
                group["flow"] = pair.flow0
                group["flow_is_valid"] = pair.flow_status0 == 0
                group["flow_category_indices"] = of_objects(scan, classes, 0).astype(np.uint8)
                group["flow_instance_id"] = (scan.instance + 1).astype(np.int16)
                group["ego_motion"] = pair.ego_motion.astype(np.float32)
    return {f"{scene_name(pair)}.h5": content.getvalue()}


def index_files(done: Sequence[Done]) -> Files:
    """Both index files: lists of [scene, nanoseconds], lists too, as the reader compares them."""
    sweeps = [[[scene.scene, str(stamp)] for stamp in scene.nanoseconds] for scene in done]
    return {
        "index_total.pkl": pickle.dumps([sweep for both in sweeps for sweep in both]),
        "index_flow.pkl": pickle.dumps([first for first, _ in sweeps]),
    }


OPENSCENEFLOW = Format(
    name="opensceneflow",
    reader="OpenSceneFlow of KTH, with two frames a sample (num_frames=2)",
    lost="rings and ticks (lidar_dt has the moments of firing), surfaces, source rows and removed points, boxes, poses "
    "and speeds of objects; ego-motion is kept as float32",
    files=scene_files,
    closing=index_files,
    module="h5py",
)
