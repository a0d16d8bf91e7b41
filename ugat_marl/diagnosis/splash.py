"""Splash: detectors that also report vehicles of the next lane.

A copy is on and off with its original. Three things show it:

- **Lone vehicles**: while nothing else passes, a twin on the next lane is a copy. Dense traffic has
  few of them.
- **Coincidences**: more pairs of passages on adjacent lanes begin and last alike than begin a
  little apart. Drivers who start side by side alike make some, too.
- **Counts**: more passages than over the other detectors of the same lanes. These may miss
  vehicles instead, so that counts only say how large a splash is that one of the others shows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.error_places import Group, ValueWithError
from ugat_marl.diagnosis.sightings import Sightings, beside
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.scenarios import Detector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SplashShare(ValueWithError):
    """The share of the vehicles beside theirs that detectors report, with its error.

    Attributes:
        counted: True if counts say how large it is.
    """

    counted: bool = False


class Splash:
    """Shares of splash of groups of detectors, beyond those of simulated days.

    Args:
        detectors: All detectors.
        groups: Indices of the detectors of each group.
        measured: Sightings of the data.
        simulated: Sightings of simulated days.
        thresholds: Numbers of the method.
        grain_s: Grain of the clock that stamps detections, s.
    """

    def __init__(
        self,
        detectors: Sequence[Detector],
        groups: Mapping[Group, Sequence[int]],
        measured: Sightings,
        simulated: Sightings,
        thresholds: Thresholds,
        grain_s: float,
    ) -> None:
        reported = Counter(chain.from_iterable(beside(detectors).values()))
        # By how many detectors beside it the vehicles of each one are reported.
        self._reported = np.array([reported[index] for index in range(len(detectors))])
        self._lanes = [detector.lane for detector in detectors]
        self._groups = {
            group: list(members)
            for group, members in groups.items()
            if self._reported[members].any()
        }
        self._measured, self._simulated = measured, simulated
        self._thresholds = thresholds
        # With fewer stamps within `twin_s`, pairs by chance cannot be told from those a bit apart.
        self._fine = grain_s < thresholds.twin_s

    def shares(self) -> dict[Group, SplashShare]:
        """Return the share of splash of every group that tells one."""
        lone = {group: self._by_lone_vehicles(members) for group, members in self._groups.items()}
        witnesses: dict[Group, SplashShare] = {}
        for group, members in self._groups.items():
            coinciding = self._by_coincidences(members) if self._fine else None
            if found := [share for share in (lone[group], coinciding) if share is not None]:
                witnesses[group] = min(found, key=lambda share: share.error)
        shares = {group: self._by_counts(group, witnesses) or lone[group] for group in lone}
        return {group: share for group, share in shares.items() if share is not None}

    def _by_lone_vehicles(self, members: Sequence[int]) -> SplashShare | None:
        """Return the share that lone vehicles show; None if they are too few."""
        limit, reported = self._thresholds, self._reported[members]
        counts = [x.twins[members] for x in (self._measured, self._simulated)]
        if min(x[reported > 0, 1].sum() for x in counts) < limit.least_sightings:
            return None
        seen, usual = (_of_twins(x, reported) for x in counts)
        error = math.hypot(seen.error, usual.error, limit.twin_doubt * usual.value)
        return SplashShare(seen.value - usual.value, error)

    def _by_coincidences(self, members: Sequence[int]) -> SplashShare:
        """Return the share that coincidences show. Copies that merge with others are missed."""
        limit = self._thresholds
        seen, usual = (
            _of_coincidences(x, members, self._reported) for x in (self._measured, self._simulated)
        )
        unlike = limit.twin_doubt * max(seen.value, usual.value)
        error = math.hypot(seen.error, usual.error, unlike, limit.coincidence_doubt)
        return SplashShare(seen.value - usual.value, error)

    def _by_counts(
        self, group: Group, witnesses: Mapping[Group, SplashShare]
    ) -> SplashShare | None:
        """Return the share of splash that counts tell.

        Args:
            group: Detectors of one kind on one road.
            witnesses: Shares of splash by lone vehicles or coincidences, of all groups.

        Returns:
            The share; None if no witness shows it, if the other detectors of the same lanes have
            splash, too, or if counts and witness disagree.
        """
        limit, witness = self._thresholds, witnesses.get(group)
        if witness is None:
            return None
        own = self._groups[group]
        lanes = {self._lanes[index] for index in own}
        others = [
            index for index, lane in enumerate(self._lanes) if lane in lanes and index not in own
        ]
        simulated, measured = self._simulated.counts, self._measured.counts
        least = min(simulated[own].sum(), simulated[others].sum(), measured[others].sum())
        there = [witnesses[one] for one in witnesses if set(self._groups[one]) & set(others)]
        own_shown, *others_shown = (
            one.value > limit.shown_deviations * one.error for one in (witness, *there)
        )
        copies = float(self._reported[own] @ simulated[own]) / max(simulated[own].sum(), 1.0)
        if not (least and copies and own_shown) or any(others_shown):
            return None
        usual = float(simulated[own].sum() / simulated[others].sum() * measured[others].sum())
        more = float(measured[own].sum()) - usual
        error = math.hypot(math.sqrt(max(more, 0.0) + 1.0) / usual, limit.count_doubt) / copies
        counted = SplashShare(more / usual / copies, error, counted=True)
        agree = limit.agreeing_deviations * math.hypot(witness.error, counted.error)
        return counted if abs(counted.value - witness.value) <= agree else None


def _of_twins(twins: Array, reported: NDArray[np.int64]) -> ValueWithError:
    """Return the share s of vehicles that each detector beside theirs reports as well.

    Of N vehicles whose lane has n detectors beside, ``N (1 - s)^n`` are alone. So the numbers of
    passages alone, each divided by ``(1 - s)^n``, sum to the number of vehicles. The error is that
    of Poisson numbers, with one more twin, since none of a few is no certainty.

    Args:
        twins: Rows of `Sightings.twins`.
        reported: Number of detectors that may report vehicles of each one, too: ``(detectors,)``.
    """
    together, alone = float(twins[:, 0].sum()), twins[:, 1]
    total = together + float(alone.sum())
    # Newton's method in x = 1 / (1 - s): the sum is convex in x, so it nears the root from above.
    x = 1.0
    for _ in range(50):
        x -= float((alone * x**reported).sum() - total) / _slope(alone, reported, x)
    share = 1.0 - 1.0 / x
    spread = together + 1.0 + float((alone * (x**reported - 1.0) ** 2).sum())
    return ValueWithError(share, math.sqrt(spread) / (_slope(alone, reported, x) * x**2))


def _slope(alone: Array, reported: NDArray[np.int64], x: float) -> float:
    """Return the derivative of the sum of `alone` by ``x**reported``."""
    return float((alone * reported * x ** (reported - 1.0)).sum())


def _of_coincidences(
    sightings: Sightings, members: Sequence[int], reported: NDArray[np.int64]
) -> ValueWithError:
    """Return the share s of splash of some detectors by the pairs of passages that coincide.

    N vehicles whose lanes have r detectors beside, on average, make ``N s r`` pairs and
    ``N (1 + s r)`` passages.

    Args:
        sightings: Those of all detectors.
        members: Indices of the detectors.
        reported: Number of detectors that may report vehicles of each one, too: ``(detectors,)``.
    """
    passages = sightings.counts[members]
    total = max(float(passages.sum()), 1.0)
    copies = max(float(passages @ reported[members]) / total, 1.0 / len(members))
    near, apart = sightings.coincidences[members].sum(axis=0).tolist()
    share = (near - apart) / total
    error = math.sqrt(near + apart + 1.0) / total
    return ValueWithError(share / (1.0 - share) / copies, error / (1.0 - share) ** 2 / copies)
