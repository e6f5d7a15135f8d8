"""The paper's figures: what the tables were made from in, PNG files with titles and captions out.

Fig. 1 (as far as it is of LiDAR), 2, 3b, the augmentation's windows and workflow, the qualitative comparison, failures
with close cars; and errors against points per car, which the paper only writes about.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.command_line import note
from augkitti.draw import figure_to
from augkitti.frames import Array, transform_points
from augkitti.scan_pair import AugmentedPair, Bool
from training.augmentation_figures import draw_windows, draw_workflow, find_example
from training.baselines import rigid_flow
from training.equivariance import draw_chart, run_experiment
from training.network import PointFlowNet
from training.network_figure import draw_network
from training.paper_scores import MIXED, Again, PaperSets, Results, best_baselines, spread_over
from training.paper_tables import BASELINE, NETWORK, OURS, REFERENCE, lines_of
from training.pictures import BOX_COLOUR, TRUE_COLOUR, draw_boxes, draw_wheel, flow_colours
from training.predictions import Prediction
from training.score import Rules, truth_of

SCENES = (0.25, 0.5, 0.75)  # of the pairs, by our foreground error: the comparison shows neither the best nor the worst
FAILURES = 3
_PLACES = 8  # pairs tried for a good place of a car
_FEWEST_POINTS = 15  # of close cars, for a failure that can be seen
_MOST_DRAWN, _ARROWS = 20_000, 450
_AHEAD_M, _ASIDE_M = 48.0, 20.0  # of a scene, at most
_ZOOM_M = 7.0  # half a side of a close-up
_CHARTS = (
    ("fg_epe", "flow of the car's points (m)"),
    ("obj_tr_lidar", "translation of the car, in LiDAR coordinates (m)"),
)
_LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7F3B08", "#999933", "#882255")
_BESIDE = (
    "Beside the camera's view KITTI labels nothing: boxes there are neither learned nor judged, and may pile up; a "
    "baseline that follows them moves their points all the same."
)
_MARKERS = ("o", "s", "^")  # of lines that share a colour


@dataclass(frozen=True)
class Picture:
    """A figure that is written."""

    path: Path
    title: str
    caption: str


def draw_all(
    folder: Path, found: Results, again: Again, network: PointFlowNet, fig3b: tuple[int, int]
) -> list[Picture]:
    """All figures into a folder; those that the data cannot give are left out, and say so."""
    out = [_network(folder, network), *_augmentation(folder, again.sets), _fig3b(folder, *fig3b)]
    ranked = _ranked(found)
    rivals = best_baselines(found.rows)
    if ranked:
        out.append(_zoom(folder, again, ranked, rivals[:1]))
        chosen = dict.fromkeys(ranked[int(share * len(ranked))] for share in SCENES)
        out += [_comparison(folder, k, name, again, rivals) for k, name in enumerate(chosen, start=1)]
    seen = [one for one in found.close if one.points >= _FEWEST_POINTS]
    out += [_failure(folder, k, one.pair_id, again) for k, one in enumerate(seen[:FAILURES], start=1)]
    out.append(_points_chart(folder, found, again.labels))
    for picture in out:
        note(f"{picture.path}: {picture.title}")
    if not seen:
        note("no cars close to each other in the test splits: no picture of failures")
    return out


def _ranked(found: Results) -> list[str]:
    """Augmented pairs by our foreground error, from the least."""
    known = [
        (one["fg_epe"], one["pair_id"])
        for one in found.per_pair[OURS]
        if one["fg_epe"] is not None and one["pair_id"].startswith("AK:")
    ]
    return [name for _, name in sorted(known)]


def _network(folder: Path, network: PointFlowNet) -> Picture:
    path = folder / "network.png"
    draw_network(network, path)
    return Picture(
        path,
        "Network (Fig. 2)",
        "Drawn from the network that was scored: layers, shapes of what comes out, numbers of weights. Blue: encoders; "
        "orange: decoders; grey: without weights.",
    )


def _augmentation(folder: Path, sets: PaperSets) -> list[Picture]:
    """Windows and workflow, from a pair of K's test split in which a car finds a good place."""
    plain = sets.plain()
    example = find_example(plain[place] for place in spread_over(len(plain), _PLACES))
    if example is None:
        note("no pair of K has room for a virtual car: no pictures of the augmentation")
        return []
    windows, workflow = folder / "windows.png", folder / "workflow.png"
    draw_windows(example, windows)
    draw_workflow(example, workflow)
    name = example.augmented.pair_id
    return [
        Picture(
            windows,
            "Augmentation: opaque and transparent windows",
            f"The same virtual car at the same place in {name}, cast with panes of steel (left) and with panes that "
            "let the pulse through and sometimes return it (right). Returns by surface; the mesh is drawn faintly.",
        ),
        Picture(
            workflow,
            "Augmented KITTI: the workflow",
            f"A plain pair, {name}, from above, x to the right; the scanner is the triangle. Panel 5 is in the frame "
            "of scan 0: where each car is then, and would be after a half and a whole second.",
        ),
    ]


def _fig3b(folder: Path, seeds: int, steps: int) -> Picture:
    path = folder / "fig3b.png"
    draw_chart(run_experiment(seeds, steps, say=lambda text: note(f"Fig. 3b: {text}")), path)
    return Picture(
        path,
        "Rigid motion from flow, world against local coordinates (Fig. 3b)",
        f"{seeds} seeds, {steps} steps a network. `pointflownet equivariance` runs it at length.",
    )


# --- scenes --------------------------------------------------------------------------------------------------------

Limits = tuple[float, float, float, float]  # x from, to, y from, to, metres
_Panel = tuple[str, Array, Prediction | None]  # title, flow, whose boxes


def _zoom(folder: Path, again: Again, ranked: Sequence[str], rivals: Sequence[str]) -> Picture:
    """In the manner of Fig. 1: a street, and one moving car in it close up, as it is and as two methods say."""
    name = ranked[len(ranked) // 3]
    pair, said = again(name, rivals)
    box = _car_to_show(pair, again.rules)
    limits = (box[0] - _ZOOM_M, box[0] + _ZOOM_M, box[1] - _ZOOM_M, box[1] + _ZOOM_M)
    path = folder / "zoom.png"
    panels: list[_Panel] = [("truth", pair.flow0, None), *_panels(pair, said, again)]
    whole = scene_limits(again.rules)
    with figure_to(path, (5.6 * (1 + len(panels)), 6.2)) as figure:
        figure.subplots_adjust(left=0.03, right=0.99, top=0.9, bottom=0.09, wspace=0.12)
        first = _scene(figure, 1, 1 + len(panels), 1, pair, pair.flow0, whole, "scan 0; colour: true flow over ground")
        draw_boxes(first, _true_boxes(pair), TRUE_COLOUR)
        draw_wheel(first, "over ground")
        first.add_patch(_rectangle(limits))
        for k, (title, flow, prediction) in enumerate(panels, start=2):
            axes = _scene(figure, 1, 1 + len(panels), k, pair, flow, limits, title, size=8.0, arrows=140)
            _boxes_of(axes, pair, prediction, again.rules)
        figure.suptitle(name, x=0.03, ha="left", fontsize=11)
    return Picture(
        path,
        "A moving car close up (in the manner of Fig. 1)",
        "Arrows: flow as the driving scanner sees it; colour: flow over ground, by direction. Blue: true boxes; "
        "orange: detections with their motion. The paper's Fig. 1 also has ISF, which needs camera images: it is out "
        f"of scope, all here is from LiDAR alone. Of all pairs by our foreground error, a quarter is better: {name}.",
    )


def _comparison(folder: Path, number: int, name: str, again: Again, rivals: Sequence[str]) -> Picture:
    """Truth, ours and two baselines on one scene."""
    pair, said = again(name, rivals)
    path = folder / f"comparison{number}.png"
    panels: list[_Panel] = [("(a) truth", pair.flow0, None)]
    for letter, (title, flow, prediction) in zip("bcd", _panels(pair, said, again), strict=False):
        panels.append((f"({letter}) {title}", flow, prediction))
    limits = scene_limits(again.rules)
    with figure_to(path, (13.0, 13.0 * (limits[1] - limits[0]) / (limits[3] - limits[2]) + 1.0)) as figure:
        figure.subplots_adjust(left=0.05, right=0.99, top=0.94, bottom=0.05, wspace=0.1, hspace=0.14)
        for k, (title, flow, prediction) in enumerate(panels, start=1):
            axes = _scene(figure, 2, 2, k, pair, flow, limits, title)
            _boxes_of(axes, pair, prediction, again.rules)
            if k == 1:
                draw_wheel(axes, "over ground")
        figure.suptitle(name, x=0.05, ha="left", fontsize=11)
    return Picture(
        path,
        f"Qualitative comparison, scene {number}",
        f"{name}. Colour: flow over ground, by direction, with the true ego-motion taken off in all panels, so that a "
        "wrong ego-motion tints the street; arrows: the flow itself. A subset of the points. Blue: true boxes; orange: "
        "boxes that the method follows, with their motion. The baselines are the two with the least foreground error. "
        + _BESIDE,
    )


def _failure(folder: Path, number: int, name: str, again: Again) -> Picture:
    """Cars close to each other, as they are and as the network has them."""
    pair, said = again(name)
    truth = truth_of(pair, again.rules)
    rows = np.flatnonzero(truth.close & truth.judged)
    error = np.linalg.norm(whole_flow(pair, said[OURS], OURS)[truth.rows] - truth.flow, axis=1)
    worst = max(rows, key=lambda row: float(error[truth.object == row].sum()))
    x, y = truth.boxes[worst, :2]
    limits = (x - _ZOOM_M, x + _ZOOM_M, y - _ZOOM_M, y + _ZOOM_M)
    here = np.isin(truth.object, rows)
    path = folder / f"close{number}.png"
    with figure_to(path, (12.0, 6.4)) as figure:
        figure.subplots_adjust(left=0.06, right=0.99, top=0.87, bottom=0.09, wspace=0.14)
        for k, (title, flow, prediction) in enumerate([("truth", pair.flow0, None), *_panels(pair, said, again)], 1):
            axes = _scene(figure, 1, 2, k, pair, flow, limits, title, size=8.0, arrows=140)
            _boxes_of(axes, pair, prediction, again.rules)
            if k == 1:
                draw_wheel(axes, "over ground")
        figure.suptitle(
            f"{name}: flow off by {error[here].mean():.2f} m on the {here.sum()} points of close cars", x=0.06,
            ha="left", fontsize=11,
        )  # fmt: skip
    return Picture(
        path,
        f"Failures with close cars, {number}",
        "Cars less than 4 m from another, where our flow is worst. Blue: true boxes; orange: detections with their "
        "score and motion. " + _BESIDE,
    )


def scene_limits(rules: Rules) -> Limits:
    """The nearer part of the grid."""
    grid = rules.grid
    return (
        grid.x_m[0], min(grid.x_m[1], _AHEAD_M), max(grid.y_m[0], -_ASIDE_M), min(grid.y_m[1], _ASIDE_M)
    )  # fmt: skip


def whole_flow(pair: AugmentedPair, said: Prediction, name: str) -> Array:
    """A method's flow (N0, 3) of all points: its ego-motion's where it has no estimate, or none."""
    rest = np.zeros_like(pair.scan0.xyz) if said.ego_motion is None else rigid_flow(said.ego_motion, pair.scan0.xyz)
    return np.where(said.where[:, None], said.flows[name], rest)


def _panels(pair: AugmentedPair, said: dict[str, Prediction], again: Again) -> list[_Panel]:
    """Title with its own error, flow, prediction: ours first."""
    truth = truth_of(pair, again.rules)
    out: list[_Panel] = []
    for name, prediction in said.items():
        flow = whole_flow(pair, prediction, name)
        error = np.linalg.norm(flow[truth.rows] - truth.flow, axis=1)
        parts = [
            f"{part} {error[mine].mean():.2f} m" for part, mine in (("FG", truth.fg), ("BG", truth.bg)) if mine.any()
        ]
        out.append((f"{again.labels[name]}: {', '.join(parts)}", flow, prediction))
    return out


def _scene(
    figure: Any,
    lines: int,
    columns: int,
    number: int,
    pair: AugmentedPair,
    flow: Array,
    limits: Limits,
    title: str,
    size: float = 2.2,
    arrows: int = _ARROWS,
) -> Any:
    """A panel: points of known flow from above, x up and left stays left, coloured by their flow over ground."""
    x0, x1, y0, y1 = limits
    axes = figure.add_subplot(lines, columns, number)
    axes.set(xlim=(-y1, -y0), ylim=(x0, x1), aspect="equal")
    axes.set_title(title, fontsize=10, loc="left")
    axes.tick_params(labelsize=7)
    axes.xaxis.set_major_formatter(lambda value, _: f"{0.0 - value:g}")
    axes.set_xlabel("y, m", fontsize=8, labelpad=1)
    axes.set_ylabel("x, m", fontsize=8, labelpad=1)
    xyz = pair.scan0.xyz
    rows = np.flatnonzero(_within(xyz, limits) & (pair.flow_status0 == 0))
    rows = _some(rows, _MOST_DRAWN)
    static = transform_points(pair.ego_motion, xyz[rows]) - xyz[rows]
    over_ground = flow[rows] - static
    moving = pair.scan0.instance[rows] >= 0
    order = np.argsort(moving, kind="stable")  # cars above the road
    at, colours = xyz[rows][order], flow_colours(over_ground[order, :2])
    axes.scatter(-at[:, 1], at[:, 0], s=size * np.where(moving[order], 1.6, 1.0), c=colours, linewidths=0)
    shown = np.concatenate([_some(rows[~moving], arrows // 2), _some(rows[moving], arrows // 2)])
    axes.quiver(
        -xyz[shown, 1], xyz[shown, 0], -flow[shown, 1], flow[shown, 0], angles="xy", scale_units="xy", scale=1.0,
        width=0.0016, color="#222222", alpha=0.6,
    )  # fmt: skip
    return axes


def _boxes_of(axes: Any, pair: AugmentedPair, said: Prediction | None, rules: Rules) -> None:
    """True boxes, and those that a method follows."""
    draw_boxes(axes, _true_boxes(pair), TRUE_COLOUR)
    if said is not None and said.boxes is not None and said.scores is not None:
        sure = said.scores >= rules.score
        motions = None if said.motions is None else said.motions[sure]
        draw_boxes(axes, said.boxes[sure], BOX_COLOUR, motions, said.scores[sure])


def _car_to_show(pair: AugmentedPair, rules: Rules) -> Array:
    """Box of a car that moves far and has many points; of the one with most where none moves."""
    truth = truth_of(pair, rules)
    points = np.sqrt(np.where(truth.counts, truth.on_points, 0))
    moving = points * np.nan_to_num(truth.own_motion_m)
    return np.asarray(truth.boxes[int(np.argmax(moving if moving.any() else points))])


def _true_boxes(pair: AugmentedPair) -> Array:
    return np.array([item.box0 for item in pair.objects if item.box0 is not None]).reshape(-1, 7)


def _within(xyz: Array, limits: Limits) -> Bool:
    x0, x1, y0, y1 = limits
    return np.asarray((xyz[:, 0] >= x0) & (xyz[:, 0] < x1) & (xyz[:, 1] >= y0) & (xyz[:, 1] < y1))


def _some(rows: Array, most: int) -> Array:
    """At most so many, spread over all."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] if len(rows) else rows


def _rectangle(limits: Limits) -> Any:
    from matplotlib.patches import Rectangle

    x0, x1, y0, y1 = limits
    return Rectangle((-y1, x0), y1 - y0, x1 - x0, fill=False, ec="#000000", lw=1.6)


# --- errors against points -----------------------------------------------------------------------------------------


def _points_chart(folder: Path, found: Results, labels: Mapping[str, str]) -> Picture:
    """Foreground and object errors by points on the car, a line a method."""
    path = folder / "points.png"
    lines = [line for line in lines_of(found.rows, 2) if line.eval_set == MIXED]
    lines = [line for line in lines if line.kind in (BASELINE, REFERENCE) or line.rows[0]["method"] == OURS]
    bins = lines[-1].rows[0]["by_points"]
    used = [k for k, one in enumerate(bins) if one["fg_points"]]
    names = [
        f"{bins[k]['from']:g}+" if bins[k]["to"] is None else f"{bins[k]['from']:g}-{bins[k]['to']:g}" for k in used
    ]
    with figure_to(path, (14.0, 5.6)) as figure:
        figure.subplots_adjust(left=0.05, right=0.8, top=0.9, bottom=0.2, wspace=0.18)
        for number, (key, title) in enumerate(_CHARTS, start=1):
            axes = figure.add_subplot(1, 2, number)
            for place, line in enumerate(lines):
                colour = _LINES[place % len(_LINES)]
                marker = _MARKERS[place // len(_LINES) % len(_MARKERS)]
                values = [_mean([row["by_points"][k][key] for row in line.rows]) for k in used]
                if np.isfinite(values).any():
                    label = labels[line.rows[0]["method"]]
                    style = "-" if line.kind == NETWORK else ":" if line.kind == REFERENCE else "--"
                    width = 2.6 if line.kind == NETWORK else 1.4
                    axes.plot(range(len(used)), values, style, marker=marker, ms=5, color=colour, lw=width, label=label)
            cars = (f"{name}\n{bins[k]['objects']:,}" for name, k in zip(names, used, strict=True))
            axes.set_xticks(range(len(used)), list(cars), fontsize=8)
            _log_scale(axes)
            axes.set_xlabel("points on the car; cars to find, in all")
            axes.set_title(title, fontsize=11, loc="left")
            axes.grid(alpha=0.3)
            if number == 1:
                legend = axes.get_legend_handles_labels()
        figure.legend(*legend, loc="center left", bbox_to_anchor=(0.81, 0.5), frameon=False, fontsize=9)
    return Picture(
        path,
        "Errors against points per car",
        "K and AK, test splits. The paper's reason for ICP's large object errors: cars with few points weigh little in "
        "the mean over points and as much as any other in the mean over cars. Right: cars found, for methods that "
        "follow them. Methods scored on fewer pairs (3DMatch) have fewer cars than the axis says. Points without an "
        "estimate (Dewan et al.) count here as moving with the method's ego-motion.",
    )


def _log_scale(axes: Any) -> None:
    """With figures that are read without counting powers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")
