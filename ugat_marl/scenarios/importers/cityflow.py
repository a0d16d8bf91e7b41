"""CityFlow's two files as a SUMO network with vehicles.

Geometry, lanes, light phases, routes, departures, sizes and speeds are those of CityFlow. CityFlow
counts lanes from the middle of the road, SUMO from the kerb. In both, lanes lie to the right of the
road's line. Stop lines keep their distance from the centre.
"""

from __future__ import annotations

import functools
import heapq
import json
import math
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from ugat_marl.errors import ScenarioError, listed
from ugat_marl.files import parse_xml, write_whole, xml_bytes
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios.importers.cityflow_roadnet import (
    Crossing,
    Point,
    Road,
    Roadnet,
    read_roadnet,
)
from ugat_marl.scenarios.importers.long_files import objects
from ugat_marl.scenarios.importers.making import NETWORK, ROUTES, RoadFiles, RoadSource
from ugat_marl.scenarios.importers.plan import build_network, coordinate
from ugat_marl.scenarios.importers.turning_shares import MOST_VEHICLES, Drive, write_drives
from ugat_marl.scenarios.junctions import links_of
from ugat_marl.scenarios.phases import RightOfWay, state_of
from ugat_marl.scenarios.signals import GREEN

YELLOW_S, ALL_RED_S = 3.0, 2.0
LONGEST_CLEARANCE_S = 10.0

_VEHICLE = ("length", "width", "maxPosAcc", "maxNegAcc", "usualPosAcc", "usualNegAcc", "minGap",
            "maxSpeed", "headwayTime")  # fmt: skip


def from_cityflow(
    roadnet: Path,
    flow: Path,
    begin_s: float,
    duration_s: float | None,
    *,
    own_vehicles: bool,
    exact: bool,
) -> RoadSource:
    """Return a source of the roads and vehicles in a ``roadnet.json`` and its ``flow.json``.

    Args:
        roadnet: File with the roads.
        flow: File with the vehicles.
        begin_s: Start of an episode, s.
        duration_s: Length of an episode, s. None for all departures, rounded up to ten minutes, and
            at least one hour.
        own_vehicles: True to import the vehicles.
        exact: True for CityFlow's headways and driving without randomness.
    """

    def roads(folder: Path, reporter: Reporter) -> RoadFiles:
        net = read_roadnet(roadnet)
        notes = write_network(net, folder / NETWORK)
        length_s, routes = duration_s or 3600.0, ()
        if own_vehicles:
            episode = (begin_s, duration_s)
            last_s = write_routes(flow, net, folder / ROUTES, episode, reporter, exact=exact)
            routes = (ROUTES,)
            tens = math.floor((last_s - begin_s) / 600) + 1
            length_s = duration_s or max(3600.0, 600.0 * tens)
        return RoadFiles(
            f"CityFlow network {roadnet.name}",
            f"Turned from CityFlow's `{roadnet.name}` and `{flow.name}`: lanes, stop lines, turns "
            "and light phases are theirs. Phase n is the n-th green one of the file, from 0, and "
            "equal greens of a light are one phase. Who made the files decides what may be done "
            "with them; keep their licence beside them.",
            routes=routes,
            settings={"duration_s": length_s, "control": {"phases": "programme"}},
            notes=tuple(notes),
        )

    return roads


def write_network(net: Roadnet, out: Path) -> list[str]:
    """Make the SUMO network.

    Args:
        net: Roads and intersections.
        out: The ``.net.xml`` to write.

    Returns:
        Notes for the user.

    Raises:
        ScenarioError: netconvert refused.
    """
    documents = {
        "--node-files": xml_bytes(_nodes(net)),
        "--edge-files": xml_bytes(_edges(net)),
        "--connection-files": xml_bytes(_connections(net)),
        "--tllogic-files": xml_bytes(_lights(net)),
    }
    options = {"junctions.limit-turn-speed": -1, "tls.yellow.time": 3}
    root = parse_xml(build_network(documents, options, strict=False), str(out))
    notes = _set_programmes(root, net)
    write_whole(out, xml_bytes(root))
    return notes


def has_light(crossing: Crossing) -> bool:
    """Return True for an intersection with a traffic light: it has two different phases."""
    return not crossing.virtual and len({frozenset(links) for _, links in crossing.phases}) > 1


def _nodes(net: Roadnet) -> ET.Element:
    root = ET.Element("nodes")
    for crossing in net.crossings.values():
        kind = "dead_end" if crossing.virtual else "priority"
        attributes = {
            "id": crossing.id,
            "x": coordinate(crossing.point[0]),
            "y": coordinate(crossing.point[1]),
        }
        if has_light(crossing):
            kind = "traffic_light"
            attributes["tl"] = crossing.id
        if not crossing.virtual and (shape := _stop_lines(crossing, net)):
            attributes["shape"] = shape
        # No road is the main one: straight on has priority over turns, as in CityFlow.
        ET.SubElement(root, "node", attributes, type=kind, rightOfWay="edgePriority")
    return root


def _edges(net: Roadnet) -> ET.Element:
    root = ET.Element("edges")
    for road in net.roads.values():
        edge = ET.SubElement(
            root,
            "edge",
            {"id": road.id, "from": road.start, "to": road.end},
            numLanes=str(len(road.lanes)),
            priority="1",
            spreadType="right",
            speed=f"{max(speed for _, speed in road.lanes):g}",
            shape=_shape(road.points),
        )
        for index, (width, speed) in enumerate(reversed(road.lanes)):
            ET.SubElement(edge, "lane", index=str(index), width=f"{width:g}", speed=f"{speed:g}")
    return root


def _connections(net: Roadnet) -> ET.Element:
    root = ET.Element("connections")
    leads = {link.start for crossing in net.crossings.values() for link in crossing.links}
    for road in net.roads.values():
        if road.id not in leads and not net.crossings[road.end].virtual:
            ET.SubElement(root, "connection", {"from": road.id})  # forbids guessed connections
    for crossing in net.crossings.values():
        for _, attributes in _ways(crossing, net):
            ET.SubElement(root, "connection", attributes)
    return root


def _lights(net: Roadnet) -> ET.Element:
    """Return lights with one letter per way. `_set_programmes` writes the states later."""
    root = ET.Element("tlLogics")
    for crossing in filter(has_light, net.crossings.values()):
        ways = list(_ways(crossing, net))
        logic = ET.SubElement(
            root, "tlLogic", id=crossing.id, type="static", programID="0", offset="0"
        )
        ET.SubElement(logic, "phase", duration="30", state="G" * len(ways))
        for index, (_, attributes) in enumerate(ways):
            ET.SubElement(root, "connection", attributes, tl=crossing.id, linkIndex=str(index))
    return root


def _ways(crossing: Crossing, net: Roadnet) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield every way across an intersection, with its road link's number, in file order."""
    for number, link in enumerate(crossing.links):
        before, behind = net.roads[link.start], net.roads[link.end]
        for a, b in link.lanes:
            yield (
                number,
                {
                    "from": link.start,
                    "to": link.end,
                    "fromLane": str(len(before.lanes) - 1 - a),
                    "toLane": str(len(behind.lanes) - 1 - b),
                },
            )


def _stop_lines(crossing: Crossing, net: Roadnet) -> str:
    """Return a polygon through the ends of all stop lines; empty if there are none."""
    if crossing.width_m <= 0:
        return ""
    corners: list[Point] = []
    for road in net.roads.values():
        if road.end == crossing.id:
            corners += _corners(road, road.points[::-1], crossing.width_m, backwards=True)
        if road.start == crossing.id:
            corners += _corners(road, road.points, crossing.width_m, backwards=False)
    x, y = crossing.point
    around = sorted(set(corners), key=lambda p: math.atan2(p[1] - y, p[0] - x))
    return _shape(around) if len(around) > 2 else ""


def _corners(
    road: Road, points: tuple[Point, ...], distance_m: float, *, backwards: bool
) -> list[Point]:
    """Return both ends of the line across a road at a distance from the intersection's centre."""
    left = distance_m
    for (ax, ay), (bx, by) in pairwise(points):
        length = math.hypot(bx - ax, by - ay)
        if length > left or (bx, by) == points[-1]:
            dx, dy = (bx - ax) / max(length, 1e-9), (by - ay) / max(length, 1e-9)
            left = min(left, 0.45 * length)
            x, y = ax + left * dx, ay + left * dy
            width = sum(width for width, _ in road.lanes) * (-1 if backwards else 1)
            return [_rounded(x, y), _rounded(x + width * dy, y - width * dx)]
        left -= length
    return []


def _rounded(x: float, y: float) -> Point:
    return round(x, 2), round(y, 2)


def _shape(points: tuple[Point, ...] | list[Point]) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in points)


def _set_programmes(root: ET.Element, net: Roadnet) -> list[str]:
    """Write the light phases into the network and return notes.

    The network must be built first, because ``g`` or ``G`` depends on its right of way.
    """
    links = links_of(root)
    rules = RightOfWay.of(root)
    without: list[str] = []
    equal: dict[str, list[str]] = defaultdict(list)
    for logic in root.iter("tlLogic"):
        crossing = net.crossings[logic.get("id", "")]
        crossing_links = links.get(crossing.id, [])
        number_of = dict(enumerate(number for number, _ in _ways(crossing, net)))
        width = len(number_of)
        for phase in list(logic):
            logic.remove(phase)
        greens = _split(crossing)
        if not any(green.clearance_s for green in greens):
            without.append(crossing.id)
        states = [
            state_of(
                [k for k in crossing_links if number_of[k.index] in green.links],
                crossing_links,
                rules,
                width,
            )
            for green in greens
        ]
        if numbers := _equal_greens(states):
            equal[numbers].append(crossing.id)
        for place, green in enumerate(greens):
            following = states[(place + 1) % len(states)]
            ET.SubElement(logic, "phase", duration=f"{green.seconds:g}", state=states[place])
            for duration, state in _clearing(
                states[place], following, green.clearance_s, _letters(number_of, green.going)
            ):
                ET.SubElement(logic, "phase", duration=f"{duration:g}", state=state)
    notes = [
        f"the greens {numbers} of the file, from 0, are equal at {listed(lights, 'light')}; they "
        "are one phase, and those behind have lower numbers"
        for numbers, lights in equal.items()
    ]
    if without:
        notes.append(
            f"{len(without)} lights have no phase between two greens (the first: {without[0]!r}); "
            f"{YELLOW_S:g} s of yellow and {ALL_RED_S:g} s of red were put in"
        )
    return notes


def _equal_greens(states: Sequence[str]) -> str:
    """Return the numbers of a light's greens that are equal, as ``0 and 2``; empty if none are."""
    places: dict[str, list[str]] = defaultdict(list)
    for place, state in enumerate(state for state in states if set(state) & GREEN):
        places[state].append(str(place))
    return ", ".join(" and ".join(numbers) for numbers in places.values() if len(numbers) > 1)


@dataclass(frozen=True, slots=True)
class _Green:
    """Green phase of a light, with the time between it and the next one.

    Attributes:
        seconds: Its length, s.
        links: Road links with green.
        clearance_s: Time until the next green, s; 0 if the light has no phase between two greens.
        going: Road links that may go in this time.
    """

    seconds: float
    links: frozenset[int]
    clearance_s: float
    going: frozenset[int]


def _split(crossing: Crossing) -> list[_Green]:
    """Return the green phases of a light.

    CityFlow's files have separate phases for the time between two greens. In these, only links may
    go that have green before and after. Many files have such a phase once, usually as the first
    one, and mean it between all greens.
    """
    phases = [(seconds, frozenset(links)) for seconds, links in crossing.phases if seconds > 0]
    if not phases:
        raise ScenarioError(
            f"intersection {crossing.id!r}: no light phase has a time above 0; give each its "
            "seconds"
        )
    places = _green_places(phases)
    runs: list[list[tuple[float, frozenset[int]]]] = []  # a green and what follows it
    for place in (*range(places[0], len(phases)), *range(places[0])):
        if place in places:
            runs.append([])
        runs[-1].append(phases[place])
    always = frozenset.intersection(*(phases[place][1] for place in places))
    usual_s = next((sum(s for s, _ in gap) for _, *gap in runs if gap), 0.0)
    greens: list[_Green] = []
    for (seconds, links), *gap in runs:
        clearance_s = sum(s for s, _ in gap) or usual_s
        going = frozenset[int].intersection(*(own for _, own in gap)) if gap else always
        greens.append(_Green(seconds, links, clearance_s, always | going))
    return greens


def _green_places(phases: Sequence[tuple[float, frozenset[int]]]) -> list[int]:
    """Return the positions of the green phases, in their order.

    A phase is none if it is short, its links have green in the greens before and after it, and one
    of these has more. Those with the fewest links go first: a time without green is no neighbour.
    """
    greens = list(range(len(phases)))

    def is_between(at: int) -> bool:
        seconds, links = phases[greens[at]]
        before, after = (phases[greens[n % len(greens)]][1] for n in (at - 1, at + 1))
        return seconds <= LONGEST_CLEARANCE_S and before | after != links <= before & after

    while between := [at for at in range(len(greens)) if is_between(at)]:
        del greens[min(between, key=lambda at: len(phases[greens[at]][1]))]
    return greens


def _letters(number_of: dict[int, int], numbers: frozenset[int]) -> set[int]:
    return {index for index, number in number_of.items() if number in numbers}


def _clearing(
    state: str, following: str, clearance_s: float, always: set[int]
) -> Iterator[tuple[float, str]]:
    """Yield yellow and red between two greens; always-green links stop while all is red."""
    if not any(a in "Gg" and b not in "Gg" for a, b in zip(state, following, strict=True)):
        return
    length_s = clearance_s or YELLOW_S + ALL_RED_S
    yellow_s = min(YELLOW_S, length_s)
    pairs = list(zip(state, following, strict=True))
    yield yellow_s, "".join("y" if a in "Gg" and b not in "Gg" else a for a, b in pairs)
    if length_s > yellow_s:
        kept = ("s" if index in always else "r" for index in range(len(state)))
        yield length_s - yellow_s, "".join(kept)


def write_routes(
    path: Path,
    net: Roadnet,
    out: Path,
    episode: tuple[float, float | None],
    reporter: Reporter,
    *,
    exact: bool,
) -> float:
    """Turn a ``flow.json`` into a route file.

    Vehicles keep their size, gap, accelerations and speed. Without `exact` they follow each other
    as in SUMO's defaults, with a headway of 1 s and some randomness. The SUMO versions of
    CityFlow's data sets do the same.

    Args:
        path: File with the flows.
        net: Roads and intersections that they use.
        out: The file to write.
        episode: Start and length of the episode, s. Flows without an end run to its end. Without a
            length they run to the end of the last flow that has one, and for at least one hour.
        reporter: Shows progress if the file is long.
        exact: True for CityFlow's headways and driving without randomness.

    Returns:
        Departure of the last vehicle, s.

    Raises:
        ScenarioError: The file is not a list of flows, or a flow is impossible; the message names
            the line.
    """
    routes = _Routes(net)
    types: dict[str, dict[str, str]] = {}
    drives: list[Drive] = []
    begin_s, length_s = episode

    @functools.cache  # most files need no second reading
    def end_s() -> float:
        return begin_s + length_s if length_s else max(begin_s + 3600.0, _latest_end_s(path))

    for number, (flow, line) in enumerate(objects(path, reporter)):
        where = f"{path}, line {line}: flow {number}"
        kind = types.setdefault(json.dumps(flow.get("vehicle"), sort_keys=True), {})
        if not kind:
            kind |= _vehicle_type(flow.get("vehicle"), f"car{len(types)}", where, exact=exact)
        route = routes.through(flow.get("route"), where)
        for i, depart_s in enumerate(_departures(flow, end_s, where)):
            drives.append(Drive(f"{number}.{i}", depart_s, route, kind["id"], "0"))
        if len(drives) > MOST_VEHICLES:
            raise ScenarioError(f"{where}: more than {MOST_VEHICLES} vehicles")
    if not drives:
        raise ScenarioError(f"{path}: no vehicle in it")
    drives.sort(key=lambda drive: drive.depart_s)  # stable: equal times keep the file's order
    write_drives(out, drives, types.values())
    return drives[-1].depart_s


def _latest_end_s(path: Path) -> float:
    """Return the end of the last flow that has one, s; 0 if none has."""
    ends = (flow.get("endTime") for flow, _ in objects(path, Silent()))
    numbers = (float(end) for end in ends if isinstance(end, int | float))
    return max([0.0, *filter(math.isfinite, numbers)])  # others are refused in their flows


def _departures(flow: Mapping[str, Any], end_s: Callable[[], float], where: str) -> Iterator[float]:
    """Yield a flow's departures in s, ``startTime`` to ``endTime`` (-1 is the episode's end)."""
    start, end, interval = (
        _number(flow, key, where, least=least)
        for key, least in (("startTime", 0.0), ("endTime", -1.0), ("interval", 0.0))
    )
    last = end_s() if end < 0 else end
    if end >= 0 and last < start:
        raise ScenarioError(f"{where}: endTime ({end:g}) is before startTime ({start:g})")
    if last > start and interval <= 0:
        raise ScenarioError(f"{where}: interval = {interval:g} must be above 0")
    steps = (last - start) / interval if last > start else 0.0
    if steps > MOST_VEHICLES:  # also infinite
        raise ScenarioError(f"{where}: more than {MOST_VEHICLES} vehicles")
    count = max(1, math.ceil(steps - 1e-9)) if end < 0 else 1 + int(steps + 1e-9)
    for i in range(count):
        yield start + i * interval


def _vehicle_type(raw: Any, name: str, where: str, *, exact: bool) -> dict[str, str]:
    """Return the attributes of a SUMO vehicle type for a vehicle of CityFlow."""
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
            # CityFlow: gap = headway * v. SUMO's Krauss model: gap = tau * v + minGap.
            # Both are equal at maxSpeed with tau = headway - minGap / maxSpeed.
            "tau": f"{max(value['headwayTime'] - value['minGap'] / value['maxSpeed'], 0.1):.3g}",
            "sigma": "0",
            "speedFactor": "1",
            "speedDev": "0",
        }
    return kind


def _number(raw: Mapping[str, Any], key: str, where: str, *, least: float) -> float:
    value = raw.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ScenarioError(f"{where}: {key!r} is missing or not a number")
    if value < least:
        raise ScenarioError(f"{where}: {key} = {value:g} must be at least {least:g}")
    return float(value)


class _Routes:
    """Routes through anchor roads; the shortest way joins two anchors that do not touch."""

    def __init__(self, net: Roadnet) -> None:
        self._net = net
        self._known: dict[tuple[str, ...], tuple[str, ...]] = {}

    def through(self, raw: Any, where: str) -> tuple[str, ...]:
        """Return the whole route through a list of anchors."""
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
        ahead: dict[str, list[str]] = {name: [] for name in self._net.roads}
        for crossing in self._net.crossings.values():
            for link in crossing.links:
                if link.lanes:
                    ahead[link.start].append(link.end)
        return ahead

    @cached_property
    def _length_m(self) -> dict[str, float]:
        return {name: _length(road.points) for name, road in self._net.roads.items()}

    def _between(self, start: str, goal: str, where: str) -> list[str]:
        """Return the roads after `start`, up to and including `goal` (Dijkstra)."""
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
