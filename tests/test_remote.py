"""Folders on an object store: an S3 server on loopback, one that fails every tenth request too; the local bytes."""

import json
import os
import pickle
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from car_files import write_cars
from tiny_drive import write_drive, write_odometry
from tiny_shards import write_tiny_set
from typer.testing import CliRunner

import augkitti
from augkitti.dataset_index import file_sha256
from augkitti.errors import InputError, MachineError
from augkitti.kitti import open_root, read_pair
from augkitti.remote import RemotePath, as_path, as_source, copy_here, is_remote
from augkitti.shards import replace_whole
from pipelines import lock
from pipelines.cli import app
from pipelines.run import WORK

pytest.importorskip("s3fs", reason="needs the extra `remote`")
pytest.importorskip("moto", reason="needs moto, an S3 server for tests")

BUCKET = "s3://augkitti-tests"
ACCESS = {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def server():
    """A function that makes the server fail every n-th request; tells (asked, failed, sent) since its last call."""
    words = [sys.executable, str(Path(__file__).with_name("s3_server.py"))]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        address = f"http://127.0.0.1:{int(process.stdout.readline())}"

        def fail_every(n):
            with urllib.request.urlopen(f"{address}/_every/{n}", timeout=10) as answer:
                return tuple(int(word) for word in answer.read().split())

        with pytest.MonkeyPatch.context() as patch:
            for name, value in (ACCESS | {"AWS_ENDPOINT_URL": address}).items():
                patch.setenv(name, value)
            patch.delenv("AWS_PROFILE", raising=False)
            yield fail_every
        process.stdin.close()


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """A root of two small drives of different layouts."""
    root = tmp_path_factory.mktemp("remote") / "kitti"
    write_drive(root, frames=(7, 8, 9), truth=True)
    write_odometry(root)
    return root


@pytest.fixture(scope="module")
def bucket(server, local):
    """The same root in a bucket."""
    import s3fs

    s3fs.S3FileSystem(use_listings_cache=False).mkdir(BUCKET)
    for path in sorted(path for path in local.rglob("*") if path.is_file()):
        content = path.read_bytes()
        replace_whole(as_path(f"{BUCKET}/kitti/{path.relative_to(local).as_posix()}"), lambda f, c=content: f.write(c))
    return f"{BUCKET}/kitti"


@pytest.fixture(scope="module")
def cars(bucket, tmp_path_factory):
    """A folder of two car models, and the same in the bucket."""
    folder = tmp_path_factory.mktemp("cars") / "cad"
    write_cars(folder)
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        replace_whole(as_path(f"{BUCKET}/cars/{path.name}"), lambda f, c=content: f.write(c))
    return folder, f"{BUCKET}/cars"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def run(cache, monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE", str(cache))
    monkeypatch.delenv("AUGKITTI_KITTI", raising=False)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def digests(folder):
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in folder.rglob("*") if path.is_file()}


def test_a_root_on_a_store_reads_as_the_local_one(local, bucket):
    near, far = open_root(local), open_root(bucket)
    assert [(s.name, s.recording, s.frames) for s in far.sequences] == [
        (s.name, s.recording, s.frames) for s in near.sequences
    ]
    for one, other in zip(near.sequences, far.sequences, strict=True):
        frame0 = one.pairs[0][0]
        a, b = read_pair(one, frame0), read_pair(pickle.loads(pickle.dumps(other)), frame0)
        np.testing.assert_array_equal(a.scan0.xyz, b.scan0.xyz)
        np.testing.assert_array_equal(a.ego_motion, b.ego_motion)
        assert [box.id for box in a.labels0] == [box.id for box in b.labels0]
        assert (a.scan0.time_s, a.ego_source, a.label_coverage) == (b.scan0.time_s, b.ego_source, b.label_coverage)


def test_a_run_on_a_store_that_fails_every_tenth_request_gives_the_bytes_of_a_local_run(
    local, bucket, cars, server, run, tmp_path
):
    common = ("--n", 3, "--cars", 1)
    near = run("generate", "--kitti", local, "--cad", cars[0], "--out", tmp_path / "near", *common)
    assert near.exit_code == 0, near.output
    out = f"{BUCKET}/far"
    server(10)
    made = run("generate", "--kitti", bucket, "--cad", cars[1], "--out", out, *common)
    assert made.exit_code == 0, made.output
    split = run("split", out, "--ratios", 70, 0, 30)
    assert split.exit_code == 0, split.output
    checked = run("validate", out, "--kitti", bucket)
    assert checked.exit_code == 0, checked.output
    shown = run("view", out, "--out", tmp_path / "pair.png")
    assert shown.exit_code == 0, shown.output
    train = augkitti.open(out, split="train")
    asked, failed, _ = server(0)
    assert failed >= asked // 10 >= 5
    assert run("split", tmp_path / "near", "--ratios", 70, 0, 30).exit_code == 0
    assert digests(as_path(out)) == digests(tmp_path / "near")
    assert not (as_path(out) / WORK).exists()
    near = augkitti.open(tmp_path / "near", split="train")
    assert train.pair_ids == near.pair_ids
    np.testing.assert_array_equal(train[0].flow0, near[near.pair_ids[0]].flow0)


def test_one_pair_of_a_set_on_a_store_costs_its_row_group_and_its_shards_footer(bucket, server, tmp_path):
    write_tiny_set(tmp_path / "aug", {"0001": (12,), "0002": (12,)}, tick_step=40)
    for path in sorted(path for path in (tmp_path / "aug").rglob("*") if path.is_file()):
        content = path.read_bytes()
        far = as_path(f"{BUCKET}/aug/{path.relative_to(tmp_path / 'aug').as_posix()}")
        replace_whole(far, lambda f, c=content: f.write(c))
    pairs = augkitti.open(f"{BUCKET}/aug")
    shard = tmp_path / "aug" / pairs.shards[1].path
    with parquet.ParquetFile(shard) as file:
        footer, group = file.metadata.serialized_size, file.metadata.row_group(7)
        row_group = sum(group.column(k).total_compressed_size for k in range(group.num_columns))
    server(0)
    far, near = pairs[12 + 7], augkitti.open(tmp_path / "aug")[12 + 7]
    asked, _, sent = server(0)
    np.testing.assert_array_equal(far.flow0, near.flow0)
    assert row_group < sent < row_group + footer + (128 << 10) < shard.stat().st_size / 2
    assert asked < 12


def test_a_run_that_was_cut_off_goes_on_and_a_finished_one_is_refused(local, bucket, run, tmp_path, monkeypatch):
    import pipelines.augment

    common = ("--kitti", bucket, "--n", 3, "--cars", 1)
    out = f"{BUCKET}/cut"

    def cut_off(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pipelines.augment, "write_row", cut_off)
        assert run("generate", *common, "--out", out).exit_code == 130
    refused = run("generate", *common, "--out", out)
    assert refused.exit_code == 2
    assert "holds an unfinished run" in refused.output
    assert run("generate", *common, "--out", out, "--resume").exit_code == 0
    assert run("generate", "--kitti", local, "--out", tmp_path / "near", *common[2:]).exit_code == 0
    assert digests(as_path(out)) == digests(tmp_path / "near")
    assert "is not empty" in run("generate", *common, "--out", out).output


def test_a_folder_that_a_living_run_holds_is_refused(bucket):
    work = as_path(f"{BUCKET}/held/{WORK}")
    with lock.hold(work):
        content = (work / "lock").read_bytes()
    assert not (work / "lock").exists()
    replace_whole(work / "lock", lambda file: file.write(content.replace(b'"host": "', b'"host": "another ')))
    with pytest.raises(InputError, match=r"is held by another run .*; if it is dead, remove s3://"), lock.hold(work):
        pass


RIVAL = {"host": "another", "process": 1, "start": "1"}


def put_rival(path):
    replace_whole(path, lambda file: file.write(json.dumps(RIVAL).encode()))


@pytest.mark.parametrize("moment", ["looked", "tried", "asked", "put"])
def test_of_two_runs_that_take_a_lock_in_one_moment_ours_is_refused_and_theirs_stays(bucket, monkeypatch, moment):
    """The other run's lock comes after ours found none, before ours puts, in the middle of it, or after it."""
    work, look, put = as_path(f"{BUCKET}/raced-{moment}/{WORK}"), lock._check_object, lock.put_whole

    def looked(path):
        found = look(path)
        if moment == "looked":
            put_rival(path)
        return found

    def tried(path, write, new=False):
        if moment == "tried":
            put_rival(path)
        put(path, write, new)
        if moment == "put":  # on a store without conditional writes
            put_rival(path)

    def asked(path):
        put_rival(path)
        return False

    monkeypatch.setattr(lock, "_check_object", looked)
    monkeypatch.setattr(lock, "put_whole", tried)
    if moment == "asked":
        monkeypatch.setattr(RemotePath, "exists", asked)
    with pytest.raises(InputError, match=r"held by another run \(process 1 on another\)"), lock.hold(work):
        pass
    assert json.loads((work / "lock").read_bytes()) == RIVAL


def test_a_dead_runs_lock_on_a_store_is_taken_over_and_a_run_that_ends_takes_its_own_lock_alone(bucket):
    work = as_path(f"{BUCKET}/dead/{WORK}")
    own = lock._own()
    dead = json.dumps(own | {"process": 2**22 + 1}).encode()  # above the largest number that Linux gives
    replace_whole(work / "lock", lambda file: file.write(dead))
    with lock.hold(work):
        assert json.loads((work / "lock").read_bytes()) == own
        put_rival(work / "lock")
    assert json.loads((work / "lock").read_bytes()) == RIVAL


def test_a_file_is_on_the_store_whole_or_not_at_all(bucket):
    path = as_path(f"{BUCKET}/whole/shard.parquet")

    def breaks(file):
        file.write(b"half")
        raise OSError("the process dies here")

    with pytest.raises(OSError, match="dies"):
        replace_whole(path, breaks)
    assert not path.exists()
    replace_whole(path, lambda file: file.write(b"all"))
    with pytest.raises(OSError, match="dies"):
        replace_whole(path, breaks)
    assert path.read_bytes() == b"all"


def test_a_store_that_gives_no_answer_is_never_taken_for_a_file_that_is_not_there(bucket, server, monkeypatch):
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")  # another file system of fsspec: one that does not try again
    scan = as_path(bucket) / "raw"
    server(1)
    try:
        for question in (scan.exists, scan.is_file, scan.is_dir, scan.stat, scan.read_bytes, lambda: [*scan.iterdir()]):
            with pytest.raises(MachineError, match="gave no answer"):
                question()
        with pytest.raises(MachineError, match="gave no answer"):
            open_root(f"{BUCKET}/kitti/raw")
    finally:
        server(0)


def test_what_is_not_there_is_told_as_on_a_disk(bucket, run):
    answer = run("generate", "--kitti", f"{BUCKET}/nothing", "--out", f"{BUCKET}/no", "--n", 1)
    assert answer.exit_code == 2
    assert f"{BUCKET}/nothing: does not exist" in answer.output
    with pytest.raises(InputError, match="does not exist"):
        augkitti.open(f"{BUCKET}/nothing")
    with pytest.raises(InputError, match="unfinished or no data set"):
        augkitti.open(bucket)
    assert run("split", "s3://").exit_code == 2


def test_car_models_are_copied_once_and_again_when_they_change_or_the_copy_is_damaged(bucket, tmp_path):
    folder = as_path(f"{BUCKET}/cad")
    for name in ("a.obj", "parts/b.mtl"):
        replace_whole(folder / name, lambda file: file.write(b"one"))
    here = copy_here(folder, tmp_path)
    assert (here / "parts" / "b.mtl").read_bytes() == b"one"
    assert copy_here(folder, tmp_path) == here
    (here / "a.obj").write_bytes(b"on")
    (here / "parts" / "b.mtl").unlink()
    assert copy_here(folder, tmp_path) == here
    assert [(here / name).read_bytes() for name in ("a.obj", "parts/b.mtl")] == [b"one", b"one"]
    assert [path.name for path in tmp_path.iterdir()] == [here.name]
    replace_whole(folder / "a.obj", lambda file: file.write(b"another"))
    assert (copy_here(folder, tmp_path) / "a.obj").read_bytes() == b"another"


def test_addresses_answer_as_paths_do(tmp_path):
    path = as_path("s3://bucket/kitti/2011/0000000001.bin")
    assert (path.name, path.stem, path.suffix) == ("0000000001.bin", "0000000001", ".bin")
    assert str(path.parent) == "s3://bucket/kitti/2011"
    assert str(as_path("s3://bucket/").parent) == "s3://bucket"
    assert path.relative_to(as_path("s3://bucket/kitti")).as_posix() == "2011/0000000001.bin"
    assert as_path(str(path)) == path == pickle.loads(pickle.dumps(path))
    assert hash(as_source(str(path))) == hash(path)
    assert is_remote(path)
    assert isinstance(path, RemotePath)
    assert as_path("data/aug") == Path("data/aug")
    assert as_path(f"file://{tmp_path}") == tmp_path
    with pytest.raises(TypeError):
        os.fspath(path)


def test_local_folders_need_no_library_of_stores(tmp_path):
    heavy = "('fsspec', 's3fs', 'distributed')"
    code = f"import sys, augkitti, pipelines.generate, pipelines.cli; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
