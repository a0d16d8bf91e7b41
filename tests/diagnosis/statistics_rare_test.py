"""Days on which traffic stands still, single places that differ wildly, and rare events."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Reference, Tally
from ugat_marl.diagnosis.engine import locked_up
from ugat_marl.diagnosis.features import BIN_FEATURES, EVENT_FEATURES, FEATURES, INDEX
from ugat_marl.diagnosis.statistics import Pools, shrunk, softened
from ugat_marl.diagnosis.thresholds import Thresholds

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

NETWORK = Pools({"network": np.ones((1, 1))}, THRESHOLDS)


def days_of(values: Array, weight: float, feature: str) -> list[Tally]:
    """Days on which one feature of one lane has these means."""
    found: list[Tally] = []
    for value in values:
        sums = np.zeros((len(FEATURES), 1, 2))
        sums[INDEX[feature], 0] = value * weight, weight
        found.append(Tally(sums, np.zeros((len(BIN_FEATURES), 1, 1))))
    return found


def counted(counts: Array, occupied: float = 0.0) -> list[Tally]:
    """Days with so many vehicles in all, half at the one and half at the other kind of detector."""
    found: list[Tally] = []
    for count in counts:
        bins = np.zeros((len(BIN_FEATURES), 1, 2))
        bins[0, 0, 0] = bins[1, 0, 1] = count / 2
        bins[BIN_FEATURES.index("occupied")] = occupied * len(found)
        found.append(Tally(np.zeros((len(FEATURES), 1, 2)), bins))
    return found


def test_a_day_on_which_traffic_stood_still_is_set_aside() -> None:
    counts = 1000.0 + 30.0 * np.random.default_rng(40).standard_normal(60)
    assert locked_up(counted(counts), THRESHOLDS) == []
    counts[17] = 700.0
    assert locked_up(counted(counts), THRESHOLDS) == [17]
    counts[[3, 44]] = 600.0
    assert locked_up(counted(counts), THRESHOLDS) == [3, 17, 44]


def test_where_traffic_often_stands_still_that_is_part_of_the_model() -> None:
    counts = 1000.0 + 30.0 * np.random.default_rng(41).standard_normal(60)
    counts[:7] = 600.0  # more than one day in ten
    assert locked_up(counted(counts), THRESHOLDS) == []


def test_few_days_are_judged_by_what_is_usual() -> None:
    counts = np.array([1000.0, 1001.0, 1002.0, 1000.0, 1030.0, 999.0])
    assert locked_up(counted(counts), THRESHOLDS) == [4]
    assert locked_up(counted(counts), THRESHOLDS, usual=30.0) == []
    counts[2] = 600.0
    assert locked_up(counted(counts), THRESHOLDS, usual=30.0) == [2]
    counts[4] = 600.0
    assert locked_up(counted(counts), THRESHOLDS, usual=30.0) == [], "two of six are no exception"


def test_only_vehicles_tell_whether_traffic_stood_still() -> None:
    counts = 1000.0 + 30.0 * np.random.default_rng(42).standard_normal(60)
    assert locked_up(counted(counts, occupied=100.0), THRESHOLDS) == []
    assert locked_up(counted(counts[:1]), THRESHOLDS) == []


def test_large_differences_of_single_places_count_less() -> None:
    z = np.array([[0.0, 0.01, 4.0, 100.0]])
    assert softened("network", z, THRESHOLDS) is z
    assert softened("intersection", z, THRESHOLDS) is z
    assert softened("lane", z, THRESHOLDS) == pytest.approx(5.0 * np.arcsinh(z / 5.0))
    assert softened("time", z, THRESHOLDS) == pytest.approx(4.0 * np.arcsinh(z / 4.0))
    for name in ("lane", "time"):
        assert softened(name, -z, THRESHOLDS) == pytest.approx(-softened(name, z, THRESHOLDS))
        assert softened(name, z, THRESHOLDS)[0, 1] == pytest.approx(0.01, rel=1e-4)
        assert softened(name, z, THRESHOLDS)[0, 3] < 20.0


def test_derivatives_are_drawn_towards_0_by_what_may_be_chance() -> None:
    # Of 6 variances all may be chance, of 24 a quarter; what has no noise stays.
    values = np.array([[2.0, -2.0, 2.0, 2.0, 0.0]])
    noise = np.array([[4 / 6, 4 / 24, 0.0, np.inf, 0.0]])
    found = shrunk({"lane": values}, {"lane": noise}, THRESHOLDS)["lane"]
    assert found == pytest.approx(np.array([[0.0, -1.5, 2.0, 0.0, 0.0]]), abs=1e-12)


def test_of_nothing_but_chance_little_is_left_of_a_derivative() -> None:
    noise = np.random.default_rng(43).standard_normal((1, 5000))
    found = shrunk({"lane": noise}, {"lane": np.ones_like(noise)}, THRESHOLDS)["lane"]
    assert (found != 0).mean() < 0.03  # beyond the root of 6: 1.4 %
    assert (found**2).sum() < 0.02 * (noise**2).sum()


def test_a_rare_event_is_no_difference_of_many_standard_deviations() -> None:
    # Never in 60 days of 200 observations, then once: one event in a period is its own noise.
    weight, days = 200.0, 60

    def z(feature: str, periods: int) -> float:
        never = days_of(np.zeros(days), weight, feature)
        once = np.zeros(periods)
        once[0] = 1.0 / weight
        found = Reference(NETWORK, never).distance(days_of(once, weight, feature))
        return float(found.z["network"][0, INDEX[feature]])

    for feature in EVENT_FEATURES:
        assert z(feature, 1) == pytest.approx(1.0 / np.sqrt(1.0 + 1.0 / days))
        assert z(feature, 5) == pytest.approx(0.2 / np.sqrt(0.2 + 1.0 / days))
    assert "lost" not in EVENT_FEATURES
    assert z("lost", 1) > 3.0, "the check above would see a floor that is too low"


def test_an_event_that_became_common_is_found() -> None:
    never = days_of(np.zeros(60), 200.0, "red_crossings")
    often = days_of(np.full(5, 10.0 / 200.0), 200.0, "red_crossings")
    assert Reference(NETWORK, never).distance(often).z["network"].max() > 15.0
