"""Chances of sets of changes: closed forms, and what a draw without some of them is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from ugat_marl.grounding.posterior import ServicePrior
from ugat_marl.grounding.presence import LEAST_SPREAD, Presence, lanes_differ

ENDS = (np.zeros(2), np.full(2, -3.0), np.full(2, 5.0))
"""Nominal, lowest and highest values of two changes."""


def with_floor(covariance: np.ndarray) -> np.ndarray:
    """Return the covariance that `Presence.of` makes of one."""
    return covariance + np.eye(2) * (LEAST_SPREAD * 8.0) ** 2


def presence(mean: list[float], covariance: np.ndarray, chance: float = 0.3) -> Presence:
    log_odds = [math.log(chance / (1.0 - chance)), math.log(1.5)]
    return Presence.of(log_odds, np.array(mean), covariance, *ENDS)


@pytest.mark.parametrize("at", [0.0, 0.4, 1.0, 4.8])
@pytest.mark.parametrize("chance", [0.3, 0.05])
def test_the_chance_is_that_of_a_prior_with_a_point_of_mass(at: float, chance: float) -> None:
    """Of values that do not depend on each other, each has the chance of its own integral."""
    given = presence([at, 3.0], np.diag([0.25, 0.25]), chance)
    spread = float(np.sqrt(with_floor(np.diag([0.25, 0.25]))[0, 0]))
    absent = (1.0 - chance) * norm.pdf(0.0, at, spread)
    present = chance * quad(lambda x: norm.pdf(x, at, spread) / 8.0, -3.0, 5.0, points=[at])[0]
    assert given.chance_of(0) == pytest.approx(present / (present + absent), rel=1e-6)
    assert given.chance_of(1) > 0.999
    assert given.chances.sum() == pytest.approx(1.0)


def test_what_is_left_of_a_draw_follows_what_is_absent() -> None:
    """The mean and the variance of a normal distribution whose first value is known."""
    covariance = np.array([[0.5, 0.4], [0.4, 0.6]])
    mean = np.array([0.3, 4.0])
    given = presence(mean.tolist(), covariance)
    generator = np.random.default_rng(2)
    floor = with_floor(covariance)
    left: list[float] = []
    for values in generator.multivariate_normal(mean, floor, size=4000):
        drawn, out = given.drawn(values, generator)
        if out.tolist() == [0]:
            assert drawn[0] == 0.0
            left.append(drawn[1])
        elif out.size == 0:
            assert np.array_equal(drawn, values)
    ratio = floor[0, 1] / floor[0, 0]
    assert len(left) > 1000
    assert np.mean(left) == pytest.approx(4.0 - 0.3 * ratio, abs=0.06)
    assert np.var(left) == pytest.approx(floor[1, 1] - ratio * floor[0, 1], rel=0.1)


def test_a_value_that_explains_alone_leaves_the_other_out() -> None:
    """Two values that are known only as a sum: one of them is enough, both are dearer."""
    covariance = np.array([[1.0, -0.98], [-0.98, 1.0]])
    given = presence([0.4, 0.6], covariance)
    both = given.chances[[out.size == 0 for out in given.absent]].sum()
    assert both < 0.3
    assert given.chance_of(1) > given.chance_of(0)


def test_lanes_that_differ_are_seen() -> None:
    spread = np.full(12, 0.2)
    near = 0.2 * np.random.default_rng(1).standard_normal(12)
    assert lanes_differ(near, spread, 2.5) < -0.5
    one_is_slow = near + np.eye(12)[3] * 3.0
    assert lanes_differ(one_is_slow, spread, 2.5) > 5.0
    assert lanes_differ(np.zeros(1), np.full(1, 0.01), 2.5) == 0.0  # one alone is the mean


@pytest.mark.parametrize("ratio", [1e-9, 0.3, 1.0, 40.0])
def test_the_odds_of_unused_green_count_every_case(ratio: float) -> None:
    """The mean is above 0 or not, lanes differ or not: three of four cases have unused green."""
    prior = ServicePrior(chance=0.3, high_s=5.0, unequal=0.2)
    cases = {
        (mean, differ): (0.3 if mean else 0.7) * (0.2 * ratio if differ else 0.8)
        for mean in (True, False)
        for differ in (True, False)
    }
    none = cases.pop((False, False))
    odds = math.exp(prior.log_odds(math.log(ratio)))
    assert odds == pytest.approx(sum(cases.values()) / none)


def test_lanes_that_are_seen_to_be_equal_speak_for_no_unused_green() -> None:
    """Then what is left is the chance of a mean above 0, whatever the chance that lanes differ."""
    for unequal in (0.1, 0.5, 0.9):
        prior = ServicePrior(chance=0.35, high_s=3.0, unequal=unequal)
        assert prior.log_odds(-50.0) == pytest.approx(math.log(0.35 / 0.65))
