"""Facts about a scenario for its controllers: intersections, phases and traffic."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ugat_marl.errors import ScenarioError
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.capacity import Flows, degrees_of_saturation, discharge_vph, may_go
from ugat_marl.scenarios.demand import Demand, check_demand
from ugat_marl.scenarios.junctions import Link, links_for_cars
from ugat_marl.scenarios.network import Intersection, Network, free_flow_s
from ugat_marl.scenarios.phases import (
    RightOfWay,
    are_foes,
    kerb_turn_of,
    programme_phases,
    turn_of,
)
from ugat_marl.scenarios.routes import between_districts, departures, random_flow
from ugat_marl.scenarios.scenario import Scenario
from ugat_marl.scenarios.signals import AMBER, GREEN, YELLOW
from ugat_marl.scenarios.street_names import intersection_name

SHORT_LANE_M = 50.0
"""Length below which a lane at a light shows little of a queue."""
FILLINGS = 3.0
"""Least length of a useful episode, in multiples of the time in which the network fills."""


@dataclass(frozen=True)
class PhaseFacts:
    """One green phase.

    Attributes:
        state: State in SUMO's letters.
        protected: Movements with protected green (``G``), as ``edge turn``.
        permitted: Movements with permitted green (``g``), which give way to others.
        crossings: Number of crossings with green.
        green_of_file: Number of the file's programme green, from 0, that has the same links green;
            None if there is none.
    """

    state: str
    protected: tuple[str, ...]
    permitted: tuple[str, ...]
    crossings: int
    green_of_file: int | None


@dataclass(frozen=True)
class ApproachFacts:
    """One road that leads to a traffic light.

    Attributes:
        edge: SUMO id of the road.
        lanes: Number of its lanes for cars at the light.
        vph: Vehicles per hour at the end of the road by free flow, mean of the episode.
        worst_vph: The same in the worst quarter of an hour.
        worst_from_s: Start of this quarter of an hour, s from the start of the episode.
        flow_ratio: Traffic of its fullest lanes in that quarter of an hour, divided by the flow
            that they would discharge in permanent green (`discharge_vph`). Drivers divide among the
            lanes from which they may turn as evenly as possible.
        saturation: The same with the flow that lanes discharge under the network's own programme.
            Turns that share a lane hold each other up. Above 1 the queue grows. None if there is no
            programme, or no green for some turn.
        first_s: Time at which the first vehicle can be there, s from the start of the episode; None
            if no route uses the road, or none can be there before the end.
    """

    edge: str
    lanes: int
    vph: float
    worst_vph: float
    worst_from_s: float
    flow_ratio: float
    saturation: float | None
    first_s: float | None

    @property
    def fullness(self) -> tuple[float, float]:
        """Saturation and flow ratio; traffic without green is more than any other."""
        saturation = self.saturation
        if saturation is None:
            saturation = math.inf if self.worst_vph > 0 else 0.0
        return saturation, self.flow_ratio


@dataclass(frozen=True)
class IntersectionFacts:
    """One agent.

    Attributes:
        id: SUMO id of its traffic light.
        junctions: Ids of the junctions it controls.
        lanes: Number of incoming lanes.
        links: Number of links for vehicles.
        movements: Number of different pairs of approach and turn.
        conflicts: Number of pairs of links that cross or merge.
        phases: Green phases the agent chooses from.
        unserved_lanes: Incoming lanes that no phase serves.
        unserved_links: Links that no phase serves, as ``lane -> lane``.
        partly_served: Lanes that some phase serves in one direction only. A vehicle that waits for
            the other direction blocks them.
        lanes_behind: Short incoming lanes that are counted together with their upstream lanes.
        short_lanes: Lanes shorter than `SHORT_LANE_M` whose upstream vehicles are not counted.
        always_green: Number of links that are green in every phase.
        right_on_red: Number of links that may go on red after a stop.
        u_turns: Number of links that turn around.
        crossings: Number of links for pedestrians.
        unserved_crossings: Number of crossings that are green in no phase.
        foot_phases: Number of phases with green for pedestrians only. A controller that sees
            vehicles alone has no reason to choose them.
        clashes: Protected greens of vehicles across a crossing with green, as ``phase n: edge
            turn``.
        uncontrolled: Number of links at its junctions without a light.
        approaches: Incoming roads with their traffic.
        name: Streets that meet there; empty if they have no names.
        file_yellow_s: Different times of yellow in its programme in the file, s.
        file_all_red_s: Different times of red between two greens there, s.
        times_vary: As in `Intersection`.
        degrees: Source of phases to the degree of saturation of the intersection with these phases,
            in the quarter of an hour with the most traffic in the network; None if no cycle serves
            a lane with traffic. ``now`` are its present phases.
    """

    id: str
    junctions: tuple[str, ...]
    lanes: int
    links: int
    movements: int
    conflicts: int
    phases: tuple[PhaseFacts, ...]
    unserved_lanes: tuple[str, ...]
    unserved_links: tuple[str, ...]
    partly_served: tuple[str, ...]
    lanes_behind: tuple[str, ...]
    short_lanes: tuple[str, ...]
    always_green: int
    right_on_red: int
    u_turns: int
    crossings: int
    unserved_crossings: int
    foot_phases: int
    clashes: tuple[str, ...]
    uncontrolled: int
    approaches: tuple[ApproachFacts, ...]
    name: str
    file_yellow_s: tuple[float, ...]
    file_all_red_s: tuple[float, ...]
    times_vary: str
    degrees: Mapping[str, float | None]


@dataclass(frozen=True)
class Survey:
    """Facts about a scenario.

    Attributes:
        scenario: Id of the scenario.
        duration_s: Length of an episode.
        decisions: Number of decisions in an episode.
        vehicles: Number of vehicles that depart within an episode.
        flows: Number of flows within an episode.
        first_s: Seconds until the first vehicle departs.
        fill_s: Driving time that 95 % of the routes do not exceed at the speed limits, s.
        shortest_episode_s: Shortest useful episode, s: `first_s` plus `FILLINGS` times `fill_s`,
            rounded up to whole decisions.
        intersections: Facts about each agent.
        uncontrolled: Traffic lights with fewer than two green phases; they are no agents.
        reasons: Light of `uncontrolled` to the reason why.
        last_s: Seconds until the last vehicle of the episode departs.
        busiest_s: Start of the quarter of an hour with the most departures, s from the start.
        busiest: Number of vehicles that depart in it.
        busiest_length_s: Its length, s; the last one also has what is left over.
        yellow_s: Yellow that the environment shows, s.
        all_red_s: Red that the environment shows after it, s.
        notes: Changes to the programmes of the file.
    """

    scenario: str
    duration_s: float
    decisions: int
    vehicles: int
    flows: int
    first_s: float
    fill_s: float
    shortest_episode_s: float
    intersections: tuple[IntersectionFacts, ...]
    uncontrolled: tuple[str, ...]
    reasons: Mapping[str, str]
    last_s: float
    busiest_s: float
    busiest: int
    busiest_length_s: float
    yellow_s: float
    all_red_s: float
    notes: tuple[str, ...]


def survey(scenario: Scenario, reporter: Reporter | None = None) -> Survey:
    """Collect all facts that need no simulation.

    Args:
        scenario: The scenario.
        reporter: Shows progress if a route file is long.

    Raises:
        ScenarioError: The scenario cannot be controlled or driven.
    """
    network = Network.read(scenario)
    demand = check_demand(scenario, network, reporter)
    root = scenario.network.parse()
    traffic = _Traffic.of(scenario, network, demand, reporter)
    free = _free_links(root)
    short = _short(scenario, network)
    rules = RightOfWay.of(root)
    interval = scenario.control.decision_interval_s
    shortest = traffic.first_s + FILLINGS * traffic.fill_s
    shortest = -(-shortest // interval) * interval
    degrees = _degrees(scenario, traffic.busiest_flows_vph)
    return Survey(
        scenario.id,
        scenario.settings.duration_s,
        scenario.decisions,
        demand.vehicles,
        demand.flows,
        round(traffic.first_s, 2),
        round(traffic.fill_s, 1),
        shortest,
        tuple(
            _facts(intersection, network, rules, free, traffic, short, degrees)
            for intersection in network.intersections
        ),
        network.uncontrolled,
        network.reasons,
        round(traffic.last_s, 2),
        traffic.busiest_s,
        traffic.busiest,
        traffic.busiest_length_s,
        scenario.control.yellow_s,
        scenario.control.all_red_s,
        (*network.notes, *_notes_of_demand(scenario, demand)),
    )


def _notes_of_demand(scenario: Scenario, demand: Demand) -> Iterator[str]:
    """Yield what makes the demand of this survey differ from that of an episode."""
    if demand.flows and (flow := random_flow(scenario)):
        yield (
            f"{flow!r} departs at random: SUMO draws its vehicles for each episode, while this "
            "check, drawn days and a diagnosis take one draw, whose number of vehicles may be off "
            "the expected one by chance; give it vehsPerHour, or single vehicles"
        )
    if vehicle := between_districts(scenario):
        yield (
            f"{vehicle!r} runs between districts (fromTaz, toTaz): in an episode SUMO chooses "
            "where it begins and ends by the travel times of the moment, while this check, drawn "
            "days and a diagnosis take the quickest free-flow route; those that duarouter writes "
            "are the same in all"
        )


PHASE_SOURCES = ("programme", "conflict-free", "permitted")
"""Sources of phases that are compared."""


def _degrees(scenario: Scenario, flows_vph: Flows) -> dict[str, dict[str, float]]:
    """Return source of phases, or ``now``, to the degree of saturation of each light."""
    found = {"now": degrees_of_saturation(scenario, flows_vph)}
    lights = {
        light: own.model_copy(update={"phases": None})
        for light, own in scenario.settings.intersections.items()
    }
    settings = scenario.settings.model_copy(update={"intersections": lights})
    for source in PHASE_SOURCES:
        other = replace(scenario, settings=settings).with_control(phases=source)
        try:
            found[source] = degrees_of_saturation(other, flows_vph)
        except ScenarioError:  # no light has two such phases, or a light has too many
            found[source] = {}
    return found


def _short(scenario: Scenario, network: Network) -> set[str]:
    """Return the lanes that would get more upstream lanes with a reach of `SHORT_LANE_M`."""
    if scenario.control.reach_m >= SHORT_LANE_M or scenario.settings.is_mesoscopic:
        return set()
    farther = Network.read(scenario.with_control(reach_m=SHORT_LANE_M))
    return {
        name
        for name, lane in farther.lanes.items()
        if lane.behind.lanes.keys() - network.lanes[name].behind.lanes.keys()
    }


def _facts(
    intersection: Intersection,
    network: Network,
    rules: RightOfWay,
    free: Mapping[str, int],
    traffic: _Traffic,
    short: Container[str],
    degrees: Mapping[str, Mapping[str, float]],
) -> IntersectionFacts:
    served = [
        {i for i, letter in enumerate(phase) if letter in GREEN} for phase in intersection.phases
    ]
    ever = set[int]().union(*served)
    stop_and_go = {
        i for phase in intersection.phases for i, letter in enumerate(phase) if letter == "s"
    }
    may_go = ever | stop_and_go
    junctions = tuple(dict.fromkeys(link.junction for link in intersection.links))
    moving = {link.from_lane for link in intersection.links if link.index in may_go}
    return IntersectionFacts(
        id=intersection.id,
        junctions=junctions,
        lanes=len(intersection.incoming_lanes),
        links=len(intersection.links),
        movements=len({_movement(link) for link in intersection.links}),
        conflicts=sum(
            a.from_edge != b.from_edge and are_foes(a, b, rules.foes)
            for a, b in combinations(intersection.links, 2)
        ),
        phases=tuple(_phase(intersection, phase) for phase in intersection.phases),
        unserved_lanes=tuple(lane for lane in intersection.incoming_lanes if lane not in moving),
        unserved_links=tuple(
            f"{link.from_lane} -> {link.to_lane}"
            for link in intersection.links
            if link.index not in may_go
        ),
        partly_served=tuple(
            lane for lane in intersection.incoming_lanes if _in_part(lane, intersection)
        ),
        lanes_behind=tuple(
            lane for lane in intersection.incoming_lanes if network.lanes[lane].behind.lanes
        ),
        short_lanes=tuple(lane for lane in intersection.incoming_lanes if lane in short),
        always_green=sum(
            all(link.index in green for green in served) for link in intersection.links
        ),
        right_on_red=sum(link.index in stop_and_go for link in intersection.links),
        u_turns=sum(link.direction in "tT" for link in intersection.links),
        crossings=len(intersection.crossings),
        unserved_crossings=sum(
            all(phase[walk.index] not in GREEN for phase in intersection.phases)
            for walk in intersection.crossings
        ),
        foot_phases=sum(
            not green & {link.index for link in intersection.links} for green in served
        ),
        clashes=tuple(_clashes(intersection, rules)),
        uncontrolled=sum(free.get(junction, 0) for junction in junctions),
        approaches=tuple(_approaches(intersection, network, traffic)),
        name=intersection_name(intersection.links, network.streets),
        file_yellow_s=_times_of(intersection, yellow=True),
        file_all_red_s=_times_of(intersection, yellow=False),
        times_vary=intersection.times_vary,
        degrees={
            source: _finite(lights[intersection.id])
            for source, lights in degrees.items()
            if intersection.id in lights
        },
    )


def _finite(degree: float) -> float | None:
    return round(degree, 3) if math.isfinite(degree) else None


def _times_of(intersection: Intersection, *, yellow: bool) -> tuple[float, ...]:
    """Return the different times of yellow, or of red between two greens, in the programme, s."""
    wanted = [
        seconds
        for seconds, state in intersection.programme
        if (bool(set(state) & AMBER) if yellow else not set(state) & (YELLOW | GREEN))
    ]
    return tuple(sorted(set(wanted)))


def _in_part(lane: str, intersection: Intersection) -> bool:
    links = [link for link in intersection.links if link.from_lane == lane]
    return any(
        any(state[link.index] in GREEN for link in links) and not may_go(links, state)
        for state in intersection.phases
    )


def _clashes(intersection: Intersection, rules: RightOfWay) -> Iterator[str]:
    """Yield the protected greens of vehicles across a crossing with green."""
    for number, phase in enumerate(intersection.phases):
        walks = [walk for walk in intersection.crossings if phase[walk.index] in GREEN]
        through = [link for link in intersection.links if phase[link.index] == "G"]
        pairs = (
            f"phase {number}: {_movement(link)}"
            for link in through
            if any(link.index != walk.index and are_foes(link, walk, rules.foes) for walk in walks)
        )
        yield from dict.fromkeys(pairs)


def _movement(link: Link) -> str:
    return f"{link.from_edge} {turn_of(link)}"


def _phase(intersection: Intersection, state: str) -> PhaseFacts:
    def movements(letter: str) -> tuple[str, ...]:
        return tuple(
            dict.fromkeys(
                _movement(link) for link in intersection.links if state[link.index] == letter
            )
        )

    crossings = sum(state[crossing.index] in GREEN for crossing in intersection.crossings)
    number = green_of_file(intersection, state)
    return PhaseFacts(state, movements("G"), movements("g"), crossings, number)


def green_of_file(intersection: Intersection, state: str) -> int | None:
    """Return the number of the programme's green, from 0, with the same links green as a state."""

    def going(letters: str) -> set[int]:
        return {link.index for link in intersection.links if letters[link.index] in GREEN}

    greens = programme_phases(intersection.programme)
    return next((n for n, green in enumerate(greens) if going(green) == going(state)), None)


def _approaches(
    intersection: Intersection, network: Network, traffic: _Traffic
) -> Sequence[ApproachFacts]:
    roads: dict[str, list[Link]] = defaultdict(list)
    for link in intersection.links:
        roads[link.from_edge].append(link)
    cycle_s = sum(seconds for seconds, _ in intersection.programme)
    approaches: list[ApproachFacts] = []
    for edge, links in roads.items():
        edge_lanes = tuple(dict.fromkeys(link.from_lane for link in links_for_cars(links)))
        vph, (worst_vph, worst_from_s, flows) = traffic.mean_vph(edge), traffic.worst(edge)
        lanes_of = _lanes_by_turn(links)
        used = frozenset(edge_lanes).union(*lanes_of.values())
        turns: dict[str, set[str]] = defaultdict(set)
        for link in links:
            turns[link.from_lane].add(kerb_turn_of(link))
        speeds = {lane: network.lanes[lane].speed_mps for lane in used}
        vehicles = {lane: discharge_vph(turns[lane], speeds[lane]) for lane in used}
        ratio = fullest(flows, lanes_of, vehicles)
        saturation = math.inf
        if cycle_s:
            served: dict[str, float] = {}
            for lane in used:
                share = {
                    turn: flow / len(lanes_of[turn])
                    for turn, flow in flows.items()
                    if lane in lanes_of.get(turn, ())
                }
                green_s = _green_s(intersection, lane, share, 3600 / vehicles[lane])
                served[lane] = vehicles[lane] * green_s / cycle_s
            saturation = fullest(flows, lanes_of, served)
        approaches.append(
            ApproachFacts(
                edge,
                len(edge_lanes),
                round(vph, 1),
                round(worst_vph, 1),
                worst_from_s,
                round(ratio, 3),
                _finite(saturation),
                traffic.first_at_s.get(edge),
            )
        )
    return approaches


def _lanes_by_turn(links: Sequence[Link]) -> dict[str, frozenset[str]]:
    """Return each road that an approach leads to, and the lanes that lead there."""
    towards: dict[str, list[Link]] = defaultdict(list)
    for link in links:
        towards[link.to_edge].append(link)
    usable = {edge: links_for_cars(each) for edge, each in towards.items()}
    return {edge: frozenset(link.from_lane for link in each) for edge, each in usable.items()}


def fullest(
    flows_vph: Mapping[str, float],
    lanes_of: Mapping[str, Set[str]],
    capacity_vph: Mapping[str, float],
) -> float:
    """Return traffic as a share of capacity on the fullest lanes of an approach.

    Traffic is divided among lanes so that the fullest ones are as empty as possible. By the theorem
    of the maximum flow and the minimum cut, some turns then fill all lanes from which they can be
    made.

    Args:
        flows_vph: Turn to its vehicles per hour.
        lanes_of: Turn to the lanes from which it can be made.
        capacity_vph: Lane to the vehicles per hour that it can discharge.

    Returns:
        The share; infinite if a turn with traffic has no capacity.
    """
    turns = [turn for turn, flow in flows_vph.items() if flow > 0 and turn in lanes_of]
    most = 0.0
    for count in range(1, len(turns) + 1):
        for together in combinations(turns, count):
            lanes = frozenset[str]().union(*(lanes_of[turn] for turn in together))
            capacity = sum(capacity_vph.get(lane, 0.0) for lane in lanes)
            flow = sum(flows_vph[turn] for turn in together)
            most = max(most, flow / capacity if capacity > 0 else math.inf)
    return most


def _green_s(
    intersection: Intersection, lane: str, flows_vph: Mapping[str, float], headway_s: float
) -> float:
    """Return the green that the queue of a lane uses per cycle of the programme, s.

    Vehicles queue in one lane, so the first one blocks the rest while it has no green. The turn of
    the first vehicle is modelled as a Markov chain: when it leaves, the turn of the next one is
    drawn by the shares of the traffic.

    Args:
        intersection: The intersection with its programme.
        lane: A lane that leads there.
        flows_vph: Road ahead to the lane's traffic that goes there. Without traffic the mean over
            the links is returned.
        headway_s: Time between two vehicles in permanent green, s.
    """
    links = [link for link in intersection.links if link.from_lane == lane]
    ahead: dict[str, list[Link]] = defaultdict(list)
    for link in links:
        if flows_vph.get(link.to_edge, 0.0) > 0:
            ahead[link.to_edge].append(link)
    if not ahead:
        return sum(
            seconds * may_go([link], state) / len(links)
            for seconds, state in intersection.programme
            for link in links
        )
    going = [
        np.array([any(may_go([link], state) for link in to) for to in ahead.values()])
        for _, state in intersection.programme
    ]
    if not np.all(np.any(going, axis=0)):
        return 0.0  # a vehicle that never has green is the first one at last
    share = np.array([flows_vph[road] for road in ahead], dtype=np.float64)
    share /= share.sum()
    count = len(ahead)
    still = np.eye(count + 1)
    cycle = still  # probability of the next first vehicle by the present one; last, the green used
    for (seconds, _), goes in zip(intersection.programme, going, strict=True):
        one_leaves = still.copy()
        one_leaves[:count, :count] = np.where(goes[:, None], share, np.eye(count))
        one_leaves[:count, count] = headway_s * goes
        whole, part = divmod(seconds / headway_s, 1.0)
        last = (1 - part) * still + part * one_leaves
        cycle = cycle @ np.linalg.matrix_power(one_leaves, int(whole)) @ last
    in_the_long_run = np.linalg.matrix_power(cycle[:count, :count], 1024)
    return float(share @ in_the_long_run @ cycle[:count, count])


def _free_links(root: ET.Element) -> Counter[str]:
    """Count the links without a light, by the junction they cross."""
    ends = {edge.get("id", ""): edge.get("to", "") for edge in root.iter("edge")}
    return Counter(
        ends.get(element.get("from", ""), "")
        for element in root.iter("connection")
        if element.get("tl") is None
        and not any(element.get(end, ":").startswith(":") for end in ("from", "to"))
    )


QUARTER_S = 900.0
"""Quarter of an hour, s: the interval of peak flows in the Highway Capacity Manual."""


@dataclass
class _Traffic:
    """Traffic from the routes. Vehicles are taken to drive at the speed limit.

    The last quarter of an hour of an episode is half as long to half as long again, since what is
    left over belongs to it. Quarters are compared by their flows per hour.

    Attributes:
        duration_s: Length of the episode.
        passes: Road and quarter of an hour to the vehicles that reach its end.
        turns: Quarter of an hour in which the end of the first road is reached, to the vehicles
            from road to road.
        departing: Quarter of an hour to the vehicles that depart.
        first_at_s: Road to the time at which the first vehicle reaches its end, s from the start.
        first_s: Seconds until the first vehicle departs.
        last_s: Seconds until the last vehicle departs.
        fill_s: Driving time that 95 % of the routes do not exceed at the speed limits, s.
    """

    duration_s: float
    passes: dict[str, Counter[int]]
    turns: dict[int, Counter[tuple[str, str]]]
    departing: Counter[int]
    first_at_s: dict[str, float]
    first_s: float
    last_s: float
    fill_s: float

    @property
    def _last(self) -> int:
        """Number of the last quarter of an hour."""
        return max(1, round(self.duration_s / QUARTER_S)) - 1

    def _quarter(self, at_s: float) -> int:
        return min(int(at_s // QUARTER_S), self._last)

    def _vph(self, count: int, quarter: int) -> float:
        """Return vehicles per hour, from vehicles in a quarter of an hour."""
        return count * 3600 / self._length_s(quarter)

    def _length_s(self, quarter: int) -> float:
        return self.duration_s - quarter * QUARTER_S if quarter == self._last else QUARTER_S

    def mean_vph(self, edge: str) -> float:
        """Return the mean flow of a road over the episode, vehicles per hour."""
        return sum(self.passes.get(edge, {}).values()) * 3600 / self.duration_s

    def worst(self, edge: str) -> tuple[float, float, dict[str, float]]:
        """Return the flow of a road in its worst quarter of an hour, vehicles per hour.

        Returns:
            The flow, the start of the quarter, s, and the flow to each of the next roads.
        """
        quarters = self.passes.get(edge)
        if not quarters:
            return 0.0, 0.0, {}
        worst = max(sorted(quarters), key=lambda quarter: self._vph(quarters[quarter], quarter))
        flows = {
            after: self._vph(count, worst)
            for (before, after), count in self.turns.get(worst, {}).items()
            if before == edge
        }
        return self._vph(quarters[worst], worst), worst * QUARTER_S, flows

    @property
    def _busiest(self) -> int:
        """Number of the quarter of an hour with the most departures."""
        counts = self.departing
        return max(sorted(counts), key=lambda n: self._vph(counts[n], n), default=0)

    @property
    def busiest_s(self) -> float:
        """Start of the quarter of an hour with the most departures, s."""
        return self._busiest * QUARTER_S

    @property
    def busiest_length_s(self) -> float:
        """Length of this quarter of an hour, s."""
        return self._length_s(self._busiest)

    @property
    def busiest(self) -> int:
        """Number of vehicles that depart in the busiest quarter of an hour."""
        return self.departing[self._busiest]

    @property
    def busiest_flows_vph(self) -> dict[tuple[str, str], float]:
        """Vehicles per hour from road to road, in the quarter of an hour with the most of them."""
        turns = self.turns
        most = max(sorted(turns), key=lambda n: self._vph(turns[n].total(), n), default=0)
        return {turn: self._vph(count, most) for turn, count in turns.get(most, {}).items()}

    @classmethod
    def of(
        cls, scenario: Scenario, network: Network, demand: Demand, reporter: Reporter | None
    ) -> _Traffic:
        seconds = free_flow_s(network.lanes.values())
        begin, length_s = scenario.settings.begin_s, scenario.settings.duration_s
        lengths_s: list[float] = []
        traffic = cls(
            length_s, defaultdict(Counter), defaultdict(Counter), Counter(), {}, length_s, 0.0, 0.0
        )
        for _, depart, edges in departures(scenario, routed=demand.routed, reporter=reporter):
            traffic._drive(depart - begin, edges, seconds)
            lengths_s.append(sum(seconds.get(edge, 0.0) for edge in edges))
        lengths_s.sort()
        traffic.fill_s = lengths_s[math.ceil(0.95 * len(lengths_s)) - 1] if lengths_s else 0.0
        return traffic

    def _drive(self, depart_s: float, edges: Sequence[str], seconds: Mapping[str, float]) -> None:
        """Count a vehicle at the end of each of its roads, if it is there before the end."""
        self.departing[self._quarter(depart_s)] += 1
        self.first_s, self.last_s = min(self.first_s, depart_s), max(self.last_s, depart_s)
        at_s, before, quarter = depart_s, "", 0
        for edge in edges:
            if before:
                self.turns[quarter][before, edge] += 1
            at_s += seconds.get(edge, 0.0)
            if at_s >= self.duration_s:
                break
            quarter = self._quarter(at_s)
            self.passes[edge][quarter] += 1
            if at_s < self.first_at_s.get(edge, math.inf):
                self.first_at_s[edge] = at_s
            before = edge
