"""Figures of a pair that can be worked out by hand: which points and boxes count, and what comes out for whom."""

import csv
import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scored_pair import EGO, SIZE, an_object, make_pair, right

from augkitti.command_line import as_json
from augkitti.errors import InputError
from augkitti.frames import compose, pose_from_xyz_yaw, transform_points
from training.config import GridConfig, load_settings
from training.predictions import Prediction
from training.report_tables import as_csv, as_latex, pairs_csv, print_report, write_report
from training.score import Rules, Score, baseline_predictors, score_pairs, truth_of

RULES = Rules()
ROW_KEYS = {
    "method", "fg_epe", "bg_epe", "all_epe", "obj_rot", "obj_tr_lidar", "obj_tr_centre", "ego_rot", "ego_tr",
    "ap_bev50", "ap_bev70", "pairs", "fg_points", "objects",
}  # fmt: skip


def rows_of(pairs, predictors, rules=RULES):
    report = score_pairs(pairs, predictors, rules).report()
    return {row["method"]: row for row in report.rows}


def row_of(pair, prediction, rules=RULES):
    return rows_of([pair], [lambda _: prediction], rules)["direct"]


def moved(pair, by, rows=slice(None)):
    flow = pair.flow0.copy()
    flow[rows] += np.asarray(by, np.float32)
    return {"direct": flow}


def test_the_truth_has_no_error_and_finds_all():
    pair = make_pair([an_object(10, 0, step=2.0), an_object(20, -8, turn=0.1)])
    row = row_of(pair, right(pair))
    for key in ("fg_epe", "bg_epe", "all_epe", "obj_rot", "obj_tr_lidar", "obj_tr_centre", "ego_rot", "ego_tr"):
        assert row[key] == pytest.approx(0.0, abs=1e-6), key
    assert row["ap_bev50"] == row["ap_bev70"] == row["ap_3d50"] == row["ap_3d70"] == 1.0
    assert (row["fg_points"], row["bg_points"], row["objects"], row["true_positives"]) == (40, 20, 2, 2)
    assert row["accuracy"]["all"] == {"acc_s": 1.0, "acc_r": 1.0, "outliers": 0.0, "points": 60}


def test_baselines_by_hand():
    # the world comes 1 m nearer; the car drives 3 m away: 2 m of flow, 3 m over ground
    pair = make_pair([an_object(10, 0, step=3.0)], points=30)
    rows = rows_of([pair], baseline_predictors(["zero", "ego_true"]))
    assert list(rows) == ["zero", "ego_true"]
    assert rows["zero"]["fg_epe"] == pytest.approx(2.0)
    assert rows["zero"]["bg_epe"] == pytest.approx(1.0)
    assert rows["zero"]["all_epe"] == pytest.approx((30 * 2.0 + 20 * 1.0) / 50)
    assert rows["zero"]["ego_tr"] == pytest.approx(1.0)
    assert rows["ego_true"]["fg_epe"] == pytest.approx(3.0)
    assert rows["ego_true"]["bg_epe"] == pytest.approx(0.0, abs=1e-6)
    for row in rows.values():
        for key in ("obj_rot", "obj_tr_lidar", "obj_tr_centre", "ap_bev50", "ap_bev70"):
            assert row[key] is None
        assert (row["fg_points"], row["objects"]) == (30, 1)


def test_points_of_unknown_flow_outside_the_grid_on_vans_and_on_small_boxes_count_for_nobody():
    objects = [
        an_object(10, 0),
        an_object(20, 8, category="Van"),
        an_object(30, 0),  # four points
        an_object(-10, 0),  # behind
        an_object(20, -8, category="Pedestrian"),  # background
    ]
    pair = make_pair(objects, points=[20, 15, 4, 20, 6], background=((10.0, 12.0), (80.0, 0.0)))
    status = pair.flow_status0.copy()
    status[:3] = 1
    pair = replace(pair, flow_status0=status)
    rows = rows_of([pair], [lambda _: right(pair), *baseline_predictors()])
    assert list(rows) == ["direct", "zero", "ego_true", "ego_registration"]
    for row in rows.values():
        assert (row["fg_points"], row["bg_points"]) == (17, 16)
        assert row["objects"] == 1


def test_what_is_neutral_and_how_many_points_a_box_needs_can_be_chosen():
    pair = make_pair([an_object(10, 0), an_object(20, 8, category="Van"), an_object(30, 0)], points=[20, 15, 4])
    row = row_of(pair, right(pair), Rules(neutral=(), least_points=4))
    assert (row["fg_points"], row["bg_points"], row["objects"]) == (24, 35, 2)
    row = row_of(pair, right(pair), Rules(category="Van", neutral=("Car",)))
    assert (row["fg_points"], row["bg_points"], row["objects"]) == (15, 20, 1)


def test_rules_come_from_settings_and_are_printed():
    rules = Rules.of(load_settings("small"))
    assert rules.grid.x_m == (0.0, 35.2)
    assert "Foreground is Car" in rules.as_text()
    assert "Van neutral" in rules.as_text()
    assert "boxes under 5 points ignored" in rules.as_text()


def test_points_without_an_estimate_move_with_the_ego_motion_or_not_at_all():
    pair = make_pair([an_object(10, 0, step=3.0)], points=10)
    where = np.ones(len(pair.scan0), bool)
    where[:5] = False  # of the car
    where[-5:] = False  # of the background
    row = row_of(pair, right(pair, where=where))
    assert row["fg_epe"] == pytest.approx(3.0 / 2)
    assert row["bg_epe"] == pytest.approx(0.0, abs=1e-6)
    assert row["covered"] == pytest.approx(20 / 30)
    assert row["given_only"]["fg_epe"] == pytest.approx(0.0, abs=1e-6)
    row = row_of(pair, right(pair, where=where, ego_motion=None))
    assert row["fg_epe"] == pytest.approx(2.0 / 2)
    assert row["bg_epe"] == pytest.approx(1.0 * 5 / 20)
    assert row["ego_rot"] is row["ego_tr"] is None


def test_values_where_there_is_no_estimate_do_not_matter():
    pair = make_pair([an_object(10, 0)], points=10)
    where = np.arange(len(pair.scan0)) >= 4
    flow = pair.flow0.copy()
    flow[:4] = np.nan
    assert np.isfinite(row_of(pair, right(pair, flows={"direct": flow}, where=where))["fg_epe"])


def test_object_motion_errors_by_hand():
    pair = make_pair([an_object(30, 0, step=1.0)])
    true, centre = pair.objects[0].motion, pair.objects[0].box0[:3]
    shifted = compose(pose_from_xyz_yaw(0.3, 0.4, 0.0, 0.0), true)
    row = row_of(pair, right(pair, motions=shifted[None]))
    assert row["obj_rot"] == pytest.approx(0.0, abs=1e-9)
    assert [row["obj_tr_lidar"], row["obj_tr_centre"]] == pytest.approx([0.5, 0.5])
    end = transform_points(true, centre)
    about_end = compose(pose_from_xyz_yaw(*end, 0.1), pose_from_xyz_yaw(*-end, 0.0))
    row = row_of(pair, right(pair, motions=compose(about_end, true)[None]))
    assert row["obj_rot"] == pytest.approx(0.1)
    assert row["obj_tr_centre"] == pytest.approx(0.0, abs=1e-9)
    assert row["obj_tr_lidar"] == pytest.approx(2 * np.hypot(*end[:2]) * np.sin(0.05))


def test_motions_are_judged_on_sure_true_positives_alone():
    pair = make_pair([an_object(10, 0), an_object(20, 0), an_object(30, 0, motion=False), an_object(30, 10)])
    boxes = np.array([item.box0 for item in pair.objects])
    boxes[3, 0] += 2.5  # overlaps by less than a half
    off = np.array([compose(pose_from_xyz_yaw(k + 1.0, 0, 0, 0), np.asarray(right(pair).motions[k])) for k in range(4)])
    row = row_of(pair, right(pair, boxes=boxes, scores=np.array([0.9, 0.4, 0.8, 0.9]), motions=off))
    assert row["true_positives"] == 2  # the second is unsure, the last misses
    assert row["obj_motions"] == 1  # the third has no true motion
    assert row["obj_tr_lidar"] == pytest.approx(1.0)
    # 1 of 2 right down to 0.9, 2 of 3 to 0.8, 3 of 4 to 0.4: precision 3/4 up to recall 3/4
    assert row["ap_bev50"] == pytest.approx(3 / 4 * 3 / 4)


def test_average_precision_counts_a_second_box_on_a_car_as_false():
    pair = make_pair([an_object(10, 0), an_object(30, 0)])
    boxes = np.array([pair.objects[0].box0, pair.objects[0].box0, pair.objects[1].box0])
    row = row_of(pair, right(pair, boxes=boxes, scores=np.array([0.9, 0.8, 0.7]), motions=None))
    assert row["ap_bev50"] == pytest.approx((20 * 1.0 + 20 * 2 / 3) / 40)
    assert row["obj_rot"] is None
    assert row["obj_motions"] is None
    assert row["detections"] == 3


@pytest.mark.parametrize(
    ("coverage", "azimuth", "judged"),
    [("full", None, {"ahead", "left"}), ("camera", (-0.7, 0.7), {"ahead"}), ("none", None, set())],
)
def test_detections_beyond_the_labels_reach_are_no_false_ones(coverage, azimuth, judged):
    for place, name in (((40.0, 0.0), "ahead"), ((5.0, 30.0), "left")):
        pair = make_pair([an_object(10, 0, origin="virtual")], coverage=coverage, azimuth=azimuth)
        boxes = np.array([[*place, -1.0, *SIZE, 0.0], pair.objects[0].box0])
        row = row_of(pair, right(pair, boxes=boxes, scores=np.array([0.9, 0.8]), motions=None))
        assert row["objects"] == 1  # virtual ones count everywhere
        assert row["ap_bev50"] == (0.5 if name in judged else 1.0)
        assert row["detections_not_judged"] == (name not in judged)


def test_labels_may_reach_over_the_seam_of_the_azimuth():
    pair = make_pair([], coverage="camera", azimuth=(2.5, -2.5))
    reach = truth_of(pair, RULES).labels_reach
    assert reach(np.array([[-10.0, 0.0], [-10.0, 0.1], [10.0, 0.0], [0.0, 10.0]])).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_a_virtual_car_outside_the_labels_reach_must_be_found_and_a_bad_box_on_it_is_false():
    pair = make_pair([an_object(10, 20, origin="virtual")], coverage="camera", azimuth=(-0.7, 0.7))
    assert row_of(pair, right(pair))["ap_bev50"] == 1.0
    box = pair.objects[0].box0 + np.array([1.9, 0, 0, 0, 0, 0, 0])
    row = row_of(pair, right(pair, boxes=box[None], motions=None))
    assert (row["ap_bev50"], row["detections_not_judged"]) == (0.0, 0)


@pytest.mark.parametrize("ignored", [an_object(20, 0, category="Van"), an_object(20, 0)])
def test_detections_on_neutral_and_ignored_boxes_are_no_false_ones(ignored):
    pair = make_pair([an_object(10, 0), ignored], points=[20, 4])
    boxes = np.array([ignored.box0, pair.objects[0].box0])
    row = row_of(pair, right(pair, boxes=boxes, scores=np.array([0.9, 0.8]), motions=None))
    assert (row["ap_bev50"], row["objects"], row["detections_not_judged"]) == (1.0, 1, 1)


def test_close_cars_are_found_counted_and_scored_apart():
    # footprints along x are 4 m long: gaps of 3.9, 4.1 and, between the van and the last car, 2 m
    objects = [an_object(x, 0, step=3.0) for x in (5.0, 12.9, 21.0)]
    objects += [an_object(30, 10, category="Van"), an_object(36, 10, step=2.0)]
    pair = make_pair(objects, points=10)
    truth = truth_of(pair, RULES)
    assert truth.close.tolist() == [True, True, False, True, True]
    assert truth.close_pairs == 1  # of cars
    row = row_of(pair, right(pair, flows=moved(pair, (0.5, 0, 0), slice(0, 10))))
    assert row["close"]["pairs_of_cars"] == 1
    assert (row["close"]["objects"], row["apart"]["objects"]) == (3, 1)
    assert row["close"]["fg_epe"] == pytest.approx(0.5 / 3, rel=1e-5)
    assert row["apart"]["fg_epe"] == pytest.approx(0.0, abs=1e-6)
    assert row["close"]["fg_points"] + row["apart"]["fg_points"] == row["fg_points"]
    assert truth_of(pair, Rules(close_m=4.2)).close_pairs == 2
    assert truth_of(pair, Rules(close_between="centres", close_m=8.0)).close_pairs == 1


def test_spread_within_an_object_is_roughness_not_error():
    pair = make_pair([an_object(10, 0), an_object(30, 0)], points=10)
    flow = pair.flow0.copy()
    flow[:10] += np.float32([0.4, 0, 0])  # the same all over the first
    flow[10:20:2] += np.float32([0, 0, 0.2])
    flow[11:20:2] -= np.float32([0, 0, 0.2])
    row = row_of(pair, right(pair, flows={"direct": flow}))
    assert row["fg_epe"] == pytest.approx(0.3, abs=1e-6)
    assert row["spread"] == {"mean": pytest.approx(0.1, abs=1e-6), "objects": 2}


def test_errors_by_range_speed_and_points_have_counts_that_add_up():
    pair = make_pair(
        [an_object(5, 0, step=0.0), an_object(25, 0, step=0.7), an_object(65, 0, step=3.0)], points=[60, 15, 5]
    )
    row = row_of(pair, right(pair, flows=moved(pair, (0.3, 0, 0), slice(60, 75))))
    for key in ("by_range", "by_speed", "by_points"):
        assert sum(one["fg_points"] for one in row[key]) == 80
        assert sum(one["objects"] for one in row[key]) == 3
        filled = [one for one in row[key] if one["objects"]]
        assert sorted(one["fg_epe"] > 0.1 for one in filled) == [False, False, True]
    assert [(one["from"], one["to"]) for one in row["by_range"] if one["objects"]] == [(0, 10), (20, 30), (60, 70)]
    assert [(one["from"], one["to"]) for one in row["by_speed"] if one["objects"]] == [(0, 0.05), (0.5, 1), (2.5, None)]
    assert [(one["from"], one["to"]) for one in row["by_points"] if one["objects"]] == [(0, 10), (10, 20), (50, 100)]
    assert sum(one["bg_points"] for one in row["by_range"]) == 20


def test_three_way_and_bucketed_errors_by_hand():
    # standing car, car that drives 1 m over ground, background; errors 0.1, 0.5, 0.2 m
    pair = make_pair([an_object(10, 0, step=0.0), an_object(20, 0, step=1.0)], points=10, background=((10.0, 12.0),))
    flow = pair.flow0.copy()
    for rows, error in ((slice(0, 10), 0.1), (slice(10, 20), 0.5), (slice(20, 30), 0.2)):
        flow[rows, 1] += np.float32(error)
    row = row_of(pair, right(pair, flows={"direct": flow}))
    three = row["three_way"]
    assert [three[key] for key in ("fd", "fs", "bs")] == pytest.approx([0.5, 0.1, 0.2], rel=1e-5)
    assert three["mean"] == pytest.approx(0.8 / 3, rel=1e-5)
    assert three["points"] == {"fd": 10, "fs": 10, "bs": 10}
    assert row["bucketed"]["CAR"]["static_epe"] == pytest.approx(0.1, rel=1e-5)
    assert row["bucketed"]["CAR"]["dynamic_error"] == pytest.approx(0.5, rel=1e-4)
    assert row["bucketed"]["BACKGROUND"]["static_epe"] == pytest.approx(0.2, rel=1e-5)
    assert row["bucketed"]["BACKGROUND"]["dynamic_error"] is None


def test_rigid_motion_is_judged_about_the_centres_of_cells_of_cars():
    grid = GridConfig(x_m=(0.0, 32.0), y_m=(-16.0, 16.0), z_m=(-3.0, 1.0), voxel_m=(0.5, 0.5, 0.5))
    pair = make_pair([an_object(10, 0, step=1.0, turn=0.2)])
    rules = Rules(grid)
    truth = truth_of(pair, rules)
    assert len(truth.cells)
    centre = np.array([grid.x_m[0], grid.y_m[0]]) + (truth.cells + 0.5) * 0.5
    at = np.column_stack([centre, np.zeros(len(centre))])
    flow = transform_points(pair.objects[0].motion, at) - at
    np.testing.assert_allclose(truth.cell_motions[:, :2], flow[:, :2], atol=1e-9)
    np.testing.assert_allclose(truth.cell_motions[:, 2], 0.2, atol=1e-9)
    said = (truth.cell_motions + [0.3, 0.4, 0.05]).astype(np.float32)
    row = row_of(pair, right(pair, columns=truth.cells, column_motions=said), rules)
    assert row["rigid_tr_local"] == pytest.approx(0.5, rel=1e-5)
    assert row["rigid_rot"] == pytest.approx(0.05, rel=1e-5)
    assert row["rigid_cells"] == len(truth.cells)
    elsewhere = np.array([[60, 60]], np.int32)
    row = row_of(pair, right(pair, columns=elsewhere, column_motions=said[:1]), rules)
    assert (row["rigid_tr_local"], row["rigid_cells"]) == (None, 0)


def test_ego_motion_is_averaged_over_pairs_and_flow_over_points():
    one = make_pair([an_object(10, 0)], points=5, background=((10.0, 12.0),), name="a/0/0")
    other = make_pair([an_object(10, 0)], points=45, background=((10.0, 12.0),), name="a/1/0")
    off = {"a/0/0": 0.2, "a/1/0": 0.4}

    def predict(pair):
        ego = compose(pose_from_xyz_yaw(off[pair.pair_id], 0, 0, 0.01), EGO)
        return right(pair, flows=moved(pair, (off[pair.pair_id], 0, 0)), ego_motion=ego)

    row = rows_of([one, other], [predict])["direct"]
    assert row["ego_tr"] == pytest.approx((0.2 + 0.4) / 2, rel=0.02)
    assert row["ego_rot"] == pytest.approx(0.01)
    assert row["fg_epe"] == pytest.approx((5 * 0.2 + 45 * 0.4) / 50, rel=1e-5)
    assert row["pairs"] == 2


def test_three_ways_of_flow_are_three_rows_with_the_same_objects():
    pair = make_pair([an_object(10, 0, step=2.0)])
    flows = {"direct": pair.flow0, "dense": moved(pair, (0, 0.1, 0))["direct"], "object": np.zeros_like(pair.flow0)}
    rows = rows_of([pair], [lambda _: right(pair, flows=flows)])
    assert [rows[name]["fg_epe"] for name in ("direct", "dense", "object")] == pytest.approx([0, 0.1, 1.0], abs=1e-5)
    assert len({rows[name]["ap_bev50"] for name in rows}) == 1


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0.0, 3.0), min_size=2, max_size=4), st.randoms())
def test_the_order_of_pairs_does_not_matter_and_all_is_the_mean_over_points(steps, random):
    pairs = [make_pair([an_object(10, 0, step=step)], name=f"a/{k}/0") for k, step in enumerate(steps)]
    shuffled = list(pairs)
    random.shuffle(shuffled)
    predictors = [lambda pair: right(pair, flows=moved(pair, (0.1, 0, 0))), *baseline_predictors(["zero"])]
    for name, row in rows_of(pairs, predictors).items():
        other = rows_of(shuffled, predictors)[name]
        assert {k: v for k, v in row.items() if v is not None and isinstance(v, float)} == pytest.approx(
            {k: v for k, v in other.items() if v is not None and isinstance(v, float)}
        )
        points = row["fg_points"] + row["bg_points"]
        mean = (row["fg_epe"] * row["fg_points"] + row["bg_epe"] * row["bg_points"]) / points
        assert row["all_epe"] == pytest.approx(mean)


def test_best_median_and_worst_pairs_are_named():
    pairs = [make_pair([an_object(10, 0)], name=f"a/{k}/0") for k in range(5)]
    error = {f"a/{k}/0": e for k, e in enumerate((0.3, 0.1, 0.5, 0.2, 0.4))}
    score = score_pairs(pairs, [lambda p: right(p, flows=moved(p, (error[p.pair_id], 0, 0)))], RULES)
    assert score.report().telling_pairs("direct") == {"best": "a/1/0", "median": "a/0/0", "worst": "a/2/0"}


def test_pairs_without_a_car_or_without_a_point_have_no_figures_rather_than_wrong_ones():
    pair = make_pair([], background=((-10.0, 0.0),))
    row = row_of(pair, right(pair))
    for key in ("fg_epe", "bg_epe", "all_epe", "ap_bev50", "obj_rot"):
        assert row[key] is None, key
    assert (row["fg_points"], row["objects"]) == (0, 0)


def test_damaged_pairs_and_flows_are_told_and_foreign_predictions_refused():
    pair = make_pair([an_object(10, 0)])
    bad = pair.flow0.copy()
    bad[0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        row_of(pair, right(pair, flows={"direct": bad}))
    with pytest.raises(ValueError, match="prediction of b/0/0"):
        row_of(pair, replace(right(pair), pair_id="b/0/0"))
    with pytest.raises(ValueError, match="has methods"):
        score_pairs([pair], [lambda _: right(pair), lambda _: right(pair)], RULES)
    instance = pair.scan0.instance.copy()
    instance[0] = 7
    with pytest.raises(InputError, match="names none of its 1 objects"):
        truth_of(replace(pair, scan0=replace(pair.scan0, instance=instance)), RULES)
    with pytest.raises(InputError, match="no pairs to score"):
        Score(RULES).report()


@pytest.fixture(scope="module")
def report():
    pair = make_pair([an_object(10, 0, step=2.0), an_object(30, 0)])
    predictors = [lambda _: right(pair, flows=moved(pair, (0.1, 0, 0))), *baseline_predictors()]
    return score_pairs([pair], predictors, RULES).report({"split": "test"})


def test_json_has_the_rows_with_null_where_there_is_nothing(report):
    written = json.loads(as_json(report.as_json()))
    assert [row["method"] for row in written["rows"]] == ["direct", "zero", "ego_true", "ego_registration"]
    for row in written["rows"]:
        assert set(row) >= ROW_KEYS
    assert written["rows"][1]["obj_rot"] is None
    assert written["rows"][0]["fg_epe"] == pytest.approx(0.1, rel=1e-5)
    assert written["rules"]["neutral"] == ["Van"]
    assert written["about"] == {"split": "test"}


def test_csv_has_a_line_a_method_and_one_a_pair(report):
    rows = list(csv.DictReader(io.StringIO(as_csv(report))))
    assert [row["method"] for row in rows] == ["direct", "zero", "ego_true", "ego_registration"]
    assert rows[1]["obj_rot"] == ""
    assert float(rows[0]["accuracy.fg.acc_r"]) == pytest.approx(0.5)  # flow of 1 m, and of none
    pairs = list(csv.DictReader(io.StringIO(pairs_csv(report))))
    assert [row["method"] for row in pairs] == ["direct", "zero", "ego_true", "ego_registration"]
    assert {row["pair_id"] for row in pairs} == {"a/0/0"}


def test_latex_has_the_papers_columns_and_the_best_in_bold(report):
    lines = as_latex(report, "K+AK").splitlines()
    assert len(lines) == 4
    assert all(line.count("&") == 8 and line.endswith(r"\\") for line in lines)
    assert lines[0].startswith(r"K+AK & direct & {\bf 0.10} & {\bf 0.10} ")  # the truth, which is better, is no method
    assert lines[2].startswith(r"K+AK & ego\_true & ")
    assert "bf" not in lines[2]
    assert " - & - " in lines[1]


def test_the_table_is_whole_on_a_narrow_screen(report):
    out = io.StringIO()
    print_report(report, Console(file=out, width=60))
    text = out.getvalue()
    assert "…" not in text
    for word in (
        "Foreground is Car",
        "Van neutral",
        "ego_registration",
        "AP BEV",
        "1 pairs, 40 foreground",
        "close",
        "apart",
    ):
        assert word in text


def test_a_folder_gets_all_tables(report, tmp_path):
    write_report(report, tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "pairs.csv", "scores.csv", "scores.json", "scores.tex",
    ]  # fmt: skip


def test_scoring_needs_no_torch():
    code = "import sys, training.score, training.report_tables; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_predictions_may_have_no_boxes_at_all():
    pair = make_pair([an_object(10, 0)])
    one = Prediction(pair.pair_id, {"direct": pair.flow0}, np.ones(len(pair.scan0), bool))
    row = row_of(pair, one)
    assert row["ap_bev50"] is row["obj_rot"] is row["ego_tr"] is row["detections"] is None
    none = right(pair, boxes=np.zeros((0, 7)), scores=np.zeros(0), motions=np.zeros((0, 4, 4)))
    row = row_of(pair, none)
    assert (row["ap_bev50"], row["true_positives"], row["obj_rot"]) == (0.0, 0, None)
