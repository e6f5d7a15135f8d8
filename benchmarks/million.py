"""Plan, index and split a million pairs, scans faked by an index of names: seconds and memory of each step.

    python benchmarks/million.py [--n 1000000] [--drives 151] [--frames 290] [--seconds-per-pair 0.075]

Two sources: one as large as KITTI's raw data (151 drives), whose pairs are used again and again at new variants, and
one of as many pairs as are asked for, in 5,000 drives. No scan is read and no shard is written; the rest is the
program's own: the plan, a row a shard, `dataset.json`, `splits.json`, the card, and reading all of them
back. At the end, the estimate of `docs/scale.md` from the measured rate.
"""

import argparse
import heapq
import math
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from augkitti.config import Config
from augkitti.dataset import open_dataset
from augkitti.dataset_index import KITTI_LICENCE, ShardEntry, make_index, read_index, write_card, write_index
from augkitti.kitti import Sequence
from augkitti.splits import check_splits, pairs_by_split, read_splits, split_dataset
from pipelines.generate import BYTES_PER_PAIR
from pipelines.plan import plan_shards, stream
from pipelines.run import Options, Run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=1_000_000)
    parser.add_argument("--drives", type=int, default=151)
    parser.add_argument("--frames", type=int, default=290)
    parser.add_argument("--seconds-per-pair", type=float, default=0.075)
    asked = parser.parse_args()
    wide = 5_000
    for drives, frames in ((asked.drives, asked.frames), (wide, asked.n // wide + 1)):
        print(f"## {asked.n:,} pairs of {drives:,} drives with {frames:,} scans each")
        _measure(asked.n, drives, frames)
    estimate(asked.seconds_per_pair, asked.drives, asked.frames)


def _measure(n: int, drives: int, frames: int) -> None:
    start = time.monotonic()
    with _timed("index of names"):
        sequences = {name: _sequence(name, frames) for name in (f"drive_{k:05d}_sync" for k in range(drives))}
    with _timed("plan"):
        shards = plan_shards([(name, len(one.pairs)) for name, one in sequences.items()], n, seed=0)
    options = Options(kitti=Path("kitti"), cad=None, out=Path("aug"), n=n, seed=0, config=Config())
    with _timed("which scans to prepare"):
        planned = Run(options, sequences, shards, (), {}).planned_frames()
    with _timed("every pair's name and seed"):
        firsts = {name: tuple(first for first, _ in one.pairs) for name, one in sequences.items()}
        count = sum(len([*islice(stream(s, firsts[s.sequence], 0), s.quota)]) for s in shards)
    assert count == n, count
    with tempfile.TemporaryDirectory() as folder:
        with _timed("index and card"):
            entries = [
                ShardEntry(
                    f"data/{s.name}.parquet", s.sequence, s.sequence[:11], s.quota, s.quota * 3_200_000, "0" * 64
                )
                for s in shards
            ]
            index = make_index(Config(), 0, entries, {"points": 0}, [], KITTI_LICENCE, {"kind": "kitti"})
            write_card(Path(folder), index)
            write_index(Path(folder), index)
        size = (Path(folder) / "dataset.json").stat().st_size
        with _timed("split"):
            split_dataset(folder, seed=0)
        with _timed("read back, check, open each split"):
            index, splits = read_index(folder), read_splits(Path(folder) / "splits.json")
            assert not check_splits(index, splits)
            assert sum(len(open_dataset(folder, split)) for split in splits.splits) == n
    shares = {name: f"{100 * pairs / n:.2f} %" for name, (pairs, _) in pairs_by_split(index, splits).items()}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    sizes = Counter(math.ceil(shard.quota / 8) * 8 for shard in shards)
    print(
        f"{len(shards):,} shards, {sum(map(len, planned.values())):,} scan pairs used; dataset.json {size / 1e6:.1f} MB"
    )
    print(f"pairs a shard, up to: {dict(sorted(sizes.items()))}; {shares}")
    print(f"**{time.monotonic() - start:.1f} s, peak {peak:.2f} GB**\n")


def _sequence(name: str, frames: int) -> Sequence:
    return Sequence(name, name.removesuffix("_sync"), "raw", "raw", Path(name), tuple(range(frames)), Path())


@contextmanager
def _timed(what: str) -> Iterator[None]:
    start = time.monotonic()
    yield
    print(f"- {what}: {time.monotonic() - start:.2f} s", flush=True)


def estimate(seconds_per_pair: float, drives: int, frames: int) -> None:
    """Time for 20,000 and a million pairs: the plan's shards in their order, each to the worker that is free first."""
    print(f"at {seconds_per_pair} s a pair and core, source of {drives} drives with {frames} scans:\n")
    print("| pairs | shards | disk | 1 worker | 16 workers | 256 workers |\n|---|---|---|---|---|---|")
    for n in (20_000, 1_000_000):
        shards = plan_shards([(f"drive_{k:05d}_sync", frames - 1) for k in range(drives)], n, seed=0)
        spans = []
        for workers in (1, 16, 256):
            free_at = [0.0] * workers
            for shard in shards:
                heapq.heapreplace(free_at, free_at[0] + shard.quota * seconds_per_pair)
            spans.append(_span(max(free_at)))
        print(f"| {n:,} | {len(shards):,} | {n * BYTES_PER_PAIR / 1e12:.2f} TB | {' | '.join(spans)} |")


def _span(seconds: float) -> str:
    for size, unit in ((86_400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


if __name__ == "__main__":
    main()
