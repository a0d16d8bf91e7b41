"""Effects on the number of vehicles that depart, and on their times.

They change single vehicles, trips and flows. A hash of their ids decides which vehicles are left
out or get a twin, so vehicles kept at a level of 0.6 are also kept at 0.8.
"""

from __future__ import annotations

import copy
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import ClassVar

from ugat_marl.effects.base import (
    EVERYWHERE,
    TIME_OF_EPISODE,
    Effect,
    ExaminedStrengths,
    NumberParameter,
    TextParameter,
    hashed_uniform,
    salt_of,
)
from ugat_marl.effects.documents import (
    FLOW_RATES,
    depart_s,
    edit_scenario,
    is_demand,
    mentions,
    windows,
)
from ugat_marl.effects.places import network_places
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import (
    Scenario,
    laps_of,
    move_stops,
    own_stops,
    parse_time,
    seconds_text,
)

TAGS = ("<vehicle", "<trip", "<flow")
"""Texts of demand; a document without any of them has no demand."""

TWIN_S = 15.0
"""Largest time between the departures of a twin and its original, in s."""

_FACTOR = NumberParameter("", 0.0, 20.0)
_EXPONENTIAL = re.compile(r"\s*exp\((.*)\)\s*")
_TWIN = re.compile(rb"(\++)(?:\d+|surge|after)[\"']")


@dataclass
class NamedRoutes:
    """Routes that are defined apart from their vehicles.

    Attributes:
        edges: Route to its edges.
        first: Route, or distribution of routes, to its first edge.
        several: Distribution of routes that begin on several edges, to these edges.
        stops: Route to its stops, if it has any.
    """

    edges: dict[str, tuple[str, ...]] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)
    several: dict[str, set[str]] = field(default_factory=dict)
    stops: dict[str, list[ET.Element]] = field(default_factory=dict)

    @classmethod
    def of(cls, scenario: Scenario) -> NamedRoutes:
        """Read all routes that vehicles of a scenario may refer to."""
        documents = (*scenario.additional, *scenario.routes)
        routes = cls()
        if not any(mentions(document, "route=", "route =") for document in documents):
            return routes
        distributions: list[ET.Element] = []
        shared: dict[tuple[str, ...], tuple[str, ...]] = {}  # many routes go the same way
        for document in documents:
            if not mentions(document, *(f"<route{space}" for space in " \n\t\r")):
                continue
            for part in document.parts():
                for element in part.iter("route"):
                    if "id" in element.attrib:
                        edges = _edges(element)
                        routes.edges[element.get("id", "")] = shared.setdefault(edges, edges)
                        if stops := element.findall("stop"):
                            routes.stops[element.get("id", "")] = stops
                distributions += part.iter("routeDistribution")
        routes.first = {name: edges[0] for name, edges in routes.edges.items() if edges}
        for element in distributions:
            first = routes.begins(element)
            name = element.get("id", "")
            if len(first) == 1:
                routes.first[name] = next(iter(first))
            elif first:
                routes.several[name] = first
        return routes

    def begins(self, distribution: ET.Element) -> set[str]:
        """Return the first edges of the routes of a distribution."""
        inner = [_edges(x) for x in distribution.iter("route")]
        inner += [self.edges.get(x, ()) for x in distribution.get("routes", "").split()]
        return {edges[0] for edges in inner if edges}

    def drawn(self, element: ET.Element) -> set[str]:
        """Return the edges of which a vehicle or flow draws its first one; none if it does not."""
        if element.find("route") is not None:
            return set()
        inner = element.find("routeDistribution")
        if inner is not None:
            return self.begins(inner)
        return self.several.get(element.get("route", ""), set())

    def edges_of(self, element: ET.Element) -> tuple[str, ...]:
        """Return the edges of a vehicle or flow; none if SUMO still has to find its way."""
        inner = element.find("route")
        return _edges(inner) if inner is not None else self.edges.get(element.get("route", ""), ())

    def origin(self, element: ET.Element) -> str | None:
        """Return the first edge of a vehicle, trip or flow; None if only SUMO knows it."""
        inner = element.find("route")
        if inner is not None:
            return next(iter(_edges(inner)), None)
        drawn = self.drawn(element)
        if len(drawn) == 1:
            return next(iter(drawn))
        return self.first.get(element.get("route", "")) or element.get("from")


def _edges(element: ET.Element) -> tuple[str, ...]:
    """Return the edges of a route, as often as its laps are driven."""
    return laps_of(element.attrib) * tuple(element.get("edges", "").split())


@dataclass(frozen=True)
class DemandLevel(Effect):
    """The number of vehicles that start on an edge (``"*"``: all) is multiplied by a factor."""

    name: ClassVar[str] = "demand_level"
    on_departures: ClassVar[bool] = True
    ranges: ClassVar[dict[str, NumberParameter]] = {"factor": _FACTOR}
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge", everywhere=True)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((1.15,), 1.0, 0.03, both=True)
    edge: str
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Leave out or repeat vehicles, and change the rates of flows.

        Raises:
            UnknownNameError: No such edge.
        """
        return _scaled(scenario, self, self.edge, (0.0, math.inf), self.factor)


@dataclass(frozen=True)
class DemandSurge(Effect):
    """Between two times, the number of vehicles that start on an edge is multiplied by a factor."""

    name: ClassVar[str] = "demand_surge"
    on_departures: ClassVar[bool] = True
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "begin_s": TIME_OF_EPISODE,
        "end_s": TIME_OF_EPISODE,
        "factor": _FACTOR,
    }
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge", everywhere=True)}
    edge: str
    begin_s: float
    end_s: float
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Leave out or repeat vehicles that depart then, and cut flows into parts.

        Raises:
            UnknownNameError: No such edge.
        """
        return _scaled(scenario, self, self.edge, (self.begin_s, self.end_s), self.factor)


@dataclass(frozen=True)
class DemandTiming(Effect):
    """Vehicles that start on an edge (``"*"``: all) depart `seconds` later.

    Vehicles that would depart before the scenario begins are left out.
    """

    name: ClassVar[str] = "demand_timing"
    on_departures: ClassVar[bool] = True
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "seconds": NumberParameter("s", -7200.0, 7200.0)
    }
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge", everywhere=True)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((300.0,), 0.0, 45.0, both=True)
    edge: str
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Shift departures.

        Raises:
            UnknownNameError: No such edge.
        """
        earliest = scenario.settings.begin_s
        over = earliest + scenario.settings.duration_s

        def shifted(element: ET.Element) -> list[ET.Element]:
            begin = depart_s(element)
            if math.isnan(begin):
                return [element]
            if element.tag == "flow":
                return _shifted_flow(element, self.seconds, earliest, over)
            if begin >= earliest:  # others take no part in the simulation anyway
                begin += self.seconds
            if begin < earliest:
                return []
            move_stops(own_stops(element), begin - depart_s(element))
            element.set("depart", seconds_text(begin))
            return [element]

        return replace_departing(scenario, self, self.edge, shifted)


def _refuse_unknown_origin(
    effect: Effect, element: ET.Element, edge: str, routes: NamedRoutes
) -> None:
    """Refuse demand of which only SUMO decides whether it starts on an edge.

    Raises:
        OptionError: The element starts in a district or at a junction, or draws its route from a
            distribution of routes that begin on that edge and on others.
    """
    drawn = routes.drawn(element)
    if edge in drawn and len(drawn) > 1:
        raise OptionError(
            f"{effect}: {element.tag} {element.get('id')!r} draws one of several routes, which "
            f"begin on {', '.join(sorted(drawn))}, so its first edge is not known; give it a route "
            "of its own, or take every edge (*)"
        )
    for attribute in ("fromTaz", "fromJunction", "fromXY", "fromLonLat"):
        if attribute in element.attrib:
            raise OptionError(
                f"{effect}: {element.tag} {element.get('id')!r} starts at {attribute} = "
                f"{element.get(attribute)!r}, so its first edge is not known; give it the "
                "attribute from, or take every edge (*)"
            )


def replace_departing(
    scenario: Scenario,
    effect: Effect,
    edge: str,
    becomes: Callable[[ET.Element], list[ET.Element]],
) -> Scenario:
    """Replace the vehicles, trips and flows that start on `edge`.

    Args:
        scenario: The scenario; it does not change itself.
        effect: Effect to add to `applied`.
        edge: Edge on which they start, or ``"*"``.
        becomes: Function from an element to the elements that replace it.

    Raises:
        UnknownNameError: The edge does not exist.
    """
    routes = NamedRoutes()
    if edge != EVERYWHERE:
        places = network_places(scenario)
        places.check(effect.name, "edge", edge, places.edges)
        routes = NamedRoutes.of(scenario)

    def change(root: ET.Element) -> bool:
        children: list[ET.Element] = []
        any_changed = False
        for element in root:
            if edge != EVERYWHERE and is_demand(element):
                _refuse_unknown_origin(effect, element, edge, routes)
            if is_demand(element) and (edge == EVERYWHERE or routes.origin(element) == edge):
                any_changed = True
                children += becomes(element)
            else:
                children.append(element)
        root[:] = children
        return any_changed

    return edit_scenario(scenario, change, *TAGS, applied=str(effect), in_order=True)


@dataclass(frozen=True)
class _Regular:
    """Vehicles that depart at equal distances in time.

    Attributes:
        begin_s: First departure, s.
        spacing_s: Time between two departures, s; 0 if the flow has no duration.
        number: Number of vehicles.
        until_s: Time before which the last one has to depart, s.
    """

    begin_s: float
    spacing_s: float
    number: int
    until_s: float = math.inf

    @property
    def end_s(self) -> float:
        """Time of the departure that would follow the last one, s."""
        return self.begin_s + self.number * self.spacing_s

    def before(self, time_s: float) -> int:
        """Return the number of vehicles that depart before a time."""
        if self.spacing_s <= 0:
            return self.number if self.begin_s < time_s else 0
        number = math.ceil((time_s - self.begin_s) / self.spacing_s - 1e-9)
        return min(max(number, 0), self.number)

    def cut(self, first: int, last: int) -> _Regular:
        """Return the flow of the vehicles from number `first` to the one before `last`."""
        return replace(
            self, begin_s=self.begin_s + first * self.spacing_s, number=max(0, last - first)
        )

    def resized(self, number: int) -> _Regular:
        """Return another number of vehicles in the same time."""
        end_s = min(self.end_s, self.until_s) if number > self.number else self.end_s
        return replace(self, spacing_s=(end_s - self.begin_s) / number, number=number)

    @classmethod
    def of(cls, flow: ET.Element, over_s: float) -> _Regular | None:
        """Read a flow as SUMO does; None if departures are random, or its time is empty or unknown.

        Args:
            flow: A ``<flow>``.
            over_s: End of a flow that has none itself, s.
        """
        begin, text = depart_s(flow), flow.get("number")
        period, end = _period_s(flow), flow.get("end")
        until = parse_time(end) if end else max(over_s, begin)
        if math.isnan(begin) or period is None or until < begin:
            return None
        if period and text is None:
            return cls(begin, period, math.ceil((until - begin) / period - 1e-9), until)
        number = round(float(text or 0))
        return cls(begin, period or (until - begin) / max(number, 1), number)

    def written(self, element: ET.Element) -> ET.Element:
        """Return a copy of the element that is this flow."""
        flow = copy.deepcopy(element)
        for key in FLOW_RATES:
            flow.attrib.pop(key, None)
        move_stops(own_stops(flow), self.begin_s - depart_s(element))
        flow.set("begin", seconds_text(self.begin_s))
        flow.set("number", str(self.number))
        if self.spacing_s > 0 or "end" in flow.attrib:
            # The end of several vehicles tells their spacing; that of a single one is its flow's.
            end_s = min(self.end_s, self.until_s) if self.number == 1 else self.end_s
            flow.set("end", seconds_text(end_s))
        return flow


def _period_s(flow: ET.Element) -> float | None:
    """Return the time between two departures, s: 0 without a rate, None if random or never."""
    if departs_by_chance(flow):
        return None
    if hourly := flow.get("vehsPerHour") or flow.get("perHour"):
        rate = float(hourly)
        return 3600 / rate if rate > 0 else None
    return parse_time(flow.get("period", "0"))


def departs_by_chance(flow: ET.Element) -> bool:
    """Return True if the vehicles of a flow depart at random times."""
    return "probability" in flow.attrib or bool(_EXPONENTIAL.fullmatch(flow.get("period", "")))


def parted_flow(
    element: ET.Element, shares: Sequence[float], over_s: float, salt: str
) -> list[ET.Element | None]:
    """Return parts of a flow, each with a share of its vehicles.

    Random departures get other rates. Flows with a number of vehicles get whole numbers. A hash of
    the flow's id decides which of them are rounded up: the expectation is exact for each part, and
    shares that sum up to 1 keep every vehicle.

    Args:
        element: A ``<flow>``.
        shares: Shares of its vehicles, 0 or more; they may sum up to more than 1.
        over_s: End of the flow, in s, if it has none itself.
        salt: Name of the decision, as for `hashed_uniform`.

    Returns:
        The parts, all with the id of the flow; None for those without vehicles.
    """
    regular = _Regular.of(element, over_s)
    number = round(float(element.get("number", "0"))) if regular is None else regular.number
    offset = hashed_uniform(salt, "flow", element.get("id", ""))
    sums = [0.0, *accumulate(shares)]
    bounds = [math.floor(round(number * total, 9) + offset) for total in sums]
    counts = [last - first for first, last in pairwise(bounds)]
    if regular is not None:
        return [regular.resized(some).written(element) if some else None for some in counts]
    numbers = counts if "number" in element.attrib else [None] * len(counts)
    return [_scaled_rate(element, *part, over_s) for part in zip(shares, numbers, strict=True)]


def _scaled_rate(
    element: ET.Element, factor: float, number: int | None, end_s: float
) -> ET.Element | None:
    """Return a flow of random departures with another rate; None if nothing is left of it.

    Args:
        element: A ``<flow>``.
        factor: Factor of its rate.
        number: Number of its vehicles; None if it has none.
        end_s: End of a flow that has neither a number nor an end, s.
    """
    if factor <= 0 or number == 0:
        return None
    flow = copy.deepcopy(element)
    if rate := _EXPONENTIAL.fullmatch(flow.get("period", "")):
        flow.set("period", f"exp({float(rate[1]) * factor:.12g})")
    if text := flow.get("probability"):
        share = float(text) * factor
        if share <= 1:
            flow.set("probability", f"{share:.12g}")
        else:  # a probability per second cannot exceed 1, so use a rate
            del flow.attrib["probability"]
            flow.set("period", f"exp({share:.12g})")
    if number is None:
        flow.attrib.setdefault("end", seconds_text(end_s))
    else:
        flow.set("number", str(number))
    return flow


def _mean_period_s(flow: ET.Element) -> float:
    """Return the mean time between two random departures, s."""
    exponential = _EXPONENTIAL.fullmatch(flow.get("period", ""))
    return 1 / float(exponential[1] if exponential else flow.get("probability", "1"))


def _shifted_flow(
    element: ET.Element, seconds: float, earliest_s: float, over_s: float
) -> list[ET.Element]:
    """Return the flow with later departures, without those before `earliest_s`.

    Vehicles that were due before `earliest_s` take no part in the simulation; none is shifted.
    """
    endless = "end" not in element.attrib and "number" not in element.attrib
    regular = None if endless else _Regular.of(element, over_s)
    if regular is not None:
        present = regular.cut(regular.before(earliest_s), regular.number)
        until_s = present.until_s + seconds
        later = replace(present, begin_s=present.begin_s + seconds, until_s=until_s)
        kept = later.cut(later.before(earliest_s), later.number)
        return [kept.written(element)] if kept.number else []
    period_s = _period_s(element) or 0.0  # endless departures keep their spacing
    first = _not_before(earliest_s, depart_s(element), period_s)
    begin = _not_before(earliest_s, first + seconds, period_s)
    if first + seconds < earliest_s and (number := element.attrib.pop("number", None)):
        over = depart_s(element) + float(number) * _mean_period_s(element)
        element.attrib.setdefault("end", seconds_text(over))
    end = element.get("end")
    if end is not None:
        until = parse_time(end) + seconds
        if until <= earliest_s:
            return []
        element.set("end", seconds_text(until))
    move_stops(own_stops(element), begin - depart_s(element) if period_s else seconds)
    element.set("begin", seconds_text(begin))
    return [element]


def _not_before(earliest_s: float, begin_s: float, period_s: float) -> float:
    """Return the first time from `earliest_s` on of a row of times with a period, or of 0 s."""
    if begin_s >= earliest_s or not period_s:
        return max(begin_s, earliest_s)
    return begin_s + period_s * math.ceil((earliest_s - begin_s) / period_s - 1e-9)


def _scaled(
    scenario: Scenario, effect: Effect, edge: str, window: tuple[float, float], factor: float
) -> Scenario:
    begin, end = window
    settings = scenario.settings
    over = settings.begin_s + settings.duration_s
    salt = salt_of(scenario, effect, edge)
    least = max(settings.begin_s, begin)
    mark = _mark(scenario)

    def scaled(element: ET.Element) -> list[ET.Element]:
        if element.tag == "flow":
            return _scaled_window(element, window, factor, over, mark, salt)
        depart = depart_s(element)
        if not least <= depart < end:  # not a number for one that waits for a person or container
            return [element]  # one from before the episode takes no part in it
        name = element.get("id", "")
        count = math.floor(factor) + (hashed_uniform(salt, name) < factor - math.floor(factor))
        copies = [element] if count else []
        for number in range(1, count):
            twin = copy.deepcopy(element)
            twin.set("id", f"{name}{mark}{number}")
            shift = TWIN_S * (2 * hashed_uniform(salt, "when", name, str(number)) - 1)
            times = (round(depart + shift, 2), round(depart - shift, 2), depart)
            time = next(time for time in times if least <= time < end)
            move_stops(own_stops(twin), time - depart)
            twin.set("depart", seconds_text(time))
            copies.append(twin)
        return copies

    return replace_departing(scenario, effect, edge, scaled)


def _mark(scenario: Scenario) -> str:
    """Return a mark for the ids of twins that no id has yet, because demand may grow twice."""
    documents = (*scenario.additional, *scenario.routes)
    twins = (_TWIN.finditer(window) for document in documents for window in windows(document))
    return "+" * (1 + max((len(match[1]) for matches in twins for match in matches), default=0))


def _scaled_window(
    element: ET.Element,
    window: tuple[float, float],
    factor: float,
    over_s: float,
    mark: str,
    salt: str,
) -> list[ET.Element]:
    """Return a flow in up to three parts: before, within and after the window."""
    begin = depart_s(element)
    if math.isnan(begin):
        return [element]
    regular = _Regular.of(element, over_s)
    end = regular.end_s if regular else _random_end_s(element, over_s)
    first, last = max(begin, window[0]), min(end, window[1])
    if first > last or (first == last and (regular is None or regular.spacing_s)):
        return [element]
    if first >= window[1]:  # all depart at once when the window ends
        return [element]
    if first == begin and last == end:
        return [flow for flow in parted_flow(element, (factor,), over_s, salt) if flow is not None]
    parts = (
        (begin, first, 1.0, ""),
        (first, last, factor, f"{mark}surge"),
        (last, end, 1.0, f"{mark}after"),
    )
    flows: list[ET.Element] = []
    for start, stop, rate, suffix in parts:
        if stop <= start:
            continue
        part = copy.deepcopy(element)
        if regular is not None:
            some = regular.cut(regular.before(start), regular.before(stop))
            part = some.written(part)
            if not some.number:
                continue
            if rate != 1:
                part.set("end", seconds_text(min(some.end_s, some.until_s, stop)))
        else:
            part.set("begin", seconds_text(start))
            part.set("end", seconds_text(stop))
            part.attrib.pop("number", None)
        if rate != 1:
            part = parted_flow(part, (rate,), stop, salt)[0]
        if part is not None:
            part.set("id", f"{element.get('id', '')}{suffix if start > begin else ''}")
            flows.append(part)
    return flows


def _random_end_s(flow: ET.Element, over_s: float) -> float:
    """Return the end of a flow of random departures, s."""
    if end := flow.get("end"):
        return parse_time(end)
    begin, number = depart_s(flow), flow.get("number")
    lasts_s = float(number) * _mean_period_s(flow) if number else math.inf
    return min(begin + lasts_s, max(over_s, begin))
