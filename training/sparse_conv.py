"""Sparse convolutions: features at the occupied sites of a grid in, features at the sites that they reach out.

Definition. Cells that are no site hold zero. A sparse convolution is the dense one of that grid, without bias, seen at
its output sites: those whose window holds at least one input site (`reached_sites`), or the input sites themselves
(`Rules` from a set of sites to itself). All other cells of the output are zero by definition, also after batch norm and
ReLU, which act on the sites alone: their statistics are over active sites. That is where it departs from the dense
network, whose empty cells hold a constant after batch norm; here training, inference and the dense definition agree.

Each offset of the kernel gathers the rows that it meets, multiplies them and adds them to their targets. Plain torch
without synchronisation but for the list of sizes; runs on any device.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class Sites:
    """Occupied cells of a batch of grids."""

    coords: Tensor  # (V, 1 + d) int64: batch, then the cell along each axis; unique, ascending
    shape: tuple[int, ...]  # cells along each axis
    batch: int

    def __len__(self) -> int:
        return len(self.coords)

    def flat(self) -> Tensor:
        """(V,) int64: each site's row in the dense grid (batch, *shape), flattened."""
        return _flatten(self.coords, self.shape)


@dataclass(frozen=True, eq=False)
class Rules:
    """Which input row meets which output row under each offset of a kernel of K offsets; R meetings in all."""

    source: Tensor  # (R,) int64 rows of the input, offset after offset
    target: Tensor  # (R,) int64 rows of the output; within one offset no row comes twice, in either
    counts: tuple[int, ...]  # (K,) meetings of each offset
    targets: int  # rows of the output


def reached_sites(inputs: Sequence[Sites], kernel: int, stride: Sequence[int], padding: int) -> Sites:
    """The output cells whose window holds a site of any of `inputs` (same shape and batch).

    Args:
        inputs: what is convolved and summed.
        kernel: cells along each axis of the window.
        stride: along each axis.
        padding: empty cells before and after the grid along each axis.
    """
    first = inputs[0]
    shape = tuple((n + 2 * padding - kernel) // s + 1 for n, s in zip(first.shape, stride, strict=True))
    padded = tuple(n + 2 * padding for n in first.shape)
    hit = torch.zeros(first.batch * math.prod(padded), dtype=torch.bool, device=first.coords.device)
    for sites in inputs:
        hit[_flatten(_shifted(sites.coords, padding), padded)] = True
    hit = hit.view(first.batch, *padded)
    for axis, (cells, step) in enumerate(zip(shape, stride, strict=True), start=1):  # windows are boxes: axis by axis
        views = [hit.narrow(axis, k, step * (cells - 1) + 1) for k in range(kernel)]
        merged = views[0].clone()
        for view in views[1:]:
            merged |= view
        hit = merged[(slice(None),) * axis + (slice(None, None, step),)]
    return Sites(hit.nonzero(), shape, first.batch)


def conv_rules(
    inputs: Sites, outputs: Sites, kernel: int, stride: Sequence[int], padding: int, dilation: int = 1
) -> Rules:
    """The meetings of a convolution from one set of sites to another, offsets in the order of a dense kernel.

    `outputs.shape` is that of the dense convolution with the same numbers.
    """
    reach = dilation * (kernel - 1) + 1
    padded = tuple(
        max(n + padding, s * (m - 1) + reach) for n, m, s in zip(inputs.shape, outputs.shape, stride, strict=True)
    )
    device = inputs.coords.device
    row_of = torch.full((inputs.batch * math.prod(padded),), -1, dtype=torch.int32, device=device)
    row_of[_flatten(_shifted(inputs.coords, padding), padded)] = torch.arange(
        len(inputs), dtype=torch.int32, device=device
    )
    scale = torch.tensor([1, *stride], device=device)
    corner = _flatten(outputs.coords * scale, padded)  # (V_out,) of each window
    offsets = torch.tensor(list(product(range(0, reach, dilation), repeat=len(padded))), device=device)  # (K, d)
    steps = _flatten(torch.cat([torch.zeros_like(offsets[:, :1]), offsets], dim=1), padded)
    met = row_of[corner + steps[:, None]]  # (K, V_out)
    present = met >= 0
    target = present.nonzero()[:, 1]
    return Rules(met[present].long(), target, tuple(present.sum(1).tolist()), len(outputs))


def upsampling_rules(coarse: tuple[int, int], outputs: Sites, stride: int) -> Rules:
    """The meetings of an up-convolution (kernel = stride) from a dense coarse map to the sites of a fine one.

    Args:
        coarse: cells of the coarse map along x and y; rows of the input are (batch, *coarse) flattened.
        outputs: sites of the fine map (two axes).
        stride: fine cells to a side of a coarse one; a coarse map that reaches beyond the fine one is cut.
    """
    fine = outputs.coords[:, 1:]
    within = fine % stride
    offset = within[:, 0] * stride + within[:, 1]
    target = offset.argsort(stable=True)
    cell = torch.cat([outputs.coords[:, :1], fine // stride], dim=1)
    source = _flatten(cell, coarse)[target]
    counts = torch.bincount(offset, minlength=stride * stride).tolist()
    return Rules(source, target, tuple(counts), len(outputs))


def gather_multiply_scatter(features: Tensor, weight: Tensor, rules: Rules) -> Tensor:
    """Sum of the meetings: features (V_in, C) and weight (K, C, D) to (V_out, D) float32.

    Under autocast the products are in its type, the sums in float32; of float64 all is float64.
    """
    kind = features.device.type
    if torch.is_autocast_enabled(kind):
        dtype = torch.get_autocast_dtype(kind)
        features, weight = features.to(dtype), weight.to(dtype)
    with torch.autocast(kind, enabled=False):
        return _GatherMultiplyScatter.apply(features, weight, rules)  # type: ignore[no-any-return,no-untyped-call]


class _GatherMultiplyScatter(torch.autograd.Function):
    """Keeps its inputs alone for the way back; what it gathers is gathered anew."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, rules: Rules) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.rules = rules
        out = features.new_zeros((rules.targets, weight.shape[2]), dtype=_sums_in(features))
        for part, source, target in _by_offset(weight, rules):
            out.index_add_(0, target, (features.index_select(0, source) @ part).to(out.dtype))
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        grad = grads[0].to(weight.dtype)
        wants_features, wants_weight = ctx.needs_input_grad[:2]
        grad_features = torch.zeros_like(features, dtype=_sums_in(features)) if wants_features else None
        grad_weight = torch.zeros_like(weight) if wants_weight else None
        for k, (part, source, target) in enumerate(_by_offset(weight, ctx.rules)):
            came = grad.index_select(0, target)
            if grad_features is not None:
                grad_features.index_add_(0, source, (came @ part.T).to(grad_features.dtype))
            if grad_weight is not None:
                torch.mm(features.index_select(0, source).T, came, out=grad_weight[k])
        return None if grad_features is None else grad_features.to(features.dtype), grad_weight, None


def _sums_in(features: Tensor) -> torch.dtype:
    return torch.promote_types(features.dtype, torch.float32)


def _by_offset(weight: Tensor, rules: Rules) -> "zip[tuple[Tensor, Tensor, Tensor]]":
    sizes = list(rules.counts)
    source, target = torch.split(rules.source, sizes), torch.split(rules.target, sizes)
    return zip(weight.unbind(0), source, target, strict=True)


class SparseConv(nn.Module):
    """The weight of a sparse convolution without bias, (K, C, D), offsets in the order of a dense kernel.

    Args:
        inputs: C.
        outputs: D.
        offsets: K: cells of the kernel.
    """

    def __init__(self, inputs: int, outputs: int, offsets: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(offsets, inputs, outputs))
        bound = 1.0 / math.sqrt(inputs * offsets)  # as torch's dense convolutions
        nn.init.uniform_(self.weight, -bound, bound)

    def forward(self, features: Tensor, rules: Rules) -> Tensor:
        """(V_in, C) to (V_out, D)."""
        return gather_multiply_scatter(features, self.weight, rules)


def to_dense(features: Tensor, sites: Sites) -> Tensor:
    """Features (V, C) to the dense grid (batch, *shape, C), zero where no site is."""
    dense = features.new_zeros((sites.batch * math.prod(sites.shape), features.shape[1]))
    return dense.index_copy(0, sites.flat(), features).view(sites.batch, *sites.shape, features.shape[1])


def dense_kernel(weight: Tensor, axes: int) -> Tensor:
    """A weight (K, C, D) as torch's dense convolutions have it, (D, C, *kernel)."""
    side = round(len(weight) ** (1.0 / axes))
    return weight.permute(2, 1, 0).reshape(weight.shape[2], weight.shape[1], *(side,) * axes)


def _shifted(coords: Tensor, cells: int) -> Tensor:
    return torch.cat([coords[:, :1], coords[:, 1:] + cells], dim=1)


def _flatten(coords: Tensor, shape: Sequence[int]) -> Tensor:
    """(V, 1 + d) batch and cell to rows of the flattened (batch, *shape)."""
    flat = coords[:, 0]
    for axis, cells in enumerate(shape, start=1):
        flat = flat * cells + coords[:, axis]
    return flat
