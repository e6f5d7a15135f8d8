"""Cars made in code: no input, car models of several body types with wheels, glass, lamps and seats out.

Sizes follow the labelled cars of KITTI (Geiger et al. 2012, object labels, class Car): length 3.88 +- 0.43 m, width
1.63 +- 0.10 m, height 1.53 +- 0.14 m, means and standard deviations over all labels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from augkitti import same_math as sm
from augkitti.cad_vehicle import finished_model
from augkitti.frames import F64
from augkitti.scan_pair import GLASS, LAMP, OTHER, PAINT, TYRE, CarModel

PANE_OPACITY = 0.3  # only says "not solid"; what a pane lets through is the noise model's matter
_SEGMENTS = 28  # of a wheel


@dataclass(frozen=True)
class BodySpec:
    """Measures of a body, metres; x runs back from the nose, z up from the ground."""

    name: str
    category: str
    length_m: float
    width_m: float  # over the mirrors
    height_m: float
    wheelbase_m: float
    front_axle_m: float  # from the nose
    tyre_radius_m: float
    sill_m: float  # lower edge of the body
    nose_m: float  # height of the bonnet's front edge
    cowl_m: float  # where the windscreen starts, from the nose
    belt_m: float  # height of the windows' lower edge
    screen_top_m: float  # where the windscreen ends, from the nose
    roof_end_m: float  # where the roof ends, from the nose
    back_base_m: float  # where the rear window ends, from the nose
    deck_m: float  # height of the body behind the rear window
    pillars_m: tuple[float, ...]  # middles of the pillars between side windows, from the nose
    side_glass_end_m: float  # where the side windows end, from the nose
    roof_share: float = 0.76  # roof width over body width
    rear_seats: bool = True
    box_m: tuple[float, float] | None = None  # a truck's box: where it starts, its height


BODIES = (
    BodySpec("parametric_city", "Car", 3.25, 1.52, 1.53, 2.20, 0.62, 0.27, 0.19, 0.74,
             0.72, 0.90, 1.35, 2.85, 3.19, 0.84, (1.95,), 3.00),
    BodySpec("parametric_compact", "Car", 3.45, 1.58, 1.45, 2.30, 0.68, 0.28, 0.18, 0.70,
             0.90, 0.88, 1.60, 2.95, 3.36, 0.86, (2.12,), 3.10),
    BodySpec("parametric_hatchback", "Car", 3.85, 1.64, 1.48, 2.48, 0.76, 0.30, 0.18, 0.72,
             1.02, 0.91, 1.78, 3.25, 3.74, 0.90, (2.22, 3.02), 3.45),
    BodySpec("parametric_sedan", "Car", 4.25, 1.68, 1.44, 2.56, 0.82, 0.30, 0.17, 0.70,
             1.18, 0.90, 1.92, 3.00, 3.62, 0.95, (2.36, 3.08), 3.36),
    BodySpec("parametric_estate", "Car", 4.30, 1.68, 1.49, 2.60, 0.84, 0.31, 0.17, 0.71,
             1.16, 0.91, 1.92, 3.90, 4.20, 0.92, (2.38, 3.16), 4.02),
    BodySpec("parametric_coupe", "Car", 3.95, 1.66, 1.35, 2.42, 0.80, 0.30, 0.15, 0.66,
             1.22, 0.84, 1.95, 2.70, 3.52, 0.90, (2.50,), 3.05, 0.72, False),
    BodySpec("parametric_mpv", "Car", 4.00, 1.68, 1.64, 2.62, 0.76, 0.31, 0.19, 0.80,
             0.86, 0.97, 1.78, 3.60, 3.92, 0.95, (2.20, 3.02), 3.74, 0.80),
    BodySpec("parametric_suv", "Car", 4.10, 1.74, 1.70, 2.55, 0.78, 0.35, 0.27, 0.92,
             1.10, 1.06, 1.80, 3.60, 3.98, 1.04, (2.24, 3.04), 3.76, 0.80),
    BodySpec("parametric_van", "Van", 4.95, 1.92, 2.10, 3.00, 0.90, 0.33, 0.22, 0.98,
             0.72, 1.14, 1.62, 4.82, 4.92, 1.12, (1.98,), 2.60, 0.86, False),
    BodySpec("parametric_truck", "Truck", 7.20, 2.42, 3.05, 4.10, 1.10, 0.42, 0.42, 1.05,
             0.16, 1.45, 0.48, 1.80, 1.86, 1.40, (), 1.50, 0.92, False, (2.02, 3.05)),
)  # fmt: skip


class _Skin:
    """Collects patches of quads as triangles with a surface class and an opacity."""

    def __init__(self) -> None:
        self.corners: list[F64] = []
        self.surface: list[F64] = []

    def patch(self, grid: F64, surface: object) -> None:
        """A grid (M, N, 3) of points; `surface` is one class, or (M - 1, N - 1) of them."""
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        kinds = np.broadcast_to(np.asarray(surface, dtype=np.float64), a.shape[:2]).reshape(-1)
        self.corners.append(np.stack([a, b, c], axis=2).reshape(-1, 3, 3))
        self.corners.append(np.stack([a, c, d], axis=2).reshape(-1, 3, 3))
        self.surface += [kinds, kinds]

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], surface: int) -> None:
        """A closed cuboid between two corners."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        corner = np.array([[x, y, z] for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])
        for i, j, k, m in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)):
            self.patch(np.array([[corner[i], corner[j]], [corner[m], corner[k]]]), surface)


class _Shape:
    """The outlines of a body: lower edge, belt, roof line and half width over x (car's middle at 0) and z."""

    def __init__(self, spec: BodySpec) -> None:
        self.spec = spec
        self.nose_x = spec.length_m / 2.0
        self.end_x = self.nose_x - (spec.length_m if spec.box_m is None else spec.box_m[0] - 0.12)
        self.half_m = spec.width_m / 2.0 - 0.05  # the mirrors stand 5 cm out on either side
        self.front_x = self.nose_x - spec.front_axle_m
        self.rear_x = self.front_x - spec.wheelbase_m
        self.arch_m = spec.tyre_radius_m + 0.055
        self.tyre_width_m = 0.62 * spec.tyre_radius_m

    def x(self, from_nose_m: float) -> float:
        return self.nose_x - from_nose_m

    def belt(self, x: F64) -> F64:
        """Upper edge of the body's sides."""
        s = self.spec
        knots = [(0.0, s.nose_m), (0.06, s.nose_m + 0.03), (s.cowl_m, s.belt_m), (s.back_base_m, s.deck_m)]
        knots.append((self.nose_x - self.end_x, s.deck_m - 0.04))
        return _piecewise(self.nose_x - x, knots)

    def roof(self, x: F64) -> F64:
        """Upper edge of the cabin; the belt where there is none."""
        s = self.spec
        middle = (s.screen_top_m + s.roof_end_m) / 2.0
        top = s.height_m - (0.0 if s.box_m is None else s.height_m - 2.45)
        knots = [(s.cowl_m, s.belt_m), (s.screen_top_m, top - 0.05), (middle, top - 0.02)]
        knots += [(s.roof_end_m, top - 0.07), (s.back_base_m, s.deck_m)]
        line = _piecewise(self.nose_x - x, knots)
        inside = (x <= self.x(s.cowl_m)) & (x >= self.x(s.back_base_m))
        return np.where(inside, np.maximum(line, self.belt(x)), self.belt(x))

    def half_width(self, x: F64, z: F64) -> F64:
        """Half width: narrower towards nose and tail, at the sill, and above the belt up to the roof."""
        s = self.spec
        to_end = np.minimum(self.nose_x - x, (x - self.end_x) + (0.0 if s.box_m is None else 9.0))
        ends = 1.0 - 0.16 * sm.power(np.clip(1.0 - to_end / 0.6, 0.0, 1.0), 2.5)
        low = np.clip((s.belt_m * 0.72 - z) / (s.belt_m * 0.72 - s.sill_m), 0.0, 1.0)
        shoulder = np.clip((z - s.belt_m * 0.72) / (s.belt_m * 0.28), 0.0, 1.0)
        top = s.height_m if s.box_m is None else 2.45
        high = np.clip((z - s.belt_m) / (top - s.belt_m), 0.0, 1.0)
        side = 1.0 - 0.05 * low**2 - 0.035 * shoulder**2 - (0.965 - s.roof_share) * high
        return np.asarray(self.half_m * ends * side)

    def lower(self, x: F64) -> F64:
        """Lower edge of the sides, arches cut out."""
        edge = np.full(len(x), self.spec.sill_m)
        edge += 0.06 * np.clip(1.0 - np.minimum(self.nose_x - x, x - self.end_x) / 0.35, 0.0, 1.0)
        for axle in (self.front_x, self.rear_x):
            inside = self.arch_m**2 - (x - axle) ** 2
            arch = self.spec.tyre_radius_m + np.sqrt(np.maximum(inside, 0.0))
            edge = np.where(inside > 0.0, np.maximum(edge, arch), edge)
        return edge


def _piecewise(at: F64, knots: list[tuple[float, float]]) -> F64:
    return np.interp(at, [k[0] for k in knots], [k[1] for k in knots])


@lru_cache(maxsize=1)
def parametric_cars() -> tuple[CarModel, ...]:
    """Car models made in code, sorted by name: eight of category Car, a Van and a Truck; the same on every call."""
    return tuple(sorted((build_car(spec) for spec in BODIES), key=lambda m: m.name))


def build_car(spec: BodySpec) -> CarModel:
    """The mesh of one body: shell with arches, panes, lamps, seats, floor, underside and four wheels."""
    shape, skin = _Shape(spec), _Skin()
    stations = _stations(shape)
    _add_sides(skin, shape, stations)
    _add_cabin_sides(skin, shape, stations)
    _add_top(skin, shape, stations)
    _add_ends(skin, shape)
    _add_underside(skin, shape, stations)
    _add_inside(skin, shape)
    _add_mirrors(skin, shape)
    if spec.box_m is not None:
        _add_load_box(skin, shape)
    for axle in (shape.front_x, shape.rear_x):
        for side in (1.0, -1.0):
            _add_wheel(skin, shape, axle, side)
    corners = np.concatenate(skin.corners)
    # patch() appends the classes of both halves of its quads in the order of the corners
    surface = np.concatenate(skin.surface).astype(np.uint8)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.sqrt((area * area).sum(axis=1)) > 2e-7
    corners, surface = corners[kept], surface[kept]
    # the outline was drawn for these measures; the last per cent comes from scaling to the stated box
    points = corners.reshape(-1, 3)
    size = points.max(axis=0) - points.min(axis=0)
    factor = np.array([spec.length_m, spec.width_m, spec.height_m]) / size
    floor = points[:, 2].min()
    points = (points - [0.0, 0.0, floor]) * factor
    return finished_model(
        spec.name,
        spec.category,
        points,
        np.arange(len(points)).reshape(-1, 3),
        surface,
        np.where(surface == GLASS, np.float32(PANE_OPACITY), np.float32(1.0)),
        wheelbase_m=spec.wheelbase_m * float(factor[0]),
        rear_axle_x_m=shape.rear_x * float(factor[0]),
    )


def _stations(shape: _Shape) -> F64:
    """x of the cross sections, from nose to tail: even, closer over the arches, and at every edge of a pane."""
    s = shape.spec
    x = [np.linspace(shape.nose_x, shape.end_x, max(int((shape.nose_x - shape.end_x) / 0.09), 12))]
    for axle in (shape.front_x, shape.rear_x):
        x.append(axle + shape.arch_m * sm.cos(np.linspace(0.0, np.pi, 19)))
    edges = [s.cowl_m, s.cowl_m + 0.05, s.screen_top_m, s.screen_top_m - 0.05, s.roof_end_m, s.back_base_m]
    edges += [s.roof_end_m + 0.04, s.back_base_m - 0.04, s.side_glass_end_m, _first_pane(s), s.belt_m * 0 + s.cowl_m]
    edges += [p + d for p in s.pillars_m for d in (-0.045, 0.045)]
    x.append(shape.nose_x - np.array(edges))
    every = np.round(np.concatenate(x), 6)
    every = np.unique(every[(every <= shape.nose_x) & (every >= shape.end_x)])[::-1]
    return np.asarray(every)


def _first_pane(spec: BodySpec) -> float:
    """Where the front side window starts, from the nose: 30 cm behind the windscreen's foot, or halfway up it."""
    return spec.cowl_m + min(0.3, 0.45 * (spec.screen_top_m - spec.cowl_m))


def _mirrored(skin: _Skin, grid: F64, surface: object) -> None:
    skin.patch(grid, surface)
    skin.patch(grid * np.array([1.0, -1.0, 1.0]), surface)


def _between(shape: _Shape, x: F64, low: F64, high: F64, share: F64) -> F64:
    """Grid (X, S, 3) of the left side at given shares of the height between two edges."""
    z = low[:, None] + (high - low)[:, None] * share[None, :]
    xx = np.broadcast_to(x[:, None], z.shape)
    return np.stack([xx, shape.half_width(xx, z), z], axis=2)


def _add_sides(skin: _Skin, shape: _Shape, x: F64) -> None:
    low, high = shape.lower(x), shape.belt(x)
    _mirrored(skin, _between(shape, x, np.minimum(low, high - 0.02), high, np.linspace(0.0, 1.0, 8)), PAINT)


def _add_cabin_sides(skin: _Skin, shape: _Shape, stations: F64) -> None:
    s = shape.spec
    x = stations[(stations <= shape.x(s.cowl_m) + 1e-6) & (stations >= shape.x(s.back_base_m) - 1e-6)]
    share = np.array([0.0, 0.06, 0.3, 0.6, 0.86, 1.0])
    grid = _between(shape, x, shape.belt(x), shape.roof(x), share)
    from_nose = shape.nose_x - (x[:-1] + x[1:]) / 2.0
    pane = (from_nose > _first_pane(s)) & (from_nose < s.side_glass_end_m)
    for pillar in s.pillars_m:
        pane &= np.abs(from_nose - pillar) > 0.045
    middle = (share[:-1] + share[1:]) / 2.0
    glass = pane[:, None] & ((middle > 0.06) & (middle < 0.86))[None, :]
    _mirrored(skin, grid, np.where(glass, GLASS, PAINT))


def _add_top(skin: _Skin, shape: _Shape, x: F64) -> None:
    """Bonnet, windscreen, roof, rear window and deck: one skin across the car."""
    s = shape.spec
    across = np.array([-1.0, -0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9, 1.0])
    z = np.maximum(shape.roof(x), shape.belt(x))
    half = shape.half_width(x, z)
    crown = 0.03 * (1.0 - across**2)
    xx = np.broadcast_to(x[:, None], (len(x), len(across)))
    grid = np.stack([xx, half[:, None] * across[None, :], z[:, None] + crown[None, :]], axis=2)
    from_nose = shape.nose_x - (x[:-1] + x[1:]) / 2.0
    screen = (from_nose > s.cowl_m + 0.05) & (from_nose < s.screen_top_m - 0.05)
    back = (from_nose > s.roof_end_m + 0.04) & (from_nose < s.back_base_m - 0.04)
    middle = np.abs((across[:-1] + across[1:]) / 2.0) < 0.9
    glass = (screen | back)[:, None] & middle[None, :]
    skin.patch(grid, np.where(glass, GLASS, PAINT))


def _add_ends(skin: _Skin, shape: _Shape) -> None:
    """Front and rear faces with lamps, grille and bumpers."""
    s = shape.spec
    across = np.array([-1.0, -0.9, -0.58, -0.3, 0.0, 0.3, 0.58, 0.9, 1.0])
    column = np.abs((across[:-1] + across[1:]) / 2.0)
    for x, front in ((shape.nose_x, True), (shape.end_x, False)):
        edge = np.array([x])
        low, high = float(shape.lower(edge)[0]), float(shape.belt(edge)[0])
        share = np.array([0.0, 0.3, 0.55, 0.62, 0.92, 1.0])
        z = low + (high - low) * share
        half = shape.half_width(np.full(len(z), x), z)
        crown = 0.03 * (1.0 - across**2)[None, :] * (share == 1.0)[:, None]
        zz = z[:, None] + crown
        grid = np.stack([np.full(zz.shape, x), half[:, None] * across[None, :], zz], axis=2)
        kinds = np.full((len(z) - 1, len(across) - 1), PAINT)
        kinds[3, (column > 0.58) & (column < 0.9)] = LAMP
        if front:
            kinds[1:4, column < 0.3] = OTHER  # grille
        else:
            kinds[1, column < 0.3] = OTHER  # number plate
        if s.box_m is not None and not front:
            kinds[:] = PAINT
        skin.patch(grid, kinds)


def _add_underside(skin: _Skin, shape: _Shape, x: F64) -> None:
    """Floor pan, narrow between the wheels, and the wheel housings."""
    s = shape.spec
    inner = shape.half_m - shape.tyre_width_m - 0.08
    in_arch = np.minimum(np.abs(x - shape.front_x), np.abs(x - shape.rear_x)) <= shape.arch_m + 1e-6
    half = np.where(in_arch, inner, shape.half_width(x, np.full(len(x), s.sill_m)))
    z = np.full(len(x), s.sill_m) + 0.06 * np.clip(1.0 - np.minimum(shape.nose_x - x, x - shape.end_x) / 0.35, 0.0, 1.0)
    across = np.array([-1.0, 0.0, 1.0])
    xx = np.broadcast_to(x[:, None], (len(x), 3))
    skin.patch(np.stack([xx, half[:, None] * across, np.broadcast_to(z[:, None], xx.shape)], axis=2), OTHER)
    angle = np.linspace(0.0, np.pi, 17)
    for axle in (shape.front_x, shape.rear_x):
        if axle < shape.end_x:
            continue
        wx, wz = axle + shape.arch_m * sm.cos(angle), s.tyre_radius_m + shape.arch_m * sm.sin(angle)
        outer = shape.half_width(wx, wz)
        housing = np.stack([np.stack([wx, y, wz], axis=1) for y in (outer, np.full(len(wx), inner))], axis=1)
        _mirrored(skin, housing, OTHER)
        hub = np.stack([np.full(len(wx), axle), np.full(len(wx), inner), np.full(len(wx), s.sill_m)], axis=1)
        _mirrored(skin, np.stack([housing[:, 1], hub], axis=1), OTHER)


def _add_inside(skin: _Skin, shape: _Shape) -> None:
    """Floor, dashboard, seats and the wall behind them."""
    s = shape.spec
    floor = s.sill_m + 0.06
    half = 0.86 * shape.half_m
    cowl, back = shape.x(s.cowl_m), shape.x(s.back_base_m)
    cabin_end = max(back + 0.15, shape.end_x + 0.1)
    inner = shape.half_m - shape.tyre_width_m - 0.08  # between the wheel housings
    skin.patch(_sheet(cowl + 0.1, cabin_end, inner, floor), OTHER)
    skin.box((cowl - 0.32, -half, s.belt_m - 0.32), (cowl + 0.02, half, s.belt_m - 0.04), OTHER)  # dashboard
    skin.patch(_wall(cowl + 0.05, inner, floor, s.belt_m - 0.04), OTHER)
    seat = floor + (0.12 if s.height_m < 1.6 else 0.24)
    front = shape.x(s.screen_top_m) - (0.32 if s.box_m is None else 0.0)
    rows = [(front, 2)] + ([(front - 0.82, 3)] if s.rear_seats else [])
    for x, count in rows:
        if x - 0.6 < cabin_end:
            continue
        room = 2.0 * (half if count == 2 else inner) / count  # the rear bench sits between the wheels
        wide = 0.86 * room
        for i in range(count):
            y = (i - (count - 1) / 2.0) * room
            skin.box((x - 0.48, y - wide / 2, seat), (x, y + wide / 2, seat + 0.16), OTHER)
            skin.box((x - 0.6, y - wide / 2, seat + 0.05), (x - 0.46, y + wide / 2, seat + 0.62), OTHER)
            skin.box((x - 0.58, y - 0.13, seat + 0.65), (x - 0.48, y + 0.13, seat + 0.82), OTHER)
    skin.patch(_wall(cabin_end, inner, floor, float(shape.belt(np.array([cabin_end]))[0]) - 0.05), OTHER)
    wheel_x, wheel_y, wheel_z = cowl - 0.42, half * 0.5, s.belt_m - 0.12
    ring = np.linspace(0.0, 2.0 * np.pi, 13)
    rims = [np.stack([wheel_x - 0.3 * r * sm.sin(ring), wheel_y + r * sm.cos(ring), wheel_z + r * sm.sin(ring)], 1)
            for r in (0.15, 0.18)]  # fmt: skip
    skin.patch(np.stack(rims, axis=1), OTHER)


def _sheet(x0: float, x1: float, half: float, z: float) -> F64:
    return np.array([[[x0, -half, z], [x0, half, z]], [[x1, -half, z], [x1, half, z]]])


def _wall(x: float, half: float, z0: float, z1: float) -> F64:
    return np.array([[[x, -half, z0], [x, half, z0]], [[x, -half, z1], [x, half, z1]]])


def _add_mirrors(skin: _Skin, shape: _Shape) -> None:
    s = shape.spec
    x = shape.x(_first_pane(s))
    foot = 0.93 * float(shape.half_width(np.array([x]), np.array([s.belt_m]))[0])
    outer = s.width_m / 2.0
    for side in (1.0, -1.0):
        y = sorted((side * foot, side * outer))
        skin.box((x - 0.06, y[0], s.belt_m + 0.03), (x + 0.05, y[1], s.belt_m + 0.16), PAINT)


def _add_load_box(skin: _Skin, shape: _Shape) -> None:
    s = shape.spec
    start, top = s.box_m or (0.0, 0.0)
    half = s.width_m / 2.0 - 0.02
    tail = shape.nose_x - s.length_m
    skin.box((tail, -half, 0.98), (shape.x(start), half, top), PAINT)
    for side in (1.0, -1.0):
        y = sorted((side * 0.34, side * 0.46))
        skin.box((tail + 0.05, y[0], 0.62), (shape.end_x + 0.1, y[1], 0.98), OTHER)  # frame
    skin.box((tail + 0.02, -half * 0.9, 0.5), (tail + 0.1, half * 0.9, 0.62), OTHER)
    for side in (1.0, -1.0):
        y = sorted((side * half * 0.6, side * half * 0.9))
        skin.box((tail, y[0], 0.66), (tail + 0.06, y[1], 0.8), LAMP)


def _add_wheel(skin: _Skin, shape: _Shape, axle: float, side: float) -> None:
    """A tyre with rounded shoulders and a dished rim, turned about its axle."""
    radius, width = shape.spec.tyre_radius_m, shape.tyre_width_m
    height = np.array([radius])
    out = float(shape.half_width(np.array([axle]), height)[0]) - 0.02
    if shape.spec.box_m is not None:
        out = min(out, shape.half_m - 0.06)
    rim = 0.64 * radius
    # (radius, distance from the outer face) of the turned outline, and the class between two of its points
    outline = [
        (0.0, 0.05),
        (0.3 * rim, 0.03),
        (0.92 * rim, 0.05),
        (rim, 0.012),
        (0.93 * radius, 0.0),
        (radius, 0.12 * width),
    ]
    outline += [(radius, 0.88 * width), (0.93 * radius, width), (rim, width), (0.0, width)]
    kinds = np.array([OTHER, OTHER, OTHER, TYRE, TYRE, TYRE, TYRE, TYRE, OTHER])
    angle = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS + 1) + np.pi / 2.0 * 3.0  # a vertex at the lowest point
    r = np.array([o[0] for o in outline])
    y = side * (out - np.array([o[1] for o in outline]))
    grid = np.stack(
        [
            axle + r[None, :] * sm.cos(angle)[:, None],
            np.broadcast_to(y[None, :], (len(angle), len(r))),
            radius + r[None, :] * sm.sin(angle)[:, None],
        ],
        axis=2,
    )
    skin.patch(grid, np.broadcast_to(kinds, (len(angle) - 1, len(kinds))))
