"""Environments around the simulation: with grounded actions, and with random delays of greens."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.envs import AnyParallelEnv, ResetResult, StepResult, as_traffic_env, memory_size
from ugat_marl.errors import ActionError, OptionError
from ugat_marl.grounding.transform import Transform
from ugat_marl.grounding.view import Moment
from ugat_marl.seeding import numpy_generator

Infos = dict[str, dict[str, Any]]

LEAST_CHANCE = 0.5
"""Smallest chance of a green, in an episode, to begin late by a random time, which may be 0."""


class GroundedEnv(BaseParallelWrapper[str, Any, Any]):
    """Executes grounded actions in the wrapped simulation, without changes to the learner.

    This is E_sim of Algorithm 1 in lines 9 to 15 (`ugat`); the comments give these line numbers.

    A learner gets the observations and rewards of the grounded simulation, and stores its own
    action with them. The infos of `reset` and `step` describe the grounding:

    - ``grounded_action``: int, the inverse model's answer; -1 at reset.
    - ``uncertainty``: float, u of this answer in [0, 1]; 1.0 at reset.
    - ``accepted``: int, 1 if the grounded action was executed; with constant delays, 1 if a green
      begins late.
    - ``delay_s``: float, delay of the agent's green in s; 0.0 at reset.

    A grounded action that the agent's action mask forbids is never executed. An epoch of the gate
    is an episode of this environment. Models with a history see the earlier observations and phases
    of the episode. The phases are ``executed_action`` in the infos, if the environment gives it.

    Args:
        env: The simulation.
        transform: Fitted models and gate, made for the same agents.

    Raises:
        OptionError: The transform was made for other agents or observations.
    """

    def __init__(self, env: AnyParallelEnv, transform: Transform) -> None:
        super().__init__(env)
        _refuse_misfit(env, transform)
        self.transform = transform
        self._earlier: deque[Moment] = deque(maxlen=transform.inputs.history - 1)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode of the wrapped environment."""
        self.transform.gate.end_epoch()
        observations, infos = self.env.reset(seed=seed, options=options)
        self._earlier.clear()
        self._notice(observations, infos)
        return observations, _extended(infos, self.env.agents)

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Ground the actions and execute the outcome.

        Raises:
            ActionError: An agent's action is missing or outside its action space.
        """
        acting = list(self.env.agents)
        if not acting:  # after the last step; the environment itself says so
            return self.env.step(actions)
        stack = self.transform.stack
        requested = np.array([self._action(agent, actions) for agent in stack.agents])  # line 10
        outcome = self.transform(
            self._seen, requested, self._allowed, self._earlier
        )  # lines 11 to 13 and 15
        executed = dict(zip(stack.agents, outcome.executed.tolist(), strict=True))
        env: Any = self.env
        if hasattr(env, "remember"):  # one of the suite: its agents see their own commands
            env.remember(dict(zip(stack.agents, requested.tolist(), strict=True)))
        if outcome.delay_s.any():
            env.delay_greens(dict(zip(stack.agents, outcome.delay_s.tolist(), strict=True)))
        observations, rewards, terminations, truncations, infos = self.env.step(executed)  # line 14
        if self.env.agents:
            ran = [infos.get(a, {}).get("executed_action", executed[a]) for a in stack.agents]
            self._earlier.appendleft(self._moment(ran, requested.tolist()))
            self._notice(observations, infos)
        else:
            self.transform.gate.end_epoch()
        columns = (outcome.grounded, outcome.u, outcome.accepted, outcome.delay_s)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        taken = dict(zip(stack.agents, rows, strict=True))
        return observations, rewards, terminations, truncations, _extended(infos, acting, taken)

    def _moment(self, executed: list[int], asked: list[int]) -> Moment:
        """Return the decision that has ended, for models with a history."""
        phases = (torch.tensor(numbers)[:, None] for numbers in (executed, asked))
        return Moment(self._seen, *phases)

    def _notice(self, observations: dict[str, Any], infos: Infos) -> None:
        """Keep copies for the next grounding, because learners may scale observations in place."""
        stack = self.transform.stack
        self._seen = stack.observations(observations)
        self._allowed = stack.masks({a: infos.get(a, {}).get("action_mask") for a in stack.agents})

    def _action(self, agent: str, actions: dict[str, Any]) -> int:
        phases = self.transform.stack.layouts[agent].phases
        if agent not in actions:
            raise ActionError(f"no action for {agent}; every agent acts at every step")
        action = np.asarray(actions[agent])
        if action.size != 1 or not np.issubdtype(action.dtype, np.integer):
            raise ActionError(
                f"action of {agent} is {actions[agent]!r}; allowed: whole numbers 0 to {phases - 1}"
            )
        if not 0 <= action.item() < phases:
            raise ActionError(f"action of {agent} is {action}; allowed: 0 to {phases - 1}")
        return int(action.item())


def _extended(
    infos: Infos, agents: list[str], taken: dict[str, tuple[Any, ...]] | None = None
) -> Infos:
    """Return copies of the infos with the keys of the grounding; other entries are kept."""
    extended = dict(infos)
    for agent in agents:
        grounded, u, accepted, delay_s = taken[agent] if taken else (-1, 1.0, False, 0.0)
        extended[agent] = {
            **infos.get(agent, {}),
            "grounded_action": grounded,
            "uncertainty": u,
            "accepted": int(accepted),
            "delay_s": delay_s,
        }
    return extended


def _refuse_misfit(env: AnyParallelEnv, transform: Transform) -> None:
    layouts = transform.stack.layouts
    if tuple(env.possible_agents) != transform.stack.agents:
        raise OptionError(
            f"the grounding was made for {len(layouts)} agents {tuple(layouts)[:4]}, the "
            f"environment has {len(env.possible_agents)} {tuple(env.possible_agents)[:4]}; "
            "use the same scenario"
        )
    options = getattr(env.unwrapped, "env_options", {})
    for agent, layout in layouts.items():
        shape = env.observation_space(agent).shape
        width = layout.size + memory_size(layout.phases, options.get("commands", 0))
        phases = int(getattr(env.action_space(agent), "n", 0))
        if shape != (width,) or phases != layout.phases:
            raise OptionError(
                f"the grounding expects observations of ({width},) and {layout.phases} "
                f"phases from {agent}; the environment has {shape} and {phases}; use the "
                "observation options the models were fitted with"
            )


class RandomDelays(BaseParallelWrapper[str, Any, Any]):
    """Delays greens by random whole seconds; the infos give the delay in ``delay_s``.

    Every episode draws its own share of delayed greens. So traffic flows in some episodes and jams
    in others, and the models learn the effect of a delay in both.

    Args:
        env: A `TrafficEnv`, wrapped or not.
        most_s: Longest delay, in s.
        always_s: Constant delay of all greens, in s; None for random delays.
    """

    def __init__(self, env: AnyParallelEnv, most_s: int, always_s: int | None = None) -> None:
        super().__init__(env)
        self._most_s = most_s
        self._always_s = always_s
        self._generator = numpy_generator(0, "delays")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode; `seed` decides the delays, too."""
        if seed is not None:
            self._generator = numpy_generator(seed, "delays")
        self._chance = self._generator.uniform(LEAST_CHANCE, 1.0)
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Execute the actions with delays."""
        agents = list(self.env.agents)
        if not agents:  # after the last step; the environment itself says so
            return self.env.step(actions)
        if self._always_s is None:
            drawn = self._generator.integers(self._most_s + 1, size=len(agents))
            drawn = drawn * (self._generator.random(len(agents)) < self._chance)
        else:
            drawn = np.full(len(agents), self._always_s)
        delays = dict(zip(agents, drawn.astype(float).tolist(), strict=True))
        env: Any = self.env
        env.delay_greens(delays)
        before = dict(zip(agents, as_traffic_env(self.env).phases, strict=True))
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        told = dict(infos)
        for agent in agents:  # only a green that begins can be late
            begins = infos[agent]["executed_action"] != before[agent]
            told[agent] = {**infos[agent], "delay_s": delays[agent] * begins}
        return observations, rewards, terminations, truncations, told


class ChangePenalty(BaseParallelWrapper[str, Any, Any]):
    """Lowers an agent's reward whenever its intersection changes the phase.

    It is a control that needs no data: somebody guesses that changes cost more on the street.

    Args:
        env: A `TrafficEnv`, wrapped or not.
        cost: Amount taken from the reward for a change, in the unit of the reward.
    """

    def __init__(self, env: AnyParallelEnv, cost: float) -> None:
        super().__init__(env)
        self._cost = cost

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Execute the actions, and take the cost of changes from the rewards."""
        agents = list(self.env.agents)
        before = dict(zip(agents, as_traffic_env(self.env).phases, strict=True)) if agents else {}
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        paid = {
            agent: reward - self._cost * (infos[agent]["executed_action"] != before[agent])
            for agent, reward in rewards.items()
        }
        return observations, paid, terminations, truncations, infos
