"""Scene flow: scan 0 with its instances and the motions of all objects in, the displacement of every point out."""

from collections.abc import Sequence

import numpy as np

from augkitti.frames import F32, F64
from augkitti.scan_pair import U8, AugmentedScan, Bool, ObjectRecord

FLOW_STEP_M = 1.0 / 65536.0  # 15 micrometres: points are rounded to a millimetre, and it stores in 0.6 of the bytes
_BLOCK = 8192  # points at a time: they stay in the processor's cache


def scene_flow(
    scan0: AugmentedScan, ego_motion: F64, objects: Sequence[ObjectRecord], unknown0: Bool
) -> tuple[F32, U8]:
    """Flow (N0, 3) metres from velo0 to velo1, ego-motion included, and its status (N0,): 0 known, 1 not known.

    `flow = M p - p` with M the motion of the point's object, or the ego-motion for the static world; where the flow is
    not known (`unknown0`, objects seen once), it is that of the static world (contract, column `flow0`).
    """
    unknown = unknown0.copy()
    flow = _displacement(ego_motion, scan0.xyz)
    of_objects = np.flatnonzero(scan0.instance >= 0)
    for row, item in enumerate(objects):
        mine = of_objects[scan0.instance[of_objects] == row]
        if item.motion is None:
            unknown[mine] = True
        mine = mine[~unknown[mine]]
        if item.motion is not None and len(mine):
            flow[mine] = _displacement(item.motion, scan0.xyz[mine])
    return flow, unknown.view(np.uint8)


def _displacement(motion: F64, xyz: F32) -> F32:
    """`M p - p` as `(R - I) p + t`, where no large numbers cancel, so float32 does; on steps of `FLOW_STEP_M`."""
    D, t = (motion[:3, :3] - np.eye(3)).astype(np.float32), motion[:3, 3].astype(np.float32)
    flow = np.empty_like(xyz)
    for start in range(0, len(xyz), _BLOCK):
        x, y, z = np.ascontiguousarray(xyz[start : start + _BLOCK].T)
        for axis in range(3):
            along = D[axis, 0] * x + D[axis, 1] * y + D[axis, 2] * z + t[axis]
            flow[start : start + _BLOCK, axis] = np.rint(along * np.float32(1.0 / FLOW_STEP_M))
    flow *= np.float32(FLOW_STEP_M)
    return flow
