"""Folders that are made once and kept: any file that was cut, lost, added or written over is seen; mended in place."""

import os

import pytest

from augkitti.kept_folder import LIST, is_whole, put_folder


def filled(folder, content=b"content"):
    for name in ("a.bin", "deep/er/b.bin"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


@pytest.fixture
def kept(tmp_path):
    put_folder(filled(tmp_path / "part"), tmp_path / "kept")
    return tmp_path / "kept"


def test_a_folder_is_whole_as_it_was_put_there_and_when_only_times_are_others(kept):
    assert is_whole(kept)
    os.utime(kept / "a.bin", (1e9, 1e9))
    assert is_whole(kept)
    assert not is_whole(kept / "deep")
    assert not is_whole(kept / "nothing")


def cut(kept):
    os.truncate(kept / "a.bin", 3)


def write_over(kept):
    (kept / "a.bin").write_bytes(b"CONTENT")


def lose(kept):
    (kept / "deep" / "er" / "b.bin").unlink()


def add(kept):
    (kept / "deep" / "c.bin").write_bytes(b"")


def lose_the_list(kept):
    (kept / LIST).unlink()


def spoil_the_list(kept):
    (kept / LIST).write_text('{"a.bin": 1, "deep/er/b.bin": null}')


@pytest.mark.parametrize("harm", [cut, write_over, lose, add, lose_the_list, spoil_the_list])
def test_what_is_damaged_is_seen_and_mended_file_by_file(kept, tmp_path, harm):
    other = kept / "deep" / "er"
    before = other.stat().st_ino
    harm(kept)
    assert not is_whole(kept)
    put_folder(filled(tmp_path / "again"), kept)
    assert is_whole(kept)
    found = {str(path.relative_to(kept)): path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    assert found.pop(LIST)
    assert found == {"a.bin": b"content", "deep/er/b.bin": b"content"}
    assert other.stat().st_ino == before, "a run may be reading in the folder: it stays"
