"""One network for intersections of any shape, whose weights can move to another road network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.errors import OptionError
from ugat_marl.policies.networks.batched import BatchedLinear, BatchedMLP
from ugat_marl.policies.networks.frap import green_shares
from ugat_marl.policies.networks.structure import Junction

VEHICLES = 10.0
"""Number of vehicles of a movement that the network reads as 1."""

LANES = 3.0
"""Number of lanes of a movement that the network reads as 1."""

SECONDS = 10.0
"""Decision interval, or clearance, that the network reads as 1, in s."""


class UniversalNetwork(nn.Module):
    """One network for all intersections of all road networks.

    No weight belongs to an intersection, and Q does not depend on the numbering of phases or
    movements, as in FRAP (Zheng et al. 2019). A movement m is read as numbers x_m: its vehicles,
    halting vehicles and lanes, how full the lanes behind the intersection are, the times of the
    signal, the age of its green, and its share of green now and under the last own commands. So
    commands under way are part of the state, and long and short lanes compare.

    The embedding of a movement is ``e_m = ReLU(f(x_m))``. A phase p serves ``d_p = sum_m green_pm
    e_m``, and the whole intersection holds ``t = sum_m e_m`` (Zaheer et al. 2017, deep sets). Q of
    phase p is ``v(t) + g(d_p, t)``, with perceptrons f and v of one hidden layer and g of two. The
    value v is shared by all phases (Wang et al. 2016, dueling networks).

    Args:
        agents: Sizes of the agents.
        junctions: Movements and phases of the intersections, in the order of the agents.
        hidden: Size of the embedding of a movement, and of the hidden layers of v and g.
        generator: Source of the initial weights.

    Raises:
        OptionError: The observation does not count vehicles.
    """

    inputs: Tensor
    ages: Tensor
    facts: Tensor
    present: Tensor
    greens: Tensor

    def __init__(
        self,
        agents: AgentSet,
        junctions: Sequence[Junction],
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if not all(junction.vehicles for junction in junctions):
            raise OptionError(
                'the network "universal" reads numbers of vehicles; use the observation '
                "movements, count, queue or density"
            )
        embedding, width = hidden
        inputs, ages = _inputs(agents, junctions), _ages(agents, junctions)
        greens = green_shares(agents, junctions)
        self.register_buffer("inputs", inputs, persistent=False)
        self.register_buffer("ages", ages, persistent=False)
        self.register_buffer("facts", _facts(junctions), persistent=False)
        self.register_buffer("greens", greens, persistent=False)
        self.register_buffer("present", (greens.sum(1) > 0).float(), persistent=False)
        numbers = inputs.shape[2] // greens.shape[2] + 1 + self.facts.shape[2]
        self.movement = BatchedMLP([numbers], [embedding], embedding, generator)
        self.own = BatchedLinear([embedding], width, generator)
        self.whole = BatchedLinear([embedding], width, generator)
        self.readout = BatchedMLP([width], [width], 1, generator)
        self.value = BatchedMLP([embedding], [width], 1, generator)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, widest_observation)`` to Q ``(agents, batch, most_actions)``."""
        agents, batch, _ = inputs.shape
        phases = self.greens.shape[1]
        embedded = self.embedded(inputs)
        demands = (self.greens.unsqueeze(1) @ embedded).view(1, agents * batch * phases, -1)
        total = embedded.sum(2).view(1, agents * batch, -1)
        own = self.own(demands).view(agents * batch, phases, -1)
        joint = (own + self.whole(total).view(agents * batch, 1, -1)).relu()
        scores = self.readout(joint.view(1, agents * batch * phases, -1))
        return scores.view(agents, batch, phases) + self.value(total).view(agents, batch, 1)

    def embedded(self, inputs: Tensor) -> Tensor:
        """Return the embeddings of movements, ``(agents, batch, movements, size)``; 0 if padded."""
        agents, batch, _ = inputs.shape
        movements = self.greens.shape[2]
        read = torch.bmm(inputs, self.inputs).view(agents, batch, movements, -1)
        green = read[..., -1:]
        age = torch.bmm(inputs, self.ages).unsqueeze(2) * green
        facts = self.facts.unsqueeze(1).expand(agents, batch, movements, -1)
        numbers = torch.cat((read, age, facts), dim=3).view(1, agents * batch * movements, -1)
        embedded = self.movement(numbers).relu().view(agents, batch, movements, -1)
        return embedded * self.present[:, None, :, None]


def _inputs(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Return matrices from observations to the numbers of each movement.

    These numbers are the traffic of each kind, the share of green under each of the last commands,
    and the share of green. The shape is ``(agents, widest_observation, movements * numbers)``, 0
    where padded.
    """
    most = max(len(junction.movements) for junction in junctions)
    kinds, commands = len(junctions[0].movements[0]), len(junctions[0].commands)
    selection = torch.zeros(len(agents), agents.widest_observation, most, kinds + commands + 1)
    for row, junction in enumerate(junctions):
        for movement, places in enumerate(junction.movements):
            for kind, columns in enumerate(places):
                # halting vehicles and vehicles are summed; lanes behind are full by a mean share
                for column in columns:
                    share = 1 / len(columns) if kind == 2 else junction.vehicles[column] / VEHICLES
                    selection[row, column, movement, kind] = share
        for phase, shares in enumerate(junction.greens):
            own = torch.tensor(shares)
            for lag, first in enumerate((*junction.commands, junction.first_phase)):
                selection[row, first + phase, : len(own), kinds + lag] = own
    return selection.flatten(2)


def _ages(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Return columns that read the age of the green, ``(agents, widest_observation, 1)``."""
    ages = torch.zeros(len(agents), agents.widest_observation, 1)
    for row, junction in enumerate(junctions):
        if junction.age is not None:
            ages[row, junction.age] = 1.0
    return ages


def _facts(junctions: Sequence[Junction]) -> Tensor:
    """Return lanes of each movement, decision interval and clearance, ``(agents, movements, 3)``.

    They are divided by `LANES` and `SECONDS`.
    """
    most = max(len(junction.movements) for junction in junctions)
    facts = torch.zeros(len(junctions), most, 3)
    for row, junction in enumerate(junctions):
        for movement, places in enumerate(junction.movements):
            facts[row, movement, 0] = len(places[0]) / LANES
        facts[row, :, 1] = junction.interval_s / SECONDS
        facts[row, :, 2] = junction.clearance_s / SECONDS
    return facts
