"""What every method of uncertainty has to offer: a loss to train h with, and answers with a u.

A method is a network with an encoder per intersection and one head shared by all, whose outputs it
reads in its own way. u is always in [0, 1] and comparable in its ends: 0 is one action beyond
doubt, 1 knows nothing and gives every phase of the intersection the same probability.

- ``edl``: u = K / S of a Dirichlet distribution (`evidential`).
- ``dropout`` and ``ensemble``: the predictive entropy of the mean over networks, in units of its
  maximum log K (`normalised_entropy`). Not the mutual information of network and action, which is
  blind to states in which several actions lead to the same next one: all networks agree on a coin
  flip there, and the gate would take it. The evidence of ``edl`` is low in such states, too.
- ``none``: u = 0.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ugat_marl.errors import OptionError
from ugat_marl.policies import BatchedMLP

MOST = 100
"""Members or passes above which a number is taken for a mistake."""

MethodName = Literal["edl", "dropout", "ensemble", "none"]
METHODS: tuple[MethodName, ...] = ("edl", "dropout", "ensemble", "none")


@dataclass(frozen=True)
class Method:
    """Which uncertainty h has, and how many networks it asks.

    Attributes:
        name: "edl", "dropout", "ensemble" or "none".
        members: Networks of an ensemble.
        passes: Thinned networks that dropout averages over.
    """

    name: MethodName = "edl"
    members: int = 5
    passes: int = 20

    def __post_init__(self) -> None:
        if self.name not in METHODS:
            raise OptionError(f"uncertainty is {self.name!r}; allowed: {', '.join(METHODS)}")
        for name in ("members", "passes"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= MOST:
                raise OptionError(f"{name} is {value}; allowed: whole numbers 1 to {MOST}")


@dataclass(frozen=True)
class InversePrediction:
    """What h answers; tensors with the leading axes ``(agents, batch)``.

    Attributes:
        action: int64, the likeliest action.
        probability: ``(agents, batch, actions)`` expected probabilities, 0 where masked.
        u: Uncertainty in [0, 1].
    """

    action: Tensor
    probability: Tensor
    u: Tensor

    @classmethod
    def joined(cls, parts: Sequence[InversePrediction]) -> InversePrediction:
        """Answers to some rows and those to the next ones, together."""
        return cls(
            torch.cat([part.action for part in parts], 1),
            torch.cat([part.probability for part in parts], 1),
            torch.cat([part.u for part in parts], 1),
        )


@dataclass(frozen=True)
class Lesson:
    """What a loss may ask for beside the rows; every method takes what it needs.

    Attributes:
        held_out: Whether the rows are held out: the loss only ranks weights then.
        generator: Source of all that is drawn; on the CPU wherever the rows are.
        rows: ``(agents,)`` rows each agent is trained on in all.
        share: How far terms that would keep fresh weights from learning are annealed in, 0 to 1.
        kl_weight: Final weight of the divergence of misleading evidence.
        off_data_weight: Final weight of certainty on invented inputs.
        invent: Standardised inputs off the data, a number of rows per agent.
    """

    held_out: bool
    generator: torch.Generator
    rows: Tensor
    share: float
    kl_weight: float
    off_data_weight: float
    invent: Callable[[int], Tensor]


@dataclass(frozen=True)
class NetShape:
    """Sizes of a network.

    Attributes:
        fan_in: Number of inputs of each agent.
        hidden: Hidden layers of an encoder.
        embedding: What an encoder hands to the head.
        valid_actions: ``(agents, 1, actions)`` bool, the phases each agent has.
    """

    fan_in: Sequence[int]
    hidden: Sequence[int]
    embedding: int
    valid_actions: Tensor


class AnswerNet(nn.Module, abc.ABC):
    """A method: the network of h, its loss, and how its answers are read.

    Args:
        shape: Sizes.
        generator: Source of the initial weights.
        members: Networks side by side. They share no weight; every parameter holds them in order,
            so that ``parameter.view(members, -1)`` has one row for each.
    """

    valid_actions: Tensor

    def __init__(self, shape: NetShape, generator: torch.Generator, members: int = 1) -> None:
        super().__init__()
        self.members = members
        fan_in = [*shape.fan_in] * members
        self.encoders = BatchedMLP(fan_in, shape.hidden, shape.embedding, generator)
        bound = shape.embedding**-0.5
        self.head = nn.Linear(shape.embedding, members * shape.valid_actions.shape[-1])
        with torch.no_grad():  # nn.Linear draws from the global generator; ours must decide
            for part in self.head.parameters():
                part.copy_((torch.rand(part.shape, generator=generator) * 2 - 1) * bound)
        self.register_buffer("valid_actions", shape.valid_actions, persistent=False)

    @abc.abstractmethod
    def outputs(self, inputs: Tensor, lesson: Lesson) -> Tensor:
        """What `row_loss` and `certainty` read, rows on the last axis but one."""

    @abc.abstractmethod
    def row_loss(self, outputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """Loss of every row, in the shape of `target`."""

    @abc.abstractmethod
    def certainty(self, outputs: Tensor) -> Tensor:
        """What is claimed about rows off the data, in nats; 0 where nothing is claimed.

        ``(agents, count)`` or ``(agents, members, count)``.
        """

    def loss(self, inputs: Tensor, target: Tensor, lesson: Lesson) -> Tensor:
        """Loss of every row, in the shape of `target`, with what is claimed off the data.

        Args:
            inputs: ``(agents, batch, width)`` standardised, or ``(agents, members, batch, width)``
                if every member has rows of its own.
            target: ``(agents, batch)`` or ``(agents, members, batch)`` int64, the true actions.
            lesson: What else a loss may need.
        """
        if not lesson.off_data_weight:
            return self.row_loss(self.outputs(inputs, lesson), target, lesson)
        rows = target.shape[-1]
        invented = lesson.invent(rows // 2 + 1)
        if inputs.dim() > invented.dim():
            invented = invented[:, None].expand(-1, self.members, -1, -1)
        # One pass for both: two would read all weights, and sum all their gradients, twice.
        outputs = self.outputs(torch.cat([inputs, invented], -2), lesson)
        error = self.row_loss(outputs[..., :rows, :], target, lesson)
        certain = self.certainty(outputs[..., rows:, :])
        return error + lesson.off_data_weight * lesson.share * certain.mean(-1, keepdim=True)

    @abc.abstractmethod
    def answer(self, inputs: Tensor) -> InversePrediction:
        """Answers to ``(agents, batch, width)`` standardised inputs, each row for itself."""


def log_probability(logits: Tensor, mask: Tensor) -> Tensor:
    """Log of the softmax over the classes a row has; minus infinity for the others."""
    return logits.masked_fill(~mask, -math.inf).log_softmax(-1)


def negative_log_likelihood(logits: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of every row in nats, ``(...)`` for logits ``(..., actions)``."""
    return -log_probability(logits, mask).gather(-1, target[..., None])[..., 0]


def divergence_from_even(logits: Tensor, mask: Tensor) -> Tensor:
    """KL divergence of the softmax from even odds among a row's own classes, in nats, ``(...)``.

    Its gradient is that of the cross-entropy with even odds, with which Hendrycks, Mazeika and
    Dietterich, "Deep Anomaly Detection with Outlier Exposure", ICLR 2019, teach what is unknown.
    """
    own, count = log_probability(logits, mask).masked_fill(~mask, 0.0), mask.sum(-1)
    return -own.sum(-1) / count - count.log()


def normalised_entropy(probability: Tensor, mask: Tensor) -> Tensor:
    """Entropy over its maximum log K, in [0, 1], K being a row's own number of classes.

    Of the mean over networks this is the predictive entropy (Gal, "Uncertainty in Deep Learning",
    2016, section 3.3; Lakshminarayanan et al., NeurIPS 2017, section 3.5): what the data leave
    open and what the networks disagree on, together. A single class has entropy 0.
    """
    most = mask.sum(-1).clamp(min=2).log()
    return (torch.special.entr(probability).sum(-1) / most).clamp(0.0, 1.0)


def prediction(probability: Tensor, mask: Tensor) -> InversePrediction:
    """The likeliest action, its probabilities, and their normalised entropy as u."""
    u = normalised_entropy(probability, mask)
    return InversePrediction(probability.argmax(-1), probability, u)
