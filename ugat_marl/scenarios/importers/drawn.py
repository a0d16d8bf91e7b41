"""Road networks with demand, drawn from one seed: grids, main roads and irregular networks.

`NetworkRanges` holds everything that is drawn, with its range. `draw_network` draws a network as a
value, without SUMO; `drawn_sources` makes its files, and `draw_scenario` a scenario directory.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import Document, read_xml, write_whole
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios.capacity import degrees_of_saturation
from ugat_marl.scenarios.importers.making import (
    NETWORK,
    ROUTES,
    RoadFiles,
    RoadSource,
    VehicleFiles,
    VehicleSource,
    make_scenario,
)
from ugat_marl.scenarios.importers.plan import (
    NETCONVERT,
    Node,
    Road,
    RoadPlan,
    build_network,
    lattice,
    netconvert_documents,
)
from ugat_marl.scenarios.importers.streets import Streets
from ugat_marl.scenarios.importers.turning_shares import Drive, poisson_arrivals, write_drives
from ugat_marl.scenarios.phases import suited
from ugat_marl.scenarios.scenario import Scenario
from ugat_marl.scenarios.settings import validate_settings
from ugat_marl.seeding import numpy_generator

Profile = Literal["constant", "rising", "peak"]
Range = tuple[float, float]
Turns = tuple[float, float, float]
"""Shares of left turns, straight on and right turns."""

MOST_ALONG = 6
"""Most intersections along a main road: with more, half an hour would not fill it."""
MOST_ACROSS = 3
"""Most rows and columns of a grid."""
LARGEST_SHIFT = 0.12
"""Largest `NetworkRanges.shift`: with more, the turn of a road ahead could be mistaken."""
_LEAST_SHARE = 0.02
"""Smallest share of a turn before the shares are scaled to one."""
_LEAST_ROUTE = 1e-5
"""Share of an entry's vehicles below which a route is left out."""
_SIDES = ("west", "east", "south", "north")
"""Beginnings of the names of ends; the row or column follows."""
_ARMS = 3
"""Least number of roads at an intersection."""


@dataclass(frozen=True)
class NetworkRanges:
    """Ranges from which networks are drawn; pairs are least and largest value, drawn evenly.

    Attributes:
        intersections: Number of intersections.
        spacing_m: Distance between intersections, and length of the roads into the network, before
            nodes are moved, m. Regular networks have one distance, irregular ones one per row,
            column and entry.
        lanes: Number of lanes of a road; main roads are drawn wider than those across.
        left_lanes: Probability that all roads have two or more lanes, one of them for left turns
            alone. In other networks every second road with two or more lanes has one.
        speed_mps: Speed limit, drawn for each row and column, m/s.
        irregular: Probability of an irregular network.
        shift: Distance by which an irregular network moves its intersections along each axis, as a
            share of the shortest road there; at most `LARGEST_SHIFT`.
        removed: Probability that a road of an irregular network is taken away, as long as the
            network stays connected and every intersection keeps three roads.
        permitted: Probability that all left turns are permitted. Otherwise they are so only at
            intersections with lanes for both straight on and left.
        turns: Mean shares of left turns, straight on and right turns.
        turns_alike: Concentration of the Dirichlet distribution around `turns` for the network,
            and around the network's shares for each approach. Larger numbers make them more alike.
        entry_spread: Standard deviation of the logarithm of an entry's demand per lane.
        main_direction: Demand per lane of one end of the main roads against all other entries.
        profiles: Courses of the demand over time, one of which is drawn. It is ``constant``, or it
            is ``rising`` to the end, or has its ``peak`` in the middle of the episode.
        lowest_demand: Least demand of a profile as a share of its largest.
        yellow_s: Yellow, s. Times are drawn in whole seconds.
        all_red_s: All-red, s.
        min_green_s: Minimum green, s.
        decision_interval_s: Decision interval, s.
        duration_s: Length of an episode, s. It is not drawn.
        load: Degree of saturation of the busiest intersection (`degrees_of_saturation`) when the
            demand is largest.
    """

    intersections: tuple[int, int] = (1, 9)
    spacing_m: Range = (120.0, 500.0)
    lanes: tuple[int, int] = (1, 3)
    left_lanes: float = 0.5
    speed_mps: Range = (8.0, 17.0)
    irregular: float = 0.5
    shift: float = LARGEST_SHIFT
    removed: float = 0.25
    permitted: float = 0.2
    turns: Turns = (0.2, 0.6, 0.2)
    turns_alike: float = 20.0
    entry_spread: float = 0.3
    main_direction: Range = (1.0, 2.5)
    profiles: tuple[Profile, ...] = ("constant", "rising", "peak")
    lowest_demand: Range = (0.3, 0.8)
    yellow_s: tuple[int, int] = (3, 5)
    all_red_s: tuple[int, int] = (0, 2)
    min_green_s: tuple[int, int] = (5, 10)
    decision_interval_s: tuple[int, int] = (5, 10)
    duration_s: float = 1800.0
    load: Range = (0.3, 1.1)

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            OptionError: A value is impossible.
        """
        for name, (least, most) in _LIMITS.items():
            value: Any = getattr(self, name)
            paired = isinstance(getattr(NetworkRanges, name), tuple)
            if isinstance(value, tuple) != paired or (paired and len(value) != 2):
                wanted = "the least and the largest value" if paired else "one number"
                raise OptionError(f"{name} = {value}: give {wanted}")
            bounds = cast(Range, value if paired else (value, value))
            if not least <= bounds[0] <= bounds[1] <= most:
                raise OptionError(
                    f"{name} = {value}: give values from {least:g} to {most:g}, the least first"
                )
        if np.shape(self.turns) != (3,) or not all(0 < share < math.inf for share in self.turns):
            raise OptionError(f"turns = {self.turns}: give three shares above 0")
        if not self.profiles or not {*self.profiles} <= {*get_args(Profile)}:
            raise OptionError(
                f"profiles = {self.profiles}: give one or more of {', '.join(get_args(Profile))}"
            )


_LIMITS: dict[str, Range] = {
    "intersections": (1, MOST_ACROSS * MOST_ACROSS), "spacing_m": (80, 5000), "lanes": (1, 3),
    "left_lanes": (0, 1), "speed_mps": (1, 60), "irregular": (0, 1), "shift": (0, LARGEST_SHIFT),
    "removed": (0, 1), "permitted": (0, 1), "turns_alike": (0.1, 1e6), "entry_spread": (0, 2),
    "main_direction": (0.1, 10), "lowest_demand": (0, 1), "yellow_s": (0, 60),
    "all_red_s": (0, 60), "min_green_s": (0, 600), "decision_interval_s": (1, 600),
    "duration_s": (1, 1e7), "load": (0.01, 3),
}  # fmt: skip


@dataclass(frozen=True)
class DrawnNetwork:
    """A network that was drawn.

    Attributes:
        seed: Seed of all draws.
        plan: Nodes and roads.
        words: Description.
        permitted: True if all left turns are permitted.
        turns: Road to an intersection, to the shares of its turns.
        entries: Road into the network, to its share of the demand; they add up to one.
        profile: Course of the demand over time.
        lowest_demand: Least demand of the profile as a share of its largest.
        control: Signal timing, as in ``scenario.toml``, s.
        duration_s: Length of an episode, s.
        load: Degree of saturation of the busiest intersection when the demand is largest.
    """

    seed: int
    plan: RoadPlan
    words: str
    permitted: bool
    turns: Mapping[str, Turns]
    entries: Mapping[str, float]
    profile: Profile
    lowest_demand: float
    control: Mapping[str, float]
    duration_s: float
    load: float

    def demand_at(self, time_s: float) -> float:
        """Return the demand at a time after the start, as a share of the largest."""
        course = time_s / self.duration_s
        rise = {"constant": 1.0, "rising": course, "peak": 1.0 - abs(2.0 * course - 1.0)}
        return self.lowest_demand + (1.0 - self.lowest_demand) * rise[self.profile]


def draw_network(seed: int, ranges: NetworkRanges | None = None) -> DrawnNetwork:
    """Draw a network; the same seed and ranges give the same network.

    Args:
        seed: Seed of all draws.
        ranges: Ranges to draw from.
    """
    ranges = ranges or NetworkRanges()
    random = numpy_generator(seed, "drawn network")
    rows, columns = _size(ranges, random)
    irregular = bool(random.random() < ranges.irregular)
    lines = _lines(rows, columns, ranges, random)
    nodes, segments = _laid_out(rows, columns, ranges, random, irregular=irregular)
    if irregular:
        nodes = _moved(nodes, segments, ranges.shift, random)
        segments = _thinned(nodes, segments, ranges.removed, random)
    ends = {end for segment in segments for end in segment.ends}
    plan = _with_lanes({name: nodes[name] for name in nodes if name in ends}, segments, lines)
    seconds = ("yellow_s", "all_red_s", "min_green_s", "decision_interval_s")
    control = {name: float(_whole(getattr(ranges, name), random)) for name in seconds}
    return DrawnNetwork(
        seed,
        plan,
        f"{'An irregular' if irregular else 'A regular'} network of {rows} by {columns} "
        "intersections",
        bool(random.random() < ranges.permitted),
        _turns(plan, ranges, random),
        _entries(plan, lines, ranges, random),
        ranges.profiles[int(random.integers(len(ranges.profiles)))],
        _even(ranges.lowest_demand, random),
        control,
        ranges.duration_s,
        _even(ranges.load, random),
    )


def draw_scenario(
    target: Path,
    seed: int,
    ranges: NetworkRanges | None = None,
    *,
    force: bool = False,
    reporter: Reporter | None = None,
) -> Scenario:
    """Draw a scenario and write its directory atomically.

    The same name, seed and ranges give the same files, byte by byte.

    Args:
        target: The directory to make; its last part is the scenario's name.
        seed: Seed of all draws.
        ranges: Ranges to draw from.
        force: True to replace an existing scenario.
        reporter: Shows progress.

    Raises:
        OutputError: The directory exists, or cannot be written.
    """
    ranges = ranges or NetworkRanges()
    command = f"ugat-marl scenario new {shlex.quote(target.name)} --draw {seed}"
    if ranges != NetworkRanges():
        names = "NetworkRanges, draw_scenario"
        call = f"draw_scenario(Path({target.name!r}), {seed}, {_differing(ranges)})"
        script = f"from pathlib import Path; from ugat_marl.scenarios import {names}; {call}"
        command = shlex.join(["python", "-c", script])
    roads, vehicles = drawn_sources(seed, ranges)
    made = make_scenario(
        target,
        roads,
        vehicles,
        settings={},
        command=command,
        force=force,
        reporter=reporter or Silent(),
    )
    return made.scenario


def _differing(ranges: NetworkRanges) -> str:
    usual = NetworkRanges()
    pairs = ((field.name, getattr(ranges, field.name)) for field in fields(ranges))
    changed = (f"{name}={value!r}" for name, value in pairs if value != getattr(usual, name))
    return f"NetworkRanges({', '.join(changed)})"


def drawn_sources(
    seed: int, ranges: NetworkRanges | None = None
) -> tuple[RoadSource, VehicleSource]:
    """Return a source of roads and one of vehicles for a network drawn from a seed."""
    drawn = draw_network(seed, ranges)

    def roads(folder: Path, reporter: Reporter) -> RoadFiles:
        shared = any({"s", "l"} <= set(lane) for r in drawn.plan.roads.values() for lane in r.lanes)
        programme = {
            "tls.yellow.time": int(drawn.control["yellow_s"]),
            "tls.allred.time": int(drawn.control["all_red_s"]),
            "tls.minor-left.max-speed": 100 if drawn.permitted or shared else 0,
        }
        documents = netconvert_documents(drawn.plan, 13.9)
        write_whole(folder / NETWORK, build_network(documents, {**NETCONVERT, **programme}))
        return RoadFiles(
            f"{drawn.words}, drawn with seed {seed}; {drawn.profile} demand, load {drawn.load:.2f}",
            "Drawn by the suite and built by SUMO's netconvert. Nobody else has rights in it.",
            settings=_settings(drawn, folder / NETWORK),
        )

    def vehicles(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
        drives = _drives(drawn, network)
        if not drives:
            raise ScenarioError(
                f"nobody enters within {drawn.duration_s:g} s at load {drawn.load:.2f}; raise the "
                "load or the duration"
            )
        write_drives(folder / ROUTES, drives)
        return VehicleFiles((ROUTES,))

    return roads, vehicles


def _settings(drawn: DrawnNetwork, network: Path) -> Mapping[str, Any]:
    """Return what the ``scenario.toml`` holds beside the files."""
    if drawn.permitted:
        control, lights = {"phases": "permitted", **drawn.control}, {}
    else:
        control, lights = {"phases": "conflict-free", **drawn.control}, suited(network)[0]
    return {
        "duration_s": drawn.duration_s,
        "control": control,
        "intersections": {tls: {"phases": kind} for tls, kind in lights.items()},
    }


# Demand


def _drives(drawn: DrawnNetwork, network: Path) -> list[Drive]:
    """Draw the vehicles: Poisson arrivals at every entry, routes by the shares of the turns."""
    streets = Streets.of(read_xml(network))
    routes = {
        entry: route_shares(streets, entry, lambda road: drawn.turns[road])
        for entry in drawn.entries
    }
    flows: dict[tuple[str, str], float] = {}
    for entry, share in drawn.entries.items():
        for route, part in routes[entry].items():
            for movement in pairwise(route):
                flows[movement] = flows.get(movement, 0.0) + 1000.0 * share * part
    draft = Scenario(
        "drawn",
        Document(network.name, network),
        (),
        (),
        validate_settings(
            {"network": NETWORK, "routes": [ROUTES], **_settings(drawn, network)}, "drawn"
        ),
    )
    total_vph = 1000.0 * drawn.load / max(degrees_of_saturation(draft, flows).values())
    drives: list[Drive] = []
    for entry, share in drawn.entries.items():
        random = numpy_generator(drawn.seed, "drawn entry", entry)
        names, parts = list(routes[entry]), np.cumsum(list(routes[entry].values()))
        for moment in poisson_arrivals(random, total_vph * share / 3600, drawn.duration_s):
            kept, place = random.random(2)
            if kept < drawn.demand_at(moment):
                route = names[min(int(np.searchsorted(parts, place)), len(names) - 1)]
                drives.append(Drive(f"{entry}_{len(drives)}", round(moment, 2), route))
    return sorted(drives, key=lambda drive: (drive.depart_s, drive.id))


def route_shares(
    streets: Streets, entry: str, turns: Callable[[str], Turns]
) -> dict[tuple[str, ...], float]:
    """Return all routes from an entry to an exit that pass no junction twice, with their shares.

    Vehicles draw a turn at each junction; a route that would pass a junction twice is drawn again.
    So the share of a route is the product of its turns, divided by the sum over all routes.

    Args:
        streets: Roads of the network.
        entry: Road into the network.
        turns: Function from a road to the shares of left turns, straight on and right turns. If a
            turn is not possible, the others keep their proportion.

    Raises:
        ScenarioError: No route leads from the entry to an exit.
    """
    found = dict(_routes(streets, (entry,), {streets.start[entry]}, 1.0, turns))
    total = sum(found.values())
    if not total:
        raise ScenarioError(f"no route leads from road {entry!r} out of the network")
    return {route: share / total for route, share in found.items()}


def _routes(
    streets: Streets,
    route: tuple[str, ...],
    passed: set[str],
    share: float,
    turns: Callable[[str], Turns],
) -> Iterator[tuple[tuple[str, ...], float]]:
    road = route[-1]
    here = streets.end[road]
    if here in passed or share < _LEAST_ROUTE:
        return
    if road in streets.exits:
        yield route, share
        return
    ahead = {turn: roads for turn, roads in streets.ahead.get(road, {}).items() if turn != "t"}
    left, straight, right = turns(road)
    shares = {"l": left, "s": straight, "r": right}
    total = sum(shares[turn] for turn in ahead)
    for turn, roads in ahead.items():
        for following in roads:
            part = share * shares[turn] / total / len(roads)
            yield from _routes(streets, (*route, following), passed | {here}, part, turns)


def _turns(plan: RoadPlan, ranges: NetworkRanges, random: np.random.Generator) -> dict[str, Turns]:
    def around(mean: Turns) -> Turns:
        shares = random.dirichlet(ranges.turns_alike * np.array(mean))
        left, straight, right = map(float, np.maximum(shares, _LEAST_SHARE))
        total = left + straight + right
        return left / total, straight / total, right / total

    network = around(ranges.turns)
    return {road.id: around(network) for road in plan.roads.values() if plan.nodes[road.end].signal}


def _entries(
    plan: RoadPlan, lines: Mapping[str, _Line], ranges: NetworkRanges, random: np.random.Generator
) -> dict[str, float]:
    """Draw the shares of the entries; one end of the main roads has more demand than the others."""
    factor = _even(ranges.main_direction, random)
    first = bool(random.random() < 0.5)
    weights: dict[str, float] = {}
    for road in plan.roads.values():
        if plan.nodes[road.start].signal:
            continue
        weights[road.id] = len(road.lanes) * math.exp(ranges.entry_spread * random.normal())
        side = next(side for side in _SIDES if road.start.startswith(side))
        if lines[road.start.removeprefix(side)].main and first == (side in ("west", "south")):
            weights[road.id] *= factor
    total = sum(weights.values())
    return {road: weight / total for road, weight in weights.items()}


# Roads


@dataclass(frozen=True)
class _Line:
    """A row or column: its roads have the same width and speed limit.

    Attributes:
        lanes: Number of lanes.
        left_lane: True if there is a lane for left turns alone.
        speed_mps: Speed limit.
        main: True if it is a main road.
    """

    lanes: int
    left_lane: bool
    speed_mps: float
    main: bool


@dataclass(frozen=True)
class _Segment:
    """Two-way road between two nodes.

    Attributes:
        ends: Its nodes.
        line: Row or column that it belongs to.
    """

    ends: tuple[str, str]
    line: str


def _size(ranges: NetworkRanges, random: np.random.Generator) -> tuple[int, int]:
    """Draw rows and columns: first the kind, then one of its sizes.

    The kinds are single intersections, main roads and grids; the first is drawn half as often.
    """
    least, most = ranges.intersections
    across = range(2, MOST_ACROSS + 1)
    kinds = (
        [(1, 1)],
        [(1, columns) for columns in range(2, MOST_ALONG + 1)],
        [(rows, columns) for rows in across for columns in across],
    )
    fitting = [[size for size in sizes if least <= size[0] * size[1] <= most] for sizes in kinds]
    fitting = [sizes for sizes in fitting if sizes]
    if not fitting:
        raise OptionError(
            f"intersections = {ranges.intersections}: no network has so many; give a wider range"
        )
    weights = [2 if len(sizes) > 1 else 1 for sizes in fitting]
    sizes = fitting[int(random.choice(len(fitting), p=np.array(weights) / sum(weights)))]
    return sizes[int(random.integers(len(sizes)))]


def _lines(
    rows: int, columns: int, ranges: NetworkRanges, random: np.random.Generator
) -> dict[str, _Line]:
    """Draw the width and speed limit of each row (1, 2, ...) and column (A, B, ...)."""
    rows_are_main = rows == 1 or bool(random.random() < 0.5)
    everywhere = bool(random.random() < ranges.left_lanes)
    least, most = ranges.lanes
    widths = (max(least, min(2, most)), most) if everywhere else (least, most)
    lines: dict[str, _Line] = {}
    names = [(str(row + 1), True) for row in range(rows)]
    names += [(letter, False) for letter in "ABCDEF"[:columns]]
    for name, is_row in names:
        main = is_row == rows_are_main
        two = (_whole(widths, random), _whole(widths, random))
        lines[name] = _Line(
            max(two) if main else min(two),
            bool(random.random() < 0.5) or everywhere,
            round(_even(ranges.speed_mps, random), 1),
            main,
        )
    return lines


def _laid_out(
    rows: int,
    columns: int,
    ranges: NetworkRanges,
    random: np.random.Generator,
    *,
    irregular: bool,
) -> tuple[dict[str, Node], list[_Segment]]:
    """Return nodes and roads of a grid, with the names of `plan.grid`."""
    usual_m = _even(ranges.spacing_m, random)

    def length_m() -> float:
        return round(_even(ranges.spacing_m, random) if irregular else usual_m, 1)

    xs = np.cumsum([0.0, *(length_m() for _ in range(columns - 1))]).tolist()
    ys = np.cumsum([0.0, *(length_m() for _ in range(rows - 1))]).tolist()
    nodes: dict[str, Node] = {}
    segments: list[_Segment] = []
    for line, chain in lattice(xs, ys, length_m):
        nodes |= {node.id: node for node in chain}
        segments += [_Segment((a.id, b.id), line) for a, b in pairwise(chain)]
    return nodes, segments


def _moved(
    nodes: Mapping[str, Node],
    segments: Sequence[_Segment],
    shift: float,
    random: np.random.Generator,
) -> dict[str, Node]:
    """Move each intersection along both axes, by at most a share of its shortest road."""

    def length_m(segment: _Segment) -> float:
        a, b = (nodes[end] for end in segment.ends)
        return math.hypot(a.x - b.x, a.y - b.y)

    moved: dict[str, Node] = {}
    for name, node in nodes.items():
        if node.signal:
            most_m = shift * min(length_m(s) for s in segments if name in s.ends)
            x, y = random.uniform(-most_m, most_m, 2)
            moved[name] = replace(
                node, x=round(node.x + float(x), 1), y=round(node.y + float(y), 1)
            )
        else:
            moved[name] = node
    return moved


def _thinned(
    nodes: Mapping[str, Node],
    segments: Sequence[_Segment],
    removed: float,
    random: np.random.Generator,
) -> list[_Segment]:
    """Take roads away at random; intersections keep three roads, and the network is connected."""
    kept = list(segments)
    for place in random.permutation(len(segments)).tolist():
        if random.random() >= removed:
            continue
        segment = segments[place]
        rest = [other for other in kept if other != segment]
        enough = all(
            sum(end in other.ends for other in rest) >= _ARMS
            for end in segment.ends
            if nodes[end].signal
        )
        if enough and _connected(nodes, rest):
            kept = rest
    return kept


def _connected(nodes: Mapping[str, Node], segments: Sequence[_Segment]) -> bool:
    """Return True if roads join all intersections and at least two ends."""
    reached = {segments[0].ends[0]}
    while more := {
        end for s in segments if reached & set(s.ends) for end in s.ends if end not in reached
    }:
        reached |= more
    signals = {name for name, node in nodes.items() if node.signal}
    return signals <= reached and len(reached - signals) >= 2


def _with_lanes(
    nodes: dict[str, Node], segments: Sequence[_Segment], lines: Mapping[str, _Line]
) -> RoadPlan:
    """Return the plan, with lanes for the turns that each approach has.

    No approach has more lanes straight on than the road ahead, and no road has lanes that nobody
    enters. So narrowing one road can force its feeders to narrow. All roads are narrowed again
    until nothing changes.
    """
    roads: dict[str, Road] = {}
    line_of: dict[str, _Line] = {}
    for segment in segments:
        line = lines[segment.line]
        for start, end in (segment.ends, segment.ends[::-1]):
            road = Road(start, end, ("s",) * line.lanes, line.speed_mps)
            roads[road.id], line_of[road.id] = road, line
    plan = RoadPlan(nodes, roads)
    entered: dict[str, set[str]] = {}
    for road in roads.values():
        for turn, following in plan.exits(road).items() if nodes[road.end].signal else ():
            entered.setdefault(following.id, set()).add(turn)
    before: dict[str, Road] = {}
    while before != roads:
        before = dict(roads)
        for name, road in before.items():
            turns = entered.get(name, {"s"})
            count = len(road.lanes) if "s" in turns else min(len(road.lanes), len(turns))
            lanes = ("s",) * count
            if nodes[road.end].signal:
                exits = plan.exits(road)
                ahead = len(exits["s"].lanes) if "s" in exits else 0
                left_lane = line_of[name].left_lane
                lanes = approach_lanes(frozenset(exits), count, ahead, left_lane=left_lane)
            roads[name] = replace(road, lanes=lanes)
    return plan


def approach_lanes(
    turns: frozenset[str], count: int, ahead: int, *, left_lane: bool
) -> tuple[str, ...]:
    """Return the lanes of an approach, kerb first, each with its turns.

    Args:
        turns: Turns that are possible (``l``, ``s``, ``r``), two or three.
        count: Number of lanes wished for.
        ahead: Number of lanes of the road straight ahead.
        left_lane: True for a lane for left turns alone, if there are two lanes.
    """
    if "s" not in turns:
        return ("r", "l") if count > 1 else ("rl",)
    apart = left_lane and "l" in turns and count > 1
    lanes = ["s"] * min(count - apart, ahead)
    if "r" in turns:
        lanes[0] += "r"
    if apart:
        lanes.append("l")
    elif "l" in turns:
        lanes[-1] += "l"
    return tuple(lanes)


def _even(bounds: Range, random: np.random.Generator) -> float:
    return float(random.uniform(*bounds))


def _whole(bounds: tuple[int, int], random: np.random.Generator) -> int:
    return int(random.integers(bounds[0], bounds[1] + 1))
