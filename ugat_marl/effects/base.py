"""What an effect is, and the hash that decides which vehicles it meets."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any, ClassVar, Literal

from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Scenario

EVERYWHERE = "*"
"""As a place: all of them."""

TextKind = Literal["lane", "edge", "traffic light", "detector", "model", "phase order", "objective"]

_FORBIDDEN = frozenset(" \t\n\r|\\'\";,<>&")
"""Characters that ids in SUMO cannot have; a comma ends a value in the text form."""


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
class Effect:
    """A physical effect; subclasses are frozen dataclasses whose fields are its parameters.

    Attributes:
        name: How files, the command line and verdicts call it.
        ranges: Unit and plausible range of each field that is a number.
        texts: What each other field names.

    Raises:
        OptionError: A value is outside its plausible range, or a name cannot be one.
        UnknownNameError: A model that does not exist.
    """

    name: ClassVar[str]
    ranges: ClassVar[dict[str, Parameter]] = {}
    texts: ClassVar[dict[str, Text]] = {}

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in self.texts:
                object.__setattr__(self, item.name, self._name(item.name, value))
            else:
                object.__setattr__(self, item.name, self._number(item.name, value))
        begin, end = getattr(self, "begin_s", None), getattr(self, "end_s", None)
        if begin is not None and end is not None and begin >= end:
            raise OptionError(
                f"effect {self.name!r}: begin_s = {begin:g} is not before end_s = {end:g}"
            )

    def apply(self, scenario: Scenario) -> Scenario:
        """A scenario in which the effect is present; `scenario` itself does not change."""
        raise TypeError(f"{type(self).__name__} does not say how it is applied")

    def record(self) -> dict[str, Any]:
        """Name and parameters, as in ``[[effects]]`` of a scenario file."""
        return {"name": self.name} | {item.name: getattr(self, item.name) for item in fields(self)}

    def __str__(self) -> str:
        values = (getattr(self, item.name) for item in fields(self))
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
    """An effect on what controllers see, do or are judged by; traffic and detectors stay alone.

    The environment keeps it, so the scenario goes on listing it in its own `effects`: there it is
    hashed, written and read again. No files change.
    """

    def apply(self, scenario: Scenario) -> Scenario:
        """Lists the effect in the scenario; the last of two of the same name counts."""
        others = [item for item in scenario.settings.effects if item.get("name") != self.name]
        listed = sorted([*others, self.record()], key=lambda item: str(item.get("name")))
        settings = scenario.settings.model_copy(update={"effects": tuple(listed)})
        known = () if str(self) in scenario.applied else (str(self),)  # a scenario is loaded twice
        return replace(scenario, settings=settings, applied=(*scenario.applied, *known))


def draw(salt: str, *names: str) -> float:
    """A number in [0, 1) that belongs to a vehicle, or to whatever is named.

    It takes the place of a random generator: a share of 0.2 is all vehicles with a number below
    0.2, so that they are among the ones met at 0.3, and nothing depends on who comes first.

    Args:
        salt: What is decided; other decisions about the same vehicle are independent.
        *names: Whom it is decided for.
    """
    digest = hashlib.blake2b("\0".join((salt, *names)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2.0**64
