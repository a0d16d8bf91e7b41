"""Webster's fixed-time plan, from counts the signal makes itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Actions, Infos, Observations
from ugat_marl.policies.rules.streets import Approach, Streets, mask_of

LONGEST_CYCLE_S = 180.0
"""Cycles are cut here: near saturation the formula knows no bound."""

MEMORY_S = 900.0
"""Counts older than this weigh less than 1/e."""

FIRST_PHASE_S = 20.0
"""Time of each phase while nothing has been counted."""


def webster_plan(
    ratios: Sequence[float], clearance_s: float, decision_interval_s: float
) -> list[int]:
    """Decisions of each phase: Webster's cycle, split as the critical flow ratios are.

    The cycle is ``(1.5 L + 5) / (1 - Y)`` with L the clearances of all phases (start-up loss and
    the use of yellow taken to cancel) and Y the sum of the ratios, at most `LONGEST_CYCLE_S`.

    Args:
        ratios: Of each phase, the largest ratio of flow to saturation flow among its lanes.
        clearance_s: Yellow and all-red.
        decision_interval_s: Phases last whole decisions, at least one.

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
    decisions = [max(1, math.floor(part + 1e-9)) for part in wanted]
    left = max(round(cycle_s / decision_interval_s), len(ratios)) - sum(decisions)
    short = sorted(range(len(wanted)), key=lambda i: decisions[i] - wanted[i])
    for place in short[: max(left, 0)]:
        decisions[place] += 1
    return decisions


class Webster:
    """Cycle and splits by Webster (1958), counted anew before each cycle.

    Counts come from the observation as it goes, not from an episode before: so the rule needs no
    other traffic than that it controls, follows the demand, and works in any domain. What
    arrives on a lane is what its number of vehicles grows by between two decisions with red
    in between: nobody leaves. Lanes that never have red are not counted, and need no green of
    their own. A lane that several phases of the cycle serve spreads its flow over them.

    Args:
        streets: The network.
        saturation_vph: Vehicles an hour that a lane discharges in green.
    """

    def __init__(self, streets: Streets, saturation_vph: float = 1800.0) -> None:
        self.env_options: Mapping[str, Any] = {"observation": "movements"}
        self.saturation_vph = saturation_vph
        self._streets = streets
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forgets all counts and starts every cycle again."""
        self._counts = {a: _RedCounts(w) for a, w in self._streets.approaches.items()}
        self._plans: dict[str, list[int]] = {}
        self._left: dict[str, list[int]] = {}

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """The phase whose turn it is; where it is masked, the first allowed one."""
        actions: Actions = {}
        for agent, approach in self._streets.approaches.items():
            self._counts[agent].add(agent, observations[agent], self._streets.decision_interval_s)
            if not self._left.get(agent):
                plan = self.plan(agent)
                self._left[agent] = [
                    phase for phase, n in zip(approach.cycle, plan, strict=True) for _ in range(n)
                ]
            wanted = self._left[agent].pop(0)
            allowed = mask_of(infos, agent, len(approach.served))
            actions[agent] = wanted if allowed[wanted] else int(allowed.argmax())
        return actions

    def plan(self, agent: str) -> list[int]:
        """Decisions of each phase of an agent's cycle, by what has been counted so far."""
        streets, approach = self._streets, self._streets.approaches[agent]
        flows = self._counts[agent].flows_per_s()
        if flows is None:
            return [streets.decisions(FIRST_PHASE_S)] * len(approach.cycle)
        served = approach.served[list(approach.cycle)]
        spread = flows / np.maximum(served.sum(axis=0), 1)
        ratios = (served * spread).max(axis=1) * 3600.0 / self.saturation_vph
        return webster_plan(
            [float(ratio) for ratio in ratios], streets.clearance_s, streets.decision_interval_s
        )


class _RedCounts:
    """Arrivals on each lane while it has red, the recent ones weighing more."""

    def __init__(self, approach: Approach) -> None:
        self._approach = approach
        self._arrived = np.zeros(len(approach.lanes))
        self._red_s = np.zeros(len(approach.lanes))
        self._before: NDArray[np.float64] | None = None
        self._shown = 0

    def add(self, agent: str, observation: NDArray[np.float32], interval_s: float) -> None:
        """Takes in the vehicles after another decision interval."""
        seen = self._approach.traffic(agent, observation)
        if self._before is not None:
            served = self._approach.served
            red = ~(served[self._shown] | served[seen.shown])
            kept = math.exp(-interval_s / MEMORY_S)
            self._arrived = kept * self._arrived + red * (seen.vehicles - self._before)
            self._red_s = kept * self._red_s + red * interval_s
        self._before, self._shown = seen.vehicles, seen.shown

    def flows_per_s(self) -> NDArray[np.float64] | None:
        """Vehicles per second and lane, ``(lanes,)``; None before the first red."""
        if not self._red_s.any():
            return None
        return np.maximum(self._arrived, 0.0) / np.maximum(self._red_s, 1e-9)
