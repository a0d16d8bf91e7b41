"""When vehicles came to an approach, and where they left it: read from its detectors."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Passages, Period

Array = NDArray[np.float64]

HELD_UP, FREE = 0.55, 0.85
"""Shares of the limit: who is slower at the advance detector comes out of a queue, who is faster
does not; who is between them does if he closely follows one who does."""
_CLOSE_S = 3.5
_LENGTH_M = 5.0
"""Of a vehicle whose speed has to be told from its time on the detector."""
_WINDOW_S = 600.0
_MISSING, _MISSING_SHARE = 10.0, 0.1
"""Vehicles, and share of those seen, that the stop detectors of an approach must have seen beyond
the advance ones for the latter to have missed them."""


def unhindered(seen: Passages, limit_mps: float, period: Period, zone_m: float = 0.0) -> Array:
    """When vehicles would have come if nobody had stood in their way, s.

    Vehicles that came through a queue arrived at its end before; when, nobody saw. They are spread
    evenly between the last that came freely and the next, but none comes later than it did.

    Args:
        seen: An advance detector's vehicles.
        limit_mps: Speed limit there.
        period: Its begin and end.
        zone_m: Length of the detection zone.
    """
    seen = seen.at(np.isfinite(seen.on_s))
    times = seen.on_s.copy()
    over = np.maximum(seen.off_s - seen.on_s, 1e-3)
    pace = (
        np.where(np.isfinite(seen.speed_mps), seen.speed_mps, (_LENGTH_M + zone_m) / over)
        / limit_mps
    )
    slow = pace < HELD_UP
    close = np.diff(times, prepend=-np.inf) < _CLOSE_S
    for place in np.flatnonzero(close & ~slow & (pace < FREE)).tolist():
        slow[place] = slow[place - 1]  # it stood farther back in the same queue
    edges = np.flatnonzero(np.diff(np.concatenate(([False], slow, [False]))))
    for first, behind in zip(edges[::2], edges[1::2], strict=True):
        before = times[first - 1] if first else period.begin_s
        after = times[behind] if behind < len(times) else period.end_s
        spread = np.linspace(before, after, behind - first + 2)[1:-1]
        times[first:behind] = np.minimum(times[first:behind], spread)
    return times


def by_lane_left(
    came: Sequence[Array], crossed: Sequence[Array], travel_s: Sequence[float]
) -> list[Array]:
    """When the vehicles came that left an approach by each of its lanes.

    Between the detectors some change lanes. Every vehicle at a stop detector is taken for the first
    that came on its lane and has not left yet; if there is none, for the first on any other lane.

    Args:
        came: Times at the advance detectors in order, per lane.
        crossed: Times at the stop detectors in order, per lane.
        travel_s: Least time from the one to the other, per lane.

    Returns:
        Times per lane; who never left is counted for the lane on which he came.
    """
    waiting = [deque(times.tolist()) for times in came]
    found: list[list[float]] = [[] for _ in came]
    events = sorted((time, lane) for lane, times in enumerate(crossed) for time in times.tolist())
    for time, lane in events:
        latest = time - travel_s[lane]
        source = waiting[lane]
        if not source or source[0] > latest:
            source = min(waiting, key=lambda queue: queue[0] if queue else np.inf)
        if source and source[0] <= latest:
            found[lane].append(source.popleft())
    return [np.array(sorted([*own, *left])) for own, left in zip(found, waiting, strict=True)]


def missed(times: Array, crossed: Array, period: Period) -> Array:
    """Vehicles advance detectors missed if the stop detectors saw many more, by window."""
    if len(crossed) - len(times) <= _MISSING + _MISSING_SHARE * len(times):
        return np.empty(0)
    count = max(1, round((period.end_s - period.begin_s) / _WINDOW_S))
    edges = np.linspace(period.begin_s, period.end_s, count + 1)
    lacking = np.histogram(crossed, edges)[0] - np.histogram(times, edges)[0]
    lacking = np.maximum(lacking, 0)
    share = (len(crossed) - len(times)) / max(int(lacking.sum()), 1)
    parts = [
        np.linspace(begin, end, n + 2)[1:-1]
        for begin, end, n in zip(
            edges[:-1], edges[1:], np.round(share * lacking).astype(int), strict=True
        )
    ]
    return np.concatenate(parts)
