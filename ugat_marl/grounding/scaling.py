"""Standardised inputs for padded tensors, with statistics that travel with the weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

SMALLEST_SPREAD = 1e-3
"""A number that varied less than this is not scaled up: its noise would be mistaken for traffic."""

FARTHEST = 5.0
"""Inputs are cut off at this many standard deviations, so that a rare lane cannot dominate."""


class Standardiser(nn.Module):
    """Maps each agent's inputs to mean 0 and deviation 1 of the data it was fitted to.

    Args:
        agents: Number of agents.
        width: Padded size of the inputs. A padded input stays zero.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, agents: int, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(agents, 1, width))
        self.register_buffer("spread", torch.ones(agents, 1, width))

    def fit(self, inputs: Tensor, weight: Tensor) -> None:
        """Takes mean and deviation of ``(agents, n, width)`` rows with weights ``(agents, n)``."""
        share = (weight / weight.sum(1, keepdim=True))[..., None]
        mean = (share * inputs).sum(1, keepdim=True)
        spread = (share * (inputs - mean) ** 2).sum(1, keepdim=True).sqrt()
        self.mean.copy_(mean)
        self.spread.copy_(torch.where(spread > SMALLEST_SPREAD, spread, 1.0))

    def forward(self, inputs: Tensor) -> Tensor:
        """Maps ``(agents, batch, width)`` to the same shape, within ``FARTHEST`` of zero."""
        return ((inputs - self.mean) / self.spread).clamp(-FARTHEST, FARTHEST)
