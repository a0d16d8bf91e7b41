"""Speeds and lengths that detectors do not measure, and times without a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import (
    Passages,
    Period,
)


@dataclass(frozen=True)
class Unmeasured:
    """Detectors that saw vehicles but never measured their speeds or lengths.

    Attributes:
        speeds: Ids of detectors without speeds, sorted.
        lengths: Ids of detectors without lengths, sorted.
        holes: Times in which nothing was recorded, begin and end in s; the same in all periods.
    """

    speeds: tuple[str, ...]
    lengths: tuple[str, ...]
    holes: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, periods: Sequence[Period], holes: Sequence[tuple[float, float]] = ()) -> Unmeasured:
        """Find the detectors without speeds or lengths in all measured periods.

        Args:
            periods: The periods.
            holes: Times in which nothing was recorded.
        """
        seen: set[str] = set()
        speeds: set[str] = set()
        lengths: set[str] = set()
        for period in periods:
            for name, passages in period.passages.items():
                if len(passages):
                    seen.add(name)
                if np.isfinite(passages.speed_mps).any():
                    speeds.add(name)
                if np.isfinite(passages.length_m).any():
                    lengths.add(name)
        return cls(tuple(sorted(seen - speeds)), tuple(sorted(seen - lengths)), tuple(holes))

    def __bool__(self) -> bool:
        return bool(self.speeds or self.lengths or self.holes)

    def kept_from(self, period: Period) -> Period:
        """Return a simulated period without what the street lacks."""
        if not self:
            return period
        period = without_holes(period, self.holes)
        passages = {
            name: Passages(
                seen.on_s,
                seen.off_s,
                _blank(seen.speed_mps) if name in self.speeds else seen.speed_mps,
                _blank(seen.length_m) if name in self.lengths else seen.length_m,
            )
            for name, seen in period.passages.items()
        }
        return replace(period, passages=passages)


def without_holes(period: Period, holes: Sequence[tuple[float, float]]) -> Period:
    """Return a period without the passages that lie in times without a recording, or reach in."""
    if not holes:
        return period
    kept: dict[str, Passages] = {}
    for name, seen in period.passages.items():
        # A vehicle that stands on the detector at an end of the period has one event alone.
        on_s = np.where(np.isfinite(seen.on_s), seen.on_s, period.begin_s)
        off_s = np.where(np.isfinite(seen.off_s), seen.off_s, period.end_s)
        outside = np.all([(off_s <= begin) | (on_s >= end) for begin, end in holes], axis=0)
        kept[name] = seen.at(outside)
    return replace(period, passages=kept)


def _blank(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(values, np.nan)
