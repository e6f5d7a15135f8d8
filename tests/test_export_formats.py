"""What comes back from each export equals what went in, to the format's own precision, as the target's reader sees it.

OpenSceneFlow and HPLFlowNet are not on PyPI: here their rules of reading, taken from their source, are written anew.
"""

import json
import os
import pickle
import warnings
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from exported_set import COMPENSATED, export, write_set
from pair_factory import CONFIG, with_scan

import augkitti
from augkitti.export import FORMATS, Scene
from augkitti.frames import box_pose, invert, transform_points
from augkitti.kitti import open_root, read_labels, read_scan
from augkitti.scan_pair import MIXED
from augkitti.scanner import assign_rays, load_profile

GROUND_Z_M = -1.73  # of the pairs here


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set") / "aug"
    write_set(folder)
    return folder


@pytest.fixture(scope="module")
def pairs(source):
    return list(augkitti.open(source))


def exported(source, name, out):
    """Export all pairs; the journal's rows."""
    export(source, name, out)
    return [json.loads(line) for line in (out / "augkitti-pairs.jsonl").read_text().splitlines()]


def known_boxes(pair, k):
    return [(item, getattr(item, f"box{k}")) for item in pair.objects if getattr(item, f"box{k}") is not None]


def in_file(scan):
    """Rows of a scan as KITTI's files have them: ring by ring, counter-clockwise from straight ahead."""
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(np.float64)
    return np.lexsort((np.where(azimuth < 0.0, azimuth + 2.0 * np.pi, azimuth), scan.ring))


# --- opensceneflow ---


@pytest.fixture(scope="module")
def opensceneflow(source, tmp_path_factory):
    pytest.importorskip("h5py", reason="no h5py: pip install augkitti[export]")
    out = tmp_path_factory.mktemp("osf") / "out"
    return out, exported(source, "opensceneflow", out)


def sample(folder, index_name, number):
    """Two sweeps and their labels as OpenSceneFlow's dataset takes them: a sweep of an index, and the next in total."""
    import h5py

    total = pickle.loads((folder / "index_total.pkl").read_bytes())
    scene, stamp = pickle.loads((folder / index_name).read_bytes())[number]
    of_scene = [row for row in total if row[0] == scene]
    first = min(total.index([scene, stamp]), total.index(max(of_scene, key=lambda row: row[1])) - 1)
    assert total[first][0] == total[first + 1][0] == scene
    with h5py.File(folder / f"{scene}.h5", "r") as file:
        return [{key: value[:] for key, value in file[total[first + k][1]].items()} for k in (0, 1)]


def test_opensceneflow_gives_back_points_flow_and_what_is_known_exactly(opensceneflow, pairs):
    folder, _ = opensceneflow
    for number, pair in enumerate(pairs):
        sweeps = sample(folder, "index_flow.pkl", number)
        for sweep, scan in zip(sweeps, (pair.scan0, pair.scan1), strict=True):
            assert sweep["lidar"].dtype == np.float32
            assert np.array_equal(sweep["lidar"], np.column_stack([scan.xyz, scan.reflectance]))
        assert np.array_equal(sweeps[0]["flow"], pair.flow0)
        assert sweeps[0]["flow_is_valid"].dtype == bool
        assert np.array_equal(sweeps[0]["flow_is_valid"], pair.flow_status0 == 0)
        assert np.array_equal(sweeps[0]["flow_instance_id"], pair.scan0.instance + 1)
        assert not [key for key in sweeps[1] if "flow" in key or key == "ego_motion"]


def test_opensceneflow_gives_back_ego_motion_to_a_micrometre(opensceneflow, pairs):
    folder, _ = opensceneflow
    for number, pair in enumerate(pairs):
        first, second = sample(folder, "index_flow.pkl", number)
        assert first["pose"].dtype == np.float32
        by_poses = np.linalg.inv(second["pose"].astype(np.float64)) @ first["pose"]
        assert np.allclose(by_poses, pair.ego_motion, rtol=0, atol=1e-6)
        assert np.allclose(first["ego_motion"], pair.ego_motion, rtol=0, atol=1e-6)
        still = (pair.scan0.instance < 0) & first["flow_is_valid"]
        rigid = transform_points(by_poses, first["lidar"][:, :3]) - first["lidar"][:, :3]
        assert np.abs(rigid - first["flow"])[still].max() < 1e-4


def test_opensceneflow_numbers_categories_as_argoverse_does_from_one(opensceneflow, pairs):
    folder, _ = opensceneflow
    first = sample(folder, "index_flow.pkl", 0)[0]
    categories = first["flow_category_indices"]
    assert categories.dtype == np.uint8
    assert set(categories[pairs[0].scan0.instance == 2]) == {19}  # REGULAR_VEHICLE
    assert set(categories[pairs[0].scan0.instance < 0]) == {0}


def test_opensceneflow_masks_the_ground_and_no_car(opensceneflow, pairs):
    folder, _ = opensceneflow
    for number, pair in enumerate(pairs):
        for sweep, scan in zip(sample(folder, "index_flow.pkl", number), (pair.scan0, pair.scan1), strict=True):
            mask = sweep["ground_mask"]
            road = (np.abs(scan.xyz[:, 2] - GROUND_Z_M) < 0.02) & (scan.instance < 0) & (scan.source >= 0)
            assert mask[road].mean() > 0.95
            assert not mask[(scan.instance >= 0) | (scan.source < 0) | (scan.xyz[:, 2] > 0.0)].any()


def test_opensceneflow_gives_the_moment_of_each_point(opensceneflow, pairs):
    folder, rows = opensceneflow
    for number, pair in enumerate(pairs):
        after = sample(folder, "index_flow.pkl", number)[0]["lidar_dt"]
        if pair.scan_kind == "compensated":
            assert not after.any()
            continue
        azimuth = np.arctan2(pair.scan0.xyz[:, 1], pair.scan0.xyz[:, 0]).astype(np.float64)  # it turns clockwise
        period = pair.time1 - pair.time0
        wanted = (0.5 - azimuth / (2.0 * np.pi)) * period
        assert (
            np.abs(after - wanted)[np.abs(azimuth) < 2.8].max() < 0.03 * period
        )  # beams look to the sides by up to 9 degrees
        assert 0.0 <= after.min() < after.max() <= period
    stamps = [row["nanoseconds"] for row in rows]
    assert [[t / 1e9 for t in both] for both in stamps] == [[pair.time0, pair.time1] for pair in pairs]


def test_opensceneflow_reads_every_pair_from_either_index_and_any_sweep(opensceneflow, pairs):
    folder, rows = opensceneflow
    total = pickle.loads((folder / "index_total.pkl").read_bytes())
    assert total == [[row["scene"], str(stamp)] for row in rows for stamp in row["nanoseconds"]]
    assert len(total) == 2 * len(pairs)
    for number in range(len(total)):  # in training each sweep of a scene leads to its first
        sweeps = sample(folder, "index_total.pkl", number)
        assert "flow" in sweeps[0]
        assert len(sweeps[0]["lidar"]) == len(pairs[number // 2].scan0)


# --- av2 ---


@pytest.fixture(scope="module")
def av2(source, tmp_path_factory):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("bucketed_scene_flow_eval", reason="no bucketed-scene-flow-eval installed")
        from bucketed_scene_flow_eval.datasets.argoverse2 import Argoverse2CausalSceneFlow
    out = tmp_path_factory.mktemp("av2") / "out"
    rows = {row["scene"]: row for row in exported(source, "av2", out)}
    cache = tmp_path_factory.mktemp("cache")

    def read(**options):
        return Argoverse2CausalSceneFlow(
            out / "all", cache_root=cache, use_cache=False, point_cloud_range=None, **options
        )

    flow, boxes = read(), read(load_boxes=True)
    by_name = {pair.pair_id: pair for pair in augkitti.open(source)}
    return flow, boxes, [by_name[rows[name]["pair_id"]] for name in flow.sequence_loader.get_sequence_ids()]


def test_bucketed_eval_reads_each_pair_as_a_log_of_two_sweeps(av2, pairs):
    flow, boxes, order = av2
    assert len(flow) == len(boxes) == len(pairs) == len({pair.pair_id for pair in order})
    for frames, pair in zip(flow, order, strict=False):
        assert np.array_equal(frames[0].pc.full_pc.points, pair.scan0.xyz)
        assert np.array_equal(frames[1].pc.full_pc.points, pair.scan1.xyz)


def test_bucketed_eval_reads_flow_over_ground_poses_and_what_is_known(av2):
    flow, _, order = av2
    for (first, second), pair in zip(flow, order, strict=False):
        assert np.array_equal(first.flow.mask, pair.flow_status0 == 0)
        motion = second.pc.pose.ego_to_global.inverse().compose(first.pc.pose.ego_to_global).to_array()
        assert np.allclose(motion, pair.ego_motion, rtol=0, atol=1e-12)
        moved = transform_points(motion, first.pc.full_pc.points.astype(np.float64) + first.flow.full_flow)
        assert np.abs(moved - pair.scan0.xyz - pair.flow0).max() < 1e-5
        still = (pair.scan0.instance < 0) & first.flow.mask
        assert np.abs(first.flow.full_flow[still]).max() < 1e-4


def test_bucketed_eval_reads_categories_and_scores_the_truth_without_error(av2, tmp_path):
    from bucketed_scene_flow_eval.eval import BucketedEPEEvaluator

    flow, _, order = av2
    names = {number: flow.sequence_loader.category_id_to_name(number) for number in flow.sequence_loader.category_ids()}
    evaluator = BucketedEPEEvaluator(
        names, meta_class_lookup={"BACKGROUND": ["BACKGROUND"], "CAR": ["REGULAR_VEHICLE"]}, output_path=tmp_path
    )
    for (first, _), pair in zip(flow, order, strict=False):
        kinds = {names[int(number)] for number in np.unique(first.pc.full_pc_classes[pair.scan0.instance == 2])}
        assert kinds == {"REGULAR_VEHICLE"}
        assert set(first.pc.full_pc_classes[pair.scan0.instance < 0]) == {-1}
        evaluator.eval(first.flow, first)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # means of empty buckets
        errors = evaluator.compute_results(save_results=False)
    assert errors["CAR"][1] == 0.0
    assert errors["BACKGROUND"][0] == 0.0


def test_bucketed_eval_reads_boxes_turned_as_the_cars_are(av2):
    _, boxes, order = av2
    slopes = 0
    for frames, pair in zip(boxes, order, strict=False):
        for k, frame in enumerate(frames):
            wanted = known_boxes(pair, k)
            assert [box.track_uuid for box in frame.boxes] == [item.id for item, _ in wanted]
            for box, (item, numbers) in zip(frame.boxes, wanted, strict=True):
                pose = getattr(item, f"pose{k}")
                slopes += pose is not None and abs(pose[2, 2] - 1.0) > 1e-4
                wanted_pose = box_pose(numbers) if pose is None else pose
                assert np.allclose(box.pose.to_array(), wanted_pose, rtol=0, atol=1e-9)
                assert [box.length, box.width, box.height] == list(numbers[3:6])
                assert box.category == {"Car": "REGULAR_VEHICLE", "Pedestrian": "PEDESTRIAN"}[item.category]
    assert slopes == 2


def test_bucketed_eval_finds_the_ground_by_the_exported_heights(av2):
    flow, _, order = av2
    for number, pair in enumerate(order):
        sequence = flow.sequence_loader[number]
        for k, scan in enumerate((pair.scan0, pair.scan1)):
            ground = sequence.load(k, 0, with_flow=False)[1].is_ground_points
            near = np.abs(scan.xyz[:, :2]).max(axis=1) < 40.0
            assert ground[near & (scan.xyz[:, 2] < GROUND_Z_M + 0.02)].mean() > 0.99
            assert ground[near & (scan.xyz[:, 2] > GROUND_Z_M + 0.6)].mean() < 1e-3


def test_ground_heights_of_av2_lie_where_its_map_says(pairs):
    xyz = pairs[0].scan0.xyz.copy()
    xyz[:, 2] += 0.04 * xyz[:, 0] - 0.02 * xyz[:, 1]  # another slope along x than along y
    pair = with_scan(pairs[0], 0, xyz=xyz)
    files = FORMATS["av2"].files(pair, Scene(0, "all", CONFIG.ground, load_profile()))
    (heights,) = [np.load(BytesIO(content)) for name, content in files.items() if "_ground_height_surface____" in name]
    (place,) = [json.loads(content) for name, content in files.items() if name.endswith("img_Sim2_city.json")]
    spots = np.array([[10.0, 0.0], [0.0, 6.0], [-12.0, -4.0], [25.0, 5.0]])
    cells = np.rint((spots @ np.reshape(place["R"], (2, 2)).T + place["t"]) * place["s"]).astype(int)  # as theirs
    wanted = GROUND_Z_M + 0.04 * spots[:, 0] - 0.02 * spots[:, 1]
    assert np.allclose(heights[cells[:, 1], cells[:, 0]], wanted, atol=0.03)


def test_sweeps_of_av2_keep_rings_moments_and_reflectance(source, tmp_path, pairs):
    from pyarrow import feather

    rows = exported(source, "av2", tmp_path / "out")
    for row, pair in zip(rows, pairs, strict=True):
        log = tmp_path / "out" / "all" / row["scene"]
        for stamp, scan in zip(row["nanoseconds"], (pair.scan0, pair.scan1), strict=True):
            sweep = feather.read_table(log / "sensors" / "lidar" / f"{stamp}.feather")
            assert np.array_equal(sweep["laser_number"], scan.ring)
            assert np.abs(sweep["intensity"].to_numpy() / 255.0 - scan.reflectance).max() <= 0.5 / 255.0 + 1e-7
            moments = sweep["offset_ns"].to_numpy()
            if pair.sequence == COMPENSATED:
                assert not moments.any()
            else:
                assert -52_000_000 < moments.min() < -40_000_000 < 40_000_000 < moments.max() < 52_000_000


# --- semantickitti ---


@pytest.fixture(scope="module")
def semantickitti(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("semantickitti") / "out"
    exported(source, "semantickitti", out)
    return out


def test_pykitti_reads_scans_times_and_poses(semantickitti, pairs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pykitti = pytest.importorskip("pykitti", reason="no pykitti installed")
    for number, pair in enumerate(pairs):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            read = pykitti.odometry(str(semantickitti), f"{number:02d}")
        for k, scan in enumerate((pair.scan0, pair.scan1)):
            assert np.array_equal(read.get_velo(k), np.column_stack([scan.xyz, scan.reflectance])[in_file(scan)])
        assert [t.total_seconds() for t in read.timestamps] == pytest.approx([0, pair.time1 - pair.time0], abs=1e-6)
        T = read.calib.T_cam0_velo
        assert np.allclose(np.linalg.inv(T) @ read.poses[1] @ T, invert(pair.ego_motion), rtol=0, atol=1e-12)


def among_walls(pair):
    """The pair with both scans taken of one place with walls that face many ways: odometry has something to hold on."""
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-30.0, 30.0, 20_000), rng.uniform(-1.7, 3.0, 20_000)
    facing = rng.integers(0, 6, 20_000) * (np.pi / 3.0)
    away = 12.0 + 3.0 * np.sin(facing)
    walls = np.column_stack([away * np.cos(facing) - u * np.sin(facing), away * np.sin(facing) + u * np.cos(facing), v])
    floor = np.column_stack([rng.uniform(-30.0, 30.0, (20_000, 2)), np.full(20_000, -1.7)])
    place = np.concatenate([walls, floor])
    scans = []
    for scan, T in ((pair.scan0, np.eye(4)), (pair.scan1, pair.ego_motion)):
        xyz = transform_points(T, place).astype(np.float32)
        columns = {
            name: np.zeros(len(xyz), getattr(scan, name).dtype) for name in ("reflectance", "ring", "tick", "surface")
        }
        nobody = {name: np.full(len(xyz), -1, getattr(scan, name).dtype) for name in ("source", "instance")}
        scans.append(replace(scan, xyz=xyz, **columns, **nobody))
    return replace(pair, scan0=scans[0], scan1=scans[1])


def test_kiss_icp_runs_on_a_sequence_and_finds_its_motion(pairs, tmp_path, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("kiss_icp", reason="no kiss-icp installed")
        from kiss_icp.datasets.kitti import KITTIOdometryDataset
        from kiss_icp.pipeline import OdometryPipeline
    monkeypatch.chdir(tmp_path)
    pair = among_walls(pairs[0])
    for name, content in FORMATS["semantickitti"].files(pair, Scene(3, "all", CONFIG.ground, load_profile())).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    data = KITTIOdometryDataset(str(tmp_path), 3)
    column = data.get_frames_timestamps()
    assert column[1, 0] == pair.time1 - pair.time0
    data.get_frames_timestamps = column.ravel  # version 1.3 hands numpy a column where a number belongs
    pipeline = OdometryPipeline(data)
    truth = invert(pair.ego_motion)
    assert np.allclose(pipeline.gt_poses[1], truth, rtol=0, atol=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = pipeline.run()
    assert not results.empty()
    assert np.linalg.norm(truth[:3, 3]) > 0.5
    assert np.linalg.norm((pair.ego_motion @ pipeline.poses[1])[:3, 3]) < 0.05


@pytest.fixture
def open3d_datasets():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            from open3d.ml import datasets
        except ImportError as err:
            pytest.skip(f"no Open3D-ML: {err}")
    return datasets


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_open3d_reads_points_and_classes_of_semantickitti(semantickitti, pairs, tmp_path, open3d_datasets):
    os.symlink(semantickitti, tmp_path / "dataset")
    names = [f"{number:02d}" for number in range(len(pairs))]
    split = open3d_datasets.SemanticKITTI(str(tmp_path), all_split=names).get_split("all")
    assert len(split) == 2 * len(pairs)
    for number in range(len(split)):
        read, pair = split.get_data(number), pairs[number // 2]
        scan = (pair.scan0, pair.scan1)[number % 2]
        rows = in_file(scan)
        assert np.array_equal(read["point"], scan.xyz[rows])
        assert np.array_equal(read["feat"][:, 0], scan.reflectance[rows])
        assert np.array_equal(
            read["label"] == 1, scan.instance[rows] >= 0
        )  # cars; what has no motion has no points here


def test_labels_of_semantickitti_tell_moving_cars_from_standing_ones_and_keep_instances(semantickitti, pairs):
    for number, pair in enumerate(pairs):
        for k, scan in enumerate((pair.scan0, pair.scan1)):
            label = np.fromfile(semantickitti / f"sequences/{number:02d}/labels/{k:06d}.label", np.uint32)
            of_shard = np.empty_like(label)
            of_shard[in_file(scan)] = label
            label = of_shard
            assert np.array_equal(label >> 16, scan.instance + 1)
            classes = label & 0xFFFF
            virtual = {252} if pair.objects[2].speed > 0.0 else {10}
            assert set(classes[scan.instance == 2]) == virtual
            assert set(classes[scan.instance == 0]) == {10}
            assert set(classes[scan.surface == MIXED]) == {1}
            assert set(classes[(scan.instance < 0) & (scan.surface != MIXED)]) == {0}
    assert {pair.objects[2].speed > 0.0 for pair in pairs} == {True, False}


# --- kitti-object ---


@pytest.fixture(scope="module")
def kitti_object(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("kitti-object") / "out"
    exported(source, "kitti-object", out)
    return out


def test_our_own_reader_gives_back_scans_and_boxes_of_kitti_object(kitti_object, pairs):
    sequence = open_root(kitti_object).sequence("object_training")
    assert sequence.frames == tuple(range(2 * len(pairs)))
    for frame in sequence.frames:
        pair, k = pairs[frame // 2], frame % 2
        scan, read, wanted = (pair.scan0, pair.scan1)[k], read_scan(sequence, frame), known_boxes(pair, k)
        rows = in_file(scan)
        assert np.array_equal(read.xyz, scan.xyz[rows])
        assert np.array_equal(read.reflectance, scan.reflectance[rows])
        if pair.scan_kind == "raw":  # the beams are found by the order of points
            rays = assign_rays(replace(read, kind="raw", period_s=pair.time1 - pair.time0), load_profile())
            assert np.array_equal(rays.ring, scan.ring[rows])
            assert np.array_equal(rays.tick, scan.tick[rows])
        labels = read_labels(sequence, frame)
        assert [label.category for label in labels] == [item.category for item, _ in wanted]
        for label, (_, box) in zip(labels, wanted, strict=True):
            assert np.allclose(label.box, box, rtol=0, atol=1.5e-6)


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_open3d_reads_scans_and_boxes_of_kitti_object(kitti_object, pairs, open3d_datasets):
    split = open3d_datasets.KITTI(str(kitti_object)).get_split("all")
    assert len(split) == 2 * len(pairs)
    for number in range(len(split)):
        with np.errstate(divide="ignore", invalid="ignore"):  # points in the camera's own plane
            read = split.get_data(number)
        pair, k = pairs[number // 2], number % 2
        scan, wanted = (pair.scan0, pair.scan1)[k], known_boxes(pair, k)
        assert np.array_equal(read["full_point"][:, :3], scan.xyz[in_file(scan)])
        assert len(read["bounding_boxes"]) == len(wanted)
        for box, (item, numbers) in zip(read["bounding_boxes"], wanted, strict=True):
            assert np.allclose(box.center, numbers[:3], atol=1e-5)
            assert np.allclose(box.size, numbers[[4, 5, 3]], atol=1e-5)  # width, height, length
            assert np.cos(box.yaw + 0.5 * np.pi + numbers[6]) == pytest.approx(1.0)
            assert box.label_class == item.category
            if item.origin == "virtual" and numbers[0] > 5.0:
                assert box.get_difficulty() in (0, 1, 2)
                assert box.to_img()[2:4].min() > 10.0


def test_image_boxes_hold_the_points_of_the_car_in_front_and_nothing_behind(kitti_object, pairs):
    for number, pair in enumerate(pairs):
        lines = (kitti_object / f"training/label_2/{2 * number:06d}.txt").read_text().splitlines()
        assert all(len(line.split()) == 15 for line in lines)
        left, top, right, bottom = map(float, lines[2].split()[4:8])
        xyz = pair.scan0.xyz[pair.scan0.instance == 2].astype(np.float64)
        u, v = 609.5593 - 721.5377 * xyz[:, 1] / xyz[:, 0], 172.854 - 721.5377 * xyz[:, 2] / xyz[:, 0]
        inside = (u >= left - 1) & (u <= right + 1) & (v >= top - 1) & (v <= bottom + 1)
        in_picture = (u >= 0) & (u <= 1241) & (v >= 0) & (v <= 374)
        assert in_picture.any()
        assert inside[in_picture].all()
        behind = lines[1].split()  # a pedestrian behind the car
        assert behind[0] == "Pedestrian"
        assert behind[1] == "1.00"
        assert [float(word) for word in behind[4:8]] == [0.0, 0.0, 0.0, 0.0]


# --- hplflownet ---


def test_hplflownet_reads_points_before_and_after_their_flow(source, pairs, tmp_path):
    exported(source, "hplflownet", tmp_path)
    root = tmp_path / "KITTI_processed_occ_final"
    folders = [Path(at) for at, below, _ in sorted(os.walk(root)) if not below]
    assert [int(folder.name) for folder in folders] == list(range(len(pairs)))
    for folder, pair in zip(folders, pairs, strict=True):
        pc1, pc2 = np.load(folder / "pc1.npy"), np.load(folder / "pc2.npy")
        assert pc1.dtype == pc2.dtype == np.float32
        known = pair.flow_status0 == 0
        assert not known.all()
        back = [2, 0, 1]  # left, up, forward to forward, left, up
        assert np.array_equal(pc1[:, back], pair.scan0.xyz[known])
        assert np.abs((pc2 - pc1)[:, back] - pair.flow0[known]).max() < 1e-5
        assert np.array_equal(np.load(folder / "scan2.npy")[:, back], pair.scan1.xyz)
        ground = (pc1[:, 1] < -1.4) & (pc2[:, 1] < -1.4)  # the reader's rule
        assert np.array_equal(ground, (pair.scan0.xyz[known, 2] < -1.4) & (pc2[:, 1] < -1.4))
        assert 0.05 < ground.mean() < 0.95


def test_every_format_is_checked_here():
    assert set(FORMATS) == {"opensceneflow", "av2", "semantickitti", "kitti-object", "hplflownet"}
