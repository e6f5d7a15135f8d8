"""A folder that is made once and kept: its files in, a list of their sizes, times and sha256 beside them out; checked.

A file counts as the one listed while its size and time of change are as listed; where only the time is another, while
its sha256 is. So gigabytes are checked by their names, and a file that was cut, written over, lost or added is seen.
Not seen: a disk that gives other bytes under the same size and time.
"""

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path

LIST = ".files.json"


def is_whole(folder: Path) -> bool:
    """Whether a folder holds the files of its list as they were put there, and no others; no where it has no list."""
    try:
        listed = json.loads((folder / LIST).read_bytes())
        return _names(folder) == sorted(listed) and all(_is(folder / name, *listed[name]) for name in listed)
    except (OSError, ValueError, TypeError, RecursionError):
        return False


def put_folder(part: Path, folder: Path) -> None:
    """List the files of a folder, and move it to its place.

    Where something stands there already (damaged, or another process was faster), its files are replaced one by one,
    and what is not listed goes: a run that reads there finds every file at any moment.

    Raises:
        OSError: the disk refuses.
    """
    names = _names(part)
    (part / LIST).write_text(json.dumps({name: _row(part / name) for name in names}), encoding="utf-8")
    with suppress(OSError):
        os.rename(part, folder)
        return
    for name in (*names, LIST):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(part / name, folder / name)
    for name in set(_names(folder)) - set(names):
        (folder / name).unlink(missing_ok=True)


def _names(folder: Path) -> list[str]:
    """All files under a folder but the list, however deep, by name."""
    base = str(folder)
    names = [os.path.relpath(os.path.join(at, name), base) for at, _, files in os.walk(base) for name in files]
    return sorted(name for name in names if name != LIST)


def _row(path: Path) -> list[int | str]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, _sha256(path)]


def _is(path: Path, size: int, mtime_ns: int, sha256: str) -> bool:
    status = path.stat()
    return status.st_size == size and (status.st_mtime_ns == mtime_ns or _sha256(path) == sha256)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
