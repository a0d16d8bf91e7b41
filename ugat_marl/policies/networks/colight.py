"""CoLight: an intersection attends to its neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.policies.networks.batched import BatchedLinear, SharedMLP, size_mask

HEADS = 5
"""Number of attention heads; Wei et al. found it best."""

HEAD_SIZE = 16
"""Length of a query, a key and a value of one head."""


class CoLight(nn.Module):
    """One network of attention to the neighbours for all intersections.

    Wei et al. 2019 ("CoLight: Learning Network-level Cooperation for Traffic Signal Control",
    CIKM). Every observation x_i is embedded as e_i. In each head, an intersection i attends to the
    set N(i) of itself and its neighbours: ``s_i = sum_j softmax_j(q_i . k_j) v_j`` for j in N(i),
    with queries q, keys k and values v linear in e. The mean of s_i over the heads passes through
    two layers to Q. So Q depends on what the neighbours observe at the same decision, but not on
    their order.

    Two things differ from the paper. The embedding has a bias for each agent, as in `SharedMLP`, so
    that intersections with differently numbered lanes can be told apart. The number of neighbours
    is not fixed at four: no distant intersections are added.

    Args:
        agents: Sizes of the agents.
        neighbours: For each agent, the positions of its neighbours among the agents.
        hidden: Size of an embedding, and of the layer after the attention.
        generator: Source of the initial weights.
    """

    around: Tensor
    absent: Tensor

    def __init__(
        self,
        agents: AgentSet,
        neighbours: Sequence[Sequence[int]],
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        embedding, joint = hidden
        present = size_mask([1 + len(near) for near in neighbours])
        around = torch.zeros(present.shape, dtype=torch.int64)
        around[present] = torch.tensor([j for i, near in enumerate(neighbours) for j in (i, *near)])
        self.register_buffer("around", around, persistent=False)
        self.register_buffer("absent", ~present[:, :, None, None], persistent=False)
        self.embedding = SharedMLP(len(agents), agents.widest_observation, (), embedding, generator)
        # one product for queries, keys and values of all heads is faster than three
        self.heads = BatchedLinear([embedding], 3 * HEADS * HEAD_SIZE, generator)
        self.joint = BatchedLinear([HEAD_SIZE], joint, generator)
        self.readout = BatchedLinear([joint], agents.most_actions, generator)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, widest_observation)`` to Q ``(agents, batch, most_actions)``."""
        agents, batch, _ = inputs.shape
        embedded = self.embedding(inputs).relu().view(1, agents * batch, -1)
        query, key, value = self.heads(embedded).view(agents, batch, 3, HEADS, HEAD_SIZE).unbind(2)
        scores = (query.unsqueeze(1) * self._around(key)).sum(-1)
        shares = scores.masked_fill(self.absent, -torch.inf).softmax(dim=1)
        seen = (shares.unsqueeze(-1) * self._around(value)).sum(1).mean(2)
        joint = self.joint(seen.view(1, agents * batch, -1)).relu()
        return self.readout(joint).view(agents, batch, -1)

    def _around(self, embedded: Tensor) -> Tensor:
        """Gather rows of each agent and its neighbours, ``(agents, 1 + most neighbours, ...)``.

        Rows without a neighbour hold the numbers of agent 0; their share is zero.
        """
        return embedded.index_select(0, self.around.flatten()).unflatten(0, self.around.shape)
