"""Speed of generation on prepared scans, beside a floor measured in the same run.

Floor: read the two scans of a pair, and write the same row as Parquet with zstd level 1, plain encoding, nothing else.
Ours: everything that a pair costs when its scans are prepared: scans, digests and cache read, cars placed and cast,
noise, labels, the row written. Both write shards of as many pairs, ours with its fsync. One process, one thread; the
order of the two changes from round to round.

Usage: python benchmarks/generate.py [KITTI_ROOT] [CAD_FOLDER]
"""

import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from augkitti import add_cars, augmentation, kitti, shards
from augkitti.augmentation import augment_pair, prepare_scan
from augkitti.cad_models import load_cad_folder
from augkitti.config import Config
from augkitti.scan_pair import AugmentedPair, CarModel
from augkitti.scanner import ScannerProfile, load_profile
from augkitti.seeds import pair_seed
from pipelines.prepare import prepared_pair

PAIRS_OF_A_SEQUENCE, ROUNDS = 32, 3
CONFIG = Config()
PLAIN = {"use_dictionary": False, "write_statistics": False, "compression": "zstd", "compression_level": 1}
STAGES = (
    "make_scene",
    "propose_car",
    "cast_and_measure",
    "keeps_its_shape",
    "hides_what_is_behind",
    "occlude_both",
    "finish_pair",
)


class Clock:
    """Seconds spent by name; a stage within another counts for both."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted under a name."""

        @wraps(function)
        def counted(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                self.seconds[name] += time.perf_counter() - start

        return counted


def ours(
    sequence: kitti.Sequence,
    round_: int,
    models: tuple[CarModel, ...],
    profile: ScannerProfile,
    folder: Path,
    clock: Clock,
) -> tuple[list[AugmentedPair], int]:
    """Write one shard as the program does; its pairs and its size."""
    made: list[AugmentedPair] = []

    def pairs() -> Iterator[AugmentedPair]:
        for frame0, _ in sequence.pairs[:PAIRS_OF_A_SEQUENCE]:
            seed, name = pair_seed(0, sequence.name, frame0, round_), f"{sequence.name}/{frame0}/{round_}"
            pair, prepared, _ = clock.timed("read scans and cache", prepared_pair)(
                sequence, frame0, profile, CONFIG, folder / "cache"
            )
            augment = clock.timed("place, cast, measure, label", augment_pair)
            one = augment(pair, models, profile, CONFIG, seed, name, prepared)
            if one is not None:
                made.append(one)
                yield one

    path = folder / "ours.parquet"
    clock.timed("ours", shards.write_shard)(path, pairs(), {})
    return made, path.stat().st_size


def floor(sequence: kitti.Sequence, made: list[AugmentedPair], folder: Path, clock: Clock) -> int:
    """Read the scans of the pairs and write their rows plainly; the file's size."""
    tables = [shards.to_table(pair) for pair in made]
    path = folder / "floor.parquet"

    def write() -> None:
        with pq.ParquetWriter(path, tables[0].schema, **PLAIN) as writer:
            for pair, table in zip(made, tables, strict=True):
                for frame in (pair.frame0, pair.frame1):
                    np.fromfile(sequence.scan_path(frame), dtype=np.float32).reshape(-1, 4)
                writer.write_table(table)

    clock.timed("floor", write)()
    return path.stat().st_size


def not_prepared(root: kitti.KittiRoot, profile: ScannerProfile) -> None:
    """What `prepare` costs a scan and a pair."""
    spent: dict[str, list[float]] = defaultdict(list)
    for sequence in root.sequences:
        for frame0, _ in sequence.pairs[:PAIRS_OF_A_SEQUENCE]:
            scans = [kitti.read_scan(sequence, frame0 + k) for k in (0, 1)]
            for scan in scans:
                start = time.perf_counter()
                prepare_scan(scan, profile, CONFIG)
                spent["rays, ground, region, a scan"].append(time.perf_counter() - start)
            start = time.perf_counter()
            kitti.read_ego_motion(sequence, frame0, *scans)
            spent["ego-motion, a pair"].append(time.perf_counter() - start)
    print("not prepared, milliseconds (median, 10 to 90 %)")
    for name, values in spent.items():
        low, middle, high = 1e3 * np.quantile(values, [0.1, 0.5, 0.9])
        print(f"  {name:36s} {middle:6.0f} ({low:.0f} to {high:.0f})")


def main() -> None:
    root = kitti.open_root(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti"))
    cad = Path(sys.argv[2] if len(sys.argv) > 2 else "../shared/cad")
    profile = load_profile()
    models = load_cad_folder(cad, CONFIG.categories).models
    stages = Clock()
    for name in STAGES:
        setattr(augmentation, name, stages.timed(name, getattr(augmentation, name)))
    rays = [0]

    def counting(*args: Any) -> Any:
        rays[0] += len(args[1])
        return cast_mesh(*args)

    cast_mesh = stages.timed("cast_mesh", add_cars.cast_mesh)
    add_cars.cast_mesh = counting
    per_pair: dict[str, list[float]] = defaultdict(list)
    sizes: dict[str, list[int]] = defaultdict(list)
    pairs = 0
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        for round_ in range(ROUNDS + 1):
            if round_ == 1:  # round 0 fills the cache and starts the libraries
                per_pair.clear()
                stages.seconds.clear()
                rays[0] = pairs = 0
            for sequence in root.sequences:
                if not sequence.pairs:
                    continue
                clock = Clock()
                before = (
                    floor(sequence, made, scratch, clock) if round_ % 2 and (made := _last.get(sequence.name)) else 0
                )
                made, size = ours(sequence, round_, models, profile, scratch, clock)
                if not before:
                    before = floor(sequence, made, scratch, clock)
                _last[sequence.name] = made
                pairs += len(made)
                for name, seconds in clock.seconds.items():
                    per_pair[name] += [1e3 * seconds / len(made)] * len(made)
                sizes["ours"] += [size // len(made)] * len(made)
                sizes["floor"] += [before // len(made)] * len(made)
    _print(per_pair, stages, sizes, pairs, rays[0])
    not_prepared(root, profile)


_last: dict[str, list[AugmentedPair]] = {}


def _print(per_pair: dict[str, list[float]], stages: Clock, sizes: dict[str, list[int]], pairs: int, rays: int) -> None:
    print(f"{pairs} pairs, {ROUNDS} rounds; milliseconds a pair, mean (10 to 90 % over shards)")
    for name in ("floor", "ours", "read scans and cache", "place, cast, measure, label"):
        low, high = np.quantile(per_pair[name], [0.1, 0.9])
        print(f"  {name:36s} {np.mean(per_pair[name]):6.1f} ({low:.1f} to {high:.1f})")
    parts = ("read scans and cache", "place, cast, measure, label")
    written = np.array(per_pair["ours"]) - sum(np.array(per_pair[name]) for name in parts)
    low, high = np.quantile(written, [0.1, 0.9])
    print(f"  {'write':36s} {written.mean():6.1f} ({low:.1f} to {high:.1f})")
    for name in (*STAGES, "cast_mesh"):
        print(f"    {name:34s} {1e3 * stages.seconds[name] / pairs:6.1f}")
    ratio = np.array(per_pair["ours"]) / np.array(per_pair["floor"])
    low, high = np.quantile(ratio, [0.1, 0.9])
    whole = np.mean(per_pair["ours"]) / np.mean(per_pair["floor"])
    print(
        f"  ours {whole:.2f} times the floor; by shard {np.median(ratio):.2f} in the median ({low:.2f} to {high:.2f})"
    )
    print(f"  {1e3 / np.mean(per_pair['ours']):.1f} pairs a second and core")
    print(f"  {rays / pairs:,.0f} rays cast a pair, {rays / stages.seconds['cast_mesh'] / 1e6:.2f} million a second")
    print(f"  a pair {np.mean(sizes['ours']) / 1e6:.2f} MB, plain {np.mean(sizes['floor']) / 1e6:.2f} MB")
    print(f"  peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
