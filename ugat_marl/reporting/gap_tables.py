"""Tables of 80 columns: cost of each gap per controller, and measures of hidden objectives."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ugat_marl.envs import OBJECTIVE_MEASURES
from ugat_marl.experiments import Evaluation, domains_by_gap, gap_matrix
from ugat_marl.reporting.formats import fixed, number_text
from ugat_marl.reporting.terminal import in_tables, named_table, titled_table


def gap_matrix_table(evaluation: Evaluation) -> RenderableType:
    """Return the cost of each gap for each controller, then travel times by domain."""
    gaps = domains_by_gap(evaluation)
    first = evaluation.domains[0]
    table = titled_table(f"{evaluation.scenario}: what each gap costs each controller")
    table.add_column("policy", max_width=16, overflow="fold")
    table.add_column(f"{first}\nATT s", justify="right")
    for gap, domains in gaps.items():
        unit = "%" if gap == "reward" else "s"
        heading = f"{gap}\n({len(domains)}) {unit}"
        table.add_column(heading, justify="right", overflow="fold")
    for policy, cells in gap_matrix(evaluation).items():
        start = evaluation.estimate(policy, first, "att_s").mean
        table.add_row(
            Text(policy), number_text(start), *(_change(cell.cost.mean) for cell in cells.values())
        )
        worst = [
            f"{cell.worst.removeprefix('want-')}\n{fixed(cell.worst_cost, 0, plus=True)}"
            if cell.worst_cost > 0
            else "-"
            for cell in cells.values()
        ]
        table.add_row(*(Text(text, style="dim") for text in ("  worst", "", *worst)))
    legend = (
        f"Mean over the gap's domains (how many) and seeds: ATT above that in {first}. reward: the "
        "hidden cost above that of the best of these policies, in %."
    )
    return Group(table, Text(legend, style="dim"), _by_domain(evaluation))


def objective_tables(evaluation: Evaluation) -> list[RenderableType]:
    """Return the measures of domains with an objective; an empty list without such domains."""
    told = {result.domain for result in evaluation.results if result.scores.hidden}
    domains = [domain for domain in evaluation.domains if domain in told]
    if not domains:
        return []
    table = named_table(
        f"{evaluation.scenario}: cost of what is wanted, hidden from training", "policy"
    )
    for domain in domains:
        table.add_column(domain.removeprefix("want-"), justify="right", overflow="fold")
    for policy in evaluation.policies:
        costs = (evaluation.estimate(policy, domain, "cost").mean for domain in domains)
        table.add_row(Text(policy), *map(number_text, costs))
    legend = ", ".join(OBJECTIVE_MEASURES[name] for name in _SHORT)
    return [
        table,
        *_measured(evaluation, domains),
        Text(f"{legend}. docs/reference/domains.md", style="dim"),
    ]


_SIDE_BY_SIDE = 8
"""Largest number of policies beside each other, so that numbers stay whole in 80 columns."""
_SHORT = {
    "co2_g": "CO2",
    "delay_gini": "Gini",
    "delay_p95_s": "95 %",
    "person_delay_s": "persons",
    "hard_brakings": "brakings",
    "collisions": "collisions",
}


def _measured(evaluation: Evaluation, domains: Sequence[str]) -> list[Table]:
    """Return tables of the parts of the costs, one table for all domains with equal values."""
    alike: dict[tuple[float, ...], list[str]] = {}
    for domain in domains:
        values = [
            evaluation.estimate(policy, domain, name).mean
            for policy in evaluation.policies
            for name in _SHORT
        ]
        alike.setdefault(tuple(values), []).append(domain)
    tables: list[Table] = []
    for values, same in alike.items():
        table = named_table(f"measured in {', '.join(same)}", "policy")
        for heading in _SHORT.values():
            table.add_column(heading, justify="right")
        for place, policy in enumerate(evaluation.policies):
            row = values[place * len(_SHORT) : (place + 1) * len(_SHORT)]
            table.add_row(Text(policy), *map(number_text, row))
        tables.append(table)
    return tables


def _by_domain(evaluation: Evaluation) -> RenderableType:
    tables: list[Table] = []
    for policies in in_tables(evaluation.policies, _SIDE_BY_SIDE):
        table = named_table("average travel time in s, domain by domain", "domain")
        for policy in policies:
            table.add_column(policy, justify="right", overflow="fold")
        for domain in evaluation.domains:
            values = (evaluation.estimate(policy, domain, "att_s").mean for policy in policies)
            table.add_row(Text(domain), *map(number_text, values))
        tables.append(table)
    return Group(*tables)


def _change(percent: float) -> str:
    """Return a change with its sign and one decimal; "-" for nan."""
    return "-" if math.isnan(percent) else fixed(percent, 1, plus=True)
