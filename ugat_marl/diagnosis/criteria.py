"""Usual criteria on counts: GEH, and the four of FHWA.

GEH below 5 on 85 % of the counts is a common criterion (UK TAG unit M3.1). Those of the Traffic
Analysis Toolbox, volume III (FHWA-HOP-18-036, 2019, chapter 5) compare the simulation with one
representative day, interval by interval, in the measure of how much measured days differ.
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
    """Criteria met by the counts of a simulation: shares of detectors or of their intervals.

    Attributes:
        within_2_sigma: Share of intervals within 1.96 standard deviations of the representative
            day (criterion I: at least 0.95).
        within_1_sigma: Within one (criterion II: at least two thirds).
        absolute_error: Share of detectors whose mean absolute error is at most that of the other
            measured days (criterion III, bounded dynamic absolute error: all of them).
        systematic_error: Share of detectors whose mean error is at most a third of that
            (criterion IV, bounded dynamic systematic error: all of them).
    """

    within_2_sigma: float
    within_1_sigma: float
    absolute_error: float
    systematic_error: float


def hourly(item: Tally) -> Array:
    """Return vehicles per hour at every stop and exit detector, 0 where there is none."""
    sums = item.sums[[INDEX[name] for name in _COUNTED]].reshape(-1, 2)
    return 60.0 * sums[:, 0] / np.maximum(sums[:, 1], 1e-9)


def geh(measured: Array, simulated: Array) -> Array:
    """Return ``sqrt(2 (m - c)^2 / (m + c))`` of hourly counts, where there are any."""
    some = measured + simulated > 1.0
    m, c = simulated[some], measured[some]
    return np.sqrt(2 * (m - c) ** 2 / (m + c))


def fhwa(measured: Sequence[Tally], simulated: Sequence[Tally], together: int) -> Criteria | None:
    """Compute the four criteria on the counts of stop and exit detectors.

    Args:
        measured: The measured days, at least `LEAST_DAYS`.
        simulated: Simulated days; their mean is compared.
        together: Bins of time that one measured count covers.

    Returns:
        None where there are too few days, or no detector counts in all intervals of all days.
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
    error = model - days[chosen]
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
    """Find the day that differs least, in relative terms, from the mean of all.

    Args:
        days: Counts, ``(days, detectors, intervals)``.
    """
    mean = days.mean(axis=0)
    relative = np.abs(days - mean) / np.where(mean > 0, mean, 1.0)
    return int(relative.mean(axis=(1, 2)).argmin())


def _intervals(day: Tally, bins: int, count: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return the first counts, and if they are complete, ``(detectors, intervals)``."""
    rows = [BIN_FEATURES.index(name) for name in _COUNTED]
    sums, known = (values[rows, :, :count].reshape(-1, count) for values in day.gathered(bins))
    return sums, known > 0
