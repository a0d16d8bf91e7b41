"""What every learner reaches: trainings over several seeds, beside fixed time and the best rule.

Every training is a process of its own in a folder of its own under `--runs`. A killed run goes on
where it was, and more seeds or episodes later train only those. A page and a table for each
scenario say which library it was, how fast, and the travel times of the last and of the best
evaluation.

    python baselines/results.py --scenarios grid4x4-v1 --episodes 30
    python baselines/results.py --scenarios single-v1 --learners ippo sb3-ppo --seeds 5
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich.console import Console

from ugat_marl.data import locked, version_of
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, UgatMarlError
from ugat_marl.experiments import (
    DOMAIN,
    LEAST_BUDGET,
    VERSION,
    Curve,
    Training,
    evaluation_seeds,
    found,
    machine_facts,
    perform,
    played,
    rule_factory,
    tune,
    tuned_rules,
    word,
)
from ugat_marl.files import require_writable, write_whole
from ugat_marl.policies import BASELINES, DQN_NAME, require_known
from ugat_marl.progress import Bars, Reporter
from ugat_marl.reporting import curves_as_csv, curves_page
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import end_with_input

JOB, LOG, RULES = "job.json", "job.log", "rules.json"


@dataclass(frozen=True)
class Results:
    """Trains the learners on the scenarios and writes what they reach beside the rules.

    Attributes:
        scenarios: Scenarios, a page each.
        learners: Names; all, if none is given.
        seeds: Number of trainings of each learner, with the seeds 0, 1, ...
        episodes: Of each training.
        evaluate_every: Episodes from one evaluation to the next.
        evaluation_seeds: Episodes of an evaluation, always the same; rules are played for them too.
        rule_budget: Most episodes in which each rule is tuned.
        jobs: Trainings at a time.
        out: Folder of pages and tables.
        runs: Folder of the trainings.
        only: Used by the command itself: the folder of one training.
    """

    scenarios: tuple[str, ...] = ("grid4x4-v1",)
    learners: tuple[str, ...] = (DQN_NAME, *BASELINES)
    seeds: int = 3
    episodes: int = 30
    evaluate_every: int = 10
    evaluation_seeds: int = 5
    rule_budget: int = 24
    jobs: int = 1
    out: Path = Path("results/baselines")
    runs: Path = Path("runs/baselines")
    only: Path | None = None

    def __post_init__(self) -> None:
        for name in ("seeds", "episodes", "evaluate_every", "evaluation_seeds", "jobs"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: must be at least 1")
        if self.rule_budget < LEAST_BUDGET:
            raise OptionError(f"rule_budget = {self.rule_budget}: must be at least {LEAST_BUDGET}")
        for name in self.learners:
            require_known(name)

    def run(self) -> int:
        """Returns 1 if a training failed."""
        if self.only is not None:
            return one_of_them(self.only)
        console, failures = Console(), list[str]()
        scenarios = {name: load_scenario(name) for name in self.scenarios}
        for name in scenarios:  # what is wrong is said before anything is trained
            require_writable(self.out / f"{word(name)}.md")
        for name, scenario in scenarios.items():
            where, reporter = self.out / f"{word(name)}.md", Bars(console)
            plan = self.plan(name)
            failures += perform_all(plan, self.runs, self.jobs, reporter)
            curves: dict[Training, Curve] = {}
            for one in plan:
                with contextlib.suppress(UgatMarlError):  # told by perform_all
                    if curve := found(one, self.runs):
                        curves[one] = curve
            if curves:
                rules, best = self.rules(scenario, reporter)
                text = curves_page(scenario.id, curves, rules, best, machine_facts())
                write_whole(where, text + "\n")
                write_whole(where.with_suffix(".csv"), curves_as_csv(curves))
                console.print(f"page: {where}, each evaluation: {where.with_suffix('.csv')}")
        for line in failures:
            console.print(line, markup=False, soft_wrap=True)
        return int(bool(failures))

    def plan(self, scenario: str) -> list[Training]:
        """All trainings on a scenario, one of every learner before the next seed."""
        return [
            Training(
                scenario,
                learner,
                seed,
                self.episodes,
                self.evaluate_every,
                self.evaluation_seeds,
            )
            for seed in range(self.seeds)
            for learner in self.learners
        ]

    def rules(self, scenario: Scenario, reporter: Reporter) -> tuple[dict[str, list[float]], str]:
        """ATT by seed of the programme, of fixed time and of the best rule, s; and the last's name.

        The programme is the network's own; the others are tuned, on other seeds.
        """
        file = self.runs / f"{word(scenario.id)}-{RULES}"
        made_with = [scenario.hash, self.rule_budget, self.evaluation_seeds]
        made_with += [version_of("eclipse-sumo"), VERSION]
        with contextlib.suppress(OSError, ValueError, KeyError):
            told = json.loads(file.read_text())
            if told["made_with"] == made_with:
                return told["att_s"], told["best"]
        budget, jobs = self.rule_budget, self.jobs
        fixed = tune("fixed-time", scenario, DOMAIN, budget, workers=jobs, reporter=reporter)
        best = tuned_rules(scenario, [DOMAIN], budget, workers=jobs, reporter=reporter)[DOMAIN]
        seeds = evaluation_seeds(self.evaluation_seeds)
        att_s = {
            spec: played(scenario, rule_factory(spec), seeds)
            for spec in dict.fromkeys(("programme", fixed.best.spec, best))
        }
        told = {"made_with": made_with, "best": best, "att_s": att_s}
        write_whole(file, json.dumps(told) + "\n")
        return att_s, best


def one_of_them(folder: Path) -> int:
    """Performs the training described in a folder; it ends when its standard input does."""
    end_with_input()
    try:
        with warnings.catch_warnings(), contextlib.closing(locked(folder)):
            warnings.simplefilter("ignore")
            perform(Training(**json.loads((folder / JOB).read_text())), folder)
    except UgatMarlError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


def perform_all(plan: Sequence[Training], runs: Path, jobs: int, reporter: Reporter) -> list[str]:
    """Performs what is missing, `jobs` at a time; returns a line for each training that failed."""

    def one(training: Training) -> str:
        folder = runs.resolve() / training.name
        try:
            if found(training, runs) is not None:
                return ""
        except UgatMarlError as error:
            return f"{folder.name}: {' '.join(str(error).split())}"
        write_whole(folder / JOB, json.dumps(asdict(training)) + "\n")
        with (folder / LOG).open("wb") as log:
            done = subprocess.Popen(
                [sys.executable, "-P", __file__, "--only", str(folder)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            ).wait()
        lines = (folder / LOG).read_text(errors="replace").strip().splitlines()
        return f"{folder.name}: exit code {done}: {(lines or [''])[-1]}" if done else ""

    failures: list[str] = []
    with reporter.task("training", len(plan)) as advance, ThreadPoolExecutor(jobs) as pool:
        for training, failure in zip(plan, pool.map(one, plan), strict=True):
            failures += [failure] * bool(failure)
            advance(note=training.name)
    return failures


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(Results).run())
    except UgatMarlError as error:
        sys.exit(f"results.py: error: {error}")
