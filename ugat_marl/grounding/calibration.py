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
    """Rank correlation of two samples; NaN if one of them is constant, or empty."""
    if not len(one):
        return float("nan")
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


def risk_by_coverage(u: Numbers, wrong: NDArray[np.bool_], bins: int) -> tuple[float, ...]:
    """Error rate among the 1/bins, 2/bins, ... of the answers with the lowest u.

    The risk-coverage curve of selective classification (El-Yaniv and Wiener, JMLR 2010): what a
    gate that lets so many answers pass lets through. Equal u share their errors evenly, so that it
    is flat for a u that says nothing. NaN for a share without an answer.
    """
    _, group, counts = np.unique(u, return_inverse=True, return_counts=True)
    rate = np.bincount(group, weights=wrong) / counts
    errors = np.concatenate([[0.0], np.cumsum(np.repeat(rate, counts))])
    shares = [round(len(u) * (i + 1) / bins) for i in range(bins)]
    return tuple(float(errors[n] / n) if n else float("nan") for n in shares)


def expected_calibration_error(
    confidence: Numbers, correct: NDArray[np.bool_], bins: int = 15
) -> float:
    """Mean distance of confidence from accuracy over equally wide bins of confidence.

    Guo, Pleiss, Sun, Weinberger, "On Calibration of Modern Neural Networks", ICML 2017, equation 3,
    with their 15 bins. Confidence is the probability of the answer given; NaN without an answer.
    """
    if not len(correct):
        return float("nan")
    place = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    surplus = np.bincount(place, weights=confidence - correct, minlength=bins)
    return float(np.abs(surplus).sum() / len(correct))
