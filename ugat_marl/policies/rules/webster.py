"""Webster's fixed-time plan, from vehicles counted during control."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Actions, Infos, Observations
from ugat_marl.policies.rules.approaches import (
    Approach,
    ControlledNetwork,
    least_decisions,
    permitted_phases,
)

LONGEST_CYCLE_S = 180.0
"""Longest cycle in seconds; near saturation the formula has no bound."""

MEMORY_S = 900.0
"""Age in seconds at which the weight of a count has fallen to 1/e."""

FULL = 0.9
"""Share of its capacity from which a lane counts as full."""

FIRST_PHASE_S = 20.0
"""Time of each phase in seconds before the first count."""


def webster_plan(
    ratios: Sequence[float],
    clearance_s: float,
    decision_interval_s: float,
    min_green_s: float = 0.0,
) -> list[int]:
    """Return the decisions of each phase: Webster's cycle, split by the critical flow ratios.

    The cycle is ``(1.5 L + 5) / (1 - Y)`` seconds, at most `LONGEST_CYCLE_S`. L is the sum of the
    clearances of all phases; the start-up loss and the use of yellow are assumed to cancel. Y is
    the sum of the ratios.

    Args:
        ratios: For each phase, the largest ratio of flow to saturation flow among its lanes.
        clearance_s: Seconds of yellow and all-red.
        decision_interval_s: Seconds of one decision. Each phase lasts at least one decision.
        min_green_s: Minimum green. Each phase lasts at least clearance and minimum green, which may
            make the cycle longer.

    Source:
        Webster, Traffic Signal Settings, Road Research Technical Paper 39, 1958.
    """
    lost_s, total = clearance_s * len(ratios), sum(ratios)
    cycle_s = LONGEST_CYCLE_S
    if total < 1:
        cycle_s = min((1.5 * lost_s + 5) / (1 - total), LONGEST_CYCLE_S)
    green_s = max(cycle_s - lost_s, 0.0)
    shares = [ratio / total if total > 0 else 1 / len(ratios) for ratio in ratios]
    wanted = [(clearance_s + share * green_s) / decision_interval_s for share in shares]
    least = least_decisions(clearance_s, min_green_s, decision_interval_s)
    decisions = [max(least, math.floor(part + 1e-9)) for part in wanted]
    left = max(round(cycle_s / decision_interval_s), len(ratios)) - sum(decisions)
    short = sorted(range(len(wanted)), key=lambda i: decisions[i] - wanted[i])
    for place in short[: max(left, 0)]:
        decisions[place] += 1
    return decisions


class Webster:
    """Cycle and splits by Webster (1958), computed anew before each cycle.

    Counts come from the running episode, so the rule follows the demand and works in any domain.
    The arrivals on a lane are the growth of its number of vehicles between two decisions with red,
    because no vehicle leaves then. A full lane cannot grow, so it keeps the flow counted before. A
    lane that never has red is not counted and needs no green of its own. If several phases of the
    cycle serve a lane, its flow is divided equally among them.

    Args:
        network: The controlled network.
        saturation_vph: Saturation flow of a lane, in vehicles per hour of green.
    """

    def __init__(self, network: ControlledNetwork, saturation_vph: float = 1800.0) -> None:
        self.env_options: Mapping[str, Any] = {"observation": "movements"}
        self.saturation_vph = saturation_vph
        self._network = network
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget all counts and start every cycle again."""
        self._counts = {a: _RedCounts(w) for a, w in self._network.approaches.items()}
        self._left: dict[str, list[int]] = {}

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the phase whose turn it is; if it is masked, the first allowed one."""
        wanted: Actions = {}
        for agent, approach in self._network.approaches.items():
            self._counts[agent].add(agent, observations[agent], self._network.decision_interval_s)
            if not self._left.get(agent):
                plan = self.plan(agent)
                self._left[agent] = [
                    phase for phase, n in zip(approach.cycle, plan, strict=True) for _ in range(n)
                ]
            wanted[agent] = self._left[agent].pop(0)
        return permitted_phases(wanted, infos, self._network.phases)

    def plan(self, agent: str) -> list[int]:
        """Return the decisions of each phase of an agent's cycle, from the counts so far."""
        network, approach = self._network, self._network.approaches[agent]
        flows = self._counts[agent].flows_per_s()
        if flows is None:
            return [network.planned_decisions(FIRST_PHASE_S)] * len(approach.cycle)
        served = approach.served[list(approach.cycle)]
        spread = flows / np.maximum(served.sum(axis=0), 1)
        ratios = (served * spread).max(axis=1) * 3600.0 / self.saturation_vph
        return webster_plan(
            [float(ratio) for ratio in ratios],
            network.clearance_s,
            network.decision_interval_s,
            network.min_green_s,
        )


class _RedCounts:
    """Arrivals on each lane while it has red; recent arrivals weigh more."""

    def __init__(self, approach: Approach) -> None:
        self._approach = approach
        self._arrived = np.zeros(len(approach.lanes))
        self._red_s = np.zeros(len(approach.lanes))
        self._before: NDArray[np.float64] | None = None
        self._shown = 0

    def add(self, agent: str, observation: NDArray[np.float32], interval_s: float) -> None:
        """Count the vehicles that arrived during one more decision interval."""
        seen = self._approach.traffic(agent, observation)
        if self._before is not None:
            served = self._approach.served
            red = ~(served[self._shown] | served[seen.shown])
            red &= self._before < FULL * self._approach.capacity
            kept = math.exp(-interval_s / MEMORY_S)
            self._arrived = kept * self._arrived + red * (seen.vehicles - self._before)
            self._red_s = kept * self._red_s + red * interval_s
        self._before, self._shown = seen.vehicles, seen.shown

    def flows_per_s(self) -> NDArray[np.float64] | None:
        """Return arrivals per second on each lane, ``(lanes,)``; None before the first red."""
        if not self._red_s.any():
            return None
        return np.maximum(self._arrived, 0.0) / np.maximum(self._red_s, 1e-9)
