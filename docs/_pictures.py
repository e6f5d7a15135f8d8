"""The pictures of the documentation: nothing in, PNGs of the embedded default data set out (`make pictures`).

Writes `docs/pair.png`, `docs/pictures/set.png` and one picture a step of `docs/method.md`. Large ones are
halved and colours are few, so that all of them together stay below half a megabyte.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import augkitti
from augkitti.config import Config
from augkitti.dataset_index import read_index
from augkitti.draw import (
    CAR_COLOURS,
    REGION_COLOUR,
    REMOVED_COLOUR,
    SURFACE_COLOURS,
    figure_to,
    viewing_axes,
)
from augkitti.frames import footprint_corners, invert, transform_points
from augkitti.kitti import open_root
from augkitti.scan_pair import SURFACE_NAMES, AugmentedPair, PreparedScan
from pipelines.cache import cache_folder
from pipelines.inspect_set import set_profile, source_of
from pipelines.prepare import prepared_scan

DOCS = Path(__file__).resolve().parent
PAIR = "2000_01_01_drive_0002_sync/0/0"
CAR = "virtual_0"
COLOURS = 255


def main() -> None:
    """Make the set, with windows that let the pulse through and with opaque ones, and draw."""
    with tempfile.TemporaryDirectory() as folder:
        clear, opaque = Path(folder) / "aug", Path(folder) / "opaque"
        _run("generate", "--n", "20", "--out", clear)
        _run("generate", "--n", "20", "--out", opaque, "--glass", "opaque")
        _run("view", clear, "--pair", PAIR, "--out", DOCS / "pair.png")
        _run("info", clear, "--out", DOCS / "pictures" / "set.png")
        pair, twin = augkitti.open(clear)[PAIR], augkitti.open(opaque)[PAIR]
        index = read_index(clear)
        profile = set_profile(clear, index)
        root = source_of(index, profile, None)
        assert root is not None
        scan, _ = prepared_scan(open_root(root).sequence(pair.sequence), pair.frame0, profile, Config(), cache_folder())
    draw_rays(scan)
    draw_region(pair, scan)
    draw_cast(pair, scan)
    draw_windows(pair, twin)
    draw_flow(pair)
    for path in (DOCS / "pair.png", *sorted((DOCS / "pictures").glob("*.png"))):
        drawn = Image.open(path).convert("RGB")
        drawn = drawn.reduce(2) if drawn.width > 1500 else drawn
        drawn.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)
        print(f"{path.relative_to(DOCS.parent)} {path.stat().st_size // 1000} kB")


def _run(*words: object) -> None:
    command = [sys.executable, "-m", "pipelines", *(str(word) for word in words)]
    environment = {name: value for name, value in os.environ.items() if name != "AUGKITTI_KITTI"}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)


@contextmanager
def _picture(name: str, size_inches: tuple[float, float], panels: tuple[int, int] = (1, 1)) -> Iterator[Any]:
    with figure_to(DOCS / "pictures" / f"{name}.png", size_inches) as figure:
        axes = figure.subplots(*panels, squeeze=False)
        yield axes if panels != (1, 1) else axes[0, 0]
        figure.tight_layout(pad=0.6)


SIDE = (20.0, 100.0)  # degrees: the window of azimuths that the range images show


def draw_rays(scan: PreparedScan) -> None:
    """Every fired ray by ring and azimuth: the measured range, and the rays that returned nothing."""
    rays = scan.rays
    azimuth = np.rad2deg(rays.ray_azimuth_rad)
    shown = (azimuth > SIDE[0]) & (azimuth < SIDE[1])
    hit = shown & (rays.ray_point >= 0)
    miss = shown & (rays.ray_point < 0)
    distance = np.linalg.norm(scan.scan.xyz[rays.ray_point[hit]], axis=1)
    with _picture("rays", (9.0, 3.2)) as axes:
        drawn = axes.scatter(
            azimuth[hit], rays.ray_ring[hit], c=np.log(distance), s=1.1, lw=0, marker="s", cmap="cividis_r"
        )
        axes.scatter(azimuth[miss], rays.ray_ring[miss], c=REMOVED_COLOUR, s=1.1, lw=0, marker="s")
        _range_axes(axes, f"fired rays: {hit.sum():,} returned (colour: range), {miss.sum():,} did not (red)")
        bar = axes.figure.colorbar(drawn, ax=axes, pad=0.01, fraction=0.03)
        bar.set_ticks([np.log(r) for r in (4, 10, 30, 80)], labels=["4 m", "10", "30", "80"])


def draw_region(pair: AugmentedPair, scan: PreparedScan) -> None:
    """Ground heights, the drivable region, and the cars with the ways that they go."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Polygon

    region, ground = scan.region, scan.ground
    with _picture("region", (9.0, 5.0)) as axes:
        left, low = region.origin_m
        rows, columns = region.drivable.shape
        shade = np.ma.masked_where(~region.drivable.T, np.ones((columns, rows)))
        extent = (left, left + rows * region.cell_m, low, low + columns * region.cell_m)
        axes.imshow(shade, extent=extent, origin="lower", cmap=ListedColormap([REGION_COLOUR]), zorder=0)
        for of_ground, colour in ((True, "#b9a88a"), (False, "#555555")):
            at = scan.scan.xyz[ground.is_ground == of_ground]
            axes.scatter(at[:, 0], at[:, 1], s=0.4, c=colour, lw=0)
        for number, item in enumerate(i for i in pair.objects if i.origin == "virtual"):
            for box, style in ((item.box0, "-"), (item.box1, (0, (2, 1)))):
                axes.add_patch(Polygon(footprint_corners(box), fill=False, ec=CAR_COLOURS[number], lw=1.8, ls=style))
            axes.annotate(
                f"{item.speed:.0f} m/s, {np.rad2deg(item.yaw_rate):+.0f} deg/s",
                (item.box0[0], item.box0[1] + 2.2),
                color=CAR_COLOURS[number],
                fontsize=9,
                ha="center",
                fontweight="bold",
                bbox={"fc": "white", "ec": "none", "alpha": 0.85, "pad": 1.0},
            )
        axes.set(xlim=(-28, 32), ylim=(-16, 16), aspect="equal", xticks=[], yticks=[])
        axes.set_title("ground (brown), what stands on it (grey), drivable region (green), cars in both scans",
                       loc="left", fontsize=9)  # fmt: skip


def draw_cast(pair: AugmentedPair, scan: PreparedScan) -> None:
    """The same window of the range image before and after."""
    import matplotlib as mpl

    before, ring = scan.scan.xyz, scan.rays.ring
    row = [item.id for item in pair.objects].index(CAR)
    with _picture("cast", (9.0, 5.6), (2, 1)) as axes:
        for panel, title, xyz, rings in (
            (axes[0, 0], "scan 0 as the scanner wrote it", before, ring),
            (axes[1, 0], "with a virtual car: its returns (blue), and the measured points that it hides are gone",
             pair.scan0.xyz, pair.scan0.ring),
        ):  # fmt: skip
            azimuth = np.rad2deg(np.arctan2(xyz[:, 1], xyz[:, 0]))
            shown = (azimuth > SIDE[0]) & (azimuth < SIDE[1])
            colour = mpl.colormaps["cividis_r"](np.clip(np.log(np.linalg.norm(xyz[shown], axis=1) / 3) / 3.2, 0, 1))
            if xyz is not before:
                colour[pair.scan0.instance[shown] == row] = mpl.colors.to_rgba(CAR_COLOURS[0])
            panel.scatter(azimuth[shown], rings[shown], c=colour, s=1.1, lw=0, marker="s")
            _range_axes(panel, title)


def _range_axes(axes: Any, title: str) -> None:
    axes.set(xlim=(SIDE[1], SIDE[0]), ylim=(64, -1), xlabel="azimuth, degrees to the left", ylabel="ring")
    axes.set_title(title, loc="left", fontsize=9)
    axes.tick_params(labelsize=7)
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)


def draw_windows(pair: AugmentedPair, twin: AugmentedPair) -> None:
    """One car by surface, with windows that let the pulse through and with opaque ones."""
    from matplotlib.lines import Line2D

    with _picture("windows", (9.0, 2.7), (1, 2)) as axes:
        for panel, title, its in (
            (axes[0, 0], "windows as they are", pair),
            (axes[0, 1], "the same car with opaque windows", twin),
        ):
            item = next(item for item in its.objects if item.id == CAR)
            row = its.objects.index(item)
            T_car_velo0 = invert(item.pose0)
            seen = transform_points(T_car_velo0, np.zeros(3))
            to_view = viewing_axes(float(np.arctan2(seen[1], seen[0])) + 0.5, 0.25)
            mine = (its.scan0.instance == row) | (its.scan0.surface == SURFACE_NAMES.index("mixed at an edge"))
            local = transform_points(T_car_velo0, its.scan0.xyz)
            mine &= (np.abs(local) < np.asarray(item.box0[3:6]) / 2 + 0.4).all(axis=1)
            flat = local[mine] @ to_view
            colours = np.array(SURFACE_COLOURS)[its.scan0.surface[mine]]
            panel.scatter(flat[:, 0], flat[:, 1], c=colours, s=2.2, lw=0)
            panel.set(aspect="equal", xticks=[], yticks=[], xlim=(-2.6, 2.6), ylim=(-1.25, 1.25))
            panel.set_title(f"{title}: {mine.sum():,} returns", loc="left", fontsize=9)
        handles = [
            Line2D([], [], marker="o", ls="", ms=4, color=SURFACE_COLOURS[k], label=SURFACE_NAMES[k])
            for k in range(1, len(SURFACE_NAMES))
        ]
        axes[0, 0].legend(handles=handles, fontsize=6.5, ncols=4, loc="lower center", frameon=False)


def draw_flow(pair: AugmentedPair) -> None:
    """Both scans of a moving car from above, with the flow of its points."""
    from matplotlib.patches import Polygon

    item = max((i for i in pair.objects if i.origin == "virtual"), key=lambda i: abs(i.speed or 0.0))
    row = pair.objects.index(item)
    middle = (item.box0[:2] + item.box1[:2]) / 2
    with _picture("flow", (9.0, 4.2)) as axes:
        for scan, colour, size in ((pair.scan0, CAR_COLOURS[0], 5.0), (pair.scan1, CAR_COLOURS[1], 5.0)):
            world = scan.instance != row
            axes.scatter(scan.xyz[world, 0], scan.xyz[world, 1], s=0.8, c="#aaaaaa", lw=0)
            axes.scatter(scan.xyz[~world, 0], scan.xyz[~world, 1], s=size, c=colour, lw=0)
        for rows, every, colour in (
            (np.flatnonzero(pair.scan0.instance == row), 45, "black"),
            (np.flatnonzero((pair.scan0.instance < 0) & (pair.flow_status0 == 0)), 60, "#5b6b8c"),
        ):
            some = rows[::every]
            at, move = pair.scan0.xyz[some], pair.flow0[some]
            axes.quiver(at[:, 0], at[:, 1], move[:, 0], move[:, 1], angles="xy", scale_units="xy", scale=1.0,
                        width=0.0016, color=colour)  # fmt: skip
        for box, colour in ((item.box0, CAR_COLOURS[0]), (item.box1, CAR_COLOURS[1])):
            axes.add_patch(Polygon(footprint_corners(box), fill=False, ec=colour, lw=1.5))
        axes.set(xlim=(middle[0] - 6, middle[0] + 6), ylim=(middle[1] - 2.8, middle[1] + 2.8), aspect="equal")
        axes.set(xticks=[], yticks=[])
        axes.set_title(
            f"flow of a car at {item.speed:.1f} m/s: its points in scan 0 (blue) and scan 1 (orange); the road's flow "
            "is the ego car's own motion",
            loc="left",
            fontsize=9,
        )


if __name__ == "__main__":
    main()
