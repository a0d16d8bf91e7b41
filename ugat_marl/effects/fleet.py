"""Effects on the fleet: desired speeds, their spread, and trucks."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist, fmean
from typing import ClassVar

from ugat_marl.effects.base import (
    Effect,
    ExaminedStrengths,
    NumberParameter,
    hashed_uniform,
    salt_of,
)
from ugat_marl.effects.demand import TAGS, parted_flow
from ugat_marl.effects.documents import (
    DEFAULT_TYPES,
    edit_scenario,
    free_suffix,
    is_demand,
    parts_with,
    with_default_types,
)
from ugat_marl.effects.vehicles import driven_types
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Scenario, SpeedFactors

HEAVY = "heavy."
"""Begin of the names of types that are trucks, though they may drive where cars may."""


@dataclass(frozen=True)
class DesiredSpeed(Effect):
    """Desired speeds are multiplied by a factor: speedFactor of all types and vehicles."""

    name: ClassVar[str] = "desired_speed"
    ranges: ClassVar[dict[str, NumberParameter]] = {"factor": NumberParameter("", 0.2, 3.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.87,), 1.0, 0.01, both=True)
    factor: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Multiply every speedFactor."""

        def typed(old: SpeedFactors) -> SpeedFactors:
            x = self.factor
            return SpeedFactors(old.mean * x, old.deviation * x, old.least * x, old.greatest * x)

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

        def typed(old: SpeedFactors) -> SpeedFactors:
            return replace(old, deviation=self.deviation)

        def single(name: str, value: float, old: SpeedFactors) -> float:
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
        salt = salt_of(scenario, self)
        scenario = with_default_types(scenario)
        over = scenario.settings.begin_s + scenario.settings.duration_s
        types, members = _types(scenario)
        cars = _cars(types, members)
        used: dict[str, ET.Element] = {}
        suffix = free_suffix(scenario, "+heavy")

        def heavy(element: ET.Element) -> list[ET.Element]:
            kind = element.get("type", DEFAULT_TYPES[0])
            if not is_demand(element) or kind not in cars:
                return [element]
            name = element.get("id", "")
            truck = f"{HEAVY}{cars[kind].get('id')}"
            if element.tag != "flow":
                if hashed_uniform(salt, name) < self.share:
                    used[truck] = cars[kind]
                    element.set("type", truck)
                return [element]
            used[truck] = cars[kind]
            part, rest = parted_flow(element, (self.share, 1 - self.share), over, salt)
            if part is not None:
                part.attrib |= {"id": f"{name}{suffix}", "type": truck}
            return [flow for flow in (rest, part) if flow is not None]

        def change(root: ET.Element) -> bool:
            parts = [heavy(element) for element in root]
            root[:] = [element for part in parts for element in part]
            mixed = [x for x in root.iter("vTypeDistribution") if x.get("id") not in cars]
            for distribution in mixed:
                used.update(_mix_trucks_in(distribution, types, cars, self.share))
            return bool(mixed) or any(len(part) != 1 or is_demand(part[0]) for part in parts)

        scenario = edit_scenario(scenario, change, *TAGS, "<vTypeDistribution", applied=str(self))

        declared, *others = scenario.additional
        root = declared.parse()
        present = {element.get("id") for element in root.iter("vType")}
        root.extend(_truck(used[name], name) for name in sorted(set(used) - present))
        return replace(scenario, additional=(declared.edited(xml_bytes(root)), *others))


def _types(scenario: Scenario) -> tuple[dict[str, ET.Element], dict[str, list[str]]]:
    """Return all vehicle types, and the names of the types in each distribution."""
    types: dict[str, ET.Element] = {}
    members: dict[str, list[str]] = {}
    for document in (*scenario.additional, *scenario.routes):
        for part in parts_with(document, "<vType"):
            types |= {element.get("id", ""): element for element in part.iter("vType")}
            for distribution in part.iter("vTypeDistribution"):
                inner = [x.get("id", "") for x in distribution.iter("vType")]
                members[distribution.get("id", "")] = inner + distribution.get("vTypes", "").split()
    return types, members


def _cars(
    types: Mapping[str, ET.Element], members: Mapping[str, list[str]]
) -> dict[str, ET.Element]:
    """Return types of cars, and distributions of cars that are alike, each with its first type."""
    passenger_cars = {
        name: element
        for name, element in types.items()
        if element.get("vClass", "passenger") == "passenger" and not is_heavy(element.attrib)
    }
    for distribution, names in members.items():
        if names and all(name in passenger_cars for name in names):
            own = [_nameless(passenger_cars[name]) for name in names]
            if all(one == own[0] for one in own):
                passenger_cars[distribution] = passenger_cars[names[0]]
    return passenger_cars


def _nameless(vehicle_type: ET.Element) -> bytes:
    """Return all of a type but its name and its share in a distribution."""
    kind = copy.deepcopy(vehicle_type)
    kind.tail = None
    for key in ("id", "probability"):
        kind.attrib.pop(key, None)
    return ET.tostring(kind)


def _mix_trucks_in(
    distribution: ET.Element,
    types: Mapping[str, ET.Element],
    cars: Mapping[str, ET.Element],
    share: float,
) -> dict[str, ET.Element]:
    """Give trucks a share of the probability of each car in a distribution.

    Returns:
        Replaced cars, by the names of their trucks.
    """
    names = distribution.get("vTypes", "").split()
    given = [float(text) for text in distribution.get("probabilities", "").split()]
    usual = [_chance(types[name]) if name in types else 1.0 for name in names]
    listed = dict(zip(names, [*given, *usual[len(given) :]], strict=True))
    nested = {element.get("id", ""): _chance(element) for element in distribution.iter("vType")}
    chances = dict(listed)
    trucks: dict[str, ET.Element] = {}
    for name, chance in (listed | nested).items():
        if name in cars:
            truck = f"{HEAVY}{name}"
            trucks[truck] = cars[name]
            chances[truck] = chances.get(truck, 0.0) + chance * share
    for name in set(listed) & set(cars):
        chances[name] *= 1 - share
    for element in distribution.iter("vType"):
        if (name := element.get("id", "")) in cars:
            element.set("probability", f"{nested[name] * (1 - share):.12g}")
    if trucks:
        distribution.set("vTypes", " ".join(chances))
        distribution.set("probabilities", " ".join(f"{x:.12g}" for x in chances.values()))
    return trucks


def _chance(vehicle_type: ET.Element) -> float:
    """Return the probability of a type in a distribution, as SUMO reads it."""
    return float(vehicle_type.get("probability", "1"))


def is_heavy(attributes: Mapping[str, str]) -> bool:
    """Return True if the attributes of a ``<vType>`` are those of a truck that this effect made."""
    looks = attributes.get("guiShape"), attributes.get("length")
    return attributes.get("id", "").startswith(HEAVY) and looks == ("truck", "12")


def _truck(car: ET.Element, name: str) -> ET.Element:
    truck = copy.deepcopy(car)
    truck.attrib.pop("probability", None)
    least = {"accel": 1.0, "decel": 3.5, "maxSpeed": 36.11}
    for element in truck.iter():  # models inside of it, an old way to write a type, overrule it
        for key, most in least.items():
            least[key] = min(most, float(element.get(key, "inf")))
    for model in truck:
        for key in ("accel", "decel"):
            model.attrib.pop(key, None)
    truck.attrib |= {
        "id": name, "length": "12", "accel": f"{least['accel']:g}", "decel": f"{least['decel']:g}",
        "guiShape": "truck", "maxSpeed": f"{least['maxSpeed']:g}",
        # that of SUMO's class of trucks, which may not use every lane of cars
        "emissionClass": "HBEFA4/RT_le7.5t_Euro-VI_A-C",
    }  # fmt: skip
    return truck


def _with_speeds(
    scenario: Scenario,
    effect: Effect,
    typed: Callable[[SpeedFactors], SpeedFactors],
    single: Callable[[str, float, SpeedFactors], float],
) -> Scenario:
    """Change the speeds of all types, and of the vehicles that have their own."""
    scenario = with_default_types(scenario)
    known = _speeds(scenario)
    usual = SpeedFactors.of({}, scenario.settings.sumo)

    def change(root: ET.Element) -> bool:
        types = driven_types(root)
        for element in types:
            element.attrib.pop("speedDev", None)
            element.set("speedFactor", typed(known[element.get("id", "")]).text)
        with_factor = [x for x in root if is_demand(x) and "speedFactor" in x.attrib]
        for element in with_factor:
            kind = known.get(element.get("type", DEFAULT_TYPES[0]), usual)
            value = single(element.get("id", ""), float(element.get("speedFactor", "1")), kind)
            element.set("speedFactor", f"{value:.6g}")
        return bool(types or with_factor)

    return edit_scenario(
        scenario, change, "<vType", "speedFactor", applied=str(effect), in_place=True
    )


def _speeds(scenario: Scenario) -> dict[str, SpeedFactors]:
    """Return the speeds of each type, and the mean speeds of each distribution of types."""
    types, members = _types(scenario)
    sumo = scenario.settings.sumo
    speeds = {name: SpeedFactors.of(element.attrib, sumo) for name, element in types.items()}
    for distribution, names in members.items():
        if inner := [speeds[name] for name in names if name in speeds]:
            speeds[distribution] = SpeedFactors(
                fmean(x.mean for x in inner), fmean(x.deviation for x in inner)
            )
    return speeds
