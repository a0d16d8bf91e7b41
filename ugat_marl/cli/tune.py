"""``ugat-marl tune``: find the best settings of rules in a domain."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import (
    LengthS,
    RayAddress,
    Workers,
    require_names,
    require_numbers,
    workers_of,
)
from ugat_marl.effects import domain_label, load_scenario
from ugat_marl.errors import OutputError, UnknownNameError
from ugat_marl.experiments import BUDGET, LEAST_BUDGET, tune
from ugat_marl.files import json_values, read_json, require_writable, write_whole
from ugat_marl.policies import RULE_NAMES, RULES, TUNED_RULES
from ugat_marl.progress import Bars
from ugat_marl.reporting import tuning_table


@dataclass(frozen=True)
class Tune:
    """Find the best settings of each rule in a domain by racing them.

    Examples:
        ugat-marl tune single-v1 --domain V4
        ugat-marl tune grid2x2-v1 --rules actuated max-pressure --budget 40

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        domain: The domain to tune in.
        rules: Names of rules, without their numbers.
        budget: Most episodes for each rule.
        duration_s: Length of an episode in s.
        workers: Simulations at a time.
        ray: Play on Ray instead.
        fresh: Repeat episodes that an earlier call has stored.
        out: JSON file with all settings that were tried.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    domain: str = "sim"
    rules: tuple[str, ...] = TUNED_RULES
    budget: int = BUDGET
    duration_s: LengthS = None
    workers: Workers = None
    ray: RayAddress = None
    fresh: bool = False
    out: Path | None = None

    def run(self, console: Console) -> int:
        """Tune and print."""
        require_names(rules=self.rules)
        for name in self.rules:
            if name not in RULES:
                raise UnknownNameError("rule", name, RULE_NAMES)
        require_numbers(LEAST_BUDGET, budget=self.budget)
        require_numbers(1, workers=self.workers)
        if self.out is not None:
            require_writable(self.out, ".json")
            _require_table(self.out)
        scenario, reporter = load_scenario(self.scenario, self.duration_s), Bars(console)
        with workers_of(self.workers, self.ray) as workers:
            tuned = [
                tune(
                    name,
                    scenario,
                    self.domain,
                    self.budget,
                    duration_s=self.duration_s,
                    workers=workers,
                    reporter=reporter,
                    fresh=self.fresh,
                )
                for name in self.rules
            ]
        if self.out is not None:
            content = json_values([asdict(each) for each in tuned])
            write_whole(self.out, json.dumps(content, indent=1, allow_nan=False) + "\n")
        console.print(tuning_table(f"{scenario.id} in {domain_label(self.domain)}", tuned))
        if self.out is not None:
            console.print(f"table: {self.out}", soft_wrap=True)
        return 0


def _require_table(out: Path) -> None:
    """Refuse a file that is there and no earlier table of this command."""
    if not out.exists():
        return
    try:
        rows = read_json(out, OutputError)
    except OutputError:
        rows = None
    if not isinstance(rows, list) or not all(
        isinstance(row, dict) and {"rule", "domain", "trials"} <= row.keys() for row in rows
    ):
        raise OutputError(
            f"{out}: is no table of `ugat-marl tune`, and would be lost; give another name"
        )
