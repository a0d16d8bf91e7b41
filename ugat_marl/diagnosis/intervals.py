"""Counts, occupancies and mean speeds per interval, and the features of a period from them.

Detectors of cities and motorways report sums of an interval of 20 s to 15 min, not single vehicles.
The length of the interval decides what is left in them. So simulated detectors are added up over
intervals of the same length. Both sides then share them out to the bins of time alike, and have
these features for each kind of detector:

- ``over``: occupied time per vehicle, ``Σ o / Σ n``, s;
- ``mean_speed``: ``Σ n v / Σ n``, m/s;
- ``busy_count``: vehicles per interval, weighted by occupied time, ``Σ n o / Σ o``: near capacity
  where queues stand on the detector;
- ``busy_speed``: ``Σ n o v / Σ n o``, m/s: speed in crowded intervals;
- ``bunching``: ``Σ n^2 / Σ n``: vehicles in the interval of a vehicle.

n are the vehicles of an interval, o is its occupied time, v its mean speed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import Intervals
from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    BIN_FEATURES,
    FEATURES,
    INDEX,
    DetectorLayout,
    Tally,
    bins_in,
)
from ugat_marl.diagnosis.thresholds import DayThresholds, Thresholds
from ugat_marl.scenarios import Period

Array = NDArray[np.float64]

OCCUPANCY, MEAN_SPEED = "occupancy", "mean_speed_mps"
"""Columns of counts that hold more than vehicles."""


def interval_sums(intervals: Intervals, length_s: float) -> dict[str, tuple[float, float]]:
    """Return the sum and the weight of each feature of a detector.

    Args:
        intervals: Reports of the detector in a period.
        length_s: Usual length of an interval, s; features that depend on it leave out others.
    """
    n, o, v = intervals.vehicles, intervals.occupied_s, intervals.speed_mps
    usual = np.abs(intervals.end_s - intervals.begin_s - length_s) < 1e-3
    measured = np.isfinite(o)
    moving = np.isfinite(v) & (n > 0)
    busy, both = measured & usual, measured & moving & usual
    values = {
        "over": (o[measured].sum(), n[measured].sum()),
        "mean_speed": ((n * v)[moving].sum(), n[moving].sum()),
        "busy_count": ((n * o)[busy].sum(), o[busy].sum()),
        "busy_speed": ((n * o * v)[both].sum(), (n * o)[both].sum()),
        "bunching": ((n**2)[usual].sum(), n[usual].sum()),
    }
    return {name: (float(total), float(weight)) for name, (total, weight) in values.items()}


def usual_length(counts: pl.DataFrame | None) -> float | None:
    """Return the most frequent length of an interval, s; None without counts."""
    if counts is None or counts.is_empty():
        return None
    lengths = (counts["end_s"].cast(pl.Float64) - counts["begin_s"].cast(pl.Float64)).round(3)
    return float(lengths.mode().sort()[0])


def with_intervals(
    counted: Tally, layout: DetectorLayout, period: Period, length_s: float
) -> Tally:
    """Return the tally of a period of single vehicles with the features and bins of intervals.

    Args:
        counted: Tally of the period, with `FEATURES`.
        layout: Lanes and detectors.
        period: Period with passages.
        length_s: Length of an interval, s.
    """
    sums, bins = _widened(counted.sums), np.zeros_like(counted.bins)
    edges = np.linspace(period.begin_s, period.end_s, bins.shape[-1] + 1)
    for name, (feature, place) in layout.counted.items():
        reports = Intervals.of(period.of_detector(name), period, length_s)
        _enter(sums, feature, place, reports, length_s)
        _share_out(bins, feature, place, reports, overlap_s(reports.begin_s, reports.end_s, edges))
    return replace(counted, sums=sums, bins=bins)


# --- the detectors as they are --------------------------------------------------------------------


def seeming_lengths(
    reports: Iterable[tuple[str, Intervals]], thresholds: Thresholds
) -> dict[str, Array]:
    """Return sums from which the length of vehicles and zone follows, by kind of detector.

    A vehicle of length L over a zone of length z at speed v occupies it for (L + z) / v. So in free
    traffic ``L + z = Σ o v / Σ n``, whatever the drivers do.

    Args:
        reports: Kind of detector and reports of each detector.
        thresholds: Numbers of the method.

    Returns:
        Kind to its sum ``Σ o v`` in m and its number of vehicles, ``(2,)``, of intervals that are
        occupied for at most `Thresholds.free_occupancy`.
    """
    sums: dict[str, Array] = {}
    for kind, one in reports:
        n, o, v = one.vehicles, one.occupied_s, one.speed_mps
        share = o / np.maximum(one.end_s - one.begin_s, 1e-9)
        free = np.isfinite(v) & (n > 0) & (share <= thresholds.free_occupancy)
        total = np.array([(o * v)[free].sum(), n[free].sum()])
        sums[kind] = sums.get(kind, np.zeros(2)) + total
    return sums


def reports_of_passages(
    layout: DetectorLayout, period: Period, length_s: float
) -> Iterator[tuple[str, Intervals]]:
    """Yield kind and reports of each detector over which vehicles passed."""
    for name, (feature, _) in layout.counted.items():
        seen = period.of_detector(name)
        yield feature.removeprefix("count_"), Intervals.of(seen, period, length_s)


def reports_of_counts(
    layout: DetectorLayout, counts: pl.DataFrame
) -> Iterator[tuple[str, Intervals]]:
    """Yield kind and reports of each detector that was counted."""
    for (name,), own in counts.group_by("detector_id", maintain_order=True):
        feature, _ = layout.counted.get(str(name), ("", -1))
        if feature:
            yield feature.removeprefix("count_"), _reports(own)


def implausible(
    street: Mapping[str, Array], model: Mapping[str, Array], thresholds: Thresholds
) -> dict[str, tuple[float, float]]:
    """Find kinds of detectors whose occupancies do not fit their counts and speeds.

    A difference is attributed to the detectors if no vehicle length could cause it, or if other
    kinds of detectors do not show it; longer vehicles would show at all kinds.

    Args:
        street: Sums of `seeming_lengths` of the measured periods.
        model: The same of simulated days.
        thresholds: Numbers of the method.

    Returns:
        Kind to its length of vehicle and zone on the street and in the model, m.
    """
    least = thresholds.least_sightings
    lengths = {
        kind: (float(sums[0] / sums[1]), float(model[kind][0] / model[kind][1]))
        for kind, sums in street.items()
        if sums[1] >= least and kind in model and model[kind][1] >= least
    }
    longer = {kind: here - there for kind, (here, there) in lengths.items()}
    possible = {
        kind: more for kind, more in longer.items() if abs(more) <= thresholds.most_longer_m
    }

    def alone(kind: str) -> bool:
        """Return True if the length differs from the one elsewhere, and from the simulated one."""
        own = longer[kind]
        others = [more for other, more in possible.items() if len(possible) > 2 or other != kind]
        usual = float(np.median(others)) if others else own
        return min(abs(own - usual), abs(own)) > thresholds.most_unlike_m

    return {kind: found for kind, found in lengths.items() if kind not in possible or alone(kind)}


def without_occupancies(counted: Tally, kinds: Collection[str]) -> Tally:
    """Return a tally in which some kinds of detectors measured no occupancies."""
    sums, known = counted.sums.copy(), counted.counted.copy()
    for kind in kinds:
        for name in ("over", "busy_count", "busy_speed"):
            sums[INDEX[f"{name}_{kind}"]] = 0.0
    if "advance" in kinds:
        known[BIN_FEATURES.index("occupied")] = 0.0
    return replace(counted, sums=sums, bins=counted.bins * (known > 0), known=known)


# --- features -------------------------------------------------------------------------------------


def _widened(sums: Array) -> Array:
    """Return sums of `FEATURES` with empty rows for the other features."""
    wide = np.zeros((len(ALL_FEATURES), *sums.shape[1:]))
    wide[: len(FEATURES)] = sums
    return wide


def _enter(sums: Array, feature: str, place: int, intervals: Intervals, length_s: float) -> None:
    """Enter the features of one detector, whose count is called ``count_<kind>``."""
    kind = feature.removeprefix("count_")
    for name, values in interval_sums(intervals, length_s).items():
        sums[INDEX[f"{name}_{kind}"], place] = values


def overlap_s(begin_s: Array, end_s: Array, edges: Array) -> Array:
    """Return how much of each interval lies in each bin, s, ``(intervals, bins)``.

    Args:
        begin_s: Start of each interval, s.
        end_s: End of each interval, s.
        edges: Bounds of the bins, s.
    """
    begin = np.maximum(edges[:-1], begin_s[:, None])
    end = np.minimum(edges[1:], end_s[:, None])
    return np.clip(end - begin, 0.0, None)


def _share_out(bins: Array, feature: str, place: int, reports: Intervals, inside: Array) -> None:
    """Share vehicles, and occupied times of advance detectors, out to the bins of a place."""
    share = inside / np.maximum(reports.end_s - reports.begin_s, 1e-9)[:, None]
    bins[BIN_FEATURES.index(feature), place] = reports.vehicles @ share
    if feature == "count_advance":
        measured = np.isfinite(reports.occupied_s)
        occupied_s = reports.occupied_s[measured] @ share[measured]
        bins[BIN_FEATURES.index("occupied"), place] = occupied_s


# --- measured counts ------------------------------------------------------------------------------


def bins_together(counts: pl.DataFrame | None, thresholds: DayThresholds) -> int:
    """Return the number of bins that the longest interval of the counts covers.

    Args:
        counts: Table with ``begin_s, end_s``; None if single vehicles were detected.
        thresholds: Numbers of the method.
    """
    if counts is None or counts.is_empty():
        return 1
    longest = float((counts["end_s"] - counts["begin_s"]).cast(pl.Float64).to_numpy().max())
    return max(1, math.ceil(longest / thresholds.bin_s - 1e-6))


def without_gaps(
    counts: pl.DataFrame, periods: Sequence[Period], thresholds: DayThresholds
) -> frozenset[str]:
    """Find detectors that were counted in every period from begin to end."""
    length = pl.col("end_s").cast(pl.Float64) - pl.col("begin_s").cast(pl.Float64)
    whole = set(counts["detector_id"].to_list())
    for period in periods:
        of_period = counts.filter(pl.col("period_id") == period.id)
        times = dict(of_period.group_by("detector_id").agg(length.sum()).iter_rows())
        least = thresholds.whole * period.length_s
        whole = {name for name in whole if times.get(name, 0.0) >= least}
    return frozenset(whole)


def counts_tally(
    layout: DetectorLayout,
    period: Period,
    counts: pl.DataFrame,
    whole: Collection[str],
    thresholds: DayThresholds,
) -> Tally:
    """Return the tally of measured counts; features of single vehicles stay empty.

    Args:
        layout: Lanes and detectors.
        period: Period to tally.
        counts: Table with ``period_id, begin_s, end_s, detector_id, count``, and perhaps
            ``occupancy, mean_speed_mps``.
        whole: Detectors `without_gaps`. Other detectors fill only their known bins, since the mean
            of some hours is not the mean of the period.
        thresholds: Numbers of the method.
    """
    places = len(layout.lanes) + len(layout.exits)
    bins = np.zeros((len(BIN_FEATURES), places, bins_in(period.length_s, thresholds)))
    covered = np.zeros_like(bins)
    edges = np.linspace(period.begin_s, period.end_s, bins.shape[-1] + 1)
    length_s = usual_length(counts) if _more_than_vehicles(counts) else None
    sums = np.zeros((len(FEATURES), places, 2))
    if length_s is not None:
        sums = _widened(sums)
    rows = counts.filter(pl.col("period_id") == period.id)
    for (name,), own in rows.group_by("detector_id", maintain_order=True):
        feature, place = layout.counted.get(str(name), ("", -1))
        if place < 0:
            continue
        reports = _reports(own)
        if name in whole:
            minutes = (reports.end_s - reports.begin_s).sum() / 60.0
            sums[INDEX[feature], place] = reports.vehicles.sum(), minutes
        if name in whole and length_s is not None:
            _enter(sums, feature, place, reports, length_s)
        inside = overlap_s(reports.begin_s, reports.end_s, edges)
        _share_out(bins, feature, place, reports, inside)
        covered[BIN_FEATURES.index(feature), place] = inside.sum(axis=0)
        if feature == "count_advance":
            measured = np.isfinite(reports.occupied_s)
            covered[BIN_FEATURES.index("occupied"), place] = inside[measured].sum(axis=0)
    known = (covered > thresholds.whole * np.diff(edges)).astype(np.float64)
    return Tally(sums, bins * known, known=known, window=period.window, period=period.id)


def _more_than_vehicles(counts: pl.DataFrame) -> bool:
    """Return True if the counts have occupancies or mean speeds."""
    return any(name in counts.columns and counts[name].count() for name in (OCCUPANCY, MEAN_SPEED))


def _reports(rows: pl.DataFrame) -> Intervals:
    """Return the reports of one detector in the rows of its counts."""
    begin, end = _numbers(rows, "begin_s"), _numbers(rows, "end_s")
    occupied_s = _numbers(rows, OCCUPANCY) * (end - begin)
    return Intervals(begin, end, _numbers(rows, "count"), occupied_s, _numbers(rows, MEAN_SPEED))


def _numbers(frame: pl.DataFrame, column: str) -> Array:
    """Return a column as numbers; NaN for empty cells, and if there is no such column."""
    if column not in frame.columns:
        return np.full(frame.height, np.nan)
    return frame[column].cast(pl.Float64).fill_null(float("nan")).to_numpy()
