"""Conversion between dictionaries by agent and padded arrays over all agents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ugat_marl.envs.types import AnyParallelEnv, Infos, Observations
from ugat_marl.errors import ActionError, OptionError

ActionMask = NDArray[np.bool_]


@dataclass(frozen=True)
class AgentSet:
    """The agents of an environment, in a fixed order, with the sizes of their spaces.

    Attributes:
        names: Names of the agents.
        observation_sizes: Length of each agent's observation vector.
        action_counts: Number of actions of each agent.
    """

    names: tuple[str, ...]
    observation_sizes: tuple[int, ...]
    action_counts: tuple[int, ...]

    def __str__(self) -> str:
        """Return the first three agents with their sizes, for messages."""
        columns = (self.names, self.observation_sizes, self.action_counts)
        rows = [f"{name} ({n} numbers, {m} actions)" for name, n, m in zip(*columns, strict=True)]
        return ", ".join(rows[:3]) + f" and {len(rows) - 3} more" * (len(rows) > 3)

    @classmethod
    def of(cls, env: AnyParallelEnv) -> AgentSet:
        """Return the agents of a parallel environment with Box vectors and Discrete actions.

        Raises:
            OptionError: The environment has no agents, or a space of another kind.
        """
        names = tuple(env.possible_agents)
        if not names:
            raise OptionError("the environment has no agents; nothing can be learned in it")
        observed = tuple(int(vector_box(env, agent).shape[0]) for agent in names)
        return cls(names, observed, tuple(int(discrete_actions(env, agent).n) for agent in names))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def widest_observation(self) -> int:
        """Length of padded observations."""
        return max(self.observation_sizes)

    @property
    def most_actions(self) -> int:
        """Number of padded actions."""
        return max(self.action_counts)

    def stack(self, observations: Observations) -> NDArray[np.float32]:
        """Return observations as one array ``(agents, widest_observation)``, padded with zeros.

        Raises:
            OptionError: An agent is missing or unknown, or its vector has another length or holds
                NaN or infinity.
        """
        if len(observations) != len(self.names):
            raise OptionError(
                f"observations of {len(observations)} agents ({', '.join(observations)}), but this "
                f"policy acts for {len(self.names)} ({', '.join(self.names)}); use the environment "
                "it was trained in, or train a new one"
            )
        stacked = np.zeros((len(self.names), self.widest_observation), dtype=np.float32)
        for row, (name, size) in enumerate(zip(self.names, self.observation_sizes, strict=True)):
            vector = observations.get(name)
            if vector is None or vector.shape != (size,):
                problem = "is missing" if vector is None else f"has shape {vector.shape}"
                raise OptionError(
                    f"the observation of agent {name!r} {problem}, expected ({size},); use the "
                    "scenario and the observation this policy was trained with"
                )
            stacked[row, :size] = vector
        if not np.isfinite(stacked).all():
            name = self.names[int(np.isfinite(stacked).all(axis=1).argmin())]
            raise OptionError(f"the observation of agent {name!r} holds NaN or infinity")
        return stacked

    def masks(self, infos: Infos) -> ActionMask:
        """Return allowed actions ``(agents, most_actions)``; an info without a mask allows all.

        Raises:
            ActionError: An agent's mask allows nothing, or has the wrong length.
        """
        allowed = np.zeros((len(self.names), self.most_actions), dtype=np.bool_)
        for row, (name, count) in enumerate(zip(self.names, self.action_counts, strict=True)):
            mask = infos.get(name, {}).get("action_mask")
            if mask is None:
                allowed[row, :count] = True
            elif len(mask) == count:
                allowed[row, :count] = mask
            else:
                raise ActionError(f"action_mask of {name!r} has {len(mask)} entries, not {count}")
        if not allowed.any(axis=1).all():
            name = self.names[int(allowed.any(axis=1).argmin())]
            raise ActionError(f"action_mask of agent {name!r} allows no action; it must allow one")
        return allowed

    def actions(self, chosen: NDArray[np.int64]) -> dict[str, int]:
        """Return action indices ``(agents,)`` as a dictionary by agent."""
        return dict(zip(self.names, chosen.tolist(), strict=True))

    def values(self, by_agent: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return one number per agent as a vector ``(agents,)``."""
        return np.array([by_agent[name] for name in self.names], dtype=np.float32)


def agent_groups(agents: AgentSet) -> dict[str, str]:
    """Return the group of each agent ``<group>_<n>``, or its own name if the group is not alike."""
    sizes = zip(agents.observation_sizes, agents.action_counts, strict=True)
    kinds: dict[str, set[tuple[int, int]]] = {}
    for agent, kind in zip(agents.names, sizes, strict=True):
        kinds.setdefault(agent.rpartition("_")[0], set()).add(kind)
    prefixes = {agent: agent.rpartition("_")[0] for agent in agents.names}
    return {a: p if p and len(kinds[p]) == 1 else a for a, p in prefixes.items()}


def vector_box(env: AnyParallelEnv, agent: str) -> spaces.Box:
    """Return an agent's space of observations.

    Raises:
        OptionError: It is not a box of one dimension.
    """
    space = env.observation_space(agent)
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise OptionError(
            f"agent {agent!r} observes {space}; needed: a Box of one dimension (put "
            "masked_observation last; supersuit.flatten_v0 makes vectors of other boxes)"
        )
    return space


def discrete_actions(env: AnyParallelEnv, agent: str) -> spaces.Discrete:
    """Return an agent's space of actions.

    Raises:
        OptionError: It is not ``Discrete(n)`` from 0.
    """
    space = env.action_space(agent)
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise OptionError(f"agent {agent!r} acts in {space}; needed: Discrete(n)")
    return space
