"""Regression of the values of simulated worlds on their statistics, and how it answers.

Approximate Bayesian computation on summaries that are themselves regressions (Fearnhead and Prangle
2012):

    g      = ridge regression of the values on the statistics of simulated worlds
    g(s)   = a + x B + e, fitted to worlds of known values x that were left out of g

A regression answers too near to the values that it learned from, the more so the less the
statistics say. The second line measures by how much, and how far its errors go together: what one
effect explains, another one need not.

Lanes, of which there are many, are drawn with linear regression adjustment (Beaumont, Zhang and
Balding 2002): the residual of one world is added to the answer, with a chance that falls with the
distance of that world's answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PENALTIES = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Ridge penalties among which leave-one-out errors choose."""
FOLDS = 10
"""Number of parts of which each is left out once."""
NEAR = 0.3
"""Share of the simulated worlds that the kernel takes into account. Halved, draws follow the
regression's local errors more closely, from fewer of them."""
MOST_DEVIATIONS = 4.0
"""Standard deviations at which a statistic is cut. By hand: a square of more would extrapolate far
beyond the simulated worlds. Halved, real differences are cut as well."""


@dataclass(frozen=True)
class Design:
    """Standardised statistics with their squares; NaN becomes the mean.

    Attributes:
        mean: Mean of each statistic, ``(k,)``.
        spread: Standard deviation of each, ``(k,)``.
    """

    mean: Floats
    spread: Floats

    @classmethod
    def of(cls, statistics: Floats) -> Design:
        """Return the design of simulated statistics, ``(n, k)``."""
        known = ~np.isnan(statistics).all(0)
        mean, spread = np.zeros(statistics.shape[1]), np.ones(statistics.shape[1])
        mean[known] = np.nanmean(statistics[:, known], 0)
        spread[known] = np.nanstd(statistics[:, known], 0)
        return cls(mean, np.where(spread > 1e-9, spread, 1.0))

    def inputs(self, statistics: Floats) -> Floats:
        """Return the inputs of the regression, ``(n, 1 + 2 k)``; the first one is 1."""
        z = np.nan_to_num((statistics - self.mean) / self.spread, nan=0.0)
        z = np.clip(z, -MOST_DEVIATIONS, MOST_DEVIATIONS)
        return np.concatenate((np.ones((len(z), 1)), z, z**2), axis=1)


def ridge(x: Floats, y: Floats, penalty: float) -> Floats:
    """Return coefficients ``(inputs, outputs)``; the first input has no penalty."""
    return _solved(x.T @ x, x.T @ y, penalty)


def _solved(squares: Floats, products: Floats, penalty: float) -> Floats:
    """Solve the normal equations ``(X'X + penalty) b = X'y``."""
    weight = penalty * np.eye(len(squares))
    weight[0, 0] = 1e-9
    return np.linalg.solve(squares + weight, products).astype(np.float64)


def left_out(x: Floats, y: Floats, groups: NDArray[np.int64]) -> tuple[Floats, float]:
    """Predict every row from the other groups, with the penalty that predicts best.

    Args:
        x: Inputs ``(n, inputs)``.
        y: Outputs ``(n, outputs)``.
        groups: Group of each row, ``(n,)``; rows of one world belong together.

    Returns:
        Predictions ``(n, outputs)``, and the penalty that makes their error smallest.
    """
    folds = [np.flatnonzero(groups % FOLDS == part) for part in range(FOLDS)]
    parts = [(x[rows].T @ x[rows], x[rows].T @ y[rows]) for rows in folds]
    squares, products = x.T @ x, x.T @ y
    scale = y.var(0) + 1e-12

    def predicted(penalty: float) -> Floats:
        answer = np.zeros_like(y)
        for rows, (own, theirs) in zip(folds, parts, strict=True):
            answer[rows] = x[rows] @ _solved(squares - own, products - theirs, penalty)
        return answer

    tried = {penalty: predicted(penalty) for penalty in PENALTIES}
    errors = {p: float((((y - answer) ** 2).mean(0) / scale).mean()) for p, answer in tried.items()}
    best = min(errors, key=lambda penalty: errors[penalty])
    return tried[best], best


@dataclass(frozen=True)
class Calibration:
    """Answers of a regression to known values: ``constant + values @ slopes + error``.

    Attributes:
        constant: Answer where all values are 0, ``(k,)``.
        slopes: Change of each answer with each value, ``(k values, k answers)``.
        covariance: Covariance of the errors, ``(k, k)``.
    """

    constant: Floats
    slopes: Floats
    covariance: Floats

    @classmethod
    def of(cls, values: Floats, answers: Floats) -> Calibration:
        """Fit the calibration to worlds that were left out of the regression.

        Args:
            values: Values of the worlds, ``(n, k)``; n has to be above k + 1.
            answers: What the regression answers, ``(n, k)``.
        """
        inputs = np.concatenate((np.ones((len(values), 1)), values), axis=1)
        lines = np.linalg.lstsq(inputs, answers)[0].astype(np.float64)
        errors = answers - inputs @ lines
        covariance = errors.T @ errors / max(len(values) - inputs.shape[1], 1)
        return cls(lines[0], lines[1:], covariance)


def kernel(predicted: Floats, observed: Floats, residual: Floats) -> Floats:
    """Return weights of simulated worlds by their distance to the observed one, ``(n,)``.

    The weights are those of Epanechnikov's kernel; `NEAR` of the worlds have one above 0.

    Args:
        predicted: Predictions of the simulated worlds, ``(n, outputs)``.
        observed: Prediction of the observed one, ``(outputs,)``.
        residual: Residuals of the simulated worlds, ``(n, outputs)``.
    """
    spread = residual.std(0) + 1e-9
    distance = np.sqrt((((predicted - observed) / spread) ** 2).mean(1))
    reach = np.quantile(distance, NEAR) + 1e-9
    weights = np.clip(1.0 - (distance / reach) ** 2, 0.0, None)
    return weights / weights.sum()
