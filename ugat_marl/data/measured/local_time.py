"""Local times of a street, with or without a time zone, as seconds of a scenario's clock."""

from __future__ import annotations

import itertools
import re
import zoneinfo
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import polars as pl

from ugat_marl.data.measured.values import first_row, place
from ugat_marl.errors import MeasuredDataError

_DATES = ("%Y-%m-%d ", "%Y-%m-%dT", "%m/%d/%Y ", "%d.%m.%Y ")
_OF_DAY = ("%H:%M:%S%.f", "%H:%M")
_OF_HALF_DAY = ("%I:%M:%S%.f %p", "%I:%M %p")
_HALF = r"(?i) ?([ap]m)$"
"""End of a time that has a half of the day."""

_OFFSET = r"(Z|:\d\d(\.\d+)? ?[+-]\d\d(:?\d\d)?)$"
"""End of a time that has an offset from UTC."""


@dataclass(frozen=True)
class LocalClock:
    """Local times at which the scenario's clock is 0.

    Attributes:
        zeros: Period to its local time.
        zeros_utc: The same in UTC.
        time_zone: Time zone of the street; "" if the times have none.
        unsure: What is wrong with a local time that is not one time in UTC; "" if there is none.
    """

    zeros: Mapping[str, datetime]
    zeros_utc: Mapping[str, datetime]
    time_zone: str = ""
    unsure: str = ""

    @classmethod
    def of(
        cls,
        path: Path,
        periods: pl.Series,
        begins_s: pl.Series,
        cells: pl.Series,
        time_zone: str,
        mapping: str = "the column time_zone",
    ) -> LocalClock:
        """Return the clock of some periods.

        A zero with an offset is a time in UTC. Without one, a period begins at its local time, and
        its clock runs on in UTC from there: a change of the clock before the period shifts nothing.

        Args:
            path: File of the times, for messages.
            periods: Name of each period.
            begins_s: Start of each, s on the scenario's clock.
            cells: Local time at which the scenario's clock is 0 in each.
            time_zone: Time zone of the street; "" if it is not known.
            mapping: Place at which the time zone can be given, for messages.

        Raises:
            MeasuredDataError: A time cannot be read.
        """
        zone = zoneinfo.ZoneInfo(time_zone or "UTC")
        zeros: dict[str, datetime] = {}
        zeros_utc: dict[str, datetime] = {}
        unsure = ""
        start = first_row(path)
        for at, (period, begin_s) in enumerate(zip(periods, begins_s, strict=True)):
            cell = _times(path, cells[at : at + 1], time_zone, at + start, mapping)
            where = f"{place(path, at + start)}: {cells.name}"
            try:
                zeros[period], zeros_utc[period], later = _readings(cell, begin_s, zone)
            except (OverflowError, ValueError):
                raise MeasuredDataError(
                    f"{where} is too early or too late for a date; write one such as "
                    "2024-03-05 07:00:00"
                ) from None
            if later != zeros_utc[period] and not unsure:
                what = (
                    "did not show, as they were set forward"
                    if later < zeros_utc[period]
                    else "showed twice, as they were set back"
                )
                begins = zeros[period] + timedelta(seconds=begin_s)
                unsure = (
                    f"{where} is {zeros[period]}, so period {period!r} begins at {begins}, which "
                    f"clocks in {time_zone} {what}; write {cells.name} with its offset"
                )
        return cls(zeros, zeros_utc, time_zone, unsure)

    def seconds(self, path: Path, cells: pl.Series, periods: pl.Series, start: int) -> pl.Series:
        """Return times as seconds of the scenario's clock, named as `cells` with ``_s``.

        Args:
            path: File of the times.
            cells: Times.
            periods: Period of each; a time of an unknown period becomes 0.
            start: Number of the first row, for messages.

        Raises:
            MeasuredDataError: A time cannot be read, or `zeros_of` fails.
        """
        times = _times(path, cells, self.time_zone, start, "periods.csv, as time_zone")
        zero = periods.replace_strict(self.zeros_of(times), default=None, return_dtype=times.dtype)
        # a time of an unknown period is left out later, with its row
        seconds = ((times - zero).dt.total_microseconds() / 1e6).fill_null(0.0)
        return seconds.set(times.is_null(), None).alias(f"{cells.name}_s")

    def zeros_of(self, times: pl.Series) -> Mapping[str, datetime]:
        """Return the times at which the clock is 0, in UTC if `times` have a time zone.

        Raises:
            MeasuredDataError: `times` have a time zone, and the street's clock showed the start of
                a period twice or never.
        """
        if not _is_zoned(times):
            return self.zeros
        if self.unsure:
            raise MeasuredDataError(self.unsure)
        return self.zeros_utc  # local times would lose or gain an hour where the clock is changed


def require_time_zone(name: str, where: str) -> None:
    """Refuse a time zone that does not exist.

    Raises:
        MeasuredDataError: There is no such zone.
    """
    if name and name not in zoneinfo.available_timezones():
        raise MeasuredDataError(
            f"{where}: unknown time_zone {name!r}; write one such as America/Denver"
        )


def local_times(
    path: Path, cells: pl.Series, time_zone: str, start: int, mapping: str
) -> pl.Series:
    """Return times in microseconds, in the street's time zone if they have one.

    Empty cells stay empty.

    Args:
        path: File of the times.
        cells: Texts or datetimes; their name is that of the column.
        time_zone: Time zone of the street; required if the times have one.
        start: Number of the first row, for messages.
        mapping: Place at which the time zone can be given, for messages.

    Raises:
        MeasuredDataError: The times have an unknown form, or a time zone without `time_zone`.
    """
    times = _times(path, cells, time_zone, start, mapping)
    return times.dt.convert_time_zone(time_zone) if _is_zoned(times) else times


def _readings(
    zero: pl.Series, begin_s: float, zone: zoneinfo.ZoneInfo
) -> tuple[datetime, datetime, datetime]:
    """Return a period's zero on the street's clock, and in UTC.

    The two times in UTC are unequal only if the street's clock showed the start of the period
    twice or never.

    Args:
        zero: One time, in UTC or without a time zone.
        begin_s: Start of the period, s on the scenario's clock.
        zone: Time zone of the street.

    Raises:
        OverflowError: A time is too far off.
        ValueError: A time is too far off.
    """
    (time,) = zero
    if _is_zoned(zero):
        return time.astimezone(zone).replace(tzinfo=None), time, time
    begin = timedelta(seconds=begin_s)
    shown = (time + begin).replace(tzinfo=zone)
    first, second = (shown.replace(fold=fold).astimezone(UTC) - begin for fold in (0, 1))
    return time, first, second


def _is_zoned(times: pl.Series) -> bool:
    return isinstance(times.dtype, pl.Datetime) and times.dtype.time_zone is not None


def _times(path: Path, cells: pl.Series, time_zone: str, start: int, mapping: str) -> pl.Series:
    """Return times in microseconds, in UTC if they have a time zone; see `local_times`."""
    if isinstance(cells.dtype, pl.String):
        cells = _parsed(path, cells.str.strip_chars(), start)
    if not isinstance(cells.dtype, pl.Datetime):
        raise MeasuredDataError(
            f"{path}: {cells.name} has the type {cells.dtype}; it holds dates with times"
        )
    if cells.dtype.time_zone is not None:
        if not time_zone:
            raise MeasuredDataError(
                f"{path}: {cells.name} has offsets from UTC, such as Z or +01:00; write the "
                f"street's own time_zone in {mapping}, such as America/Denver"
            )
        return cells.dt.convert_time_zone("UTC").dt.cast_time_unit("us")
    return cells.cast(pl.Datetime("us"))


def _parsed(path: Path, cells: pl.Series, start: int) -> pl.Series:
    empty = cells.is_null() | (cells == "")
    given, cells = cells, cells.str.replace(r"(:\d\d:\d\d),(\d)", "$1.$2")
    offset = cells.str.contains(_OFFSET)
    if offset.any():
        whole = (
            cells.str.replace(r" ([+-])", "$1")
            .str.replace(" ", "T", literal=True)
            .str.replace(r"(T\d\d:\d\d)(Z|[+-])", "${1}:00${2}")  # without seconds
            .str.replace(r"([+-]\d\d)$", "${1}:00")
        )
        zoned = whole.str.to_datetime("%+", strict=False, time_unit="us", time_zone="UTC")
        parsed = [zoned.set(~offset, None)]
    else:
        days = cells
        if cells.name == "zero" or cells.str.contains(":", literal=True).any():
            between = "T" if cells.str.contains("T", literal=True).any() else " "
            midnight = f"${{1}}{between}00:00:00"  # which pandas leaves out
            days = cells.str.replace(r"^(\d{4}-\d\d-\d\d)$", midnight)
        times = _OF_DAY
        if days.str.contains(_HALF).any():
            days, times = days.str.replace(_HALF, " $1"), _OF_HALF_DAY
        parsed = [
            days.str.to_datetime(date + time, strict=False, time_unit="us")
            for time, date in itertools.product(times, _DATES)
        ]
    best = min(parsed, key=lambda times: times.null_count())
    wrong = best.is_null() & ~empty.fill_null(True)
    if wrong.any():
        at = int(wrong.arg_true()[0])
        text = str(given[at])[:40]
        dotted = re.fullmatch(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T]+(\d.*)", text, re.ASCII)
        if dotted:
            day, month, year, clock = dotted.groups()
            way_out = f"write it as {year}-{month:0>2}-{day:0>2} {clock}"
        elif offset.any() and not offset[at]:
            way_out = "other times of the column have an offset from UTC; write it behind this one"
        else:
            way_out = "write it in a form such as 2024-03-05 07:00:00.1"
        raise MeasuredDataError(f"{place(path, at + start)}: {cells.name} is {text!r}; {way_out}")
    return best
