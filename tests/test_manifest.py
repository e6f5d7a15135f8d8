"""The manifest's own consistency, and a disk compared with it."""

from pathlib import Path

import pytest
from conftest import ROOT
from tiny_drive import write_drive, write_odometry

from augkitti import manifest
from augkitti.data_status import data_status
from augkitti.errors import InputError


def test_the_61_drives_of_the_paper_are_there_once() -> None:
    drives = manifest.drives()
    categories = [drive.category for drive in drives]
    assert [categories.count(name) for name in ("City", "Residential", "Road")] == [28, 21, 12]
    assert len({drive.name for drive in drives}) == 61
    assert sum(drive.tracklets_archive is not None for drive in drives) == 38


def test_the_package_carries_the_file_at_the_top_of_the_repository() -> None:
    packaged = ROOT / "augkitti" / "data_manifest.yaml"
    assert packaged.read_bytes() == (ROOT / "data_manifest.yaml").read_bytes()


def test_other_names_agree_in_both_directions() -> None:
    content = manifest.load_manifest()
    for drive in manifest.drives():
        if drive.odometry is not None:
            assert manifest.odometry_recording(drive.odometry) == drive.name
        if drive.tracking is not None:
            assert manifest.tracking_source(drive.tracking).recording == drive.name
    assert set(content["odometry"]) == {f"{n:02d}" for n in range(11)}
    assert set(content["tracking"]) == {f"{n:04d}" for n in range(21)}
    named = {entry["recording"] for entry in content["odometry"].values()}
    assert named - {drive.name for drive in manifest.drives()} == {"2011_09_26_drive_0067"}


def test_stated_lengths_fit_the_odometry_ranges_and_the_archives() -> None:
    last = {entry["recording"]: entry["last_frame"] for entry in manifest.load_manifest()["odometry"].values()}
    for drive in manifest.drives():
        length = drive.frames or drive.frames_unconfirmed
        assert length is not None
        assert length > last.get(drive.name, 0)
        assert 3.5e6 < drive.archive_bytes / length < 4.6e6
        assert (drive.frames is None) != (drive.frames_unconfirmed is None)


def test_unknown_names_are_none() -> None:
    assert manifest.odometry_recording("11") is None
    assert manifest.tracking_source("0016") is None


def test_an_empty_disk_misses_every_drive_and_says_what_to_download(tmp_path: Path) -> None:
    rows = data_status(tmp_path)
    assert len(rows) == 61
    assert {row.state for row in rows} == {"missing"}
    assert rows[0].download[0].endswith("2011_09_26_drive_0001/2011_09_26_drive_0001_sync.zip")
    with pytest.raises(InputError):
        data_status(tmp_path / "nowhere")


def test_short_gappy_and_damaged_drives_are_named(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, frames=(0, 1, 3), firings=200, oxts=False, labels="none")
    write_odometry(tmp_path, frames=(0,), number="11")
    rows = {row.name: row for row in data_status(tmp_path)}
    row = rows["2011_09_26_drive_0005"]
    assert (row.state, row.scans, row.pairs, row.expected) == ("part", 3, 1, 154)
    text = " ".join(row.problems)
    assert "3 of 154 scans" in text
    assert "1 scans are missing between" in text
    assert "OXTS" in text
    assert "tracklets" in text
    assert rows["odometry_11"].state == "other"
    path = drive.folder / "velodyne_points" / "data" / "0000000001.bin"
    path.write_bytes(path.read_bytes()[:-3])
    damaged = {row.name: row for row in data_status(tmp_path)}["2011_09_26_drive_0005"]
    assert damaged.state == "damaged"
    assert "first frame 1" in " ".join(damaged.problems)
