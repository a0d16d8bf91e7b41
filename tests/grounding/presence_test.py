"""Chances of sets of changes: closed forms, and what a draw without some of them is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from ugat_marl.grounding.presence import LEAST_SPREAD, Change, Presence, lanes_are_equal

ENDS = (np.zeros(2), np.full(2, -3.0), np.full(2, 5.0))
"""Nominal, lowest and highest values of two changes."""


def with_floor(covariance: np.ndarray) -> np.ndarray:
    """Return the covariance that `Presence.of` makes of one."""
    return covariance + np.eye(2) * (LEAST_SPREAD * 8.0) ** 2


def presence(mean: list[float], covariance: np.ndarray, evidence: float = 0.0) -> Presence:
    changes = [Change(0.3, evidence), Change(0.6)]
    return Presence.of(changes, np.array(mean), covariance, *ENDS)


@pytest.mark.parametrize("at", [0.0, 0.4, 1.0, 4.8])
@pytest.mark.parametrize("evidence", [0.0, 2.0])
def test_the_chance_is_that_of_a_prior_with_a_point_of_mass(at: float, evidence: float) -> None:
    """Of values that do not depend on each other, each has the chance of its own integral."""
    given = presence([at, 3.0], np.diag([0.25, 0.25]), evidence)
    spread = float(np.sqrt(with_floor(np.diag([0.25, 0.25]))[0, 0]))
    absent = 0.7 * norm.pdf(0.0, at, spread) * np.exp(evidence)
    present = 0.3 * quad(lambda x: norm.pdf(x, at, spread) / 8.0, -3.0, 5.0, points=[at])[0]
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
    assert lanes_are_equal(near, spread, 2.5, 0.5) > 0.3
    one_is_slow = near + np.eye(12)[3] * 3.0
    assert lanes_are_equal(one_is_slow, spread, 2.5, 0.5) < -5.0
