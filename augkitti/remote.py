"""Folders on object stores: an address such as `s3://bucket/kitti` in, an object that answers as a path does out.

Any address that fsspec knows will do (`s3://` with s3fs, `gs://` with gcsfs, ...; extra `remote`). Local folders stay
`pathlib`'s, and nothing here is imported for them. Why not a general path library: those answer `is_file` with no when
the store is out of reach, and a label file that seems absent changes a pair without a word. Here only a store that says
"there is no such thing" makes a file absent; any other failure, after the retries, is a `MachineError`, which ends the
run so that `--resume` can go on with it.
"""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, BinaryIO, cast

from augkitti.errors import InputError, MachineError
from augkitti.kept_folder import is_whole, put_folder

ATTEMPTS = 10  # of a request that the store answers with an error of its own (500, 503), with growing pauses
_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)://(.+)")
_BLOCK_BYTES = 8 << 20  # read ahead in files that are read from end to end
_ABSENT = (FileNotFoundError, NotADirectoryError, IsADirectoryError, FileExistsError)


def as_path(place: Path | str) -> Path:
    """A folder as a user names it: a local path, or an address, whose object is a `RemotePath`, typed as a path.

    Raises:
        InputError: an address that names no bucket.
    """
    if not isinstance(place, str):
        return place
    found = _ADDRESS.fullmatch(place)
    if found is None:
        return Path(place)
    if found[1] == "file":
        return Path(found[2])
    rest = found[2].strip("/")
    if not rest:
        raise InputError(place, "names no bucket", "give an address such as s3://bucket/folder")
    return cast(Path, RemotePath(f"{found[1]}://{rest}"))


def as_source(place: Path | str) -> Path:
    """A folder that does not change while it is read: what a store says of it is asked once a process."""
    path: Any = as_path(place)
    return cast(Path, replace(path, root=path.address) if isinstance(path, RemotePath) else path)


def is_remote(path: object) -> bool:
    """Whether a path is on a store."""
    return isinstance(path, RemotePath)


@dataclass(frozen=True, order=True)
class RemotePath:
    """A file or folder on a store, with those parts of `pathlib.Path` that this program uses.

    A folder is there when something is in it, so making one does nothing, and removing it neither. Every method that
    asks the store raises `MachineError` where it gives no answer. It is no `os.PathLike`: what would open it as a local
    file fails loudly.
    """

    address: str  # without a slash at its end
    root: str | None = field(default=None, compare=False)  # of a source: below it, answers are kept

    def __truediv__(self, name: str | PurePosixPath) -> "RemotePath":
        return replace(self, address=f"{self.address}/{str(name).strip('/')}")

    def __str__(self) -> str:
        return self.address

    @property
    def name(self) -> str:
        """As in pathlib."""
        return self.address.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """As in pathlib."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """As in pathlib."""
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> "RemotePath":
        """As in pathlib; a bucket's is itself."""
        above = self.address.rpartition("/")[0]
        return self if above.endswith("/") else replace(self, address=above)

    def absolute(self) -> "RemotePath":
        """As in pathlib: addresses are."""
        return self

    def relative_to(self, folder: "RemotePath") -> PurePosixPath:
        """As in pathlib."""
        return PurePosixPath(self.address).relative_to(folder.address)

    def exists(self) -> bool:
        """Whether there is a file or a folder."""
        return self._look() is not None

    def is_file(self) -> bool:
        """Whether there is a file."""
        found = self._look()
        return found is not None and found[0] == "file"

    def is_dir(self) -> bool:
        """Whether there is a folder."""
        found = self._look()
        return found is not None and found[0] == "directory"

    def stat(self) -> Any:
        """Size and time of change.

        Raises:
            FileNotFoundError: there is no such thing.
        """
        found = self._look()
        if found is None:
            raise FileNotFoundError(2, "does not exist", self.address)
        return SimpleNamespace(st_size=found[1], st_mtime_ns=found[2])

    def iterdir(self) -> "Iterator[RemotePath]":
        """What is in the folder.

        Raises:
            FileNotFoundError: there is no such folder.
        """
        listing = _kept_listing(self.address) if self._is_kept() else _listing(self.address)
        return iter([self / name for name in listing])

    def glob(self, pattern: str) -> "Iterator[RemotePath]":
        """What is in the folder and bears such a name; one level only."""
        return (path for path in self.iterdir() if fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str) -> "Iterator[RemotePath]":
        """Files under the folder, however deep, that bear such a name."""
        place = _place(self.address)
        found = _ask(self.address, lambda fs: fs.find(place))
        below = (PurePosixPath(_strip(name)).relative_to(_strip(place)) for name in found)
        return iter([self / path for path in below if fnmatchcase(path.name, pattern)])

    def read_bytes(self) -> bytes:
        """As in pathlib.

        Raises:
            FileNotFoundError: there is no such file.
        """
        if not self._is_kept():
            return _content(self.address)
        status = self.stat()
        return _kept_content(self.address, status.st_size, status.st_mtime_ns)

    def read_text(self, encoding: str = "utf-8") -> str:
        """As in pathlib."""
        return self.read_bytes().decode(encoding)

    def open(self, mode: str = "rb") -> BinaryIO:
        """The file, to be read from its beginning to its end."""
        return self._open(mode, cache_type="readahead", block_size=_BLOCK_BYTES)

    def open_anywhere(self) -> BinaryIO:
        """The file, to be read here and there: each read is one request."""
        return self._open("rb", cache_type="none")

    def _open(self, mode: str, **options: Any) -> BinaryIO:
        if mode != "rb":
            raise ValueError(f"{self}: mode {mode}; files on stores are written by `put_whole`")
        return cast(BinaryIO, _ask(self.address, lambda fs: fs.open(_place(self.address), "rb", **options)))

    def put_whole(self, write: Callable[[BinaryIO], Any], new: bool = False) -> None:
        """Let `write` fill a local file, then hand it to the store, where it appears whole or not at all.

        Raises:
            FileExistsError: it is to be `new`, and there is one.
        """
        with tempfile.TemporaryDirectory(prefix="augkitti-") as folder:
            local = Path(folder) / "file"
            with local.open("xb") as file:
                write(file)
            place = _place(self.address)
            if new:
                if self.exists():
                    raise FileExistsError(17, "is there already", self.address)
                content = local.read_bytes()
                _ask(self.address, lambda fs: fs.pipe_file(place, content, mode="create"))
            else:
                _ask(self.address, lambda fs: fs.put_file(str(local), place))

    def unlink(self, missing_ok: bool = False) -> None:
        """As in pathlib."""
        try:
            _ask(self.address, lambda fs: fs.rm_file(_place(self.address)))
        except FileNotFoundError:
            if not missing_ok:
                raise

    def remove_all(self) -> None:
        """Remove every file under the folder."""
        for path in self.rglob("*"):
            path.unlink(missing_ok=True)

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: a folder is there when something is in it."""

    def rmdir(self) -> None:
        """Do nothing: a folder is gone when nothing is in it."""

    def _is_kept(self) -> bool:
        return self.root is not None and f"{self.address}/".startswith(f"{self.root}/")

    def _look(self) -> tuple[str, int, int] | None:
        """Kind, size and time of change; None where the store says that there is no such thing."""
        try:
            if self._is_kept() and self.address != self.root:
                return _kept_listing(self.parent.address).get(self.name)
            return _seen(_ask(self.address, lambda fs: fs.info(_place(self.address))))
        except _ABSENT:
            return None


def put_whole(path: Path, write: Callable[[BinaryIO], Any], new: bool = False) -> None:
    """`RemotePath.put_whole` of a path that `is_remote`."""
    cast(RemotePath, path).put_whole(write, new)


def open_anywhere(path: Path) -> BinaryIO | Path:
    """What a Parquet reader is given: a local path as it is, a file of a store to be read here and there."""
    place: object = path
    return place.open_anywhere() if isinstance(place, RemotePath) else path


def remove_all(folder: Path) -> None:
    """`RemotePath.remove_all` of a folder that `is_remote`."""
    cast(RemotePath, folder).remove_all()


def copy_here(folder: Path, cache: Path) -> Path:
    """A folder as it is, or on a store, a copy of it in the cache; another copy once what it holds has changed.

    A copy that was damaged since (`kept_folder.is_whole`) is made again.

    Raises:
        FileNotFoundError: there is no such folder.
        MachineError: the store or the disk gives way.
    """
    source: Any = folder
    if not isinstance(source, RemotePath):
        return folder
    files = sorted((path, path.stat()) for path in source.rglob("*"))
    if not files:
        raise FileNotFoundError(2, "does not exist", str(folder))
    told = [f"{path} {status.st_size} {status.st_mtime_ns}" for path, status in files]
    target = cache / hashlib.sha256("\n".join(told).encode()).hexdigest()[:32]
    if is_whole(target):
        with suppress(OSError):
            os.utime(target)  # used now: the last to go
        return target
    try:
        cache.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=".part-", dir=cache))
        try:
            for path, _ in files:
                local = part / path.relative_to(source)
                if not local.resolve().is_relative_to(part.resolve()):
                    raise InputError(str(path), "leads out of its folder", "rename it")
                local.parent.mkdir(parents=True, exist_ok=True)
                local.write_bytes(path.read_bytes())
            put_folder(part, target)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as err:
        problem = f"the cache cannot be written ({err.strerror or err})"
        raise MachineError(cache, problem, "make room or set AUGKITTI_CACHE") from err
    return target


def _filesystem(address: str) -> Any:
    """The fsspec file system of an address; fsspec keeps one a process."""
    protocol = address.partition("://")[0]
    options: dict[str, Any] = {"use_listings_cache": False}  # others write to the same folders
    if protocol in ("s3", "s3a"):
        attempts = int(os.environ.get("AWS_MAX_ATTEMPTS", ATTEMPTS))
        mode = os.environ.get("AWS_RETRY_MODE", "standard")
        options["config_kwargs"] = {"retries": {"mode": mode, "max_attempts": attempts}}
    try:
        import fsspec

        return fsspec.filesystem(protocol, **options)
    except (ImportError, ValueError) as err:
        problem = f"needs a package that is not here ({err})"
        raise InputError(address, problem, 'pip install "augkitti[remote]", gcsfs for gs://') from err


def _place(address: str) -> str:
    return address.partition("://")[2]


def _strip(place: str) -> str:
    return place.strip("/")


def _ask(address: str, question: Callable[[Any], Any]) -> Any:
    """The file system's answer.

    Raises:
        OSError: one of `_ABSENT`, which are answers.
        MachineError: anything else that goes wrong.
    """
    fs = _filesystem(address)
    try:
        return question(fs)
    except _ABSENT:
        raise
    except Exception as err:  # of s3fs, botocore, aiohttp, gcsfs, ...: they share no base
        why = " ".join(f"{type(err).__name__}: {err}".split())[:200]
        remedy = "see that the store is up and lets you in, then go on with --resume"
        raise MachineError(address, f"the store gave no answer ({why})", remedy) from err


def _seen(info: dict[str, Any]) -> tuple[str, int, int]:
    changed = info.get("LastModified") or info.get("mtime") or info.get("updated") or info.get("created")
    moment = changed.timestamp() if isinstance(changed, datetime) else 0.0
    return str(info["type"]), int(info.get("size") or 0), int(moment * 1e9)


def _listing(address: str) -> dict[str, tuple[str, int, int]]:
    """What is in a folder, by name."""
    place = _strip(_place(address))
    entries = _ask(address, lambda fs: fs.ls(_place(address), detail=True))
    named = {_strip(entry["name"]): entry for entry in entries}
    if list(named) == [place] and named[place]["type"] == "file":
        raise NotADirectoryError(20, "is not a folder", address)
    return {name.rpartition("/")[2]: _seen(named[name]) for name in sorted(named) if name != place}


_kept_listing = lru_cache(maxsize=1024)(_listing)


def _content(address: str) -> bytes:
    return bytes(_ask(address, lambda fs: fs.cat_file(_place(address))))


@lru_cache(maxsize=6)  # a scan is asked for twice or three times in a row, and is the next pair's first
def _kept_content(address: str, size: int, mtime_ns: int) -> bytes:
    return _content(address)
