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
    """Transitions of all agents at the same decisions, over one decision or several.

    Attributes:
        observation: Observations ``(agents, batch, widest_observation)``.
        action: Actions of the agents, ``(agents, batch)``.
        reward: Unscaled rewards ``(agents, batch)``; over several decisions their discounted sum.
        terminal: True where an agent terminated, ``(agents, batch)``; truncation is not terminal.
        next_observation: Observations after the last decision, in the shape of `observation`.
        next_allowed: Actions allowed after the last decision, ``(agents, batch, most_actions)``.
        weight: Sum of the discounts of the rewards, ``(batch,)``; 1 for one decision.
        discount: Discount of the value after the last decision, ``(batch,)``.
        shown: True where a teacher acted, ``(batch,)``.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    terminal: Tensor
    next_observation: Tensor
    next_allowed: Tensor
    weight: Tensor
    discount: Tensor
    shown: Tensor

    def scaled(self, factors: Tensor) -> Batch:
        """Return the batch with observations times factors ``(agents, 1, widest_observation)``."""
        seen, then = self.observation * factors, self.next_observation * factors
        return replace(self, observation=seen, next_observation=then)

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device; the batch itself if it is there already."""
        if self.reward.device == device:
            return self
        return Batch(**{name: column.to(device) for name, column in vars(self).items()})


_COLUMNS = (
    "observation", "action", "reward", "terminal", "next_observation", "next_allowed",
)  # fmt: skip
"""Columns of the memory that have a row for each agent."""


class ReplayBuffer:
    """A ring of the last `capacity` decisions of all agents, as ``(agents, capacity, ...)``.

    It stays on the CPU also for updates on a GPU: it is large, and an update needs little of it.
    """

    def __init__(self, agents: AgentSet, capacity: int) -> None:
        n, width, actions = len(agents), agents.widest_observation, agents.most_actions
        self.capacity = capacity
        self.added = 0
        self._columns = {
            "observation": torch.zeros(n, capacity, width),
            "action": torch.zeros(n, capacity, dtype=torch.int64),
            "reward": torch.zeros(n, capacity),
            "terminal": torch.zeros(n, capacity, dtype=torch.bool),
            "next_observation": torch.zeros(n, capacity, width),
            "next_allowed": torch.zeros(n, capacity, actions, dtype=torch.bool),
        }
        self._last = torch.zeros(1, capacity, dtype=torch.bool)
        self._shown = torch.zeros(1, capacity, dtype=torch.bool)

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
        last: bool = False,
        shown: bool = False,
    ) -> None:
        """Store one decision of all agents; a full ring loses its oldest decision.

        Args:
            observation: Observations ``(agents, widest_observation)``.
            action: Actions ``(agents,)``.
            reward: Rewards ``(agents,)``.
            terminal: True for an agent that terminated, ``(agents,)``.
            next_observation: Observations after the action.
            next_allowed: Actions allowed after the action, ``(agents, most_actions)``.
            last: True for the last decision of an episode.
            shown: True if a teacher acted.
        """
        at, columns = self.added % self.capacity, self._columns
        rows = (observation, action, reward, terminal, next_observation, next_allowed)
        for name, row in zip(_COLUMNS, rows, strict=True):
            columns[name][:, at] = torch.from_numpy(row)
        self._last[:, at] = last
        self._shown[:, at] = shown
        self.added += 1

    def end(self) -> None:
        """End the episode of the newest decision, which may have been broken off."""
        if self.added:
            self._last[:, (self.added - 1) % self.capacity] = True

    def sample(
        self, size: int, generator: torch.Generator, discount: float = 1.0, steps: int = 1
    ) -> Batch:
        """Draw `size` time indices with replacement; the same ones for every agent.

        Args:
            size: Number of transitions.
            generator: Source of the indices.
            discount: Discount of one decision.
            steps: Decisions that a transition covers; fewer at the end of an episode.
        """
        at = torch.randint(len(self), (size,), generator=generator)
        window = (at.unsqueeze(1) + torch.arange(steps)) % self.capacity
        newest = (self.added - 1) % self.capacity
        ends = self._last[0, window] | (window == newest)
        # a decision counts as long as none before it ended the episode
        counts = torch.ones_like(ends)
        counts[:, 1:] = ~(ends[:, :-1].cumsum(1) > 0)
        powers = discount ** torch.arange(steps) * counts
        done = (counts.sum(1) - 1).unsqueeze(1)
        final = window.gather(1, done).squeeze(1)
        read = self._columns
        return Batch(
            observation=read["observation"].index_select(1, at),
            action=read["action"].index_select(1, at),
            reward=(read["reward"][:, window] * powers).sum(2),
            terminal=read["terminal"].index_select(1, final),
            next_observation=read["next_observation"].index_select(1, final),
            next_allowed=read["next_allowed"].index_select(1, final),
            weight=powers.sum(1),
            discount=discount * powers.gather(1, done).squeeze(1),
            shown=self._shown[0, at],
        )

    def forget_teacher(self) -> None:
        """Keep the decisions of earlier teachers as those of any policy."""
        self._shown.zero_()

    def rewards(self) -> Tensor:
        """Return all stored rewards, ``(agents, len(self))``."""
        return self._columns["reward"][:, : len(self)]

    def observations(self) -> Tensor:
        """Return all stored observations, ``(agents, len(self), widest_observation)``."""
        return self._columns["observation"][:, : len(self)]

    def recent(self, decisions: int) -> Tensor:
        """Return the last observations, ``(agents, n, widest_observation)``.

        n is `decisions`, or the number of stored decisions if that is smaller.
        """
        first = max(0, self.added - min(decisions, self.capacity))
        at = torch.arange(first, self.added) % self.capacity
        return self._columns["observation"].index_select(1, at)

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
        return [*self._columns.items(), ("last", self._last), ("shown", self._shown)]
