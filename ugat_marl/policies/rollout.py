"""Roll-outs: the loop of acting and stepping, and the recording of its transitions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Provenance, TransitionLog, TransitionRecorder, installed_version
from ugat_marl.envs import (
    OBSERVATION_UNITS,
    Actions,
    AnyParallelEnv,
    Infos,
    Observations,
    Observer,
    as_traffic_env,
)
from ugat_marl.errors import OptionError
from ugat_marl.policies.protocols import Policy
from ugat_marl.seeding import numpy_generator

SIMULATING = ("libsumo", "numpy", "ugat-marl")
"""Packages whose version can change a roll-out; every log holds these versions."""


@dataclass(frozen=True)
class RollOut:
    """Result of one roll-out.

    Attributes:
        steps: Number of decisions.
        mean_reward: Mean reward over decisions and agents.
        log: All transitions; None without an observer to record them.
    """

    steps: int
    mean_reward: float
    log: TransitionLog | None


StepCallback = Callable[[int], None]
"""Called with the number of decisions made so far."""


class RollOutStopped(Exception):
    """A roll-out ended early: another thread failed, or the user interrupted."""


def stop_callback(stop: threading.Event) -> StepCallback:
    """Return a callback that raises `RollOutStopped` after `stop` is set."""

    def check(_step: int) -> None:
        if stop.is_set():
            raise RollOutStopped("stopped: another roll-out failed, or the run was interrupted")

    return check


def roll_out(
    env: AnyParallelEnv,
    policy: Policy,
    seed: int,
    *,
    record: Observer | None = None,
    on_step: StepCallback | None = None,
    decisions: int | None = None,
) -> RollOut:
    """Play one episode.

    Args:
        env: An environment made with the policy's `env_options`.
        policy: Policy that acts.
        seed: Seed of the simulation and of the policy's own choices.
        record: Observer whose observations are recorded; None records nothing. They may differ from
            those that the policy reads. It needs an environment of the suite.
        on_step: Function called after every decision.
        decisions: Most decisions of the episode; None for a whole one.

    Raises:
        OptionError: The policy reads another observation than the environment shows.
    """
    if record is None:
        return _played(env, policy, seed, None, on_step, decisions)
    base = as_traffic_env(env)
    if not hasattr(base, "measure_for"):
        raise OptionError(
            f"{type(base).__name__} cannot be recorded: record needs an environment of ugat_marl"
        )
    try:
        base.measure_for(record)
        return _played(env, policy, seed, record, on_step, decisions)
    finally:
        base.measure_for()


def _played(
    env: AnyParallelEnv,
    policy: Policy,
    seed: int,
    record: Observer | None,
    on_step: StepCallback | None,
    decisions: int | None,
) -> RollOut:
    _require_same_observation(env, policy)
    observations, infos = env.reset(seed=seed)
    policy.reset(seed)
    recording = _Recording(env, record, seed, infos) if record else None
    steps, total = 0, 0.0
    while env.agents and steps != decisions:
        agents = list(env.agents)
        actions = policy.act(observations, infos)
        observations, rewards, _, _, infos = env.step(actions)
        if recording is not None:
            recording.add(actions, rewards, infos)
        total += sum(rewards.values()) / len(agents)
        steps += 1
        if on_step is not None:
            on_step(steps)
    return RollOut(steps, total / max(steps, 1), recording.log() if recording else None)


def _require_same_observation(env: AnyParallelEnv, policy: Policy) -> None:
    """Refuse a policy that would read another observation than its own, if it is long enough."""
    shown = getattr(env.unwrapped, "env_options", {}).get("observation")
    read = policy.env_options.get("observation")
    if isinstance(shown, str) and isinstance(read, str) and shown != read:
        raise OptionError(
            f"the policy reads the observation {read!r}, and the environment shows {shown!r}; "
            f"make it with observation={read!r}"
        )


def observer_of(
    env: AnyParallelEnv, name: str | Callable[[Any], Any] | None = None, neighbours: int = 0
) -> Observer:
    """Make an observer of the environment's network.

    Args:
        env: An environment of the suite, wrapped or not.
        name: Name of the observation; None for that of the environment, with its `neighbours`.
        neighbours: Number of neighbours that the observation includes.
    """
    base = as_traffic_env(env)
    if name is None:
        name, neighbours = base.options.observation, base.options.neighbours
    assert name is not None
    return Observer(base.network, name, neighbours)


class _Recording:
    """Transitions of one episode, seen by an observer; agents have the observer's names."""

    def __init__(self, env: AnyParallelEnv, observer: Observer, seed: int, infos: Infos) -> None:
        self._base = as_traffic_env(env)
        self._observer = observer
        self._recorder = TransitionRecorder(provenance_of(env, observer, seed))
        self._names = dict(zip(self._base.possible_agents, observer.agents, strict=True))
        self._seen = self._look()
        self._before = self._base.seen
        self._masks = self._masks_of(infos)
        self._step = 0

    def add(self, actions: Actions, rewards: Mapping[str, float], infos: Infos) -> None:
        then = self._look()
        self._refuse_other_greens()
        executed = {agent: int(infos[agent]["executed_action"]) for agent in self._names}
        if self._base.options.signals == "programme":
            actions = executed  # nobody asks a programme, so what it runs is what was asked for
        delay_s = {agent: float(infos[agent].get("delay_s", 0.0)) for agent in self._names}
        self._recorder.record(
            episode=0,
            step=self._step,
            observations=self._seen,
            actions=self._renamed(actions),
            executed=self._renamed(executed),
            rewards=self._renamed(rewards),
            next_observations=then,
            delays_s=self._renamed(delay_s),
            served=self._served(),
            masks=self._masks,
        )
        self._seen = then
        if self._base.agents:
            self._masks = self._masks_of(infos)
        self._step += 1

    def log(self) -> TransitionLog:
        return self._recorder.log()

    def _refuse_other_greens(self) -> None:
        """Refuse decisions in which a programme shows a green that no action means."""
        phases = dict(zip(self._base.possible_agents, self._base.phases, strict=True))
        if lost := [agent for agent, phase in phases.items() if phase < 0]:
            raise OptionError(
                f"scenario {self._base.scenario.id!r}: the programme of {lost[0]!r} shows a green "
                "that is none of its phases, so no action can be recorded for it; set "
                'control.phases = "programme", or record another policy'
            )

    def _served(self) -> dict[str, NDArray[np.float32]] | None:
        """Return the last decision's features minus the mean number of vehicles that left since.

        Return None if the simulation does not count them, or if the features are waiting times.
        """
        before, self._before = self._before, self._base.seen
        left = self._before.mean_left
        if not len(left) or self._observer.needs_waiting:  # vehicles that left tell no waiting time
            return None
        vectors = self._observer.observe(before.less(left), self._base.phases)
        agent_vectors = zip(self._observer.agents, vectors, self._observer.layouts, strict=True)
        return {agent: vector[: layout.features] for agent, vector, layout in agent_vectors}

    def _look(self) -> dict[str, NDArray[np.float32]]:
        vectors = self._observer.observe(self._base.seen, self._base.phases)
        return dict(zip(self._observer.agents, vectors, strict=True))

    def _masks_of(self, infos: Infos) -> dict[str, Any]:
        return self._renamed({agent: infos[agent]["action_mask"] for agent in self._names})

    def _renamed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {self._names[agent]: value for agent, value in values.items()}


def provenance_of(env: AnyParallelEnv, observer: Observer, *seeds: int) -> Provenance:
    """Return the provenance of a log recorded in `env` (wrapped or not) through `observer`."""
    base = as_traffic_env(env)
    return Provenance(
        scenario=base.scenario.id,
        scenario_hash=base.scenario.hash,
        domain=base.domain,
        seeds=seeds,
        decision_interval_s=base.decision_interval_s,
        observation=observer.name,
        layouts=dict(zip(observer.agents, observer.layouts, strict=True)),
        versions={name: installed_version(name) or "not installed" for name in SIMULATING},
        units={
            "observation": OBSERVATION_UNITS.get(observer.name, "as the function returns them"),
            "reward": str(base.options.reward),
        },
    )


class EpsilonGreedy:
    """Policy that replaces each agent's action by a random permitted phase with chance ε.

    Roll-outs for D_sim and D_real need actions that the policy would not take; otherwise f and h
    never see their results.

    Args:
        policy: The policy that chooses the other actions.
        epsilon: Chance of a random phase, in [0, 1].
    """

    def __init__(self, policy: Policy, epsilon: float) -> None:
        self._policy = policy
        self._epsilon = epsilon
        self.env_options: Mapping[str, Any] = policy.env_options
        self._generator = numpy_generator(0)

    def reset(self, seed: int) -> None:
        """Begin an episode; `seed` decides which actions are replaced."""
        self._policy.reset(seed)
        self._generator = numpy_generator(seed, "exploring")

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the policy's actions, some of them replaced."""
        actions = dict(self._policy.act(observations, infos))
        draws = self._generator.random(len(actions))
        for agent, draw in zip(sorted(actions), draws, strict=True):
            if draw < self._epsilon:
                permitted = np.flatnonzero(infos[agent]["action_mask"])
                actions[agent] = int(self._generator.choice(permitted))
        return actions
