"""Whether what is to be hidden does anything at all where it is hidden.

On some networks some effects change no detection: nobody has to weave, nobody has to yield. Then
nothing is hidden, and no diagnosis can name it.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from studies.blind.drawing import Drawn
from ugat_marl.effects import Effect
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Period, Scenario
from ugat_marl.seeding import derive_seed

LEAST = 20
"""Detections of a day that have to come, go or move by more than a tenth of a second."""


class Consequences:
    """Compares a day with an effect with the same day without it.

    Args:
        seed: Root of the seed of that day.
    """

    def __init__(self, seed: int) -> None:
        self._seed = derive_seed(seed, "blind", "consequences")
        self._plain: dict[tuple[str, str], Period] = {}

    def has(self, scenario: Scenario, drawn: Drawn, policy: str) -> bool:
        """Whether each of the effects changes what is measured; faults of detectors always do.

        A setting is judged as a whole: beside drivers who brake as usual an emergency braking is
        never seen, and V1 to V4 have one all the same.
        """
        alone = [(effect,) for effect in drawn.effects if not effect.on_detectors]
        for effects in [drawn.effects] if drawn.group == "setting" else alone:
            key = (scenario.hash, policy)
            plain = self._plain.get(key)
            if plain is None:
                plain = self._plain[key] = self._day(scenario, policy, ())
            if differing(plain, self._day(scenario, policy, effects)) < LEAST:
                return False
        return True

    def _day(self, scenario: Scenario, policy: str, effects: tuple[Effect, ...]) -> Period:
        day = record(scenario, effects, policy_factory(policy), periods=1, seed=self._seed)
        return day.periods[0]


def differing(one: Period, two: Period) -> int:
    """Detections of one period that the other does not have, both ways, to a tenth of a second."""
    return sum(((_seen(one) - _seen(two)) + (_seen(two) - _seen(one))).values())


def _seen(period: Period) -> Counter[tuple[str, float]]:
    return Counter(
        (name, time)
        for name, item in period.passages.items()
        for time in np.round(item.off_s[np.isfinite(item.off_s)], 1).tolist()
    )
