"""Scene flow: scan 0 with its instances and the motions of all objects in, the displacement of every point out."""

from collections.abc import Sequence

import numpy as np

from augkitti.frames import F32, F64, transform_points
from augkitti.scan_pair import U8, AugmentedScan, Bool, ObjectRecord


def scene_flow(
    scan0: AugmentedScan, ego_motion: F64, objects: Sequence[ObjectRecord], unknown0: Bool
) -> tuple[F32, U8]:
    """Flow (N0, 3) metres from velo0 to velo1, ego-motion included, and its status (N0,): 0 known, 1 not known.

    `flow = M p - p` with M the motion of the point's object, or the ego-motion for the static world; where the flow is
    not known (`unknown0`, objects seen once), it is that of the static world (contract, column `flow0`).
    """
    unknown = unknown0.copy()
    xyz = scan0.xyz.astype(np.float64)
    moved = transform_points(ego_motion, xyz)
    of_objects = np.flatnonzero(scan0.instance >= 0)
    for row, item in enumerate(objects):
        mine = of_objects[scan0.instance[of_objects] == row]
        if item.motion is None:
            unknown[mine] = True
        mine = mine[~unknown[mine]]
        if item.motion is not None and len(mine):
            moved[mine] = transform_points(item.motion, xyz[mine])
    return (moved - xyz).astype(np.float32), unknown.astype(np.uint8)
