"""Measured data of a street, or of the same detectors in a simulation, as plain values."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars import selectors

from ugat_marl.scenarios import Detector, Period, Split

HELD_OUT_SHARE = 0.4
"""Share of the periods, the last ones, that is held out where the files do not say."""


@dataclass(frozen=True)
class Finding:
    """Gap in the data, or something that looks wrong in them.

    Attributes:
        text: What, where, and how much.
        rules_out: Names of effects that cannot be examined because of it.
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
        """Return the periods of one split."""
        return tuple(period for period in self.periods if period.split == split)

    @property
    def has_events(self) -> bool:
        """True if single vehicles were detected, and not only counted."""
        return any(period.passages for period in self.periods)

    @property
    def has_speeds(self) -> bool:
        """True if speeds of single vehicles were measured."""
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
    """Return the bytes of numbers, with one form of NaN and of zero."""
    return np.where(np.isnan(numbers), np.nan, numbers + 0.0).astype("<f8").tobytes()


def split_periods(count: int) -> tuple[Split, ...]:
    """Return the default split: the last 40 % are held out, of two periods or more at least one."""
    held = min(max(round(HELD_OUT_SHARE * count), 1), count - 1) if count > 1 else 0
    return ("fit",) * (count - held) + ("heldout",) * held
