"""What long work says while it runs: progress bars in a terminal, nothing elsewhere."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column

Advance = Callable[..., None]
"""Called as ``advance()`` or ``advance(note="...")`` when a unit of work is done."""


Pieces = Iterable[bytes]
"""A file, cut anywhere."""

_LONG = 8 << 20
"""Bytes from which reading a file is worth a bar."""


class Reporter(Protocol):
    """Shows tasks of known length."""

    def task(self, name: str, total: int) -> contextlib.AbstractContextManager[Advance]:
        """A task; the value of the context advances it by one."""
        ...

    def say(self, text: str) -> None:
        """A line that stays."""
        ...


class Silent:
    """Shows nothing."""

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """Does nothing."""
        del name, total
        yield lambda note="": None

    def say(self, text: str) -> None:
        """Does nothing."""


class Bars:
    """Progress bars with the time left; where there is no terminal, one line per task at its end.

    Args:
        console: Where to write.
    """

    def __init__(self, console: Console) -> None:
        self._console = console

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """A bar that leaves one line behind when the task is done."""
        columns = (
            TextColumn("{task.description:<26.26}"),
            BarColumn(bar_width=18),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(compact=True),
            TextColumn("[dim]{task.fields[note]}", table_column=self._rest()),
        )
        with Progress(*columns, console=self._console) as progress:
            bar = progress.add_task(name, total=total, note="")

            def advance(note: str = "") -> None:
                fields: dict[str, Any] = {"note": note} if note else {}
                progress.update(bar, advance=1, **fields)

            yield advance
            progress.update(bar, completed=total)  # the work may have ended early, by its own rule

    def _rest(self) -> Column:
        """What the other columns leave of a line: a long note must not squeeze them."""
        return Column(no_wrap=True, overflow="ellipsis", max_width=max(self._console.width - 74, 6))

    def say(self, text: str) -> None:
        """Writes a line."""
        self._console.print(text, highlight=False, markup=False)


@contextlib.contextmanager
def reading(path: Path, reporter: Reporter) -> Iterator[Callable[[Pieces], Pieces]]:
    """A bar over the pieces of a long file, each of a mebibyte; nothing for a short one.

    Args:
        path: The file.
        reporter: Shows the bar.
    """
    size = path.stat().st_size if path.is_file() else 0
    if size < _LONG or path.suffix == ".gz":  # how long a packed file is shows only at its end
        yield lambda pieces: pieces
        return
    with reporter.task(f"reading {path.name}, MiB", size >> 20) as advance:

        def counted(pieces: Pieces) -> Pieces:
            for piece in pieces:
                yield piece
                advance()

        yield counted
