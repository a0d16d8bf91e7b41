"""``bench strength``: is a policy as good as the best rule where it was trained, and does it stay.

A table across a gap measures transfer only if its learner is not under-trained. So the learner is
trained and judged in one and the same domain, beside the rule that is best there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from studies.bench.report import Report, Target, require_positive
from ugat_marl.effects import describe, load_scenario
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import TUNING_SEED, best_rules, evaluate, rule_factory
from ugat_marl.policies import DQN, DQNConfig, Policy, device_of, require_device_name, roll_out
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario

FIRST_SEED = 1000
"""First seed of the evaluations; apart from those of training and of the search for rules."""

STEADY = 1.05
"""The mean of the last evaluations may be so much above the best one."""


@dataclass(frozen=True)
class Curve:
    """Greedy evaluations in the course of one training.

    Attributes:
        att_s: Episodes trained to mean travel time over the evaluation seeds, in s.
        last: How many evaluations at the end count as the last ones.
    """

    att_s: Mapping[int, float]
    last: int

    @property
    def final_s(self) -> float:
        """Travel time of the policy at the end."""
        return list(self.att_s.values())[-1]

    @property
    def best_s(self) -> float:
        """The smallest of all evaluations."""
        return min(self.att_s.values())

    @property
    def mean_of_last_s(self) -> float:
        """Mean of the last evaluations."""
        return fmean(list(self.att_s.values())[-self.last :])

    @property
    def unsteadiness(self) -> float:
        """Mean of the last evaluations over the best one, at least 1."""
        return self.mean_of_last_s / self.best_s


@dataclass(frozen=True)
class StrengthBench:
    """What DQN reaches in the domain it is trained in, beside the best rule there.

    Every greedy policy is evaluated on the same seeds, and so is the rule, which is chosen on
    others unless it is named. Evaluated are the policies after every `every` episodes and after
    each of the `last` last ones.

    Examples:
        python -m studies.bench strength --scenario grid2x2-v1 --domain V4 --out strength.json

    Attributes:
        scenario: What to simulate.
        domain: Where to train and to evaluate.
        episodes: Episodes of training.
        every: Episodes from one evaluation to the next.
        last: Evaluations at the end that have to be close to the best one.
        seeds: Seeds of training, one policy each.
        evaluation_seeds: Episodes behind every evaluation.
        rule: The rule to compare with; default: the best one of `evaluation.best_rules`.
        tuning_seeds: Episodes behind the choice of the rule.
        duration_s: Simulated seconds per episode; default: the scenario's own.
        observation: What agents see.
        reward: What agents want; they are judged by travel time.
        neighbours: How many roads away intersections are seen too.
        device: Where updates are computed: cpu, cuda, or cuda:N.
        dqn: Settings of the learner.
        out: JSON file to write.
    """

    scenario: str = "single-v1"
    domain: str = "sim"
    episodes: int = 60
    every: int = 5
    last: int = 10
    seeds: tuple[int, ...] = (10, 11, 12)
    evaluation_seeds: int = 3
    rule: str | None = None
    tuning_seeds: int = 2
    duration_s: float | None = None
    observation: str = "count"
    reward: str = "queue"
    neighbours: int = 0
    device: str = "cpu"
    dqn: DQNConfig = field(default_factory=DQNConfig)
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive(
            "strength",
            episodes=self.episodes,
            every=self.every,
            last=self.last,
            evaluation_seeds=self.evaluation_seeds,
            tuning_seeds=self.tuning_seeds,
        )
        require_device_name(self.device)
        if not self.seeds:
            raise OptionError("bench strength: seeds is empty; give one seed of training or more")

    @property
    def judged(self) -> list[int]:
        """Numbers of episodes after which the policy is evaluated."""
        late = range(max(1, self.episodes - self.last + 1), self.episodes + 1)
        return sorted({*range(self.every, self.episodes + 1, self.every), *late})

    def run(self, reporter: Reporter | None = None) -> Report:
        """Trains and measures, and writes `out` if it is given.

        Args:
            reporter: Is told how far it has come.
        """
        reporter = reporter or Silent()
        device_of(self.device)  # what is not there is said now, not after the search for the rule
        scenario = load_scenario(self.scenario)
        rule, rule_s = self._best_rule(scenario, reporter)
        curves = {seed: self._curve(scenario, seed, reporter) for seed in self.seeds}
        rows = [_row(seed, curve, rule_s) for seed, curve in curves.items()]
        final_s = fmean(curve.final_s for curve in curves.values())
        worst = max(curve.unsteadiness for curve in curves.values())
        targets = [
            Target("ATT, mean over trainings / rule", final_s / rule_s, 1.0, at_least=False),
            Target("mean of last / best evaluation, worst", worst, STEADY, at_least=False),
        ]
        named = "best rule" if self.rule is None else "rule"
        notes = [
            f"{self.scenario} in {describe(self.domain)}: {named} {rule}, {rule_s:.1f} s; "
            f"DQN after {self.episodes} episodes {final_s:.1f} s. ATT over all vehicles due, on "
            f"seeds {FIRST_SEED} to {FIRST_SEED + self.evaluation_seeds - 1}."
        ]
        settings = {**asdict(self), "rule": rule}
        report = Report("strength", settings, rows, targets, notes, aside=("curve",))
        if self.out is not None:
            report.write(self.out)
        return report

    def _best_rule(self, scenario: Scenario, reporter: Reporter) -> tuple[str, float]:
        """The rule, searched on seeds of its own if none is named, and its travel time."""
        rule = self.rule
        if rule is None:
            tuned = best_rules(
                scenario,
                [self.domain],
                seeds=[TUNING_SEED + k for k in range(self.tuning_seeds)],
                duration_s=self.duration_s,
                reporter=reporter,
            )
            (rule,) = tuned.values()
        found = evaluate(
            scenario,
            {rule: rule_factory(rule)},
            [self.domain],
            self._seeds_of_evaluations(),
            duration_s=self.duration_s,
        )
        return rule, found.estimate(rule, found.domains[0], "att_s").mean

    def _curve(self, scenario: Scenario, seed: int, reporter: Reporter) -> Curve:
        training, judging = self._env(scenario), self._env(scenario)
        learner = DQN.of(training, self.dqn, seed, device=device_of(self.device))
        att_s: dict[int, float] = {}
        try:
            with reporter.task(f"training, seed {seed}", self.episodes) as advance:
                for number in self.judged:
                    left = number - learner.episodes
                    policy = learner.learn(training, left, seed, lambda _number, _: advance())
                    att_s[number] = self._att_s(judging, policy)
        finally:
            training.close()
            judging.close()
        return Curve(att_s, self.last)

    def _env(self, scenario: Scenario) -> TrafficEnv:
        return parallel_env(
            scenario,
            self.domain,
            observation=self.observation,
            reward=self.reward,
            neighbours=self.neighbours,
            duration_s=self.duration_s,
        )

    def _att_s(self, env: TrafficEnv, policy: Policy) -> float:
        times: list[float] = []
        for seed in self._seeds_of_evaluations():
            roll_out(env, policy, seed)
            times.append(env.scores().att_s)
        return fmean(times)

    def _seeds_of_evaluations(self) -> list[int]:
        return [FIRST_SEED + k for k in range(self.evaluation_seeds)]


def _row(seed: int, curve: Curve, rule_s: float) -> dict[str, Any]:
    return {
        "training seed": str(seed),
        "ATT [s]": curve.final_s,
        "/ rule": curve.final_s / rule_s,
        "best [s]": curve.best_s,
        f"mean of last {curve.last} [s]": curve.mean_of_last_s,
        "/ best": curve.unsteadiness,
        "curve": {str(number): att_s for number, att_s in curve.att_s.items()},
    }
