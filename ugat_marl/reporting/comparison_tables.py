"""Comparisons of settings as Markdown, as CSV and for the terminal."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from ugat_marl.data import MEASURES
from ugat_marl.errors import counted, joined
from ugat_marl.experiments import (
    LEAST_SHARE_ARRIVED,
    Comparison,
    Interval,
    PairedTest,
    check_table,
)
from ugat_marl.reporting.formats import (
    PAGE_WIDTH,
    command_block,
    made_with,
    mean_text,
    number_text,
    percent_text,
    share_text,
    signed_text,
)
from ugat_marl.reporting.terminal import in_tables, titled_table

CERTAIN = 0.05
"""Level of the paired tests in the paragraph that says what the table means."""

MOST_TARGETS = 4
"""Real domains that stand side by side in a terminal; more are in a table of their own."""

Cell = Callable[[str, str], str]
"""Setting and domain to the text of a cell."""


def terminal_tables(comparison: Comparison, direct: str) -> RenderableType:
    """Return ATT, change of the gap, regret and the share won back, in 80 columns."""
    blocks: list[RenderableType] = []
    for title, cell in _headlines(comparison, direct):
        for targets in in_tables(comparison.targets, MOST_TARGETS):
            table = titled_table(f"{comparison.scenario}: {title}")
            table.add_column("policy", max_width=28, overflow="fold")
            for target in targets:
                table.add_column(target, justify="right", overflow="fold")
            for setting in comparison.settings:
                row = [cell(setting, t) if comparison.has(setting, t) else "" for t in targets]
                table.add_row(Text(setting), *row)
            blocks.append(table)
    if check := check_table(comparison):
        blocks.append(Text(check.sentence("--episodes")))
    blocks.append(Text(seeds_note(comparison)))
    return Group(*blocks)


def seeds_note(comparison: Comparison) -> str:
    """Return a sentence on the training seeds and the intervals over them."""
    count = len(comparison.training_seeds)
    wide = "intervals: 95 %, Student's, over them" if count > 1 else "no intervals over them"
    return f"{counted(count, 'training seed')}; {wide}."


def comparison_page(
    comparison: Comparison, direct: str, title: str, facts: Mapping[str, Any]
) -> str:
    """Return the whole comparison as a page of Markdown.

    Args:
        comparison: The comparison.
        direct: Setting with which the others are compared.
        title: Name of the table; the heading is "<scenario>: <title>".
        facts: Command, versions and processor (`experiments.machine_facts`).
    """
    lines = [
        f"# {comparison.scenario}: {title}",
        "",
        "![Change of the gap of each setting](gaps.png)",
        "",
        *_meaning(comparison, direct),
        "",
        *_provenance(comparison, facts),
        "",
    ]
    for title, cell in _headlines(comparison, direct):
        lines += [f"## {title[0].upper()}{title[1:]}", "", *_grid(comparison, cell), ""]
    lines += ["## Against direct transfer, seed by seed", ""]
    lines += [
        "Difference of ATT in s (95 % interval), two-sided p of the paired t-test, and in how many "
        "of the training seeds it is lower. All are judged",
        "on the same episodes, which intervals and tests take as given. So is a rule, which has no "
        "training seed.",
        "",
        *_grid(comparison, lambda s, t: _tested(comparison.test(s, direct, t)), leave_out=direct),
        "",
    ]
    lines += [
        "## Single episodes",
        "",
        "Median of the ATT in s over all of them in the real domain, and the share of those in "
        f"which fewer than {100 * LEAST_SHARE_ARRIVED:.0f} % of the vehicles due arrived.",
        "Where two outcomes are possible, means and intervals say little.",
        "",
        *_grid(comparison, _episodes(comparison)),
        "",
    ]
    if comparison.constants:
        lines += _against_constants(comparison)
    lines += ["## The paper's measures", "", "Mean in the real domain (Δ to the simulation).", ""]
    for measure, heading in MEASURES.items():
        lines += [f"### {heading}", "", *_grid(comparison, _with_gap(comparison, measure)), ""]
    return "\n".join(lines)


def comparison_csv(comparison: Comparison) -> str:
    """Return `Comparison.rows` as CSV with a heading; a missing value is an empty cell."""
    rows = comparison.rows()
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "" if _is_nan(v) else _rounded(v) for k, v in row.items()})
    return text.getvalue()


def _headlines(comparison: Comparison, direct: str) -> list[tuple[str, Cell]]:
    return [
        ("average travel time in the real domain, s", _estimated(comparison, None)),
        ("vehicles due that never entered, in the real domain", _backlog(comparison)),
        ("average travel time in the simulation, s", _estimated(comparison, comparison.sim)),
        (
            "change of the gap Δ against direct transfer",
            lambda s, t: percent_text(-comparison.reduction(s, t, direct)),
        ),
        (
            "transfer regret, s above the best in the table",
            lambda s, t: mean_text(Interval.of(comparison.regret_s(s, t))),
        ),
        (
            "share of the regret won back (1: the best in the table)",
            lambda s, t: share_text(comparison.won_back(s, t, direct)),
        ),
    ]


def _estimated(comparison: Comparison, domain: str | None) -> Cell:
    return lambda s, t: mean_text(comparison.estimate(s, t, "att_s", domain))


def _backlog(comparison: Comparison) -> Cell:
    return lambda s, t: number_text(comparison.estimate(s, t, "backlog").mean)


def _episodes(comparison: Comparison) -> Cell:
    return lambda s, t: (
        f"{number_text(comparison.median_s(s, t))}, {100 * comparison.unserved(s, t):.0f} %"
    )


def _with_gap(comparison: Comparison, measure: str) -> Cell:
    def cell(setting: str, target: str) -> str:
        gap = float(comparison.gaps(setting, target, measure).mean())
        mean = number_text(comparison.estimate(setting, target, measure).mean)
        return f"{mean} ({signed_text(gap)})"

    return cell


def _grid(comparison: Comparison, cell: Cell, leave_out: str = "") -> list[str]:
    lines = [
        f"| | {' | '.join(comparison.targets)} |",
        f"|---|{'---:|' * len(comparison.targets)}",
    ]
    for setting in comparison.settings:
        if setting != leave_out:
            row = (
                cell(setting, t) if comparison.has(setting, t) else "" for t in comparison.targets
            )
            lines.append(f"| {setting} | {' | '.join(row)} |")
    return lines


def _against_constants(comparison: Comparison) -> list[str]:
    lines = [
        "## Against the best constant delay, chosen in hindsight",
        "",
        "Per domain the constant with the lowest mean over all training seeds.",
        "",
        f"| | {' | '.join(comparison.targets)} |",
        f"|---|{'---:|' * len(comparison.targets)}",
    ]
    best = {target: comparison.best(target, comparison.constants) for target in comparison.targets}
    lines.append(f"| best constant | {' | '.join(best.values())} |")
    for setting in comparison.grounded:
        cells = (_tested(comparison.test(setting, best[t], t)) for t in comparison.targets)
        lines.append(f"| {setting} | {' | '.join(cells)} |")
    return [*lines, ""]


def _meaning(comparison: Comparison, direct: str) -> list[str]:
    """Return the meaning of the table: settings better than direct transfer, and the best ones."""
    better = [
        setting
        for setting in comparison.settings
        if setting != direct and _better_everywhere(comparison, setting, direct)
    ]
    lowest: dict[str, list[str]] = {}
    for target in comparison.targets:
        best = "all settings alike" if _all_alike(comparison, target) else comparison.best(target)
        lowest.setdefault(best, []).append(target)
    best = joined([f"`{setting}` in {joined(targets)}" for setting, targets in lowest.items()])
    is_tested = len(comparison.training_seeds) > 1
    if not is_tested:
        first = "With one training seed no setting can be tested against direct transfer."
    elif better:
        first = (
            f"Better than direct transfer in every domain, with p < {CERTAIN:g} in each: "
            f"{joined([f'`{setting}`' for setting in better])}."
        )
    else:
        first = f"No setting is better than direct transfer in every domain with p < {CERTAIN:g}."
    tested = len([setting for setting in comparison.settings if setting != direct])
    if is_tested and tested > 1:
        first += (
            f" Each of {tested} is tested by itself: of as many that change nothing, "
            f"{tested * CERTAIN / 2:.2g} would pass in one domain by chance."
        )
    check = check_table(comparison)
    trained = (
        check.sentence("`--episodes`")
        if check
        else f"Not compared with rules in {comparison.sim}: the table has no row of tuned rules."
    )
    return [
        *textwrap.wrap(trained, PAGE_WIDTH),
        "",
        *textwrap.wrap(f"{first} Lowest mean travel time: {best}.", PAGE_WIDTH),
    ]


def _all_alike(comparison: Comparison, target: str) -> bool:
    """Return True if several settings have the same travel times in a domain, to the last digit."""
    there = [name for name in comparison.settings if comparison.has(name, target)]
    values = [comparison.values(name, target, "att_s") for name in there]
    return len(there) > 1 and all(np.array_equal(values[0], one) for one in values[1:])


def _better_everywhere(comparison: Comparison, setting: str, direct: str) -> bool:
    """Return True if a setting is faster than another in each domain, with p < `CERTAIN`."""
    if not all(comparison.has(setting, target) for target in comparison.targets):
        return False
    tests = [comparison.test(setting, direct, target) for target in comparison.targets]
    return all(test.difference.mean < 0 and test.p < CERTAIN for test in tests)


def _provenance(comparison: Comparison, facts: Mapping[str, Any]) -> list[str]:
    seeds = comparison.training_seeds
    cores = "1 core" if facts["cores"] == 1 else f"{facts['cores']} cores"
    rows = {
        "training seeds": ", ".join(map(str, seeds)),
        "intervals": "95 %, Student's, over training seeds"
        if len(seeds) > 1
        else "none, of one training seed",
        "processor": f"{facts['cpu']}, {cores}",
        "Python": facts["python"],
        **facts["versions"],
        "date": facts["date"][:10],
        **comparison.notes,
    }
    return [*command_block(facts["command"]), "", *made_with(rows)]


def _tested(test: PairedTest) -> str:
    mean = test.difference
    text = signed_text(mean.mean)
    if not math.isnan(mean.low):
        text += f" ({number_text(mean.low)} to {number_text(mean.high)}), p {_p(test.p)}"
    return f"{text}, {test.better}/{test.count}"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _rounded(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value
