"""``bench field-soak``: hours at a street that breaks down every ten minutes."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Target, require_positive
from studies.errors import MeasurementError
from ugat_marl.effects import load_scenario
from ugat_marl.progress import Reporter, Silent


@dataclass(frozen=True)
class FieldSoakBench:
    """Drive lights for hours while something fails in every ten minutes.

    Lights get stuck, follow late or run a plan of their own; the street is gone or
    stuck; the loop is killed or stopped; its disk is full, its policy late, its
    counts are wrong. An observer who shares no code with the loop counts seconds
    in which lights break a rule.

    Examples:
        python -m studies.bench field-soak --hours 2

    Attributes:
        hours: Hours to simulate.
        scenario: Shipped scenario of the street.
        seed: Seed of the faults and of the traffic.
        subject: The loop, or a blind one that does not look at what lights show.
        out: JSON file to write.
    """

    hours: int = 24
    scenario: str = "grid2x2-v1"
    seed: int = 1
    subject: Literal["loop", "blind"] = "loop"
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("field-soak", hours=self.hours)

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: The street or the loop failed for good.
        """
        network = load_scenario(self.scenario).network.path
        if network is None or not (network.parent / "scenario.toml").exists():
            raise MeasurementError(f"{self.scenario}: is not a directory; take a shipped scenario")
        asked = {
            "directory": str(network.parent),
            "seconds": 3600 * self.hours,
            "seed": self.seed,
            "subject": self.subject,
        }
        begun = time.monotonic()
        with (reporter or Silent()).task(f"{self.hours} h with faults", 1):
            found = in_fresh_process(["-m", "studies.bench.soak_program"], asked, timeout_s=86400)
        rows = [
            {"fault": kind, "times": times, "unsafe [s]": found["unsafe_during"].get(kind, 0)}
            for kind, times in sorted(found["begun"].items())
        ]
        later = found["unsafe_during"].get("no fault", 0)
        rows.append({"fault": "no fault", "times": 1, "unsafe [s]": later})
        decisions, sources = found["decisions"], found["sources"]
        notes = [
            f"{found['seconds'] / 3600:.1f} h in {time.monotonic() - begun:.0f} s, "
            f"{found['connections']} connections, {decisions} decisions in the log, "
            f"{sources.get('policy', 0) / max(decisions, 1):.0%} of them by the policy alone",
            "faults of decisions: "
            + ", ".join(f"{kind} {count}" for kind, count in sorted(found["reasons"].items())),
            *(f"{rule}: {count}" for rule, count in sorted(found["broken"].items())),
            *found["examples"],
        ]
        targets = [
            Target("unsafe seconds", found["unsafe"], 0.0, at_least=False),
            Target("files left over", len(found["left"]), 0.0, at_least=False),
        ]
        report = Report("field-soak", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report
