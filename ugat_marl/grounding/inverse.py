"""Inverse models h_i: the action of the simulation that leads from one state to another.

Every intersection has its own encoder; all share one head, or each has its own. Phases that an
intersection does not have are masked, and its uncertainty uses its own number of phases.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ugat_marl.errors import OptionError, require_kinds, require_ranges
from ugat_marl.grounding.networks import Standardiser, TrainableModel, by_member, rows_at_once
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.uncertainty import (
    AnswerNet,
    DropoutNet,
    EnsembleNet,
    EvidentialNet,
    InversePrediction,
    Method,
    NetShape,
    PlainNet,
)
from ugat_marl.grounding.view import View


@dataclass(frozen=True)
class InverseConfig:
    """Shape of the inverse models.

    Attributes:
        hidden: Sizes of the hidden layers of an encoder.
        embedding: Size of the output of an encoder, which the shared head reads.
        include_phase: True if h sees the phase of s'. Off by default: this phase alone reveals the
            action, and h would ignore the traffic.
        head: "shared" for one head of all intersections, "own" for one per intersection. A shared
            one learns from all of them.
    """

    hidden: tuple[int, ...] = (128, 128)
    embedding: int = 64
    include_phase: bool = False
    head: Literal["shared", "own"] = "shared"

    def __post_init__(self) -> None:
        require_kinds(self, "inverse")
        if not self.hidden or min(self.hidden) < 1:
            raise OptionError(f"inverse hidden is {self.hidden}; allowed: one or more sizes >= 1")
        require_ranges(self, "inverse", at_least={"embedding": 1})


class AnswerModel(TrainableModel):
    """A network that answers inputs with one of some classes and an uncertainty.

    Args:
        view: The agents, and the inputs of their models beside their own state.
        config: Shape of the models.
        fan_in: Number of inputs of each agent.
        valid_answers: ``(agents, classes)`` bool, the classes each agent has.
        generator: Source of the initial weights.
        method: Method of uncertainty; evidential by default.
    """

    valid_answers: Tensor
    method: Method
    net: AnswerNet

    def __init__(
        self,
        view: View,
        config: InverseConfig,
        fan_in: list[int],
        valid_answers: Tensor,
        generator: torch.Generator,
        method: Method | None,
    ) -> None:
        super().__init__(view.stack, view)
        self.config = config
        self._fan_in = fan_in
        self.standardise = Standardiser(len(fan_in), max(fan_in))
        self.register_buffer("valid_answers", valid_answers[:, None, :], persistent=False)
        self.renew(method or Method(), generator)

    @property
    def members(self) -> int:
        """Number of networks of an ensemble; 1 for the other methods."""
        return self.net.members

    @property
    def parts(self) -> int:
        """Number of members, times that of the agents if they share no head."""
        return self.net.members * (len(self._fan_in) if self.net.own_heads else 1)

    def loss_by_part(self, loss: Tensor) -> Tensor:
        """Return the mean loss over agents for each member, or every loss, members first."""
        return by_member(loss) if self.net.own_heads else loss.mean(0).view(-1)

    def renew(self, method: Method, generator: torch.Generator) -> None:
        """Make a new, unfitted network of this method with weights from `generator`."""
        self.method = method
        shape = NetShape(
            self._fan_in,
            self.config.hidden,
            self.config.embedding,
            self.valid_answers,
            self.config.head == "own",
        )
        match method.name:
            case "edl":
                self.net = EvidentialNet(shape, generator)
            case "dropout":
                self.net = DropoutNet(shape, generator, method.passes)
            case "ensemble":
                self.net = EnsembleNet(shape, generator, method.members)
            case "none":
                self.net = PlainNet(shape, generator)
        self.fitted.fill_(False)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Answer unscaled inputs, ``(agents, batch, width)``."""
        rows = rows_at_once(len(inputs) * self.net.members)
        parts = [self.net.answer(self.standardise(part)) for part in inputs.split(rows, dim=1)]
        return parts[0] if len(parts) == 1 else InversePrediction.joined(parts)

    def answer_each(self, inputs: Tensor, draws: int) -> InversePrediction:
        """Answer inputs of which each has several draws, with one answer that mixes them.

        Args:
            inputs: ``(agents, draws * batch, width)`` unscaled, all rows of a draw together.
            draws: Number of draws; with one, the answer is that of `answer`.
        """
        answer = self.answer(inputs)
        if draws == 1:
            return answer

        def apart(part: Tensor) -> Tensor:
            return part.unflatten(1, (draws, -1)).transpose(0, 1)

        return self.net.mixed(
            InversePrediction(apart(answer.action), apart(answer.probability), apart(answer.u))
        )


class InverseModel(AnswerModel):
    """h of every intersection: (s, features of s') -> distribution over actions, and u.

    Args:
        stack: The agents.
        config: Shape of the models.
        generator: Source of the initial weights.
        method: Method of uncertainty; evidential by default.
        view: Inputs of the models beside s and s'; none by default.
    """

    columns: Tensor
    valid_inputs: Tensor

    def __init__(
        self,
        stack: Stack,
        config: InverseConfig,
        generator: torch.Generator,
        method: Method | None = None,
        view: View | None = None,
    ) -> None:
        view = view or View(stack)
        heads = stack.heads(config.include_phase)
        fan_in = [size + head for size, head in zip(view.sizes, heads, strict=True)]
        super().__init__(view, config, fan_in, stack.valid_actions, generator, method)
        columns, valid = _columns(view.sizes, heads)
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("valid_inputs", valid, persistent=False)

    def inputs(self, observation: Tensor, next_features: Tensor) -> Tensor:
        """Return the state, and directly behind it the change of its features; unscaled.

        Args:
            observation: ``(agents, batch, view.width)`` inputs from `view`.
            next_features: ``(agents, batch, features)`` features of s', with the phase if included.
                Further columns are ignored.
        """
        size = max(self.stack.heads(self.config.include_phase))
        change = next_features[..., :size] - observation[..., :size]
        both = torch.cat([observation, change], -1)
        columns = self.columns.expand(-1, both.shape[1], -1)
        return both.gather(2, columns) * self.valid_inputs

    def predict(
        self, observation: Tensor, next_features: Tensor, draws: int = 1
    ) -> InversePrediction:
        """Answer with the action that h assigns to the step from s to s'.

        Args:
            observation: ``(agents, batch, view.width)`` inputs from `view`.
            next_features: ``(agents, draws * batch, features)`` draws of s', see `inputs`.
            draws: Number of draws.
        """
        inputs = self.inputs(observation.repeat(1, draws, 1), next_features)
        return self.answer_each(inputs, draws)


def _columns(sizes: list[int], heads: list[int]) -> tuple[Tensor, Tensor]:
    """Return the column of each agent's input j in ``[observation | change]``, and if it exists."""
    width = max(size + head for size, head in zip(sizes, heads, strict=True))
    columns = torch.zeros(len(sizes), 1, width, dtype=torch.long)
    valid = torch.zeros(len(sizes), 1, width)
    for i, (size, head) in enumerate(zip(sizes, heads, strict=True)):
        columns[i, 0, :size] = torch.arange(size)
        columns[i, 0, size : size + head] = max(sizes) + torch.arange(head)
        valid[i, 0, : size + head] = 1.0
    return columns, valid


class DelayModel(AnswerModel):
    """h of every intersection: (s, a, change of the features) -> delay in whole seconds, and u.

    Args:
        stack: The agents.
        config: Shape of the models.
        most_s: Longest delay in s; the classes are 0, 1, ..., `most_s` s.
        generator: Source of the initial weights.
        method: Method of uncertainty; evidential by default.
        view: Inputs of the models beside s, a and the change; none by default.
    """

    def __init__(
        self,
        stack: Stack,
        config: InverseConfig,
        most_s: int,
        generator: torch.Generator,
        method: Method | None = None,
        view: View | None = None,
    ) -> None:
        self.most_s = most_s
        view = view or View(stack)
        heads = stack.heads(include_phase=False)
        sizes = zip(view.sizes, heads, stack.phases, strict=True)
        fan_in = [size + head + phases for size, head, phases in sizes]
        classes = torch.ones(len(fan_in), most_s + 1, dtype=torch.bool)
        super().__init__(view, config, fan_in, classes, generator, method)

    def inputs(self, observation: Tensor, action: Tensor, change: Tensor) -> Tensor:
        """Return state, change and action directly behind each other; unscaled.

        Args:
            observation: ``(agents, batch, view.width)`` inputs from `view`.
            action: ``(agents, batch)`` int64, the phase that turns green.
            change: ``(agents, batch, features)`` change of the features, unscaled.
        """
        batch = action.shape[1]
        assembled = torch.zeros(len(self._fan_in), batch, max(self._fan_in))
        for i, (size, layout) in enumerate(
            zip(self.view.sizes, self.stack.layouts.values(), strict=True)
        ):
            end = size + layout.features
            assembled[i, :, :size] = observation[i, :, :size]
            assembled[i, :, size:end] = change[i, :, : layout.features]
            assembled[i].scatter_(1, end + action[i][:, None], 1.0)
        return assembled

    @property
    def action_columns(self) -> Tensor:
        """Columns of the action in the inputs, ``(agents, 1, width)`` bool."""
        columns = torch.zeros(len(self._fan_in), 1, max(self._fan_in), dtype=torch.bool)
        for i, (size, layout) in enumerate(
            zip(self.view.sizes, self.stack.layouts.values(), strict=True)
        ):
            start = size + layout.features
            columns[i, 0, start : start + layout.phases] = True
        return columns

    def predict(
        self, observation: Tensor, action: Tensor, change: Tensor, draws: int = 1
    ) -> InversePrediction:
        """Answer with the delay that h assigns to a change.

        Args:
            observation: ``(agents, batch, view.width)`` inputs from `view`.
            action: ``(agents, batch)`` int64, the phase that turns green.
            change: ``(agents, draws * batch, features)`` draws of the change, unscaled.
            draws: Number of draws.
        """
        seen, phases = observation.repeat(1, draws, 1), action.repeat(1, draws)
        return self.answer_each(self.inputs(seen, phases, change), draws)
