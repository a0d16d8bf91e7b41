"""A diagnosis in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ugat_marl.diagnosis import Diagnosis, HeldOut, NamedEffect, statistic
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.formats import chance, number, share, signed
from ugat_marl.reporting.light_names import LightNames
from ugat_marl.reporting.terminal import titled_table

_SHOWN = 3
"""Number of disagreements in the table."""


def diagnosis_summary(diagnosis: Diagnosis, names: LightNames) -> RenderableType:
    """Return verdict, effects, strongest disagreements and the numbers of the held-out periods.

    Args:
        diagnosis: The diagnosis.
        names: Names of the network's lights.
    """
    blocks: list[RenderableType] = []
    if (text := words.criteria_line(diagnosis)) is not None:
        blocks.append(Text(text))
    if (text := words.partial(diagnosis)) is not None:
        blocks.append(Text(text, style="bold yellow"))
    verdict = words.VERDICTS[diagnosis.verdict]
    blocks.append(Text(f"{verdict}: {diagnosis.sentence}", style="bold"))
    if diagnosis.next_measurement:
        blocks.append(Text(f"What would tell: {diagnosis.next_measurement}."))
    if diagnosis.effects:
        blocks.append(_effects(diagnosis.effects, names))
        if domain := words.as_domain(diagnosis.effects):
            blocks.append(Text(f"as a domain: {domain}"))
    if diagnosis.limits:
        blocks.append(_limits(diagnosis))
    if diagnosis.where:
        blocks.append(_where(diagnosis, names))
    if diagnosis.heldout is not None:
        blocks.append(_heldout(diagnosis.heldout, fitted=diagnosis.verified_on_fitted_periods))
    if diagnosis.approaches:
        blocks.append(_traffic(diagnosis))
    if (text := words.traffic_check_line(diagnosis)) is not None:
        blocks.append(Text(text))
    return Group(*blocks)


def _effects(effects: Sequence[NamedEffect], names: LightNames) -> Table:
    certain = any(map(words.has_interval, effects))
    table = titled_table("effects (value with 95 % interval)" if certain else "effects")
    table.add_column("effect", overflow="fold", max_width=20)
    table.add_column("where", overflow="fold", max_width=22)
    timed = any(effect.window for effect in effects)
    if timed:
        table.add_column("when", no_wrap=True)
    table.add_column("value", overflow="fold")
    for effect in effects:
        when = [words.window(effect.window) or "always"] if timed else []
        cells = [words.effect_name(effect), words.place(effect, names), *when, words.values(effect)]
        table.add_row(*map(Text, cells))
    return table


def _limits(diagnosis: Diagnosis) -> Table:
    table = titled_table("values that would show in at least four of five data sets like this")
    for heading in ("effect", "usual", "would show"):
        table.add_column(heading, overflow="fold")
    for cells in words.limit_rows(diagnosis.limits):
        table.add_row(*map(Text, cells))
    return table


def _where(diagnosis: Diagnosis, names: LightNames) -> Table:
    table = titled_table("strongest disagreements on the fitted periods (measured minus simulated)")
    table.add_column("where", overflow="fold", max_width=18)
    table.add_column("what", overflow="fold", max_width=36)
    table.add_column("size", justify="right", no_wrap=True)
    table.add_column("z", justify="right", no_wrap=True)
    for disagreement in words.strongest(diagnosis, _SHOWN):
        size = f"{signed(disagreement.size)} {disagreement.unit}".rstrip()
        observed = f"{disagreement.regime}: {statistic(disagreement.statistic)}"
        if disagreement.window:
            observed += f", {words.window(disagreement.window)}"
        where = words.disagreement_place(disagreement, names)
        table.add_row(*map(Text, (where, observed, size, signed(disagreement.z))))
    return table


def _traffic(diagnosis: Diagnosis) -> Table:
    """Return capacity, queue and delay of the approach whose delay differs most."""
    corrected = diagnosis.best is not None
    approach = words.slowest(diagnosis)
    table = titled_table(f"approach {approach[0].approach}")
    table.add_column("", overflow="fold")
    for heading in ("measured", "before", "after"):
        table.add_column(heading, justify="right")
    for _, name, *values in words.traffic_rows(approach, corrected=corrected):
        table.add_row(*map(Text, (name, *values)))
    return table


def _heldout(heldout: HeldOut, *, fitted: bool) -> RenderableType:
    """Return the numbers of the held-out periods; `fitted` says that none was held out."""
    where = "fitted periods" if fitted else "held-out periods"
    lines: list[RenderableType] = [Text(f"distance of the data from the simulation, {where}")]
    table = titled_table("")
    for heading in ("before", "after", "floor", "shrink", "p before", "p after"):
        table.add_column(heading, justify="right")
    corrected = heldout.shrink is not None
    table.add_row(
        number(heldout.before),
        number(heldout.after) if corrected else "–",
        number(heldout.floor),
        share(heldout.shrink),
        chance(heldout.p_before),
        chance(heldout.p_after) if corrected else "–",
    )
    lines.append(table)
    whose = "corrected simulation" if corrected else "simulation"
    lines.append(Text(f"floor: 99 of 100 data sets of the {whose} itself stay below", "dim"))
    if corrected:
        lines.append(Text("shrink: of what is above the mean of such data sets", "dim"))
    if fitted:
        lines.append(Text("No period was held out; on the fitted ones the numbers flatter."))
    return Group(*lines)
