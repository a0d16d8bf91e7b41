"""Race of rules by successive halving (Jamieson and Talwalkar 2016).

All take part in the first rung. After each rung the better half goes on, and each mean covers all
rungs so far. So most episodes are played by rules that are good.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from ugat_marl.policies.rules.catalogue import RULES, format_rule

TUNED_RULES = tuple(name for name in RULES if name != "random")
"""Rules that are tuned in a search for the best rule."""

LEAST_FIELD = 2
"""Rules in the last rung."""


def rule_settings(name: str, budget: int) -> list[str]:
    """Return the spellings of a rule that race: the default, and others spread evenly.

    Args:
        name: Name of the rule, without parameters.
        budget: Most episodes that they may play, one of each in every rung.
    """
    rule = RULES[name]
    values = itertools.product(*(parameter.choices for parameter in rule.parameters))
    specs = [format_rule(name, list(each)) for each in values]
    many = len(specs)
    while many > 1 and sum(race_fields(many)) > budget:
        many -= 1
    kept = [(2 * k + 1) * len(specs) // (2 * many) for k in range(many)]
    usual = specs.index(format_rule(name, [parameter.default for parameter in rule.parameters]))
    kept[min(range(many), key=lambda k: abs(kept[k] - usual))] = usual
    return [specs[k] for k in kept]


def nan_last(mean: float | np.floating) -> float:
    """Return a mean for sorting: NaN, of episodes in which no vehicle was due, is the largest."""
    return math.inf if math.isnan(mean) else float(mean)


def race_fields(settings: int, rungs: int | None = None) -> list[int]:
    """Return the number of rules in each rung: half of the rung before, but at least two.

    Args:
        settings: Number of rules at the start.
        rungs: Number of rungs; None for one after the other until two rules are left.
    """
    fields = [settings]
    while len(fields) < rungs if rungs is not None else fields[-1] > LEAST_FIELD:
        fields.append(_next_field(fields[-1]))
    return fields


def _next_field(rules: int) -> int:
    """Return the number of rules that go on from a rung."""
    return min(rules, max(LEAST_FIELD, math.ceil(rules / 2)))


def race(
    names: Sequence[str], rungs: int, play: Callable[[int, Sequence[str]], Sequence[list[float]]]
) -> dict[str, list[float]]:
    """Return the results of a race by name, the best first.

    Args:
        names: Rules that take part.
        rungs: Number of rungs.
        play: Called with the number of a rung and the rules that run in it; returns the results of
            each. Smaller is better.

    Returns:
        First the rules of the last rung, then those that dropped out, the latest first. In each
        rung the order is by the mean of all results so far.
    """
    played: dict[str, list[float]] = {name: [] for name in names}
    running, left = list(played), list[str]()
    for rung in range(rungs):
        for name, results in zip(running, play(rung, tuple(running)), strict=True):
            played[name] += results
        # The sort is stable: of equal rules, the one named first stays first.
        running.sort(key=lambda name: nan_last(np.mean(played[name])))
        if rung + 1 < rungs:
            kept = _next_field(len(running))
            running, left = running[:kept], running[kept:] + left
    return {name: played[name] for name in running + left}
