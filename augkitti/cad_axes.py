"""Finds how an undescribed model stands: its triangles in; up, forward and unit out, each with its reason.

Up is what the format declares, else the axis that leaves the best left-right mirror plane; the plane gives the yaw to
0.02 degrees; the unit is the one that makes a vehicle's size; forward is a vote of windows, outline, overhangs, lamps
and, last, names. What is not clear is refused rather than guessed.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import I32, Bool

_SAMPLES = 3000
_REMEDY = "give up_axis, forward_axis and unit_scale in a sidecar"
_UNITS_M = (0.01, 0.001, 0.0254, 0.1, 0.3048, 10.0)
TALL_M = 2.1
FORWARD_VOTE = 0.5  # least difference of votes that counts as clear


@dataclass(frozen=True)
class Cues:
    """What marks the faces (F,) of a model for the question where its front is."""

    clear: Bool  # declared translucent, or glass by name where nothing is
    red: Bool  # of a red material
    front_named: Bool
    rear_named: Bool


def surface_points(vertices: F64, faces: I32, count: int) -> F64:
    """Points (count, 3) spread over the area of a mesh, the same on every call."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.cumsum(np.sqrt((normal * normal).sum(axis=1)))
    step = np.arange(count)
    face = np.minimum(np.searchsorted(total, (step + 0.5) / count * total[-1]), len(faces) - 1)
    u, v = np.mod(step * 0.7548776662466927, 1.0), np.mod(step * 0.5698402909980532, 1.0)  # R2 low-discrepancy sequence
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u)[:, None], np.where(flip, 1.0 - v, v)[:, None]
    return np.asarray(a[face] + u * (b - a)[face] + v * (c - a)[face])


def level_axes(vertices: F64, faces: I32, up: tuple[float, float, float] | None) -> tuple[F64, list[str]]:
    """Rotation (3, 3) from file axes to axes with z up and x along the car, front or back; and the reasons.

    Raises:
        InputError: no axis has a mirror plane, by which a car would be told.
    """
    points = surface_points(vertices, faces, _SAMPLES)
    if up is not None:
        base = _base(np.array(up))
        yaw, error = mirror_yaw(_turn(points, base))
        reasons = ["up axis: the format's"]
    else:
        tried = []
        for axis in range(3):
            base = _base(np.eye(3)[axis])
            yaw, error = mirror_yaw(_turn(points, base))
            extent = np.ptp(_turn(points, sm.product(_about_z(yaw), base)), axis=0)
            if extent[0] > extent[2]:  # no vehicle is higher than long
                tried.append((error, axis, yaw))
        if not tried:
            raise InputError("model", "no axis along which it is longer than high", _REMEDY)
        error, axis, yaw = min(tried)
        base = _base(np.eye(3)[axis])
        reasons = [f"up axis: {'xyz'[axis]}, by the left-right mirror plane"]
    if error > 0.35:
        raise InputError("model", f"no left-right symmetry to tell its axes by ({error:.2f})", _REMEDY)
    turned = sm.product(_about_z(yaw), base)
    if up is None and _upside_down(_turn(points, turned)):
        turned = sm.product(np.diag([1.0, -1.0, -1.0]), turned)
        reasons = [f"{reasons[0]}, pointing down"]
    if abs(yaw) > 1e-9:
        reasons.append(f"yaw {math.degrees(yaw):.2f} degrees, by the mirror plane")
    return turned, reasons


def _base(up: F64) -> F64:
    """A rotation (3, 3) that takes `up` to z."""
    up = up / np.sqrt((up * up).sum())
    helper = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
    x = helper - up * (helper * up).sum()
    x = x / np.sqrt((x * x).sum())
    return np.stack([x, np.cross(up, x), up])


def _about_z(yaw: float) -> F64:
    """Rotation (3, 3) into axes turned by yaw."""
    s, c = sm.sincos(float(yaw))
    if abs(c) < 1e-12 or abs(s) < 1e-12:
        c, s = float(round(c)), float(round(s))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _turn(points: F64, R: F64) -> F64:
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    return np.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=1)


def mirror_yaw(points: F64) -> tuple[float, float]:
    """The yaw of the vertical mirror plane through points (N, 3), z up, and how badly the mirror image fits.

    The yaw is that of the plane's long direction, in [-90, 90) degrees; within half a degree of the file's own axes, or
    within two where these fit as well, they are taken. The misfit is 0 for a perfect mirror image, 1 where the distance
    to it is 4 % of the diagonal.
    """
    cap = 0.04 * float(np.sqrt((np.ptp(points, axis=0) ** 2).sum()))
    tree = cKDTree(points)
    few, some = points[:: max(len(points) // 300, 1)], points[:: max(len(points) // 1000, 1)]
    scores = {float(d): _misfit(few, points, tree, float(d), cap) for d in range(-90, 90, 3)}
    best = min(scores, key=lambda d: (scores[d], d))
    error = scores[best]
    for step, reach, chosen in ((1.0, 3, few), (0.2, 5, some), (0.02, 10, points)):
        around = [round(best + step * k, 6) for k in range(-reach, reach + 1)]
        fits = {d: _misfit(chosen, points, tree, d, cap) for d in around}
        best = min(fits, key=lambda d: (fits[d], abs(d)))
        error = fits[best]
    nearest = 90.0 * round(best / 90.0)
    away = abs(best - nearest)
    if away < 0.5 or (away < 2.0 and _misfit(points, points, tree, nearest, cap) < 1.02 * error):
        best = nearest
    best = (best + 90.0) % 180.0 - 90.0
    return math.radians(best), error


def _misfit(some: F64, points: F64, tree: cKDTree, degrees: float, cap: float) -> float:
    """Mean distance, capped and relative to the cap, of mirrored points to the nearest of the others."""
    c, s = _about_z(math.radians(degrees))[0, :2]
    along, across = c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]
    low, high = across.min(), across.max()
    if high - low >= along.max() - along.min():
        return 2.0  # across the car's length: not its mirror plane
    beyond = (c * some[:, 1] - s * some[:, 0]) - (low + high) / 2.0
    mirrored = some - 2.0 * beyond[:, None] * np.array([-s, c, 0.0])
    distance, _ = tree.query(mirrored, distance_upper_bound=cap)
    return float(np.minimum(distance, cap).mean() / cap)


def _upside_down(points: F64) -> bool:
    """Whether the lowest fifth is narrower than the highest: a car's roof is narrower than its wheels and sills."""
    low, high = points[:, 2].min(), points[:, 2].max()
    bottom = points[points[:, 2] < low + 0.3 * (high - low)]
    top = points[points[:, 2] > high - 0.3 * (high - low)]
    return bool(np.ptp(bottom[:, 1]) * np.ptp(bottom[:, 0]) < 0.98 * np.ptp(top[:, 1]) * np.ptp(top[:, 0]))


def find_unit(extent: F64, declared_m: float | None) -> tuple[float, str]:
    """Metres per file unit that make an extent (length, width, height) a vehicle's, and the reason.

    Raises:
        InputError: none does, or more than one does.
    """
    if declared_m is not None and is_vehicle_size(extent * declared_m):
        return declared_m, f"unit {declared_m:g} m: declared"
    if declared_m is None and is_vehicle_size(extent):
        return 1.0, "unit 1 m: by size"
    fits = [u for u in _UNITS_M if is_vehicle_size(extent * u)]
    if len(fits) == 1:
        return fits[0], f"unit {fits[0]:g} m: by size"
    length, width, height = (float(e) for e in extent)
    what = "has no unit that makes it a vehicle" if not fits else f"could be in units of {fits[0]:g} or {fits[1]:g} m"
    raise InputError("model", f"a size of {length:.3g} x {width:.3g} x {height:.3g} {what}", _REMEDY)


def is_vehicle_size(size_m: F64) -> bool:
    """Whether length, width, height are a car's (3 to 6 m) or a van's, truck's or bus's (up to 13.5 m)."""
    length, width, height = (float(s) for s in size_m)
    car = 2.9 <= length <= 6.0 and 1.3 <= width <= 2.5 and 1.0 <= height <= 2.4 and 1.7 <= length / width <= 3.2
    large = 4.2 <= length <= 13.5 and 1.8 <= width <= 3.4 and 1.8 <= height <= 3.8 and 1.5 <= length / width <= 6.0
    return car or large


def forward_votes(vertices: F64, faces: I32, cues: Cues, axle_x: tuple[float, float] | None) -> list[tuple[str, float]]:
    """Votes for +x (positive) or -x as forward, each with its cue; vertices (V, 3) in metres, x along the car."""
    low, high = vertices[np.unique(faces)].min(axis=0), vertices[np.unique(faces)].max(axis=0)
    length, height = float((high - low)[0]), float((high - low)[2])
    corners = vertices[faces]
    middle = corners.mean(axis=1) - (low + high) / 2.0
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    area = np.sqrt((normal * normal).sum(axis=1))
    votes = []
    # windscreens are larger and lean more than rear windows
    outward = normal * np.where(normal[:, 2:] < 0.0, -1.0, 1.0)
    pane = cues.clear & (middle[:, 2] > -0.05 * height) & (np.abs(normal[:, 0]) > 0.3 * area)
    facing = {s: np.abs(normal[pane & (outward[:, 0] * s > 0.0), 0]).sum() for s in (1, -1)}
    if facing[1] + facing[-1] > 0.2:
        votes.append(("windscreen", _clip(2.0 * (facing[1] - facing[-1]) / (facing[1] + facing[-1]))))
    points = surface_points(vertices, faces, 20000) - (low + high) / 2.0
    hollow = {s: _hollow(points, high - low, s) > 0.15 * height for s in (1, -1)}
    if hollow[1] != hollow[-1]:
        votes.append(("load bed", 1.0 if hollow[-1] else -1.0))
    elif height < TALL_M:  # bonnets are lower than tails; of pickups and tall vehicles the tail may be anything
        tops = {s: _top(corners, low, high, s) for s in (1, -1)}
        votes.append(("outline", _clip((tops[-1] - tops[1]) / (0.15 * height))))
    if axle_x is not None:
        front, rear = axle_x  # of +x and of -x
        votes.append(("overhang", 0.5 * _clip(((rear - low[0]) - (high[0] - front)) / (0.1 * length))))
    red = cues.red & (np.abs(middle[:, 0]) > 0.3 * length)
    if 0.0 < area[red].sum() < 0.03 * area.sum():
        x = float((middle[red, 0] * area[red]).sum() / area[red].sum())
        votes.append(("red lamps", _clip(-2.0 * x / (0.5 * length))))
    for cue, named, sign in (("front by name", cues.front_named, 1.0), ("rear by name", cues.rear_named, -1.0)):
        if area[named].sum() > 0.0:
            x = float((middle[named, 0] * area[named]).sum() / area[named].sum())
            votes.append((cue, _clip(sign * 1.5 * x / (0.5 * length))))
    return votes


def _top(corners: F64, low: F64, high: F64, side: int) -> float:
    """Mean height of the upper outline over the outer fifth of the length on one side, bumper left out."""
    length = high[0] - low[0]
    from_end = (high[0] - corners[..., 0]) if side > 0 else (corners[..., 0] - low[0])
    edges = np.linspace(0.04, 0.2, 9) * length
    tops = []
    for start, end in pairwise(edges):
        spans = (from_end.min(axis=1) <= end) & (from_end.max(axis=1) >= start)
        inside = spans[:, None] & (from_end >= start - 0.02 * length) & (from_end <= end + 0.02 * length)
        if inside.any():
            tops.append(float(corners[..., 2][inside].max()))
    return float(np.mean(tops)) if tops else float(low[2])


def _hollow(points: F64, size: F64, side: int) -> float:
    """How far the middle lies below the edges over the outer 6 to 28 % of the length on one side: a pickup's bed."""
    from_end = size[0] / 2.0 - points[:, 0] * side
    depth = []
    for start in np.arange(0.06, 0.28, 0.02) * size[0]:
        here = (from_end >= start) & (from_end < start + 0.02 * size[0])
        middle = points[here & (np.abs(points[:, 1]) < 0.25 * size[1]), 2]
        edge = points[here & (np.abs(points[:, 1]) > 0.35 * size[1]), 2]
        if len(middle) and len(edge):
            depth.append(float(edge.max() - middle.max()))
    return float(np.median(depth)) if depth else 0.0


def _clip(value: float) -> float:
    return float(min(max(value, -1.0), 1.0))


def forward_sign(path: Path, votes: list[tuple[str, float]]) -> tuple[float, str]:
    """+1 or -1 for the x axis, and the reason.

    Raises:
        InputError: the votes do not settle it.
    """
    total = sum(v for _, v in votes)
    said = ", ".join(f"{cue} {value * (1 if total >= 0 else -1):+.2f}" for cue, value in votes)
    if abs(total) < FORWARD_VOTE:
        raise InputError(path, f"its front cannot be told from its back ({said})", _REMEDY)
    return (1.0 if total > 0.0 else -1.0), f"forward: {said}"
