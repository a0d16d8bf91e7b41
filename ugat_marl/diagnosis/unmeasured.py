"""What detectors of the street do not tell, kept from those of the simulation, too.

A statistic that is worked out one way with speeds and another without them would differ between the
two although the vehicles do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Passages, Period


@dataclass(frozen=True)
class Unmeasured:
    """Detectors that saw vehicles, but never measured something of them.

    Attributes:
        speeds: Those without speeds, sorted.
        lengths: Those without lengths of vehicles, sorted.
    """

    speeds: tuple[str, ...]
    lengths: tuple[str, ...]

    @classmethod
    def of(cls, periods: Sequence[Period]) -> Unmeasured:
        """What no measured period tells."""
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
        """A simulated period as the detectors of the street would have told it."""
        if not self:
            return period
        passages = {
            name: Passages(
                item.on_s,
                item.off_s,
                _blank(item.speed_mps) if name in self.speeds else item.speed_mps,
                _blank(item.length_m) if name in self.lengths else item.length_m,
            )
            for name, item in period.passages.items()
        }
        return replace(period, passages=passages)


def _blank(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(values, np.nan)
