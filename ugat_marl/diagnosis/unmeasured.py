"""Values that a street does not measure; simulated days do without them too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import Tally
from ugat_marl.scenarios import Passages, Period


@dataclass(frozen=True, eq=False)
class Unmeasured:
    """Speeds and lengths of vehicles, times, and sums that the measured periods lack.

    Attributes:
        speeds: Ids of detectors that saw vehicles but never measured their speeds, sorted.
        lengths: Ids of detectors that saw vehicles but never measured their lengths, sorted.
        holes: Times in which nothing was recorded, begin and end in s; the same in all periods.
        summed: True for the sums that the data hold, ``(features, places, 1)``; None for all. Means
            over several places are then of the same places in both.
    """

    speeds: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()
    holes: tuple[tuple[float, float], ...] = ()
    summed: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls,
        periods: Sequence[Period],
        holes: Sequence[tuple[float, float]] = (),
        summed: NDArray[np.bool_] | None = None,
    ) -> Unmeasured:
        """Find the detectors without speeds or lengths in all measured periods.

        Args:
            periods: The periods.
            holes: Times in which nothing was recorded.
            summed: True for the sums that the data hold.
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
        return cls(
            speeds=tuple(sorted(seen - speeds)),
            lengths=tuple(sorted(seen - lengths)),
            holes=tuple(holes),
            summed=None if summed is None or summed.all() else summed,
        )

    @property
    def key(self) -> tuple[object, ...]:
        """Values that tell it from another one in a cache; empty if nothing is unmeasured."""
        sums = None if self.summed is None else (self.summed.shape, self.summed.tobytes())
        values = (self.speeds, self.lengths, self.holes, sums)
        return values if any(values) else ()

    def kept_from(self, period: Period) -> Period:
        """Return a simulated period without what the street lacks."""
        if not (self.speeds or self.lengths or self.holes):
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

    def summed_in(self, tally: Tally) -> Tally:
        """Return a simulated tally without the sums that the data lack."""
        if self.summed is None:
            return tally
        return replace(tally, sums=tally.sums[: len(self.summed)] * self.summed)


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
