"""Progress of long work: bars in a terminal, occasional lines elsewhere."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Protocol

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

_QUIET_S = 60.0
"""Least seconds between two lines of a task if there is no terminal."""

_PATIENCE_S = 1.0
"""Seconds of reading a file after which a bar appears."""


class Reporter(Protocol):
    """Shows tasks of known length."""

    def task(self, name: str, total: int) -> contextlib.AbstractContextManager[Advance]:
        """Show a task; the value of the context advances it by one."""
        ...

    def say(self, text: str) -> None:
        """Show a line that stays."""
        ...


class Silent:
    """Reporter that shows nothing."""

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """Do nothing."""
        del name, total
        yield lambda note="": None

    def say(self, text: str) -> None:
        """Do nothing."""


class Bars:
    """Reporter with progress bars and the time left.

    Without a terminal, as in a log, a bar is printed when its task ends and at most once a minute
    before.

    Args:
        console: The console to write to.
    """

    def __init__(self, console: Console) -> None:
        self._console = console

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """Show a bar that leaves one line behind when the task is done."""
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
            printed = time.monotonic()

            def advance(note: str = "") -> None:
                nonlocal printed
                fields: dict[str, Any] = {"note": note} if note else {}
                progress.update(bar, advance=1, **fields)
                if not self._console.is_terminal and time.monotonic() - printed >= _QUIET_S:
                    printed = time.monotonic()
                    self._console.print(progress.make_tasks_table(progress.tasks))

            yield advance
            progress.update(bar, completed=total)  # the work may end early by its own rule

    def _rest(self) -> Column:
        """Return the column of the note, as wide as the other columns leave space."""
        return Column(no_wrap=True, overflow="ellipsis", max_width=max(self._console.width - 74, 6))

    def say(self, text: str) -> None:
        """Write a line."""
        self._console.print(text, highlight=False, markup=False)


_shown: list[Reporter] = [Silent()]


def usual() -> Reporter:
    """Return the default reporter: the one of `showing`, else a silent one."""
    return _shown[-1]


@contextlib.contextmanager
def showing(reporter: Reporter) -> Iterator[None]:
    """Make a reporter the default of the whole program inside the block."""
    _shown.append(reporter)
    try:
        yield
    finally:
        _shown.pop()


def watched(pieces: Iterable[bytes], file: IO[bytes], reporter: Reporter) -> Iterator[bytes]:
    """Yield the pieces of a file, with a bar if reading takes longer than a second.

    Args:
        pieces: Content of the file, unpacked or not.
        file: The open file; its position shows how much has been read.
        reporter: Shows the bar.
    """
    size, name = os.fstat(file.fileno()).st_size, Path(file.name).name
    begun, done, advance = time.monotonic(), 0, None
    with contextlib.ExitStack() as stack:
        for piece in pieces:
            yield piece
            if advance is None and size >> 20 and time.monotonic() - begun > _PATIENCE_S:
                advance = stack.enter_context(reporter.task(f"MiB of {name}", size >> 20))
            while advance is not None and done < file.tell() >> 20:
                advance()
                done += 1
