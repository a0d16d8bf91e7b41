"""Deep ensembles, and the plain network that is an ensemble of one.

Lakshminarayanan, Pritzel, Blundell, "Simple and Scalable Predictive Uncertainty Estimation using
Deep Ensembles", NeurIPS 2017: networks that differ in their initial weights and in the order of
their data agree where there are data and need not agree elsewhere. Every member has all rows, each
in an order of its own: the paper found bootstrap samples to do harm (section 2.4). Its adversarial
training is left out, as its inputs have no common scale here.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ugat_marl.grounding.uncertainty import (
    AnswerNet,
    InversePrediction,
    Lesson,
    divergence_from_even,
    log_probability,
    negative_log_likelihood,
    prediction,
)


class EnsembleNet(AnswerNet):
    """Members side by side in one batched product; u is the entropy of their mean."""

    def logits(self, inputs: Tensor) -> Tensor:
        """``(agents, members, batch, actions)`` for the inputs that `loss` and `answer` take."""
        if inputs.dim() == 3:
            inputs = inputs[:, None].expand(-1, self.members, -1, -1)
        agents, members, rows, width = inputs.shape
        own = inputs.transpose(0, 1).reshape(members * agents, rows, width)
        embedding = torch.relu(self.encoders(own)).view(members, agents * rows, -1)
        weight = self.head.weight.view(members, -1, embedding.shape[-1])
        bias = self.head.bias.view(members, 1, -1)
        out = torch.baddbmm(bias, embedding, weight.transpose(1, 2))
        return out.view(members, agents, rows, -1).transpose(0, 1)

    def outputs(self, inputs: Tensor, lesson: Lesson) -> Tensor:
        """The logits."""
        del lesson
        return self.logits(inputs)

    def row_loss(self, outputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """Cross-entropy, member by member."""
        del lesson
        own = target.reshape(outputs.shape[:3])
        return negative_log_likelihood(outputs, own, self.valid_actions[:, None]).view(target.shape)

    def certainty(self, outputs: Tensor) -> Tensor:
        """Divergence from even odds, member by member."""
        certain = divergence_from_even(outputs, self.valid_actions[:, None])
        return certain if self.members > 1 else certain[:, 0]

    def answer(self, inputs: Tensor) -> InversePrediction:
        """The mean of the members' probabilities (section 2.4); u is its entropy."""
        each = log_probability(self.logits(inputs), self.valid_actions[:, None]).exp()
        return prediction(each.mean(1), self.valid_actions)


class PlainNet(EnsembleNet):
    """One network without uncertainty: u = 0, so that every grounded action is taken.

    This is the grounded action transformation without a gate (GAT; Hanna and Stone, AAAI 2017).
    """

    def loss(self, inputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """Cross-entropy; what would be claimed off the data is nobody's concern."""
        return self.row_loss(self.outputs(inputs, lesson), target, lesson)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """The likeliest action, as if beyond doubt."""
        found = super().answer(inputs)
        return InversePrediction(found.action, found.probability, torch.zeros_like(found.u))
