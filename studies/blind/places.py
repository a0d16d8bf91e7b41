"""Places of a scenario with enough traffic to show a hidden effect."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from ugat_marl.diagnosis import Routes
from ugat_marl.effects import (
    EVERYWHERE,
    detectors_at,
    group_name,
    network_places,
    next_detectors,
)
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Detector, Network, Scenario
from ugat_marl.seeding import derive_seed

TURN_PER_HOUR = 60.0
"""Least vehicles per hour on a turn to which others are diverted."""
BUSY_PER_HOUR = 120.0
"""Least vehicles per hour of a busy origin, detector or lane."""
YIELDING_PER_HOUR = 200.0
"""Least vehicles per hour on a turn that shows how drivers yield."""
LONG_M = 50.0
"""Least length in metres of a lane to close or to park on."""


@dataclass(frozen=True)
class Busy:
    """Places at which effects can be hidden.

    Attributes:
        lights: Traffic lights that agents control.
        origins: Edges where vehicles start, and the vehicles per hour of `telling`.
        turns: ``(from, to)`` edges of turns at traffic lights.
        closable: Lanes before a traffic light with a lane beside them.
        lanes: Lanes before a traffic light.
        edges: Edges before a traffic light.
        detectors: Detectors.
        groups: Places of groups of detectors: all, those of a kind, those of a kind on an edge.
        beside: Those of `groups` with a busy detector of the same kind on a next lane.
        room_m: Lengths of lane before and behind all detectors of such a place, m. Behind advance
            detectors it ends at the next detector.
        pairs: Detectors of one kind on neighbouring lanes that count differently.
        permitted: True if enough drivers have to yield on a green.
        several_lanes: True if an approach has more than one lane.
    """

    lights: tuple[str, ...]
    origins: Mapping[str, float]
    turns: tuple[tuple[str, str], ...]
    closable: tuple[str, ...]
    lanes: tuple[str, ...]
    edges: tuple[str, ...]
    detectors: tuple[str, ...]
    groups: tuple[str, ...]
    beside: tuple[str, ...]
    room_m: Mapping[str, tuple[float, float]]
    pairs: tuple[tuple[str, str], ...]
    permitted: bool
    several_lanes: bool


def busy_places(scenario: Scenario, seed: int) -> Busy:
    """Count the demand, and play one day to count the vehicles on each lane.

    Args:
        scenario: Scenario of the simulation.
        seed: Root of the seed of this day.
    """
    network = Network.read(scenario)
    rates, detectors = _detected(scenario, seed)
    routes = Routes.of(scenario)
    turns = {(edge, other): n for edge, far in routes.turns.items() for other, n in far.items()}
    incoming = {lane for item in network.intersections for lane in item.incoming_lanes}
    approaches = {network.lanes[lane].edge for lane in incoming}
    lanes = [
        lane
        for lane in sorted(incoming)
        if rates.get(f"stop:{lane}", 0.0) >= BUSY_PER_HOUR
        and network.lanes[lane].length_m >= LONG_M
    ]
    places = network_places(scenario)
    counted = {network.lanes[item.lane].edge for item in detectors}
    cars = Counter(item.edge for item in places.lanes.values() if item.cars)
    ways = {
        (edge, other) for edge in sorted(approaches) for other in places.following.get(edge, ())
    }
    groups = _groups(detectors, rates, network)
    return Busy(
        lights=tuple(item.id for item in network.intersections),
        origins={
            origin: rate
            for origin in sorted(routes.origins)
            if (rate := telling(routes, origin, counted)) >= BUSY_PER_HOUR
        },
        turns=tuple(
            sorted(
                (edge, other)
                for edge, other in ways
                if (turning := turns.get((edge, other), 0.0)) >= TURN_PER_HOUR
                and routes.joint[edge][edge] - turning >= BUSY_PER_HOUR
            )
        ),
        closable=tuple(x for x in lanes if cars[network.lanes[x].edge] > 1),
        lanes=tuple(lanes),
        edges=tuple(sorted({network.lanes[x].edge for x in lanes})),
        detectors=tuple(item.id for item in detectors if rates.get(item.id, 0.0) >= BUSY_PER_HOUR),
        groups=groups,
        beside=with_next_lane(groups, detectors, rates),
        room_m={place: _room_m(place, detectors, network) for place in groups},
        pairs=_pairs(detectors, rates, network),
        permitted=any(turns.get(way, 0.0) >= YIELDING_PER_HOUR for way in _yielding(network)),
        several_lanes=any(cars[edge] > 1 for edge in approaches),
    )


def telling(routes: Routes, origin: str, counted: Collection[str]) -> float:
    """Return the effective vehicles per hour by which detectors measure an origin.

    A detector counts `own` vehicles of the origin among `all`. The noise is that of all vehicles,
    so the count is as precise as ``own**2 / all`` vehicles counted alone. Return the largest value
    over the edges.

    Args:
        routes: Routes of the scenario.
        origin: Edge where vehicles start.
        counted: Edges with detectors.
    """
    told = (
        own**2 / routes.joint[edge][edge]
        for edge, own in routes.passing[origin].items()
        if edge in counted
    )
    return max(told, default=0.0)


def _yielding(network: Network) -> set[tuple[str, str]]:
    """Return the edges of the turns that have to yield on some green."""
    return {
        (network.lanes[link.from_lane].edge, network.lanes[link.to_lane].edge)
        for item in network.intersections
        for link in item.links
        if any(phase[link.index] == "g" for phase in item.phases)
    }


def _detected(scenario: Scenario, seed: int) -> tuple[dict[str, float], tuple[Detector, ...]]:
    """Return the vehicles per hour at every detector on a day without effects."""
    day = record(
        scenario,
        "sim",
        policy_factory("fixed-time:30"),
        periods=1,
        seed=derive_seed(seed, "blind", "survey"),
    )
    hours = (day.periods[0].end_s - day.periods[0].begin_s) / 3600.0
    return {x: len(seen) / hours for x, seen in day.periods[0].passages.items()}, day.detectors


def _groups(
    detectors: tuple[Detector, ...], rates: Mapping[str, float], network: Network
) -> tuple[str, ...]:
    """Return the places of groups of detectors, the groups on an edge if vehicles pass there."""
    kinds = sorted({item.kind for item in detectors})
    on_edges = {
        group_name(item.kind, network.lanes[item.lane].edge)
        for item in detectors
        if rates.get(item.id, 0.0) >= BUSY_PER_HOUR
    }
    return (EVERYWHERE, *kinds, *sorted(on_edges))


def with_next_lane(
    places: Sequence[str], detectors: tuple[Detector, ...], rates: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the places whose detectors can report vehicles of a busy next lane."""
    reporting = {
        name
        for name, beside in next_detectors(detectors).items()
        if any(rates.get(other, 0.0) >= BUSY_PER_HOUR for other in beside)
    }
    return tuple(place for place in places if reporting & set(detectors_at(place, detectors)))


def _room_m(place: str, detectors: tuple[Detector, ...], network: Network) -> tuple[float, float]:
    """Return the room before and behind all detectors of a place, m."""
    names = detectors_at(place, detectors)
    before, behind = math.inf, math.inf
    for one in (item for item in detectors if item.id in names):
        ends = [x.position_m for x in detectors if x.lane == one.lane]
        next_m = min(
            (end for end in ends if end > one.position_m),
            default=network.lanes[one.lane].length_m,
        )
        before = min(before, one.position_m)
        behind = min(behind, next_m - one.position_m - one.length_m)
    return before, behind


def _pairs(
    detectors: tuple[Detector, ...], rates: Mapping[str, float], network: Network
) -> tuple[tuple[str, str], ...]:
    found: list[tuple[str, str]] = []
    for one in detectors:
        for two in detectors:
            same = network.lanes[one.lane].edge == network.lanes[two.lane].edge
            if one.id < two.id and one.kind == two.kind and same:
                low, high = sorted((rates.get(one.id, 0.0), rates.get(two.id, 0.0)))
                if high >= BUSY_PER_HOUR and low <= 0.7 * high:
                    found.append((one.id, two.id))
    return tuple(found)
