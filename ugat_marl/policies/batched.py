"""Small networks for many intersections at once.

Intersections differ in size; their tensors are padded to a common size and the multiplications of
all of them run as one batched product. A padded input is zero and a padded output is masked by
whoever reads it, so no intersection sees another one's numbers.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn


class BatchedLinear(nn.Module):
    """One affine map per intersection, computed together.

    Weights have shape ``(agents, n_in, n_out)``, biases ``(agents, 1, n_out)``. Initialised like
    `torch.nn.Linear`, with the fan-in of each agent's own (unpadded) input.

    Args:
        fan_in: Input size of each agent, length ``agents``; the padded size is its maximum.
        n_out: Output size, shared.
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
        """Maps ``(agents, batch, n_in)`` to ``(agents, batch, n_out)``."""
        return torch.baddbmm(self.bias, inputs, self.weight)


class BatchedMLP(nn.Module):
    """One multi-layer perceptron with ReLU per intersection, computed together.

    Args:
        fan_in: Input size of each agent.
        hidden: Sizes of the hidden layers.
        n_out: Output size (of the largest agent; the caller masks the rest).
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
        """Maps ``(agents, batch, max(fan_in))`` to ``(agents, batch, n_out)``."""
        return self.layers(inputs)


def mask_of(sizes: Sequence[int]) -> Tensor:
    """Boolean ``(agents, max(sizes))``, true where an agent's own entries are."""
    return torch.arange(max(sizes))[None, :] < torch.tensor(list(sizes))[:, None]


def pad(rows: Sequence[Tensor], width: int) -> Tensor:
    """Stacks ``(batch, size_i)`` tensors into ``(agents, batch, width)``, zeros on the right."""
    return torch.stack([nn.functional.pad(row, (0, width - row.shape[-1])) for row in rows])


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Runs torch on one thread: products this small lose by being split, sums keep their order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
