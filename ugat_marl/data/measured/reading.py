"""Reads a directory of measured data, checked against the network they were measured on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl

from ugat_marl.data.measured import tables
from ugat_marl.data.measured.checks import detectors_of, periods_of
from ugat_marl.data.measured.coverage import coverage
from ugat_marl.data.measured.data import Finding, Measured
from ugat_marl.data.measured.detections import passages_of
from ugat_marl.data.measured.rows import with_period
from ugat_marl.data.measured.signal_logs import signals_of
from ugat_marl.data.measured.tables import Table, read_table, refuse
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import (
    Detector,
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    signal_widths,
)


def read_measured(directory: Path, scenario: Scenario, network: Network) -> Measured:
    """Reads measured data; the files are never written to.

    Args:
        directory: Holds the files described in ``docs/reference/measured-data.md``.
        scenario: The scenario whose clock and demand the data are compared with.
        network: Its network.

    Returns:
        The data, with findings on what they lack and what was left out.

    Raises:
        MeasuredDataError: A file is missing, cannot be read, contradicts itself, or does not fit
            the network or the scenario.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise MeasuredDataError(
            f"{directory}: no such directory; measured data are a directory with periods.csv, "
            "detectors.csv, signals and detections (docs/reference/measured-data.md)"
        )
    found: list[Finding] = []
    paths = {table.stem: table.path(directory) for table in tables.TABLES}
    for table in (tables.PERIODS, tables.DETECTORS):
        if paths[table.stem] is None:
            raise _missing(directory, table)
    counts_only = paths["detections"] is None and paths["counts"] is not None
    if paths["detections"] is None and not counts_only:
        raise _missing(directory, tables.DETECTIONS)
    if paths["signals"] is None and not counts_only:
        raise _missing(directory, tables.SIGNALS)

    def rows(table: Table) -> tuple[Path, pl.DataFrame]:
        path = paths[table.stem]
        assert path is not None
        return path, read_table(path, table, found)

    periods = periods_of(*rows(tables.PERIODS), scenario)
    detectors = detectors_of(*rows(tables.DETECTORS), network)
    signals: tuple[dict[str, SignalLog], ...] = tuple({} for _ in periods)
    if paths["signals"] is not None:
        signals = _signals(*rows(tables.SIGNALS), periods, scenario, network, found)
    passages: tuple[dict[str, Passages], ...] = tuple({} for _ in periods)
    if paths["detections"] is not None:
        path, frame = rows(tables.DETECTIONS)
        if frame.is_empty():
            raise MeasuredDataError(f"{path}: no detections; write one row per on and off")
        frame = with_period(path, frame, periods, found)
        passages, broken = passages_of(path, frame, periods, detectors, found)
        _refuse_empty(
            path, "detections", [p.id for p, x in zip(periods, passages, strict=True) if not x]
        )
        detectors = tuple(detector for detector in detectors if detector.id not in broken)
    periods = tuple(
        replace(period, signals=shown, passages=seen)
        for period, shown, seen in zip(periods, signals, passages, strict=True)
    )

    def extra(table: Table) -> pl.DataFrame | None:
        return None if paths[table.stem] is None else _extra(*rows(table), table, periods, found)

    measured = Measured(
        detectors,
        periods,
        extra(tables.LANES),
        extra(tables.TRAJECTORIES),
        None
        if paths["counts"] is None
        else _counts(*rows(tables.COUNTS), periods, detectors, counts_only),
    )
    found += coverage(measured, scenario, network)
    return replace(measured, findings=tuple(found))


def _missing(directory: Path, table: Table) -> MeasuredDataError:
    there = ", ".join(sorted(path.name for path in directory.iterdir())[:8]) or "nothing"
    return MeasuredDataError(
        f"{directory}: no {' or '.join(table.names())}; there is {there}. "
        "docs/reference/measured-data.md describes the files"
    )


def _signals(
    path: Path,
    frame: pl.DataFrame,
    periods: tuple[Period, ...],
    scenario: Scenario,
    network: Network,
    found: list[Finding],
) -> tuple[dict[str, SignalLog], ...]:
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no signals; write the state at every change")
    frame = with_period(path, frame, periods, found, early=True)
    logs = signals_of(path, frame, periods, signal_widths(scenario), found)
    controlled = [intersection.id for intersection in network.intersections]
    for period, shown in zip(periods, logs, strict=True):
        if not any(tls in shown for tls in controlled):
            raise MeasuredDataError(
                f"{path}: no signals of any intersection in period {period.id!r}; add them, or "
                "leave the period out"
            )
    return logs


def _extra(
    path: Path,
    frame: pl.DataFrame,
    table: Table,
    periods: tuple[Period, ...],
    found: list[Finding],
) -> pl.DataFrame:
    frame = with_period(path, frame, periods, found)
    for column in ("vehicles", "halting", "mean_speed_mps", "speed_mps", "position_m"):
        if column in frame.columns:
            refuse(
                path, frame.filter(pl.col(column) < 0), column, "is negative", "correct the rows"
            )
    return frame.select(*table.columns, *table.optional)


def _counts(
    path: Path,
    frame: pl.DataFrame,
    periods: tuple[Period, ...],
    detectors: tuple[Detector, ...],
    alone: bool,
) -> pl.DataFrame:
    """Counts per detector and interval, all of known detectors and within their periods."""
    names = [detector.id for detector in detectors]
    refuse(
        path,
        frame.filter(~pl.col("detector_id").is_in(names)),
        "detector_id",
        "is not listed in detectors.csv",
        "add it there, or leave the rows out",
    )
    for column, values in (
        ("begin_s", {period.id: period.begin_s for period in periods}),
        ("end_s", {period.id: period.end_s for period in periods}),
    ):
        limit = pl.col("period_id").replace_strict(values, default=None, return_dtype=pl.Float64)
        frame = frame.with_columns(limit.alias(f"period_{column}"))
    refuse(
        path,
        frame.filter(pl.col("period_begin_s").is_null()),
        "period_id",
        "is not listed in periods.csv",
        "add it there, or leave the rows out",
    )
    for bad, column, complaint in (
        (pl.col("begin_s") < pl.col("period_begin_s"), "begin_s", "is before the period's begin"),
        (pl.col("end_s") > pl.col("period_end_s"), "end_s", "is after the period's end"),
        (pl.col("end_s") <= pl.col("begin_s"), "end_s", "is not after begin_s"),
        (pl.col("count") < 0, "count", "is negative"),
        (pl.col("count") % 1 != 0, "count", "is not a whole number"),
        (
            pl.struct("period_id", "begin_s", "detector_id").is_duplicated(),
            "begin_s",
            "is there twice for its detector",
        ),
    ):
        refuse(path, frame.filter(bad), column, complaint, "correct the row")
    if alone:
        counted = set(frame["period_id"])
        _refuse_empty(path, "counts", [period.id for period in periods if period.id not in counted])
    return frame.select(*tables.COUNTS.columns)


def _refuse_empty(path: Path, what: str, periods: list[str]) -> None:
    """A period of which a file holds nothing is no period without vehicles."""
    if periods:
        raise MeasuredDataError(
            f"{path}: no {what} in period {', '.join(map(repr, periods[:6]))}; was the file cut "
            "short? Add them, or leave the period out of periods.csv"
        )
