"""Policies x domains x seeds -> scores with intervals, gaps and regret.

The gap of a policy is its score in a domain minus its score in the first one, usually ``sim``, seed
by seed. It mixes physics with policy: slow vehicles are slow under any policy. The regret is how
far the policy is, in that domain, from the best policy known there; that part transfer can win
back.
"""

from __future__ import annotations

import concurrent.futures
import json
import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.controllers import STANDARD_RULES, controller_for, parse_spec
from ugat_marl.effects import Domain, describe, in_domain
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.files import write_whole
from ugat_marl.learners.agents import AgentSet
from ugat_marl.learners.dqn_policy import DQNPolicy
from ugat_marl.metrics import MEASURES, Scores, bootstrap_interval
from ugat_marl.policy import Policy
from ugat_marl.progress import Advance, Reporter, Silent
from ugat_marl.rollout import roll_out, until
from ugat_marl.scenario import Scenario
from ugat_marl.seeding import numpy_generator
from ugat_marl.traffic_env import TrafficEnv, parallel_env

PolicyFactory = Callable[[TrafficEnv], Policy]
"""Makes a policy for an environment; controllers read the network from it."""

TUNING_SEED = 9001
"""First of the seeds the best rule is searched on; never those a result is reported on."""


@dataclass(frozen=True)
class Result:
    """One episode.

    Attributes:
        policy: Name of the policy.
        domain: Name of the domain.
        seed: Seed of the episode.
        scores: How it went.
    """

    policy: str
    domain: str
    seed: int
    scores: Scores


@dataclass(frozen=True)
class Estimate:
    """Mean over seeds with a 95 % bootstrap interval (nan for a single seed), and the median."""

    mean: float
    low: float
    high: float
    median: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Estimate:
        """The estimate from one value per seed."""
        low, high = bootstrap_interval(values, numpy_generator(0, "bootstrap"))
        return cls(float(values.mean()), low, high, float(np.median(values)))


@dataclass(frozen=True)
class Evaluation:
    """All episodes of an evaluation.

    Attributes:
        scenario: Id of the scenario.
        scenario_hash: Its hash.
        results: One per policy, domain and seed.
        notes: What else a reader must know, such as which rule was the best one.
    """

    scenario: str
    scenario_hash: str
    results: tuple[Result, ...]
    notes: Mapping[str, str]

    @property
    def policies(self) -> list[str]:
        """Names of the policies, in the order they were evaluated."""
        return list(dict.fromkeys(result.policy for result in self.results))

    @property
    def domains(self) -> list[str]:
        """Names of the domains, in the order they were evaluated."""
        return list(dict.fromkeys(result.domain for result in self.results))

    def values(self, policy: str, domain: str, measure: str) -> NDArray[np.float64]:
        """One value per seed, in the order of the seeds."""
        found = [r for r in self.results if r.policy == policy and r.domain == domain]
        found.sort(key=lambda result: result.seed)
        return np.array([getattr(result.scores, measure) for result in found])

    def estimate(self, policy: str, domain: str, measure: str) -> Estimate:
        """Mean and interval of a measure."""
        return Estimate.of(self.values(policy, domain, measure))

    def gap(self, policy: str, domain: str, measure: str) -> Estimate:
        """The measure in `domain` minus that in the first domain, paired by seed."""
        real = self.values(policy, domain, measure)
        return Estimate.of(real - self.values(policy, self.domains[0], measure))

    def regret(self, policy: str, domain: str) -> Estimate:
        """ATT above that of the best policy evaluated in the domain, in s, paired by seed."""
        best = min(self.policies, key=lambda name: self.estimate(name, domain, "att_s").mean)
        mine = self.values(policy, domain, "att_s")
        return Estimate.of(mine - self.values(best, domain, "att_s"))

    def as_dict(self) -> dict[str, Any]:
        """Everything, for JSON: the summary and every episode."""
        summary: list[dict[str, Any]] = []
        for policy in self.policies:
            for domain in self.domains:
                row: dict[str, Any] = {"policy": policy, "domain": domain}
                for measure in MEASURES:
                    row[measure] = asdict(self.estimate(policy, domain, measure))
                    if domain != self.domains[0]:
                        row[f"{measure}_gap"] = asdict(self.gap(policy, domain, measure))
                row["regret_s"] = asdict(self.regret(policy, domain))
                summary.append(row)
        return {
            "scenario": self.scenario,
            "scenario_hash": self.scenario_hash,
            "notes": dict(self.notes),
            "summary": summary,
            "episodes": [
                {"policy": r.policy, "domain": r.domain, "seed": r.seed, **asdict(r.scores)}
                for r in self.results
            ],
        }

    def write(self, path: Path) -> None:
        """Writes `as_dict` as JSON, whole or not at all; what has no value is null."""
        content = json.dumps(_without_nan(self.as_dict()), indent=1, allow_nan=False)
        write_whole(path, content + "\n")


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


@dataclass(frozen=True)
class _Task:
    name: str
    make: PolicyFactory
    domain: Domain
    seeds: tuple[int, ...]


def evaluate(
    scenario: Scenario,
    policies: Mapping[str, PolicyFactory],
    domains: Sequence[Domain],
    seeds: Sequence[int],
    *,
    duration_s: float | None = None,
    workers: int | None = None,
    reporter: Reporter | None = None,
    title: str = "evaluating",
    notes: Mapping[str, str] | None = None,
) -> Evaluation:
    """Plays every policy in every domain with every seed, spread over the cores.

    Args:
        scenario: Where.
        policies: Name to factory.
        domains: Domains; gaps are taken against the first, usually ``"sim"``.
        seeds: Seeds of the episodes, the same for all.
        duration_s: Length of an episode; None for the scenario's own.
        workers: Simulations at a time; None for the number of cores.
        reporter: Shows progress.
        title: What to call the work there.
        notes: Kept with the result.
    """
    names = [describe(domain) for domain in domains]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise OptionError(f"domain {twice[0]!r} is listed twice (rain is V3, snow is V4, ...)")
    for domain in domains:
        in_domain(scenario, domain)  # a wrong name is an error now, not in an hour
    probe = parallel_env(scenario, domains[0], duration_s=duration_s)
    for make in policies.values():
        make(probe)  # and so is a wrong policy
    workers = workers or _usable_cores()
    per_task = max(1, len(seeds) * len(policies) * len(domains) // (4 * workers))
    tasks = [
        _Task(name, make, domain, tuple(seeds[start : start + per_task]))
        for domain in domains
        for name, make in policies.items()
        for start in range(0, len(seeds), per_task)
    ]
    with (reporter or Silent()).task(title, len(seeds) * len(policies) * len(domains)) as advance:
        results = _play_all(scenario, tasks, duration_s, workers, advance)
    order = {
        (name, describe(domain)): i for i, (name, domain) in enumerate(_pairs(policies, domains))
    }
    results.sort(key=lambda r: (order[r.policy, r.domain], r.seed))
    return Evaluation(scenario.id, scenario.hash, tuple(results), dict(notes or {}))


def best_rules(
    scenario: Scenario,
    domains: Sequence[Domain],
    *,
    rules: Sequence[str] = STANDARD_RULES,
    seeds: Sequence[int] = (TUNING_SEED, TUNING_SEED + 1),
    duration_s: float | None = None,
    workers: int | None = None,
    reporter: Reporter | None = None,
) -> dict[str, str]:
    """For each domain the rule with the smallest mean ATT on the tuning seeds.

    Returns:
        Name of the domain to the spelling of the rule.
    """
    found = evaluate(
        scenario,
        {rule: _controller_factory(rule) for rule in rules},
        domains,
        seeds,
        duration_s=duration_s,
        workers=workers,
        reporter=reporter,
        title="best rule of each domain",
    )
    return {
        domain: min(rules, key=lambda rule: found.estimate(rule, domain, "att_s").mean)
        for domain in found.domains
    }


def rule_factory(spec: str) -> PolicyFactory:
    """A factory for a controller such as ``"largest-queue:30"``; the spelling is checked now."""
    parse_spec(spec)
    return _controller_factory(spec)


def fixed_policy(policy: Policy) -> PolicyFactory:
    """A factory that always gives the same, stateless, policy."""
    return lambda _env: policy


def policy_factory(spec: str) -> PolicyFactory:
    """A factory for what a user names: a rule, or the file of a trained policy.

    Raises:
        UnknownNameError: Neither a file nor a rule.
        CheckpointError: The file is not a policy, or (when used) one of another scenario.
    """
    path = Path(spec)
    if path.is_dir():
        raise CheckpointError(f"{path} is a folder; name the .pt file of a policy in it")
    if path.suffix != ".pt" and not path.is_file():
        return rule_factory(spec)
    policy = DQNPolicy.load(path)

    def make(env: TrafficEnv) -> Policy:
        fitting = parallel_env(env.scenario, **policy.env_options)
        if AgentSet.of(fitting) != policy.agents:
            raise CheckpointError(
                f"{path} was trained for other intersections than those of scenario "
                f"{env.scenario.id!r}: its agents are {policy.agents}, here {AgentSet.of(fitting)}"
            )
        return policy

    return make


def _controller_factory(spec: str) -> PolicyFactory:
    return lambda env: controller_for(spec, env)


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _pairs(
    policies: Mapping[str, PolicyFactory], domains: Sequence[Domain]
) -> list[tuple[str, Domain]]:
    return [(name, domain) for name in policies for domain in domains]


def _play_all(
    scenario: Scenario,
    tasks: Sequence[_Task],
    duration_s: float | None,
    workers: int,
    advance: Advance,
) -> list[Result]:
    """Threads suffice: the simulations run in processes of their own."""
    stop = threading.Event()
    lock = threading.Lock()
    results: list[Result] = []

    def done() -> None:
        with lock:
            advance()

    pool = concurrent.futures.ThreadPoolExecutor(workers)
    try:
        running = {pool.submit(_play, scenario, t, duration_s, stop, done) for t in tasks}
        while running:  # wakes up now and then, so that Ctrl-C is heard
            finished, running = concurrent.futures.wait(
                running, timeout=0.2, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in finished:
                results += future.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
    return results


def _play(
    scenario: Scenario,
    task: _Task,
    duration_s: float | None,
    stop: threading.Event,
    done: Callable[[], None],
) -> list[Result]:
    probe = parallel_env(scenario, task.domain, duration_s=duration_s)
    policy = task.make(probe)
    env = parallel_env(scenario, task.domain, duration_s=duration_s, **policy.env_options)
    results: list[Result] = []
    try:
        for seed in task.seeds:
            roll_out(env, policy, seed, on_step=until(stop))
            results.append(Result(task.name, env.domain, seed, env.scores()))
            done()
    finally:
        env.close()
    return results
