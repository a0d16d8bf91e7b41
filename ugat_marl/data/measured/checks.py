"""Periods and detectors, checked against the scenario and its network."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import polars as pl

from ugat_marl.data.measured.data import split_periods
from ugat_marl.data.measured.tables import ROW, place, refuse
from ugat_marl.errors import MeasuredDataError, nearest
from ugat_marl.scenarios import Detector, DetectorKind, Network, Period, Scenario, Split

TOLERANCE_M = 0.1
"""How far a zone may reach beyond its lane: networks give lengths to the centimetre."""


def periods_of(path: Path, frame: pl.DataFrame, scenario: Scenario) -> tuple[Period, ...]:
    """The periods, still without signals and detections.

    Raises:
        MeasuredDataError: None, one twice, one that ends before it begins or that the scenario's
            demand does not cover, or a split that is not ``fit`` or ``heldout``.
    """
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no periods; write one row per period of measurement")
    refuse(
        path,
        frame.filter(pl.col("period_id").is_duplicated()),
        "period_id",
        "occurs twice",
        "give each period a name of its own",
    )
    refuse(
        path,
        frame.filter(~(pl.col("end_s") > pl.col("begin_s"))),
        "end_s",
        "is not after begin_s",
        "write times in seconds of the scenario's clock",
    )
    _check_times(path, frame, scenario)
    splits = _splits(path, frame)
    return tuple(
        Period(name, begin, end, split, {}, {})
        for name, begin, end, split in zip(
            frame["period_id"].to_list(),
            frame["begin_s"].to_list(),
            frame["end_s"].to_list(),
            splits,
            strict=True,
        )
    )


def _check_times(path: Path, frame: pl.DataFrame, scenario: Scenario) -> None:
    settings = scenario.settings
    first, last = settings.begin_s, settings.begin_s + settings.duration_s
    for column, bad in (
        ("begin_s", pl.col("begin_s") < first),
        ("end_s", pl.col("end_s") > last + 1e-6),
    ):
        refuse(
            path,
            frame.filter(bad),
            column,
            f"lies outside the scenario {scenario.id!r}, which has demand from {first:g} s to "
            f"{last:g} s",
            "shorten the period, or use a scenario whose duration_s covers it",
        )


def _splits(path: Path, frame: pl.DataFrame) -> tuple[Split, ...]:
    refuse(
        path,
        frame.filter(pl.col("split").is_not_null() & ~pl.col("split").is_in(list(get_args(Split)))),
        "split",
        "is unknown",
        "write fit or heldout",
    )
    given = frame["split"]
    if 0 < given.null_count() < len(given):
        refuse(
            path,
            frame.filter(pl.col("split").is_null()),
            "period_id",
            "has no split, though others have",
            "write fit or heldout for every period, or leave the column out",
        )
    splits = split_periods(len(given)) if given.null_count() else tuple(given.to_list())
    if "fit" not in splits:
        raise MeasuredDataError(
            f"{path}: every period is held out, none is left to fit; write split = fit for some"
        )
    return splits


def detectors_of(path: Path, frame: pl.DataFrame, network: Network) -> tuple[Detector, ...]:
    """The detectors.

    Raises:
        MeasuredDataError: None, one twice, on a lane the network does not have, reaching beyond
            its lane, or of an unknown kind.
    """
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no detectors; write one row per detection zone")
    refuse(
        path,
        frame.filter(pl.col("detector_id").is_duplicated()),
        "detector_id",
        "occurs twice",
        "give each detector a name of its own",
    )
    kinds = get_args(DetectorKind)
    refuse(
        path,
        frame.filter(~pl.col("kind").is_in(list(kinds))),
        "kind",
        "is unknown",
        f"write one of {', '.join(kinds)}",
    )
    found: list[Detector] = []
    for row in frame.iter_rows(named=True):
        lane = network.lanes.get(row["lane_id"])
        where = f"{place(path, row[ROW])}: detector {row['detector_id']!r}"
        if lane is None:
            near = nearest(row["lane_id"], network.lanes)
            raise MeasuredDataError(
                f"{where} lies on lane {row['lane_id']!r}, which the network does not have"
                + (f"; did you mean {near!r}?" if near else "; lanes are called <edge>_<number>")
            )
        begin, length = row["position_m"], row["length_m"]
        if not (0 <= begin <= lane.length_m + TOLERANCE_M and length >= 0):
            raise MeasuredDataError(
                f"{where} has position_m {begin:g} and length_m {length:g}; lane {lane.id!r} "
                f"goes from 0 to {lane.length_m:g} m, measured from its upstream end"
            )
        if begin + length > lane.length_m + TOLERANCE_M:
            raise MeasuredDataError(
                f"{where} ends {begin + length:g} m along lane {lane.id!r}, which ends at "
                f"{lane.length_m:g} m; its length_m is at most {lane.length_m - begin:g}"
            )
        found.append(Detector(row["detector_id"], lane.id, begin, length, row["kind"]))
    return tuple(found)
