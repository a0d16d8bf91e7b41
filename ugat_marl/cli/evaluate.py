"""``ugat-marl evaluate``: play policies and rules in domains and compare them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from ugat_marl.effects import NAMED_DOMAINS, expand_domains, load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, OutputError, ScenarioError, UgatMarlError
from ugat_marl.experiments import Evaluation, domains_by_gap, evaluation_of, policy_factory
from ugat_marl.files import distinct_endings, require_writable
from ugat_marl.progress import Bars
from ugat_marl.reporting import (
    gap_matrix_table,
    measures_table,
    objective_tables,
    service_tables,
)
from ugat_marl.scenarios import Network, Scenario

MOST_IN_DETAIL = 8
"""Most domains in the detailed table; more are shown as a matrix of controllers and gaps."""


@dataclass(frozen=True)
class Evaluate:
    """Play policies in domains with several seeds; print measures, gaps and regret.

    Examples:
        ugat-marl evaluate single-v1 --policies largest-queue:20 max-pressure programme
        ugat-marl evaluate single-v1 --policies runs/demo/policies/fitted-street.pt
        --domains sim V4
        ugat-marl evaluate single-v1 --domains all --seeds 1 --duration-s 900

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        policies: Rules (such as fixed-time:30, actuated:40, largest-queue:20, max-pressure:10,
            programme; docs/reference/rules.md has them all), files of trained policies, and your
            own policies as my_module:my_policy.
        domains: Domains; gaps are differences from the first. "all" is sim and every named domain
            but meso. "observation", "action", "transition" or "reward" is every domain of this
            gap; see ugat-marl domains.
        seeds: Number of episodes of each policy in each domain.
        first_seed: Seed of the first episode.
        duration_s: Length of an episode in s.
        workers: Simulations at a time.
        ray: Play on Ray instead.
        out: JSON file for the table and every episode.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    policies: tuple[str, ...] = ("programme", "largest-queue:20", "max-pressure:10", "random")
    domains: tuple[str, ...] = ("sim", "V1", "V2", "V3", "V4")
    seeds: int = 5
    first_seed: int = 1000
    duration_s: LengthS = None
    workers: Workers = None
    ray: RayAddress = None
    out: Path | None = None

    def run(self, console: Console) -> int:
        """Evaluate and print."""
        require_names(policies=self.policies, domains=self.domains)
        if self.out is not None:
            _require_place(self.out)
        require_numbers(0, first_seed=self.first_seed)
        require_numbers(1, seeds=self.seeds, workers=self.workers)
        scenario = load_scenario(self.scenario, self.duration_s)
        domains = self._domains(scenario, console)
        with workers_of(self.workers, self.ray) as workers:
            evaluation = evaluation_of(
                scenario,
                dict(zip(names_of(self.policies), map(policy_factory, self.policies), strict=True)),
                domains,
                range(self.first_seed, self.first_seed + self.seeds),
                duration_s=self.duration_s,
                workers=workers,
                reporter=Bars(console),
                approaches=True,
            )
        if self.out is not None:
            evaluation.write(self.out)
        if len(domains) > MOST_IN_DETAIL and domains_by_gap(evaluation):
            console.print(gap_matrix_table(evaluation))
        else:
            console.print(measures_table(evaluation))
        for table in objective_tables(evaluation):
            console.print(table)
        for table in service_tables(evaluation, Network.read(scenario)):
            console.print(table)
        if self.out is not None:
            console.print(f"table: {self.out}", soft_wrap=True)
        return 0

    def _domains(self, scenario: Scenario, console: Console) -> list[str]:
        """Return the names of all domains, without those that do not fit the network."""
        names: list[str] = []
        for name in expand_domains(self.domains):
            if name in NAMED_DOMAINS and name not in self.domains and _may_not_fit(name):
                try:
                    parallel_env(scenario, name, duration_s=self.duration_s)
                except (OptionError, ScenarioError) as error:
                    console.print(f"{name} is left out: {error}", style="dim")
                    continue
            names.append(name)
        return names


def _require_place(out: Path) -> None:
    """Refuse a path that cannot become a table, or whose file is no earlier one of this command."""
    require_writable(out, ".json")
    if not out.exists():
        return
    try:
        Evaluation.read(out)
    except UgatMarlError:
        raise OutputError(
            f"{out}: is no table of `ugat-marl evaluate`, and would be lost; give another name"
        ) from None
    place = out.resolve()  # a link is followed
    if place.name == "table.json" and place.with_name("run.json").exists():
        raise OutputError(
            f"{out}: is the table of a training, and would be lost; give another name"
        )


def _may_not_fit(name: str) -> bool:
    """Return true if a domain may not fit the network or the episode.

    Not every network has a barrier order of phases or a lane long enough for an incident. With late
    demand, all vehicles may come after the end of a short episode. A detection zone does not go
    with a reach, nor with the queue model. A longest green has to hold one decision, and a delay
    at least half of one.
    """
    words = (
        "phase_order=barrier", "incident=", "demand_timing=", "detection_zone=", "max_green=",
        "observation_delay=", "execution_delay=",
    )  # fmt: skip
    return any(word in NAMED_DOMAINS[name].effects for word in words)


def names_of(policies: Sequence[str]) -> list[str]:
    """Return names for the table: rules as given, files by the shortest endings that differ."""
    names = distinct_endings(Path(spec.removesuffix(".pt")) for spec in policies) or policies
    files = [Path(spec).suffix == ".pt" for spec in policies]
    return [name if file else spec for name, file, spec in zip(names, files, policies, strict=True)]
