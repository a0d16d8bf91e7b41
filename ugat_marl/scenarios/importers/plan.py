"""A road network as a short plan, and the SUMO network made from it.

The `source.toml` of a shipped scenario holds either a grid or single junctions and roads. The lanes
of an approach are listed from the kerb to the middle of the road, each with its turns at the next
junction. ``["sr", "l"]`` means a lane for straight on and right, and a lane for left.
"""

from __future__ import annotations

import math
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import write_whole, xml_bytes
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.making import NETWORK, RoadFiles, RoadSource
from ugat_marl.scenarios.naming import letters
from ugat_marl.scenarios.sumo_tools import netconvert

TURNS = {"l": "left", "s": "straight", "r": "right"}
STRAIGHT_WITHIN_DEG = 45.0
"""Largest angle between an approach and a road ahead that counts as straight on."""


SIDE_STREET = ("sr", "l")
MAIN_ROAD = ("sr", "s", "l")
NETCONVERT = {
    "tls.cycle.time": 90, "tls.left-green.time": 10, "tls.minor-left.max-speed": 0,
    "tls.yellow.time": 3, "tls.allred.time": 2,
    # turns are driven as slowly as their radius asks; netconvert warns of it on fast roads
    "junctions.limit-turn-speed.warn.straight": 100, "junctions.limit-turn-speed.warn.turn": 100,
}  # fmt: skip
MOST = 2500
"""Most intersections in a grid."""


@dataclass(frozen=True)
class Node:
    """A signalised junction, or an end of the network; coordinates are in metres."""

    id: str
    x: float
    y: float
    signal: bool


@dataclass(frozen=True)
class Road:
    """Carriageway between two nodes.

    Attributes:
        start: Node at its start.
        end: Node at its end.
        lanes: Turns of each lane, kerb first.
        speed_mps: Speed limit; None for the network's.
    """

    start: str
    end: str
    lanes: tuple[str, ...]
    speed_mps: float | None = None

    @property
    def id(self) -> str:
        """The edge id in SUMO."""
        return f"{self.start}_{self.end}"


@dataclass(frozen=True)
class RoadPlan:
    """Nodes and roads by id, from which the network is made."""

    nodes: dict[str, Node]
    roads: dict[str, Road]

    def heading_deg(self, road: Road) -> float:
        """Return the direction of travel in degrees, anticlockwise from east."""
        start, end = self.nodes[road.start], self.nodes[road.end]
        return math.degrees(math.atan2(end.y - start.y, end.x - start.x))

    def exits(self, approach: Road) -> dict[str, Road]:
        """Return the road after each turn (``l``, ``s``, ``r``) at the end of `approach`."""
        by_turn: dict[str, Road] = {}
        for road in self.roads.values():
            if road.start != approach.end or road.end == approach.start:
                continue
            bend = (self.heading_deg(road) - self.heading_deg(approach) + 180) % 360 - 180
            turn = "s" if abs(bend) < STRAIGHT_WITHIN_DEG else "l" if bend > 0 else "r"
            if turn in by_turn:
                raise ScenarioError(f"{approach.id}: two roads ahead count as {TURNS[turn]}")
            by_turn[turn] = road
        return by_turn

    def connections(self, approach: Road) -> list[tuple[int, Road, int]]:
        """Return (lane, road entered, lane entered) for every lane and turn of `approach`.

        Right turns enter the lane at the kerb, left turns the lane at the middle. Through lanes
        keep their order, and the innermost one may enter all remaining lanes. Through traffic
        therefore conflicts with left turns from other sides, and a junction with four arms has the
        usual eight conflict-free phases.
        """
        exits = self.exits(approach)
        through = [lane for lane, turns in enumerate(approach.lanes) if "s" in turns]
        connected: list[tuple[int, Road, int]] = []
        for lane, turns in enumerate(approach.lanes):
            for turn in turns:
                if turn not in exits:
                    raise ScenarioError(f"{approach.id} lane {lane}: no road to the {TURNS[turn]}")
                count = len(exits[turn].lanes)
                entered = {"r": range(1), "l": range(count - 1, count)}.get(turn)
                if entered is None:
                    order = through.index(lane)
                    entered = range(order, count if lane == through[-1] else order + 1)
                if not entered:
                    raise ScenarioError(f"{approach.id}: more lanes straight on than the road has")
                connected.extend((lane, exits[turn], target) for target in entered)
        return connected


def read_road_plan(source: Mapping[str, Any]) -> RoadPlan:
    """Return the plan in a parsed `source.toml`: its table ``grid`` or ``junctions``/``roads``."""
    if "grid" in source:
        return grid(**source["grid"])
    nodes = {
        id_: Node(id_, *map(float, place), signal=kind == "junctions")
        for kind in ("junctions", "ends")
        for id_, place in source[kind].items()
    }
    roads: dict[str, Road] = {}
    for entry in source["roads"]:
        here, there = entry["between"]
        for road in (
            Road(here, there, tuple(entry["there"])),
            Road(there, here, tuple(entry["back"])),
        ):
            roads[road.id] = road
    return RoadPlan(nodes, roads)


def grid(
    columns: int,
    rows: int,
    spacing_m: float,
    entry_m: float,
    east_west: Sequence[str],
    north_south: Sequence[str],
) -> RoadPlan:
    """Return a grid: junctions A1 (south-west), B1, ..., A2, ...; ends west1, east1, southA, ...

    Args:
        columns: Number of junctions from west to east.
        rows: Number of junctions from south to north.
        spacing_m: Distance between neighbouring junctions.
        entry_m: Length of the roads into the network.
        east_west: Lanes of the roads along the rows, kerb first, each with its turns.
        north_south: Lanes of the roads along the columns, kerb first, each with its turns.
    """
    nodes: dict[str, Node] = {}
    roads: dict[str, Road] = {}
    xs = [column * spacing_m for column in range(columns)]
    ys = [row * spacing_m for row in range(rows)]
    for name, chain in lattice(xs, ys, lambda: entry_m):
        lanes = tuple(east_west if name.isdigit() else north_south)
        nodes |= {node.id: node for node in chain}
        for here, there in pairwise(chain):
            for road in (Road(here.id, there.id, lanes), Road(there.id, here.id, lanes)):
                roads[road.id] = road
    return RoadPlan(nodes, roads)


def lattice(
    xs: Sequence[float], ys: Sequence[float], entry_m: Callable[[], float]
) -> Iterator[tuple[str, list[Node]]]:
    """Yield the rows of a grid, then its columns: name, and nodes from west or south.

    Rows are called 1, 2, ... and columns A, B, ...; `grid` says how their nodes are called.

    Args:
        xs: Coordinates of the columns, m.
        ys: Coordinates of the rows, m.
        entry_m: Function that returns the length of the next road into the network, m: at the west
            and the east of each row, then at the south and the north of each column.
    """
    names = [letters(number).upper() for number in range(len(xs))]
    for row, y in enumerate(ys, 1):
        inner = [Node(f"{name}{row}", x, y, True) for name, x in zip(names, xs, strict=True)]
        west = Node(f"west{row}", -entry_m(), y, False)
        yield str(row), [west, *inner, Node(f"east{row}", xs[-1] + entry_m(), y, False)]
    for name, x in zip(names, xs, strict=True):
        inner = [Node(f"{name}{row}", x, y, True) for row, y in enumerate(ys, 1)]
        south = Node(f"south{name}", x, -entry_m(), False)
        yield name, [south, *inner, Node(f"north{name}", x, ys[-1] + entry_m(), False)]


def coordinate(metres: float) -> str:
    """Return a coordinate for netconvert; far from the origin six digits are too few."""
    return f"{metres:g}" if abs(metres) < 10_000 else f"{metres:.2f}"


def netconvert_documents(plan: RoadPlan, speed_mps: float) -> dict[str, bytes]:
    """Return the three plain-XML documents of netconvert, by the option that takes them."""
    nodes, edges, connections = ET.Element("nodes"), ET.Element("edges"), ET.Element("connections")
    for node in plan.nodes.values():
        kind = "traffic_light" if node.signal else "dead_end"
        ET.SubElement(
            nodes, "node", id=node.id, x=coordinate(node.x), y=coordinate(node.y), type=kind
        )
    for road in plan.roads.values():
        attributes = {"id": road.id, "from": road.start, "to": road.end}
        limit = speed_mps if road.speed_mps is None else road.speed_mps
        ET.SubElement(edges, "edge", attributes, numLanes=str(len(road.lanes)), speed=f"{limit:g}")
        if not plan.nodes[road.end].signal:
            continue
        for lane, entered, target in plan.connections(road):
            link = {"from": road.id, "to": entered.id, "fromLane": str(lane), "toLane": str(target)}
            ET.SubElement(connections, "connection", link)
    return {
        "--node-files": xml_bytes(nodes),
        "--edge-files": xml_bytes(edges),
        "--connection-files": xml_bytes(connections),
    }


def build_network(
    documents: Mapping[str, bytes], options: Mapping[str, Any], *, strict: bool = True
) -> bytes:
    """Return the ``.net.xml`` that netconvert makes, without its comment with date and paths.

    Args:
        documents: Documents such as those of `netconvert_documents`, by the option that takes them.
        options: Further options of netconvert, without the leading dashes.
        strict: True to refuse a network of which netconvert warns.

    Raises:
        ScenarioError: netconvert refused, or warned and `strict` is True; the message quotes it.
    """
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as folder:
        arguments: list[str] = []
        for option, document in documents.items():
            file = Path(folder) / f"{option.strip('-')}.xml"
            file.write_bytes(document)
            arguments += [option, str(file)]
        arguments += ["--no-turnarounds", "true", "--offset.disable-normalization", "true"]
        for name, value in options.items():
            arguments += [
                f"--{name}",
                str(value).lower() if isinstance(value, bool) else str(value),
            ]
        output = Path(folder) / "network.net.xml"
        if (warnings := netconvert(arguments, output)) and strict:
            raise ScenarioError(f"netconvert: {warnings}")
        return output.read_bytes()


def grid_roads(text: str, spacing_m: float, speed_mps: float) -> RoadSource:
    """Return a source of a grid of roads.

    Args:
        text: Rows and columns, as in ``4x5``.
        spacing_m: Distance between intersections, and length of the roads into the network.
        speed_mps: Speed limit.

    Raises:
        OptionError: The text is not a size, or a value is out of range.
    """
    match = re.fullmatch(r"(\d{1,4})[x×X](\d{1,4})", text.strip())
    rows, columns = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (rows and columns and rows * columns <= MOST):
        raise OptionError(
            f"--grid {text!r}: give rows and columns, as in 4x4; at most {MOST} intersections"
        )
    _check(spacing_m, speed_mps)
    plan = grid(columns, rows, spacing_m, spacing_m, SIDE_STREET, SIDE_STREET)
    words = f"{rows} by {columns} intersections, {spacing_m:g} m apart"
    return _drawn(plan, speed_mps, f"A grid of {words}")


def arterial_roads(count: int, spacing_m: float, speed_mps: float) -> RoadSource:
    """Return a source of a main road from west to east with side streets.

    Args:
        count: Number of intersections.
        spacing_m: Distance between intersections, and length of the roads into the network.
        speed_mps: Speed limit.

    Raises:
        OptionError: A value is out of range.
    """
    if not 1 <= count <= MOST:
        raise OptionError(f"--arterial {count}: give 1 to {MOST} intersections")
    _check(spacing_m, speed_mps)
    plan = grid(count, 1, spacing_m, spacing_m, MAIN_ROAD, SIDE_STREET)
    words = f"{count} intersections, {spacing_m:g} m apart"
    return _drawn(plan, speed_mps, f"A main road with {words}")


def _check(spacing_m: float, speed_mps: float) -> None:
    if not 50 <= spacing_m <= 5000:
        raise OptionError(f"--spacing-m {spacing_m:g} is not within 50 to 5000 m")
    if not 1 <= speed_mps <= 60:
        raise OptionError(f"--speed-mps {speed_mps:g} is not within 1 to 60 m/s")


def _drawn(plan: RoadPlan, speed_mps: float, description: str) -> RoadSource:
    def roads(folder: Path, reporter: Reporter) -> RoadFiles:
        write_whole(
            folder / NETWORK, build_network(netconvert_documents(plan, speed_mps), NETCONVERT)
        )
        return RoadFiles(
            description,
            "Drawn by the suite and built by SUMO's netconvert: every approach has a lane for left "
            f"turns beside those straight on and right; the speed limit is {speed_mps:g} m/s, and "
            "there are no U-turns. Nobody else has rights in it.",
            settings={"control": {"phases": "conflict-free"}},
        )

    return roads
