"""Predicted and true arrays in, errors out: flow, rigid motions, matching, average precision, speed buckets.

Metres, radians; flow and motions are over one pair of scans. numpy alone, so that any program's figures can be checked.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from augkitti.frames import F64, Array, transform_points
from training.rigid_motion import motion_of

Bool = npt.NDArray[np.bool_]
I64 = npt.NDArray[np.int64]

RECALLS = 40  # positions at which KITTI's benchmark reads precision
DYNAMIC_M = 0.05  # a pair: from there on a point counts as moving (Argoverse 2: 0.5 m/s at 10 Hz)
BUCKET_EDGES_M = np.concatenate([np.linspace(0.0, 2.0, 51), [np.inf]])  # a pair: bucketed-scene-flow-eval's


def end_point_error(flow: Array, truth: Array) -> F64:
    """Distance (N,) between the ends of flow vectors (N, 3) and (N, 3)."""
    return np.asarray(np.linalg.norm(np.asarray(flow, np.float64) - np.asarray(truth, np.float64), axis=-1))


def accuracy(error: F64, length: F64) -> tuple[Bool, Bool, Bool]:
    """AccS, AccR and Outliers of each point, each (N,), as FlowNet3D and HPLFlowNet count them.

    Args:
        error: (N,) end-point errors.
        length: (N,) of the true flow, ego-motion included.

    Returns:
        Error below 0.05 m or 5 % of the length; below 0.1 m or 10 %; above 0.3 m or 10 %.
    """
    relative = error / (length + 1e-4)
    return (error < 0.05) | (relative < 0.05), (error < 0.1) | (relative < 0.1), (error > 0.3) | (relative > 0.1)


def spread(error_vectors: Array, group: I64, groups: int) -> F64:
    """How far errors (N, 3) scatter about their mean within each group (N,), (groups,): root mean square, metres.

    A flow that is wrong by the same vector all over an object has none: spread is roughness, not error. NaN where a
    group has no point.
    """
    errors = np.asarray(error_vectors, np.float64)
    count = np.bincount(group, minlength=groups)
    with np.errstate(invalid="ignore"):
        mean = np.stack([np.bincount(group, errors[:, k], minlength=groups) for k in range(3)], axis=1) / count[:, None]
        squares = np.bincount(group, ((errors - mean[group]) ** 2).sum(axis=1), minlength=groups) / count
    return np.asarray(np.sqrt(squares))


def rotation_error(motion: Array, truth: Array) -> F64:
    """Angle (...,) between the rotations of rigid motions (..., 4, 4), radians; exact for small angles too."""
    apart = np.asarray(motion, np.float64)[..., :3, :3] - np.asarray(truth, np.float64)[..., :3, :3]
    chord = np.sqrt((apart**2).sum(axis=(-2, -1)) / 8.0)  # the sine of half the angle
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def yaw_error(motion: Array, truth: Array) -> F64:
    """Difference (...,) of the turns about z alone of rigid motions (..., 4, 4), radians, 0 to pi."""
    return np.abs(wrapped(motion_of(np.asarray(motion))[..., 2] - motion_of(np.asarray(truth))[..., 2]))


def translation_error(motion: Array, truth: Array, centre: Array | None = None) -> F64:
    """Distance (...,) between where two rigid motions (..., 4, 4) carry a point; metres.

    Args:
        motion: predicted.
        truth: true.
        centre: (..., 3) the point, a box's centre; without it the LiDAR's origin, so a wrong rotation of a far object
            counts times its distance (only this fits the paper's object translation errors).
    """
    if centre is None:
        return np.asarray(np.linalg.norm(np.asarray(motion)[..., :3, 3] - np.asarray(truth)[..., :3, 3], axis=-1))
    return np.asarray(np.linalg.norm(transform_points(motion, centre) - transform_points(truth, centre), axis=-1))


def wrapped(angle: Array) -> F64:
    """Angles brought to -pi to pi."""
    return np.asarray((np.asarray(angle, np.float64) + np.pi) % (2.0 * np.pi) - np.pi)


def match_one_to_one(overlap: F64, scores: Array, least: float) -> I64:
    """Which truth each detection finds: the surest first, each takes the free truth that it overlaps most.

    Args:
        overlap: (n, m) of n detections with m truths.
        scores: (n,) of the detections; of equal ones the first comes first.
        least: overlap that a match needs.

    Returns:
        (n,) index of the truth, -1 for none; no truth twice.
    """
    found = np.full(len(overlap), -1, dtype=np.int64)
    left = np.array(overlap, dtype=np.float64)
    for row in np.argsort(-np.asarray(scores), kind="stable") if left.shape[1] else ():
        best = int(left[row].argmax())
        if left[row, best] >= least:
            found[row] = best
            left[:, best] = -1.0
    return found


def average_precision(scores: Array, is_true: Array, truths: int) -> float | None:
    """Mean over 40 recalls (1/40 to 1) of the best precision at that recall or above, as KITTI's benchmark has it.

    Args:
        scores: (n,) of all judged detections of a data set.
        is_true: (n,) whether each found a truth of its own.
        truths: number of truths to be found; None comes back where there are none.
    """
    if truths <= 0:
        return None
    order = np.argsort(-np.asarray(scores, np.float64), kind="stable")
    ordered, hits = np.asarray(scores, np.float64)[order], np.cumsum(np.asarray(is_true, np.float64)[order])
    last_of_equals = np.append(ordered[1:] != ordered[:-1], True)[: len(ordered)]
    recall = (hits / truths)[last_of_equals]
    precision = (hits / np.arange(1, len(hits) + 1))[last_of_equals]
    best = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, np.arange(1, RECALLS + 1) / RECALLS - 1e-12)
    return float(np.append(best, 0.0)[at].mean())


@dataclass
class Buckets:
    """Counts, errors and speeds of points by class and by bucket of their own speed; added up pair by pair.

    Speeds are of a point's motion over ground: its flow less what the ego-motion alone would give.
    """

    count: F64  # (classes, buckets)
    error: F64  # sum of end-point errors
    speed: F64  # sum of speeds
    edges_m: F64  # (buckets + 1,)

    @classmethod
    def empty(cls, classes: int, edges_m: F64 = BUCKET_EDGES_M) -> "Buckets":
        """Without points."""
        shape = (classes, len(edges_m) - 1)
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), edges_m)

    def add(self, kind: I64, error: F64, speed: F64) -> None:
        """Points of class `kind` (N,) with their errors (N,) and speeds (N,), metres a pair."""
        classes, buckets = self.count.shape
        cell = kind * buckets + np.searchsorted(self.edges_m, speed, side="right") - 1
        for sums, weights in ((self.count, None), (self.error, error), (self.speed, speed)):
            sums += np.bincount(cell, weights, minlength=classes * buckets).reshape(classes, buckets)

    def mean_error(self) -> F64:
        """(classes, buckets) mean end-point errors; NaN where no point fell."""
        return self._per_point(self.error)

    def static_and_dynamic(self) -> F64:
        """(classes, 2): mean error of the first bucket, metres; mean over the others of error by speed, no unit.

        The second is bucketed scene flow's "dynamic error": 1 for whoever takes moving things as standing.
        """
        error, speed = self.mean_error(), self._per_point(self.speed)
        share = error[:, 1:] / np.where(speed[:, 1:] > 0, speed[:, 1:], np.nan)
        filled = np.isfinite(share)
        with np.errstate(invalid="ignore"):
            dynamic = np.where(filled, share, 0.0).sum(axis=1) / np.where(
                filled.any(axis=1), filled.sum(axis=1), np.nan
            )
        return np.stack([error[:, 0], dynamic], axis=1)

    def _per_point(self, sums: F64) -> F64:
        return np.divide(sums, self.count, out=np.full_like(sums, np.nan), where=self.count > 0)
