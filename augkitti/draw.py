"""Pictures: an augmented pair in, one PNG out that shows it from above, as range images, and each virtual car close up.

matplotlib (extra `view`) is imported inside the functions, so that generating needs none of it; drawing goes to its Agg
canvas directly, without a window system and without global state.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import F64, Array, footprint_corners, invert, transform_points
from augkitti.scan_pair import (
    MEASURED,
    SURFACE_NAMES,
    AugmentedPair,
    AugmentedScan,
    Bool,
    CarModel,
    DrivableRegion,
    GroundMap,
    ObjectRecord,
    Scan,
)
from augkitti.scanner import ScannerProfile, assign_rays, load_profile

# Okabe and Ito's palette: told apart with any colour vision.
CAR_COLOURS = ("#0072B2", "#E69F00", "#CC79A7", "#009E73", "#56B4E9", "#F0E442")
SURFACE_COLOURS = ("#9A9A9A", "#0072B2", "#56B4E9", "#000000", "#E69F00", "#009E73", "#CC79A7", "#7F3B08")
REMOVED_COLOUR = "#DD0000"
REGION_COLOUR = "#D9EFE3"
LABEL_COLOUR = "#333333"
_COLUMNS = 2083  # of a range image: 360 degrees at 0.1728, the step of a firing
_CLOSE_M = 1.6  # what lies this far round a car is drawn with it
_EGO_OUTLINE = (-2.7, 1.6, -0.9, 0.9)  # rear, front, right, left of the ego car round its scanner, metres
_HEIGHTS_M = (-0.2, 3.0)  # grey from light to dark
_CREASE_COS = 0.8  # edges sharper than this are drawn


def draw_pair(
    pair: AugmentedPair,
    path: Path,
    source0: Scan | None = None,
    source1: Scan | None = None,
    region: DrivableRegion | None = None,
    ground: GroundMap | None = None,
    models: Sequence[CarModel] | None = None,
    profile: ScannerProfile | None = None,
) -> None:
    """One PNG of a pair.

    From above, in velo0: points by height, virtual cars at both moments with their flow, labelled boxes, and what else
    is given. Boxes of scan 1 stand at their velo1 coordinates, where the flow arrows end. Below: each virtual car seen
    from the scanner's side in its own frame, coloured by surface; the range images before and after.

    Args:
        pair: the pair to draw.
        path: the PNG to write.
        source0: scan 0 as the real scanner wrote it: shows what the cars hide, and the range image before.
        source1: scan 1 likewise; adds its range image before.
        region: where cars may stand, of scan 0.
        ground: of scan 0; heights are then above the local ground, else above 1.73 m under the scanner.
        models: CAD models; a virtual car whose model is among them gets its outline.
        profile: the scanner; without: KITTI's.

    Raises:
        InputError: matplotlib is missing, or the picture cannot be written.
    """
    cars = [(row, item) for row, item in enumerate(pair.objects) if item.origin == "virtual" and item.pose0 is not None]
    named = {model.name: model for model in models or ()}
    scanner = profile or load_profile()
    removed = np.zeros((0, 3)) if source0 is None else source0.xyz[np.isin(source0.row, pair.scan0.removed)]
    images: list[tuple[str, Scan | AugmentedScan]] = []
    for k, source, after in ((0, source0, pair.scan0), (1, source1, pair.scan1)):
        if source is not None:
            images.append((f"range image of scan {k}, before", source))
        images.append((f"range image of scan {k}, after", after))
    rows = [7.7, 4.4, *[1.2] * len(images)]
    height = 3.0 + 1.06 * sum(rows)
    with figure_to(path, (16.0, height)) as figure:
        layout = figure.add_gridspec(len(rows), 1, height_ratios=rows, hspace=0.24)
        figure.subplots_adjust(left=0.035, right=0.985, top=1.0 - 1.15 / height, bottom=0.45 / height)
        figure.suptitle(pair.pair_id, x=0.035, y=1.0 - 0.2 / height, ha="left", fontsize=17, fontweight="bold")
        figure.text(0.035, 1.0 - 0.66 / height, _summary(pair), fontsize=10.5, color="#444444", va="center")
        _draw_from_above(figure.add_subplot(layout[0]), pair, cars, removed, region, ground)
        _draw_cars(figure, layout[1], pair, cars, removed, named)
        for slot, (title, scan) in enumerate(images, start=2):
            _draw_range_image(figure.add_subplot(layout[slot]), scan, cars, title, slot == len(rows) - 1, scanner)


@contextmanager
def figure_to(path: Path, size_inches: tuple[float, float]) -> Iterator[Any]:
    """A white figure, written to `path` at the end."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as err:
        raise InputError("matplotlib", "is not installed", "pip install 'augkitti[view]'") from err
    figure = Figure(figsize=size_inches, dpi=110, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    yield figure
    try:
        canvas.print_png(path, metadata={"Software": None})
    except OSError as err:
        raise InputError(path, f"cannot be written ({err.strerror})", "name a PNG in a folder that exists") from err


def _summary(pair: AugmentedPair) -> str:
    step = float(np.hypot(pair.ego_motion[0, 3], pair.ego_motion[1, 3]))
    labelled = sum(item.origin == "labelled" for item in pair.objects)
    virtual = len(pair.objects) - labelled
    interval = pair.time1 - pair.time0
    speed = f"{step / interval:.1f} m/s" if interval > 0 else f"{step:.2f} m a scan"
    simulated = int((pair.scan0.source < 0).sum())
    return (
        f"frames {pair.frame0} and {pair.frame1} · {pair.scan_kind} scans · ego car {speed} ({pair.ego_source}) · "
        f"{virtual} virtual and {labelled} labelled objects (coverage: {pair.label_coverage}) · "
        f"scan 0: {len(pair.scan0):,} points, {simulated:,} simulated, {len(pair.scan0.removed):,} removed · "
        f"flow unknown at {100.0 * float(pair.flow_status0.mean()):.1f} %"
    )


def _colour(number: int) -> str:
    return CAR_COLOURS[number % len(CAR_COLOURS)]


# --- from above ----------------------------------------------------------------------------------------------------


def _draw_from_above(
    axes: Any,
    pair: AugmentedPair,
    cars: list[tuple[int, ObjectRecord]],
    removed: Array,
    region: DrivableRegion | None,
    ground: GroundMap | None,
) -> None:
    from matplotlib.colors import ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Polygon

    xyz, instance = pair.scan0.xyz, pair.scan0.instance
    x0, x1, y0, y1 = _extent(cars)
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", facecolor="white")
    legend: list[Any] = []
    if region is not None:
        rows, columns = region.drivable.shape
        left, low = region.origin_m
        extent = (left, left + rows * region.cell_m, low, low + columns * region.cell_m)
        shade = np.ma.masked_where(~region.drivable.T, np.ones((columns, rows)))
        colours = ListedColormap([REGION_COLOUR])
        axes.imshow(shade, extent=extent, origin="lower", cmap=colours, interpolation="nearest", zorder=0)
        axes.set(xlim=(x0, x1), ylim=(y0, y1))
        legend.append(Patch(facecolor=REGION_COLOUR, edgecolor="#8CC5A6", label="drivable region"))

    virtual_rows = [row for row, _ in cars]
    world = ~np.isin(instance, virtual_rows) & (pair.scan0.source >= 0)
    height = _height(xyz[world], ground)
    order = np.argsort(height, kind="stable")
    at = xyz[world][order]
    axes.scatter(
        *(at[:, 0], at[:, 1]), c=_grey(height[order]), s=0.55, linewidths=0, marker="o", rasterized=True, zorder=1
    )
    _background_flow(axes, pair, world, (x0, x1, y0, y1))
    legend.append(Line2D([], [], marker="o", ls="", ms=5, color="#8a8a8a", label="measured point, darker is higher"))
    unknown = (pair.flow_status0 == 1) & world
    if unknown.any():
        axes.scatter(xyz[unknown, 0], xyz[unknown, 1], s=1.6, c="#B8860B", linewidths=0, zorder=2)
        legend.append(Line2D([], [], marker="o", ls="", ms=5, color="#B8860B", label="flow unknown (status 1)"))
    if len(removed):
        axes.scatter(removed[:, 0], removed[:, 1], s=1.3, c=REMOVED_COLOUR, linewidths=0, zorder=3)
        label = "measured point that a car hides"
        legend.append(Line2D([], [], marker="o", ls="", ms=5, color=REMOVED_COLOUR, label=label))

    labelled = [item for item in pair.objects if item.origin == "labelled"]
    for item in labelled:
        if item.box0 is not None:
            axes.add_patch(Polygon(footprint_corners(item.box0), fill=False, ec=LABEL_COLOUR, lw=1.1, zorder=4))
            label = item.category + (f" {item.speed:.1f} m/s" if item.speed is not None else "")
            x, y = item.box0[0], item.box0[1] + 0.5 * float(np.hypot(item.box0[3], item.box0[4])) * 0.75
            if x0 < x < x1 and y0 < y < y1:
                axes.text(x, y, label, fontsize=7.5, color=LABEL_COLOUR, ha="center", clip_on=True, zorder=6)
        if item.box1 is not None:
            corners = footprint_corners(item.box1)
            axes.add_patch(Polygon(corners, fill=False, ec=LABEL_COLOUR, lw=0.9, ls=(0, (3, 2)), zorder=4))
    if labelled:
        legend.append(Line2D([], [], color=LABEL_COLOUR, lw=1.1, label="labelled object, scan 0 (dashed: scan 1)"))

    for number, (row, item) in enumerate(cars):
        colour = _colour(number)
        mine = instance == row
        axes.scatter(xyz[mine, 0], xyz[mine, 1], s=3.5, c=colour, linewidths=0, zorder=5)
        arrows = np.flatnonzero(mine)[:: max(1, int(mine.sum()) // 8)]
        _arrows(axes, xyz[arrows], pair.flow0[arrows], "black", 0.0011, zorder=7)
        for box, style in ((item.box0, "-"), (item.box1, (0, (3, 2)))):
            if box is not None:
                axes.add_patch(Polygon(footprint_corners(box), fill=False, ec=colour, lw=1.7, ls=style, zorder=5))
        if item.box0 is not None:
            corners = footprint_corners(item.box0)
            nose = np.stack([corners[0], item.box0[:2], corners[3]])
            axes.plot(nose[:, 0], nose[:, 1], color=colour, lw=1.0, zorder=5)
            axes.annotate(
                f"{number + 1}",
                xy=(item.box0[0], item.box0[1]),
                xytext=(0, 19),
                textcoords="offset points",
                fontsize=12,
                fontweight="bold",
                color="white",
                ha="center",
                va="center",
                bbox={"boxstyle": "circle,pad=0.25", "fc": colour, "ec": "white"},
                zorder=8,
            )
        label = f"virtual car {number + 1}, scan 0 (dashed: scan 1)"
        legend.append(Line2D([], [], marker="s", ls="-", ms=6, color=colour, label=label))
    legend.append(Line2D([], [], color="black", lw=1.3, label="flow, velo0 to velo1 (drawn to scale)"))

    rear, front, right, left = _EGO_OUTLINE
    ego = np.array([[rear, right], [front, right], [front + 0.7, 0.0], [front, left], [rear, left]])
    axes.add_patch(Polygon(ego, closed=True, fc="#404040", ec="black", lw=1.0, zorder=6))
    axes.text(-0.7, 0.0, "ego", color="white", fontsize=7.5, ha="center", va="center", zorder=9)
    _scale_bar(axes, 20.0, (x0, x1, y0, y1))
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title("from above, in the frame of scan 0", loc="left", fontsize=11)
    # The corner with the fewest points under it: a legend hides what it lies on.
    axes.legend(handles=legend, loc=_empty_corner(xyz, cars, (x0, x1, y0, y1)), fontsize=8.5, framealpha=0.92)


def _extent(cars: list[tuple[int, ObjectRecord]]) -> tuple[float, float, float, float]:
    """x and y limits, two to one, round the ego car and all virtual cars."""
    places = [box[:2] for _, item in cars for box in (item.box0, item.box1) if box is not None]
    at = np.array([[0.0, 0.0], [30.0, 0.0], *places])
    low, high = at.min(axis=0) - 10.0, at.max(axis=0) + 10.0
    middle, span = (low + high) / 2.0, high - low
    width = max(span[0], 2.05 * span[1], 66.0)
    return (middle[0] - width / 2, middle[0] + width / 2, middle[1] - width / 4.1, middle[1] + width / 4.1)


def _empty_corner(xyz: Array, cars: list[tuple[int, ObjectRecord]], limits: tuple[float, float, float, float]) -> str:
    x0, x1, y0, y1 = limits
    corners = {"upper left": (0.0, 1.0), "upper right": (1.0, 1.0), "lower left": (0.0, 0.0)}
    boxes = np.array([item.box0[:2] for _, item in cars if item.box0 is not None]).reshape(-1, 2)

    def crowd(corner: tuple[float, float]) -> float:
        def inside(at: Array) -> int:
            u, v = (at[:, 0] - x0) / (x1 - x0), (at[:, 1] - y0) / (y1 - y0)
            return int(((np.abs(u - corner[0]) < 0.24) & (np.abs(v - corner[1]) < 0.34)).sum())

        return inside(xyz) + 1e6 * inside(boxes)

    return min(corners, key=lambda name: crowd(corners[name]))


def _scale_bar(axes: Any, length_m: float, limits: tuple[float, float, float, float]) -> None:
    x0, x1, y0, y1 = limits
    right, low = x1 - 0.02 * (x1 - x0), y0 + 0.035 * (y1 - y0)
    axes.plot([right - length_m, right], [low, low], color="black", lw=3.0, solid_capstyle="butt", zorder=9)
    box = {"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1.0}
    place = (right - length_m / 2, low + 0.012 * (y1 - y0))
    axes.text(*place, f"{length_m:.0f} m", ha="center", va="bottom", fontsize=9, bbox=box, zorder=9)


def _background_flow(axes: Any, pair: AugmentedPair, world: Bool, limits: tuple[float, float, float, float]) -> None:
    """A sparse field of arrows: the first point of every 5 m cell."""
    x0, x1, y0, y1 = limits
    xyz = pair.scan0.xyz
    inside = world & (xyz[:, 0] > x0) & (xyz[:, 0] < x1) & (xyz[:, 1] > y0) & (xyz[:, 1] < y1)
    rows = np.flatnonzero(inside & (pair.flow_status0 == 0) & (pair.scan0.instance < 0))
    cell = np.floor(xyz[rows, :2] / 5.0).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    rows = rows[first]
    _arrows(axes, xyz[rows], pair.flow0[rows], "#5b6b8c", 0.0008, zorder=2)


def _arrows(axes: Any, start: Array, move: Array, colour: str, width: float, zorder: int) -> None:
    """Arrows of true length; what moves less than 5 cm is left out."""
    far = np.hypot(move[:, 0], move[:, 1]) > 0.05
    if far.any():
        axes.quiver(
            *(start[far, 0], start[far, 1], move[far, 0], move[far, 1]),
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=width,
            headwidth=4.5,
            headlength=5.5,
            headaxislength=5.0,
            minlength=0.5,
            color=colour,
            zorder=zorder,
        )


def _height(xyz: Array, ground: GroundMap | None) -> F64:
    """Height above the local ground, or above 1.73 m under the scanner where it is not given (KITTI's set-up)."""
    if ground is None:
        return np.asarray(xyz[:, 2] + 1.73, dtype=np.float64)
    shape = ground.height_m.shape
    cell = [
        np.clip(((xyz[:, k] - ground.origin_m[k]) / ground.cell_m).astype(np.int64), 0, shape[k] - 1) for k in (0, 1)
    ]
    return np.asarray(xyz[:, 2] - ground.height_m[cell[0], cell[1]], dtype=np.float64)


def _grey(height: F64) -> F64:
    """Light for low, dark for high: (N, 3) RGB."""
    low, high = _HEIGHTS_M
    share = np.clip((height - low) / (high - low), 0.0, 1.0)
    return np.repeat((0.80 - 0.62 * share)[:, None], 3, axis=1)


# --- close-ups -----------------------------------------------------------------------------------------------------


def _draw_cars(
    figure: Any,
    slot: Any,
    pair: AugmentedPair,
    cars: list[tuple[int, ObjectRecord]],
    removed: Array,
    models: dict[str, CarModel],
) -> None:
    from matplotlib.lines import Line2D

    grid = slot.subgridspec(1, max(3, len(cars)), wspace=0.04)
    if not cars:
        axes = figure.add_subplot(grid[0, :])
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no virtual cars in this pair", ha="center", fontsize=12, color="#666666")
        return
    for number, (row, item) in enumerate(cars):
        axes = figure.add_subplot(grid[0, number])
        _draw_car(axes, pair, row, item, removed, models.get(item.model or ""))
        _title_car(axes, number, item)
    shown = [s for s in range(1, len(SURFACE_NAMES)) if (pair.scan0.surface == s).any()]
    handles = [
        Line2D([], [], marker="o", ls="", ms=6, color=SURFACE_COLOURS[s], label=SURFACE_NAMES[s])
        for s in (*shown, MEASURED)
    ]
    if len(removed):
        handles.append(Line2D([], [], marker="x", ls="", ms=5, color=REMOVED_COLOUR, label="removed"))
    if len(cars) < 3:
        axes = figure.add_subplot(grid[0, len(cars)])
        axes.set_axis_off()
        axes.legend(handles=handles, loc="center left", fontsize=10, title="surface", frameon=False)
    else:
        figure.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=slot.get_position(figure).corners()[0] + [0.47, 0.002],
            ncols=len(handles),
            fontsize=8.5,
            frameon=False,
        )


def _title_car(axes: Any, number: int, item: ObjectRecord) -> None:
    distance = float(np.hypot(item.box0[0], item.box0[1])) if item.box0 is not None else float("nan")
    yaw_rate = 0.0 if item.yaw_rate is None else float(np.rad2deg(item.yaw_rate))
    text = (
        f"{item.model} · {distance:.0f} m away · {item.speed or 0.0:.1f} m/s · turning {yaw_rate:.0f} deg/s\n"
        f"points {item.points0} and {item.points1} of {item.rays0} and {item.rays1} rays"
    )
    axes.set_title(text, loc="left", fontsize=9.5, x=0.075)
    axes.annotate(
        f"{number + 1}",
        xy=(0.0, 1.0),
        xycoords="axes fraction",
        xytext=(12, 18),
        textcoords="offset points",
        fontsize=11,
        fontweight="bold",
        color="white",
        ha="center",
        va="center",
        bbox={"boxstyle": "circle,pad=0.25", "fc": _colour(number), "ec": "white"},
        annotation_clip=False,
    )


def _draw_car(
    axes: Any, pair: AugmentedPair, row: int, item: ObjectRecord, removed: Array, model: CarModel | None
) -> None:
    """One car in its own frame, seen without perspective from above the scanner's side, turned a little."""
    from matplotlib.collections import LineCollection

    assert item.pose0 is not None
    assert item.box0 is not None
    T_car_velo0 = invert(item.pose0)
    half = np.asarray(item.box0[3:6]) / 2.0
    scanner = transform_points(T_car_velo0, np.zeros(3))
    bearing = float(np.arctan2(scanner[1], scanner[0]))
    turned = bearing + np.deg2rad(np.arange(-40.0, 41.0, 5.0))
    from_a_corner = float(turned[np.argmax(np.abs(np.sin(2.0 * turned)))])
    to_view = viewing_axes(from_a_corner, np.deg2rad(20.0))

    local = transform_points(T_car_velo0, pair.scan0.xyz)
    mine = pair.scan0.instance == row
    near = (np.abs(local) < half + _CLOSE_M).all(axis=1) & ~mine
    hidden = transform_points(T_car_velo0, removed)
    hidden = hidden[(np.abs(hidden) < half + 0.3).all(axis=1)]

    if model is not None:
        lines = _outline(model, to_view[:, 2])
        axes.add_collection(LineCollection(list(_flat(lines, to_view)), colors="#6f7f95", linewidths=0.45, alpha=0.4))
    axes.add_collection(LineCollection(list(_flat(_box_edges(half), to_view)), colors="black", lw=0.8, alpha=0.7))
    for points, marker, size, zorder in ((local[near], "o", 4.0, 1), (hidden, "x", 7.0, 2)):
        at = _flat(points, to_view)
        colour = SURFACE_COLOURS[MEASURED] if marker == "o" else REMOVED_COLOUR
        width = 0.0 if marker == "o" else 0.6
        axes.scatter(at[:, 0], at[:, 1], s=size, c=colour, linewidths=width, marker=marker, zorder=zorder)
    order = np.argsort(_depth(local[mine], to_view), kind="stable")
    at = _flat(local[mine], to_view)[order]
    surface = pair.scan0.surface[mine][order]
    colours = np.array(SURFACE_COLOURS)[np.minimum(surface, len(SURFACE_COLOURS) - 1)]
    size = float(np.clip(3000.0 / max(1, int(mine.sum())), 5.0, 26.0))
    axes.scatter(at[:, 0], at[:, 1], s=size, c=colours, linewidths=0.25, edgecolors="white", zorder=3)
    other = np.flatnonzero(near & (pair.scan0.surface > MEASURED))  # mixed points, and those of a neighbouring car
    if len(other):
        at = _flat(local[other], to_view)
        colours = np.array(SURFACE_COLOURS)[pair.scan0.surface[other]]
        axes.scatter(at[:, 0], at[:, 1], s=size, c=colours, linewidths=0.25, edgecolors="white", zorder=3)
    corners = _flat(_box_edges(half + 0.35).reshape(-1, 3), to_view)
    middle, span = (corners.min(axis=0) + corners.max(axis=0)) / 2.0, np.ptp(corners, axis=0)
    reach = max(span[0] / 1.34, span[1]) / 2.0
    axes.set(
        xlim=(middle[0] - 1.34 * reach, middle[0] + 1.34 * reach),
        ylim=(middle[1] - reach, middle[1] + reach),
        aspect="equal",
        xticks=[],
        yticks=[],
    )
    for spine in axes.spines.values():
        spine.set_color("#cccccc")


def _depth(points: Array, to_view: F64) -> F64:
    """Depth (N,) towards the viewer of points in the car's frame."""
    return np.asarray((np.asarray(points, dtype=np.float64) * to_view[:, 2]).sum(axis=1))


def viewing_axes(azimuth_rad: float, elevation_rad: float) -> F64:
    """Columns: picture right, picture up, towards the viewer who stands at this bearing and height."""
    ca, sa, ce, se = np.cos(azimuth_rad), np.sin(azimuth_rad), np.cos(elevation_rad), np.sin(elevation_rad)
    towards = np.array([ca * ce, sa * ce, se])
    right = np.array([-sa, ca, 0.0])
    return np.stack([right, np.cross(towards, right), towards], axis=1)


def _flat(points: Array, to_view: F64) -> F64:
    p = np.asarray(points, dtype=np.float64)
    return np.stack([(p * to_view[:, k]).sum(axis=-1) for k in (0, 1)], axis=-1)


def _box_edges(half: Array) -> F64:
    """The 12 edges (12, 2, 3) of a box about the origin."""
    edges = []
    for axis in range(3):
        a, b = (k for k in range(3) if k != axis)
        for sa in (-1.0, 1.0):
            for sb in (-1.0, 1.0):
                start = np.zeros(3)
                start[a], start[b], start[axis] = sa, sb, -1.0
                end = start.copy()
                end[axis] = 1.0
                edges.append([start * half, end * half])
    return np.array(edges)


def _outline(model: CarModel, towards: F64) -> F64:
    """Edges (E, 2, 3) of a mesh that a person would draw: borders, creases, and the silhouette from this side."""
    corner, index = np.unique(np.round(model.vertices, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1)[model.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    a, b, c = (corner[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.sqrt((normal * normal).sum(axis=1)), 1e-12)[:, None]
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs, owner = pairs[order], owner[order]
    same = (pairs[1:] == pairs[:-1]).all(axis=1)
    n0, n1 = normal[owner[:-1][same]], normal[owner[1:][same]]
    crease = np.abs((n0 * n1).sum(axis=1)) < _CREASE_COS
    silhouette = ((n0 * towards).sum(axis=1) > 0) != ((n1 * towards).sum(axis=1) > 0)
    shared = pairs[:-1][same][crease | silhouette]
    alone = pairs[~(np.concatenate([[False], same]) | np.concatenate([same, [False]]))]
    return np.asarray(corner[np.concatenate([shared, alone])])


# --- range images --------------------------------------------------------------------------------------------------


def range_image(xyz: Array, ring: Array, columns: int = _COLUMNS, beams: int = 64) -> npt.NDArray[np.float64]:
    """Nearest range (beams, columns) metres by ring and azimuth, 180 degrees left to 180 right; NaN where nothing."""
    distance = np.sqrt((np.asarray(xyz, dtype=np.float64) ** 2).sum(axis=1))
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    column = np.clip(((np.pi - azimuth) / (2.0 * np.pi) * columns).astype(np.int64), 0, columns - 1)
    image = np.full((max(beams, int(ring.max(initial=0)) + 1), columns), np.inf)
    np.minimum.at(image, (ring.astype(np.int64), column), distance)
    image[np.isinf(image)] = np.nan
    return image


def _draw_range_image(
    axes: Any,
    scan: Scan | AugmentedScan,
    cars: list[tuple[int, ObjectRecord]],
    title: str,
    last: bool,
    profile: ScannerProfile,
) -> None:
    import matplotlib as mpl
    from matplotlib.patches import Rectangle

    ring = scan.ring if isinstance(scan, AugmentedScan) else assign_rays(scan, profile).ring
    image = range_image(scan.xyz, ring, beams=profile.beams)
    colours = mpl.colormaps["cividis_r"].with_extremes(bad="white")
    shown = axes.imshow(
        np.log(image),
        cmap=colours,
        vmin=np.log(3.0),
        vmax=np.log(80.0),
        aspect="auto",
        extent=(180.0, -180.0, len(image), 0),
        interpolation="nearest",
    )
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_ylabel("ring", fontsize=9)
    axes.set_xticks(range(135, -136, -45), [f"{d} deg" if last else "" for d in range(135, -136, -45)], fontsize=8)
    axes.tick_params(axis="y", labelsize=8)
    if isinstance(scan, AugmentedScan):
        for number, (row, _) in enumerate(cars):
            mine = scan.instance == row
            if not mine.any():
                continue
            azimuth = np.rad2deg(np.arctan2(scan.xyz[mine, 1], scan.xyz[mine, 0]))
            low, high = float(azimuth.min()) - 0.5, float(azimuth.max()) + 0.5
            top, bottom = int(ring[mine].min()) - 1, int(ring[mine].max()) + 2
            colour = _colour(number)
            axes.add_patch(Rectangle((low, top), high - low, bottom - top, fill=False, ec=colour, lw=1.8))
            axes.text(high, top, f"{number + 1}", color=colour, fontsize=10, fontweight="bold", va="bottom", ha="right")
    if not last:
        return
    bar = axes.inset_axes([0.86, 1.08, 0.14, 0.09])
    bar_colours = axes.figure.colorbar(shown, cax=bar, orientation="horizontal")
    bar_colours.set_ticks([np.log(r) for r in (3, 10, 30, 80)], labels=["3", "10", "30", "80 m"])
    bar.xaxis.set_ticks_position("top")
    bar.tick_params(labelsize=7, length=2, pad=1)
