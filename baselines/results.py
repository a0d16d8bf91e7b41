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
from collections.abc import Collection
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
from ugat_marl.errors import OptionError
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

    def run(self) -> int:
        """Train, judge and write; return 1 if a training failed."""
        console = Console(markup=False, emoji=False, highlight=False)
        failures: dict[str, str] = {}
        scenarios = {name: load_scenario(name) for name in self.scenarios}
        for name in scenarios:  # a folder that is not writable is an error before the trainings
            require_writable(self.out / f"{file_stem(name)}.md")
            table = self.out / f"{file_stem(name)}.csv"
            if lost := _lost(table, self.config.learners):
                raise OptionError(
                    f"{table} has rows of {', '.join(lost)}, which would be lost: name these in "
                    "--learners, too (what is trained stays trained), or give another --out"
                )
        for name, scenario in scenarios.items():
            page = self.out / f"{file_stem(name)}.md"
            found = learn_curves(scenario, name, self.config, self.runs, self.jobs, Bars(console))
            failures |= found.failures
            lost = _lost(page.with_suffix(".csv"), {curve.learner for curve in found.curves})
            if lost:
                failures[str(page)] = f"kept, since it has rows of {', '.join(lost)}, which failed"
            elif found.curves and found.best:
                write_whole(page, curves_page(found, self.config, machine_facts()) + "\n")
                write_csv(page.with_suffix(".csv"), curves_as_csv(found.curves))
                console.print(f"page: {page}, each evaluation: {page.with_suffix('.csv')}")
        for name, reason in failures.items():
            console.print(f"{name}: {reason}", soft_wrap=True)
        return int(bool(failures))


def _lost(table: Path, learners: Collection[str]) -> list[str]:
    """Return the learners of a table that others do not include.

    Raises:
        OptionError: The file is another kind of table.
    """
    if not table.is_file():
        return []
    try:
        there = pl.read_csv(table, columns=["learner"])["learner"].unique(maintain_order=True)
    except pl.exceptions.PolarsError:
        raise OptionError(f"{table} is no table of results.py; give another --out") from None
    return [name for name in there if name not in learners]


if __name__ == "__main__":
    sys.exit(guarded("results.py", lambda: tyro.cli(Results).run()))
