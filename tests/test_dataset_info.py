import json
from dataclasses import replace

import numpy as np
import pytest
from hand_made_pair import EGO, labelled_car, make_pair
from rich.console import Console

from augkitti.dataset_info import Motions, draw_info, info_json, info_of_pairs, info_tables
from augkitti.frames import box_pose, compose, invert, pose_from_xyz_yaw


def text_of(info):
    console = Console(width=160, record=True, file=open("/dev/null", "w"))  # noqa: SIM115 (the console owns it)
    console.print(*info_tables(info))
    console.file.close()
    return console.export_text()


def test_totals_count_both_scans_of_all_pairs():
    pairs = [make_pair(frame)[0] for frame in (0, 1, 5)]
    info = info_of_pairs(pairs)
    assert info.pairs == 3
    assert info.pairs_of_sequence == {"2011_09_26_drive_0005_sync": 3}
    assert info.points == sum(len(p.scan0) + len(p.scan1) for p in pairs)
    assert info.simulated_points == 3 * 2 * 60
    assert info.car_points == 3 * 2 * 59
    assert info.removed_points == 3 * 30
    assert info.objects == {"labelled Car": 3, "virtual Car": 3}
    assert sum(info.surfaces) == info.points == int(info.range_counts.sum())
    assert int(info.car_range_counts.sum()) == info.simulated_points


@pytest.mark.parametrize("speed", [0.0, 4.0, 13.5])
@pytest.mark.parametrize("place", [(20.0, 5.0, 0.0), (-15.0, -8.0, 2.0)])
def test_labelled_speed_is_over_ground_whatever_the_ego_car_does(speed, place):
    pair, *_ = make_pair(labelled=[labelled_car(place, speed, yaw_rate=0.4)])
    info = info_of_pairs([pair])
    assert info.labelled.speed_mps == pytest.approx([speed], abs=1e-9)
    assert info.labelled.yaw_rate_rps == pytest.approx([0.4])


def test_labelled_speed_knows_that_moments_are_not_one_revolution_apart():
    """A standing car's moments 6 ms closer than the scans: its motion is not the ego-motion, yet it stands."""
    from augkitti.frames import se3_exp, se3_log

    motion = se3_exp(se3_log(EGO), np.array(0.94))
    car = labelled_car((20.0, 5.0, 0.0), 0.0)
    car = replace(car, motion=motion, moment0=0.004, moment1=-0.002)
    info = info_of_pairs([make_pair(labelled=[car])[0]])
    assert info.labelled.speed_mps == pytest.approx([0.0], abs=1e-9)


def test_jitter_of_labelled_boxes_is_steadied_over_neighbouring_pairs():
    """A car at 5 m/s whose boxes jitter by 2 cm and half a degree: five pairs in a row calm it."""
    rng = np.random.default_rng(3)
    off = [compose(pose_from_xyz_yaw(*rng.normal(0, 0.02, 2), 0.0, rng.normal(0, 0.009)), np.eye(4)) for _ in range(41)]
    clean = labelled_car((20.0, 5.0, 0.0), 5.0)
    pairs = []
    for frame in range(40):
        T0, T1 = box_pose(clean.box0), box_pose(clean.box1)
        motion = compose(compose(T1, off[frame + 1]), invert(compose(T0, off[frame])))
        pairs.append(make_pair(frame, labelled=[replace(clean, motion=motion)])[0])
    steady = info_of_pairs(pairs).labelled
    raw = info_of_pairs(pairs[::3]).labelled  # no neighbours: each by itself
    assert len(steady.speed_mps) == 40
    assert steady.speed_mps.mean() == pytest.approx(5.0, abs=0.1)
    assert steady.yaw_rate_rps.std() < 0.5 * raw.yaw_rate_rps.std()
    assert steady.speed_mps.std() < 0.5 * raw.speed_mps.std()


def test_a_box_labelled_back_to_front_does_not_turn():
    car = labelled_car((20.0, 5.0, 0.0), 0.0)
    about_centre = compose(box_pose(car.box0), compose(pose_from_xyz_yaw(0, 0, 0, np.pi), invert(box_pose(car.box0))))
    info = info_of_pairs([make_pair(labelled=[replace(car, motion=compose(EGO, about_centre))])[0]])
    assert info.labelled.yaw_rate_rps == pytest.approx([0.0], abs=1e-6)


def test_pedestrians_and_boxes_seen_once_give_no_labelled_motion():
    walker = labelled_car((20.0, 5.0, 0.0), 1.0, category="Pedestrian")
    once = replace(labelled_car((9.0, 5.0, 0.0), 1.0), motion=None)
    info = info_of_pairs([make_pair(labelled=[walker, once])[0]])
    assert len(info.labelled.speed_mps) == 0
    assert info.spread_ratios() == {"speed": None, "yaw_rate": None}
    assert "no labelled cars" in text_of(info)


def test_spread_ratio_is_std_over_std_and_is_printed():
    pairs = [make_pair(f, virtual_speed=v, virtual_yaw_rate=w)[0] for f, v, w in ((0, 0.0, -1.0), (3, 20.0, 1.0))]
    info = info_of_pairs(pairs, Motions(np.array([4.0, 8.0]), np.array([-0.1, 0.1])))
    assert info.spread_ratios() == {"speed": pytest.approx(5.0), "yaw_rate": pytest.approx(10.0)}
    text = text_of(info)
    assert "5.0 times" in text
    assert "10.0 times" in text
    narrow = info_of_pairs(pairs, Motions(np.array([0.0, 20.0]), np.array([-1.0, 1.0])))
    assert "1.0 times, below 2" in text_of(narrow)


def test_reversing_counts_as_speed():
    info = info_of_pairs([make_pair(virtual_speed=-3.0)[0]])
    assert info.virtual.speed_mps.tolist() == [3.0]


def test_json_round_trips_and_holds_the_figures():
    info = info_of_pairs([make_pair(f)[0] for f in (0, 1)])
    content = json.loads(info_json(info))
    assert content["pairs"] == 2
    assert content["virtual"]["speed_mps"]["mean"] == pytest.approx(10.0)
    assert content["points_by_range"][0]["cars"] == 2
    assert sum(content["surfaces"].values()) == content["points"]


def test_no_pairs_at_all_still_give_tables_and_json():
    info = info_of_pairs([])
    assert json.loads(info_json(info))["car_point_share"] == 0.0
    assert "pairs" in text_of(info)


def test_info_makes_a_picture_with_and_without_labelled_cars(tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need the extra `view`")
    draw_info(info_of_pairs([make_pair(f)[0] for f in (0, 1)]), tmp_path / "info.png")
    draw_info(info_of_pairs([]), tmp_path / "empty.png")
    assert (tmp_path / "info.png").stat().st_size > 20000
    assert (tmp_path / "empty.png").is_file()
