"""PointFlowNet's time and memory on a real pair, and how many pairs a second the reader gives, as Markdown tables.

Weights are untrained: they change neither. Each variant runs in a process of its own, whose peak memory is its own.
Reading is of a data set's shards (pairs of full size made in code where none is given), decoded and voxelised, with and
without targets and augmentation, on one core.

Usage: python benchmarks/network.py [KITTI_ROOT] [DATA_SET] [--threads 2] [--repeats 5] [--only small]
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

VARIANTS = (("paper", "fp32"), ("paper", "bf16"), ("small", "fp32"), ("small", "bf16"))
SCANS = "raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", nargs="?", type=Path, default=Path("../shared/kitti"))
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", help="of the settings: paper or small")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        print(json.dumps(time_one(*options.one, options.kitti, options.threads, options.repeats)))
        return
    print(f"{options.threads} threads, a real pair, the best and the median of {options.repeats} runs\n")
    print("| settings | precision | network s | network s, median | whole prediction s | peak GB | of them before GB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, precision in VARIANTS:
        if options.only in (None, name):
            row = run_one(name, precision, options)
            print(
                f"| `{name}` | {precision} | {row['best']:.3f} | {row['median']:.3f} | {row['whole']:.3f} "
                f"| {row['peak']:.2f} | {row['before']:.2f} |",
                flush=True,
            )
    print("\n| reading on one core | settings | ms a pair | pairs/s |")
    print("| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        data = options.data or made_in_code(Path(folder))
        for name in ("paper", "small"):
            if options.only in (None, name):
                for what, seconds in time_reading(data, name):
                    print(f"| {what} | `{name}` | {1e3 * seconds:.0f} | {1.0 / seconds:.1f} |", flush=True)


def run_one(name: str, precision: str, options: argparse.Namespace) -> dict[str, float]:
    """`time_one` in a process of its own."""
    given = ["--threads", str(options.threads), "--repeats", str(options.repeats), "--one", name, precision]
    command = [sys.executable, __file__, str(options.kitti), *given]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def time_one(name: str, precision: str, kitti: Path, threads: int, repeats: int) -> dict[str, float]:
    """Seconds and gigabytes of one variant in this process."""
    import numpy as np
    import torch

    from training.config import load_settings
    from training.network import PointFlowNet
    from training.point_files import read_points
    from training.predict import Predictor, sample_of_scans
    from training.team import team_of
    from training.voxelize import make_batch

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    settings = load_settings(name)
    first, second = (read_points(path) for path in sorted((kitti / SCANS).glob("*.bin"))[:2])
    sample = sample_of_scans("pair", first, second)
    before = peak_gb()
    times, whole = [], []
    with team_of("cpu", precision) as team:
        network = PointFlowNet(settings).eval()
        predictor = Predictor(network, settings, team)
        batch = make_batch([sample], settings, with_targets=False)
        for _ in range(repeats + 1):
            start = time.perf_counter()
            with torch.inference_mode(), team.precision():
                network(batch.voxels0, batch.voxels1, 1)
            times.append(time.perf_counter() - start)
        for _ in range(repeats + 1):
            start = time.perf_counter()
            predictor.of_samples([sample])
            whole.append(time.perf_counter() - start)
    return {
        "best": min(times[1:]),
        "median": float(np.median(times[1:])),
        "whole": min(whole[1:]),
        "peak": peak_gb(),
        "before": before,
    }


def peak_gb() -> float:
    """The most memory that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # Linux counts in kB


def time_reading(data: Path, name: str, most: int = 24) -> list[tuple[str, float]]:
    """Processor seconds a pair: decoded and voxelised; with targets; augmented, too, as in training."""
    from training.config import load_settings
    from training.shard_dataset import ShardPairs
    from training.voxelize import make_batch

    settings = load_settings(name)
    rows = []
    for what, training, with_targets in (
        ("decode, voxelise", False, False),
        ("decode, voxelise, targets", False, True),
        ("decode, augment, voxelise, targets", True, True),
    ):
        pairs = ShardPairs([(data, 1.0)], None, settings, training=training)
        count, start = 0, 0.0
        for number, sample in enumerate(pairs):
            make_batch([sample], settings, training=training, with_targets=with_targets)
            if number == 0:  # imports and caches
                start = time.process_time()
                continue
            count = number
            if number == most:
                break
        rows.append((what, (time.process_time() - start) / max(count, 1)))
    return rows


def made_in_code(folder: Path) -> Path:
    """A data set of 8 pairs of 120,000 points."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from tests.tiny_shards import write_tiny_set

    write_tiny_set(folder, {"0001": (8,)}, tick_step=2)
    return folder


if __name__ == "__main__":
    main()
