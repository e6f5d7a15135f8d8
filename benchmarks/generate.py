"""Speed of generation on prepared scans, beside a floor measured in the same run.

Floor: read the two scans of a pair, and write the same row as Parquet with zstd level 1, plain encoding, nothing else.
Ours: everything that a pair costs when its scans are prepared: digests, scans and cache read, cars placed and cast,
noise, labels, the shard written with its fsync. Wall time of one process with one thread.

Usage: python benchmarks/generate.py [KITTI_ROOT] [CAD_FOLDER]
"""

import resource
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from augkitti import kitti, shards
from augkitti.augmentation import augment_pair
from augkitti.cad_models import load_cad_folder
from augkitti.config import Config
from augkitti.scanner import load_profile
from augkitti.seeds import pair_seed
from pipelines.prepare import prepared_pair

PAIRS_OF_A_SEQUENCE, ROUNDS = 6, 3


def main() -> None:
    root = kitti.open_root(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti"))
    cad = Path(sys.argv[2] if len(sys.argv) > 2 else "../shared/cad")
    profile, config = load_profile(), Config()
    models = load_cad_folder(cad, config.categories).models
    spent: dict[str, list[float]] = defaultdict(list)
    sizes: dict[str, list[int]] = defaultdict(list)
    todo = [(s, frame0) for s in root.sequences for frame0, _ in s.pairs[:PAIRS_OF_A_SEQUENCE]]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)

        def clock(name: str, since: float) -> float:
            spent[name].append(1e3 * (time.perf_counter() - since))
            return time.perf_counter()

        for round_ in range(ROUNDS + 1):
            if round_ == 1:  # round 0 fills the cache and starts the libraries
                spent.clear()
            for sequence, frame0 in todo:
                start = time.perf_counter()
                for frame in (frame0, frame0 + 1):
                    np.fromfile(sequence.scan_path(frame), dtype=np.float32).reshape(-1, 4)
                start = clock("floor: read two scans", start)
                pair, prepared, _ = prepared_pair(sequence, frame0, profile, config, scratch / "cache")
                start = clock("ours: read scans and cache", start)
                seed, name = pair_seed(0, sequence.name, frame0, round_), f"{sequence.name}/{frame0}/{round_}"
                made = augment_pair(pair, models, profile, config, seed, name, prepared)
                start = clock("ours: place, cast, measure, label", start)
                if made is None:
                    continue
                shards.write_shard(scratch / "ours.parquet", [made], {})
                start = clock("ours: write", start)
                table = shards.to_table(made)
                start = time.perf_counter()
                plain = {"use_dictionary": False, "write_statistics": False}
                pq.write_table(table, scratch / "floor.parquet", compression="zstd", compression_level=1, **plain)
                clock("floor: write the row", start)
                for which in ("ours", "floor"):
                    sizes[which].append((scratch / f"{which}.parquet").stat().st_size)
    print(f"{len(todo)} pairs, {ROUNDS} rounds; milliseconds a pair, mean (10 to 90 %)")
    for name in sorted(spent):
        low, high = np.quantile(spent[name], [0.1, 0.9])
        print(f"  {name:36s} {np.mean(spent[name]):6.1f} ({low:.1f} to {high:.1f})")
    ours, floor = (sum(float(np.mean(v)) for n, v in spent.items() if n.startswith(k)) for k in ("ours", "floor"))
    print(f"  ours {ours:.0f}, floor {floor:.0f}: {ours / floor:.2f} times the floor")
    print(f"  {1e3 / ours:.1f} pairs a second and core; a pair {np.mean(sizes['ours']) / 1e6:.2f} MB", end=", ")
    print(f"plain {np.mean(sizes['floor']) / 1e6:.2f} MB", end="; ")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
