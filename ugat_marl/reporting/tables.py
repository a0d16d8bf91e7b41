"""Evaluations as tables that fit a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType
from rich.text import Text

from ugat_marl.data import MEASURES
from ugat_marl.diagnosis import PolicyGap, TravelTimeEstimate
from ugat_marl.errors import counted
from ugat_marl.experiments import CORRECTED, Estimate, Evaluation, Tuned, best_rule_note, check_run
from ugat_marl.reporting.formats import ends_text, mean_text, number_text, share, signed_text
from ugat_marl.reporting.terminal import named_table, titled_table


def transfer_table(evaluation: Evaluation) -> RenderableType:
    """Return ATT of every policy in the simulation and the real domains, with gap and regret."""
    first, *others = evaluation.domains
    several = len(evaluation.seeds) > 1
    interval = " (95 % interval)" if several else ""
    table = named_table(f"{evaluation.scenario}: average travel time in s{interval}", "policy")
    table.add_column(first, justify="right", overflow="fold")
    for domain in others:
        for heading in (domain, "Δ", "regret"):
            table.add_column(heading, justify="right", overflow="fold")
    for policy in evaluation.policies:
        cells = [mean_text(evaluation.estimate(policy, first, "att_s"))]
        for domain in others:
            cells += [
                mean_text(evaluation.estimate(policy, domain, "att_s")),
                _signed(evaluation.gap(policy, domain, "att_s")),
                number_text(evaluation.regret(policy, domain).mean),
            ]
        table.add_row(Text(policy), *cells)
    return Group(table, Text(_caption(evaluation), style="dim"))


def measures_table(evaluation: Evaluation) -> RenderableType:
    """Return a block per domain: measures, intervals, and gaps against the first domain."""
    blocks: list[RenderableType] = []
    for domain in evaluation.domains:
        table = titled_table(f"{evaluation.scenario} in {domain}")
        table.add_column("policy", max_width=20, overflow="fold")
        headings = ("ATT s", "through.", "reward", "queue", "delay", "delay s", "regret s")
        for heading in headings:
            table.add_column(heading, justify="right", no_wrap=True)
        for policy in evaluation.policies:
            estimates = [evaluation.estimate(policy, domain, measure) for measure in MEASURES]
            estimates.append(evaluation.regret(policy, domain))
            table.add_row(Text(policy), *(number_text(e.mean) for e in estimates))
            if not math.isnan(estimates[0].low):
                table.add_row(*_dim("  95 % interval", *map(_half, estimates)))
            if domain != evaluation.domains[0]:
                gaps = [evaluation.gap(policy, domain, measure) for measure in MEASURES]
                table.add_row(*_dim(f"  gap to {evaluation.domains[0]}", *map(_signed, gaps)))
                if not math.isnan(gaps[0].low):
                    table.add_row(*_dim("  its 95 % interval", *map(_half, gaps)))
        blocks.append(table)
        blocks += [Text(line, style="dim") for line in _backlog(evaluation, domain)]
    blocks.append(Text(_legend(evaluation), style="dim"))
    return Group(*blocks)


def tuning_table(title: str, results: Sequence[Tuned]) -> RenderableType:
    """Return the best settings of each rule, the best rule first."""
    table = titled_table(f"{title}: rules at their best")
    table.add_column("best setting", max_width=28, overflow="fold")
    for heading in ("ATT s", "worst s", "settings", "episodes"):
        table.add_column(heading, justify="right")
    for tuned in sorted(results, key=lambda each: each.best.att_s):
        worst = max(trial.att_s for trial in tuned.trials)
        table.add_row(
            Text(tuned.best.spec),
            number_text(tuned.best.att_s),
            number_text(worst) if len(tuned.trials) > 1 else "-",
            str(len(tuned.trials)),
            str(tuned.episodes),
        )
    legend = (
        "ATT: mean in s over the tuning seeds, all vehicles due. worst: of the settings tried. "
        "Numbers after a name are its settings; see docs/reference/rules.md."
    )
    if len({tuned.best.episodes for tuned in results}) > 1:
        legend += (
            " The best settings were played with different numbers of seeds; evaluate ranks them "
            "on equal ones."
        )
    return Group(table, Text(legend, style="dim"))


def policy_gap_table(title: str, gaps: Mapping[str, PolicyGap], seeds: int) -> RenderableType:
    """Return distances of both simulations from the real domain, policy by policy.

    Args:
        title: Title of the table.
        gaps: Gap of each policy; see `ugat_marl.experiments.policy_gaps.policy_gap`.
        seeds: Number of episodes behind every number.
    """
    table = titled_table(title)
    table.add_column("policy", max_width=24, overflow="fold")
    for heading in ("sim", "corrected", "real", "before", "after", "shrink"):
        table.add_column(heading, justify="right")
    for policy, gap in gaps.items():
        times = (gap.sim, gap.corrected, gap.real)
        table.add_row(
            Text(policy),
            *(number_text(time.mean) for time in times),
            number_text(gap.before),
            number_text(gap.after),
            share(gap.shrink),
        )
        if any(time.low is not None for time in times):
            table.add_row(*_dim("  95 % interval", *map(_limits, times)))
    legend = (
        f"{counted(seeds, 'seed')}. before: |real - sim|, after: |real - corrected|, both in s; "
        "shrink: share of the gap that is gone."
    )
    return Group(table, Text(legend, style="dim"))


def _limits(time: TravelTimeEstimate) -> str:
    if time.low is None or time.high is None:
        return "-"
    return ends_text(time.low, time.high)


def _backlog(evaluation: Evaluation, domain: str) -> list[str]:
    """Return a line on vehicles that never entered; throughput and queue do not show them."""
    waiting = {
        name: evaluation.estimate(name, domain, "backlog").mean for name in evaluation.policies
    }
    kept_out = [f"{name} {number_text(mean)}" for name, mean in waiting.items() if mean >= 0.5]
    return [f"vehicles due that never entered: {', '.join(kept_out)}"] if kept_out else []


def _caption(evaluation: Evaluation) -> str:
    lines = [
        f"{best_rule_note(domain)}: {rule}"
        for domain in evaluation.domains
        if (rule := evaluation.best_rule(domain)) is not None
    ]
    if check := check_run(evaluation):
        lines.insert(0, check.sentence("--pretrain-episodes"))
    if corrected := evaluation.notes.get(CORRECTED):
        lines.append(f"{CORRECTED}: trained in {corrected}")
    lines += _medians(evaluation)
    for domain in evaluation.domains:
        lines += [f"in {domain}, {line}" for line in _backlog(evaluation, domain)]
    if len(evaluation.domains) == 1:
        return "\n".join([*lines, _seeds(evaluation)])
    lines.append(
        f"{_seeds(evaluation)}. Δ: minus {evaluation.domains[0]}. regret: ATT above the "
        "best of these policies in that domain."
    )
    return "\n".join(lines)


def _medians(evaluation: Evaluation) -> list[str]:
    """Return medians for domains in which a few locked-up episodes dominate the mean."""
    lines: list[str] = []
    for domain in evaluation.domains:
        both = {name: evaluation.estimate(name, domain, "att_s") for name in evaluation.policies}
        if any(abs(e.mean - e.median) > 0.1 * e.median for e in both.values()):
            values = ", ".join(f"{name} {number_text(e.median)}" for name, e in both.items())
            lines.append(f"medians in {domain}: {values}")
    return lines


def _legend(evaluation: Evaluation) -> str:
    return (
        f"{_seeds(evaluation)}. ATT: all vehicles due, scheduled departure to arrival or "
        "end. queue: halting vehicles per intersection. delay: 1 - v/vmax of incoming lanes. "
        "delay s: time loss plus departure delay. regret: ATT above the best of these policies."
    )


def _seeds(evaluation: Evaluation) -> str:
    return counted(len(evaluation.seeds), "seed")


def _dim(*cells: str) -> list[Text]:
    return [Text(cell, style="dim") for cell in cells]


def _half(estimate: Estimate) -> str:
    """Return half of an interval."""
    return f"±{number_text(estimate.half)}"


def _signed(estimate: Estimate) -> str:
    return signed_text(estimate.mean)
