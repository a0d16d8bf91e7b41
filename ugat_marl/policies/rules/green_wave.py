"""Green waves: fixed time with offsets, so that the green travels with the vehicles."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ugat_marl.envs import Actions, Infos, Observations
from ugat_marl.policies.rules.approaches import (
    ControlledNetwork,
    green_indices,
    permitted_phases,
)
from ugat_marl.scenarios import Intersection, Link, edge_of_lane


@dataclass(frozen=True)
class Corridor:
    """A chain of intersections, each reached from the one before by driving straight on.

    Attributes:
        agents: Agents of the intersections, in the direction of travel.
        edges: For each intersection, the edge on which the road enters it.
        arrival_s: Seconds at the speed limit from the first stop line to each stop line.
        lanes: Number of lanes that lead straight on, summed over the intersections.
    """

    agents: tuple[str, ...]
    edges: tuple[str, ...]
    arrival_s: tuple[float, ...]
    lanes: int


def main_roads(network: ControlledNetwork) -> list[Corridor]:
    """Find roads that share no intersection and together pass all intersections.

    The longest road is taken first: the one with the most intersections, then with the most lanes
    that lead straight on. Of equal roads, or of the two directions of one road, the one that starts
    at the earlier agent is taken. A later road ends where it meets a road already taken.
    """
    free = dict(network.intersections)
    roads: list[Corridor] = []
    while free:
        candidates = [road for agent in free for road in _roads_from(agent, free, network)]
        best = max(
            candidates, key=lambda road: (len(road.agents), road.lanes)
        )  # max returns the first of equals
        roads.append(best)
        for agent in best.agents:
            del free[agent]
    return roads


def _roads_from(
    agent: str, free: Mapping[str, Intersection], network: ControlledNetwork
) -> Iterator[Corridor]:
    entered = {
        edge_of_lane(lane): other
        for other, intersection in free.items()
        for lane in intersection.incoming_lanes
    }
    for edge in dict.fromkeys(edge_of_lane(lane) for lane in free[agent].incoming_lanes):
        agents, edges, arrival_s, lanes = [agent], [edge], [0.0], 0
        while True:
            straight = _straight(free[agents[-1]], edges[-1])
            lanes += len({link.from_lane for link in straight})
            ways = (_onward(link.to_edge, network) for link in straight)
            ahead = next((way for way in ways if way[-1] in entered), None)
            if ahead is None or entered[ahead[-1]] in agents:
                break
            agents.append(entered[ahead[-1]])
            edges.append(ahead[-1])
            arrival_s.append(arrival_s[-1] + sum(network.road_s[road] for road in ahead))
        yield Corridor(tuple(agents), tuple(edges), tuple(arrival_s), lanes)


def _onward(road: str, network: ControlledNetwork) -> list[str]:
    """Return a road and those straight ahead of it, up to a light or the end of the network."""
    way = [road]
    while (following := network.straight.get(way[-1])) is not None and following not in way:
        way.append(following)
    return way


class GreenWave:
    """Fixed time on a common cycle; each signal of a road is delayed by the travel time to it.

    The roads come from `main_roads`. All lights of a road have the same cycle. The main phase
    serves straight traffic in the direction of travel and lasts `main_s`. The other phases of a
    smallest cover last `green_s` each. A light with fewer phases gives the remaining time to its
    main phase.

    The cycle of each light starts later than that of the first light, by the travel time at the
    speed limit rounded to whole decisions. With ``main_s = green_s`` and lights of equally many
    phases, the rule differs from fixed time only in the offsets and the order of the phases.

    Args:
        network: The controlled network.
        green_s: Time of each other phase (clearance included), rounded up to whole decisions; at
            least clearance and minimum green.
        main_s: Time of the phase along the road; None for `green_s`.
    """

    def __init__(
        self, network: ControlledNetwork, green_s: float = 20.0, main_s: float | None = None
    ) -> None:
        self.env_options: Mapping[str, Any] = {}
        self.green_s, self.main_s = green_s, green_s if main_s is None else main_s
        self._phases = network.phases
        self._turns: dict[str, list[tuple[int, int]]] = {}  # phases in order, and decisions of each
        self._offsets: dict[str, int] = {}
        for road in main_roads(network):
            self._plan(road, network)
        self._time = 0

    def reset(self, seed: int) -> None:
        """Start the clocks again."""
        self._time = 0

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the phase whose turn it is; if it is masked, the first allowed one."""
        wanted: Actions = {}
        for agent in self._phases:
            turns = self._turns[agent]
            place = (self._time - self._offsets[agent]) % sum(length for _, length in turns)
            ends = itertools.accumulate(length for _, length in turns)
            wanted[agent] = next(
                phase for (phase, _), end in zip(turns, ends, strict=True) if place < end
            )
        self._time += 1
        return permitted_phases(wanted, infos, self._phases)

    def _plan(self, road: Corridor, network: ControlledNetwork) -> None:
        main, other = map(network.planned_decisions, (self.main_s, self.green_s))
        cycles = [network.approaches[agent].cycle for agent in road.agents]
        length = main + other * (max(len(cycle) for cycle in cycles) - 1)
        for agent, edge, arrival_s, cycle in zip(
            road.agents, road.edges, road.arrival_s, cycles, strict=True
        ):
            intersection = network.intersections[agent]
            wanted = {link.index for link in _straight(intersection, edge)}
            along = max(
                cycle,
                key=lambda p: len(wanted & green_indices(intersection, intersection.phases[p])),
            )
            at = cycle.index(along)
            others = [*cycle[at + 1 :], *cycle[:at]]
            first = (along, length - other * len(others))
            self._turns[agent] = [first, *((phase, other) for phase in others)]
            self._offsets[agent] = round(arrival_s / network.decision_interval_s)


def _straight(intersection: Intersection, edge: str) -> list[Link]:
    return [link for link in intersection.links if link.direction == "s" and link.from_edge == edge]
