"""The cache on disk: names and arrays in, the same arrays out as long as they are there; bounded, oldest use out first.

`CACHE/prepared/<2 digits>/<digest>.arrays` is what `prepare` finds in scans and pairs, `CACHE/cad/car-<digest>.npz` are
finished car models, `CACHE/cad-copies/<digest>/` models from a store, `CACHE/streets/<digest>/` embedded streets. A
name is the digest of all that the content depends on, the program's own source and the libraries that compute it among
it: what is found is never stale. Nothing is lost but time with any of it.
"""

import hashlib
import json
import math
import os
import shutil
import struct
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.command_line import is_json, print_json, signed
from augkitti.dataset_index import replace_whole
from augkitti.errors import InputError, MachineError

BOUND_GB = 32.0  # all of KITTI raw prepared is about 25 GB
_FORMAT = "prepared 2"
_MAGIC, _SIZES = b"augkitti prepared scan\n\n", struct.Struct("<II")  # before all else: checksum, length of the JSON
_PATTERNS = {
    "prepared": "[0-9a-f][0-9a-f]/*.arrays",
    "cad": "car-*.npz",
    "cad-copies": "[0-9a-f]*",
    "streets": "[0-9a-f]*",
}
_LEFT_OVER = (
    "prepared/[0-9a-f][0-9a-f]/.*.tmp",
    "cad/*.part",
    "cad-copies/.part-*",
    "streets/.*.part-*",
)  # of runs that died
_PREPARING = ("numpy", "scipy", "small_gicp")  # libraries whose results the cache keeps
_MAKING = (*_PREPARING, "embreex", "pyarrow", "trimesh")  # those that a shard's bytes depend on
_STREETS_STAY_S = _LEFT_OVER_STAYS_S = 86_400.0  # streets are a run's source: not taken from under one


@dataclass(frozen=True)
class Entry:
    """A file of the cache, or the folder of one set of streets."""

    kind: str
    path: Path
    bytes: int
    used_s: float  # when it was last used, seconds since 1970


def cache_folder() -> Path:
    """`$AUGKITTI_CACHE`, or `augkitti` in the user's cache folder."""
    given = os.environ.get("AUGKITTI_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "augkitti"


def bound_bytes() -> float:
    """How large the cache may become: `$AUGKITTI_CACHE_GB`, or 32 GB.

    Raises:
        InputError: the variable is no number from 0.
    """
    text = os.environ.get("AUGKITTI_CACHE_GB", str(BOUND_GB))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value >= 0.0:
        raise InputError("AUGKITTI_CACHE_GB", f"is `{text}`", "give gigabytes, 0 or more")
    return value * 1e9


@cache
def program_digest() -> str:
    """sha256 over all of the program that shards depend on: what `--resume` and the workers of a scheduler compare."""
    sources = [*_sources("augkitti"), *_sources("pipelines")]
    return _digest(sources, _MAKING)


@cache
def preparing_digest() -> str:
    """sha256 over the part of it that prepared scans depend on: another program never reads this one's cache."""
    sources = [*_sources("augkitti"), *_sources("pipelines", "prepare.py")]
    return _digest(sources, _PREPARING)


def _sources(package: str, ending: str = ".py") -> list[tuple[str, bytes]]:
    found = [entry for entry in resources.files(package).iterdir() if entry.name.endswith(ending)]
    return sorted((f"{package}/{entry.name}", entry.read_bytes()) for entry in found)


def _digest(sources: list[tuple[str, bytes]], libraries: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for name, content in sources:
        digest.update(f"{name} {len(content)}\n".encode() + content)
    for name in libraries:
        digest.update(f"{name} {metadata.version(name)}\n".encode())
    return digest.hexdigest()


def entry_path(folder: Path, parts: list[Any]) -> Path:
    """Where what depends on `parts` (JSON) and the program is kept."""
    key = hashlib.sha256(json.dumps([_FORMAT, preparing_digest(), *parts], sort_keys=True).encode()).hexdigest()
    return folder / "prepared" / key[:2] / f"{key}.arrays"


def load(path: Path) -> dict[str, Any] | None:
    """The arrays of a cache file; None where there is none, or none that is whole and bears its own name."""
    try:
        content = path.read_bytes()
        start = len(_MAGIC) + _SIZES.size
        crc, length = _SIZES.unpack(content[len(_MAGIC) : start])
        if content[: len(_MAGIC)] != _MAGIC or zlib.crc32(memoryview(content)[start:]) != crc:
            return None
        head = json.loads(content[start : start + length])
        if head["key"] != path.stem:
            return None
        arrays, offset = {}, _aligned(start + length)
        for name, dtype, shape in head["arrays"]:
            arrays[name] = np.frombuffer(content, dtype, math.prod(shape), offset).reshape(shape)
            offset = _aligned(offset + arrays[name].nbytes)
    except (OSError, struct.error, ValueError, KeyError, TypeError, RecursionError):
        return None
    with suppress(OSError):  # a cache that may only be read serves as well
        os.utime(path)  # used now: the last to go
    return arrays


def store(path: Path, arrays: dict[str, Any]) -> None:
    """Keep arrays under a path of `entry_path`: checksum, names and shapes as JSON, then the numbers as they are.

    Not compressed, nor NumPy's own archive, which takes a fifth of a millisecond an array to open: it is read for every
    pair.

    Raises:
        MachineError: the disk refuses.
    """
    listed = [(name, np.asarray(value).dtype.str, np.shape(value)) for name, value in arrays.items()]
    head = json.dumps({"key": path.stem, "arrays": listed}).encode()
    body = bytearray(head)
    for value in arrays.values():
        at = len(_MAGIC) + _SIZES.size + len(body)
        body += bytes(_aligned(at) - at) + np.ascontiguousarray(value).tobytes()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = _MAGIC + _SIZES.pack(zlib.crc32(body), len(head)) + body
        replace_whole(path, lambda file: file.write(whole))
    except OSError as err:
        problem = f"the cache cannot be written ({err.strerror or err})"
        raise MachineError(path.parent, problem, "make room or set AUGKITTI_CACHE, then use --resume") from err


def _aligned(offset: int) -> int:
    return -(-offset // 8) * 8


def entries(folder: Path) -> list[Entry]:
    """All that the cache keeps, longest unused first; what does not look like ours is not looked at."""
    found = []
    for kind, pattern in _PATTERNS.items():
        for path in (folder / kind).glob(pattern):
            try:
                state = path.stat()
                size = sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else state.st_size
            except OSError:
                continue  # another run dropped it just now
            found.append(Entry(kind, path, size, state.st_mtime))
    return sorted(found, key=lambda entry: (entry.used_s, str(entry.path)))


def trim(folder: Path, bound: float | None = None) -> int:
    """Drop what was not used for longest until the cache fits; how many entries went.

    Streets used within a day stay, and so may others' files that cannot be removed.

    Raises:
        InputError: as `bound_bytes`.
    """
    limit = bound_bytes() if bound is None else bound
    now = time.time()
    for pattern in _LEFT_OVER:
        for path in folder.glob(pattern):
            if now - _changed(path) > _LEFT_OVER_STAYS_S:
                _remove(path)
    there = entries(folder)
    total, dropped = sum(entry.bytes for entry in there), 0
    for entry in there:
        if total <= limit:
            break
        if entry.kind in ("streets", "cad-copies") and now - entry.used_s < _STREETS_STAY_S:
            continue
        _remove(entry.path)
        total, dropped = total - entry.bytes, dropped + 1
    return dropped


def clear(folder: Path) -> tuple[int, int]:
    """Remove all that the cache keeps, nothing else; number of entries and bytes."""
    gone = entries(folder)
    for path in [*(entry.path for entry in gone), *(path for pattern in _LEFT_OVER for path in folder.glob(pattern))]:
        _remove(path)
    return len(gone), sum(entry.bytes for entry in gone)


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return math.inf


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with suppress(OSError):
        path.unlink(missing_ok=True)


def show_cache() -> None:
    """Print where the cache is, what it keeps, and how large it may become."""
    folder, bound = cache_folder(), bound_bytes()
    there = entries(folder)
    if is_json():
        kinds = {kind: [entry.bytes for entry in there if entry.kind == kind] for kind in _PATTERNS}
        content = {kind: {"entries": len(sizes), "bytes": sum(sizes)} for kind, sizes in kinds.items()}
        print_json({"folder": str(folder), "most_bytes": bound, "kinds": content})
        return
    print(signed(f"{folder}: {sum(entry.bytes for entry in there) / 1e9:,.2f} of at most {bound / 1e9:,.1f} GB"))
    for kind in _PATTERNS:
        sizes = [entry.bytes for entry in there if entry.kind == kind]
        print(f"  {kind}: {len(sizes):,}, {sum(sizes) / 1e9:,.2f} GB")
