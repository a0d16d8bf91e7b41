"""Protocols of a policy, which acts, and of a learner, which improves a policy.

The training of UGAT, the evaluation and the conformance kit use policies only through them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from ugat_marl.envs import Actions, AnyParallelEnv, Infos, Observations, TrafficEnv


@runtime_checkable
class Policy(Protocol):
    """Choose a green phase for every intersection.

    Attributes:
        env_options: Options of `ugat_marl.parallel_env` that the policy relies on, such as
            ``{"observation": "movements"}``. Make its environment with these options.
    """

    env_options: Mapping[str, Any]

    def reset(self, seed: int) -> None:
        """Forget the past; call this once before every episode."""
        ...

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Map the observations of all agents to an action for each of them.

        Args:
            observations: Agent to float32 vector, in the agent's observation space.
            infos: Agent to info; ``infos[agent]["action_mask"]`` is int8, 1 where a phase may be
                chosen.

        Returns:
            Agent to the index of its next green phase.
        """
        ...


EpisodeCallback = Callable[[int, Mapping[str, float]], None]
"""Called as ``callback(episode, numbers)`` after every training episode."""


@runtime_checkable
class Learner(Protocol):
    """Improve a policy by acting in an environment; keep the state between calls.

    Attributes:
        episodes: Number of training episodes in all calls so far; saved with the state.
    """

    episodes: int

    def learn(
        self,
        env: AnyParallelEnv,
        episodes: int,
        seed: int,
        on_episode: EpisodeCallback | None = None,
    ) -> Policy:
        """Train for a number of episodes and return the current greedy policy.

        A further call continues the training. `seed` fixes every random choice of this call.
        """
        ...

    def policy(self) -> Policy:
        """Return the current greedy policy (a snapshot: later learning does not change it)."""
        ...

    def save(self, path: Path) -> None:
        """Write the whole state (networks, optimiser, replay), so that learning can go on."""
        ...

    def load(self, path: Path) -> None:
        """Restore the state from a file that `save` wrote.

        Raises:
            CheckpointError: Unreadable, not finite, or of another set of agents.
        """
        ...


@runtime_checkable
class Taught(Protocol):
    """A learner that can watch a rule before it acts itself."""

    def plays(self, env: AnyParallelEnv, best: str | None = None) -> int:
        """Return the number of episodes that `attend` plays; 0 without a teacher."""
        ...

    def attend(
        self,
        env: AnyParallelEnv,
        seed: int,
        on_play: Callable[[str], None] | None = None,
        best: str | None = None,
    ) -> str | None:
        """Watch the rule that is good in an environment, and return its spelling.

        Args:
            env: The environment.
            seed: Root of the seeds of the episodes.
            on_play: Called after every episode with the rule that played it.
            best: The best rule there, if it is known.
        """
        ...


PolicyFactory = Callable[[TrafficEnv], Policy]
"""Make a policy for an environment; controllers read the network from it."""
