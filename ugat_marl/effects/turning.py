"""Effect on the turns of vehicles at one place."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise
from typing import ClassVar

from ugat_marl.effects.base import (
    Effect,
    NumberParameter,
    TextParameter,
    hashed_uniform,
    salt_of,
)
from ugat_marl.effects.demand import (
    TAGS,
    NamedRoutes,
    departs_by_chance,
    parted_flow,
)
from ugat_marl.effects.documents import (
    depart_s,
    edit_scenario,
    free_suffix,
    is_demand,
    mentions,
)
from ugat_marl.effects.places import Places, network_places
from ugat_marl.errors import ScenarioError, UnknownNameError
from ugat_marl.scenarios import Scenario, edge_of_lane, move_stops, own_stops

Way = tuple[str, ...]

_UNKNOWN_ENDS = tuple(
    f"{end}{kind}" for kind in ("Taz", "Junction", "XY", "LonLat") for end in ("from", "to")
)
"""Attributes of origins and destinations that name no edge."""
_ENDS = ("arrivalLane", "arrivalPos", "arrivalEdge", "arrivalPosLat", "arrivalSpeed")


@dataclass(frozen=True)
class Turning(Effect):
    """This share of the vehicles that leave an edge by another turn take `to_edge` instead.

    From there they take the ways of vehicles that already turn there, or the fastest way out of the
    network if there are none. Trips first get the fastest way over empty streets.
    """

    name: ClassVar[str] = "turning"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    texts: ClassVar[dict[str, TextParameter]] = {
        "from_edge": TextParameter("edge"),
        "to_edge": TextParameter("edge"),
    }
    from_edge: str
    to_edge: str
    share: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Change the routes of vehicles, trips and flows.

        Raises:
            UnknownNameError: No such edge, or no way from the one to the other.
            ScenarioError: A vehicle or flow draws its way from a distribution of routes, or goes
                between districts.
        """
        places = network_places(scenario)
        places.check(self.name, "edge", self.from_edge, places.edges)
        places.check(self.name, "edge", self.to_edge, places.edges)
        ahead = places.following.get(self.from_edge, ())
        if self.to_edge not in ahead:
            raise UnknownNameError(
                f"edge behind {self.from_edge!r}:", self.to_edge, ahead,
                f"Effect {self.name!r} names it.",
            )  # fmt: skip
        routes = NamedRoutes.of(scenario)

        def way(element: ET.Element) -> Way:
            edges = routes.edges_of(element) or _fastest(element, places)
            for end in _UNKNOWN_ENDS:
                if not edges and (district := element.get(end)) is not None:
                    raise ScenarioError(
                        f"effect {self.name!r}: {element.tag} {element.get('id')!r} has {end} = "
                        f"{district!r}, so its way is not known; give it a route, or from and to"
                    )
            inner = element.find("routeDistribution")
            drawn = element.get("route") if inner is None else "a distribution of its own"
            if not edges and drawn is not None:
                raise ScenarioError(
                    f"effect {self.name!r}: {element.tag} {element.get('id')!r} draws its way from "
                    f"{drawn!r}; give it a route of its own, or from and to"
                )
            return edges

        def turned(element: ET.Element, edges: Way) -> ET.Element:
            named = routes.stops.get(element.get("route", ""), [])
            if named and element.tag == "flow" and departs_by_chance(element):
                name = element.get("id", "").partition(suffix)[0]
                raise ScenarioError(
                    f"effect {self.name!r}: flow {name!r} departs by chance, and its "
                    f"route {element.get('route')!r} has stops; give it a route of its own"
                )
            return _with_route(element, edges, named)

        tails = self._tails(scenario, way, places)
        over = scenario.settings.begin_s + scenario.settings.duration_s
        suffix = free_suffix(scenario, "+turning")
        salt = salt_of(scenario, self, self.from_edge, self.to_edge)

        def change(root: ET.Element) -> bool:
            children: list[ET.Element] = []
            for element in root:
                children += self._turned(element, way, turned, tails, over, suffix, salt)
            changed = len(children) != len(root) or any(
                a is not b for a, b in zip(children, root, strict=True)
            )
            root[:] = children
            return changed

        return edit_scenario(scenario, change, *TAGS, applied=str(self), in_order=True)

    def _tails(
        self, scenario: Scenario, way: Callable[[ET.Element], Way], places: Places
    ) -> Counter[Way]:
        """Return the further ways of those that take the turn, with their numbers.

        A flow counts once.
        """
        tails: Counter[Way] = Counter()
        for document in (*scenario.additional, *scenario.routes):
            if not mentions(document, *TAGS):
                continue
            for element in chain.from_iterable(document.parts()):
                edges = way(element) if is_demand(element) else ()
                for index, pair in enumerate(pairwise(edges)):
                    if pair == (self.from_edge, self.to_edge):
                        tails[edges[index + 1 :]] += 1
                        break
        return tails or Counter({_way_out(self.to_edge, places): 1})

    def _turned(
        self,
        element: ET.Element,
        way: Callable[[ET.Element], Way],
        turned: Callable[[ET.Element, Way], ET.Element],
        tails: Counter[Way],
        over_s: float,
        suffix: str,
        salt: str,
    ) -> list[ET.Element]:
        """Return the elements that replace one element of a route file."""
        if not is_demand(element):
            return [element]
        edges = way(element)
        place = next((n for n, edge in enumerate(edges[:-1]) if edge == self.from_edge), None)
        if place is None or edges[place + 1] == self.to_edge:
            return [element]
        name = element.get("id", "")
        if element.tag != "flow":
            if hashed_uniform(salt, name) >= self.share:
                return [element]
            return [turned(element, (*edges[: place + 1], *_drawn(tails, salt, name)))]
        total = sum(tails.values())
        shares = [self.share * count / total for _, count in sorted(tails.items())]
        *others, rest = parted_flow(element, (*shares, 1 - self.share), over_s, salt)
        parts = [rest]
        for number, (part, tail) in enumerate(zip(others, sorted(tails), strict=True)):
            if part is not None:
                part.set("id", f"{name}{suffix}{number or ''}")
                parts.append(turned(part, (*edges[: place + 1], *tail)))
        return [part for part in parts if part is not None]


def _drawn(tails: Counter[Way], salt: str, name: str) -> Way:
    """Return one of the further ways, drawn by the number of vehicles and flows on each."""
    ways = sorted(tails)
    bounds = list(accumulate(tails[way] for way in ways))
    return ways[bisect_right(bounds, hashed_uniform(salt, "way", name) * bounds[-1])]


def _fastest(element: ET.Element, places: Places) -> Way:
    """Return the way of a trip over empty streets; none if it names no origin or destination."""
    stations = [element.get("from", ""), *element.get("via", "").split(), element.get("to", "")]
    if not stations[0] or not stations[-1]:
        return ()
    way: list[str] = [stations[0]]
    for start, end in pairwise(stations):
        part = places.path(start, end)
        if part is None:
            return ()
        way += part[1:]
    return tuple(way)


def _way_out(start: str, places: Places) -> Way:
    """Return the fastest way out of the network."""
    ways = [way for way in places.ways(start).values() if way[-1] in places.exits]
    return min(ways, key=lambda way: sum(map(places.seconds, way)), default=(start,))


def _with_route(element: ET.Element, edges: Way, named: Iterable[ET.Element]) -> ET.Element:
    """Return the vehicle or flow on another route; stops there that name a lane or edge stay.

    Args:
        element: The vehicle, trip or flow.
        edges: The other route.
        named: Stops of its named route.
    """
    made = copy.deepcopy(element)
    if made.tag == "trip":
        made.tag = "vehicle"
    for key in ("route", "from", "to", "via", *_ENDS):
        made.attrib.pop(key, None)
    route = ET.Element("route", {"edges": " ".join(edges)})
    before = [copy.deepcopy(stop) for stop in named]
    move_stops(before, depart_s(element))  # the times of a named route count from the departure
    stops = [*before, *own_stops(made)]
    for child in list(made):
        if child.tag in ("route", "stop"):
            made.remove(child)
    made.insert(0, route)
    made.extend(stop for stop in stops if _edge_of(stop) in edges)
    return made


def _edge_of(stop: ET.Element) -> str:
    """Return the edge on which a vehicle stops; "" for a stop with a name, such as a bus stop."""
    return stop.get("edge") or edge_of_lane(stop.get("lane", ""))
