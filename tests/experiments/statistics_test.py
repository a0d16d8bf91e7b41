"""Student's intervals and paired tests, against printed tables and sums done by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ugat_marl.experiments import Interval, PairedTest, student_p


@pytest.mark.parametrize(
    ("degrees", "quantile"),
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (5, 2.571), (9, 2.262), (30, 2.042)],
)
def test_quantiles_are_those_of_the_printed_tables(degrees: int, quantile: float) -> None:
    values = np.arange(degrees + 1.0)
    half = quantile * values.std(ddof=1) / math.sqrt(degrees + 1)
    assert Interval.of(values).high - values.mean() == pytest.approx(half, rel=5e-4)
    assert student_p(quantile, degrees) == pytest.approx(0.05, abs=1e-4)


def test_p_values_are_symmetric_and_bounded() -> None:
    assert student_p(0.0, 4) == 1.0
    assert student_p(-2.0, 4) == student_p(2.0, 4)
    assert 0.0 <= student_p(1e9, 4) < 1e-9
    assert student_p(1.0, 1) == pytest.approx(0.5)  # Cauchy: P(|t| > 1) = 1/2


def test_an_interval_by_hand() -> None:
    found = Interval.of(np.array([1.0, 2.0, 3.0]))
    half = 4.3027 / math.sqrt(3)  # the standard deviation is 1
    assert (found.mean, found.low, found.high) == pytest.approx((2.0, 2 - half, 2 + half), abs=1e-3)
    assert math.isnan(Interval.of(np.array([5.0])).low)
    level = Interval.of(np.full(5, 107.71235))  # whose mean, summed up, is beside it
    assert level.low == level.mean == level.high


def test_a_paired_test_sees_what_an_unpaired_one_would_not() -> None:
    one, other = np.array([10.0, 50.0, 90.0]), np.array([11.0, 52.0, 91.0])
    test = PairedTest.of(one, other)
    assert test.difference.mean == pytest.approx(-4 / 3)
    # t = (4/3) / (0.57735 / sqrt 3) = 4; with two degrees of freedom p = 1 - 4 / sqrt(2 + 16)
    assert test.p == pytest.approx(1 - 4 / math.sqrt(18))
    assert (test.better, test.count) == (3, 3)


def test_equal_differences() -> None:
    same = np.array([3.0, 4.0])
    assert PairedTest.of(same, same).p == 1.0
    assert PairedTest.of(same - 1, same).p == 0.0


def test_a_value_that_is_missing_is_no_certainty() -> None:
    assert math.isnan(PairedTest.of(np.array([1.0, math.nan]), np.array([0.0, 0.0])).p)


def test_intervals_of_few_values_cover_the_mean_as_often_as_they_say() -> None:
    generator = np.random.default_rng(5)
    for count in (2, 5, 30):
        found = [Interval.of(generator.normal(3, 1, count)) for _ in range(1000)]
        hits = sum(own.low <= 3 <= own.high for own in found)
        assert 0.93 < hits / 1000 < 0.97, count
