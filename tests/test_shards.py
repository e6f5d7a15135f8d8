import json
import pickle
import subprocess
import sys
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pair_factory import make_pair, metadata, write_data_set, write_whole_index

import augkitti
from augkitti.dataset_index import read_index, shard_entry
from augkitti.errors import InputError
from augkitti.shards import (
    CONTRACT_VERSION,
    METADATA_KEY,
    OBJECT,
    SCHEMA,
    from_table,
    read_frames,
    read_metadata,
    read_pair,
    read_pair_ids,
    read_pairs,
    schema_page,
    to_table,
    write_shard,
)
from augkitti.splits import split_dataset
from pipelines.plan import plan_shards, stream

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def pairs():
    return [make_pair(frame0=frame, tick_step=40).pair for frame in (0, 3, 5)]


@pytest.fixture(scope="module")
def shard(pairs, tmp_path_factory):
    path = tmp_path_factory.mktemp("shard") / "one.parquet"
    write_shard(path, iter(pairs), metadata())
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    base = tmp_path_factory.mktemp("set")
    write_data_set(base / "aug", base / "kitti", recordings=3, pairs=2)
    split_dataset(base / "aug")
    return base / "aug"


def same(a, b):
    """Whether two records hold the same bits."""
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


def test_round_trip_is_exact(pairs, shard):
    assert all(same(a, b) for a, b in zip(pairs, read_pairs(shard), strict=True))


@settings(max_examples=15, deadline=None)
@given(
    xyz=arrays(np.float32, (7, 3)),
    source=arrays(np.int32, 7),
    tick=arrays(np.uint16, 7),
    removed=arrays(np.int32, st.integers(0, 4)),
    box=st.none() | arrays(np.float64, 7),
    azimuth=st.none() | st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    seed=st.integers(0, 2**63 - 1),
)
def test_round_trip_is_exact_for_any_values(xyz, source, tick, removed, box, azimuth, seed):
    pair = make_pair_of_seven()
    scan = replace(pair.scan0, xyz=xyz, source=source, tick=tick, removed=removed)
    item = replace(pair.objects[0], box0=box)
    pair = replace(pair, scan0=scan, seed=seed, label_azimuth=azimuth, objects=(item, *pair.objects[1:]))
    assert same(from_table(to_table(pair)), pair)


def make_pair_of_seven():
    pair = make_pair(tick_step=400).pair
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    scan = replace(pair.scan0, **{name: getattr(pair.scan0, name)[:7] for name in names})
    return replace(pair, scan0=scan, flow0=pair.flow0[:7], flow_status0=pair.flow_status0[:7])


def test_pair_without_points_and_objects_round_trips():
    pair = make_pair_of_seven()
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface", "removed")
    empty = replace(pair.scan0, **{name: getattr(pair.scan0, name)[:0] for name in names})
    pair = replace(pair, scan0=empty, scan1=empty, flow0=pair.flow0[:0], flow_status0=pair.flow_status0[:0], objects=())
    assert same(from_table(to_table(pair)), pair)


def test_same_pairs_give_same_bytes(pairs, shard, tmp_path):
    again = tmp_path / "other" / "name.parquet"
    write_shard(again, pairs, metadata())
    assert again.read_bytes() == shard.read_bytes()


def test_row_group_is_one_pair(shard, pairs):
    file = pq.ParquetFile(shard)
    assert file.num_row_groups == file.metadata.num_rows == len(pairs)
    assert same(read_pair(shard, 1), pairs[1])
    assert read_pair_ids(shard) == [pair.pair_id for pair in pairs]
    assert read_frames(shard) == [(pair.frame0, pair.frame1) for pair in pairs]


def test_other_readers_see_the_same_values(shard, pairs):
    table = pyarrow.dataset.dataset(shard).to_table(columns=["pair_id", "xyz0", "source1", "objects"])
    assert table.column("pair_id").to_pylist() == [pair.pair_id for pair in pairs]
    assert table.column("xyz0")[2].as_py() == pairs[2].scan0.xyz.reshape(-1).tolist()
    assert table.column("source1")[0].as_py() == pairs[0].scan1.source.tolist()
    assert table.column("objects")[1].as_py()[2]["motion"] == pairs[1].objects[2].motion.reshape(-1).tolist()


def column_chunks(shard):
    """What the file says of the first row's columns, by name; lists without their `.list.element`."""
    group = pq.ParquetFile(shard).metadata.row_group(0)
    chunks = [group.column(i) for i in range(group.num_columns)]
    return {chunk.path_in_schema.removesuffix(".list.element"): chunk for chunk in chunks}


def test_big_columns_carry_no_statistics(shard):
    columns = column_chunks(shard)
    assert columns["pair_id"].is_stats_set
    assert not any(columns[name].is_stats_set for name in ("xyz0", "flow0", "source1", "ring0"))


@pytest.mark.parametrize(
    ("names", "encoding"),
    [
        ("xyz0 xyz1 flow0 tick0 tick1 source0 source1 removed0 removed1", "BYTE_STREAM_SPLIT"),
        ("reflectance0 reflectance1", "RLE_DICTIONARY"),
        ("ring0 ring1 instance0 instance1 surface0 surface1 flow_status0", "PLAIN"),
    ],
)
def test_columns_are_stored_as_measured(shard, names, encoding):
    columns = column_chunks(shard)
    for name in names.split():
        plain = {"PLAIN"} if encoding == "RLE_DICTIONARY" else set()  # the dictionary itself
        squeezed = name.startswith(("flow0", "reflectance"))
        assert columns[name].compression == ("ZSTD" if squeezed else "LZ4"), name
        assert set(columns[name].encodings) - {"RLE"} == {encoding, *plain}, name


def test_small_columns_are_stored_as_they_are(shard):
    columns = column_chunks(shard)
    big = {name for name, chunk in columns.items() if chunk.compression in ("ZSTD", "LZ4")}
    per_point = {
        f"{name}{k}" for name in ("reflectance", "ring", "tick", "source", "instance", "surface") for k in (0, 1)
    }
    assert big == per_point | {"xyz0", "xyz1", "flow0", "flow_status0", "removed0", "removed1"}
    assert all(chunk.compression == "UNCOMPRESSED" for name, chunk in columns.items() if name not in big)


@pytest.mark.parametrize("values", ["many", "one", "none", "extreme"])
def test_stored_columns_come_back_bit_for_bit(tmp_path, values):
    pair = make_pair_of_seven()
    n = {"many": 70_000, "one": 1, "none": 0, "extreme": 4000}[values]
    bits = np.random.default_rng(3)

    def any_bits(name):
        dtype, width = getattr(pair.scan0, name).dtype, 3 if name == "xyz" else 1
        column = bits.integers(0, 256, n * width * dtype.itemsize, np.uint8).view(dtype)
        if values == "extreme" and dtype.kind != "f":
            column = np.where(np.arange(n) % 2, np.iinfo(dtype).max, np.iinfo(dtype).min).astype(dtype)
        return column.reshape(-1, 3) if width == 3 else column

    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface", "removed")
    scans = [replace(pair.scan0, **{name: any_bits(name) for name in names}) for _ in (0, 1)]
    pair = replace(pair, scan0=scans[0], scan1=scans[1], flow0=any_bits("xyz"), flow_status0=any_bits("ring"))
    write_shard(tmp_path / "s.parquet", [pair], metadata())
    assert same(read_pair(tmp_path / "s.parquet", 0), pair)


def test_column_types_are_those_of_the_contract():
    types = {field.name: field.type for field in SCHEMA}
    assert types["xyz0"] == types["flow0"] == types["reflectance1"] == pa.list_(pa.float32())
    assert types["ring0"] == types["surface1"] == types["flow_status0"] == pa.list_(pa.uint8())
    assert types["tick0"] == pa.list_(pa.uint16())
    assert types["source0"] == types["removed1"] == pa.list_(pa.int32())
    assert types["instance0"] == pa.list_(pa.int16())
    assert types["ego_motion"] == types["label_azimuth"] == pa.list_(pa.float64())
    assert types["frame0"] == pa.int32()
    assert types["seed"] == pa.int64()
    assert [field.name for field in SCHEMA if field.nullable] == ["label_azimuth"]
    nullable = {field.name for field in OBJECT if field.nullable}
    assert nullable == {
        *("model", "box0", "box1", "pose0", "pose1", "motion"),
        *("rays0", "rays1", "speed", "yaw_rate", "steering"),
    }


def test_metadata_says_how_it_was_made_and_nothing_of_the_machine(shard):
    content = read_metadata(shard)
    assert content == metadata()
    assert content["contract"] == CONTRACT_VERSION
    assert len(content["scanner_profile"]["elevation_rad"]) == 64
    assert str(Path.home()) not in json.dumps(content)


def test_schema_page_of_the_documentation_is_up_to_date():
    page = (ROOT / "docs" / "shards.md").read_text(encoding="utf-8")
    assert page == schema_page(), "renew it with `python -m augkitti.shards > docs/shards.md`"


def test_failed_shard_leaves_nothing_behind(tmp_path, pairs):
    def broken():
        yield pairs[0]
        raise InputError("scan.bin", "is cut short", "copy it again")

    with pytest.raises(InputError, match="cut short"):
        write_shard(tmp_path / "data" / "s.parquet", broken(), metadata())
    assert list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize("how", ["nothing", "twice", "other sequence", "lengths", "type"])
def test_wrong_pairs_are_refused(tmp_path, pairs, how):
    first = pairs[0]
    wrong = {
        "nothing": [],
        "twice": [first, first],
        "other sequence": [first, replace(pairs[1], sequence="other")],
        "lengths": [replace(first, flow0=first.flow0[1:])],
        "type": [replace(first, flow0=first.flow0.astype(np.float64))],
    }[how]
    with pytest.raises(ValueError, match=r"."):
        write_shard(tmp_path / "s.parquet", wrong, metadata())
    assert list(tmp_path.iterdir()) == []


def test_unknown_contract_version_is_refused(tmp_path, pairs):
    write_shard(tmp_path / "s.parquet", pairs[:1], {**metadata(), "contract": 2})
    with pytest.raises(InputError, match="contract version 2; this program reads 1"):
        read_pair(tmp_path / "s.parquet", 0)


def test_parquet_file_that_is_no_shard_is_refused(tmp_path):
    pq.write_table(pa.table({"a": [1]}), tmp_path / "s.parquet")
    with pytest.raises(InputError, match="not a shard"):
        read_pair(tmp_path / "s.parquet", 0)


def test_shard_with_a_missing_column_names_it(tmp_path, shard):
    table = pq.read_table(shard).drop_columns(["ring1"])
    assert METADATA_KEY in table.schema.metadata
    pq.write_table(table, tmp_path / "s.parquet")
    with pytest.raises(InputError, match="columns differ from the contract: ring1"):
        read_pair(tmp_path / "s.parquet", 0)


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "garbled"])
def test_damaged_shard_is_answered_with_one_line(tmp_path, shard, damage):
    path = tmp_path / "s.parquet"
    content = bytearray(shard.read_bytes())
    if damage == "garbled":
        content[2000:200_000] = bytes(198_000)
    if damage != "missing":
        path.write_bytes({"empty": b"", "cut": bytes(content[: len(content) // 2])}.get(damage, bytes(content)))
    with pytest.raises(InputError) as caught:
        list(read_pairs(path))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_row_of_the_wrong_length_is_an_error_of_one_line(tmp_path, shard):
    table = pq.read_table(shard).slice(0, 1)
    column = SCHEMA.get_field_index("xyz0")
    table = table.set_column(column, SCHEMA.field("xyz0"), pa.array([[1.0, 2.0]], pa.list_(pa.float32())))
    pq.write_table(table, tmp_path / "s.parquet")
    with pytest.raises(InputError, match="xyz0 has 2 values, not a multiple of 3"):
        read_pair(tmp_path / "s.parquet", 0)


def test_row_that_is_not_there_is_an_error(shard):
    with pytest.raises(InputError, match="none numbered 3"):
        read_pair(shard, 3)


# --- the Python face ------------------------------------------------------------------------------------------------


def test_data_set_is_a_sequence_of_pairs(folder):
    dataset = augkitti.open(folder)
    ids = [pair.pair_id for pair in dataset]
    assert len(dataset) == len(ids) == 6
    assert dataset.pair_ids == ids
    assert dataset[4].pair_id == ids[4]
    assert dataset[-1].pair_id == ids[-1]
    assert dataset[ids[3]].pair_id == ids[3]
    assert same(dataset[ids[3]], dataset[3])
    with pytest.raises(IndexError):
        dataset[6]
    with pytest.raises(InputError, match="holds no pair"):
        dataset["2011_09_26_drive_9000_sync/7/0"]


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A set of a sequence as `pipelines.plan` lays it out, spares among its pairs; its names by shard."""
    folder, pair = tmp_path_factory.mktemp("planned"), make_pair_of_seven()
    frames = list(range(3, 200, 2))
    names, entries = {}, []
    for plan in plan_shards([(pair.sequence, len(frames))], 290, 5):
        drawn = list(islice(stream(plan, frames, 5), plan.quota + 2))[2:]  # the first two could not be made
        path = folder / "data" / f"{plan.name}.parquet"
        write_shard(path, [replace(pair, pair_id=d.pair_id, frame0=d.frame0) for d in drawn], metadata())
        entries.append(shard_entry(folder, path, pair.sequence, pair.recording, len(drawn)))
        names[path] = [d.pair_id for d in drawn]
    write_whole_index(folder, entries)
    return folder, names


def test_a_pair_is_found_by_its_name_in_few_shards(planned, monkeypatch):
    folder, names = planned
    opened = []
    monkeypatch.setattr("augkitti.dataset.read_pair_ids", lambda path: opened.append(path) or names[path])
    dataset = augkitti.open(folder)
    assert len(names) == 12
    assert any("/1000000" in name for here in names.values() for name in here)
    for path, here in names.items():
        for row, name in enumerate(here):
            opened.clear()
            assert dataset._place(name) == (path, row)
            assert len(opened) <= 4
    with pytest.raises(InputError, match="holds no pair"):
        dataset[f"{dataset.shards[0].sequence}/4/0"]


def test_a_pair_is_found_by_its_name_in_shards_of_any_order(planned):
    folder, names = planned
    dataset = augkitti.open(folder)
    dataset.shards = dataset.shards[::-1]
    for here in names.values():
        assert dataset[here[-1]].pair_id == here[-1]
    with pytest.raises(InputError, match="holds no pair"):
        dataset[f"{dataset.shards[0].sequence}/odd"]


def test_data_set_can_be_pickled(folder):
    dataset = pickle.loads(pickle.dumps(augkitti.open(folder)))
    assert len(dataset) == 6
    assert dataset[0].pair_id == augkitti.open(folder)[0].pair_id


def test_splits_of_a_data_set_are_disjoint_and_whole(folder):
    parts = {name: augkitti.open(folder, name).pair_ids for name in ("train", "validation", "test")}
    assert sorted(name for names in parts.values() for name in names) == sorted(augkitti.open(folder).pair_ids)
    with pytest.raises(InputError, match="has no split"):
        augkitti.open(folder, "holiday")


def test_shard_path_that_leads_out_of_the_folder_is_refused(tmp_path, folder):
    content = json.loads((folder / "dataset.json").read_text())
    content["shards"][0]["path"] = "../other.parquet"
    (tmp_path / "dataset.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="leads out of the folder"):
        read_index(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"contract": 1}', '{"contract": 2}', '{"contract": true}', '{"contract": 1, "shards": [3]}'],
)
def test_broken_index_is_answered_with_one_line(tmp_path, text):
    (tmp_path / "dataset.json").write_text(text)
    with pytest.raises(InputError) as caught:
        augkitti.open(tmp_path)
    assert "dataset.json" in str(caught.value)


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, augkitti; print([m for m in ('numpy', 'pyarrow', 'pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_public_names_are_there():
    assert all(hasattr(augkitti, name) for name in augkitti.__all__)
    assert callable(augkitti.augment_pair)


@pytest.mark.parametrize("name", ["reflectance0", "ring1", "source0", "surface1", "flow0", "flow_status0"])
def test_columns_of_unequal_length_are_refused(shard, tmp_path, name):
    table = pq.read_table(shard).slice(0, 1)
    at = table.column_names.index(name)
    values = table.column(at)[0].as_py()[:-3]
    path = tmp_path / "cut.parquet"
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array([values], table.schema.field(at).type)), path)
    with pytest.raises(InputError, match=f"{name} has .* rows, the scan"):
        read_pair(path, 0)


def test_a_message_is_one_short_line_that_no_terminal_acts_on():
    message = str(InputError("a\nb.txt", "holds `\x1b[31m\u202e" + "9" * 5000 + "`\n", "fetch it again"))
    assert message.isprintable()
    assert len(message) < 600
    assert message.startswith("a b.txt: holds `\\x1b[31m\\u202e999")
