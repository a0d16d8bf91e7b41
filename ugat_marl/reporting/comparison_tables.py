"""Comparisons of settings as Markdown, as CSV and for the terminal."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ugat_marl.data import MEASURES
from ugat_marl.experiments import LEAST_SHARE_ARRIVED, Comparison, Interval, PairedTest
from ugat_marl.reporting.formats import (
    PAGE_WIDTH,
    command_block,
    listed,
    made_with,
    number_text,
    percent_text,
    share_text,
)

CERTAIN = 0.05
"""Level of the paired tests in the paragraph that says what the table means."""

Cell = Callable[[str, str], str]
"""Setting and domain to the text of a cell."""


def terminal_tables(found: Comparison, direct: str) -> RenderableType:
    """Return ATT, change of the gap, regret and the share won back, in 80 columns."""
    blocks: list[RenderableType] = []
    for title, cell in _headlines(found, direct):
        table = Table(
            box=box.SIMPLE_HEAD,
            title=Text(f"{found.scenario}: {title}"),
            title_justify="left",
            pad_edge=False,
            padding=(0, 1, 0, 0),
        )
        table.add_column("policy", max_width=28, overflow="fold")
        for target in found.targets:
            table.add_column(target, justify="right", no_wrap=True)
        for setting in found.settings:
            row = [cell(setting, t) if found.has(setting, t) else "" for t in found.targets]
            table.add_row(Text(setting), *row)
        blocks.append(table)
    count = len(found.training_seeds)
    blocks.append(Text(f"{count} training seeds; intervals: 95 %, Student's, over them."))
    return Group(*blocks)


def comparison_page(found: Comparison, direct: str, title: str, facts: Mapping[str, Any]) -> str:
    """Return the whole comparison as a page of Markdown.

    Args:
        found: The comparison.
        direct: Setting with which the others are compared.
        title: Name of the table; the heading is "<scenario>: <title>".
        facts: Command, versions and processor (`experiments.machine_facts`).
    """
    lines = [
        f"# {found.scenario}: {title}",
        "",
        "![Change of the gap of each setting](gaps.png)",
        "",
        *_meaning(found, direct),
        "",
        *_provenance(found, facts),
        "",
    ]
    for title, cell in _headlines(found, direct):
        lines += [f"## {title[0].upper()}{title[1:]}", "", *_grid(found, cell), ""]
    lines += ["## Against direct transfer, seed by seed", ""]
    lines += [
        "Difference of ATT in s (95 % interval), two-sided p of the paired t-test, and in how many "
        "of the training seeds it is lower. All are judged",
        "on the same episodes, which intervals and tests take as given. So is a rule, which has no "
        "training seed.",
        "",
        *_grid(found, lambda s, t: _tested(found.test(s, direct, t)), leave_out=direct),
        "",
    ]
    lines += [
        "## Single episodes",
        "",
        "Median of the ATT in s over all of them in the real domain, and the share of those in "
        f"which fewer than {100 * LEAST_SHARE_ARRIVED:.0f} % of the vehicles due arrived.",
        "Where two outcomes are possible, means and intervals say little.",
        "",
        *_grid(found, _episodes(found)),
        "",
    ]
    if found.constants:
        lines += _against_constants(found)
    lines += ["## The paper's measures", "", "Mean in the real domain (Δ to the simulation).", ""]
    for measure, heading in MEASURES.items():
        lines += [f"### {heading}", "", *_grid(found, _with_gap(found, measure)), ""]
    return "\n".join(lines)


def comparison_csv(found: Comparison) -> str:
    """Return `Comparison.rows` as CSV with a heading; a missing value is an empty cell."""
    rows = found.rows()
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "" if _is_nan(v) else _rounded(v) for k, v in row.items()})
    return text.getvalue()


def seeds_csv(found: Comparison) -> str:
    """Return every training with its mean ATT and throughput as CSV, for tests of a reader."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["setting", "domain", "training_seed", "att_s", "att_s_sim", "throughput"])
    seeds = found.training_seeds
    for setting in found.settings:
        for target in found.targets:
            if found.has(setting, target):
                columns = [
                    found.values(setting, target, "att_s"),
                    found.values(setting, target, "att_s", found.sim),
                    found.values(setting, target, "throughput"),
                ]
                for seed, *values in zip(seeds, *(c.tolist() for c in columns), strict=True):
                    writer.writerow([setting, target, seed, *(round(v, 3) for v in values)])
    return text.getvalue()


def _headlines(found: Comparison, direct: str) -> list[tuple[str, Cell]]:
    return [
        ("average travel time in the real domain, s", _estimated(found, None)),
        ("average travel time in the simulation, s", _estimated(found, found.sim)),
        (
            "change of the gap Δ against direct transfer",
            lambda s, t: percent_text(-found.reduction(s, t, direct)),
        ),
        (
            "transfer regret, s above the best in the table",
            lambda s, t: with_interval(Interval.of(found.regret_s(s, t))),
        ),
        (
            "share of the regret won back (1: the best in the table)",
            lambda s, t: share_text(found.won_back(s, t, direct)),
        ),
    ]


def _estimated(found: Comparison, domain: str | None) -> Cell:
    return lambda s, t: with_interval(found.estimate(s, t, "att_s", domain))


def _episodes(found: Comparison) -> Cell:
    return lambda s, t: f"{number_text(found.median_s(s, t))}, {100 * found.unserved(s, t):.0f} %"


def _with_gap(found: Comparison, measure: str) -> Cell:
    def cell(setting: str, target: str) -> str:
        gap = float(found.gaps(setting, target, measure).mean())
        mean = number_text(found.estimate(setting, target, measure).mean)
        return f"{mean} ({'+' if gap >= 0 else ''}{number_text(gap)})"

    return cell


def _grid(found: Comparison, cell: Cell, leave_out: str = "") -> list[str]:
    lines = [
        f"| | {' | '.join(found.targets)} |",
        f"|---|{'---:|' * len(found.targets)}",
    ]
    for setting in found.settings:
        if setting != leave_out:
            row = (cell(setting, t) if found.has(setting, t) else "" for t in found.targets)
            lines.append(f"| {setting} | {' | '.join(row)} |")
    return lines


def _against_constants(found: Comparison) -> list[str]:
    lines = [
        "## Against the best constant delay, chosen in hindsight",
        "",
        "Per domain the constant with the lowest mean over all training seeds.",
        "",
        f"| | {' | '.join(found.targets)} |",
        f"|---|{'---:|' * len(found.targets)}",
    ]
    best = {target: found.best(target, found.constants) for target in found.targets}
    lines.append(f"| best constant | {' | '.join(best.values())} |")
    for setting in found.grounded:
        cells = (_tested(found.test(setting, best[t], t)) for t in found.targets)
        lines.append(f"| {setting} | {' | '.join(cells)} |")
    return [*lines, ""]


def _meaning(found: Comparison, direct: str) -> list[str]:
    """Return the meaning of the table: settings better than direct transfer, and the best ones."""
    better = [
        setting
        for setting in found.settings
        if setting != direct and _better_everywhere(found, setting, direct)
    ]
    lowest: dict[str, list[str]] = {}
    for target in found.targets:
        lowest.setdefault(found.best(target), []).append(target)
    best = listed([f"`{setting}` in {listed(targets)}" for setting, targets in lowest.items()])
    first = (
        f"Better than direct transfer in every domain, with p < {CERTAIN:g} in each: "
        f"{listed([f'`{setting}`' for setting in better])}."
        if better
        else f"No setting is better than direct transfer in every domain with p < {CERTAIN:g}."
    )
    return textwrap.wrap(f"{first} Lowest mean travel time: {best}.", PAGE_WIDTH)


def _better_everywhere(found: Comparison, setting: str, direct: str) -> bool:
    """Return True if a setting is faster than another in each domain, with p < `CERTAIN`."""
    tests = [found.test(setting, direct, t) for t in found.targets if found.has(setting, t)]
    return all(test.difference.mean < 0 and test.p < CERTAIN for test in tests)


def _provenance(found: Comparison, facts: Mapping[str, Any]) -> list[str]:
    cores = "1 core" if facts["cores"] == 1 else f"{facts['cores']} cores"
    rows = {
        "training seeds": ", ".join(map(str, found.training_seeds)),
        "intervals": "95 %, Student's, over training seeds",
        "processor": f"{facts['cpu']}, {cores}",
        "Python": facts["python"],
        **facts["versions"],
        "date": facts["date"][:10],
        **found.notes,
    }
    return [*command_block(facts["command"]), "", *made_with(rows)]


def with_interval(interval: Interval) -> str:
    """Return a mean with its interval, if it has one."""
    if math.isnan(interval.low) or interval.low == interval.high:
        return number_text(interval.mean)
    to = " to " if interval.low < 0 else "–"
    mean, low, high = map(number_text, (interval.mean, interval.low, interval.high))
    return f"{mean} ({low}{to}{high})"


def _tested(test: PairedTest) -> str:
    mean = test.difference
    text = f"{'+' if mean.mean >= 0 else ''}{number_text(mean.mean)}"
    if not math.isnan(mean.low):
        text += f" ({number_text(mean.low)} to {number_text(mean.high)}), p {_p(test.p)}"
    return f"{text}, {test.better}/{test.count}"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _rounded(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value
