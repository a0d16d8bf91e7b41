"""Rewards: from the snapshots before and after a decision to one number per intersection."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Network
from ugat_marl.simulation import Snapshot

RewardName = Literal["total-queue", "queue", "pressure", "waiting"]


@dataclass(frozen=True)
class IntersectionView:
    """Part of a snapshot that belongs to one intersection, lanes in its own order.

    Functions that make observations get what effects on observations let through; functions that
    make rewards get what is measured.

    Attributes:
        time_s: Time on the scenario's clock, in s.
        vehicles: Number of vehicles per incoming lane.
        halting: Number of halting vehicles per incoming lane.
        mean_speed_mps: Mean speed per incoming lane, in m/s.
        waiting_s: Summed waiting time per incoming lane, in s.
        outgoing_vehicles: Number of vehicles per outgoing lane.
        queued_upstream: Number of vehicles that queue for each incoming lane upstream of it or
            outside the network.
    """

    time_s: float
    vehicles: NDArray[np.float64]
    halting: NDArray[np.float64]
    mean_speed_mps: NDArray[np.float64]
    waiting_s: NDArray[np.float64]
    outgoing_vehicles: NDArray[np.float64]
    queued_upstream: NDArray[np.float64]


RewardFunction = Callable[[IntersectionView, IntersectionView], float]
"""Function from the views before and after a decision interval to a reward."""


class IntersectionViews:
    """Division of snapshots into the views of all intersections, in the network's order.

    Args:
        network: The network.

    Attributes:
        lanes: Positions of the incoming and of the outgoing lanes of each intersection.
    """

    def __init__(self, network: Network) -> None:
        lanes = network.lane_table()
        self.lanes = [
            (lanes.indices(item.incoming_lanes), lanes.indices(item.outgoing_lanes))
            for item in network.intersections
        ]

    def __call__(self, snapshot: Snapshot) -> list[IntersectionView]:
        """Return the views of a snapshot."""
        return [
            IntersectionView(
                snapshot.time_s,
                snapshot.vehicles[incoming],
                snapshot.halting[incoming],
                snapshot.mean_speed_mps[incoming],
                snapshot.waiting_s[incoming],
                snapshot.vehicles[outgoing],
                snapshot.queued_upstream[incoming],
            )
            for incoming, outgoing in self.lanes
        ]


class Rewarder:
    """Computes the rewards of all intersections at once.

    Args:
        network: The network.
        reward: Name of the reward, or a function of two `IntersectionView`. ``"queue"``: minus the
            number of halting vehicles on incoming lanes (UGAT paper). ``"total-queue"``: the same,
            minus the vehicles that halt upstream of these lanes, up to the light before, and those
            that wait to enter the network (`Snapshot.queued_upstream`). ``"queue"`` cannot fall
            below what the lanes hold, so that a policy may be paid for blocking an entry;
            ``"total-queue"`` can, and equals it where queues end on the lanes at the lights.
            ``"pressure"``: minus the absolute difference of the numbers of vehicles on incoming and
            outgoing lanes (Wei et al. 2019, PressLight). ``"waiting"``: decrease of the summed
            waiting time, in s.
    """

    def __init__(self, network: Network, reward: str | RewardFunction = "total-queue") -> None:
        if not callable(reward) and reward not in get_args(RewardName):
            raise UnknownNameError(
                "reward", str(reward), get_args(RewardName), "A function works as well."
            )
        self._reward = reward
        self._views = IntersectionViews(network)
        self._sum_in, self._sum_out = map(_Sums, zip(*self._views.lanes, strict=True))

    @property
    def needs_waiting(self) -> bool:
        """True if snapshots must hold waiting times."""
        return self._reward == "waiting" or callable(self._reward)

    @property
    def needs_upstream(self) -> bool:
        """True if snapshots must hold the vehicles that queue upstream of lanes."""
        return self._reward == "total-queue" or callable(self._reward)

    def rewards(self, before: Snapshot, after: Snapshot) -> list[float]:
        """Return the rewards of all intersections, in the network's order."""
        if self._reward == "queue":
            return (-self._sum_in(after.halting)).tolist()
        if self._reward == "total-queue":
            return (-self._sum_in(after.halting + after.queued_upstream)).tolist()
        if self._reward == "pressure":
            difference = self._sum_in(after.vehicles) - self._sum_out(after.vehicles)
            return (-np.abs(difference)).tolist()
        if self._reward == "waiting":
            return (self._sum_in(before.waiting_s) - self._sum_in(after.waiting_s)).tolist()
        assert callable(self._reward)
        views = zip(self._views(before), self._views(after), strict=True)
        return [_number(self._reward(then, now)) for then, now in views]


def _number(reward: Any) -> float:
    """Return the reward of a user's function; refuse what is not a finite number."""
    try:
        value = float(reward)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise OptionError(
            f"reward: the function returned {reward!r}; it must return one finite number"
        )
    return value


class _Sums:
    """Sums over groups of lanes; no group is empty."""

    def __init__(self, groups: Sequence[NDArray[np.int64]]) -> None:
        self._members = np.concatenate(groups)
        self._starts = np.cumsum([0, *map(len, groups[:-1])])

    def __call__(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.add.reduceat(values[self._members], self._starts)
