"""A finished shard's row: what `finish` needs to know of a shard without reading it, kept in the work folder."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from augkitti.dataset_index import ShardEntry, file_sha256, write_text
from pipelines.plan import ShardPlan


@dataclass(frozen=True)
class ShardRow:
    """What became of one shard of the plan."""

    shard: ShardPlan
    entry: ShardEntry | None  # None where not one pair could be made
    totals: dict[str, int]
    skipped: tuple[dict[str, Any], ...]  # source, reason, count

    @property
    def pairs(self) -> int:
        """Pairs that were made."""
        return 0 if self.entry is None else self.entry.rows


def write_row(work: Path, row: ShardRow) -> None:
    """Write the row; the shard counts as finished from here on."""
    write_text(_path(work, row.shard), json.dumps(asdict(row), indent=1, sort_keys=True))


def read_row(work: Path, out: Path, shard: ShardPlan) -> ShardRow | None:
    """The row of a finished shard; None where it is unfinished, of another plan, or its file has changed."""
    try:
        content = json.loads(_path(work, shard).read_text(encoding="utf-8"))
        entry = None if content["entry"] is None else ShardEntry(**content["entry"])
        row = ShardRow(ShardPlan(**content["shard"]), entry, dict(content["totals"]), tuple(content["skipped"]))
        if row.shard != shard or (entry is not None and file_sha256(out / entry.path) != entry.sha256):
            return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return row


def _path(work: Path, shard: ShardPlan) -> Path:
    return work / "rows" / f"{shard.name}.json"
