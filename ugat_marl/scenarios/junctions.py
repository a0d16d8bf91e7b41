"""Ways across the junctions of a ``.net.xml``: links, crossings, right of way."""

from __future__ import annotations

import heapq
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field

from ugat_marl.scenarios.naming import edge_of

CROSSING = "c"
"""Direction of a link for people on foot."""

_ROUNDS = 50
"""Rounds of the iteration for roundabouts; the error shrinks by a factor with each round."""

Matrix = Mapping[str, Sequence[int]]
"""Per junction, a bit mask of other rows for each row of its right-of-way matrix."""


@dataclass(frozen=True)
class Link:
    """A way across an intersection, controlled by one letter of the signal state.

    Attributes:
        index: Position of its letter; several links may share one.
        from_lane: Incoming lane.
        to_lane: Outgoing lane.
        direction: SUMO's letter: s straight, l/L left, r/R right, t turn-around; c for a crossing.
        junction: Junction it crosses.
        request: Its row in that junction's right-of-way matrix, or -1 if the network has none.
    """

    index: int
    from_lane: str
    to_lane: str
    direction: str
    junction: str = ""
    request: int = -1

    @property
    def from_edge(self) -> str:
        """Edge of the incoming lane."""
        return edge_of(self.from_lane)

    @property
    def to_edge(self) -> str:
        """Edge of the outgoing lane."""
        return edge_of(self.to_lane)


def links_of(root: ET.Element) -> dict[str, list[Link]]:
    """Return the links for vehicles of every traffic light."""
    links: dict[str, list[Link]] = defaultdict(list)
    for item in root.iter("connection"):
        tls = item.get("tl")
        if tls is None or item.get("from", ":").startswith(":"):
            continue
        junction, request = _request_of(item.get("via", ""))
        links[tls].append(
            Link(
                index=int(item.get("linkIndex", "0")),
                from_lane=f"{item.get('from')}_{item.get('fromLane')}",
                to_lane=f"{item.get('to')}_{item.get('toLane')}",
                direction=item.get("dir", "s"),
                junction=junction,
                request=request,
            )
        )
    return links


def crossings_of(root: ET.Element) -> dict[str, list[Link]]:
    """Return the crossings for people on foot of every traffic light.

    Their rows are the last ones of the junction's matrix, in the order of their numbers. A crossing
    that shows a light at either end is one link with the letter of its first end.
    """
    numbers: dict[str, list[int]] = defaultdict(list)
    for edge in root.iter("edge"):
        if edge.get("function") == "crossing":
            junction, number = edge.get("id", ":_c0")[1:].rsplit("_c", 1)
            numbers[junction].append(int(number))
    rows = {
        item.get("id", ""): sum(1 for _ in item.iter("request")) for item in root.iter("junction")
    }
    found: dict[str, list[Link]] = defaultdict(list)
    for item in root.iter("connection"):
        tls, target = item.get("tl"), item.get("to", "")
        if tls is None or not target.startswith(":") or "_c" not in target:
            continue
        junction, number = target[1:].rsplit("_c", 1)
        if junction in numbers and number.isdigit():
            first = rows.get(junction, 0) - len(numbers[junction])
            row = first + sorted(numbers[junction]).index(int(number))
            start = f"{item.get('from')}_{item.get('fromLane')}"
            index = int(item.get("linkIndex", "0"))
            found[tls].append(Link(index, start, f"{target}_0", CROSSING, junction, row))
    return found


def foes_of(root: ET.Element) -> dict[str, list[int]]:
    """Return, per junction and row of the right-of-way matrix, a bit mask of conflicting rows."""
    return _matrix(root, "foes")


def yields_of(root: ET.Element) -> dict[str, list[int]]:
    """Return, per junction and row, a bit mask of the rows it gives way to."""
    return _matrix(root, "response")


def neighbours_of(
    links: Mapping[str, Sequence[Link]], root: ET.Element
) -> dict[str, tuple[str, ...]]:
    """Return the traffic lights reached along roads without another light in between."""
    enters = {link.from_edge: tls for tls, own in links.items() for link in own}
    following: dict[str, set[str]] = defaultdict(set)
    for item in root.iter("connection"):
        if not item.get("from", ":").startswith(":") and item.get("tl") is None:
            following[item.get("from", "")].add(item.get("to", ""))
    adjacent: dict[str, set[str]] = {tls: set() for tls in links}
    for tls, own in links.items():
        edges = {link.to_edge for link in own}
        seen: set[str] = set()
        while edges:
            edge = edges.pop()
            seen.add(edge)
            other = enters.get(edge)
            if other is None:
                edges |= following[edge] - seen
            elif other != tls:
                adjacent[tls].add(other)
                adjacent[other].add(tls)
    return {tls: tuple(sorted(found)) for tls, found in adjacent.items()}


def right_on_red_of(root: ET.Element) -> frozenset[str]:
    """Return the junctions where right turns may go on red after a stop."""
    return frozenset(
        item.get("id", "")
        for item in root.iter("junction")
        if item.get("type") == "traffic_light_right_on_red"
    )


def has_bit(a: Link, b: Link, matrix: Matrix) -> bool:
    """Return True if the matrix marks link `b` in the row of link `a`."""
    if a.junction != b.junction or a.request < 0 or b.request < 0:
        return False
    return bool(matrix[a.junction][a.request] >> b.request & 1)


def _matrix(root: ET.Element, attribute: str) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for junction in root.iter("junction"):
        rows = {
            int(r.get("index", "0")): int(r.get(attribute, "0"), 2)
            for r in junction.iter("request")
        }
        found[junction.get("id", "")] = [rows.get(i, 0) for i in range(max(rows, default=-1) + 1)]
    return found


def _request_of(via: str) -> tuple[str, int]:
    """Return junction and matrix row of an internal lane ``:<junction>_<first row>_<lane>``."""
    if not via:
        return "", -1
    junction, first, lane = via[1:].rsplit("_", 2)
    return junction, int(first) + int(lane)


@dataclass(frozen=True)
class Upstream:
    """Lanes and roads upstream of a lane at a light.

    Attributes:
        lanes: Lanes inside junctions and outside to the share of their vehicles that is counted.
        roads: Roads to the share of the vehicles waiting to enter the network there.
    """

    lanes: dict[str, float] = field(default_factory=dict[str, float])
    roads: dict[str, float] = field(default_factory=dict[str, float])


def behind_of(
    root: ET.Element, lengths_m: Mapping[str, float], reach_m: float, lights: Container[str]
) -> dict[str, Upstream]:
    """Find the lanes behind short lanes at lights, whose vehicles are on their way to the light.

    Networks made of maps have lanes at lights that are cut off by a node of the map, some shorter
    than a vehicle. The rest of the queue is on the lanes behind and would not be seen.

    Args:
        root: The ``<net>``.
        lengths_m: Length of every lane outside of junctions, m.
        reach_m: Distance looked upstream. Whole lanes are added until one begins so far from the
            light or farther.
        lights: The traffic lights that matter; others count as plain nodes.

    Returns:
        For each shorter lane at a light the lanes and roads counted with it. The share of a lane is
        the share of its ways that lead to the lane at the light: one over their number at every
        node, U-turns not counted. Lanes at a light of their own are not behind another one.
        Where a lane begins nearer than `reach_m`, vehicles that wait to enter on its road, each on
        any of its lanes, are behind it.
    """
    ways = _ways(root, lights)
    widths = Counter(map(edge_of, ways.number))
    found: dict[str, Upstream] = {}
    for lane in ways.at_lights:
        begins_m = _begins(lane, ways, lengths_m, reach_m)
        near = [name for name, at_m in begins_m.items() if at_m < reach_m]
        if not near:
            continue
        shares = _shares(lane, near, ways)
        own = found[lane] = Upstream()
        for name in near:
            road = edge_of(name)
            own.roads[road] = own.roads.get(road, 0.0) + shares[name] / widths[road]
            for feeder, inside in ways.feeds.get(name, ()):
                if feeder in begins_m and feeder not in ways.at_lights:
                    own.lanes.update(dict.fromkeys(inside, shares[name]))
                    own.lanes[feeder] = shares[feeder]
    return found


@dataclass(frozen=True)
class _Ways:
    """Connections between lanes outside of junctions.

    Attributes:
        feeds: For each lane those that lead to it without a light, with the lanes inside the
            junction in between.
        number: In how many ways each lane leads on.
        at_lights: Lanes that end at a light.
    """

    feeds: Mapping[str, Sequence[tuple[str, Sequence[str]]]]
    number: Mapping[str, int]
    at_lights: Mapping[str, None]


def _ways(root: ET.Element, lights: Container[str]) -> _Ways:
    feeds: dict[str, list[tuple[str, list[str]]]] = defaultdict(list)
    number: dict[str, int] = defaultdict(int)
    at_lights: dict[str, None] = {}
    onward: dict[str, str] = {}
    for item in root.iter("connection"):
        start, end, via = item.get("from", ":"), item.get("to", ":"), item.get("via", "")
        ends_at_light = item.get("tl", "") in lights
        lane = f"{start}_{item.get('fromLane')}"
        if start.startswith(":"):
            onward[lane] = via
            continue
        if end.startswith(":"):
            continue
        if ends_at_light:
            at_lights[lane] = None
        if item.get("dir") != "t":
            number[lane] += 1
            if not ends_at_light:
                feeds[f"{end}_{item.get('toLane')}"].append((lane, [via] if via else []))
    for own in feeds.values():
        for _, inside in own:
            while inside and (following := onward.get(inside[-1])) and following not in inside:
                inside.append(following)
    return _Ways(feeds, number, at_lights)


def _begins(
    lane: str, ways: _Ways, lengths_m: Mapping[str, float], reach_m: float
) -> dict[str, float]:
    """Return each lane's distance from its begin to the light, m, nearest first."""
    found: dict[str, float] = {}
    waiting = [(lengths_m.get(lane, reach_m), lane)]
    while waiting:
        at_m, name = heapq.heappop(waiting)
        if name in found:
            continue
        found[name] = at_m
        if at_m < reach_m:
            for feeder, _ in ways.feeds.get(name, ()):
                if feeder not in ways.at_lights:
                    heapq.heappush(waiting, (at_m + lengths_m.get(feeder, 0.0), feeder))
    return found


def _shares(lane: str, near: Sequence[str], ways: _Ways) -> dict[str, float]:
    """Return the share of each lane's vehicles that come to `lane`, by all ways through `near`.

    The shares solve one linear equation per lane, by fixed-point iteration: roundabouts need more
    than one round, and each round adds a smaller share.
    """
    shares = {lane: 1.0}
    for _ in range(_ROUNDS + len(near)):  # a chain of n lanes takes n rounds
        after: dict[str, float] = defaultdict(float, {lane: 1.0})
        for name in near:
            for feeder, _inside in ways.feeds.get(name, ()):
                if feeder not in ways.at_lights:
                    after[feeder] += shares.get(name, 0.0) / ways.number[feeder]
        if after == shares:
            break
        shares = dict(after)
    return shares
