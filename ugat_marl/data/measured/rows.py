"""Rows of signals and detections: which period they are of, and in which order they happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.data import Finding
from ugat_marl.data.measured.tables import place
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Period

CLOCK_JUMP_S = 60.0
"""A step back by more is a clock set back; by less, late delivery."""
FEW_ROWS = 10
"""In a stream of fewer rows nobody can tell a clock set back from rows out of order."""
MOST_OUTSIDE = 0.5
"""Share of the rows that may lie outside of their periods."""
EPOCH = 1e8
"""Larger times are dates, not seconds of a scenario."""

PERIOD = "period"
"""Column with the index of the row's period."""


def with_period(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    found: list[Finding],
    *,
    early: bool = False,
) -> pl.DataFrame:
    """The rows within their periods, times rounded to 1 ms, with the column `PERIOD`.

    Args:
        path: Where the rows come from.
        frame: Rows with ``period_id`` and ``time_s``.
        periods: The periods.
        found: Findings; what is left out is added.
        early: Whether rows before the begin of a period are kept.

    Raises:
        MeasuredDataError: No row of a known period, or most rows of a period outside of it.
    """
    index = {period.id: i for i, period in enumerate(periods)}
    frame = frame.with_columns(
        pl.col("period_id").replace_strict(index, default=None, return_dtype=pl.Int32).alias(PERIOD)
    )
    other = frame.filter(pl.col(PERIOD).is_null())
    if other.height:
        names = ", ".join(map(repr, other["period_id"].unique().sort().to_list()[:5]))
        if other.height == frame.height:
            raise MeasuredDataError(
                f"{path}: no row is of a period in periods.csv ({', '.join(list(index)[:5])}); "
                f"the rows are of {names}"
            )
        found.append(
            Finding(
                f"{path.name}: {other.height} rows are of periods that periods.csv does not list "
                f"({names}); they are left out"
            )
        )
        frame = frame.filter(pl.col(PERIOD).is_not_null())
    begins = np.array([period.begin_s for period in periods])
    ends = np.array([period.end_s for period in periods])
    which = frame[PERIOD].to_numpy()
    time = frame["time_s"].round(3).to_numpy() + 0.0
    inside = time <= ends[which]
    if not early:
        inside &= time >= begins[which]
    if not inside.all():
        _report_outside(path, periods, which, time, inside, found)
    frame = frame.with_columns(pl.Series("time_s", time))
    return frame.filter(pl.Series(inside))


def _report_outside(
    path: Path,
    periods: Sequence[Period],
    which: NDArray[np.int32],
    time: NDArray[np.float64],
    inside: NDArray[np.bool_],
    found: list[Finding],
) -> None:
    total = np.bincount(which, minlength=len(periods))
    outside = np.bincount(which[~inside], minlength=len(periods))
    for period, rows, lost in zip(periods, total, outside, strict=True):
        if lost > MOST_OUTSIDE * rows:
            example = time[~inside & (which == periods.index(period))][0]
            hint = (
                "these are dates; subtract the moment at which the scenario's clock is 0"
                if abs(example) > EPOCH
                else "write times in seconds of the scenario's clock"
            )
            raise MeasuredDataError(
                f"{path}: {lost} of {rows} rows of period {period.id!r} lie outside of it "
                f"({period.begin_s:g} s to {period.end_s:g} s), the first at {example:g} s; {hint}"
            )
    lost = int(outside.sum())
    names = ", ".join(repr(p.id) for p, n in zip(periods, outside, strict=True) if n)
    found.append(
        Finding(f"{path.name}: {lost} of {len(time)} rows lie outside of their periods ({names})")
    )


def in_order(
    path: Path,
    key: NDArray[np.int64],
    time: NDArray[np.float64],
    found: list[Finding],
) -> NDArray[np.int64]:
    """The order by stream and time; rows of one stream at the same time stay as they are.

    Args:
        path: Where the rows come from.
        key: Stream of each row ``(n,)``.
        time: ``(n,)`` s.
        found: Findings; a sort that was needed is added.
    """
    as_found = np.argsort(key, kind="stable")
    back = len(_steps_back(key[as_found], time[as_found]))
    if not back:
        return as_found
    found.append(Finding(f"{path.name}: {back} rows come before an earlier one; they were sorted"))
    return np.lexsort((time, key))


def refuse_set_back(
    path: Path,
    key: NDArray[np.int64],
    time: NDArray[np.float64],
    row: NDArray[np.int64],
    name: Callable[[int], str],
) -> None:
    """Refuses streams whose clock was set back.

    A file that is merely out of order steps back all the time; one whose pieces were put together
    the wrong way has no time twice.

    Args:
        path: Where the rows come from.
        key: Stream of each row ``(n,)``; what is exported on its own is a stream of its own.
        time: ``(n,)`` s.
        row: Number of the row in its file ``(n,)``.
        name: What to call a stream in messages.

    Raises:
        MeasuredDataError: The clock of a stream was set back, so that some of its time is there
            twice.
    """
    as_found = np.argsort(key, kind="stable")
    stream, clock = key[as_found], time[as_found]
    back = _steps_back(stream, clock)
    if not len(back):
        return
    starts = np.flatnonzero(np.diff(stream, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(stream)), strict=True):
        steps = back[(back > begin) & (back < end)]
        if not 1 <= len(steps) <= 2 or end - begin < FEW_ROWS:
            continue
        step = int(steps[0])
        jump = clock[step - 1] - clock[step]
        if jump > CLOCK_JUMP_S and clock[end - 1] > clock[begin]:
            raise MeasuredDataError(
                f"{place(path, int(row[as_found[step]]))}: the clock of {name(int(stream[begin]))} "
                f"steps back by {jump:g} s, so some time is there twice (daylight saving, or a "
                "clock that was set?); end the period before the step, or correct the times "
                "behind it"
            )


def _steps_back(stream: NDArray[np.int64], clock: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows that are earlier than the one before them in their stream."""
    return np.flatnonzero((stream[1:] == stream[:-1]) & (np.diff(clock) < 0)) + 1
