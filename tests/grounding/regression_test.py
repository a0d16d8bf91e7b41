"""Regression of worlds on statistics, against what ordinary least squares gives."""

from __future__ import annotations

import numpy as np
import pytest

from ugat_marl.grounding.regression import (
    MOST_DEVIATIONS,
    NEAR,
    PENALTIES,
    Calibration,
    Design,
    kernel,
    left_out,
    ridge,
)


def test_the_constant_has_no_penalty() -> None:
    z = np.array([-1.0, 0.0, 1.0])
    x, y = np.column_stack([np.ones(3), z]), (5.0 + 2.0 * z)[:, None]
    for penalty in PENALTIES:
        expected = [5.0, 2.0 * 2.0 / (2.0 + penalty)]  # z'y / (z'z + penalty)
        assert ridge(x, y, penalty)[:, 0] == pytest.approx(expected)


def test_a_group_is_predicted_by_the_others() -> None:
    generator = np.random.default_rng(0)
    x = np.column_stack([np.ones(60), generator.standard_normal((60, 3))])
    y = x @ generator.standard_normal((4, 2)) + generator.standard_normal((60, 2))
    groups = np.repeat(np.arange(20), 3)
    predicted, penalty = left_out(x, y, groups)
    for part in range(10):
        own = groups % 10 == part
        assert predicted[own] == pytest.approx(x[own] @ ridge(x[~own], y[~own], penalty))


def test_statistics_are_cut_far_from_the_simulated_ones_and_unknown_ones_are_usual() -> None:
    design = Design.of(np.array([[1.0, 0.0], [3.0, 0.0]]))  # mean 2, deviation 1
    (far, unknown) = design.inputs(np.array([[9.0, 0.0], [np.nan, 0.0]]))
    assert far.tolist() == [1.0, MOST_DEVIATIONS, 0.0, MOST_DEVIATIONS**2, 0.0]
    assert unknown.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_the_covariance_of_answers_has_no_bias() -> None:
    generator = np.random.default_rng(0)
    found: list[float] = []
    for _ in range(500):
        values = generator.standard_normal((6, 2))
        answers = 1.0 + values @ np.array([[0.5, 0.0], [0.2, 0.8]])
        noisy = answers + 3.0 * generator.standard_normal((6, 2))
        found.append(float(np.diag(Calibration.of(values, noisy).covariance).mean()))
    assert np.mean(found) == pytest.approx(9.0, rel=0.1)


def test_only_the_nearest_worlds_have_a_weight_whatever_the_units() -> None:
    generator = np.random.default_rng(0)
    predicted, residual = generator.standard_normal((2, 200, 2))
    observed = np.zeros(2)
    weights = kernel(predicted, observed, residual)
    distance = (predicted / residual.std(0)) ** 2
    near = distance.sum(1) < np.quantile(distance.sum(1), NEAR)
    assert weights.sum() == pytest.approx(1.0)
    assert (weights[near] > 0).all() and not weights[~near].any()
    assert weights.argmax() == distance.sum(1).argmin()
    units = np.array([1.0, 1000.0])
    assert kernel(predicted * units, observed, residual * units) == pytest.approx(weights)
