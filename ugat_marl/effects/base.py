"""Base of all effects, and the hash that decides which vehicles an effect meets."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any, ClassVar, Literal

from ugat_marl.effects.controllers import Actuator, Cost, Sensor
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Detector, Network, Period, Scenario, SignalTiming

EVERYWHERE = "*"
"""As a place: all of them."""

TextKind = Literal["lane", "edge", "traffic light", "detector", "model", "phase order", "objective"]

_FORBIDDEN = frozenset(" \t\n\r|\\'\";,<>&")
"""Characters that ids in SUMO cannot have; a comma ends a value in the text form."""


Owner = Mapping[str, str]
"""Detector to the traffic light whose controller records it."""


@dataclass(frozen=True)
class Parameter:
    """A number an effect has.

    Attributes:
        unit: SI unit, or "" for a pure number.
        low: Smallest plausible value.
        high: Largest plausible value.
    """

    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Text:
    """A name an effect has: a place of the network, or a model.

    Attributes:
        kind: What is named.
        everywhere: Whether ``"*"`` is allowed and means all of them.
        allowed: The names there are, if the network does not decide it.
    """

    kind: TextKind
    everywhere: bool = False
    allowed: Collection[str] = ()


@dataclass(frozen=True)
class Examined:
    """Strengths of an effect on a whole network that a diagnosis first simulates.

    Attributes:
        levels: Values of its number.
        nominal: Value that changes nothing; where vehicle types hold the number, theirs counts.
        least: Distance from nominal below which the effect does not matter in practice.
        both: True if values on the other side of nominal have the opposite effect.
        step: The number is a multiple of it, if not 0.
        extreme: Values that are simulated as well, and are no plausible world.
    """

    levels: tuple[float, ...]
    nominal: float
    least: float
    both: bool = False
    step: float = 0.0
    extreme: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect:
    """A physical effect; subclasses are frozen dataclasses whose fields are its parameters.

    An effect does something at one of three places and leaves the others as they are: to the files
    of a scenario (`apply`), to what detectors report (`observe`), or between a controller and its
    street (`sensor`, `actuator`, `cost`).

    Attributes:
        name: Name in files, on the command line and in verdicts.
        ranges: Unit and plausible range of each field that is a number.
        texts: Kind of name that each other field holds.
        attribute: Attribute of vehicle types that holds its number, or "".
        examined: Strengths a diagnosis tries on a whole network; None if it tries none.
        on_detectors: True if it changes what detectors report, and no traffic.
        on_departures: True if it changes which vehicles depart or when, and not how they drive.

    Raises:
        OptionError: A value is outside its plausible range, or a name cannot be one.
        UnknownNameError: A model that does not exist.
    """

    name: ClassVar[str]
    ranges: ClassVar[dict[str, Parameter]] = {}
    texts: ClassVar[dict[str, Text]] = {}
    attribute: ClassVar[str] = ""
    examined: ClassVar[Examined | None] = None
    on_detectors: ClassVar[bool] = False
    on_departures: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            checked = self._name if field.name in self.texts else self._number
            object.__setattr__(self, field.name, checked(field.name, value))
        begin, end = getattr(self, "begin_s", None), getattr(self, "end_s", None)
        if begin is not None and end is not None and begin >= end:
            raise OptionError(
                f"effect {self.name!r}: begin_s = {begin:g} is not before end_s = {end:g}"
            )

    def apply(self, scenario: Scenario) -> Scenario:
        """Return a scenario in which the effect is present; `scenario` itself does not change."""
        raise NotImplementedError(f"{type(self).__name__} has no apply()")

    @staticmethod
    def apply_all(scenario: Scenario, effects: Sequence[Any]) -> Scenario:
        """Apply effects that have this method in common, one after the other."""
        for effect in effects:
            scenario = effect.apply(scenario)
        return scenario

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Return what detectors would have reported instead.

        Args:
            period: What was measured; it does not change itself.
            detectors: All detectors.
            owner: Detector to its traffic light, see `owners`.

        Raises:
            UnknownNameError: No such detector.
        """
        del detectors, owner
        return period

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor | None:
        """Make what changes the view of the controllers of a network; None if nothing does."""
        del network, decision_interval_s
        return None

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> Actuator | None:
        """Make what changes the commands of the controllers of a network; None if nothing does.

        Raises:
            ScenarioError: The phases of an intersection do not allow it.
        """
        del network, timing, decision_interval_s
        return None

    def cost(self) -> Cost | None:
        """Make the cost by which controllers are judged; None if it stays as it is."""
        return None

    def record(self) -> dict[str, Any]:
        """Return name and parameters, as in ``[[effects]]`` of a scenario file."""
        return {"name": self.name} | self._values()

    def _values(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __str__(self) -> str:
        values = self._values().values()
        texts = (value if isinstance(value, str) else f"{value:.12g}" for value in values)
        return f"{self.name}={','.join(texts)}"

    def _number(self, field: str, value: object) -> float:
        allowed = self.ranges[field]
        if (
            isinstance(value, bool)
            or not isinstance(value, Real)
            or not math.isfinite(value)
            or not allowed.low <= float(value) <= allowed.high
        ):
            raise OptionError(
                f"effect {self.name!r}: {field} = {value!r} is outside "
                f"[{allowed.low:g}, {allowed.high:g}] {allowed.unit}".rstrip()
            )
        return float(value)

    def _name(self, field: str, value: object) -> str:
        text = self.texts[field]
        if not isinstance(value, str) or not value or set(value) & _FORBIDDEN:
            raise OptionError(
                f"effect {self.name!r}: {field} = {value!r} is not the name of a {text.kind}"
            )
        if value == EVERYWHERE and not text.everywhere:
            raise OptionError(f"effect {self.name!r}: {field} must be one {text.kind}, not '*'")
        if text.allowed and value not in text.allowed:
            same = [name for name in text.allowed if name.lower() == value.lower()]
            if not same:
                raise UnknownNameError(f"{text.kind} of effect {self.name!r}:", value, text.allowed)
            return same[0]
        return value


@dataclass(frozen=True)
class ControllerEffect(Effect):
    """An effect on what controllers see, do or are judged by; traffic and detectors stay the same.

    No files change. The scenario goes on listing the effect in its own `effects`, where it is
    hashed, written and read again, and the environment asks the effect for its part.
    """

    def apply(self, scenario: Scenario) -> Scenario:
        """List the effect in the scenario; the last of two of the same name counts."""
        others = [item for item in scenario.settings.effects if item.get("name") != self.name]
        listed = sorted([*others, self.record()], key=lambda item: str(item.get("name")))
        settings = scenario.settings.model_copy(update={"effects": tuple(listed)})
        known = () if str(self) in scenario.applied else (str(self),)  # a scenario is loaded twice
        return replace(scenario, settings=settings, applied=(*scenario.applied, *known))


def draw(salt: str, *names: str) -> float:
    """Return a number in [0, 1) that belongs to a vehicle, or to anything else with a name.

    It takes the place of a random generator. A share of 0.2 is all vehicles with a number below
    0.2: they are among those met at 0.3, and the order of vehicles does not matter.

    Args:
        salt: Name of the decision; other decisions about the same vehicle are independent.
        *names: Names of the vehicle, or of what else the decision is about.
    """
    digest = hashlib.blake2b("\0".join((salt, *names)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2.0**64
