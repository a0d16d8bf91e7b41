"""Days that are drawn from a demand: equal for a seed, and varied from day to day on request."""

from __future__ import annotations

import numpy as np
import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import draw_day


def vehicles(share: float, seed: int) -> int:
    day = draw_day(load_scenario("single-v1").with_duration(600), seed, share)
    return day.routes[0].read().count(b"<vehicle ")


def test_a_day_without_variation_is_the_day_it_was() -> None:
    scenario = load_scenario("single-v1").with_duration(600)
    assert draw_day(scenario, 3).routes[0].read() == draw_day(scenario, 3, 0.0).routes[0].read()


def test_days_vary_by_the_share_that_is_asked_for() -> None:
    steady = np.array([vehicles(0.0, seed) for seed in range(40)], np.float64)
    varied = np.array([vehicles(0.2, seed) for seed in range(40)], np.float64)
    mean = steady.mean()
    assert steady.var() == pytest.approx(mean, rel=0.7)
    # the standard error of a standard deviation of 40 days is 11 %
    assert (varied.var() - mean) ** 0.5 / mean == pytest.approx(0.2, rel=0.35)
    assert varied.mean() == pytest.approx(mean, rel=0.1)
