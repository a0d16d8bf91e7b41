"""Check of a scenario: traffic must enter and pass, and controllers must differ."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ugat_marl.experiments.evaluation import evaluation_of, rule_factory
from ugat_marl.experiments.transfer_headroom import HeadroomRow
from ugat_marl.files import chunks_of, json_values, scan_xml
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import (
    IntersectionFacts,
    Scenario,
    Survey,
    demand_as_vehicles,
    departures,
    run_program,
)
from ugat_marl.simulation import launch_of

TRIPS = "trips.xml"
"""Name of the file with SUMO's report on its vehicles."""

RULES = ("programme", "largest-queue:20")
MUCH_WORSE = 1.5
"""A rule's ATT divided by the programme's above which the phases do not suit the rule."""
_NAMED = 5
MUCH_LESS = 0.9
"""A degree of saturation divided by another one below which it is worth a change of phases."""
MOST_BACKLOG = 0.01
"""Largest share of the vehicles due that may wait outside under the better rule."""
JUST_DUE_S = 10.0
"""Vehicles that are due in so many last seconds may wait for the one ahead of them."""


@dataclass(frozen=True)
class RuleEpisode:
    """Episode under a rule, in the domain that is checked.

    Attributes:
        rule: The rule.
        att_s: Average travel time of all vehicles due, in s.
        due: Number of vehicles due.
        departed: Number of vehicles that entered the network.
        arrived: Number of vehicles that arrived.
        backlog: Number of vehicles that wait outside at the end.
        approaches: Approach to the number of vehicles that passed and their mean control delay, s.
    """

    rule: str
    att_s: float
    due: int
    departed: int
    arrived: int
    backlog: int
    approaches: Mapping[str, tuple[float, float]] = field(
        default_factory=dict[str, tuple[float, float]]
    )


def play_check_rules(
    scenario: Scenario, seed: int, workers: int | None, reporter: Reporter
) -> tuple[RuleEpisode, ...]:
    """Play one episode under each of `RULES`, and measure the delay on every approach."""
    evaluation = evaluation_of(
        scenario,
        {name: rule_factory(name) for name in RULES},
        ("sim",),
        (seed,),
        workers=workers,
        reporter=reporter,
        title="an episode for each rule",
        approaches=True,
    )

    def value(rule: str, measure: str) -> float:
        return float(evaluation.values(rule, "sim", measure)[0])

    return tuple(
        RuleEpisode(
            rule,
            round(value(rule, "att_s"), 1),
            int(value(rule, "due")),
            int(value(rule, "departed")),
            int(value(rule, "throughput")),
            int(value(rule, "backlog")),
            evaluation.approaches(rule, "sim"),
        )
        for rule in RULES
    )


def is_full(runs: Sequence[RuleEpisode], duration_s: float) -> bool:
    """Return True if too many vehicles stay outside under every rule.

    Args:
        runs: Episodes of the rules.
        duration_s: Length of these episodes, s.
    """
    most = max(MOST_BACKLOG, JUST_DUE_S / duration_s)
    return bool(runs) and all(run.backlog > most * run.due for run in runs)


def left_outside(scenario: Scenario, seed: int) -> Counter[str]:
    """Count the vehicles that wait outside at the end, by road, under the network's own programme.

    Raises:
        ScenarioError: SUMO failed; the message quotes SUMO.
    """
    scenario = demand_as_vehicles(scenario)  # SUMO counts the vehicles of flows from its begin on
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name) / "run"
        launch = launch_of(scenario, seed, directory, ())
        launch.write()
        end_s = scenario.settings.begin_s + scenario.settings.duration_s
        run_program("sumo", launch.command("--end", repr(end_s)))
        waiting = {
            element.attributes.get("id", "")
            for element in scan_xml(chunks_of(directory / TRIPS), "SUMO's report")
            if element.name == "tripinfo" and float(element.attributes.get("depart", "-1")) < 0
        }
    all_drives = departures(scenario, routed=False)
    return Counter(edges[0] for who, _, edges in all_drives if who in waiting and edges)


def problems(
    facts: Survey, runs: Sequence[RuleEpisode], outside: Mapping[str, int] | None = None
) -> list[str]:
    """Return the faults to repair before training, each with a remedy.

    Args:
        facts: Survey of the scenario.
        runs: Results of `play_check_rules`.
        outside: Result of `left_outside`; None if it was not called.
    """
    faults: list[str] = []
    for light in facts.intersections:
        if light.unserved_lanes:
            faults.append(
                f"traffic light {light.id!r}: no phase gives green to the lanes "
                f'{", ".join(light.unserved_lanes)}; use phases = "conflict-free" or list them'
            )
        elif light.unserved_links:
            faults.append(
                f"traffic light {light.id!r}: never green: {', '.join(light.unserved_links)}; "
                "vehicles that turn there block their lane"
            )
        if light.clashes:
            faults.append(
                f"traffic light {light.id!r}: people on foot have green while vehicles that cross "
                f"their way need not wait ({'; '.join(light.clashes)}); write g for these vehicles"
            )
    if facts.duration_s < facts.shortest_episode_s:
        faults.append(
            f"an episode of {facts.duration_s:g} s is shorter than the shortest useful one "
            f"({facts.shortest_episode_s:g} s); set duration_s"
        )
    if text := _unsuited(facts, runs):
        faults.append(text)
    if runs:
        best = min(runs, key=lambda run: run.backlog)
        if is_full(runs, facts.duration_s):
            roads = Counter(outside or {}).most_common(_NAMED)
            where = ", ".join(f"{road} ({n})" for road, n in roads)
            where = f"; under the network's own programme they wait at {where}"
            faults.append(
                f"{best.backlog} of {best.due} vehicles cannot enter even under {best.rule}"
                f"{where if roads else ''}; lower the demand, or look at what blocks these roads"
            )
    return faults


def _other_phases(light: IntersectionFacts) -> list[str]:
    """Return a message if the demand is too much for the phases and another source serves more."""
    now, (source, degree) = degree_with(light, "now"), best_phases(light)
    if now <= 1.0 or degree > MUCH_LESS * now:
        return []
    share = f"{now:.0%} of what its phases can serve" if now < math.inf else "not served by them"
    return [
        f"traffic light {light.id!r}: in the busiest quarter of an hour its demand is {share}, and "
        f'{degree:.0%} with phases = "{source}"; set it under [intersections.{light.id}]'
    ]


BY_PREFERENCE = ("permitted", "conflict-free", "programme")
"""Sources of phases; of equally good ones the first is named."""


def best_phases(light: IntersectionFacts) -> tuple[str, float]:
    """Return the source of phases with the least degree of saturation, and this degree."""
    sources = [source for source in BY_PREFERENCE if source in light.degrees]
    if not sources:
        return "now", degree_with(light, "now")
    best = min(sources, key=lambda source: degree_with(light, source))
    return best, degree_with(light, best)


def degree_with(light: IntersectionFacts, source: str) -> float:
    """Return an intersection's degree of saturation with some phases; inf if it is not known."""
    degree = light.degrees.get(source)
    return math.inf if degree is None else degree


def remarks(facts: Survey, runs: Sequence[RuleEpisode]) -> list[str]:
    """Return what a user should know and need not repair.

    Args:
        facts: Survey of the scenario.
        runs: Results of `play_check_rules`.
    """
    notes = list(facts.notes)
    clearances: dict[str, list[str]] = {}
    for light in facts.intersections:
        if not light.unserved_links:
            notes += _other_phases(light)
        shown = (facts.yellow_s,), (facts.all_red_s,)
        file = (light.file_yellow_s or shown[0], light.file_all_red_s or (0.0,))
        if light.file_yellow_s and file != shown:
            times = ["/".join(f"{seconds:g}" for seconds in own) for own in file]
            text = (
                f"the file has {times[0]} s of yellow and {times[1]} s of red between greens; "
                f"agents' greens get {facts.yellow_s:g} s and {facts.all_red_s:g} s ([control] "
                "yellow_s, all_red_s)"
            )
            clearances.setdefault(text, []).append(repr(light.id))
        if light.times_vary:
            notes.append(
                f"traffic light {light.id!r}: {light.times_vary}, so what its own programme can "
                "serve is counted by the durations in the file"
            )
        if far := [road.edge for road in light.approaches if road.first_s is None]:
            notes.append(
                f"traffic light {light.id!r}: no vehicle can be there within the episode on "
                f"{', '.join(far)}; agents never see traffic on these roads"
            )
    notes += [
        f"traffic light{'s' if len(lights) > 1 else ''} {', '.join(lights)}: {text}"
        for text, lights in clearances.items()
    ]
    return notes + _compared(facts, runs)


def _compared(facts: Survey, runs: Sequence[RuleEpisode]) -> list[str]:
    """Return a remark if one of programme and rule is far behind the other."""
    att_s = {run.rule: run.att_s for run in runs}
    if any(rule not in att_s for rule in RULES) or _unsuited(facts, runs):
        return []
    programme_s, rule_s = (att_s[rule] for rule in RULES)
    most = max((degree_with(light, "now") for light in facts.intersections), default=0.0)
    busiest = f"{most:.0%} of their capacity" if most < math.inf else "more than they can serve"
    if programme_s > MUCH_WORSE * rule_s:
        suits = (
            f"and the phases suit (demand: at most {busiest})"
            if most <= 1.0
            else f"though no timing of these phases serves all (demand: {busiest})"
        )
        return [
            f"the programme takes {programme_s:g} s where {RULES[1]} takes {rule_s:g} s: its "
            f"timing is the worse one, {suits}"
        ]
    if rule_s > MUCH_WORSE * programme_s:
        return [
            f"{RULES[1]} takes {rule_s:g} s where the programme takes {programme_s:g} s: the rule "
            f"does not suit these lights (demand: at most {busiest}); try other rules and times "
            "(ugat-marl tune)"
        ]
    return []


def _unsuited(facts: Survey, runs: Sequence[RuleEpisode]) -> str:
    """Return a message if phases serve lanes in part and a rule is far behind the programme."""
    lanes = sum(len(light.partly_served) for light in facts.intersections)
    att_s = {run.rule: run.att_s for run in runs}
    if not lanes or any(rule not in att_s for rule in RULES):
        return ""
    programme_s, rule_s = (att_s[rule] for rule in RULES)
    if rule_s <= MUCH_WORSE * programme_s:
        return ""
    return (
        f"{RULES[1]} takes {rule_s:g} s where the programme takes {programme_s:g} s, and {lanes} "
        "lanes are served in part by some phase: whoever waits there for another phase blocks the "
        f'lane; phases = "{_whole_lanes(facts)}" serves the demand best'
    )


def _whole_lanes(facts: Survey) -> str:
    """Return the best source of phases of the most lights with lanes served in part."""
    partly = [light for light in facts.intersections if light.partly_served]
    return Counter(best_phases(light)[0] for light in partly).most_common(1)[0][0]


def as_json(
    facts: Survey,
    runs: Sequence[RuleEpisode],
    rows: Sequence[HeadroomRow] | None,
    wrong: Sequence[str],
    outside: Mapping[str, int] | None = None,
) -> dict[str, object]:
    """Return survey, runs, headroom and faults as values for JSON.

    What is not known is null, such as the delay of an approach that nobody passed.
    """
    content: dict[str, object] = asdict(facts)
    content["runs"] = [asdict(run) for run in runs]
    content["headroom"] = None if rows is None else [asdict(row) for row in rows]
    content["left_outside"] = dict(outside or {})
    content["problems"] = list(wrong)
    content["remarks"] = remarks(facts, runs)
    return json_values(content)
