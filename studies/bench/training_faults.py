"""``bench training-faults``: trainings with a fault, resumed, against an unbroken one."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Target, require_positive
from ugat_marl.progress import Reporter, Silent


@dataclass(frozen=True)
class TrainingFaultsBench:
    """Disturb short trainings once each, resume them, and compare all their files.

    A training is killed, interrupted or stopped for a while; one of its simulations
    is killed or stopped; its disk is full, or it has no more descriptors. It is then
    resumed without the fault. All files must have the content of an unbroken run.

    Examples:
        python -m studies.bench training-faults --faults 14

    Attributes:
        faults: Number of trainings with a fault.
        seed: Seed of the faults and their moments.
        most_s: Time after which no further training begins, s.
        out: JSON file to write.
    """

    faults: int = 200
    seed: int = 1
    most_s: float = 36_000.0
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("training-faults", faults=self.faults)

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: The unbroken training failed.
        """
        asked = {"faults": self.faults, "seed": self.seed, "most_s": self.most_s}
        with (reporter or Silent()).task(f"{self.faults} trainings with faults", 1):
            found = in_fresh_process(
                ["-m", "studies.bench.training_faults_program"], asked, timeout_s=86_400
            )
        trainings: list[dict[str, Any]] = found["rows"]
        wrong = [row for row in trainings if row["wrong"] or row["resumed"] != "done"]
        rude = [row for row in trainings if row["first"].startswith(("traceback", "hang"))]
        rows = [_row(kind, trainings) for kind in sorted({row["kind"] for row in trainings})]
        notes = [
            f"{len(trainings)} trainings of {found['steps']} steps; {found['files']} files of each "
            "are compared.",
            *(
                f"{row['kind']} at step {row['at']}: ended with {row['first']}; resumed: "
                f"{row['resumed']}; differing: {', '.join(row['wrong'][:5]) or 'none'}"
                for row in [*wrong, *rude][:10]
            ),
        ]
        targets = [
            Target("trainings with other numbers after resume", len(wrong), 0.0, at_least=False),
            Target("trainings that hung or ended with a traceback", len(rude), 0.0, at_least=False),
        ]
        report = Report("training-faults", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report


def _row(kind: str, trainings: list[dict[str, Any]]) -> dict[str, Any]:
    own = [row for row in trainings if row["kind"] == kind]
    ends = Counter(row["first"].partition(":")[0] for row in own)
    return {
        "fault": kind,
        "trainings": len(own),
        "equal after resume": sum(not row["wrong"] and row["resumed"] == "done" for row in own),
        "ended with": ", ".join(f"{end} {count}" for end, count in ends.most_common()),
    }
