"""Usual criteria on counts: GEH, and the four of FHWA.

GEH below 5 on 85 % of the counts is a common criterion (UK TAG unit M3.1). The criteria of FHWA are
in the Traffic Analysis Toolbox, volume III (FHWA-HOP-18-036, 2019, chapter 5). They compare the
simulation with one representative day, interval by interval, relative to the variation between
measured days.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import BIN_FEATURES, INDEX, Tally
from ugat_marl.diagnosis.statistics import Array
from ugat_marl.diagnosis.thresholds import THRESHOLDS

_COUNTED = ("count_stop", "count_exit")


@dataclass(frozen=True)
class Criteria:
    """Results of the four criteria: shares of detectors or of their intervals, in [0, 1].

    Attributes:
        within_2_sigma: Share of intervals within 1.96 standard deviations of the representative
            day. Criterion I asks for at least 0.95.
        within_1_sigma: Share of intervals within one standard deviation. Criterion II asks for at
            least two thirds.
        absolute_error: Share of detectors whose mean absolute error is at most that of the other
            measured days. Criterion III (bounded dynamic absolute error) asks for 1.
        systematic_error: Share of detectors whose mean error is at most a third of that. Criterion
            IV (bounded dynamic systematic error) asks for 1.
    """

    within_2_sigma: float
    within_1_sigma: float
    absolute_error: float
    systematic_error: float


def hourly(item: Tally) -> Array:
    """Return vehicles per hour at every stop and exit detector, 0 without one; ``(2 places,)``."""
    sums = item.sums[[INDEX[name] for name in _COUNTED]].reshape(-1, 2)
    return 60.0 * sums[:, 0] / np.maximum(sums[:, 1], 1e-9)


def geh(measured: Array, simulated: Array) -> Array:
    """Return ``GEH = sqrt(2 (m - c)^2 / (m + c))`` of hourly counts, without empty pairs.

    Args:
        measured: Counts c, vehicles per hour.
        simulated: Counts m, vehicles per hour.
    """
    some = measured + simulated > 1.0
    m, c = simulated[some], measured[some]
    return np.sqrt(2 * (m - c) ** 2 / (m + c))


def fhwa(measured: Sequence[Tally], simulated: Sequence[Tally], together: int) -> Criteria | None:
    """Compute the four criteria on the counts of stop and exit detectors.

    Args:
        measured: Tallies of the measured days, at least `THRESHOLDS.least_days`.
        simulated: Tallies of simulated days; their mean is compared.
        together: Number of bins of time that one measured count covers.

    Returns:
        None if there are too few days, or if no detector counts in all intervals of all days.
    """
    shortest = min(day.bins.shape[-1] for day in (*measured, *simulated))
    bins = min(max(round(THRESHOLDS.interval_s / THRESHOLDS.bin_s), together), shortest)
    real = [_intervals(day, bins, shortest // bins) for day in measured]
    days = np.stack([counts for counts, _ in real])
    model = np.mean([_intervals(day, bins, shortest // bins)[0] for day in simulated], axis=0)
    whole = np.all([known for _, known in real], axis=(0, 2))
    used = whole & (days.sum(axis=(0, 2)) > 0)
    if len(measured) < THRESHOLDS.least_days or not used.any():
        return None
    days, model = days[:, used], model[used]
    chosen = representative(days)
    error = model - days[chosen]  # (detectors, intervals)
    sigma = np.maximum(days.std(axis=0, ddof=1), 1e-9)
    others = np.delete(days, chosen, axis=0)
    bound = np.abs(others - days[chosen]).mean(axis=(0, 2)) + 1e-9
    return Criteria(
        float((np.abs(error) <= 1.96 * sigma).mean()),
        float((np.abs(error) <= sigma).mean()),
        float((np.abs(error).mean(axis=1) <= bound).mean()),
        float((np.abs(error.mean(axis=1)) <= bound / 3.0).mean()),
    )


def representative(days: Array) -> int:
    """Return the index of the day with the least relative difference from the mean of all days.

    Args:
        days: Counts, ``(days, detectors, intervals)``.
    """
    mean = days.mean(axis=0)
    relative = np.abs(days - mean) / np.where(mean > 0, mean, 1.0)
    return int(relative.mean(axis=(1, 2)).argmin())


def _intervals(day: Tally, bins: int, count: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return counts of the first intervals, and a mask of complete ones.

    Args:
        day: The day.
        bins: Number of bins in an interval.
        count: Number of intervals.

    Returns:
        Both ``(detectors, intervals)``.
    """
    rows = [BIN_FEATURES.index(name) for name in _COUNTED]
    sums, known = (values[rows, :, :count].reshape(-1, count) for values in day.gathered(bins))
    return sums, known > 0
