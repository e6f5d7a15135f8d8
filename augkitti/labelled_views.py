"""Labelled vehicles: a KITTI root in, each uncovered car or van as one scan's rays meet its label box out.

Figures of a vehicle follow scanner.md section 3: what became of the rays through its windows, which share of the rays
at its body returned, and how misses stand together. They are taken of any rays, measured ranges and box, so that
simulated returns are judged by the same code as real ones.

A ray's measured range counts from its own origin; lines are those of the profile's beam table. Only fired rays of raw
scans outside the ego car's shadow are taken.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from augkitti import kitti
from augkitti import same_math as sm
from augkitti.frames import F32, F64, box_pose, invert, points_in_box, rotate_vectors, transform_points, wrap_angle
from augkitti.raycast import cross_box, rays_near
from augkitti.scan_pair import I32, NO_TICK, Bool, LabelledBox, Scan, ScanRays
from augkitti.scanner import ScannerProfile, assign_rays, lines_of_rays

Index = npt.NDArray[np.intp]

CATEGORIES = ("Car", "Van")
CLASSES = ("none", "surface", "inside", "beyond")  # of window rays, as scanner.md counts them
NONE, SURFACE, INSIDE, BEYOND = range(4)
LAGS = ("next firing", "four firings on", "next beam")  # of clumps

GROW_M = 0.25  # rays are taken this far round the label box
CROP_M = 0.10  # labels are loose by centimetres, and beams are biased by as much: points are the car's up to here
TRIM_M = 0.15  # scanner.md: lower points in a box are ground
MOST_COVERED = 0.03  # scanner.md: of the body and window rays, stopped before the box
NEAREST_M, FARTHEST_M = 4.0, 45.0  # scanner.md section 3
MIN_POINTS = 80

# Shares of length and width about the middle, and of the height above the floor (scanner.md section 3).
_WINDOW = ((-0.30, 0.20), (-0.40, 0.40), (0.68, 0.90))
_BODY = ((-0.45, 0.45), (-0.44, 0.44), (0.25, 0.50))
_WHOLE = ((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0))
_CROSSED_M = 0.25  # a ray belongs to a zone that it crosses for longer
_BEFORE_M = 0.25  # a return this far before the box is of something else
_PAST_M = 0.10  # up to here past the box a return is the car's
_FACE_M = 0.20  # a return before this depth in the cabin is of its face
_SAME_BEAM_RAD = np.pi / 2150.0  # half a firing: the ray of the next beam at the same azimuth
_MANY = 1 << 16  # more firings than a revolution has
_ONE_CAR_M = 1.0  # two labels of one moment with centres this close are of one car


@dataclass(frozen=True, eq=False)
class RayedScan:
    """A scan with the ray of each point, and no more."""

    scan: Scan
    rays: ScanRays


@dataclass(frozen=True, eq=False)
class VehicleView:
    """One labelled vehicle as one scan saw it; K rays."""

    sequence: str
    frame: int
    track: str  # the physical drive and the car in it: two labels of one car are one track
    category: str
    box: F64  # (7,) x, y, z (centre), length, width, height, yaw; metres, radians, velo
    scan: RayedScan
    ray: I32  # (K,) ascending: fired rays, outside the shadow, whose lines cross the box grown by 0.25 m
    measured_m: F64  # (K,) range along the ray; inf where nothing returned
    reflectance: F32  # (K,) nan where nothing returned
    enter_m: F64  # (K,) where the ray's line enters the label box; after `leave_m` where it misses it
    leave_m: F64  # (K,)
    covered_share: float  # of the body and window rays, stopped more than 0.25 m before the box

    @property
    def distance_m(self) -> float:
        """Of the box's centre from the scanner, in the ground plane."""
        return float(sm.hypot(self.box[0], self.box[1]))


@dataclass(frozen=True, eq=False)
class BoxRays:
    """What rays and their measured ranges are to a vehicle's box; K rays."""

    ring: I32  # (K,)
    azimuth_rad: F64  # (K,)
    firing: I32  # (K,) number of the ray's firing within the revolution: neighbours are 1 apart
    enter_m: F64  # (K,) where the line enters the box; after `leave_m` where it misses it
    leave_m: F64  # (K,)
    cabin_m: F64  # (K,) where it enters the inner cabin
    crosses_window: Bool  # (K,) goes through the inner cabin for more than 0.25 m
    is_body: Bool  # (K,) goes through the body's middle for more than 0.25 m
    measured_m: F64  # (K,) inf where nothing returned
    is_window: Bool  # (K,) a window ray that nothing before the box stopped
    window_class: I32  # (K,) NONE, SURFACE, INSIDE or BEYOND; -1 for other rays
    returns: Bool  # (K,) a return up to 0.1 m past the box
    is_covered: Bool  # (K,) stopped more than 0.25 m before the box

    @property
    def depth_m(self) -> F64:
        """Depth (K,) of the return behind the inner cabin's face."""
        return self.measured_m - self.cabin_m


def vehicle_views(
    root: kitti.KittiRoot,
    profile: ScannerProfile,
    sequences: Iterable[str] | None = None,
    min_points: int = MIN_POINTS,
    most_covered: float = MOST_COVERED,
    range_m: tuple[float, float] = (NEAREST_M, FARTHEST_M),
) -> Iterator[VehicleView]:
    """Every labelled car and van of the raw and object scans, by sequence, frame and label.

    Args:
        sequences: names of sequences to look into; None for all.
        min_points: of the car (`car_points`).
        most_covered: share of body and window rays that stop before the box; scanner.md keeps less than 0.03.
        range_m: of the box's centre, from and to.

    A scan that lies under two names of one drive is taken once. Compensated scans have no rays, and are left out.

    Raises:
        InputError: a scan or a label file is malformed.
    """
    chosen = [s for s in root.sequences if s.kind == "raw" and (sequences is None or s.name in set(sequences))]
    track_of = _tracks(chosen)
    seen: set[tuple[str, int]] = set()
    for sequence in chosen:
        for frame in sequence.frames:
            labels = [
                label
                for label in kitti.read_labels(sequence, frame)
                if label.category in CATEGORIES and (sequence.recording, frame) not in seen
                if range_m[0] <= float(sm.hypot(label.box[0], label.box[1])) <= range_m[1]
            ]
            if not labels:
                continue
            seen.add((sequence.recording, frame))
            scan = kitti.read_scan(sequence, frame, profile.elevation_rad)
            rayed = RayedScan(scan, assign_rays(scan, profile))
            for label in labels:
                track = track_of[sequence.recording, label.id]
                view = view_of(rayed, label, profile, sequence.name, frame, track)
                if view is None or view.covered_share >= most_covered or len(car_points(view, profile)) < min_points:
                    continue
                yield view


def view_of(
    rayed: RayedScan, label: LabelledBox, profile: ScannerProfile, sequence: str, frame: int, track: str
) -> VehicleView | None:
    """One label's view, whatever covers it; None where no ray crosses its box."""
    ray = rays_at(rayed.rays, label.box, profile, GROW_M)
    if not len(ray):
        return None
    measured, reflectance = measured_along(rayed, ray, profile)
    box_rays = judge_rays(rayed.rays, ray, measured, label.box, profile)
    zone = box_rays.is_body | box_rays.crosses_window
    covered = float(box_rays.is_covered[zone].mean()) if zone.any() else 1.0
    return VehicleView(
        sequence,
        frame,
        track,
        label.category,
        label.box,
        rayed,
        ray,
        measured,
        reflectance,
        box_rays.enter_m,
        box_rays.leave_m,
        covered,
    )


def rays_at(rays: ScanRays, box: F64, profile: ScannerProfile, grow_m: float) -> I32:
    """Indices (K,) of the fired rays outside the shadow whose lines cross a box (7,) grown all round."""
    near = rays_near(rays, box_pose(box), box[3:6], grow_m)
    near = near[(rays.ray_tick[near] != NO_TICK) & ~rays.ray_blind[near]]
    enter, leave = crossed(rays, near, box, profile, grow_m)
    return np.asarray(near[(leave >= enter) & (enter > 0.0)], dtype=np.int32)


def crossed(rays: ScanRays, ray: I32, box: F64, profile: ScannerProfile, grow_m: float = 0.0) -> tuple[F64, F64]:
    """Where (K,) metres the lines of rays enter and leave a box (7,) grown all round; entry after exit: a miss."""
    origin, direction = _in_box(rays, ray, box, profile)
    return _zone(origin, direction, box, _WHOLE, grow_m)


def measured_along(rayed: RayedScan, ray: I32, profile: ScannerProfile) -> tuple[F64, F32]:
    """Range (K,) metres and reflectance (K,) of what rays measured; inf and nan where nothing returned."""
    point = rayed.rays.ray_point[ray]
    origin, direction = lines_of_rays(profile, rayed.rays, ray)
    along = ((rayed.scan.xyz[point].astype(np.float64) - origin) * direction).sum(axis=1)
    reflectance = np.where(point >= 0, rayed.scan.reflectance[point], np.nan).astype(np.float32)
    return np.where(point >= 0, along, np.inf), reflectance


def car_points(view: VehicleView, profile: ScannerProfile, measured_m: F64 | None = None) -> F64:
    """Points (N, 3), velo, of the vehicle among its view's returns, or among other ranges along the same rays.

    Cropped to the label box grown by 0.1 m, less the 0.15 m above its floor; coordinates in the scanner's steps.
    """
    measured = view.measured_m if measured_m is None else measured_m
    ray, rays = view.ray[np.isfinite(measured)], view.scan.rays
    origin, direction = lines_of_rays(profile, rays, ray)
    step = profile.coordinate_quantum_m
    points = np.rint((origin + measured[np.isfinite(measured), None] * direction) / step) * step
    return points[in_crop(points, view.box)]


def in_crop(points: F64, box: F64) -> Bool:
    """Which points (N, 3) are a vehicle's: in its box grown by 0.1 m, more than 0.15 m above the box's floor."""
    above = points[:, 2] > box[2] - 0.5 * box[5] + TRIM_M
    return np.asarray(points_in_box(points, box_pose(box), box[3:6], CROP_M) & above)


def judge_rays(rays: ScanRays, ray: I32, measured_m: F64, box: F64, profile: ScannerProfile) -> BoxRays:
    """Window and body rays of a box (7,) among rays (K,) with their measured ranges (K,), inf for nothing."""
    origin, direction = _in_box(rays, ray, box, profile)
    enter, leave = _zone(origin, direction, box, _WHOLE)
    window_in, window_out = _zone(origin, direction, box, _WINDOW)
    body_in, body_out = _zone(origin, direction, box, _BODY)
    nothing = np.zeros(len(ray), dtype=bool)
    unjudged = BoxRays(
        ring=rays.ray_ring[ray].astype(np.int32),
        azimuth_rad=rays.ray_azimuth_rad[ray],
        firing=(ray - rays.ring_start[rays.ray_ring[ray]]).astype(np.int32),
        enter_m=enter,
        leave_m=leave,
        cabin_m=window_in,
        crosses_window=window_out - window_in > _CROSSED_M,
        is_body=body_out - body_in > _CROSSED_M,
        measured_m=measured_m,
        is_window=nothing,
        window_class=np.zeros(len(ray), dtype=np.int32),
        returns=nothing,
        is_covered=nothing,
    )
    return rejudged(unjudged, measured_m)


def rejudged(box_rays: BoxRays, measured_m: F64) -> BoxRays:
    """The same rays and box with other measured ranges (K,), inf for nothing."""
    covered = measured_m < box_rays.enter_m - _BEFORE_M
    is_window = box_rays.crosses_window & ~covered
    kind = np.where(measured_m > box_rays.leave_m + _PAST_M, BEYOND, INSIDE)
    kind = np.where(measured_m < box_rays.cabin_m + _FACE_M, SURFACE, kind)
    kind = np.where(np.isfinite(measured_m), kind, NONE)
    return replace(
        box_rays,
        measured_m=measured_m,
        is_window=is_window,
        window_class=np.where(is_window, kind, -1).astype(np.int32),
        returns=measured_m <= box_rays.leave_m + _PAST_M,
        is_covered=covered,
    )


def view_rays(view: VehicleView, profile: ScannerProfile, measured_m: F64 | None = None) -> BoxRays:
    """`judge_rays` of a view, or of other ranges along its rays."""
    measured = view.measured_m if measured_m is None else measured_m
    return judge_rays(view.scan.rays, view.ray, measured, view.box, profile)


def window_shares(box_rays: BoxRays) -> F64:
    """Shares (4,) of a vehicle's window rays: nothing, surface, inside, beyond; nan without window rays."""
    kind = box_rays.window_class[box_rays.is_window]
    return np.bincount(kind, minlength=4) / len(kind) if len(kind) else np.full(4, np.nan)


def body_return_rate(box_rays: BoxRays) -> float:
    """Share of a vehicle's body rays with a return up to 0.1 m past its box; nan without body rays."""
    return float(box_rays.returns[box_rays.is_body].mean()) if box_rays.is_body.any() else float("nan")


def clump_sums(box_rays: BoxRays, chosen: Bool | None = None) -> F64:
    """How alike neighbouring rays of one view are in "returned": (3, 2) for `LAGS`, to add up over views.

    The first column sums the products of both rays' deviation from the view's own return rate, the second what that
    sum is for rays that are alike: so a dark car beside bright ones is no clump.

    Args:
        chosen: (K,) rays to look at; None for the body's.
    """
    among = box_rays.is_body if chosen is None else chosen
    if not among.any():
        return np.zeros((len(LAGS), 2))
    rate = float(box_rays.returns[among].mean())
    off = box_rays.returns - rate
    pairs = (next_firings(box_rays, among), next_firings(box_rays, among, 4), next_beams(box_rays, among))
    return np.array([[float((off[a] * off[b]).sum()), len(a) * rate * (1.0 - rate)] for a, b in pairs])


def next_firings(box_rays: BoxRays, chosen: Bool, step: int = 1) -> tuple[Index, Index]:
    """Pairs (P,), (P,) of chosen rays of one ring that are `step` firings apart, the earlier in azimuth first."""
    key = box_rays.ring.astype(np.int64) * _MANY + box_rays.firing
    among = np.flatnonzero(chosen)
    among = among[np.argsort(key[among])]
    key = key[among]
    at = np.minimum(np.searchsorted(key, key + step), max(len(key) - 1, 0))
    there = np.flatnonzero(key[at] == key + step)
    return among[there], among[at[there]]


def next_beams(box_rays: BoxRays, chosen: Bool) -> tuple[Index, Index]:
    """Pairs (P,), (P,) of chosen rays of neighbouring rings, upper first, within half a firing of one azimuth."""
    among = np.flatnonzero(chosen)
    upper, lower = _next_beam(box_rays.ring[among], box_rays.azimuth_rad[among])
    return among[upper], among[lower]


def clump_correlations(sums: Iterable[F64]) -> F64:
    """Correlation (3,) of "returned" for each of `LAGS` over the `clump_sums` of many views; nan: nothing varies."""
    total = np.sum([np.zeros((len(LAGS), 2)), *sums], axis=0)
    return np.where(total[:, 1] > 0.0, total[:, 0] / np.where(total[:, 1] > 0.0, total[:, 1], 1.0), np.nan)


def _next_beam(ring: I32, azimuth_rad: F64) -> tuple[Index, Index]:
    """Pairs of rays of neighbouring rings that look within half a firing of the same azimuth."""
    first, second = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for beam in np.unique(ring):
        upper, lower = np.flatnonzero(ring == beam), np.flatnonzero(ring == beam + 1)
        if not len(lower):
            continue
        middle = azimuth_rad[upper[0]]
        along = np.asarray(wrap_angle(azimuth_rad[lower] - middle))
        order = np.argsort(along)
        lower, along = lower[order], along[order]
        wanted = np.asarray(wrap_angle(azimuth_rad[upper] - middle))
        at = np.searchsorted(along, wanted)
        before, after = np.maximum(at - 1, 0), np.minimum(at, len(along) - 1)
        nearest = np.where(np.abs(along[before] - wanted) <= np.abs(along[after] - wanted), before, after)
        close = np.abs(along[nearest] - wanted) <= _SAME_BEAM_RAD
        first.append(upper[close])
        second.append(lower[nearest[close]])
    return np.concatenate(first), np.concatenate(second)


def _in_box(rays: ScanRays, ray: I32, box: F64, profile: ScannerProfile) -> tuple[F64, F64]:
    """Origins (K, 3) and directions (K, 3) of rays in the frame of a box."""
    T_box_velo = invert(box_pose(box))
    origin, direction = lines_of_rays(profile, rays, ray)
    return transform_points(T_box_velo, origin), rotate_vectors(T_box_velo, direction)


def _zone(
    origin: F64, direction: F64, box: F64, zone: tuple[tuple[float, float], ...], grow_m: float = 0.0
) -> tuple[F64, F64]:
    (x0, x1), (y0, y1), (z0, z1) = zone
    low = box[3:6] * (x0, y0, z0 - 0.5) - grow_m
    high = box[3:6] * (x1, y1, z1 - 0.5) + grow_m
    return cross_box(origin, direction, low, high)


def _tracks(sequences: Sequence[kitti.Sequence]) -> dict[tuple[str, str], str]:
    """The track of each (recording, label id): ids whose boxes coincide at one moment are one car."""
    parent: dict[tuple[str, str], tuple[str, str]] = {}

    def root_of(key: tuple[str, str]) -> tuple[str, str]:
        while parent[key] != key:
            key = parent[key]
        return key

    at: dict[tuple[str, int], list[tuple[F64, tuple[str, str]]]] = {}
    for sequence in sequences:
        for frame in sequence.frames:
            for label in kitti.read_labels(sequence, frame):
                key = (sequence.recording, label.id)
                parent.setdefault(key, key)
                others = at.setdefault((sequence.recording, frame), [])
                for centre, other in others:
                    if float(sm.hypot(*(centre - label.box[:2]))) < _ONE_CAR_M and root_of(other) != root_of(key):
                        parent[root_of(key)] = root_of(other)
                others.append((label.box[:2], key))
    return {key: "/".join(root_of(key)) for key in parent}
