"""What a ``.net.xml`` says of the ways across its junctions: links, crossings, who gives way."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

CROSSING = "c"
"""Direction of a link for people on foot."""

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
        return _road(self.from_lane)

    @property
    def to_edge(self) -> str:
        """Edge of the outgoing lane."""
        return _road(self.to_lane)


def links_of(root: ET.Element) -> dict[str, list[Link]]:
    """The links for vehicles of every traffic light."""
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
    """The crossings for people on foot of every traffic light.

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
    """Per junction, a bit mask of conflicting rows for each row of the right-of-way matrix."""
    return _matrix(root, "foes")


def yields_of(root: ET.Element) -> dict[str, list[int]]:
    """Per junction and row, a bit mask of the rows it gives way to."""
    return _matrix(root, "response")


def neighbours_of(
    links: Mapping[str, Sequence[Link]], root: ET.Element
) -> dict[str, tuple[str, ...]]:
    """Traffic lights reached along roads without another traffic light in between."""
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
    """Junctions where right turns may go on red after a stop."""
    return frozenset(
        item.get("id", "")
        for item in root.iter("junction")
        if item.get("type") == "traffic_light_right_on_red"
    )


def has_bit(a: Link, b: Link, matrix: Matrix) -> bool:
    """Whether the matrix marks link `b` in the row of link `a`."""
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
    """Junction and matrix row of an internal lane ``:<junction>_<first row>_<lane>``."""
    if not via:
        return "", -1
    junction, first, lane = via[1:].rsplit("_", 2)
    return junction, int(first) + int(lane)


@dataclass(frozen=True)
class Upstream:
    """What lies upstream of a lane at a light.

    Attributes:
        lanes: Lanes inside junctions and outside to the share of their vehicles that is counted.
        roads: Roads to the share of the vehicles waiting to enter the network there.
    """

    lanes: dict[str, float] = field(default_factory=dict[str, float])
    roads: dict[str, float] = field(default_factory=dict[str, float])


def behind_of(
    root: ET.Element, lengths_m: Mapping[str, float], reach_m: float
) -> dict[str, Upstream]:
    """Lanes where those stand who are on their way to a light, but not on the lane at it.

    Networks made of maps have lanes at lights that are cut off by a node of the map, some shorter
    than a vehicle. Who waits farther back stands on the lanes behind, of which nothing would be
    seen.

    Args:
        root: The ``<net>``.
        lengths_m: Length of every lane outside of junctions, m.
        reach_m: How far upstream one looks: lanes behind are added until they begin so far from the
            light or farther, each as a whole.

    Returns:
        For each lane at a light that is shorter, what is counted with it. The share of a lane
        is one over the ways it leads on, along all of the way to the light; turning around
        is none. Lanes at a light of their own are not behind another one. Where a lane begins
        nearer than `reach_m`, vehicles that wait to enter on its road, each on any of its lanes,
        are behind it.
    """
    feeds: dict[str, list[tuple[str, str]]] = defaultdict(list)
    ways: dict[str, int] = defaultdict(int)
    at_lights: dict[str, None] = {}
    for item in root.iter("connection"):
        start, end = item.get("from", ":"), item.get("to", ":")
        if start.startswith(":") or end.startswith(":") or item.get("dir") == "t":
            continue
        lane = f"{start}_{item.get('fromLane')}"
        ways[lane] += 1
        if item.get("tl") is None:
            feeds[f"{end}_{item.get('toLane')}"].append((lane, item.get("via", "")))
        else:
            at_lights[lane] = None
    widths = Counter(map(_road, lengths_m))
    found: dict[str, Upstream] = {}
    for lane in at_lights:
        begins_m = {lane: lengths_m.get(lane, reach_m)}
        own, roads = Upstream(), defaultdict[str, float](float)
        here = {lane: 1.0} if begins_m[lane] < reach_m else {}
        while here:
            before: dict[str, float] = defaultdict(float)
            for name, share in here.items():
                roads[_road(name)] += share / widths[_road(name)]
                for feeder, via in feeds[name]:
                    if feeder in at_lights or (feeder in begins_m and feeder not in before):
                        continue
                    before[feeder] += share / ways[feeder]
                    at_m = begins_m[name] + lengths_m.get(feeder, 0.0)
                    begins_m[feeder] = min(begins_m.get(feeder, at_m), at_m)
                    if via:
                        own.lanes[via] = share
            own.lanes.update(before)
            here = {name: share for name, share in before.items() if begins_m[name] < reach_m}
        if roads:
            own.roads.update(roads)
            found[lane] = own
    return found


def _road(lane: str) -> str:
    return lane.rsplit("_", 1)[0]
