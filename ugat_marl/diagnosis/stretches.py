"""Stretches of time in which counts depart most from what is expected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.statistics import Distance

Array = NDArray[np.float64]

SCAN_S = 60.0
SHORTEST_S = 240.0
_COUNTS = 3
"""Kinds of counts in time that are counts of vehicles; they come first."""


def largest_stretches(edges: Sequence[str], distance: Distance) -> dict[str, float]:
    """The largest squared departure over any stretch of bins: of an edge's counts, of a lane's.

    Args:
        edges: Edge of every place.
        distance: Of the data from a model.
    """
    z, difference = distance.z["time"], distance.difference["time"]
    variance = np.where(z != 0, (difference / np.where(z != 0, z, 1.0)) ** 2, 0.0)
    places = len(edges)
    groups = [
        [kind * places + index for index, name in enumerate(edges) if name == edge]
        for edge in dict.fromkeys(edges)
        for kind in range(_COUNTS)
    ]
    of_edges = np.stack([difference[rows].sum(axis=0) for rows in groups])
    noise = np.stack([variance[rows].sum(axis=0) for rows in groups])
    return {"window": _largest(of_edges, noise), "lane window": _largest(difference, variance)}


def _largest(difference: Array, variance: Array) -> float:
    """Over all rows and all stretches of bins; both ``(rows, bins)``."""
    sums, noise = (
        np.concatenate((np.zeros((len(item), 1)), np.cumsum(item, axis=1)), axis=1)
        for item in (difference, variance)
    )
    largest = 0.0
    for length in range(1, sums.shape[1]):
        part = noise[:, length:] - noise[:, :-length]
        squared = (sums[:, length:] - sums[:, :-length]) ** 2 / np.maximum(part, 1e-9)
        largest = max(largest, float(np.where(part > 0, squared, 0.0).max()))
    return largest


def most_unusual(
    measured: Array, expected: Array, variance: Array, begin_s: float, side: int = 0
) -> tuple[float, float, float, float] | None:
    """Scans all stretches for the largest standardised departure from a constant ratio.

    Args:
        measured: Per minute.
        expected: Per minute.
        variance: Of what is expected, per minute.
        begin_s: Of the first minute.
        side: -1 or 1 for departures to that side only.
    """
    minutes = len(measured)
    if expected.sum() <= 0 or minutes * SCAN_S <= SHORTEST_S:
        return None
    sums = [np.concatenate(([0.0], np.cumsum(row))) for row in (measured, expected, variance)]
    shortest = int(SHORTEST_S / SCAN_S)
    best: tuple[float, int, int, float] | None = None
    for length in range(shortest, max(int(0.7 * minutes), shortest) + 1):
        inside = [row[length:] - row[:-length] for row in sums]
        rest = (sums[0][-1] - inside[0]) / np.maximum(sums[1][-1] - inside[1], 1e-9)
        excess = inside[0] - rest * inside[1]
        share = inside[1] / np.maximum(sums[1][-1] - inside[1], 1e-9)
        noise = np.sqrt(np.maximum(inside[2] * (1 + share), 1e-6))
        z = excess / noise
        size = side * z if side else np.abs(z)
        place = int(np.argmax(size))
        if best is None or size[place] > best[0]:
            ratio = float(inside[0][place] / max(rest[place] * inside[1][place], 1e-9))
            best = (float(size[place]), place, place + length, ratio)
    if best is None or best[0] < 4.0:
        return None
    z, first, last, ratio = best
    return z, begin_s + SCAN_S * first, begin_s + SCAN_S * last, ratio


def occupied_between(on: Array, off: Array, edges: Array) -> Array:
    """Occupied seconds between edges of time."""
    filled = np.zeros(len(edges))
    for index, edge in enumerate(edges):
        filled[index] = np.clip(np.minimum(off, edge) - on, 0.0, None).sum()
    return np.diff(filled)
