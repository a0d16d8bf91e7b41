"""Where transitions come from: roll-outs in a domain, or a log of the street."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Protocol

import polars as pl

from ugat_marl.data import Scores, TransitionLog
from ugat_marl.effects import Domain
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import LogError
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_loop import split
from ugat_marl.grounding.random_delays import RandomDelays
from ugat_marl.grounding.stacked import Stack, stack_log
from ugat_marl.parallel import Stop, Workers, as_done, persistently
from ugat_marl.policies import Exploring, Policy, PolicyFactory, observer_of, roll_out, until
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed, numpy_generator

EPISODES_PER_DELAY = 2
"""The fewest that tell how much chance there is in one."""


class World(Protocol):
    """Where transitions come from."""

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """The transitions this iteration adds; None if there are no more."""
        ...

    def stop(self) -> None:
        """Ends a `collect` that is under way in another thread, with `Stopped`."""
        ...

    def close(self) -> None:
        """Gives up what the world holds."""
        ...


class SimulatedWorld:
    """Roll-outs in a domain.

    Args:
        make_env: Makes an environment of the domain.
        name: Distinguishes the seeds of two worlds.
        episodes: Roll-outs per iteration.
        epsilon: Chance of a random phase.
        most_delay_s: Longest of the random delays of greens; 0 for none.
        workers: An executor that plays each roll-out in an environment of its own; anything else:
            those of `collect` one after the other here, in one environment.
    """

    def __init__(
        self,
        make_env: Callable[[], TrafficEnv],
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
        self._env: AnyParallelEnv | None = None
        self._stop = Stop()

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Plays the iteration's episodes and returns their transitions."""
        seeds = [
            derive_seed(seed, "roll-out", self._name, iteration, episode)
            for episode in range(self._episodes)
        ]
        if isinstance(self._workers, Executor):
            logs = self._played_by(self._workers, policy, [(s, None) for s in seeds])
            return TransitionLog.concatenate(logs)
        if self._env is None:
            self._env = _delayed(self._make_env, self._most_delay_s)
        env, exploring = self._env, Exploring(policy, self._epsilon)
        return TransitionLog.concatenate(
            [_recorded(env, exploring, s, None, self._stop) for s in seeds]
        )

    def under_delays(
        self, policy: Policy, iteration: int, seed: int, on_done: Callable[[], object]
    ) -> list[TransitionLog]:
        """Roll-outs for each delay of 0, 1, ... s up to the longest, which every green has.

        Each has traffic of its own: a busy hour would make all delays look short. There are
        `EPISODES_PER_DELAY` of each.

        Args:
            policy: Who acts.
            iteration: Decides the seeds, with `seed`.
            seed: As for `collect`.
            on_done: Called after each of `roll_outs_under_delays`.
        """
        lates = range(self._most_delay_s + 1)
        parts = [
            (derive_seed(seed, "matching", self._name, iteration, late, episode), late)
            for late in lates
            for episode in range(EPISODES_PER_DELAY)
        ]
        logs = self._played_by(self._workers, policy, parts, on_done)
        size = EPISODES_PER_DELAY
        return [TransitionLog.concatenate(logs[late * size : late * size + size]) for late in lates]

    @property
    def roll_outs_under_delays(self) -> int:
        """How many `under_delays` plays."""
        return EPISODES_PER_DELAY * (self._most_delay_s + 1)

    def _played_by(
        self,
        workers: Workers,
        policy: Policy,
        parts: Sequence[tuple[int, int | None]],
        on_done: Callable[[], object] = lambda: None,
    ) -> list[TransitionLog]:
        """Roll-outs by their seeds and constant delays, in that order."""
        stop, made = self._stop, (self._make_env, self._most_delay_s, policy, self._epsilon)
        found: dict[int, TransitionLog] = {}
        given = [(*made, *part, stop) for part in parts]
        for number, log in as_done(workers, _roll_out_alone, given, stop):
            found[number] = log
            on_done()
        self._stop = Stop()  # the other is set now, since nobody waits any more
        return [found[number] for number in range(len(parts))]

    def stop(self) -> None:
        """Ends the roll-out that is under way."""
        self._stop.set()

    def close(self) -> None:
        """Ends the simulation."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _delayed(make_env: Callable[[], TrafficEnv], most_delay_s: int) -> AnyParallelEnv:
    env = make_env()
    return RandomDelays(env, most_delay_s) if most_delay_s else env


def _recorded(
    env: AnyParallelEnv, policy: Policy, seed: int, always_s: int | None, stop: Stop
) -> TransitionLog:
    observer = observer_of(env)
    if isinstance(env, RandomDelays):
        env.always_s = always_s
    played = persistently(lambda: roll_out(env, policy, seed, record=observer, on_step=until(stop)))
    assert played.log is not None
    return played.log


def _roll_out_alone(
    make_env: Callable[[], TrafficEnv],
    most_delay_s: int,
    policy: Policy,
    epsilon: float,
    seed: int,
    always_s: int | None,
    stop: Stop,
) -> TransitionLog:
    """One roll-out in an environment of its own, wherever that is."""
    env = _delayed(make_env, most_delay_s)
    own = copy.deepcopy(policy)  # some remember their episode, and others play beside this one
    try:
        return _recorded(env, Exploring(own, epsilon), seed, always_s, stop)
    finally:
        env.close()


@dataclass(frozen=True)
class RollOut:
    """What roll-outs have in common: all that whoever plays one has to be sent.

    Attributes:
        scenario: Where.
        domain: In which domain.
        options: Of the environment; those the policy relies on are added.
        make: Makes who acts; rules remember their episode, so that each has its own.
        epsilon: Chance of a random phase.
        observation: What is recorded.
        neighbours: How many roads away intersections are recorded too.
    """

    scenario: Scenario
    domain: Domain
    options: Mapping[str, Any]
    make: PolicyFactory
    epsilon: float
    observation: str
    neighbours: int = 0

    def play(self, seed: int, stop: Stop) -> tuple[TransitionLog, Scores]:
        """Plays one episode in an environment of its own."""
        probe = parallel_env(self.scenario, self.domain, **self.options)
        policy = self.make(probe)
        options = {**self.options, **policy.env_options}
        env = parallel_env(self.scenario, self.domain, **options)
        observer = observer_of(env, self.observation, self.neighbours)
        exploring = Exploring(policy, self.epsilon)
        try:
            played = persistently(
                lambda: roll_out(env, exploring, seed, record=observer, on_step=until(stop))
            )
            assert played.log is not None
            return played.log, env.scores()
        finally:
            env.close()


def roll_outs(
    each: RollOut,
    seeds: Sequence[int],
    *,
    workers: Workers = None,
    reporter: Reporter | None = None,
    title: str = "rolling out",
) -> tuple[TransitionLog, tuple[Scores, ...]]:
    """Plays episodes, several at a time, and records them in the order of their seeds.

    Args:
        each: What they have in common.
        seeds: One for each.
        workers: Simulations at a time; None for the number of cores; or an executor.
        reporter: Shows progress.
        title: What to call the work there.

    Returns:
        All transitions, and the scores of every episode.
    """
    stop = Stop()
    found: dict[int, tuple[TransitionLog, Scores]] = {}
    with (reporter or Silent()).task(title, len(seeds)) as advance:
        parts = [(seed, stop) for seed in seeds]
        for number, (log, scores) in as_done(workers, each.play, parts, stop):
            found[number] = log, scores
            advance(note=f"ATT {scores.att_s:.0f} s")
    logs, scores = zip(*(found[number] for number in range(len(seeds))), strict=True)
    return TransitionLog.concatenate(list(logs)), tuple(scores)


class RecordedWorld:
    """A log that was measured or recorded before; no simulator stands in for the street.

    Args:
        log: The transitions.
        env: The simulation they are to be compared with.
        held_out_every: As for `FitConfig`.

    Raises:
        LogError: The log's agents, observation or decision interval are not those of `env`, or
            there are too few rows to fit anything to.
    """

    def __init__(
        self, log: TransitionLog, env: TrafficEnv, held_out_every: int = FitConfig.held_out_every
    ) -> None:
        own = log.provenance
        for what, found, wanted in (
            ("agents", list(own.layouts), list(env.layouts)),
            *(
                (f"sizes at {agent}", own.layouts.get(agent), layout)
                for agent, layout in env.layouts.items()
            ),
            ("observation", own.observation, env.options.observation),
            ("decision interval", own.decision_interval_s, env.decision_interval_s),
        ):
            if found != wanted:
                raise LogError(
                    f"the real log's {what} are {found}, the simulation's {wanted}; record it on "
                    f"{env.scenario.id!r} with the same options"
                )
        stack = Stack(env.layouts)
        split(stack_log(log, stack), held_out_every, stack)  # now rather than after hours
        self._log = log

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """The whole log at the first iteration, nothing afterwards."""
        del policy, seed
        return self._log if iteration == 0 else None

    def stop(self) -> None:
        """Nothing is under way."""

    def close(self) -> None:
        """Nothing to give up."""


class ShuffledWorld:
    """Another world whose transitions lead anywhere: a negative control.

    Among the rows of an agent, what followed is dealt out anew. Where vehicles were and what they
    did next is as it was; that one came of the other is not.

    Args:
        world: Where the transitions come from.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """The other world's transitions, shuffled."""
        log = self._world.collect(policy, iteration, seed)
        return None if log is None else shuffled(log, derive_seed(seed, "shuffled", iteration))

    def stop(self) -> None:
        """Ends what is under way in the other world."""
        self._world.stop()

    def close(self) -> None:
        """Gives up what the other world holds."""
        self._world.close()


def shuffled(log: TransitionLog, seed: int) -> TransitionLog:
    """The log with the outcomes of each agent's rows in random order.

    What is seen next and what was served belong together, and stay so; state, action and reward
    stay where they are.

    Args:
        log: Any log; it does not change.
        seed: Of the order.
    """
    outcomes = ["next_observation", "served_features"]
    parts: list[pl.DataFrame] = []
    for agent in log.agents:
        own = log.frame.filter(pl.col("agent") == agent)
        order = numpy_generator(seed, "shuffled", agent).permutation(own.height)
        parts.append(own.with_columns(own[name].gather(order) for name in outcomes))
    frame = pl.concat(parts).sort("episode", "step", maintain_order=True)
    return TransitionLog(log.provenance, frame)
