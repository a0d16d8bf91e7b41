"""Effects on the counts that controllers see: the observation gap.

Traffic, rewards and scores stay the same. The *counts* of a lane are its vehicles, its halting
vehicles, their waiting time and the vehicles queued upstream; its mean speed is seen with them.
Each effect makes a `Sensor` that changes them. Errors of counting do not change the mean speed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects.base import ControllerEffect, DelayEffect, NumberParameter
from ugat_marl.effects.controllers import Reading, Sensor, Stage, whole_decisions
from ugat_marl.scenarios import Network
from ugat_marl.seeding import numpy_generator


def _stream(seed: int, effect: type[ControllerEffect]) -> np.random.Generator:
    return numpy_generator(seed, "sensing", effect.name)


@dataclass(frozen=True)
class CountingNoise(ControllerEffect):
    """Every count has a normal error; its standard deviation is this share of the count."""

    name: ClassVar[str] = "counting_noise"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    share: float

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor that draws a relative error for each lane and decision."""
        return _Noise(self.share)


class _Noise(Sensor):
    stage = Stage.NOISE

    def __init__(self, share: float) -> None:
        self._share = share

    def reset(self, seed: int) -> None:
        self._random = _stream(seed, CountingNoise)

    def read(self, reading: Reading) -> Reading:
        drawn = self._random.standard_normal(reading.counts.shape[1])
        counts = reading.counts.copy()
        counts[:4] *= np.maximum(1.0 + self._share * drawn, 0.0)
        return replace(reading, counts=counts)


@dataclass(frozen=True)
class CountingError(ControllerEffect):
    """Numbers of vehicles, halting ones too, have a normal error, also on an empty lane.

    Its deviation is `vehicles`.
    """

    name: ClassVar[str] = "counting_error"
    ranges: ClassVar[dict[str, NumberParameter]] = {"vehicles": NumberParameter("veh", 0.0, 100.0)}
    vehicles: float

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor that draws an absolute error for each lane and decision."""
        return _Error(self.vehicles)


class _Error(Sensor):
    stage = Stage.ERROR

    def __init__(self, vehicles: float) -> None:
        self._vehicles = vehicles

    def reset(self, seed: int) -> None:
        self._random = _stream(seed, CountingError)

    def read(self, reading: Reading) -> Reading:
        drawn = self._random.standard_normal(reading.counts.shape[1])
        counts = reading.counts.copy()
        counts[:2] = np.maximum(counts[:2] + self._vehicles * drawn, 0.0)
        return replace(reading, counts=counts)


@dataclass(frozen=True)
class DetectorFailure(ControllerEffect):
    """This share of all lanes, drawn for each episode, has a dead detector, which reports 0."""

    name: ClassVar[str] = "detector_failure"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    share: float

    def sensor(self, network: Network, decision_interval_s: float) -> DeadDetectors:
        """Make a sensor with dead detectors."""
        return DeadDetectors(self.share, len(network.lane_table().ids))


class DeadDetectors(Sensor):
    """Sensor in which some detectors report 0 for a whole episode.

    For one seed, detectors that are dead at a low share are also dead at a higher share.

    Args:
        share: Chance of a dead detector, for each lane.
        lanes: Number of lanes.

    Attributes:
        dead: True for each lane with a dead detector in this episode, bool ``(lanes,)``.
    """

    stage = Stage.FAILURE

    def __init__(self, share: float, lanes: int) -> None:
        self._share = share
        self._lanes = lanes
        self.dead: NDArray[np.bool_] = np.zeros(lanes, dtype=np.bool_)

    def reset(self, seed: int) -> None:
        """Draw the dead detectors of the episode."""
        self.dead = _stream(seed, DetectorFailure).random(self._lanes) < self._share

    def read(self, reading: Reading) -> Reading:
        """Return the reading with zeros at dead detectors."""
        alive, left = ~self.dead, reading.mean_left
        return replace(
            reading,
            counts=reading.counts * alive,
            mean_left=left * alive if len(left) else left,
        )


@dataclass(frozen=True)
class DetectionZone(ControllerEffect):
    """Only vehicles within `metres` of a stop line are seen."""

    name: ClassVar[str] = "detection_zone"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", 1.0, 1000.0)}
    metres: float

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor with zones at the stop lines; lanes without a stop line report 0."""
        return _Zone(self.metres, network)


class _Zone(Sensor):
    stage = Stage.ZONE

    def __init__(self, metres: float, network: Network) -> None:
        self.zone_m = metres
        incoming = {
            lane for intersection in network.intersections for lane in intersection.incoming_lanes
        }
        self._at_stop_line = np.array(
            [lane in incoming for lane in network.lane_table().ids], dtype=np.float64
        )

    def read(self, reading: Reading) -> Reading:
        vehicles, halting, waiting_s, below_limit_mps = reading.near * self._at_stop_line
        upstream = np.zeros_like(vehicles)  # outside of the zone
        seen = np.array([vehicles, halting, waiting_s, upstream, below_limit_mps])
        return replace(reading, counts=seen)


@dataclass(frozen=True)
class ObservationDelay(DelayEffect):
    """Counts arrive after `seconds`, rounded to decisions; phases are known at once."""

    name: ClassVar[str] = "observation_delay"

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor that delays counts by whole decisions."""
        return _Late(whole_decisions(self.seconds, decision_interval_s))


class _Late(Sensor):
    stage = Stage.DELAY

    def __init__(self, decisions: int) -> None:
        self._decisions = decisions

    def reset(self, seed: int) -> None:
        self._under_way: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()

    def read(self, reading: Reading) -> Reading:
        self._under_way.append((reading.counts, reading.mean_left))
        counts, left = np.zeros_like(reading.counts), np.zeros_like(reading.mean_left)
        if len(self._under_way) > self._decisions:
            counts, before = self._under_way.popleft()
            left = before if len(before) else left  # none is measured before the first decision
        return replace(reading, counts=counts, mean_left=left)


@dataclass(frozen=True)
class LostReadings(ControllerEffect):
    """A lane's counts are lost with this chance at each decision; the last ones are seen again."""

    name: ClassVar[str] = "lost_readings"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    share: float

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor that loses counts, independently for each lane."""
        return _Lossy(self.share)


class _Lossy(Sensor):
    stage = Stage.LOSS

    def __init__(self, share: float) -> None:
        self._share = share

    def reset(self, seed: int) -> None:
        self._random = _stream(seed, LostReadings)
        self._last: NDArray[np.float64] | None = None
        self._old: NDArray[np.bool_] | bool = False

    def read(self, reading: Reading) -> Reading:
        last = np.zeros_like(reading.counts) if self._last is None else self._last
        lost = self._random.random(reading.counts.shape[1]) < self._share
        self._last = np.where(lost, last, reading.counts)
        left = reading.mean_left  # of a lane that is seen late, it is not known when they left
        left = np.where(lost | self._old, 0.0, left) if len(left) else left
        self._old = lost
        return replace(reading, counts=self._last, mean_left=left)


@dataclass(frozen=True)
class QuantisedCounts(ControllerEffect):
    """Numbers of vehicles, halting ones too, are rounded to the nearest multiple of `vehicles`."""

    name: ClassVar[str] = "quantised_counts"
    ranges: ClassVar[dict[str, NumberParameter]] = {"vehicles": NumberParameter("veh", 1.0, 100.0)}
    vehicles: float

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor that rounds counts to the step; halves are rounded up."""
        return _Steps(self.vehicles)


class _Steps(Sensor):
    stage = Stage.ROUNDING

    def __init__(self, vehicles: float) -> None:
        self._vehicles = vehicles

    def read(self, reading: Reading) -> Reading:
        counts = reading.counts.copy()
        counts[:2] = np.floor(counts[:2] / self._vehicles + 0.5) * self._vehicles
        return replace(reading, counts=counts)


OBSERVATION_EFFECTS: tuple[type[ControllerEffect], ...] = (
    CountingNoise, CountingError, DetectorFailure, DetectionZone, ObservationDelay, LostReadings,
    QuantisedCounts,
)  # fmt: skip
"""Effects on the counts that controllers see."""
