"""The network against its dense definition, part by part: borders, batch norm and gradients included."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tiny_network import tiny_sample, tiny_settings  # noqa: E402
from torch import nn  # noqa: E402
from torch.nn import functional as F  # noqa: E402

from training.config import load_settings  # noqa: E402
from training.losses import total_loss  # noqa: E402
from training.network import (  # noqa: E402
    DILATIONS,
    ContextEncoder,
    FeatureEncoder,
    FlowDecoder,
    PointFlowNet,
    RigidMotionDecoder,
    UpConvolution,
)
from training.sparse_conv import Sites, dense_kernel, to_dense  # noqa: E402
from training.voxelize import Voxels, make_batch  # noqa: E402

SETTINGS = tiny_settings()
SHAPE = SETTINGS.grid.shape
OUTPUTS = ("flow_columns", "motion_columns", "ego", "scores", "residuals")


@pytest.fixture(autouse=True)
def same_weights():
    torch.manual_seed(0)


def corner_sites(shape: tuple[int, ...], seed: int, share: float = 0.1) -> Sites:
    """Random cells of two grids, both far corners among them."""
    drawn = torch.rand((2, *shape), generator=torch.Generator().manual_seed(seed)) < share
    drawn[0].flatten()[0] = drawn[1].flatten()[-1] = True
    return Sites(drawn.nonzero(), shape, 2)


def unlike_first(network: nn.Module) -> nn.Module:
    """The same with batch norms that have seen something, and without layers that begin with zeros."""
    for part in network.modules():
        if isinstance(part, nn.BatchNorm1d | nn.BatchNorm2d):
            for value, low in (
                (part.weight, 0.5),
                (part.bias, -0.5),
                (part.running_mean, -0.3),
                (part.running_var, 0.5),
            ):
                nn.init.uniform_(value, low, low + 1.0)
    for weight in network.parameters():
        if not weight.any():
            nn.init.uniform_(weight, -0.1, 0.1)
    return network


def norm_relu_at(norm: nn.Module, dense: torch.Tensor, active: torch.Tensor) -> torch.Tensor:
    """Batch norm and ReLU of a dense map (B, C, ...) over active cells (B, ...); zero elsewhere."""
    out = torch.zeros_like(dense.movedim(1, -1))
    out[active] = F.relu(norm(dense.movedim(1, -1)[active]))
    return out.movedim(-1, 1)


def occupied(sites: Sites) -> torch.Tensor:
    cells = torch.zeros((sites.batch, *sites.shape), dtype=torch.bool)
    cells[tuple(sites.coords.T)] = True
    return cells


def dense_context(encoder: ContextEncoder, maps: list[torch.Tensor], active: torch.Tensor) -> list[torch.Tensor]:
    """The context encoder with dense 3D convolutions on the concatenation of both scans' maps (B, C, X, Y, Z)."""
    first = torch.cat([encoder.scan0.weight, encoder.scan1.weight], dim=1)
    flat = torch.cat(maps, dim=1)
    for weight, norm in zip([first, *(conv.weight for conv in encoder.deeper)], encoder.norms, strict=True):
        reach = F.conv3d(active[:, None].float(), torch.ones(1, 1, 3, 3, 3), stride=(1, 1, 2), padding=1)
        active = reach[:, 0] > 0
        flat = norm_relu_at(norm, F.conv3d(flat, dense_kernel(weight, 3), stride=(1, 1, 2), padding=1), active)
    flat = flat.movedim(1, -1).flatten(3).movedim(-1, 1)
    out = []
    for layers in encoder.blocks:
        flat = layers(flat)
        out.append(flat)
    return out


@pytest.mark.parametrize("training", [True, False])
def test_the_context_encoder_is_the_dense_one_with_batch_norm_over_active_cells(training):
    encoder = unlike_first(ContextEncoder(SETTINGS.grid, SETTINGS.network)).train(training)
    other = deepcopy(encoder)
    scans = [corner_sites(SHAPE, seed) for seed in (1, 2)]
    features = [torch.randn(len(sites), 12) for sites in scans]
    sparse = encoder(features[0], scans[0], features[1], scans[1])
    maps = [to_dense(rows, sites).movedim(-1, 1) for rows, sites in zip(features, scans, strict=True)]
    dense = dense_context(other, maps, occupied(scans[0]) | occupied(scans[1]))
    assert [tuple(level.shape) for level in sparse] == [(2, 8, 8, 6), (2, 10, 4, 3), (2, 12, 2, 2)]
    for one, expected in zip(sparse, dense, strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-5)
    for one, expected in zip(encoder.buffers(), other.buffers(), strict=True):  # running statistics, too
        torch.testing.assert_close(one, expected)


def test_the_context_encoders_gradients_are_those_of_the_dense_one():
    encoder = unlike_first(ContextEncoder(SETTINGS.grid, SETTINGS.network))
    other = deepcopy(encoder)
    scans = [corner_sites(SHAPE, seed) for seed in (1, 2)]
    grads = []
    for network, is_sparse in ((encoder, True), (other, False)):
        torch.manual_seed(3)
        features = [torch.randn(len(sites), 12, requires_grad=True) for sites in scans]
        if is_sparse:
            maps = network(features[0], scans[0], features[1], scans[1])
        else:
            filled = [to_dense(rows, sites).movedim(-1, 1) for rows, sites in zip(features, scans, strict=True)]
            maps = dense_context(network, filled, occupied(scans[0]) | occupied(scans[1]))
        sum(level.square().sum() for level in maps).backward()
        grads.append([*(rows.grad for rows in features), *(p.grad for p in network.parameters())])
    for one, expected in zip(*grads, strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-3, atol=1e-3 * expected.abs().max().item())


@pytest.mark.parametrize("training", [True, False])
def test_the_flow_decoder_is_the_dense_one_read_at_occupied_columns(training):
    decoder = unlike_first(FlowDecoder(SETTINGS.network)).train(training)
    where = corner_sites(SHAPE[:2], 4, share=0.3)
    maps = [torch.randn(2, 8, 8, 6), torch.randn(2, 10, 4, 3), torch.randn(2, 12, 2, 2)]
    stacked = []
    norms = deepcopy(decoder.norms)
    for level, (coarse, up, norm) in enumerate(zip(maps, decoder.ups, norms, strict=True), start=1):
        kernel = up.weight.permute(1, 2, 0).unflatten(2, (2**level, 2**level))
        fine = F.conv_transpose2d(coarse, kernel, stride=2**level)[..., : SHAPE[0], : SHAPE[1]]
        stacked.append(norm_relu_at(norm, fine, occupied(where)))
    last = decoder.last
    dense = F.conv2d(torch.cat(stacked, dim=1), last.weight[..., None, None], last.bias)
    sparse = decoder(maps, where)
    torch.testing.assert_close(sparse, dense.movedim(1, -1)[tuple(where.coords.T)], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("training", [True, False])
def test_the_rigid_motion_decoder_is_dilated_convolutions_of_the_flow_map(training):
    decoder = unlike_first(RigidMotionDecoder(8, 5)).train(training)
    nn.init.uniform_(decoder.bias)
    where = corner_sites(SHAPE[:2], 5, share=0.4)
    flow = torch.randn(len(where), 3)
    sparse = decoder(flow, where)
    cells, norms = occupied(where), deepcopy(decoder.norms)
    dense = to_dense(torch.cat([flow, torch.ones(len(flow), 1)], dim=1), where).movedim(-1, 1)
    for layer, conv in enumerate(decoder.convs):
        step = DILATIONS[layer]
        dense = F.conv2d(dense, dense_kernel(conv.weight, 2), padding=step, dilation=step)
        if layer < len(norms):
            dense = norm_relu_at(norms[layer], dense, cells)
    expected = dense.movedim(1, -1)[tuple(where.coords.T)] + decoder.bias
    expected[:, :2] += flow[:, :2]
    torch.testing.assert_close(sparse, expected, rtol=1e-4, atol=1e-5)


def test_an_up_convolution_for_detection_is_the_transposed_convolution():
    up = unlike_first(UpConvolution(5, 3, 4)).eval()
    coarse = torch.randn(2, 5, 3, 2)
    kernel = up.conv.weight[..., 0, 0].T.unflatten(1, (3, 4, 4))
    torch.testing.assert_close(up(coarse), F.relu(up.norm(F.conv_transpose2d(coarse, kernel, stride=4))))


@pytest.mark.parametrize("training", [True, False])
def test_the_feature_encoder_is_voxelnets_on_padded_voxels(training):
    encoder = unlike_first(FeatureEncoder(SETTINGS.grid, SETTINGS.network)).train(training)
    voxels = make_batch([tiny_sample(0), tiny_sample(1)], SETTINGS).voxels0
    sparse = encoder(voxels)
    other = deepcopy(encoder)
    number = torch.cat([torch.arange(n) for n in torch.bincount(voxels.voxel)])  # of a point in its voxel
    padded = torch.zeros(len(voxels.coords), SETTINGS.grid.max_points, 9)
    padded[voxels.voxel, number] = encoder._inputs(voxels)
    mask = torch.zeros(padded.shape[:2], dtype=torch.bool)
    mask[voxels.voxel, number] = True

    def layer(part, rows):
        out = torch.zeros(*rows.shape[:2], part.linear.out_features)
        out[mask] = F.relu(part.norm(part.linear(rows[mask])))
        return out

    for part in other.layers:
        each = layer(part.each, padded)
        padded = torch.cat([each, each.amax(1, keepdim=True).expand_as(each)], dim=2) * mask[..., None]
    expected = layer(other.last, padded).amax(1)
    torch.testing.assert_close(sparse, expected, rtol=1e-4, atol=1e-5)


def test_points_features_are_their_place_and_their_offsets_in_voxels():
    voxels = Voxels(
        torch.tensor([[0.8, -4.0, -2.4, 0.2, 0.0, -0.1]]), torch.zeros(1, dtype=torch.int64), torch.tensor([[1, 1, 1]])
    )
    inputs = FeatureEncoder(SETTINGS.grid, SETTINGS.network)._inputs(voxels)[0]
    # voxel (1, 1, 1): from 0.8, -4.0, -2.5; its centre 1.2, -3.6, -2.25
    expected = [-0.875, -5 / 6, -0.7, 0.25, 0.0, -0.2, -0.5, -0.5, -0.3]
    torch.testing.assert_close(inputs, torch.tensor(expected))


def test_what_comes_out_has_the_shapes_that_are_said_and_the_columns_of_scan_0():
    network = PointFlowNet(SETTINGS)
    batch = make_batch([tiny_sample(0), tiny_sample(1), tiny_sample(2)], SETTINGS)
    output = network(batch.voxels0, batch.voxels1, 3)
    assert output.columns.equal(batch.targets.columns)
    count = len(output.columns)
    assert output.flow_columns.shape == output.motion_columns.shape == (count, 3)
    assert output.ego.shape == (3, 3)
    assert output.scores.shape == batch.targets.anchor_labels.shape == (3, 2, 8, 6)
    assert output.residuals.shape == batch.targets.anchor_residuals.shape == (3, 2, 7, 8, 6)
    assert {getattr(output, name).dtype for name in OUTPUTS} == {torch.float32}


def test_a_pair_is_judged_alike_alone_and_in_a_batch():
    network = unlike_first(PointFlowNet(SETTINGS)).eval()
    samples = [tiny_sample(0), tiny_sample(1)]
    batch = make_batch(samples, SETTINGS)
    together = network(batch.voxels0, batch.voxels1, 2)
    for number, sample in enumerate(samples):
        one = make_batch([sample], SETTINGS)
        alone = network(one.voxels0, one.voxels1, 1)
        here = together.columns[:, 0] == number
        for name in OUTPUTS:
            both = getattr(together, name)
            part = both[here] if name.endswith("columns") else both[number : number + 1]
            torch.testing.assert_close(part, getattr(alone, name), rtol=1e-4, atol=1e-5)


def test_the_order_of_a_scans_points_does_not_matter():
    network = unlike_first(PointFlowNet(tiny_settings())).eval()
    sample = tiny_sample(0, points=60)  # no voxel has more than T points
    order = np.random.default_rng(0).permutation(60)
    mixed = replace(
        sample,
        xyz0=sample.xyz0[order],
        flow0=sample.flow0[order],
        status0=sample.status0[order],
        instance0=sample.instance0[order],
        reflectance0=sample.reflectance0[order],
    )
    outputs = []
    for one in (sample, mixed):
        batch = make_batch([one], SETTINGS)
        outputs.append(network(batch.voxels0, batch.voxels1, 1))
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(outputs[0], name), getattr(outputs[1], name), rtol=1e-4, atol=1e-5)


def test_every_weight_learns_from_every_batch():
    network = PointFlowNet(SETTINGS)
    batch = make_batch([tiny_sample(0), tiny_sample(1)], SETTINGS)
    optimiser = torch.optim.SGD(network.parameters(), lr=1e-3)
    for _ in range(2):  # layers before one that begins with zeros learn from the second step on
        optimiser.step()
        optimiser.zero_grad()
        output = network(batch.voxels0, batch.voxels1, 2, batch.targets.columns)
        total_loss(output, batch.targets, SETTINGS)[0].backward()
    still = [name for name, weight in network.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert not still


def test_a_few_steps_learn_two_pairs():
    network = PointFlowNet(SETTINGS)
    batch = make_batch([tiny_sample(0), tiny_sample(1)], SETTINGS)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(40):
        output = network(batch.voxels0, batch.voxels1, 2, batch.targets.columns)
        loss, _ = total_loss(output, batch.targets, SETTINGS)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.25 * losses[0]


def test_bfloat16_gives_nearly_the_same_and_float32_comes_out():
    network = unlike_first(PointFlowNet(SETTINGS)).eval()
    batch = make_batch([tiny_sample(0)], SETTINGS)
    exact = network(batch.voxels0, batch.voxels1, 1)
    with torch.autocast("cpu", torch.bfloat16):
        rough = network(batch.voxels0, batch.voxels1, 1)
    for name in OUTPUTS:
        assert getattr(rough, name).dtype == torch.float32
        torch.testing.assert_close(getattr(rough, name), getattr(exact, name), rtol=0.1, atol=0.05)


def test_reflectance_is_one_more_input():
    with_it = SETTINGS.model_copy(update={"network": SETTINGS.network.model_copy(update={"reflectance": True})})
    network = PointFlowNet(with_it).eval()
    batch = make_batch([tiny_sample(0)], with_it)
    assert network.feature_encoder._inputs(batch.voxels0).shape[1] == 10
    assert network(batch.voxels0, batch.voxels1, 1).flow_columns.isfinite().all()


@pytest.mark.parametrize(("name", "millions"), [("paper", (8.0, 10.0)), ("small", (0.5, 1.5))])
def test_shipped_settings_make_networks_of_their_size(name, millions):
    with torch.device("meta"):
        network = PointFlowNet(load_settings(name))
    assert millions[0] < sum(p.numel() for p in network.parameters()) / 1e6 < millions[1]
