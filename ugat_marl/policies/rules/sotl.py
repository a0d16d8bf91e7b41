"""Self-organising traffic lights: red lanes collect impatience until it switches the signal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.policies.rules.approaches import ControlledNetwork, EachLight


class SelfOrganising(EachLight):
    """SOTL (Gershenson 2005; Cools, Gershenson and D'Hooghe 2007), for any number of phases.

    Each lane keeps a sum. At every decision with red the lane adds its vehicles times the decision
    interval; green sets the sum to 0. When a green has lasted `hold_s` and the sums of another
    phase's lanes reach `threshold` together, the phase with the largest total is next.

    One rule of the original is left out: not to cut a short platoon close to the stop line. It
    needs positions of vehicles, and the observation only gives counts per lane.

    Args:
        network: The controlled network.
        threshold: Vehicle-seconds on the red lanes of a phase that give it green.
        hold_s: Shortest time a phase is kept, rounded up to whole decisions.
    """

    def __init__(
        self, network: ControlledNetwork, threshold: float = 600.0, hold_s: float = 10.0
    ) -> None:
        self.env_options: Mapping[str, Any] = {"observation": "movements"}
        self.threshold, self.hold_s = threshold, hold_s
        super().__init__(network)
        self._approaches = network.approaches
        self._interval_s = network.decision_interval_s
        self._hold = network.decisions(hold_s)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Empty all sums."""
        self._shown: dict[str, int] = {}
        self._age: dict[str, int] = {}
        self._sums = {agent: np.zeros(len(a.lanes)) for agent, a in self._approaches.items()}

    def _choose(
        self, agent: str, observation: NDArray[np.float32], allowed: NDArray[np.bool_]
    ) -> int:
        approach = self._approaches[agent]
        seen = approach.traffic(agent, observation)
        shown, age = self._shown.get(agent, seen.shown), self._age.get(agent, self._hold)
        green = approach.served[shown]
        sums = np.where(green, 0.0, self._sums[agent] + seen.vehicles * self._interval_s)
        self._sums[agent] = sums
        totals = np.where(allowed, approach.served @ sums, -1.0)
        best = int(totals.argmax())
        if not allowed[shown]:
            chosen = best
        else:
            switches = age >= self._hold and totals[best] >= self.threshold
            chosen = best if switches else shown
        self._age[agent] = age + 1 if chosen == shown else 1
        self._shown[agent] = chosen
        return chosen
