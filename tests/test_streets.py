"""Embedded streets in the cache: made once, and again, to the same bytes, where one of their files was damaged."""

import os

from augkitti.dataset_index import file_sha256
from augkitti.kept_folder import LIST
from augkitti.scanner import load_profile
from pipelines.streets import Streets, make_streets


def digests(streets):
    return {path: file_sha256(path) for path in streets.folder.rglob("*") if path.is_file() and path.name != LIST}


def test_a_scan_that_was_cut_is_made_again_and_a_whole_folder_is_not(tmp_path, monkeypatch):
    streets = Streets(tmp_path / "streets" / "0123456789abcdef", "0123456789abcdef", drives=1, frames=2, seed=0)
    assert not streets.are_there
    make_streets(streets, load_profile(), jobs=1)
    made = digests(streets)
    os.utime(streets.folder, (1e9, 1e9))
    with monkeypatch.context() as patch:
        patch.delattr("augkitti.synthesize.synthesize")
        make_streets(streets, load_profile(), jobs=1)
    assert streets.folder.stat().st_mtime > 1e9, "it was used now, so it is the last to go"
    scan = next(path for path in made if path.suffix == ".bin")
    os.truncate(scan, scan.stat().st_size - 16)
    assert not streets.are_there
    make_streets(streets, load_profile(), jobs=1)
    assert streets.are_there
    assert digests(streets) == made
    assert [path.name for path in streets.folder.parent.iterdir()] == [streets.folder.name]
