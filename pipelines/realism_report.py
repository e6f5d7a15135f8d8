"""The realism report: findings in, one HTML page that stands alone, `realism.json` and a PNG of each figure out.

Each figure is on the page twice, for light and dark; the PNGs in `figures/` are the light ones.
"""

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path

from augkitti import realism_features as rf
from augkitti.errors import InputError
from pipelines.realism_columns import COLUMNS
from pipelines.realism_figures import DARK, LIGHT, FigureOf, figures_of, label_of, render
from pipelines.realism_findings import SET, Findings, write_json
from pipelines.two_sample import interval, mean_known, middle_known


def write_report(found: Findings, folder: Path) -> None:
    """Write `index.html`, `realism.json` and `figures/*.png` into a folder.

    Raises:
        InputError: it cannot be written, or matplotlib is not installed.
    """
    try:
        pictures = folder / "figures"
        pictures.mkdir(parents=True, exist_ok=True)
        write_json(found, folder / "realism.json")
        parts = []
        for figure in figures_of(found):
            light, dark = (render(figure, found, theme) for theme in (LIGHT, DARK))
            (pictures / f"{figure.name}.png").write_bytes(light)
            parts.append(_figure_html(figure, light, dark))
        (folder / "index.html").write_text(_page(found, parts), encoding="utf-8")
    except OSError as err:
        raise InputError(folder, f"cannot be written ({err.strerror})", "name another folder with --out") from err


# --- the page ------------------------------------------------------------------------------------------------------

_CSS = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1f2328; --soft: #59636e; --line: #d6dae0; --pass: #1a7f37;
  --fail: #c4320a; --tint: #f4f6f8; }
@media (prefers-color-scheme: dark) { :root { --paper: #161a20; --ink: #e3e6ea; --soft: #9aa4b0; --line: #3a404a;
  --pass: #4ac26b; --fail: #ff8a65; --tint: #1e242c; } }
* { box-sizing: border-box; }
body { background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; max-width: 68rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin: 0 0 .5rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .3rem; }
.verdict { background: var(--tint); border-left: .3rem solid var(--edge); padding: .9rem 1.1rem; font-size: 1.08rem; }
.soft, figcaption { color: var(--soft); font-size: .92rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .28rem .55rem; border-bottom: 1px solid var(--line); vertical-align: top; }
th:first-child, td:first-child, .checks td { text-align: left; }
th { font-weight: 600; color: var(--soft); vertical-align: bottom; }
td { white-space: nowrap; } .checks td { white-space: normal; }
tr.chief td { font-weight: 600; }
.pass { color: var(--pass); font-weight: 600; } .fail { color: var(--fail); font-weight: 600; }
figure { margin: 0; } figure img { max-width: 100%; height: auto; display: block; }
"""


def _page(found: Findings, figures: Sequence[str]) -> str:
    edge = "var(--pass)" if all(check.passed for check in found.checks) else "var(--fail)"
    views = len(found.gathered.real)
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
            f"<title>How real are the simulated cars?</title><style>{_CSS}</style></head><body>",
            "<h1>How real are the simulated cars?</h1>",
            f'<p class="verdict" style="--edge: {edge}">{html.escape(found.verdict)}</p>',
            f'<p class="soft">{found.tracks} labelled cars and vans, {views} views of them, 4 to 45 m, in '
            f"{html.escape(found.source)}. Simulated cars stand in their places, on the same rays: range, bearing, "
            "heading and size are alike, and so are crop, ground trim and rounding.</p>",
            *(f'<p class="soft">{html.escape(note)}</p>' for note in found.notes),
            "<h2>What was asked for</h2>",
            _checks_html(found),
            "<h2>Figures by model</h2>",
            _columns_html(found),
            *figures,
            "<h2>How it was done, and what it cannot say</h2>",
            _method_html(found),
            "</body></html>\n",
        ]
    )


def _checks_html(found: Findings) -> str:
    words = {True: '<span class="pass">yes</span>', False: '<span class="fail">no</span>', None: "cannot tell"}
    rows = [
        f"<tr><td>{words[check.passed]}</td><td>{html.escape(check.name)}</td><td>{html.escape(check.detail)}</td></tr>"
        for check in found.checks
    ]
    return f'<div class="wide"><table class="checks">{"".join(rows)}</table></div>'


def _columns_html(found: Findings) -> str:
    names = [name for name in ("real", *COLUMNS, SET) if name in found.numbers]

    def several(values: Sequence[float]) -> str:
        return "&thinsp;/&thinsp;".join(_two(value)[1:] if 0.0 <= value < 0.995 else _two(value) for value in values)

    alike, seen = [], []
    for name in names:
        its = found.numbers[name]
        value, spread, apart = math.nan, (math.nan, math.nan), its["separation"]
        if name in found.judged:
            value, spread = found.judged[name].auc, interval(found.boot[name])
        by_points = found.points_judged[name].auc if name in found.points_judged else math.nan
        alike.append(
            [
                _with_spread(value, spread) if name in found.judged else "below",
                _two(by_points),
                _two(apart),
                _two(its["mmd"]),
                _two(its["jsd_bits"]),
                _two(its["chamfer"]),
            ]
        )
        seen.append(
            [
                several(its["window"]),
                several(its["body_quantiles"]),
                several(its["clumps"]),
                several((its["zero_body"], its["zero_window"])),
                f"{its['residual_mm']:.0f}",
                _two(its["residual_tail"]),
            ]
        )
    what = "".join(
        f"<li><b>{html.escape(label_of(name))}</b>: {html.escape(COLUMNS[name][1])}</li>"
        for name in names
        if name in COLUMNS
    )
    return (
        _table(
            ("", "AUC", "by points", "separation", "MMD&sup2;", "JSD, bits", "Chamfer"),
            names,
            alike,
            "real against real",
        )
        + '<p class="soft">AUC: 0.5 cannot be told, 1 always; in brackets 95 % of resamples of the cars. Separation: '
        "mean of |2 AUC - 1| over single numbers. MMD&sup2;: of the same numbers. JSD: of the points seen from above. "
        "Chamfer: density-aware, 0 alike, 1 not. Real against real: one half of the cars against the other; Chamfer of "
        "the same car one view on.</p>"
        + _equal_html(found)
        + _table(
            (
                "",
                "window: nothing / surface / inside / beyond",
                "body returns: 10 / 50 / 90 %",
                "clumps: next / four on / beam",
                "zeros: body / window",
                "rough, mm",
                "over 4 cm",
            ),
            names,
            seen,
            label_of("real"),
        )
        + f'<ul class="soft">{what}</ul>'
    )


def _equal_html(found: Findings) -> str:
    """What chance does: classifiers and single numbers at equal counts."""
    rows, names = [], [name for name in ("real", "full", "common") if name in found.equal]
    for name in names:
        one = found.equal[name]
        low, high = interval(one.auc, 0.9)
        rows.append(
            [
                _with_spread(middle_known(one.auc), (low, high)),
                _two(float(mean_known(one.separation))),
            ]
        )
    if not rows:
        return ""
    return (
        _table(("half of the real cars against the other half", "AUC", "separation"), names, rows, "real")
        + '<p class="soft">AUC grows with the number of cars: only these compare with real against real. In brackets '
        f"5 to 95 % of {len(found.equal['real'].auc)} ways to halve the cars.</p>"
    )


def _table(heads: Sequence[str], names: Sequence[str], rows: Sequence[Sequence[str]], real: str) -> str:
    head = "".join(f"<th>{word}</th>" for word in heads)
    lines = []
    for name, cells in zip(names, rows, strict=True):
        chief = ' class="chief"' if name in ("real", "full") else ""
        title = html.escape(real if name == "real" else label_of(name))
        lines.append(f"<tr{chief}><td>{title}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    return f'<div class="wide"><table><tr>{head}</tr>{"".join(lines)}</table></div>'


def _with_spread(value: float, spread: tuple[float, float]) -> str:
    return f"{_two(value)} <span class='soft'>({_two(spread[0])} to {_two(spread[1])})</span>"


def _two(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def _method_html(found: Findings) -> str:
    few = (
        "<li>With so few cars the intervals are wide; AUC also grows with the number of cars, so figures of different "
        "roots do not compare.</li>"
        if found.tracks < 100
        else ""
    )
    return (
        "<ul><li>A view is every fired ray that meets a label's box and that nothing stopped before it. Its returns "
        "are the car's within the box grown by 0.1 m and more than 0.15 m above its floor.</li>"
        "<li>The classifier is the mean of a logistic regression and randomised trees on "
        f"{len(rf.FEATURES)} numbers of a view. Views of one car are never both learned and judged; every car weighs "
        "the same; intervals are of resamples of the cars, with the classifiers as they are.</li>"
        "<li>The model in a car's place is the one whose size fits best, stretched by at most 8 % along each axis; "
        "paint and tint are spread evenly over the cars; shares and quantiles of the full model are of four cars in "
        "each place. Cars move through the sweep by their labels in the scans next "
        "to it.</li>"
        "<li>Boxes are a crude cabin: pillars and the roof's edge count as window, for real and simulated cars alike. "
        f"Labels are loose by centimetres.</li>{few}</ul>"
    )


def _figure_html(figure: FigureOf, light: bytes, dark: bytes) -> str:
    day, night = (f"data:image/png;base64,{base64.b64encode(png).decode()}" for png in (light, dark))
    title = html.escape(figure.title)
    return (
        f'<h2 id="{figure.name}">{title}</h2><figure><picture>'
        f'<source media="(prefers-color-scheme: dark)" srcset="{night}"><img alt="{title}" src="{day}">'
        f"</picture><figcaption>{html.escape(figure.caption)}</figcaption></figure>"
    )
