"""Days that are drawn from a demand: equal for a seed, and varied from day to day on request."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Scenario, draw_day


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


def departures(scenario: Scenario) -> np.ndarray:
    text = b"".join(document.read() for document in scenario.routes)
    return np.array([float(time) for time in re.findall(rb' depart="([\d.]+)"', text)])


def test_vehicles_that_depart_before_the_begin_are_in_no_day() -> None:
    whole = load_scenario("single-v1")
    settings = whole.settings.model_copy(update={"begin_s": 1800.0, "duration_s": 1800.0})
    scenario = replace(whole, settings=settings)
    depart = departures(scenario)
    expected = np.count_nonzero(depart >= 1800)
    assert 100 < expected < len(depart) - 100
    days = [departures(draw_day(scenario, seed)) for seed in range(16)]
    assert min(day.min() for day in days) >= 1800
    mean = np.mean([np.count_nonzero(day < 3600) for day in days])
    assert abs(mean - expected) < 3 * (expected / len(days)) ** 0.5  # Poisson
