"""Other people's loaders on a finished data set: they find the splits and give the bytes that `augkitti.open` gives."""

import datetime
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from tiny_shards import TEST, TRAIN, VALIDATION, write_tiny_set
from typer.testing import CliRunner

import augkitti
from augkitti.croissant import croissant
from augkitti.dataset_index import KITTI_LICENCE, STREET_LICENCE, read_index
from augkitti.shards import SCHEMA
from augkitti.splits import read_splits
from pipelines.cli import app

SIZES = {TRAIN: (2, 1), VALIDATION: (1,), TEST: (2,)}
SPLITS = {"train": (TRAIN,), "validation": (VALIDATION,), "test": (TEST,)}
PER_POINT = ("reflectance", "ring", "tick", "source", "instance", "surface", "removed")


@pytest.fixture(scope="module")
def aug(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loaders") / "aug"
    write_tiny_set(folder, SIZES, SPLITS)
    return folder


@pytest.fixture(scope="module")
def hugging_face(tmp_path_factory):
    """The library, with a cache of its own and without a network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HOME", str(tmp_path_factory.mktemp("hf")))
        patch.setenv("HF_HUB_OFFLINE", "1")
        yield pytest.importorskip("datasets", reason="needs datasets, of requirements-dev.txt")


def check_same(row, pair):
    """A row of a Parquet reader, as arrays or lists, holds what the record holds."""
    assert row["pair_id"] == pair.pair_id
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        np.testing.assert_array_equal(np.asarray(row[f"xyz{k}"], np.float32).reshape(-1, 3), scan.xyz)
        for name in PER_POINT:
            values = getattr(scan, name)
            np.testing.assert_array_equal(np.asarray(row[f"{name}{k}"], values.dtype), values)
    np.testing.assert_array_equal(np.asarray(row["flow0"], np.float32).reshape(-1, 3), pair.flow0)
    np.testing.assert_array_equal(np.asarray(row["ego_motion"]).reshape(4, 4), pair.ego_motion)
    assert [item["id"] for item in row["objects"]] == [item.id for item in pair.objects]
    for item, record in zip(row["objects"], pair.objects, strict=True):
        assert item["speed"] == record.speed
        np.testing.assert_array_equal(item["box0"], record.box0)


@pytest.mark.parametrize("streaming", [False, True])
def test_hugging_face_datasets_finds_the_three_splits_and_gives_every_pair(aug, hugging_face, streaming):
    loaded = hugging_face.load_dataset(str(aug), streaming=streaming)
    assert set(loaded) == {"train", "validation", "test"}
    for name, rows in loaded.items():
        ours = augkitti.open(aug, split=name)
        assert len(ours) > 0
        for row, pair in zip(rows, ours, strict=True):
            check_same(row, pair)


def test_pyarrow_polars_and_duckdb_give_every_pair(aug):
    dataset = pytest.importorskip("pyarrow.dataset")
    polars = pytest.importorskip("polars", reason="needs polars, of requirements-dev.txt")
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb, of requirements-dev.txt")
    ours = {pair.pair_id: pair for pair in augkitti.open(aug)}
    relation = duckdb.sql(f"select * from '{aug}/data/*.parquet'")
    readers = {
        "pyarrow": dataset.dataset(aug / "data").to_table().to_pylist(),
        "polars": polars.scan_parquet(aug / "data" / "*.parquet").collect().to_dicts(),
        "duckdb": [dict(zip(relation.columns, row, strict=True)) for row in relation.fetchall()],
    }
    for name, rows in readers.items():
        assert len(rows) == len(ours) == 6, name
        for row in rows:
            check_same(row, ours[row["pair_id"]])


def test_an_opened_set_is_a_dataset_for_torch(aug):
    torch = pytest.importorskip("torch", reason="needs torch")
    loader = torch.utils.data.DataLoader(
        augkitti.open(aug, split="train"), batch_size=None, shuffle=True, num_workers=2, collate_fn=lambda pair: pair
    )
    named = {pair.pair_id: pair for pair in augkitti.open(aug, split="train")}
    seen = {pair.pair_id: pair for pair in loader}
    assert seen.keys() == named.keys()
    for name, pair in seen.items():
        np.testing.assert_array_equal(pair.flow0, named[name].flow0)


def test_the_card_tells_licence_figures_and_loaders_and_its_block_runs(aug, hugging_face, monkeypatch, capsys):
    text = (aug / "README.md").read_text()
    header = yaml.safe_load(text.split("---")[1])
    assert header["license"] == "cc-by-nc-sa-3.0"
    assert KITTI_LICENCE in text
    assert "| pairs | 6 |" in text
    assert str(aug) not in text
    assert "](" not in text, "a card has neither pictures nor links that a copied folder would break"
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    for library in ("polars", "duckdb"):
        pytest.importorskip(library, reason="of requirements-dev.txt")
    monkeypatch.chdir(aug.parent)
    told = {}
    exec(block, told)
    assert capsys.readouterr().out.count("2011_09_26_drive") == 6
    assert {name: len(rows) for name, rows in told["splits"].items()} == {"train": 3, "validation": 1, "test": 2}
    assert len(told["ego_motion"]) == len(told["objects"]) == 6
    assert len(told["speeds"]) >= 6


@pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated:DeprecationWarning")  # rdflib's own parser
@pytest.mark.filterwarnings("ignore:The inplace keyword")  # mlcroissant's use of pandas
def test_croissant_metadata_is_valid_and_reads_back_to_the_same_pairs(aug):
    mlcroissant = pytest.importorskip("mlcroissant", reason="needs mlcroissant, of requirements-dev.txt")
    file = aug.parent / "croissant.json"
    words = ["croissant", str(aug), "--out", str(file), "--published", "2026-11-25", "--url", "https://example.org/aug"]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    metadata = json.loads(file.read_text())
    assert metadata["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert metadata["license"] == "https://creativecommons.org/licenses/by-nc-sa/3.0/"
    assert str(aug.parent) not in file.read_text()
    dataset = mlcroissant.Dataset(file)
    issues = dataset.metadata.ctx.issues
    assert not issues.errors
    assert not issues.warnings
    assert [fields.id for fields in dataset.metadata.record_sets] == ["train", "validation", "test"]
    assert len(dataset.metadata.record_sets[0].fields) == len(SCHEMA)
    (pair,) = augkitti.open(aug, split="validation")
    (record,) = dataset.records("validation")
    plain = {key.partition("/")[2]: value for key, value in record.items()}
    plain["pair_id"] = plain["pair_id"].decode()
    plain["objects"] = [{key.rpartition("/")[2]: value for key, value in item.items()} for item in plain["objects"]]
    for item in plain["objects"]:
        item["id"] = item["id"].decode()
    check_same(plain, pair)


def test_croissant_names_each_shard_with_its_digest_and_the_licence_of_its_source(aug):
    index = read_index(aug)
    told = croissant(index, None, "aug", "s3://bucket/aug", datetime.date(2026, 1, 2))
    files = {part["@id"]: part for part in told["distribution"] if part["@type"] == "cr:FileObject"}
    assert {path: file["sha256"] for path, file in files.items()} == {s.path: s.sha256 for s in index.shards}
    assert files[index.shards[0].path]["contentUrl"] == f"s3://bucket/aug/{index.shards[0].path}"
    assert [fields["@id"] for fields in told["recordSet"]] == ["pairs"]
    assert told["datePublished"] == "2026-01-02"
    splits = read_splits(aug / "splits.json").splits
    assert [r["@id"] for r in croissant(index, splits, "a", "a", datetime.date.today())["recordSet"]] == list(SPLITS)
    street = croissant(replace(index, licence=STREET_LICENCE), splits, "a", "a", datetime.date.today())
    assert street["license"].endswith("/MIT.html")


def test_no_croissant_file_is_put_into_a_finished_folder(aug):
    before = sorted(aug.rglob("*"))
    answer = CliRunner().invoke(app, ["croissant", str(aug), "--out", str(aug / "data" / "croissant.json")])
    assert answer.exit_code == 2
    assert "holds data alone" in answer.output
    assert sorted(aug.rglob("*")) == before
