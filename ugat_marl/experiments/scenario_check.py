"""Check of a scenario: traffic must enter and pass, and controllers must differ."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ugat_marl.experiments.evaluation import evaluate, rule_factory
from ugat_marl.experiments.transfer_headroom import HeadroomRow
from ugat_marl.files import chunks_of, scan_xml
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Scenario, Survey, departures, run_program
from ugat_marl.simulation import launch_of

TRIPS = "trips.xml"
"""Name of the file with SUMO's report on its vehicles."""

RULES = ("programme", "largest-queue:20")
MUCH_WORSE = 1.5
"""A rule's ATT divided by the programme's above which the phases do not suit the rule."""
_NAMED = 5
MOST_BACKLOG = 0.01
"""Largest share of the vehicles due that may wait outside under the better rule."""


@dataclass(frozen=True)
class RuleEpisode:
    """Episode under a rule, in sim.

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
    evaluation = evaluate(
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

    measures = ("due", "departed", "throughput", "backlog")
    return tuple(
        RuleEpisode(
            rule,
            round(value(rule, "att_s"), 1),
            *(int(value(rule, name)) for name in measures),
            evaluation.approaches(rule, "sim"),
        )
        for rule in RULES
    )


def is_full(runs: Sequence[RuleEpisode]) -> bool:
    """Return True if too many vehicles stay outside under every rule."""
    return bool(runs) and all(run.backlog > MOST_BACKLOG * run.due for run in runs)


def left_outside(scenario: Scenario, seed: int) -> Counter[str]:
    """Count the vehicles that wait outside at the end, by road, under the network's own programme.

    Raises:
        ScenarioError: SUMO failed; the message quotes SUMO.
    """
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
        if is_full(runs):
            roads = Counter(outside or {}).most_common(_NAMED)
            where = "; they wait at " + ", ".join(f"{road} ({n})" for road, n in roads)
            faults.append(
                f"{best.backlog} of {best.due} vehicles cannot enter even under {best.rule}"
                f"{where if roads else ''}; lower the demand, or look at what blocks these roads"
            )
    return faults


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
        'lane; phases = "permitted" serves whole lanes'
    )


def as_json(
    facts: Survey,
    runs: Sequence[RuleEpisode],
    rows: Sequence[HeadroomRow] | None,
    wrong: Sequence[str],
    outside: Mapping[str, int] | None = None,
) -> dict[str, object]:
    """Return survey, runs, headroom and faults as values for JSON."""
    content: dict[str, object] = asdict(facts)
    content["runs"] = [asdict(run) for run in runs]
    content["headroom"] = None if rows is None else [asdict(row) for row in rows]
    content["left_outside"] = dict(outside or {})
    content["problems"] = list(wrong)
    return content
