"""Measured lanes in SUMO's mesoscopic model, which has neither lanes nor positions.

There an edge is a chain of segments, and a vehicle knows its segment, its route, and for how long
it has been kept from leaving. From these follow the same numbers as lanes have in car following, so
that observations mean the same in both.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError
from ugat_marl.scenarios import edge_of
from ugat_marl.simulation.snapshots import HALTING_MPS


@dataclass(slots=True)
class _Stay:
    """A vehicle in one segment.

    Attributes:
        position_m: Where the segment begins on its edge.
        since_s: Time at which the vehicle got there, about.
        lanes: Positions of the lanes that lead to its next edge.
        lane: Position of the lane it counts on; -1 while that is not known.
    """

    position_m: float
    since_s: float
    lanes: Sequence[int]
    lane: int


@dataclass(slots=True)
class _Road:
    """An edge whose lanes are measured.

    Attributes:
        edge: Its name.
        lanes: Positions of its lanes.
        towards: Following edge to the positions of the lanes that lead there.
        segment_s: Time through a segment at the speed limit.
        last_m: Segments that begin after this are the last one.
        stays: Vehicles that were there at the last measurement.
    """

    edge: str
    lanes: list[int]
    towards: dict[str, list[int]]
    segment_s: float
    last_m: float
    stays: dict[str, _Stay]


class MesoscopicLanes:
    """Measures the lanes of a running mesoscopic simulation, from its single vehicles.

    A vehicle counts on the lane that leads to the next edge of its route; where several do, on the
    one in whose queue SUMO has it, or else on the one with the fewest vehicles. It waits when it
    has been in its segment for longer than that takes at the speed limit: as SUMO counts it, only
    the first of a queue is held up. When it got there is known to within the time
    between two measurements.

    A waiting vehicle halts, except near the stop line while the queue drives off. In car following
    a queue starts at about one vehicle per second and serves one every two seconds: as many
    vehicles move behind the line as have left since the first one was last seen held up.

    A call to SUMO takes longer than everything else here. A vehicle is therefore asked only for
    what may have changed: its route when it enters an edge, its queue when it enters a segment,
    nothing more while it waits in the last one.

    Args:
        api: The module `libsumo`, with a simulation under way.
        lanes: Lanes to measure.
        segment_m: Length of a segment that was asked for.
    """

    def __init__(self, api: Any, lanes: Sequence[str], segment_m: float) -> None:
        self._api = api
        self._count = len(lanes)
        self._index = [int(lane.rpartition("_")[2]) for lane in lanes]
        self._roads: dict[str, _Road] = {}
        for place, lane in enumerate(lanes):
            edge, length = edge_of(lane), api.lane.getLength(lane)
            segments = max(1, math.floor(length / segment_m + 0.5))
            road = self._roads.setdefault(edge, _Road(edge, [], defaultdict(list), 0.0, 0.0, {}))
            road.lanes.append(place)
            for following in {edge_of(link[0]) for link in api.lane.getLinks(lane)}:
                road.towards[following].append(place)
            road.segment_s = length / segments / api.lane.getMaxSpeed(lane)
            road.last_m = length * (1 - 1.5 / segments)
        self._measured_s = -math.inf
        self._left = [0] * self._count  # since the first vehicle of the lane was last held up

    def measure(self, time_s: float, limits: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vehicles, halting ones, mean speed and waiting time of all lanes, ``(4, lanes)``.

        Args:
            time_s: Now.
            limits: Speed of an empty lane, m/s, ``(lanes,)``.
        """
        vehicles, halting, speeds, waits = ([0.0] * self._count for _ in range(4))
        names_on, api = self._api.edge.getLastStepVehicleIDs, self._api.vehicle
        position_m, waiting_s, speed_mps = api.getLanePosition, api.getWaitingTime, api.getSpeed
        passed_s = time_s - self._measured_s
        for road in self._roads.values():
            segment_s, last_m = road.segment_s, road.last_m
            entered_s = time_s - min(passed_s, segment_s) / 2
            before, road.stays = road.stays, {}
            waiting: dict[int, list[float]] = {}
            first: dict[int, str] = {}
            for name in names_on(road.edge):
                stay = before.get(name)
                if stay is None:
                    stay = self._entered(name, road, entered_s)
                    stay.lane = self._lane(name, road, stay, vehicles)
                elif stay.position_m <= last_m and (at_m := position_m(name)) != stay.position_m:
                    stay.position_m, stay.since_s = at_m, entered_s
                    stay.lane = self._lane(name, road, stay, vehicles)
                road.stays[name] = stay
                lane = stay.lane
                vehicles[lane] += 1.0
                first[lane] = name  # SUMO lists queues from their ends
                waited = time_s - stay.since_s - segment_s
                if waited > 0:
                    waiting.setdefault(lane, []).append(waited)
                    continue
                speed = speed_mps(name)
                speeds[lane] += speed
                halting[lane] += speed < HALTING_MPS
                if speed == 0:  # as SUMO has it, whoever it holds up has no speed
                    waits[lane] += waiting_s(name)
            for name, stay in before.items():
                self._left[stay.lane] += name not in road.stays
            for lane, waited_s in waiting.items():
                if waiting_s(first[lane]) > 0:
                    self._left[lane] = 0
                standing = max(len(waited_s) - self._left[lane], 0)
                halting[lane] += standing
                waits[lane] += sum(waited_s[:standing])
                for waited in waited_s[standing:]:
                    speeds[lane] += limits[lane] * segment_s / (segment_s + waited)
        self._measured_s = time_s
        measured = np.array([vehicles, halting, speeds, waits])
        there = measured[0] > 0
        measured[2] = np.where(there, measured[2] / np.maximum(measured[0], 1.0), limits)
        return measured

    def _entered(self, name: str, road: _Road, entered_s: float) -> _Stay:
        route = self._api.vehicle.getRoute(name)
        place = self._api.vehicle.getRouteIndex(name) + 1
        following = route[place] if place < len(route) else ""
        lanes = road.towards.get(following) or road.lanes
        return _Stay(self._api.vehicle.getLanePosition(name), entered_s, lanes, -1)

    def _lane(self, name: str, road: _Road, stay: _Stay, vehicles: Sequence[float]) -> int:
        """Return the lane on which a vehicle counts, given the vehicles counted so far."""
        if len(stay.lanes) == 1:
            return stay.lanes[0]
        # Where an edge has but one successor, SUMO has one queue for all its lanes.
        if len(road.towards) > 1:
            queue = self._api.vehicle.getLaneIndex(name)
            for place in stay.lanes:
                if self._index[place] == queue:
                    return place
        if stay.lane in stay.lanes:
            return stay.lane
        return min(stay.lanes, key=lambda place: vehicles[place])


def refuse_in_queues(scenario: str, **requested: bool) -> None:
    """Refuse what needs positions on lanes.

    Raises:
        OptionError: Crossings, zones or a window are asked for in the mesoscopic model.
    """
    words = {
        "crossings": "when vehicles cross stop lines (crossings, timed grounding)",
        "zone": "who is near a stop line (detection_zone)",
        "gui": 'pictures of vehicles (render_mode "human")',
    }
    for name, wanted in requested.items():
        if wanted:
            raise OptionError(
                f"scenario {scenario!r} runs in SUMO's mesoscopic model, in which vehicles have no "
                f"position on a lane: it cannot tell {words[name]}; leave out queue_model"
            )
