"""Names that people use: streets, directions of approaches, turns and intersections.

A direction is that of travel, as on sheets of counts and in signal plans: a northbound approach
comes from the south. The y axis of a network points north.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from ugat_marl.scenarios.junctions import Link
from ugat_marl.scenarios.network import Lane, Network

MAIN_DIRECTIONS = ("northbound", "eastbound", "southbound", "westbound")
ALL_DIRECTIONS = (
    "northbound", "northeastbound", "eastbound", "southeastbound",
    "southbound", "southwestbound", "westbound", "northwestbound",
)  # fmt: skip
TURN_NAMES = {"l": "left", "L": "left", "s": "through", "r": "right", "R": "right",
              "t": "u-turn", "T": "u-turn"}  # fmt: skip
"""SUMO's letter of a direction to the name of the turn."""
_TURN_ORDER = ("left", "through", "right", "u-turn")
_HEADING_M = 30.0
"""Length of road before the stop line whose direction counts, m; less is a kerb, more a bend."""
_FARTHEST_RAD = math.radians(60.0)
"""Largest angle between a road and a name of the four main directions; 45° are between two."""
_MOST_STREETS = 3


@dataclass(frozen=True)
class NamedTurn:
    """One way across an intersection, from road to road, with its names.

    Attributes:
        light: SUMO id of the traffic light.
        street: Street it comes from; empty if the network has no name for it.
        approach: Direction of travel, such as ``northbound``.
        turn: ``left``, ``through``, ``right`` or ``u-turn``.
        to_street: Street it leads to; empty if the network has no name for it.
        from_edge: SUMO id of the road it comes from.
        to_edge: SUMO id of the road it leads to.
    """

    light: str
    street: str
    approach: str
    turn: str
    to_street: str
    from_edge: str
    to_edge: str


def named_turns(
    light: str, links: Sequence[Link], lanes: Mapping[str, Lane], streets: Mapping[str, str]
) -> tuple[NamedTurn, ...]:
    """Return the turns of a traffic light, clockwise by approach, and from left to right.

    Args:
        light: SUMO id of the traffic light.
        links: Its links for vehicles.
        lanes: Lanes of the network.
        streets: Road (SUMO's edge) to the name of its street.
    """
    approaches = approach_directions(links, lanes)
    turns = {
        (link.from_edge, link.to_edge): NamedTurn(
            light,
            streets.get(link.from_edge, ""),
            approaches[link.from_edge],
            TURN_NAMES.get(link.direction, "through"),
            streets.get(link.to_edge, ""),
            link.from_edge,
            link.to_edge,
        )
        for link in links
    }
    return tuple(
        sorted(
            turns.values(),
            key=lambda turn: (
                ALL_DIRECTIONS.index(turn.approach),
                turn.from_edge,
                _TURN_ORDER.index(turn.turn),
                turn.to_edge,
            ),
        )
    )


@dataclass(frozen=True)
class NamedApproach:
    """A road that leads to a traffic light, with its names.

    Attributes:
        light: SUMO id of the traffic light.
        intersection: Streets that meet there; empty if they have no names.
        street: Street of the road; empty if the network has no name for it.
        direction: Direction of travel, such as ``northbound``.
        edge: SUMO id of the road.
    """

    light: str
    intersection: str
    street: str
    direction: str
    edge: str

    @property
    def name(self) -> str:
        """Street and direction, as in ``Long Road, eastbound``."""
        return f"{self.street}, {self.direction}" if self.street else self.direction


def named_approaches(network: Network) -> dict[str, NamedApproach]:
    """Return the approaches of all agents by road, clockwise at each light."""
    approaches: dict[str, NamedApproach] = {}
    for light in network.intersections:
        name = intersection_name(light.links, network.streets)
        directions = approach_directions(light.links, network.lanes)
        for edge in sorted(directions, key=lambda edge: ALL_DIRECTIONS.index(directions[edge])):
            street = network.streets.get(edge, "")
            approaches[edge] = NamedApproach(light.id, name, street, directions[edge], edge)
    return approaches


def approach_directions(links: Iterable[Link], lanes: Mapping[str, Lane]) -> dict[str, str]:
    """Return the direction of travel of each road that leads to a traffic light.

    Up to eight roads get different names, chosen together so that the squared angles between name
    and road are least. Up to four roads get the four main directions, unless one of them would be
    farther than `_FARTHEST_RAD` from its name; others get all eight. Roads between two junctions of
    the light, as in the middle of a wide dual carriageway, get what is left.

    Args:
        links: Links for vehicles of the traffic light.
        lanes: Lanes of the network.
    """
    links = tuple(links)
    # In order of their ids: of two roads with one heading the same one gets the better name always.
    headings: dict[str, float] = {}
    for edge, lane in sorted((link.from_edge, link.from_lane) for link in links):
        if edge not in headings:
            headings[edge] = heading_rad(lanes[lane].shape)
    inside = {link.to_edge for link in links}
    outer = {edge: heading for edge, heading in headings.items() if edge not in inside}
    directions = _nearest_names(outer, MAIN_DIRECTIONS)
    angles = [_between(outer[edge], _angle_of(name)) for edge, name in directions.items()]
    if len(outer) > len(MAIN_DIRECTIONS) or max(angles, default=0.0) > _FARTHEST_RAD:
        directions = _nearest_names(outer, ALL_DIRECTIONS)
    inner = {edge: heading for edge, heading in headings.items() if edge in inside}
    left = [name for name in ALL_DIRECTIONS if name not in directions.values()]
    directions |= _nearest_names(inner, left if len(inner) <= len(left) else ALL_DIRECTIONS)
    return {edge: directions[edge] for edge in headings}


def _nearest_names(headings: Mapping[str, float], names: Sequence[str]) -> dict[str, str]:
    """Return a name for each road, different ones if there are enough."""
    places = [*map(_angle_of, names)]
    costs = [[_between(heading, place) ** 2 for place in places] for heading in headings.values()]
    table = np.array(costs).reshape(len(headings), len(names))
    if len(headings) > len(names):
        chosen = table.argmin(axis=1)
    else:
        _, chosen = optimize.linear_sum_assignment(table)
    return {edge: names[int(place)] for edge, place in zip(headings, chosen, strict=True)}


def _angle_of(name: str) -> float:
    """Return the angle of a direction, clockwise from north, rad."""
    return 2 * math.pi * ALL_DIRECTIONS.index(name) / len(ALL_DIRECTIONS)


def heading_rad(shape: Sequence[tuple[float, float]]) -> float:
    """Return the direction of the last metres of a line, clockwise from north, rad."""
    end, start, left_m = shape[-1], shape[-1], _HEADING_M
    for before, after in zip(reversed(shape[:-1]), reversed(shape[1:]), strict=True):
        length_m = math.dist(before, after)
        if length_m >= left_m:
            share = left_m / length_m
            start = tuple(b + share * (a - b) for a, b in zip(before, after, strict=True))
            break
        start, left_m = before, left_m - length_m
    return math.atan2(end[0] - start[0], end[1] - start[1])


def _between(a_rad: float, b_rad: float) -> float:
    """Return the angle between two directions, 0 to pi."""
    return abs((a_rad - b_rad + math.pi) % (2 * math.pi) - math.pi)


def intersection_name(links: Iterable[Link], streets: Mapping[str, str]) -> str:
    """Return the streets that meet at a traffic light, as in ``Long Road / Cross Street``.

    Args:
        links: Links for vehicles of the traffic light.
        streets: Road (SUMO's edge) to the name of its street.

    Returns:
        At most three names, those of the most links first; empty if no street has a name.
    """
    counts: dict[str, int] = {}
    for link in links:
        for edge in (link.from_edge, link.to_edge):
            if name := streets.get(edge):
                counts[name] = counts.get(name, 0) + 1
    busiest = sorted(counts, key=lambda name: (-counts[name], name))
    return " / ".join(busiest[:_MOST_STREETS])
