"""The contact sheet: car models in, one picture with each from the side, from above and at an angle out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.cad_models import CadLibrary
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import GLASS, LAMP, OTHER, PAINT, TYRE, CarModel

COLOURS = {
    PAINT: (0.72, 0.72, 0.70),
    GLASS: (0.15, 0.45, 0.95),
    TYRE: (0.12, 0.12, 0.12),
    LAMP: (0.95, 0.55, 0.05),
    OTHER: (0.45, 0.62, 0.42),
}
_LIGHT = np.array([0.35, 0.5, 0.79])
_PANE_ALPHA = 0.55


def draw_contact_sheet(library: CadLibrary | Sequence[CarModel], path: Path) -> None:
    """Draw every model from the left, from above (front to the right) and at an angle, coloured by surface.

    Paint is grey, glass blue, tyres black, lamps orange, all else green; the line under a car is the ground.

    Raises:
        InputError: matplotlib is not installed, or the picture cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as err:
        raise InputError("--sheet", "matplotlib is not installed", "pip install 'augkitti[view]'") from err
    models = library.models if isinstance(library, CadLibrary) else tuple(library)
    columns = 2
    rows = max(-(-len(models) // columns), 1)
    figure = Figure(figsize=(9.0 * columns, 2.3 * rows), dpi=80)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 3 * columns, squeeze=False)
    for axis in axes.reshape(-1):
        axis.axis("off")
    for i, model in enumerate(models):
        row, column = divmod(i, columns)
        for k, view in enumerate((_from_left(), _from_above(), _at_an_angle())):
            _draw(axes[row, 3 * column + k], model, view)
        length, width, height = model.size_m
        title = f"{model.name}  {model.category}  {length:.2f} x {width:.2f} x {height:.2f} m"
        axes[row, 3 * column].set_title(title, fontsize=9, loc="left")
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.98, wspace=0.03, hspace=0.12)
    try:
        figure.savefig(path, format="png")
    except OSError as err:
        raise InputError(path, f"not writable ({err.strerror})", "name another file") from err


def _from_left() -> F64:
    """Rows right, up, towards the eye, in car axes: the car drives to the left, as seen from its left side."""
    return np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def _from_above() -> F64:
    return np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])


def _at_an_angle() -> F64:
    """From the front left, a little above."""
    eye = np.array([0.75, 0.6, 0.33])
    eye = eye / np.sqrt((eye * eye).sum())
    right = np.cross([0.0, 0.0, 1.0], eye)
    right = right / np.sqrt((right * right).sum())
    return np.stack([right, np.cross(eye, right), eye])


def _draw(axis: Any, model: CarModel, view: F64) -> None:
    from matplotlib.collections import PolyCollection

    corners = np.einsum("ij,fkj->fki", view, model.vertices[model.faces])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.sqrt((normal * normal).sum(axis=1, keepdims=True)), 1e-12)
    shade = 0.45 + 0.55 * np.abs((normal * _LIGHT).sum(axis=1))
    colour = np.array([COLOURS[int(s)] for s in model.surface]) * shade[:, None]
    alpha = np.where(model.surface == GLASS, _PANE_ALPHA, 1.0)
    order = np.argsort(corners[:, :, 2].max(axis=1) + corners[:, :, 2].mean(axis=1), kind="stable")
    faces = PolyCollection(
        corners[order][:, :, :2], facecolors=np.c_[colour, alpha][order], edgecolors="none", linewidths=0.0
    )
    axis.add_collection(faces)
    low, high = corners[:, :, :2].min(axis=(0, 1)), corners[:, :, :2].max(axis=(0, 1))
    if view[1, 2] == 1.0:
        axis.plot([low[0], high[0]], [-model.size_m[2] / 2.0] * 2, color="red", linewidth=0.6)
    axis.set_xlim(low[0] - 0.1, high[0] + 0.1)
    axis.set_ylim(low[1] - 0.1, high[1] + 0.1)
    axis.set_aspect("equal")
