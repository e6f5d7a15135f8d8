"""The command line: what its options are, what it says first, what it leaves alone."""

import re
from pathlib import Path

import pytest
import typer
import yaml
from tiny_drive import write_drive

import pipelines.cache
import pipelines.cli as cli
from augkitti import __version__
from augkitti.config import Config, load_config
from augkitti.dataset_index import read_index
from pipelines.cli import DEFAULT_OUT
from pipelines.streets import Streets


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    write_drive(root, frames=(7, 8, 9))
    return root


GENERATE = [
    *("--kitti", "--cad", "--out", "--n", "--seed", "--jobs", "--cars", "--categories", "--min-points", "--glass"),
    *("--shutter", "--profile", "--config", "--on-error", "--resume", "--dry-run"),
]


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("generate", GENERATE),
        ("split", ["--ratios", "--seed", "--like", "--allow-frames-split"]),
        ("validate", ["--kitti", "--jobs", "--json"]),
        ("view", ["--pair", "--out"]),
        ("info", ["--json", "--out", "--kitti"]),
        ("synthesize", ["--out", "--drives", "--frames", "--seed", "--jobs"]),
        ("cad check", ["--sheet"]),
        ("data status", ["--kitti"]),
        ("prepare", ["--kitti", "--out"]),
        ("augment", ["--jobs"]),
        ("finish", []),
    ],
)
def test_a_command_has_the_options_that_others_rely_on(augkitti, command, options):
    result = augkitti(*command.split(), "--help")
    assert result.exit_code == 0
    offered = set(re.findall(r"--[a-z-]+", result.output)) | ({"--n"} if "--n " in result.output else set())
    assert set(options) <= offered


def test_stages_say_what_they_read_and_write(augkitti):
    for stage in ("prepare", "augment", "finish"):
        text = augkitti(stage, "--help").output
        assert "Reads" in text
        assert "writes" in text


def test_config_show_prints_yaml_that_reads_back_as_the_defaults(augkitti, tmp_path):
    result = augkitti("config", "show")
    (tmp_path / "settings.yaml").write_text(result.output)
    assert load_config(tmp_path / "settings.yaml") == Config()
    keys = [line for line in result.output.splitlines() if re.match(r"\s*[a-z_]\w*:", line)]
    whys = [line for line in result.output.splitlines()[1:] if line.strip().startswith("# ")]
    assert len(whys) == len(keys)
    assert all(len(line.strip()) > 8 for line in whys), "a line of why for each key"


def test_config_show_of_a_file_shows_what_it_changes(augkitti, tmp_path):
    (tmp_path / "settings.yaml").write_text("min_points: 33\n")
    assert yaml.safe_load(augkitti("config", "show", "--config", "settings.yaml").output)["min_points"] == 33


def test_dry_run_prints_the_plan_with_disk_and_time_and_touches_nothing(augkitti, kitti, tmp_path):
    before = sorted(tmp_path.rglob("*"))
    result = augkitti("generate", "--kitti", kitti, "--n", 5, "--dry-run", "--jobs", 2)
    assert result.exit_code == 0, result.output
    assert "2011_09_26_drive_0005_sync" in result.output
    assert re.search(r"5 pairs of 3 scans: about [\d.,]+ GB on disk", result.output)
    assert "--jobs 2" in result.output
    assert sorted(tmp_path.rglob("*")) == before


def test_without_kitti_the_first_line_says_that_streets_stand_in_and_where_they_are_kept(augkitti, tmp_path):
    result = augkitti("generate", "--n", 20, "--dry-run")
    assert result.exit_code == 0, result.output
    first = result.output.splitlines()[0]
    assert "EMBEDDED STREETS" in first
    assert "not real KITTI" in first
    assert "4 streets of seed 0" in first
    assert str(tmp_path / "cache") in first
    assert not (tmp_path / "cache").exists()


def test_kitti_is_found_through_the_environment(augkitti, kitti, monkeypatch):
    monkeypatch.setenv("AUGKITTI_KITTI", str(kitti))
    assert f"KITTI at {kitti}" in augkitti("generate", "--n", 1, "--dry-run").output.splitlines()[0]


def test_out_defaults_to_one_folder_for_all_commands(augkitti, kitti):
    result = augkitti("generate", "--kitti", kitti, "--n", 2, "--cars", 0)
    assert result.exit_code == 0, result.output + result.stderr
    assert read_index(DEFAULT_OUT).rows == 2
    assert augkitti("validate", "--kitti", kitti, "--json", "report.json").exit_code == 0
    assert Path("report.json").is_file()
    assert augkitti("info", "--json").exit_code == 0
    assert "--allow-frames-split" in augkitti("split", "--ratios", 70, 10, 20).stderr
    again = augkitti("generate", "--kitti", kitti, "--n", 2, "--cars", 0, "--resume")
    assert again.exit_code == 0
    assert "nothing to do" in again.output


def test_categories_may_be_repeated_or_stand_between_commas(augkitti, kitti):
    for words in (["--categories", "Car,Van"], ["--categories", "Car", "--categories", "Van"]):
        assert augkitti("generate", "--kitti", kitti, "--n", 1, *words, "--dry-run").exit_code == 0


def test_an_interrupt_ends_with_130_and_a_line_that_says_how_to_go_on(augkitti, kitti, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.generate.augment_all", interrupted)
    result = augkitti("generate", "--kitti", kitti, "--n", 1, "--cars", 0)
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1].endswith("go on with --resume")
    assert not Path("augkitti-data/dataset.json").exists()
    monkeypatch.undo()


@pytest.mark.parametrize("n", [1, 5, 6, 20, 100])
def test_there_is_a_street_for_every_ten_pairs_at_least(n, tmp_path):
    from augkitti.scanner import load_profile
    from pipelines.streets import find_streets

    streets = find_streets(n, 0, load_profile(), tmp_path)
    assert isinstance(streets, Streets)
    assert streets.drives * 10 >= n
    assert streets.drives * (streets.frames - 1) >= n


def test_the_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("AUGKITTI_CACHE", str(tmp_path / "a"))
    assert pipelines.cache.cache_folder() == tmp_path / "a"
    monkeypatch.delenv("AUGKITTI_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "b"))
    assert pipelines.cache.cache_folder() == tmp_path / "b" / "augkitti"


def test_the_cache_is_shown_and_cleared(augkitti, tmp_path, monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE_GB", "5")
    folder = tmp_path / "cache" / "prepared" / "ab"
    folder.mkdir(parents=True)
    for name, size in (("one.arrays", 20_000_000), ("notes.txt", 1)):
        with (folder / name).open("wb") as file:
            file.truncate(size)
    shown = augkitti("cache", "info")
    assert shown.exit_code == 0
    assert shown.output.splitlines() == [
        f"{tmp_path / 'cache'}: 0.02 of at most 5.0 GB (augkitti {__version__})",
        *("  prepared: 1, 0.02 GB", "  cad: 0, 0.00 GB", "  cad-copies: 0, 0.00 GB", "  streets: 0, 0.00 GB"),
    ]
    cleared = augkitti("cache", "clear")
    assert (cleared.exit_code, cleared.output) == (0, "1 entries removed, 0.02 GB\n")
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    monkeypatch.setenv("AUGKITTI_CACHE_GB", "much")
    refused = augkitti("cache", "info")
    assert refused.exit_code == 2
    assert refused.stderr.startswith("augkitti: AUGKITTI_CACHE_GB: ")


def test_the_embedded_default_is_generated_and_checked_against_the_streets_in_the_cache(augkitti, tmp_path):
    result = augkitti("generate", "--n", 1, "--cars", "1", "--out", "aug")
    assert result.exit_code == 0, result.output + result.stderr
    source = read_index(Path("aug")).source
    assert source["kind"] == "embedded"
    folder = next((tmp_path / "cache" / "streets").iterdir())
    assert source["digest"].startswith(folder.name)
    report = augkitti("validate", "aug", "--json", "report.json")
    assert report.exit_code == 0, report.output
    assert "--kitti" not in report.output, "the streets are found in the cache"


@pytest.mark.parametrize(
    ("at_end", "told"), [("; go on", "augkitti: interrupted; go on\n"), ("", "augkitti: interrupted\n")]
)
def test_an_interrupt_offers_to_go_on_only_where_a_command_can(capsys, at_end, told):
    with pytest.raises(typer.Exit) as left, cli._answers(at_end):
        raise KeyboardInterrupt
    assert left.value.exit_code == 130
    assert capsys.readouterr().err == told
