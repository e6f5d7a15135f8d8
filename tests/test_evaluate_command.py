"""`pointflownet evaluate` and `predict` as typed: figures of a data set to files, bad input in one line."""

import csv
import json
import shutil
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from scored_pair import SETTINGS, a_data_set, a_run
from typer.testing import CliRunner

from training import evaluate as module
from training.cli import app
from training.predictions import Predictions

METHODS = ["direct", "dense", "object", "zero", "ego_true", "ego_registration"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    a_data_set(folder / "aug")
    a_data_set(folder / "k")
    a_data_set(folder / "unsplit", splits=False, recordings=1)
    a_run(folder / "run")
    a_run(folder / "other", seed=1)
    return folder


def asked(*words):
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})


def refused(*words):
    """The one line of a refusal."""
    answer = asked(*words)
    assert answer.exit_code == 2, answer.output
    lines = answer.stderr.strip().splitlines()
    assert len(lines) == 1, answer.stderr
    assert lines[0].startswith("pointflownet: ")
    return lines[0]


def test_a_run_is_scored_beside_the_baselines_into_files(place, tmp_path):
    answer = asked(
        "evaluate", place / "run", "--data", place / "aug", "--json", tmp_path / "a.json", "--csv", tmp_path / "a.csv",
        "--tex", tmp_path / "a.tex", "--pictures", tmp_path / "pictures",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert "Van neutral; boxes under 5 points ignored" in answer.output
    written = json.loads((tmp_path / "a.json").read_text())
    assert [row["method"] for row in written["rows"]] == METHODS
    assert len({(row["pairs"], row["fg_points"], row["bg_points"], row["objects"]) for row in written["rows"]}) == 1
    assert written["rows"][0]["pairs"] == 2
    assert written["about"]["step"] == 7
    assert written["about"]["split"] == "test"
    assert written["rows"][3]["ap_bev50"] is None
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert [row["method"] for row in csv.DictReader(lines)] == METHODS
    assert (tmp_path / "a.tex").read_text().startswith("aug & direct & ")
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == ["best.png", "median.png", "worst.png"]


def test_plain_and_augmented_sets_with_pairs_of_the_same_names_are_scored_together(place, tmp_path):
    file = tmp_path / "a.json"
    words = ["evaluate", place / "run", "--data", place / "aug", "--data", place / "k", "--limit", 1]
    answer = asked(*words, "--json", file, "--predictions", tmp_path / "p", "--tex", tmp_path / "tex")
    assert answer.exit_code == 0, answer.output
    assert {row["pairs"] for row in json.loads(file.read_text())["rows"]} == {2}
    with Predictions(tmp_path / "p") as found:
        names = [one.pair_id for one in found]
    assert [name.split(":")[0] for name in names] == ["aug", "k"]
    assert (tmp_path / "tex").read_text().startswith("aug+k & direct & ")
    sets = module._Sets([place / "aug", place / "k"], "test")
    assert sets.find(names[1]).pair_id == names[1]


def test_all_pairs_of_a_set_without_splits(place, tmp_path):
    answer = asked("evaluate", place / "run", "--data", place / "unsplit", "--split", "all", "--json", tmp_path / "a")
    assert answer.exit_code == 0, answer.output
    assert json.loads((tmp_path / "a").read_text())["rows"][0]["pairs"] == 2


def test_without_a_run_the_shipped_checkpoint_is_scored(place, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "shipped_checkpoint", lambda: place / "run" / "checkpoint.pt")
    answer = asked("evaluate", "--data", place / "aug", "--limit", 1, "--json", tmp_path / "a")
    assert answer.exit_code == 0, answer.output
    written = json.loads((tmp_path / "a").read_text())
    assert written["about"]["checkpoint"] == "shipped"
    assert written["rows"][0]["pairs"] == 1


def test_kept_predictions_are_scored_without_the_network_and_not_under_another_ones_name(place, tmp_path):
    kept = tmp_path / "p"
    first = asked("evaluate", place / "run", "--data", place / "aug", "--predictions", kept, "--json", tmp_path / "a")
    assert first.exit_code == 0, first.output
    again = ["evaluate", "--data", place / "aug", "--predictions", kept, "--json", tmp_path / "b"]
    answer = asked(*again)
    assert answer.exit_code == 0, answer.output
    assert "scored as they are" in answer.output
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert asked("evaluate", place / "run", *again[1:]).exit_code == 0
    assert "another checkpoint than" in refused("evaluate", place / "other", *again[1:])
    assert "holds no pair" in refused(*again, "--split", "train")


def test_what_is_neutral_can_be_chosen(place, tmp_path):
    words = ["evaluate", place / "run", "--data", place / "aug", "--limit", 1, "--json", tmp_path / "a"]
    points = []
    for more in ([], ["--neutral", "none"], ["--neutral", "Truck, Van"], ["--least-points", 61]):
        assert asked(*words, *more).exit_code == 0
        row = json.loads((tmp_path / "a").read_text())["rows"][0]
        points.append((row["fg_points"], row["bg_points"], row["objects"]))
    assert points == [(120, 60, 2), (120, 120, 2), (120, 60, 2), (0, 60, 0)]
    assert "cannot be neutral" in refused(*words, "--neutral", "Van,Car")


def test_data_sets_that_cannot_be_scored_are_told(place, tmp_path):
    run = place / "run"
    assert "has no splits" in refused("evaluate", run, "--data", place / "unsplit")
    assert "does not exist" in refused("evaluate", run, "--data", tmp_path / "nowhere", "--split", "all")
    assert "given twice" in refused("evaluate", run, "--data", place / "aug", "--data", place / "aug")
    assert "no split `exam`" in refused("evaluate", run, "--data", place / "aug", "--split", "exam")
    (tmp_path / "empty").mkdir()
    assert "empty" in refused("evaluate", run, "--data", tmp_path / "empty", "--split", "all")
    a_data_set(tmp_path / "two", recordings=2)  # none left for validation
    assert "holds no pair in validation" in refused(
        "evaluate", run, "--data", tmp_path / "two", "--split", "validation"
    )


def test_damaged_shards_and_shards_of_another_contract_are_told(place, tmp_path):
    run = place / "run"
    a_data_set(tmp_path / "cut")
    for path in (tmp_path / "cut" / "data").iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    assert ".parquet" in refused("evaluate", run, "--data", tmp_path / "cut")
    a_data_set(tmp_path / "newer")
    for path in (tmp_path / "newer" / "data").iterdir():
        table = pq.read_table(path)
        content = json.loads(table.schema.metadata[b"augkitti"]) | {"contract": 99}
        pq.write_table(table.replace_schema_metadata({b"augkitti": json.dumps(content)}), path, row_group_size=1)
    assert "99" in refused("evaluate", run, "--data", tmp_path / "newer")
    shutil.copytree(place / "aug", tmp_path / "index")
    file = tmp_path / "index" / "dataset.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"contract": 99}))
    assert "99" in refused("evaluate", run, "--data", tmp_path / "index")


def test_runs_that_are_none_are_told(place, tmp_path):
    data = ["--data", place / "aug"]
    assert "does not exist" in refused("evaluate", tmp_path / "nowhere", *data)
    (tmp_path / "text.pt").write_text("hello")
    assert "not readable as a checkpoint" in refused("evaluate", tmp_path / "text.pt", *data)
    import torch

    content = torch.load(place / "run" / "checkpoint.pt", weights_only=True)
    wider = SETTINGS.model_copy(update={"network": SETTINGS.network.model_copy(update={"vfe": (8, 12)})})
    other = content | {"settings": wider.model_dump_json(by_alias=True), "digest": wider.digest()}
    torch.save(other, tmp_path / "wider.pt")
    assert "other layers" in refused("evaluate", tmp_path / "wider.pt", *data)
    torch.save(content | {"digest": "0"}, tmp_path / "digest.pt")
    assert "digest" in refused("evaluate", tmp_path / "digest.pt", *data)


def test_a_device_without_memory_left_is_told(place, monkeypatch):
    import torch

    def give_way(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate\n2 GiB")

    monkeypatch.setattr(module.Predictor, "__call__", give_way)
    answer = asked("evaluate", place / "run", "--data", place / "aug")
    assert answer.exit_code == 3
    assert len(answer.stderr.strip().splitlines()) == 1
    assert "out of memory" in answer.stderr


def test_files_that_cannot_be_written_are_told_before_the_work(place, tmp_path):
    words = ["evaluate", place / "run", "--data", place / "aug"]
    for option in ("--json", "--csv", "--tex", "--predictions"):
        assert "its folder does not exist" in refused(*words, option, tmp_path / "no" / "file")


def test_the_command_line_imports_nothing_slow_before_it_knows_the_command():
    script = "import sys, training.cli; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not set(loaded.stdout.split()) & {"torch", "numpy", "scipy", "pyarrow", "pydantic", "shapely", "matplotlib"}


def test_a_predictions_file_that_is_none_is_told(place, tmp_path):
    (tmp_path / "p").write_text("hello")
    assert "no predictions file" in refused("evaluate", "--data", place / "aug", "--predictions", tmp_path / "p")


def test_predict_writes_and_refuses_in_one_line(place, tmp_path):
    rng = np.random.default_rng(0)
    rng.uniform(0.5, 15.0, (400, 4)).astype("<f4").tofile(tmp_path / "low.bin")
    rows = np.column_stack(
        [rng.uniform(1, 30, 400), rng.uniform(-15, 15, 400), rng.uniform(-2, 0.5, 400), rng.random(400)]
    )
    rows.astype("<f4").tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", rows)
    np.save(tmp_path / "away.npy", rows - [100.0, 0, 0, 0])
    words = ["--out", tmp_path / "flow.npz", "--run", place / "run"]
    answer = asked("predict", tmp_path / "a.bin", tmp_path / "b.npy", *words)
    assert answer.exit_code == 0, answer.output
    with np.load(tmp_path / "flow.npz") as found:
        assert {"xyz0", "flow0", "ego_motion", "boxes", "motions", "scores"} <= set(found)
    a, b = tmp_path / "a.bin", tmp_path / "b.npy"
    assert "away.npy, scan 1: none of its 400 points lies in the grid" in refused(
        "predict", a, tmp_path / "away.npy", *words
    )
    assert "does not exist" in refused("predict", a, tmp_path / "c.bin", *words)
    assert "no reader for `.xyz`" in refused("predict", a, tmp_path / "c.xyz", *words)
    assert "does not exist" in refused("predict", a, b, "--out", tmp_path / "x.npz", "--run", tmp_path / "no")
    assert "its folder does not exist" in refused("predict", a, b, "--out", tmp_path / "no" / "x.npz")
    assert "its folder does not exist" in refused("predict", a, b, *words, "--picture", tmp_path / "no" / "x.png")
