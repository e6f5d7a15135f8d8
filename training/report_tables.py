"""A report in, what people read out: a table on the screen, CSV, rows for LaTeX, JSON."""

import csv
import io
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from augkitti.command_line import as_json, signed
from augkitti.dataset_index import write_text
from training.score import Report

# key, heading, digits after the point; the order
COLUMNS: tuple[tuple[str, str, int], ...] = (
    ("fg_epe", "FG m", 3),
    ("bg_epe", "BG m", 3),
    ("all_epe", "All m", 3),
    ("obj_rot", "obj. rot rad", 4),
    ("obj_tr_lidar", "obj. tr m", 3),
    ("obj_tr_centre", "at centre m", 3),
    ("ego_rot", "ego rot rad", 4),
    ("ego_tr", "ego tr m", 3),
    ("ap_bev50", "AP BEV 0.5", 3),
    ("ap_bev70", "AP BEV 0.7", 3),
)
_PAPER = ("fg_epe", "bg_epe", "all_epe", "obj_rot", "obj_tr_lidar", "ego_rot", "ego_tr")  # Tables 1 and 2
_NONE = "-"
_WIDTH = 120  # columns of the widest table; a pipe has no width of its own


def print_report(report: Report, console: Console | None = None, details: bool = True) -> None:
    """The rules, the table of all methods, and with `details` how errors depend on range, speed and points."""
    console = console or Console()
    console = console if console.width >= _WIDTH else Console(file=console.file, width=_WIDTH)
    first = report.rows[0]
    counts = (
        f"{first['pairs']:,} pairs, {first['fg_points']:,} foreground and {first['bg_points']:,} background points, "
        f"{first['objects']:,} cars to find; {first['close']['pairs_of_cars']:,} pairs of cars closer than "
        f"{report.rules.close_m:g} m"
    )
    console.print(signed("evaluation"), highlight=False)
    for text in (report.rules.as_text(), counts):
        console.print(text, soft_wrap=True, highlight=False, markup=False)
    table = _table("method", *(_heading(name) for _, name, _ in COLUMNS))
    for row in report.rows:
        table.add_row(row["method"], *(_cell(row[key], digits) for key, _, digits in COLUMNS))
    console.print(table)
    if not details:
        return
    names = (
        "AccS",
        "AccR",
        "out-\nliers",
        "FD m",
        "FS m",
        "BS m",
        "3-way\nmean m",
        "static\nm",
        "dynamic",
        "spread\nm",
    )
    wide = _table("method", *names)
    for row in report.rows:
        accuracy, three, bucketed = row["accuracy"]["all"], row["three_way"], row["bucketed"]["mean"]
        figures = (
            *(accuracy[key] for key in ("acc_s", "acc_r", "outliers")),
            *(three[key] for key in ("fd", "fs", "bs", "mean")),
            *(bucketed[key] for key in ("static_epe", "dynamic_error")),
            row["spread"]["mean"],
        )
        wide.add_row(row["method"], *(_cell(value, 3) for value in figures))
    console.print(wide)
    for key, what in (("by_range", "range, m"), ("by_speed", "speed,\nm a pair"), ("by_points", "points\non the car")):
        console.print(_binned(report, key, what, "fg"))
    console.print(_binned(report, "by_range", "range, m", "bg"))
    console.print(_close(report))


def as_csv(report: Report) -> str:
    """A line a method: every figure that is a number, names of nested ones joined by points; empty where none."""
    rows = [_flat(row) for row in report.rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO()
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def as_latex(report: Report, evaluated_on: str = "") -> str:
    """Rows for a `tabular` with the columns of the paper's Table 2; the best figure of each column in bold.

    The true ego-motion is no method, so its row is never bold.
    """
    best = {}
    for key in _PAPER:
        shown = [
            _rounded(row[key], _digits(key))
            for row in report.rows
            if row[key] is not None and row["method"] != "ego_true"
        ]
        best[key] = min(shown, key=float) if shown else None
    lines = []
    for row in report.rows:
        cells = []
        for key in _PAPER:
            text = _NONE if row[key] is None else _rounded(row[key], _digits(key))
            cells.append(f"{{\\bf {text}}}" if text == best[key] and row["method"] != "ego_true" else text)
        lines.append(" & ".join([_escaped(evaluated_on), _escaped(row["method"]), *cells]) + r" \\")
    return "\n".join(lines) + "\n"


def pairs_csv(report: Report) -> str:
    """A line a pair and method: errors of flow and ego-motion; to find the pairs that a method fails on."""
    out = io.StringIO()
    names = ("method", "pair_id", "fg_epe", "bg_epe", "all_epe", "ego_rot", "ego_tr")
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows({"method": method, **one} for method, pairs in report.per_pair.items() for one in pairs)
    return out.getvalue()


def write_report(report: Report, folder: Path) -> None:
    """`scores.json`, `scores.csv`, `scores.tex` and `pairs.csv` in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "scores.json", as_json(report.as_json()))
    write_text(folder / "scores.csv", as_csv(report))
    write_text(folder / "scores.tex", as_latex(report))
    write_text(folder / "pairs.csv", pairs_csv(report))


def _binned(report: Report, key: str, what: str, group: str) -> Table:
    """Foreground or background error of every method in each bin, with counts."""
    cars = ["cars"] if group == "fg" else []
    table = _table(what, f"{group.upper()}\npoints", *cars, *(_two_lines(row["method"]) for row in report.rows))
    for k, one in enumerate(report.rows[0][key]):
        if not one[f"{group}_points"] and not (cars and one["objects"]):
            continue
        upper = "and more" if one["to"] is None else f"to {one['to']:g}"
        counts = [f"{one[f'{group}_points']:,}", *(f"{one['objects']:,}" for _ in cars)]
        values = (_cell(row[key][k][f"{group}_epe"], 3) for row in report.rows)
        table.add_row(f"{one['from']:g} {upper}", *counts, *values)
    return table


def _close(report: Report) -> Table:
    """Cars that stand close to each other against those that do not."""
    figures = (
        ("fg_epe", "FG m", 3), ("recall", "found", 2), ("obj_rot", "obj.\nrot rad", 4),
        ("obj_tr_lidar", "obj.\ntr m", 3), ("obj_tr_centre", "about\ncentre m", 3),
    )  # fmt: skip
    table = _table("cars", "method", "FG\npoints", "cars", *(heading for _, heading, _ in figures))
    table.columns[1].justify = "left"
    for where in ("close", "apart"):
        for row in report.rows:
            one = row[where]
            cells = (_cell(one[key], digits) for key, _, digits in figures)
            table.add_row(where, row["method"], f"{one['fg_points']:,}", f"{one['objects']:,}", *cells)
    return table


def _table(first: str, *others: str) -> Table:
    """Numbers to the right, nothing cut short."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate((first, *others)):
        table.add_column(name, justify="right" if k else "left", no_wrap=True)
    return table


def _heading(name: str) -> str:
    before, space, unit = name.rpartition(" ")
    return f"{before}\n{unit}" if space else name


def _two_lines(method: str) -> str:
    return method.replace("_", "_\n", 1)


def _cell(value: float | None, digits: int) -> str:
    return _NONE if value is None else f"{value:.{digits}f}"


def _digits(key: str) -> int:
    return 3 if key.endswith("rot") else 2  # as the paper prints them


def _rounded(value: float, digits: int) -> str:
    return f"{value:.{digits}f}"


def _escaped(text: str) -> str:
    return text.replace("_", r"\_")


def _flat(row: dict[str, Any], before: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, dict):
            out |= _flat(value, f"{before}{key}.")
        elif not isinstance(value, list):
            out[before + key] = value
    return out
