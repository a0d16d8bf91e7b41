"""FRAP: phases compete, pair by pair, with the demand of the movements they serve."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.policies.networks.batched import BatchedLinear, BatchedMLP, mask_of
from ugat_marl.policies.networks.structure import Junction


class FRAP(nn.Module):
    """One network of phase competition for all intersections, whatever their shape.

    Zheng et al. 2019 ("Learning Phase Competition for Traffic Signal Control", CIKM), shared by a
    whole network as in MPLight (Chen et al. 2020, AAAI). The demand of a movement is computed from
    its traffic and whether it has green; that of a phase is the sum over its movements. A pair of
    phases (p, q) is described by both demands and by whether they share a movement; from that
    comes a score of p against q, and Q of p is the mean score against all others. So Q follows when
    phases or movements are numbered otherwise, and nothing is kept of single intersections.

    It differs from the paper where intersections differ: scores are averaged, not summed, so that
    two and eight phases have values of one size, and a movement counts by the share of its links
    with green. What relations are embedded into, and the layer that joins it with the demands, are
    here the weights a pair's score is read out with, a row for each of the two relations.

    Args:
        agents: Sizes of the agents.
        junctions: Their intersections.
        hidden: Size of the demand of a movement, and of the layer for pairs.
        generator: Source of the initial weights.
    """

    inputs: Tensor
    greens: Tensor
    shared: Tensor
    rivals: Tensor

    def __init__(
        self,
        agents: AgentSet,
        junctions: Sequence[Junction],
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        demand, pair = hidden
        self.register_buffer("inputs", _inputs(agents, junctions), persistent=False)
        self.register_buffer("greens", _greens(agents, junctions), persistent=False)
        served = (self.greens > 0).float()
        self.register_buffer("shared", (served @ served.transpose(1, 2) > 0).long(), False)
        self.register_buffer("rivals", _rivals(agents), persistent=False)
        numbers = self.inputs.shape[2] // self.greens.shape[2]
        self.demand = BatchedMLP([numbers], [demand], demand, generator)
        self.pair = BatchedLinear([2 * demand], pair, generator)
        readout = BatchedLinear([pair], 2, generator).weight.detach()[0]
        self.relation = nn.Parameter(readout.T.contiguous())
        self.level = nn.Parameter(torch.zeros(1))

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, widest_observation)`` to Q ``(agents, batch, most_actions)``."""
        pairs = self.pairs(inputs)
        agents, phases, batch, _, _ = pairs.shape
        weights = self.relation[self.shared] * self.rivals.unsqueeze(3)
        values = torch.bmm(
            pairs.view(agents * phases, batch, -1), weights.view(agents * phases, -1, 1)
        )
        return values.view(agents, phases, batch).transpose(1, 2) + self.level

    def pairs(self, inputs: Tensor) -> Tensor:
        """Each phase beside each other, ``(agents, phases, batch, phases, size)``."""
        demands = self.demands(inputs)
        # the layer of pairs on (p, q) is that of its halves on p and on q, added
        own, other = self.pair.weight[0].chunk(2)
        first = (demands @ own + self.pair.bias).transpose(1, 2).contiguous().unsqueeze(3)
        return (first + (demands @ other).unsqueeze(1)).relu()

    def demands(self, inputs: Tensor) -> Tensor:
        """Demand of each phase, ``(agents, batch, phases, size)``; zeros where padded."""
        agents, batch, _ = inputs.shape
        movements = self.greens.shape[2]
        seen = torch.bmm(inputs, self.inputs).view(1, agents * batch * movements, -1)
        demands = self.demand(seen).relu().view(agents, batch, movements, -1)
        return self.greens.unsqueeze(1) @ demands


def _inputs(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Observation to (traffic of each kind, share of green) of each movement, as matrices.

    ``(agents, widest_observation, movements * numbers)``, zeros where padded.
    """
    most = max(len(junction.movements) for junction in junctions)
    kinds = len(junctions[0].movements[0])
    found = torch.zeros(len(agents), agents.widest_observation, most, kinds + 1)
    for row, junction in enumerate(junctions):
        for movement, places in enumerate(junction.movements):
            for kind, own in enumerate(places):
                found[row, list(own), movement, kind] = 1.0
            for phase, shares in enumerate(junction.greens):
                found[row, junction.first_phase + phase, movement, kinds] = shares[movement]
    return found.flatten(2)


def _greens(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Share of each movement's links that each phase gives green, zeros where padded."""
    most = max(len(junction.movements) for junction in junctions)
    found = torch.zeros(len(agents), agents.most_actions, most)
    for row, junction in enumerate(junctions):
        own = torch.tensor(junction.greens)
        found[row, : own.shape[0], : own.shape[1]] = own
    return found


def _rivals(agents: AgentSet) -> Tensor:
    """Weight of each other phase in the mean over them, ``(agents, phases, phases)``."""
    own = mask_of(agents.action_counts).float()
    pairs = own.unsqueeze(2) * own.unsqueeze(1) * (1 - torch.eye(agents.most_actions))
    return pairs / (own.sum(dim=1) - 1).clamp_min(1)[:, None, None]
