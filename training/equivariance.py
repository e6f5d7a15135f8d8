"""Fig. 3b of the paper: a CNN learns rigid motions from flow, in world and local coordinates; errors and a chart out.

A grid of 10 x 10 points lies somewhere round the scanner, moves rigidly in the plane, and the network sees its flow
alone. The paper says no more; ours: points 1 m apart (as the voxels of a car's neighbourhood, coarser), the grid's
centre within 35 m of the scanner along x and y, translations of the grid up to 2 m, rotations about its centre up to
the magnitude on the chart's axis. In world coordinates the same flow then belongs to many translations (claim 1),
t_W = (I - R) o + t_L, and the network can only give their mean; in local coordinates to one (claim 2).

Flow is Eq. 1's, see `rigid_motion.flow_of` and the slips of print noted there.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from augkitti.command_line import note
from augkitti.draw import figure_to
from augkitti.errors import InputError
from augkitti.frames import F64
from training.rigid_motion import flow_of, local_to_world, world_to_local

POINTS, SPACING_M = 10, 1.0
OFFSET_M, SHIFT_M = 35.0, 2.0
LARGEST_ROTATIONS_RAD = (0.02, 0.1, 0.3, 1.0)
LAMBDA = 10.0  # rotation against translation in the loss, as in training
BATCH, TESTED = 32, 512
REPRESENTATIONS = ("world", "local")


@dataclass(frozen=True)
class Row:
    """Errors of one trained network on fresh grids."""

    representation: str
    largest_rotation_rad: float
    seed: int
    translation_m: float  # mean distance, in the network's own representation
    translation_in_world_m: float  # the same after conversion to world coordinates
    rotation_rad: float


def draw_grids(count: int, largest_rotation_rad: float, rng: np.random.Generator) -> tuple[F64, F64, F64]:
    """Random grids: flow (n, 10, 10, 2), cell centres (n, 10, 10, 2) in world coordinates, world motions (n, 3)."""
    centre = rng.uniform(-OFFSET_M, OFFSET_M, (count, 2))
    about_centre = np.concatenate(
        [
            rng.uniform(-SHIFT_M, SHIFT_M, (count, 2)),
            rng.uniform(-largest_rotation_rad, largest_rotation_rad, (count, 1)),
        ],
        axis=1,
    )
    along = (np.arange(POINTS) - (POINTS - 1) / 2.0) * SPACING_M
    local = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1)
    flow = flow_of(about_centre[:, None, None], local)
    return flow, centre[:, None, None] + local, np.asarray(local_to_world(about_centre, centre))


def targets_of(representation: str, world: F64, centres: F64) -> F64:
    """What the network is to give at each cell: (n, 10, 10, 3) of world motions (n, 3) at centres (n, 10, 10, 2)."""
    everywhere = np.broadcast_to(world[:, None, None], (*centres.shape[:3], 3))
    if representation == "world":
        return np.array(everywhere)
    return np.asarray(world_to_local(everywhere.reshape(-1, 3), centres.reshape(-1, 2))).reshape(everywhere.shape)


def small_cnn(channels: int = 64, layers: int = 5) -> nn.Sequential:
    """Flow (n, 2, 10, 10) to motion (n, 3, 10, 10): 3 x 3 convolutions with ReLU between."""
    widths = (2, *[channels] * (layers - 1), 3)
    parts: list[nn.Module] = []
    for before, after in pairwise(widths):
        parts += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*parts[:-1])


def train_one(representation: str, largest_rotation_rad: float, seed: int, steps: int) -> Row:
    """Train one network; its errors on grids that it has not seen."""
    rng = np.random.default_rng([seed, round(largest_rotation_rad * 1e6)])  # both representations see the same grids
    torch.manual_seed(seed)
    network = small_cnn()
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps, pct_start=0.1)
    for _ in range(steps):
        flow, centres, world = draw_grids(BATCH, largest_rotation_rad, rng)
        error = (_run(network, flow) - torch.from_numpy(targets_of(representation, world, centres)).float()).abs()
        loss = error[..., :2].sum(-1).mean() + LAMBDA * error[..., 2].mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    flow, centres, world = draw_grids(TESTED, largest_rotation_rad, np.random.default_rng([seed, 1, 1]))
    with torch.no_grad():
        given = _run(network, flow).double().numpy()
    target = targets_of(representation, world, centres)
    in_world = given
    if representation == "local":
        in_world = np.asarray(local_to_world(given.reshape(-1, 3), centres.reshape(-1, 2))).reshape(given.shape)
    apart = given - target
    return Row(
        representation,
        largest_rotation_rad,
        seed,
        float(np.hypot(apart[..., 0], apart[..., 1]).mean()),
        float(np.linalg.norm((in_world - world[:, None, None])[..., :2], axis=-1).mean()),
        float(np.abs(apart[..., 2]).mean()),
    )


def run_experiment(
    seeds: int = 5,
    steps: int = 300,
    rotations_rad: Sequence[float] = LARGEST_ROTATIONS_RAD,
    say: Callable[[str], None] = print,
) -> list[Row]:
    """Every representation at every largest rotation with every seed; a line each as they come."""
    rows = []
    for rotation in rotations_rad:
        for representation in REPRESENTATIONS:
            start = time.perf_counter()
            here = [train_one(representation, rotation, seed, steps) for seed in range(seeds)]
            rows += here
            say(
                f"{representation:5s} up to {rotation:4.2f} rad: "
                f"translation {_spread([r.translation_m for r in here])} m, "
                f"rotation {_spread([r.rotation_rad for r in here], 4)} rad, {seeds} seeds, "
                f"{time.perf_counter() - start:.0f} s"
            )
    return rows


def draw_chart(rows: Sequence[Row], path: Path) -> None:
    """Translation and rotation error against the largest rotation; mean and range over seeds. Errors as `figure_to`."""
    colours = {"world": "#009E73", "local": "#E69F00"}  # green and orange, as in the paper
    with figure_to(path, (11.0, 4.2)) as figure:
        figure.subplots_adjust(left=0.07, right=0.985, top=0.9, bottom=0.14, wspace=0.22)
        for place, (field, label) in enumerate(
            (("translation_m", "translation error (m)"), ("rotation_rad", "rotation error (rad)")), start=1
        ):
            axes = figure.add_subplot(1, 2, place)
            for name in REPRESENTATIONS:
                x, middle, low, high = _curve(rows, name, field)
                axes.plot(x, middle, "o-", color=colours[name], label=f"{name} coordinates")
                axes.fill_between(x, low, high, color=colours[name], alpha=0.25, linewidth=0)
            if field == "translation_m":
                x, middle, _, _ = _curve(rows, "local", "translation_in_world_m")
                axes.plot(x, middle, "o--", color=colours["local"], label="local, converted to world")
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlabel("largest rotation (rad)")
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            axes.legend(frameon=False)
        seeds = len({row.seed for row in rows})
        title = f"Rigid motion from flow on a {POINTS} x {POINTS} grid, {seeds} seeds: mean and range"
        figure.suptitle(title, fontsize=11)


def equivariance(out: Path, seeds: int = 5, steps: int = 300) -> list[Row]:
    """The command: train, print, draw."""
    if not out.parent.is_dir():  # minutes of training go before the picture
        raise InputError(out, "its folder does not exist", "name a PNG in a folder that exists")
    if find_spec("matplotlib") is None:
        raise InputError("matplotlib", "is not installed", "pip install 'augkitti[view]'")
    rows = run_experiment(seeds, steps)
    draw_chart(rows, out)
    note(f"{out} written")
    return rows


def _run(network: nn.Module, flow: F64) -> Tensor:
    given: Tensor = network(torch.from_numpy(flow).float().permute(0, 3, 1, 2))
    return given.permute(0, 2, 3, 1)


def _curve(rows: Sequence[Row], representation: str, field: str) -> tuple[list[float], F64, F64, F64]:
    rotations = sorted({row.largest_rotation_rad for row in rows})
    values = [
        [getattr(r, field) for r in rows if r.representation == representation and r.largest_rotation_rad == rotation]
        for rotation in rotations
    ]
    table = np.array(values)
    return rotations, table.mean(1), table.min(1), table.max(1)


def _spread(values: Sequence[float], digits: int = 3) -> str:
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"
