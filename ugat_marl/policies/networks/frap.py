"""FRAP: phases compete in pairs; each enters with the demand of the movements it serves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.policies.networks.batched import BatchedLinear, BatchedMLP, size_mask
from ugat_marl.policies.networks.structure import Junction


class FRAP(nn.Module):
    """One network of phase competition for all intersections.

    Zheng et al. 2019 ("Learning Phase Competition for Traffic Signal Control", CIKM). One network
    serves all intersections, as in MPLight (Chen et al. 2020, AAAI). The demand of a movement is
    computed from its traffic and its share of green. The demand d_p of a phase p is the sum over
    its movements. With ``z_pq = ReLU(W [d_p, d_q] + b)``, Q of p is the mean over the other phases
    q of ``w_pq . z_pq``, plus a learned constant. The weights w_pq are one of two learned rows: one
    for pairs of phases that share a movement, one for the others. So Q does not depend on the
    numbering of phases or movements, and no weight belongs to a single intersection.

    Three things differ from the paper. Scores are averaged, not summed, so that intersections with
    two and with eight phases have values of one size. A movement counts by the share of its links
    with green. The row w_pq replaces the embedding of the relation of two phases, and the layer
    that joins this embedding with the demands.

    Args:
        agents: Sizes of the agents.
        junctions: Movements and phases of the intersections, in the order of the agents.
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
        self.register_buffer("greens", green_shares(agents, junctions), persistent=False)
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
        """Return z_pq of all pairs of phases, ``(agents, phases, batch, phases, size)``."""
        demands = self.demands(inputs)
        # W [d_p, d_q] = W_1 d_p + W_2 d_q: each half is computed once per phase, not per pair
        first_half, other = self.pair.weight[0].chunk(2)
        first = (demands @ first_half + self.pair.bias).transpose(1, 2).contiguous().unsqueeze(3)
        return (first + (demands @ other).unsqueeze(1)).relu()

    def demands(self, inputs: Tensor) -> Tensor:
        """Return the demand of each phase, ``(agents, batch, phases, size)``; 0 where padded."""
        agents, batch, _ = inputs.shape
        movements = self.greens.shape[2]
        seen = torch.bmm(inputs, self.inputs).view(1, agents * batch * movements, -1)
        demands = self.demand(seen).relu().view(agents, batch, movements, -1)
        return self.greens.unsqueeze(1) @ demands


def _inputs(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Return matrices from observations to the numbers of each movement.

    These numbers are the traffic of each kind and the share of green. The shape is ``(agents,
    widest_observation, movements * numbers)``, 0 where padded.
    """
    most = max(len(junction.movements) for junction in junctions)
    kinds = len(junctions[0].movements[0])
    selection = torch.zeros(len(agents), agents.widest_observation, most, kinds + 1)
    for row, junction in enumerate(junctions):
        for movement, places in enumerate(junction.movements):
            for kind, columns in enumerate(places):
                selection[row, list(columns), movement, kind] = 1.0
            for phase, shares in enumerate(junction.greens):
                selection[row, junction.first_phase + phase, movement, kinds] = shares[movement]
    return selection.flatten(2)


def green_shares(agents: AgentSet, junctions: Sequence[Junction]) -> Tensor:
    """Return the share of each movement's links that each phase gives green.

    The shape is ``(agents, phases, movements)``, 0 where padded.
    """
    most = max(len(junction.movements) for junction in junctions)
    greens = torch.zeros(len(agents), agents.most_actions, most)
    for row, junction in enumerate(junctions):
        phase_greens = torch.tensor(junction.greens)
        greens[row, : phase_greens.shape[0], : phase_greens.shape[1]] = phase_greens
    return greens


def _rivals(agents: AgentSet) -> Tensor:
    """Return the weight of each other phase in the mean, ``(agents, phases, phases)``.

    The weight is ``1 / (phases - 1)``, and 0 for the phase itself and where padded.
    """
    mask = size_mask(agents.action_counts).float()
    pairs = mask.unsqueeze(2) * mask.unsqueeze(1) * (1 - torch.eye(agents.most_actions))
    return pairs / (mask.sum(dim=1) - 1).clamp_min(1)[:, None, None]
