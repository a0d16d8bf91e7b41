"""Rewards and observations of order one, whatever the traffic and the units.

Learners of baselines/ see both scaled by what they have had so far. That is not a nicety: a lane
with five vehicles is 0.125 in the observation `count`, beside a phase that is 1, and a network
needs long to find out that the small numbers are what matters.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.envs import AgentSet

LEAST = 0.01
"""A number that was always smaller than this is scaled as if it had been this."""


class RewardScale:
    """Centre and scale each agent's rewards by mean and deviation of all it had so far.

    Args:
        agents: Their number.

    Attributes:
        sums: Number, sum and sum of squares of the rewards of each agent, ``(3, agents)``.
    """

    def __init__(self, agents: int) -> None:
        self.sums = np.zeros((3, agents))

    def __call__(self, rewards: NDArray[np.float32]) -> NDArray[np.float64]:
        """Scale the rewards of one decision, ``(agents,)``, after counting them in."""
        paid = rewards.astype(np.float64)
        self.sums += paid ** np.arange(3)[:, None]
        _, mean, square = self.sums / self.sums[0]
        deviation = np.sqrt(np.maximum(square - mean**2, 0))
        return (paid - mean) / np.where(deviation > 1e-6, deviation, 1.0)


class InputScale:
    """Divide each number of a vector by the root mean square of its place so far.

    Zero stays zero, so that padding does; and a factor can be moved into the first layer of a
    network, which then reads vectors as they are.

    Args:
        size: Of the vectors.

    Attributes:
        sums: How many numbers stood in each place, and the sum of their squares, ``(2, size)``.
    """

    def __init__(self, size: int) -> None:
        self.sums = np.zeros((2, size))

    @property
    def factors(self) -> NDArray[np.float32]:
        """Factors that scale a vector, ``(size,)``; 1 before the first vector."""
        count, squares = self.sums
        size = np.sqrt(squares / np.maximum(count, 1))
        return np.where(count > 0, 1 / np.maximum(size, LEAST), 1.0).astype(np.float32)

    def note(self, rows: NDArray[np.float32], there: NDArray[np.bool_] | None = None) -> None:
        """Count vectors ``(n, size)`` in, all of them or the numbers that are `there`."""
        squares = rows.astype(np.float64) ** 2
        exist = np.ones(rows.shape, dtype=np.bool_) if there is None else there
        self.sums += exist.sum(0), (squares * exist).sum(0)


def input_factors(observations: Tensor, agents: AgentSet, pooled: bool) -> Tensor:
    """Return one over the root mean square of each number of the agents' observations.

    Args:
        observations: ``(agents, n, widest_observation)``.
        agents: Whose they are.
        pooled: Whether all agents with a number at a place have one factor there.

    Returns:
        ``(agents, widest_observation)``; 1 where an agent has no number.
    """
    own = torch.from_numpy(places(agents))
    square = observations.square().mean(1) * own
    if pooled:
        square = (square.sum(0) / own.sum(0)).expand_as(square)
    return torch.where(own, 1 / square.sqrt().clamp_min(LEAST), 1.0)


def places(agents: AgentSet) -> NDArray[np.bool_]:
    """Return a mask of each agent's own numbers in padded observations."""
    return np.arange(agents.widest_observation) < np.array(agents.observation_sizes)[:, None]


def ceilings(seen: Tensor, quantile: float) -> Tensor:
    """Return a quantile over time of each number of an observation.

    A number that is so rarely more than its least (a phase hardly ever chosen) is held by its
    greatest instead, since held by the quantile it would say nothing any more.

    Args:
        seen: Observations ``(agents, time, widest_observation)``.
        quantile: The share.

    Returns:
        ``(agents, widest_observation)``.
    """
    # not torch's: it refuses more than 16 million numbers
    level = torch.from_numpy(np.quantile(seen.numpy(), quantile, axis=1).astype(np.float32))
    return torch.where(level > seen.amin(dim=1), level, seen.amax(dim=1))
