"""What people expect of a command: JSON alone on stdout, quiet, progress, completion, exit codes, a whole wheel."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from tiny_drive import write_drive
from typer.main import get_command
from typer.testing import CliRunner

import augkitti
from augkitti import command_line
from augkitti.export import FORMATS
from pipelines.cli import EXPORTS, app

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A root with a drive, a data set of two pairs made from it, a folder of a broken car model."""
    folder = tmp_path_factory.mktemp("habits")
    write_drive(folder / "kitti", frames=(7, 8, 9))
    (folder / "cars").mkdir()
    shutil.copy(ROOT / "tests" / "car_files.py", folder / "cars" / "car.txt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AUGKITTI_CACHE", str(folder / "cache"))
        words = ["generate", "--kitti", str(folder / "kitti"), "--n", "2", "--cars", "0", "--out", str(folder / "aug")]
        made = CliRunner().invoke(app, [*words, "--json"])
    assert made.exit_code == 0, made.stderr
    (folder / "made.json").write_text(made.stdout)
    return folder


@pytest.fixture
def run(place, monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE", str(place / "cache"))
    monkeypatch.delenv("AUGKITTI_KITTI", raising=False)
    monkeypatch.chdir(place)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize(
    ("words", "code", "keys"),
    [
        ("info aug", 0, {"pairs", "points", "virtual"}),
        ("validate aug --kitti kitti", 0, {"ok", "pairs", "invariants"}),
        ("split aug --ratios 100 0 0", 0, {"splits", "divides_recordings"}),
        ("data status --kitti kitti", 0, {"root", "drives"}),
        ("cache info", 0, {"folder", "kinds", "most_bytes"}),
        ("config show", 0, {"configuration", "configuration_digest"}),
        ("generate --kitti kitti --n 2 --cars 0 --out aug --resume", 0, {"pairs", "already_made"}),
        ("generate --kitti kitti --n 4 --cars 0 --out new --dry-run", 0, {"pairs", "scans", "sequences", "about"}),
        ("generate --n 4 --out new --dry-run", 0, {"pairs", "scans", "about"}),
    ],
)
def test_reporting_commands_print_json_alone_on_stdout_with_the_version(run, words, code, keys):
    result = run(*words.split(), "--json")
    assert result.exit_code == code, result.stderr
    content = json.loads(result.stdout)
    assert content["program_version"] == augkitti.__version__
    assert keys <= set(content)


def test_the_end_report_of_generate_is_json_too(place):
    made = json.loads((place / "made.json").read_text())
    assert (made["asked"], made["pairs"], made["program_version"]) == (2, 2, augkitti.__version__)
    assert made["totals"]["points"] > 0


def test_json_with_a_file_writes_it_beside_the_table(run, place):
    result = run("validate", "aug", "--kitti", "kitti", "--json", "report.json")
    assert "invariant" in result.stdout
    report = json.loads((place / "report.json").read_text())
    assert (report["ok"], report["program_version"]) == (True, augkitti.__version__)
    assert report == json.loads(run("validate", "--kitti", "kitti", "aug", "--json").stdout)


def test_json_before_a_folder_is_not_taken_for_the_file_to_write(run):
    result = run("validate", "--json", "aug")
    assert result.exit_code == 2
    assert "give --json last" in result.stderr


def test_quiet_leaves_nothing_of_a_run_and_all_of_what_was_asked_for(run):
    result = run("generate", "--kitti", "kitti", "--n", 1, "--cars", 0, "--out", "quiet", "--quiet")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    assert "totals" in run("--quiet", "info", "aug").stdout
    refused = run("--quiet", "info", "nowhere")
    assert refused.exit_code == 2
    assert refused.stderr.count("\n") == 1


def test_verbose_tells_versions_and_the_traceback_behind_an_error(run):
    result = run("info", "nowhere", "--verbose")
    assert result.exit_code == 2
    assert f"augkitti {augkitti.__version__}" in result.stderr
    assert "numpy" in result.stderr
    assert "Traceback" in result.stderr
    assert "Traceback" not in run("info", "nowhere").stderr
    assert json.loads(run("info", "aug", "--json", "--verbose").stdout)["pairs"] == 2


def test_a_value_that_looks_like_a_global_option_stays_behind_two_dashes(run):
    assert "--quiet: does not exist" in run("info", "--", "--quiet").stderr


def test_piped_tables_hold_no_escapes_and_forced_colour_is_obeyed(place):
    def printed(**variables):
        environment = {**os.environ, "AUGKITTI_CACHE": str(place / "cache"), **variables}
        for name in {"FORCE_COLOR", "NO_COLOR", "COLUMNS"} - set(variables):
            environment.pop(name, None)
        words = [sys.executable, "-m", "augkitti", "info", "aug"]
        environment["PYTHONPATH"] = str(ROOT)
        return subprocess.run(words, cwd=place, env=environment, capture_output=True, text=True, check=True).stdout

    plain = printed(CI="true", COLUMNS="40")
    assert "\x1b" not in plain
    forced = printed(FORCE_COLOR="1")
    assert "\x1b" in forced
    assert re.sub(r"\x1b\[[0-9;]*m", "", forced) == plain


def test_colour_is_off_on_a_terminal_with_no_color(place):
    import pty

    read, write = pty.openpty()
    environment = {**os.environ, "NO_COLOR": "1", "TERM": "xterm-256color", "PYTHONPATH": str(ROOT)}
    script = "from augkitti.command_line import counted\nfor _ in counted(range(3), 3, 'things'): pass"
    subprocess.run([sys.executable, "-c", script], env=environment, stderr=write, check=True)
    os.close(write)
    told = os.read(read, 100_000).decode()
    os.close(read)
    assert "3 of 3" in told
    assert not re.findall(r"\x1b\[[0-9;]*3[0-9][0-9;]*m", told), "no colour"


def test_progress_without_a_terminal_is_a_plain_line_now_and_then(capsys, monkeypatch):
    command_line.begin(quiet=False, verbose=False)
    clock = iter([0.0, 4.0, 12.0, 20.0, 50.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with command_line.progress(200, "pairs") as done:
        for _ in range(4):
            done(25)
    monkeypatch.undo()
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.splitlines() == [
        "50 of 200 pairs, 4.2 a second, 36 s left",
        "100 of 200 pairs, 2 a second, 50 s left",
    ]


def test_quiet_progress_says_nothing(capsys, monkeypatch):
    command_line.begin(quiet=True, verbose=False)
    monkeypatch.setattr(command_line, "_FIRST_LINE_S", -1.0)
    assert list(command_line.counted([1, 2], 2, "things")) == [1, 2]
    command_line.begin(quiet=False, verbose=False)
    assert capsys.readouterr() == ("", "")


def test_progress_within_progress_shows_the_outer_one_alone(monkeypatch, capsys):
    command_line.begin(quiet=False, verbose=False)
    monkeypatch.setattr(command_line, "_FIRST_LINE_S", -1.0)
    for _ in command_line.counted([1], 1, "folds"):
        assert list(command_line.counted([1, 2], 2, "steps")) == [1, 2]
    assert list(command_line.counted([1], 1, "scans")) == [1]
    told = capsys.readouterr().err
    assert "1 of 1 folds" in told
    assert "steps" not in told
    assert "1 of 1 scans" in told, "the next one is shown again"


def test_json_text_has_null_for_what_is_no_number():
    assert json.loads(command_line.as_json({"a": [float("nan"), 1.0], "b": {"c": float("inf")}})) == {
        "program_version": augkitti.__version__,
        "a": [None, 1.0],
        "b": {"c": None},
    }


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(("program", "module"), [("augkitti", "pipelines"), ("pointflownet", "training")])
def test_bash_completes_commands_and_options(tmp_path, program, module):
    command = tmp_path / program
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
    command.chmod(0o755)
    script = f"""
        eval "$({program} --show-completion bash)"
        complete -p {program} | grep -q _{program}_completion || exit 9
        ask() {{
            COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
            _{program}_completion {program}
            echo "${{COMPREPLY[@]}}"
        }}
        ask {program} ''
        ask {program} {"info --j" if program == "augkitti" else "evaluate --js"}
    """
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "--norc", "-c", script], env=environment, capture_output=True, text=True, check=True)
    commands, options = done.stdout.splitlines()
    assert ("generate" if program == "augkitti" else "evaluate") in commands.split()
    assert options == "--json"


def test_export_completes_every_format_that_there_is():
    assert set(EXPORTS) == set(FORMATS)
    (option,) = (option for option in get_command(app).commands["export"].params if option.name == "form")
    assert [item.value for item in option.shell_complete(None, "")] == list(EXPORTS)


def test_the_library_runs_as_a_module_and_knows_its_name():
    words = [sys.executable, "-m", "augkitti", "--help"]
    shown = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert shown.startswith("Usage: augkitti ")


def test_docs_list_every_exit_code_that_the_commands_end_with():
    table = (ROOT / "docs" / "cli.md").read_text().split("## Exit codes")[1].split("##")[0]
    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", table, flags=re.MULTILINE)}
    used = {
        int(code)
        for package in ("pipelines", "training")
        for code in re.findall(r"typer\.Exit\((\d+)\)", (ROOT / package / "cli.py").read_text())
    }
    assert used <= listed
    assert {0, 1, 2, 3, 130, 143} == listed


def test_a_wheel_holds_every_file_that_the_product_needs(tmp_path):
    for name in ("augkitti", "pipelines", "training"):
        shutil.copytree(ROOT / name, tmp_path / "src" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path / "src")
    build = f"from setuptools import build_meta; print(build_meta.build_wheel({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path / "src", capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    tree = subprocess.run(
        ["git", "ls-files", "--", "augkitti", "pipelines", "training"], cwd=ROOT, capture_output=True, text=True
    ).stdout.splitlines()
    if not tree:
        pytest.skip("no git checkout: cannot tell what belongs to the product")
    wanted = {name for name in tree if not name.endswith(".sh")}  # `make tables` alone runs it
    assert wanted <= packed
    assert {"augkitti/profiles/hdl32e.yaml", "training/checkpoints/small.pt"} <= packed


def test_make_check_is_what_ci_runs():
    (script,) = (ROOT / ".ci").iterdir()
    makefile = (ROOT / "Makefile").read_text()
    (parts,) = re.findall(r"^check: (.*?) ##", makefile, flags=re.MULTILINE)
    run = re.findall(r"^make (.*)", script.read_text(), flags=re.MULTILINE)
    assert run == parts.split()
    assert "test" in run
    named = set(re.findall(r"`make (\w+)`", (ROOT / "CONTRIBUTING.md").read_text()))
    assert named <= set(re.findall(r"^(\w+):", makefile, flags=re.MULTILINE))


def test_every_module_that_the_architecture_names_is_there():
    text = (ROOT / "docs" / "architecture.md").read_text() + (ROOT / "docs" / "architecture.svg").read_text()
    there = {
        path.name
        for package in ("augkitti", "pipelines", "training", "tests")
        for path in (ROOT / package).glob("*.py")
    }
    named = set(re.findall(r"[a-z_0-9]+\.py", text))
    assert len(named) > 25
    assert named <= there


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["generate", "--n", "0"], "augkitti generate: Invalid value for '--n'"),
        (["info", "--nosuch"], "augkitti info: No such option: --nosuch"),
        (["nosuchcommand"], "augkitti: No such command 'nosuchcommand'"),
    ],
)
def test_what_is_wrong_with_the_words_is_told_in_one_line(capsys, words, said):
    with pytest.raises(SystemExit) as end:
        app(words, prog_name="augkitti")
    told = capsys.readouterr().err
    assert end.value.code == 2
    assert told.startswith(said)
    assert told.endswith(" --help\n")
    assert told.count("\n") == 1
