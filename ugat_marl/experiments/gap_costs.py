"""Cost of each gap to each controller, as a matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import GAP_KINDS, NAMED_DOMAINS
from ugat_marl.experiments.scores import Estimate, Evaluation
from ugat_marl.policies import nan_last


@dataclass(frozen=True)
class Cell:
    """Cost of a gap to a controller.

    Attributes:
        cost: Mean over the gap's domains and the seeds, with an interval over seeds. For the
            reward gap: the cost of the domain's objective above that of the best controller there,
            in %. For the other gaps: the travel time above that of the same controller in the
            first domain, in s.
        worst: Name of the domain with the highest cost.
        worst_cost: Mean cost in that domain.
    """

    cost: Estimate
    worst: str
    worst_cost: float


def domains_by_gap(evaluation: Evaluation) -> dict[str, list[str]]:
    """Return the names of the evaluation's domains by gap, without gaps that have no domain."""
    others = evaluation.domains[1:]
    listed = {
        gap: [name for name in others if name in NAMED_DOMAINS and NAMED_DOMAINS[name].gap == gap]
        for gap in GAP_KINDS
    }
    return {gap: names for gap, names in listed.items() if names}


def gap_matrix(evaluation: Evaluation) -> dict[str, Mapping[str, Cell]]:
    """Return the cost of each gap to each controller."""
    gaps = domains_by_gap(evaluation)
    return {
        policy: {gap: _cell(evaluation, policy, gap, names) for gap, names in gaps.items()}
        for policy in evaluation.policies
    }


def _cell(evaluation: Evaluation, policy: str, gap: str, domains: Sequence[str]) -> Cell:
    costs = np.array(
        [
            _above_best(evaluation, policy, name)
            if gap == "reward"
            else _above_first(evaluation, policy, name)
            for name in domains
        ]
    )
    means = costs.mean(axis=1)
    worst = int(np.where(np.isnan(means), -np.inf, means).argmax())
    return Cell(Estimate.of(costs.mean(axis=0)), domains[worst], float(means[worst]))


def _above_first(evaluation: Evaluation, policy: str, domain: str) -> NDArray[np.float64]:
    """Return the travel time minus that in the first domain, seed by seed, in s."""
    first = evaluation.values(policy, evaluation.domains[0], "att_s")
    return evaluation.values(policy, domain, "att_s") - first


def _above_best(evaluation: Evaluation, policy: str, domain: str) -> NDArray[np.float64]:
    """Return 100 · (cost / cost of the best controller there - 1), seed by seed, in %.

    Where the best controller has no cost at all, it is nan for the others.
    """
    best = min(
        evaluation.policies,
        key=lambda name: nan_last(evaluation.values(name, domain, "cost").mean()),
    )
    least = evaluation.values(best, domain, "cost")
    own = evaluation.values(policy, domain, "cost")
    nothing = least < 1e-9
    ratio = own / np.where(nothing, 1.0, least)
    return 100.0 * (np.where(nothing, np.where(own < 1e-9, 1.0, np.nan), ratio) - 1.0)
