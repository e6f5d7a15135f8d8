"""Generation as a whole, on tiny drives: same bytes whatever the order, interruptions and processes; nothing lost."""

import hashlib
import json
import re
import shutil
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from car_files import write_cars
from pair_rows import assert_among, rows_of
from tiny_drive import write_drive, write_odometry
from typer.testing import CliRunner

import pipelines.augment
from augkitti.config import Config
from augkitti.dataset import open_dataset
from augkitti.dataset_index import read_index
from augkitti.errors import InputError
from augkitti.kitti import open_root, read_scan
from augkitti.scanner import assign_rays, load_profile
from pipelines.cli import app
from pipelines.generate import augment_stage, finish_stage, generate, prepare_stage
from pipelines.prepare import prepared_scan
from pipelines.run import WORK, read_options

SAME = "resume with the same, or start anew"
FOUND = {"data", "dataset.json", "README.md"}


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """Two raw drives, three and two pairs, and an odometry pair."""
    root = tmp_path_factory.mktemp("kitti")
    write_drive(root, frames=(40, 41, 42, 43), name="2011_09_26_drive_0005_sync", truth=True)
    write_drive(root, frames=(0, 1, 2), name="2011_09_26_drive_0101_sync", labels="none", oxts=False)
    write_odometry(root)
    return root


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def options_of(root, out, cache, n=4, **changes):
    usual = {"cad": None, "seed": 0, "config": None, "profile": None, "stop_on_error": False, "cars": (1, 1)}
    return replace(read_options(kitti=root, out=out, n=n, **{**usual, **changes}), cache=cache)


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="session")
def made(drives, cache, tmp_path_factory):
    """A data set of five pairs, made in this process."""
    out = tmp_path_factory.mktemp("made") / "aug"
    assert generate(options_of(drives, out, cache, n=5), jobs=1, resume=False, dry_run=False) == 0
    return out


def test_a_finished_folder_holds_the_data_set_and_nothing_else(made):
    assert {path.name for path in made.iterdir()} == FOUND
    index = read_index(made)
    assert index.rows == 5
    assert {path.name for path in (made / "data").iterdir()} == {Path(s.path).name for s in index.shards}
    text = (made / "dataset.json").read_text() + (made / "README.md").read_text()
    assert str(made.parent) not in text


def test_pairs_are_named_by_sequence_frame_and_variant_and_none_stands_twice(made):
    ids = open_dataset(made).pair_ids
    assert len(set(ids)) == 5
    assert all(len(name.split("/")) == 3 and name.rsplit("/", 1)[1].isdecimal() for name in ids)


def test_two_processes_give_the_same_bytes_as_one(made, drives, cache, tmp_path):
    assert generate(options_of(drives, tmp_path / "aug", cache, n=5), jobs=2, resume=False, dry_run=False) == 0
    assert digests(tmp_path / "aug") == digests(made)


def test_a_run_that_was_cut_off_goes_on_to_the_same_bytes(made, drives, cache, tmp_path, monkeypatch):
    out = tmp_path / "aug"
    options = options_of(drives, out, cache, n=5)
    whole, calls = pipelines.augment.make_pair, []

    def cut_off(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(pipelines.augment, "make_pair", cut_off)
    with pytest.raises(KeyboardInterrupt):
        generate(options, jobs=1, resume=False, dry_run=False)
    assert not (out / "dataset.json").exists()
    finished = list((out / WORK / "rows").iterdir())
    assert finished
    (out / "data" / "left-over.parquet").write_bytes(b"of a dead run")
    monkeypatch.undo()
    assert generate(options, jobs=1, resume=True, dry_run=False) == 0
    assert digests(out) == digests(made)


def test_shards_that_went_missing_are_made_again_with_the_same_bytes(made, drives, cache, tmp_path):
    out = tmp_path / "aug"
    prepare_stage(options_of(drives, out, cache, n=5), jobs=1, resume=False)
    augment_stage(out, jobs=1)
    first, second, *_ = sorted((out / "data").iterdir())
    first.unlink()
    second.write_bytes(second.read_bytes()[:-100])
    with pytest.raises(InputError, match="unfinished"):
        finish_stage(out)
    augment_stage(out, jobs=1)
    assert finish_stage(out) == 0
    assert digests(out) == digests(made)


def test_a_finished_set_that_lost_a_shard_is_mended_by_resume(made, drives, cache, tmp_path):
    out = tmp_path / "aug"
    shutil.copytree(made, out)
    next((out / "data").iterdir()).unlink()
    assert generate(options_of(drives, out, cache, n=5), jobs=1, resume=True, dry_run=False) == 0
    assert digests(out) == digests(made)


def test_resuming_with_other_settings_is_refused_and_named(drives, cache, tmp_path):
    prepare_stage(options_of(drives, tmp_path / "aug", cache, n=2, min_points=30), jobs=1, resume=False)
    with pytest.raises(InputError, match="another configuration"):
        prepare_stage(options_of(drives, tmp_path / "aug", cache, n=2), jobs=1, resume=True)
    with pytest.raises(InputError, match="another seed"):
        prepare_stage(options_of(drives, tmp_path / "aug", cache, n=2, seed=1, min_points=30), jobs=1, resume=True)


@pytest.mark.parametrize("key", ["program version", "pairs (--n)", "scanner profile", "car models", "source"])
def test_a_run_begun_with_another_program_car_or_source_is_not_resumed(drives, cache, tmp_path, key):
    options = options_of(drives, tmp_path / "aug", cache, n=2)
    prepare_stage(options, jobs=1, resume=False)
    state = tmp_path / "aug" / WORK / "run.json"
    content = json.loads(state.read_text())
    assert set(content["identity"]) == {
        *("program version", "pairs (--n)", "seed", "configuration", "scanner profile", "car models", "source")
    }
    content["identity"][key] = "another"
    state.write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"was begun with another {re.escape(key)};"):
        generate(options, jobs=1, resume=True, dry_run=False)


def test_other_car_models_of_the_same_names_are_refused_in_one_line(drives, cache, tmp_path, monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE", str(cache))
    write_cars(tmp_path / "cars", "sedan", "city")
    write_cars(tmp_path / "others", "sedan", "estate")
    common = ("--kitti", drives, "--out", tmp_path / "aug", "--n", 1, "--cars", 1)

    def run(stage, cad, *words):
        return CliRunner().invoke(app, [str(word) for word in (stage, *common, "--cad", tmp_path / cad, *words)])

    def refused(how):
        answer = run("generate", "others", "--resume")
        assert answer.exit_code == 2
        assert answer.stderr == f"augkitti: {tmp_path / 'aug'}: {how} another car models; {SAME}\n"

    assert run("prepare", "cars").exit_code == 0
    refused("was begun with")
    assert run("generate", "cars", "--resume").exit_code == 0
    refused("was made with")


def test_a_scan_that_turns_unreadable_under_a_run_stops_it_and_mended_it_goes_on(made, drives, cache, tmp_path):
    root, out = tmp_path / "kitti", tmp_path / "aug"
    shutil.copytree(drives, root)
    prepare_stage(options_of(root, out, cache, n=5, stop_on_error=True), jobs=1, resume=False)
    scan = root / "raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000041.bin"
    content = scan.read_bytes()
    scan.write_bytes(content[:-5])
    with pytest.raises(InputError, match="cut short"):
        augment_stage(out, jobs=1)
    scan.write_bytes(content)
    augment_stage(out, jobs=1)
    assert finish_stage(out) == 0
    assert digests(out) == digests(made)


def test_a_larger_set_holds_the_pairs_of_a_smaller_one_unchanged(made, drives, cache, tmp_path):
    assert generate(options_of(drives, tmp_path / "aug", cache, n=3), jobs=1, resume=False, dry_run=False) == 0
    assert_among(rows_of(tmp_path / "aug"), rows_of(made), 3)


@pytest.mark.kitti
def test_a_larger_set_of_real_scans_holds_the_pairs_of_a_smaller_one_unchanged(kitti_root, cache, tmp_path):
    for n in (2, 4):
        options = options_of(kitti_root, tmp_path / str(n), cache, n=n)
        assert generate(options, jobs=1, resume=False, dry_run=False) == 0
    assert_among(rows_of(tmp_path / "2"), rows_of(tmp_path / "4"), 2)


def test_plain_pairs_carry_the_real_labels_and_every_measured_point(drives, cache, tmp_path):
    options = options_of(drives, tmp_path / "k", cache, n=6, cars=(0, 0))
    assert generate(options, jobs=1, resume=False, dry_run=False) == 0
    root = open_root(drives)
    assert len({name.rsplit("/", 1)[0] for name in open_dataset(tmp_path / "k").pair_ids}) == 6
    for pair in open_dataset(tmp_path / "k"):
        assert all(item.origin == "labelled" for item in pair.objects)
        np.testing.assert_array_equal(pair.scan0.xyz, read_scan(root.sequence(pair.sequence), pair.frame0).xyz)
        assert len(pair.scan0.removed) == 0


def test_an_unreadable_scan_is_left_out_listed_and_filled_from_spares(drives, cache, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(drives, root)
    scan = root / "raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000043.bin"
    scan.write_bytes(scan.read_bytes()[:-5])
    out = tmp_path / "aug"
    assert generate(options_of(root, out, cache, n=6), jobs=1, resume=False, dry_run=False) == 0
    index = read_index(out)
    assert index.rows == 6
    listed = [row for row in index.skipped if "0000000043.bin" in row["source"]]
    assert listed
    assert "cut short" in listed[0]["reason"]
    assert str(tmp_path) not in json.dumps(index.skipped)
    assert not any(name.startswith("2011_09_26_drive_0005_sync/42/") for name in open_dataset(out).pair_ids)


def test_a_drive_whose_labels_are_broken_leaves_its_pairs_to_the_others(drives, cache, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(drives, root)
    (root / "raw/2011_09_26/2011_09_26_drive_0005_sync/tracklet_labels.xml").write_text("<tracklets>")
    assert generate(options_of(root, tmp_path / "aug", cache, n=3), jobs=1, resume=False, dry_run=False) == 0
    index = read_index(tmp_path / "aug")
    assert index.rows == 3
    assert {shard.sequence for shard in index.shards} <= {"2011_09_26_drive_0101_sync", "odometry_04"}
    assert [row["count"] for row in index.skipped if "tracklet_labels.xml" in row["source"]] == [3]


def test_a_shortfall_is_told_by_the_exit_code(drives, cache, tmp_path, monkeypatch, capsys):
    whole = pipelines.augment.make_pair

    def only_first_frames(sequence, candidate, options):
        return whole(sequence, candidate, options) if candidate.frame0 == 40 else None

    monkeypatch.setattr(pipelines.augment, "make_pair", only_first_frames)
    options = options_of(drives, tmp_path / "aug", cache, n=6, cars=(0, 0))
    assert generate(options, jobs=1, resume=False, dry_run=False) == 1
    told = capsys.readouterr()
    assert "short by 3 of 6" in told.err
    assert "no virtual car found room" in told.out
    index = read_index(tmp_path / "aug")
    assert index.rows == 3, "one of a drive's three pairs can be made: once as planned, and as spares"
    assert sum(row["count"] for row in index.skipped) > 3


def test_a_set_that_fell_short_is_left_as_it_is_by_resume_and_its_n_is_known(
    drives, cache, tmp_path, monkeypatch, capsys
):
    whole = pipelines.augment.make_pair

    def only_first_frames(sequence, candidate, options):
        return whole(sequence, candidate, options) if candidate.frame0 == 40 else None

    out = tmp_path / "aug"
    monkeypatch.setattr(pipelines.augment, "make_pair", only_first_frames)
    assert generate(options_of(drives, out, cache, n=6, cars=(0, 0)), jobs=1, resume=False, dry_run=False) == 1
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.rglob("*") if path.is_file()}
    assert read_index(out).totals["pairs_short"] == 3
    monkeypatch.setattr(pipelines.augment, "make_pair", None)
    assert generate(options_of(drives, out, cache, n=6, cars=(0, 0)), jobs=1, resume=True, dry_run=False) == 1
    assert "short by 3 of 6 pairs: `skipped` in dataset.json says why" in capsys.readouterr().err
    for n in (3, 7):
        with pytest.raises(InputError, match=r"was finished with --n 6; take another --out .*, or --n 6"):
            generate(options_of(drives, out, cache, n=n, cars=(0, 0)), jobs=1, resume=True, dry_run=False)
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("n", [4, 6])
@pytest.mark.parametrize("begin", [partial(generate, dry_run=False), prepare_stage])
def test_a_finished_set_is_not_made_again_with_another_n(made, drives, cache, n, begin):
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*")}
    options = options_of(drives, made, cache, n=n)
    with pytest.raises(InputError, match=r"was finished with --n 5; take another --out .*, or --n 5"):
        begin(options, jobs=1, resume=True)
    prepare_stage(options_of(drives, made, cache, n=5), jobs=1, resume=True)
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*")} == before


def test_rows_with_nan_or_zeros_are_dropped_and_counted(drives, cache, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(drives / "odometry", root / "odometry")
    path = root / "odometry/sequences/04/velodyne/000000.bin"
    rows = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    rows[100:107] = np.nan
    rows[200:205] = 0.0
    rows.tofile(path)
    options = options_of(root, tmp_path / "aug", cache, n=1, cars=(0, 0))
    assert generate(options, jobs=1, resume=False, dry_run=False) == 0
    assert read_index(tmp_path / "aug").totals["invalid_rows"] == 12
    pair = open_dataset(tmp_path / "aug")[0]
    assert not np.isin(pair.scan0.source, [*range(100, 107), *range(200, 205)]).any()


# --- the cache ------------------------------------------------------------------------------------------------------


def assert_same(a, b, where=""):
    for item in fields(a):
        x, y = getattr(a, item.name), getattr(b, item.name)
        if hasattr(x, "__dataclass_fields__"):
            assert_same(x, y, f"{where}{item.name}.")
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, f"{where}{item.name}"
            np.testing.assert_array_equal(x, y, err_msg=f"{where}{item.name}")
        else:
            assert x == y, f"{where}{item.name}"


@pytest.mark.parametrize(("name", "frame"), [("2011_09_26_drive_0101_sync", 1), ("odometry_04", 0)])
def test_a_prepared_scan_comes_back_from_the_cache_bit_for_bit(drives, tmp_path, monkeypatch, name, frame):
    sequence, profile, config = open_root(drives).sequence(name), load_profile(), Config()
    fresh, was_made = prepared_scan(sequence, frame, profile, config, tmp_path)
    monkeypatch.setattr("pipelines.prepare._recent", {})  # as another process would find it
    again, made_again = prepared_scan(sequence, frame, profile, config, tmp_path)
    assert (was_made, made_again) == (True, False)
    assert_same(fresh, again)


def test_a_damaged_or_foreign_cache_file_is_noticed_and_made_again(drives, tmp_path, monkeypatch):
    sequence, profile, config = open_root(drives).sequence("2011_09_26_drive_0101_sync"), load_profile(), Config()
    fresh, _ = prepared_scan(sequence, 0, profile, config, tmp_path)
    (file,) = (path for path in tmp_path.rglob("*.arrays"))
    good = file.read_bytes()
    prepared_scan(sequence, 1, profile, config, tmp_path)
    (other,) = (path for path in tmp_path.rglob("*.arrays") if path != file)
    for bad in (b"", good[: len(good) // 2], good[:500] + b"\x00" * 40 + good[540:], other.read_bytes()):
        file.write_bytes(bad)
        monkeypatch.setattr("pipelines.prepare._recent", {})  # as another process would find it
        again, was_made = prepared_scan(sequence, 0, profile, config, tmp_path)
        assert was_made
        assert_same(fresh, again)
        assert file.read_bytes() == good


def test_another_ground_setting_is_not_answered_from_the_cache(drives, tmp_path):
    sequence, profile = open_root(drives).sequence("2011_09_26_drive_0101_sync"), load_profile()
    config = Config()
    other = config.model_copy(update={"ground": config.ground.model_copy(update={"cell_m": 1.0})})
    assert prepared_scan(sequence, 0, profile, config, tmp_path)[1]
    assert prepared_scan(sequence, 0, profile, other, tmp_path)[1]
    assert not prepared_scan(sequence, 0, profile, config.model_copy(update={"min_points": 99}), tmp_path)[1]


@pytest.mark.kitti
def test_prepared_real_scans_with_stray_points_come_back_bit_for_bit(kitti_root, tmp_path):
    sequence = open_root(kitti_root).sequence("2011_09_26_drive_0009_sync")
    profile = load_profile()
    frames = [f for f in sequence.frames if (assign_rays(read_scan(sequence, f), profile).tick == 65535).any()][:1]
    fresh, _ = prepared_scan(sequence, (frames or [sequence.frames[0]])[0], profile, Config(), tmp_path)
    again, was_made = prepared_scan(sequence, (frames or [sequence.frames[0]])[0], profile, Config(), tmp_path)
    assert not was_made
    assert_same(fresh, again)
