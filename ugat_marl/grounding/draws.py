"""Intervals of the fitted parts of a street, from draws."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

DRAWS = 200
"""Draws from a fitted part, for its intervals."""


def quantile_metrics(
    name: str, draws: NDArray[np.floating] | NDArray[np.integer], agents: Iterable[str]
) -> dict[str, float]:
    """Return median and 90 % interval of a number of each agent, as metrics of a run.

    Args:
        name: Name of the number.
        draws: Its draws, ``(agents, n)``.
        agents: The agents.
    """
    ends = ("_low", "", "_high")
    low_to_high = np.quantile(draws, (0.05, 0.5, 0.95), axis=1)
    return {
        f"{name}{end}/{agent}": float(value)
        for end, row in zip(ends, low_to_high, strict=True)
        for agent, value in zip(agents, row, strict=True)
    }
