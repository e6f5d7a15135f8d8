"""Bad input at the level of the command: one line with place, problem and remedy; exit code 2; nothing written."""

import shutil
from pathlib import Path

import pytest
from tiny_drive import write_drive, write_odometry
from typer.testing import CliRunner

from augkitti.dataset_index import read_index
from pipelines.cli import app

DRIVE = Path("raw/2011_09_26/2011_09_26_drive_0005_sync")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    write_drive(root, frames=(0, 1, 2, 3), name=DRIVE.name)
    write_odometry(root)
    return root


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def augkitti(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("AUGKITTI_CACHE", str(cache))
    monkeypatch.delenv("AUGKITTI_KITTI", raising=False)
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def assert_one_line(result, *parts):
    assert result.exit_code == 2, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("augkitti: ")
    assert "; " in lines[0], "problem; remedy"
    for part in parts:
        assert str(part) in lines[0]


def assert_refused_before_any_work(result, out, *parts):
    assert_one_line(result, *parts)
    assert not Path(out).exists()


def test_a_missing_root_is_answered_with_the_tree_that_was_expected(augkitti):
    result = augkitti("generate", "--kitti", "nowhere", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "nowhere", "does not exist", "velodyne_points/data")


def test_a_root_without_scans_is_answered_with_the_tree_that_was_expected(augkitti, tmp_path):
    (tmp_path / "photos").mkdir()
    result = augkitti("generate", "--kitti", "photos", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "photos", "no KITTI scans", "velodyne_points/data")


def test_a_root_with_single_scans_only_has_no_usable_pair(augkitti, kitti, tmp_path):
    folder = tmp_path / "single" / DRIVE / "velodyne_points" / "data"
    folder.mkdir(parents=True)
    shutil.copy(kitti / DRIVE / "velodyne_points/data/0000000000.bin", folder)
    result = augkitti("generate", "--kitti", "single", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "single", "no usable scan pair")


def test_a_root_whose_drives_are_all_broken_has_no_usable_source(augkitti, kitti, tmp_path):
    shutil.copytree(kitti / "raw", tmp_path / "kitti" / "raw")
    (tmp_path / "kitti" / DRIVE / "tracklet_labels.xml").write_text("<")
    result = augkitti("generate", "--kitti", "kitti", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "no usable scan pair", "tracklet_labels.xml")


@pytest.mark.parametrize("folder", ["missing", "empty", "text"])
def test_no_usable_car_model_is_refused(augkitti, kitti, tmp_path, folder):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "car.obj").write_text("this is no car")
    result = augkitti("generate", "--kitti", kitti, "--cad", folder, "--out", "aug")
    assert_refused_before_any_work(result, "aug", folder)


def test_a_category_without_a_model_is_refused(augkitti, kitti):
    result = augkitti("generate", "--kitti", kitti, "--categories", "Tram", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "categories")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("carz: [1, 3]", "carz"),
        ("min_points: -1", "min_points"),
        ("cars: [3, 1]", "cars"),
        ("{", "YAML"),
        ("- 1", "table"),
    ],
)
def test_a_bad_configuration_is_refused_by_key(augkitti, kitti, tmp_path, text, part):
    (tmp_path / "settings.yaml").write_text(text)
    result = augkitti("generate", "--kitti", kitti, "--config", "settings.yaml", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "settings.yaml", part)


def test_a_missing_configuration_or_profile_is_refused(augkitti, kitti):
    for option in ("--config", "--profile"):
        result = augkitti("generate", "--kitti", kitti, option, "nowhere.file", "--out", "aug")
        assert_refused_before_any_work(result, "aug", "nowhere.file")


@pytest.mark.parametrize("cars", ["many", "1-", "-3", "3-1"])
def test_a_range_of_cars_that_is_none_is_refused(augkitti, kitti, cars):
    result = augkitti("generate", "--kitti", kitti, f"--cars={cars}", "--out", "aug")
    assert_refused_before_any_work(result, "aug", "cars")


def test_an_output_that_cannot_be_written_is_refused(augkitti, kitti, tmp_path):
    (tmp_path / "file").write_text("in the way")
    for out in ("file", "file/aug", "/proc/aug"):
        result = augkitti("generate", "--kitti", kitti, "--out", out)
        assert_one_line(result, out)


def test_an_output_that_holds_something_is_refused_without_resume(augkitti, kitti, tmp_path):
    (tmp_path / "aug").mkdir()
    (tmp_path / "aug" / "mine.txt").write_text("precious")
    assert_one_line(augkitti("generate", "--kitti", kitti, "--out", "aug"), "aug", "not empty", "--resume")
    assert [path.name for path in (tmp_path / "aug").iterdir()] == ["mine.txt"]


def test_resume_does_not_take_a_foreign_folder_for_a_run(augkitti, kitti, tmp_path):
    (tmp_path / "aug").mkdir()
    (tmp_path / "aug" / "mine.txt").write_text("precious")
    assert_one_line(augkitti("generate", "--kitti", kitti, "--out", "aug", "--resume"), "aug", "mine.txt")
    assert [path.name for path in (tmp_path / "aug").iterdir()] == ["mine.txt"]


# --- unreadable sources, with --on-error stop -------------------------------------------------------------------------

XML_BOMB = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><x>&c;</x>'
FAULTS = {
    "empty scan": ("velodyne_points/data/0000000003.bin", lambda data: b""),
    "cut-short scan": ("velodyne_points/data/0000000003.bin", lambda data: data[: len(data) // 2 + 3]),
    "scan of few points": ("velodyne_points/data/0000000003.bin", lambda data: data[:1600]),
    "malformed oxts": ("oxts/data/0000000003.txt", lambda data: b"49.0 8.4 north"),
    "binary oxts": ("oxts/data/0000000003.txt", lambda data: b"\xff\xfe\x00"),
    "malformed timestamps": ("velodyne_points/timestamps.txt", lambda data: b"yesterday\n" * 9),
    "malformed tracklets": ("tracklet_labels.xml", lambda data: data[: len(data) // 2]),
    "entities in tracklets": ("tracklet_labels.xml", lambda data: XML_BOMB.encode()),
    "malformed calib": ("../calib_imu_to_velo.txt", lambda data: b"R: 1 0 0\nT: 0 0 0\n"),
}


def broken(kitti, tmp_path, fault) -> Path:
    name, harm = FAULTS[fault]
    shutil.copytree(kitti / "raw", tmp_path / "kitti" / "raw")
    path = (tmp_path / "kitti" / DRIVE / name).resolve()
    path.write_bytes(harm(path.read_bytes()))
    return path


@pytest.mark.parametrize("fault", FAULTS)
def test_an_unreadable_source_stops_the_run_with_one_line_when_told_to(augkitti, kitti, tmp_path, fault):
    path = broken(kitti, tmp_path, fault)
    result = augkitti("generate", "--kitti", "kitti", "--n", 3, "--cars", 0, "--out", "aug", "--on-error", "stop")
    assert_one_line(result, path.name)
    assert not Path("aug/dataset.json").exists()


@pytest.mark.parametrize("fault", FAULTS)
def test_an_unreadable_source_is_listed_and_filled_from_elsewhere_by_default(augkitti, kitti, tmp_path, fault):
    path = broken(kitti, tmp_path, fault)
    shutil.copytree(kitti / "odometry", tmp_path / "kitti" / "odometry")
    write_more = Path("kitti") / DRIVE.parent / "2011_09_26_drive_0101_sync"
    shutil.copytree(kitti / DRIVE, write_more)
    result = augkitti("generate", "--kitti", "kitti", "--n", 5, "--cars", 0, "--out", "aug")
    assert result.exit_code == 0, result.output + result.stderr
    index = read_index(Path("aug"))
    assert index.rows == 5
    (listed,) = {row["source"].split(":")[0] for row in index.skipped}
    assert listed.endswith(path.name)
    assert not listed.startswith("/")


def test_missing_oxts_and_labels_are_no_error(augkitti, kitti, tmp_path):
    shutil.copytree(kitti / "raw", tmp_path / "kitti" / "raw")
    shutil.rmtree(tmp_path / "kitti" / DRIVE / "oxts")
    (tmp_path / "kitti" / DRIVE / "tracklet_labels.xml").unlink()
    result = augkitti("generate", "--kitti", "kitti", "--n", 1, "--cars", 0, "--out", "aug", "--on-error", "stop")
    assert result.exit_code == 0, result.stderr
    import augkitti as library

    (pair,) = library.open("aug")
    assert pair.ego_source == "registration"
    assert pair.label_coverage == "none"


# --- the commands that look ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["split", "validate", "view", "info", "augment", "finish"])
def test_a_folder_that_is_no_data_set_is_refused(augkitti, tmp_path, command):
    (tmp_path / "empty").mkdir()
    for folder in ("nowhere", "empty"):
        assert_one_line(augkitti(command, folder), folder)


def test_data_status_without_a_root_says_how_to_name_it(augkitti):
    assert_one_line(augkitti("data", "status"), "AUGKITTI_KITTI")


def test_cad_check_of_nothing_is_refused(augkitti):
    assert_one_line(augkitti("cad", "check", "nowhere"), "nowhere")
