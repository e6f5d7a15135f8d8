"""A procedural street: a seed in; its ground, houses and trees as one mesh, its cars and people, an ego path out.

A street is laid out in (s, n): s metres along a gently winding centre line, n metres to its left. `surface_height`
is the exact ground in these coordinates; wheels, posts and walls all stand on it. The world frame is x east, y north,
z up, with the centre line's s = 0 at the origin. Traffic keeps to the right.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from augkitti import same_math as sm
from augkitti import street_objects as objects
from augkitti.frames import F64, Array, footprints_overlap
from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import CarModel
from augkitti.street_objects import Mesh

SENSOR_HEIGHT_M = 1.73  # KITTI's set-up: scanner above the road
SENSOR_AHEAD_M = 0.76  # of the rear axle
EGO_SIZE_M = (4.9, 1.95, 1.6)
_EGO_WHEELBASE_M = 2.71

_BEYOND_M = 90.0  # the street goes on this far before and behind the ego path: farther than the scanner sees
_ASIDE_M = 80.0
_KERB_FACE_M = 0.03
_CORNER_RADIUS_M = 4.0
_PATH_STEP_M = 0.05
_STEERING_STEPS = 70  # 3.5 m, twice: about a second and a half at the speed of a turn
_CLEAR_M = 0.25


@dataclass(frozen=True)
class Crossing:
    """A side street that leaves the street at right angles."""

    s_m: float
    half_width_m: float
    left: bool
    right: bool


@dataclass(frozen=True, eq=False)
class Shape:
    """The form of a street's ground."""

    bend_rad: float  # heading = bend sin(2 pi s / wave + phase)
    wave_m: float
    phase_rad: float
    slope: float  # steepest longitudinal slope
    slope_wave_m: float
    slope_phase_rad: float
    crown: float
    lane_m: float
    half_m: tuple[float, float]  # left and right: centre line to kerb
    parking: tuple[bool, bool]
    kerb_m: float
    pavement_m: tuple[float, float]
    bank_m: tuple[float, float]  # how far the land rises behind the pavement
    driveways_m: tuple[tuple[float, ...], tuple[float, ...]]  # s of lowered kerbs
    crossings: tuple[Crossing, ...]
    bumps: F64  # (B, 4) height, 2 wave numbers, phase of the land's unevenness
    s_m: F64  # (K,) table of the centre line
    xy_m: F64  # (K, 2)


@dataclass(frozen=True, eq=False)
class Track:
    """Where a body's rear axle goes: a path on the ground, driven with constant acceleration."""

    along_m: F64  # (K,)
    position_m: F64  # (K, 3) world, on the ground
    yaw_rad: F64  # (K,) unwrapped
    normal: F64  # (K, 3) of the ground under the wheels
    start_m: float  # where on the path at time 0
    speed_mps: float
    acceleration_mps2: float = 0.0
    sway_rad: float = 0.0  # of the body on its springs
    sway_phase: float = 0.0


@dataclass(frozen=True, eq=False)
class Body:
    """A car or a person in the street."""

    model: CarModel
    track: Track
    moving: bool
    paint: float  # 0 dark to 1 bright
    tint: float


@dataclass(frozen=True, eq=False)
class Street:
    """All there is to scan, and where the scanner goes."""

    shape: Shape
    still: Mesh
    bodies: tuple[Body, ...]
    ego: Track


def build_street(rng: np.random.Generator, duration_s: float, pace: int) -> Street:
    """A street to be driven for `duration_s` seconds.

    Args:
        rng: draws everything.
        duration_s: from the middle of the first scan to that of the last.
        pace: how the ego car drives, modulo 5: town speed, fast, turning off slowly, gathering speed, standing.
    """
    speed, acceleration = _pace(rng, duration_s, pace)
    travel_m = speed * duration_s + 0.5 * acceleration * duration_s * duration_s
    turns_off = pace % 5 == 2 and travel_m < 70.0  # a side street is no longer than that
    shape = _draw_shape(rng, travel_m, turns_off)
    ego = _ego_track(shape, rng, speed, acceleration, turns_off)
    still = objects.joined([ground_mesh(shape), _markings(shape), *_standing_things(shape, rng)])
    bodies = _bodies(shape, ego, duration_s, rng)
    return Street(shape, still, bodies, ego)


# --- ground --------------------------------------------------------------------------------------------------------


def world_points(shape: Shape, s_m: Array, n_m: Array) -> F64:
    """World coordinates (..., 3) of the ground at (s, n)."""
    s, n = np.broadcast_arrays(np.asarray(s_m, dtype=np.float64), np.asarray(n_m, dtype=np.float64))
    heading = road_heading(shape, s)
    x = np.interp(s, shape.s_m, shape.xy_m[:, 0]) - n * sm.sin(heading)
    y = np.interp(s, shape.s_m, shape.xy_m[:, 1]) + n * sm.cos(heading)
    return np.stack([x, y, surface_height(shape, s, n)], axis=-1)


def road_heading(shape: Shape, s_m: Array) -> F64:
    """Heading (radians) of the centre line."""
    return np.asarray(shape.bend_rad * sm.sin(2.0 * np.pi * np.asarray(s_m) / shape.wave_m + shape.phase_rad))


def surface_height(shape: Shape, s_m: Array, n_m: Array) -> F64:
    """Height (...,) metres of the ground: crowned carriageways, kerbs, pavements, banks."""
    s, n = np.asarray(s_m, dtype=np.float64), np.asarray(n_m, dtype=np.float64)
    k = 2.0 * np.pi / shape.slope_wave_m
    along = shape.slope / k * (sm.sin(k * s + shape.slope_phase_rad) - sm.sin(shape.slope_phase_rad))
    beyond = _beyond_kerb(shape, n)
    left = n > 0.0
    half = np.where(left, shape.half_m[0], shape.half_m[1])
    pavement = np.where(left, shape.pavement_m[0], shape.pavement_m[1])
    bank = np.where(left, shape.bank_m[0], shape.bank_m[1])
    side, off_side = _on_side_street(shape, s, n)
    q = np.maximum(beyond, 0.0)
    land = 0.02 * np.minimum(q, pavement) + bank * _smooth((q - pavement - 0.5) / 12.0)
    garden = _smooth((q - pavement - 0.3) / 2.0) * _smooth((off_side - 0.5) / 2.0)
    for height, along_k, across_k, phase in shape.bumps:
        land = land + garden * height * sm.sin(along_k * s + across_k * n + phase)
    lowered = np.where(left, _lowered(shape.driveways_m[0], s), _lowered(shape.driveways_m[1], s))
    kerb = shape.kerb_m * (1.0 - 0.75 * lowered * (1.0 - _smooth(q / 1.5)))
    raised = np.where(side, 0.0, kerb)
    return np.asarray(along + np.where(beyond <= 0.0, -shape.crown * np.abs(n), -shape.crown * half + land + raised))


def ground_class(shape: Shape, s_m: Array, n_m: Array) -> Any:
    """Material (...,) of the ground: asphalt, kerb, pavement or grass."""
    s, n = np.asarray(s_m, dtype=np.float64), np.asarray(n_m, dtype=np.float64)
    beyond = _beyond_kerb(shape, n)
    side, off_side = _on_side_street(shape, s, n)
    left = n > 0.0
    pavement = np.where(left, shape.pavement_m[0], shape.pavement_m[1])
    lowered = np.where(left, _lowered(shape.driveways_m[0], s), _lowered(shape.driveways_m[1], s)) > 0.5
    paved = (beyond < pavement) | (off_side < 1.8) | (lowered & (beyond < pavement + 9.0))
    material = np.where(paved, objects.PAVEMENT, objects.GRASS)
    material = np.where((beyond < _KERB_FACE_M) | (off_side < _KERB_FACE_M), objects.KERB, material)
    return np.where((beyond <= 0.0) | side, objects.ASPHALT, material)


def ground_mesh(shape: Shape) -> Mesh:
    """The ground as a net whose lines follow every kerb."""
    s_lines, n_lines = _net_lines(shape)
    s, n = np.meshgrid(s_lines, n_lines, indexing="ij")
    s = _bend_to_corners(shape, s, n)
    vertices = world_points(shape, s, n)
    rows, columns = s.shape
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    middle_s = 0.25 * (s[:-1, :-1] + s[1:, :-1] + s[1:, 1:] + s[:-1, 1:]).ravel()
    middle_n = 0.25 * (n[:-1, :-1] + n[1:, :-1] + n[1:, 1:] + n[:-1, 1:]).ravel()
    material = ground_class(shape, middle_s, middle_n).astype(np.uint8)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return Mesh(vertices.reshape(-1, 3), faces, np.concatenate([material, material]))


def _beyond_kerb(shape: Shape, n: F64) -> F64:
    return np.asarray(np.where(n > 0.0, n - shape.half_m[0], -n - shape.half_m[1]))


def _on_side_street(shape: Shape, s: F64, n: F64) -> tuple[Any, F64]:
    """Whether (s, n) lies on a side street's asphalt, and how far (metres) it lies beyond the nearest one's kerb."""
    beyond = _beyond_kerb(shape, n)
    q = np.clip(beyond, 0.0, _CORNER_RADIUS_M)
    flare = _CORNER_RADIUS_M - np.sqrt(np.maximum(_CORNER_RADIUS_M**2 - (_CORNER_RADIUS_M - q) ** 2, 0.0))
    off: F64 = np.full(np.broadcast_shapes(s.shape, n.shape), np.inf)
    for crossing in shape.crossings:
        its = np.abs(s - crossing.s_m) - crossing.half_width_m - flare
        there = np.where(n > 0.0, crossing.left, crossing.right) & (beyond > 0.0)
        off = np.minimum(off, np.where(there, its, np.inf))
    return off <= 1e-9, off


def _lowered(driveways_m: tuple[float, ...], s: F64) -> F64:
    low = np.zeros(np.shape(s))
    for at in driveways_m:
        low = np.maximum(low, _smooth((2.3 - np.abs(s - at)) / 0.8))
    return low


def _smooth(x: Any) -> F64:
    t = np.clip(x, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _net_lines(shape: Shape) -> tuple[F64, F64]:
    s_lines = [np.arange(shape.s_m[0] + 5.0, shape.s_m[-1] - 5.0, 1.0)]
    for crossing in shape.crossings:
        for sign in (-1.0, 1.0):
            edge = crossing.s_m + sign * crossing.half_width_m
            s_lines.append(edge + sign * np.array([0.0, _KERB_FACE_M, 1.8]))
    lines = [np.zeros(1)]
    for sign, half, pavement in zip((1.0, -1.0), shape.half_m, shape.pavement_m, strict=True):
        q = np.concatenate([[0.0, _KERB_FACE_M, 0.12, 0.3], np.arange(0.6, 5.0, 0.4), [pavement, pavement + 0.05]])
        far = 5.0 + 0.8 * np.cumsum(sm.exp(sm.log(1.12) * np.arange(24)))
        lines.append(sign * (half + np.concatenate([q, far[far < _ASIDE_M - half]])))
        lines.append(sign * np.arange(0.8, half - 0.3, 0.8))
    return _apart(np.concatenate(s_lines)), _apart(np.concatenate(lines))


def _apart(values: F64) -> F64:
    ordered = np.unique(values)
    return np.asarray(ordered[np.concatenate([[True], np.diff(ordered) > 1e-3])])


def _bend_to_corners(shape: Shape, s: F64, n: F64) -> F64:
    """Shift the net's lines near a side street so that they follow its rounded kerb corners."""
    bent = s.copy()
    out = _beyond_kerb(shape, n)
    q = np.clip(out, 0.0, _CORNER_RADIUS_M)
    flare = _CORNER_RADIUS_M - np.sqrt(np.maximum(_CORNER_RADIUS_M**2 - (_CORNER_RADIUS_M - q) ** 2, 0.0))
    # On the carriageway the shift runs out towards the centre line: no sheared triangles at its kerb.
    flare = flare * np.clip(1.0 + out / np.where(n > 0.0, *shape.half_m), 0.0, 1.0)
    for crossing in shape.crossings:
        off = s - crossing.s_m
        beyond = np.abs(off) - crossing.half_width_m
        # In full at the kerb, fading outwards and towards the middle, so that lines keep their order.
        share = np.where(
            beyond >= -1e-9,
            np.clip(1.0 - (beyond - 2.0).clip(0.0) / (2.5 * _CORNER_RADIUS_M), 0.0, 1.0),
            np.abs(off) / crossing.half_width_m,
        )
        there = np.where(n > 0.0, crossing.left, crossing.right)
        bent += np.where(there, np.sign(off) * share * flare, 0.0)
    return bent


# --- paths ---------------------------------------------------------------------------------------------------------


def make_track(
    shape: Shape,
    corners_sn: Array,
    radius_m: float,
    wheelbase_m: float,
    start_m: float,
    speed_mps: float,
    acceleration_mps2: float = 0.0,
) -> Track:
    """A track along straight legs between corners (C, 2) in (s, n), rounded by arcs of `radius_m`."""
    sn = _steered(_rounded(np.asarray(corners_sn, dtype=np.float64), radius_m))
    xyz = world_points(shape, sn[:, 0], sn[:, 1])
    along = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(xyz[:, :2], axis=0) ** 2).sum(axis=1)))])
    direction = np.gradient(xyz[:, :2], axis=0)
    direction /= np.maximum(np.sqrt((direction**2).sum(axis=1, keepdims=True)), 1e-12)
    yaw = np.unwrap(sm.arctan2(direction[:, 1], direction[:, 0]))
    leg = np.gradient(sn, axis=0)
    leg /= np.maximum(np.sqrt((leg**2).sum(axis=1, keepdims=True)), 1e-12)
    ahead = sn + wheelbase_m * leg
    across = 0.8 * np.stack([-leg[:, 1], leg[:, 0]], axis=1)
    z_back = 0.5 * (_height_at(shape, sn + across) + _height_at(shape, sn - across))
    z_front = 0.5 * (_height_at(shape, ahead + across) + _height_at(shape, ahead - across))
    z_left = 0.5 * (_height_at(shape, sn + across) + _height_at(shape, ahead + across))
    z_right = 0.5 * (_height_at(shape, sn - across) + _height_at(shape, ahead - across))
    climb, lean = (z_front - z_back) / wheelbase_m, (z_left - z_right) / 1.6
    gradient = climb[:, None] * direction + lean[:, None] * np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    normal = np.concatenate([-gradient, np.ones((len(sn), 1))], axis=1)
    normal /= np.sqrt((normal**2).sum(axis=1, keepdims=True))
    position = np.concatenate([xyz[:, :2], z_back[:, None]], axis=1)
    return Track(along, position, yaw, normal, start_m, speed_mps, acceleration_mps2)


def track_poses(track: Track, time_s: Array) -> F64:
    """`T_world_axle` (..., 4, 4) at times: origin on the ground, x forward, z along the ground's normal."""
    t = np.asarray(time_s, dtype=np.float64)
    along = np.clip(track.start_m + track.speed_mps * t + 0.5 * track.acceleration_mps2 * t * t, 0.0, track.along_m[-1])
    position = np.stack([np.interp(along, track.along_m, track.position_m[:, i]) for i in range(3)], axis=-1)
    normal = np.stack([np.interp(along, track.along_m, track.normal[:, i]) for i in range(3)], axis=-1)
    yaw = np.interp(along, track.along_m, track.yaw_rad)
    c, s = sm.cos(yaw), sm.sin(yaw)
    pitch = track.sway_rad * sm.sin(2.0 * np.pi * 1.4 * t + track.sway_phase)
    roll = track.sway_rad * sm.sin(2.0 * np.pi * 0.9 * t + 2.0 * track.sway_phase)
    normal = normal + np.stack([pitch * c - roll * s, pitch * s + roll * c, np.zeros_like(c)], axis=-1)
    normal = normal / np.sqrt((normal**2).sum(axis=-1, keepdims=True))
    forward = np.stack([c, s, -(normal[..., 0] * c + normal[..., 1] * s) / normal[..., 2]], axis=-1)
    forward = forward / np.sqrt((forward**2).sum(axis=-1, keepdims=True))
    T = np.zeros(t.shape + (4, 4))
    T[..., :3, 0], T[..., :3, 1], T[..., :3, 2] = forward, np.cross(normal, forward), normal
    T[..., :3, 3], T[..., 3, 3] = position, 1.0
    return T


def _height_at(shape: Shape, sn: F64) -> F64:
    return surface_height(shape, sn[:, 0], sn[:, 1])


def _steered(path: F64) -> F64:
    """A path (K, 2) whose curvature grows gradually: arcs meet legs with a jump, a steering wheel does not."""
    half = min(_STEERING_STEPS // 2, len(path) - 1)
    mean = np.ones(2 * half + 1) / (2 * half + 1)
    for _ in range(2):
        padded = np.pad(path, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
        path = ndimage.correlate1d(padded, mean, axis=0)[half : half + len(path)]
    return path


def _rounded(corners: F64, radius_m: float) -> F64:
    """Points (K, 2), `_PATH_STEP_M` apart, along legs with rounded corners."""
    pieces, here = [], corners[0]
    for i in range(1, len(corners) - 1):
        a, b = corners[i] - corners[i - 1], corners[i + 1] - corners[i]
        a, b = a / np.sqrt((a * a).sum()), b / np.sqrt((b * b).sum())
        turn = sm.arctan2(a[0] * b[1] - a[1] * b[0], (a * b).sum())
        if abs(turn) < 1e-6:
            continue
        cut = radius_m * sm.tan(0.5 * abs(turn))
        begin = corners[i] - cut * a
        pieces.append(_leg(here, begin))
        angle = np.linspace(0.0, turn, max(2, int(abs(turn) * radius_m / _PATH_STEP_M)))[:-1]
        side = np.sign(turn) * np.array([-a[1], a[0]])
        pieces.append(begin + radius_m * (sm.sin(np.abs(angle))[:, None] * a + (1 - sm.cos(angle))[:, None] * side))
        here = corners[i] + cut * b
    pieces.append(np.concatenate([_leg(here, corners[-1]), corners[-1:]]))
    return np.concatenate(pieces)


def _leg(start: F64, end: F64) -> F64:
    length = float(np.sqrt(((end - start) ** 2).sum()))
    share = np.linspace(0.0, 1.0, max(2, int(length / _PATH_STEP_M)))[:-1]
    return np.asarray(start + share[:, None] * (end - start))


# --- drawing a street ----------------------------------------------------------------------------------------------


def _pace(rng: np.random.Generator, duration_s: float, pace: int) -> tuple[float, float]:
    """Speed (m/s) at the first scan and acceleration (m/s^2)."""
    kind = pace % 5
    if kind == 0:
        return float(rng.uniform(6.0, 9.0)), float(rng.uniform(-0.4, 0.4) / max(1.0, 0.2 * duration_s))
    if kind == 1:
        return float(rng.uniform(10.0, 14.0)), 0.0
    if kind == 2:
        return float(rng.uniform(3.5, 5.5)), 0.0
    if kind == 3:
        return float(rng.uniform(1.0, 3.0)), float(min(2.0, 11.0 / max(duration_s, 0.5)))
    return 0.0, 0.0


def _draw_shape(rng: np.random.Generator, travel_m: float, turns_off: bool) -> Shape:
    lane = float(rng.uniform(3.2, 4.2))
    parking = (bool(rng.random() < 0.5), bool(rng.random() < 0.5))
    half = (lane + 2.3 * parking[0] + 0.2, lane + 2.3 * parking[1] + 0.2)
    first = 10.0 + float(rng.uniform(0.1, 0.6)) * travel_m if turns_off else float(rng.uniform(-25.0, 45.0))
    places = [first]
    while places[-1] + 60.0 < travel_m + _BEYOND_M:
        places.append(places[-1] + float(rng.uniform(55.0, 120.0)))
    crossings = []
    for i, at in enumerate(place for place in places if place < travel_m + _BEYOND_M - 15.0):
        left, right = ((True, True), (True, False), (False, True))[int(rng.integers(3))]
        crossings.append(Crossing(at, float(rng.uniform(2.8, 3.8)), left, right or (turns_off and i == 0)))
    driveways = []
    for _ in range(2):
        ways = rng.uniform(-_BEYOND_M, travel_m + _BEYOND_M, int((travel_m + 2 * _BEYOND_M) / 30.0))
        far = [min(abs(way - c.s_m) for c in crossings) > 15.0 for way in ways]
        driveways.append(tuple(float(way) for way in np.sort(ways[far])))
    bumps = np.stack(
        [
            rng.uniform(0.01, 0.04, 6),
            rng.uniform(-1.6, 1.6, 6),
            rng.uniform(-1.6, 1.6, 6),
            rng.uniform(0.0, 2.0 * np.pi, 6),
        ],
        axis=1,
    )
    bend, wave = float(rng.uniform(0.05, 0.4)), float(rng.uniform(240.0, 420.0))
    phase = float(rng.uniform(0.0, 2.0 * np.pi))
    s = np.arange(-_BEYOND_M - 10.0, travel_m + _BEYOND_M + 10.0, 0.25)
    heading = bend * sm.sin(2.0 * np.pi * s / wave + phase)
    step = 0.5 * (heading[1:] + heading[:-1])
    xy = np.zeros((len(s), 2))
    xy[1:, 0], xy[1:, 1] = np.cumsum(0.25 * sm.cos(step)), np.cumsum(0.25 * sm.sin(step))
    xy -= [np.interp(0.0, s, xy[:, 0]), np.interp(0.0, s, xy[:, 1])]
    return Shape(
        bend_rad=bend,
        wave_m=wave,
        phase_rad=phase,
        slope=float(rng.uniform(-0.035, 0.035)),
        slope_wave_m=float(rng.uniform(250.0, 500.0)),
        slope_phase_rad=float(rng.uniform(0.0, 2.0 * np.pi)),
        crown=float(rng.uniform(0.015, 0.025)),
        lane_m=lane,
        half_m=half,
        parking=parking,
        kerb_m=float(rng.uniform(0.08, 0.15)),
        pavement_m=(float(rng.uniform(1.5, 3.2)), float(rng.uniform(1.5, 3.2))),
        bank_m=(float(rng.uniform(-0.5, 1.2)), float(rng.uniform(-0.5, 1.2))),
        driveways_m=(driveways[0], driveways[1]),
        crossings=tuple(crossings),
        bumps=bumps,
        s_m=s,
        xy_m=xy,
    )


def _ego_track(shape: Shape, rng: np.random.Generator, speed: float, acceleration: float, turns_off: bool) -> Track:
    lane = -0.47 * shape.lane_m
    begin, end = -20.0, float(shape.s_m[-1]) - 20.0
    corners = [(begin, lane), (end, lane)]
    if turns_off:
        crossing = shape.crossings[0]
        into = crossing.s_m - 0.5 * crossing.half_width_m
        corners = [(begin, lane), (into, lane), (into, -_ASIDE_M + 5.0)]
    track = make_track(shape, np.array(corners), 8.0, _EGO_WHEELBASE_M, -begin, speed, acceleration)
    return replace(track, sway_rad=0.001 if speed > 0.0 else 0.0, sway_phase=float(rng.uniform(0.0, 2.0 * np.pi)))


def _markings(shape: Shape) -> Mesh:
    """The dashed centre line, four millimetres above the asphalt."""
    dashes = []
    for s in np.arange(shape.s_m[0] + 8.0, shape.s_m[-1] - 12.0, 6.0):
        if min(abs(s + 1.5 - c.s_m) - c.half_width_m for c in shape.crossings) < 3.0:
            continue
        sn = np.array([[s, -0.06], [s + 1.5, -0.06], [s + 3.0, -0.06], [s + 3.0, 0.06], [s + 1.5, 0.06], [s, 0.06]])
        xyz = world_points(shape, sn[:, 0], sn[:, 1]) + [0.0, 0.0, 0.004]
        dashes += [xyz[[0, 1, 4, 5]], xyz[[1, 2, 3, 4]]]
    return objects.quads(np.array(dashes).reshape(-1, 4, 3), objects.MARKING)


def _stand(
    shape: Shape, mesh: Mesh, s: float, n: float, turn_rad: float, reach: tuple[float, float] = (0.0, 0.0)
) -> Mesh:
    """A thing at (s, n), turned against the street; a long one stands as low as the ground at its far corner."""
    yaw = float(road_heading(shape, np.array(s))) + turn_rad
    c, sn = sm.cos(yaw), sm.sin(yaw)
    x, y, z = world_points(shape, np.array(s), np.array(n))
    ct, st = sm.cos(turn_rad), sm.sin(turn_rad)
    far = [(s + ct * a - st * b, n + st * a + ct * b) for a in (0.0, reach[0]) for b in (0.0, reach[1])]
    z = min(float(surface_height(shape, np.array(p), np.array(q))) for p, q in far)
    return objects.placed(mesh, np.array([[c, -sn, 0, x], [sn, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=np.float64))


def _standing_things(shape: Shape, rng: np.random.Generator) -> list[Mesh]:
    things: list[Mesh] = []
    kind = rng.random()
    for sign in (1.0, -1.0):
        if kind < 0.3:  # a town street
            setback = float(rng.uniform(0.1, 1.5))
        elif kind < 0.75:  # a suburb with gardens
            setback = float(rng.uniform(3.0, 9.0))
        else:  # open land
            setback = float(rng.uniform(9.0, 20.0))
        things += _house_row(shape, sign, setback, rng)
        things += _kerbside(shape, sign, rng)
        things += _backdrop(shape, sign, rng)
    return things


def _side(shape: Shape, sign: float) -> tuple[float, float, tuple[float, ...]]:
    side = 0 if sign > 0.0 else 1
    return shape.half_m[side], shape.pavement_m[side], shape.driveways_m[side]


def _clear_of_crossings(shape: Shape, sign: float, low: float, high: float, margin_m: float) -> bool:
    for crossing in shape.crossings:
        there = crossing.left if sign > 0.0 else crossing.right
        reach = crossing.half_width_m + margin_m
        if there and low < crossing.s_m + reach and high > crossing.s_m - reach:
            return False
    return True


def _house_row(shape: Shape, sign: float, setback: float, rng: np.random.Generator) -> list[Mesh]:
    half, pavement, driveways = _side(shape, sign)
    turn = 0.0 if sign > 0.0 else np.pi
    things: list[Mesh] = []
    dense = setback < 2.0
    s, end = float(shape.s_m[0]) + 8.0, float(shape.s_m[-1]) - 8.0
    while s < end:
        lot = float(rng.uniform(10.0, 22.0))
        if not _clear_of_crossings(shape, sign, s, s + lot, 3.5):
            s += 2.0
            continue
        gap = float(rng.uniform(0.0, 1.0)) if dense and rng.random() < 0.6 else float(rng.uniform(2.5, 7.0))
        front = half + pavement + setback + float(rng.uniform(0.0, 0.8))
        wide, deep = max(6.0, lot - gap), float(rng.uniform(8.0, 12.0))
        kind = rng.random()
        if kind < (0.8 if dense else 0.66):
            floors = int(rng.integers(2, 5)) if dense else int(rng.integers(1, 4))
            mesh = objects.house(wide, deep, floors, rng)
            at = s if sign > 0.0 else s + wide
            things.append(_stand(shape, mesh, at, sign * front, turn, (wide, deep)))
            if gap > 3.5 and rng.random() < 0.5:
                shed = objects.garage(rng)
                at = s + wide + 0.2 if sign > 0.0 else s + lot - 0.2
                things.append(_stand(shape, shed, at, sign * (front + 3.0), turn, (3.0, 5.8)))
        else:
            for _ in range(int(rng.integers(2, 6))):
                plant = objects.tree(rng) if rng.random() < 0.6 else objects.bush(rng)
                q = float(rng.uniform(2.0, 22.0))
                things.append(_stand(shape, plant, s + float(rng.uniform(0, lot)), sign * (half + pavement + q), 0.0))
        if setback > 2.0:
            things += _front_garden(shape, sign, s, lot, setback, driveways, rng)
        s += lot
    return things


def _front_garden(
    shape: Shape,
    sign: float,
    s: float,
    lot: float,
    setback: float,
    driveways: tuple[float, ...],
    rng: np.random.Generator,
) -> list[Mesh]:
    half, pavement, _ = _side(shape, sign)
    things: list[Mesh] = []
    kind, at = rng.random(), s
    while kind < 0.75 and at < s + lot - 1.5:
        length = min(float(rng.uniform(3.0, 6.0)), s + lot - at)
        if all(abs(at + 0.5 * length - d) > 0.5 * length + 2.0 for d in driveways):
            piece = objects.hedge(length, rng) if kind < 0.4 else objects.fence(length, rng)
            turn = 0.0 if sign > 0.0 else np.pi
            start = at if sign > 0.0 else at + length
            things.append(_stand(shape, piece, start, sign * (half + pavement + 0.5), turn, (length, 0.0)))
        at += length
    for _ in range(int(rng.integers(0, 5))):
        plant = objects.tree(rng) if rng.random() < 0.45 else objects.bush(rng)
        place, q = s + float(rng.uniform(0.5, lot - 0.5)), float(rng.uniform(1.2, setback - 0.5))
        if all(abs(place - d) > 3.0 for d in driveways):
            things.append(_stand(shape, plant, place, sign * (half + pavement + q), 0.0))
    return things


def _kerbside(shape: Shape, sign: float, rng: np.random.Generator) -> list[Mesh]:
    half, _, driveways = _side(shape, sign)
    things: list[Mesh] = []
    turn = np.pi if sign > 0.0 else 0.0
    trees = rng.random() < 0.5
    for s in np.arange(float(shape.s_m[0]) + 10.0, float(shape.s_m[-1]) - 10.0, 14.0):
        at = float(s + rng.uniform(-4.0, 4.0))
        if not _clear_of_crossings(shape, sign, at, at, 1.0 + _CORNER_RADIUS_M):
            continue
        if any(abs(at - d) < 3.0 for d in driveways):
            continue
        kind = rng.random()
        if kind < 0.25:
            thing = objects.lamp_post(rng)
        elif kind < 0.4:
            thing = objects.sign_post(rng)
        elif kind < 0.5:
            thing = objects.bin_or_bollard(rng)
        elif trees:
            thing = objects.tree(rng)
        else:
            continue
        things.append(_stand(shape, thing, at, sign * (half + 0.55), turn))
    return things


def _backdrop(shape: Shape, sign: float, rng: np.random.Generator) -> list[Mesh]:
    """Back gardens, and the houses along side streets."""
    half, pavement, _ = _side(shape, sign)
    things: list[Mesh] = []
    for s in np.arange(float(shape.s_m[0]) + 6.0, float(shape.s_m[-1]) - 6.0, 5.0):
        at, q = float(s + rng.uniform(-3.0, 3.0)), float(rng.uniform(pavement + 21.0, 62.0))
        if not _clear_of_crossings(shape, sign, at - 8.0, at + 8.0, 3.0):
            continue
        kind = rng.random()
        if kind < 0.55:
            things.append(_stand(shape, objects.tree(rng), at, sign * (half + q), 0.0))
        elif kind < 0.85:
            wide, deep = float(rng.uniform(8.0, 12.0)), float(rng.uniform(8.0, 11.0))
            mesh = objects.house(wide, deep, int(rng.integers(1, 4)), rng)
            turn = float(rng.integers(4)) * np.pi / 2
            things.append(_stand(shape, mesh, at, sign * (half + q), turn, (wide, deep)))
    for crossing in shape.crossings:
        if not (crossing.left if sign > 0.0 else crossing.right):
            continue
        for edge in (-1.0, 1.0):
            n = half + pavement + 24.0
            while n < _ASIDE_M - 14.0:
                wide, deep = float(rng.uniform(8.0, 13.0)), float(rng.uniform(8.0, 10.0))
                at = crossing.s_m + edge * (crossing.half_width_m + 1.8 + float(rng.uniform(0.5, 4.0)))
                mesh = objects.house(wide, deep, int(rng.integers(1, 4)), rng)
                # The front looks on to the side street: the body lies away from it.
                turn = -np.pi / 2 if edge > 0.0 else np.pi / 2
                start = sign * (n + wide if (turn < 0.0) == (sign > 0.0) else n)
                things.append(_stand(shape, mesh, at, start, turn, (wide, deep)))
                n += wide + float(rng.uniform(1.0, 6.0))
    return things


# --- cars and people -----------------------------------------------------------------------------------------------


def _bodies(shape: Shape, ego: Track, duration_s: float, rng: np.random.Generator) -> tuple[Body, ...]:
    models = parametric_cars()
    parked = _parked(shape, models, rng)
    moving = _moving(shape, ego, duration_s, models, rng)
    times = np.arange(-0.1, duration_s + 0.15, 0.1)
    accepted: list[Body] = []
    taken = [_footprints(ego, times, EGO_SIZE_M[0], EGO_SIZE_M[1], 1.4)]
    for body in (*parked, *moving):
        corners = _body_footprints(body, times)
        if not any(_touch(corners, others) for others in taken):
            accepted.append(body)
            taken.append(corners)
    return tuple(accepted)


def _body(model: CarModel, track: Track, moving: bool, rng: np.random.Generator) -> Body:
    return Body(model, track, moving, paint=float(rng.random()), tint=float(rng.random()))


def _parked(shape: Shape, models: tuple[CarModel, ...], rng: np.random.Generator) -> list[Body]:
    found = []
    for sign in (1.0, -1.0):
        side = 0 if sign > 0.0 else 1
        half, _, driveways = _side(shape, sign)
        full = float(rng.uniform(0.25, 0.8))
        s = float(shape.s_m[0]) + 12.0
        while shape.parking[side] and s < float(shape.s_m[-1]) - 12.0:
            model = models[int(rng.integers(len(models)))]
            length, width = float(model.size_m[0]), float(model.size_m[1])
            free = _clear_of_crossings(shape, sign, s, s + length, _CORNER_RADIUS_M + 3.0)
            free &= all(abs(s + 0.5 * length - d) > 0.5 * length + 2.0 for d in driveways)
            if free and rng.random() < full:
                along = sign < 0.0 or rng.random() < 0.15
                n = sign * (half - 0.5 * width - float(rng.uniform(0.08, 0.3)))
                skew = float(rng.normal(0.0, 0.012)) * 3.0
                first = (s + 0.5 * length + (1.0 if along else -1.0) * model.rear_axle_x_m, n)
                ahead = (first[0] + (3.0 if along else -3.0), n + skew)
                track = make_track(shape, np.array([first, ahead]), 1.0, model.wheelbase_m, 0.0, 0.0)
                found.append(_body(model, track, False, rng))
            s += length + float(rng.uniform(0.6, 2.0)) if free else 1.5
    return found


def _moving(
    shape: Shape, ego: Track, duration_s: float, models: tuple[CarModel, ...], rng: np.random.Generator
) -> list[Body]:
    first, last = float(shape.s_m[0]) + 8.0, float(shape.s_m[-1]) - 8.0
    lane = 0.5 * shape.lane_m
    ends = ego.start_m + ego.speed_mps * duration_s + 0.5 * ego.acceleration_mps2 * duration_s * duration_s - 20.0
    found: list[Body] = []

    def car(corners: Array, radius_m: float, start_m: float, speed: float, acceleration: float = 0.0) -> None:
        model = models[int(rng.integers(len(models)))]
        track = make_track(shape, corners, radius_m, model.wheelbase_m, start_m, speed, acceleration)
        found.append(_body(model, track, True, rng))

    same, other = np.array([[first, -lane], [last, -lane]]), np.array([[last, lane], [first, lane]])
    for offset in (float(rng.uniform(10.0, 26.0)), -float(rng.uniform(11.0, 24.0))):  # ahead of the ego car, behind it
        if rng.random() < 0.75:
            pace = max(0.0, ego.speed_mps + float(rng.normal(0.0, 0.8)))
            if pace < 0.5:
                pace = 0.0 if offset < 0.0 else float(rng.uniform(2.0, 6.0))
            car(same, 5.0, offset - first, pace, ego.acceleration_mps2)
    speed = float(rng.uniform(7.0, 14.0))
    at = -float(rng.uniform(0.0, 60.0))
    while at < ends + speed * duration_s + 70.0:
        if last - at > 0.0:
            car(other, 5.0, last - at, speed + float(rng.normal(0.0, 0.5)))
        at += float(rng.uniform(16.0, 55.0))
    for crossing in shape.crossings:
        if not -40.0 < crossing.s_m < ends + 50.0:
            continue
        lane_in, lane_out = 0.5 * crossing.half_width_m, -0.5 * crossing.half_width_m
        if crossing.left:  # out of the left side street, to the right or across
            away = float(rng.uniform(8.0, 40.0))
            start = np.array([crossing.s_m + lane_out, _ASIDE_M - 10.0])
            if crossing.right and rng.random() < 0.5:
                route = np.array([start, [crossing.s_m + lane_out, -_ASIDE_M + 10.0]])
            else:
                route = np.array([start, [crossing.s_m + lane_out, lane], [first, lane]])
            reach = _ASIDE_M - 10.0 - shape.half_m[0] - away
            car(route, 5.5, max(0.0, reach), float(rng.uniform(2.5, 7.0)))
        if crossing.right:
            start = np.array([crossing.s_m + lane_in, -_ASIDE_M + 10.0])
            route = np.array([start, [crossing.s_m + lane_in, -lane], [last, -lane]])
            reach = _ASIDE_M - 10.0 - shape.half_m[1] - float(rng.uniform(6.0, 35.0))
            car(route, 5.5, max(0.0, reach), float(rng.uniform(2.0, 5.0)))
    for _ in range(int(rng.integers(2, 7))):
        sign = 1.0 if rng.random() < 0.5 else -1.0
        half, pavement, _ = _side(shape, sign)
        n = sign * (half + float(rng.uniform(1.0, max(1.05, pavement - 0.3))))
        at = float(rng.uniform(-30.0, ends + 45.0))
        model = objects.pedestrian_model(rng)
        route = np.array([[at, n], [at + (60.0 if rng.random() < 0.5 else -60.0), n]])
        if rng.random() < 0.2:
            route = np.array([[at, n], [at, -n]])
        track = make_track(shape, route, 1.0, model.wheelbase_m, 0.0, float(rng.uniform(0.9, 1.7)))
        found.append(_body(model, track, True, rng))
    for _ in range(int(rng.integers(0, 3))):
        sign = 1.0 if rng.random() < 0.5 else -1.0
        n = sign * (shape.lane_m - 0.5)
        at, pace = float(rng.uniform(-30.0, ends + 45.0)), float(rng.uniform(3.0, 6.5))
        model = objects.cyclist_model(rng)
        route = np.array([[at, n], [last if sign < 0.0 else first, n]])
        if abs(route[1, 0] - at) > 10.0:
            track = make_track(shape, route, 1.0, model.wheelbase_m, 0.0, pace)
            found.append(_body(model, track, True, rng))
    return found


def body_poses(body: Body, time_s: Array) -> F64:
    """`T_world_body` (..., 4, 4), origin at the model's middle, at times."""
    T = track_poses(body.track, time_s)
    middle = np.array([-body.model.rear_axle_x_m, 0.0, 0.5 * float(body.model.size_m[2])])
    out = T.copy()
    out[..., :3, 3] += (T[..., :3, :3] * middle).sum(axis=-1)
    return out


def scanner_poses(street: Street, time_s: Array) -> F64:
    """`T_world_velo` (..., 4, 4) at times."""
    T = track_poses(street.ego, time_s)
    out = T.copy()
    out[..., :3, 3] += (T[..., :3, :3] * np.array([SENSOR_AHEAD_M, 0.0, SENSOR_HEIGHT_M])).sum(axis=-1)
    return out


def _body_footprints(body: Body, times: F64) -> F64:
    length, width, _ = body.model.size_m
    return _footprints(body.track, times, float(length), float(width), -body.model.rear_axle_x_m)


def _footprints(track: Track, times: F64, length_m: float, width_m: float, ahead_m: float) -> F64:
    """Corners (T, 4, 2) on the ground at times, grown by what drivers keep clear."""
    T = track_poses(track, times)
    yaw = sm.arctan2(T[:, 1, 0], T[:, 0, 0])
    forward = np.stack([sm.cos(yaw), sm.sin(yaw)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    middle = T[:, :2, 3] + ahead_m * forward
    half_l, half_w = 0.5 * length_m + _CLEAR_M, 0.5 * width_m + _CLEAR_M
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return np.stack([middle + a * half_l * forward + b * half_w * left for a, b in signs], axis=1)


def _touch(a: F64, b: F64) -> bool:
    near = np.abs(a.mean(axis=1) - b.mean(axis=1)).max(axis=1) < 9.0
    return any(footprints_overlap(a[k], b[k]) for k in np.flatnonzero(near))
