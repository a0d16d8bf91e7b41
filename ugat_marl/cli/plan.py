"""``ugat-marl plan``: fixed-time signal plans in and out."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import given_words, refuse_options, require_numbers, unused
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.errors import OptionError, counted, listed
from ugat_marl.experiments import TUNING_SEED, policy_factory, typical_plans
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars
from ugat_marl.reporting import LIGHT_HEADING, LightNames, titled_table
from ugat_marl.scenarios import (
    Network,
    Scenario,
    SignalPlan,
    copy_papers,
    is_utdf,
    new_folder,
    offset_notes,
    programme_notes,
    read_plans,
    read_utdf,
    refusal_notes,
    with_plans,
    write_plans,
    yellow_notes,
)


@dataclass(frozen=True)
class Plan:
    """Write signal plans as a table, or put a table's plans into a scenario.

    The table has a row for every phase: cycle, offset, split, yellow and all-red in s, ring and
    barrier, and the movements with green, as NBL for a left turn of northbound traffic. It
    holds the programmes of the network, as a template to change, or the typical plans of --policy.
    With --apply, out is a new scenario whose lights run the plans as their programme.

    Examples:
        ugat-marl plan single-v1 --out plans.csv
        ugat-marl plan single-v1 --apply plans.csv --out my-planned
        ugat-marl plan my-city --apply synchro.csv --lights 1=A1 2=B1 --out my-city-planned
        ugat-marl plan single-v1 --policy largest-queue:20 --domain V4 --out typical.csv

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        out: CSV file to write, or with --apply the directory of the new scenario.
        policy: Rule, or file of a policy, whose typical behaviour becomes a plan.
        domain: Domain in which the policy is played.
        seeds: Number of episodes of the policy.
        first_seed: Seed of the first episode; the default is none of those that `evaluate` plays.
        apply: Table of plans, or combined UTDF file of Synchro.
        lights: Lights of the intersections of a UTDF file, as INTID=LIGHT; not needed where both
            ids are the same.
        force: Replace a table or scenario of the name --out.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    out: Path
    policy: Annotated[str | None, arg(metavar="POLICY", help_behavior_hint="(default: none)")] = (
        None
    )
    domain: str = "sim"
    seeds: int = 3
    first_seed: int = TUNING_SEED
    apply: Annotated[Path | None, unused("FILE")] = None
    lights: tuple[str, ...] = ()
    force: bool = False

    def run(self, console: Console) -> int:
        """Write the table or the scenario, and show the plans."""
        if self.apply is not None and self.policy is not None:
            raise OptionError("--apply reads plans and --policy makes them; leave out one of them")
        if self.apply is not None:
            played = ("domain", "seeds", "first_seed")
            refuse_options(self, played, "--apply reads plans and plays no episode")
        else:
            refuse_options(self, ("lights",), "without --apply a table is written")
            if self.out.exists() and not self.force:
                raise OptionError(
                    f"--out {self.out}: is there, perhaps with changes of yours; give another "
                    "name, or --force to replace it"
                )
        if self.policy is None:
            refuse_options(
                self,
                ("seeds", "first_seed"),
                "without --policy the programmes are written as they are",
            )
        require_numbers(1, seeds=self.seeds)
        require_numbers(0, first_seed=self.first_seed)
        scenario = load_scenario(self.scenario)
        if self.apply is not None:
            return self._put(scenario, self.apply, console)
        require_writable(self.out)
        plans = typical_plans(
            scenario,
            policy_factory(self.policy or "programme"),
            self.domain,
            range(self.first_seed, self.first_seed + self.seeds),
            Bars(console),
        )
        played = scenario_in_domain(scenario, self.domain)
        network = Network.read(played)
        write_plans(self.out, plans, network)
        console.print(plan_table(plans, LightNames.of(network)))
        out, name = shlex.quote(str(self.out)), shlex.quote(self.scenario)
        notes = programme_notes if self.policy in (None, "programme") else refusal_notes
        for note in (*notes(played, plans, str(self.out)), *yellow_notes(plans)):
            console.print(f"note: {note}", soft_wrap=True)
        console.print(f"plans: {out}", soft_wrap=True)
        console.print(
            f"next: ugat-marl plan {name} --apply {out} --out NEW, then ugat-marl evaluate NEW "
            "--policies programme",
            soft_wrap=True,
        )
        return 0

    def _put(self, scenario: Scenario, table: Path, console: Console) -> int:
        notes: Sequence[str] = ()
        if is_utdf(table):
            plans, notes = read_utdf(table, Network.read(scenario), self._lights())
        elif self.lights:
            raise OptionError("--lights is for UTDF files; this table names the lights itself")
        else:
            plans = read_plans(table)
        planned = with_plans(scenario, plans, str(table))
        network = Network.read(planned)
        with new_folder(self.out, force=self.force) as folder:
            planned.write(folder)
            programmes = f"Its lights have the programmes of `{table.name}` (`ugat-marl plan`)."
            copy_papers(Path(self.scenario), folder, self.out.name, programmes, self._command())
        console.print(plan_table(plans, LightNames.of(network)))
        lights = {light.id for light in network.intersections}
        without = sorted(lights - {plan.light for plan in plans})
        if without:
            notes = (*notes, f"{listed(without, 'light')} without a plan; own programme kept")
        for note in (*notes, *offset_notes(plans), *yellow_notes(plans)):
            console.print(f"note: {note}", soft_wrap=True)
        name = shlex.quote(str(self.out))
        console.print(
            f"{self.out}: {scenario.id} with programmes from {counted(len(plans), 'plan')}\n"
            f"next: ugat-marl evaluate {name} --policies programme --domains sim",
            soft_wrap=True,
        )
        return 0

    def _command(self) -> str:
        """Return the command line that makes the same scenario again."""
        words = ["ugat-marl", "plan", self.scenario, "--out", str(self.out)]
        in_place = self.out.resolve() == Path(self.scenario).resolve()
        return shlex.join([*words, *given_words(self, without=() if in_place else ("force",))])

    def _lights(self) -> dict[str, str]:
        pairs: dict[str, str] = {}
        for text in self.lights:
            name, equals, light = text.partition("=")
            if not (name and equals and light):
                raise OptionError(f"--lights {text}: give INTID=LIGHT, as in 1=A1")
            if name in pairs or light in pairs.values():
                raise OptionError(f"--lights {text}: intersection or light is given twice")
            pairs[name] = light
        return pairs


def plan_table(plans: Sequence[SignalPlan], names: LightNames) -> Table:
    """Return the plans as a table, with the green time of each phase; rings if there are some."""
    table = titled_table("")
    rings = any((phase.ring, phase.barrier) != (1, 1) for plan in plans for phase in plan.phases)
    headings = (LIGHT_HEADING, "cycle", "offset", *(["ring"] if rings else []), "phase", "turns")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for heading in ("split", "green", "yellow", "all-red"):
        table.add_column(heading, justify="right")
    for plan in plans:
        for number, phase in enumerate(plan.phases, 1):
            first = (names.text(plan.light), f"{plan.cycle_s:g}", f"{plan.offset_s:g}")
            cells = first if number == 1 else ("", "", "")
            times = (phase.split_s, phase.green_s, phase.yellow_s, phase.all_red_s)
            ring = [f"{phase.ring}|{phase.barrier}"] if rings else []
            texts = (*cells, *ring, f"{number}", " ".join(phase.movements) or "-")
            table.add_row(*map(Text, texts), *(f"{seconds:g}" for seconds in times))
    return table
