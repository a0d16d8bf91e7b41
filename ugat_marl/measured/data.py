"""What was measured on the street, or by the same detectors in a simulation; plain values."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars import selectors

DetectorKind = Literal["advance", "stop", "exit"]
Split = Literal["fit", "heldout"]

SignalLog = tuple[tuple[float, str], ...]
"""What a traffic light showed: ``(since_s, state)`` at every change, in order of time."""

HELD_OUT_SHARE = 0.4
"""Share of the periods, the last ones, that is held out where the files do not say."""


@dataclass(frozen=True)
class Detector:
    """A detection zone on one lane.

    Attributes:
        id: Name.
        lane: SUMO id of the lane.
        position_m: Upstream end of the zone, from the lane's start.
        length_m: Length of the zone; 0 for a point.
        kind: ``advance`` upstream of a stop line, ``stop`` at it, ``exit`` behind the intersection.
    """

    id: str
    lane: str
    position_m: float
    length_m: float
    kind: DetectorKind


@dataclass(frozen=True, eq=False)
class Passages:
    """Vehicles over one detector in one period, in order of time; all arrays ``(passages,)``.

    Attributes:
        on_s: When the front reached the zone; NaN if that was before the period.
        off_s: When the rear left the zone; NaN if that was after the period.
        speed_mps: Speed, NaN where it was not measured.
        length_m: Length of the vehicle, NaN where it was not measured.
    """

    on_s: NDArray[np.float64]
    off_s: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    length_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.on_s)

    @classmethod
    def none(cls) -> Passages:
        """No vehicle."""
        empty = np.empty(0)
        return cls(empty, empty, empty, empty)

    def at(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Passages:
        """The chosen passages."""
        return Passages(
            self.on_s[chosen], self.off_s[chosen], self.speed_mps[chosen], self.length_m[chosen]
        )


@dataclass(frozen=True, eq=False)
class Period:
    """One stretch of measurement; two periods are two days, or two stretches of one.

    Attributes:
        id: Name.
        begin_s: Start on the scenario's clock.
        end_s: End on the scenario's clock.
        split: Whether models are fitted to it, or judged on it.
        signals: Traffic light to what it showed; the first entry is at or before `begin_s`.
        passages: Detector to its vehicles; a detector that reported nothing is left out.
    """

    id: str
    begin_s: float
    end_s: float
    split: Split
    signals: Mapping[str, SignalLog]
    passages: Mapping[str, Passages]


@dataclass(frozen=True)
class Finding:
    """Something the data lack, or that looks wrong in them.

    Attributes:
        text: What, where, and how much.
        rules_out: Hypotheses that cannot be told apart for it, by name of their effects.
    """

    text: str
    rules_out: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Measured:
    """All that was measured on one network.

    Attributes:
        detectors: Detection zones.
        periods: Stretches of measurement, in the order of ``periods.csv``.
        lanes: Per lane and second: ``period_id, time_s, lane_id, vehicles, halting,
            mean_speed_mps``; or None.
        trajectories: ``period_id, vehicle_id, time_s, lane_id, position_m, speed_mps``; or None.
        counts: ``period_id, begin_s, end_s, detector_id, count``; or None.
        findings: What the check of the files had to say.
    """

    detectors: tuple[Detector, ...]
    periods: tuple[Period, ...]
    lanes: pl.DataFrame | None = None
    trajectories: pl.DataFrame | None = None
    counts: pl.DataFrame | None = None
    findings: tuple[Finding, ...] = field(default=())

    def of(self, split: Split) -> tuple[Period, ...]:
        """The periods of one split."""
        return tuple(period for period in self.periods if period.split == split)

    @property
    def has_events(self) -> bool:
        """Whether single vehicles were detected, and not only counted."""
        return any(period.passages for period in self.periods)

    @property
    def has_speeds(self) -> bool:
        """Whether speeds of single vehicles were measured."""
        return any(
            bool(np.isfinite(passages.speed_mps).any())
            for period in self.periods
            for passages in period.passages.values()
        )

    @property
    def hash(self) -> str:
        """SHA-256 over all that was measured, as 64 hex digits.

        Times count to the millisecond, as the files hold them, so that what was written and read
        again has the hash that it had.
        """
        digest = hashlib.sha256()
        for item in self.detectors:
            zone = (item.id, item.lane, float(item.position_m), float(item.length_m), item.kind)
            digest.update(repr(zone).encode())
        for period in self.periods:
            head = (period.id, float(period.begin_s), float(period.end_s), period.split)
            digest.update(repr(head).encode())
            for tls, log in sorted(period.signals.items()):
                shown = [(round(float(since), 3) + 0.0, state) for since, state in log]
                digest.update(repr((tls, shown)).encode())
            for name, passages in sorted(period.passages.items()):
                if len(passages):
                    digest.update(f"{name} {len(passages)}".encode())
                    for times in (passages.on_s, passages.off_s):
                        digest.update(_canonical(np.round(times, 3)))
                    digest.update(_canonical(passages.speed_mps) + _canonical(passages.length_m))
        for frame in (self.lanes, self.trajectories, self.counts):
            if frame is not None:
                numbers = selectors.numeric().cast(pl.Float64)
                table = frame.select(sorted(frame.columns)).with_columns(numbers)
                digest.update(
                    table.with_columns(selectors.float().fill_nan(None)).write_csv().encode()
                )
        return digest.hexdigest()


def _canonical(numbers: NDArray[np.float64]) -> bytes:
    """The bytes of numbers, with one way to write NaN and one to write zero."""
    return np.where(np.isnan(numbers), np.nan, numbers + 0.0).astype("<f8").tobytes()


def split_periods(count: int) -> tuple[Split, ...]:
    """The default split: the last 40 % are held out, and with two periods or more at least one."""
    held = min(max(round(HELD_OUT_SHARE * count), 1), count - 1) if count > 1 else 0
    return ("fit",) * (count - held) + ("heldout",) * held


def letter(states: Sequence[str]) -> str:
    """The letter that decides what vehicles on several links do: green before yellow before red."""
    return next((x for x in "GgYyur" if x in states), "r")
