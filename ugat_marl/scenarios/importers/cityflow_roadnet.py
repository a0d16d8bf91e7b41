"""CityFlow's road networks: the content of a ``roadnet.json``, checked value by value."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios.importers.long_files import read_json

Point = tuple[float, float]


@dataclass(frozen=True)
class Road:
    """A carriageway; lane 0 is the lane at the middle of the road.

    Attributes:
        id: Name of the road.
        points: Left border, from one intersection's centre to the other's, m.
        lanes: Width (m) and speed limit (m/s) of every lane.
        start: Intersection at its start.
        end: Intersection at its end.
    """

    id: str
    points: tuple[Point, ...]
    lanes: tuple[tuple[float, float], ...]
    start: str
    end: str


@dataclass(frozen=True)
class RoadLink:
    """A movement: from one road to another over some lanes.

    Attributes:
        start: Road before the intersection.
        end: Road after the intersection.
        lanes: For each way across, the lane on the first and the lane on the second road.
    """

    start: str
    end: str
    lanes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Crossing:
    """An intersection.

    Attributes:
        id: Name of the intersection.
        point: Centre, m.
        width_m: Distance of the stop lines from the centre.
        virtual: True for an end of the network.
        links: Movements.
        phases: Seconds of every light phase, and the indices of the movements that may go.
    """

    id: str
    point: Point
    width_m: float
    virtual: bool
    links: tuple[RoadLink, ...]
    phases: tuple[tuple[float, tuple[int, ...]], ...]


@dataclass(frozen=True)
class Roadnet:
    """All roads and intersections, by their names."""

    roads: Mapping[str, Road]
    crossings: Mapping[str, Crossing]


def read_roadnet(path: Path) -> Roadnet:
    """Read and check a ``roadnet.json``.

    Raises:
        ScenarioError: The file is not a road network, or refers to something that does not exist;
            the message names the line if it can.
    """
    raw, text = read_json(path)
    reader = _Reader(path, text)
    table = reader.table(raw, "the file")
    roads = [reader.road(entry) for entry in reader.items(table, "roads", "the file")]
    net = Roadnet(
        reader.by_name(roads, "road"),
        reader.by_name(
            [reader.crossing(entry) for entry in reader.items(table, "intersections", "the file")],
            "intersection",
        ),
    )
    for road in net.roads.values():
        for end, name in (("startIntersection", road.start), ("endIntersection", road.end)):
            if name not in net.crossings:
                raise reader.error(
                    road.id, f"road {road.id!r}: its {end} {name!r} does not exist; a road leads "
                    "from one intersection to another (ends of the network are virtual ones)"
                )  # fmt: skip
    for crossing in net.crossings.values():
        _check_links(crossing, net, reader)
    return net


def _check_links(crossing: Crossing, net: Roadnet, reader: _Reader) -> None:
    where = f"intersection {crossing.id!r}"
    for number, link in enumerate(crossing.links):
        for name, end in ((link.start, "startRoad"), (link.end, "endRoad")):
            if name not in net.roads:
                raise reader.error(
                    crossing.id, f"{where}: roadLink {number}: {end} {name!r} does not exist"
                )
        start, end = net.roads[link.start], net.roads[link.end]
        if start.end != crossing.id or end.start != crossing.id:
            raise reader.error(
                crossing.id, f"{where}: roadLink {number} leads from {link.start!r} to "
                f"{link.end!r}, which do not meet there"
            )  # fmt: skip
        for a, b in link.lanes:
            if a >= len(start.lanes) or b >= len(end.lanes):
                raise reader.error(
                    crossing.id, f"{where}: roadLink {number} names lane {a} of {link.start!r} "
                    f"({len(start.lanes)} lanes) and lane {b} of {link.end!r} "
                    f"({len(end.lanes)} lanes), counted from 0"
                )  # fmt: skip
    for number, (_, available) in enumerate(crossing.phases):
        for index in available:
            if index >= len(crossing.links):
                raise reader.error(
                    crossing.id, f"{where}: light phase {number} names road link {index}, but "
                    f"there are {len(crossing.links)}, counted from 0"
                )  # fmt: skip


class _Reader:
    """Reader of a parsed file. A missing value, or a value of another type, is an error."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._text = text

    def error(self, name: str, complaint: str) -> ScenarioError:
        """Return an error with the line where an object of this name is defined."""
        place = max(self._text.find(f'"id": "{name}"'), self._text.find(f'"id":"{name}"'))
        line = f", line {self._text.count(chr(10), 0, place) + 1}" if place >= 0 else ""
        return ScenarioError(f"{self._path}{line}: {complaint}")

    def by_name(self, items: Sequence[Any], kind: str) -> dict[str, Any]:
        named: dict[str, Any] = {}
        for entry in items:
            if entry.id in named:
                raise self.error(entry.id, f"two {kind}s are called {entry.id!r}")
            named[entry.id] = entry
        return named

    def road(self, raw: Any) -> Road:
        table = self.table(raw, "a road")
        name = self._name(table, "id", "a road")
        where = f"road {name!r}"
        points = tuple(
            self._point(point, name, where) for point in self.items(table, "points", where)
        )
        lanes = tuple(
            (
                self._number(lane, "width", name, where, least=0.1),
                self._number(lane, "maxSpeed", name, where, least=0.1),
            )
            for lane in self.items(table, "lanes", where)
        )
        if len(points) < 2 or not lanes:
            raise self.error(name, f"{where}: needs at least two points and one lane")
        start, end = (
            self._name(table, key, where) for key in ("startIntersection", "endIntersection")
        )
        return Road(name, points, lanes, start, end)

    def crossing(self, raw: Any) -> Crossing:
        table = self.table(raw, "an intersection")
        name = self._name(table, "id", "an intersection")
        where = f"intersection {name!r}"
        light = self.table(table.get("trafficLight") or {}, f"{where}: trafficLight")
        phases = self.items(light, "lightphases", where) if "lightphases" in light else []
        return Crossing(
            name,
            self._point(table.get("point"), name, where),
            self._number(table, "width", name, where) if "width" in table else 0.0,
            bool(table.get("virtual", False)),
            tuple(self._link(link, name, where) for link in self.items(table, "roadLinks", where)),
            tuple(
                (
                    self._number(phase, "time", name, where),
                    tuple(
                        self._index(index, name, f"{where}: availableRoadLinks")
                        for index in self.items(phase, "availableRoadLinks", where)
                    ),
                )
                for phase in phases
            ),
        )

    def _link(self, raw: Any, name: str, where: str) -> RoadLink:
        link_table = self.table(raw, f"{where}: a roadLink")
        lanes: list[tuple[int, int]] = []
        for lane in self.items(link_table, "laneLinks", f"{where}: a roadLink"):
            table = self.table(lane, f"{where}: a laneLink")
            ends = (table.get("startLaneIndex"), table.get("endLaneIndex"))
            a, b = (self._index(end, name, f"{where}: a laneLink") for end in ends)
            lanes.append((a, b))
        start, end = (self._name(link_table, key, where) for key in ("startRoad", "endRoad"))
        return RoadLink(start, end, tuple(dict.fromkeys(lanes)))

    def table(self, raw: Any, where: str) -> dict[str, Any]:
        if not isinstance(raw, dict):
            raise ScenarioError(f"{self._path}: {where} is {raw!r:.60}, not an object in braces")
        return raw

    def items(self, raw: Any, key: str, where: str) -> list[Any]:
        entries = self.table(raw, where).get(key)
        if not isinstance(entries, list):
            raise ScenarioError(f"{self._path}: {where}: {key!r} is missing or not a list")
        return entries

    def _name(self, table: Mapping[str, Any], key: str, where: str) -> str:
        name = table.get(key)
        if not isinstance(name, str) or not name:
            raise ScenarioError(f"{self._path}: {where}: {key!r} is missing or not a name")
        return name

    def _point(self, raw: Any, name: str, where: str) -> Point:
        table = self.table(raw, f"{where}: a point")
        x, y = (self._number(table, key, name, where, least=-math.inf) for key in ("x", "y"))
        return x, y

    def _number(self, raw: Any, key: str, name: str, where: str, *, least: float = 0.0) -> float:
        value = self.table(raw, where).get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(name, f"{where}: {key!r} is missing or not a number")
        if not math.isfinite(value) or value < least:
            raise self.error(name, f"{where}: {key} = {value} must be at least {least:g}")
        return float(value)

    def _index(self, raw: Any, name: str, where: str) -> int:
        if isinstance(raw, bool) or not isinstance(raw, int) or raw < 0:
            raise self.error(name, f"{where}: {raw!r} is not a number counted from 0")
        return raw
