"""One run at a time on one folder: a work folder in, a lock held as long as the run lives out.

The lock is the kernel's (`flock`) on `lock` in the work folder, so it goes with the process however that ends, and a
dead run's file, left behind, holds nothing. What the file says (host, process, its start) is for the message. Where
the file system knows no `flock`, the file itself is the lock: it holds while the process that it names lives, and a
process of another host is taken to live.
"""

import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from augkitti.errors import InputError, MachineError
from augkitti.remote import is_remote, put_whole

NAME = "lock"
_WITHOUT_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)


@contextmanager
def hold(work: Path) -> Iterator[None]:
    """Hold a work folder, which is made if need be.

    Raises:
        InputError: another run holds it; says which.
        MachineError: the folder cannot be written.
    """
    path = work / NAME
    if is_remote(work):
        _take(path)
        try:
            yield
        finally:
            if _object(path) == _own():
                path.unlink(missing_ok=True)
        return
    try:
        work.mkdir(parents=True, exist_ok=True)
        file = _locked(path)
    except OSError as err:
        raise MachineError(work, f"cannot be written ({err.strerror})", "take another --out") from err
    try:
        os.ftruncate(file, 0)
        os.pwrite(file, json.dumps(_own()).encode(), 0)
        yield
    finally:
        os.close(file)


def check_free(work: Path) -> None:
    """Refuse, before any work, a folder that another run holds.

    Raises:
        InputError: as said.
    """
    if is_remote(work):
        _check_object(work / NAME)
        return
    with suppress(OSError):  # no lock file, or none that can be opened: `hold` tells
        os.close(_locked(work / NAME, create=False))


def _locked(path: Path, create: bool = True) -> int:
    """A descriptor of the lock file, locked.

    Raises:
        InputError: another run holds it.
        OSError: it cannot be opened.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as err:
            content = _content(file)
            os.close(file)
            if isinstance(err, BlockingIOError):
                raise _held(path, content) from None
            if err.errno not in _WITHOUT_LOCKS:
                raise
            if content and _lives(content):
                raise _held(path, content) from None
            return os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            if os.path.samestat(os.fstat(file), os.stat(path)):
                return file
        except FileNotFoundError:
            if not create:
                os.close(file)
                raise
        os.close(file)  # the run that held it ended just now and took the file away


def _take(path: Path) -> None:
    """Put a lock on a store that has none, or a dead run's; of two that try at once, a store that can tell lets one.

    Nothing is taken away but the lock of a dead run, and what stands there in the end has to be our own.

    Raises:
        InputError: another run holds it.
    """
    if _check_object(path) is not None:
        path.unlink(missing_ok=True)
    with suppress(FileExistsError):  # another run was faster: told below
        put_whole(path, lambda file: file.write(json.dumps(_own()).encode()), new=True)
    found = _object(path)
    if found != _own():
        raise _held_object(path, found or {})


def _check_object(path: Path) -> dict[str, Any] | None:
    """Refuse a lock on a store whose run lives, or may live on another host; a dead run's lock, None without one.

    Raises:
        InputError: as said.
    """
    content = _object(path)
    if content and _lives(content):
        raise _held_object(path, content)
    return content


def _object(path: Path) -> dict[str, Any] | None:
    """What a lock on a store says, nothing where it is damaged; None where there is none."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _held_object(path: Path, content: dict[str, Any]) -> InputError:
    return _held(path, content, f"; if it is dead, remove {path}")


def _held(path: Path, content: dict[str, Any], more: str = "") -> InputError:
    who = f"process {content.get('process', '?')} on {content.get('host', '?')}"
    return InputError(path.parent.parent, f"is held by another run ({who})", f"wait for it, or end it first{more}")


def _own() -> dict[str, Any]:
    return {"host": socket.gethostname(), "process": os.getpid(), "start": _start(os.getpid())}


def _lives(content: dict[str, Any]) -> bool:
    if content.get("host") != socket.gethostname():
        return True
    return content.get("process") != os.getpid() and content.get("start") == _start(content.get("process", 0))


def _start(process: int) -> str:
    """When a process started, in the kernel's count since boot; empty where there is none (any more)."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _content(file: int) -> dict[str, Any]:
    try:
        content = json.loads(os.pread(file, 4096, 0))
        return content if isinstance(content, dict) else {}
    except (ValueError, RecursionError):
        return {}
