"""The same bytes however a run goes: real scans in, a line with a digest for each way of making one set out.

`python benchmarks/trust.py [../shared/kitti] [../shared/cad] [seed]`: a plain run; `--jobs 2`; three runs killed with
their whole process group (`kill -9`) at drawn moments after a drawn number of finished shards, and continued with
`--resume`, with one and with two processes; runs without numpy's processor-specific paths, with another BLAS kernel,
and with a C library that sees an old processor (each with a cache of its own). Exit code 1 if any digest differs, or if
a run was over before it could be killed.
"""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy._core._multiarray_umath as built

N = 16
LATER_S = 0.1  # the longest wait between the last shard that is waited for and the kill


def main(kitti: str = "../shared/kitti", cad: str = "../shared/cad", seed: str = "0") -> int:
    folder = Path(tempfile.mkdtemp(prefix="augkitti-trust-"))
    found = []
    rng = np.random.default_rng(int(seed))

    def start(name: str, *words: str, **more: str) -> subprocess.Popen:
        environment = {**os.environ, "AUGKITTI_CACHE": str(folder / "cache"), **more}
        line = [sys.executable, "-m", "pipelines", "generate", "--kitti", kitti, "--cad", cad, "--n", str(N)]
        return subprocess.Popen(
            [*line, "--out", str(folder / name), *words],
            env=environment,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def told(name: str, how: str, code: int) -> None:
        digest, files = digest_of(folder / name)
        found.append(digest if code == 0 else f"exit code {code}")
        print(f"| {how} | {files} | {found[-1][:16]} | {'same' if found[-1] == found[0] else 'DIFFERS'} |", flush=True)
        if name != "cold":  # its shards are counted first
            shutil.rmtree(folder / name, ignore_errors=True)

    print("| run | files | sha256 over all files | |\n| --- | --- | --- | --- |")
    try:
        told("cold", "one process, empty cache", start("cold").wait())
        shards = len(list((folder / "cold" / "data").glob("*.parquet")))
        shutil.rmtree(folder / "cold")
        told("two", "two processes, prepared", start("two", "--jobs", "2").wait())
        for k, jobs in enumerate(("1", "2", "2")):
            place = {"AUGKITTI_CACHE": str(folder / "cache-0")} if k == 0 else {}  # the first also prepares
            rows = folder / f"kill{k}" / ".augkitti-work" / "rows"
            wanted, wait = int(rng.integers(1, max(2, shards - 2))), float(rng.uniform(0.0, LATER_S))
            began = time.monotonic()
            process = start(f"kill{k}", "--jobs", jobs, **place)
            while process.poll() is None and len(list(rows.glob("*.json"))) < wanted:
                time.sleep(0.002)
            time.sleep(wait)
            killed = process.poll() is None
            after = time.monotonic() - began
            if killed:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            done = len(list(rows.glob("*.json")))
            how = f"--jobs {jobs}, killed after {after:.1f} s with {done} of {shards} shards finished, resumed"
            if not killed or not 0 < done < shards:
                how = f"--jobs {jobs}, NOT KILLED IN ITS MIDDLE: {done} of {shards} shards were finished"
                found.append(how)
            told(f"kill{k}", how, start(f"kill{k}", "--resume", "--jobs", jobs, **place).wait())
        paths = [name for name in built.__cpu_dispatch__ if built.__cpu_features__[name]]
        for how, more in (
            (f"numpy without {' '.join(paths[1:])}", {"NPY_DISABLE_CPU_FEATURES": " ".join(paths[1:])}),
            (f"numpy without {' '.join(paths)}", {"NPY_DISABLE_CPU_FEATURES": " ".join(paths)}),
            ("OpenBLAS for Nehalem", {"OPENBLAS_CORETYPE": "Nehalem"}),
            ("C library without AVX2 and FMA", {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"}),
        ):
            shutil.rmtree(folder / "cache-cpu", ignore_errors=True)
            place = {"AUGKITTI_CACHE": str(folder / "cache-cpu")}
            told("cpu", f"{how}, empty cache", start("cpu", "--jobs", "2", **place, **more).wait())
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return 0 if len(set(found)) == 1 and not found[0].startswith("exit") else 1


def digest_of(folder: Path) -> tuple[str, int]:
    digest = hashlib.sha256()
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in files:
        digest.update(f"{path.relative_to(folder)}\n".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest(), len(files)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
