"""The measures of the paper, each defined once and used for every domain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import LaneTable
from ugat_marl.simulation import Snapshot, Trips


@dataclass(frozen=True)
class Scores:
    """Measures of one episode.

    Attributes:
        att_s: Average travel time in s over all vehicles due, from the scheduled departure to the
            arrival or the end of the episode.
        att_finished_s: The same over the vehicles that arrived.
        throughput: Vehicles that arrived.
        reward: Mean over decisions and agents of the reward the environment gave; evaluations are
            paid by queues, whatever a policy was trained for.
        queue: Mean over decisions and intersections of the halting vehicles on incoming lanes.
        delay: Mean over decisions and incoming lanes of 1 - v / v_max (unitless; 0 for an empty
            lane), as in the tables of the UGAT paper.
        delay_s: Mean over vehicles due of time loss plus departure delay, in s.
        due: Vehicles scheduled to depart before the end.
        departed: Vehicles that entered the network.
        backlog: Vehicles due at the end that never entered.
        hidden: Measures of a domain with an objective; see `ugat_marl.envs.OBJECTIVE_MEASURES`.
    """

    att_s: float
    att_finished_s: float
    throughput: float
    reward: float
    queue: float
    delay: float
    delay_s: float
    due: float
    departed: float
    backlog: float
    hidden: Mapping[str, float] = field(default_factory=dict[str, float])


MEASURES: dict[str, str] = {
    "att_s": "ATT [s]",
    "throughput": "throughput [veh]",
    "reward": "reward",
    "queue": "queue [veh]",
    "delay": "delay [1 - v/vmax]",
    "delay_s": "delay [s]",
}
"""The five measures of the paper and delay in seconds, with their headings."""
MORE_IS_BETTER = ("throughput", "reward")
"""Measures of which more is better."""


def relative_slowness(
    speed_mps: NDArray[np.float64], limit_mps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return 1 - v / v_max of each lane, clipped to [0, 1] (vehicles may speed a little)."""
    return np.minimum(np.maximum(1.0 - speed_mps / limit_mps, 0.0), 1.0)


@dataclass
class EpisodeRecorder:
    """Sums, decision by decision, from which `Scores` are made.

    Args:
        lanes: The measured lanes.
        incoming: For each intersection the positions of its incoming lanes.
    """

    lanes: LaneTable
    incoming: list[NDArray[np.int64]]

    def __post_init__(self) -> None:
        self._all = np.concatenate(self.incoming)
        self._limits = self.lanes.speed_mps[self._all]
        self._decisions = 0
        self._reward = self._queue = self._delay = 0.0

    def add(self, snapshot: Snapshot, mean_reward: float) -> None:
        """Record the state after one decision and the mean reward of the agents."""
        self._decisions += 1
        self._reward += mean_reward
        self._queue += float(snapshot.halting[self._all].sum()) / len(self.incoming)
        self._delay += float(
            relative_slowness(snapshot.mean_speed_mps[self._all], self._limits).mean()
        )

    def scores(self, trips: Trips) -> Scores:
        """Return the scores of the episode that ended with `trips`."""
        n = max(self._decisions, 1)
        return Scores(
            att_s=_mean(trips.travel_time_s),
            att_finished_s=_mean(trips.travel_time_s[trips.finished]),
            throughput=float(trips.finished.sum()),
            reward=self._reward / n,
            queue=self._queue / n,
            delay=self._delay / n,
            delay_s=_mean(trips.delay_s),
            due=float(trips.finished.size),
            departed=float(trips.entered.sum()),
            backlog=float((~trips.entered).sum()),
        )


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else float("nan")
