"""What a ``.net.xml`` says of the ways across its junctions: links, crossings, who gives way."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
        return self.from_lane.rsplit("_", 1)[0]

    @property
    def to_edge(self) -> str:
        """Edge of the outgoing lane."""
        return self.to_lane.rsplit("_", 1)[0]


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
        edges = {link.to_lane.rsplit("_", 1)[0] for link in own}
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


def behind_of(
    root: ET.Element, lengths_m: Mapping[str, float], room_m: float
) -> dict[str, dict[str, float]]:
    """Lanes where those wait who have no room on the lane at the light.

    Networks made of maps have lanes at lights that are shorter than a vehicle, with a node of the
    map before them. Who waits there stands on the lane behind, of which nothing would be seen.

    Args:
        root: The ``<net>``.
        lengths_m: Length of every lane outside of junctions, m.
        room_m: Lanes shorter than this are too short; lanes behind are added until they have it.

    Returns:
        For each lane at a light that is too short, the lanes, inside junctions and outside, from
        which one can only get to it, with the share of each that is its own: one over the lanes a
        lane leads to. Roads that end at a light of their own are not behind another one.
    """
    feeds: dict[str, list[tuple[str, str]]] = defaultdict(list)
    roads: dict[str, set[str]] = defaultdict(set)
    ways: dict[str, int] = defaultdict(int)
    at_lights: dict[str, None] = {}
    for item in root.iter("connection"):
        start, end = item.get("from", ":"), item.get("to", ":")
        if start.startswith(":") or end.startswith(":"):
            continue
        lane = f"{start}_{item.get('fromLane')}"
        roads[start].add(end)
        ways[lane] += 1
        if item.get("tl") is None:
            feeds[f"{end}_{item.get('toLane')}"].append((lane, item.get("via", "")))
        else:
            at_lights[lane] = None
    found: dict[str, dict[str, float]] = {}
    for lane in at_lights:
        reach, room, shares = {lane: 1.0}, lengths_m.get(lane, room_m), dict[str, float]()
        while reach and room < room_m:
            before: dict[str, float] = defaultdict(float)
            for here, share in reach.items():
                for feeder, via in feeds[here]:
                    road = feeder.rsplit("_", 1)[0]
                    if roads[road] == {here.rsplit("_", 1)[0]} and feeder not in shares:
                        before[feeder] += share / ways[feeder]
                        if via:
                            shares[via] = share
            shares |= before
            room += sum(lengths_m.get(name, 0.0) * share for name, share in before.items())
            reach = before
        if shares:
            found[lane] = shares
    return found
