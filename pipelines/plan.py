"""Which pairs are made: the source's pairs, a number and a seed in, shards with their candidate pairs out.

Drawn once, before any scan is read, from names and numbers alone. How it works, and why:

1. A *round* uses every source pair once; round r gives its pairs the variant number r. `--n` is filled round by round,
   so every source pair is used once before any is used twice.
2. Within a round, drives take turns in proportion to their length (systematic sampling: the k-th of a drive's F slots
   comes at (k + u) / F, u drawn per drive and round). A small `--n` has pairs of every drive, and the first n slots of
   a round are the same whatever `--n` is.
3. A drive's pairs are cut into *pools* of at most 32 neighbours. A pool in a round is a *shard*: one task and one
   file. The drive's pools, in drawn order, fill to a quarter one after another, so that a small `--n` sees many places,
   then to seven eighths, so that spares are left in each, and to the brim when the round is nearly full.
4. A shard has an endless-enough *stream* of candidates that depends on seed, drive and pool alone, not on `--n`: its
   pool in drawn order at variant r, then, as spares, the pool again and again at variant numbers from 1,000,000 on,
   which no round reaches. The shard's pairs are the first `quota` candidates of the stream that can be made, in the
   order in which they are made.

Hence a pair's content does not depend on `--n` (its seed comes from drive, frame and variant), and the pairs of
`--n 100` are among those of `--n 200`: quotas only grow with n, and the first 20 that can be made of a stream are among
the first 30. A skipped pair is filled from its own shard only, so shards need not know of each other; a shard whose
stream ends before its quota falls short, which the run prints.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.seeds import generator, pair_seed

POOL_PAIRS = 32  # a shard of 32 pairs is about 96 MB: large enough to read fast, small enough to lose
SPARE_PASSES = 4  # how often a pool is gone through again for spares
SPARE_VARIANT = 1_000_000  # variants from here on are spares


@dataclass(frozen=True)
class Candidate:
    """A pair that may be made."""

    pair_id: str
    frame0: int
    variant: int
    seed: int


@dataclass(frozen=True)
class ShardPlan:
    """One task: make `quota` pairs from a pool of a sequence."""

    sequence: str
    pool: int  # which pool of the sequence
    pools: int  # how many it has
    round: int
    quota: int

    @property
    def number(self) -> int:
        """The shard's number within its sequence, whatever `--n` is."""
        return self.round * self.pools + self.pool

    @property
    def name(self) -> str:
        """The shard's file name without its ending."""
        return f"{self.sequence}-{self.number:05d}"

    def as_json(self) -> dict[str, Any]:
        """Its fields, for the work folder."""
        return asdict(self)


def plan_shards(pairs_of: Sequence[tuple[str, int]], n: int, seed: int, in_turn: bool = False) -> tuple[ShardPlan, ...]:
    """The shards that together hold n pairs.

    Args:
        pairs_of: name and number of source pairs of each sequence.
        n: pairs wanted.
        seed: of the data set.
        in_turn: fill the sequences one after another instead of in proportion (embedded streets, of which a larger n
            has more: so the streets of a smaller n stay filled as they were).

    Raises:
        InputError: no source pairs, or more rounds than there are variant numbers.
    """
    sequences = [(name, count) for name, count in pairs_of if count > 0]
    round_size = sum(count for _, count in sequences)
    if round_size == 0:
        raise InputError("--kitti", "holds no two neighbouring scans", "give drives with consecutive scans")
    rounds = -(-n // round_size)
    if rounds > SPARE_VARIANT:
        raise InputError("--n", f"{n} pairs need {rounds} rounds of the source", "ask for fewer pairs")
    shards = []
    for round_ in range(rounds):
        taken = min(n - round_ * round_size, round_size)
        for (name, count), slots in zip(sequences, _slots(sequences, taken, seed, round_, in_turn), strict=True):
            pools = -(-count // POOL_PAIRS)
            for pool, quota in enumerate(_quotas(name, count, pools, slots, seed)):
                if quota:
                    shards.append(ShardPlan(name, pool, pools, round_, quota))
    return tuple(sorted(shards, key=lambda shard: (shard.sequence, shard.number)))


def stream(shard: ShardPlan, frames: Sequence[int], seed: int) -> Iterator[Candidate]:
    """The shard's candidates in order: its pool once, then its spares.

    Args:
        shard: the task.
        frames: first frames of all the sequence's source pairs, ascending.
        seed: of the data set.
    """
    low, high = _bounds(len(frames), shard.pool, shard.pools)
    pool = list(frames[low:high])
    for again in range(SPARE_PASSES + 1):
        variant = shard.round if again == 0 else SPARE_VARIANT + shard.round * SPARE_PASSES + again - 1
        for index in _order(shard, variant, len(pool), seed):
            frame0 = pool[int(index)]
            pair_id = f"{shard.sequence}/{frame0}/{variant}"
            yield Candidate(pair_id, frame0, variant, pair_seed(seed, shard.sequence, frame0, variant))


def first_choice(shard: ShardPlan, frames: Sequence[int], seed: int) -> tuple[int, ...]:
    """First frames of the pairs that the shard makes if none is skipped, ascending: what to prepare."""
    low, high = _bounds(len(frames), shard.pool, shard.pools)
    if shard.quota >= high - low:  # the whole pool, in whatever order
        return tuple(frames[low:high])
    order = _order(shard, shard.round, high - low, seed)
    return tuple(sorted(frames[low + int(index)] for index in order[: shard.quota]))


def _order(shard: ShardPlan, variant: int, count: int, seed: int) -> npt.NDArray[np.int64]:
    """The drawn order of a pool of `count` pairs at a variant."""
    return generator(seed, "order", shard.sequence, shard.pool, variant).permutation(count)


def _slots(sequences: Sequence[tuple[str, int]], taken: int, seed: int, round_: int, in_turn: bool) -> list[int]:
    """How many of a round's first `taken` slots fall to each sequence."""
    counts = np.array([count for _, count in sequences])
    if taken == counts.sum():
        return [int(count) for count in counts]
    owner = np.repeat(np.arange(len(counts)), counts)
    if not in_turn:
        place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        start = np.array([generator(seed, "turn", name, round_).random() for name, _ in sequences])
        owner = owner[np.argsort((place + start[owner]) / counts[owner], kind="stable")]
    return [int(count) for count in np.bincount(owner[:taken], minlength=len(counts))]


def _quotas(name: str, count: int, pools: int, slots: int, seed: int) -> list[int]:
    """How many of a sequence's slots fall to each of its pools."""
    order = [int(pool) for pool in generator(seed, "pools", name).permutation(pools)]
    bounds = [_bounds(count, pool, pools) for pool in range(pools)]
    sizes = [high - low for low, high in bounds]
    quotas = [0] * pools
    for limits in ([-(-size // 4) for size in sizes], [size - size // 8 for size in sizes], sizes):
        for pool in order:
            more = min(max(limits[pool] - quotas[pool], 0), slots)
            quotas[pool] += more
            slots -= more
    return quotas


def _bounds(count: int, pool: int, pools: int) -> tuple[int, int]:
    """From where to where a pool's pairs stand among the sequence's."""
    return pool * count // pools, (pool + 1) * count // pools
