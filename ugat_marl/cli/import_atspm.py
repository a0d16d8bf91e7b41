"""``ugat-marl import-atspm``: convert a log of signal controllers to measured data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.data import import_atspm, require_replaceable, write_measured
from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Network


@dataclass(frozen=True)
class ImportAtspm:
    """Turn a high-resolution log of signal controllers (ATSPM) into measured data.

    The log has the columns TimeStamp, DeviceId, EventId and Parameter.

    The mapping gives its lights and lanes (docs/reference/measured-data.md).

    Examples:
        ugat-marl import-atspm my-scenario events.parquet mapping.toml --out street

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        events: The log, .csv or .parquet.
        mapping: TOML file that maps devices, phases and channels to the network.
        out: Directory to write. What import-atspm or record wrote there is replaced; other measured
            data are refused.
        csv: Write CSV instead of Parquet.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    events: Annotated[Positional[Path], arg(metavar="EVENTS")]
    mapping: Annotated[Positional[Path], arg(metavar="MAPPING")]
    out: Path
    csv: bool = False

    def run(self, console: Console) -> int:
        """Import the log, write the data, and print the findings."""
        scenario = load_scenario(self.scenario)
        require_replaceable(self.out)
        measured = import_atspm(self.events, self.mapping, scenario, Network.read(scenario))
        write_measured(measured, self.out, csv=self.csv)
        for finding in measured.findings:
            console.print(f"- {finding.text}", soft_wrap=True)
            if finding.rules_out:
                console.print(f"  rules out: {', '.join(finding.rules_out)}", soft_wrap=True)
        passages = sum(len(p) for period in measured.periods for p in period.passages.values())
        console.print(
            f"{len(measured.periods)} periods, {len(measured.detectors)} detectors, "
            f"{passages} passages over detectors: {self.out}",
            soft_wrap=True,
        )
        return 0
