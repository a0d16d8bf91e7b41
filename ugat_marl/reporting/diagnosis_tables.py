"""A diagnosis in a terminal of 80 columns."""

from __future__ import annotations

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ugat_marl.diagnosis import statistic
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_words import Record
from ugat_marl.reporting.formats import chance, number, share, signed

_SHOWN = 3
"""Number of disagreements in the table."""


def diagnosis_summary(record: Record) -> RenderableType:
    """Return verdict, effects, strongest disagreements and the numbers of the held-out periods.

    `record` is the content of ``diagnosis.json``.
    """
    blocks: list[RenderableType] = []
    if (text := words.partial(record)) is not None:
        blocks.append(Text(text, style="bold yellow"))
    verdict = words.VERDICTS.get(record["verdict"], record["verdict"])
    blocks.append(Text(f"{verdict}: {record['sentence']}", style="bold"))
    if record.get("next_measurement"):
        blocks.append(Text(f"What would tell: {record['next_measurement']}."))
    if record["effects"]:
        blocks.append(_effects(record))
    if record.get("where"):
        blocks.append(_where(record))
    if record["heldout"] is not None:
        blocks.append(_heldout(record))
    if (text := words.geh_line(record)) is not None:
        blocks.append(Text(text))
    return Group(*blocks)


def _table(title: str) -> Table:
    return Table(
        box=box.SIMPLE_HEAD,
        title=Text(title),
        title_justify="left",
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )


def _effects(record: Record) -> Table:
    table = _table("effects (value with 95 % interval)")
    table.add_column("effect", overflow="fold", max_width=20)
    table.add_column("where", overflow="fold", max_width=22)
    if any(item.get("window") for item in record["effects"]):
        table.add_column("when", no_wrap=True)
    table.add_column("value", overflow="fold")
    for item in record["effects"]:
        cells = [words.effect_name(item), words.place(item)]
        if len(table.columns) > len(cells) + 1:
            cells.append(words.window(item.get("window")) or "always")
        table.add_row(*map(Text, [*cells, words.values(item)]))
    return table


def _where(record: Record) -> Table:
    table = _table("strongest disagreements (measured minus simulated)")
    table.add_column("where", overflow="fold", max_width=18)
    table.add_column("what", overflow="fold", max_width=36)
    table.add_column("size", justify="right", no_wrap=True)
    table.add_column("z", justify="right", no_wrap=True)
    for item in words.strongest(record, _SHOWN):
        size = f"{signed(item['size'])} {item['unit']}".rstrip()
        what = f"{item['regime']}: {statistic(item['statistic'])}"
        if item.get("window"):
            what += f", {words.window(item['window'])}"
        row = (words.disagreement_place(item), what, size, signed(item["z"]))
        table.add_row(*map(Text, row))
    return table


def _heldout(record: Record) -> RenderableType:
    found = record["heldout"]
    flattering = bool(record.get("verified_on_fitted_periods"))
    where = "fitted periods" if flattering else "held-out periods"
    lines: list[RenderableType] = [Text(f"distance of the data from the simulation, {where}")]
    table = _table("")
    table.title = None
    for heading in ("before", "after", "floor", "shrink", "p before", "p after"):
        table.add_column(heading, justify="right")
    table.add_row(
        number(found["before"]),
        number(found["after"]) if found["shrink"] is not None else "–",
        number(found["floor"]),
        share(found["shrink"]),
        chance(found["p_before"]),
        chance(found["p_after"]) if found["shrink"] is not None else "–",
    )
    lines.append(table)
    lines.append(Text("floor: 99 of 100 data sets of the simulation itself stay below", "dim"))
    if flattering:
        lines.append(Text("No period was held out; on the fitted ones the numbers flatter."))
    return Group(*lines)
