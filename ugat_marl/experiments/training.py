"""Training of one policy: episode by episode in an environment, or grounded by UGAT.

`train_through` is every training without grounding: it goes on from where the learner is and stops
wherever the policy is to be judged. `train_grounded` is Algorithm 1 between two worlds.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ugat_marl.data import Run
from ugat_marl.effects import Domain, describe, in_domain
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.grounding import (
    CHUNK,
    MATCHED_REWARD,
    Placebo,
    Probe,
    ShuffledWorld,
    SimulatedWorld,
    State,
    Ugat,
    UgatConfig,
    World,
    answer_with_noise,
    neighbours_of,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import EpisodeCallback, Learner, LearnerFactory, NetworkPolicy, Policy
from ugat_marl.scenarios import Scenario, begins_when_asked


class Effort(NamedTuple):
    """Cost of some episodes of training.

    Attributes:
        episodes: How many.
        seconds: Time they took, in s.
        own_seconds: Processor time of this process in them, in s; the simulation has another.
    """

    episodes: int
    seconds: float
    own_seconds: float


def train_through(
    learner: Learner,
    env: AnyParallelEnv,
    marks: Iterable[int],
    seed: int,
    *,
    on_episode: EpisodeCallback | None = None,
    on_chunk: Callable[[Effort], None] | None = None,
) -> Iterator[tuple[int, Policy]]:
    """Train a learner and yield its policy at every mark.

    Args:
        learner: Fresh, or as it was saved.
        env: Where it is trained.
        marks: Numbers of episodes in its life, ascending; those it has had already count.
        seed: Root of every random choice.
        on_episode: Called after every episode.
        on_chunk: Called after every few episodes; the learner may be saved then.

    Yields:
        Mark and greedy policy.
    """
    for mark in marks:
        while learner.episodes < mark:
            chunk = min(CHUNK, mark - learner.episodes)
            begin, own = time.perf_counter(), time.process_time()
            learner.learn(env, chunk, seed, on_episode)
            effort = Effort(chunk, time.perf_counter() - begin, time.process_time() - own)
            if on_chunk is not None:
                on_chunk(effort)
        yield mark, learner.policy()


def train_grounded(
    ugat: UgatConfig,
    make: LearnerFactory,
    env: TrafficEnv,
    worlds: tuple[SimulatedWorld, World],
    seed: int,
    run: Run,
    *,
    start: Path | None = None,
    placebo: Placebo = "none",
    probe: Probe | None = None,
    device: str = "cpu",
) -> State:
    """Train by UGAT, or go on with the run, and return where it stands at the end.

    Args:
        ugat: Settings of the algorithm.
        make: Makes the learner.
        env: The simulation.
        worlds: Sources of D_sim and D_real.
        seed: Root of every random choice.
        run: Folder of metrics and checkpoints.
        start: File of a learner that has had its plain training; None to train it here, too.
        placebo: A negative control.
        probe: Measures the policy after every iteration.
        device: Where f and h are fitted.
    """
    learner = make(env, seed)
    transform = ugat.transform(env.layouts, seed, neighbours_of(env))
    if placebo == "noise":
        answer_with_noise(transform.forward, seed)
    state = State(learner, transform)
    if start is not None:
        learner.load(start)
        state.direct, state.pretrained = learner.policy(), ugat.pretrain_episodes
    state.restore(run, NetworkPolicy.load)
    sim, real = worlds
    if placebo == "shuffled":
        real = ShuffledWorld(real)
    with contextlib.closing(sim), contextlib.closing(real):
        Ugat(env, sim, real, ugat, seed, run, probe, device).train(state)
    return state


def check_worlds(scenario: Scenario, sim: Domain, real: Domain, timed: bool = False) -> None:
    """Check that observations and rewards are the same in two worlds.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        timed: Whether greens are to be delayed: one that begins a decision later than it was asked
            for has no delay that could be told, or executed.

    Raises:
        UnknownNameError: No such domain.
        OptionError: Agents look farther in one of them, or greens begin too late to be delayed.
    """
    here, there = (in_domain(scenario, world) for world in (sim, real))
    for world in (here, there) if timed else ():
        timing, interval_s = world.timing, world.control.decision_interval_s
        if not begins_when_asked(timing, interval_s):
            raise OptionError(
                "timed grounding delays a green in the decision that asks for it, and here some "
                f"begin later: decision_interval_s = {interval_s:g} must be "
                f"longer than yellow_s + all_red_s = {timing.clearance_s:g} by min_green_s = "
                f"{timing.min_green_s:g} or more; change them in scenario.toml, or use the "
                "grounding phase"
            )
    here_m, there_m = here.control.reach_m, there.control.reach_m
    if here_m != there_m:
        raise OptionError(
            f"agents look {here_m:g} m upstream in {describe(sim)!r} and {there_m:g} m in "
            f"{describe(real)!r}, so that counts and rewards are not the same; give both the same "
            "reach, such as +reach=100"
        )


def simulated_worlds(
    scenario: Scenario,
    sim: Domain,
    real: Domain,
    ugat: UgatConfig,
    options: Mapping[str, Any],
    workers: Workers = None,
) -> tuple[SimulatedWorld, SimulatedWorld]:
    """Return the sources of D_sim and D_real if both worlds can be played.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        ugat: How often is rolled out, and whether greens are delayed by chance.
        options: Of both environments.
        workers: As for `SimulatedWorld`.

    Raises:
        OptionError: As `check_worlds`, or rewards that cannot be matched.
    """
    check_worlds(scenario, sim, real, ugat.grounding == "timed")
    reward = options.get("reward", MATCHED_REWARD)
    if ugat.matches and reward != MATCHED_REWARD:
        raise OptionError(
            f"timed match compares mean rewards of the kind {MATCHED_REWARD!r}, not {reward!r}; "
            "leave one of the two options out"
        )

    def world(domain: Domain, name: str, episodes: int, most_delay_s: int = 0) -> SimulatedWorld:
        crossings = ugat.most_delay_s > 0  # they tell best when a green began
        make = partial(parallel_env, scenario, domain, crossings=crossings, **options)
        return SimulatedWorld(make, name, episodes, ugat.rollout_epsilon, most_delay_s, workers)

    return (
        world(sim, "sim", ugat.sim_rollouts, ugat.most_delay_s),
        world(real, "real", ugat.real_rollouts),
    )
