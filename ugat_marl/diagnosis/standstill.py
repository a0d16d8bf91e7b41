"""Days on which traffic came to a standstill, as on no other day of a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import Tally

LOCKED_UP = 5.0
"""Robust standard deviations by which a day's counts are those of no ordinary day."""
RARE = 0.1
"""Share of days up to which such days are not part of a model: five measured days rather have none.
The test of what is left does not hang on one of them."""


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
