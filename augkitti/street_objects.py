"""Things that stand in a street: sizes and a random generator in, triangle meshes with a material a face out.

Every mesh is in its own frame: x along the street, y to the left, z up from the ground under it, metres.
"""

from dataclasses import dataclass

import numpy as np

from augkitti import same_math as sm
from augkitti.frames import F64, Array, transform_points
from augkitti.scan_pair import I32, OTHER, TYRE, U8, CarModel

# Materials, in the order of the table in `surface_returns`.
ASPHALT, MARKING, PAVEMENT, KERB, GRASS, BRICK, PLASTER, WINDOW, ROOF, WOOD, LEAF, BARK, METAL, SIGN = range(14)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a material each."""

    vertices: F64  # (V, 3) metres
    faces: I32  # (F, 3)
    material: U8  # (F,)


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh of many."""
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8))
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + first for mesh, first in zip(meshes, start, strict=True)]).astype(np.int32),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def placed(mesh: Mesh, T_a_mesh: F64) -> Mesh:
    """The mesh in frame a."""
    return Mesh(transform_points(T_a_mesh, mesh.vertices), mesh.faces, mesh.material)


def quads(corners: Array, material: int) -> Mesh:
    """Quadrilaterals (Q, 4, 3), corners in order round each."""
    count = len(corners)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return Mesh(
        np.asarray(corners, dtype=np.float64).reshape(-1, 3),
        faces.astype(np.int32),
        np.full(2 * count, material, np.uint8),
    )


def box(low: tuple[float, float, float], high: tuple[float, float, float], material: int) -> Mesh:
    """An upright box between two corners, without its floor."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    sides = [[(*a, z0), (*b, z0), (*b, z1), (*a, z1)] for a, b in zip(ring, ring[1:] + ring[:1], strict=True)]
    return quads(np.array([*sides, [(*p, z1) for p in ring]]), material)


def cylinder(radius_m: float, low_m: float, high_m: float, material: int, sides: int = 8, taper: float = 1.0) -> Mesh:
    """An upright pipe about the z axis; `taper` times as thick at its top."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    rim = np.stack([sm.cos(turn), sm.sin(turn)], axis=1) * radius_m
    low, high = np.insert(rim, 2, low_m, axis=1), np.insert(rim * taper, 2, high_m, axis=1)
    return quads(np.stack([low, np.roll(low, -1, 0), np.roll(high, -1, 0), high], axis=1), material)


def ellipsoid(centre: tuple[float, float, float], half: tuple[float, float, float], material: int) -> Mesh:
    """An ellipsoid of 8 x 12 patches."""
    polar, turn = np.linspace(0.0, np.pi, 9), np.linspace(0.0, 2.0 * np.pi, 13)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    grid = np.stack([sm.sin(p) * sm.cos(t), sm.sin(p) * sm.sin(t), sm.cos(p)], axis=-1) * half + centre
    patches = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    return quads(patches.reshape(-1, 4, 3), material)


def leaves(centres: Array, size_m: float, material: int, rng: np.random.Generator) -> Mesh:
    """One triangle of about `size_m` at each centre (L, 3), turned at random: what rays partly go through."""
    corners = rng.normal(size=(len(centres), 3, 3))
    corners -= corners.mean(axis=1, keepdims=True)
    corners *= (
        size_m * rng.uniform(0.6, 1.3, (len(centres), 1, 1)) / np.sqrt((corners**2).sum(2).mean(1))[:, None, None]
    )
    vertices = (np.asarray(centres)[:, None, :] + corners).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def tree(rng: np.random.Generator) -> Mesh:
    """A trunk and a crown of a few round clusters of leaves; some are young and thin, some tall."""
    height = float(rng.uniform(4.0, 13.0))
    trunk_top = float(rng.uniform(0.25, 0.4)) * height
    parts = [cylinder(0.018 * height + 0.03, -0.3, trunk_top + 1.5, BARK, 7, 0.7)]
    spread = 0.27 * height
    for _ in range(6):
        middle = np.array([*rng.normal(0.0, 0.35 * spread, 2), rng.uniform(trunk_top + 0.8, height - 0.6)])
        count = int(26 * height)
        direction = rng.normal(size=(count, 3))
        direction /= np.sqrt((direction**2).sum(1, keepdims=True))
        reach = rng.uniform(0.45, 1.0, (count, 1)) ** 0.5 * np.array([0.75, 0.75, 0.6]) * spread
        parts.append(leaves(middle + direction * reach, 0.16, LEAF, rng))
        limb = np.array([[0.0, 0.0, trunk_top], [0.06, 0.06, trunk_top], middle + [0.03, 0.03, 0.0], middle])
        parts.append(quads(limb[None], BARK))
    return joined(parts)


def hedge(length_m: float, rng: np.random.Generator) -> Mesh:
    """A clipped hedge along x: leaves on and in its faces, over a darker core."""
    height, thick = float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.5, 1.0))
    count = int(60 * length_m * height)
    spots = rng.uniform([0.0, -0.5 * thick, 0.05], [length_m, 0.5 * thick, height], (count, 3))
    spots[:, 2] *= 1.0 + 0.08 * sm.sin(2.3 * spots[:, 0] + rng.uniform(0.0, 6.0)) + rng.normal(0.0, 0.04, count)
    face = rng.random(count)
    spots[face < 0.4, 1] = -0.5 * thick + rng.normal(0.0, 0.03, int((face < 0.4).sum()))
    spots[face > 0.7, 1] = 0.5 * thick + rng.normal(0.0, 0.03, int((face > 0.7).sum()))
    core = box((0.05, -0.3 * thick, -0.3), (length_m - 0.05, 0.3 * thick, height - 0.15), LEAF)
    return joined([leaves(spots, 0.09, LEAF, rng), core])


def bush(rng: np.random.Generator) -> Mesh:
    """A round shrub."""
    radius, height = float(rng.uniform(0.4, 1.1)), float(rng.uniform(0.6, 1.8))
    direction = rng.normal(size=(int(260 * radius * height) + 40, 3))
    direction /= np.sqrt((direction**2).sum(1, keepdims=True))
    spots = direction * rng.uniform(0.6, 1.0, (len(direction), 1)) * [radius, radius, 0.55 * height]
    return leaves(spots + [0.0, 0.0, 0.5 * height], 0.1, LEAF, rng)


def fence(length_m: float, rng: np.random.Generator) -> Mesh:
    """Pickets with gaps along x, or a low wall."""
    height = float(rng.uniform(0.8, 1.4))
    if rng.random() < 0.4:
        return box((0.0, -0.12, -0.4), (length_m, 0.12, 0.7 * height), BRICK)
    step, wide = float(rng.uniform(0.11, 0.18)), 0.07
    at = np.arange(0.0, length_m - wide, step)
    low, high = 0.05, height
    pickets = [[(x, 0.0, low), (x + wide, 0.0, low), (x + wide, 0.0, high), (x, 0.0, high)] for x in at]
    rails = [
        [(0.0, 0.03, z), (length_m, 0.03, z), (length_m, 0.03, z + 0.08), (0.0, 0.03, z + 0.08)]
        for z in (0.25, height - 0.25)
    ]
    posts = [box((x, 0.0, -0.3), (x + 0.09, 0.09, height + 0.05), WOOD) for x in np.arange(0.0, length_m, 2.4)]
    return joined([quads(np.array(pickets + rails), WOOD), *posts])


def lamp_post(rng: np.random.Generator) -> Mesh:
    """A street lamp; its arm reaches along +y."""
    height = float(rng.uniform(4.5, 8.0))
    return joined(
        [
            cylinder(0.09, -0.2, 1.2, METAL),
            cylinder(0.055, 1.2, height, METAL, 6, 0.7),
            box((-0.06, 0.0, height - 0.08), (0.06, 1.3, height + 0.06), METAL),
        ]
    )


def sign_post(rng: np.random.Generator) -> Mesh:
    """A traffic sign facing along the street."""
    height, half = float(rng.uniform(2.1, 2.8)), float(rng.uniform(0.25, 0.4))
    turn = 2.0 * np.pi * np.arange(4) / 4 + (np.pi / 4 if rng.random() < 0.5 else 0.0)
    plate = np.stack([np.full(4, 0.05), half * sm.cos(turn), height + half * sm.sin(turn)], axis=1)
    return joined([cylinder(0.035, -0.2, height + half, METAL, 6), quads(plate[None], SIGN)])


def bin_or_bollard(rng: np.random.Generator) -> Mesh:
    """A waste bin or a bollard."""
    if rng.random() < 0.5:
        return cylinder(0.06, -0.1, 0.9, METAL, 6)
    return box((-0.28, -0.3, -0.05), (0.28, 0.3, 1.05), METAL)


def house(width_m: float, depth_m: float, floors: int, rng: np.random.Generator) -> Mesh:
    """A house with its front on y = 0, body towards +y: windows set into the walls, a door, a gable or flat roof."""
    wall = BRICK if rng.random() < 0.4 else PLASTER
    floor_m = float(rng.uniform(2.7, 3.1))
    height, base = floors * floor_m + 0.4, -1.5
    parts = [
        _facade(width_m, floors, floor_m, base, height, wall, rng),
        _turned(_facade(width_m, floors, floor_m, base, height, wall, rng), np.pi, (width_m, depth_m)),
        _turned(_facade(depth_m, floors, floor_m, base, height, wall, rng), np.pi / 2, (width_m, 0.0)),
        _turned(_facade(depth_m, floors, floor_m, base, height, wall, rng), -np.pi / 2, (0.0, depth_m)),
    ]
    if rng.random() < 0.8:
        ridge = height + float(rng.uniform(0.35, 0.5)) * depth_m
        over, eave = 0.4, height - 0.15
        x0, x1, y0, y1, ym = -over, width_m + over, -over, depth_m + over, 0.5 * depth_m
        slopes = [
            [(x0, y0, eave), (x1, y0, eave), (x1, ym, ridge), (x0, ym, ridge)],
            [(x1, y1, eave), (x0, y1, eave), (x0, ym, ridge), (x1, ym, ridge)],
        ]
        gables = [
            [(x, 0.0, height), (x, depth_m, height), (x, ym, ridge - 0.2), (x, ym, ridge - 0.2)] for x in (0.0, width_m)
        ]
        parts += [quads(np.array(slopes), ROOF), quads(np.array(gables), wall)]
    else:
        parts.append(box((-0.2, -0.2, height), (width_m + 0.2, depth_m + 0.2, height + 0.5), wall))
    return joined(parts)


def garage(rng: np.random.Generator) -> Mesh:
    """A flat garage with a metal door on y = 0."""
    width, depth, height = float(rng.uniform(2.9, 5.5)), 5.8, float(rng.uniform(2.4, 2.8))
    door = [(0.3, -0.01, 0.0), (width - 0.3, -0.01, 0.0), (width - 0.3, -0.01, 2.1), (0.3, -0.01, 2.1)]
    return joined([box((0.0, 0.0, -1.0), (width, depth, height), PLASTER), quads(np.array([door]), METAL)])


def pedestrian_model(rng: np.random.Generator) -> CarModel:
    """Somebody on foot: head, trunk, arms and legs as ellipsoids, in a `CarModel` so that one caster serves all."""
    tall, stride = float(rng.uniform(1.55, 1.9)), float(rng.uniform(0.1, 0.25))
    parts = [
        ellipsoid((0.0, 0.0, 0.93 * tall), (0.1, 0.09, 0.07 * tall), WOOD),
        ellipsoid((0.0, 0.0, 0.67 * tall), (0.13, 0.2, 0.2 * tall), WOOD),
        ellipsoid((0.06, 0.24, 0.62 * tall), (0.08, 0.06, 0.19 * tall), WOOD),
        ellipsoid((-0.06, -0.24, 0.62 * tall), (0.08, 0.06, 0.19 * tall), WOOD),
        ellipsoid((stride, 0.09, 0.25 * tall), (0.11, 0.08, 0.25 * tall), WOOD),
        ellipsoid((-stride, -0.09, 0.25 * tall), (0.11, 0.08, 0.25 * tall), WOOD),
    ]
    return _as_model("pedestrian", "Pedestrian", joined(parts))


def cyclist_model(rng: np.random.Generator) -> CarModel:
    """Somebody on a bicycle."""
    lean = float(rng.uniform(0.1, 0.3))
    wheel = np.stack([sm.cos(np.linspace(0, 2 * np.pi, 15)), sm.sin(np.linspace(0, 2 * np.pi, 15))], axis=1)
    parts = [
        ellipsoid((0.15 + lean, 0.0, 1.68), (0.11, 0.1, 0.13), WOOD),
        ellipsoid((0.0, 0.0, 1.27), (0.16 + lean, 0.21, 0.3), WOOD),
        ellipsoid((0.1, 0.12, 0.75), (0.16, 0.08, 0.4), WOOD),
        ellipsoid((0.0, -0.12, 0.65), (0.12, 0.08, 0.42), WOOD),
        box((-0.5, -0.03, 0.5), (0.5, 0.03, 0.62), METAL),
        box((0.38, -0.28, 0.95), (0.46, 0.28, 1.02), METAL),
    ]
    for x in (-0.52, 0.52):
        rim = np.stack([x + 0.34 * wheel[:, 0], np.zeros(15), 0.34 + 0.34 * wheel[:, 1]], axis=1)
        hub = np.stack([x + 0.27 * wheel[:, 0], np.zeros(15), 0.34 + 0.27 * wheel[:, 1]], axis=1)
        parts.append(quads(np.stack([rim[:-1], rim[1:], hub[1:], hub[:-1]], axis=1), BARK))
    return _as_model("cyclist", "Cyclist", joined(parts))


def _as_model(name: str, category: str, mesh: Mesh) -> CarModel:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    vertices = mesh.vertices - 0.5 * (low + high)
    return CarModel(
        name=name,
        category=category,
        vertices=vertices,
        faces=mesh.faces,
        surface=np.where(mesh.material == BARK, TYRE, OTHER).astype(np.uint8),
        opacity=np.ones(len(mesh.faces), dtype=np.float32),
        size_m=high - low,
        wheelbase_m=0.5,
        rear_axle_x_m=-0.25,
        digest=name,
    )


def _turned(mesh: Mesh, yaw_rad: float, to: tuple[float, float]) -> Mesh:
    c, s = sm.cos(yaw_rad), sm.sin(yaw_rad)
    return placed(mesh, np.array([[c, -s, 0, to[0]], [s, c, 0, to[1]], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64))


def _facade(
    width_m: float, floors: int, floor_m: float, base_m: float, top_m: float, wall: int, rng: np.random.Generator
) -> Mesh:
    """A wall in the plane y = 0 over x in 0 to width, with windows set back by a hand's breadth."""
    columns = max(1, int((width_m - 0.8) / rng.uniform(2.2, 3.4)))
    pitch = width_m / columns
    wide, tall, deep = min(1.3, 0.55 * pitch), float(rng.uniform(1.2, 1.5)), float(rng.uniform(0.08, 0.2))
    door = int(rng.integers(columns))
    walls: list[list[tuple[float, float, float]]] = []
    panes: list[list[tuple[float, float, float]]] = []

    def upright(x0: float, x1: float, z0: float, z1: float, y: float = 0.0) -> list[tuple[float, float, float]]:
        return [(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)]

    for column in range(columns):
        left = column * pitch
        a, b = left + 0.5 * (pitch - wide), left + 0.5 * (pitch + wide)
        walls += [upright(left, a, base_m, top_m), upright(b, left + pitch, base_m, top_m)]
        below = base_m
        for floor in range(floors):
            is_door = floor == 0 and column == door
            z0 = 0.15 if is_door else 0.4 + floor * floor_m + 0.8
            z1 = 2.25 if is_door else z0 + tall
            walls.append(upright(a, b, below, z0))
            (walls if is_door else panes).append(upright(a, b, z0, z1, deep))
            for x in (a, b):
                walls.append([(x, 0.0, z0), (x, deep, z0), (x, deep, z1), (x, 0.0, z1)])
            for z in (z0, z1):
                walls.append([(a, 0.0, z), (b, 0.0, z), (b, deep, z), (a, deep, z)])
            below = z1
        walls.append(upright(a, b, below, top_m))
    return joined([quads(np.array(walls), wall), quads(np.array(panes).reshape(-1, 4, 3), WINDOW)])
