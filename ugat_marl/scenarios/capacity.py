"""Demand as a share of capacity: the degree of saturation of every intersection.

The method is that of critical flow ratios (Webster 1958) with free phases. A linear programme
divides the cycle among the phases so that the fullest lane is as empty as possible:

    maximise m,   sum of x[p] <= 1 - lost,
                  sum over lanes of w[v, l] = m * flow[v] / saturation flow,
                  sum over movements of e[v, l] * w[v, l] <= sum of x[p] over phases that serve l

x[p] is the share of the cycle with phase p, w[v, l] the flow ratio of movement v on lane l, and e
its through-car equivalents. The degree of saturation is 1 / m. It is proportional to the demand.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from ugat_marl.scenarios.junctions import Link, links_for_cars
from ugat_marl.scenarios.network import Intersection, Network
from ugat_marl.scenarios.phases import RightOfWay, kerb_turn_of
from ugat_marl.scenarios.routes import departures
from ugat_marl.scenarios.scenario import Scenario
from ugat_marl.scenarios.signals import GREEN

SATURATION_VPH = 1800.0
"""Vehicles per hour that a lane discharges in permanent green: one every 2 s."""

CYCLE_S = 180.0
"""Cycle for the lost time, s. It is the longest that the rule of Webster uses; with a shorter one,
capacity is rated too low for controllers that hold their phases for a minute."""

LEFT_HEADWAY_S, RIGHT_HEADWAY_S = 2.25, 2.6
"""Least time between two cars that turn, s; measured like `through_headway_s`."""

PERMITTED_EQUIVALENT = 2.0
"""Through cars in whose time one car turns that gives way; between 1.4 and 4.5 in the Highway
Capacity Manual 2000, depending on the traffic opposite."""

MOST_HEADWAY_S = 6.0
"""Longest time between two cars in permanent green, s, however low the speed limit."""

Flows = Mapping[tuple[str, str], float]
"""Vehicles per hour from one edge to the next."""


def through_headway_s(speed_mps: float) -> float:
    """Return the time between two cars that drive straight on in a queue that dissolves, s.

    It was measured in SUMO: default cars, greens of 40 s, start-up and yellow included, speed
    limits of 8, 10, 13.9 and 17 m/s gave 2.5, 2.3, 2.1 and 2.0 s.
    """
    return min(1.45 + 8.5 / max(speed_mps, 0.1), MOST_HEADWAY_S)


def discharge_vph(turns: Iterable[str], speed_mps: float) -> float:
    """Return the cars per hour that a lane discharges in permanent green.

    Args:
        turns: What its cars do at the light: ``s``, ``l`` or ``r`` as `kerb_turn_of` says. Lanes of
            several turns discharge as those of the quickest one.
        speed_mps: Its speed limit, m/s.
    """
    return 3600.0 / min(_headway_s(turn, speed_mps) for turn in turns)


def _headway_s(turn: str, speed_mps: float) -> float:
    least_s = {"l": LEFT_HEADWAY_S, "r": RIGHT_HEADWAY_S}.get(turn, 0.0)
    return max(least_s, through_headway_s(speed_mps))


def degrees_of_saturation(scenario: Scenario, flows_vph: Flows | None = None) -> dict[str, float]:
    """Return the degree of saturation of each intersection; above 1 its queues grow without end.

    - Saturation flow: one car in `through_headway_s`; in `LEFT_HEADWAY_S` or `RIGHT_HEADWAY_S` if
      it turns and that is longer.
    - Lost time: yellow and all-red of the fewest phases that serve all lanes, once in `CYCLE_S`;
      the start-up loss and the use of yellow are assumed to cancel.
    - A lane is served by phases in which all its traffic has green.
    - Lanes that cars may not use do not count, except where a movement has no other.
    - A turn that gives way (``g``) takes `PERMITTED_EQUIVALENT`. It shares the point of conflict
      with the traffic that it lets pass, and their flows add up there, 2 s for each of these cars
      (critical movements). All lanes opposite count: the turn needs a gap in all of them.

    Args:
        scenario: The scenario; its signal timing and phases count.
        flows_vph: Vehicles per hour for each pair of consecutive edges. Without it, the mean over
            the episode of the routes in the scenario's files.

    Returns:
        Intersection to degree; infinite if no phase serves a lane with traffic, or lost time fills
        the cycle.

    Source:
        Webster, Traffic Signal Settings, Road Research Technical Paper 39, 1958. Critical
        movements: Transportation Research Circular 212, 1980.
    """
    network = Network.read(scenario)
    root = scenario.network.parse()
    rules = RightOfWay.of(root)
    flows = counted_flows_vph(scenario) if flows_vph is None else flows_vph
    clearance_s = scenario.timing.clearance_s
    return {
        light.id: _degree(
            _Loaded.of(light, network, rules, flows),
            clearance_s + scenario.late_green_s(light.id),
        )
        for light in network.intersections
    }


def counted_flows_vph(scenario: Scenario) -> Flows:
    """Return the vehicles per hour from edge to edge, counted in the routes of the scenario."""
    counts: Counter[tuple[str, str]] = Counter()
    for _, _, edges in departures(scenario, routed=False):
        counts.update(zip(edges, edges[1:], strict=False))
    hours = scenario.settings.duration_s / 3600
    return {movement: count / hours for movement, count in counts.items()}


@dataclass(frozen=True)
class _Loaded:
    """One intersection with its traffic.

    Attributes:
        ratios: Movement (edge to edge) to its flow divided by a lane's saturation flow.
        places: Pairs of movement and lane on which it may queue.
        equivalents: Through-car equivalents of each of `places`.
        served: Phase by lane: True if all traffic of the lane has green.
        conflicts: For each movement that gives way: the phases in which its point of conflict is
            used, as booleans, and the flow ratios that add up there.
    """

    ratios: Mapping[tuple[str, str], float]
    places: tuple[tuple[tuple[str, str], str], ...]
    equivalents: tuple[float, ...]
    served: Mapping[str, NDArray[np.bool_]]
    conflicts: tuple[tuple[NDArray[np.bool_], float], ...]

    @classmethod
    def of(
        cls, light: Intersection, network: Network, rules: RightOfWay, flows_vph: Flows
    ) -> _Loaded:
        movements: dict[tuple[str, str], list[Link]] = defaultdict(list)
        for link in light.links:
            if flows_vph.get((link.from_edge, link.to_edge), 0.0) > 0:
                movements[link.from_edge, link.to_edge].append(link)
        movements = {name: [*links_for_cars(links)] for name, links in movements.items()}
        by_lane: dict[str, list[Link]] = defaultdict(list)
        for link in (link for links in movements.values() for link in links):
            by_lane[link.from_lane].append(link)
        ratios = {name: flows_vph[name] / SATURATION_VPH for name in movements}
        yielding = {
            name: _let_pass(links, light.phases, movements, rules)
            for name, links in movements.items()
        }
        places = tuple(
            (name, lane)
            for name, links in movements.items()
            for lane in dict.fromkeys(link.from_lane for link in links)
        )
        return cls(
            ratios,
            places,
            tuple(
                _equivalents(
                    kerb_turn_of(movements[name][0]),
                    network.lanes[lane].speed_mps,
                    yields=bool(yielding[name]),
                )
                for name, lane in places
            ),
            {
                lane: np.array([may_go(links, phase) for phase in light.phases])
                for lane, links in by_lane.items()
            },
            tuple(_conflicts(light.phases, movements, ratios, yielding)),
        )


def may_go(links: Sequence[Link], phase: str) -> bool:
    """Return True if all links have green; one that may go on red after a stop holds up nobody."""
    return all(phase[link.index] in GREEN or phase[link.index] == "s" for link in links)


def _let_pass(
    links: Sequence[Link],
    phases: Sequence[str],
    movements: Mapping[tuple[str, str], Sequence[Link]],
    rules: RightOfWay,
) -> list[tuple[str, str]]:
    """Return the movements that a movement lets pass in some phase."""
    shown = [phase for phase in phases if any(phase[link.index] == "g" for link in links)]
    return [
        other
        for other, foes in movements.items()
        if other[0] != links[0].from_edge
        and any(
            phase[foe.index] in GREEN and rules.waits(link, foe)
            for phase in shown
            for foe in foes
            for link in links
        )
    ]


def _equivalents(turn: str, speed_mps: float, *, yields: bool) -> float:
    """Return the headway of a movement divided by that of `SATURATION_VPH`."""
    equivalent = _headway_s(turn, speed_mps) * SATURATION_VPH / 3600
    return max(equivalent, PERMITTED_EQUIVALENT) if yields else equivalent


def _conflicts(
    phases: Sequence[str],
    movements: Mapping[tuple[str, str], Sequence[Link]],
    ratios: Mapping[tuple[str, str], float],
    yielding: Mapping[tuple[str, str], Sequence[tuple[str, str]]],
) -> Iterator[tuple[NDArray[np.bool_], float]]:
    for name, others in yielding.items():
        if others:
            links = [link for one in (name, *others) for link in movements[one]]
            used = np.array([any(phase[link.index] in GREEN for link in links) for phase in phases])
            lanes = len({link.from_lane for link in movements[name]})
            own = PERMITTED_EQUIVALENT * ratios[name] / lanes
            yield used, own + sum(ratios[other] for other in others)


def _degree(loaded: _Loaded, clearance_s: float) -> float:
    """Return the degree of saturation of one intersection, by the linear programme."""
    if not loaded.ratios:
        return 0.0
    count = len(next(iter(loaded.served.values())))
    lost = _fewest_phases(loaded.served) * clearance_s / CYCLE_S
    if lost >= 1:
        return math.inf
    width = count + len(loaded.places) + 1  # x, w, m
    at_most: list[NDArray[np.float64]] = []
    row = np.zeros(width)
    row[:count] = 1.0
    at_most.append(row)
    for lane, served in loaded.served.items():
        row = np.zeros(width)
        row[:count] = -served.astype(float)
        for place, (_, where) in enumerate(loaded.places):
            row[count + place] = loaded.equivalents[place] * (where == lane)
        at_most.append(row)
    for used, ratio in loaded.conflicts:
        row = np.zeros(width)
        row[:count] = -used.astype(float)
        row[-1] = ratio
        at_most.append(row)
    equal: list[NDArray[np.float64]] = []
    for name, ratio in loaded.ratios.items():
        row = np.zeros(width)
        for place, (movement, _) in enumerate(loaded.places):
            row[count + place] = movement == name
        row[-1] = -ratio
        equal.append(row)
    aim = np.zeros(width)
    aim[-1] = -1.0
    bounds = np.zeros(len(at_most))
    bounds[0] = 1.0 - lost
    found = optimize.linprog(
        aim, np.array(at_most), bounds, np.array(equal), np.zeros(len(equal)), method="highs"
    )
    most = float(found.x[-1])
    return 1.0 / most if most > 1e-9 else math.inf


def _fewest_phases(served: Mapping[str, NDArray[np.bool_]]) -> int:
    """Return the number of phases that serve all lanes (greedy); 0 if one phase does."""
    table = np.array([phases for phases in served.values() if phases.any()])
    chosen = 0
    while table.size:
        best = int(table.sum(axis=0).argmax())
        table = table[~table[:, best]]
        chosen += 1
    return chosen if chosen > 1 else 0
