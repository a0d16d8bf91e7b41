"""Counts, occupancies and mean speeds of detectors per interval, from passages of vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.values import MeasuredData
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Passages, Period

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Intervals:
    """Reports of one detector in one period; all arrays ``(intervals,)``.

    Attributes:
        begin_s: Begins of the intervals, s.
        end_s: Ends of the intervals, s.
        vehicles: Number of vehicles.
        occupied_s: Occupied time, s; NaN where it was not measured.
        speed_mps: Arithmetic mean of the speeds of the vehicles, m/s; NaN without vehicles, or
            where it was not measured.
    """

    begin_s: Array
    end_s: Array
    vehicles: Array
    occupied_s: Array
    speed_mps: Array

    @classmethod
    def of(cls, seen: Passages, period: Period, length_s: float) -> Intervals:
        """Add up the passages over a detector.

        A vehicle counts in the interval in which its front arrives, or, if it was there at the
        start of the period, in which its rear leaves.

        Args:
            seen: Passages over the detector.
            period: The period.
            length_s: Length of an interval, s; the last one may be shorter.
        """
        begin, end = period.begin_s, period.end_s
        edges = np.append(np.arange(begin, end - 1e-6, length_s), end)
        count = len(edges) - 1
        on = np.where(np.isfinite(seen.on_s), seen.on_s, begin)
        off = np.where(np.isfinite(seen.off_s), seen.off_s, end)
        which = np.clip(np.searchsorted(edges, seen.seen_s, "right") - 1, 0, count - 1)
        timed = np.isfinite(seen.speed_mps)
        known = np.bincount(which[timed], minlength=count)
        total = np.bincount(which[timed], seen.speed_mps[timed], minlength=count)
        return cls(
            edges[:-1],
            edges[1:],
            np.bincount(which, minlength=count).astype(np.float64),
            occupied_between(on, off, edges),
            np.where(known > 0, total / np.maximum(known, 1), np.nan),
        )


def occupied_between(on: Array, off: Array, edges: Array) -> Array:
    """Return occupied seconds in each interval of time, ``(edges - 1,)``.

    Args:
        on: Begins of occupation, s.
        off: Ends of occupation, s.
        edges: Bounds of the intervals, s.
    """

    def passed(times: Array) -> Array:
        """Return the seconds from all earlier times to each edge, summed."""
        times = np.sort(times)
        until = np.concatenate(([0.0], np.cumsum(times)))
        before = np.searchsorted(times, edges)
        return before * edges - until[before]

    return np.diff(passed(on) - passed(np.maximum(off, on)))


def require_interval(length_s: float) -> None:
    """Refuse an impossible length of intervals.

    Raises:
        OptionError: The length is below 1 s, or not finite.
    """
    if not 1 <= length_s < math.inf:
        raise OptionError(f"an interval of {length_s:g} s: give seconds, 1 or more")


def as_counts(measured: MeasuredData, length_s: float) -> MeasuredData:
    """Return the data as detectors report them that count per interval and log no single vehicle.

    Args:
        measured: Data with passages.
        length_s: Length of an interval, s; the last one of a period may be shorter.

    Returns:
        The data with ``counts``, with occupancies and mean speeds, and without passages.

    Raises:
        OptionError: The length is below 1 s.
    """
    require_interval(length_s)
    parts: list[pl.DataFrame] = []
    for period in measured.periods:
        for detector in measured.detectors:
            seen = period.of_detector(detector.id)
            of_detector = Intervals.of(seen, period, length_s)
            length = of_detector.end_s - of_detector.begin_s
            part = pl.DataFrame(
                {
                    "begin_s": of_detector.begin_s,
                    "end_s": of_detector.end_s,
                    "count": of_detector.vehicles,
                    "occupancy": np.clip(of_detector.occupied_s / length, 0.0, 1.0).round(5),
                    "mean_speed_mps": of_detector.speed_mps.round(3),
                }
            )
            named = part.select(
                pl.lit(period.id).alias("period_id"),
                "begin_s",
                "end_s",
                pl.lit(detector.id).alias("detector_id"),
                "count",
                "occupancy",
                pl.col("mean_speed_mps").fill_nan(None),
            )
            parts.append(named)
    periods = tuple(replace(period, passages={}) for period in measured.periods)
    return replace(measured, periods=periods, counts=pl.concat(parts))
