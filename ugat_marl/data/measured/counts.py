"""Readers of counts of detectors, turning counts and travel times of probes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path

import polars as pl

from ugat_marl.data.measured.copies import FEWEST, refuse_copies
from ugat_marl.data.measured.passages import FASTEST_MPS
from ugat_marl.data.measured.tables import (
    COUNTS,
    ROW,
    TRAVEL_TIMES,
    TURNING,
    as_written,
    refuse,
    report_outside,
)
from ugat_marl.data.measured.values import Finding, place
from ugat_marl.errors import MeasuredDataError, nearest
from ugat_marl.scenarios import Detector, Network, Period

MOST_PER_S = 1.0
"""Vehicles per second and lane that no street reaches: gaps in a moving queue are near 2 s."""
SATURATED_PER_S = 0.65
"""Vehicles per second and lane that no lane serves for a minute or more (2,340 per hour)."""
LONG_S = 60.0
"""Shortest interval in which a lane cannot serve more than that."""
_LEAST_S = 0.2
"""Least time of a vehicle over a detector, s: 4 m at 20 m/s."""
_ROUNDED = 0.005
"""Share of time below which an occupancy in whole percents is 0."""


def counts_of(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    detectors: Sequence[Detector],
    findings: list[Finding],
) -> pl.DataFrame:
    """Return counts per detector and interval, with the optional columns that hold something.

    Args:
        path: The file.
        frame: Its rows.
        periods: The periods.
        detectors: The detectors.
        findings: Findings; intervals outside of their period are added to them.

    Raises:
        MeasuredDataError: A detector or period is unknown, an interval or a number impossible,
            or two periods hold one recording.
    """
    names = [detector.id for detector in detectors]
    refuse(
        path,
        frame.filter(~pl.col("detector_id").is_in(names)),
        "detector_id",
        "is not listed in detectors.csv",
        "add it there, or leave the rows out",
    )
    frame = _checked_intervals(path, frame, periods, ("detector_id",), "its detector", findings)
    _refuse_units(path, frame)
    lanes = {detector.id: len(detector.lanes) for detector in detectors}
    served = pl.col("detector_id").replace_strict(lanes, return_dtype=pl.Float64)
    _check_rates(path, frame, served, findings)
    more = [name for name in COUNTS.optional if frame[name].count()]
    return frame.select(*COUNTS.columns, *more)


def _checked_intervals(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    keys: tuple[str, ...],
    owner: str,
    findings: list[Finding],
) -> pl.DataFrame:
    """Return counts within their periods; refuse wrong intervals and impossible numbers."""
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
    wrong = frame.filter(pl.col("end_s") <= pl.col("begin_s"))
    begin = as_written(frame, "begin_s")
    refuse(path, wrong, "end_s", f"is not after {begin}", "correct the row")
    frame = _within_periods(path, frame, periods, findings)
    copy = ~pl.struct(pl.exclude(ROW)).is_first_distinct()
    for bad, column, complaint, way_out in (
        (pl.col("count") < 0, "count", "is negative", "correct the row"),
        (pl.col("count") % 1 != 0, "count", "is not a whole number", "correct the row"),
        (copy, "begin_s", f"is there twice for {owner}", "delete the copy"),
        (
            pl.struct("period_id", "begin_s", *keys).is_duplicated(),
            "begin_s",
            f"is there twice for {owner}",
            "correct the row",
        ),
    ):
        refuse(path, frame.filter(bad), column, complaint, way_out)
    _refuse_overlaps(path, frame, keys, owner)
    refuse_copies(path, frame, periods, (*keys, "begin_s", "end_s"), "count")
    return frame


def _within_periods(
    path: Path, frame: pl.DataFrame, periods: Sequence[Period], findings: list[Finding]
) -> pl.DataFrame:
    """Leave out intervals outside of their period; refuse those that lie partly in it."""
    before = pl.col("end_s") <= pl.col("period_begin_s")
    after = pl.col("begin_s") >= pl.col("period_end_s")
    inside = frame.select(~(before | after)).to_series().to_numpy()
    if not inside.all():
        index = {period.id: i for i, period in enumerate(periods)}
        which = frame["period_id"].replace_strict(index, return_dtype=pl.Int32).to_numpy()
        begin_s, end_s = (frame[name].to_numpy() for name in ("begin_s", "end_s"))
        report_outside(path, periods, which, begin_s, inside, findings, end_s)
        frame = frame.filter(pl.Series(inside))
    for partly, column, complaint in (
        (pl.col("begin_s") < pl.col("period_begin_s"), "begin_s", "is before the period's begin"),
        (pl.col("end_s") > pl.col("period_end_s"), "end_s", "is after the period's end"),
    ):
        way_out = "begin and end the period in periods.csv where an interval does"
        refuse(path, frame.filter(partly), column, complaint, way_out)
    return frame


def _refuse_overlaps(path: Path, frame: pl.DataFrame, keys: tuple[str, ...], owner: str) -> None:
    """Refuse intervals that begin before an earlier one has ended: vehicles would count twice."""
    before = pl.col("end_s").cum_max().shift(1).over("period_id", *keys)
    overlap = (
        frame.sort("begin_s")
        .with_columns(before.alias("before"))
        .filter(pl.col("begin_s") < pl.col("before") - 1e-3)  # files hold milliseconds
        .sort(ROW)
    )
    if overlap.height:
        first, end = overlap.row(0, named=True), as_written(frame, "end_s")
        same = [pl.col(key) == first[key] for key in ("period_id", *keys)]
        last = frame.filter(*same, pl.col("end_s") == first["before"])[end][0]
        refuse(
            path,
            overlap,
            "begin_s",
            f"is before the end of an earlier interval of {owner}, "
            + (f"{last:g} s" if end == "end_s" else last),
            "write intervals that do not overlap, and no totals of several of them",
        )


def _check_rates(path: Path, frame: pl.DataFrame, lanes: pl.Expr, findings: list[Finding]) -> None:
    """Refuse counts that no lane can serve; add a finding on doubtful ones.

    Args:
        path: The file.
        frame: Its rows.
        lanes: Number of lanes that serve the vehicles of each row.
        findings: Findings.
    """
    length = pl.col("end_s") - pl.col("begin_s")
    served = lanes * length
    refuse(
        path,
        frame.filter(pl.col("count") > 1 + MOST_PER_S * served),
        "count",
        "is more than one vehicle per second and lane",
        "write the vehicles in the interval, not vehicles per hour, and times in seconds",
    )
    many = frame.filter((length >= LONG_S) & (pl.col("count") > SATURATED_PER_S * served))
    if many.height:
        findings.append(
            Finding(
                f"{path.name}: {many.height} of {frame.height} counts are above "
                f"{3600 * SATURATED_PER_S:g} vehicles per hour and lane, more than a lane serves; "
                "are they vehicles per hour, or is a vehicle counted twice?"
            )
        )


def _refuse_units(path: Path, frame: pl.DataFrame) -> None:
    """Refuse occupancies and mean speeds in other units, and zeros for what was not measured."""
    occupancy, speed = pl.col("occupancy"), pl.col("mean_speed_mps")
    for bad, column, complaint, way_out in (
        (
            (occupancy < 0) | (occupancy > 1),
            "occupancy",
            "is not a share of time from 0 to 1",
            "divide percents by 100, and leave the cell empty where it was not measured",
        ),
        (
            (speed < 0) | (speed > FASTEST_MPS),
            "mean_speed_mps",
            f"is not a speed from 0 to {FASTEST_MPS:g} m/s",
            "multiply miles per hour by 0.44704, divide km/h by 3.6, and leave the cell empty "
            "where it was not measured",
        ),
    ):
        refuse(path, frame.filter(bad), column, complaint, way_out)
    occupied = pl.col("count") * _LEAST_S / (pl.col("end_s") - pl.col("begin_s"))
    for column, shows in (("occupancy", occupied >= _ROUNDED), ("mean_speed_mps", pl.lit(True))):
        seen = frame.filter(pl.col("count") > 0, pl.col(column).is_not_null(), shows)
        if seen["count"].sum() >= FEWEST and not (seen[column] != 0).any():
            way_out = "leave the cells empty if it was not measured"
            refuse(path, seen, column, "is 0 wherever vehicles were counted", way_out)


def turning_of(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    network: Network,
    findings: list[Finding],
) -> pl.DataFrame:
    """Return vehicles per interval that go from one edge to the next.

    Args:
        path: The file.
        frame: Its rows.
        periods: The periods.
        network: Network of the scenario.
        findings: Findings; intervals outside of their period are added to them.

    Raises:
        MeasuredDataError: A period is unknown, no vehicle can turn so, or an interval or a number
            is impossible.
    """
    lanes: dict[tuple[str, str], set[str]] = defaultdict(set)
    for intersection in network.intersections:
        for link in intersection.links:
            lanes[network.lanes[link.from_lane].edge, link.to_edge].add(link.from_lane)
    _refuse_edges(path, frame, ("from_edge", "to_edge"), network)
    for row in frame.iter_rows(named=True):
        if (row["from_edge"], row["to_edge"]) not in lanes:
            ways = sorted(to for edge, to in lanes if edge == row["from_edge"])
            leads = f"{row['from_edge']!r} leads to {', '.join(ways[:8])}" if ways else (
                f"{row['from_edge']!r} leads to no traffic light"
            )  # fmt: skip
            raise MeasuredDataError(
                f"{place(path, row[ROW])}: no vehicle can turn from {row['from_edge']!r} to "
                f"{row['to_edge']!r} at a traffic light; {leads}"
            )
    keys = ("from_edge", "to_edge")
    frame = _checked_intervals(path, frame, periods, keys, "its turn", findings)
    numbers = [float(len(lanes[turn])) for turn in frame.select(keys).iter_rows()]
    _check_rates(path, frame, pl.lit(pl.Series(numbers, dtype=pl.Float64)), findings)
    return frame.select(*TURNING.columns)


def travel_times_of(path: Path, frame: pl.DataFrame, network: Network) -> pl.DataFrame:
    """Return travel times of single vehicles between two places.

    Args:
        path: The file.
        frame: Its rows, within their periods.
        network: Network of the scenario.

    Raises:
        MeasuredDataError: An edge is unknown, a place lies beyond its edge, or a time is too short.
    """
    _refuse_edges(path, frame, ("from_edge", "to_edge"), network)
    lengths = {lane.edge: lane.length_m for lane in network.lanes.values()}
    for edge, position in (("from_edge", "from_m"), ("to_edge", "to_m")):
        length = pl.col(edge).replace_strict(lengths, return_dtype=pl.Float64)
        refuse(
            path,
            frame.filter((pl.col(position) < 0) | (pl.col(position) > length + 0.1)),
            position,
            f"lies beyond its {edge}",
            "write the distance from the start of the edge, in m",
        )
    refuse(
        path,
        frame.filter(pl.col("travel_s") <= 0),
        "travel_s",
        "is not above 0",
        "write the time from the first to the second place, in s",
    )
    # At least the rest of the first edge and the part of the last one; more lies between them.
    begin, end = pl.col("from_m"), pl.col("to_m")
    length = pl.col("from_edge").replace_strict(lengths, return_dtype=pl.Float64)
    same = (pl.col("from_edge") == pl.col("to_edge")) & (end >= begin)
    metres = pl.when(same).then(end - begin).otherwise(length - begin + end)
    refuse(
        path,
        frame.filter(metres > FASTEST_MPS * pl.col("travel_s")),
        "travel_s",
        f"is shorter than at {FASTEST_MPS:g} m/s",
        "write seconds, not minutes",
    )
    return frame.select(*TRAVEL_TIMES.columns)


def _refuse_edges(
    path: Path, frame: pl.DataFrame, columns: Collection[str], network: Network
) -> None:
    edges = {lane.edge for lane in network.lanes.values()}
    for column in columns:
        unknown = frame.filter(~pl.col(column).is_in(list(edges)))
        if unknown.height:
            near = nearest(unknown[column][0], edges)
            refuse(
                path,
                unknown,
                column,
                "is not an edge of the network" + (f"; did you mean {near!r}?" if near else ""),
                "write the id of a SUMO edge",
            )
