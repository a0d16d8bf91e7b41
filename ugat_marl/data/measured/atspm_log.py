"""High-resolution logs of signal controllers: their columns, their events, their times."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ugat_marl.data.measured.data import Finding
from ugat_marl.data.measured.tables import ROW, place, read_raw, to_numbers, to_texts
from ugat_marl.errors import MeasuredDataError

GREEN, YELLOW, RED = "G", "y", "r"

PHASE_EVENTS = {1: GREEN, 8: YELLOW, 9: RED, 10: RED, 11: RED, 12: RED}
"""Begin green, begin yellow, end yellow, begin and end red clearance, phase inactive. The red
clearance is logged only where it is served, so the end of yellow counts as red."""
OVERLAP_EVENTS = {61: GREEN, 62: GREEN, 63: YELLOW, 64: RED, 65: RED, 66: RED}
"""Begin green, begin trailing green, begin yellow, begin red clearance, off, dark."""
ARROW_EVENTS = {32: GREEN, 33: RED}
"""A flashing yellow arrow, on which one may turn but yields, begins and ends."""
BEFORE = {
    1: RED,
    8: GREEN,
    9: YELLOW,
    10: YELLOW,
    61: RED,
    62: GREEN,
    63: GREEN,
    64: YELLOW,
    32: RED,
    33: GREEN,
}
"""What was shown before an event, where that is sure."""
DETECTOR_OFF, DETECTOR_ON = 81, 82
"""Parameter: detector channel. Stamped after the controller's own delay and extension."""
DETECTOR_FAULTS = (84, 85, 86, 87, 88)
CLOCK_UPDATED = 181

# Names of the columns: of ODOT's atspm package, and of UDOT's Controller_Event_Log.
_NAMES = {
    "timestamp": "time",
    "deviceid": "device",
    "signalid": "device",
    "locationidentifier": "device",
    "eventid": "event",
    "eventcode": "event",
    "parameter": "parameter",
    "eventparam": "parameter",
    "eventparameter": "parameter",
}
_FORMATS = (
    "%Y-%m-%d %H:%M:%S%.f",
    "%Y-%m-%dT%H:%M:%S%.f",
    "%m/%d/%Y %H:%M:%S%.f",
    "%m/%d/%Y %I:%M:%S%.f %p",
)


def read_log(path: Path, time_zone: str, found: list[Finding]) -> pl.DataFrame:
    """The events of a log.

    Args:
        path: CSV or Parquet with TimeStamp, DeviceId, EventId and Parameter, in any spelling.
        time_zone: Where the street is; needed if the times carry a time zone.
        found: Findings.

    Returns:
        ``ROW``, ``time`` (local, microseconds), ``device`` (text), ``event``, ``parameter``, in
        the order of the file; rows without event or parameter are left out.

    Raises:
        MeasuredDataError: Unreadable, a column missing, or times nobody can read.
    """
    if path.suffix not in (".csv", ".parquet"):
        raise MeasuredDataError(f"{path}: a log is a .csv or a .parquet file")
    raw = read_raw(path, found)
    names: dict[str, str] = {}
    for column in raw.columns:
        meaning = _NAMES.get("".join(x for x in column if x not in " _").lower())
        if meaning and meaning not in names.values():
            names[column] = meaning
    if missing := sorted({"time", "device", "event", "parameter"} - set(names.values())):
        raise MeasuredDataError(
            f"{path}: no column for {', '.join(missing)}; it has {', '.join(raw.columns[:12])}, "
            "and needs TimeStamp, DeviceId, EventId, Parameter"
        )
    raw = raw.select(*names).rename(names)
    if raw.is_empty():
        raise MeasuredDataError(f"{path}: no events")
    start = 1 if path.suffix == ".parquet" else 2
    frame = pl.DataFrame(
        [
            pl.int_range(start, raw.height + start, dtype=pl.Int64, eager=True).alias(ROW),
            _times(path, raw["time"], time_zone, start),
            to_texts(path, raw["device"]),
            to_numbers(path, raw["event"]),
            to_numbers(path, raw["parameter"]),
        ]
    )
    whole = frame.drop_nulls()
    if whole.height < frame.height:
        found.append(
            Finding(f"{path.name}: {frame.height - whole.height} rows with empty cells left out")
        )
    return whole.with_columns(
        pl.col("event").cast(pl.Int64, strict=False),
        pl.col("parameter").cast(pl.Int64, strict=False),
    ).drop_nulls()


def _times(path: Path, cells: pl.Series, time_zone: str, start: int) -> pl.Series:
    """Local times without a time zone."""
    if isinstance(cells.dtype, pl.String):
        cells = _parsed(path, cells.str.strip_chars(), start)
    if not isinstance(cells.dtype, pl.Datetime):
        raise MeasuredDataError(
            f"{path}: TimeStamp has the type {cells.dtype}; it holds dates with times"
        )
    if cells.dtype.time_zone is not None:
        if not time_zone:
            raise MeasuredDataError(
                f"{path}: TimeStamp has the time zone {cells.dtype.time_zone}; write the street's "
                'own in the mapping, as in time_zone = "America/Denver"'
            )
        cells = cells.dt.convert_time_zone(time_zone).dt.replace_time_zone(None)
    return cells.cast(pl.Datetime("us"))


def _parsed(path: Path, cells: pl.Series, start: int) -> pl.Series:
    if cells.str.contains(r"(Z|[+-]\d\d:?\d\d)$").any():
        zoned = cells.str.replace(" ", "T", literal=True).str.to_datetime(
            "%+", strict=False, time_unit="us", time_zone="UTC"
        )
        parsed = [zoned]
    else:
        parsed = [cells.str.to_datetime(x, strict=False, time_unit="us") for x in _FORMATS]
    best = min(parsed, key=lambda times: times.null_count())
    if best.null_count():
        at = int(best.is_null().arg_true()[0])
        raise MeasuredDataError(
            f"{place(path, at + start)}: TimeStamp is {str(cells[at])[:40]!r}; write it as "
            "2024-03-05 07:00:00.1"
        )
    return best
