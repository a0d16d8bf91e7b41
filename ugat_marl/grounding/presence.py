"""Chances of each set of changes of a world, and draws of the values of those that are there.

In the prior of worlds a change is absent with some chance: its value is then the one that changes
nothing. Otherwise it is somewhere in its range, here normally distributed with the range's mean and
variance. What is known of a street is the answer p of a regression. How it answers in worlds of
known values x was measured (`regression.Calibration`):

    p = a + x B + e,   e ~ N(0, S)

So with m and V, the prior's mean and variance of the values for a set of changes that are there:

    chance(set) ~ prior(set) N(p; a + m B, S + B' V B)
    x | set     = x0 + (p - p0) (S + B' V B)^-1 B' V,   x0 ~ N(m, V),  p0 = a + x0 B + e

The first is the evidence for the set (Kass and Raftery 1995). The second turns a draw from the
prior into one in which the answer is known (Matheron's rule). What worlds the regression learned
from decides how it answers, but not the values that explain an answer (Wood 2010 calls N a
synthetic likelihood). So worlds may be simulated where an earlier answer points to.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.grounding.regression import Calibration

Floats = NDArray[np.float64]

LEAST_SPREAD = 0.02
"""Share of a range that is added to the standard deviation of an answer: by hand."""
SPREADS_TRIED = 12
"""Standard deviations over which the chance that lanes differ is averaged. By hand: 100 change its
logarithm by up to 0.3, 6 by as much again."""


@dataclass(frozen=True)
class Presence:
    """Chances of every set of changes.

    Attributes:
        nominal: Values that change nothing, ``(k,)``.
        middle: Mean of each value, if its change is there, ``(k,)``.
        spread: Its standard deviation, ``(k,)``.
        calibration: How the regression answers; its covariance has `LEAST_SPREAD`.
        answer: Its answer for the street, ``(k,)``.
        there: Sets of changes that are there, ``(sets, k)``.
        chances: Chance of each set, ``(sets,)``.
    """

    nominal: Floats
    middle: Floats
    spread: Floats
    calibration: Calibration
    answer: Floats
    there: NDArray[np.bool_]
    chances: Floats

    @classmethod
    def of(
        cls, log_odds: Sequence[float], calibration: Calibration, answer: Floats, nominal: Floats,
        low: Floats, high: Floats,
    ) -> Presence:  # fmt: skip
        """Return the chances that an answer leaves of a prior.

        Args:
            log_odds: For the change of each value, the log of its odds to be there in the prior,
                ``(k,)``.
            calibration: How the regression answers.
            answer: Its answer, ``(k,)``.
            nominal: Values that change nothing, ``(k,)``.
            low: Lowest values, ``(k,)``.
            high: Highest values, ``(k,)``.
        """
        floor = np.diag((LEAST_SPREAD * (high - low)) ** 2)
        calibration = replace(calibration, covariance=calibration.covariance + floor)
        middle, spread = (low + high) / 2.0, (high - low) / np.sqrt(12.0)
        there = np.array(list(itertools.product((True, False), repeat=len(nominal))), np.bool_)
        there = there.reshape(-1, len(nominal))
        slopes = calibration.slopes
        mean = calibration.constant + np.where(there, middle, nominal) @ slopes
        variance = np.where(there, spread, 0.0)[:, :, None] ** 2 * slopes
        covariance = calibration.covariance + slopes.T @ variance
        off = answer - mean
        solved = np.linalg.solve(covariance, off[:, :, None])[:, :, 0]
        logs = -0.5 * ((off * solved).sum(1) + np.linalg.slogdet(covariance)[1])
        logs += there @ np.array(log_odds)
        weights = np.exp(logs - logs.max())
        chances = weights / weights.sum()
        return cls(nominal, middle, spread, calibration, answer, there, chances)

    def drawn(
        self, generator: np.random.Generator, chance: float | None = None
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Draw a set of changes and their values; return the values, and what is there.

        Args:
            generator: Draws both.
            chance: Chance of each change to be there, whatever the answer; None for the chances
                that the answer leaves.
        """
        if chance is None:
            there = self.there[int(generator.choice(len(self.chances), p=self.chances))]
        else:
            there = generator.random(len(self.nominal)) < chance
        spread = np.where(there, self.spread, 0.0)
        values = np.where(there, self.middle, self.nominal)
        values = values + spread * generator.standard_normal(len(values))
        slopes, covariance = self.calibration.slopes, self.calibration.covariance
        error = np.linalg.cholesky(covariance) @ generator.standard_normal(len(values))
        off = self.answer - self.calibration.constant - values @ slopes - error
        towards = spread[:, None] ** 2 * slopes
        return values + towards @ np.linalg.solve(covariance + slopes.T @ towards, off), there

    def chance_of(self, column: int) -> float:
        """Return the chance that the change of a value is there."""
        return float(self.chances[self.there[:, column]].sum())


def lanes_differ(offsets: Floats, spread: Floats, most: float) -> float:
    """Return the log of how much more likely offsets of lanes are if lanes differ.

    If they differ, each is drawn from a normal distribution, whose standard deviation is somewhere
    between 0 and `most`. Offsets from a mean add up to 0: those of n lanes are n - 1 numbers. One
    lane alone tells nothing: 0.

    Args:
        offsets: Estimated distance of each lane from the mean, ``(lanes,)``.
        spread: Standard deviations of these estimates, ``(lanes,)``.
        most: Largest standard deviation of the lanes.
    """
    tried = np.linspace(0.0, most, SPREADS_TRIED)[:, None]
    free = 1.0 - 1.0 / len(offsets)
    deviation = np.hypot(spread, np.sqrt(free) * tried)
    logs = free * (-0.5 * (offsets / deviation) ** 2 - np.log(deviation)).sum(1)
    differ = np.log(np.mean(np.exp(logs - logs.max()))) + logs.max()
    return float(differ - logs[0])
