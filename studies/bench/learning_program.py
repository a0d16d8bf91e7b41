"""Measured program: training episodes, the same episodes without a learner, single updates."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.policies import DQN, DQNConfig
from ugat_marl.seeding import torch_generator

Vector = NDArray[np.float32]


class Tape(BaseParallelWrapper[str, Vector, int]):
    """Record seed and actions of an episode, and play them again without a learner."""

    def __init__(self, env: TrafficEnv) -> None:
        super().__init__(env)
        self.seed: int | None = None
        self.actions: list[dict[str, int]] = []

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, Any]]]:
        """Start an episode and forget the actions of the last one."""
        self.seed, self.actions = seed, []
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Mapping[str, int]) -> Any:
        """Record and execute one decision."""
        self.actions.append(dict(actions))
        return self.env.step(dict(actions))

    def play(self) -> None:
        """Play the recorded episode again."""
        self.env.reset(seed=self.seed)
        for actions in self.actions:
            self.env.step(actions)


class Noise(ParallelEnv[str, Any, Any]):
    """An environment without traffic, whose agents have given spaces.

    Args:
        spaces: Observation size and number of actions of each agent.
        decisions: Decisions of an episode.
    """

    observation_spaces: dict[str, Box]
    action_spaces: dict[str, Discrete]

    metadata: dict[str, Any] = {"name": "noise_v0", "render_modes": []}  # noqa: RUF012

    def __init__(self, spaces: list[tuple[int, int]], decisions: int) -> None:
        self.possible_agents = [f"agent_{index}" for index in range(len(spaces))]
        self.observation_spaces = {
            agent: Box(0.0, 1.0, (size,), np.float32)
            for agent, (size, _) in zip(self.possible_agents, spaces, strict=True)
        }
        self.action_spaces = {
            agent: Discrete(count)
            for agent, (_, count) in zip(self.possible_agents, spaces, strict=True)
        }
        self._decisions = decisions
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Box:
        """Return the space of vectors in [0, 1]."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """Return the discrete space of an agent."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, Any]]]:
        """Begin an episode."""
        self._generator = np.random.default_rng(seed)
        self._left = self._decisions
        self.agents = self.possible_agents[:]
        return self._draw(), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, int]) -> Any:
        """Draw observations and rewards."""
        self._left -= 1
        agents, over = self.agents, self._left == 0
        rewards = dict(zip(agents, self._generator.normal(size=len(agents)).tolist(), strict=True))
        observations = self._draw()
        if over:
            self.agents = []
        return (
            observations,
            rewards,
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: {} for agent in agents},
        )

    def _draw(self) -> dict[str, Vector]:
        return {
            agent: self._generator.random(space.shape, dtype=np.float32)
            for agent, space in self.observation_spaces.items()
        }


def config_of(request: Mapping[str, Any]) -> DQNConfig:
    """Return the default settings of DQN, except that every action is random."""
    return DQNConfig(
        epsilon_start=1.0,
        epsilon_end=1.0,
        sticky_decisions=1,
        warmup_decisions=request["warmup_decisions"],
    )


def paired_episodes(request: Mapping[str, Any]) -> dict[str, Any]:
    """Play training episodes and their replays in turn; return the wall seconds of each."""
    env = parallel_env(request["scenario"], duration_s=request["duration_s"])
    tape = Tape(env)
    learner = DQN.of(tape, config_of(request), request["seed"])
    training: list[float] = []
    plain: list[float] = []
    seed = request["seed"]
    while learner.decisions < request["warmup_decisions"]:
        learner.learn(tape, 1, seed)
    before = learner.updates
    for _ in range(request["rounds"]):
        began = time.perf_counter()
        learner.learn(tape, 1, seed)
        learned = time.perf_counter()
        tape.play()
        played = time.perf_counter()
        training.append(learned - began)
        plain.append(played - learned)
    env.close()
    return {
        "agents": len(env.possible_agents),
        "decisions": env.scenario.decisions,
        "updates": (learner.updates - before) // request["rounds"],
        "training_s": training,
        "plain_s": plain,
        "spaces": [
            (int(env.observation_space(agent).shape[0]), int(env.action_space(agent).n))
            for agent in env.possible_agents
        ],
    }


def update_costs(request: Mapping[str, Any], spaces: list[tuple[int, int]]) -> dict[str, Any]:
    """Return wall seconds per update of one agent and of all, measured in turn."""
    torch.set_num_threads(1)
    generator = torch_generator(request["seed"], "bench", "updates")
    learners: list[DQN] = []
    for own in (spaces[:1], spaces):
        noise = Noise(own, request["warmup_decisions"] + 50)
        learner = DQN.of(noise, config_of(request), request["seed"])
        learner.learn(noise, 1, request["seed"])
        learners.append(learner)
    seconds: list[list[float]] = [[], []]
    for _ in range(request["repetitions"]):
        for learner, own in zip(learners, seconds, strict=True):
            began = time.perf_counter()
            for _ in range(request["updates"]):
                learner.update(generator)
            own.append((time.perf_counter() - began) / request["updates"])
    return {"update_one_s": seconds[0], "update_all_s": seconds[1]}


def measure(request: Mapping[str, Any]) -> dict[str, Any]:
    """Measure both comparisons."""
    episodes = paired_episodes(request)
    return {**episodes, **update_costs(request, episodes["spaces"])}


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(measure(json.loads(asked.read_text()))))
