"""``ugat-marl scenario check``: show facts about a scenario and check it."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import LengthS, Workers, refuse_options, require_numbers
from ugat_marl.diagnosis import clock
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import OptionError, counted
from ugat_marl.experiments import (
    HOLDS_S,
    MUCH_LESS,
    HeadroomRow,
    RuleEpisode,
    as_json,
    best_phases,
    degree_with,
    is_full,
    left_outside,
    measure_headroom,
    play_check_rules,
    problems,
    remarks,
)
from ugat_marl.progress import Bars, Silent
from ugat_marl.reporting import LIGHT_HEADING, LightNames, control_delay_table, titled_table
from ugat_marl.scenarios import (
    PHASE_SOURCES,
    SHORT_LANE_M,
    IntersectionFacts,
    Network,
    Survey,
    confinement_missing,
    survey,
)
from ugat_marl.testing import (
    CheckResult,
    check_determinism,
    check_environment,
    check_report,
    check_scenario,
    failed_checks,
)

CONFORMANCE_S = 300.0
MOST_APPROACHES = 8
MOST_LIGHTS = 8


@dataclass(frozen=True)
class ScenarioCheck:
    """Show facts about a scenario; exit with 1 if something has to be fixed.

    It plays an episode under the network's own programme and one under a good rule.

    With --conformance it runs the conformance kit (docs/reference/conformance.md).

    Examples:
        ugat-marl scenario check single-v1
        ugat-marl scenario check my-city --headroom 2
        ugat-marl scenario check my-city --json > my-city.json
        ugat-marl scenario check my.sumocfg --conformance --domain V3

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        domain: Domain that is shown or checked.
        headroom: Number of seeds for the headroom, 25 episodes each. 0 leaves it out.
        simulate: Play the two episodes.
        seed: Seed of the episodes.
        json: Print JSON instead of tables.
        conformance: Run the conformance kit on scenario and environment instead.
        observation: Observation for the conformance kit.
        duration_s: Length of the episodes, s (300 for the conformance kit).
        workers: Simulations at a time.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    domain: str = "sim"
    headroom: int = 0
    simulate: bool = True
    seed: int = 1
    json: bool = False
    conformance: bool = False
    observation: str = "count"
    duration_s: LengthS = None
    workers: Workers = None

    def run(self, console: Console) -> int:
        """Check and print."""
        if self.conformance:
            refuse_options(
                self,
                ("headroom", "simulate", "seed", "json", "workers"),
                "--conformance runs the conformance kit instead",
            )
            return self._kit(console)
        refuse_options(self, ("observation",), "only --conformance reads an observation")
        require_numbers(1, workers=self.workers)
        require_numbers(0, headroom=self.headroom, seed=self.seed)
        if self.headroom and self.domain != "sim":
            raise OptionError("--headroom plays sim and V1 to V4 by itself; leave out --domain")
        scenario = scenario_in_domain(
            load_scenario(self.scenario, self.duration_s), self.domain, duration_s=self.duration_s
        )
        reporter = Silent() if self.json else Bars(console)
        facts = survey(scenario, reporter)
        runs = (
            play_check_rules(scenario, self.seed, self.workers, reporter) if self.simulate else ()
        )
        rows = None
        if self.headroom:
            rows = measure_headroom(
                scenario, seeds=range(self.headroom), workers=self.workers, reporter=reporter
            )
        outside = left_outside(scenario, self.seed) if is_full(runs, facts.duration_s) else {}
        wrong = problems(facts, runs, outside)
        if self.json:
            content = as_json(facts, runs, rows, wrong, outside)
            print(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))
        else:
            network = Network.read(scenario)
            show(console, facts, scenario.settings.begin_s, runs, rows, wrong, network)
            if reason := confinement_missing():
                console.print(
                    f"note: simulations are not confined, because {reason}; see SECURITY.md before "
                    "you run files of others",
                    soft_wrap=True,
                )
        return 1 if wrong else 0

    def _kit(self, console: Console) -> int:
        length_s = CONFORMANCE_S if self.duration_s is None else self.duration_s
        scenario = load_scenario(self.scenario, length_s)

        def make() -> TrafficEnv:
            options: dict[str, Any] = {"observation": self.observation}
            return parallel_env(scenario, self.domain, duration_s=length_s, **options)

        make()
        results: list[CheckResult] = []
        with Bars(console).task(f"checking {scenario.id}", 3) as advance:
            for check in (
                lambda: check_scenario(self.scenario),
                lambda: check_environment(make),
                lambda: check_determinism(make),
            ):
                results += check()
                advance()
        console.print(check_report(results))
        return 1 if failed_checks(results) else 0


def show(
    console: Console,
    facts: Survey,
    begin_s: float,
    runs: Sequence[RuleEpisode],
    rows: Sequence[HeadroomRow] | None,
    wrong: Sequence[str],
    network: Network,
) -> None:
    """Print everything as tables that fit 80 columns; `begin_s` is the episode's start, s."""

    def say(text: str) -> None:
        console.print(text, soft_wrap=True)

    agents, names = facts.intersections, LightNames.of(network)
    say(
        f"{facts.scenario}: {counted(len(agents), 'agent')}, "
        f"{sum(len(light.phases) for light in agents)} green phases, "
        f"{sum(light.lanes for light in agents)} lanes, "
        f"{sum(light.movements for light in agents)} movements, "
        f"{sum(light.conflicts for light in agents)} conflicts"
    )
    say(
        f"episode {facts.duration_s:g} s, {facts.decisions} decisions; shortest useful "
        f"{facts.shortest_episode_s:g} s (the network fills in {facts.fill_s:g} s)"
    )
    flows = f" and {counted(facts.flows, 'flow')}" if facts.flows else ""
    first, last, busiest = (
        clock(begin_s + seconds) for seconds in (facts.first_s, facts.last_s, facts.busiest_s)
    )
    say(
        f"demand {counted(facts.vehicles, 'vehicle')}{flows}, the first at {first} on the "
        "scenario's clock"
    )
    say(
        f"they depart until {last}, most from {busiest} on: "
        f"{facts.busiest} within {facts.busiest_length_s / 60:g} min"
    )
    for text in _no_agents(facts):
        say(text)
    console.print(_intersections(agents, names))
    for light in [light for light in agents if light.name][:MOST_LIGHTS]:
        say(f"{names.text(light.id)}: {light.name}")
    for text in _greens_of_file(agents, names):
        console.print(text)
    console.print(_approaches(agents, names))
    console.print(_phase_sources(agents, names))
    if short := sum(len(light.short_lanes) for light in agents):
        say(
            f"lanes at lights that are shorter than {SHORT_LANE_M:g} m: {short}. Agents see nobody "
            "upstream of them; reach_m = 100 under [control], or the effect reach=100, counts those"
        )
    if runs:
        console.print(_runs(runs))
        delays = {run.rule: run.approaches for run in runs}
        console.print(
            control_delay_table("Control delay and level of service (HCM)", delays, network)
        )
    if rows is None:
        say("headroom: not measured; --headroom 1 measures it with one seed")
    else:
        console.print(_headroom(rows))
    for text in remarks(facts, runs):
        say(f"note: {text}")
    for text in wrong:
        say(f"to fix: {text}")
    if not wrong:
        say("nothing to fix")


def _no_agents(facts: Survey) -> Iterator[str]:
    """Yield which lights are no agents, once for each reason."""
    without: dict[str, list[str]] = defaultdict(list)
    for tls in facts.uncontrolled:
        without[facts.reasons[tls]].append(tls)
    for reason, lights in without.items():
        if len(lights) == 1:
            yield f"no agent: traffic light {lights[0]!r}: {reason}"
        else:
            yield f"no agents: {', '.join(lights)}: {reason}"


def _table(title: str, *columns: str) -> Table:
    table = titled_table(title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", overflow="fold")
    return table


def _intersections(agents: Sequence[IntersectionFacts], names: LightNames) -> Table:
    """Return the table of intersections, with one row for all that are alike."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for light in agents:
        groups.setdefault(_row(light), []).append(names.text(light.id))
    table = _table(
        "Intersections", LIGHT_HEADING, "lanes", "links", "movem.", "conflicts", "phases", "remarks"
    )
    table.columns[-1].justify = "left"
    for row, lights in groups.items():
        listed = ", ".join(lights)
        if len(lights) > 3:
            listed = f"{len(lights)}: {lights[0]} ... {lights[-1]}"
        table.add_row(listed, *row)
    return table


def _row(light: IntersectionFacts) -> tuple[str, ...]:
    permitted = sum(bool(phase.permitted) for phase in light.phases)
    remarks = {
        ("junction", " joined"): len(light.junctions) if len(light.junctions) > 1 else 0,
        ("phase", " with permitted turns"): permitted,
        ("link", " on red after a stop"): light.right_on_red,
        ("link", " always green"): light.always_green,
        ("U-turn", ""): light.u_turns,
        ("crossing", ""): light.crossings,
        ("crossing", " never green"): light.unserved_crossings,
        ("phase", " for people on foot alone"): light.foot_phases,
        ("link", " without a light"): light.uncontrolled,
        ("link", " never green"): len(light.unserved_links),
        ("lane", " served in part"): len(light.partly_served),
        ("lane", " counted with those behind"): len(light.lanes_behind),
    }
    counts = (light.lanes, light.links, light.movements, light.conflicts, len(light.phases))
    told = (f"{counted(n, noun)}{rest}" for (noun, rest), n in remarks.items() if n)
    return (*map(str, counts), "; ".join(told))


def _greens_of_file(agents: Sequence[IntersectionFacts], names: LightNames) -> list[str]:
    """Return lines on which green of the file's programme each phase is."""
    kinds: dict[tuple[int | None, ...], list[str]] = {}
    for light in agents:
        greens = tuple(phase.green_of_file for phase in light.phases)
        kinds.setdefault(greens, []).append(names.text(light.id))
    parts: list[str] = []
    for greens, lights in list(kinds.items())[:MOST_LIGHTS]:
        known = [f"{n} matches green {g}" for n, g in enumerate(greens) if g is not None]
        if greens == tuple(range(len(greens))):
            known = ["n matches green n"]
        text = f"phase {', '.join(known)}" if known else "no phase matches one of its greens"
        if known and None in greens:
            text += ", the others match none of them"
        listed = f"{lights[0]} and {len(lights) - 1} more" if len(lights) > 1 else lights[0]
        parts.append(f"{listed}: {text}")
    return [f"in the file's programme, {part}" for part in parts]


def _phase_sources(agents: Sequence[IntersectionFacts], names: LightNames) -> Table:
    """Return the degree of saturation of the fullest lights with each source of phases."""
    fullest = sorted(agents, key=lambda light: -degree_with(light, "now"))[:MOST_LIGHTS]
    title = "Demand as a share of capacity with other phases, busiest quarter of an hour"
    table = _table(title, LIGHT_HEADING, "now", *PHASE_SOURCES, "best")
    for light in fullest:
        cells = [
            "-" if light.degrees.get(source) is None else f"{degree_with(light, source):.0%}"
            for source in ("now", *PHASE_SOURCES)
        ]
        source, least = best_phases(light)
        best = source if least < MUCH_LESS * degree_with(light, "now") else "as now"
        table.add_row(names.text(light.id), *cells, best)
    return table


def _approaches(agents: Sequence[IntersectionFacts], names: LightNames) -> Table:
    all_roads = [(light.id, road) for light in agents for road in light.approaches]
    all_roads.sort(key=lambda pair: pair[1].fullness, reverse=True)
    shown = all_roads[:MOST_APPROACHES]
    title = f"Saturation by approach, the highest {len(shown)} of {len(all_roads)}"
    headings = ("veh/h", "worst 15 min", "flow ratio", "own programme")
    table = _table(title, LIGHT_HEADING, "road", "lanes", *headings)
    table.columns[1].justify = "left"
    if any(phase.permitted for light in agents for phase in light.phases):
        table.caption_justify = "left"
        table.caption = (
            "Permitted greens are counted in full: saturation is higher where turns have to yield."
        )
    for name, road in shown:
        saturation = "no green" if road.saturation is None else f"{road.saturation:.0%}"
        flows = (f"{road.vph:.0f}", f"{road.worst_vph:.0f}")
        cells = (str(road.lanes), *flows, f"{road.flow_ratio:.0%}", saturation)
        table.add_row(names.text(name), road.edge, *cells)
    return table


def _runs(runs: Sequence[RuleEpisode]) -> Table:
    table = _table(
        "An episode of each rule", "rule", "ATT, s", "due", "entered", "arrived", "left outside"
    )
    for run in runs:
        counts = (run.due, run.departed, run.arrived, run.backlog)
        table.add_row(run.rule, _shown(run.att_s, ".1f"), *map(str, counts))
    return table


def _headroom(rows: Sequence[HeadroomRow]) -> Table:
    """Return the table of headroom: in each domain, the loss of the rule that is best in sim."""
    holds = [f"{hold_s} s" for hold_s in HOLDS_S]
    table = _table(
        "Headroom: ATT in s of the largest-queue rule, by hold time", "domain", *holds,
        "programme", "lost", "arrived",
    )  # fmt: skip
    for row in rows:
        cells = [
            _shown(att_s, ".1f", "*" if hold_s == row.best_hold_s else "")
            for hold_s, att_s in zip(HOLDS_S, row.att_s, strict=True)
        ]
        own, lost = _shown(row.programme_att_s, ".1f"), _shown(row.lost, ".0%")
        table.add_row(row.domain, *cells, own, lost, _shown(row.finished, ".1%"))
    return table


def _shown(value: float, form: str, mark: str = "") -> str:
    """Return a number with a mark behind it; "-" for nan."""
    return "-" if math.isnan(value) else f"{value:{form}}{mark}"
