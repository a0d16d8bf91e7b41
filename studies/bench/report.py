"""Report of a bench: rows of numbers, targets, and the machine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ugat_marl.errors import OptionError
from ugat_marl.experiments import machine_facts
from ugat_marl.files import write_whole


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements.

    Attributes:
        median: Median of the values.
        low: First quartile.
        high: Third quartile.
        values: All values, in the order of measurement.
    """

    median: float
    low: float
    high: float
    values: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of at least one value; quartiles are interpolated linearly."""
        low, median, high = np.quantile(np.asarray(values, dtype=np.float64), [0.25, 0.5, 0.75])
        return cls(float(median), float(low), float(high), tuple(float(v) for v in values))

    @classmethod
    def of_ratios(cls, above: Sequence[float], below: Sequence[float]) -> Spread:
        """Return the spread of ``above[i] / below[i]``, each ratio within one round i."""
        return cls.of([a / b for a, b in zip(above, below, strict=True)])

    def __str__(self) -> str:
        return f"{_short(self.median)} ({_short(self.low)}-{_short(self.high)})"


@dataclass(frozen=True)
class Target:
    """A goal for a measured number.

    Attributes:
        name: Name of the measured number.
        measured: Median of the measurements.
        limit: Value to compare it with.
        at_least: True if `measured` must be at least `limit`; false if at most.
    """

    name: str
    measured: float
    limit: float
    at_least: bool

    @property
    def met(self) -> bool:
        """True if the goal is reached; false for nan."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    def __str__(self) -> str:
        sign = ">=" if self.at_least else "<="
        verdict = "met" if self.met else "MISSED"
        return f"{self.name}: {_short(self.measured)} (target {sign} {self.limit:g}) {verdict}"


@dataclass(frozen=True)
class Report:
    """Result of a bench.

    Attributes:
        bench: Name of the bench on the command line.
        settings: Options of the bench, seeds included.
        rows: Measurements, as mappings with the same keys; values are text, numbers or `Spread`.
        targets: Goals for measured numbers.
        notes: Remarks that a reader needs to judge the numbers.
        machine: CPU, Python, versions, date and command line.
        by: Columns of `rows` whose values divide them into tables.
        aside: Columns that only the JSON file shows.
    """

    bench: str
    settings: Mapping[str, Any]
    rows: Sequence[Mapping[str, Any]]
    targets: Sequence[Target]
    notes: Sequence[str] = ()
    machine: Mapping[str, Any] = field(default_factory=machine_facts)
    by: tuple[str, ...] = ()
    aside: tuple[str, ...] = ()

    @property
    def met(self) -> bool:
        """True if every target is met."""
        return all(target.met for target in self.targets)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; nan becomes None."""
        targets = [{**asdict(target), "met": target.met} for target in self.targets]
        return {
            "bench": self.bench,
            "settings": _plain(self.settings),
            "rows": _plain(self.rows),
            "targets": _plain(targets),
            "notes": list(self.notes),
            "machine": _plain(self.machine),
        }

    def write(self, path: Path) -> None:
        """Write the report as JSON; an interrupted write does not damage an older file."""
        write_whole(path, json.dumps(self.as_dict(), indent=2, allow_nan=False) + "\n")

    def tables(self) -> Group:
        """Return rows, targets and notes for a terminal of 80 columns.

        There is one table for each value of `by`. It shows the median of a spread; the JSON file
        holds the rest.
        """
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for row in self.rows:
            groups.setdefault(", ".join(str(row[column]) for column in self.by), []).append(row)
        lines = [
            Text(str(target), style="green" if target.met else "red") for target in self.targets
        ]
        notes = (Text(note, style="dim") for note in self.notes)
        return Group(*(self._table(*group) for group in groups.items()), *lines, *notes)

    def _table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> Table:
        columns = [column for column in rows[0] if column not in (*self.by, *self.aside)]
        title = f"bench {self.bench}" + (f": {name}" if name else "")
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        for column in columns:
            numbers = not isinstance(rows[0][column], str)
            table.add_column(
                Text(column), justify="right" if numbers else "left", no_wrap=not numbers
            )
        for row in rows:
            table.add_row(*(Text(_cell(row[column])) for column in columns))
        return table


def require_positive(bench: str, **options: float) -> None:
    """Refuse options of a bench that are not at least 1.

    Raises:
        OptionError: An option is smaller.
    """
    for name, value in options.items():
        if value < 1:
            raise OptionError(f"bench {bench}: {name} = {value!r}: must be at least 1")


def _short(number: float) -> str:
    """Return a number with three or more significant digits, without exponent."""
    if not math.isfinite(number):
        return "-"
    if abs(number) >= 999.5:
        return f"{number:.0f}"
    return np.format_float_positional(number, 3, unique=False, fractional=False, trim="-")


def _cell(value: Any) -> str:
    if isinstance(value, Spread):
        return _short(value.median)
    return _short(value) if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Spread):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
