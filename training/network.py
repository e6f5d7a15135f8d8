"""PointFlowNet: voxels of two scans in; scene flow, rigid motions, ego-motion, anchors' scores and residuals out.

In the order of the paper: feature encoder, context encoder, then the decoders. The object motion decoder has no
weights: `detection.decode` and `nms`, then `rigid_motion.local_to_world` and `pool_over_boxes`.

Departures from the paper, and choices where it is silent:

- A point's features also hold its place within the voxel (from the voxel's centre, as PointPillars has it), and all are
  scaled: flow is finer than a voxel, and where in its voxel a point lies is no smooth function of x, y, z.
- The 3D convolutions are sparse (`sparse_conv.py`): cells that no window reaches hold zero, and batch norm acts on
  active sites alone. The concatenation of the two scans' maps is never built: the first convolution of it is the sum of
  two.
- Flow and rigid motions are given at the occupied columns of scan 0 alone, where they have a meaning. Up-convolutions
  have kernel = stride (VoxelNet's first has kernel 3), so a column needs one coarse cell of each block, and what comes
  out is what the dense decoder has there; batch norm behind them is over occupied columns. Detection's are dense. Those
  for flow have 64 channels in `paper` where VoxelNet's for detection have 256: the paper gives no number.
- The rigid-motion decoder: convolutions at occupied columns with dilation, so that it sees a car's length; a fourth
  input says that a column is occupied; and its last layer corrects the flow itself, since t_L is the flow of the
  voxel's centre (Eq. 1 with p = o).
- Scores are logits of a car against none: a softmax over two is a sigmoid of their difference.
- The paper stacks three 3D convolutions of vertical stride 2 where VoxelNet has 2, 1, 2; ours are the paper's, kernel
  3, padding 1 (10 cells: 5, 3, 2). Ego-motion: pairs of a convolution and a strided one, then one fully connected
  layer.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.config import GridConfig, NetworkConfig, Settings
from training.sparse_conv import Rules, Sites, SparseConv, conv_rules, reached_sites, to_dense, upsampling_rules

if TYPE_CHECKING:
    from training.voxelize import Voxels

ANCHORS_A_CELL = 2  # along and across (VoxelNet)
DILATIONS = (1, 2, 4, 2, 1)  # of the rigid-motion decoder's layers, repeated where there are more


@dataclass(frozen=True, eq=False)
class Output:
    """What the network says of B pairs with C occupied columns in scan 0, A anchors a cell; float32."""

    columns: Tensor  # (C, 3) int64 sample, ix, iy
    flow_columns: Tensor  # (C, 3) metres
    motion_columns: Tensor  # (C, 3) t_x, t_y, theta about the column's centre
    ego: Tensor  # (B, 3) t_x, t_y, theta of T_velo1_velo0
    scores: Tensor  # (B, A, X / 2, Y / 2) logits
    residuals: Tensor  # (B, A, 7, X / 2, Y / 2)


class PointFlowNet(nn.Module):
    """The whole network.

    Args:
        settings: grid and widths.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        grid, widths = settings.grid, settings.network
        self.grid = grid
        self.feature_encoder = FeatureEncoder(grid, widths)
        self.context_encoder = ContextEncoder(grid, widths)
        self.flow_decoder = FlowDecoder(widths)
        self.rigid_motion_decoder = RigidMotionDecoder(*widths.rigid)
        self.ego_motion_regressor = EgoMotionRegressor(widths.blocks[-1][0], *widths.ego, self.context_encoder.coarsest)
        self.object_decoder = ObjectDecoder(grid, widths)

    def forward(
        self, voxels0: "Voxels", voxels1: "Voxels", batch_size: int = 1, columns: Tensor | None = None
    ) -> Output:
        """Two scans' voxels to all that is estimated.

        Args:
            voxels0: of scan 0; coordinates (V, 4), or (V, 3) of a single sample.
            voxels1: of scan 1.
            batch_size: B.
            columns: (C, 3) where to give flow and motion: some of the occupied columns of scan 0; all where not given.
        """
        sites0, sites1 = (self._sites(voxels, batch_size) for voxels in (voxels0, voxels1))
        blocks = self.context_encoder(self.feature_encoder(voxels0), sites0, self.feature_encoder(voxels1), sites1)
        if columns is None:
            columns = torch.unique_consecutive(sites0.coords[:, :3], dim=0)
        where = Sites(columns, self.grid.shape[:2], batch_size)
        flow = self.flow_decoder(blocks, where)
        scores, residuals = self.object_decoder(blocks)
        return Output(
            columns=columns,
            flow_columns=flow,
            motion_columns=self.rigid_motion_decoder(flow, where),
            ego=self.ego_motion_regressor(blocks[-1]),
            scores=scores,
            residuals=residuals,
        )

    def _sites(self, voxels: "Voxels", batch: int) -> Sites:
        coords = voxels.coords
        return Sites(F.pad(coords, (1, 0)) if coords.shape[1] == 3 else coords, self.grid.shape, batch)


# Feature encoder


class FeatureEncoder(nn.Module):
    """Points in voxels to a feature vector for each non-empty voxel: VoxelNet's stack of VFE layers.

    No padded layout: points of all voxels are one list, voxel after voxel, and the maximum is over its rows.
    """

    scale: Tensor
    low: Tensor
    size: Tensor

    def __init__(self, grid: GridConfig, widths: NetworkConfig) -> None:
        super().__init__()
        low, high = (torch.tensor(side) for side in zip(grid.x_m, grid.y_m, grid.z_m, strict=True))
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("size", torch.tensor(grid.voxel_m), persistent=False)
        self.register_buffer("scale", 2.0 / (high - low), persistent=False)
        inputs = 9 + widths.reflectance
        self.layers = nn.ModuleList()
        for width in widths.vfe:
            self.layers.append(VFELayer(inputs, width))
            inputs = width
        self.last = LinearNormRelu(inputs, inputs)
        self.outputs = inputs

    def forward(self, voxels: "Voxels") -> Tensor:
        """(V, outputs)."""
        voxel, counts = voxels.voxel, torch.bincount(voxels.voxel, minlength=len(voxels.coords))
        with torch.autocast(voxel.device.type, enabled=False):  # bfloat16 knows 60 m to a quarter of a metre
            points = self.layers[0](self._inputs(voxels), voxel, counts)
        for layer in self.layers[1:]:
            points = layer(points, voxel, counts)
        return largest(self.last(points), counts)

    def _inputs(self, voxels: "Voxels") -> Tensor:
        """(P, 9 or 10): place in the grid from -1 to 1[, reflectance], from the voxel's mean and centre in voxels."""
        xyz, rest = voxels.points[:, :3], voxels.points[:, 3:]
        centre = self.low + (voxels.coords[:, -3:] + 0.5) * self.size
        return torch.cat(
            [
                (xyz - self.low) * self.scale - 1.0,
                rest[:, :-3],
                rest[:, -3:] / self.size,
                (xyz - centre[voxels.voxel]) / self.size,
            ],
            dim=1,
        )


class VFELayer(nn.Module):
    """Each point's features beside the largest of its voxel: (P, inputs) to (P, outputs), half of them each."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.each = LinearNormRelu(inputs, outputs // 2)

    def forward(self, points: Tensor, voxel: Tensor, counts: Tensor) -> Tensor:
        """Points (P, inputs) in voxels (P,) that hold `counts` (V,) each to (P, outputs)."""
        each = self.each(points)
        return torch.cat([each, largest(each, counts).index_select(0, voxel)], dim=1)


class LinearNormRelu(nn.Module):
    """A linear layer, batch norm over rows, ReLU; float32 comes out."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, rows: Tensor) -> Tensor:
        """(rows, inputs) to (rows, outputs)."""
        return F.relu(self.norm(self.linear(rows).float()))


def largest(points: Tensor, counts: Tensor) -> Tensor:
    """The maximum over the points of each voxel: rows (P, C) in the order of voxels, `counts` (V,) each, to (V, C)."""
    return torch.segment_reduce(points, "max", lengths=counts, axis=0, unsafe=True)


# Context encoder


class ContextEncoder(nn.Module):
    """Features of two scans' voxels to dense maps seen from above, one a block, of 1/2, 1/4, 1/8 resolution."""

    def __init__(self, grid: GridConfig, widths: NetworkConfig) -> None:
        super().__init__()
        first, second, third = widths.middle
        self.scan0 = SparseConv(widths.vfe[-1], first, 27)  # together: the first 3D convolution of the concatenation
        self.scan1 = SparseConv(widths.vfe[-1], first, 27)
        self.deeper = nn.ModuleList([SparseConv(first, second, 27), SparseConv(second, third, 27)])
        self.norms = nn.ModuleList([nn.BatchNorm1d(width) for width in widths.middle])
        x, y, height = grid.shape
        for _ in widths.middle:
            height = _strided(height)
        inputs = third * height
        self.blocks = nn.ModuleList()
        for width, layers in widths.blocks:
            self.blocks.append(block(inputs, width, layers))
            inputs, x, y = width, _strided(x), _strided(y)
        self.coarsest = (x, y)

    def forward(self, features0: Tensor, sites0: Sites, features1: Tensor, sites1: Sites) -> list[Tensor]:
        """(V0, C) and (V1, C) to maps (B, width, X / 2, Y / 2), (B, width, X / 4, Y / 4), ...; halves rounded up."""
        sites = reached_sites([sites0, sites1], 3, VERTICAL, 1)
        features = self.scan0(features0, _rules(sites0, sites)) + self.scan1(features1, _rules(sites1, sites))
        features = F.relu(self.norms[0](features))
        for conv, norm in zip(self.deeper, self.norms[1:], strict=True):
            above = reached_sites([sites], 3, VERTICAL, 1)
            features = F.relu(norm(conv(features, _rules(sites, above))))
            sites = above
        kind = features.device.type
        if torch.is_autocast_enabled(kind):
            features = features.to(torch.get_autocast_dtype(kind))
        flat = to_dense(features, sites).flatten(3).permute(0, 3, 1, 2)  # height into channels; channels last in memory
        maps = []
        for layers in self.blocks:
            flat = layers(flat)
            maps.append(flat)
        return maps


VERTICAL = (1, 1, 2)  # strides along x, y, z


def block(inputs: int, width: int, layers: int) -> nn.Sequential:
    """2D convolutions with batch norm and ReLU, the first of stride 2."""
    steps = [conv_norm_relu(inputs, width, 2)] + [conv_norm_relu(width, width, 1) for _ in range(layers - 1)]
    return nn.Sequential(*steps)


def conv_norm_relu(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    """A 3 x 3 convolution, batch norm, ReLU."""
    conv: nn.Module = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    conv = conv.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def _rules(inputs: Sites, outputs: Sites) -> Rules:
    return conv_rules(inputs, outputs, 3, VERTICAL, 1)


def _strided(cells: int) -> int:
    return (cells + 1) // 2  # kernel 3, stride 2, padding 1


# Scene-flow decoder


class FlowDecoder(nn.Module):
    """Maps of all blocks to the scene flow of occupied columns, at full resolution."""

    def __init__(self, widths: NetworkConfig) -> None:
        super().__init__()
        self.ups = nn.ModuleList(
            SparseConv(width, widths.upsampled_flow, 4**level)
            for level, (width, _) in enumerate(widths.blocks, start=1)
        )
        self.norms = nn.ModuleList(nn.BatchNorm1d(widths.upsampled_flow) for _ in widths.blocks)
        self.last = nn.Linear(widths.upsampled_flow * len(widths.blocks), 3)  # the 1 x 1 convolution of a column

    def forward(self, maps: list[Tensor], where: Sites) -> Tensor:
        """(C, 3) metres."""
        stacked = []
        for level, (coarse, up, norm) in enumerate(zip(maps, self.ups, self.norms, strict=True), start=1):
            rules = upsampling_rules((coarse.shape[2], coarse.shape[3]), where, 2**level)
            rows = coarse.permute(0, 2, 3, 1).flatten(0, 2)
            stacked.append(F.relu(norm(up(rows, rules))))
        with torch.autocast(rows.device.type, enabled=False):
            flow: Tensor = self.last(torch.cat(stacked, dim=1))
        return flow


# Rigid-motion decoder


class RigidMotionDecoder(nn.Module):
    """The flow of occupied columns to the rigid motion of each, in coordinates about the column's centre."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        widths = [4] + [width] * (layers - 1) + [3]
        self.convs = nn.ModuleList(SparseConv(a, b, 9) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width) for _ in range(layers - 1))
        self.bias = nn.Parameter(torch.zeros(3))
        nn.init.zeros_(self.convs[-1].get_parameter("weight"))  # begins at the flow itself, without rotation

    def forward(self, flow: Tensor, where: Sites) -> Tensor:
        """(C, 3) metres to (C, 3) t_x, t_y, theta."""
        rules: dict[int, Rules] = {}
        with torch.autocast(flow.device.type, enabled=False):  # a small rotation is a small difference of flows
            rows = torch.cat([flow, torch.ones_like(flow[:, :1])], dim=1)
            for layer, conv in enumerate(self.convs):
                dilation = DILATIONS[layer % len(DILATIONS)]
                if dilation not in rules:
                    rules[dilation] = conv_rules(where, where, 3, (1, 1), dilation, dilation)
                rows = conv(rows, rules[dilation])
                if layer < len(self.norms):
                    rows = F.relu(self.norms[layer](rows))
            return rows + self.bias + F.pad(flow[:, :2], (0, 1))


# Ego-motion regressor


# What the last layer counts in, metres and radians. It has a thousand inputs: in units of 1 a step of Adam would shift
# the motion by a metre, and its loss, swinging about, drowned all others in the layers that they share.
EGO_UNITS = (0.05, 0.05, 0.005)


class EgoMotionRegressor(nn.Module):
    """The coarsest map to the observer's own motion."""

    units: Tensor

    def __init__(self, inputs: int, width: int, levels: int, cells: tuple[int, int]) -> None:
        super().__init__()
        steps: list[nn.Module] = []
        x, y = cells
        for _ in range(levels):
            steps += [conv_norm_relu(inputs, width, 1), conv_norm_relu(width, width, 2)]
            inputs, x, y = width, _strided(x), _strided(y)
        self.layers = nn.Sequential(*steps)
        self.last = nn.Linear(inputs * x * y, 3)
        nn.init.zeros_(self.last.weight)  # begins at no motion
        self.register_buffer("units", torch.tensor(EGO_UNITS), persistent=False)

    def forward(self, coarsest: Tensor) -> Tensor:
        """(B, inputs, x, y) to (B, 3) t_x, t_y, theta."""
        rows = self.layers(coarsest).float().flatten(1)
        with torch.autocast(rows.device.type, enabled=False):
            ego: Tensor = self.last(rows) * self.units
        return ego


# Object decoder


class ObjectDecoder(nn.Module):
    """Maps of all blocks to the score and the residuals of each anchor, at half resolution."""

    def __init__(self, grid: GridConfig, widths: NetworkConfig) -> None:
        super().__init__()
        self.cells = grid.shape[0] // 2, grid.shape[1] // 2
        self.ups = nn.ModuleList(
            UpConvolution(width, widths.upsampled, 2**level) for level, (width, _) in enumerate(widths.blocks)
        )
        stacked = widths.upsampled * len(widths.blocks)
        self.score = nn.Conv2d(stacked, ANCHORS_A_CELL, 1)
        self.residual = nn.Conv2d(stacked, ANCHORS_A_CELL * 7, 1)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Logits (B, A, X / 2, Y / 2) and residuals (B, A, 7, X / 2, Y / 2)."""
        x, y = self.cells
        stacked = torch.cat([up(coarse)[..., :x, :y] for up, coarse in zip(self.ups, maps, strict=True)], dim=1)
        return self.score(stacked).float(), self.residual(stacked).float().unflatten(1, (ANCHORS_A_CELL, 7))


class UpConvolution(nn.Module):
    """An up-convolution with kernel = stride, batch norm, ReLU; written as the 1 x 1 convolution that it is."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.stride = stride
        self.conv = nn.Conv2d(inputs, outputs * stride * stride, 1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, coarse: Tensor) -> Tensor:
        """(B, inputs, x, y) to (B, outputs, x stride, y stride)."""
        return F.relu(self.norm(F.pixel_shuffle(self.conv(coarse), self.stride)))
