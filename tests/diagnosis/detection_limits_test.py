"""Detection limits: which values are tried, and between which ones a limit lies."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from ugat_marl.diagnosis import Hypothesis
from ugat_marl.diagnosis.detection_limits import _bracket, _sides

HEADWAY = Hypothesis("headway", (), ("seconds",), ((1.3,), (1.8,)), (1.0,), 0.05)


def of_model(*members: Any) -> Any:
    return SimpleNamespace(model=SimpleNamespace(members=members))


@pytest.mark.parametrize(
    ("truth", "hidden", "shown"),
    [
        (1.33, 1.3, 1.4),  # halved three times: an eighth of the way from 1.0 to 1.8
        (1.01, 1.0, 1.1),
        (1.8, 1.7, 1.8),
        (2.5, 1.8, None),
    ],
)
def test_a_limit_lies_between_what_hides_and_what_shows(
    truth: float, hidden: float, shown: float | None
) -> None:
    found = _bracket(HEADWAY, 1.8, lambda _, value: value >= truth, 3)
    assert found == (pytest.approx(hidden), shown if shown is None else pytest.approx(shown))


def test_below_the_usual_value_smaller_ones_show() -> None:
    braking = Hypothesis("deceleration", (), ("mps2",), ((2.5,),), (4.5,), 0.2)
    assert _bracket(braking, 2.5, lambda _, value: value <= 3.1, 2) == (3.5, 3.0)


def test_neighbours_on_the_grid_of_an_effect_are_not_halved_further() -> None:
    late = Hypothesis("late_green", (("tls", "*"),), ("seconds",), ((0.4,),), (0.0,), 0.1, step=0.1)
    tried: list[float] = []

    def shows(_: Hypothesis, value: float) -> bool:
        tried.append(value)
        return value >= 0.15

    assert _bracket(late, 0.4, shows, 9) == (0.1, 0.2)
    assert tried == [0.4, 0.2, 0.1]


def test_each_effect_is_tried_on_the_sides_that_are_examined() -> None:
    speed = Hypothesis("desired_speed", (), ("factor",), ((0.8,),), (1.0,), 0.02, both=True)
    braking = Hypothesis(
        "emergency_deceleration", (), ("mps2",), ((3.0,), (5.0,), (1.0,)), (9.0,), extreme=((1.0,),)
    )
    spread = Hypothesis("speed_spread", (), ("deviation",), ((0.2,),), (0.05,), neutral=False)
    model = Hypothesis("driver_model", (("model", "IDM"),), (), ((),), None)
    every = (HEADWAY, speed, braking, spread, model)
    assert _sides(every, of_model()) == [
        (HEADWAY, 1.8), (speed, 0.8), (speed, 1.2), (braking, 3.0)
    ]  # fmt: skip
    named = cast(Any, (HEADWAY, (1.5,)))
    assert (HEADWAY, 1.8) not in _sides(every, of_model(named))
