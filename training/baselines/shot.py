"""A surface and keypoints in, SHOT out: a local reference frame and 352 numbers for each keypoint.

Signature of Histograms of OrienTations: Tombari, Salti, Di Stefano, "Unique Signatures of Histograms for Local Surface
Description", ECCV 2010. All keypoints are done at once: what lies round them is one long list of (keypoint, point)
pairs, and every sum over a neighbourhood a `bincount` of that list.

Departures: increments of neighbouring bins multiply in all four directions (the paper's words; PCL adds them); a tie
in the signs of the frame's axes goes to the side where points lie further out; and descriptors may be taken in frames
that the caller knows (`upright_frames`), as a scanner that stands upright does.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from augkitti.frames import F32, F64
from augkitti.scan_pair import I64

AZIMUTHS, ELEVATIONS, SHELLS, COSINES = 8, 2, 2, 11  # the paper's section 4.2
LENGTH = AZIMUTHS * ELEVATIONS * SHELLS * COSINES  # 352
FEWEST = 5  # points round a keypoint: with fewer it has no descriptor


@dataclass(frozen=True, eq=False)
class Support:
    """What lies round K keypoints: P pairs, in order of the keypoint."""

    keypoint: I64  # (P,) row of the keypoint
    point: I64  # (P,) row of the surface point
    away: F64  # (P, 3) from the keypoint to the point, metres
    distance: F64  # (P,) its length, above 0 and at most the radius
    count: I64  # (K,) pairs of each keypoint
    radius_m: float


def support_of(points: F64, keypoints: F64, radius_m: float) -> Support:
    """Every surface point (N, 3) within `radius_m` of a keypoint (K, 3), but for one at the keypoint itself."""
    if not len(points) or not len(keypoints):
        nothing = np.zeros(0, dtype=np.int64)
        return Support(nothing, nothing, np.zeros((0, 3)), np.zeros(0), np.zeros(len(keypoints), np.int64), radius_m)
    near = cKDTree(keypoints).sparse_distance_matrix(cKDTree(points), radius_m, output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))
    keypoint, point = near["i"][order].astype(np.int64), near["j"][order].astype(np.int64)
    away = points[point] - keypoints[keypoint]
    distance = np.sqrt(np.einsum("pa,pa->p", away, away))
    kept = distance > 1e-9
    keypoint, point = keypoint[kept], point[kept]
    count = np.bincount(keypoint, minlength=len(keypoints))
    return Support(keypoint, point, away[kept], distance[kept], count, radius_m)


def reference_frames(support: Support) -> F64:
    """The paper's repeatable frames (K, 3, 3), their rows the axes x, y, z; the identity where points are too few.

    Axes are the eigenvectors of the scatter about the keypoint, in which points weigh `R - d` (Eq. 2); x and z point to
    the side where most points are (Eqs. 3 to 6), y is z cross x.
    """
    keypoint, away, total = support.keypoint, support.away, len(support.count)
    weight = support.radius_m - support.distance
    scatter = np.empty((total, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            scatter[:, a, b] = np.bincount(keypoint, weight * away[:, a] * away[:, b], total)
            scatter[:, b, a] = scatter[:, a, b]
    scatter /= np.maximum(np.bincount(keypoint, weight, total), 1e-12)[:, None, None]
    axes = np.linalg.eigh(scatter)[1]  # columns, the smallest spread first
    x, z = (_towards_most(axes[:, :, k], support) for k in (2, 0))
    frames = np.stack([x, np.cross(z, x), z], axis=1)
    frames[support.count < FEWEST] = np.eye(3)
    return frames


def upright_frames(keypoints: F64) -> F64:
    """Frames (K, 3, 3) that need no surface: z up, x level and away from the scanner at the origin."""
    level = np.hypot(keypoints[:, 0], keypoints[:, 1])
    c = np.where(level > 0.0, keypoints[:, 0] / np.maximum(level, 1e-12), 1.0)
    s = np.where(level > 0.0, keypoints[:, 1] / np.maximum(level, 1e-12), 0.0)
    frames = np.zeros((len(keypoints), 3, 3))
    frames[:, 0, 0], frames[:, 0, 1], frames[:, 1, 0], frames[:, 1, 1], frames[:, 2, 2] = c, s, -s, c, 1.0
    return frames


def describe(support: Support, normals: F64, frames: F64) -> F32:
    """Descriptors (K, 352) of length 1; all 0 where fewer than five points lie round a keypoint.

    A histogram of the cosine between a point's normal and the frame's z axis, for each of 8 x 2 x 2 parts of the
    sphere (azimuth, elevation, distance). Every point is shared out linearly between the two nearest bins in all four
    directions (section 4.3), so that one that crosses a border changes nothing at once.

    Args:
        support: what lies round the keypoints.
        normals: (N, 3) unit normals of the surface, all to the same side of it, as the scanner's.
        frames: (K, 3, 3), rows the axes.
    """
    total, keypoint = len(support.count), support.keypoint
    rows = np.repeat(frames.reshape(total, 9), support.count, axis=0).reshape(-1, 3, 3)
    x, y, z = np.einsum("pab,pb->ap", rows, support.away)
    cosine = np.einsum("pb,pb->p", rows[:, 2], normals[support.point])
    low_a, part_a = _between((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * AZIMUTHS - 0.5, None)
    inclination = np.arccos(np.clip(z / support.distance, -1.0, 1.0))
    low_e, part_e = _between(inclination / np.pi * ELEVATIONS - 0.5, ELEVATIONS)
    low_s, part_s = _between(support.distance / support.radius_m * SHELLS - 0.5, SHELLS)
    low_c, part_c = _between((cosine + 1.0) * (0.5 * COSINES) - 0.5, COSINES)

    out = np.zeros(total * LENGTH)
    for up_a in (0, 1):
        at_a = keypoint * AZIMUTHS + (low_a + up_a) % AZIMUTHS
        share_a = part_a if up_a else 1.0 - part_a
        for up_e in (0, 1):
            at_e = at_a * ELEVATIONS + low_e + up_e
            share_e = share_a * (part_e if up_e else 1.0 - part_e)
            for up_s in (0, 1):
                at_s = (at_e * SHELLS + low_s + up_s) * COSINES + low_c
                share_s = share_e * (part_s if up_s else 1.0 - part_s)
                upper = share_s * part_c
                out += np.bincount(at_s, share_s - upper, len(out))
                out += np.bincount(at_s + 1, upper, len(out))
    histograms = out.reshape(total, LENGTH)
    histograms[support.count < FEWEST] = 0.0
    length = np.sqrt(np.einsum("kl,kl->k", histograms, histograms))
    return np.asarray((histograms / np.maximum(length, 1e-12)[:, None]).astype(np.float32))


def shot(points: F64, normals: F64, keypoints: F64, radius_m: float) -> tuple[F64, F32]:
    """Frames (K, 3, 3) and descriptors (K, 352) of keypoints (K, 3) on a surface (N, 3) with unit normals (N, 3)."""
    support = support_of(points, keypoints, radius_m)
    frames = reference_frames(support)
    return frames, describe(support, normals, frames)


def _towards_most(axis: F64, support: Support) -> F64:
    """Axes (K, 3), each turned to the side of its keypoint where most points are."""
    along = np.einsum("pa,pa->p", support.away, np.repeat(axis, support.count, axis=0))
    side = np.bincount(support.keypoint, np.sign(along), len(axis))
    tie = np.abs(side) < 0.5
    side[tie] = np.bincount(support.keypoint, along, len(axis))[tie]
    return axis * np.where(side < 0.0, -1.0, 1.0)[:, None]


def _between(place: F64, bins: int | None) -> tuple[I64, F64]:
    """The lower of the two bins whose centres (0, 1, ...) a place lies between, and the share of the upper one.

    Beyond the first or last centre all goes to the bin there; without `bins` they are a circle.
    """
    if bins is not None:
        place = np.clip(place, 0.0, bins - 1.0)
    low = np.floor(place) if bins is None else np.minimum(np.floor(place), bins - 2.0)
    return low.astype(np.int64), place - low
