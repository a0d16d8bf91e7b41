"""Scaling of rewards and observations to order one, for any traffic and unit.

Learners need it: a lane with five vehicles is 0.125 in the observation `count`, the current phase
is 1, and a network learns slowly from the small numbers. The learners of baselines/ scale by all
rewards and observations so far; DQN measures its scale once.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.envs import AgentSet

LEAST = 0.01
"""Smallest root mean square by which a number is divided."""


class RewardScale:
    """Centre and scale each agent's rewards by mean and deviation of its rewards so far.

    Args:
        agents: Number of agents.

    Attributes:
        sums: Count, sum and sum of squares of the rewards of each agent, ``(3, agents)``.
    """

    def __init__(self, agents: int) -> None:
        self.sums = np.zeros((3, agents))

    def __call__(self, rewards: NDArray[np.float32]) -> NDArray[np.float64]:
        """Add the rewards of one decision to the sums and return them scaled, ``(agents,)``."""
        paid = rewards.astype(np.float64)
        self.sums += paid ** np.arange(3)[:, None]
        _, mean, square = self.sums / self.sums[0]
        deviation = np.sqrt(np.maximum(square - mean**2, 0))
        return (paid - mean) / np.where(deviation > 1e-6, deviation, 1.0)


class InputScale:
    """Divide each number of a vector by its root mean square so far.

    Zero stays zero, so padding does not change. The factors can be moved into the first layer of a
    network, which then reads unscaled vectors.

    Args:
        size: Length of the vectors.

    Attributes:
        sums: For each place, the count of numbers and the sum of their squares, ``(2, size)``.
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
        """Add vectors to the sums.

        Args:
            rows: Vectors ``(n, size)``.
            there: Mask ``(n, size)`` of the numbers to add; None adds all.
        """
        squares = rows.astype(np.float64) ** 2
        exist = np.ones(rows.shape, dtype=np.bool_) if there is None else there
        self.sums += exist.sum(0), (squares * exist).sum(0)


def input_factors(observations: Tensor, agents: AgentSet, pooled: bool) -> Tensor:
    """Return 1 / root mean square of each number of the agents' observations.

    Args:
        observations: Observations padded with zeros, ``(agents, n, widest_observation)``.
        agents: Agents of the observations.
        pooled: True for one factor per place, from the observations of all agents.

    Returns:
        Factors ``(agents, widest_observation)``; 1 where an agent has no number, and where the root
        mean square is below `LEAST`. A number that was never seen has no size, and a large factor
        would let it rule the network when it appears.
    """
    mask = torch.from_numpy(observation_mask(agents))
    square = observations.square().mean(1) * mask
    if pooled:
        square = (square.sum(0) / mask.sum(0)).expand_as(square)
    size = square.sqrt()
    return torch.where(mask & (size >= LEAST), 1 / size, 1.0)


def observation_mask(agents: AgentSet) -> NDArray[np.bool_]:
    """Return a mask of each agent's own numbers, ``(agents, widest_observation)``."""
    return np.arange(agents.widest_observation) < np.array(agents.observation_sizes)[:, None]


def ceilings(seen: Tensor, quantile: float) -> Tensor:
    """Return a quantile over time of each number of an observation.

    If the quantile equals the minimum (as for a phase that is hardly ever chosen), return the
    maximum instead: cut to the minimum, the number would be constant.

    Args:
        seen: Observations ``(agents, time, widest_observation)``.
        quantile: Level of the quantile, in (0, 1].

    Returns:
        Ceilings ``(agents, widest_observation)``.
    """
    # numpy's quantile, because torch's refuses more than 16 million numbers
    level = torch.from_numpy(np.quantile(seen.numpy(), quantile, axis=1).astype(np.float32))
    return torch.where(level > seen.amin(dim=1), level, seen.amax(dim=1))
