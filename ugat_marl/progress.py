"""Progress of long work: bars in a terminal, occasional lines elsewhere."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, Protocol

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.progress import Progress

Advance = Callable[..., None]
"""Called as ``advance()`` or ``advance(note="...")`` when a unit of work is done."""

_QUIET_S = 60.0
"""Least seconds between two lines of a task if there is no terminal."""

_PATIENCE_S = 1.0
"""Seconds of reading a file after which a bar appears."""


Loudness = Literal["quiet", "usual", "verbose"]
"""How much a program says: results only, progress as well, or everything that is measured."""

_loudness: list[Loudness] = ["usual"]


@contextlib.contextmanager
def loudness(level: Loudness) -> Iterator[None]:
    """Let all `Bars` that are made inside the block say as much as the level asks for."""
    _loudness.append(level)
    try:
        yield
    finally:
        _loudness.pop()


@dataclass(frozen=True)
class Share:
    """Part of a long work that tasks of one kind do.

    Attributes:
        units: Expected number of units of these tasks together.
        weight: Cost of a unit, in the same measure for all shares, such as episodes.
    """

    units: int
    weight: float = 1.0


class Reporter(Protocol):
    """Shows tasks of known length.

    Attributes:
        verbose: True if everything that is measured is to be shown.
    """

    verbose: bool

    def task(self, name: str, total: int) -> contextlib.AbstractContextManager[Advance]:
        """Show a task; the value of the context advances it by one."""
        ...

    def whole(
        self, name: str, shares: Mapping[str, Share]
    ) -> contextlib.AbstractContextManager[None]:
        """Show how far the tasks inside the block are all together.

        Args:
            name: Name of the whole.
            shares: Expected work of tasks, by the beginning of their names.
        """
        ...

    def say(self, text: str) -> None:
        """Show a line that stays."""
        ...


class Silent:
    """Reporter that shows nothing."""

    verbose = False

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """Do nothing."""
        yield lambda note="": None

    @contextlib.contextmanager
    def whole(self, name: str, shares: Mapping[str, Share]) -> Iterator[None]:
        """Do nothing."""
        yield

    def say(self, text: str) -> None:
        """Do nothing."""


class Bars:
    """Reporter with progress bars and the time left.

    Without a terminal, as in a log, a bar is printed when its task ends and at most once a minute
    before. Nothing is cut: a note that does not fit beside the bar is left out.

    Args:
        console: The console to write to.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._quiet = _loudness[-1] == "quiet"
        self.verbose = _loudness[-1] == "verbose"
        self._whole: _Whole | None = None
        self._is_live = False

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Advance]:
        """Show a bar that leaves one line behind when the task is done."""
        if self._quiet:
            yield lambda note="": None
            return
        progress = _bars(self._console)
        bar = progress.add_task(name, total=total, note="")
        lines, left = _Lines(self._console, progress), total
        room = self._console.width - _TAKEN - max(len(name), _NAME_WIDTH)
        whole = self._whole

        def advance(note: str = "") -> None:
            nonlocal left
            fields: dict[str, Any] = {"note": note if len(note) <= room else ""} if note else {}
            progress.update(bar, advance=1, **fields)
            left -= 1
            if whole is not None and left >= 0:
                whole.advance(name, 1)
            lines.print_at_times()
            if whole is not None:
                whole.lines.print_at_times()

        outer = whole.step if whole is not None else None  # a task may hold others
        # rich before 14 refuses a second live display; a bar inside another is printed at its end
        is_shown = whole is None and not self._is_live
        with progress if is_shown else contextlib.nullcontext():
            self._is_live |= is_shown
            if whole is not None:
                whole.step = progress
            try:
                yield advance
                progress.update(bar, completed=total)  # the work may end early by its own rule
                if whole is not None:
                    whole.advance(name, max(left, 0))
                if not is_shown:
                    lines.print()
                if whole is not None:
                    whole.lines.print_at_times()
            finally:
                self._is_live &= not is_shown
                if whole is not None:
                    whole.step = outer

    @contextlib.contextmanager
    def whole(self, name: str, shares: Mapping[str, Share]) -> Iterator[None]:
        """Show a bar for everything, above the bar of the task at hand."""
        if self._quiet:
            yield
            return
        self._whole = whole = _Whole(name, shares, self._console)
        live = contextlib.nullcontext()
        if self._console.is_terminal:
            from rich.live import Live

            live = Live(
                get_renderable=whole.drawn, console=self._console, transient=True, screen=False
            )
        try:
            with live:
                yield
        finally:
            self._whole = None

    def say(self, text: str) -> None:
        """Write a line."""
        if not self._quiet:
            self._console.print(text, highlight=False, markup=False)


class _Lines:
    """Lines that bars leave behind."""

    def __init__(self, console: Console, bars: Progress) -> None:
        self._console, self._bars = console, bars
        self._printed = time.monotonic()

    def print(self) -> None:
        """Print the bars."""
        self._console.print(self._bars.make_tasks_table(self._bars.tasks))

    def print_at_times(self) -> None:
        """Print the bars if there is no terminal, at most once a minute."""
        if not self._console.is_terminal and time.monotonic() - self._printed >= _QUIET_S:
            self._printed = time.monotonic()
            self.print()


class _Whole:
    """Bar of everything, in units of weight, and the bar of the task at hand."""

    def __init__(self, name: str, shares: Mapping[str, Share], console: Console) -> None:
        self._shares = shares
        self._left = {name: float(share.units) for name, share in shares.items()}
        self.progress = _bars(console, counted=False)
        self.lines = _Lines(console, self.progress)
        self.step: Progress | None = None
        total = sum(share.units * share.weight for share in shares.values())
        self._bar = self.progress.add_task(name, total=max(total, 1e-9), note="")

    def advance(self, name: str, units: int) -> None:
        """Count units of a task; more of them than expected count nothing."""
        kinds = [kind for kind in self._shares if name.startswith(kind)]
        if kinds:
            kind = max(kinds, key=len)
            counted = min(units, self._left[kind])
            self._left[kind] -= counted
            self.progress.update(self._bar, advance=counted * self._shares[kind].weight)

    def drawn(self) -> Group:
        """Return both bars."""
        from rich.console import Group

        return Group(*(bars for bars in (self.progress, self.step) if bars is not None))


_NAME_WIDTH = 30
_TAKEN = 42
"""Characters beside the name and the note: bar, numbers, times and the spaces between them."""


def _bars(console: Console, counted: bool = True) -> Progress:
    """Return a set of bars in the form that all of them have."""
    # here and not above: simulations and environments load this module, and show no bars
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn(f"{{task.description:<{_NAME_WIDTH}}}", markup=False),
        BarColumn(bar_width=10),
        MofNCompleteColumn() if counted else TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[note]}", style="dim", markup=False),
        console=console,
        auto_refresh=console.is_terminal,
    )


_shown: list[Reporter] = [Silent()]


def usual() -> Reporter:
    """Return the default reporter: the one of `showing`, else a silent one."""
    return _shown[-1]


def usual_of_long_work() -> Reporter:
    """Return the default reporter of what takes minutes: bars on standard error if none shows."""
    if len(_shown) > 1:
        return usual()
    from rich.console import Console

    return Bars(Console(stderr=True))


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
