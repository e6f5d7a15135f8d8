import json
import re

import numpy as np
import pytest
from pair_factory import make_pair

from augkitti.errors import InputError
from augkitti.frames import invert
from augkitti.labelled_views import GROW_M, RayedScan, VehicleView, crossed, rays_at
from augkitti.parametric_cars import parametric_cars
from augkitti.raycast import cast_car
from augkitti.resimulate import best_model, pose_in_box, stretched
from augkitti.scan_pair import GLASS, Scan
from augkitti.scanner import fire_rays, load_profile
from augkitti.sensor_noise import simulate_returns
from pipelines import two_sample as ts
from pipelines.realism import judge, match, realism, summarise
from pipelines.realism_columns import (
    cars_of_pair,
    common_rays,
    look_of,
    simulate,
    with_independent_drops,
    without_noise,
    without_panes,
)
from pipelines.realism_findings import Gathered, as_json
from pipelines.realism_report import write_report

PROFILE = load_profile()
MODELS = tuple(model for model in parametric_cars() if model.category == "Car")
RAYS = fire_rays(PROFILE, np.arange(0, 4000, 2, dtype=np.uint16), 0.1)
EMPTY = Scan(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), 0, "raw", 0.0, 0.1)


def population(tracks, views, shift=0.0, seed=0):
    """Numbers of views: tracks differ among each other; simulated ones by `shift` in one of five."""
    rng = np.random.default_rng(seed)
    of_track = rng.standard_normal((tracks, 1, 5))
    values = (of_track + 0.5 * rng.standard_normal((tracks, views, 5))).reshape(-1, 5)
    values[:, 0] += shift
    return values


def names(tracks, views):
    return [f"t{k:02d}" for k in range(tracks) for _ in range(views)]


def view_of_made_up_car(track, frame):
    """A labelled car as the scanner would see it, made by the full model itself: real and simulated are alike."""
    rng = np.random.default_rng([track, frame, 5])
    where, bearing = rng.uniform(7.0, 22.0), rng.uniform(-0.6, 0.6)
    size = MODELS[track % len(MODELS)].size_m
    box = np.array([where * np.cos(bearing), where * np.sin(bearing), -1.73 + size[2] / 2.0, *size, rng.uniform(-3, 3)])
    ray = rays_at(RAYS, box, PROFILE, GROW_M)
    enter, leave = crossed(RAYS, ray, box, PROFILE)
    nothing = np.full(len(ray), np.inf)
    view = VehicleView("drive", frame, f"t{track:02d}", "Car", box, RayedScan(EMPTY, RAYS), ray, nothing,
                       np.full(len(ray), np.nan, np.float32), enter, leave, 0.0)  # fmt: skip
    return view, simulate(view, "full", MODELS, PROFILE, look_of(track, 99), np.zeros(3), common_rays(PROFILE), 99)


def gathered(tracks, views, columns=("full", "common")):
    out, common = Gathered(columns={name: [] for name in columns}), common_rays(PROFILE)
    for track in range(tracks):
        for frame in range(views):
            view, real = view_of_made_up_car(track, frame)
            out.real.append(summarise(view, real))
            kept = {"real": real}
            for name in columns:
                kept[name] = simulate(view, name, MODELS, PROFILE, look_of(track, 0), np.zeros(3), common, 0)
                out.columns[name].append(summarise(view, kept[name]))
            if len(out.examples) < 2:
                out.examples.append(kept)
    return out


def judged(found, **options):
    settings = {"splits": 3, "resamples": 60, "with_points": False, "source": "made up", "is_synthetic": False}
    return judge(found, ts.feature_scorer(trees=30), **(settings | options))


@pytest.fixture(scope="module")
def findings():
    return judged(gathered(14, 2))


# --- two-sample tests


def test_auc_is_half_for_ties_and_one_for_separated_scores():
    kind = np.array([False, False, True, True])
    assert ts.auc(np.zeros(4), kind) == 0.5
    assert ts.auc(np.array([0.1, 0.2, 0.3, 0.4]), kind) == 1.0
    assert ts.auc(np.array([0.3, 0.4, 0.1, 0.2]), kind) == 0.0
    assert np.isnan(ts.auc(np.zeros(2), np.array([True, True])))


def test_weights_make_tracks_equal():
    kind = np.array([False, False, False, True])
    weight = ts.track_weights(["a", "a", "b", "a"], kind)
    np.testing.assert_allclose(weight, [0.5, 0.5, 1.0, 1.0])
    # track b outweighs the two views of a
    assert ts.auc(np.array([0.0, 0.0, 1.0, 0.5]), kind, weight) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(5))
def test_a_track_never_falls_into_both_train_and_test(seed):
    rng = np.random.default_rng(seed)
    tracks = [f"t{k}" for k in rng.integers(0, 13, 80)]
    kind = rng.random(80) < 0.5
    fold = ts.track_folds(tracks, kind, 5, rng)
    for track in set(tracks):
        assert len(set(fold[np.array(tracks) == track])) == 1
    assert len(set(fold)) == 5


def test_the_judge_is_trained_without_the_tracks_that_it_scores():
    tracks = names(10, 3)
    of_row = np.array([int(track[1:]) for track in tracks], dtype=float)[:, None]
    met = []

    def scorer(train, kind, weight, test):
        met.append(set(train[:, 0]) & set(test[:, 0]))
        return np.zeros(len(test))

    kind = np.repeat([False, True], 30)
    ts.cross_validate(np.concatenate([of_row, of_row]), kind, [*tracks, *tracks], scorer, np.random.default_rng(0))
    assert len(met) == 5
    assert not any(met)


def test_identical_populations_cannot_be_told_and_separated_ones_always():
    scorer, tracks, kind = ts.feature_scorer(trees=30), names(30, 3), np.repeat([False, True], 90)
    real = population(30, 3, seed=1)
    same, apart = (
        ts.cross_validate(np.concatenate([real, other]), kind, [*tracks, *tracks], scorer, np.random.default_rng(0))
        for other in (population(30, 3, seed=2), population(30, 3, 9.0, seed=2))
    )
    assert 0.3 < same.auc < 0.7
    assert apart.auc > 0.99
    boot = ts.bootstrap_auc({"same": same, "apart": apart}, 100, np.random.default_rng(0))
    low, high = ts.interval(boot["same"])
    assert low < same.auc < high
    assert ts.interval(boot["apart"] - boot["same"])[0] > 0.0


def test_one_track_cannot_be_judged():
    with pytest.raises(InputError, match="1 labelled tracks"):
        ts.cross_validate(
            np.zeros((2, 1)), np.array([False, True]), ["a", "a"], ts.feature_scorer(), np.random.default_rng(0)
        )


def test_shuffling_finds_what_the_judge_sees():
    features = np.concatenate([population(20, 2, seed=1), population(20, 2, 6.0, seed=2)])
    tracks, kind = [*names(20, 2), *names(20, 2)], np.repeat([False, True], 40)
    drops = ts.permuted_drops(
        features, kind, tracks, {"planted": [0], "idle": [1, 2]}, ts.feature_scorer(trees=30), np.random.default_rng(0)
    )
    assert drops["planted"] > 0.3
    assert abs(drops["idle"]) < 0.05


def test_separation_and_discrepancy_grow_with_the_difference():
    kind = np.repeat([False, True], 60)
    a, b, c = population(20, 3, seed=1), population(20, 3, seed=2), population(20, 3, 4.0, seed=2)
    near = ts.separations(np.concatenate([a, b]), kind, np.ones(120))
    far = ts.separations(np.concatenate([a, c]), kind, np.ones(120))
    assert far[0] > 0.9 > near[0]
    assert ts.mmd(a, c) > ts.mmd(a, b)


def test_real_against_real_is_the_floor_at_equal_counts():
    a, far = population(16, 3, seed=1), population(16, 3, 9.0, seed=3)
    found = ts.at_equal_counts(a, {"far": far}, names(16, 3), ts.feature_scorer(trees=30), 3, np.random.default_rng(0))
    assert np.median(found["real"].auc) < 0.8 < np.median(found["far"].auc)
    assert len(found["far"].auc) == 3


def test_the_point_network_tells_boxes_from_balls():
    pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    flat = [np.column_stack([rng.uniform(-2, 2, (100, 2)), np.zeros(100)]) for _ in range(40)]
    round_ = [rng.standard_normal((100, 3)) for _ in range(40)]
    cloud = ts.point_sets([*flat, *round_], [np.full(100, 0.3)] * 80, [np.array([4.0, 2.0, 1.5])] * 80, rng)
    tracks, scorer = [*names(20, 2), *names(20, 2)], ts.point_scorer()
    found = ts.cross_validate(cloud, np.repeat([False, True], 40), tracks, scorer, np.random.default_rng(0), folds=2)
    assert found.auc > 0.95


# --- ablations


@pytest.fixture(scope="module")
def cast():
    view, _ = view_of_made_up_car(1, 0)
    model = stretched(best_model(MODELS, view.box), view.box[3:6])
    T_car_velo = np.broadcast_to(invert(pose_in_box(model, view.box)), (len(view.ray), 4, 4))
    hits = cast_car(model, T_car_velo, RAYS, view.ray, PROFILE, False)
    return hits, simulate_returns(hits, look_of(0, 0), RAYS, PROFILE, False, np.random.default_rng(0))


def test_without_panes_nothing_is_glass_and_the_rest_moves_up(cast):
    hits, _ = cast
    bare = without_panes(hits)
    assert (hits.surface == GLASS).any()
    assert not (bare.surface == GLASS).any()
    assert np.isfinite(bare.range_m[:, 0]).all()
    assert (np.diff(np.where(np.isfinite(bare.range_m), bare.range_m, 1e9), axis=1) >= 0.0).all()


def test_independent_drops_are_as_many(cast):
    hits, returns = cast
    shuffled = with_independent_drops(hits, returns, np.random.default_rng(0))
    assert shuffled.returned.sum() == returns.returned.sum()
    assert (shuffled.returned != returns.returned).any()


def test_without_noise_every_solid_surface_returns_at_its_range(cast):
    hits, returns = cast
    exact = without_noise(hits, returns, RAYS, PROFILE)
    solid = hits.surface[:, 0] != GLASS
    assert exact.returned[solid].all()
    assert np.abs(exact.range_m - hits.range_m[:, 0])[solid].max() <= 0.5 * PROFILE.range_quantum_m + 1e-9


def test_all_columns_of_a_view_see_the_same_place():
    view, _ = view_of_made_up_car(2, 0)
    common = common_rays(PROFILE)
    counts = {}
    for name in ("full", "no_noise", "independent", "opaque", "all_pass", "one_paint", "snapshot", "common"):
        seen = simulate(view, name, MODELS, PROFILE, look_of(2, 0), np.array([-8.0, 1.0, 0.0]), common, 0)
        np.testing.assert_array_equal(seen.box, view.box)
        counts[name] = int(seen.on_car.sum())
    assert counts["no_noise"] >= counts["full"] > 0
    assert counts["opaque"] >= counts["full"]


def test_paints_are_spread_evenly_over_few_cars():
    paints = np.sort([look_of(k, 3).paint for k in range(12)])
    assert np.diff(np.concatenate([[0.0], paints, [1.0]])).max() < 0.25


# --- a data set's own cars


def test_virtual_cars_of_a_pair_are_found_with_their_misses():
    found = list(cars_of_pair(make_pair(tick_step=2).pair, PROFILE))
    assert len(found) == 2  # one in both scans
    for named, view in found:
        assert named.category == "Car"
        assert 20 <= view.on_car.sum() <= len(view)


def test_matches_are_alike_and_each_is_used_once():
    real, others = gathered(6, 1, ()).real, gathered(9, 2, ()).real
    pairs = match(real, others)
    assert len({a for a, _ in pairs}) == len({b for _, b in pairs}) == len(pairs)
    for a, b in pairs:
        assert abs(real[a].place[0] - others[b].place[0]) <= 0.3
    assert len(match(real, real)) == len(real)


# --- the report


def test_the_common_recipe_is_told_apart_and_the_model_itself_is_not(findings):
    assert findings.judged["common"].auc > 0.95
    assert findings.judged["full"].auc < 0.75
    assert findings.margin[0] > 0.0


def test_json_has_the_keys_and_no_nan(findings, tmp_path):
    write_report(findings, tmp_path)
    text = (tmp_path / "realism.json").read_text()
    content = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    for key in ("auc.full", "auc.common", "auc.margin_low", "auc.margin_high"):
        assert 0.0 <= abs(content[key]) <= 1.0
    assert content["tracks"] == 14
    assert len(content["window"]["real"]) == len(content["window"]["simulated"]) == 4
    assert len(content["body_quantiles"]["real"]) == len(content["clumps"]["simulated"]) == 3
    assert content["verdict"]


def test_the_page_stands_alone_with_the_verdict_first(findings, tmp_path):
    write_report(findings, tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert not re.findall(r'(?:src|srcset|href)="(?!data:|#)', page)
    assert page.index(findings.verdict[:40]) < page.index("<table")
    assert len(list((tmp_path / "figures").glob("*.png"))) >= 12


def test_too_few_cars_give_an_honest_verdict(tmp_path):
    found = judged(gathered(3, 2))
    assert "Cannot tell: 3 labelled cars only" in found.verdict
    assert not found.checks[0].passed
    assert all(check.passed is None for check in found.checks[1:])
    write_report(found, tmp_path)


def test_one_car_gives_a_report_too(tmp_path):
    found = judged(gathered(1, 2))
    assert "Cannot tell: 1 labelled car only" in found.verdict
    assert as_json(found)["auc.full"] is None
    write_report(found, tmp_path)


def test_simulated_sources_are_named_in_the_verdict():
    assert "simulation with simulation" in judged(gathered(2, 1), is_synthetic=True).verdict


def test_a_root_without_labels_says_where_they_are_read_from(tmp_path):
    scan = tmp_path / "training" / "velodyne" / "000000.bin"
    scan.parent.mkdir(parents=True)
    rows = np.random.default_rng(0).uniform(-20.0, 20.0, (2000, 4)).astype("<f4")
    rows.tofile(scan)
    with pytest.raises(InputError, match="tracklet_labels"):
        realism(None, tmp_path, None, tmp_path / "report")


@pytest.mark.kitti
def test_real_cars_are_reported(kitti_root, tmp_path):
    code = realism(
        None, kitti_root, None, tmp_path, True, splits=2, resamples=40, views_of_a_track=2, max_tracks=4,
        with_points=False, columns=("full", "common"),
    )  # fmt: skip
    content = json.loads((tmp_path / "realism.json").read_text())
    assert code == 1  # four cars cannot tell
    assert content["tracks"] == 4
    assert content["resimulated"]["body"]["rays"] > 500
