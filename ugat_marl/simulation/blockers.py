"""Vehicles that effects add to block lanes. They are no part of the traffic that is measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import UpstreamLanes
from ugat_marl.simulation.snapshots import HALTING_MPS

_Floats = NDArray[np.float64]


class Blockers:
    """Vehicles of a running simulation that block lanes for effects.

    SUMO is asked about those that are due and have not vanished, one by one.

    Args:
        api: The module `libsumo`, with a running simulation.
        lanes: Measured lanes.
        behind: Lanes and roads that are counted with short lanes.
        vehicles: Ids of the vehicles, each with its departure in s.

    Attributes:
        departed: Number of them that had entered the network at the last look.
        waiting: Those that found no space to enter the network.
        standing: Those on the roads.
    """

    def __init__(
        self,
        api: Any,
        lanes: Sequence[str],
        behind: UpstreamLanes,
        vehicles: Sequence[tuple[str, float]],
    ) -> None:
        self._api = api
        self._later = sorted(vehicles, key=lambda vehicle: vehicle[1], reverse=True)
        self._number = len(vehicles)
        self._due: list[str] = []
        self._on_lane = {lane: [(place, 1.0)] for place, lane in enumerate(lanes)}
        for lane, counted in _places(behind.lanes).items():
            self._on_lane.setdefault(lane, []).extend(counted)
        self._outside = _places(behind.roads)
        self.departed = 0
        self.waiting: list[str] = []
        self.standing: list[str] = []

    def look(self, time_s: float) -> None:
        """Look where the vehicles are at this time, which is later than at the last call."""
        while self._later and self._later[-1][1] < time_s:
            self._due.append(self._later.pop()[0])
        outside: list[str] = []
        self.standing = []
        for name in self._due:
            try:
                entered = self._api.vehicle.getDeparture(name) >= 0
            except self._api.TraCIException:  # it has vanished
                continue
            (self.standing if entered else outside).append(name)
        self.departed = self._number - len(self._later) - len(outside)
        pending = self._api.simulation.getPendingVehicles() if outside else ()
        self.waiting = [name for name in outside if name in pending]
        self._due = self.standing + outside

    def leave_out(
        self, measured: tuple[_Floats, _Floats, _Floats, _Floats], limits_mps: _Floats
    ) -> None:
        """Take the vehicles out of the measured lanes.

        Args:
            measured: Vehicles, halting vehicles, mean speed in m/s and waiting times in s (may be
                empty) per lane, each ``(lanes,)``; changed in place.
            limits_mps: Speed of an empty lane, ``(lanes,)``.
        """
        vehicles, halting, speed_mps, waiting_s = measured
        for places, number, halted, speeds, waited_s in self._counted():
            for place, share in places:
                others = vehicles[place] - share * number
                if others > 1e-9:  # of shares, a rounding error may be left of nobody
                    total = speed_mps[place] * vehicles[place] - share * speeds
                    vehicles[place], speed_mps[place] = others, max(total, 0.0) / others
                else:
                    vehicles[place], speed_mps[place] = 0.0, limits_mps[place]
                halting[place] = max(halting[place] - share * halted, 0.0)
                if waiting_s.size:
                    waiting_s[place] = max(waiting_s[place] - share * waited_s, 0.0)

    def _counted(self) -> Iterator[tuple[Sequence[tuple[int, float]], int, int, float, float]]:
        """Yield, for each place of some of the vehicles, what they add to lanes.

        That is where they are counted, their number, how many halt, what they add to the sum of
        the speeds, and their waiting times in s.
        """
        ask, roads = self._api.vehicle, self._api.lane
        for lane in dict.fromkeys(map(ask.getLaneID, self.standing)):
            names = roads.getLastStepVehicleIDs(lane)
            own = [name for name in names if name in self.standing]
            halted = sum(ask.getSpeed(name) < HALTING_MPS for name in own)
            # SUMO's mean may leave out vehicles at a stop
            others = sum(ask.getSpeed(name) for name in names if name not in self.standing)
            speeds = roads.getLastStepMeanSpeed(lane) * len(names) - others
            waited_s = sum(map(ask.getWaitingTime, own))
            yield self._on_lane.get(lane, ()), len(own), halted, speeds, waited_s
        for name in self.waiting:
            places = self._outside.get(ask.getRoute(name)[0], ())
            yield places, 1, 1, 0.0, ask.getDepartDelay(name)


def _places(shares: Sequence[Sequence[tuple[str, float]]]) -> dict[str, list[tuple[int, float]]]:
    """Return the positions of the lanes with which a lane or road is counted, and its shares."""
    places: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for place, of_lane in enumerate(shares):
        for name, share in of_lane:
            places[name].append((place, share))
    return dict(places)
