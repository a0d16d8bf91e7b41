"""Replay memory: the last decisions of all agents, in preallocated tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.envs import ActionMask, AgentSet


@dataclass(frozen=True)
class Batch:
    """Transitions of all agents at the same decisions.

    Attributes:
        observation: Observations ``(agents, batch, widest_observation)``.
        action: Actions of the agents, ``(agents, batch)``.
        reward: Unscaled rewards, ``(agents, batch)``.
        terminal: True where an agent terminated, ``(agents, batch)``; truncation is not terminal.
        next_observation: Observations after the action, in the shape of `observation`.
        next_allowed: Actions allowed after the action, ``(agents, batch, most_actions)``.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    terminal: Tensor
    next_observation: Tensor
    next_allowed: Tensor

    def scaled(self, factors: Tensor) -> Batch:
        """Return the batch with observations times factors ``(agents, 1, widest_observation)``."""
        seen, then = self.observation * factors, self.next_observation * factors
        return replace(self, observation=seen, next_observation=then)

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device; the batch itself if it is there already."""
        if self.reward.device == device:
            return self
        return Batch(**{name: column.to(device) for name, column in vars(self).items()})


class Replay:
    """A ring of the last `capacity` decisions of all agents, as ``(agents, capacity, ...)``.

    It stays on the CPU also for updates on a GPU: it is large, and an update needs little of it.
    """

    def __init__(self, agents: AgentSet, capacity: int) -> None:
        n, width, actions = len(agents), agents.widest_observation, agents.most_actions
        self.capacity = capacity
        self.added = 0
        self._columns = Batch(
            observation=torch.zeros(n, capacity, width),
            action=torch.zeros(n, capacity, dtype=torch.int64),
            reward=torch.zeros(n, capacity),
            terminal=torch.zeros(n, capacity, dtype=torch.bool),
            next_observation=torch.zeros(n, capacity, width),
            next_allowed=torch.zeros(n, capacity, actions, dtype=torch.bool),
        )

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(
        self,
        observation: NDArray[np.float32],
        action: NDArray[np.int64],
        reward: NDArray[np.float32],
        terminal: NDArray[np.bool_],
        next_observation: NDArray[np.float32],
        next_allowed: ActionMask,
    ) -> None:
        """Store one decision of all agents; a full ring loses its oldest decision."""
        at, columns = self.added % self.capacity, self._columns
        columns.observation[:, at] = torch.from_numpy(observation)
        columns.action[:, at] = torch.from_numpy(action)
        columns.reward[:, at] = torch.from_numpy(reward)
        columns.terminal[:, at] = torch.from_numpy(terminal)
        columns.next_observation[:, at] = torch.from_numpy(next_observation)
        columns.next_allowed[:, at] = torch.from_numpy(next_allowed)
        self.added += 1

    def sample(self, size: int, generator: torch.Generator) -> Batch:
        """Draw `size` time indices with replacement; the same ones for every agent."""
        at = torch.randint(len(self), (size,), generator=generator)
        return Batch(**{name: column.index_select(1, at) for name, column in self._fields()})

    def rewards(self) -> Tensor:
        """Return all stored rewards, ``(agents, len(self))``."""
        return self._columns.reward[:, : len(self)]

    def observations(self) -> Tensor:
        """Return all stored observations, ``(agents, len(self), widest_observation)``."""
        return self._columns.observation[:, : len(self)]

    def recent(self, decisions: int) -> Tensor:
        """Return the last observations, ``(agents, n, widest_observation)``.

        n is `decisions`, or the number of stored decisions if that is smaller.
        """
        first = max(0, self.added - min(decisions, self.capacity))
        at = torch.arange(first, self.added) % self.capacity
        return self._columns.observation.index_select(1, at)

    def rows(self, added: int) -> dict[str, Tensor]:
        """Return views of the rows in use after `added` decisions."""
        used = min(added, self.capacity)
        return {name: column[:, :used] for name, column in self._fields()}

    def state(self) -> dict[str, Tensor]:
        """Return copies of the rows in use, for a checkpoint."""
        return {name: rows.clone() for name, rows in self.rows(self.added).items()}

    def restore(self, state: Mapping[str, Tensor], added: int) -> None:
        """Restore rows that `state` returned, and the number of decisions added until then."""
        self.added = added
        for name, rows in self.rows(added).items():
            rows.copy_(state[name])

    def _fields(self) -> list[tuple[str, Tensor]]:
        return list(vars(self._columns).items())
