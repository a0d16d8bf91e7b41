"""Speeds and lengths that the detectors of a street do not measure."""

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
    """

    speeds: tuple[str, ...]
    lengths: tuple[str, ...]

    @classmethod
    def of(cls, periods: Sequence[Period]) -> Unmeasured:
        """Find the detectors without speeds or lengths in all measured periods."""
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
        return cls(tuple(sorted(seen - speeds)), tuple(sorted(seen - lengths)))

    def __bool__(self) -> bool:
        return bool(self.speeds or self.lengths)

    def kept_from(self, period: Period) -> Period:
        """Return a simulated period without the speeds and lengths that the street lacks."""
        if not self:
            return period
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


def _blank(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(values, np.nan)
