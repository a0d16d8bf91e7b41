"""``ugat-marl policy-gap``: measure what a diagnosis changes for policies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import LengthS, Workers, require_names, require_numbers
from ugat_marl.cli.diagnose import REPORT
from ugat_marl.cli.evaluate import names_of
from ugat_marl.diagnosis import FILE
from ugat_marl.effects import domain_label, load_scenario, same_for_agents
from ugat_marl.experiments import policy_factory, policy_gap, read_diagnosis, write_policy_gap
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars
from ugat_marl.reporting import (
    DIAGNOSIS_TITLE,
    commands_on_page,
    policy_gap_table,
    require_page_place,
    write_diagnosis_page,
)
from ugat_marl.scenarios import Network


@dataclass(frozen=True)
class PolicyGap:
    """Measure how much a diagnosis shrinks the gap of policies to the real domain.

    Play the policies in sim, in the corrected scenario and in the real domain.

    The travel times are printed, and stand in DIR/diagnosis.json and report.html in the place of
    those of an earlier call.

    Examples:
        ugat-marl policy-gap single-v1 found --real V4
        ugat-marl policy-gap single-v1 found --real V4 --policies mine.pt

    Attributes:
        scenario: The scenario that was diagnosed.
        directory: Directory that diagnose wrote, its --out.
        real: Domain in which the data were recorded, as given to record. Data of a street have
            none.
        policies: Rules (fixed-time:30, largest-queue:20, max-pressure:10, programme, random)
            and files of trained policies.
        seeds: Number of episodes of each policy in each of the three.
        first_seed: Seed of the first episode.
        duration_s: Length of an episode in s.
        workers: Simulations at a time.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    directory: Annotated[Positional[Path], arg(metavar="DIR")]
    real: str
    policies: tuple[str, ...] = ("fixed-time:30", "max-pressure:20")
    seeds: int = 5
    first_seed: int = 1000
    duration_s: LengthS = None
    workers: Workers = None

    def run(self, console: Console) -> int:
        """Play, write and print."""
        require_names(policies=self.policies)
        require_numbers(1, seeds=self.seeds, workers=self.workers)
        require_numbers(0, first_seed=self.first_seed)
        scenario = load_scenario(self.scenario, self.duration_s)
        diagnosis, corrected = read_diagnosis(self.directory, scenario, self.duration_s)
        require_writable(self.directory / FILE)
        require_page_place(self.directory / REPORT, DIAGNOSIS_TITLE)
        if same_for_agents(corrected, scenario):
            console.print("note: only detectors were at fault; the traffic was not corrected")
        files = [Path(spec).suffix == ".pt" for spec in self.policies]
        names = [
            f"{name}.pt" if file else name
            for name, file in zip(names_of(self.policies), files, strict=True)
        ]
        gaps = policy_gap(
            scenario,
            corrected,
            self.real,
            dict(zip(names, map(policy_factory, self.policies), strict=True)),
            range(self.first_seed, self.first_seed + self.seeds),
            Bars(console),
            duration_s=self.duration_s,
            workers=self.workers,
        )
        diagnosis = write_policy_gap(self.directory, diagnosis, gaps)
        page = self.directory / REPORT
        if page.is_file():  # diagnose --no-report writes no page
            commands = commands_on_page(page)
            write_diagnosis_page(diagnosis, Network.read(scenario), page, commands)
        title = f"{scenario.id}: average travel time in s, real: {domain_label(self.real)}"
        console.print(policy_gap_table(title, gaps, self.seeds))
        return 0
