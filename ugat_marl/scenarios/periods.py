"""Periods of measurement: detectors, the vehicles that passed them, and the signal log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

DetectorKind = Literal["advance", "stop", "exit"]
SpeedPoint = Literal["front", "rear", "mean"]
"""Point of a passage at which a detector measures the speed: when the front reaches the zone, when
the rear leaves it, or the mean of both."""
SPEED_POINTS: tuple[SpeedPoint, ...] = ("front", "rear", "mean")
DetectorClock = Literal["signals", "sumo"]
"""Clock that stamps a detector's events: that of the signals, or that of SUMO's output. In SUMO the
positions at time t already follow the signals of t, so its stamps are one step early."""
DETECTOR_CLOCKS: tuple[DetectorClock, ...] = ("signals", "sumo")

Split = Literal["fit", "heldout"]


SignalLog = tuple[tuple[float, str], ...]
"""States of a traffic light: ``(since_s, state)`` at every change, sorted by time."""


@dataclass(frozen=True)
class Detector:
    """A detection zone on one lane.

    Attributes:
        id: Name.
        lane: SUMO id of the lane.
        position_m: Distance of the zone's upstream end from the lane's start.
        length_m: Length of the zone; 0 for a point.
        kind: ``advance`` upstream of a stop line, ``stop`` at the stop line, ``exit`` downstream of
            the intersection.
        speed_at: Point of the passage at which speeds are measured; None if it is not stated.
            Detectors of a simulation then measure when the rear leaves.
        clock: Clock that stamps the events; None if it is not stated, which counts as ``sumo``.
    """

    id: str
    lane: str
    position_m: float
    length_m: float
    kind: DetectorKind
    speed_at: SpeedPoint | None = None
    clock: DetectorClock | None = None

    @property
    def steps_early(self) -> int:
        """Simulation steps by which the stamps are ahead of the clock of the signals: 0 or 1."""
        return 0 if self.clock == "signals" else 1


@dataclass(frozen=True, eq=False)
class Passages:
    """Vehicles over one detector in one period, sorted by time; all arrays ``(passages,)``.

    Attributes:
        on_s: Time at which the front reached the zone; NaN if before the period.
        off_s: Time at which the rear left the zone; NaN if after the period.
        speed_mps: Speed; NaN if not measured.
        length_m: Length of the vehicle; NaN if not measured.
    """

    on_s: NDArray[np.float64]
    off_s: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    length_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.on_s)

    @classmethod
    def none(cls) -> Passages:
        """Return passages of no vehicle."""
        empty = np.empty(0)
        return cls(empty, empty, empty, empty)

    def at(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Passages:
        """Return the chosen passages."""
        return Passages(
            self.on_s[chosen], self.off_s[chosen], self.speed_mps[chosen], self.length_m[chosen]
        )


@dataclass(frozen=True, eq=False)
class Period:
    """One interval of measurement. Two periods are on two days, or apart on one day.

    Attributes:
        id: Name.
        begin_s: Start on the scenario's clock.
        end_s: End on the scenario's clock.
        split: ``fit`` if models are fitted to this period, ``heldout`` if they are judged on it.
        signals: Traffic light to its log; the first entry is at or before `begin_s`.
        passages: Detector to its passages; detectors without passages are left out.
    """

    id: str
    begin_s: float
    end_s: float
    split: Split
    signals: Mapping[str, SignalLog]
    passages: Mapping[str, Passages]


def deciding_letter(states: Sequence[str]) -> str:
    """Return the letter that counts for a lane with several links: green, else yellow, else red."""
    return next((x for x in "GgYyur" if x in states), "r")
