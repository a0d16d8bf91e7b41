"""``bench memory``: measure the growth of an environment over many resets."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Target, require_positive
from ugat_marl.errors import OptionError
from ugat_marl.progress import Reporter, Silent

SIMULATORS = ("process", "inprocess")


@dataclass(frozen=True)
class MemoryBench:
    """Measure memory, processes and open files over many resets of an environment.

    Examples:
        python -m studies.bench memory --resets 50

    Attributes:
        scenario: Scenario to simulate.
        resets: Number of resets.
        settled: Reset after which everything is loaded; growth is counted from here.
        steps: Steps after each reset.
        seed: Seed of the actions; the seeds of the episodes follow from it.
        out: JSON file to write.
    """

    scenario: str = "grid4x4-v1"
    resets: int = 200
    settled: int = 20
    steps: int = 5
    seed: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("memory", settled=self.settled, steps=self.steps)
        if self.resets <= self.settled:
            raise OptionError(
                f"bench memory: resets = {self.resets}: must be more than settled ({self.settled})"
            )

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: The measured process failed.
        """
        rows: list[dict[str, Any]] = []
        targets: list[Target] = []
        for simulator in SIMULATORS:
            asked = {**asdict(self), "out": None, "simulator": simulator}
            with (reporter or Silent()).task(f"resets, {simulator}", 1):
                found = in_fresh_process(["-m", "studies.bench.memory_program"], asked)
            for what in found["early"]:
                early, late = float(found["early"][what]), float(found["late"][what])
                growth = 100 * growth_of(early, late)
                rows.append(
                    {
                        "simulator": simulator,
                        "what": what,
                        f"after {self.settled}": early,
                        f"after {self.resets}": late,
                        "growth [%]": growth,
                    }
                )
                limit = 5.0 if "MiB" in what else 0.0
                name = f"{simulator}: growth of {what} [%]"
                targets.append(Target(name, growth, limit, at_least=False))
        notes = [
            f"{self.scenario}, {self.resets} resets with {self.steps} steps each, measured after "
            "the steps; resident memory of all processes counts pages they share in each of them."
        ]
        report = Report("memory", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report


def growth_of(early: float, late: float) -> float:
    """Return the growth relative to `early`; from 0 to 0 it is 0, from 0 to more infinite."""
    if early == 0:
        return 0.0 if late == 0 else float("inf")
    return late / early - 1
