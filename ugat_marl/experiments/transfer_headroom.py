"""Headroom of a scenario: the ATT of the largest-queue rule with long and short holds.

Longer greens serve slow vehicles better, so the best hold depends on the domain. If the rule best
in `sim` loses nothing in another domain, no transfer can win anything there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ugat_marl.effects import Domain
from ugat_marl.errors import OptionError
from ugat_marl.experiments.evaluation import evaluation_of, rule_factory
from ugat_marl.parallel import Workers
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Scenario

DOMAINS = ("sim", "V1", "V2", "V3", "V4")
HOLDS_S = (10, 20, 30, 40)
SEEDS = (0, 1, 2, 3, 4)


@dataclass(frozen=True)
class HeadroomRow:
    """Results in one domain, means over the seeds; times and shares are nan if nobody was due.

    Attributes:
        domain: Name of the domain.
        att_s: ATT for each hold in s, in the order of the holds.
        programme_att_s: ATT of the network's own signal programme, in s.
        best_hold_s: Hold with the smallest ATT, in s.
        lost: ATT of the rule best in the first domain, divided by that of the rule best here,
            minus 1.
        finished: Share of the vehicles due that arrive under the rule best here.
        backlog: Number of vehicles that never enter the network under the rule best here.
    """

    domain: str
    att_s: tuple[float, ...]
    programme_att_s: float
    best_hold_s: int
    lost: float
    finished: float
    backlog: float


def measure_headroom(
    scenario: Scenario,
    domains: Sequence[Domain] = DOMAINS,
    holds_s: Sequence[int] = HOLDS_S,
    seeds: Sequence[int] = SEEDS,
    *,
    workers: Workers = None,
    reporter: Reporter | None = None,
) -> list[HeadroomRow]:
    """Return the ATT of the largest-queue rule in every domain for every hold.

    Args:
        scenario: The scenario.
        domains: Domains; the others are compared with the first.
        holds_s: Shortest durations of a phase, in s.
        seeds: Seeds of the episodes.
        workers: Simulations at a time; None for the number of cores; or an executor.
        reporter: Shows progress.

    Returns:
        One row per domain.

    Raises:
        OptionError: Domains, holds or seeds are empty.
    """
    if not (domains and holds_s and seeds):
        raise OptionError("headroom needs at least one domain, one hold and one seed")
    rules = {hold_s: f"largest-queue:{hold_s}" for hold_s in holds_s}
    names = [*rules.values(), "programme"]
    evaluation = evaluation_of(
        scenario,
        {name: rule_factory(name) for name in names},
        domains,
        seeds,
        workers=workers,
        reporter=reporter,
    )

    def mean(name: str, domain: str, measure: str) -> float:
        return float(evaluation.values(name, domain, measure).mean())

    rows: list[HeadroomRow] = []
    for domain in evaluation.domains:
        att_s = {hold_s: mean(rule, domain, "att_s") for hold_s, rule in rules.items()}
        best = min(att_s, key=lambda hold_s: att_s[hold_s])
        reference = rows[0].best_hold_s if rows else best
        due = mean(rules[best], domain, "due")
        rows.append(
            HeadroomRow(
                domain,
                tuple(att_s.values()),
                mean("programme", domain, "att_s"),
                best,
                att_s[reference] / att_s[best] - 1,
                mean(rules[best], domain, "throughput") / due if due else math.nan,
                mean(rules[best], domain, "backlog"),
            )
        )
    return rows
