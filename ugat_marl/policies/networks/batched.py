"""Perceptrons for many intersections at once: one for each, or one that all share.

Intersections differ in size. Their tensors are padded to a common size, so one batched product
serves all of them. Padded inputs are zero, and the caller masks padded outputs. No intersection
sees the numbers of another.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn


class BatchedLinear(nn.Module):
    """One affine map per intersection, computed together.

    Weights have shape ``(agents, n_in, n_out)``, biases ``(agents, 1, n_out)``. The initial weights
    are drawn as in `torch.nn.Linear`, with the fan-in of each agent's own (unpadded) input.

    Args:
        fan_in: Input size of each agent; the padded size is the maximum.
        n_out: Output size, the same for all agents.
        generator: Source of the initial weights.
    """

    def __init__(self, fan_in: Sequence[int], n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        agents, n_in = len(fan_in), max(fan_in)
        bound = torch.tensor([1.0 / math.sqrt(n) for n in fan_in])[:, None, None]
        weight = (torch.rand(agents, n_in, n_out, generator=generator) * 2 - 1) * bound
        bias = (torch.rand(agents, 1, n_out, generator=generator) * 2 - 1) * bound
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(bias)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, n_in)`` to ``(agents, batch, n_out)``."""
        return torch.baddbmm(self.bias, inputs, self.weight)


class BatchedMLP(nn.Module):
    """One multi-layer perceptron with ReLU per intersection, computed together.

    Args:
        fan_in: Input size of each agent.
        hidden: Sizes of the hidden layers.
        n_out: Output size of the agent with the most actions; the caller masks the rest.
        generator: Source of the initial weights.
    """

    def __init__(
        self, fan_in: Sequence[int], hidden: Sequence[int], n_out: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        sizes: Sequence[int] = fan_in
        for width in hidden:
            layers += [BatchedLinear(sizes, width, generator), nn.ReLU()]
            sizes = [width] * len(fan_in)
        layers.append(BatchedLinear(sizes, n_out, generator))
        self.layers = nn.Sequential(*layers)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, max(fan_in))`` to ``(agents, batch, n_out)``."""
        return self.layers(inputs)


class SharedMLP(nn.Module):
    """One multi-layer perceptron with ReLU for all agents; its first layer has a bias per agent.

    The bias tells the network which agent it computes for. It replaces a one-hot of the agent
    behind the observation (Gupta, Egorov, Kochenderfer 2017; Terry et al. 2020): such a one-hot
    adds one row of weights to the output of the first layer, and the bias is that row. All biases
    begin equal, so agents with equal observations begin with equal Q.

    Args:
        agents: Number of agents.
        n_in: Size of the widest observation.
        hidden: Sizes of the hidden layers.
        n_out: Output size of the agent with the most actions.
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
        """Map ``(agents, batch, n_in)`` to ``(agents, batch, n_out)``."""
        agents, batch, _ = inputs.shape
        first = inputs @ self.weight + self.agent_bias
        # the samples of all agents are one batch of the layers that follow
        return self.rest(first.view(1, agents * batch, -1)).view(agents, batch, -1)


def size_mask(sizes: Sequence[int]) -> Tensor:
    """Return a mask ``(agents, max(sizes))``, true for an agent's own entries."""
    return torch.arange(max(sizes))[None, :] < torch.tensor(list(sizes))[:, None]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread.

    Products this small are slower on several threads, and sums keep their order on one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
