"""h of timed grounding: which delay of a green makes the simulation do what the street does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ugat_marl.errors import OptionError
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.inverse import AnswerModel, InverseConfig
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.uncertainty import InversePrediction, Method
from ugat_marl.grounding.view import View

ANSWERS = ("state", "constant")


@dataclass(frozen=True)
class TimedConfig:
    """How greens are delayed.

    Attributes:
        most_s: Longest delay of a green, in whole s; roll-outs for D_sim try all up to it. What is
            longer than the green that clearance leaves of a decision interval cannot be told apart.
        answer: "state" asks h in every state, as far as the gate lets it; "constant" takes the
            delay that fits all transitions best, per intersection and phase.
        spread_s: How far, in s, delays of single phases and states are expected to lie from those
            of their intersection and phase. What the data say little about stays close.
        target_noise: Noise on the changes that h learns to read, in units of what the simulation
            leaves unpredicted: f, too, is fitted to finitely many transitions.
        match: Whether the delays of an intersection are raised or lowered together until the
            simulation pays the policy in training what the street pays it (`matching`); needs
            roll-outs of that policy in both.
    """

    most_s: int = 5
    answer: Literal["state", "constant"] = "state"
    spread_s: float = 1.0
    target_noise: float = 0.2
    match: bool = False

    def __post_init__(self) -> None:
        if self.most_s < 1:
            raise OptionError(f"timed most_s is {self.most_s}; allowed: >= 1")
        if self.answer not in ANSWERS:
            raise OptionError(f"timed answer is {self.answer!r}; allowed: {', '.join(ANSWERS)}")
        if not 0 < self.spread_s < float("inf"):
            raise OptionError(f"timed spread_s is {self.spread_s}; allowed: > 0, finite")
        if not 0 <= self.target_noise < float("inf"):
            raise OptionError(f"timed target_noise is {self.target_noise}; allowed: >= 0, finite")


class DelayedForward(ForwardModel):
    """The simulation: (s, a, delay of a's green) -> change of the features.

    What a delay does bends where queues and greens end, and jumps where one more vehicle gets
    through; so whole seconds have inputs of their own, and what lies between belongs to both
    neighbours.

    Args:
        stack: The agents.
        config: Shape of the models.
        most_s: Longest delay.
        generator: Source of the initial weights.
        view: What the models see beside s, a and the delay; nothing unless given.
    """

    def __init__(
        self,
        stack: Stack,
        config: ForwardConfig,
        most_s: int,
        generator: torch.Generator,
        view: View | None = None,
    ) -> None:
        super().__init__(stack, config, generator, extra=most_s, view=view)
        self.most_s = most_s

    def extra(self, delay_s: Tensor) -> Tensor:
        """The further inputs for delays ``(agents, batch)``."""
        seconds = torch.arange(1.0, self.most_s + 1.0)
        return (1.0 - (delay_s[..., None] - seconds).abs()).clamp(min=0.0)


class DelayModel(AnswerModel):
    """h of every intersection: (s, a, change of the features) -> delay in whole seconds, and u.

    Args:
        stack: The agents.
        config: Shape of the models.
        most_s: Longest delay; the classes are 0, 1, ..., `most_s` s.
        generator: Source of the initial weights.
        method: Which uncertainty; the evidential one unless given.
        view: What the models see beside s, a and the change; nothing unless given.
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
        """State, change and action directly behind each other; unscaled.

        Args:
            observation: ``(agents, batch, view.width)``, as `view` makes it.
            action: ``(agents, batch)`` int64, the phase that turns green.
            change: ``(agents, batch, features)``.
        """
        batch = action.shape[1]
        found = torch.zeros(len(self._fan_in), batch, max(self._fan_in))
        for i, (size, layout) in enumerate(
            zip(self.view.sizes, self.stack.layouts.values(), strict=True)
        ):
            end = size + layout.features
            found[i, :, :size] = observation[i, :, :size]
            found[i, :, size:end] = change[i, :, : layout.features]
            found[i].scatter_(1, end + action[i][:, None], 1.0)
        return found

    @property
    def action_columns(self) -> Tensor:
        """``(agents, 1, width)`` bool, where the action stands in the inputs."""
        found = torch.zeros(len(self._fan_in), 1, max(self._fan_in), dtype=torch.bool)
        for i, (size, layout) in enumerate(
            zip(self.view.sizes, self.stack.layouts.values(), strict=True)
        ):
            start = size + layout.features
            found[i, 0, start : start + layout.phases] = True
        return found

    def predict(self, observation: Tensor, action: Tensor, change: Tensor) -> InversePrediction:
        """The delay that h holds responsible for a change."""
        return self.answer(self.inputs(observation, action, change))


def likely_delay(probability: Tensor, expected_s: Tensor, spread_s: float) -> Tensor:
    """The likeliest delay in s, ``(...)``, if delays are expected around some value.

    Where h does not know, its even odds leave the expected delay as it is.

    Args:
        probability: ``(..., classes)`` of delays of 0, 1, 2, ... s.
        expected_s: ``(...)``.
        spread_s: Standard deviation around it.
    """
    seconds = torch.arange(probability.shape[-1], dtype=torch.float32)
    fine = torch.linspace(0.0, float(seconds[-1]), 10 * (len(seconds) - 1) + 1)
    # Log-probabilities between whole seconds, on the line between their neighbours.
    below = fine.floor().long().clamp(max=len(seconds) - 2)
    share = fine - below
    log = probability.clamp(min=1e-12).log()
    between = log[..., below] * (1.0 - share) + log[..., below + 1] * share
    prior = -0.5 * ((fine - expected_s[..., None]) / spread_s) ** 2
    return fine[(between + prior).argmax(-1)]
