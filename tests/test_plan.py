"""The plan: which pairs are made, and that it stays so when more are asked for."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.errors import InputError
from pipelines.plan import POOL_PAIRS, SPARE_VARIANT, ShardPlan, first_choice, plan_shards, stream

DRIVES = (("a", 8), ("b", 70), ("c", 1), ("d", 33))
ROUND = sum(count for _, count in DRIVES)


def makeable(pair_id: str, rate: int) -> bool:
    """A stand-in for luck: a fixed share of candidates cannot be made."""
    return sum(map(ord, pair_id)) % 10 >= rate


def pairs_made(n: int, seed: int, rate: int, in_turn: bool = False, drives=DRIVES) -> list[str]:
    made = []
    for shard in plan_shards(drives, n, seed, in_turn):
        frames = range(100, 100 + dict(drives)[shard.sequence])
        good = [c.pair_id for c in stream(shard, frames, seed) if makeable(c.pair_id, rate)]
        made += good[: shard.quota]
    return made


@given(n=st.integers(1, 400), seed=st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_quotas_add_up_to_n_and_no_shard_is_larger_than_a_pool(n, seed):
    shards = plan_shards(DRIVES, n, seed)
    assert sum(shard.quota for shard in shards) == n
    assert all(0 < shard.quota <= POOL_PAIRS for shard in shards)
    assert len({shard.name for shard in shards}) == len(shards)


@given(n=st.integers(1, 300), more=st.integers(0, 200), seed=st.integers(0, 99), rate=st.integers(0, 4))
@settings(max_examples=50, deadline=None)
def test_pairs_of_a_small_set_are_among_those_of_a_larger_one(n, more, seed, rate):
    small, large = pairs_made(n, seed, rate), pairs_made(n + more, seed, rate)
    assert set(small) <= set(large)
    assert len(set(large)) == len(large)


def test_more_streets_leave_the_pairs_of_fewer_as_they_are():
    few = pairs_made(13, 0, 2, in_turn=True, drives=tuple((f"street{i}", 5) for i in range(3)))
    many = pairs_made(28, 0, 2, in_turn=True, drives=tuple((f"street{i}", 5) for i in range(6)))
    assert set(few) <= set(many)


@given(n=st.integers(1, 2 * ROUND), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_every_source_pair_is_used_once_before_any_is_used_twice(n, seed):
    uses: dict[tuple[str, str], int] = {}
    for pair_id in pairs_made(n, seed, rate=0):
        sequence, frame0, _ = pair_id.split("/")
        uses[sequence, frame0] = uses.get((sequence, frame0), 0) + 1
    assert max(uses.values()) == -(-n // ROUND)
    if n >= ROUND:
        assert len(uses) == ROUND


def test_spares_carry_variants_that_no_round_reaches():
    shard = ShardPlan("b", 0, 3, round=2, quota=4)
    variants = [c.variant for c in stream(shard, range(70), seed=1)]
    pool = 70 // 3
    assert set(variants[:pool]) == {2}
    assert min(variants[pool:]) >= SPARE_VARIANT


def test_a_small_set_draws_from_every_long_drive():
    sequences = {shard.sequence for shard in plan_shards((("x", 500), ("y", 300), ("z", 200)), 10, seed=3)}
    assert sequences == {"x", "y", "z"}


def test_a_small_set_sees_many_places_of_a_long_drive():
    shards = plan_shards((("long", 640),), 40, seed=0)
    assert len(shards) >= 5
    assert max(shard.pool for shard in shards) - min(shard.pool for shard in shards) > 10


def test_the_pools_of_a_drive_hold_each_pair_once_and_do_not_overlap():
    pools = [sorted({c.frame0 for c in stream(ShardPlan("x", p, 3, 0, 1), range(70), 5)}) for p in range(3)]
    assert sorted(frame for pool in pools for frame in pool) == list(range(70))
    assert pools[0][-1] < pools[1][0] <= pools[1][-1] < pools[2][0]


def test_another_seed_gives_other_pairs():
    assert pairs_made(20, 0, 0) != pairs_made(20, 1, 0)


def test_a_source_without_pairs_is_refused():
    with pytest.raises(InputError, match="no two neighbouring scans"):
        plan_shards((("single", 0),), 5, 0)


def test_what_is_prepared_is_what_the_stream_gives_first():
    frames = tuple(range(5, 78))
    for quota in (1, 7, 24, 25):
        for pool in (0, 2):
            shard = ShardPlan("drive", pool, 3, 4, min(quota, 24))
            first = {next_.frame0 for next_, _ in zip(stream(shard, frames, 9), range(shard.quota), strict=False)}
            assert first_choice(shard, frames, 9) == tuple(sorted(first))
