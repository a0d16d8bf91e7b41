"""Does u know when h is wrong? Ranks and rates that answer without assuming a scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.floating] | NDArray[np.integer] | NDArray[np.bool_]


def ranks(values: Numbers) -> NDArray[np.float64]:
    """Ranks from 1, ties sharing their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def spearman(one: Numbers, other: Numbers) -> float:
    """Rank correlation of two samples; NaN if one of them is constant."""
    a, b = ranks(one), ranks(other)
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum() / norm) if norm > 0 else float("nan")


def auroc(score: Numbers, positive: NDArray[np.bool_]) -> float:
    """Probability that a positive scores above a negative, ties half; NaN if one is missing."""
    hits = int(positive.sum())
    misses = len(positive) - hits
    if not hits or not misses:
        return float("nan")
    return float((ranks(score)[positive].sum() - hits * (hits + 1) / 2) / (hits * misses))


def rate_by_quantile(score: Numbers, hit: NDArray[np.bool_], bins: int) -> tuple[float, ...]:
    """Share of hits in `bins` equally filled groups of rising score; NaN for an empty group."""
    order = np.argsort(score, kind="stable")
    groups = np.array_split(hit[order], bins)
    return tuple(float(group.mean()) if len(group) else float("nan") for group in groups)
