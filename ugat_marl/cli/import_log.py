"""``ugat-marl import-log``: convert measured data to a log of transitions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.data import read_measured, require_log_place
from ugat_marl.effects import load_scenario
from ugat_marl.grounding import DetectionConfig, MeasuredPeriods, MeasuredSource, log_of_measured
from ugat_marl.scenarios import Network


@dataclass(frozen=True)
class ImportLog:
    """Turn measured data of a street into a log of transitions, for `train --real-log`.

    Phases come from the signals, vehicles on lanes and the service of greens from detections.

    What the log does not know is printed (docs/how-to/street-log.md).

    Examples:
        ugat-marl import-log my-scenario street --out street.parquet
        ugat-marl train my-scenario --real none --real-log street.parquet

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        measured: Directory with measured data (docs/reference/measured-data.md).
        out: Parquet file to write.
        observation: Observation to record: movements, count, queue, pressure, density. The learner
            universal reads movements by default.
        vehicles: Source of the vehicles on lanes: best (a table of lanes or trajectories if there
            is one, else detections) or detections.
        periods: Periods to take: fit (those to which models are fitted) or all (those held out as
            well, on which they are judged).
        latency_s: Constant delay of the detectors' stamps, in s; it is taken off them.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    measured: Annotated[Positional[Path], arg(metavar="MEASURED")]
    out: Path
    observation: str = "movements"
    vehicles: MeasuredSource = "best"
    periods: MeasuredPeriods = "fit"
    latency_s: float = 0.0

    def run(self, console: Console) -> int:
        """Import the data, write the log, and print what it does not know."""
        require_log_place(self.out)
        scenario = load_scenario(self.scenario)
        network = Network.read(scenario)
        measured = read_measured(self.measured, scenario, network)
        place = self.measured.resolve().name
        numbers = DetectionConfig(latency_s=self.latency_s)
        imported = log_of_measured(
            measured,
            scenario,
            network,
            place,
            self.observation,
            self.vehicles,
            numbers,
            self.periods,
        )
        imported.log.write(self.out)
        for finding in (*(finding.text for finding in measured.findings), *imported.findings):
            console.print(f"- {finding}", soft_wrap=True)
        console.print(
            f"{len(imported.log)} transitions of {imported.log.episodes} periods: {self.out}",
            soft_wrap=True,
        )
        return 0
