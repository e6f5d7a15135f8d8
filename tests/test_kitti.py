"""Reading KITTI: layouts, scans, times, pairs, and one line for every unreadable file."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_drive import EPOCH_S, PERIOD_S, TinyDrive, write_drive, write_odometry

from augkitti import kitti
from augkitti.errors import InputError
from augkitti.frames import box_pose, is_rigid, points_in_box


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TinyDrive:
    return write_drive(tmp_path_factory.mktemp("kitti"), frames=(40, 41, 43), firings=1075)


@pytest.fixture
def copy(drive: TinyDrive, tmp_path: Path) -> kitti.Sequence:
    """A drive that a test may spoil."""
    shutil.copytree(drive.root, tmp_path / "kitti")
    return kitti.open_root(tmp_path / "kitti").sequences[0]


def sequence_of(drive: TinyDrive) -> kitti.Sequence:
    return kitti.open_root(drive.root).sequence(drive.name)


@pytest.mark.parametrize("up", [0, 1, 2, 3])
def test_a_drive_is_found_from_each_folder_above_it(drive: TinyDrive, up: int) -> None:
    root = [drive.folder, *drive.folder.parents][up]
    (sequence,) = kitti.open_root(root).sequences
    assert (sequence.name, sequence.recording) == (drive.name, "2011_09_26_drive_0005")
    assert sequence.kind == "raw"


def test_pairs_are_neighbouring_numbers_that_are_both_there(drive: TinyDrive) -> None:
    sequence = sequence_of(drive)
    assert sequence.frames == (40, 41, 43)
    assert sequence.pairs == ((40, 41),)
    with pytest.raises(InputError, match="no pair"):
        kitti.read_pair(sequence, 41)


def test_a_pair_holds_scans_times_labels_and_exact_ego_motion(drive: TinyDrive) -> None:
    pair = kitti.read_pair(sequence_of(drive), 40)
    assert (pair.frame0, pair.frame1, pair.ego_source, pair.label_coverage) == (40, 41, "oxts", "camera")
    assert pair.scan0.time_s == pytest.approx(EPOCH_S, abs=1e-6)
    assert pair.scan1.time_s == pytest.approx(EPOCH_S + PERIOD_S, abs=1e-6)
    assert pair.scan0.period_s == pytest.approx(PERIOD_S, abs=1e-6)
    assert is_rigid(pair.ego_motion)
    np.testing.assert_allclose(pair.ego_motion, drive.T_velo1_velo0, atol=2e-5)
    assert [box.id for box in pair.labels0] == [box.id for box in pair.labels1]
    right, left = pair.label_azimuth or (0.0, 0.0)
    assert right == pytest.approx(-np.arctan((1242 - 610) / 720))
    assert left == pytest.approx(np.arctan(610 / 720))


def test_points_lie_in_the_labelled_boxes(drive: TinyDrive) -> None:
    pair = kitti.read_pair(sequence_of(drive), 40)
    for label in pair.labels0:
        assert points_in_box(pair.scan0.xyz, box_pose(label.box), label.box[3:6], 0.02).sum() > 300


def test_exact_poses_and_full_labels_come_from_the_sidecar(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, frames=(3, 4), truth=True, labels="none", firings=300)
    pair = kitti.read_pair(sequence_of(drive), 3)
    assert (pair.ego_source, pair.label_coverage, pair.label_azimuth) == ("truth", "full", None)
    np.testing.assert_allclose(pair.ego_motion, drive.T_velo1_velo0, atol=1e-14)


def test_without_oxts_and_labels_the_scans_are_registered(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, frames=(0, 1), oxts=False, labels="none")
    pair = kitti.read_pair(sequence_of(drive), 0)
    assert (pair.ego_source, pair.label_coverage, pair.labels0) == ("registration", "none", ())
    np.testing.assert_allclose(pair.ego_motion, drive.T_velo1_velo0, atol=0.02)


def test_odometry_poses_go_through_the_calibration(tmp_path: Path) -> None:
    write_odometry(tmp_path, frames=(5, 6))
    sequence = kitti.open_root(tmp_path).sequence("odometry_04")
    assert (sequence.recording, sequence.kind) == ("2011_09_30_drive_0016", "compensated")
    pair = kitti.read_pair(sequence, 5)
    assert pair.ego_source == "poses"
    assert pair.scan0.time_s == pytest.approx(5 * PERIOD_S, abs=1e-6)
    assert pair.scan0.period_s == pytest.approx(PERIOD_S, abs=1e-6)
    assert pair.ego_motion[0, 3] == pytest.approx(-8.0 * PERIOD_S, abs=1e-3)


def test_odometry_without_times_counts_tenths_of_a_second(tmp_path: Path) -> None:
    (write_odometry(tmp_path, frames=(5,)) / "times.txt").unlink()
    sequence = kitti.open_root(tmp_path).sequences[0]
    assert kitti.scan_time(sequence, 5) == (0.5, 0.1)


def test_object_scans_make_no_pairs_and_say_so(tmp_path: Path, drive: TinyDrive) -> None:
    folder = tmp_path / "object" / "training" / "velodyne"
    folder.mkdir(parents=True)
    for number in (7, 8):
        shutil.copy(drive.folder / "velodyne_points" / "data" / "0000000040.bin", folder / f"{number:06d}.bin")
    sequence = kitti.open_root(tmp_path).sequences[0]
    assert (sequence.frames, sequence.pairs) == ((7, 8), ())
    assert "no pairs" in sequence.note
    assert len(kitti.read_scan(sequence, 7)) > 10000
    with pytest.raises(InputError, match="single"):
        kitti.read_pair(sequence, 7)


def test_invalid_rows_are_dropped_and_counted(copy: kitti.Sequence) -> None:
    path = copy.scan_path(40)
    rows = kitti.read_scan_rows(path).copy()
    rows[3], rows[5, 1], rows[7, 3], rows[9, 0] = 0.0, np.nan, np.inf, 0.0
    rows.tofile(path)
    scan = kitti.read_scan(copy, 40)
    assert scan.rows_in_file - len(scan) == 3
    assert not {3, 5, 7} & set(scan.row.tolist())
    np.testing.assert_array_equal(scan.xyz, rows[scan.row, :3])


def test_a_sequence_survives_pickling(drive: TinyDrive) -> None:
    sequence = sequence_of(drive)
    assert pickle.loads(pickle.dumps(sequence)) == sequence


def test_digests_change_with_the_bytes_and_with_nothing_else(drive: TinyDrive, copy: kitti.Sequence) -> None:
    assert kitti.scan_digest(copy, 40) == kitti.scan_digest(sequence_of(drive), 40)
    assert kitti.ego_motion_digest(copy, 40) == kitti.ego_motion_digest(sequence_of(drive), 40)
    before = kitti.scan_digest(copy, 41), kitti.ego_motion_digest(copy, 40)
    rows = kitti.read_scan_rows(copy.scan_path(41)).copy()
    rows[0, 0] += 0.001
    rows.tofile(copy.scan_path(41))
    assert kitti.scan_digest(copy, 41) != before[0]
    assert kitti.ego_motion_digest(copy, 40) != before[1]


def test_a_changed_label_file_is_read_again(copy: kitti.Sequence) -> None:
    assert len(kitti.read_labels(copy, 40)) == 2
    path = copy.folder / "tracklet_labels.xml"
    path.write_text(path.read_text().replace("<first_frame>40<", "<first_frame>400<"))
    assert kitti.read_labels(copy, 40) == ()


def test_times_fall_back_where_velodyne_timestamps_are_missing(copy: kitti.Sequence) -> None:
    (copy.folder / "velodyne_points" / "timestamps_end.txt").unlink()
    assert kitti.scan_time(copy, 40) == (pytest.approx(EPOCH_S), 0.1035)
    (copy.folder / "velodyne_points" / "timestamps.txt").unlink()
    assert kitti.scan_time(copy, 40)[0] == pytest.approx(EPOCH_S, abs=1e-6)
    shutil.rmtree(copy.folder / "oxts")
    assert kitti.scan_time(copy, 40) == (4.0, 0.1035)


def test_tracklets_come_before_tracking_labels(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, frames=(0, 1), labels="tracking", firings=300)
    sequence = sequence_of(drive)
    labels = kitti.read_labels(sequence, 1)
    assert [box.id for box in labels] == ["tracking_0000_000", "tracking_0000_001"]
    np.testing.assert_allclose(labels[1].box, drive.boxes[1]["parked"], atol=1e-9)
    assert kitti.label_reach(sequence)[0] == "camera"
    (drive.folder / "tracklet_labels.xml").write_text(
        "<boost_serialization><tracklets><count>0</count></tracklets></boost_serialization>"
    )
    assert kitti.read_labels(sequence_of(drive), 1) == ()


def test_missing_or_empty_roots_are_answered_with_the_tree_expected(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for root in (tmp_path / "nowhere", tmp_path / "file", tmp_path):
        with pytest.raises(InputError, match=r"velodyne_points/data/0000000000.bin") as caught:
            kitti.open_root(root)
        assert "\n" not in str(caught.value)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


def front_only(path: Path) -> None:
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    rows[rows[:, 0] > 2.0].tofile(path)


def bright(path: Path) -> None:
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    rows[:, 3] *= 255.0
    rows.tofile(path)


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda path: path.write_bytes(b""), "empty"),
        (truncate, "cut short"),
        (lambda path: path.write_bytes(path.read_bytes()[:1600]), "too few"),
        (front_only, "camera-view crop"),
        (bright, "reflectance"),
        (lambda path: path.unlink(), "not readable"),
    ],
)
def test_an_unreadable_scan_is_one_line_with_file_problem_and_remedy(copy, spoil, problem) -> None:
    spoil(copy.scan_path(40))
    with pytest.raises(InputError, match=problem) as caught:
        kitti.read_pair(copy, 40)
    assert "0000000040.bin" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("oxts/data/0000000041.txt", "49.0 8.4 nonsense"),
        ("oxts/data/0000000041.txt", "1 2 3"),
        ("oxts/data/0000000040.txt", b"\xff\xfe\x00"),
        ("oxts/timestamps.txt", "\n" * 50),
        ("oxts/timestamps.txt", "2011-09-26 13:00:00.5\n" * 50),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:00:00.0\n" * 12),
        ("velodyne_points/timestamps.txt", "yesterday\n" * 50),
        ("velodyne_points/timestamps_end.txt", "2011-09-26 13:00:00.0\n" * 50),
        ("../calib_imu_to_velo.txt", "R: 1 0 0\nT: 0 0 0\n"),
        ("../calib_imu_to_velo.txt", "T: 0 0 0\n"),
        ("../calib_imu_to_velo.txt", "R: 1 1 1 1 1 1 1 1 1\nT: 0 0 0\n"),
        ("../calib_cam_to_cam.txt", "P_rect_02: a b c\n"),
        ("tracklet_labels.xml", "<boost_serialization><tracklets>"),
        ("augkitti_source.json", "{"),
        ("augkitti_source.json", '{"label_coverage": "everything"}'),
        ("augkitti_source.json", '{"velo_poses": "../poses.txt"}'),
        ("augkitti_source.json", '{"velo_poses": "gone.txt"}'),
        ("augkitti_source.json", "[" * 100_000),
        ("oxts/data/0000000040.txt", "1e300 " * 30),
        ("../calib_imu_to_velo.txt", "R: 1e300 0 0 0 1 0 0 0 1\nT: 0 0 0\n"),
    ],
)
def test_a_malformed_file_beside_the_scans_is_one_line(copy, file: str, content: str | bytes) -> None:
    path = copy.folder / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        kitti.read_pair(copy, 40)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.kitti
def test_every_shared_pair_is_read_and_its_labels_hold_points(kitti_root: Path) -> None:
    root = kitti.open_root(kitti_root)
    assert {s.layout for s in root.sequences} == {"raw", "odometry", "object"}
    for sequence in root.sequences:
        for frame0, _ in sequence.pairs[:2]:
            pair = kitti.read_pair(sequence, frame0)
            assert 100_000 < len(pair.scan0) < 130_000
            assert is_rigid(pair.ego_motion)
            near = [label for label in pair.labels0 if np.hypot(*label.box[:2]) < 25.0]
            held = [points_in_box(pair.scan0.xyz, box_pose(b.box), b.box[3:6], 0.1).sum() for b in near]
            assert not near or np.median(held) > 50


@pytest.mark.kitti
def test_tracklets_and_tracking_labels_of_one_drive_agree(kitti_root: Path) -> None:
    sequence = kitti.open_root(kitti_root).sequence("2011_09_26_drive_0005_sync")
    assert sequence.tracking_labels is not None
    assert sequence.tracking_calib is not None
    T_velo_cam = kitti._benchmark_T_velo_cam(sequence.tracking_calib)
    tracking = kitti.read_tracking_labels(sequence.tracking_labels, T_velo_cam)
    for frame in sequence.frames:
        for tracklet in kitti.read_labels(sequence, frame):
            near = min(tracking[frame], key=lambda other, t=tracklet: float(np.abs(other.box[:3] - t.box[:3]).sum()))
            assert near.category == tracklet.category
            np.testing.assert_allclose(near.box[:6], tracklet.box[:6], atol=0.03)
            assert abs(np.sin(near.box[6] - tracklet.box[6])) < 0.03


@pytest.mark.kitti
@pytest.mark.parametrize(("share", "is_read"), [(0.5, False), (0.75, False), (0.95, True)])
def test_scan_cut_at_a_whole_point_is_told_by_the_beams_that_it_lacks(
    kitti_root: Path, tmp_path: Path, share: float, is_read: bool
) -> None:
    source = sorted(kitti_root.glob("raw/*/*_0005_sync"))[0]
    copy = tmp_path / "raw" / source.parent.name / source.name / "velodyne_points" / "data"
    copy.mkdir(parents=True)
    content = sorted((source / "velodyne_points" / "data").glob("*.bin"))[0].read_bytes()
    (copy / "0000000000.bin").write_bytes(content[: int(len(content) * share) // 16 * 16])
    (sequence,) = kitti.open_root(tmp_path).sequences
    if is_read:
        assert len(kitti.read_scan(sequence, 0)) > 100_000
    else:
        with pytest.raises(InputError, match="cut short"):
            kitti.read_scan(sequence, 0)
