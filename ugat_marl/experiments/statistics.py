"""Means of few values: Student's intervals, and paired tests."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A mean with Student's 95 % interval; its ends are nan for one value, all is for none."""

    mean: float
    low: float
    high: float

    @property
    def is_wide(self) -> bool:
        """True if the ends are known and differ."""
        return self.low < self.high

    @property
    def half(self) -> float:
        """Half of the interval's width."""
        return (self.high - self.low) / 2

    @classmethod
    def of(cls, values: Floats) -> Interval:
        """Return the mean of ``(n,)`` values with its interval.

        mean ± t(0.975, n - 1) · s / √n, where s is the standard deviation of the sample.
        """
        count = values.size
        mean = float(values.mean()) if count else math.nan
        if count < 2:
            return cls(mean, math.nan, math.nan)
        # The mean of equal values may differ from them by rounding; their spread is set to 0.
        spread = float(values.std(ddof=1)) if values.min() < values.max() else 0.0
        half = float(stdtrit(count - 1, 0.975)) * spread / math.sqrt(count)
        return cls(mean, mean - half, mean + half)


@dataclass(frozen=True)
class PairedTest:
    """A difference between two settings, seed by seed.

    Attributes:
        difference: Mean of the first setting minus the second, with an interval.
        p: Two-sided p-value of Student's paired test; nan for a single seed or if a value is nan.
        better: Number of seeds with a difference below zero.
        count: Number of seeds.
    """

    difference: Interval
    p: float
    better: int
    count: int

    @classmethod
    def of(cls, one: Floats, other: Floats) -> PairedTest:
        """Compare two settings, ``(n,)`` each, in the same order of seeds.

        t = |mean| · √n / s of the differences, with n - 1 degrees of freedom.
        """
        differences = one - other
        count, better = differences.size, int((differences < 0).sum())
        p = math.nan
        if count > 1 and np.isfinite(differences).all():
            spread = float(differences.std(ddof=1))
            t = abs(float(differences.mean())) * math.sqrt(count)
            # Without a spread, t is infinite (p = 0), or all differences are 0 (p = 1).
            p = student_p(t / spread, count - 1) if spread > 0 else float(t == 0)
        return cls(Interval.of(differences), p, better, count)


def number_or_none(value: float) -> float | None:
    """Return a number for JSON and tables: None for NaN."""
    return None if math.isnan(value) else value


def student_p(t: float, degrees: float) -> float:
    """Return the two-sided p-value of Student's t.

    Args:
        t: The statistic.
        degrees: Degrees of freedom, at least 1; no whole number in Welch's test.
    """
    return float(2.0 * stdtr(degrees, -abs(t)))
