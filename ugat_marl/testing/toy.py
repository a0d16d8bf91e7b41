"""Small environment without SUMO that keeps every rule of `ugat_marl.testing`.

It serves fast tests of learners and wrappers. The tests of the kit take it as a good subject and
break one rule each. Queues grow by random arrivals, and the green phase serves its lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from ugat_marl.data import AgentLayout, Scores
from ugat_marl.envs import StepResult
from ugat_marl.errors import ActionError, EpisodeError

CAPACITY = 20
"""Vehicles that fit on a lane."""


class ToyTraffic(ParallelEnv[str, Any, Any]):
    """Queues at three intersections: two have four lanes, one has three.

    Phase k serves lanes k and k + 1. The reward is minus the number of queued vehicles at the
    intersection.

    Args:
        steps: Number of decisions in an episode.
        served: Largest number of vehicles that leave a green lane per decision. Another value makes
            another domain.
        arrivals: Mean number of arrivals per lane and decision.
        equal: Leave out the intersection with three lanes.
        masked: Forbid random phases by the masks; a forbidden phase raises an `ActionError`.
    """

    observation_spaces: dict[str, Box]
    action_spaces: dict[str, Discrete]

    metadata: ClassVar[dict[str, Any]] = {
        "name": "ugat_marl_toy_v1",
        "render_modes": ["rgb_array"],
        "is_parallelizable": True,
    }
    decision_interval_s = 10.0
    domain = "sim"

    def __init__(
        self,
        steps: int = 12,
        served: int = 3,
        arrivals: float = 1.0,
        *,
        equal: bool = False,
        masked: bool = False,
    ) -> None:
        self.steps = steps
        self.served = served
        self.arrivals = arrivals
        self.masked = masked
        self.render_mode: str | None = "rgb_array"
        places = {"cross_0": "A", "tee_0": "B", "cross_1": "C"}
        self.intersection_of = {a: b for a, b in places.items() if a != "tee_0" or not equal}
        self.possible_agents = list(self.intersection_of)
        self.agents: list[str] = []
        self.agent_groups = {"cross": ["cross_0", "cross_1"]} | (
            {} if equal else {"tee": ["tee_0"]}
        )
        self.layouts = {
            agent: AgentLayout(3, 2) if agent == "tee_0" else AgentLayout(4, 3)
            for agent in self.possible_agents
        }
        self.observation_spaces = {
            agent: Box(0.0, 1.0, (layout.size,), np.float32)
            for agent, layout in self.layouts.items()
        }
        self.action_spaces = {
            agent: Discrete(layout.phases) for agent, layout in self.layouts.items()
        }
        size = sum(layout.size for layout in self.layouts.values())
        self.state_space = Box(0.0, 1.0, (size,), np.float32)
        self._generator = np.random.default_rng()
        self._scores: Scores | None = None

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, dict[str, Any]]]:
        """Empty the roads and begin an episode."""
        if seed is not None:
            self._generator = np.random.default_rng(seed)
        self._traffic = np.random.default_rng(int(self._generator.integers(2**31)))
        self.agents = self.possible_agents[:]
        self._step = 0
        self._left = self._arrived = 0
        self._rewards: list[float] = []
        self._scores = None
        self._phase = dict.fromkeys(self.agents, 0)
        self._queue = {a: np.zeros(self.layouts[a].features, np.int64) for a in self.agents}
        return self._observe(), self._infos()

    def step(self, actions: Mapping[str, int]) -> StepResult:
        """Show the chosen phases for one interval."""
        if not actions and self._scores is not None:
            return {}, {}, {}, {}, {}
        if not self.agents:
            raise EpisodeError("step() needs a running episode; call reset() first")
        if set(actions) != set(self.agents):
            raise ActionError(
                f"actions for {sorted(actions)}; needed: one for each of {self.agents}"
            )
        for agent, action in actions.items():
            if not self.action_spaces[agent].contains(action):
                raise ActionError(f"action of {agent} is {action!r}; see its action space")
            if not self._masks[agent][action]:
                raise ActionError(f"{agent} showed the forbidden phase {action}; see its mask")
        agents = self.agents
        for agent in agents:
            self._serve(agent, int(actions[agent]))
        self._step += 1
        rewards = {agent: -float(self._queue[agent].sum()) for agent in agents}
        self._rewards.append(sum(rewards.values()) / len(rewards))
        over = self._step >= self.steps
        result = (
            self._observe(),
            rewards,
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            self._infos(),
        )
        if over:
            self._scores = self._measure()
            self.agents = []
        return result

    def state(self) -> NDArray[np.float32]:
        """Return all observations, one after the other."""
        if not hasattr(self, "_queue"):
            raise EpisodeError("state() has no meaning before the first reset()")
        return np.concatenate(list(self._vectors().values()))

    def scores(self) -> Scores:
        """Return the measures of the episode that has ended."""
        if self._scores is None:
            raise EpisodeError("scores() needs a whole episode")
        return self._scores

    def render(self) -> NDArray[np.uint8]:
        """Return the queues as bars of pixels."""
        lanes = np.concatenate(list(self._queue.values()))
        bars = np.arange(CAPACITY)[:, None] >= lanes[None, :]
        return np.repeat(np.where(bars, 255, 0).astype(np.uint8)[..., None], 3, axis=2)

    def close(self) -> None:
        """End the episode."""
        self.agents = []

    def _serve(self, agent: str, phase: int) -> None:
        queue = self._queue[agent]
        come = self._traffic.poisson(self.arrivals, queue.size)
        room = CAPACITY - queue
        queue += np.minimum(come, room)
        served = queue[phase : phase + 2]
        gone = np.minimum(served, self.served)
        served -= gone
        self._phase[agent] = phase
        self._left += int(gone.sum())
        self._arrived += int(come.sum())

    def _vectors(self) -> dict[str, NDArray[np.float32]]:
        return {
            agent: np.concatenate(
                (self._queue[agent] / CAPACITY, np.eye(layout.phases)[self._phase[agent]])
            ).astype(np.float32)
            for agent, layout in self.layouts.items()
        }

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        return self._vectors()

    def _infos(self) -> dict[str, dict[str, Any]]:
        self._masks = {a: self._allowed(layout.phases) for a, layout in self.layouts.items()}
        return {
            agent: {"action_mask": mask.copy(), "executed_action": self._phase[agent]}
            for agent, mask in self._masks.items()
        }

    def _allowed(self, phases: int) -> NDArray[np.int8]:
        mask = np.ones(phases, np.int8)
        if self.masked:
            mask[self._traffic.permutation(phases)[: self._traffic.integers(phases)]] = 0
        return mask

    def _measure(self) -> Scores:
        reward = float(np.mean(self._rewards))
        inside = float(sum(queue.sum() for queue in self._queue.values()))
        due = float(self._arrived)
        wait = -sum(self._rewards) * len(self.possible_agents) / max(due, 1.0)
        return Scores(
            att_s=wait * self.decision_interval_s,
            att_finished_s=wait * self.decision_interval_s,
            throughput=float(self._left),
            reward=reward,
            queue=-reward,
            delay=0.0,
            delay_s=wait * self.decision_interval_s,
            due=due,
            departed=float(self._left) + inside,
            backlog=due - self._left - inside,
        )
