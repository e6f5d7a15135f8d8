import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from pair_factory import CONFIG, make_pair, metadata, with_object, with_scan, write_data_set, write_whole_index

from augkitti.config import GroundConfig
from augkitti.dataset_index import read_index, shard_entry
from augkitti.errors import InputError
from augkitti.frames import compose, pose_from_xyz_yaw, transform_points
from augkitti.ground import fit_ground
from augkitti.scan_pair import AugmentedPair
from augkitti.shards import read_pair, write_shard
from augkitti.splits import split_dataset
from augkitti.validate import CHECKS, TITLES, Source, rules_of, validate_pair
from augkitti.validate_folder import validate_folder

CAR = 2  # row of the virtual car in the factory's objects
LABELLED = 0
RULES = rules_of(metadata(), "factory")


@pytest.fixture(scope="module")
def made():
    return make_pair()


@pytest.fixture(scope="module")
def pair(made):
    return made.pair


@pytest.fixture(scope="module")
def source(made):
    return source_of(made)


def source_of(made):
    grounds = [fit_ground(np.ascontiguousarray(rows[:, :3]), GroundConfig()) for rows in made.rows]
    return Source(*made.rows, *grounds)


def found(pair: AugmentedPair, source: Source | None = None) -> set[int]:
    return {offence.invariant for offence in validate_pair(pair, RULES, source)}


def changed(values, row, value):
    out = np.array(values)
    out[row] = value
    return out


def measured(scan, n=1000):
    return int(np.flatnonzero((scan.source >= 0) & (scan.instance < 0))[n])


def simulated(scan, n=50):
    return int(np.flatnonzero((scan.source < 0) & (scan.instance == CAR))[n])


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"kind": "compensated"},
        {"place": (-6.0, 6.0, 3.0), "speed_mps": -2.0},
        {"place": (25.0, 3.0, 1.5), "speed_mps": 20.0, "yaw_rate_rps": -0.1},
    ],
    ids=["raw", "compensated", "reversing beside", "fast and crossing"],
)
def test_sound_pair_has_no_offence(settings):
    made = make_pair(**settings)
    assert validate_pair(made.pair, RULES, None) == []
    assert validate_pair(made.pair, RULES, source_of(made)) == []


# --- planted faults, each found by its own invariant ------------------------------------------------------------


def test_columns_of_unequal_length_are_found(pair):
    broken = with_scan(pair, 1, ring=pair.scan1.ring[:-1])
    (offence,) = validate_pair(broken, RULES)
    assert (offence.invariant, offence.column) == (1, "ring1")


def test_flow_of_another_length_is_found(pair):
    assert found(replace(pair, flow0=pair.flow0[1:])) == {1}


def test_nan_in_points_is_found(pair):
    row = measured(pair.scan0)
    assert 1 in found(with_scan(pair, 0, xyz=changed(pair.scan0.xyz, row, np.nan)))


def test_reflectance_beyond_one_is_found(pair):
    row = measured(pair.scan1)
    assert found(with_scan(pair, 1, reflectance=changed(pair.scan1.reflectance, row, 1.01))) == {1}


def test_rows_out_of_order_are_found(pair):
    order = np.arange(len(pair.scan1))
    order[[100, 101]] = 101, 100
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    assert found(with_scan(pair, 1, **{name: getattr(pair.scan1, name)[order] for name in names})) == {1}


def test_infinite_box_is_found(pair):
    box = changed(pair.objects[LABELLED].box0, 0, np.inf)
    assert 1 in found(with_object(pair, LABELLED, box0=box))


def test_pair_id_of_another_frame_is_found(pair):
    assert found(replace(pair, pair_id=f"{pair.sequence}/99/0")) == {1}


def test_moved_measured_point_is_found(pair, source):
    row = measured(pair.scan0)
    xyz = changed(pair.scan0.xyz, row, np.nextafter(pair.scan0.xyz[row], np.float32(100.0)))
    assert found(with_scan(pair, 0, xyz=xyz), source) == {2}


def test_changed_reflectance_is_found(pair, source):
    row = measured(pair.scan1)
    assert found(with_scan(pair, 1, reflectance=changed(pair.scan1.reflectance, row, 0.26)), source) == {2}


def test_dropped_row_is_found(pair, source):
    row = measured(pair.scan1)
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    broken = with_scan(pair, 1, **{name: np.delete(getattr(pair.scan1, name), row, axis=0) for name in names})
    assert found(broken, source) == {3}


def test_row_that_is_kept_and_removed_is_found_without_the_source(pair):
    twice = pair.scan1.source[measured(pair.scan1)]
    removed = np.sort(np.append(pair.scan1.removed, twice))
    assert 3 in found(with_scan(pair, 1, removed=removed))


def test_invalid_source_row_is_found(made, source):
    row = int(made.pair.scan1.source[measured(made.pair.scan1)])
    rows = changed(made.rows[1], row, 0.0)
    assert 3 in found(made.pair, replace(source, rows1=rows))


def test_swapped_instance_is_found(pair):
    row = simulated(pair.scan1)
    assert found(with_scan(pair, 1, instance=changed(pair.scan1.instance, row, LABELLED))) == {4}


def test_instance_of_no_object_is_found(pair):
    row = simulated(pair.scan1)
    assert 4 in found(with_scan(pair, 1, instance=changed(pair.scan1.instance, row, 17)))


def test_bad_count_is_found(pair):
    assert found(with_object(pair, LABELLED, points0=pair.objects[LABELLED].points0 + 1)) == {4}


def test_fewer_rays_than_returns_are_found(pair):
    assert found(with_object(pair, CAR, rays1=pair.objects[CAR].points1 - 1)) == {4}


def test_mixed_point_with_an_instance_is_found(pair):
    row = int(np.flatnonzero(pair.scan1.surface == 7)[0])
    assert 4 in found(with_scan(pair, 1, instance=changed(pair.scan1.instance, row, CAR)))


def test_mixed_point_with_known_flow_is_found(pair):
    row = int(np.flatnonzero(pair.scan0.surface == 7)[0])
    assert found(replace(pair, flow_status0=changed(pair.flow_status0, row, 0))) == {4}


def test_return_outside_its_car_is_found(pair):
    row = simulated(pair.scan1)
    along = pair.scan1.xyz[row] * np.float32(0.8)
    assert 4 in found(with_scan(pair, 1, xyz=changed(pair.scan1.xyz, row, along)))


def test_labelled_point_outside_its_box_is_found(pair):
    row = measured(pair.scan1)
    broken = with_scan(pair, 1, instance=changed(pair.scan1.instance, row, LABELLED))
    assert found(with_object(broken, LABELLED, points1=pair.objects[LABELLED].points1 + 1)) == {4}


def test_label_that_lacks_its_points_is_found(pair, source):
    inside = pair.objects[LABELLED].box1[:3].astype(np.float32)
    broken = with_scan(pair, 1, xyz=changed(pair.scan1.xyz, measured(pair.scan1), inside))
    messages = [offence.message for offence in validate_pair(broken, RULES, source)]
    assert "of a point in the box of objects[0] is -1" in messages


def test_known_flow_round_a_moving_label_is_found(pair):
    assert found(with_object(pair, LABELLED, speed=5.0)) == {5}


def test_known_flow_of_a_label_straight_behind_is_found(pair):
    box = changed(pair.objects[LABELLED].box0, [0, 1], [-12.0, 0.5])
    messages = [offence.message for offence in validate_pair(with_object(pair, LABELLED, box0=box), RULES)]
    assert any("straight behind" in message for message in messages)


@pytest.mark.parametrize("which", [measured, simulated])
def test_flow_off_by_a_centimetre_is_found(pair, which):
    row = which(pair.scan0)
    flow = changed(pair.flow0, row, pair.flow0[row] + np.float32([0.01, 0.0, 0.0]))
    assert found(replace(pair, flow0=flow)) == {5}


def test_unknown_flow_that_is_not_ego_motion_is_found(pair):
    row = simulated(pair.scan0)
    assert found(replace(pair, flow_status0=changed(pair.flow_status0, row, 1))) == {5}


def test_matrix_that_is_not_rigid_is_found(pair):
    assert 6 in found(with_object(pair, CAR, pose1=pair.objects[CAR].pose1 * (1.0 + 1e-5)))


def test_motion_that_is_not_that_of_the_poses_is_found(pair):
    item = pair.objects[CAR]
    motion = compose(pose_from_xyz_yaw(0.0, 0.0, 2e-5, 0.0), item.motion)
    assert found(with_object(pair, CAR, motion=motion)) == {6}


def test_box_that_does_not_follow_the_motion_is_found(pair):
    box = pair.objects[LABELLED].box1 + np.array([0.002, 0, 0, 0, 0, 0, 0])
    assert 6 in found(with_object(pair, LABELLED, box1=box))


def test_box_that_turns_otherwise_is_found(pair):
    box = pair.objects[LABELLED].box1 + np.array([0, 0, 0, 0, 0, 0, 0.01])
    assert 6 in found(with_object(pair, LABELLED, box1=box))


def test_virtual_car_without_a_pose_is_found(pair):
    assert 6 in found(with_object(pair, CAR, pose0=None))


def test_moment_when_the_scanner_looks_elsewhere_is_found(pair):
    assert 6 in found(with_object(pair, LABELLED, moment0=0.03))


def test_return_off_its_ray_is_found(pair):
    row = simulated(pair.scan1)
    xyz = changed(pair.scan1.xyz, row, pair.scan1.xyz[row] + np.float32([0.0, 0.004, 0.0]))
    assert found(with_scan(pair, 1, xyz=xyz)) == {7}


def test_tick_that_was_not_fired_is_found(pair):
    row = simulated(pair.scan1)
    assert 7 in found(with_scan(pair, 1, tick=changed(pair.scan1.tick, row, pair.scan1.tick[row] + 1)))


def test_a_tick_whose_every_measured_return_a_car_hides_was_fired_all_the_same(pair, source):
    tick = pair.scan1.tick[simulated(pair.scan1)]
    gone = (pair.scan1.source >= 0) & (pair.scan1.tick == tick)
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    scan = {name: getattr(pair.scan1, name)[~gone] for name in names}
    scan["removed"] = np.sort(np.concatenate([pair.scan1.removed, pair.scan1.source[gone]]))
    hidden = with_scan(pair, 1, **scan)
    assert gone.any()
    assert not any("not fired" in offence.message for offence in validate_pair(hidden, RULES, source))


def test_doubled_ray_is_found(pair):
    row = simulated(pair.scan1)
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    scan = {name: np.insert(getattr(pair.scan1, name), row, getattr(pair.scan1, name)[row], axis=0) for name in names}
    broken = with_object(with_scan(pair, 1, **scan), CAR, points1=pair.objects[CAR].points1 + 1)
    assert found(broken) == {7}


def test_return_in_the_shadow_of_the_ego_car_is_found(pair):
    ring, tick = (int(i) for i in np.argwhere(RULES.profile.blind)[8])
    fired = np.unique(pair.scan1.tick)
    tick = int(fired[np.argmin(np.abs(fired.astype(int) - tick))])
    ring = int(np.flatnonzero(RULES.profile.blind[:, tick])[0])
    row = simulated(pair.scan1)
    broken = with_scan(pair, 1, ring=changed(pair.scan1.ring, row, ring), tick=changed(pair.scan1.tick, row, tick))
    messages = [offence.message for offence in validate_pair(broken, RULES)]
    assert any("shadow" in message for message in messages)


def test_removed_row_that_no_car_hides_is_found(pair, source):
    row = measured(pair.scan1)
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    scan = {name: np.delete(getattr(pair.scan1, name), row, axis=0) for name in names}
    removed = np.sort(np.append(pair.scan1.removed, pair.scan1.source[row])).astype(np.int32)
    assert found(with_scan(pair, 1, **scan, removed=removed), source) == {8}


def test_removed_row_before_the_car_is_found(made, source):
    pair = made.pair
    ray = RULES.rays(pair.scan1.ring, pair.scan1.tick)
    row = simulated(pair.scan1)
    origin, direction = ray[0][row], ray[1][row]
    on_ray = RULES.lines_to(
        made.rows[1][pair.scan1.removed, :3].astype(np.float64), np.full(len(pair.scan1.removed), pair.scan1.ring[row])
    )
    nearest = int(np.argmin(((on_ray[1] - direction) ** 2).sum(axis=1)))
    rows = changed(made.rows[1], pair.scan1.removed[nearest], [*np.round(origin + 6.0 * direction, 3), 0.25])
    offences = validate_pair(pair, RULES, replace(source, rows1=rows))
    assert {offence.invariant for offence in offences} == {8}


@pytest.mark.parametrize("kind", ["raw", "compensated"])
def test_measured_point_behind_an_opaque_return_is_found(kind):
    made = make_pair(kind=kind)
    pair, k = made.pair, 1
    scan = pair.scan1
    paint = np.flatnonzero(scan.surface == 1)
    if kind == "raw":
        key = scan.ring.astype(int) * 4000 + scan.tick
        back = made.rows[k][scan.removed, :3]
        ring, tick = all_rays(back)
        hidden = np.flatnonzero(np.isin(ring * 4000 + tick, key[paint]))[5]
        ring, tick = ring[hidden], tick[hidden]
    else:
        back = made.rows[k][scan.removed, :3].astype(np.float64)
        d_hidden, d_paint = (p / np.linalg.norm(p, axis=1)[:, None] for p in (back, scan.xyz[paint]))
        hidden, which = np.unravel_index(np.argmax(d_hidden @ d_paint.T), (len(back), len(paint)))
        ring, tick = scan.ring[paint[which]], 65535
        direction = RULES.lines_to(scan.xyz[paint[which : which + 1]], np.array([ring]))
        back[hidden] = (direction[0] + 1.3 * np.linalg.norm(scan.xyz[paint[which]]) * direction[1])[0]
    source_row = scan.removed[hidden]
    at = int(np.searchsorted(scan.source[scan.source >= 0], source_row))
    new = {
        "xyz": back[hidden].astype(np.float32),
        "reflectance": 0.25,
        "ring": ring,
        "tick": tick,
        "source": source_row,
        "instance": -1,
        "surface": 0,
    }
    columns = {name: np.insert(getattr(scan, name), at, value, axis=0) for name, value in new.items()}
    broken = with_scan(pair, 1, **columns, removed=np.delete(scan.removed, hidden))
    offences = [o for o in validate_pair(broken, RULES) if o.invariant == 8]
    assert any("behind an opaque return" in offence.message for offence in offences)


def all_rays(xyz):
    """Ring and tick of points by trying every beam."""
    best, ring, tick = np.full(len(xyz), np.inf), np.zeros(len(xyz), int), np.zeros(len(xyz), int)
    for beam in range(64):
        ticks = RULES.nearest_tick(xyz, np.full(len(xyz), beam))
        origin, direction = RULES.rays(np.full(len(xyz), beam), ticks)
        offset = xyz - origin
        across = np.linalg.norm(offset - (offset * direction).sum(1)[:, None] * direction, axis=1)
        better = across < best
        best[better], ring[better], tick[better] = across[better], beam, ticks[better]
    return ring, tick


@pytest.mark.parametrize("kind", ["raw", "compensated"])
def test_body_that_hides_nothing_is_found(kind):
    made = make_pair(kind=kind)
    pair = made.pair
    scan = pair.scan1
    keep = np.flatnonzero(scan.source >= 0)
    rows = made.rows[1]
    ring, tick = all_rays(rows[scan.removed, :3])
    source = np.concatenate([scan.source[keep], scan.removed])
    order = np.argsort(source)
    columns = {
        "xyz": np.concatenate([scan.xyz[keep], rows[scan.removed, :3]])[order],
        "reflectance": rows[source[order], 3],
        "ring": np.concatenate([scan.ring[keep], ring]).astype(np.uint8)[order],
        "tick": np.concatenate([scan.tick[keep], tick if kind == "raw" else 0 * tick + 65535]).astype(np.uint16)[order],
        "source": source[order].astype(np.int32),
        "instance": np.concatenate([scan.instance[keep], 0 * ring - 1]).astype(np.int16)[order],
        "surface": np.zeros(len(source), np.uint8),
        "removed": np.zeros(0, np.int32),
    }
    offences = validate_pair(with_scan(pair, 1, **columns), RULES)
    assert any(o.invariant == 8 and "rays through its body" in o.message for o in offences)


def test_pair_without_a_virtual_car_is_found_where_cars_were_asked_for(pair):
    plain = [replace(item, origin="labelled") if row == CAR else item for row, item in enumerate(pair.objects)]
    assert 9 in found(replace(pair, objects=tuple(plain)))


def test_too_few_returns_are_found(pair):
    strict = replace(RULES, min_points=pair.objects[CAR].points1 + 1)
    assert {o.invariant for o in validate_pair(pair, strict)} == {9}


def test_speed_none_is_found(pair):
    assert {6, 9} <= found(with_object(pair, CAR, speed=None))


def test_pair_in_which_no_virtual_car_moves_is_found():
    standing = make_pair(speed_mps=0.0, yaw_rate_rps=0.0)
    assert found(standing.pair) == {9}


def test_speed_that_the_poses_do_not_have_is_found(pair):
    assert found(with_object(pair, CAR, speed=pair.objects[CAR].speed + 0.5)) == {9}


def test_overlapping_boxes_are_found(pair):
    boxes = {}
    for k, name in ((0, "box0"), (1, "box1")):
        box = np.array(getattr(pair.objects[CAR], name))
        size = np.array([0.8, 0.6, 1.8])
        beside = transform_points(getattr(pair.objects[CAR], f"pose{k}"), np.array([2.2, 0.5, 0.0]))
        boxes[name] = np.array([*beside, *size, box[6]])
    walker = replace(
        pair.objects[LABELLED], id="walker", points0=0, points1=0, motion=pair.objects[CAR].motion, **boxes
    )
    walker = replace(walker, moment0=pair.objects[CAR].moment0, moment1=pair.objects[CAR].moment1)
    assert found(replace(pair, objects=(*pair.objects, walker))) == {9}


def test_measured_point_inside_a_virtual_car_is_found(made):
    far_below = make_pair(place=(9.0, 4.5, 0.05), speed_mps=0.5, yaw_rate_rps=0.0)  # where the parked car stands
    messages = [o.message for o in validate_pair(far_below.pair, RULES)]
    assert any("touches the box" in message for message in messages)
    pair = made.pair
    inside = transform_points(pair.objects[CAR].pose1, np.array([0.3, 0.2, 0.1])).astype(np.float32)
    broken = with_scan(pair, 1, xyz=changed(pair.scan1.xyz, measured(pair.scan1), inside))
    assert 9 in found(broken)


def test_car_straight_behind_in_a_raw_scan_is_found():
    behind = make_pair(place=(-12.0, -1.0, 0.0), speed_mps=4.0, yaw_rate_rps=0.0)
    assert any("straight behind" in offence.message for offence in validate_pair(behind.pair, RULES))


def test_floating_car_is_found(pair, source):
    up = pose_from_xyz_yaw(0.0, 0.0, 0.12, 0.0)
    item = pair.objects[CAR]
    lifted = with_object(
        pair,
        CAR,
        pose0=compose(up, item.pose0),
        pose1=compose(up, item.pose1),
        box0=item.box0 + np.array([0, 0, 0.12, 0, 0, 0, 0]),
        box1=item.box1 + np.array([0, 0, 0.12, 0, 0, 0, 0]),
        motion=compose(compose(up, item.pose1), np.linalg.inv(compose(up, item.pose0))),
    )
    assert 10 in found(lifted, source)
    assert 10 not in found(lifted)


def test_every_invariant_has_a_check_but_the_last():
    assert set(CHECKS) == set(TITLES) - {11} == set(range(1, 11))


# --- the folder -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    base = tmp_path_factory.mktemp("clean")
    write_data_set(base / "aug", base / "kitti", recordings=3)
    split_dataset(base / "aug")
    return base


@pytest.fixture
def copied(data_set, tmp_path):
    shutil.copytree(data_set, tmp_path / "copy")
    return tmp_path / "copy"


def test_clean_folder_gives_nothing(data_set):
    report = validate_folder(data_set / "aug", data_set / "kitti")
    assert report.ok, report.first
    assert (report.pairs, report.shards) == (3, 3)
    assert report.checked == dict.fromkeys(range(1, 11), 3)
    assert set(report.unchecked) == {11}
    assert json.loads(json.dumps(report.as_json()))["ok"] is True


def test_without_sources_the_report_says_what_was_not_checked(data_set):
    report = validate_folder(data_set / "aug")
    assert report.ok
    assert set(report.unchecked) == {2, 3, 8, 10, 11}
    assert report.checked[2] == 0
    assert report.checked[5] == 3


def test_source_that_is_missing_is_named(data_set, tmp_path):
    other = tmp_path / "kitti"
    shutil.copytree(data_set / "kitti", other)
    shutil.rmtree(next((other / "raw" / "2011_09_26").iterdir()))
    report = validate_folder(data_set / "aug", other)
    assert report.ok
    assert report.checked[2] == 2
    assert "holds no sequence" in report.unchecked[2]


def test_report_is_the_same_with_two_processes(data_set):
    assert validate_folder(data_set / "aug", jobs=2) == validate_folder(data_set / "aug")


def test_offence_of_a_pair_is_reported_with_its_name_and_column(copied):
    folder = copied / "aug"
    index = read_index(folder)
    path = folder / index.shards[1].path
    pair = read_pair(path, 0)
    row = measured(pair.scan0)
    flow = changed(pair.flow0, row, 3.0)
    write_shard(path, [replace(pair, flow0=flow)], metadata())
    entry = index.shards[1]
    entries = [*index.shards[:1], shard_entry(folder, path, entry.sequence, entry.recording, 1), *index.shards[2:]]
    write_whole_index(folder, entries)
    report = validate_folder(folder)
    assert report.counts == {5: 1}
    assert (report.first[0].pair_id, report.first[0].column) == (pair.pair_id, f"flow0[{row}]")


def test_changed_file_is_found(copied):
    path = next((copied / "aug" / "data").iterdir())
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    report = validate_folder(copied / "aug")
    assert any("sha256" in offence.message for offence in report.first)


def test_missing_shard_is_found(copied):
    next((copied / "aug" / "data").iterdir()).unlink()
    report = validate_folder(copied / "aug")
    assert report.counts == {0: 1}
    assert "does not exist" in report.first[0].message


def test_stray_file_is_found(copied):
    (copied / "aug" / "data" / ".lock").write_text("")
    report = validate_folder(copied / "aug")
    assert [(o.invariant, o.pair_id) for o in report.first] == [(0, "data/.lock")]


def test_row_count_other_than_the_index_says_is_found(copied):
    folder = copied / "aug"
    index = read_index(folder)
    write_whole_index(folder, [replace(index.shards[0], rows=2), *index.shards[1:]])
    assert any("row groups" in offence.message for offence in validate_folder(folder).first)


def test_splits_that_divide_a_recording_are_found(copied):
    folder = copied / "aug"
    splits = json.loads((folder / "splits.json").read_text())
    splits["splits"]["train"] = splits["splits"]["train"] * 2
    splits["splits"]["test"] = []
    (folder / "splits.json").write_text(json.dumps(splits))
    messages = " ".join(offence.message for offence in validate_folder(folder).first)
    assert "listed twice" in messages
    assert "is in no split" in messages


def test_pair_id_that_stands_twice_is_found(tmp_path):
    made = make_pair()
    entries = []
    for shard in range(2):
        path = tmp_path / "data" / f"s-{shard}.parquet"
        write_shard(path, [made.pair], metadata())
        entries.append(shard_entry(tmp_path, path, made.pair.sequence, made.pair.recording, 1))
    write_whole_index(tmp_path, entries)
    report = validate_folder(tmp_path)
    assert [offence.column for offence in report.first] == ["pair_id"]


def test_digest_that_is_not_of_its_content_is_found(copied):
    folder = copied / "aug"
    index = read_index(folder)
    entry = index.shards[0]
    path = folder / entry.path
    wrong = {**metadata(), "configuration_digest": "0" * 64}
    write_shard(path, [read_pair(path, 0)], wrong)
    entries = [shard_entry(folder, path, entry.sequence, entry.recording, 1), *index.shards[1:]]
    write_whole_index(folder, entries)
    assert {o.column for o in validate_folder(folder).first} == {"configuration_digest"}


def test_unfinished_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="unfinished"):
        validate_folder(tmp_path)


def test_metadata_without_rules_is_an_error_of_one_line():
    with pytest.raises(InputError, match="metadata without"):
        rules_of({"configuration": CONFIG.model_dump()}, "x.parquet")
