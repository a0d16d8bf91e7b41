"""Effects on the number of vehicles that depart, and on their times.

They change single vehicles, trips and flows. A hash of their ids decides which vehicles are left
out or get a twin, so vehicles kept at a level of 0.6 are also kept at 0.8.
"""

from __future__ import annotations

import copy
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from ugat_marl.effects.base import (
    EVERYWHERE,
    Effect,
    ExaminedStrengths,
    NumberParameter,
    TextParameter,
    hashed_uniform,
)
from ugat_marl.effects.documents import (
    depart_s,
    edit_scenario,
    is_demand,
    mentions,
    seconds_text,
    windows,
)
from ugat_marl.effects.places import network_places
from ugat_marl.scenarios import Scenario, parse_time

TAGS = ("<vehicle", "<trip", "<flow")
"""Texts of demand; a document without any of them has no demand."""

TWIN_S = 15.0
"""Largest time between the departures of a twin and its original, in s."""

_FACTOR = NumberParameter("", 0.0, 20.0)
_TIME = NumberParameter("s", 0.0, 1e7)
_EXPONENTIAL = re.compile(r"\s*exp\((.*)\)\s*")
_TWIN = re.compile(rb"(\++)(?:\d+|surge|after)[\"']")


@dataclass
class Routes:
    """Routes that are defined apart from their vehicles.

    Attributes:
        edges: Route to its edges.
        first: Route, or distribution of routes, to its first edge.
    """

    edges: dict[str, tuple[str, ...]] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, scenario: Scenario) -> Routes:
        """Read all routes that vehicles of a scenario may refer to."""
        documents = (*scenario.additional, *scenario.routes)
        routes = cls()
        if not any(mentions(document, "route=", "route =") for document in documents):
            return routes
        distributions: list[ET.Element] = []
        shared: dict[tuple[str, ...], tuple[str, ...]] = {}  # many routes go the same way
        for document in documents:
            if not mentions(document, "<route "):
                continue
            for part in document.parts():
                for element in part.iter("route"):
                    if "id" in element.attrib:
                        edges = _edges(element)
                        routes.edges[element.get("id", "")] = shared.setdefault(edges, edges)
                distributions += part.iter("routeDistribution")
        routes.first = {name: edges[0] for name, edges in routes.edges.items() if edges}
        for element in distributions:
            inner = [_edges(x) for x in element.iter("route")]
            inner += [routes.edges.get(x, ()) for x in element.get("routes", "").split()]
            first = {edges[0] for edges in inner if edges}
            if len(first) == 1:
                routes.first[element.get("id", "")] = next(iter(first))
        return routes

    def edges_of(self, element: ET.Element) -> tuple[str, ...]:
        """Return the edges of a vehicle or flow; none if SUMO still has to find its way."""
        inner = element.find("route")
        return _edges(inner) if inner is not None else self.edges.get(element.get("route", ""), ())

    def origin(self, element: ET.Element) -> str | None:
        """Return the first edge of a vehicle, trip or flow; None if only SUMO knows it."""
        inner = element.find("route")
        if inner is not None:
            return next(iter(_edges(inner)), None)
        return self.first.get(element.get("route", "")) or element.get("from")


def _edges(element: ET.Element) -> tuple[str, ...]:
    return tuple(element.get("edges", "").split())


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
        """Leave out or double vehicles, and change the rates of flows.

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
        "begin_s": _TIME,
        "end_s": _TIME,
        "factor": _FACTOR,
    }
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge", everywhere=True)}
    edge: str
    begin_s: float
    end_s: float
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Leave out or double vehicles that depart then, and cut flows into parts.

        Raises:
            UnknownNameError: No such edge.
        """
        return _scaled(scenario, self, self.edge, (self.begin_s, self.end_s), self.factor)


@dataclass(frozen=True)
class DemandTiming(Effect):
    """Vehicles that start on an edge (``"*"``: all) depart so many s later.

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

        def shifted(element: ET.Element) -> list[ET.Element]:
            begin = depart_s(element)
            if math.isnan(begin):
                return [element]
            key = "begin" if element.tag == "flow" else "depart"
            if begin >= earliest:  # others take no part in the simulation anyway
                begin += self.seconds
            if element.tag == "flow":
                if end := element.get("end"):
                    until = parse_time(end) + self.seconds
                    if until <= earliest:
                        return []
                    element.set("end", seconds_text(until))
                begin = max(begin, earliest)
            elif begin < earliest:
                return []
            element.set(key, seconds_text(begin))
            return [element]

        return replace_departing(scenario, self, self.edge, shifted)


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
    routes = Routes()
    if edge != EVERYWHERE:
        places = network_places(scenario)
        places.check(effect.name, "edge", edge, places.edges)
        routes = Routes.of(scenario)

    def change(root: ET.Element) -> bool:
        children: list[ET.Element] = []
        any_changed = False
        for element in root:
            if is_demand(element) and (edge == EVERYWHERE or routes.origin(element) == edge):
                any_changed = True
                children += becomes(element)
            else:
                children.append(element)
        root[:] = children
        return any_changed

    return edit_scenario(scenario, change, *TAGS, applied=str(effect), in_order=True)


def scaled_flow(element: ET.Element, factor: float, end_s: float) -> ET.Element | None:
    """Return the flow with another rate; None if nothing is left of it.

    Args:
        element: A ``<flow>``.
        factor: Factor of its rate.
        end_s: End of the flow, in s, if it has none itself.
    """
    if factor <= 0:
        return None
    flow = copy.deepcopy(element)
    if number := flow.get("number"):
        if "end" not in flow.attrib and any(key in flow.attrib for key in _RATES):
            seconds = _seconds_of_number(flow, float(number))
            flow.set("end", seconds_text(depart_s(flow) + seconds))
            del flow.attrib["number"]
        else:
            count = round(float(number) * factor)
            flow.set("number", str(count))
            return flow if count else None
    for key in ("vehsPerHour", "perHour"):
        if text := flow.get(key):
            flow.set(key, f"{float(text) * factor:.12g}")
    if text := flow.get("period"):
        rate = _EXPONENTIAL.fullmatch(text)
        flow.set(
            "period",
            f"exp({float(rate[1]) * factor:.12g})" if rate else f"{float(text) / factor:.12g}",
        )
    if text := flow.get("probability"):
        share = float(text) * factor
        if share <= 1:
            flow.set("probability", f"{share:.12g}")
        else:  # a probability per second cannot exceed 1, so use a rate
            del flow.attrib["probability"]
            flow.set("period", f"exp({share:.12g})")
    flow.attrib.setdefault("end", seconds_text(end_s))
    return flow


_RATES = ("vehsPerHour", "perHour", "period", "probability")


def _seconds_of_number(flow: ET.Element, number: float) -> float:
    """Return the duration of a flow of so many vehicles at its rate, in s."""
    rates: Mapping[str, Callable[[float], float]] = {
        "vehsPerHour": lambda x: 3600 / x,
        "perHour": lambda x: 3600 / x,
        "probability": lambda x: 1 / x,
        "period": lambda x: x,
    }
    for key, period in rates.items():
        if text := flow.get(key):
            exponential = _EXPONENTIAL.fullmatch(text)
            return number * (1 / float(exponential[1]) if exponential else period(float(text)))
    return 0.0


def _scaled(
    scenario: Scenario, effect: Effect, edge: str, window: tuple[float, float], factor: float
) -> Scenario:
    begin, end = window
    settings = scenario.settings
    over = settings.begin_s + settings.duration_s
    salt = f"{effect.name} {edge}"
    least = max(settings.begin_s, begin)
    mark = _mark(scenario)

    def scaled(element: ET.Element) -> list[ET.Element]:
        if element.tag == "flow":
            return _scaled_window(element, window, factor, over, mark)
        depart = depart_s(element)
        if not (math.isnan(depart) or begin <= depart < end):
            return [element]
        name = element.get("id", "")
        count = math.floor(factor) + (hashed_uniform(salt, name) < factor - math.floor(factor))
        copies = [element] if count else []
        for number in range(1, count):
            twin = copy.deepcopy(element)
            twin.set("id", f"{name}{mark}{number}")
            if not math.isnan(depart):
                shift = TWIN_S * (2 * hashed_uniform(salt, "when", name, str(number)) - 1)
                time = depart + shift
                if not least <= time < end:
                    time = depart - shift
                twin.set("depart", seconds_text(round(max(time, least), 2)))
            copies.append(twin)
        return copies

    return replace_departing(scenario, effect, edge, scaled)


def _mark(scenario: Scenario) -> str:
    """Return a mark for the ids of twins that no id has yet, because demand may grow twice."""
    documents = (*scenario.additional, *scenario.routes)
    twins = (_TWIN.finditer(window) for document in documents for window in windows(document))
    return "+" * (1 + max((len(match[1]) for matches in twins for match in matches), default=0))


def _scaled_window(
    element: ET.Element, window: tuple[float, float], factor: float, over_s: float, mark: str
) -> list[ET.Element]:
    """Return a flow in up to three parts: before, within and after the window."""
    begin = depart_s(element)
    if math.isnan(begin):
        return [element]
    end = parse_time(element.get("end", "")) if element.get("end") else math.inf
    if math.isinf(end):
        number = float(element.get("number", "inf"))
        by_rate = any(key in element.attrib for key in _RATES)
        lasts = _seconds_of_number(element, number) if by_rate and number < math.inf else math.inf
        end = min(begin + lasts, max(over_s, begin))
    first, last = max(begin, window[0]), min(end, window[1])
    if first >= last:
        return [element]
    if first == begin and last == end:
        whole = scaled_flow(element, factor, over_s)
        return [] if whole is None else [whole]
    parts = (
        (begin, first, 1.0, ""),
        (first, last, factor, f"{mark}surge"),
        (last, end, 1.0, f"{mark}after"),
    )
    flows: list[ET.Element] = []
    for start, stop, rate, suffix in parts:
        part = copy.deepcopy(element)
        part.set("id", f"{element.get('id', '')}{suffix if start > begin else ''}")
        part.set("begin", seconds_text(start))
        part.set("end", seconds_text(stop))
        number = part.attrib.pop("number", None)
        if number is not None and not any(key in part.attrib for key in _RATES):
            part.set("period", f"{(end - begin) / float(number):.12g}")
        scaled = scaled_flow(part, rate, stop) if stop > start else None
        if scaled is not None:
            flows.append(scaled)
    return flows
