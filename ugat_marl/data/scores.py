"""The measures of the paper, each defined once and used for every domain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import LaneTable
from ugat_marl.simulation import ApproachDelays, Snapshot, Trips


@dataclass(frozen=True)
class Scores:
    """Measures of one episode.

    Attributes:
        att_s: Average travel time in s over all vehicles due, from the scheduled departure to the
            arrival or the end of the episode.
        att_finished_s: Average travel time in s over the vehicles that arrived.
        throughput: Number of vehicles that arrived.
        reward: Mean over decisions and agents of the environment's reward. Evaluations use the
            reward total-queue, independent of the reward in training; where no queue is longer
            than the lanes at the lights, it is minus the queue.
        queue: Mean over decisions and intersections of the halting vehicles on incoming lanes.
        delay: Mean over decisions and incoming lanes of 1 - v / v_max (no unit; 0 for an empty
            lane), as in the tables of the UGAT paper.
        delay_s: Mean over vehicles due of time loss plus departure delay, in s.
        due: Number of vehicles scheduled to depart before the end.
        departed: Number of vehicles that entered the network.
        backlog: Number of vehicles due that never entered the network.
        hidden: Measures of a domain with an objective; see `ugat_marl.envs.OBJECTIVE_MEASURES`.
        approaches: Approach (SUMO's edge at a light) to the number of vehicles that passed and
            their mean control delay in s; empty if it was not measured.
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
    approaches: ApproachDelays = field(default_factory=dict[str, tuple[float, float]])


MEASURES: dict[str, str] = {
    "att_s": "ATT [s]",
    "throughput": "throughput [veh]",
    "reward": "reward",
    "queue": "queue [veh]",
    "delay": "delay [1 - v/vmax]",
    "delay_s": "delay [s]",
}
"""The five measures of the paper and the delay in seconds, each with its heading in tables."""


def relative_slowness(
    speed_mps: NDArray[np.float64], limit_mps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return 1 - v / v_max of each lane, clipped to [0, 1] because vehicles may exceed v_max."""
    return np.clip(1.0 - speed_mps / limit_mps, 0.0, 1.0)


@dataclass
class EpisodeRecorder:
    """Running sums over the decisions of an episode, from which it makes `Scores`.

    Args:
        lanes: The measured lanes.
        incoming: For each intersection, the indices of its incoming lanes in `lanes`.
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
