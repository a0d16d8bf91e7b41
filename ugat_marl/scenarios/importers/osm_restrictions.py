"""Turn restrictions of an OpenStreetMap extract, for a network made by netconvert.

netconvert keeps the restrictions of junctions that are one node, and loses those of junctions that
it joins from several. This file finds the turns that are left of them and lists them for netconvert
to delete.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from ugat_marl.files import Tag, xml_bytes


@dataclass(frozen=True)
class Restriction:
    """A turn restriction for cars.

    Attributes:
        from_way: Id of the way on which cars come.
        via: Id of the node between both ways; empty if they lie between other ways.
        to_way: Id of the way that they may not take, or must take.
        only: True if they must take it.
    """

    from_way: str
    via: str
    to_way: str
    only: bool


class ForbiddenTurns(NamedTuple):
    """Turns that a network must not have.

    Attributes:
        turns: The turns, from edge to edge.
        unplaced: Number of restrictions whose turns are not known: at a joined junction one of
            whose ways has become a part of it, or from one junction over a way to another.
    """

    turns: list[tuple[str, str]]
    unplaced: int


def restriction_of(tags: Mapping[str, str], members: Iterable[Tag]) -> Restriction | None:
    """Return the restriction that a relation holds; None if it holds none for all cars.

    Args:
        tags: Keys and values of the relation.
        members: Its members.
    """
    kind = tags.get("restriction:motorcar", tags.get("restriction", ""))
    if tags.get("type") != "restriction" or not kind.startswith(("no_", "only_")):
        return None
    if "motorcar" in tags.get("except", ""):
        return None
    places: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for member in members:
        given = member.attributes
        places[given.get("role", "")].append((given.get("type", ""), given.get("ref", "")))
    match places["from"], places["via"], places["to"]:
        case [("way", start)], via, [("way", goal)]:
            node = via[0][1] if len(via) == 1 and via[0][0] == "node" else ""
            return Restriction(start, node, goal, kind.startswith("only_"))
        case _:
            return None


def nodes_of(junction: str) -> list[str]:
    """Return the nodes of the map in a junction; the name of a joined one tells at most four."""
    return junction.removeprefix("cluster_").split("_") if "cluster" in junction else [junction]


def forbidden_turns(root: ET.Element, restrictions: Iterable[Restriction]) -> ForbiddenTurns:
    """Find the turns of a network that restrictions forbid.

    Args:
        root: The network.
        restrictions: The restrictions of its extract.
    """
    arriving: dict[tuple[str, str], list[str]] = defaultdict(list)
    leaving: dict[tuple[str, str], list[str]] = defaultdict(list)
    junctions: dict[str, list[str]] = defaultdict(list)
    for edge in root.iter("edge"):
        name = edge.get("id", "")
        if edge.get("function") is None:
            way = name.removeprefix("-").partition("#")[0]
            arriving[edge.get("to", ""), way].append(name)
            leaving[edge.get("from", ""), way].append(name)
    for junction in root.iter("junction"):
        name = junction.get("id", "")
        for node in nodes_of(name):
            junctions[node].append(name)
    turns: dict[str, set[str]] = defaultdict(set)
    for link in root.iter("connection"):
        if not link.get("from", ":").startswith(":"):
            turns[link.get("from", "")].add(link.get("to", ""))
    ways = {way for _, way in arriving}
    joined = {name for names in junctions.values() for name in names if "cluster" in name}
    touching = {way for end, way in (*arriving, *leaving) if end in joined}
    unplaced = 0
    found: dict[tuple[str, str], None] = {}
    for one in restrictions:
        # The name of a joined junction tells four of its nodes, and no way that has become a part
        # of it: the others are known by the two ways that meet there.
        known = junctions.get(one.via, [])
        places = known or [
            name
            for name in joined
            if (name, one.from_way) in arriving and (name, one.to_way) in leaving
        ]
        both = {one.from_way, one.to_way}
        match [
            (start, goal)
            for place in places
            for start in arriving.get((place, one.from_way), ())
            for goal in leaving.get((place, one.to_way), ())
        ]:
            case [(start, goal)]:
                forbidden = turns[start] - {goal} if one.only else turns[start] & {goal}
                if forbidden != turns[start]:  # an edge without any way on would be a mistake
                    found.update(dict.fromkeys((start, each) for each in sorted(forbidden)))
            case _ if both <= ways:
                unplaced += not known or known[0] in joined  # at others, netconvert has obeyed it
            case _:
                unplaced += bool(both & touching or joined.intersection(known))
    return ForbiddenTurns(list(found), unplaced)


def deleted_connections(turns: Iterable[tuple[str, str]]) -> bytes:
    """Return turns as a file of connections that netconvert deletes."""
    root = ET.Element("connections")
    for start, goal in turns:
        ET.SubElement(root, "delete", {"from": start, "to": goal})
    return xml_bytes(root)
