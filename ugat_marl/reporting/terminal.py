"""The form that tables for the terminal share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

_MOST_WORD = 24
"""Longest word that is kept whole in a table that is too wide, in characters."""

_MOST_NAME = 22
"""Widest column of names, in characters: three of them leave numbers a place in 80 columns."""


class WholeWords(Table):
    """A table that breaks its lines between words, as long as all words have room.

    A table of rich takes width from its widest columns first, even if that splits a word there
    while lines of other columns could be broken at a space.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Set the widths of the columns, and draw the table."""
        _, right, _, left = self.padding
        inner = len(self.columns) - 1
        edges = (left + right) * (inner + (1 if self.pad_edge else 0))
        room = options.max_width - edges - inner * bool(self.box) - 2 * (self.show_edge)
        spans = [_span(console, options, column) for column in self.columns]
        fits = sum(span.maximum for span in spans) <= room
        widths = [None] * len(spans) if fits else _widths(spans, room)
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        title, self.title = self.title, None
        if title:  # as wide as the screen, and not as the table
            yield title if isinstance(title, Text) else Text(title)
        yield from super().__rich_console__(console, options)
        self.title = title


def in_tables(names: Sequence[str], most: int) -> Iterator[Sequence[str]]:
    """Yield the columns of tables beneath each other, which have at most so many side by side."""
    for first in range(0, len(names), most):
        yield names[first : first + most]


def _span(console: Console, options: ConsoleOptions, column: Column) -> Measurement:
    """Return the widths of a column with its words whole, and with its lines whole."""
    cells = [column.header, *column.cells]
    found = [Measurement.get(console, options, cell) for cell in cells]
    most = max(span.maximum for span in found)
    least = max(min(span.minimum, _MOST_WORD) for span in found)
    if column.max_width is not None:
        most = min(most, column.max_width)
    return Measurement(most if column.no_wrap else min(least, most), most)


def _widths(spans: Sequence[Measurement], room: int) -> list[int]:
    """Return widths for the columns of a table; where words leave no room, the widest give way."""
    widths = [span.minimum for span in spans]
    while sum(widths) > room:
        widths[widths.index(max(widths))] -= 1
    while sum(widths) < room:  # the column that lacks most
        lacks = [span.maximum - width for span, width in zip(spans, widths, strict=True)]
        widths[lacks.index(max(lacks))] += 1
    return widths


def titled_table(title: str) -> Table:
    """Return a table without columns, under its title, as narrow as its cells."""
    return WholeWords(
        box=box.SIMPLE_HEAD,
        title=Text(title) if title else None,
        title_justify="left",
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )


def named_table(title: str, *headings: str) -> Table:
    """Return a titled table that begins with columns of names, which may be broken anywhere."""
    table = titled_table(title)
    for heading in headings:
        table.add_column(heading, max_width=_MOST_NAME, overflow="fold")
    return table
