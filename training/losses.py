"""The paper's losses: what the network says and what is true in; terms with their sums, counts and weights out.

One function a term, with its equation's number. Each gives a sum and what it was summed over, so that several processes
can add both up before they divide. Left out: columns whose points all have unknown flow (contract: status 1), and
anchors that are neither positive nor negative. K of Eq. 6 and 7 is the number of columns that count, those of objects
as often as `loss.object` says (the paper: once).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from training.config import Settings

if TYPE_CHECKING:
    from training.network import Output
    from training.voxelize import Targets


@dataclass(frozen=True, eq=False)
class Term:
    """A mean that enters the loss: weight times sum / count."""

    weight: float
    sum: Tensor  # scalar float32, with its gradient
    count: Tensor  # scalar: what was summed over, or its weights

    @property
    def mean(self) -> Tensor:
        """0 where nothing counts."""
        return self.sum / self.count.clamp(min=1)


def total_loss(output: "Output", targets: "Targets", settings: Settings) -> tuple[Tensor, dict[str, Tensor]]:
    """Eq. 5: L = alpha L_flow + beta L_rigmo + gamma L_ego + L_det; and each term's mean, without gradient."""
    terms = loss_terms(output, targets, settings)
    loss = torch.stack([term.weight * term.mean for term in terms.values()]).sum()
    return loss, {name: term.mean.detach() for name, term in terms.items()}


def loss_terms(output: "Output", targets: "Targets", settings: Settings) -> dict[str, Term]:
    """The terms of Eq. 5 by name; Eq. 10 (detection) in its three means."""
    config = settings.loss
    weight = targets.known * (1.0 + (config.object - 1.0) * targets.is_object)
    flow = flow_loss(output.flow_columns, targets.flow, weight)
    rigid = rigid_motion_loss(output.motion_columns, targets.motion, weight, config.lambda_)
    ego = ego_motion_loss(output.ego, targets.ego, config.lambda_)
    found, missed = classification_loss(output.scores, targets.anchor_labels)
    boxes = regression_loss(output.residuals, targets.anchor_residuals, targets.anchor_labels)
    return {
        "flow": Term(config.alpha, *flow),
        "rigid": Term(config.beta, *rigid),
        "ego": Term(config.gamma, *ego),
        "positive": Term(config.detection * config.positive, *found),
        "negative": Term(config.detection * config.negative, *missed),
        "boxes": Term(config.detection, *boxes),
    }


def flow_loss(flow: Tensor, true: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Eq. 6: l1 distance of flows (C, 3), over columns that weigh (C,): 0 where not known, 1 in the paper."""
    return ((flow - true).abs().sum(1) * weight).sum(), weight.sum()


def rigid_motion_loss(motion: Tensor, true: Tensor, weight: Tensor, lambda_: float) -> tuple[Tensor, Tensor]:
    """Eq. 7: l1 distance of local translations plus lambda times that of rotations (C, 3), weighed as in Eq. 6."""
    return (_planar_distance(motion, true, lambda_) * weight).sum(), weight.sum()


def ego_motion_loss(ego: Tensor, true: Tensor, lambda_: float) -> tuple[Tensor, Tensor]:
    """Eq. 9: l1 distance of background translations plus lambda times that of rotations, (B, 3)."""
    return _planar_distance(ego, true, lambda_).sum(), torch.tensor(len(ego), device=ego.device)


def classification_loss(scores: Tensor, labels: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Eq. 10, L_cls: cross entropy of positive anchors with 1, and of negative ones with 0; logits and labels alike."""
    positive, negative = labels == 1, labels == 0
    return (F.softplus(-scores[positive]).sum(), positive.sum()), (F.softplus(scores[negative]).sum(), negative.sum())


def regression_loss(residuals: Tensor, true: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Eq. 10, L_reg: smooth l1 of the residuals (B, A, 7, x, y) of positive anchors (B, A, x, y), the seven summed."""
    positive = labels == 1
    given, wanted = residuals.movedim(2, -1)[positive], true.movedim(2, -1)[positive]
    return F.smooth_l1_loss(given, wanted, reduction="sum"), positive.sum()


def _planar_distance(motion: Tensor, true: Tensor, lambda_: float) -> Tensor:
    error = (motion - true).abs()
    return error[..., 0] + error[..., 1] + lambda_ * error[..., 2]
