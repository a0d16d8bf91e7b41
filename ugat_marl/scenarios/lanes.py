"""The measured lanes of a network, in the order of every array about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Shares = tuple[tuple[tuple[str, float], ...], ...]
"""For each measured lane names of others, each with a share in (0, 1]."""


class UpstreamLanes(NamedTuple):
    """Lanes and roads counted with lanes shorter than an agent's sight (`junctions.behind_of`).

    Attributes:
        lanes: For each measured lane the lanes upstream of it, inside junctions and outside.
        roads: For each the roads on which it or those begin: vehicles due there that find no room
            to enter the network stand behind them.
    """

    lanes: Shares = ()
    roads: Shares = ()


NO_UPSTREAM_LANES = UpstreamLanes()
"""No lane is counted with another."""


@dataclass(frozen=True)
class LaneTable:
    """Measured lanes, in the order of every array of a `Snapshot`.

    Attributes:
        ids: Lane ids of SUMO, ``(lanes,)``.
        capacity: Vehicles that fit on the lane, ``(lanes,)``, float64.
        speed_mps: Speed limit, ``(lanes,)``, float64.
        behind: Lanes and roads counted with lanes that are too short.
    """

    ids: tuple[str, ...]
    capacity: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    behind: UpstreamLanes = NO_UPSTREAM_LANES

    def indices(self, lanes: Sequence[str]) -> NDArray[np.int64]:
        """Positions of `lanes` in the arrays, int64."""
        position = {lane: index for index, lane in enumerate(self.ids)}
        return np.array([position[lane] for lane in lanes], dtype=np.int64)
