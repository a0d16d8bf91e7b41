"""Learning curves beside rules: a page in Markdown, and a table of every evaluation."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ugat_marl.experiments import Curve, CurvesConfig, Interval, LearningCurves
from ugat_marl.reporting.formats import command_block, made_with, mean_text, number_text


def curves_page(study: LearningCurves, config: CurvesConfig, facts: Mapping[str, Any]) -> str:
    """Return a page of Markdown with the travel times of the learners and rules on a scenario.

    Args:
        study: Trainings and rules; the rules include the programme and fixed time.
        config: Settings of training and evaluation.
        facts: Command, versions and processor (`experiments.machine_facts`).
    """
    times = [
        att_s for rule, att_s in study.rules.items() if rule.startswith(("programme", "fixed-time"))
    ]
    fixed, best = min(times, default=math.nan), study.rules.get(study.best, math.nan)
    by_learner: dict[str, list[Curve]] = {}
    for curve in study.curves:
        by_learner.setdefault(curve.learner, []).append(curve)
    rows = {
        "processor": facts["cpu"],
        "Python": facts["python"],
        **facts["versions"],
        "date": facts["date"][:10],
    }
    lines = [
        f"# {study.scenario}: learners",
        "",
        f"Mean travel time in `{study.domain}` that each learner reaches, in s, beside the rules.",
        "",
        *command_block(facts["command"]),
        "",
        *made_with(rows),
        "",
        "| Column | Meaning |",
        "|---|---|",
        f"| episodes | {config.evaluation_seeds}, the same for all; mean over training seeds with "
        "Student's 95 % interval |",
        f"| last | the policy after {config.episodes} episodes of training |",
        f"| best | the best of the evaluations every {config.evaluate_every} episodes, chosen on "
        "the episodes it is reported on, so that it flatters |",
        "| fixed time | the better of the network's own programme and a tuned cycle |",
        "| decisions | of all agents together, while training, learning included |",
        "| ms/decision | processor time of the learner's process; the simulation is not in it |",
        "",
        "| learner | library | seeds | decisions/s | ms/decision | best | last | last − fixed time "
        "| last below fixed time | last below the best rule |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(_row(curves, fixed, best) for curves in by_learner.values()),
    ]
    for rule, att_s in study.rules.items():
        mark = " (best tuned rule)" if rule == study.best else ""
        lines.append(f"| *{rule}*{mark} | | | | | | {number_text(att_s)} | | | |")
    return "\n".join(lines)


def _row(curves: Sequence[Curve], fixed_s: float, best_rule_s: float) -> str:
    last = np.array([curve.final_s for curve in curves])
    cells = [
        curves[0].learner,
        curves[0].library,
        str(len(curves)),
        f"{np.median([curve.speed for curve in curves]):.0f}",
        number_text(float(np.median([curve.own_ms for curve in curves]))),
        mean_text(Interval.of(np.array([curve.best_s for curve in curves]))),
        mean_text(Interval.of(last)),
        number_text(float(last.mean() - fixed_s)),
        *(
            "-" if math.isnan(rule_s) else f"{(last < rule_s).sum()} of {len(last)}"
            for rule_s in (fixed_s, best_rule_s)
        ),
    ]
    return f"| {' | '.join(cells)} |"


def curves_as_csv(curves: Sequence[Curve]) -> str:
    """Return every evaluation of every training as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["learner", "library", "seed", "episodes", "att_s", "decisions_per_s", "ms_per_decision"]
    )
    for curve in curves:
        speed, ms = round(curve.speed, 1), round(curve.own_ms, 2)
        for mark, att_s in curve.att_s.items():
            start = curve.learner, curve.library, curve.seed
            writer.writerow([*start, mark, round(att_s, 2), speed, ms])
    return text.getvalue()
