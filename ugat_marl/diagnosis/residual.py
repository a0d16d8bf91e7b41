"""Test of the difference between data and a model against simulated chance.

The days of the model are split into halves. One half gives the statistics and their noise; sets of
days from the other half are treated as data. Tables of distributions would be wrong, since the
parts of the distance depend on each other and have heavy tails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.fit import WIDE
from ugat_marl.diagnosis.hypotheses import each_left_out
from ugat_marl.diagnosis.propose import Direction
from ugat_marl.diagnosis.records import ResidualTest
from ugat_marl.diagnosis.statistics import (
    SINGLE,
    Distance,
    Group,
    Pools,
    Reference,
    by_turns,
    correlation_groups,
    softened,
    whitened,
    without_noise,
)
from ugat_marl.diagnosis.thresholds import Thresholds

Array = NDArray[np.float64]

Directed = Callable[[Distance], Mapping[str, float]]
"""Function from a distance to further statistics by name."""


class Null:
    """The distribution of the distance under a model.

    Args:
        pools: Pools of places.
        tallies: Tallies of the model's simulated days.
        periods: Number of periods in a data set.
        speeds: True if speeds were measured.
        directed: Function that makes, for a model, further statistics of a distance. Small effects
            change these most. They are made anew for each half, so that they are never adapted to
            the days that they judge. None for no further statistics.
        doubt: Further variance of the model's means in a test of data, see `Reference`; draws from
            the model's own days do not get it.

    Attributes:
        reference: Statistics and noise of the model, from all days.
        expected: Mean total distance of data sets of the model.
    """

    def __init__(
        self,
        pools: Pools,
        tallies: Sequence[Tally],
        periods: int,
        *,
        speeds: bool,
        directed: Callable[[Reference], Directed] | None = None,
        doubt: Mapping[str, Array] | None = None,
    ) -> None:
        generator = np.random.default_rng(7)
        self._thresholds = thresholds = pools.thresholds
        self.reference = Reference(pools, tallies, speeds=speeds, doubt=doubt)
        self._directed = directed(self.reference) if directed else None
        draws: dict[str, list[float]] = {}
        tallies = by_turns(tallies)
        for half in (0, 1):
            model = Reference(pools, tallies[half::2], speeds=speeds)
            directed_of_half = directed(model) if directed else None
            others = tallies[1 - half :: 2]
            for _ in range(thresholds.null_draws):
                chosen = drawn_days(generator, len(others), periods, thresholds)
                distance = model.distance([others[int(i)] for i in chosen])
                for name, value in _statistics(
                    distance, directed_of_half, thresholds.added_distance
                ).items():
                    draws.setdefault(name, []).append(value)
                draws.setdefault("total", []).append(distance.total)
        self._moments = {
            name: log_moments(values, thresholds.least_log_spread) for name, values in draws.items()
        }
        self.expected = float(np.mean(draws["total"]))

    def test(
        self,
        data: Sequence[Tally],
        extra: Mapping[str, Array] | None = None,
    ) -> ResidualTest:
        """Test a data set.

        A difference must not depend on a single day, since a network may lock up on one day in a
        hundred. If the data without some period are not unusual, the test reports that chance.

        Args:
            data: Tallies of the periods.
            extra: Further variance of the expected statistics, for errors of the free values.
        """
        residual = self._judge(self.reference.distance(data, extra=extra))
        if len(data) < 2 or residual.p > self._thresholds.one_day:
            return residual
        distances = (self.reference.distance(x, extra=extra) for x in each_left_out(data))
        without = [self._judge(distance).p for distance in distances]
        return (
            replace(residual, p=max(without))
            if max(without) > self._thresholds.one_day
            else residual
        )

    def _judge(self, distance: Distance) -> ResidualTest:
        values = _statistics(distance, self._directed, self._thresholds.added_distance)
        chances = {
            name: log_normal_tail(value, *self._moments[name]) for name, value in values.items()
        }
        smallest = min(chances.values())
        return ResidualTest(
            distance.total,
            self.floor,
            self.expected,
            min(1.0, smallest * len(chances)),
            chances,
        )

    @property
    def floor(self) -> float:
        """Total distance that 99 of 100 data sets of the model stay below."""
        mean, deviation = self._moments["total"]
        return math.exp(mean + self._thresholds.floor_deviations * deviation)


def drawn_days(
    generator: np.random.Generator, days: int, size: int, thresholds: Thresholds
) -> NDArray[np.int64]:
    """Draw the days of a data set from the days of a model, by number.

    Large sets are drawn with replacement. Otherwise all would hold nearly the same days, and their
    spread would be too small.

    Args:
        generator: Source of the draw.
        days: Number of days of the model.
        size: Number of days of the data set.
        thresholds: Numbers of the method.
    """
    repeats = size > thresholds.drawn_once * days
    return generator.choice(days, size, replace=repeats)


def log_normal_tail(value: float, mean: float, deviation: float) -> float:
    """Return ``Phi((mean - ln value) / deviation)``, the upper tail of a log-normal distribution.

    This tail is heavier than that of a chi-square distribution.

    Args:
        value: The value.
        mean: Mean of the logarithms.
        deviation: Standard deviation of the logarithms.
    """
    return float(special.ndtr((mean - math.log(max(value, 1e-9))) / deviation))


def _statistics(distance: Distance, directed: Directed | None, more: float) -> dict[str, float]:
    """Return the tested statistics, each with `more` added.

    They are the distances of blocks, the largest single ones, and directed ones.

    Raises:
        ValueError: If a directed statistic has the name of another one, which it would replace.
    """
    values = dict(distance.parts)
    for name in ("lane", "time"):
        values[f"{name}, largest"] = float(np.abs(distance.z[name]).max(initial=0.0)) ** 2
    if directed is not None:
        further = directed(distance)
        if twice := sorted(values.keys() & further.keys()):
            raise ValueError(f"statistics of one name: {', '.join(twice)}")
        values |= further
    return {name: value + more for name, value in values.items()}


def log_moments(values: Sequence[float], least_spread: float) -> tuple[float, float]:
    """Return mean and standard deviation of logarithms, the latter at least `least_spread`."""
    logs = np.log(np.maximum(values, 1e-9))
    return float(logs.mean()), max(float(logs.std(ddof=1)), least_spread)


# --- single effects -------------------------------------------------------------------------------


class MatchedFilters:
    """Matched filters: one for each known direction in which a difference may point.

    An effect changes many statistics, each by less than its noise. Its component along its own
    direction is one number of unit noise, so it may be visible when the total distance is not. With
    unit direction u and whitened differences z, the statistic is ``max (u z)^2``.

    Args:
        directions: Changes of the statistics by block, one item for each direction.
        reference: Model that gives the noise.
        data: Data set that decides which statistics are used and how exact they are.
        blocks: Names of the blocks to use.
        extra: Further variance of the expected statistics, by block.
        fitted: Changes of the statistics by the model's own free values. A fit has removed these
            directions from the difference, so they are removed from the filters too.
    """

    def __init__(
        self,
        directions: Sequence[Mapping[str, Array]],
        reference: Reference,
        data: Sequence[Tally],
        blocks: Collection[str],
        extra: Mapping[str, Array] | None = None,
        fitted: Sequence[Mapping[str, Array]] = (),
    ) -> None:
        self._thresholds = thresholds = reference.pools.thresholds
        sums, used = reference.pools.pool_all(data), reference.distance(data).used
        self._parts: list[tuple[str, list[Group]]] = []
        scales: dict[str, Array] = {}
        for name in blocks:
            if name not in reference.blocks:
                continue
            block = reference.blocks[name]
            weight = sums[name][..., 1] / len(data)
            self._parts.append((name, correlation_groups(used[name], block.correlation)))
            more = 0.0 if extra is None else extra[name]
            scales[name] = np.sqrt(block.noise(weight, len(data)) + more)

        def rows(changes: Sequence[Mapping[str, Array]]) -> Array:
            scaled = [{n: change[n] / scales[n] for n in scales} for change in changes]
            return np.stack([self._whitened(change) for change in scaled])

        filters = rows(directions)
        size = np.sqrt((filters**2).sum(axis=1))
        self._away = np.zeros((filters.shape[1], 0))
        if fitted:
            self._away = _spanned(rows(fitted))
        filters = filters - (filters @ self._away) @ self._away.T
        left = np.sqrt((filters**2).sum(axis=1))
        seen = (left > thresholds.least_apart * size) & (size > 0)
        self._units = filters[seen] / left[seen, None]

    def __call__(self, distance: Distance) -> float:
        """Return the largest squared component along any of the directions."""
        counted = {
            name: softened(name, distance.z[name], self._thresholds) for name, _ in self._parts
        }
        components = self._units @ self._whitened(counted)
        return float((components**2).max(initial=0.0))

    def _whitened(self, z: Mapping[str, Array]) -> Array:
        return np.concatenate([whitened(z[name], groups) for name, groups in self._parts])


def _spanned(rows: Array) -> Array:
    """Return orthonormal columns that span the rows; zero or dependent rows add no column."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    return directions[sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)].T


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions in which single effects would change the remaining difference.

    Attributes:
        changes: Changes by effects, simulated on top of the scenario as it is.
        extra: Variance of the model's statistics for errors of its free values, by block.
        fitted: Changes of the statistics by the model's own free values.
    """

    changes: tuple[Direction, ...]
    extra: Mapping[str, Array] | None = None
    fitted: tuple[Mapping[str, Array], ...] = ()

    def filters(self, reference: Reference, data: Sequence[Tally]) -> dict[str, MatchedFilters]:
        """Make matched filters for the pools, and for single lanes and bins of time.

        Args:
            reference: Model that gives the noise.
            data: Tallies of the fitted periods.
        """
        if not self.changes:
            return {}
        wide = [direction.difference for direction in self.changes]
        thresholds = reference.pools.thresholds
        single = [without_noise(x.difference, x.variance, thresholds) for x in self.changes]
        return {
            name: MatchedFilters(changes, reference, data, blocks, self.extra, self.fitted)
            for name, changes, blocks in (
                ("one effect", wide, WIDE), ("one effect, lanes", single, SINGLE)
            )
        }  # fmt: skip
