"""Ego-motion of every pair under a KITTI root against registration: prints the table of docs/figures.md.

python benchmarks/ego_motion.py ROOT
"""

import sys
import time

import numpy as np

from augkitti import kitti
from augkitti.ego_motion import register
from augkitti.frames import compose, invert, se3_log

print("| sequence | pairs | m/s | known from | rms cm | worst cm | rms deg | worst deg | used | check ms |")
print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
for sequence in kitti.open_root(sys.argv[1]).sequences:
    differences, used, seconds, steps = [], set(), [], []
    for frame0, frame1 in sequence.pairs:
        known = kitti.known_ego_motion(sequence, frame0)
        scan0, scan1 = kitti.read_scan(sequence, frame0), kitti.read_scan(sequence, frame1)
        start = time.perf_counter()
        used.add(kitti.read_ego_motion(sequence, frame0, scan0, scan1).source)
        seconds.append(time.perf_counter() - start)
        if known is not None:
            registered = register(scan0.xyz, scan1.xyz, (known.T_velo1_velo0,))
            T = compose(invert(known.T_velo1_velo0), registered)
            differences.append((100 * np.linalg.norm(T[:3, 3]), np.rad2deg(np.linalg.norm(se3_log(T)[3:]))))
            steps.append(np.linalg.norm(known.T_velo1_velo0[:3, 3]) / (scan1.time_s - scan0.time_s))
    if differences:
        (rms_cm, rms_deg), (max_cm, max_deg) = np.sqrt(np.mean(np.square(differences), 0)), np.max(differences, 0)
        fields = [sequence.name, len(differences), f"{np.mean(steps):.1f}", known.source, f"{rms_cm:.1f}"]
        fields += [f"{max_cm:.1f}", f"{rms_deg:.3f}", f"{max_deg:.3f}", ", ".join(sorted(used))]
        print("|", " | ".join(map(str, [*fields, f"{1000 * np.median(seconds):.0f}"])), "|")
