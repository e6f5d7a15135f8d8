"""The method end to end on one pair: cars go in, labels come out, and nothing else changes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_drive import GROUND_Z_M, write_drive

import augkitti
from augkitti import kitti
from augkitti.add_cars import cast_and_measure, keeps_its_shape
from augkitti.augmentation import prepare_pair, prepare_scan
from augkitti.config import Config
from augkitti.frames import compose, invert, pose_from_xyz_yaw, transform_points
from augkitti.pair_motion import T_world_scanner, ego_twist
from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import AugmentedPair, PreparedPair, ScanPair, VirtualCar
from augkitti.scanner import azimuth_time, load_profile
from augkitti.shards import shard_metadata
from augkitti.validate import rules_of, validate_pair

PROFILE = load_profile()
MODELS = tuple(model for model in parametric_cars() if model.category == "Car")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> tuple[ScanPair, PreparedPair]:
    drive = write_drive(tmp_path_factory.mktemp("drive"), frames=(0, 1))
    (sequence,) = kitti.open_root(drive.root).sequences
    pair = kitti.read_pair(sequence, 0)
    scan0, scan1 = (prepare_scan(scan, PROFILE, Config()) for scan in (pair.scan0, pair.scan1))
    return pair, prepare_pair(pair, scan0, scan1, Config())


def augmented(source, seed: int = 5, **settings) -> AugmentedPair:
    pair, prepared = source
    result = augkitti.augment_pair(pair, MODELS, PROFILE, Config(**settings), seed, f"{pair.sequence}/0/0", prepared)
    assert result is not None
    return result


def virtual(pair: AugmentedPair):
    return [(row, item) for row, item in enumerate(pair.objects) if item.origin == "virtual"]


def test_one_to_three_cars_are_seen_in_both_scans_and_one_moves(source) -> None:
    for seed in range(4):
        cars = virtual(augmented(source, seed))
        assert 1 <= len(cars) <= 3
        assert any(abs(item.speed) >= 1.0 for _, item in cars)
        for _, item in cars:
            assert min(item.points0, item.points1) >= 20
            assert item.rays0 >= item.points0


def test_measured_points_are_untouched_and_all_accounted_for(source) -> None:
    pair, _ = source
    result = augmented(source)
    for scan, after in ((pair.scan0, result.scan0), (pair.scan1, result.scan1)):
        kept = after.source >= 0
        np.testing.assert_array_equal(after.xyz[kept], scan.xyz[np.searchsorted(scan.row, after.source[kept])])
        np.testing.assert_array_equal(np.sort(np.concatenate([after.source[kept], after.removed])), scan.row)
        assert (np.diff(after.source[kept]) > 0).all()
        new_order = after.ring[~kept].astype(int) * 4000 + after.tick[~kept]
        assert (np.diff(new_order) > 0).all()


def test_simulated_points_carry_the_motion_that_takes_them_to_their_second_box(source) -> None:
    result = augmented(source)
    for row, item in virtual(result):
        mine = result.scan0.instance == row
        assert (result.flow_status0[mine] == 0).all()
        landed = result.scan0.xyz[mine] + result.flow0[mine]
        np.testing.assert_allclose(landed, transform_points(item.motion, result.scan0.xyz[mine]), atol=2e-5)
        local = np.abs(transform_points(invert(item.pose1), landed))
        assert (local <= item.box1[3:6] / 2 + 0.25).all()
        np.testing.assert_allclose(item.motion, compose(item.pose1, invert(item.pose0)), atol=1e-12)


def test_car_drives_at_its_speed_over_the_ground(source) -> None:
    result = augmented(source)
    interval = result.time1 - result.time0
    for _, item in virtual(result):
        standing = transform_points(result.ego_motion, item.box0[:3])
        moved = float(np.linalg.norm(item.box1[:3] - standing)) / (interval + item.moment1 - item.moment0)
        assert moved == pytest.approx(abs(item.speed), abs=1.3)  # moments: the scanner itself moves meanwhile


def test_same_seed_gives_the_same_pair_and_another_seed_another(source) -> None:
    first, again, other = augmented(source), augmented(source), augmented(source, 6)
    np.testing.assert_array_equal(first.scan0.xyz, again.scan0.xyz)
    np.testing.assert_array_equal(first.scan1.reflectance, again.scan1.reflectance)
    np.testing.assert_array_equal(first.flow0, again.flow0)
    assert len(first.scan0) != len(other.scan0)


def test_opaque_glass_shows_nothing_inside(source) -> None:
    through = [np.count_nonzero(augmented(source, seed).scan0.surface == 6) for seed in range(4)]
    closed = [np.count_nonzero(augmented(source, seed, glass="opaque").scan0.surface == 6) for seed in range(4)]
    assert sum(through) > 0
    assert closed == [0, 0, 0, 0]


def test_no_cars_asked_for_gives_the_plain_pair_with_its_real_labels(source) -> None:
    result = augmented(source, cars=(0, 0))
    assert virtual(result) == []
    assert len(result.objects) == 2
    assert len(result.scan0.removed) == 0
    assert (result.scan0.source >= 0).all()


def test_snapshot_shutter_freezes_each_car_at_its_moment(source) -> None:
    pair, _ = source
    for seed in range(3):
        result = augmented(source, seed, shutter="snapshot")
        for row, item in virtual(result):
            bearing = float(np.arctan2(item.box0[1], item.box0[0]))
            assert item.moment0 == pytest.approx(azimuth_time(bearing, pair.scan0.period_s), abs=1e-6)
            local = transform_points(invert(item.pose0), result.scan0.xyz[result.scan0.instance == row])
            assert (np.abs(local) <= item.box0[3:6] / 2 + 0.13).all()  # beam bias and noise, and no shear


def test_pair_without_room_gives_nothing(source) -> None:
    pair, prepared = source
    region = replace(prepared.scan0.region, drivable=np.zeros_like(prepared.scan0.region.drivable))
    blocked = replace(prepared, scan0=replace(prepared.scan0, region=region))
    assert augkitti.augment_pair(pair, MODELS, PROFILE, Config(), 5, "tiny/0/0", blocked) is None


@pytest.mark.kitti
def test_compensated_scans_are_cast_as_a_snapshot_without_ticks(kitti_root: Path) -> None:
    sequences = [s for s in kitti.open_root(kitti_root).sequences if s.kind == "compensated" and s.pairs]
    pair = kitti.read_pair(sequences[0], sequences[0].pairs[0][0])
    result = augkitti.augment_pair(pair, MODELS, PROFILE, Config(), 1, "x/0/0")
    assert result is not None
    assert (result.scan0.tick == 65535).all()
    assert all(item.moment0 == 0.0 for _, item in virtual(result))
    assert np.count_nonzero(result.scan0.surface) >= 20


@pytest.mark.parametrize(("speed_mps", "keeps"), [(34.0, False), (8.0, True)])
def test_car_that_the_sweep_would_shear_out_of_its_box_is_told(source, speed_mps: float, keeps: bool) -> None:
    pair, prepared = source
    scan0 = prepared.scan0
    model = MODELS[0]
    twist_ego = ego_twist(pair.ego_motion, pair.scan1.time_s - pair.scan0.time_s)
    pose0 = pose_from_xyz_yaw(0.0, 3.0, GROUND_Z_M + model.size_m[2] / 2, 0.0)
    moment0 = azimuth_time(np.pi / 2, pair.scan0.period_s)
    T_world_car0 = compose(T_world_scanner(twist_ego, moment0), pose0)
    twist = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0])
    car = VirtualCar(model, pose0, pose0, moment0, moment0, T_world_car0, twist, speed_mps, 0.0, 0.0, paint=0.9)
    cast = cast_and_measure(car, pair, scan0, scan0, PROFILE, Config(), np.random.default_rng(0))
    here = replace(cast, hits=(cast.hits[0],) * 2, returns=(cast.returns[0],) * 2)
    assert here.returns[0].returned.sum() > 500
    assert keeps_its_shape(car, here, scan0, scan0, PROFILE) is keeps


@pytest.mark.parametrize(
    "settings",
    [{}, {"glass": "opaque"}, {"shutter": "snapshot"}, {"cars": (0, 0)}, {"cars": (2, 3)}, {"min_points": 60}],
    ids=str,
)
def test_every_way_of_casting_passes_validation(source, settings) -> None:
    rules = rules_of(shard_metadata(Config(**settings), PROFILE, MODELS), "test")
    for seed in range(3):
        offences = validate_pair(augmented(source, seed, **settings), rules)
        assert offences == []
