"""Vehicles that leave the roads of the measured lanes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import edge_of_lane

_LONGEST_S = 1.0
"""Longest time between two looks at the lanes."""
_FASTEST = 2.0
"""Largest factor on the speed limit, the limit of SUMO's own vehicle types."""


class Crossings:
    """Vehicles of a running simulation that leave a lane's road, from one look to the next.

    A vehicle that was on a lane and is not on its road any more has left. Whoever parks beside the
    road has not. Nor has whoever ends a trip on a road at a light. Between two looks, a
    vehicle can cross a short lane without being seen on it. Such vehicles are found on the lanes
    beyond: inside the junction, or on the next road.

    Args:
        api: The module `libsumo`, with a running simulation.
        lanes: Measured lanes.
    """

    def __init__(self, api: Any, lanes: Sequence[str]) -> None:
        self._api = api
        self._lanes = lanes
        self._roads = [edge_of_lane(lane) for lane in lanes]
        self._on: list[tuple[str, ...]] = []
        self._at_lights = {
            edge_of_lane(lane)
            for light in api.trafficlight.getIDList()
            for lane in api.trafficlight.getControlledLanes(light)
        }
        short = {
            edge_of_lane(lane)
            for lane in lanes
            if api.lane.getLength(lane) < api.lane.getMaxSpeed(lane) * _FASTEST * _LONGEST_S
        }
        places = {lane: place for place, lane in enumerate(lanes)}
        self._beyond = {road: _beyond(api, road, places) for road in sorted(short)}
        self._near: dict[str, set[str]] = {}
        self._last: dict[str, str] = {}  # last road of the route of vehicles on roads at lights

    def add_to(self, left: NDArray[np.float64]) -> None:
        """Add to `left`, ``(lanes,)``, the vehicles that left a lane's road since the last call."""
        api = self._api
        now = [api.lane.getLastStepVehicleIDs(lane) for lane in self._lanes]
        before, self._on = self._on, now
        gone: dict[str, int] = {}
        for index, (earlier, later) in enumerate(zip(before, now, strict=False)):
            if earlier != later:  # the same in most seconds
                gone.update(dict.fromkeys(set(earlier).difference(later), index))
                if self._roads[index] in self._at_lights:
                    new = set(later).difference(earlier)
                    self._last.update((name, api.vehicle.getRoute(name)[-1]) for name in new)
        for name, index in gone.items():
            left[index] += self._has_left(name, self._roads[index])
        for road, beyond in self._beyond.items():
            earlier = self._near.get(road, set())
            near = set(api.edge.getLastStepVehicleIDs(road))
            for lane, place in beyond.items():
                names = api.lane.getLastStepVehicleIDs(lane)
                near.update(names)
                if place is not None:
                    new = [name for name in names if name not in earlier]
                    left[place] += sum(self._comes_from(name, road) for name in new)
            # whoever parks beside the next road comes back to it
            near.update(name for name in earlier - near if self._comes_from(name, road))
            self._near[road] = near

    def _has_left(self, name: str, road: str) -> bool:
        """Return True if a vehicle that was on a road has left it, and not only its lane."""
        try:
            where: str = self._api.vehicle.getRoadID(name)  # of one that parks, the road beside it
        except self._api.TraCIException:  # it has left the simulation
            return road not in self._at_lights or self._last.pop(name, road) != road
        return where != road

    def _comes_from(self, name: str, road: str) -> bool:
        """Return True if a vehicle came by a road to the junction after it, or to the next road."""
        ask = self._api.vehicle
        try:
            at = ask.getRouteIndex(name)  # inside a junction, that of the road before
        except self._api.TraCIException:  # it has left the simulation
            return False
        if road not in ask.getRoute(name)[max(at - 1, 0) : at + 1]:
            return False
        return ask.getDistance(name) > ask.getLanePosition(name)  # else it departed on its lane


def _beyond(api: Any, road: str, places: dict[str, int]) -> dict[str, int | None]:
    """Return the lanes after a road, each with the position of the measured lane that leads to it.

    Args:
        api: The module `libsumo`.
        road: The road.
        places: Positions of the measured lanes; None stands for the others.
    """
    beyond: dict[str, int | None] = {}
    beside: dict[str, int | None] = {}
    for number in range(api.edge.getLaneNumber(road)):
        lane = f"{road}_{number}"
        place = places.get(lane)
        for link in api.lane.getLinks(lane):
            ahead, inside = link[0], link[4]
            beyond.setdefault(ahead, place)
            while inside:
                beyond[inside] = place
                inside = next((further[4] for further in api.lane.getLinks(inside)), "")
            after = edge_of_lane(ahead)
            for other in range(api.edge.getLaneNumber(after)):
                beside.setdefault(f"{after}_{other}", place)
    return beside | beyond
