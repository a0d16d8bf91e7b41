"""``bench field-log``: measure the time that a decision of the field loop waits for its log."""

from __future__ import annotations

import tempfile
import time
from array import array
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies.bench.report import Report, Target, require_positive
from ugat_marl.errors import OptionError
from ugat_marl.field import Decision, DecisionLog
from ugat_marl.progress import Reporter, Silent

_DAY_S = 86_400
_PARTS = 5


@dataclass(frozen=True)
class FieldLogBench:
    """Write the log of many days in one go, and time each decision.

    Examples:
        python -m studies.bench field-log --days 30

    Attributes:
        days: Days of the log.
        lights: Number of traffic lights.
        interval_s: Seconds from one decision to the next.
        folder: Folder for the log, which is removed at the end; by default that for temporary
            files.
        out: JSON file to write.
    """

    days: int = 365
    lights: int = 16
    interval_s: int = 10
    folder: Path | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive(
            "field-log", days=self.days, lights=self.lights, interval_s=self.interval_s
        )
        if self.days * self._per_day < _PARTS:
            raise OptionError(
                f"bench field-log: days = {self.days} at interval_s = {self.interval_s} hold fewer "
                f"than {_PARTS} decisions; give more days, or a shorter interval"
            )

    @property
    def _per_day(self) -> int:
        """Decisions of a day; none if the interval is longer."""
        return _DAY_S // self.interval_s

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.
        """
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            path = Path(folder) / "field.jsonl"
            taken = self._times_us(path, reporter or Silent())
            megabytes = path.stat().st_size / 1e6
        parts = np.array_split(taken, _PARTS)
        days = np.linspace(0, self.days, _PARTS + 1)
        rows = [
            {
                "days": f"{begin:g} to {end:g}",
                "median [µs]": float(np.median(part)),
                "99.9 % [µs]": float(np.quantile(part, 0.999)),
                "longest [µs]": float(part.max()),
            }
            for begin, end, part in zip(days[:-1], days[1:], parts, strict=True)
        ]
        growth = float(np.median(parts[-1]) / np.median(parts[0]))
        notes = [
            f"{len(taken)} decisions for {self.lights} lights, {megabytes:.0f} MB in the end. The "
            "longest ones add a full segment to the file and wait for the disk."
        ]
        targets = [Target("median of the last part / first part", growth, 1.5, at_least=False)]
        report = Report("field-log", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report

    def _times_us(self, path: Path, reporter: Reporter) -> NDArray[np.float64]:
        """Return the time of each call of `DecisionLog.add`, µs."""
        lights = [f"light{number}" for number in range(self.lights)]
        log = DecisionLog(path)
        taken = array("d")
        with reporter.task("days of the log", self.days) as advance:
            for number in range(self.days * self._per_day):
                phases = {light: (number + place) % 4 for place, light in enumerate(lights)}
                made = Decision(float(number * self.interval_s), phases, {}, 0.1, 1.5)
                begun = time.perf_counter()
                log.add(made)
                taken.append(1e6 * (time.perf_counter() - begun))
                if (number + 1) % self._per_day == 0:
                    advance()
        log.close()
        return np.array(taken)
