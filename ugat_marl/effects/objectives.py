"""Effects on the objective of controllers: the reward gap.

A domain with an objective has the same traffic and the same rewards. At the end of an episode, its
scores also have a cost and the measures in it. No training uses them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ugat_marl.effects.base import ControllerEffect, TextParameter
from ugat_marl.effects.controllers import Cost

OBJECTIVES: dict[str, dict[str, float]] = {
    "efficiency": {"queue": 1.0, "delay": 1.0},
    "emissions": {"queue": 0.5, "co2_g": 2.0},
    "fairness": {"queue": 0.5, "delay_gini": 2.0},
    "safety": {"queue": 0.5, "hard_brakings": 5.0, "collisions": 5.0},
    "person-delay": {"person_delay_s": 1.0},
}
"""Weights of measures, by name of the objective. Those of efficiency, emissions, fairness and
safety are from Sim2Signal (Al Rafi et al. 2026)."""

NORMS: dict[str, float] = {
    "queue": 10.0,
    "delay": 1.0,
    "co2_g": 300.0,
    "delay_gini": 0.5,
    "person_delay_s": 60.0,
    "hard_brakings": 10.0,
    "collisions": 1.0,
}
"""Value of each measure that counts as 1 in a cost: round numbers of the size of the measure in the
shipped scenarios."""


@dataclass(frozen=True)
class Objective(ControllerEffect):
    """Controllers are judged by efficiency, emissions, fairness, safety or person delay."""

    name: ClassVar[str] = "objective"
    texts: ClassVar[dict[str, TextParameter]] = {
        "wanted": TextParameter("objective", allowed=tuple(OBJECTIVES))
    }
    wanted: str

    def cost(self) -> Cost:
        """Return the cost function: sum over measures of weight * measure / norm."""
        return self._weighted_sum  # a method, so that an environment can be pickled

    def _weighted_sum(self, measures: Mapping[str, float]) -> float:
        weights = OBJECTIVES[self.wanted]
        return sum(weight * measures[name] / NORMS[name] for name, weight in weights.items())


JUDGING: tuple[type[ControllerEffect], ...] = (Objective,)
"""Effects on the objective of controllers."""
