"""A scenario tried out: does its traffic get in and through, and can controllers be told apart?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from ugat_marl.evaluation import evaluate, rule_factory
from ugat_marl.headroom import DOMAINS, HOLDS_S, Row, headroom
from ugat_marl.networks.survey import Survey
from ugat_marl.progress import Reporter
from ugat_marl.scenario import Scenario

RULES = ("programme", "largest-queue:20")
MOST_BACKLOG = 0.01
"""Share of the vehicles due that may be left outside under the better rule."""


@dataclass(frozen=True)
class Run:
    """How an episode went under a rule, in sim.

    Attributes:
        rule: The rule.
        att_s: Average travel time of all vehicles due, s.
        due: Vehicles due.
        departed: Vehicles that got in.
        arrived: Vehicles that reached their goal.
        backlog: Vehicles left outside at the end.
    """

    rule: str
    att_s: float
    due: int
    departed: int
    arrived: int
    backlog: int


def try_out(
    scenario: Scenario, seed: int, workers: int | None, reporter: Reporter
) -> tuple[Run, ...]:
    """One episode under each of `RULES`."""
    found = evaluate(
        scenario,
        {name: rule_factory(name) for name in RULES},
        ("sim",),
        (seed,),
        workers=workers,
        reporter=reporter,
        title="an episode for each rule",
    )

    def value(rule: str, measure: str) -> float:
        return float(found.values(rule, "sim", measure)[0])

    measures = ("due", "departed", "throughput", "backlog")
    return tuple(
        Run(rule, round(value(rule, "att_s"), 1), *(int(value(rule, name)) for name in measures))
        for rule in RULES
    )


def measured_headroom(
    scenario: Scenario, seeds: int, workers: int | None, reporter: Reporter
) -> list[Row]:
    """ATT of the largest-queue rule, held long and short, in every domain."""
    return headroom(
        scenario, DOMAINS, HOLDS_S, tuple(range(seeds)), workers=workers, reporter=reporter
    )


def problems(facts: Survey, runs: Sequence[Run]) -> list[str]:
    """What has to be mended before training makes sense, each with the way out."""
    found: list[str] = []
    for item in facts.intersections:
        if item.unserved_lanes:
            found.append(
                f"traffic light {item.id!r}: no phase gives green to the lanes "
                f'{", ".join(item.unserved_lanes)}; use phases = "conflict-free" or list them'
            )
        elif item.unserved_links:
            found.append(
                f"traffic light {item.id!r}: never green: {', '.join(item.unserved_links)}; "
                "vehicles that turn there block their lane"
            )
    if facts.duration_s < facts.shortest_episode_s:
        found.append(
            f"an episode of {facts.duration_s:g} s is shorter than the shortest useful one "
            f"({facts.shortest_episode_s:g} s); set duration_s"
        )
    if runs:
        best = min(runs, key=lambda run: run.backlog)
        if best.backlog > MOST_BACKLOG * best.due:
            found.append(
                f"{best.backlog} of {best.due} vehicles cannot enter even under {best.rule}; "
                "the roads into the network are full, or lead nowhere: lower the demand"
            )
    return found


def as_json(
    facts: Survey, runs: Sequence[Run], rows: Sequence[Row] | None, wrong: Sequence[str]
) -> dict[str, object]:
    """Everything as plain values."""
    found: dict[str, object] = asdict(facts)
    found["runs"] = [asdict(run) for run in runs]
    found["headroom"] = None if rows is None else [asdict(row) for row in rows]
    found["problems"] = list(wrong)
    return found
