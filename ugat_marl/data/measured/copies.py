"""Checks that no two periods hold one recording."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import polars as pl

from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Period

FEWEST = 20
"""Smallest number of vehicles, or of rows with vehicles, that tells something."""
TWICE = (
    "one recording would count twice; let periods of one day not overlap, and give each day its "
    "own rows"
)
"""End of the errors."""


def overlapping(periods: Sequence[Period]) -> Iterator[tuple[Period, Period]]:
    """Yield the pairs of periods that share some times of the day."""
    for one, other in itertools.combinations(periods, 2):
        if one.begin_s < other.end_s and other.begin_s < one.end_s:
            yield one, other


def refuse_copies(
    path: Path, frame: pl.DataFrame, periods: Sequence[Period], keys: Sequence[str], values: str
) -> None:
    """Refuse two periods whose rows of the same times all have the same values.

    Rows without vehicles are equal on every quiet night, so that they do not count.

    Args:
        path: The file.
        frame: Its rows, with ``period_id``.
        periods: The periods.
        keys: Columns that say what a row is about, and when.
        values: Column of numbers, 0 for no vehicles.

    Raises:
        MeasuredDataError: Two periods hold one recording.
    """
    parts = frame.select("period_id", *keys, values).partition_by("period_id", as_dict=True)
    for one, other in overlapping(periods):
        if (one.id,) not in parts or (other.id,) not in parts:
            continue
        both = parts[one.id,].join(parts[other.id,], on=[*keys])
        twin = pl.col(f"{values}_right")
        told = both.filter((pl.col(values) > 0) | (twin > 0))
        if told.height >= FEWEST and told.select((pl.col(values) == twin).all()).item():
            raise MeasuredDataError(
                f"{path}: the periods {one.id!r} and {other.id!r} share {told.height} rows with "
                f"vehicles, and all of them are the same: {TWICE}"
            )
