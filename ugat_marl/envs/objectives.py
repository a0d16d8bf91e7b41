"""Hidden objectives: emissions, fairness, safety and persons. No training uses them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Scores
from ugat_marl.effects import Cost, Effect, is_heavy
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import Trips

OBJECTIVE_MEASURES: dict[str, str] = {
    "cost": "cost",
    "co2_g": "CO2 [g/veh]",
    "delay_gini": "Gini of delay",
    "delay_p95_s": "95 % delay [s]",
    "person_delay_s": "person delay [s]",
    "hard_brakings": "hard brakings [1/1000 veh]",
    "collisions": "collisions [1/1000 veh]",
}
"""Measures and their headings, of domains with an objective, beside `ugat_marl.data.MEASURES`."""

PERSONS: dict[str, float] = {
    "bus": 25.0,
    "coach": 30.0,
    "tram": 60.0,
    "truck": 1.0,
    "trailer": 1.0,
    "delivery": 1.0,
    "motorcycle": 1.0,
    "moped": 1.0,
    "bicycle": 1.0,
}
"""Number of persons assumed in a vehicle of each class."""

PERSONS_IN_A_CAR = 1.5
"""Number of persons assumed in any other vehicle."""


class Objectives:
    """Measures of an episode that are hidden from training, and their cost.

    Args:
        cost: Function from measures to their cost.
        scenario: Scenario whose vehicle types decide the numbers of persons.

    Attributes:
        persons: Vehicle type to the number of persons in a vehicle; "" for all other types.
    """

    def __init__(self, cost: Cost, scenario: Scenario) -> None:
        self._cost = cost
        self.persons: dict[str, float] = {"": PERSONS_IN_A_CAR}
        self.persons["DEFAULT_BIKETYPE"] = PERSONS["bicycle"]  # a type that no file declares
        for document in (*scenario.additional, *scenario.routes):
            for tag in document.scan():
                if tag.name == "vType":
                    name, kind = (tag.attributes.get(key, "") for key in ("id", "vClass"))
                    kind = "truck" if is_heavy(tag.attributes) else kind  # they drive as cars may
                    self.persons[name] = PERSONS.get(kind, PERSONS_IN_A_CAR)

    @classmethod
    def of(cls, effects: Sequence[Effect], scenario: Scenario) -> Objectives | None:
        """Return the objectives of a scenario with these effects; None if nothing is hidden."""
        for effect in effects:
            if (cost := effect.cost()) is not None:
                return cls(cost, scenario)
        return None

    def judged(self, scores: Scores, trips: Trips) -> Scores:
        """Return the scores with the hidden measures and their cost.

        Args:
            scores: Scores of an episode.
            trips: Trips of its vehicles, with emissions and persons.
        """
        hidden = hidden_measures(trips)
        cost = self._cost({"queue": scores.queue, "delay": scores.delay, **hidden})
        return replace(scores, hidden={"cost": cost, **hidden})


def hidden_measures(trips: Trips) -> dict[str, float]:
    """Return the measures of `OBJECTIVE_MEASURES`, without the cost.

    - CO2: mean emission in g per vehicle that entered, until it arrived or the episode ended
      (SUMO's emission model HBEFA, by the emission class of the vehicle's type).
    - Gini coefficient and 95 % quantile: over the delays of all vehicles due.
    - Person delay: mean delay, weighted with the persons in each vehicle.
    - Hard brakings and collisions: counted by SUMO, per 1000 vehicles that entered.
    """
    entered = max(int(trips.entered.sum()), 1)
    persons, delays = trips.persons, trips.delay_s
    collisions, brakings = (1000.0 * count / entered for count in trips.dangers.tolist())
    return {
        "co2_g": _sum(trips.co2_g) / entered,
        "delay_gini": gini(delays),
        "delay_p95_s": float(np.quantile(delays, 0.95)) if delays.size else math.nan,
        "person_delay_s": _sum(persons * delays) / _sum(persons) if delays.size else math.nan,
        "hard_brakings": brakings,
        "collisions": collisions,
    }


def gini(values: NDArray[np.float64]) -> float:
    """Return the Gini coefficient of values >= 0: 0 if all are equal, near 1 if one has it all.

    sum_i (2 i - n - 1) x_i / (n sum_i x_i),    x sorted, i = 1, ..., n
    """
    total = _sum(values)
    if total <= 0:
        return 0.0
    ranks = np.arange(1, values.size + 1)
    return _sum((2 * ranks - values.size - 1) * np.sort(values)) / (values.size * total)


def _sum(values: NDArray[np.float64]) -> float:
    """Return the exact sum; numpy's sum depends on the memory layout."""
    return math.fsum(values.tolist())
