"""Writer of measured data: makes the directory that `read_measured` reads."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Sequence, Set
from pathlib import Path

import numpy as np
import polars as pl

from ugat_marl.data.measured.passages import passages_as_written
from ugat_marl.data.measured.tables import (
    COUNTS,
    DETECTIONS,
    DETECTORS,
    LANES,
    PERIODS,
    SIGNALS,
    TABLES,
    TRAJECTORIES,
    TRAVEL_TIMES,
    TURNING,
    Table,
    frame_of,
)
from ugat_marl.data.measured.values import MeasuredData
from ugat_marl.data.row_hashes import (
    CSV_HASHES,
    UNREADABLE,
    is_csv_as_written,
    is_parquet_as_written,
    write_csv_hashes,
    write_hashed,
)
from ugat_marl.errors import OutputError
from ugat_marl.files import make_folder, put_folder
from ugat_marl.scenarios import Passages, Period


def write_measured(measured: MeasuredData, directory: Path, *, csv: bool = False) -> Path:
    """Write measured data. The directory appears whole or not at all.

    Passages are written in the form of `passages_as_written`: times in milliseconds, within their
    period, one vehicle at a time.

    Args:
        measured: The data; their findings are not written.
        directory: A new or empty directory, or one that holds what this function wrote, which is
            replaced. A link stays, and what it names is replaced.
        csv: True to write CSV where Parquet is the default.

    Returns:
        `directory`.

    Raises:
        OutputError: The directory holds anything else, or cannot be written.
    """
    require_replaceable(directory)
    suffix = ".csv" if csv else ".parquet"
    place = Path(os.path.realpath(directory))  # a link goes on to point at the data
    try:
        make_folder(place.parent)
        temporary = place.with_name(f".{place.name}.{secrets.token_hex(8)}")
        temporary.mkdir()
    except OSError as error:
        raise OutputError(
            f"{directory}: cannot be written ({error.strerror}); give another place"
        ) from None
    try:
        _write(_detectors(measured), temporary / "detectors.csv")
        _write(_periods(measured.periods), temporary / "periods.csv")
        if any(period.signals for period in measured.periods):
            _write(_signals(measured.periods), temporary / f"signals{suffix}")
        if measured.has_events or measured.counts is None:
            _write(_detections(measured.periods), temporary / f"detections{suffix}")
        if measured.lanes is not None:
            _write(_ordered(measured.lanes, LANES), temporary / f"lanes{suffix}")
        if measured.trajectories is not None:
            table = _ordered(measured.trajectories, TRAJECTORIES)
            _write(table, temporary / f"trajectories{suffix}")
        if measured.counts is not None:
            _write(_ordered(measured.counts, COUNTS), temporary / "counts.csv")
        if measured.turning is not None:
            _write(_ordered(measured.turning, TURNING), temporary / "turning.csv")
        if measured.travel_times is not None:
            _write(_ordered(measured.travel_times, TRAVEL_TIMES), temporary / "travel_times.csv")
        write_csv_hashes(temporary, sorted(path.name for path in temporary.glob("*.csv")))
        before = temporary.with_name(f"{temporary.name}.before")
        put_folder(temporary, place, before)
        shutil.rmtree(before, ignore_errors=True)
    except OSError as error:
        raise OutputError(
            f"{directory}: cannot be written ({error.strerror}); give another place"
        ) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return directory


def require_replaceable(directory: Path) -> None:
    """Refuse a directory that `write_measured` would not replace. Call this before measuring.

    Data that somebody else has measured, or changed, may be the only copy.

    Raises:
        OutputError: The directory holds anything but what `write_measured` wrote, or is a file.
    """
    if directory.name in ("", ".."):
        raise OutputError(f"{directory}: is a folder in use; give the name of a new one")
    if not directory.exists():
        return
    if not directory.is_dir():
        raise OutputError(f"{directory}: is a file; give the name of a directory")
    known = {name for table in TABLES for name in table.names()} | {CSV_HASHES}
    try:
        there = {path.name for path in directory.iterdir()}
    except OSError as error:
        raise OutputError(
            f"{directory}: cannot be read ({error.strerror}); give another place"
        ) from None
    if foreign := sorted(there - known):
        raise OutputError(
            f"{directory}: holds {foreign[0]!r}, which is not measured data; give another "
            "directory, or empty this one"
        )
    if there and "periods.csv" not in there:
        raise OutputError(
            f"{directory}: is not empty and has no periods.csv, so it is not measured data to "
            "replace; give another directory"
        )
    if (changed := _changed_table(directory, there)) is not None:
        raise OutputError(
            f"{directory}: {changed} was not written by record or import-atspm, or has changed "
            "since, and would be lost; give another directory, or move it away"
        )


def _changed_table(directory: Path, names: Set[str]) -> str | None:
    """Return the name of a table that is not as `write_measured` wrote it."""
    for name in sorted(names - {CSV_HASHES}):
        is_as_written = is_csv_as_written if name.endswith(".csv") else is_parquet_as_written
        try:
            whole = is_as_written(directory / name)
        except UNREADABLE:
            whole = False
        if not whole:
            return name
    return None


def _write(frame: pl.DataFrame, path: Path) -> None:
    if path.suffix == ".csv":
        frame.write_csv(path)
    else:
        write_hashed(frame, path)


def _detectors(measured: MeasuredData) -> pl.DataFrame:
    rows = [
        (d.id, " ".join(d.lanes), d.position_m, d.length_m, d.kind, d.speed_at, d.clock)
        for d in measured.detectors
    ]
    frame = frame_of(DETECTORS, rows)
    return frame.drop(name for name in DETECTORS.optional if not frame[name].count())


def _periods(periods: Sequence[Period]) -> pl.DataFrame:
    rows = [(p.id, p.begin_s, p.end_s, p.split) for p in periods]
    return frame_of(PERIODS, rows).drop("zero", "time_zone")  # all times are written in seconds


def _signals(periods: Sequence[Period]) -> pl.DataFrame:
    rows = [
        (period.id, round(float(since), 3), tls, state)
        for period in periods
        for tls, log in period.signals.items()
        for since, state in log
    ]
    return frame_of(SIGNALS, rows)


def _detections(periods: Sequence[Period]) -> pl.DataFrame:
    parts = [frame_of(DETECTIONS, [])]
    for period in periods:
        streams = [
            _events(period, name, passages)
            for name, passages in period.passages.items()
            if len(passages)
        ]
        if streams:
            # A stable sort keeps the off of one vehicle before the on of the next.
            parts.append(pl.concat(streams).sort("time_s", maintain_order=True))
    return pl.concat(parts)


def _events(period: Period, detector: str, passages: Passages) -> pl.DataFrame:
    passages = passages_as_written(passages, period.begin_s, period.end_s)
    time = np.stack([passages.on_s, passages.off_s], 1).reshape(-1)
    is_on = np.tile([True, False], len(passages))
    inside = np.isfinite(time)
    nothing = np.full(len(passages), np.nan)
    # Speed and length belong to the off event; without one they are written with the on event.
    with_off = inside[1::2]
    values = [
        np.stack(
            [np.where(with_off, nothing, column), np.where(with_off, column, nothing)], 1
        ).reshape(-1)
        for column in (passages.speed_mps, passages.length_m)
    ]
    frame = pl.DataFrame(
        {
            "time_s": time,
            "event": np.where(is_on, "on", "off"),
            "speed_mps": values[0],
            "length_m": values[1],
        }
    ).filter(pl.Series(inside))
    return frame.select(
        pl.lit(period.id).alias("period_id"),
        "time_s",
        pl.lit(detector).alias("detector_id"),
        "event",
        pl.col("speed_mps", "length_m").fill_nan(None),
    )


def _ordered(frame: pl.DataFrame, table: Table) -> pl.DataFrame:
    """Return the frame with the columns of the table; NaN becomes an empty cell."""
    columns = [name for name in (*table.columns, *table.optional) if name in frame.columns]
    kinds = {**table.columns, **table.optional}
    return frame.select(
        pl.col(name).cast(pl.Float64).fill_nan(None) if kinds[name] == "number" else pl.col(name)
        for name in columns
    )
