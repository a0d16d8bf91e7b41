"""One multi-layer perceptron that all agents share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ugat_marl.policies.batched import BatchedLinear, BatchedMLP


class SharedMLP(nn.Module):
    """One multi-layer perceptron with ReLU for all agents, told for which of them it computes.

    A one-hot of the agent appended to its observation (Gupta, Egorov, Kochenderfer 2017; Terry et
    al. 2020) adds one row of the first layer's weights to its output. That row is kept as the
    agent's own bias of that layer, which saves the product. The rows begin alike: agents that
    observe the same begin with the same Q, and differ once their rewards do.

    Args:
        agents: Number of agents.
        n_in: Input size, of the widest observation.
        hidden: Sizes of the hidden layers.
        n_out: Output size, of the largest agent.
        generator: Source of the initial weights.
    """

    def __init__(
        self,
        agents: int,
        n_in: int,
        hidden: Sequence[int],
        n_out: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        first, *rest = *hidden, n_out
        initial = BatchedLinear([n_in], first, generator)
        self.weight = nn.Parameter(initial.weight.detach()[0])
        self.agent_bias = nn.Parameter(initial.bias.detach().repeat(agents, 1, 1))
        self.rest: nn.Module = nn.Identity()
        if rest:
            self.rest = nn.Sequential(nn.ReLU(), BatchedMLP([first], rest[:-1], n_out, generator))

    def forward(self, inputs: Tensor) -> Tensor:
        """Maps ``(agents, batch, n_in)`` to ``(agents, batch, n_out)``."""
        agents, batch, _ = inputs.shape
        first = inputs @ self.weight + self.agent_bias
        # the samples of all agents are one batch of the layers that follow
        return self.rest(first.view(1, agents * batch, -1)).view(agents, batch, -1)
