"""Days on which traffic came to a standstill, as on no other day of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import Tally

LOCKED_UP = 5.0
"""Robust standard deviations by which a day's counts are those of no ordinary day."""
RARE = 0.1
"""Share of days up to which such days are not part of a model: five measured days rather have none.
The test of what is left does not hang on one of them."""


@dataclass(frozen=True)
class Usual:
    """Ordinary days of the scenario as it is.

    Attributes:
        set_aside: Numbers of its days on which traffic came to a standstill.
        day_to_day: Robust standard deviation of the vehicles counted on the others.
    """

    set_aside: frozenset[int] = frozenset()
    day_to_day: float = 0.0

    @classmethod
    def of(cls, tallies: Sequence[Tally]) -> Usual:
        """Tell the ordinary days from the others.

        Args:
            tallies: All days from the first on.
        """
        aside = frozenset(locked_up(tallies))
        return cls(aside, day_to_day([day for n, day in enumerate(tallies) if n not in aside]))


def day_to_day(tallies: Sequence[Tally]) -> float:
    """Robust standard deviation of the vehicles counted on a day."""
    counts = _counts(tallies)
    return 1.4826 * float(np.median(np.abs(counts - np.median(counts)))) + 1e-9


def locked_up(tallies: Sequence[Tally], usual: float = 0.0) -> list[int]:
    """Places of the few days on which traffic came to a standstill and on others did not.

    One of them widens the noise of everything. Where they are common they are part of the model.

    Args:
        tallies: Days of one model.
        usual: Least `day_to_day`, where few days hardly tell it.
    """
    counts = _counts(tallies)
    spread = max(day_to_day(tallies), usual)
    found = np.flatnonzero(np.abs(counts - np.median(counts)) > LOCKED_UP * spread)
    return found.tolist() if len(found) <= max(1.0, RARE * len(tallies)) else []


def _counts(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    return np.array([item.bins[:3].sum() for item in tallies])
