"""Effects on what controllers are judged by: the reward gap.

A domain with an objective has the same traffic and the same rewards; at the end of an episode its
scores hold what the objective is made of, which no training ever sees
(`ugat_marl.envs.objectives`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ugat_marl.effects.base import ControllerEffect, Text

OBJECTIVES: dict[str, dict[str, float]] = {
    "efficiency": {"queue": 1.0, "delay": 1.0},
    "emissions": {"queue": 0.5, "co2_g": 2.0},
    "fairness": {"queue": 0.5, "delay_gini": 2.0},
    "safety": {"queue": 0.5, "hard_brakings": 5.0, "collisions": 5.0},
    "person-delay": {"person_delay_s": 1.0},
}
"""Objectives: the weights of measures, each divided by its
`ugat_marl.envs.objectives.NORMS`; their sum is the cost. The weights of queue, emissions, fairness
and safety are those of Sim2Signal."""


@dataclass(frozen=True)
class Objective(ControllerEffect):
    """What the street's owner wants: emissions, fairness, safety or person delay are measured."""

    name: ClassVar[str] = "objective"
    texts: ClassVar[dict[str, Text]] = {"wanted": Text("objective", allowed=tuple(OBJECTIVES))}
    wanted: str


JUDGING: tuple[type[ControllerEffect], ...] = (Objective,)
"""All of them."""
