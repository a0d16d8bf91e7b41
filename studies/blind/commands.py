"""``python -m studies.blind``: hide effects, diagnose the data, grade and sum up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from studies.blind.cases import Case, read_plan, read_street
from studies.blind.detectors import first_stages
from studies.blind.detectors import markdown as detectors_markdown
from studies.blind.generate import VARIATIONS, Blueprint, generate
from studies.blind.grade import grade_cases, read_grades
from studies.blind.run import Diagnose, run_cases
from studies.blind.sampling import GROUPS
from studies.blind.strengths import STRENGTHS
from studies.blind.table import markdown, write_table
from studies.blind.visibility import judge_visibility
from ugat_marl.cli import LengthS
from ugat_marl.diagnosis import DiagnosisConfig, diagnose
from ugat_marl.errors import OptionError, require_distinct
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars, Silent

Directory = Annotated[Positional[Path], arg(metavar="DIR")]
Only = Annotated[tuple[str, ...], arg(metavar="CASE ...", help_behavior_hint="(default: all)")]


@dataclass(frozen=True)
class BlindGenerate:
    """Hide effects in scenarios, record measured data, and write the labels.

    Then follow blind run, blind grade and blind table (docs/explanation/blind-tests.md).

    Examples:
        python -m studies.blind generate --scenario single-v1 --cases 40 --out blind
        python -m studies.blind generate --scenario single-v1 --classes none --out nulls

    Attributes:
        scenario: Scenarios of the cases.
        out: Directory of the blind test; an existing one is continued.
        classes: Classes to hide: none, single, measurement, pair, setting, outside, and names of
            effects.
        strengths: Strengths of single effects: small, medium, large.
        cases: Number of cases.
        seed: Root of all seeds.
        periods: Days per case.
        speeds: Measure speeds at the detectors.
        pressure_share: Share of the cases under max-pressure instead of fixed-time control.
        duration_s: Length of a day in s.
        day_to_day: Variations of the demand from day to day, as shares; each case has one of them.
    """

    scenario: tuple[str, ...]
    out: Path
    classes: tuple[str, ...] = tuple(GROUPS)
    strengths: tuple[str, ...] = STRENGTHS
    cases: int = 40
    seed: int = 0
    periods: int = 5
    speeds: bool = True
    pressure_share: float = 0.2
    duration_s: LengthS = None
    day_to_day: tuple[float, ...] = VARIATIONS

    def run(self, console: Console) -> int:
        """Generate the cases."""
        blueprint = Blueprint(
            self.scenario,
            self.classes,
            self.strengths,
            self.cases,
            self.seed,
            self.periods,
            self.speeds,
            self.pressure_share,
            self.duration_s,
            self.day_to_day,
        )
        require_writable(self.out / "plan.json")
        made = generate(self.out, blueprint, Bars(console))
        console.print(f"{made} of {self.cases} cases made: {self.out}", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class BlindRun:
    """Diagnose the cases that have no diagnosis yet, without reading labels.

    Examples:
        python -m studies.blind run blind --budget-s 600

    Attributes:
        directory: Directory of a blind test.
        jobs: Cases at a time.
        budget_s: Time for each diagnosis, s.
        alpha: Chance of naming an effect if there is none.
        seed: Seed of the diagnoses.
        only: Names of the cases to diagnose.
    """

    directory: Directory
    jobs: int = 1
    budget_s: float = 600.0
    alpha: float = 0.05
    seed: int = 0
    only: Only = ()

    def run(self, console: Console) -> int:
        """Run; the exit code is 1 if a diagnosis failed."""
        if self.jobs < 1 or self.budget_s <= 0:
            raise OptionError("--jobs must be at least 1 and --budget-s above 0")
        command = [
            "run", str(self.directory), "--budget-s", str(self.budget_s),
            "--alpha", str(self.alpha), "--seed", str(self.seed),
        ]  # fmt: skip
        done, failed = run_cases(
            self.directory,
            self._diagnose(),
            only=self.only,
            jobs=self.jobs,
            command=command,
            options={"budget_s": self.budget_s, "alpha": self.alpha, "seed": self.seed},
            reporter=Bars(console),
        )
        console.print(f"{done} diagnosed, {failed} failed: {self.directory}", soft_wrap=True)
        return 1 if failed else 0

    def _diagnose(self) -> Diagnose:
        def run_diagnosis(case: Case, measured: Path, directory: Path) -> None:
            scenario, data = read_street(case.scenario, measured)
            config = DiagnosisConfig(
                budget_s=self.budget_s, alpha=self.alpha, seed=self.seed, leave_out=case.leave_out
            )
            diagnose(scenario, data, directory, config, Silent())

        return run_diagnosis


@dataclass(frozen=True)
class BlindVisible:
    """Test single effects: are they visible to a test that knows them?

    The test reads the labels of diagnosed cases only. Grade the cases again after it.

    Examples:
        python -m studies.blind visible blind

    Attributes:
        directory: Directory of a blind test.
        seed: Seed of the diagnoses, whose simulated days are used again.
        only: Names of the cases to test.
    """

    directory: Directory
    seed: int = 0
    only: Only = ()

    def run(self, console: Console) -> int:
        """Test and print."""
        found = judge_visibility(
            self.directory, only=self.only, seed=self.seed, reporter=Bars(console)
        )
        for case, deviations in sorted(found.items()):
            said = "in the log of the signals" if deviations is None else f"{deviations:.1f} sd"
            console.print(f"{case}  {said}", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class BlindDetectors:
    """Read off the errors of detectors alone, without a search, and open all labels.

    The set is spent by it; draw another one for whole diagnoses.

    Examples:
        python -m studies.blind detectors blind

    Attributes:
        directory: Directory of a blind test.
        seed: Seed of the simulated days.
        only: Names of the cases to look at.
    """

    directory: Directory
    seed: int = 0
    only: Only = ()

    def run(self, console: Console) -> int:
        """Read off and print."""
        grades = first_stages(
            self.directory, only=self.only, seed=self.seed, reporter=Bars(console)
        )
        console.print(detectors_markdown(grades), soft_wrap=True, markup=False)
        return 0


@dataclass(frozen=True)
class BlindGrade:
    """Compare diagnosed cases with their labels, and write grades.json.

    Examples:
        python -m studies.blind grade blind

    Attributes:
        directory: Directory of a blind test.
    """

    directory: Directory

    def run(self, console: Console) -> int:
        """Grade and print."""
        grades = grade_cases(self.directory)
        for item in grades:
            wrong = ", confident and wrong" if item.confident_wrong else ""
            named = " + ".join(item.named) or "nothing"
            line = f"{item.case}  {item.outcome}{wrong}: {item.hidden} {item.strength}".rstrip()
            console.print(f"{line}; {item.verdict}, {named}", soft_wrap=True)
        console.print(f"{len(grades)} cases graded: {self.directory}", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class BlindTable:
    """Sum up the grades of one blind test or several.

    Examples:
        python -m studies.blind table blind nulls --out table.md

    Attributes:
        directories: Directories of graded blind tests.
        out: File for the table: Markdown, or JSON if its name ends in .json.
    """

    directories: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DIR ...", help_behavior_hint="(required)")
    ]
    out: Annotated[
        Path | None, arg(metavar="PATH", help_behavior_hint="(default: only printed)")
    ] = None

    def run(self, console: Console) -> int:
        """Print and write."""
        if not self.directories:
            raise OptionError("give at least one blind test")
        require_distinct(directories=[directory.resolve() for directory in self.directories])
        if self.out is not None:
            require_writable(self.out)
        grades = [item for directory in self.directories for item in read_grades(directory)]
        drawn = sum(len(read_plan(directory)) for directory in self.directories)
        console.print(markdown(grades, drawn), soft_wrap=True, markup=False)
        if self.out is not None:
            write_table(grades, self.out, drawn)
            console.print(f"table: {self.out}", soft_wrap=True)
        return 0
