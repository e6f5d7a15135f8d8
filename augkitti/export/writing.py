"""The loop of every export: pairs in, one after another, their files on disk and a journal of them out.

    OUT/augkitti-export.json   what this export is, and whether it is finished
    OUT/augkitti-pairs.jsonl   a line a pair: its number, name, scene, the nanoseconds and the files with their bytes

A file is written in `OUT/.augkitti-export`, brought to the disk and then moved to its name, and its pair enters the
journal when all of its files are there. A pair counts as done while they all have the sizes in its line: what a killed
run left half, or somebody cut or removed, is made again, and nothing else is.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from augkitti import __version__
from augkitti.config import GroundConfig
from augkitti.dataset import Dataset
from augkitti.dataset_index import read_json
from augkitti.errors import InputError, MachineError
from augkitti.export.target import Done, Format, Scene, nanoseconds, scene_name
from augkitti.remote import is_remote
from augkitti.scanner import ScannerProfile
from augkitti.shards import CONTRACT_VERSION, read_pairs

EXPORT_NAME, PAIRS_NAME, WORK = "augkitti-export.json", "augkitti-pairs.jsonl", ".augkitti-export"
ALL = "all"  # the part's name where no split was asked for


@dataclass(frozen=True)
class Export:
    """An export that may go on: which pairs of it are there."""

    out: Path
    form: Format
    part: str
    identity: dict[str, Any]
    done: dict[int, Done]  # by number
    pairs: int  # in all
    finished: bool  # all pairs, and the files over all of them

    @property
    def left(self) -> int:
        """How many pairs are to be made."""
        return self.pairs - len(self.done)


def open_export(dataset: Dataset, form: Format, out: Path, split: str | None) -> Export:
    """See what of an export is there already; touches nothing.

    Args:
        dataset: the pairs, all of the set or of `split`.
        form: what to write.
        out: a local folder: new, empty, or of the same export.
        split: the name that `dataset` was opened with.

    Raises:
        InputError: a package is missing, the data set is empty, or the folder holds something else.
    """
    if form.module is not None and find_spec(form.module) is None:
        raise InputError(f"--format {form.name}", f"needs {form.module}", 'pip install "augkitti[export]"')
    if is_remote(out):
        raise InputError(out, "is no local folder", "export to a local folder, and copy that")
    if not len(dataset):
        raise InputError(dataset.folder, "holds no pair to export", "generate some, or name another split")
    identity = _identity(dataset, form, split)
    state = out / EXPORT_NAME
    if state.is_file():
        found = read_json(state)
        different = [name for name, value in identity.items() if found.get(name) != value]
        if different:
            said = ", ".join(f"{name} {found.get(name)!r}" for name in different)
            raise InputError(out, f"holds another export ({said})", "name another --out")
        done = {one.number: one for one in _journal(out) if _is_whole(out, one)}
        finished = found.get("finished") is True and len(done) == len(dataset)
    else:
        _check_empty(out)
        done, finished = {}, False
    return Export(out, form, split or ALL, identity, done, len(dataset), finished)


def export_pairs(dataset: Dataset, export: Export, ground: GroundConfig, profile: ScannerProfile) -> Iterator[Done]:
    """Make what is left of an export, pair by pair; holds one pair at a time.

    Args:
        dataset: as `open_export` was given it.
        export: from there. A finished one is left as it is.
        ground: bounds and cells by which points are taken for ground.
        profile: of the scanner, for moments of firing.

    Yields:
        Each pair when all of its files are on the disk.

    Raises:
        InputError: a shard is damaged.
        MachineError: the disk refuses.
    """
    if export.finished:
        return
    out, form = export.out, export.form
    try:
        (out / WORK).mkdir(parents=True, exist_ok=True)
        for stale in (out / WORK).glob("*.part"):
            stale.unlink()
        _put(out, {EXPORT_NAME: _state(export.identity, finished=False)})
        done = dict(export.done)
        with (out / PAIRS_NAME).open("ab", buffering=0) as journal:
            journal.write(b"\n")  # ends a line that a killed run left half
            number = 0
            for shard in dataset.shards:
                rows = [row for row in range(shard.rows) if number + row not in done]
                pairs = read_pairs(dataset.folder / shard.path, rows) if rows else iter(())
                for row, pair in zip(rows, pairs, strict=True):
                    scene = Scene(number + row, export.part, ground, profile)
                    sizes = _put(out, form.files(pair, scene))
                    one = Done(scene.number, pair.pair_id, scene_name(pair), nanoseconds(pair), sizes)
                    journal.write(_line(one))
                    done[one.number] = one
                    yield one
                number += shard.rows
        in_order = [done[number] for number in sorted(done)]
        _put(out, form.closing(in_order))
        _put(out, {PAIRS_NAME: b"".join(map(_line, in_order))})
        _put(out, {EXPORT_NAME: _state(export.identity, finished=True)})
    except OSError as err:
        problem = f"cannot be written ({err.strerror or err})"
        raise MachineError(out, problem, "make room; the same command goes on from there") from err


def _put(out: Path, files: Mapping[str, bytes]) -> dict[str, int]:
    """Write files so that each is there whole or not at all; their sizes."""
    part = out / WORK / "next.part"
    for name, content in files.items():
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        place = out / name
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(part, place)
    return {name: len(content) for name, content in files.items()}


def _line(one: Done) -> bytes:
    return json.dumps(asdict(one), separators=(",", ":")).encode() + b"\n"


def _journal(out: Path) -> Iterator[Done]:
    """What the journal says; lines that a killed run left half are passed over."""
    try:
        lines = (out / PAIRS_NAME).read_bytes().splitlines()
    except OSError:
        return
    for line in lines:
        try:
            row = json.loads(line)
            first, second = row["nanoseconds"]
            files = {str(name): int(size) for name, size in row["files"].items()}
            yield Done(int(row["number"]), str(row["pair_id"]), str(row["scene"]), (int(first), int(second)), files)
        except (ValueError, TypeError, KeyError, AttributeError):
            continue


def _is_whole(out: Path, one: Done) -> bool:
    try:
        return bool(one.files) and all((out / name).stat().st_size == size for name, size in one.files.items())
    except OSError:
        return False


def _state(identity: Mapping[str, Any], finished: bool) -> bytes:
    return json.dumps({**identity, "finished": finished}, indent=1).encode() + b"\n"


def _identity(dataset: Dataset, form: Format, split: str | None) -> dict[str, Any]:
    """What has to be the same for an export to go on."""
    shards = json.dumps([[shard.path, shard.rows, shard.sha256] for shard in dataset.shards])
    return {
        "format": form.name,
        "split": split or ALL,
        "pairs": len(dataset),
        "shards": hashlib.sha256(shards.encode()).hexdigest(),
        "contract": CONTRACT_VERSION,
        "program_version": __version__,
        "licence": dataset.index.licence,
    }


def _check_empty(out: Path) -> None:
    try:
        other = next((path.name for path in out.iterdir() if path.name != WORK), None) if out.exists() else None
    except OSError as err:
        raise InputError(out, f"is no folder ({err.strerror})", "name another --out") from err
    if other is not None:
        raise InputError(out, f"is not empty (`{other}`), and is no export", "name a new folder")
