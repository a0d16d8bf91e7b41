"""Race of policies in worlds of a fitted street: a policy that is clearly slower leaves it.

All policies play in the same worlds. After each round a paired test compares them with the best one
(Maron and Moore, *Hoeffding races*, 1994; the t test in place of Hoeffding's bound).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

ROUND = 8
"""Worlds of a round."""

CHANCE = 0.01
"""Chance that a policy which is as good as the best one leaves after a round."""

LEVEL = 0.005
"""Share of the travel time for which no further round is played."""


@dataclass(frozen=True)
class PolicyRace:
    """Outcome of a race.

    Attributes:
        best: Name of the best policy.
        times_s: Travel times in s by name. That of a policy which left is the time of the one that
            was best then, plus their mean difference so far; NaN if it lacks travel times.
        worlds: Worlds in which the best policy played.
    """

    best: str
    times_s: dict[str, float]
    worlds: int


def race_policies(
    names: Sequence[str],
    most: int,
    play: Callable[[Sequence[str], range], NDArray[np.float64]],
) -> PolicyRace:
    """Compare policies in more and more worlds, until no other one may be better than the best.

    Worlds in which no policy has a travel time do not count, since nobody travels there. A policy
    that lacks one where another has it leaves.

    Args:
        names: Policies that take part; of equal ones the first is the best.
        most: Most worlds in which a policy plays, at least 1.
        play: Called with the policies of a round and the numbers of its worlds; returns travel
            times in s, ``(policies, worlds)``; NaN where no vehicle is due.
    """
    played_s = {name: np.empty(0) for name in names}
    ahead: dict[str, str] = {}  # of a policy that left: the one that was best then
    best, running, done = names[0], list(names), 0
    while not done or (done < most and len(running) > 1):
        worlds = range(done, min(done + ROUND, most))
        round_s = play(tuple(running), worlds)
        round_s = round_s[:, ~np.isnan(round_s).all(0)]
        for name, times_s in zip(running, round_s, strict=True):
            played_s[name] = np.append(played_s[name], times_s)
        done = worlds.stop
        if not round_s.size:
            break
        before, running = running, [name for name in running if _is_whole(played_s[name])]
        if not running:
            break
        best = min(running, key=lambda name: played_s[name].mean())
        if len(played_s[best]) > 1:
            running = _running(played_s, running, best)
        ahead |= dict.fromkeys(set(before).difference(running), best)

    def told_s(name: str) -> float:
        if not _is_whole(played_s[name]):
            return np.nan
        if name not in ahead:
            return float(played_s[name].mean())
        return told_s(ahead[name]) + float(_behind_s(played_s, name, ahead[name]).mean())

    return PolicyRace(best, {name: told_s(name) for name in names}, len(played_s[best]))


def _is_whole(times_s: NDArray[np.float64]) -> bool:
    """Return True if there are travel times, of all worlds."""
    return bool(times_s.size) and not np.isnan(times_s).any()


def _running(
    played_s: Mapping[str, NDArray[np.float64]], running: Sequence[str], best: str
) -> list[str]:
    """Return the policies of the next round; the best one alone if no other is worth it."""
    behind_s = np.stack([_behind_s(played_s, name, best) for name in running])
    worlds = behind_s.shape[1]
    limit = stdtrit(worlds - 1, 1 - CHANCE) / np.sqrt(worlds)
    gains_s = limit * behind_s.std(1, ddof=1) - behind_s.mean(1)  # the most that chance leaves open
    if gains_s.max() <= LEVEL * played_s[best].mean():
        return [best]
    return [name for name, gain_s in zip(running, gains_s, strict=True) if gain_s >= 0]


def _behind_s(
    played_s: Mapping[str, NDArray[np.float64]], name: str, best: str
) -> NDArray[np.float64]:
    """Return by how much a policy is slower than the best one where both played, in s."""
    return played_s[name] - played_s[best][: len(played_s[name])]
