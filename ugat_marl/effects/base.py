"""Base of all effects, and the hash that chooses the vehicles of an effect."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any, ClassVar, Literal

from ugat_marl.effects.controllers import ControllerPart, Cost, whole_decisions
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Detector, Period, Scenario

EVERYWHERE = "*"
"""Place of an effect that means all places."""

TextKind = Literal[
    "lane", "edge", "traffic light", "detector", "detectors", "model", "phase order", "objective",
    "point of a passage", "report of close vehicles",
]  # fmt: skip

_FORBIDDEN = frozenset(" \t\n\r|\\'\";,<>&")
"""Characters that ids in SUMO cannot have; a comma ends a value in the text form."""


def is_detector_name(text: str) -> bool:
    """Return True for names that an effect can give a detector: ids in SUMO, and spaces inside."""
    return bool(text) and text == text.strip() and not set(text) & (_FORBIDDEN - {" "})


Owner = Mapping[str, str]
"""Detector to the traffic light whose controller records it."""


@dataclass(frozen=True)
class NumberParameter:
    """Number that is a parameter of an effect.

    Attributes:
        unit: SI unit, or "" for a pure number.
        low: Smallest plausible value.
        high: Largest plausible value.
    """

    unit: str
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if a value is plausible."""
        return self.low <= value <= self.high

    def nearest(self, value: float) -> float:
        """Return the plausible value nearest to one."""
        return min(max(value, self.low), self.high)


TIME_OF_EPISODE = NumberParameter("s", 0.0, 1e7)
"""Begin or end of a part of the episode."""


@dataclass(frozen=True)
class TextParameter:
    """Name that is a parameter of an effect: a place of the network, or a model.

    Attributes:
        kind: Kind of the named thing.
        everywhere: True if ``"*"`` is allowed; it means all of this kind.
        allowed: All names of this kind; empty if the network decides them.
    """

    kind: TextKind
    everywhere: bool = False
    allowed: Collection[str] = ()


@dataclass(frozen=True)
class ExaminedStrengths:
    """Strengths of an effect on a whole network that a diagnosis first simulates.

    Attributes:
        levels: Values of the effect's number.
        nominal: Value without an effect; if vehicle types have the number, theirs is nominal.
        least: Smallest distance from nominal that matters in practice.
        both: True if values on the other side of nominal have the opposite effect.
        step: Step of the number, which is a multiple of it; 0 for none.
        extreme: Further values to simulate, beyond plausible ones.
    """

    levels: tuple[float, ...]
    nominal: float
    least: float
    both: bool = False
    step: float = 0.0
    extreme: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect(ControllerPart):
    """A physical effect; subclasses are frozen dataclasses whose fields are its parameters.

    An effect changes one of three things: the files of a scenario (`apply`), the reports of
    detectors (`observe`), or the link between a controller and its street (`sensor`, `actuator`,
    `cost`).

    Attributes:
        name: Name in files, on the command line and in verdicts.
        ranges: Unit and plausible range of each field that is a number.
        texts: Kind of name of each other field.
        attribute: Attribute of vehicle types with the effect's number, or "".
        examined: Strengths that a diagnosis tries on a whole network; None if it tries none.
        on_detectors: True if it changes the reports of detectors, but no traffic.
        on_installation: True if it changes where or what detectors record. Unlike other effects on
            detectors it needs a new simulation.
        on_departures: True if it changes only which vehicles depart, and when.

    Raises:
        OptionError: A value is outside its plausible range, or a name has impossible characters.
        UnknownNameError: A name is not among the allowed ones.
    """

    ranges: ClassVar[dict[str, NumberParameter]] = {}
    texts: ClassVar[dict[str, TextParameter]] = {}
    attribute: ClassVar[str] = ""
    examined: ClassVar[ExaminedStrengths | None] = None
    on_detectors: ClassVar[bool] = False
    on_installation: ClassVar[bool] = False
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

    def window(self, scenario: Scenario) -> tuple[float, float] | None:
        """Return the start and end of the effect on the scenario's clock, in s.

        Return None for an effect without times.
        """
        begin, end = getattr(self, "begin_s", None), getattr(self, "end_s", None)
        return None if begin is None or end is None else (begin, end)

    def idle_in(self, scenario: Scenario) -> str:
        """Return why the effect would change nothing in a scenario, and the way out; else ""."""
        window = self.window(scenario)
        begin = scenario.settings.begin_s
        end = begin + scenario.settings.duration_s
        if window is None or (window[0] < end and window[1] > begin):
            return ""
        return (
            f"it lasts from {window[0]:g} s to {window[1]:g} s, and the episode of scenario "
            f"{scenario.id!r} from {begin:g} s to {end:g} s, so it would change nothing; give "
            "times within the episode, or a longer duration_s"
        )

    @staticmethod
    def apply_all(scenario: Scenario, effects: Sequence[Any]) -> Scenario:
        """Apply effects that have this method in common, one after the other."""
        for effect in effects:
            scenario = effect.apply(scenario)
        return scenario

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Return the period as detectors with this effect report it.

        Args:
            period: Measured passages; it does not change itself.
            detectors: All detectors.
            owner: Detector to its traffic light, see `detector_lights`.

        Raises:
            UnknownNameError: The detector does not exist.
        """
        return period

    def installed(self, detectors: Sequence[Detector]) -> tuple[Detector, ...]:
        """Return the detectors as they really are on the street.

        Args:
            detectors: The detectors as they are stated.

        Raises:
            UnknownNameError: The detector does not exist.
        """
        return tuple(detectors)

    def undone(self, period: Period, detectors: Sequence[Detector]) -> Period:
        """Return a measured period without the effect, as far as the reports allow.

        Args:
            period: Measured passages; it does not change itself.
            detectors: All detectors.
        """
        return period

    def in_words(self) -> str:
        """Return the effect as part of a sentence; its text form unless it has better words."""
        return str(self)

    def cost(self) -> Cost | None:
        """Make the cost by which controllers are judged; None without a cost."""
        return None

    def record(self) -> dict[str, Any]:
        """Return name and parameters, as in ``[[effects]]`` of a scenario file."""
        return {"name": self.name} | self._values()

    def state_dict(self) -> dict[str, Any]:
        """Return the parameters by name."""
        return self._values()

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
            or not allowed.holds(float(value))
        ):
            raise OptionError(
                f"effect {self.name!r}: {field} = {value!r} is outside "
                f"[{allowed.low:g}, {allowed.high:g}] {allowed.unit}".rstrip()
            )
        return float(value)

    def _name(self, field: str, value: object) -> str:
        text = self.texts[field]
        named = isinstance(value, str) and (
            is_detector_name(value)
            if text.kind in ("detector", "detectors")
            else bool(value) and not set(value) & _FORBIDDEN
        )
        if not isinstance(value, str) or not named:
            article = "an" if text.kind == "edge" else "a"
            raise OptionError(
                f"effect {self.name!r}: {field} = {value!r} is not the name of {article} "
                f"{text.kind}"
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
    """Base of effects on counts, commands and costs of controllers; traffic does not change.

    No files change. The scenario lists the effect in its `effects`, so it is hashed, written and
    read with the scenario. The environment asks the effect for its sensor, actuator or cost.

    Attributes:
        apart_by: Parts of the record that tell two effects of a scenario apart.
    """

    apart_by: ClassVar[tuple[str, ...]] = ("name",)

    def apply(self, scenario: Scenario) -> Scenario:
        """List the effect in the scenario; the last of two with the same identity counts.

        These effects stand in a fixed order behind those on detectors, whose order counts.
        """

        def identity(record: Mapping[str, Any]) -> list[str]:
            return [str(record.get(name, "")) for name in self.apart_by]

        own = self.record()
        others = [item for item in scenario.settings.effects if identity(item) != identity(own)]
        names = set(_names_below(ControllerEffect))
        first = [item for item in others if item.get("name") not in names]
        then = sorted([own, *(item for item in others if item.get("name") in names)], key=identity)
        return with_listed_effects(scenario, self, [*first, *then])


@dataclass(frozen=True)
class DelayEffect(ControllerEffect):
    """Base of delays of `seconds`, rounded to decisions."""

    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.0, 600.0)}
    seconds: float

    def idle_in(self, scenario: Scenario) -> str:
        """Say that the delay is rounded to no decision."""
        interval_s = scenario.control.decision_interval_s
        if not self.seconds or whole_decisions(self.seconds, interval_s):
            return ""
        return (
            f"it is rounded to decisions of {interval_s:g} s, to none, so it would change nothing; "
            f"give at least {interval_s / 2:g} s"
        )


def _names_below(kind: type[Effect]) -> Iterator[str]:
    """Yield the names of all effects of a kind."""
    for each in kind.__subclasses__():
        yield getattr(each, "name", "")
        yield from _names_below(each)


def with_listed_effects(
    scenario: Scenario, effect: Effect, records: Iterable[Mapping[str, Any]]
) -> Scenario:
    """Return the scenario with these records of effects in its settings, `effect` among them."""
    settings = scenario.settings.model_copy(update={"effects": tuple(records)})
    known = () if str(effect) in scenario.applied else (str(effect),)  # a scenario is loaded twice
    return replace(scenario, settings=settings, applied=(*scenario.applied, *known))


def salt_of(scenario: Scenario, effect: Effect, *places: str) -> str:
    """Return the name of an effect's decisions about vehicles, for `hashed_uniform`.

    A second application needs another salt: with the same one, keeping a share of 0.8 of the
    vehicles again would remove none of them.

    Args:
        scenario: The scenario without the effect.
        effect: The effect.
        *places: Where it acts, as its first parameters.
    """
    begin = f"{effect.name}=" + "".join(f"{place}," for place in places)
    earlier = sum(text.startswith(begin) for text in scenario.applied)
    return " ".join((effect.name, *places, *([str(earlier)] if earlier else ())))


def hashed_uniform(salt: str, *names: str) -> float:
    """Return a number in [0, 1) that belongs to a vehicle, or to anything else with a name.

    It replaces a random generator. A share of 0.2 contains all vehicles with a number below 0.2, so
    a share of 0.3 contains the same vehicles and more. The order of vehicles does not matter.

    Args:
        salt: Name of the decision; other decisions about the same vehicle are independent.
        *names: Name of the vehicle or other subject of the decision, in one or more parts.
    """
    digest = hashlib.blake2b("\0".join((salt, *names)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2.0**64
