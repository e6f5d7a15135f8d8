"""`pointflownet tables`: what the tables, the page, the LaTeX and the JSON hold, and what bad input is told."""

import base64
import json
import os
import re
import signal
from html.parser import HTMLParser

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from scored_pair import SETTINGS, a_data_set, a_run  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

import augkitti  # noqa: E402
from augkitti.errors import InputError, MachineError  # noqa: E402
from augkitti.frames import compose, pose_from_xyz_yaw  # noqa: E402
from training import tables as module  # noqa: E402
from training.baselines.followed import boxes_of, followed  # noqa: E402
from training.checkpoint import shipped_checkpoint  # noqa: E402
from training.cli import app  # noqa: E402
from training.paper_figures import Picture  # noqa: E402
from training.paper_scores import Compared, best_baselines, run_names, spread_over  # noqa: E402
from training.paper_tables import PAPER  # noqa: E402
from training.predictions import Prediction  # noqa: E402
from training.tables import COMPARED, TablesOptions, tables  # noqa: E402

OFF_M = 0.3
PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def a_little_off(pair, detections=None):
    """The true ego-motion, and true motions of the boxes that it is given, 0.3 m to the left."""
    motions = [compose(pose_from_xyz_yaw(0.0, OFF_M, 0.0, 0.0), pair.ego_motion)] * len(boxes_of(detections))
    return followed("late", pair, pair.ego_motion, detections, motions)


def killed_by_the_system(pair, detections=None):
    os.kill(os.getpid(), signal.SIGKILL)


QUICK = tuple(one for one in COMPARED if one.name in ("zero", "ego_true", "ego_registration"))
LATE = Compared("late", "Late+Det.", a_little_off, paper="ICP+Det.", most_pairs=1)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    a_data_set(folder / "aug")
    a_data_set(folder / "k")
    a_data_set(folder / "unsplit", splits=False)
    for seed, name in enumerate(("k0", "ka0", "ka1")):
        a_run(folder / name, seed=seed)
    return folder


def draw_a_pixel(folder, *_):
    (folder / "one.png").write_bytes(PIXEL)
    return [Picture(folder / "one.png", "One <picture>", "Of a pixel.")]


@pytest.fixture
def without_figures(monkeypatch):
    monkeypatch.setattr(module, "draw_all", draw_a_pixel)
    monkeypatch.setattr(module, "COMPARED", QUICK)


def options(place, out, **changes):
    values = {
        "data": place / "aug", "kitti_data": place / "k", "out": out, "k_runs": (place / "k0",),
        "k_ak_runs": (place / "ka0", place / "ka1"), "boxes": "truth",
    }  # fmt: skip
    return TablesOptions(**{**values, **changes})


@pytest.fixture(scope="module")
def made(place, tmp_path_factory):
    """Folder and results with a method of few pairs, and two seeds of K+AK."""
    out = tmp_path_factory.mktemp("out") / "report"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "draw_all", draw_a_pixel)
        return out, tables(options(place, out), (*QUICK, LATE))


def rows_of(made, **wanted):
    written = json.loads((made[0] / "tables.json").read_text())["rows"]
    return [row for row in written if all(row[key] == value for key, value in wanted.items())]


def asked(*words):
    return CliRunner().invoke(app, ["tables", *(str(word) for word in words)], env={"COLUMNS": "200"})


def refused(*words):
    answer = asked(*words)
    assert answer.exit_code == 2, answer.output
    lines = answer.stderr.strip().splitlines()
    assert len(lines) == 1, answer.stderr
    return lines[0]


def test_rows_hold_what_evaluate_gives_and_where_they_belong(made):
    rows = rows_of(made)
    for row in rows:
        assert {"fg_epe", "ap_bev50", "by_points", "close", "seconds", "coverage"} <= set(row)
        assert row["split"] == {1: "validation", 2: "test"}[row["table"]]
        assert row["seconds"] > 0.0
        assert row["coverage"] == row["covered"]
    ablation = {(row["eval_set"], row["trained_on"], row["run"]) for row in rows if row["table"] == 1}
    assert ablation == {(on, *run) for on in ("K", "K+AK") for run in (("K", "k0"), ("K+AK", "ka0"), ("K+AK", "ka1"))}
    assert {row["method"] for row in rows if row["table"] == 1} == {"direct", "dense", "object"}
    comparison = [row["method"] for row in rows if row["table"] == 2 and row["eval_set"] == "K" and row["run"] != "ka1"]
    assert comparison == ["zero", "ego_true", "ego_registration", "late", "direct", "dense", "object"]
    assert all(row["run"] != "k0" for row in rows if row["table"] == 2)
    assert [row["pairs"] for row in rows_of(made, table=2, method="zero")] == [2, 4]


def half_blind(pair, detections=None):
    """The truth at every second point, 9 m off at the others, for which it says that it has no estimate."""
    flow = pair.flow0.copy()
    flow[1::2] += 9.0
    return Prediction(pair.pair_id, {"half": flow}, np.arange(len(flow)) % 2 == 0, ego_motion=pair.ego_motion)


def test_a_method_that_is_valid_in_places_is_scored_there_says_so_and_wins_nothing(
    place, tmp_path, without_figures, capsys
):
    half = Compared("half", "Half", half_blind, valid_only=True)
    found = tables(options(place, tmp_path), (*QUICK, half))
    (row,) = (row for row in found.rows if row["method"] == "half" and row["eval_set"] == "K")
    assert row["label"] == f"Half (valid {100 * row['coverage']:.0f} %)"
    assert 0.4 < row["coverage"] < 0.6
    assert row["bg_epe"] == pytest.approx(0.0, abs=1e-6)
    assert row["all_points"]["bg_epe"] is not None
    assert "half" not in best_baselines(found.rows)
    assert row["label"].replace("%", r"\%") in (tmp_path / "tables.tex").read_text()


def test_a_slow_method_is_scored_on_its_own_pairs_and_says_how_many(made):
    few = rows_of(made, method="late")
    assert [(row["eval_set"], row["pairs"], row["whole"]) for row in few] == [("K", 1, False), ("K+AK", 2, False)]
    page = (made[0] / "index.html").read_text()
    assert re.search(r"Late\+Det\..*?<td>1 only</td>", page)
    assert "Late+Det. (1 pairs)" in (made[0] / "tables.tex").read_text()
    assert best_baselines(rows_of(made)) == ["ego_registration"]


def test_methods_follow_true_boxes_or_the_networks(place, tmp_path, without_figures):
    seen = {}
    for boxes in ("truth", "network"):
        counts = seen.setdefault(boxes, [])

        def watched(pair, detections=None, counts=counts):
            counts.append(len(boxes_of(detections)))
            return a_little_off(pair, detections)

        found = tables(options(place, tmp_path / boxes, boxes=boxes), (Compared("late", "Late", watched),))
        row = next(row for row in found.rows if row["method"] == "late")
        if boxes == "truth":
            assert row["bg_epe"] == pytest.approx(0.0, abs=1e-6)
            assert row["true_positives"] == row["objects"]
    assert set(seen["truth"]) == {2}
    assert set(seen["network"]) != {2}  # it learned nothing


def test_the_papers_numbers_stand_where_they_belong(made):
    (row,) = rows_of(made, table=1, eval_set="K+AK", run="k0", method="direct")
    assert row["paper"]["fg_epe"] == 0.58
    assert row["paper"]["obj_tr_lidar"] == 0.57
    (row,) = rows_of(made, table=2, eval_set="K", run="ka0", method="direct")
    assert (row["paper"]["all_epe"], row["paper"]["seconds"]) == (0.16, 0.5)
    assert rows_of(made, method="late", eval_set="K+AK")[0]["paper"]["obj_tr_lidar"] == 6.30
    assert rows_of(made, method="zero")[0]["paper"] is None
    assert rows_of(made, table=2, method="dense")[0]["paper"] is None


def test_the_page_stands_alone_and_shows_what_it_should(made):
    class Seen(HTMLParser):
        def __init__(self):
            super().__init__()
            self.sources, self.tags, self.text = [], [], []

        def handle_starttag(self, tag, attributes):
            self.tags.append(tag)
            self.sources += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]

        def handle_data(self, data):
            self.text.append(data)

    page = (made[0] / "index.html").read_text()
    seen = Seen()
    seen.feed(page)
    assert not {"script", "link", "iframe"} & set(seen.tags)
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in seen.sources)
    assert not re.search(r"https?://|url\(|@import", page)
    images = [source for source in seen.sources if source.startswith("data:")]
    assert [base64.b64decode(image.partition(",")[2]) for image in images] == [PIXEL]
    text = " ".join(seen.text)
    assert "One <picture>" in text
    assert "prefers-color-scheme: dark" in page
    assert "out of scope" in text
    assert seen.tags.count("table") == 3
    assert {"ablation", "comparison", "ways"} <= set(re.findall(r'id="(\w+)"', page))


def test_latex_has_the_papers_columns_and_numbers_beside_ours(made):
    text = (made[0] / "tables.tex").read_text()
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 2
    lines = {tuple(cell.strip() for cell in line.split("&")[:2]): line for line in text.splitlines() if "&" in line}
    ablation = lines["K+AK", "K"]
    assert ablation.count("&") == 8
    assert [float(value) for value in re.findall(r"\\paper\{([\d.]+)\}", ablation)] == [
        0.58, 0.14, 0.18, 0.010, 0.57, 0.004, 0.14,
    ]  # fmt: skip
    ours = lines["K", "Ours"]
    assert ours.count("&") == 10 - 1
    assert re.findall(r"\\paper\{([\d.]+)\}", ours)[-1] == "0.5"
    assert r"\bf" not in lines["K", r"True ego-motion, all stands"]
    assert r"\bf" not in lines["K", "Late+Det. (1 pairs)"]
    assert r"\bf" in ablation + lines["K+AK", "K+AK"]


def test_several_runs_are_shown_by_mean_and_range(made):
    values = [row["bg_epe"] for row in rows_of(made, table=1, eval_set="K", trained_on="K+AK", method="direct")]
    assert len(values) == 2
    low, high = sorted(values)
    page = (made[0] / "index.html").read_text()
    assert f'{np.mean(values):.3f} <span class="soft">({low:.3f} to {high:.3f})</span>' in page
    assert r"\pm" in (made[0] / "tables.tex").read_text()


def test_the_command_as_typed(place, tmp_path, without_figures):
    words = ["--data", place / "aug", "--kitti-data", place / "k", "--out", tmp_path / "report", "--limit", 1]
    answer = asked("--runs", place / "k0", place / "ka0", *words, "--boxes", "truth")
    assert answer.exit_code == 0, answer.output
    assert f"Table 2, test (augkitti {augkitti.__version__})" in answer.output
    written = json.loads((tmp_path / "report" / "tables.json").read_text())
    assert [(run["name"], run["trained_on"]) for run in written["about"]["runs"]] == [("k0", "K"), ("ka0", "K+AK")]
    assert {row["pairs"] for row in written["rows"]} == {1, 2}
    assert written["about"]["boxes"] == "truth"


def test_without_a_run_on_k_the_page_says_that_nothing_is_compared(place, tmp_path, without_figures):
    tables(options(place, tmp_path, k_runs=()), ())
    assert "no run trained on K was given" in (tmp_path / "index.html").read_text()


def test_bad_input_is_told_in_one_line(place, tmp_path, without_figures):
    k, aug, out = place / "k", place / "aug", ["--out", tmp_path / "report"]
    runs = ["--runs", place / "k0", place / "ka0"]
    assert "has no splits" in refused(*runs, "--data", place / "unsplit", "--kitti-data", k, *out)
    assert "for --data and for --kitti-data" in refused(*runs, "--data", k, "--kitti-data", k, *out)
    words = ["--data", aug, "--kitti-data", k]
    assert "does not exist" in refused("--runs", tmp_path / "no", place / "ka0", *words, *out)
    assert "K+AK run behind each" in refused("--runs", place / "k0", *words, *out)
    wider = SETTINGS.model_copy(update={"grid": SETTINGS.grid.model_copy(update={"z_m": (-3.0, 2.0)})})
    a_run(tmp_path / "wider", settings=wider)
    assert "another grid" in refused("--runs", place / "k0", tmp_path / "wider", *words, *out)
    (tmp_path / "file").write_text("")
    assert "cannot be made" in refused(*runs, *words, "--out", tmp_path / "file")


def test_what_is_compared_has_names_of_its_own_and_lines_of_the_paper_that_there_are():
    names = [one.name for one in COMPARED]
    assert len(set(names)) == len(names) == len({one.label for one in COMPARED})
    printed = {one.method for one in PAPER if one.table == 2}
    assert {one.paper for one in COMPARED if one.paper is not None} <= printed
    for one in COMPARED:
        assert one.paper in (None, one.label)


def test_pairs_are_spread_over_a_set():
    assert spread_over(10, 3) == [0, 3, 6]
    assert spread_over(2, 30) == [0, 1]
    assert spread_over(7, 7) == list(range(7))


def test_runs_of_one_name_are_told_apart_by_their_folders(tmp_path):
    paths = [tmp_path / "k" / "a", tmp_path / "both" / "a", tmp_path / "b" / "checkpoint.pt", tmp_path / "k.pt"]
    assert run_names(paths) == ["k/a", "both/a", "b", "k"]
    assert run_names([shipped_checkpoint(), tmp_path / "small.pt"]) == ["shipped", "small"]
    with pytest.raises(InputError, match="is given twice"):
        run_names([tmp_path / "a", tmp_path / "x" / ".." / "a"])


def test_the_page_says_how_object_flow_fares_beside_direct_flow(made):
    text = (made[0] / "index.html").read_text()
    said = re.search(
        r"Here, on K\+AK, a car&#x27;s flow from its one motion is off by ([\d.]+) m .*? by ([\d.]+) m", text
    )
    ours = {way: rows_of(made, table=2, eval_set="K+AK", method=way) for way in ("object", "direct")}
    means = [f"{np.mean([row['fg_epe'] for row in ours[way]]):.2f}" for way in ("object", "direct")]
    assert list(said.groups()) == means


def test_several_processes_say_the_same_as_one(place, tmp_path, without_figures):
    found = [tables(options(place, tmp_path / str(jobs), jobs=jobs), (*QUICK, LATE)) for jobs in (1, 2)]
    alone, beside = ([{**row, "seconds": None} for row in one.rows] for one in found)
    assert beside == alone
    assert "2 processes side by side" in (tmp_path / "2" / "index.html").read_text()
    assert "side by side" not in (tmp_path / "1" / "index.html").read_text()


def test_a_killed_process_is_told_in_a_line(place, tmp_path, without_figures):
    killed = Compared("killed", "Killed", killed_by_the_system)
    with pytest.raises(MachineError, match="a worker process was killed"):
        tables(options(place, tmp_path / "report", jobs=2), (killed,))
