"""How late greens have to be for the simulation to pay a policy what the street pays it.

What a green loses when it begins (`lost_time`) is what a street's first intervals say. Slow
vehicles lose more while the green lasts, and no delay of a beginning is that; but it can make up
for it: with the delay found here the same policy has, over whole episodes, the same reward in both
worlds. That is blunt where it comes to why: whatever else the worlds differ in is charged to the
delay, too. And it has to be the same policy, so that logs of another one do not do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.transitions import TransitionLog

Floats = NDArray[np.float64]


def mean_rewards(log: TransitionLog, agents: Sequence[str]) -> Floats:
    """Mean reward of each of these agents over all its decisions, ``(agents,)``."""
    found = dict(log.frame.group_by("agent").agg(pl.col("reward").mean()).iter_rows())
    return np.array([found[agent] for agent in agents], dtype=np.float64)


def matching_delays(street: Floats, simulated: Floats) -> Floats:
    """The delay at which the simulation pays what the street pays.

    Rewards are taken to fall with the delay: where they rise by chance, neighbours are averaged
    (isotonic regression). Between whole seconds they lie on a line.

    Args:
        street: Mean rewards ``(agents,)``.
        simulated: The same with greens late by 0, 1, 2, ... s, ``(delays, agents)``.

    Returns:
        Delays in s, ``(agents,)``; 0 where the street pays more than the simulation at its best,
        the longest where it pays less than at its worst.
    """
    pairs = zip(street, simulated.T, strict=True)
    return np.array([_matching(paid, falling(curve)) for paid, curve in pairs], dtype=np.float64)


def falling(values: Floats) -> Floats:
    """The sequence that never rises and is closest to `values` (least squares), ``(n,)``."""
    blocks: list[tuple[float, int]] = []
    for value in values.tolist():
        blocks.append((value, 1))
        while len(blocks) > 1 and blocks[-2][0] < blocks[-1][0]:
            (late, n), (early, m) = blocks.pop(), blocks.pop()
            blocks.append(((early * m + late * n) / (m + n), m + n))
    return np.repeat([mean for mean, _ in blocks], [count for _, count in blocks])


def _matching(paid: float, curve: Floats) -> float:
    (shortest,) = np.nonzero(np.diff(curve, prepend=np.inf) < 0)  # of those that pay the same
    return float(np.interp(-paid, -curve[shortest], shortest.astype(np.float64)))
