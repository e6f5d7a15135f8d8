"""The commands that look: a data set, a folder of car models or a disk in; tables, pictures and exit codes out."""

import json
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from rich.table import Table

from augkitti.config import load_config
from augkitti.errors import InputError
from pipelines.run import cache_folder
from pipelines.stage import console


def show_config(path: Path | None) -> None:
    """Print a configuration as YAML that can be read back, each key with one line of why.

    Raises:
        InputError: the file is bad.
    """
    config = load_config(path)
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
        InputError: no usable model, or the sheet cannot be drawn.
    """
    from augkitti.cad_models import load_cad_folder

    library = load_cad_folder(folder, cache_dir=cache_folder() / "cad")
    table = Table("name", "category", "size (m)", "triangles", "glass", "problem", title=str(folder))
    for row in library.report:
        size = " x ".join(f"{side:.2f}" for side in row.size_m) if row.size_m else ""
        glass = f"{100 * row.glass_share:.0f} %" if row.size_m else ""
        triangles = f"{row.triangles:,}" if row.triangles else ""
        table.add_row(row.name, row.category, size, triangles, glass, row.problem or "")
    console().print(table)
    for row in library.report:
        print(f"{row.name}: {'; '.join(row.decisions) or 'left out'}")
    out = [row for row in library.report if row.problem]
    print(f"{len(library.models)} usable, {len(out)} left out")
    if sheet is not None:
        from augkitti.cad_sheet import draw_contact_sheet

        draw_contact_sheet(library, sheet)
        print(sheet)
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
    table = Table("drive", "category", "state", "scans", "pairs", "remarks", title=str(kitti), title_justify="left")
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
    return 1 if any(row.state == "damaged" for row in rows) else 0
