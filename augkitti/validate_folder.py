"""A whole data set against the contract: a folder, and the KITTI root it came from, in; a report out.

Every pair of every shard goes through `validate.validate_pair`; index, splits, metadata and the folder itself are
compared with each other. Shards are looked at in parallel.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.config import Config, GroundConfig
from augkitti.dataset_index import (
    CARD_NAME,
    DATA_NAME,
    INDEX_NAME,
    SPLITS_NAME,
    DatasetIndex,
    ShardEntry,
    file_sha256,
    read_index,
)
from augkitti.errors import InputError
from augkitti.ground import fit_ground
from augkitti.kitti import KittiRoot, open_root, read_scan_rows
from augkitti.remote import as_path
from augkitti.scan_pair import AugmentedPair
from augkitti.shards import open_shard, read_pairs
from augkitti.splits import check_splits, read_splits
from augkitti.validate import CHECKS, TITLES, Offence, Rules, Source, rules_of, validate_pair

FOLDER = 0  # the number under which offences of the folder itself are counted
_FIRST = 20  # offences of each invariant that the report names
_NO_RERUN = "a folder alone cannot show it: generate again with the same seed and compare the bytes"


@dataclass(frozen=True)
class Finding:
    """What one shard's pairs came to."""

    pair_ids: tuple[str, ...]
    offences: tuple[Offence, ...]
    unchecked: tuple[tuple[str, int], ...]  # why pairs were looked at without their source, and how many
    digests: tuple[tuple[str, str], ...]  # of configuration, profile and models, by name


@dataclass(frozen=True)
class Report:
    """What validation found."""

    pairs: int
    shards: int
    checked: dict[int, int]  # pairs that each invariant was checked on, in full
    unchecked: dict[int, str]  # why it was not, or not in full, on the others
    counts: dict[int, int]  # offences by invariant; 0 for the folder's own rules
    first: tuple[Offence, ...]  # the first of each invariant

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.counts

    def as_json(self) -> dict[str, Any]:
        """For `--json`; keys are strings."""
        return {
            "ok": self.ok,
            "pairs": self.pairs,
            "shards": self.shards,
            "invariants": {
                str(number): {
                    "title": title,
                    "pairs_checked": self.checked.get(number, 0),
                    "unchecked": self.unchecked.get(number),
                    "offences": self.counts.get(number, 0),
                }
                for number, title in TITLES.items()
            },
            "folder_offences": self.counts.get(FOLDER, 0),
            "first": [asdict(offence) for offence in self.first],
        }


def validate_folder(
    folder: Path | str,
    kitti_root: Path | str | None = None,
    jobs: int = 1,
    on_pairs: Callable[[int], None] | None = None,
) -> Report:
    """Check every invariant on every pair of a finished data set, and the folder itself.

    Args:
        folder: made by `augkitti generate`.
        kitti_root: where the source scans lie; None: what needs them is left out, and the report says so.
        jobs: number of processes.
        on_pairs: told how many more pairs are checked, a shard at a time.

    Raises:
        InputError: the folder has no readable index, or the root holds no KITTI scans.
    """
    from joblib import Parallel, delayed

    folder = as_path(folder)
    index = read_index(folder)
    root = None if kitti_root is None else as_path(kitti_root)
    if root is not None:
        open_root(root)  # a wrong root is answered before any work
    run = Parallel(n_jobs=max(1, min(jobs, len(index.shards))), batch_size=1, return_as="generator")
    findings = []
    for shard, finding in zip(
        index.shards, run(delayed(validate_shard)(folder, shard, root) for shard in index.shards), strict=True
    ):
        findings.append(finding)
        if on_pairs is not None:
            on_pairs(shard.rows)
    return make_report(folder, index, findings, root is not None)


def validate_shard(folder: Path, shard: ShardEntry, kitti_root: Path | None) -> Finding:
    """Check one shard: its file against the index, its metadata, and each of its pairs."""
    path = folder / shard.path
    offences = list(_file_offences(path, shard))
    try:
        file, metadata = open_shard(path)
        groups, rows = file.num_row_groups, file.metadata.num_rows
        file.close()
        rules = rules_of(metadata, shard.path)
    except InputError as err:
        return Finding((), (*offences, _of_file(shard, err.problem)), (), ())
    if (groups, rows) != (shard.rows, shard.rows):
        offences.append(_of_file(shard, f"has {rows} rows in {groups} row groups, the index says {shard.rows}"))
    offences += _metadata_offences(shard, metadata)
    sources = _Sources(kitti_root, metadata)
    names: list[str] = []
    unchecked: Counter[str] = Counter()
    for row in range(groups):
        try:
            pair = next(read_pairs(path, [row]))
        except InputError as err:
            offences.append(Offence(f"{shard.path}, row {row}", 1, "row", str(row), err.problem))
            continue
        names.append(pair.pair_id)
        if (pair.sequence, pair.recording) != (shard.sequence, shard.recording):
            said = f"the index says {shard.sequence} of {shard.recording}"
            offences.append(Offence(pair.pair_id, FOLDER, "sequence", f"{pair.sequence} of {pair.recording}", said))
        try:
            source = sources.of(pair)
        except InputError as err:
            source = None
            unchecked[err.problem] += 1
        offences += _pair_offences(pair, rules, source)
    digests = {
        "configuration_digest": str(metadata.get("configuration_digest")),
        "scanner_profile_digest": str(metadata.get("scanner_profile_digest")),
        "program_version": str(metadata.get("program_version")),
        "cad_models": json.dumps(metadata.get("cad_models"), sort_keys=True),
    }
    return Finding(tuple(names), tuple(offences), tuple(sorted(unchecked.items())), tuple(digests.items()))


def make_report(folder: Path, index: DatasetIndex, findings: Sequence[Finding], with_sources: bool) -> Report:
    """The findings of all shards, and what the folder as a whole breaks."""
    offences = [*_folder_offences(folder, index), *_across_shards(index, findings)]
    offences += [offence for finding in findings for offence in finding.offences]
    pairs = sum(len(finding.pair_ids) for finding in findings)
    without = Counter[str]()
    for finding in findings:
        without.update(dict(finding.unchecked))
    missed = sum(without.values()) if with_sources else pairs
    why = "; ".join(f"{reason} ({count} pairs)" for reason, count in sorted(without.items()))
    if not with_sources:
        why = "needs the source scans (--kitti)"
    checked = dict.fromkeys(CHECKS, pairs)
    unchecked: dict[int, str] = {11: _NO_RERUN}
    if missed:
        for number, part in _NEEDS_SOURCE.items():
            checked[number] = pairs - missed
            unchecked[number] = f"{part}{why}"
    counts = Counter(offence.invariant for offence in offences)
    first = [
        offence
        for number in sorted(counts)
        for offence in [one for one in offences if one.invariant == number][:_FIRST]
    ]
    return Report(pairs, len(index.shards), checked, unchecked, dict(sorted(counts.items())), tuple(first))


_NEEDS_SOURCE = {
    2: "",
    3: "that no row is missing: ",
    8: "that removed rows lie behind a car: ",
    10: "",
}


class _Sources:
    """The source scans of a shard's pairs; neighbouring pairs share scans, so the last two are kept."""

    def __init__(self, root: Path | None, metadata: dict[str, Any]) -> None:
        self.root = root
        try:
            self.ground = Config.model_validate(metadata["configuration"]).ground
        except ValueError:  # of another program version: the contract's ground is that of this one
            self.ground = GroundConfig()
        self.kept: dict[tuple[str, int], Any] = {}
        self.opened: KittiRoot | None = None

    def of(self, pair: AugmentedPair) -> Source | None:
        """The pair's source; None where no root was given.

        Raises:
            InputError: the root lacks it, or it is unreadable.
        """
        if self.root is None:
            return None
        before, self.kept = self.kept, {}
        for frame in (pair.frame0, pair.frame1):
            key = (pair.sequence, frame)
            self.kept[key] = before[key] if key in before else self._read(*key)
        (rows0, ground0), (rows1, ground1) = (self.kept[pair.sequence, f] for f in (pair.frame0, pair.frame1))
        return Source(rows0, rows1, ground0, ground1)

    def _read(self, sequence: str, frame: int) -> tuple[Any, Any]:
        assert self.root is not None
        if self.opened is None:
            self.opened = open_root(self.root)
        rows = read_scan_rows(self.opened.sequence(sequence).scan_path(frame))
        valid = np.isfinite(rows).all(axis=1) & (rows != 0.0).any(axis=1)
        return rows, fit_ground(np.ascontiguousarray(rows[valid, :3]), self.ground)


def _pair_offences(pair: AugmentedPair, rules: Rules, source: Source | None) -> list[Offence]:
    try:
        return validate_pair(pair, rules, source)
    except (ValueError, IndexError, ArithmeticError) as err:  # a breach so bad that a check could not be made
        return [Offence(pair.pair_id, 1, "row", "", f"is too broken to be checked ({type(err).__name__}: {err})")]


def _file_offences(path: Path, shard: ShardEntry) -> Iterable[Offence]:
    if not path.is_file():
        return  # said when it is opened
    size = path.stat().st_size
    if size != shard.bytes:
        yield _of_file(shard, f"has {size} bytes, the index says {shard.bytes}")
    digest = file_sha256(path)
    if digest != shard.sha256:
        yield _of_file(shard, f"has sha256 {digest[:16]}..., the index says {shard.sha256[:16]}...")


def _of_file(shard: ShardEntry, message: str) -> Offence:
    return Offence(shard.path, FOLDER, "file", "", message)


def _metadata_offences(shard: ShardEntry, metadata: dict[str, Any]) -> Iterable[Offence]:
    for name in ("configuration", "scanner_profile"):
        text = json.dumps(metadata.get(name), sort_keys=True)
        if metadata.get(f"{name}_digest") != hashlib.sha256(text.encode()).hexdigest():
            said = str(metadata.get(f"{name}_digest"))
            yield Offence(shard.path, FOLDER, f"{name}_digest", said, f"is not the sha256 of `{name}`")


def _across_shards(index: DatasetIndex, findings: Sequence[Finding]) -> Iterable[Offence]:
    times = Counter(name for finding in findings for name in finding.pair_ids)
    for name, count in sorted(times.items()):
        if count > 1:
            yield Offence(name, FOLDER, "pair_id", name, f"stands {count} times in the data set")
    expected = {"configuration_digest": index.configuration_digest, "program_version": index.program_version}
    for shard, finding in zip(index.shards, findings, strict=True):
        for name, value in finding.digests:
            if expected.setdefault(name, value) != value:
                message = "differs from the index" if name in _IN_INDEX else "differs from the first shard's"
                yield Offence(shard.path, FOLDER, name, value[:80], message)


_IN_INDEX = ("configuration_digest", "program_version")


def _folder_offences(folder: Path, index: DatasetIndex) -> Iterable[Offence]:
    listed = {shard.path for shard in index.shards}
    allowed = {*listed, INDEX_NAME, SPLITS_NAME, CARD_NAME}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name not in allowed and not (path.is_dir() and name == DATA_NAME):
            yield Offence(name, FOLDER, "file", "", "does not belong in a finished folder")
    if not (folder / CARD_NAME).is_file():
        yield Offence(CARD_NAME, FOLDER, "file", "", "is missing")
    if len(listed) != len(index.shards):
        yield Offence(INDEX_NAME, FOLDER, "shards", str(len(index.shards)), "name a file twice")
    text = json.dumps(index.configuration, sort_keys=True)
    if index.configuration_digest != hashlib.sha256(text.encode()).hexdigest():
        message = "is not the sha256 of `configuration`"
        yield Offence(INDEX_NAME, FOLDER, "configuration_digest", index.configuration_digest, message)
    for name, value in (("pairs", index.rows), ("shards", len(index.shards))):
        if index.totals.get(name) != value:
            yield Offence(INDEX_NAME, FOLDER, f"totals.{name}", str(index.totals.get(name)), f"the shards make {value}")
    if (folder / SPLITS_NAME).exists():
        try:
            problems = check_splits(index, read_splits(folder / SPLITS_NAME))
        except InputError as err:
            problems = [err.problem]
        for problem in problems:
            yield Offence(SPLITS_NAME, FOLDER, "splits", "", problem)
