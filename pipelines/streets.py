"""The embedded default: a number of pairs and a seed in, procedural streets in KITTI's layout out, kept in the cache.

A street is a short drive of its own, so that even a few pairs come from different places; street k of a seed is the
same however many there are.
"""

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import augkitti
from augkitti.errors import InputError
from augkitti.scanner import ScannerProfile

PAIRS_PER_STREET = 5  # the most; issue: at least one street for ten pairs


@dataclass(frozen=True)
class Streets:
    """Which streets, and where they are kept."""

    folder: Path
    digest: str  # of all that they are drawn from
    drives: int
    frames: int
    seed: int

    def as_source(self) -> dict[str, Any]:
        """What `dataset.json` says of them: enough to make them again."""
        return {
            "kind": "embedded",
            "digest": self.digest,
            "drives": self.drives,
            "frames": self.frames,
            "seed": self.seed,
        }

    @property
    def are_there(self) -> bool:
        """Whether they have been made."""
        return self.folder.is_dir()


def find_streets(n: int, seed: int, profile: ScannerProfile, cache: Path) -> Streets:
    """The streets for n pairs; made or not yet."""
    drives, frames = -(-n // PAIRS_PER_STREET), PAIRS_PER_STREET + 1
    recipe = [augkitti.__version__, profile.digest, drives, frames, seed]
    digest = hashlib.sha256(json.dumps(recipe).encode()).hexdigest()
    return Streets(cache / "streets" / digest[:16], digest, drives, frames, seed)


def make_streets(streets: Streets, profile: ScannerProfile, jobs: int) -> None:
    """Scan the streets into the cache, unless they are there; they appear whole or not at all.

    Raises:
        InputError: the cache cannot be written.
    """
    if streets.are_there:
        return
    from augkitti.synthesize import synthesize

    unfinished = streets.folder.parent / f".{streets.folder.name}.{os.getpid()}.{uuid4().hex[:8]}"
    try:
        streets.folder.parent.mkdir(parents=True, exist_ok=True)
        synthesize(unfinished, streets.drives, streets.frames, streets.seed, profile, jobs)
        if not streets.are_there:
            os.replace(unfinished, streets.folder)
    except OSError as err:
        if not streets.are_there:  # another run may have been faster
            raise InputError(streets.folder, f"cannot be written ({err.strerror})", "set AUGKITTI_CACHE") from err
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
