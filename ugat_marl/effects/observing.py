"""Effects on what controllers see: the observation gap. Traffic and scores are not touched.

`ugat_marl.envs.sensors` puts them into practice. A *count* is what a lane's detector reports:
vehicles and halting vehicles on the lane, and with them their waiting time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ugat_marl.effects.base import ControllerEffect, Parameter


@dataclass(frozen=True)
class CountingNoise(ControllerEffect):
    """Every count is off by a normal error of this standard deviation, as a share of the count."""

    name: ClassVar[str] = "counting_noise"
    ranges: ClassVar[dict[str, Parameter]] = {"share": Parameter("", 0.0, 1.0)}
    share: float


@dataclass(frozen=True)
class CountingError(ControllerEffect):
    """Every count is off by a normal error of so many vehicles, also where nobody is."""

    name: ClassVar[str] = "counting_error"
    ranges: ClassVar[dict[str, Parameter]] = {"vehicles": Parameter("veh", 0.0, 100.0)}
    vehicles: float


@dataclass(frozen=True)
class DetectorFailure(ControllerEffect):
    """This share of all lanes, drawn for each episode, has a dead detector, which reports 0."""

    name: ClassVar[str] = "detector_failure"
    ranges: ClassVar[dict[str, Parameter]] = {"share": Parameter("", 0.0, 1.0)}
    share: float


@dataclass(frozen=True)
class DetectionZone(ControllerEffect):
    """Only vehicles within so many metres before a stop line are seen."""

    name: ClassVar[str] = "detection_zone"
    ranges: ClassVar[dict[str, Parameter]] = {"metres": Parameter("m", 1.0, 1000.0)}
    metres: float


@dataclass(frozen=True)
class ObservationDelay(ControllerEffect):
    """Counts arrive so late, in whole decisions; the phase shown is known at once."""

    name: ClassVar[str] = "observation_delay"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 0.0, 600.0)}
    seconds: float


@dataclass(frozen=True)
class LostReadings(ControllerEffect):
    """A lane's reading is lost with this chance at each decision; the last one is seen again."""

    name: ClassVar[str] = "lost_readings"
    ranges: ClassVar[dict[str, Parameter]] = {"share": Parameter("", 0.0, 1.0)}
    share: float


@dataclass(frozen=True)
class QuantisedCounts(ControllerEffect):
    """Counts are multiples of so many vehicles, rounded to the nearest."""

    name: ClassVar[str] = "quantised_counts"
    ranges: ClassVar[dict[str, Parameter]] = {"vehicles": Parameter("veh", 1.0, 100.0)}
    vehicles: float


OBSERVING: tuple[type[ControllerEffect], ...] = (
    CountingNoise, CountingError, DetectorFailure, DetectionZone, ObservationDelay, LostReadings,
    QuantisedCounts,
)  # fmt: skip
"""All of them."""
