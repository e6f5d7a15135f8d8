"""Table 1 of the paper: plain pairs (K) and augmented ones (AK) in; what augmentation does to errors on both out.

    python benchmarks/table1.py K AK [--config small] [--steps 500] [--seeds 3] [--at-once 2] [--out build/table1]

A network trained on K and one on K and AK for as many steps, with each seed; each scored on the validation split of K
and on that of K and AK. Prints mean and range over seeds. Runs that are there go on. The experiment of the
paper is the same with sets made from all of KITTI and `--config paper` (docs/training.md).
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np

COLUMNS = {
    "fg_epe": "FG m",
    "bg_epe": "BG m",
    "all_epe": "all m",
    "obj_rot": "obj. rot. rad",
    "obj_tr_lidar": "obj. tr. m",
    "ego_rot": "ego rot. rad",
    "ego_tr": "ego tr. m",
}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("k", type=Path)
    parser.add_argument("ak", type=Path)
    parser.add_argument("--config", default="small")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--at-once", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--out", type=Path, default=Path("build/table1"))
    asked = parser.parse_args()
    sets = {"K": [asked.k], "K+AK": [asked.k, asked.ak]}
    asked.out.mkdir(parents=True, exist_ok=True)

    def run(job: tuple[int, str]) -> list[dict[str, object]]:
        seed, trained_on = job
        folder = asked.out / f"{trained_on}-{seed}"
        data = [word for path in sets[trained_on] for word in ("--data", str(path))]
        words = ["--config", asked.config, "--steps", str(asked.steps), "--seed", str(seed), "--validation", "none"]
        if (folder / "checkpoint.pt").exists():
            words.append("--resume")  # what is finished ends at once
        _pointflownet(folder.with_suffix(".log"), "train", *data, "--out", str(folder), *words)
        rows = []
        for scored_on, paths in sets.items():
            file = folder / f"{scored_on}.json"
            data = [word for path in paths for word in ("--data", str(path))]
            if not file.exists():
                words = ["--split", asked.split, "--json", str(file)]
                _pointflownet(folder.with_suffix(".log"), "evaluate", str(folder), *data, *words)
            found = {row["method"]: row for row in json.loads(file.read_text())["rows"]}
            rows += [
                {"on": scored_on, "trained": trained_on, **found["direct"]},
                {"on": scored_on, "trained": "zero motion", **found["zero"]},
                {"on": scored_on, "trained": "true ego-motion", **found["ego_true"]},
            ]
        return rows

    # seeds outside: if this is interrupted, whole comparisons are done
    with ThreadPoolExecutor(asked.at_once) as pool:
        rows = [row for part in pool.map(run, product(range(asked.seeds), sets)) for row in part]
    print(f"| scored on | trained on | {' | '.join(COLUMNS.values())} |\n|{' --- |' * (2 + len(COLUMNS))}")
    for on, trained in product(sets, [*sets, "zero motion", "true ego-motion"]):
        mine = [row for row in rows if row["on"] == on and row["trained"] == trained]
        print(f"| {on} | {trained} | {' | '.join(_mean_and_range([row[name] for row in mine]) for name in COLUMNS)} |")


def _pointflownet(log: Path, *words: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "training", *words, "--threads", "1"]
    with log.open("a", encoding="utf-8") as out:
        subprocess.run(line, check=True, env=environment, stdout=out, stderr=subprocess.STDOUT)


def _mean_and_range(values: Sequence[object]) -> str:
    numbers = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(numbers):
        return ""
    digits = 4 if numbers.max() < 0.1 else 3
    spread = "" if np.ptp(numbers) == 0.0 else f" ({numbers.min():.{digits}f} to {numbers.max():.{digits}f})"
    return f"{numbers.mean():.{digits}f}{spread}"


if __name__ == "__main__":
    main()
