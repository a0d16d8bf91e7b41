"""Results of trainings on a scenario beside rules: a page in Markdown, and a table of all."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ugat_marl.experiments import DOMAIN, Curve, Interval, Training
from ugat_marl.reporting.comparison_tables import with_interval
from ugat_marl.reporting.tables import number


def curves_page(
    scenario: str,
    curves: Mapping[Training, Curve],
    rules: Mapping[str, Sequence[float]],
    best: str,
    facts: Mapping[str, Any],
) -> str:
    """Return the results on a scenario as Markdown.

    Args:
        scenario: Its id.
        curves: The trainings that have all their evaluations.
        rules: Travel times of the rules by episode, s.
        best: The best of the rules, chosen on other episodes.
        facts: Command, versions and processor (`bench.machine`).
    """
    one = next(iter(curves))
    means = {rule: float(np.mean(values)) for rule, values in rules.items()}
    fixed = min(means[rule] for rule in rules if rule.startswith(("programme", "fixed-time")))
    by_learner: dict[str, list[Training]] = {}
    for training in curves:
        by_learner.setdefault(training.learner, []).append(training)
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    lines = [
        f"# {scenario}: learners",
        "",
        f"    {facts['command']}",
        "",
        f"{facts['cpu']}, Python {facts['python']}, {versions}, {facts['date'][:10]}.",
        "",
        f"ATT in `{DOMAIN}`, s: mean over {one.evaluation_seeds} episodes, the same for all, then "
        "over training seeds, with Student's 95 % interval. *Last* is the policy after "
        f"{one.episodes} episodes of training, *best* the best of the evaluations every "
        f"{one.evaluate_every} episodes, chosen on the very episodes it is reported on, so that "
        "it flatters. *Fixed time* is the better of the network's own programme and a tuned "
        "cycle. Decisions are of all agents together, while training, learning included; the time "
        "of one is the processor time of the learner's process, which the simulation is not in.",
        "",
        "| learner | library | seeds | decisions/s | ms/decision | best | last | last − fixed time "
        "| last below fixed time | last below the best rule |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(_row(name, own, curves, fixed, means[best]) for name, own in by_learner.items()),
    ]
    for rule, mean in means.items():
        kind = " (best tuned rule)" if rule == best else ""
        lines.append(f"| *{rule}*{kind} | | | | | | {number(mean)} | | | |")
    return "\n".join(lines)


def _row(
    learner: str,
    trainings: Sequence[Training],
    curves: Mapping[Training, Curve],
    fixed: float,
    best_rule: float,
) -> str:
    means = [curves[training].means(training) for training in trainings]
    last = np.array([own[-1] for own in means])
    cells = [
        learner,
        str(curves[trainings[0]].made_with["library"]),
        str(len(trainings)),
        f"{np.median([curves[one].speed for one in trainings]):.0f}",
        number(float(np.median([curves[one].own_ms for one in trainings]))),
        with_interval(Interval.of(np.array([min(own) for own in means]))),
        with_interval(Interval.of(last)),
        number(float(last.mean() - fixed)),
        *(f"{(last < rule).sum()} of {len(last)}" for rule in (fixed, best_rule)),
    ]
    return f"| {' | '.join(cells)} |"


def curves_as_csv(curves: Mapping[Training, Curve]) -> str:
    """Every evaluation of every training."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["learner", "library", "seed", "episodes", "att_s", "decisions_per_s", "ms_per_decision"]
    )
    for one, curve in curves.items():
        speed, ms = round(curve.speed, 1), round(curve.own_ms, 2)
        for mark, mean in zip(one.marks, curve.means(one), strict=True):
            own = one.learner, curve.made_with["library"], one.seed, mark, round(mean, 2), speed, ms
            writer.writerow(own)
    return text.getvalue()
