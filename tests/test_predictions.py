"""Predictions to a file and back, and files that are none."""

import contextlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_pair import an_object, make_pair, right

from augkitti.errors import InputError
from training.predictions import KEY, Prediction, Predictions, read_predictions, write_predictions


def made(name="a/0/0", n=11, found=2, **changes):
    rng = np.random.default_rng(len(name))
    values = {
        "flows": {"direct": rng.normal(size=(n, 3)).astype("f4"), "dense": rng.normal(size=(n, 3)).astype("f4")},
        "where": rng.random(n) < 0.6,
        "ego_motion": rng.normal(size=(4, 4)),
        "boxes": rng.normal(size=(found, 7)),
        "scores": rng.random(found),
        "motions": rng.normal(size=(found, 4, 4)),
        "columns": np.array([[1, 2], [3, 4]], np.int32),
        "column_motions": rng.normal(size=(2, 3)).astype("f4"),
    }
    return Prediction(name, **{**values, **changes})


def same(one, other):
    assert one.pair_id == other.pair_id
    assert list(one.flows) == list(other.flows)
    np.testing.assert_array_equal(one.where, other.where)
    for name, flow in one.flows.items():
        np.testing.assert_array_equal(flow[one.where], other.flows[name][one.where])
        assert other.flows[name].dtype == np.float32
    for name in ("ego_motion", "boxes", "scores", "motions", "columns", "column_motions"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_array_equal(a, b)
            assert a.shape == b.shape


def test_a_file_gives_back_what_was_written(tmp_path):
    wrote = [
        made("a/0/0"),
        made("a/11/0", n=0, found=0),
        made("a/2/0", ego_motion=None, boxes=None, scores=None, motions=None, columns=None, column_motions=None),
        made("a/3/0", motions=None),
    ]
    path = tmp_path / "sub" / "p.parquet"
    assert write_predictions(path, iter(wrote), {"run": "runs/a"}) == 4
    for one, other in zip(wrote, read_predictions(path), strict=True):
        same(one, other)
    with Predictions(path) as file:
        assert (len(file), file.methods, file.about) == (4, ("direct", "dense"), {"run": "runs/a"})
        same(wrote[2], file.of("a/2/0", 11))


def test_the_same_predictions_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_predictions(tmp_path / name, [made("a/0/0"), made("a/1/0")])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize(
    "changes",
    [
        {"flows": {"direct": np.zeros((10, 3), np.float32)}},
        {"scores": None},
        {"boxes": None, "scores": None},
        {"scores": np.zeros(3)},
        {"columns": None},
        {"ego_motion": np.full((4, 4), np.nan)},
        {"boxes": np.full((2, 7), np.inf)},
    ],
)
def test_parts_that_do_not_fit_are_refused(changes):
    with pytest.raises(ValueError, match=r"flow|boxes|scores|columns|ego_motion"):
        made(**changes)


@pytest.mark.parametrize(
    "second",
    [
        made("a/0/0"),
        made("a/1/0", flows={"direct": np.zeros((11, 3), np.float32)}),
        made("a/1/0", flows=dict.fromkeys(("direct", "dense"), np.full((11, 3), np.nan, np.float32))),
    ],
)
def test_a_pair_twice_other_flows_and_nan_leave_no_file(tmp_path, second):
    with pytest.raises(ValueError, match=r"pair a/1/0 is not finite|a/0/0 is there already|other flows"):
        write_predictions(tmp_path / "p", [made("a/0/0"), second])
    assert list(tmp_path.iterdir()) == []


def test_nothing_to_write_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no predictions"):
        write_predictions(tmp_path / "p", [])


def test_a_pair_that_is_not_there_and_one_of_another_data_set_are_told(tmp_path):
    pair = make_pair([an_object(10, 0)])
    write_predictions(tmp_path / "p", [right(pair)])
    with Predictions(tmp_path / "p") as file:
        with pytest.raises(InputError, match="holds no pair `b/0/0`"):
            file.of("b/0/0")
        with pytest.raises(InputError, match="has 40 points for pair `a/0/0`, the data set 41"):
            file.of("a/0/0", 41)


def test_files_that_are_none_are_told_in_one_line(tmp_path):
    good = tmp_path / "good"
    write_predictions(good, [made()])
    whole = good.read_bytes()
    (tmp_path / "text").write_text("hello")
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "cut").write_bytes(whole[: len(whole) // 2])
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other")
    pq.write_table(pa.table({"a": [1]}).replace_schema_metadata({KEY: b'{"version": 9}'}), tmp_path / "keys")
    pq.write_table(
        pa.table({"a": [1]}).replace_schema_metadata({KEY: b'{"version": 1, "methods": [], "about": {}}'}),
        tmp_path / "columns",
    )
    newer = pq.read_table(good)
    newer = newer.replace_schema_metadata({KEY: b'{"version": 2, "methods": ["direct", "dense"], "about": {}}'})
    pq.write_table(newer, tmp_path / "newer")
    for name in ("text", "empty", "cut", "other", "keys", "columns", "missing", "newer"):
        with pytest.raises(InputError, match=r"no predictions file|does not exist|version 2") as caught:
            Predictions(tmp_path / name)
        assert "\n" not in str(caught.value)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=3))
def test_damaged_bytes_give_predictions_or_one_line(tmp_path_factory, changes):
    folder = tmp_path_factory.mktemp("damaged")
    write_predictions(folder / "p", [made("a/0/0", n=60), made("b/0/0", n=50)])
    content = bytearray((folder / "p").read_bytes())
    for at, value in changes:
        content[at % len(content)] = value
    (folder / "p").write_bytes(content)
    with contextlib.suppress(InputError):
        assert len(list(read_predictions(folder / "p"))) == 2


def test_a_damaged_row_is_told(tmp_path):
    path = tmp_path / "p"
    write_predictions(path, [made("a/0/0", n=3000)])
    whole = bytearray(path.read_bytes())
    whole[2000:9000] = bytes(7000)
    path.write_bytes(whole)
    with pytest.raises(InputError, match="row 0 is damaged"):
        list(read_predictions(path))
