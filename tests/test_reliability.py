"""Runs that are cut off, crowded out or starved: each ends with one line and an exit code; `--resume` finishes it."""

import hashlib
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from pair_rows import assert_among, rows_of
from tiny_drive import write_drive

from augkitti.dataset_index import replace_whole
from augkitti.errors import InputError, MachineError
from pipelines import augment, cache
from pipelines.augment import augment_shard
from pipelines.generate import generate
from pipelines.lock import NAME, hold
from pipelines.run import WORK, Options, end_work, open_run, read_options

N = 6  # pairs, in two streets: two shards


def command(out: Path, store: Path, *words: str, **more: str) -> dict:
    environment = {**os.environ, "AUGKITTI_CACHE": str(store), "OMP_NUM_THREADS": "1", **more}
    environment.pop("AUGKITTI_KITTI", None)
    line = [sys.executable, "-m", "pipelines", "generate", "--out", str(out), "--n", str(N), "--cars", "1", *words]
    return {"args": line, "env": environment, "text": True, "cwd": Path(__file__).parent.parent}


def run(out: Path, store: Path, *words: str, limit: int | None = None) -> tuple[int, str]:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = subprocess.run(
        **command(out, store, *words), capture_output=True, check=False, preexec_fn=limited if limit else None
    )
    told = [line for line in done.stderr.splitlines() if line.startswith("augkitti: ")]
    assert "Traceback" not in done.stderr, done.stderr
    assert len(told) == (done.returncode > 1), done.stderr
    return done.returncode, "".join(told)


def options_of(out: Path, store: Path, n: int = N) -> Options:
    usual = {"kitti": None, "cad": None, "seed": 0, "config": None, "profile": None, "stop_on_error": False}
    return replace(read_options(out=out, n=n, cars=(1, 1), **usual), cache=store)


def resumed(out: Path, store: Path) -> dict[str, str]:
    assert generate(options_of(out, store), jobs=1, resume=True, dry_run=False) == 0
    return digests(out)


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, store):
    out = tmp_path_factory.mktemp("made") / "aug"
    assert run(out, store) == (0, "")
    return out


@pytest.fixture(scope="module")
def made(undisturbed):
    return digests(undisturbed)


def _hear_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell starts what runs in the background deaf to them


def begun(out: Path, store: Path, *words: str) -> subprocess.Popen:
    """A run of its own process group that has begun to write a shard."""
    process = subprocess.Popen(
        **command(out, store, *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=_hear_interrupts,
    )
    for _ in range(3000):
        if list(out.glob("data/.*.tmp")):
            return process
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    raise AssertionError("no shard was begun")


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [(signal.SIGKILL, -9, ""), (signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "told to end")],
)
def test_a_process_group_that_a_signal_ends_goes_on_to_the_same_bytes(made, store, tmp_path, number, code, said):
    out = tmp_path / "aug"
    process = begun(out, store, "--jobs", "2")
    os.killpg(process.pid, number)
    _, told = process.communicate()
    assert process.returncode == code
    assert said in told
    assert "Traceback" not in told
    assert not (out / "dataset.json").exists()
    assert resumed(out, store) == made


def test_a_run_killed_after_its_first_shard_keeps_it_and_goes_on_to_the_same_bytes(tmp_path):
    out, rows = tmp_path / "aug", tmp_path / "aug" / WORK / "rows"
    for number in ("0001", "0002", "0005", "0009"):  # four shards of two pairs
        write_drive(tmp_path / "kitti", frames=(0, 1, 2), name=f"2011_09_26_drive_{number}_sync", truth=True)
    words = ("--kitti", str(tmp_path / "kitti"), "--n", "8")
    assert run(tmp_path / "undisturbed", tmp_path / "cache", *words) == (0, "")
    process = subprocess.Popen(
        **command(out, tmp_path / "cache", *words), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    while not list(rows.glob("*.json")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)
    process.kill()
    process.communicate()
    finished = [path.stem for path in rows.glob("*.json")]
    assert 1 <= len(finished) < 4
    kept = {path: path.stat().st_mtime_ns for path in (out / "data" / f"{name}.parquet" for name in finished)}
    assert run(out, tmp_path / "cache", *words, "--resume") == (0, "")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept, "what was finished is not made again"
    assert digests(out) == digests(tmp_path / "undisturbed")


def test_memory_that_ends_under_a_pair_ends_the_run_and_it_goes_on(made, store, tmp_path, monkeypatch):
    whole, calls = augment.make_pair, []

    def short(*arguments):
        calls.append(arguments)
        if len(calls) == N:  # in the second shard
            raise MemoryError
        return whole(*arguments)

    out = tmp_path / "aug"
    monkeypatch.setattr(augment, "make_pair", short)
    with pytest.raises(MachineError, match="memory ran out; use fewer --jobs, then go on with --resume"):
        generate(options_of(out, store), jobs=1, resume=False, dry_run=False)
    assert len(list((out / WORK / "rows").iterdir())) == 1
    monkeypatch.undo()
    assert resumed(out, store) == made


def test_a_killed_worker_ends_the_run_with_one_line_and_it_goes_on(made, store, tmp_path):
    out = tmp_path / "aug"
    process = begun(out, store, "--jobs", "2")
    (temporary, *_) = out.glob("data/.*.tmp")
    os.kill(int(temporary.name.split(".")[-3]), signal.SIGKILL)  # as the kernel does when memory runs out
    _, told = process.communicate()
    assert process.returncode == 3
    assert "a worker process was killed" in told
    assert "Traceback" not in told
    assert resumed(out, store) == made


def test_an_output_folder_removed_under_a_run_ends_it_and_nothing_stands_in_its_place(made, store, tmp_path):
    out = tmp_path / "aug"
    process = begun(out, store)
    shutil.rmtree(out)
    _, told = process.communicate()
    assert process.returncode == 3
    assert "removed under the run" in told
    assert not out.exists()
    assert resumed(out, store) == made


def test_a_task_that_outlives_its_run_takes_nothing_away(undisturbed, made, store, tmp_path):
    out = tmp_path / "aug"
    shutil.copytree(undisturbed, out)
    options = options_of(out, store)
    begun_twice = open_run(options)  # as when a worker seemed lost and its shard went to another
    for shard in begun_twice.shards:
        with pytest.raises(MachineError):
            augment_shard((shard, begun_twice.sequences[shard.sequence]), options)
    assert digests(out) == made


def test_a_file_that_may_not_grow_ends_the_run_and_it_goes_on(made, store, tmp_path):
    code, told = run(tmp_path / "aug", store, limit=4_000_000)
    assert code == 3
    assert "cannot be written" in told
    assert resumed(tmp_path / "aug", store) == made


def test_a_full_disk_ends_the_run_and_it_goes_on(made, store, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=5m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here; the limit on file sizes is tested beside")
    try:
        code, told = run(disk / "aug", store)
        assert code == 3
        assert "No space left" in told
        subprocess.run(["mount", "-o", "remount,size=100m", disk], check=True)
        assert resumed(disk / "aug", store) == made
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_second_run_on_a_folder_is_told_who_holds_it(store, tmp_path):
    out = tmp_path / "aug"
    process = begun(out, store)
    os.kill(process.pid, signal.SIGSTOP)
    try:
        for resume in (False, True):
            with pytest.raises(InputError, match=rf"held by another run \(process {process.pid}"):
                generate(options_of(out, store), jobs=1, resume=resume, dry_run=False)
    finally:
        process.kill()
        process.communicate()
    with pytest.raises(InputError, match="unfinished run"):  # the dead run's lock holds nothing; its work is there
        generate(options_of(out, store), jobs=1, resume=False, dry_run=False)


def test_where_locks_are_unknown_the_process_named_in_the_file_holds_while_it_lives(tmp_path, monkeypatch):
    def unknown(*arguments):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("pipelines.lock.fcntl.flock", unknown)
    with hold(tmp_path):
        own = (tmp_path / NAME).read_text()
    sleeper = subprocess.Popen(["sleep", "60"])
    try:
        start = Path(f"/proc/{sleeper.pid}/stat").read_text().rpartition(")")[2].split()[19]
        text = own.replace(f'"process": {os.getpid()}', f'"process": {sleeper.pid}')
        begin = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]
        (tmp_path / NAME).write_text(text.replace(begin, start))
        with pytest.raises(InputError, match=f"process {sleeper.pid}"), hold(tmp_path):
            pass
    finally:
        sleeper.kill()
        sleeper.wait()
    with hold(tmp_path):
        pass


def test_a_smaller_set_of_streets_holds_the_same_pairs(undisturbed, store, tmp_path):
    options = options_of(tmp_path / "aug", store, n=3)
    assert generate(options, jobs=1, resume=False, dry_run=False) == 0
    assert_among(rows_of(tmp_path / "aug"), rows_of(undisturbed), 3)


# --- the cache's size -------------------------------------------------------------------------------------------------


def filled(folder: Path) -> list[Path]:
    """Four files of 1 kB, the first used longest ago, streets of another week, and a file of somebody else."""
    paths = [folder / "prepared" / "ab" / f"{k}.arrays" for k in range(4)]
    for path in [*paths, folder / "streets" / "0123456789abcdef" / "scan.bin", folder / "prepared" / "notes.txt"]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(1000))
    for k, path in enumerate([*paths, folder / "streets" / "0123456789abcdef"]):
        os.utime(path, (1e9 + k, 1e9 + k))
    return paths


def test_the_longest_unused_entries_are_dropped_until_the_cache_fits(tmp_path):
    paths = filled(tmp_path)
    assert cache.trim(tmp_path, 5000.0) == 0
    assert cache.trim(tmp_path, 3500.0) == 2
    assert [path.exists() for path in paths] == [False, False, True, True]
    os.utime(tmp_path / "streets" / "0123456789abcdef")
    assert cache.trim(tmp_path, 0.0) == 2
    assert (tmp_path / "streets" / "0123456789abcdef" / "scan.bin").exists(), "a run may be reading them"


def test_reading_an_entry_makes_it_the_last_to_go(tmp_path):
    old, new = (cache.entry_path(tmp_path, [name]) for name in ("old", "new"))
    for k, path in enumerate((old, new)):
        cache.store(path, {})
        os.utime(path, (1e9 + k, 1e9 + k))
    assert cache.load(old) is not None
    assert [entry.path for entry in cache.entries(tmp_path)] == [new, old]


def test_clearing_takes_what_is_ours_alone(tmp_path):
    filled(tmp_path)
    assert cache.clear(tmp_path) == (5, 5000)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["notes.txt"]


def test_a_bound_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE_GB", "much")
    with pytest.raises(InputError, match="AUGKITTI_CACHE_GB"):
        cache.bound_bytes()


# --- the order of things ----------------------------------------------------------------------------------------------


def test_the_work_folder_goes_when_all_else_is_there(made, store, tmp_path, monkeypatch):
    def dies(folder):
        raise KeyboardInterrupt

    out = tmp_path / "aug"
    monkeypatch.setattr("pipelines.finish.end_work", dies)
    with pytest.raises(KeyboardInterrupt):
        generate(options_of(out, store), jobs=1, resume=False, dry_run=False)
    assert (out / WORK / "run.json").is_file()
    assert {name: digest for name, digest in digests(out).items() if not name.startswith(WORK)} == made
    monkeypatch.undo()
    assert resumed(out, store) == made


def test_the_lock_is_the_last_of_the_work_folder_to_go(tmp_path, monkeypatch):
    work, gone, unlink = tmp_path / WORK, [], Path.unlink

    def noted(path, missing_ok=False):
        gone.append(path.name)
        unlink(path, missing_ok)

    (work / "rows").mkdir(parents=True)
    for name in ("a", NAME, "run.json", "rows/row.json", "z"):
        (work / name).write_text("")
    monkeypatch.setattr(Path, "unlink", noted)
    end_work(tmp_path)
    assert not work.exists()
    assert (gone[0], gone[-1]) == ("run.json", NAME)


def test_a_file_is_on_the_disk_before_it_has_its_name_and_then_its_folder_is(tmp_path, monkeypatch):
    done, fsync, rename = [], os.fsync, os.replace

    def synced(file):
        status = os.fstat(file)
        done.append("folder" if stat.S_ISDIR(status.st_mode) else f"{status.st_size} bytes")
        fsync(file)

    def renamed(one, other):
        done.append("rename")
        rename(one, other)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    replace_whole(tmp_path / "file", lambda file: file.write(b"all"))
    assert done == ["3 bytes", "rename", "folder"]


# --- which program ----------------------------------------------------------------------------------------------------


@pytest.fixture
def program(monkeypatch):
    """A function that tells the digests of the program and of what prepares, worked out anew."""
    both = (cache.program_digest, cache.preparing_digest)

    def told():
        for digest in both:
            digest.cache_clear()
        return tuple(digest() for digest in both)

    yield told
    monkeypatch.undo()
    for digest in both:
        digest.cache_clear()


@pytest.mark.parametrize(
    ("library", "prepares"),
    [("numpy", 1), ("scipy", 1), ("small_gicp", 1), ("embreex", 0), ("pyarrow", 0), ("trimesh", 0)],
)
def test_another_version_of_a_library_is_another_program(program, monkeypatch, library, prepares):
    whole, before, version = program(), cache.entry_path(Path(), ["scan"]), cache.metadata.version
    monkeypatch.setattr(cache.metadata, "version", lambda name: "0" if name == library else version(name))
    other = program()
    assert whole[0] != other[0]
    assert (whole[1] != other[1]) == (before != cache.entry_path(Path(), ["scan"])) == bool(prepares)


@pytest.mark.parametrize(
    ("source", "prepares"), [("augkitti/ground.py", 1), ("pipelines/prepare.py", 1), ("pipelines/augment.py", 0)]
)
def test_a_changed_line_of_library_or_pipelines_is_another_program(program, monkeypatch, source, prepares):
    whole, sources = program(), cache._sources

    def changed(*arguments):
        return [(name, text + b"#" * (name == source)) for name, text in sources(*arguments)]

    monkeypatch.setattr(cache, "_sources", changed)
    other = program()
    assert whole[0] != other[0]
    assert (whole[1] != other[1]) == bool(prepares)
