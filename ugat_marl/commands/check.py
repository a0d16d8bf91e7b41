"""``ugat-marl check``: is a scenario sound, and its environment what learners expect?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.effects import load
from ugat_marl.progress import Bars
from ugat_marl.testing import (
    Result,
    check_determinism,
    check_environment,
    check_scenario,
    failures,
    report,
)
from ugat_marl.traffic_env import TrafficEnv, parallel_env


@dataclass(frozen=True)
class Check:
    """Runs the conformance kit on a scenario and its environment; leaves with 1 if a check fails.

    Examples:
        ugat-marl check single-v1
        ugat-marl check path/to/my.sumocfg --domain V3

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        domain: Domain to check in.
        observation: Observation to check with.
        duration_s: Length of the episodes played in s; short ones suffice.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    domain: str = "sim"
    observation: str = "count"
    duration_s: float = 300.0

    def run(self, console: Console) -> int:
        """Checks and prints."""
        scenario = load(self.scenario)

        def make() -> TrafficEnv:
            options: dict[str, Any] = {"observation": self.observation}
            return parallel_env(scenario, self.domain, duration_s=self.duration_s, **options)

        make()
        results: list[Result] = []
        with Bars(console).task(f"checking {scenario.id}", 3) as advance:
            for check in (
                lambda: check_scenario(self.scenario),
                lambda: check_environment(make),
                lambda: check_determinism(make),
            ):
                results += check()
                advance()
        console.print(report(results))
        return 1 if failures(results) else 0
