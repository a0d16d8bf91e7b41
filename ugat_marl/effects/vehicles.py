"""Effects on how vehicles move, written into every vehicle type of a scenario.

A vehicle may name a type, draw one from a distribution, or use SUMO's default type. The effects
change all of these. They write XML, because TraCI silently ignores `startupDelay`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from statistics import fmean
from typing import ClassVar

from ugat_marl.effects.base import Effect, ExaminedStrengths, NumberParameter, TextParameter
from ugat_marl.effects.documents import edit_scenario, parts_with, with_default_types
from ugat_marl.scenarios import Scenario, ScenarioFile, SpeedFactors

_NOT_DRIVEN = frozenset(
    {
        "pedestrian", "wheelchair", "container", "rail", "rail_electric", "rail_urban", "rail_fast",
        "subway", "cable_car", "tram", "ship", "aircraft", "drone",
    }
)  # fmt: skip

DRIVER_MODELS = (
    "Krauss", "KraussOrig1", "KraussPS", "KraussX", "BKerner", "IDM", "IDMM", "EIDM",
    "Wiedemann", "W99", "Daniel1", "ACC", "CACC",
)  # fmt: skip
"""SUMO's car-following models that need no parameters of their own and keep to red lights in steps
of 1 s, which PWagner2009 does not."""


def driven_types(root: ET.Element) -> list[ET.Element]:
    """Return all vehicle types of a document that drive on the road."""
    return [element for element in root.iter("vType") if element.get("vClass") not in _NOT_DRIVEN]


def type_values(scenario: Scenario, attribute: str, default: str = "") -> set[str]:
    """Return the values of an attribute in the driven vehicle types of a scenario.

    Args:
        scenario: The scenario.
        attribute: Attribute of vehicle types.
        default: Value of passenger cars whose type does not name it; "" to leave these out.

    Raises:
        ValueError: A speed is asked for that is not a number.
    """
    texts: set[str] = set()
    for document in (*scenario.additional, *scenario.routes):
        for part in parts_with(document, "<vType"):
            for kind in driven_types(part):
                if attribute == "speedDev":  # speedFactor may hold it, and classes differ
                    speeds = SpeedFactors.of(kind.attrib, scenario.settings.sumo)
                    texts.add(str(speeds.deviation))
                    continue
                usual = default if kind.get("vClass", "passenger") == "passenger" else ""
                texts.add(_text(kind, attribute) or usual)
    return texts - {""}


def type_numbers(scenario: Scenario, attribute: str, default: float) -> list[float]:
    """Return the different numbers of an attribute in a scenario's types, in ascending order.

    Args:
        scenario: The scenario.
        attribute: Attribute of vehicle types, or "".
        default: The only number where no type names the attribute, or one names it in words.
    """
    try:
        numbers = {float(text) for text in type_values(scenario, attribute, str(default))}
    except ValueError:
        return [default]
    return sorted(numbers or {default})


def nominal_number(scenario: Scenario, attribute: str, default: float) -> float:
    """Return the mean of `type_numbers`; where they are one number, it changes nothing."""
    return fmean(type_numbers(scenario, attribute, default))


def _text(vehicle_type: ET.Element, attribute: str) -> str:
    """Return an attribute of a type as text, also in the old way to write a type."""
    models = [model for model in vehicle_type if model.tag.startswith("carFollowing-")]
    texts = (element.get(attribute) for element in (*models, vehicle_type))
    return next((text for text in texts if text), "")


@dataclass(frozen=True)
class VehicleEffect(Effect):
    """An effect that is one attribute of all vehicle types."""

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the attribute in every vehicle type, SUMO's default type included."""
        return self.apply_all(scenario, (self,))

    @staticmethod
    def apply_all(scenario: Scenario, effects: Sequence[VehicleEffect]) -> Scenario:
        """Apply effects one after the other; the files are read and written once."""
        settings = scenario.settings

        def change(root: ET.Element) -> bool:
            types = driven_types(root)
            for element in types:
                for effect in effects:
                    effect.write(element, settings)
            return bool(types)

        scenario = with_default_types(scenario)
        edited = edit_scenario(scenario, change, "<vType", applied="", in_place=True)
        return replace(edited, applied=(*scenario.applied, *map(str, effects)))

    def write(self, element: ET.Element, settings: ScenarioFile) -> None:
        """Put the effect into one type of a scenario with these settings."""
        self._write(element, getattr(self, fields(self)[0].name), settings)

    def _write(self, element: ET.Element, number: float, settings: ScenarioFile) -> None:
        """Write the effect's number into one type of a scenario with these settings."""
        _set(element, self.attribute, number)


def _set(element: ET.Element, attribute: str, number: float) -> None:
    value = f"{number:.12g}"
    element.set(attribute, value)
    for model in element:  # an old way to write a type, which overrules the attributes
        if model.tag.startswith("carFollowing-") and attribute in model.attrib:
            model.set(attribute, value)


def _get(vehicle_type: ET.Element, attribute: str, default: float) -> float:
    return float(_text(vehicle_type, attribute) or default)


@dataclass(frozen=True)
class Acceleration(VehicleEffect):
    """Largest acceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "acceleration"
    attribute: ClassVar[str] = "accel"
    ranges: ClassVar[dict[str, NumberParameter]] = {"mps2": NumberParameter("m/s^2", 0.1, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.8, 1.6), 2.6, 0.1, both=True)
    mps2: float


@dataclass(frozen=True)
class Deceleration(VehicleEffect):
    """Comfortable deceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "deceleration"
    attribute: ClassVar[str] = "decel"
    ranges: ClassVar[dict[str, NumberParameter]] = {"mps2": NumberParameter("m/s^2", 0.1, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((2.0, 3.2), 4.5, 0.2, both=True)
    mps2: float


@dataclass(frozen=True)
class EmergencyDeceleration(VehicleEffect):
    """Largest physically possible deceleration of all vehicles, in m/s^2."""

    name: ClassVar[str] = "emergency_deceleration"
    attribute: ClassVar[str] = "emergencyDecel"
    ranges: ClassVar[dict[str, NumberParameter]] = {"mps2": NumberParameter("m/s^2", 0.1, 20.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((3.0, 5.0), 9.0, 0.5)
    mps2: float


NO_SOFTER = {EmergencyDeceleration.name: Deceleration.name}
"""Effects with their lower bound: an emergency deceleration is at least the usual deceleration."""


@dataclass(frozen=True)
class StartupDelay(VehicleEffect):
    """Time a stopped vehicle waits before it starts, in s (SUMO's `startupDelay`).

    Below about 0.75 s it moves only the first vehicle of a queue; it is not the start-up lost time
    of the Highway Capacity Manual.
    """

    name: ClassVar[str] = "startup_delay"
    attribute: ClassVar[str] = "startupDelay"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths(
        (0.3, 0.6, 0.8, 1.2), 0.0, 0.05, extreme=(2.4,)
    )
    seconds: float


@dataclass(frozen=True)
class Headway(VehicleEffect):
    """Time gap drivers keep to the vehicle in front, in s (SUMO's `tau`; default 1).

    The smallest value is the time between two decisions of a driver: a simulation step or the
    `reaction_step`. With less, SUMO's drivers run red lights and collide.
    """

    name: ClassVar[str] = "headway"
    attribute: ClassVar[str] = "tau"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.1, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((1.3, 1.7), 1.0, 0.05)
    seconds: float

    def _write(self, element: ET.Element, number: float, settings: ScenarioFile) -> None:
        decides_s = float(settings.sumo.get("default.action-step-length", 0))
        decides_s = _get(element, "actionStepLength", decides_s)
        _set(element, "tau", max(number, settings.step_length_s, decides_s))


@dataclass(frozen=True)
class MinGap(VehicleEffect):
    """Empty space in front of a standing vehicle, in m (default 2.5)."""

    name: ClassVar[str] = "min_gap"
    attribute: ClassVar[str] = "minGap"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", 0.1, 20.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((1.2, 1.8, 3.1, 3.8, 4.7), 2.5, 0.2)
    metres: float


@dataclass(frozen=True)
class Imperfection(VehicleEffect):
    """Unevenness of following, 0 is perfect (`sigma` of Krauss' model; default 0.5)."""

    name: ClassVar[str] = "imperfection"
    attribute: ClassVar[str] = "sigma"
    ranges: ClassVar[dict[str, NumberParameter]] = {"sigma": NumberParameter("", 0.0, 1.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.15, 0.85), 0.5, 0.05)
    sigma: float


@dataclass(frozen=True)
class ReactionStep(VehicleEffect):
    """Drivers decide only every `seconds` (`actionStepLength`), rounded to simulation steps.

    Their time gap grows with it where it was shorter, see `Headway`. A shorter step after a longer
    one keeps that gap.
    """

    name: ClassVar[str] = "reaction_step"
    attribute: ClassVar[str] = "actionStepLength"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.1, 5.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((2.0,), 1.0, 0.5)
    seconds: float

    def _write(self, element: ET.Element, number: float, settings: ScenarioFile) -> None:
        step_s = settings.step_length_s
        steps = max(round(number / step_s), 1)
        _set(element, "actionStepLength", steps * step_s)
        _set(element, "tau", max(_get(element, "tau", 1), steps * step_s))


@dataclass(frozen=True)
class YellowRunning(VehicleEffect):
    """Drivers pass a light that has been yellow for at most `seconds` though they could stop.

    SUMO's `jmDriveAfterYellowTime`; by default nobody does.
    """

    name: ClassVar[str] = "yellow_running"
    attribute: ClassVar[str] = "jmDriveAfterYellowTime"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((3.0,), 0.0, 0.3)
    seconds: float


@dataclass(frozen=True)
class RedRunning(VehicleEffect):
    """Drivers pass a light that has been red for at most `seconds`; they never stop at yellow.

    SUMO's `jmDriveAfterRedTime`; by default nobody does. It overrules `yellow_running`.
    """

    name: ClassVar[str] = "red_running"
    attribute: ClassVar[str] = "jmDriveAfterRedTime"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 10.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((2.0,), 0.0, 0.3)
    seconds: float

    def _write(self, element: ET.Element, number: float, settings: ScenarioFile) -> None:
        if number:
            super()._write(element, number, settings)
            return
        for part in (element, *element):  # with 0, SUMO's drivers would still never stop at yellow
            part.attrib.pop(self.attribute, None)


@dataclass(frozen=True)
class GapAcceptance(VehicleEffect):
    """Time gap to a vehicle with priority that is enough to go first, in s (`jmTimegapMinor`).

    The default is 1; it matters to permitted turns (g) and minor roads.
    """

    name: ClassVar[str] = "gap_acceptance"
    attribute: ClassVar[str] = "jmTimegapMinor"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 20.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.4, 2.5), 1.0, 0.2)
    seconds: float


@dataclass(frozen=True)
class LaneDiscipline(VehicleEffect):
    """Eagerness to change early to the lane of a turn (`lcStrategic`; default 1, 0 is late)."""

    name: ClassVar[str] = "lane_discipline"
    attribute: ClassVar[str] = "lcStrategic"
    ranges: ClassVar[dict[str, NumberParameter]] = {"strategic": NumberParameter("", 0.0, 100.0)}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.1, 5.0), 1.0, 0.2)
    strategic: float


@dataclass(frozen=True)
class DriverModel(Effect):
    """The car-following model of all vehicles (`carFollowModel`; SUMO's default is Krauss).

    Parameters that the new model does not have stay in the types; SUMO ignores them.
    """

    name: ClassVar[str] = "driver_model"
    texts: ClassVar[dict[str, TextParameter]] = {
        "model": TextParameter("model", allowed=DRIVER_MODELS)
    }
    model: str

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the model in every vehicle type, SUMO's default type included."""

        def change(root: ET.Element) -> bool:
            types = driven_types(root)
            for element in types:
                for old in [x for x in element if x.tag.startswith("carFollowing-")]:
                    element.attrib.update(old.attrib)
                    element.remove(old)
                element.set("carFollowModel", self.model)
            return bool(types)

        scenario = with_default_types(scenario)
        return edit_scenario(scenario, change, "<vType", applied=str(self))
