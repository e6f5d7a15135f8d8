"""Cars made in code: measures, surfaces, and that they look like cars from where a scanner stands."""

import numpy as np
import pytest

from augkitti.cad_alignment import find_wheels
from augkitti.cad_soup import face_areas
from augkitti.parametric_cars import BODIES, build_car, parametric_cars
from augkitti.scan_pair import GLASS, LAMP, OTHER, PAINT, TYRE

CARS = {m.name: m for m in parametric_cars()}
# KITTI object labels, class Car: mean and standard deviation of length, width, height
KITTI_MEAN, KITTI_STD = np.array([3.88, 1.63, 1.53]), np.array([0.43, 0.10, 0.14])


def test_there_are_six_body_types_and_more_with_a_van_and_a_truck():
    categories = [m.category for m in CARS.values()]
    assert categories.count("Car") >= 6
    assert {"Van", "Truck"} <= set(categories)
    assert list(CARS) == sorted(CARS)


def test_sizes_of_cars_follow_the_labelled_cars_of_kitti():
    sizes = np.array([m.size_m for m in CARS.values() if m.category == "Car"])
    assert (np.abs(sizes.mean(axis=0) - KITTI_MEAN) < 0.25 * KITTI_STD).all()
    assert (sizes.std(axis=0) > 0.5 * KITTI_STD).all()
    assert (sizes.std(axis=0) < 1.5 * KITTI_STD).all()


@pytest.mark.parametrize("name", sorted(CARS))
def test_the_origin_is_the_middle_of_the_bounding_box(name):
    model = CARS[name]
    np.testing.assert_allclose(model.vertices.max(axis=0), model.size_m / 2, atol=1e-6)
    np.testing.assert_allclose(model.vertices.min(axis=0), -model.size_m / 2, atol=1e-6)
    assert model.faces.min() == 0
    assert model.faces.max() == len(model.vertices) - 1
    assert (face_areas(model.vertices, model.faces) > 0).all()


@pytest.mark.parametrize("name", sorted(CARS))
def test_four_tyres_stand_on_the_ground_where_the_axles_are_said_to_be(name):
    model = CARS[name]
    wheels = find_wheels(model.vertices, model.faces)
    assert len(wheels) == 4
    assert [w.y_m > 0 for w in wheels] == [True, False, True, False]
    for wheel in wheels:
        assert wheel.z_m - wheel.radius_m == pytest.approx(-model.size_m[2] / 2, abs=0.01)
    assert wheels[0].x_m - wheels[2].x_m == pytest.approx(model.wheelbase_m, abs=0.01)
    assert wheels[2].x_m == pytest.approx(model.rear_axle_x_m, abs=0.01)
    tyre = model.vertices[model.faces[model.surface == TYRE]]
    assert tyre[..., 2].min() == pytest.approx(-model.size_m[2] / 2, abs=1e-6)


@pytest.mark.parametrize("name", sorted(CARS))
def test_panes_are_in_the_upper_half_and_translucent_and_all_else_is_solid(name):
    model = CARS[name]
    glass = model.surface == GLASS
    assert set(np.unique(model.surface)) == {PAINT, GLASS, TYRE, LAMP, OTHER}
    assert (model.opacity[glass] < 1).all()
    assert (model.opacity[~glass] == 1).all()
    middle = model.vertices[model.faces].mean(axis=1)
    assert middle[glass, 2].min() > -0.05 * model.size_m[2]
    # a windscreen ahead, panes on either side
    assert middle[glass, 0].max() > 0.05 * model.size_m[0]
    assert middle[glass, 1].max() > 0.3 * model.size_m[1]
    assert middle[glass, 1].min() < -0.3 * model.size_m[1]


@pytest.mark.parametrize("name", sorted(CARS))
def test_left_and_right_are_alike(name):
    model = CARS[name]
    body = model.faces[model.surface == PAINT]
    here = {tuple(v) for v in np.round(model.vertices[np.unique(body)], 4) + 0.0}
    there = {tuple(v) for v in np.round(model.vertices[np.unique(body)] * [1, -1, 1], 4) + 0.0}
    assert here == there


@pytest.mark.parametrize("name", sorted(n for n, m in CARS.items() if m.category == "Car"))
def test_a_level_ray_at_window_height_meets_a_pane_then_a_seat_or_the_far_side(name):
    model = CARS[name]
    panes = model.vertices[model.faces[model.surface == GLASS]]
    height = panes[..., 2].mean()
    met = []
    beside = panes[np.abs(panes.mean(axis=1)[:, 1]) > 0.38 * model.size_m[1]]
    back, front = np.quantile(beside.mean(axis=1)[:, 0], [0.1, 0.8])
    for x in np.linspace(back, front, 10):
        hits = _surfaces_along_y(model, float(x), float(height))
        met.append(hits)
        assert len(hits) >= 2  # no hole in the shell
    firsts = [hits[0] for hits in met]
    assert firsts.count(GLASS) >= 4
    assert set(firsts) <= {GLASS, PAINT}


def _surfaces_along_y(model, x, z):
    """Classes that a line along y meets, from the left: a plain point-in-triangle test in the side view."""
    a, b, c = (model.vertices[model.faces[:, k]][:, [0, 2]] for k in range(3))
    p = np.array([x, z])

    def side(u, v):
        return (v[:, 0] - u[:, 0]) * (p[1] - u[:, 1]) - (v[:, 1] - u[:, 1]) * (p[0] - u[:, 0])

    s = np.stack([side(a, b), side(b, c), side(c, a)])
    hit = np.flatnonzero((s > 0).all(axis=0) | (s < 0).all(axis=0))
    y = model.vertices[model.faces[hit]].mean(axis=1)[:, 1]
    return [int(model.surface[i]) for i in hit[np.argsort(-y)]]


def test_the_same_body_comes_out_the_same_every_time():
    again = build_car(BODIES[0])
    model = CARS[BODIES[0].name]
    assert again.digest == model.digest
    np.testing.assert_array_equal(again.vertices, model.vertices)
    assert len({m.digest for m in CARS.values()}) == len(CARS)
