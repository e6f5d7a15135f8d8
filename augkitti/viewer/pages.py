"""Pages: packed pairs and rows of an index in, HTML files that a browser opens from disk out.

The templates `pair.html` and `index.html` beside this module are filled by `string.Template`; every text of a data set
goes through `html.escape`, every table through `_script_json`. The scripts and the style sheet in `static` are copied.
"""

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from augkitti import __version__
from augkitti.viewer.pair_data import PairData

GENERATOR = "augkitti view"  # in the index page's head: by it a folder is known as one of ours
MOST_PAGE_BYTES = 8_000_000  # what a page is meant to stay below
OURS = frozenset({"index.html", "pairs", "thumbs", "static"})  # all that stands in such a folder
STATIC = ("style.css", "decode.js", "scene.js", "pair.js", "index.js")
_LONGEST_NAME = 100


@dataclass(frozen=True)
class IndexRow:
    """A pair as the index page lists it."""

    pair_id: str
    sequence: str
    frames: tuple[int, int]
    page: str  # bare file name in `pairs`
    picture: str  # bare file name in `thumbs`
    cars: tuple[tuple[str, float, float, int], ...]  # of each virtual car: model, speed m/s, range m, points in scan 0
    labelled: int
    page_bytes: int


def page_names(pair_ids: Sequence[str]) -> list[str]:
    """A bare file name for each pair, without its ending: safe on any disk, each once."""
    names: list[str] = []
    taken: set[str] = set()
    for pair_id in pair_ids:
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", pair_id).strip("-")[:_LONGEST_NAME] or "pair"
        name, number = plain, 2
        while name.lower() in taken:
            name, number = f"{plain}-{number}", number + 1
        taken.add(name.lower())
        names.append(name)
    return names


def write_static_files(folder: Path) -> None:
    """Copy the scripts and the style sheet to `folder/static`."""
    (folder / "static").mkdir(parents=True, exist_ok=True)
    for name in STATIC:
        (folder / "static" / name).write_bytes(files("augkitti.viewer").joinpath("static", name).read_bytes())


def write_pair_page(path: Path, data: PairData, before: str | None, after: str | None, licence: str) -> int:
    """Write a pair's page.

    Args:
        path: of the page.
        data: of the pair.
        before: file name of the page before it, if any.
        after: file name of the page after it, if any.
        licence: of the source data.

    Returns:
        Its size in bytes.
    """
    text = _template("pair.html").substitute(
        title=escape(data.table["id"]),
        before=_link(before, "prev", "Previous pair"),
        after=_link(after, "next", "Next pair"),
        licence=escape(licence),
        version=escape(__version__),
        table=_script_json(data.table),
        packed=base64.b64encode(data.packed).decode("ascii"),
    )
    content = text.encode("utf-8")
    path.write_bytes(content)
    return len(content)


def _link(page: str | None, rel: str, words: str) -> str:
    arrow = {"prev": "&#8592;", "next": "&#8594;"}[rel]
    if page is None:
        return f'<span class="step off" aria-hidden="true">{arrow}</span>'
    return f'<a class="step" rel="{rel}" href="{escape(page)}" aria-label="{words}" title="{words}">{arrow}</a>'


def write_index_page(path: Path, rows: Sequence[IndexRow], name: str, pairs_in_set: int, licence: str) -> None:
    """Write the index page.

    Args:
        path: of the page.
        rows: the pairs that have a page, in order.
        name: of the data set.
        pairs_in_set: how many pairs the data set holds.
        licence: of the source data.
    """
    counted = f"{len(rows):,} pairs" if len(rows) == pairs_in_set else f"{len(rows):,} of {pairs_in_set:,} pairs"
    sequences = sorted({row.sequence for row in rows})
    text = _template("index.html").substitute(
        generator=GENERATOR,
        name=escape(name),
        counted=counted,
        sequences="".join(f'<option value="{escape(text)}">{escape(text)}</option>' for text in sequences),
        cards="\n".join(_card(row) for row in rows),
        licence=escape(licence),
        version=escape(__version__),
    )
    path.write_bytes(text.encode("utf-8"))


def _card(row: IndexRow) -> str:
    figures = json.dumps([list(car[1:]) for car in row.cars])
    lines = "".join(
        f'<li><b>{number}</b><em title="{escape(model)}">{escape(_short(model))}</em><span>{speed:.1f}&nbsp;m/s</span>'
        f"<span>{distance:.0f}&nbsp;m</span><span>{points:,}&nbsp;pts</span></li>"
        for number, (model, speed, distance, points) in enumerate(row.cars, start=1)
    )
    return (
        f'<li class="card" data-sequence="{escape(row.sequence)}" data-cars="{escape(figures)}">'
        f'<a href="pairs/{escape(row.page)}"><img src="thumbs/{escape(row.picture)}" width="480" height="300" '
        f'loading="lazy" alt="Scan 0 of {escape(row.pair_id)}, its virtual cars in colour">'
        f"<h2>{escape(row.sequence)}</h2></a>"
        f'<p class="quiet">frames {row.frames[0]} and {row.frames[1]} '
        f"&middot; {row.labelled} labelled objects</p>"
        f'<ul class="cars">{lines or "<li>no virtual car</li>"}</ul></li>'
    )


def _short(model: str) -> str:
    return model.removeprefix("parametric_")


def _template(name: str) -> Template:
    return Template(files("augkitti.viewer").joinpath(name).read_text(encoding="utf-8"))


def _script_json(value: Any) -> str:
    """JSON that no HTML reader takes for the end of its script."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
