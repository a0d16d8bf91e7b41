"""The form that tables for the terminal share."""

from __future__ import annotations

from rich import box
from rich.table import Table
from rich.text import Text


def titled_table(title: str) -> Table:
    """Return a table without columns, under its title, as narrow as its cells."""
    return Table(
        box=box.SIMPLE_HEAD,
        title=Text(title),
        title_justify="left",
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
