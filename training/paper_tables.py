"""Tables 1 and 2 of the paper: rows of figures in, lines with the paper's numbers beside them out, as HTML and LaTeX.

A row is one of `Report.rows` with a few keys more (`tables.py`): `table`, `eval_set`, `trained_on`, `label`, `kind`,
`paper`, `run`, `seconds`, `coverage`, `whole`. Where its flow is scored on valid points
alone, `all_points` has the figures of all. Layout asks a row for nothing else, so another method is another row.
"""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Row = Mapping[str, Any]

# the paper's columns: key of ours, heading, digits in print
FIGURES: tuple[tuple[str, str, int], ...] = (
    ("fg_epe", "FG", 2),
    ("bg_epe", "BG", 2),
    ("all_epe", "All", 2),
    ("obj_rot", "Rot.(rad)", 3),
    ("obj_tr_lidar", "Tr.(m)", 2),
    ("ego_rot", "Rot.(rad)", 3),
    ("ego_tr", "Tr.(m)", 2),
)
KEYS = tuple(key for key, _, _ in FIGURES)
SETS = ("K", "K+AK")
OURS = "direct"  # the flow that stands for the network in both tables
REFERENCE, BASELINE, NETWORK = "reference", "baseline", "network"  # `kind` of a row; references never win
_NONE = "-"


@dataclass(frozen=True)
class Printed:
    """A line of the paper's tables: metres and radians, in the order of `KEYS`; seconds a pair from its text."""

    table: int
    eval_set: str
    method: str  # of Table 1: what it was trained on
    figures: tuple[float, ...]
    seconds: float | None = None


# method.md section 6; pointflownet.tex, tab:ablation and tab:results, "Comparison with the baselines"
PAPER: tuple[Printed, ...] = (
    Printed(1, "K", "K", (0.23, 0.14, 0.14, 0.004, 0.30, 0.004, 0.09)),
    Printed(1, "K", "K+AK", (0.18, 0.14, 0.14, 0.004, 0.29, 0.004, 0.09)),
    Printed(1, "K+AK", "K", (0.58, 0.14, 0.18, 0.010, 0.57, 0.004, 0.14)),
    Printed(1, "K+AK", "K+AK", (0.28, 0.14, 0.16, 0.011, 0.48, 0.004, 0.12)),
    Printed(2, "K", "ICP+Det.", (0.56, 0.43, 0.44, 0.22, 6.27, 0.004, 0.44), 0.5),
    Printed(2, "K", "3DMatch+Det.", (0.89, 0.70, 0.71, 0.021, 1.80, 0.004, 0.68), 100.0),
    Printed(2, "K", "FPFH+Det.", (3.83, 4.24, 4.21, 0.299, 14.23, 0.135, 4.27), 300.0),
    Printed(2, "K", "Dewan et al.+Det.", (0.55, 0.41, 0.41, 0.008, 0.55, 0.006, 0.39), 4.0),
    Printed(2, "K", "Ours", (0.29, 0.15, 0.16, 0.004, 0.19, 0.005, 0.12), 0.5),
    Printed(2, "K+AK", "ICP+Det.", (0.74, 0.48, 0.50, 0.226, 6.30, 0.005, 0.49)),
    Printed(2, "K+AK", "3DMatch+Det.", (1.14, 0.77, 0.80, 0.027, 1.76, 0.004, 0.76)),
    Printed(2, "K+AK", "FPFH+Det.", (4.00, 4.39, 4.36, 0.311, 13.54, 0.122, 4.30)),
    Printed(2, "K+AK", "Dewan et al.+Det.", (0.60, 0.52, 0.52, 0.014, 0.75, 0.006, 0.46)),
    Printed(2, "K+AK", "Ours", (0.34, 0.18, 0.20, 0.011, 0.50, 0.005, 0.15)),
)


def paper_figures(table: int, eval_set: str, method: str | None) -> dict[str, float | None] | None:
    """The paper's numbers by our keys, with `seconds`; None where it has no such line."""
    for one in PAPER:
        if (one.table, one.eval_set, one.method) == (table, eval_set, method):
            return {**dict(zip(KEYS, one.figures, strict=True)), "seconds": one.seconds}
    return None


@dataclass(frozen=True)
class Spread:
    """A figure over the runs (seeds) of a line; of one run all three are the same."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Line:
    """What stands in one line: the rows of all runs of a method on a set."""

    eval_set: str
    label: str
    trained_on: str | None
    runs: int
    rows: tuple[Row, ...]
    kind: str
    whole: bool  # on all pairs that the others have

    @property
    def contends(self) -> bool:
        """Whether its figures may be the best of a column: no reference, and on the same points as the others."""
        return self.whole and self.kind != REFERENCE and self.rows[0].get("all_points") is None

    @property
    def paper(self) -> Mapping[str, float | None]:
        """The paper's numbers; empty where it has none."""
        return self.rows[0]["paper"] or {}

    def figure(self, *keys: str) -> Spread | None:
        """Of a key, or of one within another; None where a run has none."""
        values = [_within(row, keys) for row in self.rows]
        if any(value is None for value in values):
            return None
        numbers = np.array(values, dtype=np.float64)
        return Spread(float(numbers.mean()), float(numbers.min()), float(numbers.max()))


def lines_of(rows: Sequence[Row], table: int) -> list[Line]:
    """Lines of a table, K before K+AK, otherwise in the order of their rows."""
    groups: dict[tuple[str, str, str | None], list[Row]] = {}
    for row in rows:
        if row["table"] == table:
            groups.setdefault((row["eval_set"], row["label"], row["trained_on"]), []).append(row)
    lines = [
        Line(eval_set, label, trained_on, len(mine), tuple(mine), mine[0]["kind"], all(row["whole"] for row in mine))
        for (eval_set, label, trained_on), mine in groups.items()
    ]
    return [line for name in SETS for line in lines if line.eval_set == name]


def ablation_lines(rows: Sequence[Row]) -> list[Line]:
    """Table 1 as the paper has it: the network's own flow alone."""
    return lines_of([row for row in rows if row["method"] == OURS], 1)


# --- HTML ----------------------------------------------------------------------------------------------------------


def ablation_html(rows: Sequence[Row]) -> str:
    """Table 1: ours, the spread over seeds, the paper's below."""
    lines = ablation_lines(rows)
    heads = ("Evaluated on", "Trained on", *_HEADS, "object centre, m", "pairs", "runs", "steps")
    body = []
    for line in lines:
        steps = {row["step"] for row in line.rows}
        cells = [
            *_figure_cells(line, lines),
            f"<td>{_spread_text(line.figure('obj_tr_centre'), 3)}</td>",
            f"<td>{line.rows[0]['pairs']:,}</td><td>{line.runs}</td>",
            f"<td>{', '.join(f'{step:,}' for step in sorted(steps))}</td>",
        ]
        body.append((line, [f"<td>{html.escape(line.trained_on or _NONE)}</td>", *cells]))
    return _html_table(heads, body)


def comparison_html(rows: Sequence[Row]) -> str:
    """Table 2: the same for every method, then what the paper has in its text or not at all."""
    lines = lines_of(rows, 2)
    heads = ("Evaluated on", "Method", *_HEADS, "object centre, m", "cars found", "s / pair", "coverage", "pairs")
    body = []
    for line in lines:
        row = line.rows[0]
        seconds, found = line.figure("seconds"), line.figure("true_positives")
        pairs = f"{row['pairs']:,}" + ("" if line.whole else " only")
        cells = [
            f"<td>{_name_html(line)}</td>",
            *_figure_cells(line, lines),
            f"<td>{_spread_text(line.figure('obj_tr_centre'), 3)}</td>",
            f"<td>{_NONE if found is None else _of(found.mean, row['objects'])}</td>",
            f"<td>{_seconds_text(seconds)}{_paper_html(line.paper.get('seconds'), None)}</td>",
            f"<td>{_percent(line.figure('coverage'))}</td><td>{pairs}</td>",
        ]
        body.append((line, cells))
    return _html_table(heads, body)


def ways_html(rows: Sequence[Row]) -> str:
    """The paper's "Direct scene flow vs. object motion": error and roughness of the network's flow three ways."""
    lines = [line for line in lines_of(rows, 2) if line.kind == NETWORK]
    heads = ("Evaluated on", "Flow", "FG, m", "BG, m", "All, m", "scatter within a car, m")
    body = []
    for line in lines:
        spreads = [line.figure(key) for key in KEYS[:3]] + [line.figure("spread", "mean")]
        cells = (f"<td>{_spread_text(one, 3)}</td>" for one in spreads)
        body.append((line, [f"<td>{html.escape(line.rows[0]['method'])}</td>", *cells]))
    return _html_table(heads, body)


_HEADS = (
    "flow FG, m", "flow BG, m", "flow all, m", "object rot., rad", "object tr., m", "ego rot., rad", "ego tr., m",
)  # fmt: skip


def _html_table(heads: Sequence[str], body: Sequence[tuple[Line, Sequence[str]]]) -> str:
    head = "".join(f"<th>{html.escape(word)}</th>" for word in heads)
    out, before = [], None
    for line, cells in body:
        classes = " ".join(
            name for name, true in (("first", line.eval_set != before), (line.kind, True)) if true and name
        )
        out.append(f'<tr class="{classes}"><td>{html.escape(line.eval_set)}</td>{"".join(cells)}</tr>')
        before = line.eval_set
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(out)}</tbody></table></div>'


def _name_html(line: Line) -> str:
    runs = f' <span class="soft">{line.runs} runs</span>' if line.runs > 1 else ""
    return html.escape(line.label) + runs


def _figure_cells(line: Line, lines: Sequence[Line]) -> list[str]:
    cells = []
    for key, _, digits in FIGURES:
        mark = ' class="best"' if _is_best(line, lines, key, digits + 1) else ""
        text = _spread_text(line.figure(key), digits + 1)
        cells.append(f"<td{mark}>{text}{_paper_html(line.paper.get(key), digits)}</td>")
    return cells


def _paper_html(value: float | None, digits: int | None) -> str:
    if value is None:
        return ""
    return (
        f'<span class="paper">{value:g}</span>' if digits is None else f'<span class="paper">{value:.{digits}f}</span>'
    )


def _spread_text(one: Spread | None, digits: int) -> str:
    if one is None:
        return _NONE
    spread = f' <span class="soft">({one.low:.{digits}f} to {one.high:.{digits}f})</span>' if one.low < one.high else ""
    return f"{one.mean:.{digits}f}{spread}"


def _seconds_text(one: Spread | None) -> str:
    if one is None:
        return _NONE
    return f"{one.mean:.{3 if one.mean < 0.1 else 2 if one.mean < 10.0 else 0}f}"


def _of(part: float, whole: int) -> str:
    return f"{part:,.0f} of {whole:,}"


def _percent(one: Spread | None) -> str:
    return _NONE if one is None else f"{100.0 * one.mean:.0f} %"


# --- LaTeX ---------------------------------------------------------------------------------------------------------

_LATEX_NONE = "n/a"  # a dash beside the paper's figure would be read as its sign
_LATEX_HEAD = r"""% Needs booktabs, graphicx and xcolor. In grey beside each figure: the paper's.
\providecommand{\paper}[1]{\,{\scriptsize\color{gray}#1}}
"""


def latex_of(rows: Sequence[Row], captions: tuple[str, str]) -> str:
    """Both tables in the paper's layout; captions may say what was scored."""
    return "\n".join([_LATEX_HEAD, _ablation_latex(rows, captions[0]), _comparison_latex(rows, captions[1])])


def _ablation_latex(rows: Sequence[Row], caption: str) -> str:
    lines = ablation_lines(rows)
    body = _latex_lines(lines, [[latex_text(line.trained_on or _NONE)] for line in lines], [[] for _ in lines], 9)
    head = _latex_head((("Eval.", "Dataset"), ("Training", "Dataset")), ())
    return _latex_table("c" * 9, head, body, caption, "tab:ablation")


def _comparison_latex(rows: Sequence[Row], caption: str) -> str:
    lines = lines_of(rows, 2)
    names = [[latex_text(line.label) + ("" if line.whole else f" ({line.rows[0]['pairs']} pairs)")] for line in lines]
    times = [[_latex_seconds(line)] for line in lines]
    head = _latex_head((("Eval.", "Dataset"), ("Method", "")), (("Time", "(s)"),))
    return _latex_table("cc*{7}cc", head, _latex_lines(lines, names, times, 10), caption, "tab:results")


def _latex_head(first: Sequence[tuple[str, str]], last: Sequence[tuple[str, str]]) -> str:
    above = [
        *(word for word, _ in first),
        r"\multicolumn{3}{c}{Scene Flow (m)}",
        r"\multicolumn{2}{c}{Object Motion}",
        r"\multicolumn{2}{c}{Ego-motion}",
        *(word for word, _ in last),
    ]
    below = [*(word for _, word in first), *(heading for _, heading, _ in FIGURES), *(word for _, word in last)]
    rule = r"\cmidrule(lr){3-5} \cmidrule(lr){6-7} \cmidrule(lr){8-9}"
    return " & ".join(above) + " \\\\\n" + rule + "\n" + " & ".join(below) + r" \\"


def _latex_lines(
    lines: Sequence[Line], before: Sequence[Sequence[str]], after: Sequence[Sequence[str]], columns: int
) -> str:
    out: list[str] = []
    for k, line in enumerate(lines):
        if k and line.eval_set != lines[k - 1].eval_set:
            out.append(rf"\cmidrule{{1-{columns}}}")
        cells = [_latex_figure(line, lines, key, digits) for key, _, digits in FIGURES]
        out.append(" & ".join([line.eval_set, *before[k], *cells, *after[k]]) + r" \\")
    return "\n".join(out)


def _latex_figure(line: Line, lines: Sequence[Line], key: str, digits: int) -> str:
    one, paper = line.figure(key), line.paper.get(key)
    text = _LATEX_NONE if one is None else f"{one.mean:.{digits}f}"
    if _is_best(line, lines, key, digits):
        text = rf"{{\bf {text}}}"
    if one is not None and line.runs > 1:
        text += rf"{{\scriptsize$\,\pm\,${(one.high - one.low) / 2.0:.{digits}f}}}"
    return text if paper is None else rf"{text}\paper{{{paper:.{digits}f}}}"


def _latex_seconds(line: Line) -> str:
    paper = line.paper.get("seconds")
    return _seconds_text(line.figure("seconds")) + ("" if paper is None else rf"\paper{{{paper:g}}}")


def _latex_table(columns: str, head: str, body: str, caption: str, label: str) -> str:
    return (
        "\\begin{table*}[t]\n\\centering\n"
        "\\resizebox{\\textwidth}{!}{%\n"
        f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{head}\n\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}}}\n"
        f"\\caption{{{caption}}}\n\\label{{{label}}}\n\\end{{table*}}\n"
    )


def latex_text(text: str) -> str:
    """With what LaTeX would take for commands written as signs."""
    for sign in "&%#_":
        text = text.replace(sign, "\\" + sign)
    return text


# --- both ----------------------------------------------------------------------------------------------------------


def _is_best(line: Line, lines: Sequence[Line], key: str, digits: int) -> bool:
    """Least of its set, as printed: equal figures are all best."""
    mine = line.figure(key)
    rivals = [one.figure(key) for one in lines if one.contends and one.eval_set == line.eval_set]
    known = [round(one.mean, digits) for one in rivals if one is not None]
    return mine is not None and line.contends and round(mine.mean, digits) == min(known)


def _within(row: Row, keys: Sequence[str]) -> float | None:
    value: Any = row
    for key in keys:
        value = value[key]
    return None if value is None else float(value)
