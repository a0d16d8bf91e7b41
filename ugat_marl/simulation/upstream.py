"""Queues upstream of the measured lanes, and vehicles that wait to enter the network.

A queue that is longer than the lane at the light goes on upstream: on roads that end at a node
without a light, and outside the network, where SUMO holds vehicles that are due but find no space.
Each of these vehicles belongs to the next agent's light on its route.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Turns, UpstreamLanes, edge_of_lane
from ugat_marl.simulation.mesoscopic import MesoscopicLanes
from ugat_marl.simulation.snapshots import HALTING_MPS

_Place = tuple[str, tuple[int, ...]]
"""Road on which a vehicle was last seen ("" outside), and the lanes of its next light."""


class UpstreamQueues:
    """Vehicles of a running simulation that queue for a lane without being on it.

    These are vehicles that halt on a road that does not end at an agent's light, and vehicles that
    wait to enter the network. A vehicle counts on the lanes that lead across the next agent's light
    of its route, in equal parts. Vehicles whose route meets no such light any more do not count,
    nor do vehicles that stand inside a junction. What short lanes with a reach count already is
    left out.

    SUMO is asked one question for each such road, and further ones only about roads with a queue.
    While vehicles wait to enter the network, it is asked who is due on each road.
    Roads from which no such light can be reached are left out. The routes of vehicles are asked for
    once on each road.

    Args:
        api: The module `libsumo`, with a running simulation.
        lanes: Measured lanes.
        turns: Ways across the agents' lights.
        behind: Lanes and roads that are counted with short lanes.
        segment_m: Requested length of a segment of the mesoscopic model, m; 0 without it.
    """

    def __init__(
        self,
        api: Any,
        lanes: Sequence[str],
        turns: Turns,
        behind: UpstreamLanes,
        segment_m: float = 0.0,
    ) -> None:
        self._api = api
        self._count = len(lanes)
        self._turns = {(start, end): places for start, end, places in turns}
        at_lights = dict.fromkeys(start for start, _, _ in turns)
        self._roads = _roads_before(api, at_lights)
        self._entries = [*at_lights, *self._roads]
        self._queues: MesoscopicLanes | None = None
        if segment_m:
            every = [f"{road}_{n}" for road in self._roads for n in range(_width(api, road))]
            self._queues = MesoscopicLanes(api, every, segment_m)
            self._limits = np.ones(len(every))  # no speed is used
        self._on_lane = _shares(behind.lanes)
        self._outside = _shares(behind.roads)
        self._known: dict[str, _Place] = {}

    def measure(self, backlog: int) -> NDArray[np.float64]:
        """Return the vehicles that queue upstream of each lane, ``(lanes,)``.

        Args:
            backlog: Number of vehicles that wait to enter the network; with 0 SUMO is not asked
                about them.
        """
        queued = np.zeros(self._count)
        known, self._known = self._known, {}
        for name, road, lane in self._halting():
            self._add(queued, name, road, 1.0 - self._on_lane.get(lane, 0.0), known)
        for name, road in self._due() if backlog else ():
            self._add(queued, name, road, 1.0 - self._outside.get(road, 0.0), known, outside=True)
        return queued

    def _due(self) -> Iterator[tuple[str, str]]:
        """Yield the vehicles that wait to enter the network, and the roads on which they are due.

        That is not always the first road of a route (``departEdge``).
        """
        due = self._api.edge.getPendingVehicles
        roads = {name: road for road in self._entries for name in due(road)}
        for name in self._api.simulation.getPendingVehicles():
            if name in roads:
                yield name, roads[name]

    def _halting(self) -> Iterator[tuple[str, str, str]]:
        """Yield the vehicles that halt, their roads, and their lanes if some are counted there."""
        if self._queues is not None:
            self._queues.measure(self._api.simulation.getTime(), self._limits)
            for name, lane in self._queues.standing.items():
                yield name, edge_of_lane(lane), lane
            return
        roads, vehicles = self._api.edge, self._api.vehicle
        for road in self._roads:
            if roads.getLastStepHaltingNumber(road):
                for name in roads.getLastStepVehicleIDs(road):
                    if vehicles.getSpeed(name) < HALTING_MPS:
                        yield name, road, vehicles.getLaneID(name) if self._on_lane else ""

    def _add(
        self,
        queued: NDArray[np.float64],
        name: str,
        road: str,
        weight: float,
        known: dict[str, _Place],
        *,
        outside: bool = False,
    ) -> None:
        """Add a vehicle to the lanes of its next light."""
        place, where = known.get(name), "" if outside else road
        if place is None or place[0] != where:
            place = where, self._next_lanes(name, road)
        self._known[name] = place
        for lane in place[1]:
            queued[lane] += weight / len(place[1])

    def _next_lanes(self, name: str, road: str) -> tuple[int, ...]:
        """Return the lanes that lead across the next agent's light of a vehicle's route."""
        route = self._api.vehicle.getRoute(name)
        at = self._api.vehicle.getRouteIndex(name)
        if at < 0:  # it has not entered the network
            at = route.index(road)
        for turn in zip(route[at:], route[at + 1 :], strict=False):
            if turn in self._turns:
                return self._turns[turn]
        return ()


def _roads_before(api: Any, at_lights: Collection[str]) -> list[str]:
    """Return the roads from which a vehicle can reach a road at an agent's light, in SUMO's order.

    Roads at the lights are not among them.
    """
    roads = [x for x in api.edge.getIDList() if not x.startswith(":") and x not in at_lights]
    into: dict[str, set[str]] = defaultdict(set)
    for road in roads:
        for number in range(_width(api, road)):
            for link in api.lane.getLinks(f"{road}_{number}"):
                into[edge_of_lane(link[0])].add(road)
    reached, left = set(at_lights), list(at_lights)
    while left:
        new = into[left.pop()] - reached
        reached |= new
        left += new
    return [road for road in roads if road in reached]


def _width(api: Any, road: str) -> int:
    return api.edge.getLaneNumber(road)


def _shares(counted: Sequence[Sequence[tuple[str, float]]]) -> dict[str, float]:
    """Return the share of the vehicles of each lane or road that short lanes count, at most 1."""
    shares: dict[str, float] = defaultdict(float)
    for of_lane in counted:
        for name, share in of_lane:
            shares[name] = min(1.0, shares[name] + share)
    return dict(shares)
