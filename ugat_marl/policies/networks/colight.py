"""CoLight: an intersection attends to those around it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.policies.networks.batched import BatchedLinear, SharedMLP, mask_of

HEADS = 5
"""Heads of attention, the number Wei et al. found best."""

HEAD_SIZE = 16
"""Length of a query, a key and a value of one head."""


class CoLight(nn.Module):
    """One network of attention to the neighbours for all intersections.

    Wei et al. 2019 ("CoLight: Learning Network-level Cooperation for Traffic Signal Control",
    CIKM). Every observation is embedded. In each head the query of an intersection is compared
    with the keys of itself and of its neighbours; their values are averaged with the softmax of
    these scores, the heads with equal weights, and two layers make Q of the average. So Q depends
    on what the neighbours observe at the same decision, and not on their order.

    It differs from the paper in the embedding, whose bias is each agent's own, as in `SharedMLP`:
    intersections whose lanes are numbered otherwise can then be told apart. An intersection has
    the neighbours it has, not always four, and their number is not filled up with distant ones.

    Args:
        agents: Sizes of the agents.
        neighbours: For each agent the positions of those it attends to beside itself.
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
        present = mask_of([1 + len(near) for near in neighbours])
        around = torch.zeros(present.shape, dtype=torch.int64)
        around[present] = torch.tensor([j for i, near in enumerate(neighbours) for j in (i, *near)])
        self.register_buffer("around", around, persistent=False)
        self.register_buffer("absent", ~present[:, :, None, None], persistent=False)
        self.embedding = SharedMLP(len(agents), agents.widest_observation, (), embedding, generator)
        # queries, keys and values of all heads in one product
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

    def _around(self, own: Tensor) -> Tensor:
        """Gather rows of each agent and its neighbours, ``(agents, 1 + most neighbours, ...)``.

        Rows without a neighbour hold somebody's numbers; their share is zero.
        """
        return own.index_select(0, self.around.flatten()).unflatten(0, self.around.shape)
