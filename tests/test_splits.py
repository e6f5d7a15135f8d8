import json
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pair_factory import make_pair, metadata, write_whole_index

from augkitti.dataset_index import ShardEntry, read_index, shard_entry
from augkitti.errors import InputError
from augkitti.shards import write_shard
from augkitti.splits import (
    GAP_FRAMES,
    check_splits,
    pairs_by_split,
    read_splits,
    split_dataset,
    split_recordings,
)

RATIOS = (70.0, 10.0, 20.0)


def shards_of(sizes, names=None):
    """A shard of at most 32 pairs after another, by recording."""
    entries = []
    for i, size in enumerate(sizes):
        recording = names[i] if names else f"drive_{i:04d}"
        for number, first in enumerate(range(0, size, 32)):
            rows = min(32, size - first)
            path = f"data/{recording}_sync-{number:05d}.parquet"
            entries.append(ShardEntry(path, f"{recording}_sync", recording, rows, 1, "0" * 64))
    return entries


def held(shards, splits):
    rows = {shard.path: shard.rows for shard in shards}
    return np.array([sum(rows[path] for path in splits[name]) for name in ("train", "validation", "test")])


def off(shards, splits, ratios=RATIOS):
    total = sum(shard.rows for shard in shards)
    return np.abs(held(shards, splits) - np.array(ratios) / sum(ratios) * total).sum()


def write_folder(folder, sizes, first_frames=None):
    """A finished folder with recordings of few-point pairs; `first_frames` of each shard of each recording."""
    base = make_pair(tick_step=400).pair
    entries = []
    for i, size in enumerate(sizes):
        sequence = f"2011_09_26_drive_{i:04d}_sync"
        for number, frames in enumerate((first_frames or [[range(size)]] * len(sizes))[i]):
            pairs = [
                replace(
                    base,
                    pair_id=f"{sequence}/{frame}/0",
                    sequence=sequence,
                    recording=sequence.removesuffix("_sync"),
                    frame0=frame,
                    frame1=frame + 1,
                )
                for frame in frames
            ]
            path = folder / "data" / f"{sequence}-{number:05d}.parquet"
            write_shard(path, pairs, metadata())
            entries.append(shard_entry(folder, path, sequence, pairs[0].recording, len(pairs)))
    write_whole_index(folder, entries)
    return folder


def test_recording_is_never_divided():
    names = ["a", "b", "a", "c", "d", "b"]  # two names of one drive share a recording
    shards = [*shards_of([40, 70, 33, 90, 20, 64], names)]
    shards = [ShardEntry(f"data/{i}.parquet", s.sequence, s.recording, s.rows, 1, "") for i, s in enumerate(shards)]
    splits = split_recordings(shards)
    of_path = {path: name for name, paths in splits.items() for path in paths}
    for recording in "abcd":
        assert len({of_path[s.path] for s in shards if s.recording == recording}) == 1
    assert sorted(of_path) == sorted(s.path for s in shards)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 300), min_size=3, max_size=6), st.integers(0, 5))
def test_few_recordings_are_split_as_well_as_can_be(sizes, seed):
    shards = shards_of(sizes)
    target = np.array(RATIOS) / 100 * sum(sizes)
    best = min(
        np.abs(np.bincount(choice, weights=sizes, minlength=3) - target).sum()
        for choice in product(range(3), repeat=len(sizes))
        if len(set(choice)) == 3
    )
    assert off(shards, split_recordings(shards, RATIOS, seed)) == pytest.approx(best, abs=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_many_recordings_come_within_a_pair_of_the_ratios(seed):
    sizes = np.random.default_rng(3).integers(20, 900, 61).tolist()
    shards = shards_of(sizes)
    assert off(shards, split_recordings(shards, RATIOS, seed)) < 4.0


def test_thousands_of_recordings_are_split_to_the_ratios():
    sizes = [1 + (7 * k) % 40 for k in range(3_000)]
    shards = shards_of(sizes)
    assert off(shards, split_recordings(shards)) < 3.0


def test_many_recordings_of_one_huge_and_some_tiny_leave_no_split_empty():
    shards = shards_of([5000, *[1] * 11])
    assert (held(shards, split_recordings(shards)) > 0).all()


def test_same_seed_gives_the_same_split_and_others_differ():
    shards = shards_of(np.random.default_rng(5).integers(20, 900, 30).tolist())
    first = split_recordings(shards, RATIOS, 0)
    assert first == split_recordings(shards, RATIOS, 0)
    assert any(split_recordings(shards, RATIOS, seed) != first for seed in (1, 2, 3))


def test_split_without_a_share_stays_empty():
    shards = shards_of([60, 40])
    splits = split_recordings(shards, (60, 40, 0))
    assert held(shards, splits).tolist() == [60, 40, 0]


@pytest.mark.parametrize("ratios", [(70, 30), (0, 50, 50), (70, -10, 40), (70, float("nan"), 20), (float("inf"), 1, 1)])
def test_ratios_that_are_none_are_refused(ratios):
    with pytest.raises(InputError, match="--ratios"):
        split_recordings(shards_of([10, 10, 10]), ratios)


def test_fewer_recordings_than_splits_is_an_error_that_names_the_way_out(tmp_path):
    write_folder(tmp_path, [2, 3])
    with pytest.raises(InputError, match=r"2 recording\(s\) for 3 splits.*--allow-frames-split"):
        split_dataset(tmp_path)
    assert not (tmp_path / "splits.json").exists()


def test_split_is_written_read_back_and_stands_in_the_card(tmp_path):
    write_folder(tmp_path, [3, 1, 1])
    splits = split_dataset(tmp_path, seed=4)
    content = json.loads((tmp_path / "splits.json").read_text())
    assert set(content) == {"contract", "seed", "ratios", "divides_recordings", "splits"}
    assert content["divides_recordings"] is False
    assert read_splits(tmp_path / "splits.json") == splits
    assert check_splits(read_index(tmp_path), splits) == []
    assert pairs_by_split(read_index(tmp_path), splits)["train"] == (3, 1)
    header = yaml.safe_load((tmp_path / "README.md").read_text().split("---")[1])
    files = {entry["split"]: entry["path"] for entry in header["configs"][0]["data_files"]}
    assert files == content["splits"]
    assert header["license"] == "cc-by-nc-sa-3.0"


def test_like_follows_the_recordings_of_another_data_set(tmp_path):
    write_folder(tmp_path / "ak", [3, 1, 2, 1])
    write_folder(tmp_path / "k", [1, 2, 1, 4])
    ak = split_dataset(tmp_path / "ak", seed=1)
    k = split_dataset(tmp_path / "k", like=tmp_path / "ak" / "splits.json")
    assert k.splits == ak.splits  # the shards have the same names in both
    assert (k.seed, k.ratios) == (ak.seed, ak.ratios)


def test_like_names_recordings_that_it_does_not_know(tmp_path):
    write_folder(tmp_path / "ak", [1, 1, 1])
    write_folder(tmp_path / "k", [1, 1, 1, 1])
    split_dataset(tmp_path / "ak")
    with pytest.raises(InputError, match="has no split for 2011_09_26_drive_0003"):
        split_dataset(tmp_path / "k", like=tmp_path / "ak" / "splits.json")


def test_recordings_named_to_test_on_are_the_test_split_and_the_others_are_divided(tmp_path):
    write_folder(tmp_path, [3, 9, 4, 2])
    splits = split_dataset(tmp_path, test_on=["2011_09_26_drive_0001"]).splits
    recording_of = {shard.path: shard.recording for shard in read_index(tmp_path).shards}
    sets = {name: {recording_of[path] for path in paths} for name, paths in splits.items()}
    assert sets["test"] == {"2011_09_26_drive_0001"}
    assert sets["train"] | sets["validation"] == {f"2011_09_26_drive_{i:04d}" for i in (0, 2, 3)}
    assert sets["train"]
    assert sets["validation"] == {"2011_09_26_drive_0003"}


def test_recording_to_test_on_that_is_not_there_is_named(tmp_path):
    write_folder(tmp_path, [3, 9, 4])
    with pytest.raises(InputError, match="no pair of drive_77; name some of 2011_09_26_drive_0000"):
        split_dataset(tmp_path, test_on=["drive_77"])


def test_one_recording_is_divided_by_frames_with_a_gap_where_that_is_allowed(tmp_path):
    frames = [range(first, first + 8) for first in (0, 30, 60, 62, 90, 120)]
    write_folder(tmp_path, [48], [frames])
    splits = split_dataset(tmp_path, allow_frames_split=True)
    assert splits.divides_recordings
    first_of = {f"data/2011_09_26_drive_0000_sync-{n:05d}.parquet": frames[n] for n in range(6)}
    spans = [sorted(f for path in paths for f in first_of[path]) for paths in splits.splits.values()]
    assert all(spans)
    spans.sort()
    for before, after in pairwise(spans):
        assert after[0] - (before[-1] + 1) > GAP_FRAMES
    assert "divide a recording" in (tmp_path / "README.md").read_text()
    assert check_splits(read_index(tmp_path), splits) == []


def test_shard_between_is_left_out_where_frames_touch(tmp_path):
    write_folder(tmp_path, [40], [[range(first, first + 8) for first in (0, 8, 16, 24, 32, 40, 48)]])
    splits = split_dataset(tmp_path, allow_frames_split=True).splits
    numbers = sorted(sorted(int(path[-13:-8]) for path in paths) for paths in splits.values())
    assert [len(paths) > 0 for paths in numbers] == [True] * 3
    assert all(after[0] - before[-1] == 3 for before, after in pairwise(numbers))  # 16 frames between


def test_two_recordings_are_only_divided_as_far_as_needed(tmp_path):
    write_folder(tmp_path, [24, 8], [[range(first, first + 8) for first in (0, 30, 60)], [range(8)]])
    splits = split_dataset(tmp_path, allow_frames_split=True)
    assert splits.divides_recordings
    assert all(splits.splits.values())


def test_enough_recordings_are_not_divided_even_if_allowed(tmp_path):
    write_folder(tmp_path, [2, 1, 1])
    assert not split_dataset(tmp_path, allow_frames_split=True).divides_recordings


def test_shards_that_reach_over_the_same_frames_cannot_be_divided(tmp_path):
    write_folder(tmp_path, [6], [[range(0, 6, 3), range(1, 6, 3), range(2, 6, 3)]])
    with pytest.raises(InputError, match="frames apart"):
        split_dataset(tmp_path, allow_frames_split=True)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "3",
        '{"contract": 9}',
        '{"contract": 1}',
        '{"contract": 1, "seed": 0, "ratios": [1], "divides_recordings": false, "splits": {"train": "data/a.parquet"}}',
        '{"contract": 1, "seed": 0, "ratios": [1], "divides_recordings": 0, "splits": {}}',
    ],
)
def test_broken_splits_file_is_answered_with_one_line(tmp_path, text):
    (tmp_path / "splits.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_splits(tmp_path / "splits.json")
    assert "splits.json" in str(caught.value)
