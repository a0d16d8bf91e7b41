"""Headroom of a scenario as a Markdown table."""

from __future__ import annotations

from collections.abc import Sequence

from ugat_marl.experiments import HOLDS_S, HeadroomRow


def headroom_markdown(rows: Sequence[HeadroomRow], holds_s: Sequence[int] = HOLDS_S) -> str:
    """Return the rows as a Markdown table; the best hold of each domain is bold."""
    head = ["ATT [s]", *(f"held {hold_s} s" for hold_s in holds_s), "own programme"]
    head += [f"lost by the rule best in {rows[0].domain}", "arrived", "never got in"]
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for row in rows:
        cells = [
            f"**{att_s:.1f}**" if hold_s == row.best_hold_s else f"{att_s:.1f}"
            for hold_s, att_s in zip(holds_s, row.att_s, strict=True)
        ]
        measures = [f"{row.lost:.0%}", f"{row.finished:.1%}", f"{row.backlog:.0f}"]
        lines.append([row.domain, *cells, f"{row.programme_att_s:.1f}", *measures])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"
