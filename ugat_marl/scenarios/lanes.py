"""The measured lanes of a network. Their order is the order of all arrays about lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Shares = tuple[tuple[tuple[str, float], ...], ...]
"""For each measured lane: names of other lanes or roads, each with a share in (0, 1]."""


class UpstreamLanes(NamedTuple):
    """Lanes and roads counted with lanes shorter than the reach or a vehicle.

    See `junctions.behind_of`.

    Attributes:
        lanes: For each measured lane, the lanes upstream of it, inside and outside of junctions.
        roads: For each measured lane, the roads whose waiting vehicles count: those that are due
            on the road but find no space to enter the network.
    """

    lanes: Shares = ()
    roads: Shares = ()


Turns = tuple[tuple[str, str, tuple[int, ...]], ...]
"""Ways across the agents' lights: the road before, the road after, and the positions of the lanes
that lead from one to the other in the arrays about lanes."""


NO_UPSTREAM_LANES = UpstreamLanes()
"""No lane is counted with another."""


@dataclass(frozen=True)
class LaneTable:
    """Measured lanes, in the order of all arrays of a `Snapshot`.

    Attributes:
        ids: Lane ids of SUMO.
        storage_veh: Number of vehicles that fit on the lane, ``(lanes,)``, float64.
        speed_mps: Speed limit, ``(lanes,)``, float64.
        behind: Upstream lanes and roads counted with short lanes.
        turns: Ways across the agents' lights, for the queues of `Snapshot.queued_upstream`.
    """

    ids: tuple[str, ...]
    storage_veh: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    behind: UpstreamLanes = NO_UPSTREAM_LANES
    turns: Turns = ()

    def indices(self, lanes: Sequence[str]) -> NDArray[np.int64]:
        """Return the positions of `lanes` in the arrays, int64."""
        position = {lane: index for index, lane in enumerate(self.ids)}
        return np.array([position[lane] for lane in lanes], dtype=np.int64)
