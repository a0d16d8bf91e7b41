"""Variation of demand from day to day, on top of the chance of single vehicles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ugat_marl.data import Finding, MeasuredData
from ugat_marl.diagnosis.features import BIN_FEATURES, DetectorLayout, Tally
from ugat_marl.diagnosis.statistics import Array
from ugat_marl.diagnosis.thresholds import Thresholds


def day_to_day_variation(
    counts: Array, thresholds: Thresholds, splits: Sequence[int] | None = None
) -> float:
    """Estimate how much demand varies from day to day, on top of the chance of single vehicles.

    The mean square of a day's counts around their mean has the expectation ``m + (s m)^2``, for a
    mean m and a variation s. No variation at all, as in a simulation, and a variation with a
    half-normal distribution are equally likely before the counts are seen. If no variation is
    likelier afterwards, it is taken; otherwise the posterior root mean square of the variation is.

    Args:
        counts: Vehicles per day at places that no vehicle passes twice, ``(places, days)``. The
            busiest one is used: others see many of the same vehicles.
        thresholds: Numbers of the method.
        splits: Number of each day's split; None for one. Days differ from the mean of their own
            split, because a change between the splits is no variation. Splits of single days are
            taken together.

    Returns:
        Standard deviation as a share of the mean, rounded to `Thresholds.grain_of_variation`.
    """
    days = counts[int(np.argmax(counts.sum(axis=1)))] if len(counts) else np.empty(0)
    if len(days) < 2 or not days.mean():
        return 0.0
    own = np.zeros(len(days), np.int64) if splits is None else np.asarray(splits)
    if len(set(own)) == len(days):
        own = np.zeros_like(own)
    usual = np.array([days[own == split].mean() for split in own])
    freedom = len(days) - len(set(own))
    squares = max(float(((days - usual) ** 2).sum()), 1e-6)  # counts may be equal
    shares = np.arange(0.0, 1.0, 0.002)
    scale = days.mean() + (shares * days.mean()) ** 2
    # The density of chi-square, but for a factor that all shares have in common.
    excess = squares / scale
    logs = (0.5 * freedom - 1.0) * np.log(excess) - 0.5 * excess - np.log(scale)
    prior = np.exp(-0.5 * (shares / thresholds.usual_variation) ** 2)
    prior[0] = prior[1:].sum()
    posterior = prior * np.exp(logs - logs.max())
    if posterior[0] > posterior[1:].sum():
        return 0.0
    posterior[0] = 0.0
    posterior /= posterior.sum()
    found = math.sqrt(float((posterior * shares**2).sum()))
    grain = thresholds.grain_of_variation
    return round(grain * round(found / grain), 6)


def measured_variation(
    layout: DetectorLayout,
    measured: MeasuredData,
    splits: Sequence[Sequence[Tally]],
    thresholds: Thresholds,
) -> float:
    """Estimate the variation from day to day; 0 if the periods are not the same time of days.

    Args:
        layout: Lanes and detectors.
        measured: The data.
        splits: Tallies of the fitted and of the held-out periods.
        thresholds: Numbers of the method.
    """
    days = [day for split in splits for day in split]
    if len({(period.begin_s, period.end_s) for period in measured.periods}) > 1:
        return 0.0
    owners = np.array([lane.intersection for lane in layout.lanes])
    known = np.all([day.counted > 0 for day in days], axis=0)  # a missing interval is no zero

    def counts(kind: str, places: Sequence[int]) -> Array:
        row = BIN_FEATURES.index(kind)
        return np.array([(day.bins[row, places] * known[row, places]).sum() for day in days])

    rows: list[Array] = []
    for number in range(len(layout.intersections)):
        lanes = np.flatnonzero(owners == number).tolist()
        exits = [len(owners) + k for k, (own, *_) in enumerate(layout.exits) if own == number]
        by_kind = [counts("count_stop", lanes), counts("count_advance", lanes)]
        if not np.any(by_kind):  # exits may count vehicles of other lights
            by_kind = [counts("count_exit", exits)]
        rows.append(max(by_kind, key=lambda row: float(row.sum())))
    numbers = [number for number, split in enumerate(splits) for _ in split]
    return day_to_day_variation(np.array(rows), thresholds, numbers)


def variation_findings(variation: float, days: int) -> tuple[Finding, ...]:
    """Return a finding on the variation from day to day; none without one.

    Args:
        variation: Standard deviation as a share of the mean.
        days: Number of days that tell it.
    """
    if not variation:
        return ()
    text = (
        f"as far as {days} days tell, demand differs from day to day by about "
        f"{100 * variation:.0f} %, on top of chance; so do simulated days"
    )
    return (Finding(text),)
