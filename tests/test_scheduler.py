"""Generation on a Dask scheduler with two worker processes on loopback: the bytes of a local run, whoever dies."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_drive import write_drive

from augkitti.dataset_index import file_sha256
from augkitti.errors import InputError, MachineError
from pipelines import stage
from pipelines.cache import program_digest
from pipelines.run import WORK

pytest.importorskip("distributed", reason="needs the extra `distributed`")

ROOT = Path(__file__).resolve().parent.parent
PATIENCE_S = 120.0


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with four drives of two pairs, which make four shards, and the environment of all processes."""
    folder = tmp_path_factory.mktemp("scheduler")
    for number in ("0001", "0002", "0005", "0009"):
        write_drive(folder / "kitti", frames=(0, 1, 2), name=f"2011_09_26_drive_{number}_sync", truth=True)
    return folder


def environment(place, cache):
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": paths, "AUGKITTI_CACHE": str(place / cache), "OMP_NUM_THREADS": "1"}


def started(place, name, *words, cache="cache"):
    with (place / f"{name}.log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, *map(str, words)],
            env=environment(place, cache),
            cwd=place,
            stdout=log,
            stderr=subprocess.STDOUT,
        )


def generate(place, name, *words, cache="cache"):
    options = ("--kitti", place / "kitti", "--out", place / name, "--n", 8, "--cars", 1)
    return started(place, name, "-m", "pipelines", "generate", *options, *words, cache=cache)


def wait_for(ready, what):
    end = time.monotonic() + PATIENCE_S
    while not ready():
        assert time.monotonic() < end, f"{what} did not come"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def cluster(place):
    """The address of a scheduler, and its two workers; all are ended when the tests are."""
    words = ("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard")
    told = place / "scheduler.json"
    processes = [started(place, "scheduler", *words, "--scheduler-file", told)]
    try:
        wait_for(told.is_file, "the scheduler")
        address = json.loads(told.read_text())["address"]
        for number in (1, 2):
            words = ("-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", "--no-nanny")
            once = ("--nthreads", 1, "--no-dashboard", "--name", f"worker{number}")
            processes.append(started(place, f"worker{number}", *words, *once, cache=f"cache{number}"))
        wait_for(lambda: len(workers_of(address)) == 2, "the workers")
        yield address, processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def workers_of(address):
    """How many tasks each worker has been given, by the worker's name."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        names = {where: worker["name"] for where, worker in client.scheduler_info()["workers"].items()}
        return {names[where]: len(tasks) for where, tasks in client.processing().items()}


def test_a_run_on_two_workers_of_which_one_is_killed_ends_with_the_bytes_of_a_local_run(place, cluster):
    address, workers = cluster
    run = generate(place, "far", "--scheduler", address)
    rows = place / "far" / WORK / "rows"
    wait_for(lambda: run.poll() is not None or (rows.is_dir() and any(rows.glob("*.json"))), "the first shard")
    assert run.poll() is None, (place / "far.log").read_text()
    wait_for(lambda: workers_of(address)["worker1"], "a task for the first worker")
    assert len(list(rows.glob("*.json"))) < 4, "the run is in its middle"
    workers[0].send_signal(signal.SIGKILL)
    assert run.wait(PATIENCE_S) == 0, (place / "far.log").read_text()
    assert workers[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert workers[1].poll() is None
    assert generate(place, "near", "--resume", cache="cache2").wait(PATIENCE_S) == 0
    assert digests(place / "far") == digests(place / "near")
    assert not (place / "far" / WORK).exists()
    alone = generate(place, "alone", "--scheduler", address)  # a single worker is left: joblib would run tasks here
    assert alone.wait(PATIENCE_S) == 0, (place / "alone.log").read_text()
    assert digests(place / "alone") == digests(place / "near")


def digests(folder):
    return {str(path.relative_to(folder)): file_sha256(path) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("program", "threads", "problem"),
    [("another", 1, "has another version of augkitti, or of a library"), (None, 2, "runs several tasks at once")],
)
def test_a_worker_of_another_program_or_of_several_threads_does_no_task(monkeypatch, program, threads, problem):
    worker = SimpleNamespace(address="tcp://worker:1", state=SimpleNamespace(nthreads=threads))
    monkeypatch.setattr("distributed.get_worker", lambda: worker)
    done = []
    with pytest.raises(MachineError, match=f"tcp://worker:1: {problem}"):
        stage._on_worker(done.append, 1, 1, program or program_digest())
    assert not done
    worker.state.nthreads = 1
    assert stage._on_worker(done.append, 1, 5, program_digest()) == (None, 5)
    assert done == [1]


def test_a_scheduler_that_is_not_there_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr(stage, "_CONNECT_S", 0.2)
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:9: does not answer .*; give one such as"):
        stage.check_scheduler("tcp://127.0.0.1:9")
