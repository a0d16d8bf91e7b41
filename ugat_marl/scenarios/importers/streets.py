"""Roads for cars in a network: entries, exits, and the roads ahead of every road."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from ugat_marl.scenarios.junctions import cars_may_use, lanes_without_cars, leads_cars

TURNS = {"L": "l", "R": "r", "T": "t"}
"""SUMO's letters for partial turns and U-turns, to the letters used here."""


@dataclass(frozen=True)
class Streets:
    """The roads for cars (SUMO's edges).

    Attributes:
        start: Road to the junction at its start.
        end: Road to the junction at its end.
        ahead: Road to the roads ahead, by turn: ``s``, ``l``, ``r`` or ``t`` (back).
        entries: Roads into the network: no road leads to them except back from the other direction
            of the same street.
        exits: Roads out of the network: they lead to no road except back into their street.
    """

    start: Mapping[str, str]
    end: Mapping[str, str]
    ahead: Mapping[str, Mapping[str, tuple[str, ...]]]
    entries: tuple[str, ...]
    exits: frozenset[str]

    @classmethod
    def of(cls, root: ET.Element) -> Streets:
        """Return the roads for cars of a ``<net>``."""
        start: dict[str, str] = {}
        end: dict[str, str] = {}
        for edge in root.iter("edge"):
            outside = edge.get("function", "normal") == "normal"
            if outside and any(map(cars_may_use, edge.iter("lane"))):
                start[edge.get("id", "")] = edge.get("from", "")
                end[edge.get("id", "")] = edge.get("to", "")
        closed = lanes_without_cars(root)
        ahead: dict[str, dict[str, dict[str, None]]] = defaultdict(lambda: defaultdict(dict))
        for element in root.iter("connection"):
            here, there = element.get("from", ""), element.get("to", "")
            if here in start and there in start and leads_cars(element, closed):
                letter = element.get("dir", "s")
                ahead[here][TURNS.get(letter, letter)][there] = None
        reached: set[str] = set()
        left: set[str] = set()
        onward, behind = neighbours(ahead)
        for here, turns in ahead.items():
            # At its edge SUMO lets vehicles turn back, into a street that may be in pieces.
            at_edge = set(turns) == {"t"}
            came = {start[road] for road in (_in_line(here, behind) if at_edge else [here])}
            for there in (road for roads in turns.values() for road in roads):
                goes = {end[road] for road in (_in_line(there, onward) if at_edge else [there])}
                if start[there] != end[here] or came.isdisjoint(goes):
                    reached.add(there)
                    left.add(here)
        return cls(
            start,
            end,
            {
                road: {t: tuple(roads) for t, roads in turns.items()}
                for road, turns in ahead.items()
            },
            tuple(road for road in start if road not in reached and road in left),
            frozenset(road for road in start if road not in left),
        )


def neighbours(
    ahead: Mapping[str, Mapping[str, Iterable[str]]],
) -> tuple[dict[str, dict[str, None]], dict[str, dict[str, None]]]:
    """Return the roads ahead of and behind every road but for U-turns, as keys in their order.

    Args:
        ahead: Road to the roads ahead, by turn, as in `Streets`.
    """
    onward: dict[str, dict[str, None]] = defaultdict(dict)
    behind: dict[str, dict[str, None]] = defaultdict(dict)
    for here, turns in ahead.items():
        for there in (road for turn, roads in turns.items() if turn != "t" for road in roads):
            onward[here][there] = None
            behind[there][here] = None
    return onward, behind


def _in_line(road: str, neighbours: Mapping[str, Collection[str]]) -> list[str]:
    """Return a road and those that follow one another from it without a choice."""
    roads = [road]
    while len(following := neighbours.get(roads[-1], ())) == 1:
        (after,) = following
        if after in roads:
            break
        roads.append(after)
    return roads
