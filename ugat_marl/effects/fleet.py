"""Effects on the fleet: desired speeds, their spread, and trucks."""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import NormalDist, fmean
from typing import ClassVar

from ugat_marl.effects.base import Effect, ExaminedStrengths, NumberParameter, hashed_uniform
from ugat_marl.effects.demand import TAGS, parted_flow
from ugat_marl.effects.documents import (
    DEFAULT_TYPES,
    edit_scenario,
    is_demand,
    mentions,
    with_default_types,
)
from ugat_marl.effects.vehicles import driven_types
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Scenario

_LEAST, _GREATEST = 0.2, 2.0
"""SUMO's default limits of speedFactor."""

_HEAVY = "heavy."
_NORMAL = re.compile(r"\s*norm(c?)\(([^)]*)\)\s*")
_STEADY = frozenset({"bus", "emergency", "ignoring", "army", "authority"})
_CALM = frozenset({"truck", "trailer", "coach", "delivery", "taxi"})


@dataclass(frozen=True)
class Speeds:
    """Distribution of speedFactor in a vehicle type: normal, cut at both ends."""

    mean: float
    deviation: float
    least: float = _LEAST
    greatest: float = _GREATEST

    def write(self, element: ET.Element) -> None:
        """Write the distribution into a type in SUMO's form."""
        values = (self.mean, self.deviation, self.least, self.greatest)
        element.attrib.pop("speedDev", None)
        element.set("speedFactor", f"normc({','.join(f'{value:.8g}' for value in values)})")

    @classmethod
    def of(cls, element: ET.Element, general: float | None) -> Speeds:
        """Read a type as SUMO does.

        Args:
            element: A ``<vType>``.
            general: SUMO's option ``default.speeddev``, if it is set.
        """
        mean, deviation, least, greatest = (
            1.0,
            default_deviation(element, general),
            _LEAST,
            _GREATEST,
        )
        text = element.get("speedFactor", "")
        if normal := _NORMAL.fullmatch(text):
            numbers = [float(part) for part in normal[2].split(",")]
            mean, deviation = numbers[0], numbers[1] if len(numbers) > 1 else 0.0
            if len(numbers) > 3:
                least, greatest = numbers[2], numbers[3]
        elif text:
            mean = float(text)
        if deviation_text := element.get("speedDev"):
            deviation = float(deviation_text)
        return cls(mean, deviation, least, greatest)


def default_deviation(element: ET.Element, general: float | None) -> float:
    """Return the default deviation of speedFactor of a vehicle class."""
    if general is not None and general >= 0:
        return general
    kind = element.get("vClass", "passenger")
    return 0.0 if kind in _STEADY else 0.05 if kind in _CALM else 0.1


@dataclass(frozen=True)
class DesiredSpeed(Effect):
    """Desired speeds are multiplied by a factor: speedFactor of all types and vehicles."""

    name: ClassVar[str] = "desired_speed"
    ranges: ClassVar[dict[str, NumberParameter]] = {"factor": NumberParameter("", 0.2, 3.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.87,), 1.0, 0.01, both=True)
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Multiply every speedFactor."""

        def typed(old: Speeds) -> Speeds:
            x = self.factor
            return Speeds(old.mean * x, old.deviation * x, old.least * x, old.greatest * x)

        return _with_speeds(scenario, self, typed, lambda _, value, __: value * self.factor)


@dataclass(frozen=True)
class SpeedSpread(Effect):
    """The deviation of drivers' desired speeds, as a share of the limit (default 0.1)."""

    name: ClassVar[str] = "speed_spread"
    ranges: ClassVar[dict[str, NumberParameter]] = {"deviation": NumberParameter("", 0.0, 0.8)}
    attribute: ClassVar[str] = "speedDev"
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.03, 0.2), 0.1, 0.01)
    deviation: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the deviation of all types; single vehicles move away from their type's mean.

        The speed of a vehicle whose type has no spread follows from a hash of its id.
        """

        def typed(old: Speeds) -> Speeds:
            return replace(old, deviation=self.deviation)

        def single(name: str, value: float, old: Speeds) -> float:
            if old.deviation > 0:
                place = (value - old.mean) / old.deviation
            else:
                place = NormalDist().inv_cdf(
                    min(max(hashed_uniform(self.name, name), 1e-9), 1 - 1e-9)
                )
            value = old.mean + place * self.deviation
            return min(max(value, old.least), old.greatest)

        return _with_speeds(scenario, self, typed, single)


@dataclass(frozen=True)
class HeavyShare(Effect):
    """This share of the passenger cars are trucks, 12 m long and slow to speed up.

    A truck keeps all other attributes of the car it replaces, so effects applied before also hold
    for it. Later effects on acceleration and deceleration also set those of trucks.
    """

    name: ClassVar[str] = "heavy_share"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.12,), 0.0, 0.01)
    share: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Give vehicles chosen by a hash of their ids, and a part of each flow, truck types."""
        scenario = with_default_types(scenario)
        over = scenario.settings.begin_s + scenario.settings.duration_s
        cars = _cars(scenario)
        used: dict[str, ET.Element] = {}

        def heavy(element: ET.Element) -> list[ET.Element]:
            kind = element.get("type", DEFAULT_TYPES[0])
            if not is_demand(element) or kind not in cars:
                return [element]
            name = element.get("id", "")
            truck = f"{_HEAVY}{cars[kind].get('id')}"
            if element.tag != "flow":
                if hashed_uniform(self.name, name) < self.share:
                    used[truck] = cars[kind]
                    element.set("type", truck)
                return [element]
            used[truck] = cars[kind]
            part, rest = parted_flow(element, (self.share, 1 - self.share), over, self.name)
            if part is not None:
                part.attrib |= {"id": f"{name}+heavy", "type": truck}
            return [flow for flow in (rest, part) if flow is not None]

        def change(root: ET.Element) -> bool:
            parts = [heavy(element) for element in root]
            root[:] = [element for part in parts for element in part]
            return any(len(part) != 1 or is_demand(part[0]) for part in parts)

        scenario = edit_scenario(scenario, change, *TAGS, applied=str(self))

        types, *others = scenario.additional
        root = types.parse()
        present = {element.get("id") for element in root.iter("vType")}
        root.extend(_truck(used[name], name) for name in sorted(set(used) - present))
        return replace(scenario, additional=(types.edited(xml_bytes(root)), *others))


def _types(scenario: Scenario) -> tuple[dict[str, ET.Element], dict[str, list[str]]]:
    """Return all vehicle types, and the names of the types in each distribution."""
    types: dict[str, ET.Element] = {}
    members: dict[str, list[str]] = {}
    for document in (*scenario.additional, *scenario.routes):
        if not mentions(document, "<vType"):
            continue
        for part in document.parts():
            types |= {element.get("id", ""): element for element in part.iter("vType")}
            for distribution in part.iter("vTypeDistribution"):
                inner = [x.get("id", "") for x in distribution.iter("vType")]
                members[distribution.get("id", "")] = inner + distribution.get("vTypes", "").split()
    return types, members


def _cars(scenario: Scenario) -> dict[str, ET.Element]:
    """Return types and distributions of cars; a distribution is given with its first car type."""
    types, members = _types(scenario)
    passenger_cars = {
        name: element
        for name, element in types.items()
        if element.get("vClass", "passenger") == "passenger" and not name.startswith(_HEAVY)
    }
    for distribution, names in members.items():
        if cars := [passenger_cars[name] for name in names if name in passenger_cars]:
            passenger_cars[distribution] = cars[0]
    return passenger_cars


def _truck(car: ET.Element, name: str) -> ET.Element:
    truck = copy.deepcopy(car)
    truck.attrib.pop("probability", None)
    for model in truck:
        for key in ("accel", "decel"):
            model.attrib.pop(key, None)
    truck.attrib |= {
        "id": name, "length": "12", "accel": "1", "decel": "3.5", "guiShape": "truck",
        "maxSpeed": "36.11",
    }  # fmt: skip
    return truck


def _with_speeds(
    scenario: Scenario,
    effect: Effect,
    typed: Callable[[Speeds], Speeds],
    single: Callable[[str, float, Speeds], float],
) -> Scenario:
    """Change the speeds of all types, and of the vehicles that have their own."""
    scenario = with_default_types(scenario)
    general = scenario.settings.sumo.get("default.speeddev")
    known = _speeds(scenario, float(general) if general is not None else None)
    usual = Speeds(1.0, 0.1)

    def change(root: ET.Element) -> bool:
        types = driven_types(root)
        for element in types:
            typed(known[element.get("id", "")]).write(element)
        with_factor = [x for x in root if is_demand(x) and "speedFactor" in x.attrib]
        for element in with_factor:
            kind = known.get(element.get("type", DEFAULT_TYPES[0]), usual)
            value = single(element.get("id", ""), float(element.get("speedFactor", "1")), kind)
            element.set("speedFactor", f"{value:.6g}")
        return bool(types or with_factor)

    return edit_scenario(scenario, change, "<vType", "speedFactor", applied=str(effect))


def _speeds(scenario: Scenario, general: float | None) -> dict[str, Speeds]:
    """Return the speeds of each type, and the mean speeds of each distribution of types."""
    types, members = _types(scenario)
    speeds = {name: Speeds.of(element, general) for name, element in types.items()}
    for distribution, names in members.items():
        if inner := [speeds[name] for name in names if name in speeds]:
            speeds[distribution] = Speeds(
                fmean(x.mean for x in inner), fmean(x.deviation for x in inner)
            )
    return speeds
