"""Windows: a pair and its cars' models in, the points that were seen through a pane and where the pane stands out."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from augkitti.frames import F64, Array, invert, rotate_vectors, se3_exp, se3_log, transform_points
from augkitti.raycast import cast_mesh, cross_box
from augkitti.scan_pair import GLASS, I16, I32, NO_TICK, U8, AugmentedPair, AugmentedScan, CarModel, ObjectRecord
from augkitti.scanner import ScannerProfile, tick_time

_BEFORE_M = 0.05  # a return nearer to the pane than this is the pane's own
_BEHIND_M = 0.2  # range noise and the seats' depth: a point this far behind a solid surface still lies on it
_GROW_M = 0.7  # round the box at its moment: what a fast car moves while the beam passes along it


@dataclass(frozen=True, eq=False)
class ThroughPanes:
    """Points of one scan whose pulse went through a virtual car's pane."""

    point: I32  # (T,) rows of the scan, ascending
    car: I16  # (T,) row in `objects` of the car whose pane it was
    pane: F64  # (T, 3) where the pulse met the pane first, metres, velo


def beam_origins(xyz: Array, ring: U8, profile: ScannerProfile) -> F64:
    """Where (N, 3) metres, velo, the beam of each point (N, 3) starts: beside and above the frame's origin."""
    beam = np.minimum(ring, profile.beams - 1)
    side = profile.side_m[beam]
    rho = np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), 1e-6)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) - np.arcsin(np.clip(side / rho, -1.0, 1.0))
    return np.stack([-side * np.sin(azimuth), side * np.cos(azimuth), profile.height_m[beam]], axis=1)


def through_panes(pair: AugmentedPair, k: int, models: Mapping[str, CarModel], profile: ScannerProfile) -> ThroughPanes:
    """Points of scan `k` that were seen through panes of virtual cars whose model is at hand.

    The pulse of a point is cast at the car as it stood when the pulse was fired; a point counts where glass comes first
    and nothing solid stands between.
    """
    scan = (pair.scan0, pair.scan1)[k]
    xyz = scan.xyz.astype(np.float64)
    origin = beam_origins(xyz, scan.ring, profile)
    way = xyz - origin
    distance = np.maximum(np.sqrt((way * way).sum(axis=1)), 1e-6)
    direction = way / distance[:, None]
    found: list[tuple[Array, Array, Array]] = []
    for row, item in enumerate(pair.objects):
        model = models.get(item.model or "")
        pose = (item.pose0, item.pose1)[k]
        if item.origin != "virtual" or model is None or pose is None:
            continue
        T_car_velo = invert(pose)
        half = np.asarray(model.size_m) / 2.0 + _GROW_M
        enter, leave = cross_box(
            transform_points(T_car_velo, origin), rotate_vectors(T_car_velo, direction), -half, half
        )
        near = np.flatnonzero((leave >= np.maximum(enter, 0.0)) & (enter < distance)).astype(np.int32)
        near = near[~((scan.instance[near] == row) & (scan.surface[near] == GLASS))]
        T = _poses_inverse(pair, k, item, scan, near, profile)
        hits = cast_mesh(model, near, transform_points(T, origin[near]), rotate_vectors(T, direction[near]), False)
        if len(hits.ray) == 0:
            continue
        solid = np.where((hits.face >= 0) & (hits.surface != GLASS), hits.range_m, np.inf).min(axis=1)
        reach = distance[hits.ray]
        seen = (hits.surface[:, 0] == GLASS) & (hits.range_m[:, 0] < reach - _BEFORE_M) & (solid > reach - _BEHIND_M)
        point, pane_m = hits.ray[seen], hits.range_m[seen, 0]
        found.append((point, np.full(len(point), row), origin[point] + pane_m[:, None] * direction[point]))
    if not found:
        return ThroughPanes(np.zeros(0, np.int32), np.zeros(0, np.int16), np.zeros((0, 3)))
    point, car, pane = (np.concatenate(part) for part in zip(*found, strict=True))
    # through two cars' panes: the nearer pane is where opaque glass would have stopped the pulse
    order = np.lexsort(((pane * pane).sum(axis=1), point))
    first = order[np.concatenate([[True], np.diff(point[order]) > 0])] if len(order) else order
    return ThroughPanes(point[first].astype(np.int32), car[first].astype(np.int16), pane[first])


def _poses_inverse(
    pair: AugmentedPair, k: int, item: ObjectRecord, scan: AugmentedScan, points: I32, profile: ScannerProfile
) -> F64:
    """`T_car_velo` when the pulse of each point was fired: (4, 4), or (K, 4, 4) on raw scans."""
    pose, moment = ((item.pose0, item.moment0), (item.pose1, item.moment1))[k]
    assert pose is not None
    interval = pair.time1 + item.moment1 - pair.time0 - item.moment0
    if pair.scan_kind != "raw" or item.motion is None or interval <= 0.0 or len(points) == 0:
        return invert(pose)
    tick = scan.tick[points]
    late = np.where(tick == NO_TICK, 0.0, tick_time(profile, tick, pair.time1 - pair.time0) - moment)
    # pose(t) = exp(t w) pose, so its inverse is inverse(pose) exp(-t w)
    return np.asarray(invert(pose) @ se3_exp(se3_log(item.motion) / interval, -late))
