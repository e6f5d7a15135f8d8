"""Scans, car models and data set on `gs://`: a Google Cloud Storage server on loopback; the local bytes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from car_files import write_cars
from tiny_drive import write_drive, write_odometry
from typer.testing import CliRunner

import augkitti
from augkitti.dataset_index import file_sha256
from augkitti.remote import as_path, copy_here
from augkitti.shards import replace_whole
from pipelines.cli import app
from pipelines.run import WORK

os.environ["GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT"] = "false"  # read on import; asks Google which kind a bucket is
pytest.importorskip("gcsfs", reason="needs gcsfs")
pytest.importorskip("gcp_storage_emulator", reason="needs gcp-storage-emulator, a server for tests")

# gcsfs hands aiohttp whole scans as bytes
pytestmark = pytest.mark.filterwarnings("ignore:Sending a large body directly:ResourceWarning")
BUCKET = "gs://augkitti-tests"


@pytest.fixture(scope="module")
def bucket():
    words = [sys.executable, str(Path(__file__).with_name("gs_server.py"))]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{int(process.stdout.readline())}")
            import gcsfs

            gcsfs.GCSFileSystem(use_listings_cache=False).mkdir(BUCKET.removeprefix("gs://"))
            yield BUCKET
        process.stdin.close()


def put(folder, address):
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        replace_whole(as_path(f"{address}/{path.relative_to(folder).as_posix()}"), lambda f, c=content: f.write(c))


def digests(folder):
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in folder.rglob("*") if path.is_file()}


def test_a_run_with_all_three_folders_on_the_store_gives_the_bytes_of_a_local_run(bucket, tmp_path, monkeypatch):
    monkeypatch.setenv("AUGKITTI_CACHE", str(tmp_path / "cache"))
    kitti, cad, near, far = tmp_path / "kitti", tmp_path / "cad", tmp_path / "near", f"{bucket}/far"
    write_drive(kitti, frames=(7, 8), truth=True)
    write_odometry(kitti)
    write_cars(cad)
    put(kitti, f"{bucket}/kitti")
    put(cad, f"{bucket}/cad")

    def run(*words):
        answer = CliRunner().invoke(app, [str(word) for word in words])
        assert answer.exit_code == 0, answer.output

    run("generate", "--kitti", kitti, "--cad", cad, "--out", near, "--n", 2, "--cars", 1)
    run("generate", "--kitti", f"{bucket}/kitti", "--cad", f"{bucket}/cad", "--out", far, "--n", 2, "--cars", 1)
    run("split", near, "--ratios", 50, 0, 50)
    run("split", far, "--ratios", 50, 0, 50)
    run("validate", far, "--kitti", f"{bucket}/kitti")
    assert digests(as_path(far)) == digests(near)
    assert not (as_path(far) / WORK).exists()
    pairs = augkitti.open(far), augkitti.open(near)
    np.testing.assert_array_equal(pairs[0][0].flow0, pairs[1][0].flow0)


def test_car_models_that_change_at_equal_size_are_copied_again(bucket, tmp_path):
    model = as_path(f"{bucket}/models/a.obj")
    for content in (b"one", b"two"):
        replace_whole(model, lambda file, c=content: file.write(c))
        assert (copy_here(model.parent, tmp_path) / "a.obj").read_bytes() == content
