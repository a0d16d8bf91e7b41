"""Concrete Dropout: how much of a network to leave out is learned along with its weights.

Gal, Hron, Kendall, "Concrete Dropout", NeurIPS 2017. A network with random units left out is a draw
from an approximate posterior over networks. The objective is the likelihood of the data and, over
their number N, the divergence of that posterior from a Gaussian prior of length scale l: for an
affine map W of n inputs with rate p it is l^2 (1 - p) |W|^2 / 2 - n H(p), H being the entropy of a
coin. Much data press the rates down, little data let H pull them up. The coin is relaxed, so that p
has a gradient.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ugat_marl.grounding.uncertainty import (
    AnswerNet,
    InversePrediction,
    Lesson,
    NetShape,
    divergence_from_even,
    log_probability,
    negative_log_likelihood,
    prediction,
)
from ugat_marl.policies import BatchedLinear

TEMPERATURE = 0.1
"""Of the relaxed coin, as in the paper."""

START = 0.1
"""Rate of a fresh network, as in the authors' code."""

SPEED = 10.0
"""Rates learn so much faster than weights: a fit is a few hundred updates long."""

LENGTH_SCALE = 1e-2
"""l of the prior, as in the authors' code: weights of a hundred would be no surprise."""

SMALLEST = 1e-6
"""Rates and draws keep this distance from 0 and 1, where logarithms end."""

CHUNK = 256
"""Rows answered at once, which bounds the memory of all passes over them."""


def thinned(inputs: Tensor, logit: Tensor, draw: Tensor) -> Tensor:
    """Inputs times a relaxed coin that is 0 at rate p, and 1 / (1 - p), so that the mean stays.

    Args:
        inputs: Any shape; units last.
        logit: log p - log (1 - p), broadcastable.
        draw: Uniform numbers in [0, 1), broadcastable: above 1 - p leaves a unit out.
    """
    dropped = torch.sigmoid((logit + torch.logit(draw, SMALLEST)) / TEMPERATURE)
    return inputs * (1.0 - dropped) / torch.sigmoid(-logit)


def divergence(weight: Tensor, logit: Tensor, units: Tensor | int) -> Tensor:
    """What a layer's posterior is away from the prior, in nats and up to a constant.

    Args:
        weight: ``(..., inputs, outputs)``, 0 for inputs it does not have. `thinned` divides what
            the layer is given by 1 - p, so the W of the formula is weight / (1 - p).
        logit: ``(...)`` of its rate.
        units: Number of its inputs, ``(...)`` or the same for all.
    """
    p = torch.sigmoid(logit).clamp(SMALLEST, 1.0 - SMALLEST)
    entropy = torch.special.entr(p) + torch.special.entr(1.0 - p)
    size = weight.square().sum((-2, -1))
    return LENGTH_SCALE**2 / 2 * size / (1.0 - p) - units * entropy


class DropoutNet(AnswerNet):
    """One network, thinned before every affine map at a rate of that map.

    An intersection's encoder has rates of its own. Answers average over `passes` thinned networks
    that were drawn when this one was made and are kept in checkpoints: the same input always gets
    the same answer, whatever it is asked together with, and u needs no generator when it is used.

    Args:
        shape: Sizes.
        generator: Source of the initial weights and of the thinned networks.
        passes: Number of thinned networks, T in the papers.
    """

    fan_in: Tensor
    own_inputs: Tensor

    def __init__(self, shape: NetShape, generator: torch.Generator, passes: int) -> None:
        super().__init__(shape, generator)
        agents, widest = len(shape.fan_in), max(shape.fan_in)
        widths = [widest, *shape.hidden, shape.embedding]
        owners = [agents] * (len(widths) - 1) + [1]  # the head is shared
        start = math.log(START) - math.log(1.0 - START)
        self.slow_logits = nn.ParameterList(torch.full((n, 1, 1), start / SPEED) for n in owners)
        for k, (n, width) in enumerate(zip(owners, widths, strict=True)):
            draws = torch.rand(n, passes, 1, width, generator=generator)
            self.register_buffer(f"draws_{k}", draws)
        fan_in = torch.tensor([*shape.fan_in])
        self.register_buffer("fan_in", fan_in.float(), persistent=False)
        own_inputs = torch.arange(widest)[None, :, None] < fan_in[:, None, None]
        self.register_buffer("own_inputs", own_inputs, persistent=False)

    @property
    def rates(self) -> list[Tensor]:
        """Learned dropout rates, layer by layer: ``(agents,)``, and ``(1,)`` for the head."""
        return [torch.sigmoid(logit.detach()).flatten() for logit in self._logits()]

    def row_loss(self, outputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """Cross-entropy of one thinned network per row, and the divergence by the rows there are.

        Held-out rows are judged by the whole network and by its likelihood alone.
        """
        likelihood = negative_log_likelihood(outputs, target, self.valid_actions)
        return likelihood if lesson.held_out else likelihood + self._divergence(lesson.rows)

    def certainty(self, outputs: Tensor) -> Tensor:
        """Divergence from even odds of one thinned network per row."""
        return divergence_from_even(outputs, self.valid_actions)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """The mean of the thinned networks' probabilities; u is its entropy."""
        means = [self._mean(rows) for rows in inputs.split(CHUNK, dim=1)]
        return prediction(torch.cat(means, 1), self.valid_actions)

    def _logits(self) -> list[Tensor]:
        """The log odds of every rate, ``(agents, 1, 1)`` and ``(1, 1, 1)``."""
        return [SPEED * logit for logit in self.slow_logits]

    def outputs(self, inputs: Tensor, lesson: Lesson) -> Tensor:
        """``(agents, batch, actions)``, every row from a network thinned anew."""
        if lesson.held_out:
            return self.head(torch.relu(self.encoders(inputs)))
        x = inputs
        for k, (layer, logit) in enumerate(zip(self._maps(), self._logits(), strict=True)):
            draw = torch.rand(x.shape, generator=lesson.generator).to(x.device)
            x = layer(thinned(x if k == 0 else torch.relu(x), logit, draw))
        return x

    def _maps(self) -> list[BatchedLinear | nn.Linear]:
        """The affine maps in their order, the head last; a ReLU lies between any two."""
        return [*(m for m in self.encoders.layers if isinstance(m, BatchedLinear)), self.head]

    def _mean(self, inputs: Tensor) -> Tensor:
        agents, rows, _ = inputs.shape
        x = inputs[:, None]  # a second axis for the passes
        for k, (layer, logit) in enumerate(zip(self._maps(), self._logits(), strict=True)):
            draws = self.get_buffer(f"draws_{k}")
            x = thinned(x if k == 0 else torch.relu(x), logit[..., None], draws)
            passes = x.shape[1]
            x = layer(x.reshape(agents, passes * rows, -1)).view(agents, passes, rows, -1)
        return log_probability(x, self.valid_actions[:, None]).exp().mean(1)

    def _divergence(self, rows: Tensor) -> Tensor:
        """Divergence per row, ``(agents, 1)``; that of the head is shared out among the agents."""
        *maps, head = (layer.weight for layer in self._maps())
        logits = [logit.flatten() for logit in self._logits()]
        total = divergence(maps[0] * self.own_inputs, logits[0], self.fan_in)
        for weight, logit in zip(maps[1:], logits[1:-1], strict=True):
            total = total + divergence(weight, logit, weight.shape[-2])
        shared = divergence(head[None], logits[-1], head.shape[-1])
        return (total / rows + shared / rows.sum())[:, None]
