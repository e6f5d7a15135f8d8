"""Matched vertices to motions, and pairs of scans to what Dewan et al. say of them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scored_pair import an_object, make_pair

from augkitti.frames import pose_from_xyz_yaw, rigid, transform_points
from training.baselines.dewan import (
    PLAIN,
    best_matches,
    cell_means,
    dewan,
    dewan_strong,
    fit_normals,
    neighbours_of,
    scene_flow_of,
)
from training.baselines.followed import true_boxes
from training.baselines.rigid_scene_flow import (
    Energy,
    MotionGraph,
    Motions,
    _normal_equations,
    _Pattern,
    _stepped,
    energy_of,
    rotations_of,
    solve_motions,
    standing,
)
from training.metrics import rotation_error, translation_error

seeds = st.integers(0, 2**32)
METHODS = {"dewan": dewan, "dewan_strong": dewan_strong}


def a_box(rng, count, size=(4.2, 1.8, 1.5)):
    """Points on the surface of a box about the origin, without its underside."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 5, count)
    points[np.arange(count), np.array([0, 0, 1, 1, 2])[side]] = np.array([-0.5, 0.5, -0.5, 0.5, 0.5])[side]
    return points * size


def a_corner(rng, count):
    """Points on two walls at right angles, 6 m long and 3 m high."""
    along, up = rng.uniform(0.0, 6.0, count), rng.uniform(0.0, 3.0, count)
    first = np.arange(count) % 2 == 0
    return np.where(first[:, None], np.c_[along, 0 * along, up], np.c_[0 * along, along, up])


SHAPES = {"box": a_box, "corner": a_corner}


def graph_of(points, target, count=8):
    rows = np.arange(len(points))
    return MotionGraph(
        points, rows, points, target, np.tile(np.eye(3), (len(points), 1, 1)), neighbours_of(points, count, 2.0)
    )


def small_motion(rng, shift=1.0, turn=0.15):
    return rigid(Rotation.from_rotvec(rng.normal(0.0, turn, 3)).as_matrix(), rng.uniform(-shift, shift, 3))


@pytest.mark.parametrize("shape", SHAPES)
@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_a_known_motion_is_found_exactly(shape, seed):
    rng = np.random.default_rng(seed)
    points = cell_means(SHAPES[shape](rng, 600), 0.6)
    motion = small_motion(rng)
    target = transform_points(motion, points)
    start = standing(points, np.tile((target - points).mean(axis=0), (len(points), 1)))
    found = solve_motions(graph_of(points, target), start, Energy(match_off_m=2.0, neighbour_off_m=2.0, steps=15))
    np.testing.assert_allclose(points + found.shift, target, atol=1e-5)
    np.testing.assert_allclose(found.rotation, np.tile(motion[:3, :3], (len(points), 1, 1)), atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_noise_and_wrong_matches_leave_less_than_the_noise(shape, seed):
    rng = np.random.default_rng(seed)
    points = cell_means(SHAPES[shape](rng, 1500), 0.4)
    motion = small_motion(rng, turn=0.03)
    true = transform_points(motion, points)
    target = true + rng.normal(0.0, 0.1, true.shape)
    wrong = rng.random(len(points)) < 0.2
    target[wrong] += rng.uniform(-3.0, 3.0, (int(wrong.sum()), 3))
    start = standing(points, np.tile((true - points).mean(axis=0), (len(points), 1)))
    found = solve_motions(graph_of(points, target), start, Energy())
    off = np.linalg.norm(points + found.shift - true, axis=1)
    assert off.mean() < 0.1  # of one match it is 0.16


def test_two_bodies_side_by_side_keep_their_motions():
    rng = np.random.default_rng(0)
    points = cell_means(np.concatenate([a_box(rng, 1500), a_box(rng, 1500) + [0.0, 2.4, 0.0]]), 0.4)
    second = points[:, 1] > 1.2
    target = points + np.where(second[:, None], [1.2, 0.0, 0.0], [-0.3, 0.0, 0.0])
    graph = graph_of(points, target + rng.normal(0.0, 0.05, target.shape))
    assert (second[graph.edges[:, 0]] != second[graph.edges[:, 1]]).any()
    found = solve_motions(graph, standing(points, graph.target - points), Energy())
    assert np.linalg.norm(points + found.shift - target, axis=1).max() < 0.1


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_gradient_is_that_of_the_energy(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (5, 3))
    matched = np.array([0, 1, 1, 3])
    axes = rng.normal(size=(4, 3, 3))
    graph = MotionGraph(
        points,
        matched,
        points[matched] + rng.normal(0.0, 0.3, (4, 3)),
        points[matched] + rng.normal(0.0, 0.3, (4, 3)),
        axes @ axes.transpose(0, 2, 1),
        np.array([[0, 1], [1, 2], [2, 3], [0, 4]]),
    )
    # turns alike, since differences of rotation are taken to first order
    turn = rotations_of(np.tile(rng.normal(0.0, 0.5, 3), (5, 1)) + rng.normal(0.0, 1e-4, (5, 3)))
    motions = Motions(points, turn, rng.normal(0.0, 0.2, (5, 3)))
    energy = Energy(match_m=0.3, neighbour_m=0.3)
    _, _, gradient = _normal_equations(graph, motions, energy, _Pattern(graph))
    step = rng.normal(size=(5, 6))
    there, back = (energy_of(graph, _stepped(motions, sign * 1e-6 * step), energy) for sign in (1.0, -1.0))
    np.testing.assert_allclose(2.0 * (gradient * step).sum(), (there - back) / 2e-6, rtol=1e-3, atol=1e-3)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_rotations_are_those_of_scipy(seed):
    vector = np.random.default_rng(seed).normal(0.0, 1.0, (4, 3)) * [[1.0], [1e-3], [1e-9], [0.0]]
    np.testing.assert_allclose(rotations_of(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


def test_vertices_without_a_match_follow_their_neighbours():
    points = np.column_stack([np.arange(6.0), np.zeros(6), np.zeros(6)])
    rows = np.array([0, 1])
    edges = np.array([[k, k + 1] for k in range(5)])
    graph = MotionGraph(
        points, rows, points[rows], points[rows] + [0.2, 0.0, 0.0], np.tile(np.eye(3), (2, 1, 1)), edges
    )
    found = solve_motions(graph, standing(points), Energy(neighbour_off_m=2.0, steps=20))
    np.testing.assert_allclose(found.shift, np.tile([0.2, 0.0, 0.0], (6, 1)), atol=0.01)


def test_nothing_to_go_by_leaves_the_start():
    nothing = MotionGraph(
        np.ones((3, 3)),
        np.zeros(0, int),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        np.zeros((0, 2), int),
    )
    start = standing(nothing.xyz, np.full((3, 3), 0.5))
    assert solve_motions(nothing, start, Energy()) is start


def test_cells_hold_the_mean_of_their_points():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    found = cell_means(points, 0.5)
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]])
    assert cell_means(np.zeros((0, 3)), 0.5).shape == (0, 3)


def test_normals_stand_on_the_surface():
    rng = np.random.default_rng(0)
    normals = fit_normals(np.column_stack([rng.uniform(0, 1, (50, 2)), np.zeros(50)]), 8)
    np.testing.assert_allclose(np.abs(normals), np.tile([0.0, 0.0, 1.0], (50, 1)), atol=1e-9)
    assert fit_normals(np.zeros((2, 3)), 8).shape == (2, 3)


def test_matches_are_the_most_alike_within_the_largest_motion():
    said = np.eye(4, 352, dtype=np.float32)
    xyz0, xyz1 = np.zeros((4, 3)), np.zeros((4, 3))
    xyz1[2, 0] = 50.0
    said[3] = 0.0
    rows, targets = best_matches(xyz0, said, xyz1, said, PLAIN)
    kept = dict(zip(rows.tolist(), targets.tolist(), strict=True))
    assert kept[0] == 0
    assert kept[1] == 1
    assert kept.get(2) != 2
    assert 3 not in kept
    mutual, _ = best_matches(xyz0 + 9.0 * np.arange(4)[:, None], said, xyz1, said, replace(PLAIN, mutual=True))
    assert list(mutual) == [0]


# ---- whole pairs


def street(rng, car_motion, ego_motion, empty=False):
    """A pair with ground, a corner of walls, posts and a car, each point measured in both scans; and its instances."""
    ground = np.column_stack([rng.uniform([-5.0, -12.0], [30.0, 12.0], (6000, 2)), np.full(6000, -1.73)])
    posts = [a_box(rng, 150, (0.3, 0.3, 3.0)) + [x, y, -0.2] for x, y in rng.uniform([4, -11], [28, -6], (8, 2))]
    walls = [a_corner(rng, 3000) + [8.0, 6.0, -1.7], a_corner(rng, 2000) + [18.0, 6.0, -1.7]]
    car = a_box(rng, 1500) + [12.0, 1.0, -0.95]
    world = np.concatenate([ground, *([] if empty else [*posts, *walls])])
    xyz0 = np.concatenate([world, car])
    xyz1 = np.concatenate([transform_points(ego_motion, world), transform_points(car_motion, car)])
    made = make_pair([replace(an_object(12.0, 1.0), box0=np.array([12.0, 1.0, -0.95, 4.2, 1.8, 1.5, 0.0]))])
    scan = replace(made.scan0, instance=np.where(np.arange(len(xyz0)) < len(world), -1, 0).astype(np.int16))
    return replace(
        made,
        ego_motion=ego_motion,
        scan0=replace(scan, xyz=xyz0.astype(np.float32)),
        scan1=replace(scan, xyz=xyz1.astype(np.float32)),
        flow0=(xyz1 - xyz0).astype(np.float32),
    )


@pytest.mark.parametrize("name", METHODS)
def test_world_and_car_of_a_street_are_followed(name):
    ego_motion = pose_from_xyz_yaw(-0.9, 0.02, 0.0, 0.01)
    car_motion = pose_from_xyz_yaw(0.5, 0.15, 0.0, -0.01)
    pair = street(np.random.default_rng(0), car_motion, ego_motion)
    said = METHODS[name](pair, true_boxes(pair))
    assert list(said.flows) == [name]
    off = np.linalg.norm(said.flows[name] - pair.flow0, axis=1)
    car = pair.scan0.instance == 0
    for mine in (car, ~car):
        assert said.where[mine].mean() > 0.3
        assert off[mine & said.where].mean() < 0.12
    assert translation_error(said.ego_motion, ego_motion) < 0.1
    assert rotation_error(said.ego_motion, ego_motion) < 0.01
    centre = pair.objects[0].box0[:3]
    assert translation_error(said.motions[0], car_motion, centre) < 0.12


def test_what_falls_in_the_same_cells_is_followed_exactly():
    step = pose_from_xyz_yaw(-0.6, 0.3, 0.0, 0.0)  # whole cells of surface, vertices and targets
    pair = street(np.random.default_rng(1), step, step)
    said = scene_flow_of(pair, true_boxes(pair), replace(PLAIN, vertex_m=0.3, target_m=0.3))
    car = pair.scan0.instance == 0
    assert said.where[car].mean() > 0.9
    off = np.linalg.norm(said.flows["dewan"] - pair.flow0, axis=1)[said.where]
    assert np.median(off) < 0.005  # what is left are wrong matches
    assert translation_error(said.motions[0], step, pair.objects[0].box0[:3]) < 0.01


@pytest.mark.parametrize("name", METHODS)
def test_a_car_on_an_empty_plain_is_followed_and_the_world_stands(name):
    car_motion = pose_from_xyz_yaw(0.6, 0.0, 0.0, 0.0)
    pair = street(np.random.default_rng(4), car_motion, np.eye(4), empty=True)
    said = METHODS[name](pair, true_boxes(pair))
    assert np.isfinite(said.flows[name]).all()
    assert np.isfinite(said.ego_motion).all()
    assert translation_error(said.motions[0], car_motion, pair.objects[0].box0[:3]) < 0.15
