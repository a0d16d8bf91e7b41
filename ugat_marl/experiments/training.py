"""Training of one policy: episode by episode in an environment, or grounded by UGAT.

`train_through` trains without grounding. It continues from the learner's current episode and stops
at each mark for an evaluation. `train_grounded` trains across a gap: by Algorithm 1 of the UGAT
paper, or in a fitted street.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ugat_marl.data import Run
from ugat_marl.effects import (
    ControllerPart,
    Domain,
    controller_effects,
    domain_label,
    scenario_in_domain,
)
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.grounding import (
    CHECKPOINT_EPISODES,
    DIRECT_LEARNER,
    MATCHED_REWARDS,
    LaneView,
    NegativeControl,
    Probe,
    Rival,
    RunState,
    ShuffledWorld,
    SimulatedWorld,
    Simulation,
    StreetFit,
    StreetTraining,
    TransitionSource,
    Ugat,
    UgatConfig,
    answer_with_noise,
    is_kept,
    neighbours_of,
    street_prior,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import (
    EpisodeCallback,
    Learner,
    LearnerFactory,
    NamedRule,
    NetworkPolicy,
    Policy,
    rule_in,
)
from ugat_marl.scenarios import Scenario, green_begins_at_once


class TrainingCost(NamedTuple):
    """Cost of some episodes of training.

    Attributes:
        episodes: Number of episodes.
        seconds: Time of these episodes, in s.
        own_seconds: Processor time of this process, in s; the simulation runs in another process.
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
    on_chunk: Callable[[TrainingCost], None] | None = None,
) -> Iterator[tuple[int, Policy]]:
    """Train a learner and yield its policy at every mark.

    Args:
        learner: A fresh learner, or one read from a file.
        env: Environment of the training.
        marks: Numbers of training episodes, ascending; earlier episodes of the learner count.
        seed: Root of every random choice.
        on_episode: Called after every episode.
        on_chunk: Called after at most `CHECKPOINT_EPISODES` episodes, to save the learner.

    Yields:
        The mark and the greedy policy.
    """
    for mark in marks:
        while learner.episodes < mark:
            chunk = min(CHECKPOINT_EPISODES, mark - learner.episodes)
            begin, cpu_begin = time.perf_counter(), time.process_time()
            learner.learn(env, chunk, seed, on_episode)
            effort = TrainingCost(
                chunk, time.perf_counter() - begin, time.process_time() - cpu_begin
            )
            if on_chunk is not None:
                on_chunk(effort)
        yield mark, learner.policy()


def train_grounded(
    ugat: UgatConfig,
    make: LearnerFactory,
    env: TrafficEnv,
    worlds: tuple[SimulatedWorld, TransitionSource],
    seed: int,
    run: Run,
    *,
    start: Path | None = None,
    negative_control: NegativeControl = "none",
    probe: Probe | None = None,
    device: str = "cpu",
    workers: Workers = None,
) -> RunState[Any]:
    """Train by UGAT or in a fitted street, or resume the run, and return the final state.

    Args:
        ugat: Settings of the algorithm.
        make: Makes the learner.
        env: The simulation.
        worlds: Sources of D_sim and D_real.
        seed: Root of every random choice.
        run: Folder of metrics and checkpoints.
        start: File of a learner after plain training; None to do plain training here.
        negative_control: A negative control.
        probe: Measures the policy after every iteration.
        device: Device for the fits of f and h.
        workers: Simulations at a time, or an executor, for worlds of a fitted street.

    Raises:
        OptionError: The negative control does not fit the grounding.
    """
    sim, real = worlds
    if negative_control == "shuffled":
        real = ShuffledWorld(real)
    common: dict[str, Any]
    common = {"env": env, "real": real, "config": ugat, "seed": seed, "run": run, "probe": probe}
    algorithm: Ugat | StreetTraining
    if ugat.grounding == "street":
        if negative_control == "noise":
            raise OptionError('negative control "noise" needs f; grounding "street" has none')
        if negative_control == "shuffled":
            raise OptionError(
                'negative control "shuffled" leaves no histories, from which grounding "street" '
                'is read; use "same-world"'
            )
        algorithm = street_training(make, workers, device=device, **common)
        residual = ugat.residual(env.recorded_layouts, seed, neighbours_of(env))
        rivals = _rivals(make, env, real, ugat, seed, start or run.directory / DIRECT_LEARNER)
        fitted: Any = StreetFit(street_prior(env, ugat.street), residual=residual, rivals=rivals)
        renew = algorithm.renew
    else:
        fitted = ugat.transform(env.recorded_layouts, seed, neighbours_of(env))
        if negative_control == "noise":
            answer_with_noise(fitted.forward, seed)
        algorithm, renew = Ugat(sim=sim, device=device, **common), _keep
    state = RunState(make(env, seed), fitted)
    if start is not None:
        state.learner.load(start)
        state.direct, state.pretrained = state.learner.policy(), ugat.pretrain_episodes
    state.restore(run, _policy_reader(make, env), renew)
    algorithm.train(state)
    return state


def _rivals(
    make: LearnerFactory,
    env: TrafficEnv,
    real: TransitionSource,
    config: UgatConfig,
    seed: int,
    start: Path,
) -> tuple[Rival, ...]:
    """Return the rivals; none if the learner cannot be saved, or if rewards cannot be matched.

    A learner that cannot be saved cannot begin where plain training ended. Rewards are matched only
    where one policy acts in both worlds, and with rewards that fall with every delay.
    """
    matches = real.replay() is None and str(env.options.reward) in MATCHED_REWARDS
    every = config.street.late_s if matches else ()
    rivals = (Rival(make(env, seed), start, late_s) for late_s in every)
    return tuple(rival for rival in rivals if is_kept(rival.learner))


def _policy_reader(make: LearnerFactory, env: TrafficEnv) -> Callable[[Path], Policy]:
    """Return the function that reads policies of a learner, and rules, from a checkpoint."""
    own = getattr(make, "read_policy", None)  # makers of users' learners have it
    learned = (
        NetworkPolicy.load if own is None else partial(own, partial(parallel_env, env.scenario))
    )

    def read(path: Path) -> Policy:
        spec = rule_in(path)
        return learned(path) if spec is None else NamedRule(spec, env)

    return read


def _keep(_state: RunState[Any]) -> None:
    """Leave the learner as it is."""


def street_training(make: LearnerFactory, workers: Workers, **common: Any) -> StreetTraining:
    """Return the training in a fitted street.

    Args:
        make: Makes the learner.
        workers: Simulations at a time, or an executor.
        **common: Attributes of `Algorithm`.
    """
    env: TrafficEnv = common["env"]
    options = {
        field.name: getattr(env.options, field.name)
        for field in fields(env.options)
        if field.name != "crossings"
    }
    simulation = Simulation(env.scenario, options, common["config"].rollout_epsilon, workers)
    view = LaneView.of(env.network, str(env.options.observation))
    return StreetTraining(simulation=simulation, make=make, view=view, **common)


def check_worlds(
    scenario: Scenario,
    sim: Domain,
    real: Domain,
    timed: bool = False,
    *,
    duration_s: float | None = None,
) -> None:
    """Check that observations and rewards are the same in two worlds.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        timed: True if greens are delayed, by timed grounding or a timed residual: every green must
            begin in the decision that asks for it, or its delay can be neither measured nor set.
        duration_s: Length of an episode in s; None for that of each world.

    Raises:
        UnknownNameError: A domain does not exist.
        OptionError: The reaches differ, greens begin too late to be delayed, or a domain is one of
            detectors.
    """
    here, there = (
        scenario_in_domain(scenario, world, duration_s=duration_s) for world in (sim, real)
    )
    for world in (here, there) if timed else ():
        timing, interval_s = world.timing, world.control.decision_interval_s
        if not green_begins_at_once(timing, interval_s):
            raise OptionError(
                "timed grounding delays a green in the decision that asks for it, and here some "
                f"begin later: decision_interval_s = {interval_s:g} must be "
                f"longer than yellow_s + all_red_s = {timing.clearance_s:g} by min_green_s = "
                f"{timing.min_green_s:g} or more; change them in scenario.toml, or use the "
                "grounding phase, or street with a residual of another kind"
            )
    here_m, there_m = here.control.reach_m, there.control.reach_m
    if here_m != there_m:
        raise OptionError(
            f"agents look {here_m:g} m upstream in {domain_label(sim)!r} and {there_m:g} m in "
            f"{domain_label(real)!r}, so that counts and rewards are not the same; give both the "
            "same reach, such as +reach=100"
        )


def _refuse_own_channel(scenario: Scenario, sim: Domain, duration_s: float | None) -> None:
    """Refuse a simulation that changes commands, beside a fitted channel that changes them, too.

    Raises:
        OptionError: The simulation does.
    """
    effects = controller_effects(scenario_in_domain(scenario, sim, duration_s=duration_s))
    own = [str(item) for item in effects if type(item).actuator is not ControllerPart.actuator]
    if own:
        raise OptionError(
            f"sim = {domain_label(sim)!r} changes commands ({', '.join(own)}), and the channel of "
            "a fitted street would change them once more; leave these effects out of the "
            "simulation, or the channel out of the fit (--street.parts eyes service effects)"
        )


def simulated_worlds(
    scenario: Scenario,
    sim: Domain,
    real: Domain,
    ugat: UgatConfig,
    options: Mapping[str, Any],
    workers: Workers = None,
) -> tuple[SimulatedWorld, SimulatedWorld]:
    """Return the sources of D_sim and D_real if both domains can be simulated.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        ugat: Settings of the algorithm: numbers of roll-outs and random delays.
        options: Options of both environments.
        workers: Simulations at a time, or an executor, see `SimulatedWorld`.

    Raises:
        OptionError: `check_worlds` fails, the rewards cannot be matched, commands would be changed
            twice, or a domain is SUMO's queue model and the grounding needs crossings.
    """
    duration_s = options.get("duration_s")
    timed = max(ugat.most_delay_s, ugat.residual_delay_s) > 0
    check_worlds(scenario, sim, real, timed, duration_s=duration_s)
    if ugat.grounding == "street" and "channel" in ugat.street.parts:
        _refuse_own_channel(scenario, sim, duration_s)
    # crossing vehicles show best when a green began, and how fast it serves
    crossings = ugat.most_delay_s > 0 or ugat.grounding == "street"
    for domain in (sim, real) if crossings and ugat.iterations else ():
        if scenario_in_domain(scenario, domain, duration_s=duration_s).settings.is_mesoscopic:
            raise OptionError(
                f"the grounding {ugat.grounding} needs to know when vehicles cross the stop lines, "
                f"and SUMO's queue model ({domain_label(domain)!r}) cannot tell; use the grounding "
                "phase, or no iterations"
            )
    reward = options.get("reward", MATCHED_REWARDS[0])
    if ugat.matches and reward not in MATCHED_REWARDS:
        raise OptionError(
            f"timed match compares mean rewards that are queues ({', '.join(MATCHED_REWARDS)}), "
            f"not {reward!r}; "
            "leave one of the two options out"
        )

    def world(domain: Domain, name: str, episodes: int, most_delay_s: int = 0) -> SimulatedWorld:
        given = {"crossings": crossings, **options}
        make = partial(parallel_env, scenario, domain, **given)
        return SimulatedWorld(make, name, episodes, ugat.rollout_epsilon, most_delay_s, workers)

    return (
        world(sim, "sim", ugat.sim_rollouts, ugat.most_delay_s),
        world(real, "real", ugat.real_rollouts),
    )
