"""`augkitti export`: a finished data set in, a folder that other people's programs read out."""

import shutil
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from augkitti.dataset import Dataset
from augkitti.errors import InputError
from augkitti.export import FORMATS, Export, export_pairs, open_export
from augkitti.export.writing import WORK
from pipelines.inspect_set import set_profile
from pipelines.lock import check_free, hold
from pipelines.run import config_of


def export_set(folder: Path, format_name: str, out: Path, split: str | None) -> None:
    """Write a data set, or one of its splits, in another form; goes on where an earlier run was interrupted.

    Args:
        folder: of the data set.
        format_name: one of `FORMATS`.
        out: a new folder, or that of the same export.
        split: `train`, `validation` or `test`; None for all pairs.

    Raises:
        InputError: no such format or split, an unfinished set, a missing package, a folder that holds something else or
            is another run's, a damaged shard.
        MachineError: the disk refuses.
    """
    form = FORMATS.get(format_name)
    if form is None:
        raise InputError("--format", f"`{format_name}` is not known", f"known are {', '.join(FORMATS)}")
    dataset = Dataset(folder, split)
    export = open_export(dataset, form, out, split)
    if export.finished:
        print(f"{out}: finished already, {export.pairs:,} pairs of {form.name}; left as it is")
        return
    print(f"{form.name} cannot hold: {form.lost}")
    check_free(out / WORK)
    with hold(out / WORK):
        _make(dataset, open_export(dataset, form, out, split))
        shutil.rmtree(out / WORK, ignore_errors=True)


def _make(dataset: Dataset, export: Export) -> None:
    """Make what is left, with progress on a terminal, and print what came of it."""
    columns = (TextColumn("pairs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    quiet = not sys.stderr.isatty()
    begin, made, size = time.monotonic(), 0, 0
    ground, profile = config_of(dataset.index).ground, set_profile(dataset.folder, dataset.index)
    with Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True), disable=quiet
    ) as bar:
        line = bar.add_task("", total=export.pairs, completed=len(export.done), rate="")
        for one in export_pairs(dataset, export, ground, profile):
            made, size = made + 1, size + sum(one.files.values())
            speed = bar.tasks[0].speed
            bar.update(line, advance=1, rate=f"{speed:.1f} pairs/s" if speed else "")
    seconds = time.monotonic() - begin
    found = f", {len(export.done):,} found" if export.done else ""
    rate = f", {made / seconds:,.1f} pairs/s" if made else ""
    print(f"{export.out}: {made:,} pairs made{found}, {size / 1e6:,.1f} MB, {seconds:,.1f} s{rate}")
    print(f"for {export.form.reader}; how to read it: docs/exports.md")
