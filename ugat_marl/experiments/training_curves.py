"""Means with intervals of values that trainings log per episode or per iteration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ugat_marl.experiments.statistics import Interval

CurvePoint = tuple[float, float, float, float]
"""Episode or iteration, mean, lower and upper end of the interval."""

_STRETCHES = 20
"""Largest number of stretches in a training."""
_LEAST = 4
"""Smallest number of episodes in a stretch."""


def means_by_stretch(series: Sequence[Sequence[tuple[int, float]]]) -> list[CurvePoint]:
    """Return the middle, the mean and Student's 95 % interval of each stretch of episodes.

    For one series, the interval is over the episodes of the stretch; for several, over the series.
    """
    series = [points for points in series if points]
    if not series:
        return []
    last = max(points[-1][0] for points in series) + 1
    size = max(_LEAST, math.ceil(last / _STRETCHES))
    rows: list[CurvePoint] = []
    for start in range(0, last, size):
        parts = [[v for x, v in points if start <= x < start + size] for points in series]
        parts = [part for part in parts if part]
        values = parts[0] if len(series) == 1 and parts else [float(np.mean(p)) for p in parts]
        if values and (len(values) > 1 or len(series) > 1 or last < 2 * size):
            rows.append((start + min(size, last - start) / 2, *_interval(values)))
    return rows


def means_by_step(series: Sequence[Sequence[tuple[int, float]]]) -> list[CurvePoint]:
    """Return mean and Student's 95 % interval over the series at each step.

    With one series the ends of the interval are nan.
    """
    steps: dict[int, list[float]] = {}
    for points in series:
        for step, value in points:
            steps.setdefault(step, []).append(value)
    return [(step, *_interval(values)) for step, values in sorted(steps.items())]


def _interval(values: Sequence[float]) -> tuple[float, float, float]:
    finite = np.array([value for value in values if math.isfinite(value)])
    if not finite.size or finite.size < len(values):
        return math.nan, math.nan, math.nan
    interval = Interval.of(finite)
    return interval.mean, interval.low, interval.high
