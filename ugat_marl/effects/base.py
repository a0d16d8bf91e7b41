"""What an effect is."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from numbers import Real
from typing import ClassVar

from ugat_marl.errors import OptionError
from ugat_marl.scenario import Scenario


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
class Effect:
    """A physical effect; subclasses are frozen dataclasses whose fields are its parameters.

    Attributes:
        name: How files, the command line and verdicts call it.
        ranges: Unit and plausible range of each field.

    Raises:
        OptionError: A value is outside its plausible range.
    """

    name: ClassVar[str]
    ranges: ClassVar[dict[str, Parameter]]

    def __post_init__(self) -> None:
        for item in fields(self):
            value, allowed = getattr(self, item.name), self.ranges[item.name]
            if not (
                not isinstance(value, bool)
                and isinstance(value, Real)
                and math.isfinite(value)
                and allowed.low <= float(value) <= allowed.high
            ):
                raise OptionError(
                    f"effect {self.name!r}: {item.name} = {value!r} is outside "
                    f"[{allowed.low:g}, {allowed.high:g}] {allowed.unit}".rstrip()
                )

    def apply(self, scenario: Scenario) -> Scenario:
        """A scenario in which the effect is present; `scenario` itself does not change."""
        raise TypeError(f"{type(self).__name__} does not say how it is applied")

    def __str__(self) -> str:
        values = ",".join(f"{getattr(self, item.name):g}" for item in fields(self))
        return f"{self.name}={values}"
