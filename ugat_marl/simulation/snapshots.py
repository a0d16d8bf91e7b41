"""Measurements: every lane at one instant, and every vehicle at the end of an episode."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

HALTING_MPS = 0.1
"""Speed in m/s below which a vehicle halts (SUMO's definition)."""


def seconds_of(interval_s: float) -> NDArray[np.float64]:
    """Return the ends of the seconds of an interval, s; the last second may be a part of one."""
    return np.append(np.arange(1.0, math.ceil(interval_s)), interval_s)


@dataclass(frozen=True)
class Snapshot:
    """All measured lanes at one instant.

    Vehicles that effects add to block a lane are left out, except in `near` and `detected`.

    Attributes:
        time_s: Time on the scenario's clock.
        vehicles: Number of vehicles per lane, ``(lanes,)``.
        halting: Vehicles slower than `HALTING_MPS` per lane, ``(lanes,)``.
        mean_speed_mps: Mean speed per lane, ``(lanes,)``. An empty lane has the speed limit it had
            at the start of the episode.
        waiting_s: Sum over the lane's vehicles of the seconds since each last moved, ``(lanes,)``.
            Empty unless the simulator was started with `waiting`.
        departed: Vehicles that entered the network since the start of the episode.
        backlog: Vehicles that are due but found no space to enter the network.
        mean_left: Number of vehicles that had left the lane's road from this lane, averaged over
            the interval since the last snapshot (see `seconds_of`), ``(lanes,)``. It is larger if
            vehicles leave earlier. Empty unless the simulator was started with `crossings`, and in
            the first snapshot.
        near: Vehicles, halting vehicles, waiting time and m/s of the mean speed below the limit, in
            the last `zone_m` metres of each lane, ``(4, lanes)``. Empty unless the simulator was
            started with `zone_m`.
        queued_upstream: Vehicles that queue for a lane but are not in `vehicles`: they halt on
            roads upstream of it, up to the light before, or wait to enter the network,
            ``(lanes,)``; see `ugat_marl.simulation.upstream`. Empty unless the simulator was
            started with `turns`. Detectors of a street do not know it.
        detected: Vehicles, halting vehicles, mean speed and waiting times with those that block a
            lane, as detectors see them, ``(4, lanes)``. Empty while no vehicle blocks a lane.
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
    queued_upstream: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    detected: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @classmethod
    def idle(cls, lanes: int) -> Snapshot:
        """Return the snapshot of a network without vehicles; lanes have a mean speed of 1 m/s."""
        zeros = np.zeros(lanes)
        return cls(0.0, zeros, zeros, np.ones(lanes), zeros, 0, 0, queued_upstream=zeros)

    def with_blockers(self) -> Snapshot:
        """Return this snapshot with the vehicles that block a lane, as detectors see them."""
        if not self.detected.size:
            return self
        vehicles, halting, speed_mps, waiting_s = self.detected
        return replace(
            self,
            vehicles=vehicles,
            halting=halting,
            mean_speed_mps=speed_mps,
            waiting_s=waiting_s if self.waiting_s.size else self.waiting_s,
            detected=np.empty(0),
        )

    def less(self, left: NDArray[np.float64]) -> Snapshot:
        """Return this snapshot without the vehicles that have `left`, ``(lanes,)``."""
        halting = np.maximum(self.halting - left, 0.0)
        return replace(self, vehicles=self.vehicles - left, halting=halting)


@dataclass(frozen=True)
class Trips:
    """All vehicles due in an episode, finished or not, as SUMO reports them.

    Vehicles that effects add to block a lane are left out.

    Attributes:
        travel_time_s: Time from the scheduled departure to the arrival, or to the end of the
            episode, ``(vehicles,)``. Waiting outside the network counts.
        delay_s: Time loss inside the network plus departure delay, ``(vehicles,)``.
        finished: True if the vehicle arrived, bool ``(vehicles,)``.
        entered: True if the vehicle entered the network, bool ``(vehicles,)``.
        co2_g: CO2 emitted by the vehicle, g, ``(vehicles,)``. This array and the next two are empty
            unless the simulator was started with `persons`.
        persons: Persons in the vehicle, ``(vehicles,)``.
        dangers: Numbers of collisions and of hard brakings in the episode, ``(2,)``.
    """

    travel_time_s: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    finished: NDArray[np.bool_]
    entered: NDArray[np.bool_]
    co2_g: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    persons: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    dangers: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
