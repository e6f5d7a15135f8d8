"""Resimulation: a model takes a labelled vehicle's place on the same rays; what is learned from such views."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from augkitti import kitti, scanner
from augkitti import resimulate as rs
from augkitti.config import Config
from augkitti.labelled_views import RayedScan, VehicleView, body_return_rate, crossed, in_crop, rays_at, view_rays
from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import GLASS, MEASURED, PAINT, THROUGH_GLASS, CarModel, Scan
from augkitti.sensor_noise import CarLook
from pipelines import fit_vehicles

PROFILE = scanner.load_profile()
CONFIG = Config()
MODELS = [m for m in parametric_cars() if m.category == "Car"]
RAYS = scanner.fire_rays(PROFILE, np.arange(0, 4000, 2, dtype=np.uint16), 0.1)
SCAN = Scan(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), 0, "raw", 0.0, 0.1)
WALL_M = 30.0


def a_view(x: float = 10.0, y: float = 3.0, yaw: float = 0.2, model: CarModel = MODELS[0]) -> VehicleView:
    """A box before a wall at 30 m; its own rays return from its middle."""
    size = rs.body_size(model)
    box = np.array([x, y, -1.7 + 0.5 * size[2], *size, yaw])
    ray = rays_at(RAYS, box, PROFILE, 0.25)
    enter, leave = crossed(RAYS, ray, box, PROFILE)
    measured = np.where(leave >= enter, 0.5 * (enter + leave), WALL_M)
    reflectance = np.full(len(ray), 0.3, np.float32)
    return VehicleView(
        "drive", 0, "drive/car", "Car", box, RayedScan(SCAN, RAYS), ray, measured, reflectance, enter, leave, 0.0
    )


VIEW = a_view()


def resimulated(seed: int = 0, view: VehicleView = VIEW, **how: object) -> rs.Resimulated:
    return rs.resimulate(view, MODELS, PROFILE, CONFIG, np.random.default_rng(seed), **how)


def test_the_same_generator_gives_the_same_returns() -> None:
    first, second, third = resimulated(1), resimulated(1), resimulated(2)
    np.testing.assert_array_equal(first.range_m, second.range_m)
    np.testing.assert_array_equal(first.points, second.points)
    assert (first.range_m != third.range_m).any()


def test_the_vehicles_own_points_are_gone_and_the_world_beside_it_stays() -> None:
    own, misses = rs.own_returns(VIEW, PROFILE), VIEW.measured_m == WALL_M
    without, reflectance = rs.without_vehicle(VIEW, PROFILE)
    assert own.sum() > 500
    np.testing.assert_allclose(without[own | misses], WALL_M)
    np.testing.assert_array_equal(without[~own & ~misses], VIEW.measured_m[~own & ~misses])  # ground in its box
    np.testing.assert_allclose(reflectance, 0.3, rtol=1e-6)


def test_what_stands_before_the_vehicle_stays_before_it() -> None:
    pole = np.arange(len(VIEW.ray)) % 7 == 0
    view = dataclasses.replace(VIEW, measured_m=np.where(pole, 4.0, VIEW.measured_m))
    seen = resimulated(view=view)
    assert (seen.range_m[pole] == 4.0).all()
    assert (seen.surface[pole] == MEASURED).all()


def test_the_model_of_the_nearest_size_is_taken_and_stretched_a_little_at_most() -> None:
    for model in MODELS[:3]:
        assert rs.best_model(MODELS, a_view(model=model).box) is model
    long = rs.stretched(MODELS[0], rs.body_size(MODELS[0]) * (2.0, 1.04, 0.95))
    np.testing.assert_allclose(rs.body_size(long) / rs.body_size(MODELS[0]), [1.08, 1.04, 0.95], atol=1e-9)


def test_the_model_stands_on_the_boxs_floor_at_the_sides_that_are_seen() -> None:
    box = VIEW.box.copy()
    box[3:6] += (1.0, 0.4, 0.3)
    model = MODELS[0]
    T = rs.pose_in_box(model, box)
    floor = T[2, 3] - 0.5 * model.size_m[2]
    assert floor == pytest.approx(box[2] - 0.5 * box[5])
    heading = np.array([np.cos(box[6]), np.sin(box[6])])
    off = (T[:2, 3] - box[:2]) @ heading
    assert off == pytest.approx(-0.5)  # towards the scanner, which sees the rear
    assert abs((T[:2, 3] - box[:2]) @ [-heading[1], heading[0]]) == pytest.approx(0.2)


def test_returns_lie_on_the_model_in_the_scanners_steps() -> None:
    seen = resimulated(look=CarLook(0.95, 0.5))
    paint = seen.surface == PAINT
    assert paint.sum() > 200
    assert np.median(np.abs(seen.range_m[paint] - seen.expected_m[paint])) < 0.05
    assert np.abs(seen.range_m[paint] - seen.expected_m[paint]).max() < 0.25
    assert in_crop(seen.points, VIEW.box).all()
    np.testing.assert_allclose(seen.points * 1000, np.rint(seen.points * 1000), atol=1e-6)
    inside = seen.surface == THROUGH_GLASS
    assert (seen.range_m[inside] > seen.expected_m[inside] + 0.05).all()
    hit = seen.reflectance[seen.returned]
    assert np.isfinite(hit).all()
    assert np.isnan(seen.reflectance[~seen.returned]).all()


def test_a_look_that_is_given_does_not_move_the_rest_of_the_chance() -> None:
    drawn = resimulated(3)
    given = resimulated(3, look=drawn.look)
    np.testing.assert_array_equal(drawn.range_m, given.range_m)


def test_opaque_panes_give_no_returns_from_inside() -> None:
    seen = rs.resimulate(VIEW, MODELS, PROFILE, Config(glass="opaque"), np.random.default_rng(0))
    assert not (seen.surface == THROUGH_GLASS).any()
    assert (seen.surface == GLASS).any()


def cars_with(scores: np.ndarray, seed: int) -> list[fit_vehicles.FittedView]:
    """A view of each of many cars whose paint scores are known, measured by the profile's own noise."""
    noise = dict(PROFILE.content["noise"])
    noise["body"] = {**noise["body"], "paint": {"at": [0.0, 1.0], "value": [-3.0, 3.0]}}
    noise["body_clump"] = {"long": 0.5, "long_firing": 0.9, "short": 0.3, "short_firing": 0.6, "beam": 0.3}
    profile = dataclasses.replace(PROFILE, content={**PROFILE.content, "noise": noise})
    views = []
    for track, score in enumerate(scores):
        model = MODELS[track % len(MODELS)]
        view = a_view(9.0 + track % 7, 4.0 - track % 8, 0.3 * track, model)
        cast = rs.cast_in_place(view, model, profile, CONFIG)
        look = CarLook(float(score / 6.0 + 0.5), 0.5)
        seen = rs.measure_in_place(view, cast, look, profile, CONFIG, np.random.default_rng([seed, track]))
        view = dataclasses.replace(view, measured_m=seen.range_m, reflectance=seen.reflectance)
        real = view_rays(view, profile)
        views.append(fit_vehicles.FittedView(view, cast, real, seen.surface != MEASURED, track))
    return views


def test_a_fit_recovers_planted_paint_incidence_and_zeros() -> None:
    planted = np.linspace(-2.0, 1.0, 24)
    noise, found = fit_vehicles.fit_strength(cars_with(planted, seed=1), PROFILE.ring_step_rad)
    shipped = PROFILE.content["noise"]
    level = noise["paint"]["strength"] - shipped["paint"]["strength"]
    assert np.corrcoef(found, planted)[0, 1] > 0.95
    spread = np.quantile(found + level, [0.1, 0.5, 0.9]) - np.quantile(planted, [0.1, 0.5, 0.9])
    assert np.abs(spread).max() < 0.45
    assert noise["paint"]["zero_below"] == pytest.approx(shipped["paint"]["zero_below"], rel=0.25)
    curve = np.array(noise["body"]["cosine"]["value"])
    assert curve[-1] - curve[1] == pytest.approx(
        shipped["body"]["cosine"]["value"][-1] - shipped["body"]["cosine"]["value"][1], abs=0.5
    )


def test_figures_of_simulated_views_follow_the_noise_they_were_made_with() -> None:
    views = cars_with(np.linspace(-1.0, 1.0, 12), seed=2)
    noise = PROFILE.content["noise"]
    clumped = fit_vehicles.simulate(noise, views, None, PROFILE, 0)
    coins = {"long": 0.0, "long_firing": 0.5, "short": 0.0, "short_firing": 0.5, "beam": 0.0}
    tossed = fit_vehicles.simulate({**noise, "body_clump": coins}, views, None, PROFILE, 0)
    assert clumped.clumps[0] > 0.5 > 0.35 > tossed.clumps[0]
    again = fit_vehicles.simulate(noise, views, None, PROFILE, 0)
    assert fit_vehicles.misfit(again, clumped) == 0.0
    assert fit_vehicles.misfit(tossed, clumped) > 10.0


def test_a_search_finds_a_planted_clump_length() -> None:
    views = cars_with(np.full(24, -1.3), seed=3)
    planted = {"long": 1.0, "long_firing": 0.95, "short": 0.0, "short_firing": 0.0, "beam": 0.3}
    noise = {**PROFILE.content["noise"], "body_clump": planted}
    scores = np.full(24, -1.3)
    wanted = fit_vehicles.simulate(noise, views, scores, PROFILE, 7)
    found, best = 0.0, np.inf
    for firing in (0.80, 0.85, 0.90, 0.925, 0.94, 0.95, 0.96, 0.97, 0.98):
        trial = {**noise, "body_clump": {**planted, "long_firing": firing}}
        off = fit_vehicles.simulate(trial, views, scores, PROFILE, 11).clumps - wanted.clumps
        if float((off**2).sum()) < best:
            found, best = firing, float((off**2).sum())
    assert 1.0 / np.log(found) == pytest.approx(1.0 / np.log(0.95), rel=0.15)


def test_bright_and_dark_views_differ_in_the_body_rate() -> None:
    bright, dark = (body_return_rate(v.real) for v in cars_with(np.array([1.5, -1.5]), seed=4))
    assert bright > dark + 0.2


@pytest.mark.kitti
def test_too_few_labelled_cars_leave_the_vehicle_part_as_it_is_and_say_so(kitti_root: Path) -> None:
    said: list[str] = []
    root = kitti.open_root(kitti_root)
    noise = fit_vehicles.fit_vehicles(root, PROFILE.content, (), ["2011_09_26_drive_0002_sync"], say=said.append)
    assert noise == {key: PROFILE.content["noise"][key] for key in fit_vehicles.VEHICLE_KEYS}
    assert said == ["0 labelled cars and vans that nothing covers; 5 are needed: the vehicle part stays"]
