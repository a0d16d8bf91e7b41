"""Other days of the same expected demand, drawn by a Poisson bootstrap over vehicles.

On a street, vehicles differ from day to day, and so do counts and gaps. A simulation that repeats
one list of vehicles has less noise than the street. Comparisons would then find differences that do
not exist.
"""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import astuple, dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import ScenarioError
from ugat_marl.files import parse_xml, xml_bytes
from ugat_marl.scenarios.routes import (
    STOP_TIMES,
    demand_as_vehicles,
    departure_s,
    is_blocker,
    move_stops,
    own_stops,
)
from ugat_marl.scenarios.scenario import Document, Scenario
from ugat_marl.scenarios.speed_factors import SpeedFactors
from ugat_marl.seeding import numpy_generator

JITTER_S = 120.0
"""Greatest shift of a departure, earlier or later, s; small enough to keep the profile of a day."""
_USUALLY = 8
"""Copies that a vehicle seldom exceeds; their draws do not depend on how many there are."""
_AGAIN = 100
_LEAST_FACTOR = 0.001
"""SUMO draws no speedFactor of 0 or less, and refuses vehicles with one."""
_TYPES, _VEHICLES = "types.add.xml", "vehicles.rou.xml"
_TYPE_TAGS = ("vType", "vTypeDistribution")
_Speed = tuple[float, float, float, float]
_DEFAULT = "DEFAULT_VEHTYPE"
_LEFT_TO_SUMO: _Speed = (np.nan, np.nan, 0.0, np.inf)


@dataclass(frozen=True)
class _Vehicles:
    """Vehicles of a demand as text, ready to be written in any order.

    Attributes:
        types: Additional file with the vehicle types of the route files.
        others: Route files with everything else: persons, containers, named routes, and vehicles
            that block a lane, wait for a person, or are ridden by one.
        depart_s: Departures, s, ``(vehicles,)``.
        names: Ids.
        heads: Remaining attributes of each ``<vehicle>`` tag, up to its ``>``.
        tails: Children of each ``<vehicle>``.
        stopping: Elements of the vehicles whose stops have times, by position.
        speeds: Mean, deviation, least and greatest speedFactor, ``(vehicles, 4)``; the mean is NaN
            if SUMO draws the factor.
    """

    types: Document
    others: tuple[Document, ...]
    depart_s: NDArray[np.float64]
    names: tuple[str, ...]
    heads: tuple[str, ...]
    tails: tuple[str, ...]
    stopping: Mapping[int, ET.Element]
    speeds: NDArray[np.float64]

    def row(self, index: int, suffix: str, depart_s: float, factor: float) -> str:
        """Return a copy of a vehicle as an element of a route file.

        Args:
            index: The vehicle.
            suffix: End of the name of the copy.
            depart_s: Its departure, s.
            factor: Its speedFactor; NaN to let SUMO draw it.

        Raises:
            ScenarioError: As for `tail`.
        """
        name = quoteattr(self.names[index] + suffix)
        speed = "" if np.isnan(factor) else f' speedFactor="{factor:.4f}"'
        return (
            f'<vehicle id={name} depart="{depart_s:.2f}"{speed}{self.heads[index]}'
            f"{self.tail(index, depart_s - self.depart_s[index])}</vehicle>"
        )

    def tail(self, index: int, later_s: float) -> str:
        """Return the children of a vehicle that departs later than in the demand.

        Raises:
            ScenarioError: A time of its stops is none.
        """
        if index not in self.stopping:
            return self.tails[index]
        moved = deepcopy(self.stopping[index])
        try:
            move_stops(own_stops(moved), later_s)
        except ValueError as error:
            raise ScenarioError(
                f"vehicle {self.names[index]!r}: {str(error)!r} of a stop is not a time; give "
                "seconds or h:m:s"
            ) from None
        return _children_text(moved)


def draw_day(scenario: Scenario, seed: int, day_to_day: float = 0.0) -> Scenario:
    """Draw another day: a Poisson number of copies of every vehicle, departures jittered.

    The same seed gives the same vehicles, names and speedFactors. Effects applied afterwards do not
    change them, so two models can be compared on the same day. Vehicles that depart before the
    scenario's begin are left out, as SUMO leaves them out. A shift across the start or the end of
    the scenario is mirrored there, so the mean number of vehicles within it is that of the demand.
    Persons, and vehicles that block a lane, wait for a person or are named by one's ride, or have
    a line that is, are the same every day. Flows with random departures are drawn once, by
    `demand_as_vehicles`, and all days vary that draw: their mean is its number of vehicles, and not
    the expectation of the flow. Times of stops move with the departure. A vehicle with a
    speedFactor of its own keeps it; others draw it from that of their type.

    Args:
        scenario: Any scenario; `demand_as_vehicles` turns its trips and flows into vehicles.
        seed: Number of the day, a non-negative integer.
        day_to_day: Standard deviation of the whole demand of a day, as a share of its mean. It
            comes on top of the Poisson numbers; 0 for none.

    Raises:
        ScenarioError: A time of a vehicle's stops is none, or duarouter refuses the demand.
    """
    scenario = demand_as_vehicles(scenario)
    vehicles = _vehicles(
        tuple(document.read() for document in scenario.routes),
        tuple(document.read() for document in scenario.additional),
        tuple(scenario.settings.sumo.items()),
    )
    generator = numpy_generator(seed, "another day")
    begin = scenario.settings.begin_s
    end = begin + scenario.settings.duration_s
    count = len(vehicles.names)
    level = 1.0
    if day_to_day:  # a stream of its own, so that days without variation stay what they are
        shape = day_to_day**-2.0
        level = float(numpy_generator(seed, "level of the day").gamma(shape, 1.0 / shape))
    copies = generator.poisson(level, count)
    copies[vehicles.depart_s < begin] = 0  # SUMO leaves out what departs before the start
    most = int(copies.max(initial=0))
    shifts = generator.uniform(-JITTER_S, JITTER_S, (_USUALLY, count))
    draws = generator.standard_normal((_USUALLY, count))
    if more := max(most - _USUALLY, 0):  # a stream of its own, too
        further = numpy_generator(seed, "more copies")
        shifts = np.vstack((shifts, further.uniform(-JITTER_S, JITTER_S, (more, count))))
        draws = np.vstack((draws, further.standard_normal((more, count))))
    again = numpy_generator(seed, "speeds again")
    rows: list[tuple[float, str]] = []
    for copy in range(most):
        departs = _reflected(vehicles.depart_s, shifts[copy], begin, end)
        factors = _speed_factors(vehicles.speeds, draws[copy], again)
        suffix = f"~{seed}.{copy}"  # new names: effects choose other vehicles every day
        rows += [
            (departs[index], vehicles.row(index, suffix, departs[index], factors[index]))
            for index in np.flatnonzero(copies > copy).tolist()
        ]
    rows.sort(key=lambda row: row[0])
    text = "<routes>\n" + "\n".join(row for _, row in rows) + "\n</routes>\n"
    return replace(
        scenario,
        routes=(Document(_VEHICLES, None, text.encode()), *vehicles.others),
        additional=(*scenario.additional, vehicles.types),
    )


def _reflected(
    depart_s: NDArray[np.float64], shift_s: NDArray[np.float64], begin_s: float, end_s: float
) -> NDArray[np.float64]:
    """Return shifted departures, mirrored at the start and the end of the scenario, s.

    No vehicle crosses the end. None that departs in the scenario gets before the start.

    Args:
        depart_s: Departures, s, ``(vehicles,)``.
        shift_s: Their shifts, s, ``(vehicles,)``.
        begin_s: Start of the scenario, s.
        end_s: End of the scenario, s.
    """
    departs = depart_s + shift_s
    departs = np.where(departs < begin_s, 2 * begin_s - departs, departs)
    crosses = (departs >= end_s) != (depart_s >= end_s)
    departs = np.where(crosses, 2 * end_s - departs, departs)
    return np.maximum(departs, begin_s)  # in a scenario shorter than the shifts


def _speed_factors(
    speeds: NDArray[np.float64], draws: NDArray[np.float64], again: np.random.Generator
) -> NDArray[np.float64]:
    """Return a speedFactor for each vehicle, ``(vehicles,)``; NaN if SUMO draws it.

    Args:
        speeds: Mean, deviation, least and greatest speedFactor, ``(vehicles, 4)``.
        draws: Standard normal numbers, ``(vehicles,)``.
        again: Generator of further ones in place of factors beyond a limit.
    """
    mean, deviation, least, greatest = speeds.T
    least = np.maximum(least, _LEAST_FACTOR)
    factors = mean + deviation * draws
    for _ in range(_AGAIN):  # SUMO, too, draws again what lies beyond a limit
        if not (beyond := (factors < least) | (factors > greatest)).any():
            break
        factors = np.where(beyond, mean + deviation * again.standard_normal(len(draws)), factors)
    return np.clip(factors, least, greatest)


def _beside(additional: Iterable[bytes]) -> tuple[ET.Element, set[str]]:
    """Return the types in additional files, and the vehicles or lines that rides in them name."""
    types = ET.Element("additional")
    ridden: set[str] = set()
    for content in additional:
        names, has_types = _ridden(content)
        ridden |= names
        if has_types:
            root = parse_xml(content, "additional")
            types.extend(element for element in root if element.tag in _TYPE_TAGS)
    return types, ridden


def _ridden(content: bytes) -> tuple[set[str], bool]:
    """Return the vehicles or lines that rides in a file name; True if it has types."""
    names: set[str] = set()
    has_types = False
    for tag in Document("demand", None, content).scan():
        has_types |= tag.name in _TYPE_TAGS
        if tag.name in ("ride", "transport"):
            names.update(tag.attributes.get("lines", "").split())
    return names, has_types


@functools.lru_cache(maxsize=8)
def _vehicles(
    routes: tuple[bytes, ...],
    additional: tuple[bytes, ...],
    sumo: tuple[tuple[str, str], ...],
) -> _Vehicles:
    """Split route files into single vehicles; cached because many days use the same files."""
    types_beside, ridden = _beside(additional)
    for content in routes:
        ridden |= _ridden(content)[0]
    types = ET.Element("additional")
    others: list[Document] = []
    depart: list[float] = []
    names: list[str] = []
    heads: list[str] = []
    tails: list[str] = []
    kinds: list[str] = []
    stopping: dict[int, ET.Element] = {}
    own_speeds: list[str | None] = []
    for number, content in enumerate(routes):
        rest = ET.Element("routes")
        for element in parse_xml(content, "routes"):
            if element.tag in _TYPE_TAGS:
                types.append(element)
            elif (
                element.tag == "vehicle"
                and ridden.isdisjoint((element.get("id"), element.get("line")))
                and not is_blocker(element.get("id", ""), element.get("type", ""))
                and not np.isnan(time := departure_s(element.get("depart", "0")))
            ):
                if any(stop.get(key) for stop in own_stops(element) for key in STOP_TIMES):
                    stopping[len(names)] = element
                names.append(element.get("id", ""))
                depart.append(time)
                kinds.append(element.get("type", ""))
                own_speeds.append(element.get("speedFactor"))
                heads.append(_attributes(element))
                tails.append(_children_text(element))
            else:
                rest.append(element)
        if len(rest):
            others.append(Document(f"others{number or ''}.rou.xml", None, xml_bytes(rest)))
    options = dict(sumo)
    known = {
        element.get("id", ""): _speed_of(element.attrib, options)
        for root in (types_beside, types)
        for element in root.iter("vType")
    }
    known.setdefault(_DEFAULT, _speed_of({}, options))
    speeds = [
        known.get(kind or _DEFAULT, _LEFT_TO_SUMO) if own is None else _own_speed(own, options)
        for kind, own in zip(kinds, own_speeds, strict=True)
    ]
    return _Vehicles(
        Document(_TYPES, None, xml_bytes(types)),
        tuple(others),
        np.array(depart),
        tuple(names),
        tuple(heads),
        tuple(tails),
        stopping,
        np.array(speeds, dtype=np.float64).reshape(-1, 4),
    )


def _children_text(element: ET.Element) -> str:
    return "".join(ET.tostring(part, "unicode").strip() for part in element)


def _attributes(element: ET.Element) -> str:
    left = {k: v for k, v in element.attrib.items() if k not in ("id", "depart", "speedFactor")}
    return "".join(f" {key}={quoteattr(value)}" for key, value in left.items()) + ">"


def _own_speed(text: str, sumo: Mapping[str, str]) -> _Speed:
    """Return the speedFactor of a vehicle, a number or a distribution, as `_speed_of` does."""
    try:
        return float(text), 0.0, -np.inf, np.inf
    except ValueError:
        return _speed_of({"speedFactor": text}, sumo)


def _speed_of(attributes: Mapping[str, str], sumo: Mapping[str, str]) -> _Speed:
    """Return mean, deviation, least and greatest speedFactor of a type; NaN if SUMO must draw."""
    try:
        return astuple(SpeedFactors.of(attributes, sumo))
    except ValueError:
        return _LEFT_TO_SUMO
