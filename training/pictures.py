"""Pictures of flow: points, flow and boxes in, one PNG from above out; with the truth beside it where there is one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.draw import figure_to
from augkitti.frames import F64, Array, footprint_corners, transform_points
from augkitti.scan_pair import Bool

_MOST_POINTS = 40_000  # more only fill the picture
_ARROWS = 900
_EGO_COLOUR, BOX_COLOUR, TRUE_COLOUR = "#333333", "#D55E00", "#0072B2"


def draw_flow(
    path: Path,
    xyz0: Array,
    flow0: Array,
    where: Bool,
    limits_m: tuple[float, float, float, float],
    ego_motion: F64 | None = None,
    boxes: Array | None = None,
    motions: Array | None = None,
    scores: Array | None = None,
    truth: Array | None = None,
    known: Bool | None = None,
    true_boxes: Array | None = None,
    title: str = "",
) -> None:
    """One PNG from above.

    Colour is the direction of a point's flow over ground (less the ego-motion's, where that is given), its strength the
    speed: standing things are grey; a wheel of colours says which is which. Arrows are the flow itself, as scan 1 sees
    it from the driving car.

    Args:
        path: the PNG to write.
        xyz0: (N, 3) points of scan 0, metres, velo0.
        flow0: (N, 3) metres.
        where: (N,) points that have a flow; others are drawn pale.
        limits_m: x from, to, y from, to.
        ego_motion: (4, 4) T_velo1_velo0.
        boxes: (n, 7); motions: (n, 4, 4); scores: (n,) of detected cars.
        truth: (N, 3) true flow: then a panel of its own, and one of errors.
        known: (N,) points whose true flow is known.
        true_boxes: (m, 7).
        title: over all.

    Raises:
        InputError: matplotlib is missing, or the picture cannot be written.
    """
    x0, x1, y0, y1 = limits_m
    inside = (xyz0[:, 0] >= x0) & (xyz0[:, 0] < x1) & (xyz0[:, 1] >= y0) & (xyz0[:, 1] < y1)
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _MOST_POINTS)).astype(int)]
    points, shown = xyz0[chosen], where[chosen]
    static = np.zeros_like(points, dtype=np.float64)
    if ego_motion is not None:
        static = transform_points(ego_motion, points) - points
    panels: list[tuple[str, Array, Bool]] = [("predicted flow; cars found in orange", flow0[chosen], shown)]
    if truth is not None:
        panels.insert(
            0, ("true flow; labelled objects in blue", truth[chosen], shown if known is None else known[chosen] & shown)
        )
    count = len(panels) + (truth is not None)
    tall = 9.0 * (x1 - x0) / (y1 - y0)
    with figure_to(path, (9.0 * count, tall + 0.9)) as figure:
        figure.subplots_adjust(
            left=0.07 / count, right=1 - 0.02 / count, top=1 - 0.7 / (tall + 0.9), bottom=0.5 / (tall + 0.9), wspace=0.1
        )
        for number, (name, flow, marked) in enumerate(panels, start=1):
            axes = _axes(figure, count, number, limits_m, name)
            colours = np.full((len(points), 3), 0.86)
            colours[marked] = flow_colours((flow - static)[marked, :2])
            axes.scatter(-points[:, 1], points[:, 0], s=1.2, c=colours, linewidths=0)
            rows = np.flatnonzero(marked)
            rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _ARROWS)).astype(int)] if len(rows) else rows
            axes.quiver(
                -points[rows, 1], points[rows, 0], -flow[rows, 1], flow[rows, 0],
                angles="xy", scale_units="xy", scale=1.0, width=0.0012, color=_EGO_COLOUR, alpha=0.55,
            )  # fmt: skip
            if flow is panels[-1][1]:
                draw_boxes(axes, boxes, BOX_COLOUR, motions, scores)
            else:
                draw_boxes(axes, true_boxes, TRUE_COLOUR)
            draw_wheel(axes, "over ground" if ego_motion is not None else "as seen")
        if truth is not None:
            axes = _axes(figure, count, count, limits_m, "error of the predicted flow: grey 0, red 0.5 m and more")
            error = np.linalg.norm(flow0[chosen] - truth[chosen], axis=1)
            marked = panels[0][2]
            shade = np.clip(error / 0.5, 0.0, 1.0)[:, None]
            colours = np.where(marked[:, None], (1 - shade) * [0.85, 0.85, 0.85] + shade * [0.8, 0.0, 0.0], 0.95)
            order = np.argsort(error * marked)
            axes.scatter(-points[order, 1], points[order, 0], s=1.2, c=colours[order], linewidths=0)
            draw_boxes(axes, true_boxes, TRUE_COLOUR)
            draw_boxes(axes, boxes, BOX_COLOUR)
        figure.suptitle(title, x=0.02 / count, ha="left", fontsize=12)


def flow_colours(flow_xy: Array, full_m: float = 1.0) -> F64:
    """Colours (N, 3) of planar flow (N, 2): hue is the direction, strength the length up to `full_m`; still is grey."""
    from matplotlib.colors import hsv_to_rgb

    flow = np.asarray(flow_xy, dtype=np.float64)
    strength = np.clip(np.linalg.norm(flow, axis=1) / full_m, 0.0, 1.0)
    hue = np.arctan2(flow[:, 1], flow[:, 0]) / (2 * np.pi) % 1.0
    return np.asarray(hsv_to_rgb(np.stack([hue, strength, 0.62 + 0.3 * strength], axis=1)))


def _axes(figure: Any, count: int, number: int, limits_m: tuple[float, float, float, float], title: str) -> Any:
    x0, x1, y0, y1 = limits_m
    axes = figure.add_subplot(1, count, number)
    axes.set_xlim(-y1, -y0)  # left stays left
    axes.set_ylim(x0, x1)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    axes.xaxis.set_major_formatter(lambda value, _: f"{0.0 - value:g}")
    axes.set_xlabel("y, m", fontsize=8, labelpad=1)
    axes.set_ylabel("x, m", fontsize=8, labelpad=1)
    return axes


def draw_wheel(axes: Any, what: str, ahead_is_up: bool = True) -> None:
    """Which colour is which flow, in a corner where no street is: directions as in the picture, rim 1 m.

    A picture has x up and y to the left, or x to the right and y up.
    """
    inset = axes.inset_axes((0.01, 0.01, 0.11, 0.11))
    side = np.linspace(-1.0, 1.0, 81)
    right, up = (grid.ravel() for grid in np.meshgrid(side, side))
    disc = np.hypot(right, up) <= 1.0
    xy = np.stack([up, -right] if ahead_is_up else [right, up], axis=1)
    colours = flow_colours(xy[disc], 1.0)
    inset.scatter(right[disc], up[disc], s=1.5, c=colours, linewidths=0)
    inset.set_aspect("equal")
    inset.axis("off")
    axes.annotate(
        f"flow {what},\nrim 1 m", (0.13, 0.055), xycoords="axes fraction", fontsize=7, va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )  # fmt: skip


def draw_boxes(
    axes: Any,
    boxes: Array | None,
    colour: str,
    motions: Array | None = None,
    scores: Sequence[float] | Array | None = None,
) -> None:
    """Outlines of boxes (n, 7) from above with the heading; where each goes by its motion (4, 4), and its score."""
    for row, box in enumerate(boxes if boxes is not None else ()):
        corners = footprint_corners(box)
        loop = np.concatenate([corners, corners[:1], (corners[:1] + corners[3:]) / 2, np.asarray(box)[None, :2]])
        axes.plot(-loop[:, 1], loop[:, 0], color=colour, linewidth=1.1)
        if motions is not None:
            end = transform_points(motions[row], np.asarray(box, dtype=np.float64)[:3])
            axes.annotate(
                "", (-end[1], end[0]), (-box[1], box[0]),
                arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip
        if scores is not None:
            axes.annotate(
                f"{scores[row]:.2f}",
                (-corners[:, 1].min(), corners[:, 0].max()),
                fontsize=7,
                color=colour,
                annotation_clip=True,
            )
