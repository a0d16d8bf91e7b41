"""Lane measurements in SUMO's mesoscopic model, which has no lanes and no positions on them.

In that model an edge is a chain of segments. A vehicle knows its segment, its route and the time it
has been held up. This file derives the lane numbers of car following from them, so observations
mean the same in both models.
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
from ugat_marl.scenarios import NO_UPSTREAM_LANES, Scenario, UpstreamLanes, edge_of_lane
from ugat_marl.simulation.snapshots import HALTING_MPS


@dataclass(slots=True)
class _Stay:
    """A vehicle in one segment.

    Attributes:
        position_m: Start of the segment on its edge.
        since_s: Estimated time at which the vehicle entered the segment.
        drive_s: Time in which the vehicle drives through a segment, by its limit and its own speed.
        lanes: Indices of the lanes that lead to the vehicle's next edge.
        lane: Index of the lane on which the vehicle counts; -1 if not known yet.
    """

    position_m: float
    since_s: float
    drive_s: float
    lanes: Sequence[int]
    lane: int


@dataclass(slots=True)
class _Road:
    """An edge whose lanes are measured.

    Attributes:
        edge: Name of the edge.
        lanes: Indices of its lanes.
        towards: Following edge to the indices of the lanes that lead there.
        segment_m: Length of a segment.
        last_m: A segment that begins after this position is the last one; -1 if there is only one.
        stays: Vehicles on the edge at the last measurement.
    """

    edge: str
    lanes: list[int]
    towards: dict[str, list[int]]
    segment_m: float
    last_m: float
    stays: dict[str, _Stay]


class MesoscopicLanes:
    """Lane measurements of a running mesoscopic simulation, from its single vehicles.

    A vehicle counts on the lane that leads to the next edge of its route. If several lanes do, it
    counts on the lane of its queue in SUMO, or else on the lane with the fewest vehicles.

    A vehicle waits if it has been in its segment for longer than its drive through it takes, by the
    limit and its own speed. SUMO's own waiting time covers only the first vehicle of a queue. The
    time of entry lies between two measurements and is estimated.

    A waiting vehicle halts, unless the queue drives off and the vehicle is near the stop line. In
    car following, about one vehicle per second starts and one leaves every two seconds. So as many
    vehicles move upstream of the line as have left since the first one was last held up.

    Calls to SUMO take most of the time. A vehicle is therefore asked only for values that may have
    changed: the name of its route when it enters an edge on which lanes differ, its queue when it
    enters a segment, and nothing while it waits in the last segment. The edges of a route are asked
    for once.

    Args:
        api: The module `libsumo`, with a running simulation.
        lanes: Lanes to measure.
        segment_m: Requested length of a segment.
        behind: Lanes counted with short lanes.

    Attributes:
        standing: Vehicles that halted at the last measurement, each with its lane.
    """

    def __init__(
        self,
        api: Any,
        lanes: Sequence[str],
        segment_m: float,
        behind: UpstreamLanes = NO_UPSTREAM_LANES,
    ) -> None:
        self._api = api
        further = _further_lanes(api, lanes, behind)
        self._further_limits = [api.lane.getMaxSpeed(lane) for lane in further]
        self._shares = _share_matrix(lanes, further, behind) if any(behind.lanes) else None
        lanes = self._lanes = [*lanes, *further]
        self._count = len(lanes)
        self._index = [int(lane.rpartition("_")[2]) for lane in lanes]
        self._roads: dict[str, _Road] = {}
        for place, lane in enumerate(lanes):
            edge, length = edge_of_lane(lane), api.lane.getLength(lane)
            segments = max(1, math.floor(length / segment_m + 0.5))
            road = self._roads.setdefault(edge, _Road(edge, [], defaultdict(list), 0.0, 0.0, {}))
            road.lanes.append(place)
            for following in {edge_of_lane(link[0]) for link in api.lane.getLinks(lane)}:
                road.towards[following].append(place)
            road.segment_m = length / segments
            road.last_m = length * (1 - 1.5 / segments) if segments > 1 else -1.0
        self._routes: dict[str, Sequence[str]] = {}  # a vehicle's new route has a new name
        self.standing: dict[str, str] = {}
        self._measured_s = -math.inf
        self._left = [0] * self._count  # since the first vehicle of the lane was last held up

    def measure(self, time_s: float, limits: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vehicles, halting vehicles, mean speed (m/s) and waiting time (s), ``(4, lanes)``.

        Args:
            time_s: Current time of the simulation.
            limits: Speed of an empty lane, m/s, ``(lanes,)``.
        """
        vehicles, halting, speeds, waits = ([0.0] * self._count for _ in range(4))
        limits_mps = np.append(limits, self._further_limits)
        names_on, api = self._api.edge.getLastStepVehicleIDs, self._api.vehicle
        position_m, waiting_s, speed_mps = api.getLanePosition, api.getWaitingTime, api.getSpeed
        passed_s = time_s - self._measured_s
        self.standing = {}
        for road in self._roads.values():
            names, before = names_on(road.edge), road.stays
            if not names and not before:
                continue
            last_m = road.last_m
            stays: dict[str, _Stay] = {}
            road.stays = stays
            waiting: dict[int, list[tuple[str, float, float]]] = {}
            first: dict[int, str] = {}
            for name in names:
                stay = before.get(name)
                if stay is None:
                    stay = self._entered(name, road, time_s, passed_s)
                    stay.lane = self._lane(name, road, stay, vehicles)
                elif stay.position_m <= last_m and (at_m := position_m(name)) != stay.position_m:
                    stay.position_m = at_m
                    stay.since_s = time_s - min(passed_s, stay.drive_s) / 2
                    stay.lane = self._lane(name, road, stay, vehicles)
                stays[name] = stay
                lane = stay.lane
                vehicles[lane] += 1.0
                first[lane] = name  # SUMO lists queues from their ends
                waited = time_s - stay.since_s - stay.drive_s
                if waited > 0:
                    waiting.setdefault(lane, []).append((name, waited, stay.drive_s))
                    continue
                speed = speed_mps(name)
                speeds[lane] += speed
                if speed < HALTING_MPS:
                    halting[lane] += 1.0
                    self.standing[name] = self._lanes[lane]
                if speed == 0:  # SUMO gives speed 0 to vehicles it holds up
                    waits[lane] += waiting_s(name)
            for name, stay in before.items():
                self._left[stay.lane] += name not in stays
            for lane, held_up in waiting.items():
                if waiting_s(first[lane]) > 0:
                    self._left[lane] = 0
                standing = held_up[: max(len(held_up) - self._left[lane], 0)]
                halting[lane] += len(standing)
                waits[lane] += sum(waited for _, waited, _ in standing)
                self.standing |= {name: self._lanes[lane] for name, _, _ in standing}
                speeds[lane] += _sum_of_speeds(held_up[len(standing) :], limits_mps[lane])
        self._measured_s = time_s
        return self._with_means(np.array([vehicles, halting, speeds, waits]), limits)

    def _with_means(
        self, sums: NDArray[np.float64], limits: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the result of `measure`, given the sums over the vehicles of each lane."""
        measured = sums if self._shares is None else sums @ self._shares
        there = measured[0] > 0
        measured[2] = np.where(there, measured[2] / np.where(there, measured[0], 1.0), limits)
        return measured

    def _entered(self, name: str, road: _Road, time_s: float, passed_s: float) -> _Stay:
        lanes = road.lanes
        if road.towards and len(lanes) > 1:
            lanes = road.towards.get(self._following(name, road.edge)) or lanes
        position_m = self._api.vehicle.getLanePosition(name) if road.last_m >= 0 else 0.0
        # a speed sign may forbid to drive at all
        drive_s = road.segment_m / max(self._api.vehicle.getAllowedSpeed(name), HALTING_MPS)
        return _Stay(position_m, time_s - min(passed_s, drive_s) / 2, drive_s, lanes, -1)

    def _following(self, name: str, edge: str) -> str:
        """Return the edge behind `edge` on a vehicle's route; empty if it ends there.

        It is also empty inside of a junction, where all lanes of an edge lead to the same one.
        """
        if edge.startswith(":"):
            return ""
        number: str = self._api.vehicle.getRouteID(name)
        route = self._routes.get(number)
        if route is None:
            route = self._routes[number] = self._api.vehicle.getRoute(name)
        place: int = route.index(edge)
        if route.count(edge) > 1:  # a route that comes back
            place = self._api.vehicle.getRouteIndex(name)
        return "" if place + 1 == len(route) else route[place + 1]

    def _lane(self, name: str, road: _Road, stay: _Stay, vehicles: Sequence[float]) -> int:
        """Return the lane on which a vehicle counts, given the vehicles counted so far."""
        if len(stay.lanes) == 1:
            return stay.lanes[0]
        # If an edge has only one successor, SUMO has one queue for all its lanes.
        if len(road.towards) > 1:
            queue = self._api.vehicle.getLaneIndex(name)
            for place in stay.lanes:
                if self._index[place] == queue:
                    return place
        if stay.lane in stay.lanes:
            return stay.lane
        return min(stay.lanes, key=lambda place: vehicles[place])


def _further_lanes(api: Any, lanes: Sequence[str], behind: UpstreamLanes) -> list[str]:
    """Return the lanes of the roads behind short lanes that are not among the measured lanes."""
    roads = dict.fromkeys(edge_of_lane(name) for counted in behind.lanes for name, _ in counted)
    every = (f"{road}_{number}" for road in roads for number in range(api.edge.getLaneNumber(road)))
    return [lane for lane in every if lane not in lanes]


def _share_matrix(
    lanes: Sequence[str], further: Sequence[str], behind: UpstreamLanes
) -> NDArray[np.float64]:
    """Return the share of each lane that counts with a measured one, ``(all lanes, lanes)``."""
    shares = np.eye(len(lanes) + len(further), len(lanes))
    places = {lane: place for place, lane in enumerate([*lanes, *further])}
    for column, counted in enumerate(behind.lanes):
        for name, share in counted:
            shares[places[name], column] = share
    return shares


def _sum_of_speeds(held_up: Sequence[tuple[str, float, float]], limit_mps: float) -> float:
    """Return the mean speeds in their segment of vehicles that move again, added up, m/s."""
    return sum(limit_mps * drive_s / (drive_s + waited) for _, waited, drive_s in held_up)


def refuse_in_queues(scenario: Scenario, **requested: bool) -> None:
    """Refuse options that need positions on lanes if a scenario has SUMO's mesoscopic model.

    Args:
        scenario: The scenario.
        requested: ``crossings``, ``zone``, ``pictures`` and ``detectors``: True if requested.

    Raises:
        OptionError: One of them is requested.
    """
    words = {
        "crossings": "when vehicles cross stop lines (crossings, timed grounding)",
        "zone": "who is near a stop line (detection_zone)",
        "pictures": "pictures of vehicles (render_mode, films)",
        "detectors": "who comes over a detector (record)",
    }
    for name, wanted in requested.items():
        if wanted and scenario.settings.is_mesoscopic:
            raise OptionError(
                f"scenario {scenario.id!r} runs in SUMO's mesoscopic model, in which vehicles have "
                f"no position on a lane: it cannot tell {words[name]}; leave out queue_model"
            )
