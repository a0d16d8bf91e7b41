"""Evidential classification (Sensoy, Kaplan and Kandemir, NeurIPS 2018), with masked classes.

A network's outputs become the concentration of a Dirichlet distribution over class probabilities.
Its mean is the prediction; how little evidence there is in all is the uncertainty. Rows may have
different numbers of classes: a mask says which are theirs, and K is their number, row by row.

Shapes: ``(..., K)`` for logits, concentrations and masks (broadcastable), ``(...)`` for the rest.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ugat_marl.grounding.uncertainty import AnswerNet, InversePrediction, Lesson


def concentration(logits: Tensor, mask: Tensor) -> Tensor:
    """Dirichlet concentration ``softplus(logits) + 1``; 0 where a row has no such class."""
    return (functional.softplus(logits) + 1.0) * mask


def expected_probability(alpha: Tensor) -> Tensor:
    """Mean of the Dirichlet; 0 for classes a row does not have."""
    return alpha / alpha.sum(-1, keepdim=True)


def uncertainty(alpha: Tensor, mask: Tensor) -> Tensor:
    """U = K / S, in (0, 1]: 1 without any evidence. K is the row's own number of classes."""
    return mask.sum(-1) / alpha.sum(-1)


def expected_squared_error(alpha: Tensor, target: Tensor) -> Tensor:
    """E[sum_j (y_j - p_j)^2] for p from the Dirichlet (Sensoy et al., equation 5).

    Args:
        alpha: ``(..., K)`` concentrations, 0 where masked.
        target: ``(...)`` int64, the true class.
    """
    total = alpha.sum(-1, keepdim=True)
    mean = alpha / total
    truth = functional.one_hot(target, alpha.shape[-1])
    return ((truth - mean) ** 2 + mean * (1.0 - mean) / (total + 1.0)).sum(-1)


def divergence_from_uniform(alpha: Tensor, mask: Tensor) -> Tensor:
    """KL of Dirichlet(alpha) from the uniform Dirichlet over the row's own classes, in nats."""
    return _Divergence.apply(alpha, mask)  # pyright: ignore[reportReturnType]


class _Divergence(torch.autograd.Function):
    """That divergence with its derivative in closed form, in which all digammas have cancelled.

    With S the total: dKL/d alpha_k = (alpha_k - 1) trigamma(alpha_k) - (S - K) trigamma(S).
    """

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor) -> Tensor:
        own = torch.where(mask, alpha, 1.0)  # a concentration of 1 contributes nothing below
        total = (own * mask).sum(-1)
        count = mask.sum(-1).to(alpha.dtype)
        ctx.save_for_backward(own, mask, total, count)
        pull = ((own - 1.0) * (torch.digamma(own) - torch.digamma(total)[..., None])).sum(-1)
        return torch.lgamma(total) - torch.lgamma(count) - torch.lgamma(own).sum(-1) + pull

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        own, mask, total, count = ctx.saved_tensors
        shared = (total - count) * torch.polygamma(1, total)
        slope = (own - 1.0) * torch.polygamma(1, own) - shared[..., None]
        return gradients[0][..., None] * slope * mask, None


def misleading(alpha: Tensor, target: Tensor) -> Tensor:
    """Concentrations with the evidence for the true class removed (Sensoy et al., section 3)."""
    truth = functional.one_hot(target, alpha.shape[-1])
    return truth + (1 - truth) * alpha


def evidential_loss(alpha: Tensor, target: Tensor, mask: Tensor, kl_weight: float) -> Tensor:
    """Expected squared error plus weighted divergence of the misleading evidence, per row."""
    error = expected_squared_error(alpha, target)
    if kl_weight == 0.0:
        return error
    return error + kl_weight * divergence_from_uniform(misleading(alpha, target), mask)


def annealing(epoch: int, epochs: int = 10) -> float:
    """Weight of the divergence in epoch 0, 1, ...: min(1, epoch / epochs)."""
    return 1.0 if epochs <= 0 else min(1.0, epoch / epochs)


class EvidentialNet(AnswerNet):
    """One network whose outputs are evidence; u = K / S."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Concentrations ``(agents, batch, actions)`` for standardised inputs."""
        embedding = torch.relu(self.encoders(inputs))
        return concentration(self.head(embedding), self.valid_actions)

    def outputs(self, inputs: Tensor, lesson: Lesson) -> Tensor:
        """The concentrations."""
        del lesson
        return self(inputs)

    def row_loss(self, outputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """The evidential loss, its divergence annealed in."""
        weight = lesson.kl_weight * lesson.share
        return evidential_loss(outputs, target, self.valid_actions, weight)

    def certainty(self, outputs: Tensor) -> Tensor:
        """Divergence of the evidence from none."""
        return divergence_from_uniform(outputs, self.valid_actions)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """The mean of the Dirichlet, and how little evidence there is."""
        alpha = self(inputs)
        return InversePrediction(
            action=alpha.argmax(-1),
            probability=expected_probability(alpha),
            u=uncertainty(alpha, self.valid_actions),
        )
