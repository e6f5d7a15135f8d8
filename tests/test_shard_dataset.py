"""The reader: every pair once whoever reads, shuffled, resumed in the middle; bad data sets told in one line."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from tiny_network import tiny_settings  # noqa: E402
from tiny_shards import write_tiny_set  # noqa: E402
from torch.utils.data import DataLoader  # noqa: E402

from augkitti.errors import InputError  # noqa: E402
from training.config import Settings  # noqa: E402
from training.sample import sample_of  # noqa: E402
from training.shard_dataset import ShardPairs, load_batches, places_of  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")  # more workers than processors
SETTINGS = tiny_settings()  # batches of 2
SPLITS = {"train": ("0001", "0002"), "validation": ("0003",), "test": ()}


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> tuple[Path, list[str]]:
    """A set of 13 training pairs in 4 shards, and 2 validation pairs."""
    folder = tmp_path_factory.mktemp("k")
    return folder, write_tiny_set(folder, {"0001": (4, 3), "0002": (1, 5), "0003": (2,)}, SPLITS)


@pytest.fixture(scope="module")
def second(tmp_path_factory) -> tuple[Path, list[str]]:
    """Another of the same recordings: 6 training pairs."""
    folder = tmp_path_factory.mktemp("ak")
    return folder, write_tiny_set(folder, {"0001": (4,), "0002": (2,), "0003": (1,)}, SPLITS, variant=1)


def reader(*folders, training: bool = True, split: str | None = "train", **more) -> ShardPairs:
    weighted = [folder if isinstance(folder, tuple) else (folder, 1.0) for folder in folders]
    return ShardPairs(weighted, split, SETTINGS, training=training, **more)


def names(samples) -> list[str]:
    return [sample.pair_id for sample in samples]


def batch_names(pairs: ShardPairs, workers: int = 0, settings: Settings = SETTINGS) -> list[list[str]]:
    return [names(batch.samples) for batch in load_batches(pairs, settings, workers)]


@given(st.integers(0, 60), st.integers(0, 20), st.integers(1, 4), st.integers(1, 5), st.integers(0, 3))
@settings(deadline=None)
def test_ranks_and_workers_share_all_places_without_repeating_one(pairs, batches, ranks, batch, workers):
    done = min(batches * batch * ranks, pairs)
    taken = [
        places_of(pairs, done, rank, ranks, batch, worker, max(workers, 1))
        for rank in range(ranks)
        for worker in range(max(workers, 1))
    ]
    assert sorted(np.concatenate(taken).tolist()) == list(range(done, pairs))


def test_without_training_pairs_come_once_in_the_order_of_the_index(first):
    folder, all_names = first
    assert names(reader(folder, training=False, split=None)) == all_names
    assert names(reader(folder, training=False)) == all_names[:13]
    assert names(reader(folder, training=False, split="validation")) == all_names[13:]


def test_an_epoch_holds_every_pair_once_shuffled_within_and_across_shards(first):
    folder, all_names = first
    got = names(reader(folder))
    assert sorted(got) == sorted(all_names[:13])
    shard_of = {name: name.split("/")[0] + str(int(name.split("/")[1]) >= 4) for name in got}
    runs = sum(shard_of[a] != shard_of[b] for a, b in pairwise(got))
    assert runs > 4  # across: shard after shard would be 3
    within = [name for name in got if shard_of[name].endswith("0001_syncFalse")]
    assert within != sorted(within)


def test_epochs_and_seeds_differ_and_come_again(first):
    folder, _ = first
    pairs = reader(folder)
    zeroth = names(pairs)
    pairs.set_epoch(1)
    assert sorted(names(pairs)) == sorted(zeroth)
    assert names(pairs) != zeroth
    pairs.set_epoch(0)
    assert names(pairs) == zeroth
    assert names(reader(folder, seed=1)) != zeroth


def test_a_sample_is_augmented_by_its_place_whoever_reads_it(first):
    folder, _ = first
    one, again = list(reader(folder)), list(reader(folder))
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a.xyz0, b.xyz0)
        assert a.draw == b.draw
    other = reader(folder, rank=1, ranks=2)
    for a, b in zip(one[1::2], other, strict=True):
        np.testing.assert_array_equal(a.xyz0, b.xyz0)
    assert len({sample.draw for sample in one}) == len(one)


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_batches_are_the_same_for_any_number_of_workers(first, workers):
    expected = names(reader(first[0]))
    got = batch_names(reader(first[0]), workers)
    assert [name for batch in got for name in batch] == expected
    assert [len(batch) for batch in got] == [2] * 6 + [1]


def test_two_ranks_with_two_workers_each_see_every_pair_once(first):
    ranks = [batch_names(reader(first[0], rank=rank, ranks=2), workers=2) for rank in range(2)]
    both = [name for batches in ranks for batch in batches for name in batch]
    assert sorted(both) == sorted(first[1][:13])
    assert len(ranks[0]) == 4
    assert reader(first[0], rank=1, ranks=2).batches_left() == 3  # the 13th pair is rank 0's alone


def test_two_ranks_see_together_what_one_process_sees_in_doubled_batches(first):
    doubled = tiny_settings(batch=4)
    alone = [sorted(batch) for batch in batch_names(ShardPairs([(first[0], 1.0)], "train", doubled, True), 0, doubled)]
    ranks = [batch_names(reader(first[0], rank=rank, ranks=2)) for rank in range(2)]
    assert [sorted(a + b) for a, b in zip(*ranks, strict=False)] == alone[:3]


@pytest.mark.parametrize(("ranks", "workers"), [(1, 0), (1, 2), (2, 0)])
def test_after_a_break_in_the_middle_of_an_epoch_the_rest_is_the_same(first, ranks, workers):
    for rank in range(ranks):
        whole = reader(first[0], rank=rank, ranks=ranks)
        whole.set_epoch(3)
        rest = batch_names(whole, workers)[2:]
        whole.batch_done(2)
        state = json.loads(json.dumps(whole.state_dict()))  # plain values
        resumed = reader(first[0], rank=rank, ranks=ranks)
        resumed.load_state_dict(state)
        assert resumed.epoch == 3
        assert batch_names(resumed, workers) == rest
        assert resumed.batches_left() == whole.batches_left()


def test_a_state_of_other_data_or_of_another_seed_is_refused(first, second):
    state = reader(first[0]).state_dict()
    with pytest.raises(InputError, match="not the data that the run was begun with"):
        reader(second[0]).load_state_dict(state)
    with pytest.raises(InputError, match="not the seed"):
        reader(first[0], seed=9).load_state_dict(state)
    assert reader(first[0]).digest != reader((first[0], 2.0)).digest


def test_sets_are_mixed_by_their_weights(first, second):
    pairs = reader(first[0], (second[0], 0.5))
    assert pairs.pairs_in_epoch() == 13 + 3
    halves = []
    for epoch in (0, 1):
        pairs.set_epoch(epoch)
        got = names(pairs)
        assert sorted(name for name in got if name.endswith("/0")) == sorted(first[1][:13])
        halves += [name for name in got if name.endswith("/1")]
    assert sorted(halves) == sorted(second[1][:6])  # the other half in the next epoch
    twice = names(reader(first[0], (second[0], 2.0)))
    assert sorted(name for name in twice if name.endswith("/1")) == sorted(second[1][:6] * 2)


def test_workers_that_persist_hear_of_a_new_epoch(first):
    pairs = reader(first[0])
    loader = DataLoader(pairs, batch_size=None, num_workers=1, persistent_workers=True)
    zeroth = names(loader)
    pairs.set_epoch(1)
    pairs_of_epoch_1 = names(loader)
    fresh = reader(first[0])
    fresh.set_epoch(1)
    assert pairs_of_epoch_1 == names(fresh) != zeroth


def told(call) -> str:
    with pytest.raises(InputError) as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)


def test_bad_data_sets_are_told_in_one_line(first, tmp_path):
    assert "names no data set" in told(lambda: reader())
    assert str(tmp_path / "none") in told(lambda: reader(tmp_path / "none"))
    assert "holds no pair in test" in told(lambda: reader(first[0], split="test"))
    assert "has no split `trial`" in told(lambda: reader(first[0], split="trial"))
    assert "has the weight -1" in told(lambda: reader((first[0], -1.0)))
    assert "has the weight nan" in told(lambda: reader((first[0], float("nan"))))
    write_tiny_set(tmp_path / "whole", {"0001": (1,)})
    assert "splits.json" in told(lambda: reader(tmp_path / "whole"))
    assert names(reader(tmp_path / "whole", split=None))


def test_two_sets_whose_splits_disagree_are_refused(first, tmp_path):
    swapped = {"train": ("0003",), "validation": ("0001",), "test": ("0002",)}
    write_tiny_set(tmp_path, {"0001": (1,), "0002": (1,), "0003": (1,)}, swapped)
    line = told(lambda: reader(first[0], tmp_path))
    assert "2011_09_26_drive_000" in line
    assert "--like" in line


def test_a_set_of_another_contract_is_told_in_one_line(tmp_path):
    write_tiny_set(tmp_path, {"0001": (1,)}, {"train": ("0001",), "validation": (), "test": ()})
    index = json.loads((tmp_path / "dataset.json").read_text())
    index["contract"] = 2
    (tmp_path / "dataset.json").write_text(json.dumps(index))
    assert "has contract version 2" in told(lambda: reader(tmp_path))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_truncated_shard_is_told_in_one_line_also_out_of_a_worker(tmp_path, workers):
    write_tiny_set(tmp_path, {"0001": (2,)}, {"train": ("0001",), "validation": (), "test": ()})
    (shard,) = (tmp_path / "data").glob("*.parquet")
    shard.write_bytes(shard.read_bytes()[:-500])
    assert shard.name in told(lambda: batch_names(reader(tmp_path), workers))


@pytest.mark.parametrize("workers", [0, 1])
def test_a_scan_outside_the_grid_is_told_in_one_line_also_out_of_a_worker(first, workers):
    far = SETTINGS.model_copy(update={"grid": SETTINGS.grid.model_copy(update={"z_m": (20.0, 24.0)})})
    line = told(lambda: list(load_batches(ShardPairs([(first[0], 1.0)], "train", far), far, workers)))
    assert "lies in the grid" in line


def test_points_of_an_object_without_a_box_in_scan_0_keep_their_flow_and_lose_their_number(tmp_path):
    from pair_factory import make_pair, with_object

    pair = make_pair(tick_step=64).pair
    without = with_object(pair, 0, box0=None)
    sample = sample_of(without)
    assert len(sample.boxes0) == len(pair.objects) - 1
    np.testing.assert_array_equal(sample.instance0[pair.scan0.instance == 0], -1)
    assert set(sample.instance0[pair.scan0.instance == 2]) == {1}
    np.testing.assert_array_equal(sample.flow0, pair.flow0)
    assert sample.has_motion.tolist() == [False, True]  # the walker is labelled in scan 0 only
    odd = replace(pair, scan0=replace(pair.scan0, instance=pair.scan0.instance + np.int16(1)))
    assert "names none of its 3 objects" in told(lambda: sample_of(odd))
