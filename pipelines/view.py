"""`augkitti view`: a data set in; a folder of pages, one picture, or a pair in rerun out.

Pages are made in a folder beside the one asked for, which is renamed when all is there.
"""

import os
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from augkitti.command_line import aside, note
from augkitti.config import Config
from augkitti.dataset import Dataset, open_dataset
from augkitti.errors import InputError
from augkitti.frames import F32
from augkitti.kitti import open_root, read_scan
from augkitti.remote import is_remote
from augkitti.scan_pair import AugmentedPair, CarModel
from augkitti.scanner import ScannerProfile
from augkitti.shards import read_metadata
from augkitti.viewer.pages import (
    GENERATOR,
    MOST_PAGE_BYTES,
    OURS,
    IndexRow,
    page_names,
    write_index_page,
    write_pair_page,
    write_static_files,
)
from augkitti.viewer.pair_data import pair_data, source_points
from augkitti.viewer.thumbnail import thumbnail
from augkitti.viewer.to_rerun import send_to_rerun
from pipelines.cache import cache_folder
from pipelines.inspect_set import set_profile, source_of, view_pair
from pipelines.run import config_of, load_models
from pipelines.stage import run_tasks

DEFAULT_PAGES = Path("augkitti-view")
DEFAULT_PICTURE = Path("pair.png")
DEFAULT_PAIRS = 24
_OTHER_PICTURES = (".jpg", ".jpeg", ".pdf", ".svg", ".gif", ".webp", ".html")
_NO_SOURCE = "the source scans are not at hand: give --kitti"


def view(
    folder: Path, pair_id: str | None, out: Path | None, kitti: Path | None, cad: Path | None, pairs: int, jobs: int
) -> Path:
    """Write what `out` asks for: one picture where it ends in `.png`, else a folder of pages.

    Args:
        folder: of the data set.
        pair_id: the pair to show; None for the first (picture) or `pairs` of them, evenly spread (pages).
        out: what to write; None for a folder of a fixed name.
        kitti: root of the source scans, where at hand.
        cad: folder of the car models, where at hand; None for cars made in code.
        pairs: most pages.
        jobs: processes.

    Returns:
        The picture, or the index page.

    Raises:
        InputError: no such data set or pair, or `out` cannot be written or holds something else.
    """
    if out is not None and out.suffix.lower() == ".png":
        view_pair(folder, pair_id, out, kitti)
        return out
    if out is not None and out.suffix.lower() in _OTHER_PICTURES:
        raise InputError(out, "is no name of a PNG, nor of a folder of pages", "let the picture's name end in .png")
    page = write_pages(folder, pair_id, DEFAULT_PAGES if out is None else out, kitti, cad, pairs, jobs)
    note(str(page))
    return page


def view_in_rerun(folder: Path, pair_id: str | None, out: Path | None, kitti: Path | None) -> None:
    """Send a pair (the first, if none is named) to rerun, or to a file that rerun opens.

    Raises:
        InputError: as `view`; rerun is not installed.
    """
    if out is not None and out.suffix.lower() != ".rrd":
        raise InputError(out, "is no name of a rerun recording", "let it end in .rrd, or leave --out away")
    dataset = _open(folder)
    pair = dataset[0 if pair_id is None else pair_id]
    source = _Source.of(dataset, kitti)
    removed, why = source.removed(pair)
    send_to_rerun(pair, removed, out)
    if removed is None and (len(pair.scan0.removed) or len(pair.scan1.removed)):
        aside(f"removed points are not shown: {why}")
    if out is not None:
        note(str(out))


def write_pages(
    folder: Path, pair_id: str | None, out: Path, kitti: Path | None, cad: Path | None, pairs: int, jobs: int = 1
) -> Path:
    """Write a folder of pages, see `view`; the index page's path."""
    dataset = _open(folder)
    _check_out(folder, out)
    ids, numbers = dataset.pair_ids, list(range(len(dataset)))
    if pair_id is not None:
        if pair_id not in ids:
            raise InputError(folder, f"holds no pair `{pair_id}`", "names are `<sequence>/<frame0>/<variant>`")
        numbers = [ids.index(pair_id)]
    chosen = [numbers[i] for i in np.unique(np.linspace(0, len(numbers) - 1, pairs).round().astype(int))]
    names = page_names([ids[number] for number in chosen])
    source = _Source.of(dataset, kitti)
    models = _models_at_hand(dataset, cad, source.config)
    target = out.resolve()
    part = target.parent / f".{target.name}.part-{os.getpid()}"
    task = partial(_write_page, part=part, dataset=dataset, source=source, models=models, names=tuple(names))
    rows: dict[int, IndexRow] = {}
    notes: list[str] = []
    try:
        try:
            for name in ("pairs", "thumbs"):
                (part / name).mkdir(parents=True)
            write_static_files(part)
            items = list(enumerate(chosen))
            for place, row, why in run_tasks(task, items, jobs, "pages", weight=lambda item: 1):
                rows[place] = row
                notes += [why] if why else []
            write_index_page(
                part / "index.html",
                [rows[place] for place in sorted(rows)],
                folder.name or folder.resolve().name,
                len(dataset),
                dataset.index.licence,
            )
            if target.exists():
                shutil.rmtree(target)
            os.replace(part, target)
        except OSError as err:
            raise InputError(out, f"cannot be written ({err.strerror})", "name another folder, or make room") from err
    finally:
        shutil.rmtree(part, ignore_errors=True)
    for why in sorted(set(notes)):
        aside(f"removed points are not shown: {why}")
    large = sum(row.page_bytes > MOST_PAGE_BYTES for row in rows.values())
    if large:
        aside(f"{large} pages are larger than {MOST_PAGE_BYTES / 1e6:.0f} MB and may open slowly")
    if len(chosen) < len(numbers):
        aside(f"{len(chosen)} of {len(numbers):,} pairs, evenly spread; --pairs shows more")
    return out / "index.html"


def _open(folder: Path) -> Dataset:
    dataset = open_dataset(folder)
    if not len(dataset):
        raise InputError(folder, "holds no pair", "generate some")
    return dataset


def _check_out(folder: Path, out: Path) -> None:
    """Refuse a folder that holds anything but pages of ours, or lies in the data set."""
    if is_remote(out):
        raise InputError(out, "is no folder of this machine", "write the pages here, then copy them")
    here = out.resolve()
    if not is_remote(folder) and (here == folder.resolve() or folder.resolve() in here.parents):
        raise InputError(out, "lies in the data set, which holds nothing else", "name a folder beside it")
    if not out.exists():
        return
    index = out / "index.html"
    ours = index.is_file() and f'content="{GENERATOR}"' in index.read_text(encoding="utf-8", errors="replace")[:2000]
    if not out.is_dir() or (any(out.iterdir()) and not ours):
        raise InputError(out, "is not an empty folder, nor one of pages", "name a new one")
    foreign = sorted(path.name for path in out.iterdir() if path.name not in OURS)
    if foreign:
        raise InputError(out, f"holds `{foreign[0]}` beside its pages", "name a new one, or move that away")


def _models_at_hand(dataset: Dataset, cad: Path | None, config: Config) -> dict[str, CarModel]:
    """The models that the data set was made with, digest by digest, from a folder or made in code."""
    used = read_metadata(dataset.folder / dataset.index.shards[0].path).get("cad_models")
    digests = used if isinstance(used, dict) else {}
    if cad is None and not any(str(name).startswith("parametric_") for name in digests):
        return {}
    return {m.name: m for m in load_models(cad, config, cache_folder()) if digests.get(m.name) == m.digest}


@dataclass(frozen=True)
class _Source:
    """Where the scans that a data set was made from lie, and how they were read."""

    root: Path | None
    profile: ScannerProfile
    config: Config

    @classmethod
    def of(cls, dataset: Dataset, kitti: Path | None) -> "_Source":
        profile = set_profile(dataset.folder, dataset.index)
        return cls(source_of(dataset.index, profile, kitti), profile, config_of(dataset.index))

    def removed(self, pair: AugmentedPair) -> tuple[tuple[F32, F32] | None, str]:
        """The points that a pair's cars hide in both scans, or why they cannot be had."""
        if self.root is None:
            return None, _NO_SOURCE
        try:
            sequence = open_root(self.root).sequence(pair.sequence)
            scans = [read_scan(sequence, frame) for frame in (pair.frame0, pair.frame1)]
        except InputError as err:
            return None, str(err)
        first, second = source_points(scans[0], pair.scan0.removed), source_points(scans[1], pair.scan1.removed)
        if first is None or second is None:
            return None, f"the scans of {pair.sequence} at hand are not those that the data set was made from"
        return (first, second), ""


def _write_page(
    item: tuple[int, int],
    part: Path,
    dataset: Dataset,
    source: _Source,
    models: dict[str, CarModel],
    names: tuple[str, ...],
) -> tuple[int, IndexRow, str]:
    """Write one pair's page and picture; its place, its row of the index, and why removed points are missing."""
    place, number = item
    pair = dataset[number]
    removed, why = source.removed(pair)
    data = pair_data(pair, source.profile, models, removed, why)
    page = f"{names[place]}.html"
    before = f"{names[place - 1]}.html" if place else None
    after = f"{names[place + 1]}.html" if place + 1 < len(names) else None
    size = write_pair_page(part / "pairs" / page, data, before, after, dataset.index.licence)
    picture = f"{names[place]}.png"
    (part / "thumbs" / picture).write_bytes(thumbnail(pair))
    cars = [object_ for object_ in pair.objects if object_.origin == "virtual"]
    row = IndexRow(
        pair_id=pair.pair_id,
        sequence=pair.sequence,
        frames=(pair.frame0, pair.frame1),
        page=page,
        picture=picture,
        cars=tuple(
            (
                car.model or car.category,
                0.0 if car.speed is None else float(car.speed),
                0.0 if car.box0 is None else float(np.hypot(car.box0[0], car.box0[1])),
                car.points0,
            )
            for car in cars
        ),
        labelled=len(pair.objects) - len(cars),
        page_bytes=size,
    )
    return place, row, why
