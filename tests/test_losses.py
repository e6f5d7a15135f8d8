"""Each term of the loss against numbers worked out by hand, and what each leaves out."""

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from training.config import LossConfig, Settings  # noqa: E402
from training.losses import (  # noqa: E402
    classification_loss,
    ego_motion_loss,
    flow_loss,
    loss_terms,
    regression_loss,
    rigid_motion_loss,
    total_loss,
)
from training.network import Output  # noqa: E402
from training.voxelize import Targets  # noqa: E402

CONFIG = LossConfig.model_validate(
    {"alpha": 2.0, "beta": 3.0, "gamma": 5.0, "lambda": 10.0, "detection": 7.0, "positive": 1.5, "negative": 1.0}
)
SETTINGS = Settings(loss=CONFIG)
NO, YES = -1, 1


def made() -> tuple[Output, Targets]:
    """Three columns of one pair, the last without a known point; a grid of 1 x 2 cells with two anchors each."""
    columns = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    flow = torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, -1.0], [50.0, 50.0, 50.0]])
    motion = torch.tensor([[1.0, 0.0, 0.1], [0.0, 2.0, 0.0], [50.0, 50.0, 3.0]])
    labels = torch.tensor([[[[YES, 0]], [[NO, 0]]]], dtype=torch.int8)  # (B, A, 1, 2)
    residuals = torch.zeros(1, 2, 7, 1, 2)
    residuals[0, 0, :, 0, 0] = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    targets = Targets(
        columns=columns,
        flow=torch.zeros(3, 3),
        motion=torch.zeros(3, 3),
        known=torch.tensor([True, True, False]),
        is_object=torch.zeros(3, dtype=torch.bool),
        ego=torch.tensor([[1.0, 0.0, 0.02]]),
        anchor_labels=labels,
        anchor_residuals=residuals,
    )
    scores = torch.tensor([[[[0.0, 1.0]], [[30.0, -2.0]]]])
    output = Output(columns, flow, motion, torch.tensor([[0.5, 0.25, 0.0]]), scores, torch.zeros(1, 2, 7, 1, 2))
    return output, targets


def test_flow_is_the_mean_l1_distance_over_known_columns():
    output, targets = made()
    total, count = flow_loss(output.flow_columns, targets.flow, targets.known)
    assert (total.item(), count.item()) == (4.0, 2)  # 1 and 3; the third has no known point


def test_rigid_motion_is_the_l1_distance_with_lambda_times_the_rotations():
    output, targets = made()
    total, count = rigid_motion_loss(output.motion_columns, targets.motion, targets.known, 10.0)
    assert total.item() == pytest.approx(1.0 + 10 * 0.1 + 2.0)
    assert count.item() == 2


def test_ego_motion_is_the_l1_distance_over_pairs():
    output, targets = made()
    total, count = ego_motion_loss(output.ego, targets.ego, 10.0)
    assert total.item() == pytest.approx(0.5 + 0.25 + 10 * 0.02)
    assert count.item() == 1


def test_classification_is_the_cross_entropy_of_positive_and_of_negative_anchors():
    output, targets = made()
    (found, positives), (missed, negatives) = classification_loss(output.scores, targets.anchor_labels)
    assert (positives.item(), negatives.item()) == (1, 2)
    assert found.item() == pytest.approx(math.log(2.0))  # logit 0
    assert missed.item() == pytest.approx(math.log(1 + math.e) + math.log(1 + math.exp(-2.0)))


def test_regression_is_the_smooth_l1_distance_of_positive_anchors():
    output, targets = made()
    total, count = regression_loss(output.residuals, targets.anchor_residuals, targets.anchor_labels)
    assert total.item() == pytest.approx(0.5 * 0.5**2 + (2.0 - 0.5))
    assert count.item() == 1


def test_the_whole_is_the_weighted_sum_of_the_means():
    output, targets = made()
    loss, parts = total_loss(output, targets, SETTINGS)
    expected = {
        "flow": 2.0,
        "rigid": 2.0,
        "ego": 0.95,
        "positive": math.log(2.0),
        "negative": (math.log(1 + math.e) + math.log(1 + math.exp(-2.0))) / 2,
        "boxes": 1.625,
    }
    assert {name: part.item() for name, part in parts.items()} == pytest.approx(expected)
    weights = {"flow": 2, "rigid": 3, "ego": 5, "positive": 7 * 1.5, "negative": 7, "boxes": 7}
    assert loss.item() == pytest.approx(sum(weights[name] * expected[name] for name in weights))


def test_columns_that_are_not_known_and_anchors_that_are_left_out_have_no_say():
    output, targets = made()
    given = {name: getattr(output, name).clone().requires_grad_() for name in OUTPUTS}
    total_loss(replace(output, **given), targets, SETTINGS)[0].backward()
    assert not given["flow_columns"].grad[2].any()
    assert not given["motion_columns"].grad[2].any()
    assert given["flow_columns"].grad[:2].any(1).all()
    assert given["scores"].grad[0, 1, 0, 0] == 0.0  # neither positive nor negative
    assert (given["scores"].grad != 0).sum() == 3
    assert (given["residuals"].grad != 0).nonzero()[:, [1, 3, 4]].unique(dim=0).tolist() == [[0, 0, 0]]


OUTPUTS = ("flow_columns", "motion_columns", "ego", "scores", "residuals")


def test_nothing_to_learn_is_a_loss_of_zero_not_nan():
    output, targets = made()
    nothing = replace(
        targets, known=torch.zeros(3, dtype=torch.bool), anchor_labels=torch.full_like(targets.anchor_labels, NO)
    )
    given = {name: getattr(output, name).clone().requires_grad_() for name in OUTPUTS}
    loss, parts = total_loss(replace(output, **given), nothing, SETTINGS)
    assert loss.item() == pytest.approx(5.0 * 0.95)  # the ego-motion's alone
    assert all(part.item() == 0.0 for name, part in parts.items() if name != "ego")
    loss.backward()
    assert all(torch.isfinite(value.grad).all() for value in given.values())


def test_sums_and_counts_of_two_halves_add_up_to_those_of_the_whole():
    output, targets = made()
    both = loss_terms(output, targets, SETTINGS)
    parts = []
    for rows in (slice(0, 1), slice(1, 3)):
        part = replace(
            targets,
            flow=targets.flow[rows],
            motion=targets.motion[rows],
            known=targets.known[rows],
            is_object=targets.is_object[rows],
        )
        half = replace(output, flow_columns=output.flow_columns[rows], motion_columns=output.motion_columns[rows])
        parts.append(loss_terms(half, part, SETTINGS))
    for name in ("flow", "rigid"):
        assert sum(part[name].sum for part in parts).item() == pytest.approx(both[name].sum.item())
        assert sum(part[name].count for part in parts).item() == both[name].count.item()


def test_a_column_on_an_object_counts_as_often_as_is_asked_for():
    output, targets = made()
    on_object = replace(targets, is_object=torch.tensor([False, True, True]))
    often = Settings(loss=CONFIG.model_copy(update={"object": 4.0}))
    terms = loss_terms(output, on_object, often)
    assert (terms["flow"].sum.item(), terms["flow"].count.item()) == (1.0 + 4 * 3.0, 5.0)  # the unknown one still not
    assert terms["rigid"].sum.item() == pytest.approx(2.0 + 4 * 2.0)


def test_a_perfect_answer_costs_nothing():
    output, targets = made()
    perfect = replace(
        output,
        flow_columns=targets.flow,
        motion_columns=targets.motion,
        ego=targets.ego,
        residuals=targets.anchor_residuals,
        scores=torch.where(targets.anchor_labels == YES, 50.0, -50.0),
    )
    assert total_loss(perfect, targets, SETTINGS)[0].item() < 1e-12
