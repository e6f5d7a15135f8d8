"""Stage 3: the rows of all shards in, `dataset.json` and `README.md` out.

Reads: the plan and `OUT/.augkitti-work/rows/`. Writes: the card, then the index, last; takes away what a cut-off run
may have left in `OUT/data`, and the work folder.
"""

from collections import Counter
from collections.abc import Sequence

from augkitti.dataset_index import (
    DATA_NAME,
    KITTI_LICENCE,
    SPLITS_NAME,
    STREET_LICENCE,
    make_index,
    write_card,
    write_index,
)
from augkitti.errors import MachineError
from pipelines.run import Run, end_work
from pipelines.shard_row import ShardRow


def finish_set(run: Run, rows: Sequence[ShardRow]) -> None:
    """Write the index and the card of a run whose shards are all done.

    Raises:
        MachineError: the disk refuses.
    """
    options = run.options
    entries = [row.entry for row in rows if row.entry is not None]
    totals: Counter[str] = Counter()
    skipped: Counter[tuple[str, str]] = Counter()
    for row in rows:
        totals.update(row.totals)
    for entry in (*run.left_out, *(entry for row in rows for entry in row.skipped)):
        skipped[entry["source"], entry["reason"]] += entry["count"]
    short = options.n - sum(row.pairs for row in rows)
    if short:  # so that --resume knows how many were asked for
        totals["pairs_short"] = short
    streets = options.streets
    index = make_index(
        config=options.config,
        seed=options.seed,
        shards=entries,
        totals=dict(sorted(totals.items())),
        skipped=[{"source": s, "reason": r, "count": c} for (s, r), c in sorted(skipped.items())],
        licence=KITTI_LICENCE if streets is None else STREET_LICENCE,
        source={"kind": "kitti"} if streets is None else streets.as_source(),
    )
    try:
        known = {options.out / entry.path for entry in entries}
        for path in sorted((options.out / DATA_NAME).iterdir()):
            if path not in known:
                path.unlink()
        (options.out / SPLITS_NAME).unlink(missing_ok=True)  # of a set that lost shards
        write_card(options.out, index)
        write_index(options.out, index)
    except OSError as err:
        problem = f"cannot be written ({err.strerror})"
        raise MachineError(options.out, problem, "make room, then go on with --resume") from err
    end_work(options.out)
