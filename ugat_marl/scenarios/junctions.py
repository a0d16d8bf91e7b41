"""Links, crossings and right of way at the junctions of a ``.net.xml``."""

from __future__ import annotations

import heapq
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ugat_marl.scenarios.naming import edge_of_lane

CROSSING = "c"
"""Direction of a link for pedestrians."""

_ROUNDS = 50
"""Rounds of the iteration for roundabouts. Each round shrinks the error by a factor."""

Matrix = Mapping[str, Sequence[int]]
"""Junction to a bit mask of other rows for each row of its right-of-way matrix."""


@dataclass(frozen=True)
class Link:
    """A way across an intersection, controlled by one letter of the signal state.

    Attributes:
        index: Position of its letter in the state; several links may share one letter.
        from_lane: Incoming lane.
        to_lane: Outgoing lane.
        direction: SUMO's letter: s straight, l/L left, r/R right, t/T turn-around, c a crossing.
        junction: Id of the junction.
        request: Row of the link in the junction's right-of-way matrix, or -1 if there is none.
        left_hand: True if traffic keeps to the left. Right turns then cross the opposite traffic.
        cars: True if passenger cars may go this way.
    """

    index: int
    from_lane: str
    to_lane: str
    direction: str
    junction: str = ""
    request: int = -1
    left_hand: bool = False
    cars: bool = True

    @property
    def from_edge(self) -> str:
        """Edge of the incoming lane."""
        return edge_of_lane(self.from_lane)

    @property
    def to_edge(self) -> str:
        """Edge of the outgoing lane."""
        return edge_of_lane(self.to_lane)


def cars_may_use(element: ET.Element) -> bool:
    """Return True if a lane or a connection admits passenger cars."""
    allow, disallow = element.get("allow"), element.get("disallow", "")
    if allow is not None:
        return bool({"all", "passenger"} & set(allow.split()))
    return not {"all", "passenger"} & set(disallow.split())


def lanes_without_cars(root: ET.Element) -> frozenset[str]:
    """Return the lanes that passenger cars may not use."""
    return frozenset(lane.get("id", "") for lane in root.iter("lane") if not cars_may_use(lane))


def leads_cars(connection: ET.Element, closed: Container[str]) -> bool:
    """Return True if passenger cars may use a connection and both of its lanes.

    Args:
        connection: The ``<connection>``.
        closed: The lanes of `lanes_without_cars`.
    """
    ends = {start_lane(connection), end_lane(connection)}
    return cars_may_use(connection) and not any(lane in closed for lane in ends)


def start_lane(connection: ET.Element) -> str:
    """Return the lane from which a ``<connection>`` leads."""
    return f"{connection.get('from', ':')}_{connection.get('fromLane')}"


def end_lane(connection: ET.Element) -> str:
    """Return the lane to which a ``<connection>`` leads."""
    return f"{connection.get('to', ':')}_{connection.get('toLane')}"


def rail_signals_of(root: ET.Element) -> frozenset[str]:
    """Return the signals that trains set: rail signals and level crossings.

    SUMO gives them the id of their junction, and no programme. They are no traffic lights.
    """
    return _junctions_of(root, "rail_signal", "rail_crossing")


def links_of(root: ET.Element) -> dict[str, list[Link]]:
    """Return the links for vehicles of every traffic light, without signals that trains set."""
    links: dict[str, list[Link]] = defaultdict(list)
    left_hand = root.get("lefthand", "").lower() in ("true", "1")
    rails = rail_signals_of(root)
    closed = lanes_without_cars(root)
    ends = {edge.get("id"): edge.get("to", "") for edge in root.iter("edge")}
    for element in root.iter("connection"):
        tls = element.get("tl")
        if tls is None or tls in rails or element.get("from", ":").startswith(":"):
            continue
        junction, request = _request_of(element.get("via", ""))
        junction = junction or ends.get(element.get("from"), "")
        links[tls].append(
            Link(
                index=int(element.get("linkIndex", "0")),
                from_lane=start_lane(element),
                to_lane=end_lane(element),
                direction=element.get("dir", "s"),
                junction=junction,
                request=request,
                left_hand=left_hand,
                cars=leads_cars(element, closed),
            )
        )
    return links


def links_for_cars(links: Sequence[Link]) -> Sequence[Link]:
    """Return the links that passenger cars may use; all of them if there are none, as for buses."""
    return [link for link in links if link.cars] or links


def crossings_of(root: ET.Element) -> dict[str, list[Link]]:
    """Return the pedestrian crossings of every traffic light.

    Crossings have the last rows of the junction's matrix, in the order of their numbers. A crossing
    with a light at each end (``linkIndex2``) gives two links, one for each letter.
    """
    numbers: dict[str, list[int]] = defaultdict(list)
    crossed = {e.get("id", ":_c0") for e in root.iter("edge") if e.get("function") == "crossing"}
    for edge in crossed:
        junction, number = edge[1:].rsplit("_c", 1)
        numbers[junction].append(int(number))
    rows = {
        element.get("id", ""): sum(1 for _ in element.iter("request"))
        for element in root.iter("junction")
    }
    crossings: dict[str, list[Link]] = defaultdict(list)
    for connection in root.iter("connection"):
        tls, ends = connection.get("tl"), (connection.get("to", ""), connection.get("from", ""))
        target = next((end for end in ends if end in crossed), None)
        if tls is None or target is None:
            continue
        junction, number = target[1:].rsplit("_c", 1)
        first = rows.get(junction, 0) - len(numbers[junction])
        row = first + sorted(numbers[junction]).index(int(number))
        index = int(connection.get("linkIndex", "0"))
        crossings[tls].append(
            Link(index, start_lane(connection), f"{target}_0", CROSSING, junction, row)
        )
    return crossings


def foes_of(root: ET.Element) -> dict[str, list[int]]:
    """Return, per junction and row of the right-of-way matrix, a bit mask of conflicting rows."""
    return _matrix(root, "foes")


def yields_of(root: ET.Element) -> dict[str, list[int]]:
    """Return, per junction and row, a bit mask of the rows that this row gives way to."""
    return _matrix(root, "response")


def neighbours_of(
    links: Mapping[str, Sequence[Link]], between: Iterable[ET.Element]
) -> dict[str, tuple[str, ...]]:
    """Return the neighbours of each traffic light: roads join them with none of these in between.

    Other lights, as those of pedestrians, are passed like plain nodes.

    Args:
        links: Traffic light to its links.
        between: The `connections_between` these lights.
    """
    enters = {link.from_edge: tls for tls, light_links in links.items() for link in light_links}
    following: dict[str, set[str]] = defaultdict(set)
    for element in between:
        following[element.get("from", "")].add(element.get("to", ""))
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
    return {tls: tuple(sorted(beside)) for tls, beside in adjacent.items()}


def straight_roads_of(between: Iterable[ET.Element]) -> dict[str, str]:
    """Return road to the road straight ahead of it, by the `connections_between` lights."""
    ahead: dict[str, str] = {}
    for element in between:
        if element.get("dir") == "s":
            ahead.setdefault(element.get("from", ""), element.get("to", ""))
    return ahead


def connections_between(root: ET.Element, lights: Container[str]) -> list[ET.Element]:
    """Return the connections from road to road (SUMO's edges) that no light of these controls."""
    return [
        element
        for element in root.iter("connection")
        if element.get("tl", "") not in lights
        # ":" begins the names of roads inside of a junction
        and not any(element.get(end, ":").startswith(":") for end in ("from", "to"))
    ]


def right_on_red_of(root: ET.Element) -> frozenset[str]:
    """Return the junctions where vehicles may turn right on red after a stop."""
    return _junctions_of(root, "traffic_light_right_on_red")


def _junctions_of(root: ET.Element, *types: str) -> frozenset[str]:
    junctions = root.iter("junction")
    return frozenset(each.get("id", "") for each in junctions if each.get("type") in types)


def has_bit(a: Link, b: Link, matrix: Matrix) -> bool:
    """Return True if the matrix marks link `b` in the row of link `a`."""
    if a.junction != b.junction or a.request < 0 or b.request < 0:
        return False
    rows = matrix[a.junction]  # none at a junction without right of way
    return bool(rows) and bool(rows[a.request] >> b.request & 1)


def _matrix(root: ET.Element, attribute: str) -> dict[str, list[int]]:
    foe_rows: dict[str, list[int]] = {}
    for junction in root.iter("junction"):
        rows = {
            int(r.get("index", "0")): int(r.get(attribute, "0"), 2)
            for r in junction.iter("request")
        }
        foe_rows[junction.get("id", "")] = [
            rows.get(i, 0) for i in range(max(rows, default=-1) + 1)
        ]
    return foe_rows


def _request_of(via: str) -> tuple[str, int]:
    """Return junction and matrix row of an internal lane ``:<junction>_<first row>_<lane>``.

    Without a lane, as in a network without internal lanes, they are "" and -1.
    """
    if not via:
        return "", -1
    junction, first, lane = via[1:].rsplit("_", 2)
    return junction, int(first) + int(lane)


@dataclass(frozen=True)
class Upstream:
    """Lanes and roads upstream of a lane at a light, with shares in (0, 1].

    Attributes:
        lanes: Lane, inside or outside of junctions, to the counted share of its vehicles.
        roads: Road to the counted share of the vehicles that wait to enter the network there.
    """

    lanes: dict[str, float] = field(default_factory=dict[str, float])
    roads: dict[str, float] = field(default_factory=dict[str, float])


def behind_of(
    root: ET.Element, lengths_m: Mapping[str, float], reach_m: float, lights: Container[str]
) -> dict[str, Upstream]:
    """Find the lanes upstream of short lanes at lights.

    In networks made from maps, a node of the map may cut a lane at a light short, even shorter than
    a vehicle. The rest of the queue stands on upstream lanes and would not be counted.

    Args:
        root: The ``<net>``.
        lengths_m: Length of every lane outside of junctions, m.
        reach_m: Distance from the light up to which lanes are added. A lane is added as a whole if
            it ends within this distance.
        lights: Traffic lights that count as lights; other lights count as plain nodes.

    Returns:
        The lanes and roads counted with each lane at a light that is shorter than `reach_m`. The
        share of a lane is the probability that a vehicle on it comes to the lane at the light, if
        it chooses each way at a node equally often (U-turns excluded). Lanes that end at a light
        themselves are never upstream lanes. Vehicles that wait to enter a road count if a lane of
        that road begins within `reach_m`; they are spread evenly over the lanes of the road.
    """
    ways = _ways(root, lights)
    widths = Counter(map(edge_of_lane, ways.number))
    upstream: dict[str, Upstream] = {}
    for lane in ways.at_lights:
        begins_m = _begins(lane, ways, lengths_m, reach_m)
        near = [name for name, at_m in begins_m.items() if at_m < reach_m]
        if not near:
            continue
        shares = _shares(lane, near, ways)
        feeding = upstream[lane] = Upstream()
        for name in near:
            road = edge_of_lane(name)
            feeding.roads[road] = feeding.roads.get(road, 0.0) + shares[name] / widths[road]
            for feeder, inside in ways.feeds.get(name, ()):
                if feeder in begins_m and feeder not in ways.at_lights:
                    feeding.lanes.update(dict.fromkeys(inside, shares[name]))
                    feeding.lanes[feeder] = shares[feeder]
    return upstream


@dataclass(frozen=True)
class _Ways:
    """Connections between lanes outside of junctions.

    Attributes:
        feeds: For each lane, the lanes that lead to it without a light, each with the lanes inside
            the junction between them.
        number: Number of ways onward from each lane.
        at_lights: Lanes that end at a light.
    """

    feeds: Mapping[str, Sequence[tuple[str, Sequence[str]]]]
    number: Mapping[str, int]
    at_lights: Mapping[str, None]


def turns_around(connection: ET.Element) -> bool:
    """Return True for a U-turn; SUMO writes T for t where traffic keeps to the left."""
    return connection.get("dir", "").lower() == "t"


def _ways(root: ET.Element, lights: Container[str]) -> _Ways:
    feeds: dict[str, list[tuple[str, list[str]]]] = defaultdict(list)
    number: dict[str, int] = defaultdict(int)
    at_lights: dict[str, None] = {}
    onward: dict[str, str] = {}
    for element in root.iter("connection"):
        start, end, via = element.get("from", ":"), element.get("to", ":"), element.get("via", "")
        ends_at_light = element.get("tl", "") in lights
        lane = start_lane(element)
        if start.startswith(":"):
            onward[lane] = via
            continue
        if end.startswith(":"):
            continue
        if ends_at_light:
            at_lights[lane] = None
        if not turns_around(element):
            number[lane] += 1
            if not ends_at_light:
                feeds[end_lane(element)].append((lane, [via] if via else []))
    for ways in feeds.values():
        for _, inside in ways:
            while inside and (following := onward.get(inside[-1])) and following not in inside:
                inside.append(following)
    return _Ways(feeds, number, at_lights)


def _begins(
    lane: str, ways: _Ways, lengths_m: Mapping[str, float], reach_m: float
) -> dict[str, float]:
    """Return the distance from each lane's begin to the light, m, nearest first (Dijkstra)."""
    begins: dict[str, float] = {}
    waiting = [(lengths_m.get(lane, reach_m), lane)]
    while waiting:
        at_m, name = heapq.heappop(waiting)
        if name in begins:
            continue
        begins[name] = at_m
        if at_m < reach_m:
            for feeder, _ in ways.feeds.get(name, ()):
                if feeder not in ways.at_lights:
                    heapq.heappush(waiting, (at_m + lengths_m.get(feeder, 0.0), feeder))
    return begins


def _shares(lane: str, near: Sequence[str], ways: _Ways) -> dict[str, float]:
    """Return the share of each lane's vehicles that come to `lane`, by all ways through `near`.

    With ``number(f)`` ways onward from lane f, the shares solve

        share(lane) = 1,  share(f) = sum of share(n) / number(f) over the lanes n that f leads to.

    Fixed-point iteration solves this. Roundabouts need more rounds, and each round adds less.
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
