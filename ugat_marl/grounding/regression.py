"""Regression posterior: parameters of simulated worlds from their statistics, with residuals.

Approximate Bayesian computation with linear regression adjustment (Beaumont, Zhang and Balding
2002) on summaries that are themselves regressions (Fearnhead and Prangle 2012):

    g      = ridge regression of the parameters on the statistics of simulated worlds
    w_i    = kernel of the distance |g(s_i) - g(s_obs)|, in units of the spread of its residuals
    draw   = g(s_obs) + e_i with chance proportional to w_i,   e_i = theta_i - g(s_i)

Residuals are those of worlds that were left out of the fit, so the draws are as wide as the
regression is wrong. A draw takes all parameters of one world i together, so that their correlations
remain: what one effect explains, another one need not.
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
