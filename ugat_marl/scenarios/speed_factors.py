"""Distributions of desired speeds in vehicle types, read as SUMO reads them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

LEAST, GREATEST = 0.2, 2.0
"""SUMO's default limits of speedFactor."""

_NORMAL = re.compile(r"\s*normc?\(([^)]*)\)\s*")
_STEADY = frozenset(
    {
        "bus", "emergency", "ignoring", "army", "authority", "tram", "rail", "rail_urban",
        "rail_electric", "rail_fast", "subway", "cable_car", "container", "aircraft", "drone",
    }
)  # fmt: skip
_CALM = frozenset({"truck", "trailer", "coach", "delivery", "taxi"})


@dataclass(frozen=True)
class SpeedFactors:
    """Distribution of speedFactor in a vehicle type: normal, cut at its ends.

    Attributes:
        mean: Mean of the normal distribution, as a share of the speed limit.
        deviation: Its standard deviation.
        least: Least speedFactor.
        greatest: Greatest speedFactor.
    """

    mean: float
    deviation: float
    least: float = LEAST
    greatest: float = GREATEST

    @property
    def text(self) -> str:
        """Attribute speedFactor that declares this distribution."""
        values = [self.mean, self.deviation]
        least, greatest = math.isfinite(self.least), math.isfinite(self.greatest)
        if least or greatest:
            values.append(self.least if least else 0.0)  # SUMO draws no other than positive ones
        if greatest:
            values.append(self.greatest)
        return f"normc({','.join(f'{value:.8g}' for value in values)})"

    @classmethod
    def of(cls, attributes: Mapping[str, str], sumo: Mapping[str, str]) -> SpeedFactors:
        """Read the attributes of a ``<vType>``.

        Args:
            attributes: Attributes of the type; empty for SUMO's default type.
            sumo: Options of SUMO, of which ``default.speeddev`` counts.

        Raises:
            ValueError: A value is not a number.
        """
        mean, deviation = 1.0, default_deviation(attributes.get("vClass", "passenger"), sumo)
        least, greatest = LEAST, GREATEST
        text = attributes.get("speedFactor", "")
        if normal := _NORMAL.fullmatch(text):
            numbers = [float(part) for part in normal[1].split(",")]
            mean, deviation = numbers[0], numbers[1] if len(numbers) > 1 else 0.0
            least = numbers[2] if len(numbers) > 2 else -math.inf
            greatest = numbers[3] if len(numbers) > 3 else math.inf
        elif text:
            mean = float(text)
        if own := attributes.get("speedDev"):
            deviation = float(own)
        return cls(mean, deviation, least, greatest)


def default_deviation(vehicle_class: str, sumo: Mapping[str, str]) -> float:
    """Return the deviation of speedFactor of a vehicle class that states none.

    Args:
        vehicle_class: SUMO's ``vClass``.
        sumo: Options of SUMO; a ``default.speeddev`` of 0 or more holds for every class.
    """
    general = float(sumo.get("default.speeddev", -1))
    if general >= 0:
        return general
    return 0.0 if vehicle_class in _STEADY else 0.05 if vehicle_class in _CALM else 0.1
