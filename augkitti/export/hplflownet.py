"""A pair in, `pc1.npy`, `pc2.npy` and `scan2.npy` in a numbered folder out, as HPLFlowNet and its kin read KITTI.

Source of the form: `datasets/kitti.py` of github.com/laoreja/HPLFlowNet. Its axes are x left, y up, z forward; flow is
`pc2 - pc1`, so the ego-motion is in it. Points whose flow is not known are left out of both.
"""

from io import BytesIO

import numpy as np

from augkitti.export.target import Files, Format, Scene
from augkitti.frames import F32
from augkitti.scan_pair import AugmentedPair

FOLDER = "KITTI_processed_occ_final"  # the name that the readers look for
_AXES = [1, 2, 0]  # left, up, forward of forward, left, up


def pair_files(pair: AugmentedPair, scene: Scene) -> Files:
    """The arrays of one pair, float32 metres: known points, the same after their flow, and the second scan as it is."""
    known = pair.flow_status0 == 0
    before = pair.scan0.xyz[known]
    after = (before.astype(np.float64) + pair.flow0[known]).astype(np.float32)
    folder = f"{FOLDER}/{scene.number:06d}"
    arrays = {"pc1": before, "pc2": after, "scan2": pair.scan1.xyz}
    return {f"{folder}/{name}.npy": _npy(xyz) for name, xyz in arrays.items()}


def _npy(xyz: F32) -> bytes:
    content = BytesIO()
    np.save(content, np.ascontiguousarray(xyz[:, _AXES]))
    return content.getvalue()


HPLFLOWNET = Format(
    name="hplflownet",
    reader="HPLFlowNet and networks with its loader of KITTI",
    lost="points whose flow is not known, reflectance, ego-motion, objects and boxes, rolling shutter, rings, "
    "surfaces, source rows and removed points",
    files=pair_files,
)
