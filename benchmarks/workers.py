"""What a second worker gains beside a second copy of the floor, and the memory of each process of a run.

Usage: python benchmarks/workers.py [KITTI_ROOT CAD_FOLDER] [--pairs 48] [--rounds 5]
       python benchmarks/workers.py [KITTI_ROOT CAD_FOLDER] --memory 100 2000 [--jobs 2 1] [--folder /tmp]

Gain: the augment stage of the same prepared pairs in one process and in two at once (each writes a set of its own), in
alternation with the floor of `benchmarks/generate.py` (read two scans, write the row plainly) and with the program's
own pool (`--jobs 1` and `--jobs 2` on one set). Starts and first uses lie outside of what is timed.

Memory: `augkitti generate`, from the embedded streets unless folders are given; the runs of one `N` share their cache,
so that only the first draws the streets and prepares them. Resident memory is read ten times a second from /proc; the
peak is the kernel's.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.augment import augment_all, augment_shard
from pipelines.prepare import prepare_all
from pipelines.run import Run, open_run, read_options, start_work

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
FLOOR_PASSES = 4  # over the pairs: the floor is that much faster
POLL_S = 0.1
SMALL_MB = 80.0  # a process that stays below is joblib's housekeeping


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", nargs="?", type=Path)
    parser.add_argument("cad", nargs="?", type=Path)
    parser.add_argument("--pairs", type=int, default=48)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", type=int, nargs="+", metavar="N", help="watch runs of N pairs")
    parser.add_argument("--jobs", type=int, nargs="+", default=[2, 1], help="of the runs with --memory, in this order")
    parser.add_argument("--folder", type=Path, help="where the runs' output and cache go for the time being")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=asked.folder, prefix="augkitti-workers-") as scratch:
        if asked.memory:
            source = (asked.kitti, asked.cad) if asked.cad else None
            show_memory(asked.memory, asked.jobs, source, Path(scratch))
        else:
            kitti, cad = asked.kitti or Path("../shared/kitti"), asked.cad or Path("../shared/cad")
            show_gains(kitti, cad, asked.pairs, asked.rounds, Path(scratch))


# --- gain of a second worker -----------------------------------------------------------------------------------------


def show_gains(kitti: Path, cad: Path, pairs: int, rounds: int, scratch: Path) -> None:
    """Pairs a second of one and of two, each way, in alternation; gains by round and their medians."""
    os.environ["AUGKITTI_CACHE"] = str(scratch / "cache")
    os.environ.update(dict.fromkeys(THREADS, "1"))  # for the copies, as the program's own workers have it
    run = _run_into(kitti, cad, pairs, scratch / "plan")
    options = run.options
    prepare_all(run.sequences, run.planned_frames(), options.scanner, options.config, options.cache, 2, True)
    rates: dict[str, list[tuple[float, float]]] = defaultdict(list)
    used: dict[str, list[tuple[float, float]]] = defaultdict(list)  # milliseconds of a core for a pair
    with _Copies(kitti, cad, pairs, scratch) as copies:
        for jobs in (1, 2):
            _pool(run, jobs, scratch)  # starts joblib's workers, which stay
        for _ in range(rounds):
            for name, count in (("floor", pairs * FLOOR_PASSES), ("ours", pairs)):
                (one, core_of_one), (two, core_of_two) = copies.run(name, 1), copies.run(name, 2)
                rates[name].append((count / one, 2 * count / two))
                used[name].append((1e3 * core_of_one / count, 1e3 * core_of_two / (2 * count)))
            rates["pool"].append((pairs / _pool(run, 1, scratch), pairs / _pool(run, 2, scratch)))
    print(f"{pairs} pairs of {len(run.shards)} shards, {rounds} rounds; pairs a second, median (least to most)\n")
    print("| | one process | two | gain | gain, of the floor's | ms of a core a pair, one | two |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    titles = {"floor": "floor, copies", "ours": "augment, copies", "pool": "augment, one set with `--jobs`"}
    floor = [two / one for one, two in rates["floor"]]
    for name, title in titles.items():
        gain = [two / one for one, two in rates[name]]
        share = [mine / its for mine, its in zip(gain, floor, strict=True)]
        columns = [*zip(*rates[name], strict=True), gain, share, *zip(*used[name], strict=True)]
        print(f"| {title} | {' | '.join(map(_spread, columns))} |")


def _spread(values: Sequence[float]) -> str:
    return f"{median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def _run_into(kitti: Path, cad: Path, pairs: int, out: Path) -> Run:
    options = read_options(
        kitti=kitti, cad=cad, out=out, n=pairs, seed=0, config=None, profile=None, stop_on_error=True
    )
    return open_run(options)


def _begin(run: Run, out: Path) -> Run:
    """The same run with nothing done yet, in a folder of its own."""
    shutil.rmtree(out, ignore_errors=True)
    anew = replace(run, options=replace(run.options, out=out))
    start_work(anew, resume=False)
    return anew


def _pool(run: Run, jobs: int, scratch: Path) -> float:
    """Seconds of the program's own augment stage."""
    anew = _begin(run, scratch / "pool")
    start = time.perf_counter()
    augment_all(anew, jobs)
    return time.perf_counter() - start


class _Copies:
    """Two processes that do the same work when told, each into a folder of its own."""

    def __init__(self, *arguments: Any) -> None:
        spawn = get_context("spawn")
        self.pipes, self.processes = [], []
        for index in (0, 1):
            ours, theirs = spawn.Pipe()
            self.processes.append(spawn.Process(target=_serve, args=(theirs, index, *arguments)))
            self.pipes.append(ours)
        for process in self.processes:
            process.start()

    def __enter__(self) -> "_Copies":
        for pipe in self.pipes:
            pipe.recv()
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in self.pipes:
            with suppress(BrokenPipeError):
                pipe.send(None)
        for process in self.processes:
            process.join()

    def run(self, work: str, count: int) -> tuple[float, float]:
        """Seconds from the first start to the last end of `count` copies at work (one clock), and of cores in all."""
        for command in (f"begin {work}", work):
            for pipe in self.pipes[:count]:
                pipe.send(command)
            spans = [pipe.recv() for pipe in self.pipes[:count]]
        starts, ends, cores = zip(*spans, strict=True)
        return max(ends) - min(starts), sum(cores)


def _serve(pipe: Connection, index: int, kitti: Path, cad: Path, pairs: int, scratch: Path) -> None:
    """A copy: warm up, then do what the pipe says and answer when it started and ended, and what it took of a core."""
    run = _run_into(kitti, cad, pairs, scratch / f"copy{index}")
    works = {
        "begin ours": lambda: _begin(run, run.options.out),
        "ours": lambda: [augment_shard((shard, run.sequences[shard.sequence]), run.options) for shard in run.shards],
    }
    for work in works.values():
        work()
    rows = _plain_rows(run)
    works |= {"begin floor": lambda: None, "floor": lambda: _floor(rows, scratch / f"floor{index}.parquet")}
    works["floor"]()
    pipe.send("ready")
    while (command := pipe.recv()) is not None:
        start, core = time.perf_counter(), time.process_time()
        works[command]()
        pipe.send((start, time.perf_counter(), time.process_time() - core))


def _plain_rows(run: Run) -> list[tuple[tuple[Path, Path], pa.Table]]:
    """The finished pairs of a run, each a table of one row, with the two scans it came from."""
    found = []
    for path in sorted((run.options.out / "data").glob("*.parquet")):
        table = pq.read_table(path)
        for row in range(len(table)):
            one = table.slice(row, 1)
            sequence = run.sequences[one["sequence"][0].as_py()]
            frames = (one["frame0"][0].as_py(), one["frame1"][0].as_py())
            found.append(((sequence.scan_path(frames[0]), sequence.scan_path(frames[1])), one))
    return found


def _floor(rows: list[tuple[tuple[Path, Path], pa.Table]], path: Path) -> None:
    plain = {"use_dictionary": False, "write_statistics": False, "compression": "zstd", "compression_level": 1}
    for _ in range(FLOOR_PASSES):
        for scans, table in rows:
            for scan in scans:
                np.fromfile(scan, dtype=np.float32).reshape(-1, 4)
            pq.write_table(table, path, **plain)


# --- memory of a run -------------------------------------------------------------------------------------------------


@dataclass
class Watched:
    """What /proc said of a process while it lived."""

    role: str
    peak_mb: float = 0.0
    seen: list[tuple[float, float]] = field(default_factory=list)  # seconds from the run's start, resident megabytes

    @property
    def quarters(self) -> list[float]:
        """Largest of what was seen in each quarter of its life: a leak would climb."""
        first, last = self.seen[0][0], self.seen[-1][0] + 1e-9
        most = [0.0] * 4
        for at, resident in self.seen:
            quarter = int(4 * (at - first) / (last - first))
            most[quarter] = max(most[quarter], resident)
        return most


def show_memory(pairs: list[int], jobs: list[int], source: tuple[Path, Path] | None, scratch: Path) -> None:
    """A row for each process of each run."""
    print("MB of resident memory; by quarters of the process's life, its stages one after another\n")
    print("| pairs | `--jobs` | seconds | pairs/s, all stages | cache | process | peak | quarters |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for n in pairs:
        for turn, count in enumerate(jobs):
            seconds, processes = _watch(n, count, source, scratch)
            shared = f"| {n:,} | {count} | {seconds:.0f} | {n / seconds:.2f} | {'filled' if turn else 'empty'} |"
            for item in sorted(processes, key=lambda item: (item.role, -item.peak_mb)):
                if item.peak_mb >= SMALL_MB:
                    quarters = " ".join(f"{value:.0f}" for value in item.quarters)
                    print(f"{shared} {item.role} | {item.peak_mb:.0f} | {quarters} |", flush=True)
        shutil.rmtree(scratch / "cache", ignore_errors=True)


def _watch(n: int, jobs: int, source: tuple[Path, Path] | None, scratch: Path) -> tuple[float, list[Watched]]:
    """Run `augkitti generate` for n pairs; its seconds, and every process of it."""
    environment = {**os.environ, "AUGKITTI_CACHE": str(scratch / "cache")}
    environment.pop("AUGKITTI_KITTI", None)
    line = [sys.executable, "-m", "pipelines", "generate", "--out", str(scratch / "out")]
    line += [] if source is None else ["--kitti", str(source[0]), "--cad", str(source[1])]
    start = time.monotonic()
    with (scratch / "log").open("w") as log:
        run = subprocess.Popen(
            [*line, "--n", str(n), "--jobs", str(jobs)], env=environment, stdout=log, stderr=subprocess.STDOUT
        )
        processes: dict[int, Watched] = {}
        while run.poll() is None:
            _look(run.pid, "main", time.monotonic() - start, processes)
            time.sleep(POLL_S)
    seconds = time.monotonic() - start
    if run.returncode:
        sys.exit(f"exit code {run.returncode}: {(scratch / 'log').read_text()}")
    shutil.rmtree(scratch / "out")
    return seconds, list(processes.values())


def _look(pid: int, role: str, at_s: float, processes: dict[int, Watched]) -> None:
    """Note what /proc says of a process and of all below it; one that has just gone is passed over."""
    with suppress(OSError, ValueError, KeyError):
        status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        watched = processes.setdefault(pid, Watched(role))
        watched.peak_mb = max(watched.peak_mb, _megabytes(status["VmHWM"]))
        watched.seen.append((at_s, _megabytes(status["VmRSS"])))
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                _look(int(child), "worker", at_s, processes)


def _megabytes(text: str) -> float:
    return int(text.split()[0]) * 1024 / 1e6


if __name__ == "__main__":
    main()
