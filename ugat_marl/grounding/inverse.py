"""Inverse models h_i: which action of the simulation leads from one state to another.

Every intersection has an encoder of its own; one head is shared by all of them. Phases an
intersection does not have are masked, and its uncertainty counts its own number of phases.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.errors import OptionError
from ugat_marl.grounding.dropout import DropoutNet
from ugat_marl.grounding.ensemble import EnsembleNet, PlainNet
from ugat_marl.grounding.evidential import EvidentialNet
from ugat_marl.grounding.scaling import Standardiser
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.uncertainty import AnswerNet, InversePrediction, Method, NetShape


@dataclass(frozen=True)
class InverseConfig:
    """Shape of the inverse models.

    Attributes:
        hidden: Sizes of the hidden layers of an encoder.
        embedding: Size of what an encoder hands to the shared head.
        include_phase: Whether h sees the phase of s'. Off: the phase alone would give the action
            away, and h would never look at the traffic.
    """

    hidden: tuple[int, ...] = (128, 128)
    embedding: int = 64
    include_phase: bool = False

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise OptionError(f"inverse hidden is {self.hidden}; allowed: one or more sizes >= 1")
        if self.embedding < 1:
            raise OptionError(f"inverse embedding is {self.embedding}; allowed: >= 1")


class InverseModel(nn.Module):
    """h of every intersection: (s, features of s') -> distribution over actions, and u.

    Args:
        stack: The agents.
        config: Shape of the models.
        generator: Source of the initial weights.
        method: Which uncertainty; the evidential one unless given.
    """

    fitted: Tensor
    columns: Tensor
    valid_inputs: Tensor
    method: Method
    net: AnswerNet

    def __init__(
        self,
        stack: Stack,
        config: InverseConfig,
        generator: torch.Generator,
        method: Method | None = None,
    ) -> None:
        super().__init__()
        self.stack = stack
        self.config = config
        heads = stack.heads(config.include_phase)
        self._fan_in = [size + head for size, head in zip(stack.sizes, heads, strict=True)]
        self.standardise = Standardiser(len(heads), max(self._fan_in))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))
        columns, valid = _columns(stack.sizes, heads)
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("valid_inputs", valid, persistent=False)
        self.renew(method or Method(), generator)

    def renew(self, method: Method, generator: torch.Generator) -> None:
        """Forgets everything: a new network, of this method, with weights from `generator`."""
        self.method = method
        self.net = _net(self, method, self._fan_in, generator)
        self.fitted.fill_(False)

    def inputs(self, observation: Tensor, next_features: Tensor) -> Tensor:
        """The state, and directly behind it the change of its features; unscaled.

        Args:
            observation: ``(agents, batch, width)``.
            next_features: ``(agents, batch, features)`` of s', with the phase if included; columns
                of a whole next observation beyond them are ignored.
        """
        size = max(self.stack.heads(self.config.include_phase))
        change = next_features[..., :size] - observation[..., :size]
        both = torch.cat([observation, change], -1)
        columns = self.columns.expand(-1, both.shape[1], -1)
        return both.gather(2, columns) * self.valid_inputs

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Answers to unscaled `inputs`, ``(agents, batch, width)``."""
        return self.net.answer(self.standardise(inputs))

    def predict(self, observation: Tensor, next_features: Tensor) -> InversePrediction:
        """The action that h holds responsible for the step from s to s'."""
        return self.answer(self.inputs(observation, next_features))


def _net(
    model: InverseModel, method: Method, fan_in: list[int], generator: torch.Generator
) -> AnswerNet:
    valid_actions = model.stack.valid_actions[:, None, :]
    shape = NetShape(fan_in, model.config.hidden, model.config.embedding, valid_actions)
    match method.name:
        case "edl":
            return EvidentialNet(shape, generator)
        case "dropout":
            return DropoutNet(shape, generator, method.passes)
        case "ensemble":
            return EnsembleNet(shape, generator, method.members)
        case "none":
            return PlainNet(shape, generator)


def _columns(sizes: list[int], heads: list[int]) -> tuple[Tensor, Tensor]:
    """Where input j of each agent lies in ``[observation | change]``, padded; and if it exists."""
    width = max(size + head for size, head in zip(sizes, heads, strict=True))
    columns = torch.zeros(len(sizes), 1, width, dtype=torch.long)
    valid = torch.zeros(len(sizes), 1, width)
    for i, (size, head) in enumerate(zip(sizes, heads, strict=True)):
        columns[i, 0, :size] = torch.arange(size)
        columns[i, 0, size : size + head] = max(sizes) + torch.arange(head)
        valid[i, 0, : size + head] = 1.0
    return columns, valid
