"""Figures of the realism report: findings in, PNGs out, each for a light and a dark page.

matplotlib (extra `view`) is imported inside the functions.
"""

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from augkitti import realism_features as rf
from augkitti.errors import InputError
from pipelines.realism_columns import COLUMNS
from pipelines.realism_findings import AIM_AUC, CLUMPS_OF_31_CARS, SET, Findings, Summary, per_track
from pipelines.two_sample import interval, mean_known, middle_known, track_weights

# Okabe and Ito's palette: told apart with any colour vision.
_COLOURS = {
    "full": "#0072B2",
    "no_noise": "#CC79A7",
    "independent": "#009E73",
    "opaque": "#A0522D",
    "all_pass": "#F0C000",
    "one_paint": "#8C6BB1",
    "snapshot": "#999999",
    "common": "#E66100",
    SET: "#00A08A",
}
_ZERO_COLOUR = "#D6336C"
_DARK_COLOURS = {**_COLOURS, "full": "#4DB2F0", "one_paint": "#B79BE0", "common": "#FF8C42", "opaque": "#D9A37A"}


@dataclass(frozen=True)
class Theme:
    """Colours of a page."""

    name: str
    paper: str
    ink: str
    faint: str
    real: str
    colours: dict[str, str]


LIGHT = Theme("light", "#ffffff", "#1f2328", "#d6dae0", "#222222", _COLOURS)
DARK = Theme("dark", "#161a20", "#e3e6ea", "#3a404a", "#f2f2f2", _DARK_COLOURS)


@dataclass(frozen=True)
class FigureOf:
    """A figure: its file's name, heading, how to read it, and what draws it."""

    name: str
    title: str
    caption: str
    draw: Callable[[Any, Findings, Theme], None]
    size_in: tuple[float, float] = (8.0, 3.6)


def label_of(name: str) -> str:
    """What a column is called in the report."""
    return {"real": "real cars", SET: "the data set's own cars"}.get(name) or COLUMNS[name][0]


def figures_of(found: Findings) -> list[FigureOf]:
    """The figures that these findings can fill."""
    rows, judged = len(found.gathered.examples), len(found.judged)
    missing = {
        "examples": not rows,
        "auc": not judged,
        "equal_counts": not found.equal,
        "seen": not found.drops,
        "resimulated": found.resimulated is None,
    }
    sizes = {"examples": (10.0, 2.3 * rows), "auc": (8.0, 1.2 + 0.42 * judged)}
    return [
        replace(figure, size_in=sizes.get(figure.name, figure.size_in))
        for figure in _FIGURES
        if not missing.get(figure.name, False)
    ]


def render(figure: FigureOf, found: Findings, theme: Theme) -> bytes:
    """A figure as PNG.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as err:
        raise InputError("realism", "needs matplotlib", "pip install 'augkitti[fit,view]'") from err
    with matplotlib.rc_context(_rc(theme)), np.errstate(all="ignore"):
        canvas = FigureCanvasAgg(Figure(figsize=figure.size_in, dpi=110, layout="constrained"))
        figure.draw(canvas.figure, found, theme)
        out = io.BytesIO()
        canvas.figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def _rc(theme: Theme) -> dict[str, Any]:
    return {
        "figure.facecolor": theme.paper,
        "axes.facecolor": theme.paper,
        "savefig.facecolor": theme.paper,
        "axes.edgecolor": theme.ink,
        "axes.labelcolor": theme.ink,
        "text.color": theme.ink,
        "xtick.color": theme.ink,
        "ytick.color": theme.ink,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.size": 9.5,
        "axes.titlesize": 10,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "axes.grid": False,
        "grid.color": theme.faint,
        "axes.axisbelow": True,
    }


# --- the figures ---------------------------------------------------------------------------------------------------


def _views(found: Findings, name: str) -> list[Summary]:
    return found.gathered.real if name == "real" else found.gathered.columns.get(name, [])


def _shown(found: Findings, names: Sequence[str]) -> Iterator[tuple[str, list[Summary]]]:
    """The named columns that have views, a data set's own cars last."""
    for name in (*names, SET):
        if _views(found, name):
            yield name, _views(found, name)


def _style(theme: Theme, name: str) -> dict[str, Any]:
    if name == "real":
        return {"color": theme.real, "lw": 2.4, "zorder": 4}
    return {"color": theme.colours[name], "lw": 2.0 if name in ("full", SET) else 1.4, "zorder": 3}


def _draw_examples(figure: Any, found: Findings, theme: Theme) -> None:
    import matplotlib
    from matplotlib.colors import ListedColormap, Normalize

    rows = found.gathered.examples
    axes = figure.subplots(len(rows), 3, squeeze=False, sharex="row", sharey="row")
    shades, colours = Normalize(0.0, 0.6), ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.3, 1.0, 128)))
    for row, example in zip(axes, rows, strict=True):
        for axis, name in zip(row, ("real", "full", "common"), strict=True):
            axis.set_xticks([])
            axis.set_yticks([])
            for spine in axis.spines.values():
                spine.set_visible(False)
            if name not in example:
                continue
            view = example[name]
            over = view.judged.is_body | view.judged.is_window | view.on_car
            missed = over & ~view.on_car
            x, y = -np.rad2deg(view.turn_rad), np.rad2deg(view.elevation_rad)
            size = float(np.clip(4000.0 / max(over.sum(), 1), 1.0, 9.0))
            axis.scatter(x[missed], y[missed], s=0.5 * size, c=theme.faint, marker="s", linewidths=0)
            seen = view.on_car
            zero, above = seen & (view.reflectance == 0.0), seen & (view.reflectance > 0.0)
            axis.scatter(x[zero], y[zero], s=size, c=_ZERO_COLOUR, marker="s", linewidths=0)
            axis.scatter(
                x[above],
                y[above],
                s=size,
                c=view.reflectance[above],
                cmap=colours,
                norm=shades,
                marker="s",
                linewidths=0,
            )
            where = f"{math.hypot(view.box[0], view.box[1]):.0f} m, " if name == "real" else ""
            axis.set_title(f"{'real' if name == 'real' else label_of(name)}: {where}{int(seen.sum()):,} points")
    figure.colorbar(
        matplotlib.cm.ScalarMappable(shades, colours),
        ax=axes,
        shrink=min(1.0, 1.6 / len(rows)),
        label="reflectance",
        extend="max",
        pad=0.01,
    )


def _draw_auc(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    names = [name for name in (*COLUMNS, SET) if name in found.judged]
    if "real" in found.equal:
        low, high = interval(found.equal["real"].auc, 0.9)
        axis.axvspan(low, high, color=theme.faint, alpha=0.6, lw=0, label="real against real (half against half)")
    axis.axvline(0.5, color=theme.ink, lw=0.8)
    axis.axvline(AIM_AUC, color=theme.ink, lw=0.8, ls=":", label=f"aim: {AIM_AUC}")
    for place, name in enumerate(names):
        value, (low, high) = found.judged[name].auc, interval(found.boot[name])
        axis.plot([low, high], [place, place], color=theme.colours[name], lw=2.5, solid_capstyle="round")
        axis.plot(
            value, place, "o", color=theme.colours[name], ms=8, label="by 32 numbers a car" if place == 0 else None
        )
        axis.annotate(
            f"{value:.2f}", (1.0, place), (8, 0), textcoords="offset points", va="center", annotation_clip=False
        )
        if name in found.points_judged:
            axis.plot(
                found.points_judged[name].auc,
                place + 0.2,
                "^",
                mfc="none",
                mec=theme.colours[name],
                ms=6,
                label="by points (small network)" if place == 0 else None,
            )
    axis.set_yticks(range(len(names)), [label_of(name) for name in names])
    axis.invert_yaxis()
    axis.set_xlim(0.35, 1.01)
    axis.set_xlabel("AUC, cars never both learned and judged")
    axis.grid(axis="x")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16 - 0.5 / len(names)), ncols=2)


def _draw_equal(figure: Any, found: Findings, theme: Theme) -> None:
    left, right = figure.subplots(1, 2, sharey=True)
    names = [name for name in ("real", "full", "common") if name in found.equal]
    for place, name in enumerate(names):
        for axis, values in ((left, found.equal[name].auc), (right, found.equal[name].separation)):
            colour = theme.real if name == "real" else theme.colours[name]
            wobble = 0.16 * np.sin(7.0 * np.arange(len(values)))
            axis.plot(values, place + wobble, "o", ms=4, alpha=0.55, color=colour, mew=0)
            middle = middle_known(values)
            axis.plot([middle, middle], [place - 0.32, place + 0.32], color=colour, lw=2.5)
            axis.annotate(f"{middle:.2f}", (middle, place - 0.34), ha="center", va="bottom", fontsize=8.5)
    left.set_yticks(range(len(names)), [f"real | {label_of(name)}" for name in names])
    left.set_ylim(len(names) - 0.4, -0.75)
    left.set_xlabel("AUC")
    left.axvline(0.5, color=theme.ink, lw=0.8)
    right.set_xlabel("mean single-number separation")
    right.set_xlim(left=0.0)
    for axis in (left, right):
        axis.grid(axis="x")


def _draw_seen(figure: Any, found: Findings, theme: Theme) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    drops = sorted(found.drops.items(), key=lambda item: item[1])
    left.barh([name for name, _ in drops], [value for _, value in drops], color=theme.colours["full"], height=0.6)
    left.set_xlabel("fall of AUC when shuffled")
    left.axvline(0.0, color=theme.ink, lw=0.8)
    rows = [(name, *pair) for name, pair in found.feature_separation.items() if math.isfinite(pair[0])]
    rows = sorted(rows, key=lambda row: row[1])[-10:]
    words = [rf.FEATURES[name] for name, _, _ in rows]
    right.barh(words, [row[1] for row in rows], color=theme.colours["full"], height=0.6, label="full model")
    right.plot(
        [row[2] for row in rows],
        range(len(rows)),
        "|",
        color=theme.real,
        ms=14,
        mew=2.5,
        ls="none",
        label="real against real, by chance",
    )
    right.set_xlabel("separation |2 AUC - 1|")
    right.legend(loc="lower center", bbox_to_anchor=(0.2, 1.0), ncols=2)
    for axis in (left, right):
        axis.grid(axis="x")


def _draw_heights(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    edges = np.array(rf.HEIGHT_EDGES)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for name, views in _shown(found, ("real", "full", "opaque", "all_pass", "common")):
        tracks = sorted({s.track for s in views})
        values = np.array([mean_known([s.heights for s in views if s.track == t]) for t in tracks])
        axis.plot(mean_known(values), middle, marker="o", ms=4, label=label_of(name), **_style(theme, name))
        if name == "real":
            low, high = np.array([interval(column, 0.8) for column in values.T]).T
            axis.fill_betweenx(middle, low, high, color=theme.faint, alpha=0.6, lw=0)
    axis.axhline(0.66, color=theme.ink, lw=0.8, ls=":")
    axis.annotate("windows", (0.005, 0.675), xycoords=("axes fraction", "data"), fontsize=8.5)
    axis.set_xlim(0.0, 1.02)
    axis.set_xlabel("share of expected rays that return from the car")
    axis.set_ylabel("height, share of the box")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid()


def _draw_windows(figure: Any, found: Findings, theme: Theme) -> None:
    left, right = figure.subplots(1, 2)
    names = [name for name in ("real", SET, *COLUMNS) if _views(found, name)]
    shades = ("#9aa0a8", "#0072B2", "#E69F00", "#009E73")
    start = np.zeros(len(names))
    shares = np.array([found.numbers[name]["window"] for name in names])
    for k, (word, shade) in enumerate(zip(("nothing", "surface", "inside", "beyond"), shades, strict=True)):
        left.barh(range(len(names)), shares[:, k], left=start, color=shade, height=0.7, label=word)
        for place, (at, share) in enumerate(zip(start, shares[:, k], strict=True)):
            if share > 0.05:
                left.annotate(
                    f"{share:.2f}"[1:], (at + share / 2, place), ha="center", va="center", color="white", fontsize=8
                )
        start = start + shares[:, k]
    left.set_yticks(range(len(names)), [label_of(name) for name in names])
    left.invert_yaxis()
    left.set_xlim(0.0, 1.0)
    left.set_xlabel("share of window rays")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, columnspacing=1.0, handlelength=1.2)
    for name, views in _shown(found, ("real", "full", "one_paint", "common")):
        rates = np.sort(per_track(views, lambda s: s.body_rate))
        right.step(
            np.append(rates, 1.0),
            np.linspace(0.0, 1.0, len(rates) + 1),
            where="post",
            label=label_of(name),
            **_style(theme, name),
        )
    right.set_xlim(0.0, 1.0)
    right.set_ylim(0.0, 1.02)
    right.set_xlabel("share of body rays that return, mean of each car")
    right.set_ylabel("share of the cars below")
    right.legend(loc="upper left")
    right.grid()


def _draw_points(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    real = found.gathered.real
    for row in found.classes:
        low, middle, high = row["real"]
        axis.fill_between(row["range_m"], low, high, color=theme.faint, alpha=0.7, lw=0)
        axis.plot(row["range_m"], [middle, middle], color=theme.real, lw=2.2)
        for name, _ in _shown(found, ("full", "common")):
            value = row["simulated"].get(name, math.nan)
            axis.plot(row["range_m"], [value, value], **_style(theme, name))
        few = "" if row["enough"] else " (few)"
        axis.annotate(
            f"{row['cars']} car{'s' if row['cars'] != 1 else ''}{few}",
            (math.sqrt(row["range_m"][0] * row["range_m"][1]), 1.01),
            xycoords=("data", "axes fraction"),
            ha="center",
            fontsize=8,
        )
    axis.plot([s.distance_m for s in real], [s.count for s in real], "o", ms=3, alpha=0.5, color=theme.real, mew=0)
    for name, _ in _shown(found, ("real", "full", "common")):
        axis.plot([], [], label=label_of(name), **_style(theme, name))
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks([4, 8, 12, 18, 25, 35, 45], ["4", "8", "12", "18", "25", "35", "45"])
    axis.minorticks_off()
    axis.set_xlabel("range (m)")
    axis.set_ylabel("points a car")
    axis.legend(loc="lower left")
    axis.grid(axis="y")


def _draw_rings(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    for name, views in _shown(found, ("real", "full", "opaque", "common")):
        weight = track_weights([s.track for s in views], np.zeros(len(views), dtype=bool))
        total = np.tensordot(weight, np.stack([s.rings / max(s.rings[:, 0].sum(), 1.0) for s in views]), 1)
        share = np.where(total[:, 0] > 0.0, total[:, 1] / np.maximum(total[:, 0], 1e-12), np.nan)
        rings = np.flatnonzero(total[:, 0] > 0.0)
        axis.plot(rings, share[rings], label=label_of(name), **_style(theme, name))
    axis.set_ylim(0.0, 1.02)
    axis.set_xlabel("ring")
    axis.set_ylabel("share returned from the car")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid()


def _draw_clumps(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    shown = list(_shown(found, ("real", "full", "independent", "one_paint", "common")))
    width = 0.8 / len(shown)
    for k, (name, _) in enumerate(shown):
        values = np.asarray(found.numbers[name]["clumps"], dtype=float)
        colour = theme.real if name == "real" else theme.colours[name]
        axis.bar(np.arange(3) + (k + 0.5) * width - 0.4, values, 0.92 * width, color=colour, label=label_of(name))
        if name == "real" and not found.is_synthetic:
            at = np.arange(3) + (k + 0.5) * width - 0.4
            axis.plot(at, CLUMPS_OF_31_CARS, "x", color=theme.colours["common"], ms=8, mew=2, ls="none")
    axis.set_xticks(range(3), ["next firing", "four firings on", "next beam"])
    axis.set_ylabel('correlation of "returned"')
    axis.axhline(0.0, color=theme.ink, lw=0.8)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid(axis="y")


def _draw_holes(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    at = np.arange(0, 101)
    for name, views in _shown(found, ("real", "full", "independent", "common")):
        lengths = np.concatenate([s.holes for s in views])
        weight = np.concatenate([s.holes / max(s.holes.sum(), 1.0) for s in views])  # each view the same
        share = [weight[lengths > n].sum() / max(weight.sum(), 1e-12) for n in at]
        axis.plot(at + 1, share, label=label_of(name), **_style(theme, name))
    axis.set_xscale("log")
    axis.set_xticks([1, 2, 4, 10, 20, 50, 100], ["1", "2", "4", "10", "20", "50", "100"])
    axis.minorticks_off()
    axis.set_ylim(0.0, 1.02)
    axis.set_xlabel("length of the hole (firings), at least")
    axis.set_ylabel("share of missed rays")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid()


def _draw_residuals(figure: Any, found: Findings, theme: Theme) -> None:
    axis = figure.subplots()
    at = np.geomspace(1.0, 300.0, 120)
    for name, views in _shown(found, ("real", "full", "no_noise", "common")):
        off = 1e3 * np.abs(np.concatenate([s.residuals for s in views]))
        if len(off):
            axis.plot(at, [(off > x).mean() for x in at], label=label_of(name), **_style(theme, name))
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_ylim(2e-3, 1.1)
    axis.set_xticks([1, 3, 10, 30, 100, 300], ["1", "3", "10", "30", "100", "300"])
    axis.minorticks_off()
    axis.set_xlabel("distance along the ray (mm)")
    axis.set_ylabel("share of points farther off")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid()


def _draw_reflectance(figure: Any, found: Findings, theme: Theme) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.4))
    shown = list(_shown(found, ("real", "full", "common")))
    width = 0.8 / len(shown)
    edges = np.arange(0, 101, 4)
    for k, (name, views) in enumerate(shown):
        counts = np.sum([s.reflectance / max(s.reflectance.sum(), 1.0) for s in views], axis=0)
        zero = counts[:, 0] / np.maximum(counts.sum(axis=1), 1e-12)
        colour = theme.real if name == "real" else theme.colours[name]
        left.bar(np.arange(2) + (k + 0.5) * width - 0.4, zero, 0.92 * width, color=colour, label=label_of(name))
        for place, value in enumerate(zero):
            left.annotate(
                f"{value:.2f}", (place + (k + 0.5) * width - 0.4, value), ha="center", va="bottom", fontsize=8
            )
        above = counts[0].copy()
        above[0] = 0.0
        binned = np.add.reduceat(above, edges[:-1]) / max(above.sum(), 1e-12)
        right.stairs(binned, edges / 100.0, label=label_of(name), **_style(theme, name))
    left.set_xticks(range(2), ["body", "window height"])
    left.set_ylabel("share exactly 0")
    left.set_ylim(0.0, 1.05)
    left.grid(axis="y")
    right.set_xlabel("reflectance above 0, on the body")
    right.set_ylabel("share")
    right.set_xlim(0.0, 1.0)
    right.set_ylim(bottom=0.0)
    right.legend()
    right.grid()


def _draw_bev(figure: Any, found: Findings, theme: Theme) -> None:
    shown = list(_shown(found, ("real", "full", "common")))
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    pictures = []
    for _, views in shown:
        weight = track_weights([s.track for s in views], np.zeros(len(views), dtype=bool))
        pictures.append(np.tensordot(weight / weight.sum(), np.stack([s.bev for s in views]), 1))
    top = max(float(np.quantile(picture, 0.99)) for picture in pictures)
    for axis, (name, _), picture in zip(axes, shown, pictures, strict=True):
        axis.imshow(picture.T, origin="lower", cmap="magma", vmin=0.0, vmax=top, aspect=0.45 * 2.0)
        axis.set_xticks([])
        axis.set_yticks([])
        jsd = found.numbers[name]["jsd_bits"]
        axis.set_title(
            f"real (half against half: JSD {jsd:.2f})" if name == "real" else f"{label_of(name)}: JSD {jsd:.2f}"
        )


def _draw_resimulated(figure: Any, found: Findings, theme: Theme) -> None:
    assert found.resimulated is not None
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.2, 1.0, 1.0))
    keys = (("both", "both"), ("real only", "real_only"), ("simulated only", "simulated_only"), ("neither", "neither"))
    shades = ("#0072B2", theme.real if theme.name == "light" else "#b8bec8", "#E66100", "#9aa0a8")
    start = np.zeros(2)
    for (word, key), shade in zip(keys, shades, strict=True):
        values = np.array([found.resimulated[zone][key] for zone in ("body", "window")])
        left.barh(range(2), values, left=start, height=0.55, color=shade, label=word)
        for place, (at, share) in enumerate(zip(start, values, strict=True)):
            if share > 0.06:
                left.annotate(
                    f"{share:.2f}"[1:],
                    (at + share / 2, place),
                    ha="center",
                    va="center",
                    color="white" if shade != "#b8bec8" else "black",
                    fontsize=8,
                )
        start = start + values
    left.set_yticks(range(2), ["body rays", "window rays"])
    left.set_ylim(1.6, -0.6)
    left.set_xlim(0.0, 1.0)
    left.set_xlabel("share of rays returned from the car")
    left.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=2)
    rays = np.concatenate(found.gathered.ray_by_ray)
    edges = np.linspace(-0.6, 0.6, 61)
    for word, zone, colour in (("body", 1, theme.colours["full"]), ("window", 2, theme.colours["common"])):
        off = rays[((rays[:, 0].astype(int) & zone) > 0) & np.isfinite(rays[:, 3]), 3]
        if len(off):
            counts, _ = np.histogram(np.clip(off, -0.6, 0.6), edges)
            middle.stairs(counts / len(off), edges, label=word, color=colour, lw=1.8)
    middle.set_xlabel("simulated less real range (m)")
    middle.set_ylabel("share of rays")
    middle.legend()
    middle.grid()
    both = rays[(rays[:, 1] > 0) & (rays[:, 2] > 0)]
    if len(both):
        right.hist2d(both[:, 4], both[:, 5], bins=np.linspace(0.0, 0.8, 21), cmap="viridis", norm="log")
    right.set_xlabel("real reflectance")
    right.set_ylabel("simulated reflectance")


_FIGURES = (
    FigureOf(
        "examples",
        "The same cars, as the scanner sees them",
        "Every ray that meets a car: coloured where it returned from the car, by reflectance, red where that is "
        "exactly 0; grey where it did not return. Left real, then the same place simulated. Windows are the holes in "
        "the upper half.",
        _draw_examples,
    ),
    FigureOf(
        "auc",
        "How well a classifier tells each from real cars",
        "0.5: not at all; 1: always. Lines: 95 % of resamples of the cars. The band is where half of the real cars is "
        "told from the other half (5 to 95 % of splits). More cars would raise all of these.",
        _draw_auc,
    ),
    FigureOf(
        "equal_counts",
        "At equal counts: half of the real cars against the other half, real or simulated",
        "Each dot is one way to halve the cars. Left: the classifier's AUC. Right: how far apart single numbers are in "
        "the mean, |2 AUC - 1|: it does not saturate as the classifier does.",
        _draw_equal,
        (8.0, 2.4),
    ),
    FigureOf(
        "seen",
        "What the classifier still sees in the full model",
        "Left: how much the AUC falls when a group of numbers is shuffled. Right: the numbers that tell most by "
        "themselves, beside what chance does with real cars.",
        _draw_seen,
        (10.0, 4.0),
    ),
    FigureOf(
        "heights",
        "Share of rays that return from the car, by height on it",
        "Above 0.66 of the height are the windows. The band holds the middle 80 % of the real cars.",
        _draw_heights,
        (8.0, 4.0),
    ),
    FigureOf(
        "windows_and_bodies",
        "What becomes of window rays, and how much of its body each car returns",
        "Left: means over cars. Right: one step a car; real cars run from dark ones that return little to ones that "
        "return nearly all.",
        _draw_windows,
        (10.0, 3.8),
    ),
    FigureOf(
        "points",
        "Points a car against range",
        "Dots: real views. Band: their middle 80 % in each class of range; lines: medians of real cars and of "
        "simulated ones in their places.",
        _draw_points,
        (8.0, 3.8),
    ),
    FigureOf(
        "rings",
        "Returns by ring",
        "Share of the rays through body and windows that return from the car, by ring (0 is the highest).",
        _draw_rings,
    ),
    FigureOf(
        "clumps",
        "Misses come in clumps",
        'Correlation of "returned" on the body with a neighbouring ray. Crosses: 31 real cars (scanner.md).',
        _draw_clumps,
    ),
    FigureOf(
        "holes",
        "Holes: how long the runs of misses on bodies are",
        "Share of the missed body rays that stand in holes of this many firings or more; every view weighs the same.",
        _draw_holes,
    ),
    FigureOf(
        "residuals",
        "Roughness: distance of points from their neighbours' line on the ring",
        "Share of points farther off than this; real cars have a heavy tail (edges, mirrors, shape).",
        _draw_residuals,
    ),
    FigureOf(
        "reflectance",
        "Reflectance",
        "Left: share of returns that are exactly 0. Right: the others, on bodies. Every view weighs the same.",
        _draw_reflectance,
        (10.0, 3.6),
    ),
    FigureOf(
        "from_above",
        "Where the points lie, from above",
        "Mean over cars, in the box grown by a tenth; the car faces right. JSD: Jensen-Shannon divergence from the "
        "real ones, in bits (0 equal, 1 nothing in common).",
        _draw_bev,
        (10.0, 2.6),
    ),
    FigureOf(
        "resimulated",
        "Resimulation: the best-fitting model and paint in each real car's place, ray by ray",
        "Left: who returned; every view weighs the same. Middle: "
        "simulated less real range where both did (the ends hold what lies beyond). Right: reflectance of both.",
        _draw_resimulated,
        (10.0, 3.6),
    ),
)
