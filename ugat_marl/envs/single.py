"""A scenario with one intersection as an environment of Gymnasium.

``gymnasium.make("ugat_marl.envs.single:ugat_marl/single-v1")`` imports this module and makes one.
Keywords are those of `ugat_marl.parallel_env`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from ugat_marl.effects import Domain
from ugat_marl.envs.traffic_env import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Scenario

if TYPE_CHECKING:
    from ugat_marl.data import Scores
    from ugat_marl.envs.description import Description


class SingleEnv(gymnasium.Env[NDArray[np.float32], int]):
    """The traffic light of a network with one intersection.

    Args:
        scenario: Scenario, as for `ugat_marl.parallel_env`.
        domain: Domain, likewise.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        **options: Other options of `ugat_marl.parallel_env`.

    Attributes:
        parallel: The same environment as a PettingZoo `ParallelEnv`.

    Raises:
        OptionError: The scenario has several intersections.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 1}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Path | Scenario = "single-v1",
        domain: Domain = "sim",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.parallel = parallel_env(scenario, domain, render_mode=render_mode, **options)
        agents = self.parallel.possible_agents
        if len(agents) != 1:
            raise OptionError(
                f"scenario {self.parallel.scenario.id!r} has {len(agents)} intersections, and an "
                "environment of Gymnasium has one agent; use ugat_marl.parallel_env"
            )
        (self._agent,) = agents
        self.render_mode = render_mode
        self.observation_space: Box = self.parallel.observation_space(self._agent)
        self.action_space: Discrete = self.parallel.action_space(self._agent)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; ``info["action_mask"]`` is 1 where a phase may be chosen."""
        super().reset(seed=seed)
        observations, infos = self.parallel.reset(seed=seed, options=options)
        return observations[self._agent], infos[self._agent]

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Show a phase for one decision interval."""
        agent = self._agent
        seen, rewards, ended, cut, infos = self.parallel.step({agent: action})
        return seen[agent], float(rewards[agent]), ended[agent], cut[agent], infos[agent]

    def scores(self) -> Scores:
        """Return the scores of the episode: travel time, throughput, reward, queue, delay."""
        return self.parallel.scores()

    def describe(self) -> Description:
        """Return tables of the observed numbers and of the phases; ``print`` shows them whole."""
        return self.parallel.describe()

    def render(self) -> Any:
        """Return a picture in render mode "rgb_array", uint8 ``(height, width, 3)``."""
        return self.parallel.render()

    def close(self) -> None:
        """End the simulation."""
        self.parallel.close()
