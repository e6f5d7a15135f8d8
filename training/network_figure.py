"""Fig. 2 of the paper: a network in, its stages with layers, shapes and parameters out, and a diagram of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from torch import nn

from augkitti.draw import figure_to
from training.network import ANCHORS_A_CELL, DILATIONS, PointFlowNet

_SHARED, _DECODER, _PLAIN = "#E3ECF7", "#FBEBD3", "#F1F1F1"


@dataclass(frozen=True)
class Stage:
    """A box of the diagram."""

    name: str
    layers: tuple[str, ...]
    shape: str  # of what comes out
    parameters: int = 0  # weights that can learn


def network_stages(network: PointFlowNet) -> dict[str, Stage]:
    """The parts of a network, read from its modules; their parameters add up to all that it has."""
    grid, context = network.grid, network.context_encoder
    x, y, height = grid.shape
    size = " x ".join(f"{side:g}" for side in grid.voxel_m)
    points = network.feature_encoder
    stages = {
        "voxels": Stage(
            "Voxels of both scans", (f"of {size} m", f"at most {grid.max_points} points each"), f"{x} x {y} x {height}"
        ),
        "points": Stage(
            "Feature encoder",
            (
                "the same for both scans",
                *(f"VFE {a} → {2 * b}" for a, b in (_ends(layer.each.linear) for layer in _all(points.layers))),
                "FC {} → {}, max over voxel".format(*_ends(points.last.linear)),
            ),
            f"{points.outputs} per non-empty voxel",
            _count(points),
        ),
    }  # fmt: skip
    convs = [context.scan0, *_all(context.deeper)]
    shapes, level = [], height
    for conv in convs:
        level = _halved(level)
        shapes.append((conv.weight.shape[1], conv.weight.shape[2], level))
    doubled = f"3D conv 2 x {shapes[0][0]} → {shapes[0][1]}, {shapes[0][2]} high"
    stages["volume"] = Stage(
        "Context encoder: height",
        (doubled, *(f"3D conv {a} → {b}, {high} high" for a, b, high in shapes[1:]), "stride 2 in height, sparse"),
        f"{shapes[-1][1] * level} x {x} x {y}",
        _count(context.scan0, context.scan1, context.deeper, context.norms),
    )
    for number, block in enumerate(_all(context.blocks), start=1):
        x, y = _halved(x), _halved(y)
        first = block[0][0]
        stages[f"block{number}"] = Stage(
            f"Block {number}",
            (f"conv {first.in_channels} → {first.out_channels}, stride 2", f"{len(block) - 1} x conv, stride 1"),
            f"{first.out_channels} x {x} x {y}",
            _count(block),
        )
    flow, rigid = network.flow_decoder, network.rigid_motion_decoder
    ego, cars = network.ego_motion_regressor, network.object_decoder
    ups, rigid_layers = _all(flow.ups), _all(rigid.convs)
    stages["flow"] = Stage(
        "Scene flow decoder",
        (
            *(f"up x {2**level}: {a} → {b}" for level, (_, a, b) in enumerate((up.weight.shape for up in ups), 1)),
            f"1 x 1 conv {flow.last.in_features} → 3",
        ),
        "3 per occupied column",
        _count(flow),
    )  # fmt: skip
    dilations = ", ".join(str(DILATIONS[k % len(DILATIONS)]) for k in range(len(rigid_layers)))
    stages["rigid"] = Stage(
        "Rigid motion decoder",
        (
            f"{len(rigid_layers)} x conv, {rigid_layers[0].weight.shape[2]} wide",
            f"dilation {dilations}",
            r"t$_x$, t$_y$, $\theta$ about the column's centre",
        ),
        "3 per occupied column",
        _count(rigid),
    )
    strided = sum(isinstance(part, nn.Conv2d) and part.stride[0] == 2 for part in ego.layers.modules())
    stages["ego"] = Stage(
        "Ego-motion regressor",
        (f"{strided} x (conv, conv of stride 2)", f"FC {ego.last.in_features} → 3"),
        r"t$_x$, t$_y$, $\theta$",
        _count(ego),
    )
    stages["objects"] = Stage(
        "Object decoder",
        (
            *(f"up x {up.stride}: {up.conv.in_channels} → {up.norm.num_features}" for up in _all(cars.ups)),
            f"score, residuals of {ANCHORS_A_CELL} anchors a cell",
        ),
        f"{ANCHORS_A_CELL * 8} x {cars.cells[0]} x {cars.cells[1]}",
        _count(cars),
    )
    stages["motion"] = Stage(
        "Object motion",
        (r"t$_W$ = (I - R) o + t$_L$", "boxes by NMS; median of the motions", "of the columns in each box"),
        "a motion per car",
    )
    return stages


# where each stage stands: left, low, width, height, in a picture of 16 by 8
_PLACES = {
    "voxels": (0.2, 2.9, 2.3, 2.2, _PLAIN),
    "points": (3.0, 2.9, 2.5, 2.2, _SHARED),
    "volume": (6.0, 2.9, 2.6, 2.2, _SHARED),
    "block1": (9.1, 5.5, 2.5, 1.7, _SHARED),
    "block2": (9.1, 3.15, 2.5, 1.7, _SHARED),
    "block3": (9.1, 0.8, 2.5, 1.7, _SHARED),
    "flow": (12.5, 5.8, 2.7, 2.0, _DECODER),
    "rigid": (16.0, 5.8, 2.9, 2.0, _DECODER),
    "objects": (12.5, 3.0, 2.7, 2.0, _DECODER),
    "motion": (16.0, 3.0, 2.9, 2.0, _PLAIN),
    "ego": (12.5, 0.5, 2.7, 1.7, _DECODER),
}
_BUS = 12.05  # x of the line that carries all blocks' maps to the decoders


def draw_network(network: PointFlowNet, path: Path) -> None:
    """The diagram: encoders blue, decoders with weights orange, what has none grey. Errors as `figure_to`."""
    stages = network_stages(network)
    blocks = [name for name in stages if name.startswith("block")]
    with figure_to(path, (15.2, 6.6)) as figure:
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, 19.1), ylim=(0, 8.3))
        axes.axis("off")
        places = dict(_PLACES)
        places.update(_block_places(blocks))
        for name, stage in stages.items():
            _box(axes, stage, *places[name])
        for a, b in (("voxels", "points"), ("points", "volume"), ("flow", "rigid"), ("objects", "motion")):
            _arrow(axes, _side(places[a], 1), _side(places[b], 0))
        (x, y), up = _side(places["volume"], 1), _side(places[blocks[0]], 0)
        axes.plot([x, 8.85, 8.85], [y, y, up[1]], color="#444444", lw=1.3)
        _arrow(axes, (8.85, up[1]), up)
        for a, b in pairwise(blocks):
            _arrow(axes, _middle(places[a], low=True), _middle(places[b], low=False))
        for name in blocks:
            start = _side(places[name], 1)
            axes.plot([start[0], _BUS], [start[1]] * 2, color="#444444", lw=1.3)
        ends = [_side(places[name], 1)[1] for name in blocks] + [
            _side(places[name], 0)[1] for name in ("flow", "objects")
        ]
        axes.plot([_BUS, _BUS], [min(ends), max(ends)], color="#444444", lw=1.3)
        for name in ("flow", "objects"):
            at = _side(places[name], 0)
            _arrow(axes, (_BUS, at[1]), at)
        last = _middle(places[blocks[-1]], low=True)
        ego = _side(places["ego"], 0)
        axes.plot([last[0], last[0], _BUS - 0.3], [last[1], 0.25, 0.25], color="#444444", lw=1.3)
        axes.plot([_BUS - 0.3, _BUS - 0.3], [0.25, ego[1]], color="#444444", lw=1.3)
        _arrow(axes, (_BUS - 0.3, ego[1]), ego)
        _arrow(axes, _middle(places["rigid"], low=True), _middle(places["motion"], low=False))
        total = sum(stage.parameters for stage in stages.values())
        axes.text(
            0.2, 8.0, f"PointFlowNet as it was scored: {total:,} parameters", fontsize=13, va="center", weight="bold"
        )  # fmt: skip
        axes.text(
            0.2, 7.62, "Convolutions are 3 x 3 (x 3) with batch norm and ReLU. Maps: channels x cells along x x y.",
            fontsize=9, va="center", color="#555555",
        )  # fmt: skip


def _block_places(blocks: Sequence[str]) -> dict[str, tuple[float, float, float, float, str]]:
    """Of however many blocks, from top to bottom."""
    step = 7.0 / len(blocks)
    return {
        name: (9.1, 7.6 - (k + 1) * step + 0.3, 2.5, min(step - 0.6, 1.7), _SHARED) for k, name in enumerate(blocks)
    }


def _box(axes: Any, stage: Stage, left: float, low: float, width: float, height: float, colour: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    axes.add_patch(
        FancyBboxPatch(
            (left, low), width, height, boxstyle="round,pad=0,rounding_size=0.12", fc=colour, ec="#444444", lw=1.1
        )
    )
    middle, top = left + width / 2.0, low + height
    axes.text(middle, top - 0.22, stage.name, ha="center", va="center", fontsize=9.5, weight="bold")
    room = height - 0.42 - (0.5 if stage.parameters else 0.28)
    step = min(0.3, room / len(stage.layers))
    for k, line in enumerate(stage.layers):
        axes.text(middle, top - 0.42 - (k + 0.5) * step, line, ha="center", va="center", fontsize=8)
    axes.text(
        middle, low + (0.38 if stage.parameters else 0.16), stage.shape, ha="center", va="center", fontsize=8,
        color="#0B4F8A",
    )  # fmt: skip
    if stage.parameters:
        text = f"{stage.parameters:,} parameters"
        axes.text(middle, low + 0.14, text, ha="center", va="center", fontsize=7.5, color="#777777")


def _arrow(axes: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    style = {"arrowstyle": "-|>", "color": "#444444", "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=style)


def _side(place: tuple[float, float, float, float, str], right: int) -> tuple[float, float]:
    left, low, width, height, _ = place
    return left + right * width, low + height / 2.0


def _middle(place: tuple[float, float, float, float, str], low: bool) -> tuple[float, float]:
    left, bottom, width, height, _ = place
    return left + width / 2.0, bottom if low else bottom + height


def _all(modules: Any) -> list[Any]:
    """Of a module list, whose types torch does not know."""
    return list(modules)


def _ends(layer: nn.Linear) -> tuple[int, int]:
    return layer.in_features, layer.out_features


def _count(*modules: nn.Module) -> int:
    return sum(weights.numel() for module in modules for weights in module.parameters())


def _halved(cells: int) -> int:
    return (cells + 1) // 2
