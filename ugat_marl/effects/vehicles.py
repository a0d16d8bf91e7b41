"""Effects on how vehicles move, written into every vehicle type of a scenario.

A vehicle may name a type, draw one from a distribution, or name none; then SUMO uses a default
type. All of these are reached. The attributes are written as XML, because `startupDelay` is
silently ignored when it is set through TraCI.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, fields, replace
from typing import ClassVar

from ugat_marl.effects.base import Effect, Parameter
from ugat_marl.files import xml_bytes
from ugat_marl.scenario import Document, Scenario

DEFAULT_TYPES = (
    "DEFAULT_VEHTYPE", "DEFAULT_TAXITYPE", "DEFAULT_BIKETYPE", "DEFAULT_RAILTYPE",
)  # fmt: skip
"""Types SUMO defines itself. Only the first is used without being named."""

DEFAULTS_FILE = "default-types.add.xml"
_NOT_DRIVEN = frozenset(
    {
        "pedestrian", "wheelchair", "container", "rail", "rail_electric", "rail_urban", "rail_fast",
        "subway", "cable_car", "tram", "ship", "aircraft", "drone",
    }
)  # fmt: skip


@dataclass(frozen=True)
class VehicleEffect(Effect):
    """An effect that is one attribute of all vehicle types."""

    attribute: ClassVar[str]

    def apply(self, scenario: Scenario) -> Scenario:
        """Sets the attribute in every vehicle type, SUMO's default type included."""
        value = f"{getattr(self, fields(self)[0].name):.12g}"
        additional = scenario.additional
        if not additional or additional[0].name != DEFAULTS_FILE:
            additional = (_default_types(scenario), *additional)
        return replace(
            scenario,
            additional=tuple(_with_attribute(item, self.attribute, value) for item in additional),
            routes=tuple(_with_attribute(item, self.attribute, value) for item in scenario.routes),
            applied=(*scenario.applied, str(self)),
        )


@dataclass(frozen=True)
class Acceleration(VehicleEffect):
    """Largest acceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "acceleration"
    attribute: ClassVar[str] = "accel"
    ranges: ClassVar[dict[str, Parameter]] = {"mps2": Parameter("m/s^2", 0.1, 10.0)}
    mps2: float


@dataclass(frozen=True)
class Deceleration(VehicleEffect):
    """Comfortable deceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "deceleration"
    attribute: ClassVar[str] = "decel"
    ranges: ClassVar[dict[str, Parameter]] = {"mps2": Parameter("m/s^2", 0.1, 10.0)}
    mps2: float


@dataclass(frozen=True)
class EmergencyDeceleration(VehicleEffect):
    """Largest physically possible deceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "emergency_deceleration"
    attribute: ClassVar[str] = "emergencyDecel"
    ranges: ClassVar[dict[str, Parameter]] = {"mps2": Parameter("m/s^2", 0.1, 20.0)}
    mps2: float


@dataclass(frozen=True)
class StartupDelay(VehicleEffect):
    """Time a stopped vehicle waits before it starts, in s (SUMO's `startupDelay`).

    Below about 0.75 s it moves only the first vehicle of a queue; it is not the start-up lost time
    of the Highway Capacity Manual.
    """

    name: ClassVar[str] = "startup_delay"
    attribute: ClassVar[str] = "startupDelay"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 0.0, 10.0)}
    seconds: float


def _default_types(scenario: Scenario) -> Document:
    """Declares the default types in use, unless the scenario declares them itself."""
    declared: set[str] = set()
    named: set[str] = {DEFAULT_TYPES[0]}
    for document in (*scenario.additional, *scenario.routes):
        for item in document.parse().iter():
            if item.tag == "vType":
                declared.add(item.get("id", ""))
            named |= {item.get("type", ""), *item.get("vTypes", "").split()}
    root = ET.Element("additional")
    for name in DEFAULT_TYPES:
        if name in named and name not in declared:
            vehicle_class = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi"}.get(name)
            attributes = {"id": name} | ({"vClass": vehicle_class} if vehicle_class else {})
            if name != "DEFAULT_RAILTYPE":
                ET.SubElement(root, "vType", attributes)
    return Document(DEFAULTS_FILE, None, xml_bytes(root))


def _with_attribute(document: Document, attribute: str, value: str) -> Document:
    root = document.parse()
    types = [item for item in root.iter("vType") if item.get("vClass") not in _NOT_DRIVEN]
    if not types:
        return document
    for item in types:
        item.set(attribute, value)
        for model in item:  # an old way to write a type, which overrules the attributes
            if model.tag.startswith("carFollowing-") and attribute in model.attrib:
                model.set(attribute, value)
    return document.edited(xml_bytes(root))
