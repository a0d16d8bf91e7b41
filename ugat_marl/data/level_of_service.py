"""Level of service of signalised intersections, by control delay.

Source: Highway Capacity Manual, 6th edition (2016) and 7th edition (2022), exhibit 19-8. The manual
also calls a lane group F if more vehicles arrive than it can serve. For an approach or a whole
intersection the delay alone decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

LEVELS_S: dict[str, float] = {"A": 10.0, "B": 20.0, "C": 35.0, "D": 55.0, "E": 80.0, "F": math.inf}
"""Level to its largest mean control delay, s per vehicle."""


def level_of_service(delay_s: float) -> str:
    """Return the level, A to F, of a mean control delay in s per vehicle; empty for nan."""
    return next((level for level, most_s in LEVELS_S.items() if delay_s <= most_s), "")


def mean_delay_s(approaches: Iterable[tuple[float, float]]) -> float:
    """Return the mean control delay of several approaches; nan if nobody passed.

    Args:
        approaches: For each approach, the number of vehicles and their mean control delay, s; an
            approach that nobody passed does not count.
    """
    pairs = [(count, delay_s) for count, delay_s in approaches if count]
    vehicles = sum(count for count, _ in pairs)
    return sum(count * delay_s for count, delay_s in pairs) / vehicles if vehicles else math.nan
