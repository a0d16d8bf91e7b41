"""Travel times and queues between advance and stop detectors: measures that no fit uses.

Vehicles at a stop detector are matched to arrivals at the advance detectors of their approach,
first come, first served. A missed vehicle would shift every later match. So a vehicle that crosses
freely is matched to an arrival one free ride before, and older arrivals of its lane are forgotten.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Passages

Array = NDArray[np.float64]

JOURNEYS = ("travel_time", "queue")
"""Measures: time from the advance detector until the rear leaves the stop detector, in s per
vehicle; vehicles held back between the detectors when green begins, per green."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Vehicles that crossed a stop detector; arrays ``(vehicles,)``.

    Attributes:
        time_s: Time at which the rear left the detector, s, in order.
        free: True for vehicles that nothing held up.
    """

    time_s: Array
    free: NDArray[np.bool_]

    @classmethod
    def of(
        cls, stop: Passages, greens_s: Array, zone_m: float, pace_mps: float, gap_s: float
    ) -> Crossings:
        """Find the crossings and those among them that nothing held up.

        Args:
            stop: Passages over the stop detector.
            greens_s: Begins of green, s.
            zone_m: Length of the stop detector, m.
            pace_mps: Least speed of a free vehicle, m/s.
            gap_s: Least time after the vehicle before, and after green began, of a free one, s.
        """
        seen = stop.at(np.isfinite(stop.off_s))
        seen = seen.at(np.argsort(seen.off_s, kind="stable"))
        time = seen.off_s
        began = np.append(-np.inf, greens_s)[np.searchsorted(greens_s, time, "right")]
        apart = np.diff(time, prepend=-np.inf) > gap_s
        quick = seen.speed_mps >= pace_mps
        # Without speeds, a vehicle that is gone within a second drove; a zone takes its own time.
        over = np.where(np.isfinite(seen.on_s), time - seen.on_s, np.inf)
        quick |= ~np.isfinite(seen.speed_mps) & (over < 1.0 + zone_m / pace_mps)
        return cls(time, apart & quick & (time - began > gap_s))


def matched(
    came: Sequence[Array],
    crossed: Sequence[Crossings],
    travel_s: Sequence[float],
    free_s: Sequence[float] | None = None,
) -> tuple[list[list[tuple[float, float]]], list[deque[float]]]:
    """Match vehicles at the stop detectors of an approach to arrivals.

    A vehicle is matched to the earliest arrival on its lane that has not left yet. If there is
    none, it is matched to the earliest such arrival on the other lanes. A vehicle that nothing held
    up takes no arrival from so long ago that it must be another's.

    Args:
        came: Times at the advance detectors in order, per lane, s.
        crossed: Vehicles at the stop detectors, per lane.
        travel_s: Least time from the advance to the stop detector, per lane, s.
        free_s: Most time of vehicles that nothing held up, per lane, s; None for no limit.

    Returns:
        Pairs of arrival and crossing by lane of the crossing, and arrivals that never left.
    """
    waiting = [deque(times.tolist()) for times in came]
    pairs: list[list[tuple[float, float]]] = [[] for _ in came]
    events = sorted(
        (time, lane, free)
        for lane, vehicles in enumerate(crossed)
        for time, free in zip(vehicles.time_s.tolist(), vehicles.free.tolist(), strict=True)
    )
    for time, lane, free in events:
        latest = time - travel_s[lane]
        earliest = time - free_s[lane] if free and free_s is not None else -np.inf
        own = waiting[lane]
        while own and own[0] < earliest:
            own.popleft()  # it left unseen, or on another lane
        sources = [queue for queue in waiting if queue and earliest <= queue[0] <= latest]
        if sources:
            source = min(sources, key=lambda queue: (queue is not own, queue[0]))
            pairs[lane].append((source.popleft(), time))
    return pairs, waiting


def journey_sums(pairs: Sequence[tuple[float, float]], ride_s: float, greens_s: Array) -> Array:
    """Return sums and numbers of observations of `JOURNEYS` on one lane, ``(measures, 2)``.

    Args:
        pairs: Arrivals and crossings, s.
        ride_s: Time from one detector to the other at the speed limit, s.
        greens_s: Begins of green, s.
    """
    came, left = np.array(pairs, np.float64).reshape(-1, 2).T
    # Held back is who would have crossed before green began, but crosses after it.
    due = np.searchsorted(np.sort(came + ride_s), greens_s, "right")
    gone = np.searchsorted(np.sort(left), greens_s, "right")
    held = np.maximum(due - gone, 0)
    return np.array([[(left - came).sum(), len(came)], [held.sum(), len(greens_s)]])
