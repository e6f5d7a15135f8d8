"""The embedded default: a number of pairs and a seed in, procedural streets in KITTI's layout out, kept in the cache.

A street is a short drive of its own, so that even a few pairs come from different places; street k of a seed is the
same however many there are.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from augkitti.command_line import progress
from augkitti.errors import InputError
from augkitti.kept_folder import is_whole, put_folder
from augkitti.scanner import ScannerProfile

PAIRS_PER_STREET = 5  # the most; half of what would do, for a split of 20 pairs by recording needs three streets


@dataclass(frozen=True)
class Streets:
    """Which streets, and where they are kept."""

    folder: Path
    digest: str  # of all that they are drawn from
    drives: int
    frames: int
    seed: int

    @property
    def are_there(self) -> bool:
        """Whether they have been made, and no file was lost, cut or written over since."""
        return is_whole(self.folder)

    def as_source(self) -> dict[str, Any]:
        """What `dataset.json` says of them: enough to make them again."""
        return {
            "kind": "embedded",
            "digest": self.digest,
            "drives": self.drives,
            "frames": self.frames,
            "seed": self.seed,
        }


def find_streets(n: int, seed: int, profile: ScannerProfile, cache: Path) -> Streets:
    """The streets for n pairs; made or not yet."""
    return _streets(-(-n // PAIRS_PER_STREET), PAIRS_PER_STREET + 1, seed, profile, cache)


def streets_of(source: Mapping[str, Any], profile: ScannerProfile, cache: Path) -> Streets:
    """The streets that a data set was made from.

    Args:
        source: the `source` of its `dataset.json`.
        profile: the scanner profile in its shards.
        cache: where streets are kept.

    Raises:
        InputError: this program draws others from the same numbers, or they are no numbers.
    """
    try:
        streets = _streets(int(source["drives"]), int(source["frames"]), int(source["seed"]), profile, cache)
    except (KeyError, TypeError, ValueError) as err:
        raise InputError("dataset.json", "does not say which streets it was made from", "give --kitti") from err
    if streets.digest != source.get("digest"):
        raise InputError("dataset.json", "was made from streets of another program version", "use that version")
    return streets


def make_streets(streets: Streets, profile: ScannerProfile, jobs: int) -> None:
    """Scan the streets into the cache, unless they are there; they appear whole or not at all.

    Raises:
        InputError: the cache cannot be written.
    """
    if streets.are_there:
        with suppress(OSError):  # a cache that may only be read serves as well
            os.utime(streets.folder)  # used now: not taken from under the run
        return
    from augkitti.synthesize import synthesize

    above = streets.folder.parent
    try:
        above.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{streets.folder.name}.part-", dir=above) as part:
            with progress(streets.drives, "streets") as done:
                made = Path(part) / "made"
                synthesize(made, streets.drives, streets.frames, streets.seed, profile, jobs, done)
            put_folder(Path(part) / "made", streets.folder)
    except OSError as err:
        raise InputError(streets.folder, f"cannot be written ({err.strerror})", "set AUGKITTI_CACHE") from err
    except InputError as err:
        raise InputError(streets.folder, err.problem, "make room, or set AUGKITTI_CACHE") from err


def _streets(drives: int, frames: int, seed: int, profile: ScannerProfile, cache: Path) -> Streets:
    from augkitti.synthesize import street_digest

    digest = street_digest(drives, frames, seed, profile)
    return Streets(cache / "streets" / digest[:16], digest, drives, frames, seed)
