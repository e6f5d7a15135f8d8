"""Ray casting, held against a brute-force intersector in float64 and against closed forms."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti import raycast, scanner
from augkitti.frames import invert, pose_from_xyz_yaw, rotate_vectors, se3_exp, transform_points
from augkitti.scan_pair import GLASS, PAINT, CarModel

PROFILE = scanner.load_profile()


def model_of(mesh: trimesh.Trimesh, surface: np.ndarray | int = PAINT) -> CarModel:
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    faces = np.asarray(mesh.faces, dtype=np.int32)
    kinds = np.broadcast_to(np.asarray(surface, dtype=np.uint8), len(faces)).copy()
    size = vertices.max(0) - vertices.min(0)
    return CarModel("test", "Car", vertices, faces, kinds, np.ones(len(faces), np.float32), size, 2.6, -1.3, "0")


def all_hits(model: CarModel, origin: np.ndarray, direction: np.ndarray) -> list[tuple[float, int]]:
    """Every triangle that a line meets ahead, by Moeller and Trumbore in float64: the oracle."""
    a, b, c = (model.vertices[model.faces[:, i]] for i in range(3))
    p = np.cross(direction, c - a)
    det = ((b - a) * p).sum(1)
    safe = np.where(np.abs(det) < 1e-14, 1.0, det)
    u = ((origin - a) * p).sum(1) / safe
    q = np.cross(origin - a, b - a)
    v = (direction * q).sum(1) / safe
    t = ((c - a) * q).sum(1) / safe
    hit = (np.abs(det) >= 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return sorted((float(t[i]), int(i)) for i in np.flatnonzero(hit))


def lumpy_car(seed: int = 3) -> CarModel:
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.vertices *= 1 + 0.2 * rng.random(len(mesh.vertices))[:, None]
    mesh.vertices *= [2.1, 0.9, 0.75]
    return model_of(mesh)


def rays_at(model: CarModel, seed: int, count: int, distance_m: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    target = (rng.random((count, 3)) - 0.5) * model.size_m * 1.05
    origin = away * distance_m
    direction = target - origin
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)


@pytest.mark.parametrize("distance_m", [4.0, 20.0, 78.0])
def test_ranges_equal_the_brute_force_oracle_near_and_far(distance_m: float) -> None:
    model = lumpy_car()
    origin, direction = rays_at(model, 1, 400, distance_m)
    hits = raycast.cast_mesh(model, np.arange(400, dtype=np.int32), origin, direction, opaque_glass=False)
    found = dict(zip(hits.ray.tolist(), hits.range_m[:, 0].tolist(), strict=True))
    differing = 0
    for ray in range(400):
        truth = all_hits(model, origin[ray], direction[ray])
        if bool(truth) != (ray in found):
            differing += 1  # within float32 of a silhouette edge
        elif truth and abs(truth[0][0] - found[ray]) > 1e-5:
            differing += 1
    assert len(found) > 150
    assert differing <= 1


def test_grazing_rays_along_a_box_give_the_range_of_the_side_or_the_end() -> None:
    model = model_of(trimesh.creation.box((4.0, 1.8, 1.5)))
    angle = np.deg2rad(np.array([0.01, 0.1, 0.5, 2.0]))
    direction = np.stack([np.cos(angle), -np.sin(angle), np.zeros(4)], 1)
    origin = np.array([0.0, 0.9, 0.2]) - 6.0 * direction  # meets the left side in its middle
    hits = raycast.cast_mesh(model, np.arange(4, dtype=np.int32), origin, direction, opaque_glass=False)
    np.testing.assert_allclose(hits.range_m[:, 0], 6.0, atol=2e-3)
    np.testing.assert_allclose(hits.cos_incidence[:, 0], np.sin(angle), atol=1e-9)


def test_sphere_agrees_with_the_closed_form() -> None:
    model = model_of(trimesh.creation.icosphere(subdivisions=5))
    origin, direction = rays_at(model, 5, 300, 30.0)
    hits = raycast.cast_mesh(model, np.arange(300, dtype=np.int32), origin, direction, opaque_glass=False)
    o, d = origin[hits.ray], direction[hits.ray]
    b = (o * d).sum(1)
    disc = b**2 - (o * o).sum(1) + 1.0
    well_inside = disc > 0.05
    np.testing.assert_allclose(
        hits.range_m[well_inside, 0], (-b - np.sqrt(np.maximum(disc, 0)))[well_inside], atol=5e-3
    )


def panes_and_seat() -> CarModel:
    """A double-layered pane, a seat behind it, a far pane, a closed box round it all to fix the size."""
    parts = []
    for x in (-1.0, -0.99, 1.0):
        parts.append(
            trimesh.Trimesh([[x, -1, -1], [x, 1, -1], [x, 1, 1], [x, -1, 1]], [[0, 1, 2], [0, 2, 3]], process=False)
        )
    parts.append(
        trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 1, 0], [0, -1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    )
    return model_of(trimesh.util.concatenate(parts), np.array([GLASS] * 6 + [PAINT] * 2))


def test_rays_pass_panes_once_and_end_on_the_seat_or_go_on_to_the_world() -> None:
    model = panes_and_seat()
    origin = np.array([[-5.0, 0.1, -0.5], [-5.0, 0.1, 0.5], [-5.0, 3.0, 0.0]])
    direction = np.tile([1.0, 0.0, 0.0], (3, 1))
    hits = raycast.cast_mesh(model, np.array([7, 8, 9], np.int32), origin, direction, opaque_glass=False)
    np.testing.assert_array_equal(hits.ray, [7, 8])
    np.testing.assert_array_equal(hits.surface[0, :3], [GLASS, PAINT, 0])
    np.testing.assert_array_equal(hits.surface[1, :3], [GLASS, GLASS, 0])
    np.testing.assert_allclose(hits.range_m[0, :2], [4.0, 5.0], atol=1e-6)
    np.testing.assert_allclose(hits.range_m[1, :2], [4.0, 6.0], atol=1e-6)
    closed = raycast.cast_mesh(model, np.array([7, 8, 9], np.int32), origin, direction, opaque_glass=True)
    assert (closed.surface[:, 0] == GLASS).all()
    assert np.isinf(closed.range_m[:, 1:]).all()


@settings(max_examples=10, deadline=None)
@given(st.tuples(*[st.floats(-30.0, 30.0)] * 3, *[st.floats(-1.0, 1.0)] * 3).map(np.array))
def test_moving_scanner_and_car_together_changes_nothing(twist: np.ndarray) -> None:
    model = lumpy_car()
    origin, direction = rays_at(model, 2, 50, 15.0)
    T_world_car = se3_exp(twist)
    T_car_world = invert(T_world_car)
    o = transform_points(T_car_world, transform_points(T_world_car, origin))
    d = rotate_vectors(T_car_world, rotate_vectors(T_world_car, direction))
    ray = np.arange(50, dtype=np.int32)
    here = raycast.cast_mesh(model, ray, origin, direction, False)
    there = raycast.cast_mesh(model, ray, o, d, False)
    shared, i, j = np.intersect1d(here.ray, there.ray, return_indices=True)
    assert len(shared) >= len(here.ray) - 1
    np.testing.assert_allclose(here.range_m[i, 0], there.range_m[j, 0], atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-3.1, 3.1))
def test_no_ray_that_meets_the_car_is_left_out_of_the_candidates(x: float, y: float, yaw: float) -> None:
    if np.hypot(x, y) < 3.0:
        x += 4.0
    model = model_of(trimesh.creation.box((4.2, 1.8, 1.5)))
    T = pose_from_xyz_yaw(x, y, -0.9, yaw)
    rays = scanner.fire_rays(PROFILE, np.arange(0, 4000, 8, dtype=np.uint16), 0.1)
    every = np.arange(len(rays), dtype=np.int32)
    still = np.broadcast_to(invert(T), (len(rays), 4, 4))
    truth = raycast.cast_car(model, still, rays, every, PROFILE, False)
    near = raycast.rays_near(rays, T, model.size_m, 0.05)
    assert np.isin(truth.ray, near).all()
