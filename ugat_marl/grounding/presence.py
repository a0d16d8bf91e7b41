"""Chances of each set of changes of a world, and draws without the changes that are absent.

In the prior of worlds a change is absent with some chance: a point of mass at the value that
changes nothing. A regression spreads that mass: it estimates a small amount of every effect. This
module restores it. With the normal distribution N(m, C) for what the regression says of all
values, with A the values of absent changes and F those of present ones:

    chance(A) ~ prior(A) N(nominal_A; m_A, C_AA) prod_F (share of F's range that N allows) / range_F
    x_F | A   = x_F + C_FA C_AA^-1 (nominal_A - x_A)

The first is the ratio of Dickey (1971), whose factors 1 / range are the price of a further value.
The second turns a draw x into one in which the absent values are known (Matheron's rule).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]

LEAST_SPREAD = 0.02
"""Share of a range that is added to the standard deviation of a value: by hand."""
SPREADS_TRIED = 12
"""Standard deviations over which the chance that lanes differ is averaged. By hand: 100 change its
logarithm by up to 0.3, 6 by as much again."""


@dataclass(frozen=True)
class Presence:
    """Chances of every set of changes.

    Attributes:
        nominal: Values that change nothing, ``(k,)``.
        chances: Chance of each set, ``(sets,)``.
        absent: For each set, the places of the values of absent changes.
        gains: For each set, how the other values follow the absent ones, ``(k, absent)``.
    """

    nominal: Floats
    chances: Floats
    absent: tuple[NDArray[np.int64], ...]
    gains: tuple[Floats, ...]

    @classmethod
    def of(
        cls, log_odds: Sequence[float], mean: Floats, covariance: Floats, nominal: Floats,
        low: Floats, high: Floats,
    ) -> Presence:  # fmt: skip
        """Return the chances of a normal distribution and a prior.

        Args:
            log_odds: For the change of each value, the log of its odds to be there, before the
                mean and the covariance are known, ``(k,)``.
            mean: Mean of the values, ``(k,)``.
            covariance: Their covariance, ``(k, k)``.
            nominal: Values that change nothing, ``(k,)``.
            low: Lowest values, ``(k,)``.
            high: Highest values, ``(k,)``.
        """
        covariance = covariance + np.diag((LEAST_SPREAD * (high - low)) ** 2)
        odds = np.array(log_odds)
        logs: list[float] = []
        absent: list[NDArray[np.int64]] = []
        gains: list[Floats] = []
        for each in itertools.product((True, False), repeat=len(odds)):
            there = np.array(each, dtype=np.bool_)
            out = np.flatnonzero(~there)
            off = nominal[out] - mean[out]
            within = covariance[np.ix_(out, out)]
            gain: Floats = np.linalg.solve(within, covariance[out]).T.astype(np.float64)
            distance = off @ np.linalg.solve(within, off)
            density = -0.5 * (distance + np.linalg.slogdet(2.0 * np.pi * within)[1])
            middle = (mean + gain @ off)[there]
            spread = np.sqrt(np.diag(covariance - gain @ covariance[out])[there])
            share = ndtr((high[there] - middle) / spread) - ndtr((low[there] - middle) / spread)
            slab = np.log(np.maximum(share, 1e-9) / (high - low)[there]).sum()
            logs.append(float(odds[there].sum() + density + slab))
            absent.append(out)
            gains.append(gain)
        weights = np.exp(np.array(logs) - max(logs))
        return cls(nominal, weights / weights.sum(), tuple(absent), tuple(gains))

    def drawn(
        self, values: Floats, generator: np.random.Generator
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Draw a set of changes; return the values of a draw given that set, and what is absent.

        Args:
            values: A draw of all values, ``(k,)``.
            generator: Draws the set.
        """
        one = int(generator.choice(len(self.chances), p=self.chances))
        out = self.absent[one]
        return values + self.gains[one] @ (self.nominal[out] - values[out]), out

    def chance_of(self, column: int) -> float:
        """Return the chance that the change of a value is there."""
        there = [column not in out for out in self.absent]
        return float(self.chances[there].sum())


def lanes_differ(offsets: Floats, spread: Floats, most: float) -> float:
    """Return the log of how much more likely offsets of lanes are if lanes differ.

    If they differ, each is drawn from a normal distribution, whose standard deviation is somewhere
    between 0 and `most`. One lane alone tells nothing: 0.

    Args:
        offsets: Estimated distance of each lane from the mean, ``(lanes,)``.
        spread: Standard deviations of the estimates, ``(lanes,)``.
        most: Largest standard deviation of the lanes.
    """
    tried = np.linspace(0.0, most, SPREADS_TRIED)[:, None]
    if len(offsets) < 2:  # a lane alone is the mean
        return 0.0
    deviation = np.hypot(spread, tried)
    logs = (-0.5 * (offsets / deviation) ** 2 - np.log(deviation)).sum(1)
    differ = np.log(np.mean(np.exp(logs - logs.max()))) + logs.max()
    return float(differ - logs[0])
