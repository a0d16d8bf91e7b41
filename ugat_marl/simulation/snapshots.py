"""Measurements: every lane at one instant, and every vehicle at the end of an episode."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

HALTING_MPS = 0.1
"""A vehicle slower than this stands in a queue (SUMO's definition of halting, m/s)."""


@dataclass(frozen=True)
class Snapshot:
    """All measured lanes at one instant.

    Attributes:
        time_s: Time on the scenario's clock.
        vehicles: Number of vehicles per lane, ``(lanes,)``.
        halting: Of these, slower than `HALTING_MPS`, ``(lanes,)``.
        mean_speed_mps: Mean speed per lane; the speed limit the lane had at the start of the
            episode where it is empty, ``(lanes,)``.
        waiting_s: Sum over the lane's vehicles of the seconds since each last moved, ``(lanes,)``;
            empty unless the simulator was started with `waiting`.
        departed: Vehicles that entered the network since the start of the episode.
        backlog: Vehicles due but not yet in the network, for want of space.
        mean_left: Vehicles that had left the lane's road, from this lane, averaged over the seconds
            since the last snapshot, ``(lanes,)``: how many, and how early. Empty unless the
            simulator was started with `crossings`, and in the first snapshot.
        near: Vehicles, halting ones and waiting time as above of those in the last metres of the
            lane, ``(3, lanes)``. Empty unless the simulator was started with `zone_m`.
    """

    time_s: float
    vehicles: NDArray[np.float64]
    halting: NDArray[np.float64]
    mean_speed_mps: NDArray[np.float64]
    waiting_s: NDArray[np.float64]
    departed: int
    backlog: int
    mean_left: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    near: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def less(self, left: NDArray[np.float64]) -> Snapshot:
        """Return this snapshot without the vehicles that have `left`, ``(lanes,)``."""
        halting = np.maximum(self.halting - left, 0.0)
        return replace(self, vehicles=self.vehicles - left, halting=halting)


@dataclass(frozen=True)
class Trips:
    """All vehicles due in an episode, finished or not, as SUMO reports them.

    Attributes:
        travel_time_s: From the scheduled departure to the arrival, or to the end of the episode,
            ``(vehicles,)``; waiting outside the network counts.
        delay_s: Time loss inside the network plus departure delay, ``(vehicles,)``.
        finished: Whether the vehicle arrived, bool ``(vehicles,)``.
        entered: Whether the vehicle got into the network, bool ``(vehicles,)``.
        co2_g: What the vehicle emitted, in g, ``(vehicles,)``. This and what follows is empty
            unless the simulator was started with `persons`.
        persons: Persons in the vehicle, ``(vehicles,)``.
        dangers: Collisions and hard brakings in the episode, ``(2,)``.
    """

    travel_time_s: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    finished: NDArray[np.bool_]
    entered: NDArray[np.bool_]
    co2_g: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    persons: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    dangers: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
