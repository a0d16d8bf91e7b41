"""Static facts read from a ``.net.xml``: intersections, lanes, links, conflicts, neighbours."""

from __future__ import annotations

import html
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from ugat_marl.errors import ScenarioError, counted
from ugat_marl.scenarios.junctions import (
    Link,
    Upstream,
    behind_of,
    connections_between,
    crossings_of,
    links_of,
    neighbours_of,
    straight_roads_of,
)
from ugat_marl.scenarios.lanes import NO_UPSTREAM_LANES, LaneTable, Turns, UpstreamLanes
from ugat_marl.scenarios.phases import (
    RightOfWay,
    conflict_free_phases,
    conflicting_greens,
    programme_phases,
    yielding,
)
from ugat_marl.scenarios.scenario import Scenario
from ugat_marl.scenarios.settings import parse_time
from ugat_marl.scenarios.signals import GREEN, SIGNAL_LETTERS, check_phases

VEHICLE_SPACE_M = 7.5
"""Space of a queued default vehicle: 5 m length plus 2.5 m gap."""


@dataclass(frozen=True)
class Lane:
    """A lane outside of junctions.

    Attributes:
        id: SUMO id.
        edge: SUMO id of its edge.
        length_m: Length.
        speed_mps: Speed limit.
        shape: Centre line, ``((x, y), ...)`` in m.
        behind: Upstream lanes and roads counted with this lane, if it is shorter than the reach or
            than the space of a vehicle.
        room_m: Length on which vehicles are counted, upstream lanes and reach included; 0 for lanes
            that are long enough or not at an agent.
    """

    id: str
    edge: str
    length_m: float
    speed_mps: float
    shape: tuple[tuple[float, float], ...]
    behind: Upstream = field(default_factory=Upstream)
    room_m: float = 0.0

    @property
    def counted_m(self) -> float:
        """Length on which vehicles are counted, m: its own, and that of its upstream lanes."""
        return max(self.length_m, self.room_m)

    @property
    def storage_veh(self) -> float:
        """Number of default vehicles that fit on the lane and its upstream lanes, at least one."""
        return max(1.0, self.counted_m / VEHICLE_SPACE_M)


@dataclass(frozen=True)
class Intersection:
    """One traffic light: an agent.

    Attributes:
        id: SUMO id of the traffic light.
        incoming_lanes: Lanes at the start of a link, in order of link index.
        outgoing_lanes: Lanes at the end of a link, in order of link index.
        links: Links for vehicles, in order of index.
        phases: Green states the agent chooses from.
        programme: The network's own programme, ``(duration_s, state)``.
        neighbours: Other agents one road away, in either direction.
        position: Mean over the links of their junction's coordinates, m.
        crossings: Links for pedestrians.
        offset_s: Time on the scenario's clock at which the programme begins a cycle.
        times_vary: Why SUMO's times of the programme differ from those in `programme`; "" if they
            do not.
    """

    id: str
    incoming_lanes: tuple[str, ...]
    outgoing_lanes: tuple[str, ...]
    links: tuple[Link, ...]
    phases: tuple[str, ...]
    programme: tuple[tuple[float, str], ...]
    neighbours: tuple[str, ...]
    position: tuple[float, float]
    crossings: tuple[Link, ...] = ()
    offset_s: float = 0.0
    times_vary: str = ""


@dataclass(frozen=True)
class Network:
    """All lanes and all intersections of a scenario.

    Attributes:
        lanes: Lanes outside of junctions by id.
        intersections: Traffic lights with at least two green phases, in the order of their ids.
        uncontrolled: Traffic lights with fewer than two green phases; they run their own programme.
        streets: Road (SUMO's edge) to the name of its street; roads without a name are left out.
        reasons: Light of `uncontrolled` to the reason why it is not an agent.
        notes: Changes to the programmes of the file, for the user.
        straight: Road (SUMO's edge) to the road straight ahead of it, where no agent is in between.
    """

    lanes: Mapping[str, Lane]
    intersections: tuple[Intersection, ...]
    uncontrolled: tuple[str, ...]
    streets: Mapping[str, str] = field(default_factory=dict[str, str])
    reasons: Mapping[str, str] = field(default_factory=dict[str, str])
    notes: tuple[str, ...] = ()
    straight: Mapping[str, str] = field(default_factory=dict[str, str])

    @classmethod
    def read(cls, scenario: Scenario) -> Network:
        """Read and check the network of a scenario.

        Raises:
            ScenarioError: The file is not a network or has no traffic light to control. Or phases
                cannot be shown or have conflicting greens. Or settings name an unknown traffic
                light.
        """
        document = scenario.network
        root = document.parse()
        if root.tag != "net":
            raise ScenarioError(
                f"{document.source}: a SUMO network begins with <net>, this with <{root.tag}>"
            )
        try:
            return cls._of(root, scenario)
        except (ValueError, IndexError, KeyError) as error:
            raise ScenarioError(
                f"{document.source}: a value is missing or is not what SUMO writes there "
                f"({error}); build the network again with netconvert"
            ) from None

    @classmethod
    def _of(cls, root: ET.Element, scenario: Scenario) -> Network:
        document = scenario.network
        lanes = lanes_of(root)
        links = links_of(root)
        programmes = _programmes(root, scenario)
        _check_settings(scenario, links)
        _check_lanes(links, lanes, document.source)
        rules = RightOfWay.of(root)
        crossings = crossings_of(root)
        positions = _positions(root)
        agents_found: list[Intersection] = []
        uncontrolled: list[str] = []
        reasons: dict[str, str] = {}
        notes: list[str] = []
        for tls in sorted(links):
            light_links = tuple(sorted(links[tls], key=lambda link: (link.index, link.to_lane)))
            walks = tuple(crossings.get(tls, ()))
            own = programmes.get(tls, _NO_PROGRAMME)
            _check_requests((*light_links, *walks), rules, document.source)
            programme, width = _programme_of(
                scenario, tls, own.states, (*light_links, *walks), rules, notes
            )
            phases = _phases_of(scenario, tls, light_links, walks, programme, width, rules)
            source = _source_of(scenario, tls)
            if _choices(phases, light_links, source) < 2:
                uncontrolled.append(tls)
                reasons[tls] = _reason(source, phases, light_links, programme)
                continue
            agents_found.append(
                Intersection(
                    id=tls,
                    incoming_lanes=_unique(link.from_lane for link in light_links),
                    outgoing_lanes=_unique(link.to_lane for link in light_links),
                    links=light_links,
                    phases=phases,
                    programme=programme,
                    neighbours=(),
                    position=_centre([positions[link.junction] for link in light_links]),
                    crossings=walks,
                    offset_s=own.offset_s,
                    times_vary=own.times_vary,
                )
            )
        _require_agents(agents_found, links, document.source)
        agents = {light.id: links[light.id] for light in agents_found}
        between = connections_between(root, agents)
        beside = neighbours_of(agents, between)
        intersections = tuple(replace(x, neighbours=beside[x.id]) for x in agents_found)
        reach_m = scenario.control.reach_m
        return cls(
            _with_room(lanes, root, agents, reach_m),
            intersections,
            tuple(uncontrolled),
            streets_of(root),
            reasons,
            (*notes, *_unknown_conflicts(agents_found)),
            straight_roads_of(between),
        )

    def intersection(self, tls: str) -> Intersection:
        """Return the intersection with this SUMO id."""
        return next(light for light in self.intersections if light.id == tls)

    def lane_table(self) -> LaneTable:
        """Return all incoming and outgoing lanes of intersections, each once, in a fixed order."""
        names = _unique(
            lane
            for upstream in self.intersections
            for lane in (*upstream.incoming_lanes, *upstream.outgoing_lanes)
        )
        behind = [self.lanes[name].behind for name in names]
        return LaneTable(
            names,
            np.array([self.lanes[name].storage_veh for name in names]),
            np.array([self.lanes[name].speed_mps for name in names]),
            UpstreamLanes(
                tuple(tuple(upstream.lanes.items()) for upstream in behind),
                tuple(tuple(upstream.roads.items()) for upstream in behind),
            )
            if any(upstream.lanes or upstream.roads for upstream in behind)
            else NO_UPSTREAM_LANES,
            _turns(self.intersections, names),
        )


def within_hops(neighbours: Mapping[str, Sequence[str]], hops: int) -> dict[str, tuple[str, ...]]:
    """Return, for each name, the other names at most `hops` roads away, nearest first."""
    near: dict[str, tuple[str, ...]] = {}
    for name in neighbours:
        reached, frontier = [name], [name]
        for _ in range(hops):
            if not frontier:
                break
            ahead = (other for one in frontier for other in neighbours[one])
            frontier = list(dict.fromkeys(other for other in ahead if other not in reached))
            reached += frontier
        near[name] = tuple(reached[1:])
    return near


def signal_widths(scenario: Scenario) -> dict[str, int]:
    """Return the number of letters in the state of each traffic light, agent or not.

    Raises:
        ScenarioError: The network is not well-formed.
    """
    root = scenario.network.parse()
    programmes = _programmes(root, scenario)
    return {
        tls: len(programmes[tls].states[0][1])
        if tls in programmes
        else max(link.index for link in links) + 1
        for tls, links in links_of(root).items()
    }


def _source_of(scenario: Scenario, tls: str) -> str | Sequence[str]:
    """Return the source of a traffic light's phases, or the states if the settings list them."""
    settings = scenario.settings.intersections.get(tls)
    return settings.phases if settings and settings.phases is not None else scenario.control.phases


def _choices(phases: Sequence[str], links: Sequence[Link], source: str | Sequence[str]) -> int:
    """Count the phases an agent can choose from.

    Derived phases count only if they give green to vehicles. An agent sees vehicles alone, so at a
    light with only a crossing it would never stop them. Listed phases all count.
    """
    if not isinstance(source, str):
        return len(phases)
    letters = {link.index for link in links}
    return sum(any(phase[i] in GREEN for i in letters) for phase in phases)


def _phases_of(
    scenario: Scenario,
    tls: str,
    links: tuple[Link, ...],
    crossings: tuple[Link, ...],
    programme: tuple[tuple[float, str], ...],
    width: int,
    rules: RightOfWay,
) -> tuple[str, ...]:
    source = _source_of(scenario, tls)
    where = f"scenario {scenario.id!r}, traffic light {tls!r}"
    if source in ("conflict-free", "permitted"):
        phases = conflict_free_phases(
            links, rules, width, where, crossings=crossings, permitted=source == "permitted"
        )
    elif source == "programme":
        phases = programme_phases(programme)
    else:
        phases = tuple(source)
    check_phases(phases, width, where)
    for phase in phases:
        _check_greens(phase, links, rules.foes, f"{where}: phase")
    return phases


def _programme_of(
    scenario: Scenario,
    tls: str,
    programme: tuple[tuple[float, str], ...],
    links: Sequence[Link],
    rules: RightOfWay,
    notes: list[str],
) -> tuple[tuple[tuple[float, str], ...], int]:
    """Return the programme, mended by right of way, and the number of letters of its states.

    SUMO runs a programme whose protected greens cross, and lets one vehicle wait for the other.
    The phases of agents say so: who must yield has permitted green.
    """
    width = max(link.index for link in links) + 1
    if not programme:
        return programme, width
    where = f"scenario {scenario.id!r}, traffic light {tls!r}"
    width = _check_programme(programme, width, where)
    mended = tuple((seconds, yielding(state, links, rules)) for seconds, state in programme)
    if mended != programme:
        changed = {
            index
            for (_, before), (_, after) in zip(programme, mended, strict=True)
            for index, (a, b) in enumerate(zip(before, after, strict=True))
            if a != b
        }
        notes.append(
            f"traffic light {tls!r}: protected greens of its programme cross; the links "
            f"{', '.join(map(str, sorted(changed)))} have to yield and got g in place of G"
        )
    return mended, width


def _unknown_conflicts(intersections: Sequence[Intersection]) -> list[str]:
    """Return one note that names the lights without a conflict matrix; empty if all have one.

    The rows of SUMO's matrices are named by internal lanes. `netconvert --no-internal-links` leaves
    these out.
    """
    names = [light.id for light in intersections if all(x.request < 0 for x in light.links)]
    if not names:
        return []
    return [
        f"the network has no internal lanes at {', '.join(names)}, so conflicts of greens are not "
        "known there, and none are counted; build it without --no-internal-links to have them"
    ]


def _reason(
    source: str | Sequence[str],
    phases: Sequence[str],
    links: Sequence[Link],
    programme: Sequence[tuple[float, str]],
) -> str:
    """Return the reason why a light is not an agent, and what would make it one."""
    own = _choices(programme_phases(programme), links, "programme")
    if source == "programme":
        text = f"its programme has {counted(own, 'green phase')}"
        return f'{text}; phases = "conflict-free" or "permitted" may make more'
    more = f'; its programme has {own}: phases = "programme" makes it an agent' if own > 1 else ""
    if not isinstance(source, str):
        return f"{len(phases)} phase is listed{more}"
    made = _choices(phases, links, source)
    text = f'phases = "{source}" makes {made or "no"} green for vehicles'
    return f"{text}, whose ways do not cross{more}"


def _check_requests(links: Sequence[Link], rules: RightOfWay, source: str) -> None:
    """Refuse links without a row in the right of way of their junction."""
    for link in links:
        for rows in (rules.foes[link.junction], rules.yields[link.junction]):
            if rows and link.request >= len(rows):
                raise ScenarioError(
                    f"{source}: junction {link.junction!r} has {counted(len(rows), 'request')}, "
                    f"and a connection needs request {link.request}; build the network again"
                )


def _check_programme(programme: Sequence[tuple[float, str]], width: int, where: str) -> int:
    """Refuse an impossible programme and return the number of letters of its states."""
    letters = len(programme[0][1])
    durations = [seconds for seconds, _ in programme]
    if min(durations) < 0 or not sum(durations):
        raise ScenarioError(
            f"{where}: the states of its programme last {', '.join(f'{x:g}' for x in durations)} "
            "s; write durations of at least 0 that are not all 0"
        )
    for index, (_, state) in enumerate(programme):
        state_name = f"{where}: state {index} of its programme ({state!r})"
        if len(state) < width or len(state) != letters:
            raise ScenarioError(
                f"{state_name} has {len(state)} letters, but "
                + (f"it controls {width} links" if len(state) < width else f"state 0 has {letters}")
                + "; write one letter per link into every <phase> of the <tlLogic>"
            )
        if unknown := sorted(set(state) - SIGNAL_LETTERS):
            raise ScenarioError(
                f"{state_name} has unknown letters {unknown}; allowed: {sorted(SIGNAL_LETTERS)}"
            )
    return letters


def _check_greens(
    state: str, links: Sequence[Link], foes: Mapping[str, Sequence[int]], state_name: str
) -> None:
    if pair := conflicting_greens(state, links, foes):
        raise ScenarioError(
            f"{state_name} ({state!r}) gives protected green (G) to the links {pair[0]} and "
            f"{pair[1]}, whose paths cross; write g for the one that must yield"
        )


def _require_agents(
    agents: Sequence[Intersection], links: Mapping[str, Sequence[Link]], source: str
) -> None:
    if not agents:
        obstacle = (
            "only traffic lights with fewer than two green phases" if links else "no traffic light"
        )
        raise ScenarioError(
            f"{source}: {obstacle}; an environment needs at least one intersection with two green "
            "phases (netconvert --tls.guess adds traffic lights)"
        )


def _check_settings(scenario: Scenario, links: Mapping[str, Sequence[Link]]) -> None:
    if unknown := sorted(name for name in scenario.settings.intersections if name not in links):
        raise ScenarioError(
            f"scenario {scenario.id!r}: intersections.{unknown[0]} is not a traffic light of "
            f"{scenario.network.source}; it has: {', '.join(sorted(links)) or 'none'}"
        )


def _check_lanes(
    links: Mapping[str, Sequence[Link]], lanes: Mapping[str, Lane], source: str
) -> None:
    for tls, light_links in links.items():
        for lane in (name for link in light_links for name in (link.from_lane, link.to_lane)):
            if lane not in lanes:
                raise ScenarioError(
                    f"{source}: traffic light {tls!r} controls a connection over lane {lane!r}, "
                    "which the network does not have; build it again with netconvert"
                )


def lanes_of(root: ET.Element) -> dict[str, Lane]:
    """Return the lanes outside of junctions by id."""
    lanes: dict[str, Lane] = {}
    for edge in root.iter("edge"):
        if edge.get("function") in ("internal", "crossing", "walkingarea"):
            continue
        for lane in edge.iter("lane"):
            name = lane.get("id", "")
            lanes[name] = Lane(
                name,
                edge.get("id", ""),
                float(lane.get("length", "0")),
                float(lane.get("speed", "0")),
                _shape(lane.get("shape", "")),
            )
    return lanes


def free_flow_s(lanes: Iterable[Lane]) -> dict[str, float]:
    """Return road (SUMO's edge) to the time that its last lane takes at the speed limit, s."""
    return {lane.edge: lane.length_m / max(lane.speed_mps, 0.1) for lane in lanes}


def streets_of(root: ET.Element) -> dict[str, str]:
    """Return road (SUMO's edge) to the name of its street, without roads that have no name."""
    # netconvert escapes the names of a map once more
    names = {edge.get("id", ""): html.unescape(edge.get("name", "")) for edge in root.iter("edge")}
    return {edge: name for edge, name in names.items() if name}


def _with_room(
    lanes: dict[str, Lane], root: ET.Element, agents: Container[str], reach_m: float
) -> dict[str, Lane]:
    """Return the lanes; add to short lanes at lights the upstream lanes counted with them."""
    lengths_m = {name: lane.length_m for name, lane in lanes.items()}
    for name, upstream in behind_of(root, lengths_m, max(reach_m, VEHICLE_SPACE_M), agents).items():
        behind = upstream if reach_m else Upstream(upstream.lanes)
        room_m = sum(lengths_m.get(other, 0.0) * share for other, share in upstream.lanes.items())
        room_m = max(lengths_m[name] + room_m, reach_m)
        lanes[name] = replace(lanes[name], behind=behind, room_m=room_m)
    return lanes


def _shape(text: str) -> tuple[tuple[float, float], ...]:
    points = (point.split(",") for point in text.split())
    return tuple((float(xyz[0]), float(xyz[1])) for xyz in points)


@dataclass(frozen=True)
class _Programme:
    """Programme of a traffic light.

    Attributes:
        id: SUMO's programID.
        states: ``(duration_s, state)`` of each phase.
        offset_s: Time on the scenario's clock at which a cycle begins.
        times_vary: As in `Intersection`.
    """

    id: str
    states: tuple[tuple[float, str], ...]
    offset_s: float
    times_vary: str = ""


_NO_PROGRAMME = _Programme("", (), 0.0)


def _programmes(root: ET.Element, scenario: Scenario) -> dict[str, _Programme]:
    """Return the programmes SUMO runs: the last definition, additional files after the network.

    A definition without phases gives a known programme another offset. A timetable of programmes
    (WAUT) begins with one of them, wherever that is defined.
    """
    programmes: dict[str, _Programme] = {}
    defined: dict[tuple[str, str], _Programme] = {}
    timetables: dict[str, tuple[str, bool]] = {}
    timed: dict[str, str] = {}
    trees = [(scenario.network.source, root)]
    parts = ((each.source, part) for each in scenario.additional for part in each.parts())
    for source, tree in chain(trees, parts):
        for logic in tree.iter("tlLogic"):
            tls, name = logic.get("id", ""), logic.get("programID", "")
            try:
                states = tuple(
                    (parse_time(phase.get("duration", "0")), phase.get("state", ""))
                    for phase in logic.iter("phase")
                )
                for phase in logic.iter("phase"):
                    for key in ("minDur", "maxDur"):  # effects read them later
                        parse_time(phase.get(key, "0"))
                offset_s = _offset_s(logic, scenario)
            except ValueError as error:
                raise ScenarioError(
                    f"{source}: traffic light {tls!r} has a time that is none ({error})"
                ) from None
            if states:
                programmes[tls] = _Programme(name, states, offset_s, _times_vary(logic))
            elif tls in programmes and programmes[tls].id == name:
                programmes[tls] = replace(programmes[tls], offset_s=offset_s)
            if tls in programmes:
                defined[tls, programmes[tls].id] = programmes[tls]
        for table in tree.iter("WAUT"):
            switches = table.find("wautSwitch") is not None
            timetables[table.get("id", "")] = table.get("startProg", ""), switches
        timed |= {x.get("junctionID", ""): x.get("wautID", "") for x in tree.iter("wautJunction")}
    return programmes | _begun_with(timed, timetables, defined)


def _begun_with(
    timed: Mapping[str, str],
    timetables: Mapping[str, tuple[str, bool]],
    defined: Mapping[tuple[str, str], _Programme],
) -> dict[str, _Programme]:
    """Return light to the programme with which its timetable begins.

    Args:
        timed: Light to the id of its timetable.
        timetables: Id of a timetable to its first programme, and whether it switches to others.
        defined: Light and id of a programme to the programme.
    """
    begun: dict[str, _Programme] = {}
    for light, name in timed.items():
        if name in timetables and (light, timetables[name][0]) in defined:
            start, switches = timetables[name]
            begun[light] = defined[light, start]
            if switches:
                begun[light] = replace(begun[light], times_vary="a timetable (WAUT) switches it")
    return begun


def _times_vary(logic: ET.Element) -> str:
    """Return why SUMO's times of a programme differ from its durations; "" if they do not."""
    kind = logic.get("type", "static")
    if kind == "NEMA":
        return "it has rings of its own (NEMA)"
    if kind != "static":
        return f"it follows the traffic ({kind})"
    if any("next" in phase.attrib for phase in logic.iter("phase")):
        return "its phases name the next one"
    return ""


def _offset_s(logic: ET.Element, scenario: Scenario) -> float:
    """Return the offset, s; SUMO knows the start of the episode as ``begin``."""
    text = logic.get("offset", "0")
    return scenario.settings.begin_s if text == "begin" else parse_time(text)


def _turns(intersections: Sequence[Intersection], names: Sequence[str]) -> Turns:
    """Return the ways across the lights of agents, each with the positions of its lanes."""
    place = {lane: index for index, lane in enumerate(names)}
    lanes: dict[tuple[str, str], dict[int, None]] = defaultdict(dict)
    for link in chain.from_iterable(item.links for item in intersections):
        lanes[link.from_edge, link.to_edge][place[link.from_lane]] = None
    return tuple((start, end, tuple(places)) for (start, end), places in lanes.items())


def _positions(root: ET.Element) -> dict[str, tuple[float, float]]:
    return {
        element.get("id", ""): (float(element.get("x", "0")), float(element.get("y", "0")))
        for element in root.iter("junction")
    }


def _centre(points: list[tuple[float, float]]) -> tuple[float, float]:
    x, y = np.mean(points, axis=0)
    return float(x), float(y)


def _unique(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
