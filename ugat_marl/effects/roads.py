"""Effects on roads: lanes closed or blocked for some time, other speeds along an edge.

A vehicle that stands on a lane closes it. It has a short vehicle type and its own file, to keep
departures in order. Effects on the demand ignore it.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from typing import ClassVar

from ugat_marl.effects.base import (
    TIME_OF_EPISODE,
    Effect,
    NumberParameter,
    TextParameter,
    hashed_uniform,
    salt_of,
)
from ugat_marl.effects.documents import edit, mentions
from ugat_marl.effects.places import network_places
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import (
    Document,
    Scenario,
    demand_as_vehicles,
    demand_scale,
    is_blocker,
    seconds_text,
)
from ugat_marl.seeding import numpy_generator

_LENGTH_M = 5.0
_LAST_M = 60.0
_PARKED = "parking."
"""Beginning of the ids of vehicles that park."""


@dataclass(frozen=True)
class LaneClosure(Effect):
    """No vehicle passes a point near the end of a lane between two times, as after an accident."""

    name: ClassVar[str] = "lane_closure"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "begin_s": TIME_OF_EPISODE,
        "end_s": TIME_OF_EPISODE,
    }
    texts: ClassVar[dict[str, TextParameter]] = {"lane": TextParameter("lane")}
    lane: str
    begin_s: float
    end_s: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Add a vehicle that stands in the middle of the lane's last 60 m.

        Raises:
            UnknownNameError: No such lane.
            OptionError: The lane is too short to stand on.
            ScenarioError: The scenario has the queue model, whose lanes cannot be blocked.
        """
        _refuse_queues(scenario, self)
        begin = max(self.begin_s, scenario.settings.begin_s)
        departs = [begin] if begin < self.end_s else []
        stand = {"until": seconds_text(self.end_s)}
        return _with_blockers(scenario, self, self.lane, departs, stand)


@dataclass(frozen=True)
class Incident(Effect):
    """A lane before a signal, chosen by a hash of the network's lanes, is closed between two times.

    A diagnosis looks for a `LaneClosure` instead.
    """

    name: ClassVar[str] = "incident"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "after_s": TIME_OF_EPISODE,
        "lasts_s": NumberParameter("s", 1.0, 1e7),
    }
    after_s: float
    lasts_s: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Close one of the lanes that lead to a signal, if possible one with another beside it.

        Times count from the beginning of the scenario, not from midnight.

        Raises:
            ScenarioError: No lane that leads to a signal is long enough, or the scenario has the
                queue model, whose lanes cannot be blocked.
        """
        _refuse_queues(scenario, self)
        places = network_places(scenario)
        lanes = [
            lane
            for lane in places.ends
            if places.lanes[lane].cars and places.lanes[lane].length_m >= _LAST_M
        ]
        if not lanes:
            raise ScenarioError(
                f"effect {self.name!r}: scenario {scenario.id!r} has no lane of {_LAST_M:g} m that "
                "leads to a signal; name one with lane_closure"
            )
        wide = [
            lane
            for lane in lanes
            if sum(places.lanes[x].cars for x in places.edges[places.lanes[lane].edge]) > 1
        ]
        lane = min(wide or lanes, key=lambda lane: hashed_uniform(self.name, lane))
        return LaneClosure(lane, *self.window(scenario)).apply(scenario)

    def window(self, scenario: Scenario) -> tuple[float, float]:
        """Return the start and end of the incident on the scenario's clock, in s."""
        begin = scenario.settings.begin_s + self.after_s
        return begin, begin + self.lasts_s


@dataclass(frozen=True)
class Parking(Effect):
    """`per_hour` vehicles stop near the end of a lane each hour, for `dwell_s` s each."""

    name: ClassVar[str] = "parking"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "per_hour": NumberParameter("1/h", 0.0, 240.0),
        "dwell_s": NumberParameter("s", 1.0, 3600.0),
    }
    texts: ClassVar[dict[str, TextParameter]] = {"lane": TextParameter("lane")}
    lane: str
    per_hour: float
    dwell_s: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Add one vehicle in each interval of an hour over `per_hour`, at a time set by a hash.

        Raises:
            UnknownNameError: No such lane.
            OptionError: The lane is too short to stand on.
            ScenarioError: The scenario has the queue model, whose lanes cannot be blocked.
        """
        _refuse_queues(scenario, self)
        settings, number = scenario.settings, self._vehicles(scenario)
        # a second effect on the lane parks at other times
        again = salt_of(scenario, self, self.lane).removeprefix(f"{self.name} {self.lane}").split()
        names = (self.name, self.lane, *again)
        parts = [(n + hashed_uniform(*names, str(n))) / number for n in range(number)]
        departs = [settings.begin_s + part * settings.duration_s for part in parts]
        stand = {"duration": seconds_text(self.dwell_s)}
        return _with_blockers(scenario, self, self.lane, departs, stand)

    def idle_in(self, scenario: Scenario) -> str:
        """Say that the rate is rounded to no vehicle in the episode."""
        if not self.per_hour or self._vehicles(scenario):
            return ""
        seconds = scenario.settings.duration_s
        least = math.ceil(100 * 1800.0 / seconds) / 100
        return (
            f"it is rounded to vehicles in the episode of {seconds:g} s, to none, so it would "
            f"change nothing; give at least {least:g} per_hour, or a longer duration_s"
        )

    def _vehicles(self, scenario: Scenario) -> int:
        """Return the number of vehicles in the episode."""
        return math.floor(self.per_hour * scenario.settings.duration_s / 3600.0 + 0.5)


@dataclass(frozen=True)
class LocalSpeed(Effect):
    """The speed limit of an edge is multiplied by a factor, by a sign that all obey."""

    name: ClassVar[str] = "local_speed"
    ranges: ClassVar[dict[str, NumberParameter]] = {"factor": NumberParameter("", 0.1, 3.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge")}
    edge: str
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Add a variable speed sign to the edge's lanes, or change the existing one.

        Raises:
            UnknownNameError: No such edge.
            ScenarioError: The scenario has a speed sign of its own there.
        """
        places = network_places(scenario)
        places.check(self.name, "edge", self.edge, places.edges)
        # not "_": two edges that differ in such a character need two files
        name = re.sub(r"[^\w.#-]", lambda sign: f"%{ord(sign[0]):x}", self.edge)
        file = f"local-speed.{name}.add.xml"
        before = [added for added in scenario.additional if added.name == file]
        self._refuse_signs(scenario, file, places.edges[self.edge])
        if before:
            root = before[0].parse()
            for step in root.iter("step"):
                step.set("speed", f"{float(step.get('speed', '0')) * self.factor:.6g}")
        else:
            root = ET.Element("additional")
            for lane in places.edges[self.edge]:
                sign = ET.SubElement(
                    root, "variableSpeedSign", {"id": f"local_speed.{lane}", "lanes": lane}
                )
                speed = places.lanes[lane].speed_mps * self.factor
                begin = seconds_text(scenario.settings.begin_s)
                ET.SubElement(sign, "step", {"time": begin, "speed": f"{speed:.6g}"})
        document = Document(file, None, xml_bytes(root))
        others = tuple(added for added in scenario.additional if added.name != file)
        return replace(
            scenario, additional=(*others, document), applied=(*scenario.applied, str(self))
        )

    def _refuse_signs(self, scenario: Scenario, own: str, lanes: Sequence[str]) -> None:
        """Refuse lanes whose limit a sign of another file sets: the later one of two would hold."""
        for document in scenario.additional:
            if document.name == own or not mentions(document, "variableSpeedSign"):
                continue
            for tag in document.scan():
                on = tag.attributes.get("lanes", "").split()
                if tag.name == "variableSpeedSign" and (both := {*on} & {*lanes}):
                    raise ScenarioError(
                        f"{self}: a variableSpeedSign in {document.name} sets the limit of lane "
                        f"{min(both)!r}; change the speeds of its steps there"
                    )


def shift_parking(scenario: Scenario, seed: int) -> Scenario:
    """Return the day with all `Parking` vehicles shifted by one random time, modulo the duration.

    Vehicles do not park at the same second every day; a fixed time would be a false pattern.
    """
    begin, duration = scenario.settings.begin_s, scenario.settings.duration_s
    shift = numpy_generator(seed).uniform(0, duration)

    def later(root: ET.Element) -> bool:
        parked = [x for x in root.iter("vehicle") if _is_parked(x.get("id", ""), x.get("type", ""))]
        for element in parked:
            time = (float(element.get("depart", "0")) - begin + shift) % duration
            element.set("depart", f"{begin + time:.2f}")
        return bool(parked)

    return replace(scenario, routes=edit(scenario.routes, later, _PARKED, in_order=True))


def _is_parked(vehicle: str, vehicle_type: str) -> bool:
    return vehicle_type.startswith(_PARKED) and is_blocker(vehicle, vehicle_type)


def _refuse_queues(scenario: Scenario, effect: Effect) -> None:
    if scenario.settings.is_mesoscopic:
        raise ScenarioError(no_blockers(str(effect)))


def no_blockers(effect: str) -> str:
    """Say that an effect, such as ``lane_closure=...``, and the queue model exclude each other."""
    return (
        f"{effect}: in SUMO's mesoscopic model (queue_model, the domain 'meso') a vehicle that "
        "stands (incident, lane_closure, parking) blocks another lane or none; leave out one of "
        "the two"
    )


def _with_blockers(
    scenario: Scenario, effect: Effect, lane: str, departs: Sequence[float], stand: dict[str, str]
) -> Scenario:
    """Add vehicles that appear in the middle of a lane's last 60 m, stand there and vanish.

    Farther from the signal, traffic would pass them and be in order again before it. If a queue
    stands there, the vehicle appears as soon as there is room for it.

    Args:
        scenario: The scenario; it does not change itself.
        effect: Effect to add to `applied`.
        lane: Lane on which they stop.
        departs: Times at which they appear, in s, in order.
        stand: Attributes of ``<stop>`` that decide how long each of them stands.
    """
    places = network_places(scenario)
    places.check(effect.name, "lane", lane, places.lanes)
    place = places.lanes[lane]
    if place.length_m < 2 * _LENGTH_M + 2:
        raise OptionError(
            f"effect {effect.name!r}: lane {lane!r} is {place.length_m:g} m long, too short for a "
            f"vehicle to stand on; it takes {2 * _LENGTH_M + 2:g} m"
        )
    scenario = replace(scenario, applied=(*scenario.applied, str(effect)))
    if not departs:
        return scenario
    if demand_scale(scenario) != 1:  # SUMO would scale these vehicles, too
        scenario = demand_as_vehicles(scenario)
    taken = {document.name for document in scenario.documents}
    stem = f"{effect.name.removeprefix('lane_')}.{lane}"
    names = chain((stem,), (f"{stem}~{number}" for number in count(2)))
    kind = next(name for name in names if _file(name) not in taken)
    root = ET.Element("routes")
    ET.SubElement(
        root,
        "vType",
        {
            "id": kind,
            "vClass": "passenger" if place.cars else "ignoring",
            "length": f"{_LENGTH_M:g}",
            # Without a spread SUMO draws no random number, and the traffic before is that of `sim`.
            "speedDev": "0",
            "color": "255,128,0",
        },
    )
    middle = place.length_m - min(place.length_m, _LAST_M) / 2
    for number, depart in enumerate(departs):
        vehicle = {
            "id": f"{kind}.{number}", "type": kind, "depart": seconds_text(depart),
            "departLane": str(place.index), "departPos": f"{middle:.2f}", "departSpeed": "0",
            "arrivalLane": str(place.index), "arrivalPos": f"{middle + 0.5:.2f}",
        }  # fmt: skip
        element = ET.SubElement(root, "vehicle", vehicle)
        ET.SubElement(element, "route", {"edges": place.edge})
        ET.SubElement(element, "stop", {"lane": lane, "endPos": f"{middle:.2f}", **stand})
    document = Document(_file(kind), None, xml_bytes(root))
    return replace(scenario, routes=(*scenario.routes, document))


def _file(stem: str) -> str:
    """Return a file name for a blocked lane, without characters that files cannot have."""
    return re.sub(r"[^\w.~#-]", "_", stem) + ".rou.xml"
