"""Chances of sets of changes: closed forms, and what a draw without some of them is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from ugat_marl.grounding.posterior import ServicePrior
from ugat_marl.grounding.presence import LEAST_SPREAD, SPREADS_TRIED, Presence, lanes_differ
from ugat_marl.grounding.regression import Calibration

ENDS = (np.zeros(2), np.full(2, -3.0), np.full(2, 5.0))
"""Nominal, lowest and highest values of two changes."""


MIDDLE, VARIANCE = 1.0, 8.0**2 / 12


def presence(answer: list[float], slopes: np.ndarray, errors: np.ndarray) -> Presence:
    """Changes that are there with chances of 0.3 and 0.6."""
    log_odds = [math.log(0.3 / 0.7), math.log(1.5)]
    calibration = Calibration(np.array([0.5, -0.2]), slopes, errors)
    return Presence.of(log_odds, calibration, np.array(answer), *ENDS)


FLOOR = (LEAST_SPREAD * 8.0) ** 2
"""Variance that `Presence.of` adds."""


@pytest.mark.parametrize("at", [0.0, 0.4, 1.0, 4.8])
def test_the_chance_is_that_of_a_prior_with_a_point_of_mass(at: float) -> None:
    """Of values that do not depend on each other, each has the chance of its own integral."""
    slope, variance = 0.6, 0.04
    given = presence([0.5 + slope * at, 1.6], slope * np.eye(2), variance * np.eye(2))
    spread = math.sqrt(variance + FLOOR)
    absent = 0.7 * norm.pdf(slope * at, 0.0, spread)
    prior = norm(MIDDLE, math.sqrt(VARIANCE))
    present = (
        0.3
        * quad(
            lambda x: prior.pdf(x) * norm.pdf(slope * at, slope * x, spread), -9, 11, points=[at]
        )[0]
    )
    assert given.chance_of(0) == pytest.approx(present / (present + absent), rel=1e-6)
    assert given.chance_of(1) > 0.999  # its answer is that of 3
    assert given.chances.sum() == pytest.approx(1.0)


def test_draws_have_the_mean_and_the_variance_of_a_normal_distribution() -> None:
    slopes = np.array([[0.7, 0.3], [-0.2, 0.5]])
    errors = np.array([[0.5, 0.4], [0.4, 0.6]])
    answer = np.array([1.0, 2.0])
    given = presence(answer.tolist(), slopes, errors)
    errors = errors + FLOOR * np.eye(2)
    generator = np.random.default_rng(2)
    drawn = np.array([given.drawn(generator, 1.0)[0] for _ in range(6000)])
    precision = slopes @ np.linalg.inv(errors) @ slopes.T + np.eye(2) / VARIANCE
    covariance = np.linalg.inv(precision)
    off = np.linalg.inv(errors) @ (answer - [0.5, -0.2])
    mean = covariance @ (slopes @ off + MIDDLE / VARIANCE)
    assert drawn.mean(0) == pytest.approx(mean, abs=0.06)
    assert np.cov(drawn.T) == pytest.approx(covariance, rel=0.1, abs=0.02)
    found = [given.drawn(generator) for _ in range(2000)]
    absent = np.array([~there for _, there in found])
    assert absent.mean(0) == pytest.approx([1 - given.chance_of(k) for k in (0, 1)], abs=0.04)
    assert all(not values[~there].any() for values, there in found)
    # With the first value known, the second follows from the answer alone.
    only = np.array([values[1] for values, there in found if there.tolist() == [False, True]])
    row = slopes[1]
    variance = 1.0 / (row @ np.linalg.inv(errors) @ row + 1.0 / VARIANCE)
    assert len(only) > 200
    assert only.mean() == pytest.approx(variance * (row @ off + MIDDLE / VARIANCE), abs=0.15)
    assert only.var() == pytest.approx(variance, rel=0.25)


def test_a_regression_that_says_nothing_leaves_the_prior() -> None:
    given = presence([0.5, -0.2], np.zeros((2, 2)), np.eye(2))
    assert [given.chance_of(0), given.chance_of(1)] == pytest.approx([0.3, 0.6])


def test_a_value_that_explains_alone_leaves_the_other_out() -> None:
    """Two values that are known only as a sum: one of them is enough, both are dearer."""
    given = presence([1.5, 0.8], np.full((2, 2), 0.5), 0.01 * np.eye(2))
    assert given.chances[given.there.all(1)].sum() < 0.35
    assert given.chance_of(1) > given.chance_of(0)


def test_lanes_that_differ_are_seen() -> None:
    spread = np.full(12, 0.2)
    near = 0.2 * np.random.default_rng(1).standard_normal(12)
    assert lanes_differ(near, spread, 2.5) < -0.5
    one_is_slow = near + np.eye(12)[3] * 3.0
    assert lanes_differ(one_is_slow, spread, 2.5) > 5.0
    assert lanes_differ(np.zeros(1), np.full(1, 0.01), 2.5) == 0.0  # one alone is the mean


@pytest.mark.parametrize("lanes", [2, 3, 8])
def test_lanes_differ_by_the_density_of_their_distances(lanes: int) -> None:
    """The distances of all lanes but one have a normal distribution, and the last adds none."""
    error, most = 0.5, 2.5
    drawn = np.random.default_rng(lanes).normal(0.0, 1.0, lanes)
    offsets = drawn - drawn.mean()

    def density(tried: float) -> float:
        """Return the density for independent lanes and errors, less their mean."""
        centred = (np.eye(lanes) - 1.0 / lanes)[1:, 1:]
        covariance = (error**2 + tried**2) * centred
        return multivariate_normal(np.zeros(lanes - 1), covariance).pdf(offsets[1:])

    exact = np.mean([density(tried) for tried in np.linspace(0.0, most, SPREADS_TRIED)])
    spread = np.full(lanes, error * math.sqrt(1.0 - 1.0 / lanes))
    found = lanes_differ(offsets, spread, most)
    assert found == pytest.approx(math.log(exact / density(0.0)), abs=1e-9)


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
