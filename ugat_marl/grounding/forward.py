"""Forward models f_i: the outcome of a state and an action in the real world.

Each intersection has one multi-layer perceptron, or an ensemble of them; all are computed as one
batch. A model predicts the *change* of the features over one decision interval, so an uninformed
model predicts no change:

    features of s' = features of s + scale * network(s, a)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.errors import OptionError, require_kinds
from ugat_marl.grounding.networks import (
    SMALLEST_SPREAD,
    Standardiser,
    TrainableModel,
    by_member,
    member_rows,
    rows_at_once,
)
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.uncertainty import MOST_NETWORKS
from ugat_marl.grounding.view import View
from ugat_marl.policies import BatchedMLP, size_mask


@dataclass(frozen=True)
class ForwardConfig:
    """Shape of the forward models.

    Attributes:
        hidden: Sizes of the hidden layers.
        include_phase: True if the phase of s' is predicted, too. Off by default: the action gives
            this phase, so an inverse model that sees it can only answer with that action.
        members: Number of networks per intersection. Several give f an uncertainty of its own:
            they agree where there are data, and need not elsewhere.
    """

    hidden: tuple[int, ...] = (128, 128)
    include_phase: bool = False
    members: int = 1

    def __post_init__(self) -> None:
        require_kinds(self, "forward")
        if not self.hidden or min(self.hidden) < 1:
            raise OptionError(f"forward hidden is {self.hidden}; allowed: one or more sizes >= 1")
        if not 1 <= self.members <= MOST_NETWORKS:
            raise OptionError(f"forward members is {self.members}; allowed: 1 to {MOST_NETWORKS}")


class ForwardModel(TrainableModel):
    """f of every intersection: (s, a) -> features of s'.

    Args:
        stack: The agents.
        config: Shape of the models.
        generator: Source of the initial weights.
        extra: Number of further inputs.
        view: Inputs of the models beside s and a; none by default.
    """

    scale: Tensor
    offsets: Tensor
    extra_places: Tensor
    valid_outputs: Tensor

    def __init__(
        self,
        stack: Stack,
        config: ForwardConfig,
        generator: torch.Generator,
        extra: int = 0,
        view: View | None = None,
    ) -> None:
        super().__init__(stack, view or View(stack))
        self.config = config
        heads = stack.heads(config.include_phase)
        sizes = self.view.sizes
        fan_in = [size + k + extra for size, k in zip(sizes, stack.phases, strict=True)]
        self._fan_in, self._outputs = fan_in, max(heads)
        self.standardise = Standardiser(len(heads), self.view.width)
        self.width = max(fan_in)
        self.register_buffer("scale", torch.ones(len(heads), 1, 1))
        self.register_buffer("offsets", torch.tensor(sizes)[:, None, None], persistent=False)
        self.register_buffer("valid_outputs", size_mask(heads)[:, None, :], persistent=False)
        behind = torch.tensor(sizes) + torch.tensor(stack.phases)
        places = behind[:, None, None] + torch.arange(extra)
        self.register_buffer("extra_places", places, persistent=False)
        self.renew(generator)

    @property
    def members(self) -> int:
        """Number of networks per agent."""
        return self.config.members

    @property
    def parts(self) -> int:
        """Number of networks; they share no weight."""
        return self.members * len(self.stack.agents)

    def loss_by_part(self, loss: Tensor) -> Tensor:
        """Return the loss of every network, members first."""
        return by_member(loss)

    def renew(self, generator: torch.Generator) -> None:
        """Make a new network with weights from `generator`; the model counts as unfitted."""
        fan_in = self._fan_in * self.members
        self.network = BatchedMLP(fan_in, self.config.hidden, self._outputs, generator)
        self.fitted.fill_(False)

    def begin_as(self, other: ForwardModel) -> None:
        """Take over the weights of a fitted model of the same stack, view and networks.

        It may have further inputs. This model then predicts what `other` does where they are 0.
        """
        state = dict(other.state_dict())
        first = "network.layers.0.weight"
        state[first] = state[first][:, : self.width]
        self.load_state_dict(state)

    def forward(self, observation: Tensor, action: Tensor, extra: Tensor | None = None) -> Tensor:
        """Predict the change in units of ``scale``: ``(agents, batch, outputs)``, 0 in padding.

        With several networks this is their mean.

        Args:
            observation: ``(agents, batch, view.width)`` inputs from `view`.
            action: ``(agents, batch)`` int64 phases.
            extra: ``(agents, batch, extra)`` float32 further inputs; zeros if not given.
        """
        return self.read(self.inputs(observation, action, extra))

    def read(self, inputs: Tensor) -> Tensor:
        """Predict as `forward` does, from the ``(agents, batch, width)`` tensor of `inputs`.

        Members with rows of their own, ``(agents, members, batch, width)``, predict each for
        themselves.
        """
        each = self.read_each(inputs)
        if inputs.dim() == 4:
            return each
        return each[:, 0] if self.members == 1 else each.mean(1)

    def read_each(self, inputs: Tensor) -> Tensor:
        """Predict with every network, ``(agents, members, batch, outputs)``."""
        changes = self.network(member_rows(inputs, self.members))
        changes = changes.unflatten(0, (self.members, len(inputs)))
        return changes.transpose(0, 1) * self.valid_outputs[:, None]

    def read_all(self, inputs: Tensor) -> Tensor:
        """Predict as `read` does, for any number of rows, in parts to limit memory."""
        parts = inputs.split(rows_at_once(len(inputs) * self.members), dim=1)
        return torch.cat([self.read(part) for part in parts], 1)

    def inputs(self, observation: Tensor, action: Tensor, extra: Tensor | None = None) -> Tensor:
        """Return the network's inputs, ``(agents, batch, width)``, for arguments of `forward`."""
        inputs = nn.functional.pad(
            self.standardise(observation), (0, self.width - observation.shape[-1])
        )
        # The one-hot action stands directly behind the agent's own numbers, not behind the padding.
        inputs = inputs.scatter(2, self.offsets + action[..., None], 1.0)
        if extra is not None:
            inputs = inputs.scatter(2, self.extra_places.expand(-1, action.shape[1], -1), extra)
        return inputs

    def predict(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict the features (and phase, if included) of s', ``(agents, batch, outputs)``."""
        change = self.read_all(self.inputs(observation, action)) * self.scale
        return observation[..., : change.shape[-1]] * self.valid_outputs + change

    def change_each(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict the change with every network, ``(agents, members * batch, outputs)``.

        The unit is that of the features. All rows of a network stand together.
        """
        inputs = self.inputs(observation, action)
        parts = inputs.split(rows_at_once(len(inputs) * self.members), dim=1)
        return torch.cat([self.read_each(part) for part in parts], 2).flatten(1, 2) * self.scale

    def predict_each(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict as `predict` does with every network, ``(agents, members * batch, outputs)``."""
        change = self.change_each(observation, action)
        known = observation[..., : change.shape[-1]] * self.valid_outputs
        return known.repeat(1, self.members, 1) + change

    def change(self, observation: Tensor, next_observation: Tensor) -> Tensor:
        """Return the change that happened, ``(agents, batch, outputs)`` in the unit of features."""
        size = self.valid_outputs.shape[-1]
        return (next_observation[..., :size] - observation[..., :size]) * self.valid_outputs

    def fit_scale(self, observation: Tensor, change: Tensor, weight: Tensor) -> None:
        """Set the statistics of the inputs and the scale from the training rows.

        The scale of an agent is the root mean square of its changes, over rows and features.
        """
        self.standardise.fit(observation, weight)
        share = (weight / weight.sum(1, keepdim=True))[..., None]
        outputs = self.valid_outputs.sum(-1, keepdim=True)
        spread = ((share * change**2).sum((1, 2), keepdim=True) / outputs).sqrt()
        self.scale.copy_(spread.clamp(min=SMALLEST_SPREAD))


class DelayedForward(ForwardModel):
    """Model of the simulation: (s, a, delay of a's green) -> change of the features.

    The effect of a delay is not linear: it bends where queues and greens end, and jumps where one
    vehicle more passes. So every whole second has its own input. A delay between two seconds is
    divided between both.

    Args:
        stack: The agents.
        config: Shape of the models.
        most_s: Longest delay, in s.
        generator: Source of the initial weights.
        view: Inputs of the models beside s, a and the delay; none by default.
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
        """Return the further inputs for delays in s, ``(agents, batch)``.

        Input k = 1, ..., most_s is max(0, 1 - |delay - k|).
        """
        seconds = torch.arange(1.0, self.most_s + 1.0)
        return (1.0 - (delay_s[..., None] - seconds).abs()).clamp(min=0.0)
