"""`augkitti generate`: checked options in, the three stages one after another, an exit code out.

Each stage can be run alone: `augkitti prepare`, `augment`, `finish`; they hand over through the work folder.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.table import Table

from augkitti.command_line import aside, detail, is_json, is_quiet, note, print_json, signed
from augkitti.dataset_index import INDEX_NAME, ShardEntry
from augkitti.errors import InputError
from pipelines.augment import augment_all
from pipelines.finish import finish_set
from pipelines.lock import hold
from pipelines.plan import ShardPlan
from pipelines.prepare import prepare_all
from pipelines.run import (
    WORK,
    Options,
    Run,
    check_output,
    check_work,
    finished_index,
    load_library,
    open_run,
    reopen_run,
    start_work,
)
from pipelines.shard_row import ShardRow, read_row
from pipelines.stage import check_scheduler, console
from pipelines.streets import Streets, make_streets

# Measured on real scans with real CAD models, seconds of one core; docs/figures.md, "Generation". For --dry-run only.
BYTES_PER_PAIR = 3.0e6
BYTES_PER_PREPARED_SCAN = 0.48e6
BYTES_PER_STREET_SCAN = 2.0e6
_SKIPPED_SHOWN = 8  # rows of the closing table; the index has them all
SECONDS_PER_PAIR = 0.075
SECONDS_PER_PREPARED_SCAN = 0.25
SECONDS_PER_STREET_SCAN = 0.4


def generate(options: Options, jobs: int, resume: bool, dry_run: bool, scheduler: str | None = None) -> int:
    """Run all stages, or print the plan.

    With the address of a Dask scheduler its workers make the shards. Each prepares what it needs itself, for the cache
    need not be one that all of them see.

    Returns:
        0, or 1 where fewer pairs were made than asked for.

    Raises:
        InputError: bad input; before any work, except for sources that turn out unreadable with `--on-error stop`.
        MachineError: the disk, the memory or a worker gave way; `resume` goes on from there.
    """
    if dry_run:
        return show_plan(options, jobs)
    started = time.monotonic()
    detail(f"cache {options.cache}; configuration {options.config.digest()[:12]}; scanner {options.scanner.name}")
    if scheduler is not None:
        check_scheduler(scheduler)
    run = _begin(options, jobs, resume)
    if resume and (made := _already_made(run)) is not None:
        if is_json():
            print_json({"folder": str(options.out), "asked": options.n, "pairs": made, "already_made": True})
        return _shortfall(made, options.n, f"`skipped` in {INDEX_NAME} says why")
    with hold(options.work):
        if scheduler is None:
            _prepare(run, jobs, resume)
        else:
            start_work(run, resume)
        detail("prepared; making shards")
        rows = augment_all(run, jobs, scheduler)
        detail("shards made; writing the index")
        return _close(run, rows, time.monotonic() - started)


def prepare_stage(options: Options, jobs: int, resume: bool) -> None:
    """Check the input, make the streets if need be, begin the work folder, and fill the cache.

    Raises:
        InputError: as `generate`.
    """
    run = _begin(options, jobs, resume)
    if resume and _already_made(run) is not None:
        return
    with hold(options.work):
        _prepare(run, jobs, resume)


def _already_made(run: Run) -> int | None:
    """How many pairs the run's finished and whole data set has, which is told; None if there is something to do."""
    index = finished_index(run)
    if index is None:
        return None
    note(f"{run.options.out} is finished and whole: nothing to do")
    return index.rows


def _begin(options: Options, jobs: int, resume: bool) -> Run:
    """All checks, the first line, and the streets if need be."""
    assert options.models is not None  # bad car models are told before anything is made
    check_output(options.out, resume)
    if options.streets is None:
        run = open_run(options)
        note(_first_line(options))
        _print_notes(run)
        return run
    note(_first_line(options))
    make_streets(options.streets, options.scanner, jobs)
    run = open_run(options)
    _print_notes(run)
    return run


def _print_notes(run: Run) -> None:
    """What a user may not expect of the inputs, a line each."""
    options = run.options
    if options.cad is not None and options.config.cars[1] > 0:
        library = load_library(options.cad, options.config.categories, options.cache)
        left_out = len(library.report) - len(library.models)
        wanted = ", ".join(options.config.categories)
        note(f"car models: {len(library.models)} used ({wanted}), {left_out} not (`augkitti cad check` says why)")
    there = sum(len(sequence.pairs) for sequence in run.sequences.values())
    if options.config.cars[1] == 0 and options.n > there:
        note(f"note: plain pairs do not vary, and there are {there} scan pairs: some are written more than once")


def _prepare(run: Run, jobs: int, resume: bool) -> None:
    start_work(run, resume)
    options = run.options
    made, kept = prepare_all(
        run.sequences,
        run.planned_frames(),
        options.scanner,
        options.config,
        options.cache,
        jobs,
        options.stop_on_error,
    )
    aside(f"prepared: {made} made, {kept} found in {options.cache}")


def augment_stage(out: Path, jobs: int, scheduler: str | None = None) -> None:
    """Make the shards of the plan in `out`'s work folder.

    Raises:
        InputError: there is no plan, or a source is unreadable and the run is to stop there.
    """
    with _reopened(out) as run:
        augment_all(run, jobs, scheduler)


def finish_stage(out: Path) -> int:
    """Write the index and the card.

    Raises:
        InputError: there is no plan, or a shard is unfinished.
    """
    with _reopened(out) as run:
        rows = [read_row(run.options.work, out, shard) for shard in run.shards]
        there = [row for row in rows if row is not None]
        if len(there) < len(rows):
            raise InputError(
                out, f"{len(rows) - len(there)} of {len(rows)} shards are unfinished", "run `augkitti augment`"
            )
        return _close(run, there, None)


@contextmanager
def _reopened(out: Path) -> Iterator[Run]:
    """The unfinished run in a folder, held."""
    check_work(out)
    with hold(out / WORK):
        yield reopen_run(out)


def _close(run: Run, rows: list[ShardRow], seconds: float | None) -> int:
    finish_set(run, rows)
    made = sum(row.pairs for row in rows)
    _print_totals(run, rows, made, seconds)
    return _shortfall(made, run.options.n, "see the reasons above")


def _shortfall(made: int, n: int, why: str) -> int:
    """The exit code of a finished set; says what is wanting."""
    if made < n:
        print(f"short by {n - made} of {n} pairs: {why}", file=sys.stderr)
    return int(made < n)


def _first_line(options: Options) -> str:
    streets = options.streets
    if streets is None:
        return f"source: KITTI at {options.kitti}"
    return (
        f"source: EMBEDDED STREETS, procedural, not real KITTI (no --kitti, no $AUGKITTI_KITTI): "
        f"{streets.drives} street{'s' * (streets.drives > 1)} of seed {streets.seed}, "
        f"{'kept' if streets.are_there else 'to be made'} "
        f"in {streets.folder}"
    )


def _print_totals(run: Run, rows: list[ShardRow], made: int, seconds: float | None) -> None:
    totals: Counter[str] = Counter()
    skipped: Counter[tuple[str, str]] = Counter()
    for entry in run.left_out:
        skipped[entry["source"], entry["reason"]] += entry["count"]
    for row in rows:
        totals.update(row.totals)
        for entry in row.skipped:
            skipped[entry["source"], entry["reason"]] += entry["count"]
    entries = [row.entry for row in rows if row.entry is not None]
    if is_json():
        print_json(_totals_json(run, totals, skipped, entries, made, seconds))
    if is_json() or is_quiet():
        return
    table = Table(title=signed(str(run.options.out)), show_header=False, title_justify="left")
    table.add_row("pairs", f"{made:,} of {run.options.n:,}")
    table.add_row("shards", f"{len(entries):,}, {sum(entry.bytes for entry in entries) / 1e6:,.1f} MB")
    table.add_row("virtual cars", f"{totals['virtual_cars']:,}, {totals['moving_virtual_cars']:,} of them moving")
    table.add_row("points", f"{totals['points']:,}, {totals['simulated_points']:,} of them simulated")
    table.add_row("points hidden by cars", f"{totals['removed_points']:,}")
    if totals["invalid_rows"]:
        table.add_row("rows dropped (NaN or zeros)", f"{totals['invalid_rows']:,}")
    if seconds is not None:
        table.add_row("time", f"{seconds:,.1f} s, {made / max(seconds, 1e-9):.2f} pairs/s")
    for (source, reason), count in skipped.most_common(_SKIPPED_SHOWN):
        table.add_row("skipped", f"{source}: {reason} ({count:,} pairs tried)")
    if len(skipped) > _SKIPPED_SHOWN:
        table.add_row("skipped", f"and {len(skipped) - _SKIPPED_SHOWN:,} more, all in dataset.json")
    console().print(table)


def _totals_json(
    run: Run,
    totals: Counter[str],
    skipped: Counter[tuple[str, str]],
    entries: list[ShardEntry],
    made: int,
    seconds: float | None,
) -> dict[str, Any]:
    """The end report as JSON; the index has all of it but the time."""
    return {
        "folder": str(run.options.out),
        "asked": run.options.n,
        "pairs": made,
        "shards": len(entries),
        "bytes": sum(entry.bytes for entry in entries),
        "totals": dict(sorted(totals.items())),
        "skipped": [{"source": s, "reason": r, "count": count} for (s, r), count in skipped.most_common()],
        "seconds": None if seconds is None else round(seconds, 3),
    }


def show_plan(options: Options, jobs: int) -> int:
    """Print what a run would make, with disk and time; touches nothing."""
    assert options.models is not None
    check_output(options.out, resume=True)
    note(_first_line(options))
    streets = options.streets
    if streets is not None and not streets.are_there:
        scans = streets.drives * streets.frames
        _print_estimate(options.n, scans, jobs, streets, {})
        return 0
    run = open_run(options)
    table = Table("sequence", "scan pairs", "pairs to make", "shards", title=signed("plan"), title_justify="left")
    of_sequence: dict[str, list[ShardPlan]] = {}
    quotas: dict[str, int] = {}
    for shard in run.shards:
        of_sequence.setdefault(shard.sequence, []).append(shard)
    for name, shards in of_sequence.items():
        quota = quotas[name] = sum(shard.quota for shard in shards)
        table.add_row(name, f"{len(run.sequences[name].pairs):,}", f"{quota:,}", f"{len(shards):,}")
    if not is_json():
        console().print(table)
    for entry in run.left_out:
        note(f"left out: {entry['source']}: {entry['reason']} ({entry['count']} pairs)")
    scans = sum(len({*frames, *(f + 1 for f in frames)}) for frames in run.planned_frames().values())
    _print_estimate(options.n, scans, jobs, None, quotas)
    return 0


def _print_estimate(n: int, scans: int, jobs: int, streets: Streets | None, quotas: dict[str, int]) -> None:
    seconds = n * SECONDS_PER_PAIR + scans * SECONDS_PER_PREPARED_SCAN
    cache = scans * BYTES_PER_PREPARED_SCAN
    if streets is not None:
        seconds += scans * SECONDS_PER_STREET_SCAN
        cache += scans * BYTES_PER_STREET_SCAN
    if is_json():
        about = {"bytes": n * BYTES_PER_PAIR, "cache_bytes": cache, "seconds": seconds / jobs}
        print_json({"pairs": n, "scans": scans, "sequences": quotas, "about": about})
        return
    print(
        f"{n:,} pairs of {scans:,} scans: about {n * BYTES_PER_PAIR / 1e9:,.2f} GB on disk, {cache / 1e9:,.2f} GB in "
        f"the cache, {_duration(seconds / jobs)} with --jobs {jobs} (spares not counted; nothing was written)"
    )


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
