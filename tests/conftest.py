"""Fixtures that several test modules share."""

import faulthandler
import os
import sys
from pathlib import Path

import pytest

from augkitti import command_line

ROOT = Path(__file__).resolve().parent.parent


def pytest_sessionfinish() -> None:
    """What hangs after the last test tells where, too, and ends."""
    faulthandler.dump_traceback_later(300, exit=True, file=sys.__stderr__)


def pytest_unconfigure() -> None:
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(autouse=True)
def _usual_manner() -> None:
    """No test hears how quiet a command of another was told to be."""
    command_line.begin(quiet=False, verbose=False)


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    """The folder of real scans, or a skip that says how to name it."""
    root = Path(os.environ.get("AUGKITTI_TEST_KITTI", ROOT.parent / "shared" / "kitti"))
    if not (root / "raw").is_dir():
        pytest.skip(f"no real scans at {root}: set AUGKITTI_TEST_KITTI")
    return root


@pytest.fixture(scope="session")
def cad_root() -> Path:
    """The folder of real car models, or a skip that says how to name it."""
    root = Path(os.environ.get("AUGKITTI_TEST_CAD", ROOT.parent / "shared" / "cad"))
    if not (root / "manifest.json").is_file():
        pytest.skip(f"no car models at {root}: set AUGKITTI_TEST_CAD")
    return root


@pytest.fixture
def augkitti(monkeypatch, tmp_path):
    """The command, in a folder and with a cache of the test's own."""
    from typer.testing import CliRunner

    from pipelines.cli import app

    monkeypatch.setenv("AUGKITTI_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("AUGKITTI_KITTI", raising=False)
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])
