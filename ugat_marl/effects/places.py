"""Places of a network for effects: edges, lanes, traffic lights, and their connections."""

from __future__ import annotations

import functools
import heapq
import math
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from ugat_marl.errors import UnknownNameError
from ugat_marl.files import parse_xml
from ugat_marl.scenarios import (
    Scenario,
    cars_may_use,
    end_lane,
    rail_signals_of,
    start_lane,
    turns_around,
)


@dataclass(frozen=True)
class LanePlace:
    """A lane: its edge, index, length in m, speed limit in m/s, and permission for cars."""

    edge: str
    index: int
    length_m: float
    speed_mps: float
    cars: bool


@dataclass(frozen=True)
class Places:
    """Lanes, edges and traffic lights of a network, without the inside of junctions.

    Attributes:
        lanes: Lanes by id.
        edges: Edge to its lanes, from right to left.
        following: Edge to the edges that a car can reach next.
        exits: Edges from which a car can only turn around, if anything.
        lights: Ids of the traffic lights.
        ends: Lane to the traffic light it leads to.
        begins: Lane to the traffic light it comes from.
    """

    lanes: Mapping[str, LanePlace]
    edges: Mapping[str, tuple[str, ...]]
    following: Mapping[str, tuple[str, ...]]
    exits: frozenset[str]
    lights: Collection[str]
    ends: Mapping[str, str]
    begins: Mapping[str, str]

    def check(self, effect: str, kind: str, name: str, known: Collection[str]) -> None:
        """Refuse a place that does not exist.

        Raises:
            UnknownNameError: `name` is not among `known`.
        """
        if name not in known:
            hint = f"Effect {effect!r} names it."
            raise UnknownNameError(kind, name, known, hint)

    def seconds(self, edge: str) -> float:
        """Return the time to drive along an edge at its limit, in s."""
        lanes = [self.lanes[lane] for lane in self.edges[edge]]
        fastest = max(lane.speed_mps for lane in lanes)
        return lanes[0].length_m / max(fastest, 0.1)

    def path(self, start: str, end: str) -> tuple[str, ...] | None:
        """Return the fastest way over empty streets, both edges included; None if there is none."""
        if start not in self.edges or end not in self.edges:
            return None
        return self.ways(start).get(end)

    @functools.lru_cache(maxsize=4096)  # noqa: B019 - instances are few and live long
    def ways(self, start: str) -> dict[str, tuple[str, ...]]:
        """Return every edge that can be reached from `start`, with the fastest way there."""
        before: dict[str, str] = {}
        best = {start: 0.0}
        done: set[str] = set()
        queue = [(0.0, start)]
        while queue:
            cost, edge = heapq.heappop(queue)
            if edge in done:
                continue
            done.add(edge)
            for other in self.following.get(edge, ()):
                reached = cost + self.seconds(other)
                if reached < best.get(other, math.inf):
                    best[other], before[other] = reached, edge
                    heapq.heappush(queue, (reached, other))
        return {edge: _trace(before, start, edge) for edge in done}

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


def network_places(scenario: Scenario) -> Places:
    """Return the places of a scenario's network.

    Raises:
        ScenarioError: The network is not well-formed.
    """
    return _places(scenario.network.read(), scenario.network.source)


@functools.lru_cache(maxsize=8)
def _places(content: bytes, source: str) -> Places:
    root = parse_xml(content, source)
    lanes: dict[str, LanePlace] = {}
    edges: dict[str, tuple[str, ...]] = {}
    for edge in root.iter("edge"):
        if edge.get("function") in ("internal", "crossing", "walkingarea", "connector"):
            continue
        name = edge.get("id", "")
        lanes_of_edge = edge.findall("lane")
        edges[name] = tuple(lane.get("id", "") for lane in lanes_of_edge)
        for index, lane in enumerate(lanes_of_edge):
            lanes[lane.get("id", "")] = LanePlace(
                name,
                index,
                float(lane.get("length", "0")),
                float(lane.get("speed", "0")),
                cars_may_use(lane),
            )
    following: dict[str, dict[str, None]] = defaultdict(dict)
    onward: set[str] = set()
    lights = {element.get("id", ""): None for element in root.iter("tlLogic")}
    ends: dict[str, str] = {}
    begins: dict[str, str] = {}
    rails = rail_signals_of(root)
    for connection in root.iter("connection"):
        start, end = connection.get("from", ":"), connection.get("to", ":")
        if start not in edges or end not in edges:
            continue
        entry, leaving = start_lane(connection), end_lane(connection)
        if (entry not in lanes or lanes[entry].cars) and (
            leaving not in lanes or lanes[leaving].cars
        ):
            following[start][end] = None
            if not turns_around(connection):
                onward.add(start)
        light = connection.get("tl")
        if light and light not in rails:
            lights[light] = None
            ends.setdefault(entry, light)
            begins.setdefault(leaving, light)
    return Places(
        lanes,
        edges,
        {edge: tuple(ends) for edge, ends in following.items()},
        frozenset(edges.keys() - onward),
        tuple(lights),
        ends,
        begins,
    )


def _trace(before: Mapping[str, str], start: str, edge: str) -> tuple[str, ...]:
    trace = [edge]
    while edge != start:
        edge = before[edge]
        trace.append(edge)
    return tuple(reversed(trace))
