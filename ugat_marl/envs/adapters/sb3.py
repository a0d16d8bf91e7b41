"""Parallel environments as a `VecEnv` of Stable-Baselines3: one network for all agents.

    from stable_baselines3 import PPO
    from ugat_marl.envs.adapters.sb3 import AgentsVecEnv
    from ugat_marl.envs.wrappers import agent_indicator, pad_spaces

    env = AgentsVecEnv([agent_indicator(pad_spaces(ugat_marl.parallel_env("grid4x4-v1")))])
    PPO("MlpPolicy", env, seed=1).learn(100_000)

Unlike SuperSuit's version, it supports seeds and masks, can be closed, and marks truncations.
"""
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from ugat_marl.envs.agents import discrete_actions, vector_box
from ugat_marl.envs.types import AnyParallelEnv
from ugat_marl.errors import ActionError, EpisodeError, OptionError

Step = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]


class AgentsVecEnv(VecEnv):
    """`VecEnv` with one row for each agent of each environment, in the order of both.

    After the end of an episode the next one begins at once, as Stable-Baselines3 expects. The infos
    hold the last observation as ``terminal_observation``, and ``TimeLimit.truncated``; the library
    then bootstraps with the value of this observation. sb3-contrib's `MaskablePPO` calls
    `action_masks`.

    Args:
        envs: Environments whose agents all have the same spaces, and stay to the end of the
            episode; `ugat_marl.envs.wrappers.pad_spaces` makes spaces equal.
        masks_in_observation: True to append the action mask to each observation, for policies
            without another way to see it (`ugat_marl.envs.wrappers.appended_mask` does the same for
            one environment).

    Raises:
        OptionError: There are no agents, or their spaces are unequal.
    """

    def __init__(
        self, envs: Sequence[AnyParallelEnv], *, masks_in_observation: bool = False
    ) -> None:
        self.envs = list(envs)
        self.rows = [(env, agent) for env in self.envs for agent in env.possible_agents]
        if not self.rows:
            raise OptionError("no environment with agents; nothing can be learned in none")
        box, actions = _common_spaces(self.rows)
        self.masks_in_observation = masks_in_observation
        if masks_in_observation:
            ones = np.ones(int(actions.n), np.float32)
            low, high = np.append(box.low, 0 * ones), np.append(box.high, ones)
            box = spaces.Box(low, high, dtype=np.float32)
        self._masks = np.ones((len(self.rows), int(actions.n)), np.bool_)
        self._starts = np.cumsum([0, *(len(env.possible_agents) for env in self.envs)])
        self._chosen = np.zeros(len(self.rows), np.int64)
        super().__init__(len(self.rows), box, actions)

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment, with the seeds set by `seed`."""
        seen = [
            self._begin(k, self._seeds[int(self._starts[k])])  # its first agent's
            for k in range(len(self.envs))
        ]
        self._reset_seeds()
        self._reset_options()
        return np.concatenate(seen)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seeds of the next reset: ``seed + k`` for environment `k`."""
        if seed is None:
            return list(super().seed(None))
        for k in range(len(self.envs)):
            for row in self._agents_of(k):
                self._seeds[row] = seed + k
        return self._seeds

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions; environments in worker processes may begin with them."""
        self._chosen = np.asarray(actions).reshape(-1)

    def step_wait(self) -> Step:
        """Step every environment once, and begin the next episodes of ended ones."""
        seen, infos = list[NDArray[np.float32]](), list[dict[str, Any]]()
        rewards = np.zeros(len(self.rows), np.float32)
        over = np.zeros(len(self.rows), np.bool_)
        for k, env in enumerate(self.envs):
            rows = self._agents_of(k)
            agents = env.possible_agents
            chosen = dict(zip(agents, self._chosen[rows.start : rows.stop].tolist(), strict=True))
            observations, paid, terminated, truncated, told = env.step(chosen)
            now = self._stacked(k, observations, told)
            rewards[rows.start : rows.stop] = [paid[agent] for agent in agents]
            agent_infos = [dict(told[agent]) for agent in agents]
            if not env.agents:
                over[rows.start : rows.stop] = True
                for agent, row, info in zip(agents, now, agent_infos, strict=True):
                    info["terminal_observation"] = row
                    info["TimeLimit.truncated"] = truncated[agent] and not terminated[agent]
                now = self._begin(k, None)
            elif len(env.agents) < len(agents):
                gone = sorted(set(agents) - set(env.agents))
                raise EpisodeError(f"{', '.join(gone)} left before the others; all have to stay")
            seen.append(now)
            infos += agent_infos
        return np.concatenate(seen), rewards, over, infos

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the allowed actions, ``(agents, actions)``; all if the info has no mask."""
        return self._masks.copy()

    def close(self) -> None:
        """Close every environment; a second call does nothing."""
        for env in self.envs:
            env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment of each agent."""
        if attr_name == "action_masks":
            return [lambda row=row: self._masks[row] for row in self._picked(indices)]
        return [getattr(self.rows[row][0], attr_name) for row in self._picked(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environments of these agents."""
        for env in self._environments(indices):
            setattr(env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method, once for each environment that these agents are in.

        ``action_masks`` returns one mask for each agent instead.
        """
        if method_name == "action_masks":
            return [self._masks[row].copy() for row in self._picked(indices)]
        environments = self._environments(indices)
        return [getattr(env, method_name)(*method_args, **method_kwargs) for env in environments]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for every agent, because Gymnasium's wrappers are not supported."""
        return [False for _ in self._picked(indices)]

    def get_images(self) -> Sequence[Any]:
        """Return a picture of each environment."""
        return [env.render() for env in self.envs]

    def _begin(self, k: int, seed: int | None) -> NDArray[np.float32]:
        options = self._options[int(self._starts[k])] or None
        observations, infos = self.envs[k].reset(seed=seed, options=options)
        for row in self._agents_of(k):
            self.reset_infos[row] = dict(infos[self.rows[row][1]])
        return self._stacked(k, observations, infos)

    def _stacked(self, k: int, observations: Any, infos: Any) -> NDArray[np.float32]:
        """Return the observations of environment `k`, ``(agents, size)``, and keep the masks."""
        rows = self._agents_of(k)
        agents = self.envs[k].possible_agents
        for row, agent in zip(rows, agents, strict=True):
            given = infos[agent].get("action_mask")
            self._masks[row] = True if given is None else given
            if not self._masks[row].any():
                raise ActionError(f"action_mask of agent {agent!r} allows no action")
        seen = np.array([observations[agent] for agent in agents], dtype=np.float32)
        if not self.masks_in_observation:
            return seen
        masks = self._masks[rows.start : rows.stop].astype(np.float32)
        return np.concatenate((seen, masks), axis=1)

    def _agents_of(self, k: int) -> range:
        return range(int(self._starts[k]), int(self._starts[k + 1]))

    def _picked(self, indices: Any) -> Iterable[int]:
        return self._get_indices(indices)

    def _environments(self, indices: Any) -> list[AnyParallelEnv]:
        return list(
            {id(self.rows[row][0]): self.rows[row][0] for row in self._picked(indices)}.values()
        )


def _common_spaces(
    rows: Sequence[tuple[AnyParallelEnv, str]],
) -> tuple[spaces.Box, spaces.Discrete]:
    (env, first), *others = rows
    box, actions = vector_box(env, first), discrete_actions(env, first)
    for other, agent in others:
        for space, common in (
            (other.observation_space(agent), box),
            (other.action_space(agent), actions),
        ):
            if space != common:
                raise OptionError(
                    f"agent {agent!r} has {space}, agent {first!r} {common}; Stable-Baselines3 "
                    "needs equal spaces: wrap each environment in "
                    "ugat_marl.envs.wrappers.pad_spaces; environments whose largest intersections "
                    "differ cannot share one VecEnv"
                )
    return box, spaces.Discrete(int(actions.n))
