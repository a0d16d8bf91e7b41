"""Rules that score every phase and take the best one: queues, pressure, waiting times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import WAITING_SCALE_S
from ugat_marl.policies.rules.approaches import (
    Approach,
    ControlledNetwork,
    EachLight,
    awaited_links,
    check_length,
)
from ugat_marl.scenarios import GREEN, Intersection


class _Scored(EachLight):
    """Take the phase of highest score and hold it for at least `hold_s`.

    After that time the rule chooses again at every decision. Of equal scores the phase already
    shown wins, then the phase of lower index.
    """

    env_options: Mapping[str, Any] = {"observation": "movements"}

    def __init__(
        self, network: ControlledNetwork, weights: Mapping[str, NDArray[np.float64]], hold_s: float
    ):
        super().__init__(network)
        self._weights = weights
        self._hold = network.decisions(hold_s)
        self._shown: dict[str, int] = {}
        self._age: dict[str, int] = {}

    def reset(self, seed: int) -> None:
        """Forget the phases shown and their ages."""
        self._shown, self._age = {}, {}

    def scores(self, agent: str, observation: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the score of every phase of an agent, ``(phases,)``.

        The unit is vehicles, or vehicle-seconds for waiting times.
        """
        weights = self._weights[agent]
        phases, features = weights.shape
        check_length(agent, observation, features + phases, self.env_options["observation"])
        return weights @ observation[:features]

    def _choose(
        self, agent: str, observation: NDArray[np.float32], allowed: NDArray[np.bool_]
    ) -> int:
        shown, age = self._shown.get(agent), self._age.get(agent, 0)
        if shown is not None and age < self._hold and allowed[shown]:
            self._age[agent] = age + 1
            return shown
        scores = np.where(allowed, self.scores(agent, observation), -np.inf)
        best = int(scores.argmax())
        if shown is not None and allowed[shown] and self._stays(scores[shown], scores[best]):
            best = shown
        self._age[agent] = age + 1 if best == shown else 1
        self._shown[agent] = best
        return best

    def _stays(self, shown: float, best: float) -> bool:
        """Return true if the shown phase goes on, given its score and the highest score."""
        return shown >= best


class LargestQueue(_Scored):
    """Serve the phase whose incoming lanes hold the most halting vehicles.

    A phase serves a lane when a link is green in it for which the lane waits; a lane counts once.

    Args:
        network: The controlled network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    def __init__(self, network: ControlledNetwork, hold_s: float = 20.0) -> None:
        self.hold_s = hold_s
        weights = {
            agent: _of_halting(approach, approach.served * approach.capacity)
            for agent, approach in network.approaches.items()
        }
        super().__init__(network, weights, hold_s)


class MaxPressure(_Scored):
    """Serve the phase of highest pressure (Varaiya 2013).

    The pressure of a phase is a sum over the incoming lanes that it serves. Each lane adds its
    vehicles minus the mean number of vehicles on the lanes that its green links lead to; links that
    every phase serves are left out. The mean replaces the turning shares, which a controller does
    not know. If every lane has one link, the pressure is the sum over links of upstream minus
    downstream vehicles.

    Args:
        network: The controlled network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    def __init__(self, network: ControlledNetwork, hold_s: float = 10.0) -> None:
        self.hold_s = hold_s
        weights = {
            agent: _pressure_weights(intersection, network.capacity)
            for agent, intersection in network.intersections.items()
        }
        super().__init__(network, weights, hold_s)


class MaxPressureLoss(MaxPressure):
    """Max pressure that counts the time lost by a switch (after Wang et al. 2022).

    In the next `hold_s` seconds the shown phase serves all the time, another phase only after the
    clearance. The rule switches if ``best * (1 - clearance / hold) > shown``. Pressures below 0
    count as 0, because a phase without traffic is not worth a switch.

    Args:
        network: The controlled network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions. Gain and loss of a
            switch are counted over this time, or over clearance and minimum green in whole
            decisions if that is longer.
    """

    def __init__(self, network: ControlledNetwork, hold_s: float = 10.0) -> None:
        super().__init__(network, hold_s)
        lasts_s = network.planned_decisions(hold_s) * network.decision_interval_s
        self.served_share = 1.0 - network.clearance_s / lasts_s

    def _stays(self, shown: float, best: float) -> bool:
        return max(shown, 0.0) >= self.served_share * max(best, 0.0)


class LongestWaiting(_Scored):
    """Serve the phase whose incoming lanes have waited longest.

    The score of a lane is a sum over its vehicles: the seconds since each vehicle last moved. Many
    short waits weigh as much as one long wait. The observation is cut at a mean of 100 s per
    storage place of the lane, where the score stops growing. So a lane may wait for ever if the
    phase shown keeps a score that no other one exceeds.

    Args:
        network: The controlled network.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    env_options: Mapping[str, Any] = {"observation": "waiting"}

    def __init__(self, network: ControlledNetwork, hold_s: float = 20.0) -> None:
        self.hold_s = hold_s
        weights = {
            agent: approach.served * approach.capacity * WAITING_SCALE_S
            for agent, approach in network.approaches.items()
        }
        super().__init__(network, weights, hold_s)


def _of_halting(approach: Approach, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights of halting vehicles, ``(phases, lanes)``, as those of `movements`.

    The shape is ``(phases, 2 * incoming + outgoing)``.
    """
    return np.pad(weights, ((0, 0), (0, len(approach.lanes) + approach.outgoing)))


def _pressure_weights(
    intersection: Intersection, capacity: Mapping[str, float]
) -> NDArray[np.float64]:
    """Return weights for vehicles upstream minus mean vehicles downstream.

    The shape is ``(phases, 2 * incoming + outgoing)``, as the features of `movements`.
    """
    incoming, outgoing = list(intersection.incoming_lanes), list(intersection.outgoing_lanes)
    weights = np.zeros((len(intersection.phases), 2 * len(incoming) + len(outgoing)))
    awaited = awaited_links(intersection)
    for row, phase in enumerate(intersection.phases):
        for lane in incoming:
            links = [link for link in awaited[lane] if phase[link.index] in GREEN]
            targets = sorted({link.to_lane for link in links})
            if targets:
                weights[row, len(incoming) + incoming.index(lane)] = capacity[lane]
            for target in targets:
                column = 2 * len(incoming) + outgoing.index(target)
                weights[row, column] -= capacity[target] / len(targets)
    return weights
