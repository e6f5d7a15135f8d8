"""Voxels and training targets: samples in, sparse voxels of both scans and the targets of occupied columns out.

Paper, Feature Encoder: the volume in front of the scanner in W x H x 10 voxels, only non-empty ones kept, at most T
points of each, drawn at random; a point's features are VoxelNet's. Targets (method.md section 3): a column of voxels
has the flow and the rigid motion, in coordinates about the column's centre, of that body to which most of its points
belong, ties to the object. Points whose flow is not known have no vote; a column with no others is left out of losses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from augkitti.errors import InputError
from augkitti.frames import F32
from augkitti.scan_pair import I64, Bool
from augkitti.seeds import generator
from training import detection
from training.config import GridConfig, Settings
from training.rigid_motion import motion_of, world_to_local
from training.sample import Sample, is_labelled

FEWEST_POINTS = 5  # an object with fewer is no positive example, as the scores ignore it
_Record = TypeVar("_Record", bound="Voxels | Targets | Batch")


@dataclass(frozen=True, eq=False)
class Voxels:
    """Non-empty voxels of one scan, or of the same scan of a batch."""

    points: torch.Tensor  # (P, 6 or 7) float32: x, y, z[, reflectance], x, y, z minus the mean of the voxel's points
    voxel: torch.Tensor  # (P,) int64, ascending: row in `coords`
    coords: torch.Tensor  # (V, 3) int64 ix, iy, iz, unique and sorted; of a batch (V, 4) with the sample in front

    def to(self, device: torch.device | str) -> "Voxels":
        """The same on another device."""
        return _moved(self, device)

    def pin_memory(self) -> "Voxels":
        """The same in memory that a GPU copies from while it computes."""
        return _moved(self, None)


@dataclass(frozen=True, eq=False)
class Targets:
    """What the network should say of B scan pairs with C occupied columns in scan 0; A anchors a cell."""

    columns: torch.Tensor  # (C, 3) int64 sample, ix, iy, sorted
    flow: torch.Tensor  # (C, 3) float32 metres: mean over the body's points in the column
    motion: torch.Tensor  # (C, 3) float32 t_x, t_y, theta about the column's centre
    known: torch.Tensor  # (C,) bool: the column holds points whose flow is known
    is_object: torch.Tensor  # (C,) bool: it has an object's motion
    ego: torch.Tensor  # (B, 3) float32 t_x, t_y, theta of T_velo1_velo0
    anchor_labels: torch.Tensor  # (B, A, X / 2, Y / 2) int8: 1 positive, 0 negative, -1 left out
    anchor_residuals: torch.Tensor  # (B, A, 7, X / 2, Y / 2) float32, where positive

    def to(self, device: torch.device | str) -> "Targets":
        """The same on another device."""
        return _moved(self, device)

    def pin_memory(self) -> "Targets":
        """The same in memory that a GPU copies from while it computes."""
        return _moved(self, None)


@dataclass(frozen=True, eq=False)
class Batch:
    """Input of B pairs, and targets where they have labels; the samples themselves stay on the host."""

    voxels0: Voxels
    voxels1: Voxels
    targets: Targets | None
    samples: list[Sample]

    def to(self, device: torch.device | str) -> "Batch":
        """The same with tensors on another device."""
        return _moved(self, device)

    def pin_memory(self) -> "Batch":
        """The same in memory that a GPU copies from while it computes; `DataLoader` calls it."""
        return _moved(self, None)


def make_batch(
    samples: Sequence[Sample],
    settings: Settings,
    rng: np.random.Generator | None = None,
    training: bool = False,
    with_targets: bool = True,
) -> Batch:
    """The batch of some samples: what a `DataLoader` collates.

    Args:
        samples: at least one; not augmented here.
        settings: grid, anchors, and whether reflectance is an input.
        rng: draws the points of crowded voxels; without one each sample's own `draw` seeds it.
        training: draw anew; else the same points are taken whenever a pair comes.
        with_targets: False for scans without labels.

    Raises:
        InputError: a scan without a point in the grid.
    """
    scans0, scans1 = [], []
    for sample in samples:
        draw = generator(sample.draw if training else 0, "voxels") if rng is None or not training else rng
        scans0.append(voxelize(sample.xyz0, sample.reflectance0, settings, draw, f"{sample.pair_id}, scan 0"))
        scans1.append(voxelize(sample.xyz1, sample.reflectance1, settings, draw, f"{sample.pair_id}, scan 1"))
    targets = targets_of(samples, settings) if with_targets else None
    return Batch(_joined(scans0), _joined(scans1), targets, list(samples))


def voxelize(xyz: F32, reflectance: F32, settings: Settings, rng: np.random.Generator, name: str = "a scan") -> Voxels:
    """The non-empty voxels of a scan of (N, 3) points and (N,) reflectances; `name` is told where there are none.

    Raises:
        InputError: no point lies in the grid.
    """
    grid = settings.grid
    rows, flat = _voxel_of_points(xyz, grid)
    if not len(rows):
        raise InputError(name, f"none of its {len(xyz)} points lies in the grid", f"the grid is {_extent(grid)}")
    shuffled = rng.permutation(len(rows))  # so that those of a voxel come in random order
    bits = len(rows).bit_length()
    key = np.sort((flat[shuffled] << bits) | np.arange(len(rows)))  # no two alike: quicker than a stable argsort
    rows, flat = rows[shuffled[key & ((1 << bits) - 1)]], key >> bits
    first = np.flatnonzero(np.diff(flat, prepend=-1))
    count = np.diff(first, append=len(flat))
    kept = np.arange(len(flat)) - np.repeat(first, count) < grid.max_points
    rows, flat, found = rows[kept], flat[kept], flat[first]
    count = np.minimum(count, grid.max_points)
    voxel = np.repeat(np.arange(len(count)), count)
    points = xyz[rows]
    mean = np.add.reduceat(points, np.cumsum(count) - count, axis=0, dtype=np.float64) / count[:, None]
    columns = [points, reflectance[rows, None]] if settings.network.reflectance else [points]
    features = np.concatenate([*columns, points - mean.astype(np.float32)[voxel]], axis=1)
    coords = np.stack(np.unravel_index(found, grid.shape), axis=1)
    return Voxels(torch.from_numpy(features), torch.from_numpy(voxel), torch.from_numpy(coords))


def empty_share(voxels: Voxels, grid: GridConfig, scans: int = 1) -> float:
    """Share of the grid's voxels, 0 to 1, that hold no point, over `scans` scans; the paper: more than 90 %."""
    return 1.0 - len(voxels.coords) / (scans * grid.shape[0] * grid.shape[1] * grid.shape[2])


def column_of_points(xyz: F32, grid: GridConfig) -> I64:
    """The column of each point (N, 3), numbered ix * Y + iy, (N,); -1 for points out of the grid, height included."""
    out = np.full(len(xyz), -1, dtype=np.int64)
    rows, flat = _voxel_of_points(xyz, grid)
    out[rows] = flat // grid.shape[2]
    return out


def column_centres(columns: Any, grid: GridConfig) -> Any:
    """Centres (C, 2) in metres, velo0, of columns whose last two numbers are ix, iy; arrays or tensors."""
    (x, _), (y, _), (size_x, size_y, _) = grid.x_m, grid.y_m, grid.voxel_m
    stack = torch.stack if isinstance(columns, torch.Tensor) else np.stack
    return stack([x + (columns[..., -2] + 0.5) * size_x, y + (columns[..., -1] + 0.5) * size_y], -1)


def targets_of(samples: Sequence[Sample], settings: Settings) -> Targets:
    """The targets of a batch."""
    parts = [column_targets(sample, settings.grid) for sample in samples]
    anchors = [anchor_targets(sample, settings) for sample in samples]
    columns, flow, motion, known, is_object = (
        torch.from_numpy(np.concatenate([part[k] for part in parts])) for k in range(5)
    )
    sample = torch.from_numpy(np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]))
    return Targets(
        columns=torch.cat([sample[:, None], columns], dim=1),
        flow=flow,
        motion=motion,
        known=known,
        is_object=is_object,
        ego=torch.from_numpy(motion_of(np.stack([sample.ego_motion for sample in samples])).astype(np.float32)),
        anchor_labels=torch.from_numpy(np.stack([labels for labels, _ in anchors])),
        anchor_residuals=torch.from_numpy(np.stack([residuals for _, residuals in anchors])),
    )


def column_targets(sample: Sample, grid: GridConfig) -> tuple[I64, F32, F32, Bool, Bool]:
    """Columns (C, 2), flow (C, 3), local motion (C, 3), known (C,), is_object (C,) of the columns that scan 0 fills."""
    rows, voxel = _voxel_of_points(sample.xyz0, grid)
    flat = voxel // grid.shape[2]
    occupied = np.zeros(grid.shape[0] * grid.shape[1], dtype=bool)
    occupied[flat] = True
    columns = np.flatnonzero(occupied)
    number = np.cumsum(occupied) - 1  # of a column among the occupied ones
    instance = sample.instance0[rows]
    known = ~sample.status0[rows] & ((instance < 0) | np.append(sample.has_motion, True)[instance])
    rows, column, body = rows[known], number[flat[known]], instance[known] + 1  # body 0: the static world

    bodies = len(sample.boxes0) + 1
    votes = np.bincount(column * bodies + body, minlength=len(columns) * bodies).reshape(-1, bodies)
    winner = votes.argmax(axis=1)
    if bodies > 1:
        strongest = votes[:, 1:].argmax(axis=1) + 1
        most = np.take_along_axis(votes, strongest[:, None], axis=1)[:, 0]
        winner = np.where((most > 0) & (most >= votes[:, 0]), strongest, 0)  # a tie is the object's
    counted = votes[np.arange(len(columns)), winner]
    is_known = counted > 0

    of_winner = body == winner[column]
    rows, column = rows[of_winner], column[of_winner]
    totals = [np.bincount(column, weights=sample.flow0[rows, k], minlength=len(columns)) for k in range(3)]
    flow = np.stack(totals, axis=1) / np.maximum(counted, 1)[:, None]

    planar = motion_of(np.stack([sample.ego_motion, *sample.motion]))
    ix, iy = np.divmod(columns, grid.shape[1])
    places = np.stack([ix, iy], axis=1)
    local = world_to_local(planar[winner], column_centres(places, grid))
    local[~is_known] = 0.0
    return places, flow.astype(np.float32), local.astype(np.float32), is_known, is_known & (winner > 0)


def anchor_targets(sample: Sample, settings: Settings) -> tuple[npt.NDArray[np.int8], F32]:
    """Labels (A, X / 2, Y / 2) and residuals (A, 7, X / 2, Y / 2) of the anchors, by `detection.match`.

    Boxes of the neutral categories, and of the wanted one with fewer than 5 points, are neither positive nor negative;
    nor are anchors where the source has no labels, virtual cars excepted.
    """
    config = settings.detection
    wanted = np.array([name == config.category for name in sample.category], dtype=bool)
    neutral = np.array([name in config.neutral for name in sample.category], dtype=bool)
    enough = sample.points0 >= FEWEST_POINTS
    return detection.match(
        sample.boxes0[wanted & enough],
        sample.boxes0[neutral | (wanted & ~enough)],
        settings,
        judged=lambda xy: is_labelled(xy, sample.label_coverage, sample.label_azimuth),
    )


def _voxel_of_points(xyz: F32, grid: GridConfig) -> tuple[I64, I64]:
    """Rows of the points in the grid, and their voxels, numbered (ix * Y + iy) * Z + iz."""
    inside = np.ones(len(xyz), dtype=bool)
    cells = []
    for axis, (low, _) in enumerate((grid.x_m, grid.y_m, grid.z_m)):
        cell = (xyz[:, axis] - np.float32(low)) / np.float32(grid.voxel_m[axis])
        inside &= (cell >= 0) & (cell < grid.shape[axis])
        cells.append(cell)
    rows = np.flatnonzero(inside)
    ix, iy, iz = (cell[rows].astype(np.int64) for cell in cells)
    return rows, (ix * grid.shape[1] + iy) * grid.shape[2] + iz


def _joined(scans: Sequence[Voxels]) -> Voxels:
    """The voxels of a batch: one list, the number of the sample in front of each coordinate."""
    counts = [len(scan.coords) for scan in scans]
    ends = np.cumsum([0, *counts])
    numbers = torch.from_numpy(np.repeat(np.arange(len(scans)), counts))
    return Voxels(
        points=torch.cat([scan.points for scan in scans]),
        voxel=torch.cat([scan.voxel + int(start) for scan, start in zip(scans, ends[:-1], strict=True)]),
        coords=torch.cat([numbers[:, None], torch.cat([scan.coords for scan in scans])], dim=1),
    )


def _moved(record: _Record, device: torch.device | str | None) -> _Record:
    """A record with its tensors on a device, or pinned where `device` is None."""
    changed: dict[str, Any] = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, torch.Tensor):
            changed[field.name] = value.pin_memory() if device is None else value.to(device, non_blocking=True)
        elif isinstance(value, Voxels | Targets):
            changed[field.name] = _moved(value, device)
    return replace(record, **changed)


def _extent(grid: GridConfig) -> str:
    return ", ".join(
        f"{name} {low:g} to {high:g} m" for name, (low, high) in zip("xyz", (grid.x_m, grid.y_m, grid.z_m), strict=True)
    )
