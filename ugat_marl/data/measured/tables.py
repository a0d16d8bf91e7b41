"""Tables of measured data: their files and columns, checked while they are read."""

from __future__ import annotations

import contextlib
import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.local_time import LocalClock
from ugat_marl.data.measured.values import Finding, first_row, place
from ugat_marl.data.row_hashes import (
    UNREADABLE,
    csv_damage,
    csv_texts,
    damage,
    half_parquet,
    read_quietly,
)
from ugat_marl.errors import MeasuredDataError, counted, first_line, nearest
from ugat_marl.files import refuse_endless
from ugat_marl.scenarios import Period

ROW = "row"
"""Column added to every table: the line of a CSV file, or the row of a Parquet file, from 1."""

Kind = Literal["text", "number"]

CLOCK_JUMP_S = 60.0
"""A larger step back in time means a clock set back; a smaller one means a late delivery."""
MOST_PACKETS = 100
"""With more steps back, rows are out of order, and no clock was set back."""
FEW_ROWS = 10
"""With fewer rows, a clock set back looks the same as rows out of order."""
MOST_OUTSIDE = 0.5
"""Largest share of a period's rows that may lie outside of the period."""
HOUR_S, DAY_S = 3600.0, 86400.0
"""Step of a clock at the begin and end of daylight saving, and what a wrong date shifts, in s."""
QUARTER_S, MOST_HOURS = 900.0, 14
"""Difference from whole hours or days, in s, at which a log seems shifted, and most hours."""
EPOCH = 1e8
"""Times above this are dates, not seconds of a scenario."""

TIMES = ("time_s", "begin_s", "end_s")
"""Columns whose times may be local: without ``_s`` in the name they hold dates."""

PERIOD = "period"
"""Column with the index of the row's period."""


@dataclass(frozen=True)
class Table:
    """A file of the format.

    Attributes:
        stem: File name without suffix.
        columns: Required column to its kind.
        optional: Optional column to its kind; these columns may have empty cells.
        suffixes: Allowed file types, the default first.
    """

    stem: str
    columns: Mapping[str, Kind]
    optional: Mapping[str, Kind]
    suffixes: tuple[str, ...] = (".parquet", ".csv")

    def path(self, directory: Path) -> Path | None:
        """Return the file in a directory, or None.

        Raises:
            MeasuredDataError: The directory has the file in two types.
        """
        paths = (directory / name for name in self.names())
        existing = [path for path in paths if path.exists()]
        if len(existing) > 1:
            raise MeasuredDataError(
                f"{directory}: both {existing[0].name} and {existing[1].name} are there; remove one"
            )
        return existing[0] if existing else None

    def names(self) -> tuple[str, ...]:
        """Return the names the file may have."""
        return tuple(self.stem + suffix for suffix in self.suffixes)


PERIODS = Table(
    "periods",
    {"period_id": "text", "begin_s": "number", "end_s": "number"},
    {"split": "text", "zero": "text", "time_zone": "text"},
    (".csv",),
)
DETECTORS = Table(
    "detectors",
    {
        "detector_id": "text",
        "lane_id": "text",
        "position_m": "number",
        "length_m": "number",
        "kind": "text",
    },
    {"speed_at": "text", "clock": "text"},
    (".csv",),
)
SIGNALS = Table(
    "signals", {"period_id": "text", "time_s": "number", "tls_id": "text", "state": "text"}, {}
)
DETECTIONS = Table(
    "detections",
    {"period_id": "text", "time_s": "number", "detector_id": "text", "event": "text"},
    {"speed_mps": "number", "length_m": "number"},
)
LANES = Table(
    "lanes",
    {
        "period_id": "text",
        "time_s": "number",
        "lane_id": "text",
        "vehicles": "number",
        "halting": "number",
    },
    {"mean_speed_mps": "number"},
)
TRAJECTORIES = Table(
    "trajectories",
    {
        "period_id": "text",
        "vehicle_id": "text",
        "time_s": "number",
        "lane_id": "text",
        "position_m": "number",
        "speed_mps": "number",
    },
    {"length_m": "number"},
)
COUNTS = Table(
    "counts",
    {
        "period_id": "text",
        "begin_s": "number",
        "end_s": "number",
        "detector_id": "text",
        "count": "number",
    },
    {"occupancy": "number", "mean_speed_mps": "number"},
    (".csv",),
)
TURNING = Table(
    "turning",
    {
        "period_id": "text",
        "begin_s": "number",
        "end_s": "number",
        "from_edge": "text",
        "to_edge": "text",
        "count": "number",
    },
    {},
    (".csv",),
)
TRAVEL_TIMES = Table(
    "travel_times",
    {
        "period_id": "text",
        "time_s": "number",
        "from_edge": "text",
        "from_m": "number",
        "to_edge": "text",
        "to_m": "number",
        "travel_s": "number",
    },
    {},
    (".csv",),
)
TABLES = (
    PERIODS, DETECTORS, SIGNALS, DETECTIONS, LANES, TRAJECTORIES, COUNTS, TURNING, TRAVEL_TIMES,
)  # fmt: skip


def read_table(
    path: Path, table: Table, findings: list[Finding], clock: LocalClock | None = None
) -> pl.DataFrame:
    """Read the columns of `table` from a file, numbers as Float64, and add `ROW`.

    Args:
        path: The file.
        table: Expected columns.
        findings: Findings; unknown columns are added to them.
        clock: Clock for columns of local times: ``time`` in place of ``time_s``, ``begin`` and
            ``end`` in place of ``begin_s`` and ``end_s``. None if periods.csv has no ``zero``.

    Returns:
        One row per row of the file, in its order. Missing optional columns are null. Columns of
        ``begin`` and ``end`` stay beside the seconds, so that messages can quote the file.

    Raises:
        MeasuredDataError: The file is unreadable or cut short. Or a column is missing, has text
            instead of numbers, or is required and has empty cells.
    """
    raw = read_raw(path, findings)
    wanted = {**table.columns, **table.optional}
    _check_columns(path, table, raw, findings, clock)
    local = [
        own
        for name, own in _local_names(table).items()
        if name not in raw.columns and own in raw.columns
    ]
    raw = _in_seconds(path, raw, local, clock)
    start = first_row(path)
    columns = [pl.int_range(start, raw.height + start, dtype=pl.Int64, eager=True).alias(ROW)]
    for name, kind in wanted.items():
        if name not in raw.columns:
            dtype = pl.Float64 if kind == "number" else pl.String
            columns.append(pl.Series(name, [None] * raw.height, dtype))
            continue
        cells = raw[name]
        values = to_numbers(path, cells) if kind == "number" else to_texts(path, cells)
        if name in table.columns and values.null_count():
            where = place(path, int(values.is_null().arg_true()[0]) + start)
            raise MeasuredDataError(
                f"{where}: {name} is empty, in {values.null_count()} of {values.len()} rows; "
                "fill it in or leave the rows out (an empty last row means a file cut short)"
            )
        columns.append(values)
    columns += [raw[name] for name in local if name != "time"]  # of events there are millions
    return pl.DataFrame(columns)


def _local_names(table: Table) -> dict[str, str]:
    """Return columns of seconds, each with the column of local times that may replace it."""
    if table.stem == "periods":
        return {}
    return {name: name.removesuffix("_s") for name in table.columns if name in TIMES}


def _in_seconds(
    path: Path, raw: pl.DataFrame, local: Sequence[str], clock: LocalClock | None
) -> pl.DataFrame:
    """Add seconds of the scenario's clock to the columns of local times."""
    if not local:
        return raw
    if clock is None:
        raise MeasuredDataError(
            f"{path}: {local[0]} holds local times, and periods.csv does not say when the "
            "scenario's clock is 0; add the column zero there, such as 2024-03-05T07:00:00"
        )
    start = first_row(path)
    periods = to_texts(path, raw["period_id"])
    seconds = [clock.seconds(path, raw[name], periods, start) for name in local]
    return raw.with_columns(seconds)


def read_raw(path: Path, findings: list[Finding]) -> pl.DataFrame:
    """Read all columns of a CSV or Parquet file; columns of a CSV file are text.

    Raises:
        MeasuredDataError: The file is unreadable, damaged or cut short.
    """
    parquet = path.suffix.lower() == ".parquet"
    return _read_parquet(path) if parquet else _read_csv(path, findings)


def frame_of(table: Table, rows: Sequence[tuple[object, ...]]) -> pl.DataFrame:
    """Return rows as a frame with the columns of a table; the last ones may be missing."""
    kinds = {**table.columns, **table.optional}
    if rows and len(rows[0]) < len(kinds):
        rows = [(*row, *[None] * (len(kinds) - len(row))) for row in rows]
    schema = {
        name: pl.Float64() if kind == "number" else pl.String() for name, kind in kinds.items()
    }
    return pl.DataFrame(rows, schema=schema, orient="row")


def as_written(frame: pl.DataFrame, column: str) -> str:
    """Return the name under which a frame has a column of its file: that of local times, if any."""
    own = column.removesuffix("_s")
    return own if column in TIMES and own in frame.columns else column


def refuse(path: Path, bad: pl.DataFrame, column: str, complaint: str, way_out: str) -> None:
    """Raise an error for the first of the bad rows, if there are any.

    Local times are quoted as in the file.

    Raises:
        MeasuredDataError: `bad` has rows.
    """
    if bad.is_empty():
        return
    column = as_written(bad, column)
    value = str(bad[column][0])
    shown = value if len(value) <= 60 else f"{value[:57]}..."
    rows = "row" if bad.height == 2 else "rows"
    more = f" (and {bad.height - 1} {rows} more)" if bad.height > 1 else ""
    raise MeasuredDataError(
        f"{place(path, int(bad[ROW][0]))}: {column} {shown!r} {complaint}{more}; {way_out}"
    )


def _check_columns(
    path: Path,
    table: Table,
    raw: pl.DataFrame,
    findings: list[Finding],
    clock: LocalClock | None,
) -> None:
    given, local = raw.columns, _local_names(table)
    in_place = [own for name, own in local.items() if name not in given]
    wanted = (*table.columns, *table.optional, *in_place)
    unknown = [name for name in given if name not in wanted]
    for name in table.columns:
        if name not in given and local.get(name) not in given:
            own = name if clock is None else local.get(name, name)
            near = nearest(own, unknown)
            guess = f" (is it {near!r}?)" if near else ""
            needed = table.columns if clock is None else [local.get(x, x) for x in table.columns]
            raise MeasuredDataError(
                f"{path}: no column {own!r}{guess}; it has {_listed(given)}, and needs "
                f"{', '.join(needed)}"
            )
    for name, own in local.items():
        if name in given and isinstance(raw[name].dtype, pl.String):
            shown = raw[name].filter(raw[name].str.contains(r"\d:\d\d"))
            if len(shown):
                raise MeasuredDataError(
                    f"{path}: {name} holds local times, such as {shown[0][:40]!r}; name the column "
                    f"{own}"
                )
    for name in unknown:
        missing = [column for column in table.optional if column not in given]
        near = nearest(name, missing)
        guess = f"; if it means {near!r}, rename it" if near else ""
        findings.append(Finding(f"{path.name}: column {name!r} is not read{guess}"))


def _listed(names: list[str]) -> str:
    shown = ", ".join(name.split("\n")[0][:30] for name in names[:12])
    return shown + (" ..." if len(names) > 12 else "")


def _read_parquet(path: Path) -> pl.DataFrame:
    content = _bytes(path)
    if wrong := half_parquet(io.BytesIO(content)):
        raise MeasuredDataError(f"{path}: {wrong}; copy or export it again")
    try:
        frame, metadata = read_quietly(io.BytesIO(content), nested=False)
    except (*UNREADABLE, ValueError) as error:
        raise MeasuredDataError(
            f"{path}: damaged Parquet file ({first_line(error)}); copy or export it again"
        ) from None
    if wrong := damage(frame, metadata):  # tables of others carry no hashes
        raise MeasuredDataError(f"{path}: damaged, {wrong}; copy or export it again")
    return frame


def _read_csv(path: Path, findings: list[Finding]) -> pl.DataFrame:
    content = _bytes(path).removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")  # line ends of an old Mac
    if b"\0" in content:
        line = content[: content.index(b"\0")].count(b"\n") + 1
        raise MeasuredDataError(
            f"{path}, line {line}: a NUL byte; the file is damaged or not CSV in UTF-8, "
            "export it again"
        )
    try:
        head, row = [*content.decode("utf-8").split("\n", 2), ""][:2]
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise MeasuredDataError(
            f"{path}, line {line}: not UTF-8 ({error.reason}); save the file as UTF-8"
        ) from None
    if not content.strip():
        raise MeasuredDataError(f"{path}: the file is empty; it needs a header and rows")
    if head.startswith("sep="):
        raise MeasuredDataError(
            f"{path}: line 1 is {head.strip()!r}, which is for Excel alone; remove it"
        )
    mark = next((one for one in (";", "\t") if one in head and "," not in head), ",")
    if other := _other_mark(head, row, mark):
        raise MeasuredDataError(
            f"{path}, line 2: its cells are separated by {other!r}, and the names in line 1 by "
            f"{mark!r}; separate all by one of them"
        )
    if not content.endswith((b"\n", b"\r")):
        findings.append(
            Finding(f"{path.name}: the last line has no end; the file may have been cut short")
        )
    try:
        frame = csv_texts(content, mark)
        if mark != ",":  # a spreadsheet of a country with decimal commas
            frame = frame.with_columns(pl.col(pl.String).str.replace(_DECIMAL_COMMA, "$1.$2$3"))
        # polars gives the second of two equal names another one
        written = [name.strip() for name in next(csv.reader([head], delimiter=mark), [])]
    except (*UNREADABLE, ValueError, csv.Error) as error:
        raise MeasuredDataError(
            _wide_line(path, content, mark)
            or f"{path}: not a table ({first_line(error)}); every line needs the columns of line 1"
        ) from None
    if wrong := csv_damage(path, frame):  # tables of others carry no hashes
        raise MeasuredDataError(f"{path}: damaged, {wrong}")
    if twice := sorted({name for name in written if written.count(name) > 1}):
        raise MeasuredDataError(f"{path}: column {twice[0]!r} is there twice; keep one of them")
    return frame.rename({name: name.strip() for name in frame.columns})


_DECIMAL_COMMA = r"^([-\d :T]*\d),(\d+)(Z|[+-]\d\d(?::?\d\d)?)?\s*$"
"""A number or a local time with a comma before its decimals."""


def _other_mark(head: str, row: str, mark: str) -> str | None:
    """Return what separates as many cells of a row as line 1 has, if `mark` does not."""
    with contextlib.suppress(csv.Error):
        named = len(next(csv.reader([head], delimiter=mark)))
        cells = {one: len(next(csv.reader([row], delimiter=one), [])) for one in ",;\t"}
        if named > 1 and cells[mark] != named:
            return next((one for one, count in cells.items() if count == named), None)
    return None


def _wide_line(path: Path, content: bytes, mark: str) -> str | None:
    """Describe the first line that has more cells than line 1; None without one."""
    rows = csv.reader(io.StringIO(content.decode()), delimiter=mark)
    with contextlib.suppress(csv.Error, StopIteration):
        named = len(next(rows))
        for row in rows:
            if len(row) > named:
                return (
                    f"{path}, line {rows.line_num}: {len(row)} cells, but line 1 names "
                    f"{counted(named, 'column')}; every line needs the columns of line 1, numbers "
                    "with a point and no decimal comma, and quotes around a text with a comma"
                )
    return None


def _bytes(path: Path) -> bytes:
    refuse_endless(path, MeasuredDataError)
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeasuredDataError(
            f"{path}: cannot be read ({error.strerror}); check its path and its rights"
        ) from None


def to_numbers(path: Path, cells: pl.Series) -> pl.Series:
    """Return cells as Float64; empty cells and NaN become null.

    Raises:
        MeasuredDataError: A cell is text or infinite, or the column has another type.
    """
    name, start = cells.name, first_row(path)
    if cells.dtype == pl.String:
        cells = cells.str.strip_chars()
        cells = cells.set(cells == "", None)
    elif not (cells.dtype.is_numeric() or cells.dtype == pl.Null):
        meaning = "seconds of the scenario's clock" if name.endswith("_s") else "numbers"
        raise MeasuredDataError(
            f"{path}: column {name!r} has the type {cells.dtype}; it holds {meaning}"
        )
    numbers = cells.cast(pl.Float64, strict=False)
    wrong = (numbers.is_null() & cells.is_not_null()) | numbers.is_infinite().fill_null(False)
    if wrong.any():
        at = int(wrong.arg_true()[0])
        text = str(cells[at])
        wanted = "a number with a point, not a comma" if "," in text else "a number"
        clock = re.fullmatch(r"(\d{1,2}):(\d\d)(?::(\d\d))?", text, re.ASCII)
        if clock and name in TIMES:
            hours, minutes, seconds = (int(part or 0) for part in clock.groups())
            since_s = 3600 * hours + 60 * minutes + seconds
            wanted = f"seconds of the scenario's clock, {since_s} if that is 0 at midnight"
        raise MeasuredDataError(
            f"{place(path, at + start)}: {name} is {text[:40]!r}; write {wanted}, or "
            "leave the row out"
        )
    return numbers.fill_nan(None)


def to_texts(path: Path, cells: pl.Series) -> pl.Series:
    """Return cells as text; empty cells become null.

    Raises:
        MeasuredDataError: The column holds no names.
    """
    dtype = cells.dtype
    known = isinstance(dtype, pl.String | pl.Categorical | pl.Enum | pl.Null)
    if not (known or dtype.is_integer()):
        raise MeasuredDataError(
            f"{path}: column {cells.name!r} has the type {dtype}; it holds names (text)"
        )
    try:
        texts = cells.cast(pl.String).str.strip_chars()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise MeasuredDataError(
            f"{path}: column {cells.name!r} is damaged ({first_line(error)}); export it again"
        ) from None
    return texts.set(texts == "", None)


def with_period(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    findings: list[Finding],
    *,
    early: bool = False,
) -> pl.DataFrame:
    """Return the rows within their periods, times rounded to 1 ms, with the column `PERIOD`.

    Args:
        path: File of the rows.
        frame: Rows with ``period_id`` and ``time_s``.
        periods: The periods.
        findings: Findings; rows that are left out are added to them.
        early: True to keep rows before the start of a period.

    Raises:
        MeasuredDataError: No row belongs to a known period, most rows of a period lie outside of
            it, or the clock of a detector or traffic light was set back.
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
        findings.append(
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
    _refuse_clocks(path, frame, periods, time)  # before the copy of an hour is left out
    inside = time <= ends[which]
    if not early:
        inside &= time >= begins[which]
    if not inside.all():
        report_outside(path, periods, which, time, inside, findings)
    frame = frame.with_columns(pl.Series("time_s", time))
    return frame.filter(pl.Series(inside))


def _refuse_clocks(
    path: Path, frame: pl.DataFrame, periods: Sequence[Period], time: NDArray[np.float64]
) -> None:
    """Refuse rows of a detector or traffic light whose clock was set back."""
    owners = {"detector_id": "detector", "tls_id": "traffic light"}
    column = next((name for name in owners if name in frame.columns), None)
    if column is None or frame.is_empty():
        return
    frame = frame.with_columns(pl.Series("time_s", time))
    if "event" in frame.columns:  # rows that are there twice count once
        values = [name for name in frame.columns if name != ROW]
        frame = frame.unique(values, keep="first", maintain_order=True)
    names = frame[column].unique(maintain_order=True).to_list()
    index = {name: i for i, name in enumerate(names)}
    code = frame[column].replace_strict(index, return_dtype=pl.Int64).to_numpy()
    key = (frame[PERIOD].to_numpy().astype(np.int64) * len(names) + code) * 2
    if "event" in frame.columns:  # ons and offs may have been exported separately
        key += (frame["event"] == "on").to_numpy()

    def name(stream: int) -> str:
        period, number = divmod(stream // 2, len(names))
        return f"{owners[column]} {names[number]!r} in period {periods[period].id!r}"

    begins = np.array([period.begin_s for period in periods])[frame[PERIOD].to_numpy()]
    time, row = frame["time_s"].to_numpy(), frame[ROW].to_numpy()
    refuse_set_back(path, key, time, row, name, begins)


def report_outside(
    path: Path,
    periods: Sequence[Period],
    which: NDArray[np.int32],
    time: NDArray[np.float64],
    inside: NDArray[np.bool_],
    findings: list[Finding],
    end_s: NDArray[np.float64] | None = None,
) -> None:
    """Add a finding on rows outside of their periods.

    Args:
        path: File of the rows.
        periods: The periods.
        which: Index of the period of each row, ``(n,)``.
        time: Time of each row, s, ``(n,)``.
        inside: True for rows within their period, ``(n,)``.
        findings: Findings.
        end_s: End of each row, s, ``(n,)``, where rows are intervals.

    Raises:
        MeasuredDataError: Most rows of a period lie outside of it, and the others do not reach from
            its begin to its end, as those of a longer log do.
    """
    total = np.bincount(which, minlength=len(periods))
    outside = np.bincount(which[~inside], minlength=len(periods))
    for period, rows, lost in zip(periods, total, outside, strict=True):
        own = which == periods.index(period)
        last = time if end_s is None else end_s
        kept = own & inside
        if lost > MOST_OUTSIDE * rows and not _reaches_through(time[kept], last[kept], period):
            example = time[own & ~inside][0]
            if abs(example) > EPOCH:
                hint = "these are dates; subtract the moment at which the scenario's clock is 0"
            elif 0 < abs(hours := _off(time[own], period, HOUR_S)) <= MOST_HOURS:
                hint = (
                    f"the log seems to be {counted(abs(hours), 'hour')} "
                    f"{'early' if hours < 0 else 'late'}: is it in another time zone, such as UTC, "
                    "or was daylight saving forgotten?"
                )
            elif days := _off(time[own], period, DAY_S):
                hint = (
                    f"the log seems to be {counted(abs(days), 'day')} "
                    f"{'early' if days < 0 else 'late'}: is the date of the period's zero right?"
                )
            else:
                hint = (
                    "write times in seconds of the scenario's clock, or local times with the "
                    "period's own zero; or is the period too short?"
                )
            raise MeasuredDataError(
                f"{path}: {lost} of {rows} rows of period {period.id!r} lie outside of it "
                f"({period.begin_s:g} s to {period.end_s:g} s), the first at {example:g} s; {hint}"
            )
    lost = int(outside.sum())
    names = ", ".join(repr(p.id) for p, n in zip(periods, outside, strict=True) if n)
    findings.append(
        Finding(f"{path.name}: {lost} of {len(time)} rows lie outside of their periods ({names})")
    )


def _reaches_through(
    begin_s: NDArray[np.float64], end_s: NDArray[np.float64], period: Period
) -> bool:
    """Return True if rows reach from the first to the last tenth of a period."""
    margin = 0.1 * period.length_s
    return bool(
        len(begin_s)
        and begin_s.min() <= period.begin_s + margin
        and end_s.max() >= period.end_s - margin
    )


def _off(time_s: NDArray[np.float64], period: Period, unit_s: float) -> int:
    """Return by how many whole units a log as long as its period is late; 0 for none."""
    off_s = (time_s.min() + time_s.max() - period.begin_s - period.end_s) / 2
    units = round(off_s / unit_s)
    return units if abs(off_s - units * unit_s) <= QUARTER_S else 0


def in_order(
    path: Path,
    key: NDArray[np.int64],
    time: NDArray[np.float64],
    findings: list[Finding],
) -> NDArray[np.int64]:
    """Return row indices sorted by stream and time; equal rows keep their order.

    Args:
        path: File of the rows.
        key: Number of the stream of each row, ``(n,)``.
        time: Time of each row, s, ``(n,)``.
        findings: Findings; one is added if the rows were not sorted.
    """
    as_found = np.argsort(key, kind="stable")
    back = len(_steps_back(key[as_found], time[as_found]))
    if not back:
        return as_found
    findings.append(
        Finding(f"{path.name}: {back} rows are earlier than the row before them; they were sorted")
    )
    return np.lexsort((time, key))


def refuse_set_back(
    path: Path,
    key: NDArray[np.int64],
    time: NDArray[np.float64],
    row: NDArray[np.int64],
    name: Callable[[int], str],
    begin_s: NDArray[np.float64] | None = None,
) -> None:
    """Refuse streams whose clock was set back.

    Three other cases are accepted. Rows out of order step back many times. Rows that were delivered
    late fill a gap, and the clock is right again behind them. A file with swapped pieces steps
    back, but ends before it began, so no time occurs twice; all of it is within its period.

    Args:
        path: File of the rows.
        key: Number of the stream of each row, ``(n,)``. Rows that were exported separately are
            separate streams.
        time: Time of each row, s, ``(n,)``.
        row: Number of each row in its file, ``(n,)``.
        name: Function that names a stream in messages.
        begin_s: Start of the period of each row, s, ``(n,)``; None if the rows are within theirs.

    Raises:
        MeasuredDataError: The clock of a stream was set back, so some time occurs twice.
    """
    as_found = np.argsort(key, kind="stable")
    stream, clock = key[as_found], time[as_found]
    if not len(_steps_back(stream, clock)):
        return
    starts = np.flatnonzero(np.diff(stream, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(stream)), strict=True):
        least = -np.inf if begin_s is None else float(begin_s[as_found[begin]])
        steps = begin + clock_steps(clock[begin:end], least)
        if not 1 <= len(steps) <= 2 or end - begin < FEW_ROWS:
            continue
        step = int(steps[0])
        jump = clock[step - 1] - clock[step]
        gone = min(clock[step], clock[end - 1]) < least
        if gone or clock[end - 1] > clock[begin]:
            lost = "the rows behind it lie before the period" if gone else "some times occur twice"
            raise MeasuredDataError(
                f"{place(path, int(row[as_found[step]]))}: the clock of {name(int(stream[begin]))} "
                f"steps back by {jump:g} s, so {lost} (daylight saving, a "
                "clock that was set, or a log that was appended twice?); end the period before the "
                "step, correct the times behind it, or leave the copy out"
            )


def clock_steps(clock: NDArray[np.float64], begin_s: float = -np.inf) -> NDArray[np.int64]:
    """Return the indices of rows before which the clock of a stream may have been set back.

    Args:
        clock: Time of each row, s, in the order of the file, ``(n,)``.
        begin_s: Start of the period, s: a row before it is no late one.
    """
    steps = np.flatnonzero(np.diff(clock) < -CLOCK_JUMP_S) + 1  # others are late rows
    following = np.append(clock, np.inf)[steps + 1]
    alone = following >= clock[steps - 1]  # behind a late row the clock is right again
    steps = steps[~alone | (clock[steps] < begin_s)]
    if len(steps) > MOST_PACKETS:
        return steps  # rows out of order
    late = np.array([_are_late(clock, int(step)) for step in steps], bool)
    return steps[~late | (clock[steps] < begin_s)]


def _are_late(clock: NDArray[np.float64], step: int) -> bool:
    """Return True if rows from `step` on were delivered late: all in one gap of the rows before."""
    right = np.append(clock[step:] >= clock[step - 1], True)  # the end of the file counts as right
    own = clock[step : step + int(right.argmax())]
    before = clock[:step]
    return not ((before > own.min()) & (before < own.max())).any() and len(own) < len(before)


def _steps_back(stream: NDArray[np.int64], clock: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices of rows that are earlier than the row before them in their stream."""
    return np.flatnonzero((stream[1:] == stream[:-1]) & (np.diff(clock) < 0)) + 1
