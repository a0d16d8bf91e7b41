"""Timed grounding: the policy's phase, with a green that begins as late as it does in reality.

The paper's grounded action is another phase, which cannot say "the same green, but it is of less
use": what slow vehicles lose. Here the grounded action is the policy's own phase and a delay of its
green. h answers with the delay that makes the simulation do what f expects of the street; where h
is not trusted, the delay is the one that fits all the street's transitions best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import AgentLayout
from ugat_marl.errors import OptionError
from ugat_marl.grounding.delays import DelayedForward, DelayModel, TimedConfig, likely_delay
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.gate import GateConfig
from ugat_marl.grounding.inverse import InverseConfig
from ugat_marl.grounding.joint import running
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.transform import Grounding, Transform
from ugat_marl.grounding.uncertainty import Method
from ugat_marl.grounding.view import InputsConfig, Moment, Neighbours
from ugat_marl.seeding import torch_generator


class _Constants(nn.Module):
    """The delay in s that is expected of every intersection and phase.

    Attributes:
        delay_s: What greens lose when they begin, ``(agents, phases)``.
        beyond_s: What all of an intersection are later by, to match rewards, ``(agents, 1)``.
    """

    delay_s: Tensor
    beyond_s: Tensor

    def __init__(self, stack: Stack, match: bool) -> None:
        super().__init__()
        self.register_buffer("delay_s", torch.zeros(len(stack.agents), stack.actions))
        # Checkpoints of those that match nothing do without.
        self.register_buffer("beyond_s", torch.zeros(len(stack.agents), 1), persistent=match)


class TimedTransform(Transform):
    """f, h, gate and the best constant delays of a network.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Decides the initial weights.
        forward: Shape of the forward models, of the street and of the simulation.
        inverse: Shape of the inverse models.
        gate: How alpha is found.
        timed: How greens are delayed.
        inputs: What the models see beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.
    """

    inverse: DelayModel

    def __init__(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        forward: ForwardConfig | None = None,
        inverse: InverseConfig | None = None,
        gate: GateConfig | None = None,
        timed: TimedConfig | None = None,
        inputs: InputsConfig | None = None,
        neighbours: Neighbours | None = None,
    ) -> None:
        forward, inverse = forward or ForwardConfig(), inverse or InverseConfig()
        if forward.include_phase or inverse.include_phase:
            raise OptionError(
                "timed grounding does not change phases, so that include_phase says nothing; "
                "leave it off"
            )
        super().__init__(layouts, seed, forward, gate, inputs, neighbours)
        self.timed = timed or TimedConfig()
        most_s = self.timed.most_s
        # What the street does is compared with it, so that both see the same.
        self.simulated = DelayedForward(
            self.stack, forward, most_s, torch_generator(seed, "simulated"), self.forward.view
        )
        self.inverse = DelayModel(
            self.stack, inverse, most_s, torch_generator(seed, "inverse"), view=self.local
        )
        self.constants = _Constants(self.stack, self.timed.match)

    @property
    def models(self) -> dict[str, nn.Module]:
        """Whatever has weights, under its name in a checkpoint."""
        return {**super().models, "simulated": self.simulated, "constants": self.constants}

    def fresh_inverse(self, method: Method) -> DelayModel:
        """An unfitted h of the same shape with this method of uncertainty."""
        return DelayModel(
            self.stack,
            self.inverse.config,
            self.timed.most_s,
            torch_generator(0),
            method,
            self.local,
        )

    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> Grounding:
        """The policy's phases, with a delay where they change.

        The gate sees delays in whole seconds; an action counts as changed if h's delay is another
        than the one taken without h.
        """
        asked = torch.from_numpy(actions)[:, None]
        usual = self._later(self.constants.delay_s.gather(1, asked))
        switched = (self.stack.current_phase(observations) != asked)[:, 0].numpy()
        if self.timed.answer == "constant":
            delay = np.where(switched, usual[:, 0].numpy(), 0.0).astype(np.float32)
            return Grounding(actions, actions, np.zeros_like(delay), np.ones_like(switched), delay)
        # No phase is changed, so that it is known at once what runs at the neighbours.
        phases = torch.from_numpy(running(actions, permitted))[:, None]
        found, u = self.delays(
            self.forward.view.seen(observations, phases, earlier),
            self.local.seen(observations, phases),
            asked,
        )
        accepted = self.gate.decide(
            u[:, 0].numpy(),
            usual[:, 0].round().long().numpy(),
            found[:, 0].round().long().numpy(),
            asked=switched,
        )
        delay = np.where(accepted, found[:, 0].numpy(), usual[:, 0].numpy())
        delay = np.where(switched, delay, 0.0).astype(np.float32)
        return Grounding(actions, actions, u[:, 0].numpy(), accepted, delay)

    def delays(self, seen: Tensor, local: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """H's delays in s, in the light of the best constants, and its u: ``(agents, batch)``.

        Args:
            seen: ``(agents, batch, forward.view.width)``, the observations as f sees them.
            local: ``(agents, batch, local.width)``, the same as h sees them.
            actions: ``(agents, batch)`` int64, phases that turn green.
        """
        change = self.forward(seen, actions) * self.forward.scale
        answer = self.inverse.predict(local, actions, change)
        usual = self.constants.delay_s.gather(1, actions)
        # h says what a green loses when it begins, in some states more and in others less.
        found = likely_delay(answer.probability, usual, self.timed.spread_s)
        return self._later(found), answer.u

    def _later(self, delay_s: Tensor) -> Tensor:
        """Delays ``(agents, batch)`` after all of an intersection have been moved."""
        return (delay_s + self.constants.beyond_s).clamp(0.0, float(self.timed.most_s))
