"""Statistics of data sets, their noise, and the distance between data and a model.

A data set is one or more periods. Its statistics are features pooled three ways: over the network,
over each intersection, over each lane. A fourth block holds counts in bins of time. A block has one
correlation between features. It is estimated from simulated days over all members of the block and
shrunk (Ledoit and Wolf 2004). The distance is the sum of the blocks' Mahalanobis distances. The
blocks depend on each other, so the distribution of the distance is always simulated.

Periods may be different stretches of a day, with other demand and other queues. Each is compared
with simulated days of its own stretch: the differences between the means of stretches are taken off
measured and simulated days alike. Otherwise they would count as chance and hide everything. The
differences are those of the scenario as it is; an effect is taken to change all stretches alike.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    EVENT_FEATURES,
    FEATURES,
    SPEED_FEATURES,
    DetectorLayout,
    Tally,
    bins_in,
)
from ugat_marl.diagnosis.supplementary_data import LANES, TRAVEL_TIME, TURNING, Label
from ugat_marl.diagnosis.thresholds import Thresholds

Array = NDArray[np.float64]
Window = tuple[float, float] | None
"""Begin and end of a stretch of a day, s."""

SINGLE = ("lane", "time", LANES)
"""Blocks of single lanes and bins of time. Most differences there are chance, so differences that
may be chance are not used when a model changes."""


@dataclass(frozen=True)
class Pools:
    """Pools of places: the network, intersections, lanes.

    Attributes:
        blocks: Matrix ``(members, places)`` of zeros and ones, by name of the block.
        thresholds: Numbers of the method.
        together: Number of bins of time that are joined to one; leftover bins at the end are not
            used.
        supplementary: Members of the blocks of `Tally.supplementary`.
    """

    blocks: dict[str, Array]
    thresholds: Thresholds
    together: int = 1
    supplementary: Mapping[str, tuple[Label, ...]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        layout: DetectorLayout,
        thresholds: Thresholds,
        together: int = 1,
        supplementary: Mapping[str, tuple[Label, ...]] | None = None,
    ) -> Pools:
        """Pool the network, every intersection if there are several, every lane."""
        places = len(layout.places)
        owners = [owner for owner, _, _ in layout.places]
        blocks = {"network": np.ones((1, places))}
        if len(layout.intersections) > 1:
            blocks["intersection"] = np.array(
                [
                    [float(owner == index) for owner in owners]
                    for index in range(len(layout.intersections))
                ]
            )
        blocks["lane"] = np.eye(places)
        return cls(blocks, thresholds, together, supplementary or {})

    def grouped_s(self, length_s: float) -> float:
        """Return how much of a period lies in groups of bins, from its start on.

        Bins left over at the end are in no group, as in `Tally.gathered`.

        Args:
            length_s: Length of the period, s.
        """
        bins = bins_in(length_s, self.thresholds)
        width = min(self.together, bins)
        return length_s * (bins // width * width / bins)

    def pool(self, tally: Tally) -> dict[str, Array]:
        """Return sums and weights ``(members, features, 2)`` of every block.

        In the block "time" the members are pairs of bin feature and place, and the features are the
        bins of time.
        """
        pooled = {
            name: np.einsum("mp,fpc->mfc", matrix, tally.sums)
            for name, matrix in self.blocks.items()
        }
        bins, counted = tally.gathered(self.together)
        time = np.stack([bins, counted], axis=-1)
        pooled["time"] = time.reshape(-1, *time.shape[2:])
        return pooled | dict(tally.supplementary)

    def pool_all(self, tallies: Sequence[Tally]) -> dict[str, Array]:
        """Return the pooled sums of several periods, which may lack bins of time.

        A group of bins counts in the periods that have the whole group.
        """
        pooled = self.pool(sum_of(tallies))
        if any(tally.known is not None for tally in tallies):
            groups = pooled["time"].shape[1]
            pooled["time"] = np.sum([self.pool(x)["time"][:, :groups] for x in tallies], axis=0)
        return pooled

    def least_weight(self, block: str) -> float:
        """Return the observations per measured period that a statistic of a block needs."""
        return self.thresholds.least_counted if block == "time" else self.thresholds.least_measured


@dataclass(frozen=True, eq=False)
class Block:
    """One block of statistics under a model; all arrays ``(members, features)``.

    Attributes:
        mean: Expected statistics, in units of the features.
        variance: Variance of a statistic of one period.
        weight: Observations per period.
        error: Variance of `mean`, since it comes from a finite number of days.
        used: True for statistics that are used.
        correlation: Correlation between features, ``(features, features)``.
        thinning: Least and largest factor of `variance` for unusual numbers of observations.
        doubt: Variance of `mean` that more days do not reduce.
    """

    mean: Array
    variance: Array
    weight: Array
    error: Array
    used: NDArray[np.bool_]
    correlation: Array
    thinning: tuple[float, float]
    doubt: Array | float = 0.0

    def noise(self, weight: Array, periods: int) -> Array:
        """Return the variance of measured minus expected statistics.

        noise = variance * thin / periods + error + doubt, where `thin` is the usual number of
        observations over the measured one, within `thinning`.

        Args:
            weight: Observations per measured period.
            periods: Number of measured periods.
        """
        thin = np.clip(self.weight / np.maximum(weight, 1e-9), *self.thinning)
        return self.variance * thin / periods + self.error + self.doubt


@dataclass(frozen=True, eq=False)
class Distance:
    """Distance of data from a model.

    Attributes:
        total: Sum of `parts`.
        parts: Squared Mahalanobis distance of every block.
        penalty: Sum of the logarithms of the variances relative to those of a reference, for the
            comparison of models; 0 without a reference.
        used: Mask of the statistics that are compared, by block, ``(members, features)``.
        z: Standardised differences of every block, 0 where unused, same shape.
        difference: Data minus model in units of the features, 0 where unused, same shape.
    """

    total: float
    parts: dict[str, float]
    penalty: float
    used: dict[str, NDArray[np.bool_]]
    z: dict[str, Array]
    difference: dict[str, Array]


class Reference:
    """Statistics and noise of a model, from simulated days.

    Args:
        pools: Pools of places.
        tallies: Tallies of the simulated days.
        speeds: True if speeds were measured.
        prior: Model whose correlations are used, and towards whose variances the variances of few
            days are shrunk.
        paired: Days of `prior` with the same numbers as `tallies`. They make the means more exact,
            since both models have common random numbers.
        doubt: Variance of the means that more days do not reduce, by block; None for that of
            `prior`.

    Attributes:
        blocks: Statistics and noise by name of the block.
        stretches: Mean of each stretch of the day minus that of all days, by block; those of
            `prior` if it is given. Empty if all days are of one stretch.
    """

    def __init__(
        self,
        pools: Pools,
        tallies: Sequence[Tally],
        *,
        speeds: bool = True,
        prior: Reference | None = None,
        paired: Sequence[Tally] = (),
        doubt: Mapping[str, Array] | None = None,
    ) -> None:
        self.pools = pools
        self._speeds = speeds
        self._thresholds = pools.thresholds
        stacked = _stack(pools, tallies)
        self.stretches = prior.stretches if prior else _stretches(stacked, tallies)
        self._of_stretches = prior._of_stretches if prior else {}
        self._of_window = prior._of_window if prior else Counter(day.window for day in tallies)
        stacked = self._level(stacked, tallies)
        partners = self._level(_stack(pools, paired), paired) if paired else {}
        self.blocks: dict[str, Block] = {}
        for name, sums in stacked.items():
            before = prior.blocks[name] if prior else None
            block = self._block(sums, before, partners.get(name), name)
            known = before.doubt if before else 0.0
            self.blocks[name] = replace(block, doubt=doubt[name] if doubt else known)
        if prior is None:
            self._of_stretches = {name: block.error for name, block in self.blocks.items()}

    def _level(self, stacked: dict[str, Array], tallies: Sequence[Tally]) -> dict[str, Array]:
        """Take the means of stretches off the sums of days ``(days, members, features, 2)``."""
        if not self.stretches:
            return stacked
        level: dict[str, Array] = {}
        for name, sums in stacked.items():
            own = [self.stretches.get(day.window, {}).get(name, 0.0) for day in tallies]
            apart = np.stack([np.broadcast_to(x, sums.shape[1:3]) for x in own])
            level[name] = np.stack((sums[..., 0] - sums[..., 1] * apart, sums[..., 1]), axis=-1)
        return level

    def _block(self, sums: Array, prior: Block | None, partner: Array | None, name: str) -> Block:
        """Make a block from sums ``(days, members, features, 2)``."""
        timed = name == "time"
        means = max(1, len(self.stretches)) if prior is None else 1
        mean, variance, weight, residual = _moments(sums, means)
        least = (
            np.full(sums.shape[2], self._thresholds.grain)
            if timed
            else _grain(sums.shape[2], self._thresholds)
        )
        variance = np.maximum(variance, (least / np.maximum(weight, 1.0)) ** 2)
        if timed:
            variance = _smoothed(mean, variance, self._thresholds)
        error = variance / len(sums)
        if prior is not None:
            scale = len(sums) / (len(sums) + self._thresholds.few_days)
            variance = scale * variance + (1 - scale) * prior.variance
            error = variance / len(sums)
            if partner is not None:
                moved = (
                    _moved(mean, residual, partner, self._thresholds) if name in SINGLE else True
                )
                mean, error = _controlled(
                    mean, variance, residual, partner, prior, self._thresholds
                )
                mean = np.where(moved, mean, prior.mean)
                variance = np.where(moved, variance, prior.variance)
                error = np.where(moved, error, prior.error)
        if timed:
            used = mean > self._thresholds.least_count
        else:
            seen = _observations(name, mean, weight)
            used = (seen >= self._thresholds.least_observations) & np.isfinite(mean)
            if name in self.pools.blocks:
                used &= ~_constant(self._speeds)[None, : used.shape[1]]
        if timed:
            correlation = np.eye(sums.shape[2])
        elif prior is None:
            correlation = _correlation(
                np.where(used, residual / np.sqrt(variance), 0.0), self._thresholds.least_shrinkage
            )
        else:
            correlation = prior.correlation
            used &= prior.used
        least, most = self._thresholds.thinning
        if name == TRAVEL_TIME:  # probes may be a few of all vehicles
            most = math.inf
        return Block(mean, variance, weight, error, used, correlation, (least, most))

    def distance(
        self,
        data: Sequence[Tally],
        *,
        relative_to: Reference | None = None,
        extra: Mapping[str, Array] | None = None,
    ) -> Distance:
        """Measure the distance of a data set.

        Args:
            data: Tallies of its periods.
            relative_to: Model that chooses the statistics and gives the variances for the penalty;
                None for this model without a penalty.
            extra: Further variance of the expected statistics, by block.
        """
        if self.stretches:
            days = self._level(_stack(self.pools, data), data)
            sums = {name: several.sum(axis=0) for name, several in days.items()}
        else:
            sums = self.pools.pool_all(data)
        # The mean of a stretch comes from its own n of all N days. If it has a share s of the data,
        # the errors of these means add up to the sum of N s ** 2 / n times that of the mean of all
        # days: once where data and days are divided alike.
        missing = 0.0
        if self.stretches:
            days, usual = self._of_window.total(), self._of_window.total() / len(self.stretches)
            shares = {w: n / len(data) for w, n in Counter(day.window for day in data).items()}
            errors = [s**2 / self._of_window.get(w, usual) for w, s in shares.items()]
            missing = days * sum(errors) - 1.0
        total = penalty = 0.0
        parts: dict[str, float] = {}
        compared: dict[str, NDArray[np.bool_]] = {}
        z: dict[str, Array] = {}
        difference: dict[str, Array] = {}
        for name, block in self.blocks.items():
            other = relative_to.blocks[name] if relative_to else block
            weight = sums[name][..., 1] / len(data)
            seen = _observations(name, other.mean, weight)
            used = other.used & (seen >= self.pools.least_weight(name))
            compared[name] = used
            value = sums[name][..., 0] / np.maximum(sums[name][..., 1], 1e-9)
            variance = block.noise(weight, len(data)) + missing * self._of_stretches[name]
            if extra is not None:
                variance = variance + extra[name]
            mean = np.where(np.isfinite(block.mean), block.mean, other.mean)
            difference[name] = np.where(used, value - mean, 0.0)
            z[name] = difference[name] / np.sqrt(variance)
            parts[name] = _mahalanobis(
                softened(name, z[name], self._thresholds), used, other.correlation
            )
            total += parts[name]
            if relative_to:
                ratio = np.log(
                    np.maximum(variance, 1e-12) / (other.variance / len(data) + other.doubt)
                )
                penalty += float(ratio[used].sum())
        return Distance(total, parts, penalty, compared, z, difference)


def _observations(block: str, mean: Array, weight: Array) -> Array:
    """Return observations per day: weights, but vehicles of turning counts, which weigh minutes."""
    return np.nan_to_num(mean) * weight if block == TURNING else weight


def softened(block: str, z: Array, thresholds: Thresholds) -> Array:
    """Return ``s asinh(z / s)``: large differences of single places count less.

    Single lanes and bins of time have heavy tails: a queue either reaches a place or does not.
    """
    soft = _softness(block, thresholds)
    return soft * np.arcsinh(z / soft) if soft < np.inf else z


def _softness(block: str, thresholds: Thresholds) -> float:
    """Return the standardised difference beyond which differences in a block count less."""
    soft = {"lane": thresholds.soft_lane, LANES: thresholds.soft_lane, "time": thresholds.soft_time}
    return soft.get(block, np.inf)


def _stack(pools: Pools, tallies: Sequence[Tally]) -> dict[str, Array]:
    """Return pooled sums of several days, ``(days, members, features, 2)``."""
    pooled = [pools.pool(tally) for tally in tallies]
    return {name: np.stack([sums[name] for sums in pooled]) for name in pooled[0]}


def _stretches(
    stacked: Mapping[str, Array], tallies: Sequence[Tally]
) -> dict[Window, dict[str, Array]]:
    """Return the mean of each stretch minus that of all days, by block; see `Reference`."""
    windows = [day.window for day in tallies]
    found: dict[Window, dict[str, Array]] = {}
    if len(set(windows)) == 1:
        return found
    for window in set(windows):
        own = np.array([other == window for other in windows])
        found[window] = {
            name: np.nan_to_num(means(sums[own]) - means(sums)) for name, sums in stacked.items()
        }
    return found


def means(sums: Array) -> Array:
    """Return ratios of sums over days; NaN without observations."""
    total = sums.sum(axis=0)
    return np.where(total[..., 1] > 0, total[..., 0] / np.maximum(total[..., 1], 1e-9), np.nan)


def by_turns(tallies: Sequence[Tally]) -> list[Tally]:
    """Return days ordered by stretch and period, so that every other day has some of each."""
    return sorted(tallies, key=lambda day: (day.window or (0.0, 0.0), day.period or ""))


def of_the_same_stretches(days: Sequence[Tally], data: Sequence[Tally]) -> list[Tally]:
    """Return the days of the stretches of measured data, in the data's proportions.

    Days of a stretch that has too many are left out, the last ones first. If a stretch has no day,
    proportions are left as they are; without any day of the stretches all days are returned.
    """
    wanted = Counter(day.window for day in data)
    found = [day for day in days if day.window in wanted]
    there = Counter(day.window for day in found)
    times = min(there[window] // number for window, number in wanted.items())
    if not times or len(wanted) == 1:
        return found or list(days)
    left = {window: times * number for window, number in wanted.items()}
    kept: list[Tally] = []
    for day in found:
        if left[day.window]:
            left[day.window] -= 1
            kept.append(day)
    return kept


def sum_of(tallies: Sequence[Tally]) -> Tally:
    """Return the tally of several periods together."""
    total = tallies[0]
    for tally in tallies[1:]:
        total = total + tally
    return total


def _smoothed(mean: Array, variance: Array, thresholds: Thresholds) -> Array:
    """Return variances of counts in bins: the estimate, mixed with the mean times a factor.

    Both arrays and the result are ``(members, bins)``. The estimate of one bin is noisy.
    """
    scale = variance.sum(axis=1, keepdims=True) / np.maximum(mean.sum(axis=1, keepdims=True), 1e-9)
    share = thresholds.proportional_share
    mixed = (1.0 - share) * variance + share * scale * mean
    return np.maximum(mixed, thresholds.least_count_variance)


def _moments(sums: Array, means: int = 1) -> tuple[Array, Array, Array, Array]:
    """Return ratio estimates from sums ``(days, members, features, 2)``.

    With sums s and numbers of observations n: mean m = Σs / Σn, residual of a day
    r = (s - m n) / mean(n), variance = Σr² / (days - means).

    Args:
        sums: Sums and numbers of observations.
        means: Number of means that were taken off the days: one for each stretch of the day.

    Returns:
        Mean, variance of one day, observations per day: all ``(members, features)``; residuals
        ``(days, members, features)``.
    """
    total = sums.sum(axis=0)
    weight = total[..., 1] / len(sums)
    mean = total[..., 0] / np.maximum(total[..., 1], 1e-9)
    residual = (sums[..., 0] - mean * sums[..., 1]) / np.maximum(weight, 1e-9)
    variance = (residual**2).sum(axis=0) / max(len(sums) - means, 1)
    mean = np.where(weight > 0, mean, np.nan)
    return mean, variance, weight, residual


def _moved(
    mean: Array, residual: Array, partner: Array, thresholds: Thresholds
) -> NDArray[np.bool_]:
    """Mark statistics that differ from those of the same days of the prior model beyond chance."""
    before, _, _, other = _moments(partner)
    days = len(partner)
    noise = ((residual - other) ** 2).sum(axis=0) / max(days - 1, 1) / days
    return np.nan_to_num((mean - before) ** 2, nan=np.inf) > thresholds.certain * noise


def _controlled(
    mean: Array,
    variance: Array,
    residual: Array,
    partner: Array,
    prior: Block,
    thresholds: Thresholds,
) -> tuple[Array, Array]:
    """Return the mean and its variance, corrected by the same days of the prior model.

    The days of the prior model are a control variate: m' = m - b (m_same - m_prior), with b the
    slope of the residuals on those of the prior model.
    """
    before, _, _, other = _moments(partner)
    spread = (other**2).sum(axis=0)
    slope = np.clip(
        (residual * other).sum(axis=0) / np.maximum(spread, 1e-12), 0.0, thresholds.steepest_control
    )
    slope = np.where(np.isfinite(prior.mean) & np.isfinite(before), slope, 0.0)
    days = len(partner)
    left = ((residual - slope * other) ** 2).sum(axis=0) / max(days - 2, 1)
    shift = np.where(slope > 0, slope * (before - prior.mean), 0.0)
    error = np.maximum(left, thresholds.least_own_share * variance) / days + slope**2 * prior.error
    return mean - shift, error


@functools.cache
def _grain(width: int, thresholds: Thresholds) -> Array:
    """Return the least standard deviation of a sum over a day, by feature or measure."""
    if width not in (len(FEATURES), len(ALL_FEATURES)):
        return np.full(width, thresholds.grain)
    return np.array(
        [
            thresholds.least_events if name in EVENT_FEATURES else thresholds.grain
            for name, _, _ in ALL_FEATURES[:width]
        ]
    )


@functools.cache
def _constant(speeds: bool) -> NDArray[np.bool_]:
    """Mark features that are never used: those that need speeds if no speeds were measured."""
    return np.array([not speeds and name in SPEED_FEATURES for name, _, _ in ALL_FEATURES])


def _correlation(residual: Array, least_shrinkage: float) -> Array:
    """Return the shrunk correlation ``(features, features)`` over all days and members.

    Args:
        residual: Standardised residuals, ``(days, members, features)``.
        least_shrinkage: Least weight of the identity.
    """
    rows = residual.reshape(-1, residual.shape[-1])
    spread = np.sqrt((rows**2).mean(axis=0))
    rows = rows / np.where(spread > 0, spread, 1.0)
    count, width = rows.shape
    sample = rows.T @ rows / count
    np.fill_diagonal(sample, 1.0)
    # Ledoit and Wolf (2004): C = (1 - k) S + k I, k = noise of S / distance of S from I.
    distance = ((sample - np.eye(width)) ** 2).sum()
    noise = float((((rows**2).T @ (rows**2)) / count - sample**2).sum()) / count
    shrinkage = min(max(noise / max(distance, 1e-12), least_shrinkage), 1.0)
    return (1 - shrinkage) * sample + shrinkage * np.eye(width)


def _mahalanobis(z: Array, used: NDArray[np.bool_], correlation: Array) -> float:
    """Return the sum over the members of ``z' C^-1 z``, each with the features it uses."""
    total = 0.0
    for members, pattern in _by_features(used):
        rows = z[members][:, pattern]
        solved = np.linalg.solve(correlation[np.ix_(pattern, pattern)], rows.T)
        total += float((rows.T * solved).sum())
    return total


def _by_features(used: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Yield the members that use the same features, and the mask of these; not those without any.

    Args:
        used: Mask of the features that each member uses, ``(members, features)``.
    """
    members: dict[bytes, list[int]] = {}  # np.unique takes twenty times as long
    for place, pattern in enumerate(used):
        members.setdefault(pattern.tobytes(), []).append(place)
    for _, places in sorted(members.items()):
        if used[places[0]].any():
            yield np.array(places), used[places[0]]


def change_between(
    pools: Pools, after: Sequence[Tally], before: Sequence[Tally]
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the change of the statistics between two models, from the same days.

    Args:
        pools: Pools of places.
        after: Days of the changed model.
        before: The same days of the model before.

    Returns:
        The differences by block, and their variances; infinite where nothing is known.
    """
    new, old = _stack(pools, after), _stack(pools, before)
    difference: dict[str, Array] = {}
    variance: dict[str, Array] = {}
    for name in new:
        mean, _, _, left = _moments(new[name])
        base, _, _, right = _moments(old[name])
        difference[name] = np.nan_to_num(mean - base)
        days = len(after)
        spread = ((left - right) ** 2).sum(axis=0) / max(days - 1, 1)
        variance[name] = np.nan_to_num(spread / days, nan=np.inf)
    return difference, variance


def shrunk(
    difference: Mapping[str, Array], variance: Mapping[str, Array], thresholds: Thresholds
) -> dict[str, Array]:
    """Return differences d shrunk towards 0: ``d max(0, 1 - certain * variance / d^2)``.

    Noise in a derivative makes the steps of a fit too short and its standard errors too small.
    """
    smaller: dict[str, Array] = {}
    for name, values in difference.items():
        squared = np.maximum(values**2, 1e-300)
        smaller[name] = values * np.maximum(
            1.0 - thresholds.certain * variance[name] / squared, 0.0
        )
    return smaller


def without_noise(
    difference: Mapping[str, Array], variance: Mapping[str, Array], thresholds: Thresholds
) -> dict[str, Array]:
    """Return differences; in blocks of `SINGLE`, those that may be chance are set to 0."""
    certain_changes: dict[str, Array] = {}
    for name, values in difference.items():
        certain = values**2 > thresholds.certain * variance[name]
        certain_changes[name] = np.where(certain, values, 0.0) if name in SINGLE else values
    return certain_changes


# --- whitening ------------------------------------------------------------------------------------

Group = tuple[NDArray[np.int64], NDArray[np.bool_], Array]
"""Members of a block with equal features, a mask of these features, and the inverse Cholesky factor
of their correlation."""


class Whitener:
    """Map from differences of statistics to one vector of independent numbers of unit noise.

    Args:
        reference: Model that gives the noise.
        data: Data set that decides which statistics are used and how exact they are.
        tolerance: Share of a measured difference that counts as noise, since predictions by
            interpolation are not more exact.
        relative_to: Model that chooses the statistics, so that vectors of different models have the
            same length; None for `reference`.
        blocks: Names of the blocks to use; None for all.

    Attributes:
        measured: The whitened difference of data and model, ``(statistics,)``.
    """

    def __init__(
        self,
        reference: Reference,
        data: Sequence[Tally],
        tolerance: float,
        relative_to: Reference | None = None,
        blocks: Collection[str] | None = None,
    ) -> None:
        distance = reference.distance(data, relative_to=relative_to)
        sums = reference.pools.pool_all(data)
        self._parts: list[tuple[str, Array, list[Group]]] = []
        for name, block in reference.blocks.items():
            if blocks is not None and name not in blocks:
                continue
            weight = sums[name][..., 1] / len(data)
            noise = block.noise(weight, len(data))
            difference = distance.difference[name]
            soft = 1.0 / _softness(
                name, reference.pools.thresholds
            )  # 0 for blocks that are not softened
            scale = np.sqrt(noise + (max(tolerance, soft) * difference) ** 2)
            groups = correlation_groups(distance.used[name], block.correlation)
            self._parts.append((name, scale, groups))
        self.measured = self(distance.difference)

    def __call__(self, differences: Mapping[str, Array]) -> Array:
        """Return whitened differences of all blocks, ``(statistics,)``."""
        rows: list[Array] = []
        for name, scale, groups in self._parts:
            rows.append(whitened(differences[name] / scale, groups))
        return np.concatenate(rows)

    @property
    def gap(self) -> float:
        """Squared length of `measured`, about its number of statistics if only noise is left."""
        return float(self.measured @ self.measured)


def correlation_groups(used: NDArray[np.bool_], correlation: Array) -> list[Group]:
    """Group members that use the same features.

    Args:
        used: Mask of the features that each member uses, ``(members, features)``.
        correlation: Correlation of the features, ``(features, features)``.
    """
    groups: list[Group] = []
    for members, pattern in _by_features(used):
        lower = np.linalg.cholesky(correlation[np.ix_(pattern, pattern)])
        groups.append((members, pattern, np.asarray(np.linalg.inv(lower), np.float64)))
    return groups


def whitened(z: Array, groups: Sequence[Group]) -> Array:
    """Return ``L^-1 z`` of every member, one after the other, where ``C = L L'``.

    Args:
        z: Standardised differences, ``(members, features)``.
        groups: Groups of members, from `correlation_groups`.
    """
    z = np.nan_to_num(z)
    rows = [(z[members][:, used] @ inverse.T).ravel() for members, used, inverse in groups]
    return np.concatenate(rows) if rows else np.empty(0)
