"""Evaluation of policies x domains x seeds, and races between rules."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ugat_marl.effects import Domain, domain_label
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.experiments.scores import Evaluation, Result, RuleTrial, best_rule_note
from ugat_marl.files import with_home
from ugat_marl.parallel import (
    Stop,
    Workers,
    as_done,
    in_this_process,
    parts_at_a_time,
    retry_on_crash,
)
from ugat_marl.policies import (
    RULES,
    STANDARD_RULES,
    OwnLearnerFactory,
    Policy,
    PolicyFactory,
    StepCallback,
    asked_options,
    is_own,
    load_own,
    make_rule,
    own_policy,
    parse_rule,
    race,
    roll_out,
    stop_callback,
)
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import ApproachDelays, kept_warm, measured_approaches

if TYPE_CHECKING:
    from ugat_marl.policies import NetworkPolicy

Watch = Callable[[str, str, TrafficEnv], StepCallback]
"""Maker of a callback from the name of the policy, the name of the domain and the environment. The
callback is called after each decision. Several threads call callbacks at the same time."""

TUNING_SEED = 9001
"""First seed of the search for the best rule. No result is reported on these seeds."""


@dataclass(frozen=True)
class _Task:
    name: str
    make: PolicyFactory
    world: TrafficEnv
    seeds: tuple[int, ...]
    watch: Watch | None
    approaches: bool


def require_distinct_domains(domains: Sequence[Domain]) -> None:
    """Refuse domains of which two are the same.

    Raises:
        OptionError: A domain is listed twice.
    """
    names = [domain_label(domain) for domain in domains]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise OptionError(f"domain {twice[0]!r} is listed twice (rain is V3, snow is V4, ...)")


@kept_warm()
def evaluation_of(
    scenario: Scenario,
    policies: Mapping[str, PolicyFactory],
    domains: Sequence[Domain],
    seeds: Sequence[int],
    *,
    duration_s: float | None = None,
    workers: Workers = None,
    reporter: Reporter | None = None,
    title: str = "evaluating",
    watch: Watch | None = None,
    approaches: bool = False,
) -> Evaluation:
    """Play every policy in every domain with every seed, spread over the cores.

    Args:
        scenario: The scenario.
        policies: Factories by name of the policy.
        domains: Domains; gaps are differences to the first, usually ``"sim"``.
        seeds: Seeds of the episodes, the same for all policies and domains.
        duration_s: Length of an episode in s; None for the scenario's own.
        workers: Simulations at a time; None for the number of cores; or an executor.
        reporter: Shows progress.
        title: Title of the progress bar.
        watch: Makes callbacks that observe the environments; needs workers in this process.
        approaches: True to measure the control delay on every approach (`Scores.approaches`).

    Returns:
        The scores of all episodes, as policies and domains are given, then by seed.

    Raises:
        OptionError: A domain or a seed is listed twice, or `watch` is given with an executor.
        UnknownNameError: There is no such domain or rule.
        CheckpointError: The file of a policy is unreadable, or of another network.
    """
    require_distinct_domains(domains)
    if len(set(seeds)) < len(seeds):
        raise OptionError("a seed is given twice: its episode would count twice in the intervals")
    # Made once for all policies. A wrong name is an error now, not in an hour.
    worlds = [parallel_env(scenario, domain, duration_s=duration_s) for domain in domains]
    for make in policies.values():
        make(worlds[0])  # a wrong policy is an error now, too
    if watch is not None and not in_this_process(workers):
        raise OptionError(
            "watch needs workers in this process; give a number of workers, not an executor"
        )
    episodes = len(seeds) * len(policies) * len(domains)
    per_task = max(1, episodes // (4 * parts_at_a_time(workers)))
    tasks = [
        _Task(name, make, world, tuple(seeds[start : start + per_task]), watch, approaches)
        for world in worlds
        for name, make in policies.items()
        for start in range(0, len(seeds), per_task)
    ]
    stop, results = Stop(), list[Result]()
    with (reporter or Silent()).task(title, episodes) as advance:
        for _, played in as_done(workers, _play, [(task, stop) for task in tasks], stop):
            results += played
            for _ in played:
                advance()
    pairs = ((name, domain_label(domain)) for name in policies for domain in domains)
    order = {pair: place for place, pair in enumerate(pairs)}
    results.sort(key=lambda r: (order[r.policy, r.domain], r.seed))
    return Evaluation(scenario.id, scenario.hash, tuple(results), {})


def best_rule(
    scenario: Scenario,
    domain: Domain,
    *,
    rules: Sequence[str] = STANDARD_RULES,
    seeds: Sequence[int] = (TUNING_SEED, TUNING_SEED + 1),
    duration_s: float | None = None,
    workers: Workers = None,
    reporter: Reporter | None = None,
) -> str:
    """Return the spelling of the rule with the smallest mean ATT in a domain on the tuning seeds.

    The rules are raced: after each seed the worse half drops out.

    Raises:
        OptionError: There is no rule or no seed.
    """
    trials = race_rules(
        scenario,
        domain,
        rules,
        [[seed] for seed in seeds],
        duration_s=duration_s,
        workers=workers,
        reporter=reporter,
        title=best_rule_note(domain_label(domain)),
    )
    return trials[0].spec


@kept_warm()
def race_rules(
    scenario: Scenario,
    domain: Domain,
    specs: Sequence[str],
    seeds: Sequence[Sequence[int]],
    *,
    duration_s: float | None = None,
    workers: Workers = None,
    reporter: Reporter | None = None,
    title: str = "racing",
) -> tuple[RuleTrial, ...]:
    """Race rules by successive halving: after each rung, the better half plays the next rung.

    Args:
        scenario: The scenario.
        domain: The domain.
        specs: Spellings of the rules.
        seeds: Seeds of each rung.
        duration_s: Length of an episode in s; None for the scenario's own.
        workers: Simulations at a time; None for the number of cores; or an executor.
        reporter: Shows progress.
        title: Title of the progress bar.

    Returns:
        All rules, first those of the last rung, then those that dropped out, the latest first. In
        each rung the order is by mean ATT.

    Raises:
        OptionError: There is no rule or no seed.
    """
    if not specs or not seeds:
        raise OptionError("a race of rules needs at least one rule and one seed")

    def play(rung: int, running: Sequence[str]) -> list[list[float]]:
        evaluation = evaluation_of(
            scenario,
            {spec: RuleFactory(spec) for spec in running},
            [domain],
            seeds[rung],
            duration_s=duration_s,
            workers=workers,
            reporter=reporter,
            title=title,
        )
        (played_in,) = evaluation.domains
        return [evaluation.values(spec, played_in, "att_s").tolist() for spec in running]

    played = race(specs, len(seeds), play)
    return tuple(RuleTrial(spec, float(np.mean(each)), len(each)) for spec, each in played.items())


@dataclass(frozen=True)
class RuleFactory:
    """Maker of a controller by its spelling, such as ``"largest-queue:30"``."""

    spec: str

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the controller for an environment."""
        return make_rule(self.spec, env)


@dataclass(frozen=True)
class FixedPolicy:
    """Maker that returns one policy; an evaluation plays copies of it."""

    policy: Policy

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the policy."""
        return self.policy


@dataclass(frozen=True)
class TrainedPolicy:
    """Maker that returns a trained policy if its intersections are those of the environment.

    Attributes:
        policy: The trained policy.
        path: File of the policy, named in the error message.
    """

    policy: NetworkPolicy
    path: str

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the policy; warn if it was trained for decisions at other times.

        Raises:
            CheckpointError: It has other agents, movements or phases.
        """
        fitting = parallel_env(env.scenario, **self.policy.env_options)
        if misfit := self.policy.misfit(fitting):
            raise CheckpointError(
                f"{self.path} was trained for other intersections than those of scenario "
                f"{env.scenario.id!r}: {misfit}"
            )
        interval_s = self.policy.decision_interval_s
        if interval_s not in (None, env.decision_interval_s):
            warnings.warn(
                f"{self.path} was trained for a decision every {interval_s:g} s; scenario "
                f"{env.scenario.id!r} takes one every {env.decision_interval_s:g} s",
                stacklevel=1,
            )
        return self.policy


def rule_factory(spec: str) -> PolicyFactory:
    """Return a factory for a controller such as ``"largest-queue:30"``, and check its spelling."""
    parse_rule(spec)
    return RuleFactory(spec)


def policy_factory(spec: str) -> PolicyFactory:
    """Return a factory for a rule, a trained policy, or a policy in a user's module.

    Args:
        spec: Spelling of a rule, a file, the id of a shipped policy such as
            ``single-v1/direct-transfer-s0``, ``module:name`` of a policy or of what makes one, or
            ``module:name@file`` of a learner with the file of its state.

    Raises:
        UnknownNameError: The name is neither a file nor a rule nor a shipped policy.
        OptionError: The module or the name in it is missing.
        CheckpointError: The file is not a policy. The factory raises it for a policy of another
            scenario.
    """
    if spec.partition(":")[0] in RULES:  # also beside a file of this name, which is ./NAME
        return rule_factory(spec)
    from ugat_marl.policies import load_policy, rule_in  # torch, which rules do without

    name, at, file = spec.partition("@")
    path = Path(file if at and is_own(name) else spec)
    if path.is_file() and (rule := rule_in(path)) is not None:  # a fitted street may keep a rule
        return rule_factory(rule)
    if is_own(name):
        if at:
            return OwnLearnerPolicy(name, path)
        load_own(name, "policy")  # a wrong name is an error now
        place, _, found = name.rpartition(":")
        file = place.endswith(".py")
        return NamedPolicy(f"{with_home(place).resolve()}:{found}" if file else name)
    if path.is_dir():
        raise CheckpointError(f"{path} is a folder; name the .pt file of a policy in it")
    if path.suffix == ".py" and path.is_file():
        raise OptionError(f"policy {spec!r}: give the name in it, {spec}:NAME")
    if path.suffix != ".pt" and not path.is_file() and "/" not in spec:
        return rule_factory(spec)  # an error that names those there are
    return TrainedPolicy(load_policy(spec), spec)


@dataclass(frozen=True)
class OwnPolicyFactory:
    """Maker of a policy that a user gives."""

    given: Any
    name: str

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the policy for an environment, whose options are those that it asks for."""
        if options := asked_options(self.given, self.name):
            env = parallel_env(env.scenario, **options)
        return copy.deepcopy(own_policy(self.given, self.name, env))


@dataclass(frozen=True)
class NamedPolicy:
    """Maker of a user's policy by its name, because other processes cannot import a FILE.py.

    Attributes:
        name: Name as for `load_own`; a file has its whole path.
    """

    name: str

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the policy for an environment, whose options are those that it asks for."""
        return OwnPolicyFactory(load_own(self.name, "policy"), self.name)(env)


@dataclass(frozen=True)
class OwnLearnerPolicy:
    """Maker of the policy of a user's learner, restored from a file."""

    name: str
    path: Path

    def __call__(self, env: TrafficEnv) -> Policy:
        """Return the policy for an environment."""
        make_env = partial(parallel_env, env.scenario)
        return OwnLearnerFactory(self.name).read_policy(make_env, self.path)


def _play(task: _Task, stop: Stop) -> list[Result]:
    policy = task.make(task.world)
    # The scenario's files hold the effects of the domain already.
    scenario = task.world.scenario
    if not task.approaches:
        return _episodes(task, parallel_env(scenario, **policy.env_options), policy, stop)
    with measured_approaches(scenario, task.world.network) as (measured, read):
        env = parallel_env(measured, **policy.env_options)
        return _episodes(task, env, policy, stop, read)


def _episodes(
    task: _Task,
    env: TrafficEnv,
    policy: Policy,
    stop: Stop,
    read: Callable[[], ApproachDelays] = dict,
) -> list[Result]:
    results: list[Result] = []
    check = stop_callback(stop)
    look = task.watch(task.name, task.world.domain, env) if task.watch is not None else check

    def on_step(step: int) -> None:
        check(step)
        look(step)

    try:
        for seed in task.seeds:
            # Tasks may share a policy, and a user's may remember earlier episodes, whose number
            # depends on the workers.
            retry_on_crash(
                lambda seed=seed: roll_out(env, copy.deepcopy(policy), seed, on_step=on_step)
            )
            scores = replace(env.scores(), approaches=read())
            results.append(Result(task.name, task.world.domain, seed, scores))
    finally:
        env.close()
    return results
