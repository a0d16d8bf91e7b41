"""Greens that begin late by chance: how the simulation is asked what a delay does."""

from __future__ import annotations

from typing import Any

import numpy as np
from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.envs import AnyParallelEnv, Begun, Stepped
from ugat_marl.seeding import numpy_generator

LEAST_CHANCE = 0.5


class RandomDelays(BaseParallelWrapper[str, Any, Any]):
    """Delays greens by random whole seconds, and says so in the infos, under ``delay_s``.

    How often is drawn anew for every episode, so that traffic flows in some and jams in others:
    what a delay does has to be known in both.

    Args:
        env: An environment of the suite.
        most_s: Longest delay.

    Attributes:
        always_s: In place of random delays, the same for every green; None for random ones.
    """

    always_s: int | None = None

    def __init__(self, env: AnyParallelEnv, most_s: int) -> None:
        super().__init__(env)
        self._most_s = most_s
        self._generator = numpy_generator(0, "delays")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Begun:
        """Starts an episode; `seed` decides the delays, too."""
        if seed is not None:
            self._generator = numpy_generator(seed, "delays")
        self._chance = self._generator.uniform(LEAST_CHANCE, 1.0)
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> Stepped:
        """Executes the actions with delays."""
        agents = list(self.env.agents)
        if not agents:  # after the last step; the environment itself says so
            return self.env.step(actions)
        if self.always_s is None:
            drawn = self._generator.integers(self._most_s + 1, size=len(agents))
            drawn = drawn * (self._generator.random(len(agents)) < self._chance)
        else:
            drawn = np.full(len(agents), self.always_s)
        delays = dict(zip(agents, drawn.astype(float).tolist(), strict=True))
        env: Any = self.env
        env.delay_greens(delays)
        before = dict(zip(agents, env.unwrapped.phases, strict=True))
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        told = dict(infos)
        for agent in agents:  # only a green that begins can be late
            begins = infos[agent]["executed_action"] != before[agent]
            told[agent] = {**infos[agent], "delay_s": delays[agent] * begins}
        return observations, rewards, terminations, truncations, told
