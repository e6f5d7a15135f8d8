"""Labelled views: window and body rays by scanner.md's definitions, clumps, and one track a car."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from augkitti import kitti, labelled_views, scanner
from augkitti.frames import box_pose, invert, transform_points
from augkitti.labelled_views import (
    BEYOND,
    INSIDE,
    NONE,
    SURFACE,
    BoxRays,
    body_return_rate,
    clump_correlations,
    clump_sums,
    in_crop,
    judge_rays,
    next_beams,
    next_firings,
    rays_at,
    rejudged,
    vehicle_views,
    window_shares,
)
from augkitti.scan_pair import LabelledBox

PROFILE = scanner.load_profile()
RAYS = scanner.fire_rays(PROFILE, np.arange(0, 4000, 2, dtype=np.uint16), 0.1)
BOX = np.array([10.0, 0.0, -0.9, 4.0, 1.8, 1.6, 0.0])  # its rear looks at the scanner


def hand_made_car() -> tuple[np.ndarray, BoxRays]:
    ray = rays_at(RAYS, BOX, PROFILE, 0.25)
    return ray, judge_rays(RAYS, ray, np.full(len(ray), np.inf), BOX, PROFILE)


def field_rays(share_long: float, firing: float, beam: float, seed: int, rate: float = 0.6) -> BoxRays:
    """A wall of body rays that return where a field with known correlations is high."""
    rings, firings = 40, 600
    rng = np.random.default_rng(seed)
    field = rng.standard_normal((rings, firings))
    for k in range(1, firings):
        field[:, k] = firing * field[:, k - 1] + np.sqrt(1 - firing**2) * field[:, k]
    for k in range(1, rings):
        field[k] = beam * field[k - 1] + np.sqrt(1 - beam**2) * field[k]
    field = np.sqrt(share_long) * field + np.sqrt(1 - share_long) * rng.standard_normal(field.shape)
    returned = (field > np.quantile(field, 1 - rate)).ravel()
    ring, step = (a.ravel().astype(np.int32) for a in np.indices((rings, firings)))
    yes, zero = np.ones(len(ring), dtype=bool), np.zeros(len(ring))
    return BoxRays(
        ring=ring, azimuth_rad=step * 2 * np.pi / 2150, firing=step, enter_m=zero, leave_m=zero + 5, cabin_m=zero,
        crosses_window=~yes, is_body=yes, measured_m=np.where(returned, 4.0, np.inf), is_window=~yes,
        window_class=np.full(len(ring), -1, np.int32), returns=returned, is_covered=~yes,
    )  # fmt: skip


def test_rays_of_a_box_are_those_whose_lines_cross_it_grown() -> None:
    ray = rays_at(RAYS, BOX, PROFILE, 0.25)
    origin, direction = scanner.lines_of_rays(PROFILE, RAYS, np.arange(len(RAYS), dtype=np.int32))
    along = np.linspace(7.0, 13.0, 601)
    half = BOX[3:6] / 2 + 0.25
    T = invert(box_pose(BOX))
    near = np.flatnonzero((np.abs(RAYS.ray_azimuth_rad) < 0.25) & ~RAYS.ray_blind)
    points = transform_points(T, origin[near, None] + along[None, :, None] * direction[near, None])
    crosses = near[(np.abs(points) <= half).all(axis=2).any(axis=1)]
    missed = np.setdiff1d(crosses, ray)
    assert len(missed) == 0
    assert len(np.setdiff1d(ray, crosses)) < 0.02 * len(ray)  # the sampled lines miss what only grazes a corner


def test_window_rays_fall_into_their_four_classes_by_where_they_return() -> None:
    ray, car = hand_made_car()
    window = np.flatnonzero(car.crosses_window)
    assert len(window) > 100
    measured = np.full(len(ray), np.inf)
    quarter = len(window) // 4
    measured[window[:quarter]] = car.cabin_m[window[:quarter]] + 0.1
    measured[window[quarter : 2 * quarter]] = car.cabin_m[window[quarter : 2 * quarter]] + 0.9
    measured[window[2 * quarter : 3 * quarter]] = car.leave_m[window[2 * quarter : 3 * quarter]] + 5.0
    judged = rejudged(car, measured)
    kinds = judged.window_class[window]
    assert (kinds[:quarter] == SURFACE).all()
    assert (kinds[quarter : 2 * quarter] == INSIDE).all()
    assert (kinds[2 * quarter : 3 * quarter] == BEYOND).all()
    assert (kinds[3 * quarter :] == NONE).all()
    np.testing.assert_allclose(window_shares(judged), [1 - 3 * quarter / len(window), *[quarter / len(window)] * 3])


def test_what_stops_before_the_box_is_no_window_ray_and_covers_the_car() -> None:
    ray, car = hand_made_car()
    measured = np.where(np.arange(len(ray)) % 2, car.enter_m - 1.0, np.inf)
    judged = rejudged(car, measured)
    assert judged.is_covered[1::2].all()
    assert not judged.is_window[1::2].any()
    assert judged.is_window.sum() == car.crosses_window[::2].sum()


def test_body_rays_count_as_returned_up_to_a_little_past_the_box() -> None:
    _, car = hand_made_car()
    measured = np.where(np.arange(len(car.ring)) % 4 == 0, car.leave_m + 0.05, car.leave_m + 0.5)
    judged = rejudged(car, measured)
    body = np.flatnonzero(judged.is_body)
    assert body_return_rate(judged) == pytest.approx(np.mean(body % 4 == 0))


def test_window_and_body_do_not_share_a_height() -> None:
    ray, car = hand_made_car()
    origin, direction = scanner.lines_of_rays(PROFILE, RAYS, ray)
    height = (origin + car.enter_m[:, None] * direction)[:, 2] - (BOX[2] - 0.5 * BOX[5])
    assert height[car.is_body].max() < 0.7 * BOX[5] < 1.15 * height[car.crosses_window].min()


def test_a_planted_clump_length_is_recovered() -> None:
    planted = field_rays(1.0, 0.96, 0.5, seed=1)
    field = clump_correlations([clump_sums(planted)])
    # Of a thresholded Gaussian field at rate 1/2 the correlation is 2/pi arcsin(rho).
    half = clump_correlations([clump_sums(field_rays(1.0, 0.96, 0.5, seed=s, rate=0.5)) for s in range(3)])
    found = np.sin(np.pi / 2 * half[0])
    assert np.log(found) == pytest.approx(np.log(0.96), rel=0.15)
    assert np.sin(np.pi / 2 * half[1]) == pytest.approx(0.96**4, rel=0.05)
    assert np.sin(np.pi / 2 * half[2]) == pytest.approx(0.5, abs=0.05)
    assert field[0] > field[1] > field[2]


def test_independent_drops_have_no_clumps_and_a_dark_car_beside_a_bright_one_is_none() -> None:
    views = [clump_sums(field_rays(0.0, 0.0, 0.0, seed=s, rate=r)) for s, r in ((1, 0.2), (2, 0.95))]
    np.testing.assert_allclose(clump_correlations(views), 0.0, atol=0.03)


def test_no_ray_of_a_car_gives_no_clumps() -> None:
    empty = field_rays(0.0, 0.0, 0.0, seed=1)
    nothing = dataclasses.replace(empty, is_body=np.zeros_like(empty.is_body))
    assert np.isnan(clump_correlations([clump_sums(nothing)])).all()
    assert np.isnan(clump_correlations([])).all()


def test_neighbours_are_one_firing_or_one_beam_apart() -> None:
    _, car = hand_made_car()
    a, b = next_firings(car, car.is_body)
    assert (car.ring[a] == car.ring[b]).all()
    assert (car.firing[b] - car.firing[a] == 1).all()
    a, b = next_beams(car, car.is_body)
    assert (car.ring[b] - car.ring[a] == 1).all()
    assert np.abs(car.azimuth_rad[a] - car.azimuth_rad[b]).max() <= np.pi / 2150


def test_crop_takes_the_car_and_leaves_the_ground_in_its_box() -> None:
    floor = BOX[2] - 0.5 * BOX[5]
    points = np.array([[10.0, 0.0, floor + 0.1], [10.0, 0.0, floor + 0.2], [12.08, 0.0, -0.9], [12.2, 0.0, -0.9]])
    assert in_crop(points, BOX).tolist() == [False, True, True, False]


def test_two_labels_of_one_car_at_one_moment_are_one_track(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (
        kitti.Sequence(name, "drive", "raw", "raw", Path(), (0,), Path()) for name in ("drive_sync", "drive_extract")
    )
    other = BOX + [0.0, 6.0, 0, 0, 0, 0, 0]
    labels = {
        "drive_sync": (LabelledBox("tracklet_000", "Car", BOX), LabelledBox("tracklet_001", "Car", other)),
        "drive_extract": (LabelledBox("tracking_7", "Car", BOX + [0.3, 0, 0, 0, 0, 0, 0]),),
    }
    monkeypatch.setattr(kitti, "read_labels", lambda sequence, frame: labels[sequence.name])
    tracks = labelled_views._tracks([first, second])
    assert tracks["drive", "tracking_7"] == tracks["drive", "tracklet_000"]
    assert tracks["drive", "tracklet_001"] != tracks["drive", "tracklet_000"]


@pytest.mark.kitti
def test_real_windows_agree_with_the_independent_measurement(kitti_root: Path) -> None:
    root = kitti.open_root(kitti_root)
    views = list(vehicle_views(root, PROFILE, ["2011_09_26_drive_0013_sync", "object_training"]))
    assert len({v.track for v in views}) >= 8
    judged = [labelled_views.view_rays(v, PROFILE) for v in views]
    shares = np.nanmean([window_shares(j) for j in judged], axis=0)
    np.testing.assert_allclose(shares, [0.62, 0.19, 0.16, 0.03], atol=0.12)
    found = clump_correlations([clump_sums(j) for j in judged])
    np.testing.assert_allclose(found, [0.76, 0.50, 0.29], atol=0.12)
