"""``ugat-marl record``: record measured data of a domain under a controller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import LengthS, Workers, require_numbers
from ugat_marl.data import as_counts, require_interval, require_replaceable, write_measured
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.errors import OptionError, listed
from ugat_marl.experiments import policy_factory, record
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars


@dataclass(frozen=True)
class Record:
    """Measure a simulation as a street is measured: detections and signals.

    Examples:
        ugat-marl record single-v1 --domain V4 --out measured
        ugat-marl record single-v1 --domain headway=1.4 --periods 3 --out slow

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        out: Directory to write (docs/reference/measured-data.md). What record or import-atspm wrote
            there is replaced; other measured data are refused.
        domain: Domain to measure: sim, V1 to V4, effects (headway=1.4+acceleration=1), or the
            directory of another scenario on the same network.
        policy: Controller of the signals: a rule (fixed-time:30, largest-queue:20,
            max-pressure:10, programme, random) or the file of a trained policy.
        periods: Number of days. The last 40 % are held out: a diagnosis is judged on them.
        seed: Root of the seeds of all days.
        duration_s: Length of a day in s.
        day_to_day: Standard deviation of the whole demand of a day, as a share of its mean.
        same_demand: Use the scenario's own vehicles on every day, instead of drawing each day anew.
        detector_length_m: Length of the detection zones in m, less near the start of a lane; 0 for
            points.
        speeds: Measure speeds and lengths at the detectors.
        lanes: Also record vehicles, halting and mean speed per lane and second.
        trajectories: Also record the position of every vehicle at every second.
        counts_every_s: Write counts, occupancies and mean speeds of intervals of this length in s,
            as detectors of cities and motorways report, in place of single detections.
        workers: Simulations at a time.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    out: Path
    domain: str = "sim"
    policy: str = "fixed-time:30"
    periods: int = 5
    seed: int = 0
    duration_s: LengthS = None
    day_to_day: float = 0.0
    same_demand: bool = False
    detector_length_m: float = 0.0
    speeds: bool = True
    lanes: bool = False
    trajectories: bool = False
    counts_every_s: float | None = None
    workers: Workers = None

    def run(self, console: Console) -> int:
        """Record and write."""
        scenario = load_scenario(self.scenario, self.duration_s)
        # a wrong name is an error before anything is written
        scenario_in_domain(scenario, self.domain, recorded=True, duration_s=self.duration_s)
        policy = policy_factory(self.policy)
        if self.counts_every_s is not None:
            require_interval(self.counts_every_s)
        require_numbers(1, periods=self.periods, workers=self.workers)
        require_numbers(0, seed=self.seed)
        require_replaceable(self.out)
        is_new = not self.out.exists()
        require_writable(self.out / "periods.csv")
        try:
            measured = record(
                scenario,
                self.domain,
                policy,
                periods=self.periods,
                seed=self.seed,
                duration_s=self.duration_s,
                same_demand=self.same_demand,
                day_to_day=self.day_to_day,
                detector_length_m=self.detector_length_m,
                speeds=self.speeds,
                lanes=self.lanes,
                trajectories=self.trajectories,
                workers=self.workers,
                reporter=Bars(console),
            )
        except BaseException:  # an interruption, too, leaves no empty folder
            if is_new:
                self.out.rmdir()
            raise
        seen = sum(len(log) for period in measured.periods for log in period.passages.values())
        empty = [p.id for p in measured.periods if not any(map(len, p.passages.values()))]
        if empty:
            if is_new:
                self.out.rmdir()
            raise OptionError(
                f"nobody came over a detector in {listed(empty, 'period')}; give longer days with "
                "--duration-s, or other traffic"
            )
        if self.counts_every_s is not None:
            measured = as_counts(measured, self.counts_every_s)
        write_measured(measured, self.out)
        console.print(
            f"{seen} passages over {len(measured.detectors)} detectors in {self.periods} "
            f"period(s): {self.out}",
            soft_wrap=True,
        )
        return 0
