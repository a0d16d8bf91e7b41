"""Sources of transitions: roll-outs in a domain, or a log of the real domain."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import Scores, TransitionLog, Transitions
from ugat_marl.effects import Domain
from ugat_marl.envs import (
    Actions,
    AnyParallelEnv,
    Infos,
    Observations,
    Observer,
    TrafficEnv,
    parallel_env,
)
from ugat_marl.errors import LogError
from ugat_marl.grounding.fitting import FitConfig, split
from ugat_marl.grounding.stacked import Stack, stack_log
from ugat_marl.grounding.view import InputsConfig, View, neighbours_of
from ugat_marl.grounding.wrappers import RandomDelays
from ugat_marl.parallel import Stop, Workers, in_order, retry_on_crash
from ugat_marl.policies import (
    EpsilonGreedy,
    Policy,
    PolicyFactory,
    observer_of,
    roll_out,
    stop_callback,
)
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed

EPISODES_PER_DELAY = 2
"""Roll-outs for each delay; at least two are needed to measure their scatter."""


class TransitionSource(Protocol):
    """A source of transitions."""

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Return the transitions this iteration adds; None if there are no more."""
        ...

    def replay(self) -> Policy | None:
        """Return a policy that repeats the commands; None if the policy of `collect` acted."""
        ...

    def stop(self) -> None:
        """End a `collect` that runs in another thread; it raises `RollOutStopped`."""
        ...


class SimulatedWorld:
    """Roll-outs in a domain.

    Args:
        make_env: Function that makes an environment of the domain; options of the policy are added.
        name: Name that separates the seeds of two worlds.
        episodes: Number of roll-outs per iteration.
        epsilon: Chance of a random phase.
        most_delay_s: Longest random delay of greens, in s; 0 for none.
        workers: Roll-outs at a time, or an executor; each roll-out has its own environment.
    """

    def __init__(
        self,
        make_env: Callable[..., TrafficEnv],
        name: str,
        episodes: int,
        epsilon: float,
        most_delay_s: int = 0,
        workers: Workers = None,
    ) -> None:
        self._make_env = make_env
        self._name = name
        self._episodes = episodes
        self._epsilon = epsilon
        self._most_delay_s = most_delay_s
        self._workers = workers
        self._stop = Stop()

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Run the iteration's episodes and return their transitions."""
        seeds = [
            derive_seed(seed, "roll-out", self._name, iteration, episode)
            for episode in range(self._episodes)
        ]
        parts: list[tuple[int, int | None]] = [(one, None) for one in seeds]
        return TransitionLog.concatenate(self._played_by(policy, parts))

    def under_delays(
        self, policy: Policy, iteration: int, seed: int, on_done: Callable[[], object]
    ) -> list[TransitionLog]:
        """Run roll-outs in which all greens have the same delay, for 0, 1, ... `most_delay_s` s.

        There are `EPISODES_PER_DELAY` roll-outs for each delay. Each has its own traffic, because
        one busy hour would make all delays look short.

        Args:
            policy: Policy that acts.
            iteration: Number of the iteration; it decides the seeds, with `seed`.
            seed: Root seed, as for `collect`.
            on_done: Function called after each roll-out.
        """

        def play(pairs: Sequence[tuple[int, int]]) -> list[TransitionLog]:
            root = seed, "matching", self._name, iteration
            parts = [(derive_seed(*root, *pair), pair[0]) for pair in pairs]
            return self._played_by(policy, parts, on_done)

        return under_each_delay(self._most_delay_s, play)

    @property
    def roll_outs_under_delays(self) -> int:
        """Number of roll-outs of `under_delays`."""
        return episodes_under_delays(self._most_delay_s)

    def _played_by(
        self,
        policy: Policy,
        parts: Sequence[tuple[int, int | None]],
        on_done: Callable[[], object] = lambda: None,
    ) -> list[TransitionLog]:
        """Run a roll-out for each pair of seed and constant delay; return logs in this order."""
        alone = _RollOutAlone(self._make_env, self._most_delay_s, policy, self._epsilon)
        self._stop = stop = Stop()
        given = [(*part, stop) for part in parts]
        return in_order(self._workers, alone.play, given, stop, lambda _: on_done())

    def replay(self) -> Policy | None:
        """Return None: the policy that is given to `collect` acts."""
        return None

    def stop(self) -> None:
        """Stop the running roll-outs; later ones begin as usual."""
        self._stop.set()


def episodes_under_delays(most_delay_s: int) -> int:
    """Return the number of episodes of `under_each_delay`."""
    return EPISODES_PER_DELAY * (most_delay_s + 1)


def under_each_delay(
    most_delay_s: int, play: Callable[[Sequence[tuple[int, int]]], Sequence[TransitionLog]]
) -> list[TransitionLog]:
    """Return a log of `EPISODES_PER_DELAY` episodes for each delay of 0, 1, ... `most_delay_s` s.

    Args:
        most_delay_s: Longest delay of all greens, in s.
        play: Runs an episode for each pair of delay and number; returns their logs in this order.
    """
    size = EPISODES_PER_DELAY
    logs = play([(late, episode) for late in range(most_delay_s + 1) for episode in range(size)])
    return [TransitionLog.concatenate(logs[k : k + size]) for k in range(0, len(logs), size)]


def _for_policy(make_env: Callable[..., TrafficEnv], policy: Policy) -> Callable[[], TrafficEnv]:
    """Return a function that makes environments in which a policy sees the commands it needs."""
    commands = int(policy.env_options.get("commands", 0))
    return partial(make_env, commands=commands) if commands else make_env


def delayed(env: TrafficEnv, most_delay_s: int, always_s: int | None = None) -> AnyParallelEnv:
    """Return an environment with `RandomDelays`, or as it is if `most_delay_s` is 0."""
    return RandomDelays(env, most_delay_s, always_s) if most_delay_s else env


def recorded(
    env: AnyParallelEnv,
    policy: Policy,
    seed: int,
    stop: Stop,
    observer: Observer | None = None,
    decisions: int | None = None,
) -> TransitionLog:
    """Run an episode of a policy and return its transitions; a simulation that dies begins again.

    Args:
        env: The environment.
        policy: The policy.
        seed: Seed of the episode.
        stop: Flag that ends the episode early.
        observer: What is recorded; None for what agents observe.
        decisions: Most decisions of the episode; None for all.
    """
    observer, check = observer or observer_of(env), stop_callback(stop)
    played = retry_on_crash(
        lambda: roll_out(env, policy, seed, record=observer, on_step=check, decisions=decisions)
    )
    assert played.log is not None
    return played.log


def explored(
    env: AnyParallelEnv, policy: Policy, epsilon: float, seed: int, stop: Stop
) -> TransitionLog:
    """Run an episode of a policy that explores, as `recorded`, and close the environment.

    The policy is copied: policies with a memory must not share it between threads. An episode of
    recorded commands is no longer than the recording: its last command would be held for the rest,
    and lanes with red would jam. What is before the recording is left out of its log.

    Args:
        env: The environment.
        policy: The policy.
        epsilon: Chance of a random phase.
        seed: Seed of the episode.
        stop: Flag that ends the episode early.
    """
    exploring = EpsilonGreedy(copy.deepcopy(policy), epsilon)
    with contextlib.closing(env):
        if not isinstance(policy, RecordedCommands):
            return recorded(env, exploring, seed, stop)
        decisions = policy.decisions(seed)
        log = recorded(env, exploring, seed, stop, decisions=decisions)
        return log.since(policy.lead(seed))


@dataclass(frozen=True)
class _RollOutAlone:
    """Roll-outs that each have their own environment, in any process.

    Attributes:
        make_env: Function that makes an environment of the domain.
        most_delay_s: Longest random delay of greens, in s; 0 for none.
        policy: Policy that acts.
        epsilon: Chance of a random phase.
    """

    make_env: Callable[..., TrafficEnv]
    most_delay_s: int
    policy: Policy
    epsilon: float

    def play(self, seed: int, always_s: int | None, stop: Stop) -> TransitionLog:
        """Run one roll-out, with random delays or with the constant delay `always_s`."""
        env = delayed(_for_policy(self.make_env, self.policy)(), self.most_delay_s, always_s)
        return explored(env, self.policy, self.epsilon, seed, stop)


@dataclass(frozen=True)
class RollOutSettings:
    """Common settings of roll-outs; sent to every process that runs one.

    Attributes:
        scenario: The network and its traffic.
        domain: Domain of the roll-outs.
        options: Options of the environment; those that the policy needs are added.
        make: Function that makes the policy of a roll-out; policies without a memory may be shared.
        epsilon: Chance of a random phase.
        observation: Name of the recorded observation.
        neighbours: Distance in roads up to which other intersections are recorded, too.
    """

    scenario: Scenario
    domain: Domain
    options: Mapping[str, Any]
    make: PolicyFactory
    epsilon: float
    observation: str
    neighbours: int = 0

    def play(self, seed: int, stop: Stop) -> tuple[TransitionLog, Scores]:
        """Run one episode in its own environment; return its transitions and scores."""
        probe = parallel_env(self.scenario, self.domain, **self.options)
        policy = self.make(probe)
        options = {**self.options, **policy.env_options}
        env = parallel_env(self.scenario, self.domain, **options)
        observer = observer_of(env, self.observation, self.neighbours)
        exploring = EpsilonGreedy(policy, self.epsilon)
        with contextlib.closing(env):
            return recorded(env, exploring, seed, stop, observer), env.scores()


def roll_outs(
    each: RollOutSettings,
    seeds: Sequence[int],
    *,
    workers: Workers = None,
    reporter: Reporter | None = None,
    title: str = "rolling out",
) -> tuple[TransitionLog, tuple[Scores, ...]]:
    """Run episodes, several at a time, and record them in the order of their seeds.

    Args:
        each: Common settings of the roll-outs.
        seeds: One seed for each episode.
        workers: Number of simulations at a time; None for the number of cores; or an executor.
        reporter: Display of the progress.
        title: Name of the work in this display.

    Returns:
        All transitions, and the scores of every episode.
    """
    stop = Stop()
    with (reporter or Silent()).task(title, len(seeds)) as advance:
        parts = [(seed, stop) for seed in seeds]
        played = in_order(
            workers,
            each.play,
            parts,
            stop,
            lambda done: advance(note=f"ATT {done[1].att_s:.0f} s"),
        )
    logs, scores = zip(*played, strict=True)
    return TransitionLog.concatenate(list(logs)), tuple(scores)


class RecordedCommands:
    """Policy that repeats the commands of a log, decision by decision.

    Each episode repeats one in which every agent has a command. A decision that the log lacks
    repeats the command before it. After the last decision, the last command stays. A log that
    begins later than its scenario is led up to by its own first commands: the streets are then full
    when it begins.

    Args:
        log: The transitions.
        longest: Most decisions of an episode; what the log has beyond them is left out. None for
            as many as it needs.

    Attributes:
        interval_s: Seconds from one decision to the next.
        longest_lead_s: Seconds before the latest begin of an episode of the log.

    Raises:
        LogError: No episode of the log has commands of every agent, or one begins where episodes
            of `longest` decisions end.
    """

    def __init__(self, log: TransitionLog, longest: int | None = None) -> None:
        self.env_options: Mapping[str, Any] = {"observation": log.provenance.observation}
        rows = {agent: log.transitions(agent) for agent in log.agents}
        whole = set[int].intersection(*(set(own.episode.tolist()) for own in rows.values()))
        if not whole:
            alone = [agent for agent, own in rows.items() if not len(own)]
            raise LogError(
                "commands of the log cannot be repeated: no episode has a decision of every "
                f"agent{'; no row of ' + ', '.join(alone) if alone else ''}"
            )
        begins = {
            episode: min(int(own.step[own.episode == episode].min()) for own in rows.values())
            for episode in sorted(whole)
        }
        if not log.provenance.from_begin:
            begins = dict.fromkeys(begins, 0)
        self._leads: list[int] = []
        self._lengths: list[int] = []
        self._commands: list[Mapping[str, NDArray[np.int64]]] = []
        for episode, first in begins.items():
            commands = {agent: _commands_of(own, episode, first) for agent, own in rows.items()}
            self._leads.append(first)
            self._lengths.append(max(map(len, commands.values())))
            led_up = {agent: _led_up(own, first)[:longest] for agent, own in commands.items()}
            self._commands.append(led_up)
        self.interval_s = interval_s = log.provenance.decision_interval_s
        self.longest_lead_s = max(self._leads) * interval_s
        self._numbers = list(begins)
        every = log.frame["episode"].unique().sort().to_list()
        self._lead_of = {every.index(episode): lead for episode, lead in begins.items()}
        if longest is not None and max(self._leads) >= longest:
            late = self._numbers[int(np.argmax(self._leads))]
            raise LogError(
                f"episode {late} of the log begins {self.longest_lead_s:g} s after its scenario, "
                f"and episodes end after {longest * interval_s:g} s: choose a longer --duration-s "
                "(duration_s), or leave that episode out"
            )
        self.reset(0)

    def lead(self, seed: int) -> int:
        """Return the number of decisions before the episode of the log that `seed` chooses."""
        return self._leads[seed % len(self._leads)]

    def decisions(self, seed: int) -> int:
        """Return the number of decisions of that episode, with those before it."""
        return max(map(len, self._chosen(seed).values()))

    def left(self, longest: int) -> list[tuple[int, int, int]]:
        """Return number, decisions, and decisions of the simulation that are left, per episode.

        Args:
            longest: Decisions of an episode of the simulation.
        """
        each = zip(self._numbers, self._lengths, self._leads, strict=True)
        return [(number, length, longest - lead) for number, length, lead in each]

    def within(self, log: TransitionLog, longest: int) -> TransitionLog:
        """Return the decisions of a log that episodes of the simulation reach.

        Args:
            log: The log whose commands are repeated, with steps counted from 0.
            longest: Decisions of an episode of the simulation.
        """
        number = pl.col("episode").rank("dense").cast(pl.Int64) - 1
        lead = number.replace_strict(self._lead_of, default=0, return_dtype=pl.Int64)
        return TransitionLog(log.provenance, log.frame.filter(pl.col("step") + lead < longest))

    def reset(self, seed: int) -> None:
        """Begin an episode of the log; `seed` chooses it."""
        self._episode, self._step = self._chosen(seed), 0

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the commands of the next decision of the log."""
        commands = self._episode
        step, self._step = self._step, self._step + 1
        return {
            name: int(commands[name][min(step, len(commands[name]) - 1)]) for name in observations
        }

    def _chosen(self, seed: int) -> Mapping[str, NDArray[np.int64]]:
        return self._commands[seed % len(self._commands)]


def _led_up(commands: NDArray[np.int64], lead: int) -> NDArray[np.int64]:
    """Return commands behind as many of their own first ones."""
    return np.concatenate((commands[np.arange(lead) % len(commands)], commands))


def _commands_of(own: Transitions, episode: int, first: int) -> NDArray[np.int64]:
    """Return an agent's command at each decision of an episode from one on, ``(decisions,)``."""
    here = own.episode == episode
    steps, commands = own.step[here] - first, own.action[here]
    before = np.searchsorted(steps, np.arange(steps[-1] + 1), side="right") - 1
    return commands[np.maximum(before, 0)]


class RecordedWorld:
    """World that consists of a recorded log; nothing is simulated.

    Args:
        log: The transitions.
        env: Simulation to compare them with.
        held_out_every: Held-out share, as in `FitConfig`.
        inputs: Inputs of the models that are fitted to the log; None if there are no models.

    Attributes:
        longest: Decisions of an episode of the simulation.

    Raises:
        LogError: The log's agents, observation or decision interval are not those of `env`, there
            are too few rows to fit anything to, or models see neighbours that were recorded at
            other times.
    """

    def __init__(
        self,
        log: TransitionLog,
        env: TrafficEnv,
        held_out_every: int = FitConfig.held_out_every,
        inputs: InputsConfig | None = None,
    ) -> None:
        provenance = log.provenance
        for fact, given, wanted in (
            ("agents", list(provenance.layouts), list(env.recorded_layouts)),
            ("observation", provenance.observation, env.options.observation),
            *(
                (f"sizes at {agent}", provenance.layouts.get(agent), layout)
                for agent, layout in env.recorded_layouts.items()
            ),
            ("decision interval", provenance.decision_interval_s, env.decision_interval_s),
        ):
            if given != wanted:
                raise LogError(
                    f"{fact} of the real log: {given}, of the simulation: {wanted}; record it on "
                    f"{env.scenario.id!r} with the same options, or train with those of the log "
                    "(--observation count --learner dqn, for example)"
                )
        stack = Stack(env.recorded_layouts)
        self._log = log.from_step_0()
        self._given = log if provenance.from_begin else self._log
        seconds = env.options.duration_s or env.scenario.settings.duration_s
        self.longest = int(seconds / provenance.decision_interval_s + 1e-9)
        # These raise now, not after hours.
        data = stack_log(self._log, stack)
        split(data, held_out_every, stack)
        if inputs is not None:
            View(stack, near=inputs.near(stack.agents, neighbours_of(env))).of(data)

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Return the whole log at the first iteration, nothing afterwards."""
        return self._log if iteration == 0 else None

    def replay(self) -> RecordedCommands:
        """Return a policy that repeats the log: whoever made it, other worlds get its commands."""
        return RecordedCommands(self._given, self.longest)

    def stop(self) -> None:
        """Do nothing; `collect` returns at once."""
