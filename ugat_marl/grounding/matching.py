"""How late greens have to be for the simulation to pay a policy what the street pays it.

What a green loses when it begins (`lost_time`) is what a street's first intervals say. Slow
vehicles lose more while the green lasts, and no delay of a beginning is that; but it can make up
for it: with the delay found here the same policy has, over whole episodes, the same reward in both
worlds. That is blunt where it comes to why: whatever else the worlds differ in is charged to the
delay, too. And it has to be the same policy, so that logs of another one do not do.

An hour of traffic is one sample, and some delay fits best even where no green is late. So greens
are moved only where chance does not explain what lies between the street's rewards and those of the
simulation with the lost time alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy import special

from ugat_marl.data import TransitionLog
from ugat_marl.grounding.arrays import Floats

MATCHED_REWARD = "queue"
"""The reward that can be matched: it falls with every delay, and an episode's mean is one of many
moments. Differences of waiting times add up to what is left at the end."""
CHANCE = 0.05
"""What is likelier than this under the lost time alone does not speak against it."""


@dataclass(frozen=True)
class Paid:
    """Mean rewards per decision that one policy got in single episodes.

    Attributes:
        street: ``(episodes, agents)``.
        simulated: In the simulation with all greens late by 0, 1, 2, ... s,
            ``(delays, episodes, agents)``.
        before: What earlier policies got on the street, each ``(episodes, agents)``: they, too,
            tell how much the rewards of an episode vary.
    """

    street: Floats
    simulated: Floats
    before: Sequence[Floats] = ()


@dataclass(frozen=True)
class Matched:
    """What rewards say of the delays of greens.

    Attributes:
        delay_s: ``(agents,)``, with which the simulation pays what the street pays, in s.
        chance: How likely the street's rewards are under the lost time alone (`chance_of`).
        beyond_s: ``(agents,)``, what greens are to be later by than the lost time; 0 where chance
            explains the rewards.
    """

    delay_s: Floats
    chance: float
    beyond_s: Floats


def match(paid: Paid, lost_s: Floats) -> Matched:
    """Asks rewards whether greens have to be later than what they lose when they begin.

    Args:
        paid: Rewards in both worlds.
        lost_s: ``(agents,)``, what greens lose when they begin, in s.
    """
    delay_s = matching_delays(paid.street.mean(0), paid.simulated.mean(1))
    chance = chance_of(paid, lost_s)
    return Matched(delay_s, chance, (delay_s - lost_s) * (chance < CHANCE))


def episode_rewards(log: TransitionLog, agents: Sequence[str]) -> Floats:
    """Mean reward of each of these agents in each episode of a log, ``(episodes, agents)``."""
    means = log.frame.group_by("episode", "agent").agg(pl.col("reward").mean())
    table = means.pivot("agent", index="episode", values="reward").sort("episode")
    return table.select(agents).to_numpy().astype(np.float64)


def chance_of(paid: Paid, delay_s: Floats) -> float:
    """How likely the street's rewards are, if its greens are late by these delays and no more.

    Two-sided, by Student's t, of the sum over the network: what an hour's traffic does to rewards
    it does to all intersections. Episodes are taken to vary in proportion to their mean.

    Args:
        paid: Rewards in both worlds.
        delay_s: ``(agents,)``, delays in s.

    Returns:
        A p-value; 1 where no two episodes tell how much rewards vary.
    """
    delays, episodes, _ = paid.simulated.shape
    late = np.arange(delays, dtype=np.float64)
    curves = zip(delay_s, paid.simulated.mean(1).T, strict=True)
    expected = sum(float(np.interp(seconds, late, falling(curve))) for seconds, curve in curves)
    street = paid.street.sum(1)
    alike = [street, *paid.simulated.sum(2), *(group.sum(1) for group in paid.before)]
    degrees = sum(len(group) - 1 for group in alike)
    if degrees < 1:
        return 1.0
    varies = math.sqrt(sum(_relative_squares(group) for group in alike) / degrees)
    error = varies * math.hypot(
        float(street.mean()) / math.sqrt(len(street)), expected / math.sqrt(episodes)
    )
    beyond = float(street.mean()) - expected
    if beyond == 0.0 or error == 0.0:
        return 1.0 if beyond == 0.0 else 0.0
    return 2.0 * float(special.stdtr(degrees, -abs(beyond / error)))


def _relative_squares(group: Floats) -> float:
    """Sum of squared distances from the mean, as shares of it; 0 around a mean of 0."""
    mean = float(group.mean())
    return float((((group - mean) / mean) ** 2).sum()) if mean else 0.0


def matching_delays(street: Floats, simulated: Floats) -> Floats:
    """The delay at which the simulation pays what the street pays.

    Rewards are taken to fall with the delay: where they rise by chance, neighbours are averaged
    (isotonic regression). Between whole seconds they lie on a line.

    Args:
        street: Mean rewards ``(agents,)``.
        simulated: The same with greens late by 0, 1, 2, ... s, ``(delays, agents)``.

    Returns:
        Delays in s, ``(agents,)``, of several that pay the same the shortest; 0 where the street
        pays more than the simulation at its best, that of its worst where it pays less.
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
    after = int(np.argmax(curve <= max(paid, curve[-1])))  # the shortest of those that pay the same
    if after == 0 or curve[after] > paid:
        return float(after)
    return after - (paid - curve[after]) / (curve[after - 1] - curve[after])
