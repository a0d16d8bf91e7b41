"""Standings as tables for the terminal."""

from __future__ import annotations

import math

import polars as pl
from rich.console import Group, RenderableType
from rich.text import Text

from ugat_marl.experiments import Interval, ranked
from ugat_marl.reporting.formats import chance, mean_text, number_text, share_text
from ugat_marl.reporting.terminal import titled_table


def standings_table(scenario: str, table: pl.DataFrame, name: str) -> RenderableType:
    """Return the settings of each domain, the fastest first; one of them is marked.

    Args:
        scenario: Id of the scenario.
        table: A table of standings (`experiments.standings`).
        name: Setting to mark.
    """
    rows = ranked(table)
    blocks: list[RenderableType] = []
    for domain in rows["domain"].unique(maintain_order=True):
        shown = titled_table(f"{scenario} in {domain}: average travel time, s")
        shown.add_column("", width=1)
        shown.add_column("setting", max_width=30, overflow="fold")
        for heading in ("runs", "ATT (95 %)", "gap", "regret", "won back", "p"):
            shown.add_column(heading, justify="right", no_wrap=True)
        for row in rows.filter(pl.col("domain") == domain).iter_rows(named=True):
            ends = (math.nan if row[end] is None else row[end] for end in ("low_s", "high_s"))
            att = mean_text(Interval(row["att_s"], *ends))
            shown.add_row(
                "▶" if row["setting"] == name else "",
                Text(row["setting"]),
                str(row["trainings"]),
                att,
                number_text(row["gap_s"]),
                number_text(row["regret_s"]),
                "–" if row["won_back"] is None else share_text(row["won_back"]),
                chance(row["p"]),
            )
        blocks.append(shown)
    blocks.append(
        Text(
            "runs: trainings. gap: minus that in the simulation. regret: minus the fastest. won "
            "back: share of direct transfer's regret. p: Welch's test against direct transfer."
        )
    )
    return Group(*blocks)
