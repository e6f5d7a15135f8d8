"""What both commands have in common: options in; how much they say, JSON on stdout alone and progress on stderr out.

`--quiet` leaves errors and what was asked for; `--verbose` adds versions, settings, times and the traceback behind an
error. Both may stand before or behind the command's name. Nothing here changes what is made.
"""

import json
import math
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import typer
from typer.core import TyperGroup

import augkitti

_FIRST_LINE_S, _LINE_EVERY_S = 10.0, 30.0  # of progress where there is no terminal
_GLOBAL = ("--quiet", "--verbose")
_LIBRARIES = ("numpy", "scipy", "pyarrow", "embreex", "small_gicp", "trimesh", "torch")

Item = TypeVar("Item")


@dataclass
class _Manner:
    quiet: bool = False
    verbose: bool = False
    json: bool = False  # the command prints JSON: stdout is its alone
    started_s: float = 0.0
    shows_progress: bool = False


_manner = _Manner()


class Group(TyperGroup):
    """A command's group: takes its own options anywhere, and `--json` without a file where a file may follow."""

    json_may_name_a_file: tuple[str, ...] = ()  # commands whose `--json` takes a file, or nothing for stdout

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Put global options first, and `-` (stdout) behind a `--json` that names no file."""
        end = args.index("--") if "--" in args else len(args)
        words = [word for word in args[:end] if word not in _GLOBAL]
        first = [word for word in args[:end] if word in _GLOBAL]
        if any(word in self.json_may_name_a_file for word in words):
            words = [part for word, behind in zip(words, [*words[1:], None], strict=True)
                     for part in ([word, "-"] if word == "--json" and _is_no_file(behind) else [word])]  # fmt: skip
        return list(super().parse_args(ctx, [*first, *words, *args[end:]]))

    def main(self, *args: Any, **more: Any) -> Any:
        """As `typer` does, but what is wrong with the words is told in one line, as all bad input is."""
        alone, more["standalone_mode"] = more.get("standalone_mode", True), False
        if not alone:
            return super().main(*args, **more)
        try:
            code = super().main(*args, **more)
        except Exception as err:  # click's, of whichever module it comes from
            if not hasattr(err, "format_message"):
                raise
            if type(err).__name__ == "NoArgsIsHelpError":  # no words at all: the help
                err.show()  # type: ignore[attr-defined]
                sys.exit(2)
            program = getattr(getattr(err, "ctx", None), "command_path", self.name)
            print(f"{program}: {_one_line(err.format_message())}; see {program} --help", file=sys.stderr)
            sys.exit(2)
        sys.exit(code if isinstance(code, int) else 0)


def _one_line(text: str) -> str:
    return " ".join(text.split()).rstrip(".")


def _is_no_file(word: str | None) -> bool:
    return word is None or (word.startswith("-") and word != "-")


def begin(quiet: bool, verbose: bool) -> None:
    """Take note of how much a command says; with `verbose` say what runs."""
    _manner.quiet, _manner.verbose, _manner.json = quiet and not verbose, verbose, False
    _manner.started_s = time.monotonic()
    if verbose:
        from importlib import metadata

        detail(f"augkitti {augkitti.__version__}, Python {platform.python_version()}, {platform.platform()}")
        found = {name: _version(metadata, name) for name in _LIBRARIES}
        detail(", ".join(f"{name} {version or 'is not installed'}" for name, version in found.items()))


def _version(metadata: Any, name: str) -> str | None:
    try:
        return str(metadata.version(name))
    except metadata.PackageNotFoundError:
        return None


def json_alone(wanted: bool) -> None:
    """From here on stdout is for JSON: notes go to stderr."""
    _manner.json = wanted


def is_json() -> bool:
    """Whether the command prints JSON instead of tables."""
    return _manner.json


def is_quiet() -> bool:
    """Whether nothing but errors and what was asked for is wanted."""
    return _manner.quiet


def note(text: str) -> None:
    """A line that a user should see, on stdout; on stderr beside JSON, nowhere with `--quiet`."""
    if not _manner.quiet:
        print(text, file=sys.stderr if _manner.json else sys.stdout, flush=True)


def aside(text: str) -> None:
    """A line on stderr; nowhere with `--quiet`."""
    if not _manner.quiet:
        print(text, file=sys.stderr, flush=True)


def detail(text: str) -> None:
    """A line on stderr with `--verbose`, with the time since the command began."""
    if _manner.verbose:
        print(f"[{time.monotonic() - _manner.started_s:7.2f} s] {text}", file=sys.stderr, flush=True)


def trace() -> None:
    """The traceback of the error in hand, with `--verbose`."""
    if _manner.verbose:
        traceback.print_exc()


def signed(title: str) -> str:
    """A title with the version of the program whose table it stands over."""
    return f"{title} (augkitti {augkitti.__version__})"


def as_json(content: Mapping[str, Any]) -> str:
    """Indented JSON text with the program's version first; null for what is no number."""
    return json.dumps(_finite({"program_version": augkitti.__version__, **content}), indent=1, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_json(content: Mapping[str, Any]) -> None:
    """`as_json` on stdout."""
    sys.stdout.write(as_json(content))


@contextmanager
def progress(total: int | None, what: str) -> Iterator[Callable[[int], None]]:
    """A function to call with how many more are done; shown on stderr with rate and time left.

    On a terminal a bar. Elsewhere a plain line after ten seconds, then every half minute: a log shows that it goes on.
    Within another progress it shows nothing.

    Args:
        total: how many there are; None where that is not known.
        what: their name, in the plural.
    """
    if _manner.quiet or _manner.shows_progress:
        yield lambda done: None
        return
    _manner.shows_progress = True
    try:
        with _bar(total, what) as advance:
            yield advance
    finally:
        _manner.shows_progress = False


@contextmanager
def _bar(total: int | None, what: str) -> Iterator[Callable[[int], None]]:
    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        number = TextColumn("{task.completed:,.0f}" + ("" if total is None else " of {task.total:,.0f}"))
        columns = (TextColumn("{task.description}"), BarColumn(), number, TextColumn("{task.fields[rate]}"))
        with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
            line = bar.add_task(what, total=total, rate="")

            def advance(done: int) -> None:
                bar.advance(line, done)
                speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
                bar.update(line, rate=f"{speed:.1f} {what}/s" if speed else "")

            yield advance
    else:
        plain = _PlainLines(total, what)
        yield plain.advance


def counted(items: Iterable[Item], total: int | None, what: str) -> Iterator[Item]:
    """The items, with `progress` of them."""
    with progress(total, what) as done:
        for item in items:
            yield item
            done(1)


class _PlainLines:
    """Progress as lines, now and then."""

    def __init__(self, total: int | None, what: str) -> None:
        self.total, self.what, self.done = total, what, 0
        self.started_s = time.monotonic()
        self.next_s = self.started_s + _FIRST_LINE_S

    def advance(self, done: int) -> None:
        self.done += done
        now = time.monotonic()
        if now < self.next_s:
            return
        self.next_s = now + _LINE_EVERY_S
        rate = self.done / max(now - self.started_s, 1e-9)
        of = "" if self.total is None else f" of {self.total:,}"
        left = "" if self.total is None or not rate else f", {_duration((self.total - self.done) / rate)} left"
        print(f"{self.done:,}{of} {self.what}, {rate:.2g} a second{left}", file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
