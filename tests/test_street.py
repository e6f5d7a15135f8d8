"""Procedural streets: ground, paths, things and bodies hold together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.frames import is_rigid, points_in_box
from augkitti.raycast import MeshCaster
from augkitti.seeds import generator
from augkitti.street import (
    EGO_SIZE_M,
    Street,
    body_poses,
    build_street,
    ground_class,
    ground_mesh,
    make_track,
    scanner_poses,
    surface_height,
    track_poses,
    world_points,
)
from augkitti.street_objects import (
    ASPHALT,
    GRASS,
    KERB,
    LEAF,
    PAVEMENT,
    cyclist_model,
    fence,
    hedge,
    house,
    pedestrian_model,
    tree,
)

DURATION_S = 1.0


@pytest.fixture(scope="module")
def streets() -> list[Street]:
    return [build_street(generator(5, "street", i), DURATION_S, i) for i in range(5)]


def test_same_seed_same_street_and_another_seed_another(streets):
    again = build_street(generator(5, "street", 0), DURATION_S, 0)
    assert np.array_equal(again.still.vertices, streets[0].still.vertices)
    assert again.shape.half_m != streets[1].shape.half_m


def test_net_of_the_ground_lies_on_the_exact_height(streets):
    for street in streets:
        mesh = ground_mesh(street.shape)
        caster = MeshCaster(mesh.vertices, mesh.faces)
        rng = np.random.default_rng(0)
        s, n = rng.uniform(-60.0, 60.0, 4000), rng.uniform(-25.0, 25.0, 4000)
        target = world_points(street.shape, s, n)
        start = target + [0.0, 0.0, 30.0]
        face, reach, _ = caster.first_hit(start, np.tile([0.0, 0.0, -1.0], (len(s), 1)))
        assert (face >= 0).all()
        error = np.abs(start[:, 2] - reach - target[:, 2])
        paved = np.isin(mesh.material[face], (ASPHALT, PAVEMENT))
        assert np.median(error[paved]) < 5e-4
        assert np.median(error) < 0.01  # gardens are uneven between the net's lines
        assert (error[paved] > 0.01).mean() < 0.06  # kerb faces, lowered kerbs
        carriageway = (n < street.shape.half_m[0]) & (n > -street.shape.half_m[1])
        assert error[carriageway].max() < 0.004
        agree = mesh.material[face] == ground_class(street.shape, s, n)
        assert agree.mean() > 0.95


def test_net_has_no_folded_triangles(streets):
    for street in streets:
        mesh = ground_mesh(street.shape)
        a, b, c = (mesh.vertices[mesh.faces[:, i], :2] for i in range(3))
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        assert (area > -1e-9).all() or (area < 1e-9).all()


def test_road_is_crowned_and_the_pavement_stands_a_kerb_above_it(streets):
    for street in streets:
        shape = street.shape
        s = np.array([-70.0])
        middle, edge = surface_height(shape, s, np.zeros(1)), surface_height(shape, s, np.array([-shape.half_m[1]]))
        assert middle - edge == pytest.approx(shape.crown * shape.half_m[1])
        for sign, half, ways in (
            (1.0, shape.half_m[0], shape.driveways_m[0]),
            (-1.0, shape.half_m[1], shape.driveways_m[1]),
        ):
            along = np.arange(-80.0, 60.0, 0.5)
            clear = np.array([all(abs(a - w) > 4 for w in ways) for a in along])
            clear &= np.array([all(abs(a - c.s_m) > c.half_width_m + 6 for c in shape.crossings) for a in along])
            at = along[clear]
            step = surface_height(shape, at, np.full(len(at), sign * (half + 0.04)))
            step = step - surface_height(shape, at, np.full(len(at), sign * half))
            assert 0.08 <= shape.kerb_m <= 0.15
            assert np.abs(step - shape.kerb_m).max() < 0.003


def test_every_kind_of_ground_is_there(streets):
    for street in streets:
        assert {ASPHALT, PAVEMENT, KERB, GRASS} <= set(np.unique(street.still.material))


def test_scanner_stands_where_kittis_does_above_the_road(streets):
    for street in streets:
        mesh = ground_mesh(street.shape)
        caster = MeshCaster(mesh.vertices, mesh.faces)
        T = scanner_poses(street, np.linspace(0.0, DURATION_S, 5))
        down = -T[:, :3, 2]
        face, reach, _ = caster.first_hit(T[:, :3, 3], down)
        assert (mesh.material[face] == ASPHALT).all()
        assert (np.abs(reach - 1.73) < 0.06).all()
        assert all(is_rigid(pose) for pose in T)


def test_ego_car_drives_as_its_pace_says(streets):
    speeds = []
    for street in streets:
        T = scanner_poses(street, np.array([0.0, DURATION_S]))
        speeds.append(float(np.linalg.norm(T[1, :3, 3] - T[0, :3, 3])) / DURATION_S)
    assert speeds[4] == 0.0
    assert speeds[1] > speeds[0] > speeds[2] > 0.0


def test_bodies_stand_on_the_ground_and_touch_neither_each_other_nor_the_ego_car(streets):
    for street in streets:
        mesh = ground_mesh(street.shape)
        caster = MeshCaster(mesh.vertices, mesh.faces)
        ego = track_poses(street.ego, np.array(0.5))
        middle = ego.copy()
        middle[:3, 3] += ego[:3, :3] @ [1.4, 0.0, 0.8]
        poses = [body_poses(body, np.array(0.5)) for body in street.bodies]
        for body, T in zip(street.bodies, poses, strict=True):
            foot = T[:3, 3] - 0.5 * body.model.size_m[2] * T[:3, 2]
            face, reach, _ = caster.first_hit((foot + 3.0 * T[:3, 2])[None], -T[None, :3, 2])
            assert face[0] >= 0
            assert abs(reach[0] - 3.0) < 0.16  # on a kerb, half of it
            assert not points_in_box(T[None, :3, 3], middle, np.array(EGO_SIZE_M)).any()
            for other, T_other in zip(street.bodies, poses, strict=True):
                if other is not body:
                    assert not points_in_box(T[None, :3, 3], T_other, other.model.size_m).any()


def test_streets_hold_parked_and_moving_cars_and_people(streets):
    kinds = {(body.model.category, body.moving) for street in streets for body in street.bodies}
    assert {("Car", True), ("Car", False), ("Pedestrian", True)} <= kinds


@settings(max_examples=20, deadline=None)
@given(radius=st.floats(4.0, 10.0), side=st.sampled_from([-1.0, 1.0]), speed=st.floats(1.0, 10.0))
def test_turning_car_keeps_its_heading_along_its_path(streets, radius, side, speed):
    shape = streets[0].shape
    corners = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, side * 30.0]])
    track = make_track(shape, corners, radius, 2.6, 0.0, speed)
    t = np.linspace(0.5, 0.9 * track.along_m[-1] / speed, 200)
    T = track_poses(track, t)
    step = np.diff(T[:, :2, 3], axis=0)
    assert np.allclose(np.sqrt((step**2).sum(1)), speed * np.diff(t), rtol=0.02)
    heading = T[:-1, :2, 0] + T[1:, :2, 0]
    across = (heading[:, 0] * step[:, 1] - heading[:, 1] * step[:, 0]) / np.sqrt((step**2).sum(1) * (heading**2).sum(1))
    assert np.abs(across).max() < 0.06  # rolls along itself, does not slip aside


@pytest.mark.parametrize("make", [tree, lambda rng: hedge(4.0, rng), lambda rng: fence(4.0, rng)])
def test_plants_and_fences_let_some_rays_through_and_stop_some(make):
    stopped = []
    for k in range(6):
        mesh = make(np.random.default_rng(k))
        caster = MeshCaster(mesh.vertices, mesh.faces)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        x = np.random.default_rng(1).uniform(low[0], high[0], 2000)
        z = np.random.default_rng(2).uniform(max(low[2], 0.0), high[2], 2000)
        start = np.stack([x, np.full(2000, low[1] - 5.0), z], axis=1)
        face, _, _ = caster.first_hit(start, np.tile([0.0, 1.0, 0.0], (2000, 1)))
        stopped.append((face >= 0).mean())
    assert 0.1 < np.mean(stopped) < 0.97


def test_house_walls_are_closed_to_rays_from_outside():
    mesh = house(10.0, 9.0, 2, np.random.default_rng(3))
    caster = MeshCaster(mesh.vertices, mesh.faces)
    turn = np.linspace(0.0, 2.0 * np.pi, 400)
    start = np.stack([5.0 + 20.0 * np.cos(turn), 4.5 + 20.0 * np.sin(turn), np.full(400, 1.3)], axis=1)
    aim = np.array([5.0, 4.5, 1.3]) - start
    face, reach, _ = caster.first_hit(start, aim / np.sqrt((aim**2).sum(1))[:, None])
    assert (face >= 0).all()
    assert (reach > 10.0).all()


def test_people_have_peoples_size():
    for model, low, high in (
        (pedestrian_model(np.random.default_rng(0)), [0.3, 0.4, 1.5], [0.9, 0.8, 1.95]),
        (cyclist_model(np.random.default_rng(0)), [1.5, 0.4, 1.5], [2.0, 0.8, 2.0]),
    ):
        assert (model.size_m >= low).all()
        assert (model.size_m <= high).all()
        assert np.allclose(model.vertices.min(0), -0.5 * model.size_m)


def test_leaves_are_part_of_most_streets(streets):
    assert sum((street.still.material == LEAF).any() for street in streets) >= 4
