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
    """A detection zone on one lane, or on several lanes of one road.

    Attributes:
        id: Name.
        lane: SUMO id of the lane; of the first one of a zone on several lanes.
        position_m: Distance of the zone's upstream end from the lane's start.
        length_m: Length of the zone; 0 for a point.
        kind: ``advance`` upstream of a stop line, ``stop`` at the stop line, ``exit`` downstream of
            the intersection.
        speed_at: Point of the passage at which speeds are measured; None if it is not stated.
            Detectors of a simulation then measure when the rear leaves.
        clock: Clock that stamps the events; None if it is not stated, which counts as ``sumo``.
        beside: SUMO ids of the other lanes of the zone. The zone is on while a vehicle is on any
            of its lanes, so vehicles side by side are one event.
    """

    id: str
    lane: str
    position_m: float
    length_m: float
    kind: DetectorKind
    speed_at: SpeedPoint | None = None
    clock: DetectorClock | None = None
    beside: tuple[str, ...] = ()

    @property
    def lanes(self) -> tuple[str, ...]:
        """SUMO ids of all lanes of the zone."""
        return (self.lane, *self.beside)

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

    @classmethod
    def concatenated(cls, parts: Sequence[Passages]) -> Passages:
        """Return all passages of several parts, sorted by time."""
        rows = [[x.on_s, x.off_s, x.speed_mps, x.length_m] for x in parts]
        whole = cls(*np.concatenate(rows, axis=1))
        return whole.at(np.argsort(whole.seen_s, kind="stable"))

    @classmethod
    def together(cls, lanes: Sequence[Passages]) -> Passages:
        """Return the passages over a zone on several lanes, from those over each of its lanes.

        Vehicles that are on the zone at the same time are one passage: from the first front to the
        last rear, with their mean speed, and without a length. A vehicle that changes lanes over
        the zone may come or leave unseen: then ``on_s`` is not finite, or ``off_s`` is NaN, and it
        was there at its other time only. With an infinite ``off_s`` it stays.
        """
        if not any(len(lane) for lane in lanes):
            return cls.none()
        rows = np.concatenate([[x.on_s, x.off_s, x.speed_mps, x.length_m] for x in lanes], axis=1)
        begin = np.where(np.isfinite(rows[0]), rows[0], rows[1])
        end = np.where(np.isnan(rows[1]), begin, rows[1])
        order = np.argsort(begin, kind="stable")
        begin, end, rows = begin[order], end[order], rows[:, order]
        latest = np.maximum.accumulate(end)
        starts = np.append(0, 1 + np.flatnonzero(begin[1:] >= latest[:-1]))
        count = np.diff(np.append(starts, len(begin)))
        known = np.isfinite(rows[2])
        timed = np.add.reduceat(known.astype(np.float64), starts)
        speed = np.add.reduceat(np.where(known, rows[2], 0.0), starts)
        last = np.maximum.reduceat(end, starts)
        return cls(  # who comes or leaves unseen is alone, or inside of another's time
            np.where(count == 1, rows[0][starts], begin[starts]),
            np.where(count == 1, rows[1][starts], last),
            np.where(timed > 0, speed / np.maximum(timed, 1.0), np.nan),
            np.where(count == 1, rows[3][starts], np.nan),
        )

    @property
    def seen_s(self) -> NDArray[np.float64]:
        """Time of each passage, s: `on_s` where it is known, else `off_s`."""
        return np.where(np.isfinite(self.on_s), self.on_s, self.off_s)

    @property
    def counted_s(self) -> NDArray[np.float64]:
        """Times at which vehicles are counted, s: `seen_s` of those that have one."""
        times = self.seen_s
        return times[np.isfinite(times)]

    def spans(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return start and end of each passage, ``(passages,)``, without NaN.

        A missing start or end is replaced by the other one. But the passages without an end behind
        the last one that has an end stay for ever: no vehicle was seen to leave after them. A
        passage without any time lasts throughout.
        """
        begin = np.where(np.isnan(self.on_s), self.off_s, self.on_s)
        begin = np.where(np.isnan(begin), -np.inf, begin)
        end = np.where(np.isnan(self.off_s), begin, self.off_s)
        left = np.flatnonzero(~np.isnan(self.off_s))
        end[left[-1] + 1 if len(left) else 0 :] = np.inf
        return begin, end

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

    @property
    def window(self) -> tuple[float, float]:
        """Begin and end on the scenario's clock, s."""
        return self.begin_s, self.end_s

    @property
    def length_s(self) -> float:
        """Length, s."""
        return self.end_s - self.begin_s

    def of_detector(self, detector: str) -> Passages:
        """Return the passages over a detector; none if it saw no vehicle."""
        return self.passages.get(detector, Passages.none())


def deciding_letter(states: Sequence[str]) -> str:
    """Return the letter that counts for a lane with several links: green, else yellow, else red."""
    return next((x for x in "GgYyur" if x in states), "r")
