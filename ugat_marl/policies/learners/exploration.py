"""Exploration that persists: an agent repeats its exploratory action for some decisions.

A green of 10 s tells little about a phase: most of it is yellow, all-red and starting up. What a
phase is worth shows when it is held, so exploratory actions come in bouts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Mask


class StickyExploration:
    """Mixes exploratory bouts into greedy actions, independently for every agent.

    A bout lasts 1 to `longest` decisions (uniform). Bouts begin at a rate that makes `epsilon` the
    long-run share of *decisions* that are exploratory, whatever their length.

    Args:
        agents: Number of agents.
        longest: Longest bout, in decisions; 1 is plain epsilon-greedy.
        generator: Source of every random choice.
    """

    def __init__(self, agents: int, longest: int, generator: np.random.Generator) -> None:
        self._longest = longest
        self._generator = generator
        self._action = np.zeros(agents, dtype=np.int64)
        self._left = np.zeros(agents, dtype=np.int64)

    def choose(self, greedy: NDArray[np.int64], allowed: Mask, epsilon: float) -> NDArray[np.int64]:
        """Replaces some greedy actions by exploratory ones.

        Args:
            greedy: Greedy action of every agent, ``(agents,)``.
            allowed: Allowed actions, ``(agents, actions)``.
            epsilon: Share of exploratory decisions, 0 to 1.

        Returns:
            The action of every agent; always an allowed one.
        """
        agents, actions = allowed.shape
        mean_length = (1 + self._longest) / 2
        rate = epsilon / (epsilon + mean_length * (1 - epsilon))
        begins = (self._left == 0) & (self._generator.random(agents) < rate)
        drawn = np.where(allowed, self._generator.random((agents, actions)), -1.0).argmax(axis=1)
        length = self._generator.integers(1, self._longest + 1, agents)
        self._action = np.where(begins, drawn, self._action)
        self._left = np.where(begins, length, self._left)
        # a bout ends early when the environment no longer allows its action
        self._left *= allowed[np.arange(agents), self._action]
        chosen = np.where(self._left > 0, self._action, greedy)
        self._left = np.maximum(self._left - 1, 0)
        return chosen
