"""Results of the learners: trainings over several seeds, beside fixed time and the best rule.

Every training has its own process and its own folder under `--runs`. An interrupted run resumes. A
later run with more seeds or episodes does only the additional trainings. Each scenario gets a page
and a table: library and speed of each learner, and the travel times of its last and its best
evaluation.

    python baselines/results.py --scenarios grid4x4-v1 --episodes 30
    python baselines/results.py --scenarios single-v1 --learners ippo sb3-ppo --seeds 5
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import polars as pl
import tyro
from rich.console import Console
from tyro.conf import arg

from ugat_marl.cli import guarded
from ugat_marl.data import write_csv
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, counted, require_distinct
from ugat_marl.experiments import CurvesConfig, file_stem, learn_curves, machine_facts
from ugat_marl.files import require_writable, write_whole
from ugat_marl.progress import Bars
from ugat_marl.reporting import curves_as_csv, curves_page


@dataclass(frozen=True)
class Results:
    """Train learners on scenarios and write their results beside the rules'.

    Attributes:
        scenarios: Scenarios, a page each.
        config: Options of trainings and evaluations.
        jobs: Trainings at a time.
        out: Folder of pages and tables.
        runs: Folder of the trainings.
    """

    scenarios: tuple[str, ...] = ("grid4x4-v1",)
    config: Annotated[CurvesConfig, arg(name="")] = field(default_factory=CurvesConfig)
    jobs: int = 1
    out: Path = Path("results/baselines")
    runs: Path = Path("runs/baselines")

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise OptionError(f"jobs = {self.jobs}: must be at least 1")
        require_distinct(pages=[f"{file_stem(name)}.md" for name in self.scenarios])

    def run(self) -> int:
        """Train, judge and write; return 1 if a training failed."""
        console = Console(markup=False, emoji=False, highlight=False)
        failures: dict[str, str] = {}
        scenarios = {name: load_scenario(name) for name in self.scenarios}
        for name in scenarios:  # a folder that is not writable is an error before the trainings
            require_writable(self.out / f"{file_stem(name)}.md")
            table = self.out / f"{file_stem(name)}.csv"
            planned = [
                (job.setting.name, job.seed, mark)
                for job in self.config.trainings(name)
                for mark in job.marks
            ]
            if lost := _lost(table, planned):
                raise OptionError(
                    f"{table} has rows that would be lost, such as {lost}; ask for their "
                    "learners, seeds and evaluations, too (what is trained stays trained), or give "
                    "another --out"
                )
        for name, scenario in scenarios.items():
            page = self.out / f"{file_stem(name)}.md"
            found = learn_curves(scenario, name, self.config, self.runs, self.jobs, Bars(console))
            failures |= found.failures
            made = [
                (curve.learner, curve.seed, mark) for curve in found.curves for mark in curve.att_s
            ]
            if lost := _lost(page.with_suffix(".csv"), made):
                failures[str(page)] = f"kept, since rows of it failed, such as {lost}"
            elif found.curves and found.best:
                write_whole(page, curves_page(found, self.config, machine_facts()) + "\n")
                write_csv(page.with_suffix(".csv"), curves_as_csv(found.curves))
                console.print(f"page: {page}, each evaluation: {page.with_suffix('.csv')}")
        for name, reason in failures.items():
            console.print(f"{name}: {reason}", soft_wrap=True)
        return int(bool(failures))


def _lost(table: Path, kept: Sequence[tuple[str, int | None, int]]) -> str:
    """Return the first evaluation of a table that is not kept, in words; "" if all are.

    Args:
        table: The table; nothing is lost if there is none.
        kept: Learner, seed and training episodes of each evaluation that stays.

    Raises:
        OptionError: The file is another kind of table.
    """
    if not table.is_file():
        return ""
    evaluation = {"learner": pl.String, "seed": pl.Int64, "episodes": pl.Int64}
    try:
        there = pl.read_csv(table, columns=[*evaluation], schema_overrides=evaluation)
    except pl.exceptions.PolarsError:
        raise OptionError(f"{table} is no table of results.py; give another --out") from None
    after = pl.DataFrame(kept, schema=evaluation, orient="row")
    lost = there.join(after, on=[*evaluation], how="anti", maintain_order="left")
    if lost.is_empty():
        return ""
    learner, seed, episodes = lost.row(0)
    return f"{learner} with seed {seed} after {counted(episodes, 'episode')}"


if __name__ == "__main__":
    sys.exit(guarded("results.py", lambda: tyro.cli(Results).run()))
