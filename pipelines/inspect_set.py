"""The commands that look: a data set, a folder of car models or a disk in; tables, pictures and exit codes out."""

import datetime
import json
import os
import types
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from rich.table import Table

from augkitti.command_line import as_json, aside, is_json, is_quiet, note, print_json, progress, signed
from augkitti.config import load_config
from augkitti.dataset_index import DatasetIndex
from augkitti.dataset_info import Motions
from augkitti.errors import InputError
from augkitti.scanner import ScannerProfile
from pipelines.cache import cache_folder
from pipelines.run import config_of
from pipelines.stage import console
from pipelines.streets import make_streets, streets_of


def show_config(path: Path | None) -> None:
    """Print a configuration as YAML that can be read back, each key with one line of why.

    Raises:
        InputError: the file is bad.
    """
    config = load_config(path)
    if is_json():
        print_json({"configuration": config.model_dump(mode="json"), "configuration_digest": config.digest()})
        return
    print("# The defaults." if path is None else f"# {path}, with defaults where it says nothing.")
    for line in _config_lines(config, 0):
        print(line)


def _config_lines(section: BaseModel, depth: int) -> Iterator[str]:
    indent = "  " * depth
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        yield f"{indent}# {field.description or ''}{_choices(field.annotation)}"
        if isinstance(value, BaseModel):
            lines = list(_config_lines(value, depth + 1))
            yield f"{indent}{name}:" + ("" if lines else " {}")
            yield from lines
        else:
            plain = section.model_dump(mode="json")[name]
            yield f"{indent}{name}: {json.dumps(plain)}"


def _choices(annotation: Any) -> str:
    """The values that a key may have, where it has a fixed few."""
    if get_origin(annotation) is Literal:
        return f" ({', '.join(str(value) for value in get_args(annotation))})"
    if get_origin(annotation) in (tuple, Union, types.UnionType):
        return next((text for text in map(_choices, get_args(annotation)) if text), "")
    return ""


def check_cad(folder: Path, sheet: Path | None) -> int:
    """Print what each model is taken for; draw the usable ones.

    Returns:
        0; 1 where a model was left out.

    Raises:
        InputError: no file that could be a model, or the sheet cannot be drawn.
    """
    from augkitti.cad_models import check_cad_folder

    library = check_cad_folder(folder, cache_dir=cache_folder() / "cad")
    out = [row for row in library.report if row.problem]
    table = Table("name", "category", "size (m)", "triangles", "glass", "problem", title=signed(str(folder)))
    for row in library.report:
        size = " x ".join(f"{side:.2f}" for side in row.size_m) if row.size_m else ""
        glass = f"{100 * row.glass_share:.0f} %" if row.size_m else ""
        triangles = f"{row.triangles:,}" if row.triangles else ""
        table.add_row(row.name, row.category, size, triangles, glass, row.problem or "")
    if is_json():
        models = [asdict(row) for row in library.report]
        print_json({"folder": str(folder), "usable": len(library.models), "left_out": len(out), "models": models})
    else:
        console().print(table)
        for row in library.report:
            print(f"{row.name}: {'; '.join(row.decisions) or 'left out'}")
        print(f"{len(library.models)} usable, {len(out)} left out")
    if sheet is not None:
        from augkitti.cad_sheet import draw_contact_sheet

        draw_contact_sheet(library, sheet)
        note(str(sheet))
    return 1 if out else 0


def show_data_status(kitti: Path | None) -> int:
    """Compare a disk with the manifest.

    Returns:
        0; 1 where files are damaged.

    Raises:
        InputError: no root was named, or it is no folder.
    """
    from augkitti.data_status import data_status

    if kitti is None:
        raise InputError("--kitti", "is missing", "name the folder with KITTI in it, or set AUGKITTI_KITTI")
    rows = data_status(kitti)
    code = 1 if any(row.state == "damaged" for row in rows) else 0
    if is_json():
        print_json({"root": str(kitti), "drives": [asdict(row) for row in rows]})
        return code
    table = Table(
        "drive", "category", "state", "scans", "pairs", "remarks", title=signed(str(kitti)), title_justify="left"
    )
    for row in rows:
        scans = f"{row.scans:,}" + (f" of {row.expected:,}" if row.expected else "")
        if row.state != "missing":
            table.add_row(row.name, row.category, row.state, scans, f"{row.pairs:,}", "; ".join(row.problems))
    console().print(table)
    missing = [row for row in rows if row.state == "missing"]
    print(f"{len(rows) - len(missing)} drives here, {len(missing)} missing")
    addresses = list(dict.fromkeys(address for row in rows for address in row.download))
    if addresses:
        print("to download:")
        for address in addresses:
            print(f"  {address}")
    return code


def split_set(
    out: Path,
    ratios: tuple[float, float, float],
    seed: int,
    like: Path | None,
    allow_frames_split: bool,
    test_on: Sequence[str] = (),
) -> None:
    """Divide a data set by recording and print what went where.

    Raises:
        InputError: unfinished set, no ratios, too few recordings, or recordings that `like` or the set lacks.
    """
    from augkitti.dataset_index import read_index
    from augkitti.splits import pairs_by_split, split_dataset

    try:
        splits = split_dataset(out, ratios, seed, like, allow_frames_split, test_on)
    except OSError as err:
        raise InputError(out, f"cannot be written ({err.strerror})", "check its permissions") from err
    index = read_index(out)
    counts = pairs_by_split(index, splits)
    if is_json():
        found = {name: {"pairs": pairs, "recordings": recordings} for name, (pairs, recordings) in counts.items()}
        print_json({"folder": str(out), "divides_recordings": splits.divides_recordings, "splits": found})
        return
    total = max(1, sum(pairs for pairs, _ in counts.values()))
    table = Table("split", "pairs", "share", "recordings", title=signed(str(out)), title_justify="left")
    for name, (pairs, recordings) in counts.items():
        table.add_row(name, f"{pairs:,}", f"{100 * pairs / total:.1f} %", f"{recordings:,}")
    if not is_quiet():
        console().print(table)
    if splits.divides_recordings:
        note("a recording is divided between splits: for toy sets only")


def describe_set(folder: Path, out: Path, url: str | None, published: datetime.date) -> None:
    """Write Croissant metadata of a data set, with its splits where it has them.

    Raises:
        InputError: unfinished set, a file inside the set's folder, or one that cannot be written.
    """
    from augkitti.croissant import croissant
    from augkitti.dataset_index import SPLITS_NAME, read_index, write_text
    from augkitti.remote import is_remote
    from augkitti.splits import read_splits

    index = read_index(folder)
    splits = read_splits(folder / SPLITS_NAME).splits if (folder / SPLITS_NAME).is_file() else None
    address, name = str(folder), folder.name
    if not is_remote(folder):
        here, there = folder.resolve(), out.resolve()
        if there.is_relative_to(here):
            raise InputError(out, "lies in the data set's folder, which holds data alone", "put it beside that folder")
        address, name = Path(os.path.relpath(here, there.parent)).as_posix(), here.name
    text = json.dumps(croissant(index, splits, name, address, published, url), indent=1) + "\n"
    try:
        write_text(out, text)
    except OSError as err:
        raise InputError(out, f"cannot be written ({err.strerror})", "name another file") from err
    note(str(out))


def view_pair(folder: Path, pair_id: str | None, picture: Path, kitti: Path | None) -> None:
    """Draw a pair; with its source at hand, what the cars hide and where they may stand, too.

    Raises:
        InputError: no such pair, or the picture cannot be written.
    """
    from augkitti.dataset import open_dataset
    from augkitti.draw import draw_pair

    dataset = open_dataset(folder)
    if not len(dataset):
        raise InputError(folder, "holds no pair", "generate some")
    pair = dataset[0 if pair_id is None else pair_id]
    config = config_of(dataset.index)
    profile = set_profile(folder, dataset.index)
    prepared = None
    root = source_of(dataset.index, profile, kitti)
    if root is not None:
        from augkitti.kitti import open_root
        from pipelines.prepare import prepared_scan

        sequence = open_root(root).sequence(pair.sequence)
        prepared = [prepared_scan(sequence, f, profile, config, cache_folder())[0] for f in (pair.frame0, pair.frame1)]
    if prepared is None:
        aside("no source at hand: give --kitti to see what the cars hide")
        draw_pair(pair, picture, profile=profile)
    else:
        scan0, scan1 = prepared
        draw_pair(pair, picture, scan0.scan, scan1.scan, scan0.region, scan0.ground, profile=profile)
    note(str(picture))


def set_profile(folder: Path, index: DatasetIndex) -> ScannerProfile:
    """The scanner profile that a data set's shards carry.

    Raises:
        InputError: the first shard is unreadable.
    """
    from augkitti.scanner import load_profile, profile_from_content
    from augkitti.shards import read_metadata

    if not index.shards:
        return load_profile()
    path = folder / index.shards[0].path
    return profile_from_content(read_metadata(path).get("scanner_profile"), str(path))


def source_of(index: DatasetIndex, profile: ScannerProfile, kitti: Path | None, make: bool = False) -> Path | None:
    """Where the scans of a data set lie: `--kitti`, or for embedded streets the cache; None where that is not known.

    Args:
        index: of the data set.
        profile: that its shards carry.
        kitti: the root that was given.
        make: draw embedded streets again where the cache has lost them.

    Raises:
        InputError: streets of another program version.
    """
    if index.source.get("kind") != "embedded":
        return kitti
    streets = streets_of(index.source, profile, cache_folder())
    if make and not streets.are_there:
        make_streets(streets, profile, jobs=1)
    return streets.folder if streets.are_there else None


def synthesize_drives(out: Path, drives: int, frames: int, seed: int, jobs: int, profile: Path | None) -> None:
    """Write procedural streets in KITTI's layout.

    Raises:
        InputError: the folder is not empty or cannot be written, or the profile is bad.
    """
    from augkitti.scanner import load_profile
    from augkitti.synthesize import synthesize

    with progress(drives, "drives") as done:
        folders = synthesize(out, drives, frames, seed, load_profile(profile), jobs, done)
    for folder in folders:
        note(str(folder))


def show_info(folder: Path, picture: Path | None, kitti: Path | None) -> None:
    """Figures of a data set, beside the labelled motions of real KITTI.

    Raises:
        InputError: no data set there, or a shard, a source or the picture is at fault.
    """
    from augkitti.dataset_info import dataset_info, draw_info, info_tables

    info = dataset_info(folder, None if kitti is None else labelled_motions(kitti))
    if is_json():
        print_json(info.as_dict())
    else:
        for table in info_tables(info):
            console().print(table)
    if picture is not None:
        draw_info(info, picture)
        note(str(picture))


def labelled_motions(kitti: Path, most: int = 500) -> Motions:
    """Motions of the cars that KITTI labels under a root: of up to `most` pairs, in runs of neighbours per drive.

    Raises:
        InputError: the root holds no KITTI, or a source is unreadable.
    """
    from augkitti.dataset_info import info_of_pairs
    from augkitti.kitti import label_reach, open_root
    from pipelines.augment import make_pair
    from pipelines.plan import Candidate
    from pipelines.run import read_options

    plain = read_options(
        kitti=kitti, cad=None, out=Path(), n=1, seed=0, config=None, profile=None, stop_on_error=True, cars=(0, 0)
    )
    drives = [s for s in open_root(kitti).sequences if s.pairs and label_reach(s)[0] != "none"]
    run = max(5, most // max(1, len(drives)))
    made = (
        make_pair(sequence, Candidate(f"{sequence.name}/{frame0}/0", frame0, 0, 0), plain)
        for sequence in drives
        for frame0, _ in sequence.pairs[:run]
    )
    return info_of_pairs(result[0] for result in made if result is not None).labelled


def validate_set(folder: Path, kitti: Path | None, jobs: int, report_file: Path | None) -> int:
    """Check every invariant on every pair and print the first offenders.

    Returns:
        0, or 1 where anything was found.

    Raises:
        InputError: the folder is no finished data set, the root holds no KITTI, or the report cannot be written.
    """
    from augkitti.dataset_index import read_index, write_text
    from augkitti.validate import TITLES
    from augkitti.validate_folder import FOLDER, validate_folder

    index = read_index(folder)
    root = source_of(index, set_profile(folder, index), kitti, make=True)
    with progress(index.rows, "pairs") as done:
        report = validate_folder(folder, root, jobs, done)
    if report_file is not None:
        try:
            write_text(report_file, as_json(report.as_json()))
        except OSError as err:
            raise InputError(report_file, f"cannot be written ({err.strerror})", "name another file") from err
    if is_json():
        print_json(report.as_json())
        return 0 if report.ok else 1
    table = Table(
        "", "invariant", "pairs checked", "offences", "not checked", title=signed(str(folder)), title_justify="left"
    )
    for number, title in TITLES.items():
        checked = f"{report.checked.get(number, 0):,}"
        table.add_row(
            str(number), title, checked, f"{report.counts.get(number, 0):,}", report.unchecked.get(number, "")
        )
    table.add_row("", "the folder itself", "", f"{report.counts.get(FOLDER, 0):,}", "")
    console().print(table)
    for offence in report.first:
        print(f"{offence.invariant} {offence.pair_id} {offence.column} {offence.value}: {offence.message}")
    print(f"{report.pairs:,} pairs of {report.shards:,} shards: {sum(report.counts.values()):,} offences")
    return 0 if report.ok else 1
