"""Means of few values: Student's intervals, and paired tests."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % interval (nan for a single value)."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Floats) -> Interval:
        """Student's interval of the mean of ``(n,)`` values."""
        mean, count = float(values.mean()), values.size
        if count < 2:
            return cls(mean, math.nan, math.nan)
        # Equal values have a mean beside them by rounding, and a spread of nearly 0.
        spread = float(values.std(ddof=1)) if values.min() < values.max() else 0.0
        half = student_quantile(0.975, count - 1) * spread / math.sqrt(count)
        return cls(mean, mean - half, mean + half)


@dataclass(frozen=True)
class PairedTest:
    """A difference between two settings, seed by seed.

    Attributes:
        difference: One minus the other.
        p: Two-sided, of Student's paired test; nan for a single seed, or where a value is nan.
        better: Number of seeds in which the difference is below zero.
        count: Number of seeds.
    """

    difference: Interval
    p: float
    better: int
    count: int

    @classmethod
    def of(cls, one: Floats, other: Floats) -> PairedTest:
        """Of two settings, ``(n,)`` each, in the same order of seeds."""
        differences = one - other
        count, better = differences.size, int((differences < 0).sum())
        p = math.nan
        if count > 1 and np.isfinite(differences).all():
            spread = float(differences.std(ddof=1))
            t = abs(float(differences.mean())) * math.sqrt(count)
            # Equal differences leave no doubt, or none to settle.
            p = student_p(t / spread, count - 1) if spread > 0 else float(t == 0)
        return cls(Interval.of(differences), p, better, count)


def student_p(t: float, degrees: int) -> float:
    """Two-sided p-value of Student's t (Abramowitz and Stegun 26.7.3, 26.7.4).

    Args:
        t: The statistic.
        degrees: Degrees of freedom, at least 1.
    """
    angle = math.atan(abs(t) / math.sqrt(degrees))
    cosine, sine = math.cos(angle), math.sin(angle)
    odd = degrees % 2 == 1
    term = cosine if odd else 1.0
    total = term if degrees > 1 else 0.0
    for k in range(3 if odd else 2, degrees - 1, 2):
        term *= cosine**2 * (k - 1) / k
        total += term
    inside = 2.0 / math.pi * (angle + sine * total) if odd else sine * total
    return min(max(1.0 - inside, 0.0), 1.0)


def student_quantile(level: float, degrees: int) -> float:
    """The t below which Student's distribution has `level`, for 0.5 < level < 1."""
    low, high = 0.0, 1.0
    while student_p(high, degrees) > 2.0 * (1.0 - level):
        high *= 2.0
    for _ in range(80):
        middle = (low + high) / 2.0
        if student_p(middle, degrees) > 2.0 * (1.0 - level):
            low = middle
        else:
            high = middle
    return high
