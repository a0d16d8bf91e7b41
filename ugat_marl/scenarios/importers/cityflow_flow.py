"""CityFlow's vehicles as a SUMO route file: the same ways, departures, sizes and speeds."""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from ugat_marl.errors import ScenarioError
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.cityflow import Roadnet
from ugat_marl.scenarios.importers.reading import objects
from ugat_marl.scenarios.importers.walks import MOST_VEHICLES, Drive, write_drives

_VEHICLE = ("length", "width", "maxPosAcc", "maxNegAcc", "usualPosAcc", "usualNegAcc", "minGap",
            "maxSpeed", "headwayTime")  # fmt: skip


@dataclass(frozen=True)
class Flows:
    """What was written.

    Attributes:
        vehicles: How many.
        last_s: When the last one departs.
    """

    vehicles: int
    last_s: float


def write_routes(
    path: Path,
    net: Roadnet,
    out: Path,
    duration_s: float | None,
    reporter: Reporter,
    *,
    exact: bool,
) -> Flows:
    """Turns a ``flow.json`` into a route file.

    Vehicles keep their size, gap, accelerations and speed. How they follow each other is SUMO's
    unless `exact` is set: the headway of 1 s and the chance in driving that its models are tuned
    for, as in the SUMO forms that CityFlow's data sets come with.

    Args:
        path: The flows.
        net: The roads they use.
        out: The file to write.
        duration_s: End of the episode, for flows without an end; None for an hour.
        reporter: Shows progress in a long file.
        exact: Whether headways are CityFlow's too, and nothing is left to chance.

    Raises:
        ScenarioError: Not a list of flows, or one that cannot be driven; with the line.
    """
    ways = _Ways(net)
    types: dict[str, dict[str, str]] = {}
    drives: list[Drive] = []
    for number, (flow, line) in enumerate(objects(path, reporter)):
        where = f"{path}, line {line}: flow {number}"
        kind = types.setdefault(json.dumps(flow.get("vehicle"), sort_keys=True), {})
        if not kind:
            kind |= _vehicle_type(flow.get("vehicle"), f"car{len(types)}", where, exact=exact)
        route = ways.through(flow.get("route"), where)
        for i, depart_s in enumerate(_departures(flow, duration_s or 3600.0, where)):
            drives.append(Drive(f"{number}.{i}", depart_s, route, kind["id"], "0"))
        if len(drives) > MOST_VEHICLES:
            raise ScenarioError(f"{where}: more than {MOST_VEHICLES} vehicles")
    if not drives:
        raise ScenarioError(f"{path}: no vehicle in it")
    drives.sort(key=lambda drive: drive.depart_s)  # stable: as in the file within a second
    write_drives(out, drives, types.values())
    return Flows(len(drives), drives[-1].depart_s)


def _departures(flow: Mapping[str, Any], end_s: float, where: str) -> Iterator[float]:
    """From ``startTime`` to ``endTime``, both included, every ``interval``; -1 is the end."""
    start, end, interval = (
        _number(flow, key, where, least=least)
        for key, least in (("startTime", 0.0), ("endTime", -1.0), ("interval", 0.0))
    )
    last = end_s if end < 0 else end
    if end >= 0 and last < start:
        raise ScenarioError(f"{where}: endTime ({end:g}) is before startTime ({start:g})")
    if last > start and interval <= 0:
        raise ScenarioError(f"{where}: interval = {interval:g} must be above 0")
    steps = (last - start) / interval if last > start else 0.0
    count = max(1, math.ceil(steps - 1e-9)) if end < 0 else 1 + int(steps + 1e-9)
    if count > MOST_VEHICLES:
        raise ScenarioError(f"{where}: more than {MOST_VEHICLES} vehicles")
    for i in range(count):
        yield start + i * interval


def _vehicle_type(raw: Any, name: str, where: str, *, exact: bool) -> dict[str, str]:
    """Attributes of a SUMO vehicle type for CityFlow's vehicle."""
    if not isinstance(raw, dict):
        raise ScenarioError(f"{where}: 'vehicle' is missing or not an object in braces")
    value = {key: _number(raw, key, where, least=0.0) for key in _VEHICLE}
    for key in ("length", "maxPosAcc", "maxNegAcc", "usualPosAcc", "usualNegAcc", "maxSpeed"):
        if value[key] <= 0:
            raise ScenarioError(f"{where}: vehicle: {key} = {value[key]:g} must be above 0")
    kind = {
        "id": name,
        "vClass": "passenger",
        "length": f"{value['length']:g}",
        "width": f"{value['width'] or 1.8:g}",
        "minGap": f"{value['minGap']:g}",
        "accel": f"{value['usualPosAcc']:g}",
        "decel": f"{value['usualNegAcc']:g}",
        "maxSpeed": f"{value['maxSpeed']:g}",
    }
    if exact:
        kind |= {
            "emergencyDecel": f"{max(value['maxNegAcc'], value['usualNegAcc']):g}",
            # CityFlow's gap to the bumper ahead is headway times speed; Krauss adds minGap to it.
            "tau": f"{max(value['headwayTime'] - value['minGap'] / value['maxSpeed'], 0.1):.3g}",
            "sigma": "0",
            "speedFactor": "1",
            "speedDev": "0",
        }
    return kind


def _number(raw: Mapping[str, Any], key: str, where: str, *, least: float) -> float:
    found = raw.get(key)
    if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
        raise ScenarioError(f"{where}: {key!r} is missing or not a number")
    if found < least:
        raise ScenarioError(f"{where}: {key} = {found:g} must be at least {least:g}")
    return float(found)


class _Ways:
    """The roads from anchor to anchor; where they do not touch, the shortest way between them."""

    def __init__(self, net: Roadnet) -> None:
        self._net = net
        self._known: dict[tuple[str, ...], tuple[str, ...]] = {}

    def through(self, raw: Any, where: str) -> tuple[str, ...]:
        """The whole route."""
        if not isinstance(raw, list) or not raw or not all(isinstance(name, str) for name in raw):
            raise ScenarioError(f"{where}: 'route' is missing or not a list of roads")
        anchors = tuple(raw)
        if anchors not in self._known:
            for name in anchors:
                if name not in self._net.roads:
                    raise ScenarioError(f"{where}: road {name!r} does not exist")
            route = [anchors[0]]
            for a, b in pairwise(anchors):
                route += self._between(a, b, where)
            self._known[anchors] = tuple(route)
        return self._known[anchors]

    @cached_property
    def _ahead(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {name: [] for name in self._net.roads}
        for crossing in self._net.crossings.values():
            for link in crossing.links:
                if link.lanes:
                    found[link.start].append(link.end)
        return found

    @cached_property
    def _length_m(self) -> dict[str, float]:
        return {name: _length(road.points) for name, road in self._net.roads.items()}

    def _between(self, start: str, goal: str, where: str) -> list[str]:
        """The roads after `start` up to and with `goal` (Dijkstra)."""
        best = {start: 0.0}
        came: dict[str, str] = {}
        heap = [(0.0, start)]
        while heap:
            length, road = heapq.heappop(heap)
            if length > best[road]:
                continue
            for other in self._ahead[road]:
                total = length + self._length_m[other]
                if total < best.get(other, math.inf):
                    best[other], came[other] = total, road
                    if other == goal:
                        return _back(came, start, goal)
                    heapq.heappush(heap, (total, other))
        raise ScenarioError(f"{where}: no road link leads from {start!r} on to {goal!r}")


def _back(came: Mapping[str, str], start: str, goal: str) -> list[str]:
    route = [goal]
    while came[route[-1]] != start:
        route.append(came[route[-1]])
    return route[::-1]


def _length(points: Sequence[tuple[float, float]]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(points))
