"""CityFlow's roads, turns and lights as a SUMO network: same geometry, lanes and phases.

CityFlow counts lanes from the middle of the road, SUMO from the kerb. Both draw lanes to the right
of the road's line and stop vehicles at a distance from the centre, which is kept.
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from ugat_marl.files import parse_xml, read_bytes, write_whole, xml_bytes
from ugat_marl.scenarios.importers.cityflow import Crossing, Point, Road, Roadnet
from ugat_marl.scenarios.importers.programs import netconvert
from ugat_marl.scenarios.junctions import foes_of, links_of, yields_of
from ugat_marl.scenarios.phases import RightOfWay, state_of

YELLOW_S, ALL_RED_S = 3.0, 2.0
LONGEST_CLEARANCE_S = 10.0


def write_network(net: Roadnet, out: Path) -> list[str]:
    """Makes the SUMO network.

    Args:
        net: The roads.
        out: The ``.net.xml`` to write.

    Returns:
        What was noticed on the way.

    Raises:
        ScenarioError: netconvert refused.
    """
    documents = {
        "--node-files": _nodes(net),
        "--edge-files": _edges(net),
        "--connection-files": _connections(net),
        "--tllogic-files": _lights(net),
    }
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        arguments: list[str] = []
        for option, root in documents.items():
            file = Path(name) / f"{option.strip('-')}.xml"
            write_whole(file, xml_bytes(root))
            arguments += [option, str(file)]
        arguments += ["--no-turnarounds", "true", "--offset.disable-normalization", "true"]
        arguments += ["--junctions.limit-turn-speed", "-1", "--tls.yellow.time", "3"]
        netconvert(arguments, Path(name) / "out.net.xml")
        root = parse_xml(read_bytes(Path(name) / "out.net.xml"), str(out))
    notes = _set_programmes(root, net)
    write_whole(out, xml_bytes(root))
    return notes


def has_light(crossing: Crossing) -> bool:
    """Whether an intersection has a traffic light: two phases that differ."""
    return not crossing.virtual and len({frozenset(links) for _, links in crossing.phases}) > 1


def _nodes(net: Roadnet) -> ET.Element:
    root = ET.Element("nodes")
    for crossing in net.crossings.values():
        kind = "dead_end" if crossing.virtual else "priority"
        attributes = {
            "id": crossing.id,
            "x": f"{crossing.point[0]:g}",
            "y": f"{crossing.point[1]:g}",
        }
        if has_light(crossing):
            kind = "traffic_light"
            attributes["tl"] = crossing.id
        if not crossing.virtual and (shape := _stop_lines(crossing, net)):
            attributes["shape"] = shape
        # No road is the main one: straight on goes before turns, as in CityFlow.
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
            ET.SubElement(root, "connection", {"from": road.id})  # nothing leads on
    for crossing in net.crossings.values():
        for _, attributes in _ways(crossing, net):
            ET.SubElement(root, "connection", attributes)
    return root


def _lights(net: Roadnet) -> ET.Element:
    """Which letter belongs to which way; the states come later, when the conflicts are known."""
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
    """Every way across with the number of its road link, in the order of the file."""
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
    """A polygon through the ends of all stop lines; empty if roads begin at the centre."""
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
    """Both ends of the line across a road at a distance from the intersection's centre."""
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
    """Writes the light phases into the network, now that it is known who has to wait for whom."""
    links = links_of(root)
    rules = RightOfWay(foes_of(root), yields_of(root))
    without: list[str] = []
    for logic in root.iter("tlLogic"):
        crossing = net.crossings[logic.get("id", "")]
        own = links.get(crossing.id, [])
        number_of = dict(enumerate(number for number, _ in _ways(crossing, net)))
        width = len(number_of)
        for phase in list(logic):
            logic.remove(phase)
        greens, clearance_s, always = _split(crossing)
        if not clearance_s:
            without.append(crossing.id)
        states = [
            state_of([k for k in own if number_of[k.index] in green], own, rules, width)
            for _, green in greens
        ]
        for place, (seconds, _) in enumerate(greens):
            following = states[(place + 1) % len(states)]
            ET.SubElement(logic, "phase", duration=f"{seconds:g}", state=states[place])
            for duration, state in _clearing(
                states[place], following, clearance_s, _letters(number_of, always)
            ):
                ET.SubElement(logic, "phase", duration=f"{duration:g}", state=state)
    if without:
        return [
            f"{len(without)} lights have no phase between two greens (the first: {without[0]!r}); "
            f"{YELLOW_S:g} s of yellow and {ALL_RED_S:g} s of red were put in"
        ]
    return []


def _split(
    crossing: Crossing,
) -> tuple[list[tuple[float, frozenset[int]]], float, frozenset[int]]:
    """The green phases, the seconds between two of them, and what goes all the time.

    CityFlow's files hold the time between two greens as a phase of its own, usually the first, in
    which only those may go who may always go.
    """
    phases = [(seconds, frozenset(links)) for seconds, links in crossing.phases if seconds > 0]
    greens = [
        phase
        for phase in phases
        if phase[0] > LONGEST_CLEARANCE_S or not all(phase[1] <= other for _, other in phases)
    ]
    greens = greens or phases
    between = [phase for phase in phases if phase not in greens]
    always = frozenset.intersection(*(links for _, links in greens))
    return greens, between[0][0] if between else 0.0, always


def _letters(number_of: dict[int, int], numbers: frozenset[int]) -> set[int]:
    return {index for index, number in number_of.items() if number in numbers}


def _clearing(
    state: str, following: str, clearance_s: float, always: set[int]
) -> Iterator[tuple[float, str]]:
    """Yellow and red between two greens; who may always go stops first, while all is red."""
    if not any(a in "Gg" and b not in "Gg" for a, b in zip(state, following, strict=True)):
        return
    length_s = clearance_s or YELLOW_S + ALL_RED_S
    yellow_s = min(YELLOW_S, length_s)
    pairs = list(zip(state, following, strict=True))
    yield yellow_s, "".join("y" if a in "Gg" and b not in "Gg" else a for a, b in pairs)
    if length_s > yellow_s:
        kept = ("s" if index in always else "r" for index in range(len(state)))
        yield length_s - yellow_s, "".join(kept)
