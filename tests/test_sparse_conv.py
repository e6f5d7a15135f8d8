"""Each sparse operation is its dense definition, read where it is defined: values, borders, gradients."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from torch.nn import functional as F  # noqa: E402

from training.sparse_conv import (  # noqa: E402
    Rules,
    Sites,
    SparseConv,
    conv_rules,
    dense_kernel,
    gather_multiply_scatter,
    reached_sites,
    to_dense,
    upsampling_rules,
)

F64 = torch.float64
VERTICAL = (1, 1, 2)
BORDER = 0.3  # share of occupied cells: corners and edges are among them
seeds = st.integers(0, 2**31)


def some_sites(shape: tuple[int, ...], seed: int, batch: int = 2, share: float = BORDER) -> Sites:
    """Random cells, and both far corners of the grid."""
    drawn = torch.rand((batch, *shape), generator=torch.Generator().manual_seed(seed)) < share
    drawn[0].flatten()[0] = drawn[-1].flatten()[-1] = True
    return Sites(drawn.nonzero(), shape, batch)


def some(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def channels_first(features: torch.Tensor, sites: Sites) -> torch.Tensor:
    """The dense grid as torch's convolutions have it, (batch, C, *shape)."""
    return to_dense(features, sites).movedim(-1, 1)


def read(dense: torch.Tensor, sites: Sites) -> torch.Tensor:
    """What a dense map (batch, C, *shape) holds at sites: (V, C)."""
    return dense.movedim(1, -1)[tuple(sites.coords.T)]


@given(seeds, st.sampled_from([(5, 4, 10), (4, 6, 8), (3, 3, 5), (4, 5, 3)]))
@settings(max_examples=25, deadline=None)
def test_a_strided_3d_convolution_is_the_dense_one_at_the_cells_that_it_reaches(seed, shape):
    inputs = some_sites(shape, seed)
    features, weight = some(len(inputs), 3, seed=seed), some(27, 3, 4, seed=seed + 1)
    outputs = reached_sites([inputs], 3, VERTICAL, 1)
    sparse = gather_multiply_scatter(features, weight, conv_rules(inputs, outputs, 3, VERTICAL, 1))
    dense = F.conv3d(channels_first(features, inputs), dense_kernel(weight, 3), stride=VERTICAL, padding=1)
    assert dense.shape[2:] == outputs.shape
    torch.testing.assert_close(sparse, read(dense, outputs))
    reached = torch.zeros((2, *outputs.shape), dtype=torch.bool)
    reached[tuple(outputs.coords.T)] = True
    assert not dense.movedim(1, -1)[~reached].any()  # all other cells are zero by themselves


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_the_first_convolution_of_two_scans_side_by_side_is_the_sum_of_two(seed):
    scans = [some_sites((5, 4, 10), seed + k, share=0.15) for k in range(2)]
    features = [some(len(sites), 3, seed=seed + k) for k, sites in enumerate(scans)]
    halves = [some(27, 3, 4, seed=seed + k) for k in (2, 3)]
    outputs = reached_sites(scans, 3, VERTICAL, 1)
    sparse = sum(
        gather_multiply_scatter(rows, half, conv_rules(sites, outputs, 3, VERTICAL, 1))
        for rows, half, sites in zip(features, halves, scans, strict=True)
    )
    side_by_side = torch.cat([channels_first(r, s) for r, s in zip(features, scans, strict=True)], dim=1)
    dense = F.conv3d(side_by_side, dense_kernel(torch.cat(halves, dim=1), 3), stride=VERTICAL, padding=1)
    torch.testing.assert_close(sparse, read(dense, outputs))
    torch.testing.assert_close(channels_first(sparse, outputs), dense)


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_cells_that_are_reached_are_those_whose_window_holds_a_site(seed):
    scans = [some_sites((5, 4, 7), seed + k, share=0.03) for k in range(2)]
    occupied = torch.zeros((2, 1, 5, 4, 7), dtype=F64)
    for sites in scans:
        occupied[:, 0][tuple(sites.coords.T)] = 1.0
    touched = F.conv3d(occupied, torch.ones(1, 1, 3, 3, 3, dtype=F64), stride=VERTICAL, padding=1)[:, 0] > 0
    assert reached_sites(scans, 3, VERTICAL, 1).coords.equal(touched.nonzero())


@pytest.mark.parametrize("dilation", [1, 2, 4])
def test_a_dilated_convolution_between_the_same_columns_is_the_dense_one_there(dilation):
    sites = some_sites((9, 7), seed=dilation)
    features, weight = some(len(sites), 3), some(9, 3, 4, seed=1)
    sparse = gather_multiply_scatter(features, weight, conv_rules(sites, sites, 3, (1, 1), dilation, dilation))
    kernel = dense_kernel(weight, 2)
    dense = F.conv2d(channels_first(features, sites), kernel, padding=dilation, dilation=dilation)
    torch.testing.assert_close(sparse, read(dense, sites))


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_an_up_convolution_at_columns_is_the_dense_one_read_there(stride):
    fine = 16, 12  # 12 is no multiple of 8: the coarse map reaches beyond the fine one
    coarse = tuple(-(-n // stride) for n in fine)
    sites = some_sites(fine, seed=stride)
    maps, weight = some(2, 3, *coarse), some(stride * stride, 3, 5, seed=1)
    rows = maps.movedim(1, -1).flatten(0, 2)
    sparse = gather_multiply_scatter(rows, weight, upsampling_rules(coarse, sites, stride))
    kernel = weight.permute(1, 2, 0).unflatten(2, (stride, stride))
    dense = F.conv_transpose2d(maps, kernel, stride=stride)[..., : fine[0], : fine[1]]
    torch.testing.assert_close(sparse, read(dense, sites))


def test_gradients_are_those_of_finite_differences():
    inputs = some_sites((3, 3, 4), seed=0, batch=1)
    outputs = reached_sites([inputs], 3, VERTICAL, 1)
    rules = conv_rules(inputs, outputs, 3, VERTICAL, 1)
    features, weight = some(len(inputs), 2).requires_grad_(), some(27, 2, 2, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: gather_multiply_scatter(f, w, rules), (features, weight))
    assert torch.autograd.gradcheck(lambda f: gather_multiply_scatter(f, weight.detach(), rules), (features,))


def test_gradients_of_an_up_convolution_are_those_of_finite_differences():
    sites = some_sites((4, 4), seed=3, batch=1)
    rules = upsampling_rules((2, 2), sites, 2)
    features, weight = some(4, 2).requires_grad_(), some(4, 2, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: gather_multiply_scatter(f, w, rules), (features, weight))


def test_gradients_are_those_of_the_dense_convolution():
    inputs = some_sites((4, 4, 6), seed=5)
    outputs = reached_sites([inputs], 3, VERTICAL, 1)
    grads = []
    for is_sparse in (True, False):
        features, weight = some(len(inputs), 3).requires_grad_(), some(27, 3, 4, seed=1).requires_grad_()
        if is_sparse:
            out = gather_multiply_scatter(features, weight, conv_rules(inputs, outputs, 3, VERTICAL, 1))
        else:
            kernel = dense_kernel(weight, 3)
            dense = F.conv3d(channels_first(features, inputs), kernel, stride=VERTICAL, padding=1)
            out = read(dense, outputs)
        out.square().sum().backward()
        grads.append((features.grad, weight.grad))
    torch.testing.assert_close(grads[0], grads[1])


def test_samples_of_a_batch_do_not_see_each_other():
    both = some_sites((4, 4, 6), seed=7)
    features, weight = some(len(both), 2), some(27, 2, 3, seed=1)

    def convolved(sites, rows):
        outputs = reached_sites([sites], 3, VERTICAL, 1)
        return outputs, gather_multiply_scatter(rows, weight, conv_rules(sites, outputs, 3, VERTICAL, 1))

    outputs, together = convolved(both, features)
    for number in range(2):
        here = both.coords[:, 0] == number
        alone = both.coords[here].clone()
        alone[:, 0] = 0
        torch.testing.assert_close(
            convolved(Sites(alone, both.shape, 1), features[here])[1], together[outputs.coords[:, 0] == number]
        )


def test_an_offset_that_meets_nothing_adds_nothing():
    lonely = Sites(torch.tensor([[0, 1, 1]]), (3, 3), 1)
    rules = conv_rules(lonely, lonely, 3, (1, 1), 1)
    assert rules.counts == (0, 0, 0, 0, 1, 0, 0, 0, 0)
    weight = some(9, 2, 2).requires_grad_()
    gather_multiply_scatter(some(1, 2), weight, rules).sum().backward()
    assert not weight.grad[[0, 1, 2, 3, 5, 6, 7, 8]].any()
    assert weight.grad[4].any()


def test_under_autocast_products_are_bfloat16_and_sums_float32():
    rules = Rules(torch.zeros(256, dtype=torch.int64), torch.zeros(256, dtype=torch.int64), (256,), 1)
    one = torch.ones(1, 1)
    with torch.autocast("cpu", torch.bfloat16):
        out = gather_multiply_scatter(one, torch.full((1, 1, 1), 1.0 + 2.0**-12), rules)
    assert out.dtype == torch.float32
    assert out.item() == 256.0  # the weight was rounded
    assert gather_multiply_scatter(one, torch.full((1, 1, 1), 1.0 + 2.0**-12), rules).item() == 256.0 + 2.0**-4


def test_first_weights_are_as_large_as_those_of_dense_convolutions():
    torch.manual_seed(0)
    sparse, dense = SparseConv(32, 64, 27).weight, torch.nn.Conv3d(32, 64, 3).weight
    assert sparse.std().item() == pytest.approx(dense.std().item(), rel=0.02)
    assert sparse.abs().max().item() == pytest.approx(dense.abs().max().item(), rel=0.01)
