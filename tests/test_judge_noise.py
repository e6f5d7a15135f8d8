"""`judge-noise` and `fit-noise`: clear refusals, and figures by flat keys."""

import json
from pathlib import Path

import pytest
from tiny_drive import write_drive, write_odometry
from typer.testing import CliRunner

from augkitti import kitti, range_noise
from augkitti.errors import InputError
from augkitti.scanner import load_profile
from pipelines import fit_noise, judge_noise
from pipelines.cli import app

KEYS = (
    *("nll.constant", "nll.parametric", "nll.network", "nll.shipped", "coverage68", "coverage95", "drop.predicted"),
    *("drop.observed", "drop.clump_predicted", "drop.clump_observed", "share_kept"),
)


def test_compensated_scans_are_refused_for_a_raw_profile(tmp_path: Path) -> None:
    write_odometry(tmp_path)
    with pytest.raises(InputError, match=r"compensated.*nothing can be fitted"):
        judge_noise.raw_scans(kitti.open_root(tmp_path))
    answer = CliRunner().invoke(app, ["judge-noise", "--kitti", str(tmp_path)])
    assert answer.exit_code == 2


def test_compensated_scans_beside_raw_ones_are_left_out_and_counted(tmp_path: Path) -> None:
    write_odometry(tmp_path)
    write_drive(tmp_path, frames=(0, 1))
    root = kitti.open_root(tmp_path)
    assert {sequence.kind for sequence, _ in judge_noise.raw_scans(root)} == {"raw"}
    assert str(judge_noise.left_out(root)).startswith("2 compensated scans are left out")


def test_without_labels_silhouettes_are_not_known(tmp_path: Path) -> None:
    write_drive(tmp_path, frames=(0, 1), labels="none")
    assert fit_noise.vehicle_edges(kitti.open_root(tmp_path), load_profile()) is None


def test_one_drive_cannot_be_compared_and_the_way_out_is_named(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("torch")
    write_drive(tmp_path, frames=(0, 1, 2, 3))
    with pytest.raises(InputError, match=r"one drive only.*--no-compare"):
        fit_noise.fit_noise(tmp_path, tmp_path / "profile")


def test_too_few_scans_say_what_can_still_be_fitted(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    write_drive(tmp_path, frames=(0, 1))
    with pytest.raises(InputError, match=r"2 raw scans.*fit-sensor"):
        fit_noise.fit_noise(tmp_path, tmp_path / "profile")


def test_no_kitti_is_told_in_one_line(monkeypatch) -> None:
    monkeypatch.delenv("AUGKITTI_KITTI", raising=False)
    for command in ("judge-noise", "fit-noise"):
        assert CliRunner().invoke(app, [command]).exit_code == 2


def test_generating_with_a_scanner_that_has_no_noise_stops_at_once_and_names_the_command(tmp_path: Path) -> None:
    content = {key: value for key, value in load_profile().content.items() if key != "noise"}
    (tmp_path / "profile.json").write_text(json.dumps(content))
    command = ["generate", "--profile", str(tmp_path), "--n", "1", "--out", str(tmp_path / "out")]
    answer = CliRunner().invoke(app, command)
    assert answer.exit_code == 2
    assert "augkitti fit-noise --profile FOLDER" in " ".join(answer.output.split())


def test_a_folder_without_a_profile_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fit-noise"):
        judge_noise.profile_of(tmp_path / "none")


def test_figures_come_with_all_keys_and_no_clumps_without_labels(tmp_path: Path) -> None:
    write_drive(tmp_path, frames=(0,))
    lines: list[str] = []
    found = judge_noise.judge_noise(tmp_path, None, tmp_path / "out" / "figures.json", lines.append)
    stored = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert set(KEYS) <= set(stored)
    assert found == stored
    assert 0.0 < stored["share_kept"] <= 1.0
    assert stored["nll.shipped"] == stored[f"nll.{stored['shipped']}"]
    assert stored["drop.classes"] == stored[f"drop.classes.{stored['shipped_drop']}"]
    assert any("drops" in line for line in lines)
    assert [line.split()[0] for line in lines[2:6]] == ["constant", "parametric", "network", "shipped"]
    assert "clumps: too few labelled vehicles to tell" in lines


def test_a_written_profile_is_read_back_with_all_that_simulation_needs(tmp_path: Path) -> None:
    shipped = range_noise.load_noise()
    (tmp_path / "README.md").write_text("the scanner's own card")
    fit_noise.write_profile(tmp_path, shipped, load_profile())
    scanner, noise = judge_noise.profile_of(tmp_path)
    assert scanner.content["noise"]["solid"] == range_noise.solid_part(shipped)
    assert noise.shipped == shipped.shipped
    assert scanner.range_bias_m == pytest.approx(shipped.bias_m, abs=1e-5)
    assert (tmp_path / "README.md").read_text() == "the scanner's own card"
    card = (tmp_path / "noise.md").read_text()
    for words in ("Fitted on", "What it cannot know", "bias common to all beams"):
        assert words in card


def test_shipped_scanner_profile_holds_the_shipped_noise() -> None:
    noise, scanner = range_noise.load_noise(), load_profile()
    assert scanner.content["noise"]["solid"] == range_noise.solid_part(noise)
    assert scanner.range_bias_m == pytest.approx(noise.bias_m, abs=1e-5)


def test_the_better_model_on_unseen_drives_is_chosen() -> None:
    folds = [
        {"nll.parametric": 0.0, "nll.network": -0.1, "drop.logloss.parametric": 0.1, "drop.logloss.network": 0.2},
        {"nll.parametric": 0.1, "nll.network": 0.05, "drop.logloss.parametric": 0.3, "drop.logloss.network": 0.05},
    ]
    assert fit_noise.better_models(folds) == ("network", "network")
    assert fit_noise.better_models(folds[:1]) == ("network", "parametric")


def test_figures_of_a_fold_are_those_of_the_models_that_ship() -> None:
    keys = ("nll", "coverage68", "coverage95", "drop.predicted", *judge_noise.CLASS_KEYS)
    fold = {f"{key}.{model}": f"{key} {model}" for key in keys for model in range_noise.MODELS}
    found = fit_noise.as_shipped({**fold, "nll.shipped": ""}, "parametric", "network")
    assert found["nll.shipped"] == "nll parametric"
    assert found["coverage68"] == "coverage68 parametric"
    assert found["drop.classes_within"] == "drop.classes_within network"


@pytest.mark.kitti
def test_shipped_profile_beats_a_constant_on_real_scans(kitti_root: Path) -> None:
    root = kitti.open_root(kitti_root)
    judged = judge_noise.judge_scans(judge_noise.raw_scans(root)[:2], load_profile(), share=0.1)
    figures = judge_noise.figures_of(range_noise.load_noise(), judged)
    assert figures["nll.shipped"] < figures["nll.constant"] - 0.3
    assert figures["drop.logloss.parametric"] < figures["drop.logloss.constant"]
