"""Tails and tests of scipy.stats against closed forms and a count by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ugat_marl.diagnosis.locate import discoveries, two_sided
from ugat_marl.diagnosis.residual import log_normal_tail
from ugat_marl.diagnosis.verdict import combined


@pytest.mark.parametrize("z", [0.0, 0.3, -1.0, 2.5, -6.0, 40.0, 1e4])
def test_two_sided_tails_are_those_of_the_error_function(z: float) -> None:
    soft = 6.0 * math.asinh(abs(z) / 6.0)
    assert two_sided(z, 6.0) == pytest.approx(math.erfc(soft / math.sqrt(2)), rel=1e-12)


@pytest.mark.parametrize("value", [0.0, 0.5, 20.0, 148.0, 313.0, 1e5])
def test_log_normal_tails_are_those_of_the_error_function(value: float) -> None:
    mean, deviation = math.log(226.0), 0.2
    logarithm = math.log(max(value, 1e-9))
    expected = 0.5 * math.erfc((logarithm - mean) / (deviation * math.sqrt(2)))
    assert log_normal_tail(value, mean, deviation) == pytest.approx(expected, rel=1e-12, abs=1e-300)


@pytest.mark.parametrize("one", [1.0, 0.5, 0.03, 1e-9, 1e-100, 0.0])
@pytest.mark.parametrize("other", [1.0, 0.2, 1e-12])
def test_two_chances_as_a_whole_have_a_closed_form(one: float, other: float) -> None:
    product = max(one * other, 1e-300)
    assert combined(one, other) == pytest.approx(product * (1.0 - math.log(product)), rel=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_discoveries_are_those_of_a_count_by_hand(seed: int) -> None:
    generator = np.random.default_rng(seed)
    chances = np.sort(generator.random(40) ** generator.choice([1.0, 6.0], 40)).tolist()
    tested = 40 + int(generator.integers(0, 60))
    kept = 0
    for rank, p in enumerate(chances, start=1):
        if p <= 0.05 * rank / tested:
            kept = rank
    assert discoveries(chances, tested, 0.05) == kept


def test_where_nothing_is_tested_nothing_is_discovered() -> None:
    assert discoveries([], 0, 0.05) == 0
