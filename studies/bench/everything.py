"""``bench all``: run all benches that measure time and memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from studies.bench.env import EnvBench
from studies.bench.fitting import FittingBench
from studies.bench.learning import LearningBench
from studies.bench.memory import MemoryBench
from studies.bench.report import Report
from ugat_marl.progress import Reporter


@dataclass(frozen=True)
class AllBench:
    """Run all benches of time and memory, one after the other.

    Examples:
        python -m studies.bench all --env.rounds 3 --out bench

    Attributes:
        env: Options of ``bench env``.
        learning: Options of ``bench learning``.
        fitting: Options of ``bench fitting``.
        memory: Options of ``bench memory``.
        out: Folder for one JSON file per bench.
    """

    env: EnvBench = field(default_factory=EnvBench)
    learning: LearningBench = field(default_factory=LearningBench)
    fitting: FittingBench = field(default_factory=FittingBench)
    memory: MemoryBench = field(default_factory=MemoryBench)
    out: Path | None = None

    def run(self, reporter: Reporter | None = None) -> list[Report]:
        """Measure all of them; write each report when its bench ends.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: A measured process failed.
        """
        reports: list[Report] = []
        for name in ("env", "learning", "fitting", "memory"):
            bench: EnvBench | LearningBench | FittingBench | MemoryBench = getattr(self, name)
            if self.out is not None and bench.out is None:
                bench = replace(bench, out=self.out / f"{name}.json")
            reports.append(bench.run(reporter))
        return reports
