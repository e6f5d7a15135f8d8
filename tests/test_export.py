"""Exports: what is finished stays, what is not goes on, what is in the way is told in one line."""

import errno
import gc
import json
import os
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path

import pytest
from exported_set import COMPENSATED, ODD, RAW, contents, export, stamps, write_set
from pair_factory import CONFIG
from tiny_shards import write_tiny_set
from typer.testing import CliRunner

import augkitti
from augkitti.dataset import Dataset
from augkitti.dataset_index import INDEX_NAME
from augkitti.errors import MachineError
from augkitti.export import FORMATS, export_pairs, open_export
from augkitti.export.target import scene_name
from augkitti.export.writing import EXPORT_NAME, PAIRS_NAME
from augkitti.scanner import load_profile
from pipelines.cli import app
from pipelines.lock import hold

ROOT = Path(__file__).resolve().parent.parent
QUICK = "kitti-object"


def formats():
    """Every format whose package is here."""
    return [
        pytest.param(name, marks=pytest.mark.skipif(not _is_here(form.module), reason=f"no {form.module} installed"))
        for name, form in FORMATS.items()
    ]


def _is_here(module):
    try:
        return module is None or bool(__import__(module))
    except ImportError:
        return False


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set") / "aug"
    write_set(folder, tick_step=40)
    return folder


@pytest.fixture
def run(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, ["export", *map(str, words)])


@pytest.mark.parametrize("name", formats())
def test_an_interrupted_export_goes_on_to_the_bytes_of_one_that_was_not(name, source, tmp_path):
    export(source, name, tmp_path / "whole")
    export(source, name, tmp_path / "cut", most=2)
    before = stamps(tmp_path / "cut")
    made = export(source, name, tmp_path / "cut")
    assert [one.number for one in made] == [2, 3, 4]
    after = stamps(tmp_path / "cut")
    rewritten = {path for path, stamp in before.items() if after[path] != stamp}
    assert rewritten <= {EXPORT_NAME, PAIRS_NAME}
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")


def test_a_finished_export_is_left_alone(run, source, tmp_path):
    assert run(source, "--format", QUICK, "--out", "out").exit_code == 0
    before = stamps(tmp_path / "out")
    again = run(source, "--format", QUICK, "--out", "out")
    assert again.exit_code == 0
    assert "finished already" in again.stdout
    assert stamps(tmp_path / "out") == before


def test_what_was_cut_or_removed_after_an_export_is_made_again_and_nothing_else(source, tmp_path):
    out = tmp_path / "out"
    export(source, QUICK, out)
    whole, before = contents(out), stamps(out)
    with (out / "training/velodyne/000003.bin").open("r+b") as file:  # of pair 1
        file.truncate(1000)
    (out / "training/calib/000004.txt").unlink()  # of pair 2
    assert [one.number for one in export(source, QUICK, out)] == [1, 2]
    assert contents(out) == whole
    after = stamps(out)
    others = [path for path in before if path.startswith("training") and int(Path(path).stem) // 2 not in (1, 2)]
    assert others
    assert all(after[path] == before[path] for path in others)


def test_a_line_of_the_journal_that_was_written_half_is_passed_over(source, tmp_path):
    out = tmp_path / "out"
    export(source, QUICK, out, most=3)
    journal = out / PAIRS_NAME
    journal.write_bytes(journal.read_bytes()[:-9])
    assert [one.number for one in export(source, QUICK, out)] == [2, 3, 4]
    assert [json.loads(line)["number"] for line in journal.read_text().splitlines()] == [0, 1, 2, 3, 4]


def test_a_killed_command_goes_on_and_leaves_nothing_behind(tmp_path):
    write_tiny_set(tmp_path / "aug", {"0001": (20, 20)}, tick_step=60)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pipelines", "export", str(tmp_path / "aug"), "--format", "hplflownet", "--out"]
    process = subprocess.Popen([*command, str(out)], cwd=ROOT, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 60.0
    while process.poll() is None and time.monotonic() < until:
        if (out / PAIRS_NAME).is_file() and (out / PAIRS_NAME).read_bytes().count(b"}\n") >= 3:
            process.send_signal(signal.SIGKILL)
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL, "it was over before it could be killed"
    assert json.loads((out / EXPORT_NAME).read_text())["finished"] is False
    begun = stamps(out)
    ended = subprocess.run([*command, str(out)], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "found" in ended.stdout
    after = stamps(out)
    firsts = [path for path in begun if Path(path).parent.name in ("000000", "000001")]
    assert len(firsts) == 6
    assert all(after[path] == begun[path] for path in firsts)
    export(tmp_path / "aug", "hplflownet", tmp_path / "whole")
    assert contents(out) == {p: content for p, content in contents(tmp_path / "whole").items() if not p.startswith(".")}


def test_a_full_disk_ends_in_exit_code_three_and_the_same_command_goes_on(run, source, tmp_path, monkeypatch):
    real, count = os.replace, 0

    def replace_until_full(a, b):
        nonlocal count
        count += 1
        if count == 12:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(a, b)

    monkeypatch.setattr("augkitti.export.writing.os.replace", replace_until_full)
    full = run(source, "--format", QUICK, "--out", "out")
    assert full.exit_code == 3
    assert "No space left" in full.stderr
    assert len(full.stderr.splitlines()) == 1
    on = run(source, "--format", QUICK, "--out", "out")
    assert on.exit_code == 0, on.output
    assert "4 pairs made, 1 found" in on.stdout
    assert not (tmp_path / "out" / ".augkitti-export").exists()


def test_the_loop_turns_an_error_of_the_disk_into_one_of_the_machine(source, tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("augkitti.export.writing.os.replace", refuse)
    with pytest.raises(MachineError, match="Permission denied"):
        export(source, QUICK, tmp_path / "out")


def test_one_pair_is_held_at_a_time(tmp_path):
    write_tiny_set(tmp_path / "aug", {"0001": (6,)})
    pairs, most = [], 0

    def count(pair, scene):
        nonlocal most
        pairs.append(weakref.ref(pair))
        del pair
        gc.collect()
        most = max(most, sum(ref() is not None for ref in pairs))
        return {f"{scene.number}.txt": b"x"}

    form = replace(FORMATS[QUICK], files=count)
    dataset = Dataset(tmp_path / "aug")
    made = export_pairs(dataset, open_export(dataset, form, tmp_path / "out", None), CONFIG.ground, load_profile())
    assert len(list(made)) == 6
    assert most <= 2  # the next one is read while the last one's name is still there


def test_a_split_is_exported_alone(run, source, tmp_path):
    result = run(source, "--format", QUICK, "--out", "out", "--split", "test")
    assert result.exit_code == 0, result.output
    rows = [json.loads(line) for line in (tmp_path / "out" / PAIRS_NAME).read_text().splitlines()]
    assert [row["pair_id"] for row in rows] == [f"{ODD}/0/0"]
    assert json.loads((tmp_path / "out" / EXPORT_NAME).read_text())["split"] == "test"


def test_without_a_split_all_pairs_are_exported_under_their_numbers(source, tmp_path):
    made = export(source, QUICK, tmp_path / "out")
    assert {one.number: one.pair_id for one in made} == dict(enumerate(Dataset(source).pair_ids))


def test_what_a_format_cannot_hold_is_printed_in_one_line(run, source):
    result = run(source, "--format", QUICK, "--out", "out")
    assert f"{QUICK} cannot hold: {FORMATS[QUICK].lost}" in result.stdout.splitlines()


def test_the_page_says_of_each_format_what_it_cannot_hold():
    page = " ".join((ROOT / "docs" / "exports.md").read_text().split())
    for name, form in FORMATS.items():
        assert f"## `{name}`" in page
        assert form.lost in page, name


def test_the_command_names_every_format():
    help_text = " ".join(CliRunner(env={"COLUMNS": "300"}).invoke(app, ["export", "--help"]).stdout.split())
    assert ", ".join(FORMATS) in help_text


def test_names_of_scenes_tell_pairs_apart_and_hold_no_dot_or_slash(source):
    names = [scene_name(pair) for pair in augkitti.open(source)]
    assert names == [f"{RAW}-0-0", f"{RAW}-0-1", f"{RAW}-1-0", "my%20drive%2Ev2-0-0", f"{COMPENSATED}-0-0"]


def one_line(result, *parts):
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("augkitti: ")
    assert "; " in line
    for part in parts:
        assert str(part) in line


def test_an_unknown_format_is_answered_with_the_known_ones(run, source, tmp_path):
    one_line(run(source, "--format", "nuscenes", "--out", "out"), "nuscenes", *FORMATS)
    one_line(run(source, "--out", "out"), "--format", *FORMATS)
    assert not (tmp_path / "out").exists()


def test_a_command_without_a_folder_is_told_so(run, source):
    one_line(run(source, "--format", QUICK), "--out", "not given")


def test_an_unfinished_set_is_refused(run, tmp_path):
    write_tiny_set(tmp_path / "aug", {"0001": (1,)})
    (tmp_path / "aug" / INDEX_NAME).unlink()
    one_line(run("aug", "--format", QUICK, "--out", "out"), "aug")
    assert not (tmp_path / "out").exists()


def test_a_split_that_is_not_there_is_answered_with_those_that_are(run, source, tmp_path):
    one_line(run(source, "--format", QUICK, "--out", "out", "--split", "val"), "`val`", "train, validation, test")
    assert not (tmp_path / "out").exists()


def test_a_folder_with_another_export_is_refused(run, source, tmp_path):
    run(source, "--format", QUICK, "--out", "out")
    before = stamps(tmp_path / "out")
    one_line(run(source, "--format", "semantickitti", "--out", "out"), "another export", QUICK)
    one_line(run(source, "--format", QUICK, "--out", "out", "--split", "test"), "another export", "split 'all'")
    write_tiny_set(tmp_path / "other", {"0001": (2,)})
    one_line(run("other", "--format", QUICK, "--out", "out"), "another export")
    assert stamps(tmp_path / "out") == before


def test_a_folder_with_other_things_is_refused(run, source, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    one_line(run(source, "--format", QUICK, "--out", "out"), "thesis.tex", "name a new folder")
    one_line(run(source, "--format", QUICK, "--out", "out/thesis.tex"), "is no folder")
    assert list(contents(tmp_path / "out")) == ["thesis.tex"]


def test_a_missing_package_is_named_with_what_to_install(run, source, monkeypatch, tmp_path):
    monkeypatch.setattr("augkitti.export.writing.find_spec", lambda name: None)
    one_line(run(source, "--format", "opensceneflow", "--out", "out"), "h5py", 'pip install "augkitti[export]"')
    assert run(source, "--format", QUICK, "--out", "out").exit_code == 0


def test_a_place_that_is_no_local_folder_is_refused(run, source):
    one_line(run(source, "--format", QUICK, "--out", "memory://bucket/out"), "local folder")


def test_two_runs_do_not_write_one_folder(run, source, tmp_path):
    with hold(tmp_path / "out" / ".augkitti-export"):
        one_line(run(source, "--format", QUICK, "--out", "out"), "out")
    assert run(source, "--format", QUICK, "--out", "out").exit_code == 0
