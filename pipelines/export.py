"""`augkitti export`: a finished data set in, a folder that other people's programs read out."""

import shutil
import time
from pathlib import Path

from augkitti.command_line import counted, note
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
    if not format_name:
        raise InputError("--format", "not given", f"name one of {', '.join(FORMATS)}")
    form = FORMATS.get(format_name)
    if form is None:
        raise InputError("--format", f"`{format_name}` is not known", f"known are {', '.join(FORMATS)}")
    dataset = Dataset(folder, split)
    export = open_export(dataset, form, out, split)
    if export.finished:
        note(f"{out}: finished already, {export.pairs:,} pairs of {form.name}; left as it is")
        return
    note(f"{form.name} cannot hold: {form.lost}")
    check_free(out / WORK)
    with hold(out / WORK):
        _make(dataset, open_export(dataset, form, out, split))
        shutil.rmtree(out / WORK, ignore_errors=True)


def _make(dataset: Dataset, export: Export) -> None:
    """Make what is left, and say what came of it."""
    begin, made, size = time.monotonic(), 0, 0
    ground, profile = config_of(dataset.index).ground, set_profile(dataset.folder, dataset.index)
    for one in counted(export_pairs(dataset, export, ground, profile), export.pairs - len(export.done), "pairs"):
        made, size = made + 1, size + sum(one.files.values())
    seconds = time.monotonic() - begin
    found = f", {len(export.done):,} found" if export.done else ""
    rate = f", {made / seconds:,.1f} pairs/s" if made else ""
    note(f"{export.out}: {made:,} pairs made{found}, {size / 1e6:,.1f} MB, {seconds:,.1f} s{rate}")
    note(f"for {export.form.reader}")
