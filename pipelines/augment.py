"""Stage 2, per shard: a shard's plan in, one Parquet file and a row about it out.

Reads: the plan, the source's scans and drive files, the cache of `prepare`, the car models.
Writes: `OUT/data/<shard>.parquet` (temporary file, then rename) and `OUT/.augkitti-work/rows/<shard>.json` after it. A
shard whose row and file match the plan is kept. A shard depends on configuration, seed and its own scans alone.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path

import numpy as np

from augkitti.augmentation import augment_pair
from augkitti.dataset_index import INDEX_NAME, shard_entry
from augkitti.errors import InputError, MachineError
from augkitti.kitti import Sequence
from augkitti.scan_pair import MEASURED, AugmentedPair, PreparedScan
from augkitti.shards import shard_metadata, write_shard
from pipelines.cache import trim
from pipelines.plan import Candidate, ShardPlan, stream
from pipelines.prepare import prepared_pair
from pipelines.run import Options, Run, skip_entry
from pipelines.shard_row import ShardRow, read_row, write_row
from pipelines.stage import run_tasks

TRIM_EVERY = 100  # shards between two looks at the size of the cache
NO_ROOM = "no virtual car found room"


def augment_all(run: Run, jobs: int, scheduler: str | None = None) -> list[ShardRow]:
    """Make every shard of the plan that is not there yet; the rows of all, by shard.

    Raises:
        InputError: a source is unreadable and the run is to stop there.
        MachineError: the output or the cache cannot be written, or a worker died.
    """
    items = [(shard, run.sequences[shard.sequence]) for shard in run.shards]
    task = partial(augment_shard, options=run.options)
    rows = []
    for row in run_tasks(task, items, jobs, "pairs", lambda item: item[0].quota, scheduler):
        rows.append(row)
        if len(rows) % TRIM_EVERY == 0:
            trim(run.options.cache)
    trim(run.options.cache)
    return sorted(rows, key=lambda row: row.shard.name)


def augment_shard(item: tuple[ShardPlan, Sequence], options: Options) -> ShardRow:
    """Make one shard, unless it is there.

    Raises:
        InputError: a source is unreadable and the run is to stop there.
        MachineError: the output or the cache cannot be written, or memory is short.
    """
    shard, sequence = item
    done = read_row(options.work, options.out, shard)
    if done is not None:
        return done
    totals: Counter[str] = Counter()
    skipped: Counter[tuple[str, str]] = Counter()
    path = options.out / "data" / f"{shard.name}.parquet"
    try:
        options.work.stat()  # gone with the output folder: nothing is made in its place
        if path.exists():  # of a run that was cut off before it wrote the row
            path.unlink()
        pairs = _pairs(shard, sequence, options, totals, skipped)
        first = next(pairs, None)
        entry = None
        if first is not None:
            metadata = shard_metadata(options.config, options.scanner, options.models)
            rows = write_shard(path, chain([first], pairs), metadata)
            entry = shard_entry(options.out, path, sequence.name, sequence.recording, rows)
        row = ShardRow(
            shard=shard,
            entry=entry,
            totals=dict(sorted(totals.items())),
            skipped=tuple({"source": s, "reason": r, "count": c} for (s, r), c in sorted(skipped.items())),
        )
        write_row(options.work, row)
    except OSError as err:
        if not options.work.is_dir():
            _take_back(path, options)
            problem = "the output folder was removed under the run"
            raise MachineError(options.out, problem, "start it again, with --resume") from err
        problem = f"cannot be written ({err.strerror or err})"
        raise MachineError(path, problem, "make room, then go on with --resume") from err
    except MemoryError as err:
        raise MachineError(path, "memory ran out", "use fewer --jobs, then go on with --resume") from err
    return row


def _take_back(path: Path, options: Options) -> None:
    """Remove what was written after the output folder had gone: a folder without a work folder is nobody's run.

    A finished data set is left as it is: the shard was made twice, and the run did not wait for this one.
    """
    if (options.out / INDEX_NAME).is_file():
        return
    with suppress(OSError):
        path.unlink(missing_ok=True)
        path.parent.rmdir()
        options.out.rmdir()


def _pairs(
    shard: ShardPlan,
    sequence: Sequence,
    options: Options,
    totals: Counter[str],
    skipped: Counter[tuple[str, str]],
) -> Iterator[AugmentedPair]:
    """The shard's pairs as they are made; counts what is in them and what was skipped on the way.

    They are the first of the stream that can be made: as many candidates as are wanting are tried in the order of their
    frames, since neighbouring pairs share a scan, then as many as are still wanting.
    """
    candidates = stream(shard, tuple(first for first, _ in sequence.pairs), options.seed)
    while batch := sorted(islice(candidates, shard.quota - totals["pairs"]), key=attrgetter("frame0")):
        yield from _made(batch, sequence, options, totals, skipped)


def _made(
    batch: list[Candidate],
    sequence: Sequence,
    options: Options,
    totals: Counter[str],
    skipped: Counter[tuple[str, str]],
) -> Iterator[AugmentedPair]:
    """Those of a few candidates that can be made."""
    for candidate in batch:
        try:
            made = make_pair(sequence, candidate, options)
        except InputError as err:
            if options.stop_on_error:
                raise
            entry = skip_entry(err, options.root, 1)
            skipped[entry["source"], entry["reason"]] += 1
            continue
        if made is None:
            skipped[sequence.name, NO_ROOM] += 1
            continue
        pair, scans = made
        totals.update(_count(pair, scans))
        yield pair


def make_pair(
    sequence: Sequence, candidate: Candidate, options: Options
) -> tuple[AugmentedPair, tuple[PreparedScan, PreparedScan]] | None:
    """One pair with its cars, and its prepared scans; None where the cars found no room.

    Raises:
        InputError: a source of the pair is unreadable.
    """
    config, profile = options.config, options.scanner
    pair, prepared, _ = prepared_pair(sequence, candidate.frame0, profile, config, options.cache)
    augmented = augment_pair(pair, options.models, profile, config, candidate.seed, candidate.pair_id, prepared)
    return None if augmented is None else (augmented, (prepared.scan0, prepared.scan1))


def _count(pair: AugmentedPair, scans: tuple[PreparedScan, PreparedScan]) -> dict[str, int]:
    """What a pair adds to the totals of the data set."""
    virtual = [item for item in pair.objects if item.origin == "virtual"]
    moving = sum(item.speed is not None and abs(item.speed) > 0.0 for item in virtual)
    both = (pair.scan0, pair.scan1)
    return {
        "pairs": 1,
        "virtual_cars": len(virtual),
        "moving_virtual_cars": moving,
        "labelled_objects": len(pair.objects) - len(virtual),
        "points": sum(len(scan) for scan in both),
        "simulated_points": sum(int(np.count_nonzero(scan.surface != MEASURED)) for scan in both),
        "removed_points": sum(len(scan.removed) for scan in both),
        "invalid_rows": sum(p.scan.rows_in_file - len(p.scan) for p in scans),
    }
