"""The embedded default: what is written is read back as KITTI, with exact truth."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from augkitti import kitti
from augkitti.errors import InputError
from augkitti.frames import box_pose, compose, invert, points_in_box, se3_log, transform_points
from augkitti.scan_pair import NO_TICK
from augkitti.scanner import assign_rays, load_profile, ray_distance
from augkitti.street import body_poses
from augkitti.synthesize import (
    content_digest,
    drive_street,
    ego_truth,
    scanner_poses_at,
    street_digest,
    synthesize,
)

PROFILE = load_profile()
DRIVES, FRAMES, SEED = 2, 2, 11


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    out = tmp_path_factory.mktemp("streets") / "kitti"
    folders = synthesize(out, DRIVES, FRAMES, SEED, PROFILE)
    assert all(folder.is_dir() for folder in folders)
    return out


@pytest.fixture(scope="module")
def sequences(root):
    return kitti.open_root(root).sequences


def truth(sequence, frame):
    return np.load(sequence.folder / "truth" / f"{frame:010d}.npz", allow_pickle=False)


def test_reader_finds_every_drive_and_frame(sequences):
    assert [s.name for s in sequences] == [f"2000_01_01_drive_{i + 1:04d}_sync" for i in range(DRIVES)]
    assert all(s.layout == "raw" and s.frames == tuple(range(FRAMES)) for s in sequences)


def test_points_lie_on_the_scanners_rays(sequences):
    for sequence in sequences:
        scan = kitti.read_scan(sequence, 1)
        rays = assign_rays(scan, PROFILE)
        assert (rays.tick == NO_TICK).mean() <= 1e-4
        assert np.median(ray_distance(scan, rays, PROFILE)) <= 0.5e-3
        fired = len(np.unique(rays.ray_tick[rays.ray_tick != NO_TICK]))
        assert 2140 <= fired <= 2170
        assert not (rays.ray_blind & (rays.ray_point >= 0)).any()
        returned = len(scan) / (rays.ray_tick != NO_TICK).sum()
        assert 0.7 < returned < 0.95


def test_points_have_the_scanners_quanta(sequences):
    rows = kitti.read_scan_rows(sequences[0].scan_path(0)).astype(np.float64)
    assert np.abs(rows[:, :3] * 1000 - np.rint(rows[:, :3] * 1000)).max() < 5e-3
    assert np.abs(rows[:, 3] * 100 - np.rint(rows[:, 3] * 100)).max() < 1e-4
    distance = np.sqrt((rows[:, :3] ** 2).sum(1))
    assert distance.min() >= 1.459
    assert distance.max() <= 80.001


def test_truth_has_a_value_for_each_row(sequences):
    for sequence in sequences:
        for frame in sequence.frames:
            count = len(kitti.read_scan_rows(sequence.scan_path(frame)))
            found = truth(sequence, frame)
            assert {key: len(found[key]) for key in found.files} == dict.fromkeys(
                ("object", "ground", "moving", "mixed"), count
            )
            assert not ((found["object"] >= 0) & (found["ground"] > 0)).any()
            assert {0, 1, 2} <= set(np.unique(found["ground"]))


def test_ego_motion_lays_what_stands_still_onto_itself(sequences):
    for sequence in sequences:
        pair = kitti.read_pair(sequence, 0)
        assert pair.ego_source == "truth"
        still = (truth(sequence, 0)["ground"] == 0) & ~truth(sequence, 0)["moving"] & ~truth(sequence, 0)["mixed"]
        still &= np.sqrt((pair.scan0.xyz[:, :2] ** 2).sum(1)) < 25
        tree, points = cKDTree(pair.scan1.xyz), pair.scan0.xyz[still][::7]

        def misfit(x_m, y_m, tree=tree, points=points, pair=pair):
            moved = transform_points(pair.ego_motion, points) + [x_m, y_m, 0.0]
            return np.minimum(tree.query(moved)[0], 1.0)

        exact = misfit(0.0, 0.0)
        assert np.median(exact) < 0.09
        for beside in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)):
            assert exact.mean() < misfit(*beside).mean()


def test_oxts_alone_gives_nearly_the_same_motion(sequences, tmp_path):
    for sequence in sequences:
        exact = kitti.known_ego_motion(sequence, 0)
        (sequence.folder / kitti.SIDECAR).rename(tmp_path / "aside")
        try:
            measured = kitti.known_ego_motion(sequence, 0)
        finally:
            (tmp_path / "aside").rename(sequence.folder / kitti.SIDECAR)
        assert (exact.source, measured.source) == ("truth", "oxts")
        off = compose(invert(exact.T_velo1_velo0), measured.T_velo1_velo0)
        assert np.linalg.norm(off[:3, 3]) < 0.02
        assert np.rad2deg(np.linalg.norm(se3_log(off)[3:])) < 0.08


def test_timestamps_are_kittis(sequences):
    for sequence in sequences:
        stamps = sequence.folder / "velodyne_points"
        lines = [(stamps / f"timestamps{part}.txt").read_text().splitlines() for part in ("_start", "", "_end")]
        seconds = np.array([[float(line.rsplit(":", 1)[1]) for line in part] for part in lines])
        assert np.allclose(seconds[1], 0.5 * (seconds[0] + seconds[2]), atol=2e-9)
        assert np.allclose(seconds[0, 1:], seconds[2, :-1], atol=2e-9)
        packets = (sequence.folder / "oxts" / "timestamps.txt").read_text().splitlines()
        late = np.array([float(line.rsplit(":", 1)[1]) for line in packets]) - seconds[1]
        assert (late >= 0.005 - 1e-9).all()
        assert (late <= 0.038 + 1e-9).all()


def test_tracklet_boxes_hold_the_points_of_their_object(sequences):
    held = total = 0
    for sequence in sequences:
        for frame in sequence.frames:
            scan, found = kitti.read_scan(sequence, frame), truth(sequence, frame)
            labels = kitti.read_labels(sequence, frame)
            assert labels
            for label in labels:
                inside = points_in_box(scan.xyz, box_pose(label.box), label.box[3:6], 0.15)
                numbers = found["object"][inside]
                numbers = numbers[numbers >= 0]
                assert len(numbers)
                number = np.bincount(numbers).argmax()
                held += int((numbers == number).sum())
                total += int((found["object"] == number).sum())
    assert held / total > 0.99


def test_labels_reach_as_far_as_the_camera_and_movers_go_on_beyond(sequences):
    unlabelled = 0
    for sequence in sequences:
        coverage, azimuth = kitti.label_reach(sequence)
        assert coverage == "camera"
        assert azimuth == pytest.approx((-0.720, 0.703), abs=0.02)
        scan, found = kitti.read_scan(sequence, 0), truth(sequence, 0)
        turn = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
        unlabelled += int((found["moving"] & ((turn < azimuth[0] - 0.1) | (turn > azimuth[1] + 0.1))).sum())
    assert unlabelled > 20


def test_boxes_are_poses_at_the_moment_the_scanner_looks_at_them(sequences):
    from augkitti.scanner import azimuth_time
    from augkitti.seeds import generator

    street = drive_street(SEED, 0, FRAMES, PROFILE.period_s)
    ego = ego_truth(street, FRAMES, PROFILE.period_s, generator(SEED, "clock", 0))
    scan = kitti.read_scan(sequences[0], 1)
    found = 0
    for label in kitti.read_labels(sequences[0], 1):
        moment = azimuth_time(float(np.arctan2(label.box[1], label.box[0])), scan.period_s)
        at = np.array([ego.middle_s[2] + moment])
        T_velo_world = invert(scanner_poses_at(ego, at)[0])
        off = min(
            float(np.abs(transform_points(T_velo_world, body_poses(b, at)[0, :3, 3]) - label.box[:3]).max())
            for b in street.bodies
        )
        found += off < 1e-5
    assert found == len(kitti.read_labels(sequences[0], 1)) > 0


def test_drives_have_streets_of_their_own(sequences):
    first, second = (kitti.read_scan(s, 0) for s in sequences[:2])
    assert len(first) != len(second)


def test_same_seed_gives_the_same_bytes_with_any_number_of_jobs(root, tmp_path):
    synthesize(tmp_path / "again", DRIVES, FRAMES, SEED, PROFILE, jobs=2)
    assert content_digest(tmp_path / "again") == content_digest(root)


def test_other_seed_gives_other_bytes_and_another_name(root, tmp_path):
    synthesize(tmp_path / "other", 1, 1, SEED + 1, PROFILE)
    first = "2000_01_01/2000_01_01_drive_0001_sync/velodyne_points/data/0000000000.bin"
    assert (tmp_path / "other" / first).read_bytes() != (root / first).read_bytes()
    assert street_digest(1, 1, SEED, PROFILE) != street_digest(1, 1, SEED + 1, PROFILE)
    assert street_digest(1, 1, SEED, PROFILE) == street_digest(1, 1, SEED, load_profile())


def test_broken_off_run_leaves_nothing(tmp_path, monkeypatch):
    def break_off(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("augkitti.synthesize._write_times", break_off)
    with pytest.raises(KeyboardInterrupt):
        synthesize(tmp_path / "out", 1, 1, SEED, PROFILE)
    assert list(tmp_path.iterdir()) == []


def test_folder_in_use_and_unwritable_folder_are_answered_in_one_line(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("kept")
    with pytest.raises(InputError, match="not an empty folder"):
        synthesize(tmp_path / "full", 1, 1, SEED, PROFILE)
    with pytest.raises(InputError, match="cannot be written"):
        synthesize(tmp_path / "full" / "file" / "below", 1, 1, SEED, PROFILE)
    with pytest.raises(InputError, match="0 drives"):
        synthesize(tmp_path / "none", 0, 1, SEED, PROFILE)
    assert (tmp_path / "full" / "file").read_text() == "kept"


def test_sidecar_is_the_readers(sequences):
    content = json.loads((sequences[0].folder / kitti.SIDECAR).read_text())
    assert content == {"label_coverage": "camera", "velo_poses": "velo_poses.txt"}
