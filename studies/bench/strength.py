"""``bench strength``: compare a policy with the best rule in the domain of its training.

A table across a gap measures transfer only if its learner is not under-trained. So this bench
trains and evaluates a learner in one domain, and compares it with the best rule there.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from studies.bench.report import Report, Target, require_positive
from ugat_marl.effects import domain_label, load_scenario
from ugat_marl.errors import OptionError
from ugat_marl.experiments import (
    DIRECT,
    RULE,
    RULE_FILE,
    Curve,
    Job,
    LearnerSpec,
    Setting,
    evaluation_seeds,
    perform_here,
)
from ugat_marl.policies import UNIVERSAL_NAME, DQNConfig, require_device_name
from ugat_marl.progress import Reporter, Silent

STEADY = 1.05
"""Largest ratio of the mean of the last evaluations to the best one."""


@dataclass(frozen=True)
class StrengthBench:
    """Compare a learner with the best rule in the domain of its training.

    Greedy policies are evaluated after every `every` episodes and after each of the `last` last
    ones. All policies and the rule are evaluated on the same seeds. If no rule is named, it is
    chosen on other seeds.

    Examples:
        python -m studies.bench strength --scenario grid2x2-v1 --domain V4 --out strength.json

    Attributes:
        scenario: Scenario to simulate.
        domain: Domain of training and evaluation.
        episodes: Episodes of training.
        every: Episodes from one evaluation to the next.
        last: Number of evaluations at the end, which have to be close to the best one.
        seeds: Seeds of training, one policy each.
        evaluation_seeds: Episodes of every evaluation.
        rule: Rule to compare with; default: the best of the standard rules, chosen on other seeds.
        tuning_seeds: Episodes for the choice of the rule.
        duration_s: Simulated seconds per episode; default: the scenario's own.
        observation: Observation of the agents; default: the one that the learner needs, or count.
        reward: Reward of the agents; they are judged by travel time.
        neighbours: Distance in roads up to which other intersections are observed too.
        learner: Learner: universal, dqn, or a baseline.
        learner_settings: Settings of a baseline as NAME=VALUE.
        device: Device of dqn's updates: cpu, cuda, or cuda:N.
        dqn: Settings of the learners universal and dqn.
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
    observation: str | None = None
    reward: str = "total-queue"
    neighbours: int = 0
    learner: str = UNIVERSAL_NAME
    learner_settings: tuple[str, ...] = ()
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
    def spec(self) -> LearnerSpec:
        """Name and settings of the learner."""
        return LearnerSpec(self.learner, self.learner_settings, self.dqn)

    @property
    def plan(self) -> list[Job]:
        """Jobs: one for the rule, then a training for each seed."""
        rules = () if self.rule is None else (self.rule,)
        return [
            self._job(Setting(RULE, "rule", rules=rules), None),
            *(self._job(Setting(DIRECT, "direct", learner=self.spec), s) for s in self.seeds),
        ]

    def run(self, reporter: Reporter | None = None) -> Report:
        """Train and measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.
        """
        self.spec.factory(
            self.device
        )  # a missing library or device is an error now, not after the search
        scenario, plan = load_scenario(self.scenario), self.plan
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            folder = Path(name)
            by_rule, *records = perform_here(plan, folder, reporter=reporter or Silent())
            rule = (folder / plan[0].name / RULE_FILE).read_text()
        rule_s = fmean(s.att_s for s in by_rule.played(plan[0], 0, self.domain))
        trained = zip(plan[1:], records, strict=True)
        curves = [Curve.of(job, record, scenario) for job, record in trained]
        return self._report(rule, rule_s, curves)

    def _report(self, rule: str, rule_s: float, curves: Sequence[Curve]) -> Report:
        final_s = fmean(curve.final_s for curve in curves)
        worst = max(_unsteadiness(curve, self.last) for curve in curves)
        targets = [
            Target("ATT, mean over trainings / rule", final_s / rule_s, 1.0, at_least=False),
            Target("mean of last / best evaluation, worst", worst, STEADY, at_least=False),
        ]
        named = "best rule" if self.rule is None else "rule"
        seeds = evaluation_seeds(self.evaluation_seeds)
        notes = [
            f"{self.scenario} in {domain_label(self.domain)}: {named} {rule}, {rule_s:.1f} s; "
            f"{self.learner} after {self.episodes} episodes {final_s:.1f} s. ATT over all vehicles "
            f"due, on seeds {seeds[0]} to {seeds[-1]}."
        ]
        rows = [_row(curve, self.last, rule_s) for curve in curves]
        settings = {**asdict(self), "rule": rule}
        report = Report("strength", settings, rows, targets, notes, aside=("curve",))
        if self.out is not None:
            report.write(self.out)
        return report

    def _job(self, setting: Setting, seed: int | None) -> Job:
        is_rule = setting.recipe == "rule"
        return Job(
            setting,
            self.scenario,
            sim=self.domain,
            seed=seed,
            episodes=0 if is_rule else self.episodes,
            every=0 if is_rule else self.every,
            last=1 if is_rule else self.last,
            options={
                **self.spec.env_options(self.observation),
                "reward": self.reward,
                "neighbours": self.neighbours,
                "duration_s": self.duration_s,
            },
            tuning_seeds=self.tuning_seeds,
            domains=(self.domain,),
            evaluation_seeds=evaluation_seeds(self.evaluation_seeds),
            device=self.device,
        )


def _unsteadiness(curve: Curve, last: int) -> float:
    """Return the mean of the last evaluations divided by the best one, at least 1."""
    return curve.mean_of_last_s(last) / curve.best_s


def _row(curve: Curve, last: int, rule_s: float) -> dict[str, Any]:
    return {
        "training seed": str(curve.seed),
        "ATT [s]": curve.final_s,
        "/ rule": curve.final_s / rule_s,
        "best [s]": curve.best_s,
        f"mean of last {last} [s]": curve.mean_of_last_s(last),
        "/ best": _unsteadiness(curve, last),
        "curve": {str(number): att_s for number, att_s in curve.att_s.items()},
    }
