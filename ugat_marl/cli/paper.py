"""``ugat-marl paper``: make the tables of the UGAT paper, and further ones."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import polars as pl
from rich.console import Console
from tyro.conf import arg

from ugat_marl.cli.arguments import RayAddress, require_numbers, workers_of
from ugat_marl.cli.frame import continued_by, given_call
from ugat_marl.data import write_csv
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, counted
from ugat_marl.experiments import (
    DIRECT,
    Comparison,
    Judging,
    PaperConfig,
    all_standings,
    compare,
    file_stem,
    machine_facts,
    planned_trainings,
    require_kept,
)
from ugat_marl.files import require_writable, write_whole
from ugat_marl.policies import device_of
from ugat_marl.progress import Bars
from ugat_marl.reporting import (
    comparison_csv,
    comparison_page,
    draw_table,
    terminal_tables,
)

SEEDS = "seeds.csv"
"""File of a table with a row for each training."""

_REMEDY = "give the same command with another --out, it trains nothing again"
"""Way out where a table may not be replaced."""


@dataclass(frozen=True)
class _Paper:
    """Options that all tables share.

    Attributes:
        config: Settings of the trainings and of the evaluation.
        out: Folder of the tables. A table there is replaced only by one that has all its trainings.
        title: Name of the table in its heading; default: that of the command.
        runs: Folder of the trainings.
        jobs: Trainings at a time; default: one per core.
        ray: Train on Ray instead, on machines that share the folder of the trainings.
    """

    config: Annotated[PaperConfig, arg(name="")]
    out: Path = Path("runs/tables")
    title: str | None = None
    runs: Path = Path("runs/paper")
    jobs: int | None = None
    ray: RayAddress = None

    table: ClassVar[str]
    FIRST: ClassVar[tuple[str, ...]] = (
        "scenario",
        "domains",
        "seeds",
        "episodes",
        "iterations",
        "grounded-episodes",
        "groundings",
        "rows",
        "learner",
        "evaluation-seeds",
        "rule-budget",
        "out",
        "runs",
        "jobs",
    )
    """Options of the first screen of the help."""

    def run(self, console: Console) -> int:
        """Train and evaluate; print the table and write it as Markdown, CSV and PNG."""
        require_numbers(1, jobs=self.jobs)
        self.config.ugat.gate.require_settings_count(also_dynamic=self.table == "alpha")
        if self.ray is not None and self.config.device != "cpu":
            raise OptionError(
                f"device = {self.config.device!r}: trainings on Ray have a core each and no GPU; "
                "leave --ray or --device out"
            )
        device_of(self.config.device)  # a missing device is an error now, not in a job's log
        config = self.config
        self._require_own_folders()
        # A wrong one is an error before any is trained in.
        scenarios = [load_scenario(name, config.duration_s) for name in config.scenario]
        folders = [self.out / file_stem(scenario) / self.table for scenario in config.scenario]
        for folder in folders:
            require_writable(folder / "table.md")
            require_kept(folder / SEEDS, planned_trainings(self.table, config), _REMEDY)
        for scenario, loaded, folder in zip(config.scenario, scenarios, folders, strict=True):
            with (
                continued_by(
                    given_call("paper", self.table) or ["paper", self.table, "..."],
                    f"trainings: {self.runs}",
                ),
                workers_of(self.jobs, self.ray, "--jobs") as workers,
            ):
                comparison = compare(
                    self.table, scenario, config, self.runs, workers, Bars(console)
                )
            judging = Judging.of(loaded, config.evaluation_seeds, config.duration_s)
            _write(comparison, judging, self.title or self.table, folder)
            console.print(terminal_tables(comparison, DIRECT))
            console.print(f"table and pictures: {folder}\ntrainings: {self.runs}", soft_wrap=True)
        return 0

    def _require_own_folders(self) -> None:
        """Refuse scenarios of the same name, whose tables would be written to one folder."""
        names = [file_stem(scenario) for scenario in self.config.scenario]
        if twice := [name for name in names if names.count(name) > 1]:
            raise OptionError(
                f"scenario {' '.join(self.config.scenario)}: two have the name {twice[0]!r}, and "
                f"{self.out / twice[0]} holds the tables of one; make the tables of the other in "
                "a call of its own, with another --out"
            )


@dataclass(frozen=True)
class Main(_Paper):
    """Compare UGAT with direct transfer and with all controls.

    docs/how-to/paper-tables.md explains the controls and the other rows.

    All tables share the trainings in --runs. A killed run continues.

    Examples:
        ugat-marl paper main
        ugat-marl paper main --scenario grid4x4-v1 --domains V3 V4 --seeds 3 --episodes 40
        ugat-marl paper main --learner sb3-ppo
    """

    table: ClassVar[str] = "main"


@dataclass(frozen=True)
class Ablation(_Paper):
    """Compare UGAT with and without its parts (paper, Table 3).

    The variants have a static α, no gate, no uncertainty or no grounding.

    Examples:
        ugat-marl paper ablation
        ugat-marl paper ablation --domains V1 V4 --groundings phase
    """

    table: ClassVar[str] = "ablation"


@dataclass(frozen=True)
class Alpha(_Paper):
    """Compare static thresholds α with the dynamic one (paper, Table 4).

    Examples:
        ugat-marl paper alpha
    """

    table: ClassVar[str] = "alpha"


@dataclass(frozen=True)
class Uncertainty(_Paper):
    """Compare evidential, Concrete Dropout, Deep Ensembles and none (paper, Fig. 4).

    The gaps are drawn as dots with intervals.

    Examples:
        ugat-marl paper uncertainty --domains V1 V2 V3 V4
    """

    table: ClassVar[str] = "uncertainty"


@dataclass(frozen=True)
class Gap(_Paper):
    """Draw the loss of direct transfer in each real domain as radar charts (Fig. 3).

    Examples:
        ugat-marl paper gap --scenario single-v1 grid2x2-v1
    """

    table: ClassVar[str] = "gap"


def _write(comparison: Comparison, judging: Judging, title: str, folder: Path) -> None:
    every = all_standings(comparison)
    is_unknown = pl.col("att_s").is_nan() | pl.col("att_s_sim").is_nan()
    rows, unknown = every.filter(~is_unknown), every.filter(is_unknown)
    if unknown.height:
        warnings.warn(
            f"no vehicle was due for {counted(unknown.height, 'row')}, such as "
            f"{unknown['setting'][0]!r} in {unknown['domain'][0]}; {SEEDS} is without them",
            stacklevel=2,
        )
    seeds = judging.written_to(rows).write_csv()
    require_kept(folder / SEEDS, rows, _REMEDY)
    page = comparison_page(comparison, DIRECT, title, machine_facts())
    write_whole(folder / "table.md", page + "\n")
    write_csv(folder / "table.csv", comparison_csv(comparison))
    write_csv(folder / SEEDS, seeds)
    draw_table(comparison.rows(), comparison.sim, folder)
