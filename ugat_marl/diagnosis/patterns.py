"""Patterns in what is left: a sparse regression behind the search, told in one sentence.

Where no effect of the library explains the data, single vehicles still tell where, when and for
whom the simulation is wrong. Three quantities are compared with simulated days: the gaps of
discharging queues, the speeds of free vehicles, and the numbers of vehicles. They are sorted into
cells by place, kind of detector, position in the queue, age of green, time of day and length of
vehicle. With m the simulated mean of a cell, s^2 its variance and n numbers of observations,

    y = m (1 + b),   a = w m (y - m),   v = w m^2,   1 / w = s^2 (1 / n_measured + 1 / n_simulated).

A pattern is a set of cells that differs by the same share b: all cells of some lanes, from some
vehicle on, in some window of time. Its best share is b = sum(a) / sum(v), and it explains
sum(a)^2 / sum(v). All such sets are compared, and the best one is taken off, until only chance is
left. The shares of all sets found are estimated together, so that of two that overlap each has what
the other leaves. Chance is known from simulated days that are treated as data.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import DetectorLayout, Discharge, Greens, free_vehicles
from ugat_marl.diagnosis.records import Pattern
from ugat_marl.diagnosis.residual import drawn_days, log_moments, log_normal_tail
from ugat_marl.diagnosis.thresholds import DayThresholds, Thresholds
from ugat_marl.effects import DemandLevel, DemandSurge, Effect, LaneService
from ugat_marl.scenarios import DetectorKind, Passages, Period

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Named = dict[tuple[object, ...], tuple[Mask, int]]
"""Values and number of limits of sets along an axis, by what each set is."""

QUANTITIES = ("discharge", "free speed", "count")
"""Gaps of queued vehicles from the second on, s; speeds of free vehicles at advance detectors, m/s;
vehicles per bin of time."""
POSITIONS = (2, 3, 4, 6, 9)
"""First positions in the queue of the cells: 2nd, 3rd, 4th and 5th, 6th to 8th, 9th and later."""
AGES_S = (0.0, 10.0, 20.0, 30.0, 45.0)
"""Begins of the cells in the age of green, s."""
MOST_LOST_S = 30.0
"""Most seconds of a green that a lane may leave unused."""
USUAL_GAP_S = 2.0
"""Time that a queued vehicle takes, for patterns that end with some vehicle, s."""
KINDS: tuple[DetectorKind, ...] = ("advance", "stop", "exit")
AXES = ("place", "kind", "position", "age", "time", "length")
_AGE = AXES.index("age")


# --- cells ----------------------------------------------------------------------------------------


def cells_of(
    layout: DetectorLayout, period: Period, greens: Sequence[Greens], thresholds: Thresholds
) -> dict[str, Array]:
    """Sort the vehicles of a period into cells.

    Args:
        layout: Lanes and detectors.
        period: The period.
        greens: Greens of every lane.
        thresholds: Numbers of the method.

    Returns:
        By quantity, numbers of observations, their sums and their sums of squares, by place, kind,
        position, age, time, length of vehicle: ``(places, kinds, positions, ages, bins, 2, 3)``.
    """
    places, lanes = len(layout.lanes) + len(layout.exits), len(layout.lanes)
    wished = round(period.length_s / thresholds.pattern_bin_s)
    bins = min(max(1, wished), thresholds.most_pattern_bins)
    shapes = {
        "discharge": (lanes, 1, len(POSITIONS), len(AGES_S), bins, 2, 3),
        "free speed": (lanes, 1, 1, 1, bins, 2, 3),
        "count": (places, len(KINDS), 1, 1, bins, 1, 3),
    }
    cells = {name: np.zeros(shape) for name, shape in shapes.items()}
    for index, (lane, green) in enumerate(zip(layout.lanes, greens, strict=True)):
        for kind, name in lane.detectors.items():
            seen = period.of_detector(name)
            if kind == "stop":
                _queue(cells["discharge"][index, 0], seen, green, period, thresholds)
            if kind == "advance":
                _free(cells["free speed"][index, 0, 0, 0], seen, green, period, thresholds)
            _count(cells["count"][index, KINDS.index(kind), 0, 0, :, 0], seen, period)
    for index, (_, _, name) in enumerate(layout.exits):
        place = cells["count"][lanes + index, KINDS.index("exit"), 0, 0, :, 0]
        _count(place, period.of_detector(name), period)
    return cells


def _queue(
    cells: Array, stop: Passages, greens: Greens, period: Period, thresholds: Thresholds
) -> None:
    """Add gaps of one lane to cells ``(positions, ages, bins, 2, 3)``."""
    queue = Discharge.of(stop, greens, thresholds)
    if queue is None:
        return
    used = queue.protected & (queue.number >= 1)
    position = np.searchsorted(POSITIONS, queue.number + 1, "right") - 1
    age = np.searchsorted(AGES_S, queue.stop.off_s - queue.start_s, "right") - 1
    where = (
        position,
        age,
        _bins(queue.start_s, period, cells.shape[2]),
        _long(queue.stop, thresholds),
    )
    _add(cells, tuple(axis[used] for axis in where), queue.gap_s[used])


def _free(
    cells: Array, advance: Passages, greens: Greens, period: Period, thresholds: Thresholds
) -> None:
    """Add speeds of free vehicles of one lane to cells ``(bins, 2, 3)``."""
    advance = advance.at(np.isfinite(advance.on_s))
    if len(advance) < 2 or not len(greens.start_s):
        return
    used = free_vehicles(advance, greens, thresholds) & np.isfinite(advance.speed_mps)
    where = (_bins(advance.on_s, period, cells.shape[0]), _long(advance, thresholds))
    _add(cells, tuple(axis[used] for axis in where), advance.speed_mps[used])


def _count(cells: Array, seen: Passages, period: Period) -> None:
    """Add the counts of one detector to cells ``(bins, 3)``."""
    span = period.begin_s, period.end_s
    counts = np.histogram(seen.counted_s, len(cells), span)[0].astype(np.float64)
    cells += np.stack([np.ones_like(counts), counts, counts**2], axis=-1)


def _add(cells: Array, where: tuple[NDArray[np.int64], ...], values: Array) -> None:
    for power in range(3):
        np.add.at(cells[..., power], where, values**power)


def _bins(times: Array, period: Period, bins: int) -> NDArray[np.int64]:
    share = (times - period.begin_s) / period.length_s
    return np.clip((share * bins).astype(np.int64), 0, bins - 1)


def _long(seen: Passages, thresholds: DayThresholds) -> NDArray[np.int64]:
    """Return 1 for vehicles that are known to be long, else 0."""
    return (seen.length_m > thresholds.long_vehicle_m).astype(np.int64)


# --- sets of cells --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AxisSets:
    """Sets of values along one axis: all of them, and those that a sentence can name.

    Attributes:
        names: What each set is; None for all values.
        masks: Their values, ``(sets, values)``.
        limits: Number of limits that each set needs in a sentence.
    """

    names: tuple[tuple[object, ...] | None, ...]
    masks: Mask
    limits: tuple[int, ...]

    @classmethod
    def of(cls, width: int, named: Named) -> AxisSets:
        """Make the sets of an axis; sets that are empty, whole or repeated are left out.

        Args:
            width: Number of values.
            named: Values and number of limits of each set.
        """
        names: list[tuple[object, ...] | None] = [None]
        masks, limits = [np.ones(width, np.bool_)], [0]
        known = {masks[0].tobytes()}
        for name, (mask, count) in named.items():
            if mask.any() and mask.tobytes() not in known:
                known.add(mask.tobytes())
                names.append(name)
                masks.append(mask)
                limits.append(count)
        return cls(tuple(names), np.stack(masks), tuple(limits))


def place_sets(layout: DetectorLayout, width: int) -> AxisSets:
    """Return sets of lanes: approaches, movements of all and of single approaches, single lanes."""
    places = layout.places[:width]
    turns = [lane.directions for lane in layout.lanes]
    turns = (turns + [frozenset[str]()] * len(layout.exits))[:width]
    edges = dict.fromkeys(edge for _, edge, _ in places)
    on = {edge: np.array([edge == other for _, other, _ in places]) for edge in edges}
    moving = {
        letter: np.array([turn == frozenset(letter) for turn in turns])
        for letter in ("s", "l", "r")
    }
    named: Named = {}
    named |= {(edge, ""): (mask, 1) for edge, mask in on.items()}
    named |= {("", letter): (mask, 1) for letter, mask in moving.items()}
    for edge, letter in itertools.product(on, moving):
        named[edge, letter] = on[edge] & moving[letter], 2
    incoming = {lane.id for lane in layout.lanes}
    for index, (_, _, lane) in enumerate(places):
        # A lane between two lights is two places: in front of one of them, and behind the other.
        behind = index >= len(layout.lanes) and lane in incoming
        named[lane, "exit" if behind else "lane"] = np.arange(len(places)) == index, 2
    return AxisSets.of(len(places), named)


def sets_of(layout: DetectorLayout, shape: Sequence[int]) -> tuple[AxisSets, ...]:
    """Return the sets along every axis of cells of this shape, in the order of `AXES`."""
    _, kinds, positions, ages, bins, lengths = shape
    windows: Named = {
        (first, last): (_between(bins, first, last), 1 + (first > 0 and last < bins))
        for first in range(bins)
        for last in range(first + 1, bins + 1)
    }
    of_kinds: Named = {(kind,): (np.arange(kinds) == n, 1) for n, kind in enumerate(KINDS)}
    long: Named = {("long",): (np.arange(lengths) == 1, 1)} if lengths > 1 else {}
    return (
        place_sets(layout, shape[0]),
        AxisSets.of(kinds, of_kinds if kinds > 1 else {}),
        AxisSets.of(positions, _sides(positions, POSITIONS, 1)),
        AxisSets.of(ages, _sides(ages, AGES_S, 0.0)),
        AxisSets.of(bins, windows),
        AxisSets.of(lengths, long),
    )


def _sides(width: int, begins: Sequence[float], before: float) -> Named:
    """Return the sets "from one value on" and "up to one value".

    Args:
        width: Number of values.
        begins: Start of each.
        before: Distance from a begin to the end of the value before.
    """
    sides: Named = {}
    for place in range(1, width):
        sides[begins[place], None] = _between(width, place, width), 1
        sides[None, begins[place] - before] = _between(width, 0, place), 1
    return sides


def _between(width: int, first: int, last: int) -> Mask:
    return (np.arange(width) >= first) & (np.arange(width) < last)


# --- regression -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class PatternTerm:
    """One set of cells with its share.

    Attributes:
        chosen: Index of the set along every axis.
        share: Measured over simulated, minus 1.
        error: Standard error of `share`.
        gain: Squared standardised size.
    """

    chosen: tuple[int, ...]
    share: float
    error: float
    gain: float


class Regression:
    """Differences of one quantity from simulated days, and the sets of cells that explain them.

    Args:
        sets: Sets along every axis.
        simulated: Cells of simulated days, one item for each day.
        counts: True for numbers of vehicles, which differ from hour to hour.
        thresholds: Numbers of the method.
    """

    def __init__(
        self,
        sets: Sequence[AxisSets],
        simulated: Sequence[Array],
        thresholds: Thresholds,
        *,
        counts: bool = False,
    ) -> None:
        self._sets = tuple(sets)
        self._price = thresholds.price_of_a_limit
        self._limits = thresholds
        self._counts = counts
        self._total = np.sum(simulated, axis=0)
        self._usual = self._usual_of(self._total)

    def _usual_of(self, total: Array) -> tuple[Array, Array]:
        """Return mean and variance of single observations in every cell."""
        limits = self._limits
        pooled = total if self._counts else total.sum(axis=4, keepdims=True)
        number, sums, squares = np.moveaxis(pooled, -1, 0)
        used = number >= limits.least_simulated
        mean = np.where(used, sums / np.maximum(number, 1.0), 0.0)
        variance = squares / np.maximum(number, 1.0) - mean**2
        least = mean if self._counts else (limits.least_relative_spread * mean) ** 2
        shape = total.shape[:-1]
        return np.broadcast_to(mean, shape), np.broadcast_to(np.maximum(variance, least), shape)

    def pulls(self, measured: Array) -> tuple[Array, Array]:
        """Return a and v of every cell, see the module."""
        return self._pulls(measured, self._total[..., 0], *self._usual)

    @staticmethod
    def _pulls(measured: Array, known: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
        number, sums = measured[..., 0], measured[..., 1]
        used = (number > 0) & (known > 0) & (mean > 0)
        spread = variance * (1.0 / np.maximum(number, 1e-9) + 1.0 / np.maximum(known, 1e-9))
        weight = np.where(used, 1.0 / np.where(used, spread, 1.0), 0.0)
        apart = np.where(used, sums / np.maximum(number, 1e-9) - mean, 0.0)
        return weight * mean * apart, weight * mean**2

    def best(self, pull: Array, size: Array) -> PatternTerm:
        """Return the set of cells that explains most for its number of limits."""
        a, v = self._summed(pull), self._summed(size)
        gain = np.where(v > 0, a**2 / np.maximum(v, 1e-12), 0.0)
        limits = np.zeros(())
        for sets in self._sets:
            limits = limits[..., None] + np.array(sets.limits)
        chosen = np.unravel_index(int(np.argmax(gain - self._price * limits)), gain.shape)
        share, own = float(a[chosen] / max(v[chosen], 1e-12)), float(v[chosen])
        place = tuple(int(index) for index in chosen)
        return PatternTerm(place, share, 1.0 / math.sqrt(max(own, 1e-12)), float(gain[chosen]))

    def together(self, measured: Array, terms: Sequence[PatternTerm]) -> list[PatternTerm]:
        """Return terms with the shares that explain most together, by weighted least squares."""
        pull, size = self.pulls(measured)
        masks = [self.mask(term) for term in terms]
        sizes = [[float((size * one * other).sum()) for other in masks] for one in masks]
        pulls = [float((pull * mask).sum()) for mask in masks]
        shares = np.linalg.lstsq(np.array(sizes), np.array(pulls), rcond=None)[0]
        return [replace(term, share=float(b)) for term, b in zip(terms, shares, strict=True)]

    def without(self, measured: Array, terms: Sequence[PatternTerm]) -> Array:
        """Return data from which the shares of terms are taken off."""
        left, (mean, _) = measured.copy(), self._usual
        for term in terms:
            left[..., 1] -= term.share * self.mask(term) * mean * measured[..., 0]
        return left

    def of(self, term: PatternTerm, measured: Array) -> tuple[float, float]:
        """Return share and standard error of data in the set of cells of a term.

        Slower vehicles are in later cells of green, among those that are always late there. So the
        age of green is left out of the comparison if the term has no limit there.
        """
        mask, total = self.mask(term), self._total
        if term.chosen[_AGE] == 0:
            measured, total = (cells.sum(axis=_AGE, keepdims=True) for cells in (measured, total))
            mask = mask.max(axis=_AGE, keepdims=True)
        pull, size = self._pulls(measured, total[..., 0], *self._usual_of(total))
        own = max(float((size * mask).sum()), 1e-12)
        return float((pull * mask).sum()) / own, 1.0 / math.sqrt(own)

    def mask(self, term: PatternTerm) -> Array:
        """Return 1 for the cells of a term, else 0."""
        mask = np.ones(())
        for sets, index in zip(self._sets, term.chosen, strict=True):
            mask = mask[..., None] * sets.masks[index]
        return mask

    def names(self, term: PatternTerm) -> list[tuple[object, ...] | None]:
        """Return what the set is along every axis; None for all values."""
        return [sets.names[index] for sets, index in zip(self._sets, term.chosen, strict=True)]

    def _summed(self, values: Array) -> Array:
        for axis, sets in enumerate(self._sets):
            values = np.moveaxis(
                np.tensordot(sets.masks.astype(np.float64), values, axes=(1, axis)), 0, axis
            )
        return values


def patterns(
    layout: DetectorLayout,
    measured: Sequence[Mapping[str, Array]],
    heldout: Sequence[Mapping[str, Array]],
    simulated: Sequence[Mapping[str, Array]],
    quantities: Sequence[str],
    span: tuple[float, float],
    thresholds: Thresholds,
    alpha: float,
) -> tuple[Pattern, ...]:
    """Find the patterns in what is left, the strongest first.

    Args:
        layout: Lanes and detectors.
        measured: Cells of the fitted periods, see `cells_of`.
        heldout: Cells of the held-out periods; a pattern must be there too, if there are any.
        simulated: Cells of days of the model.
        quantities: Names of the quantities to examine, of `QUANTITIES`.
        span: Begin and end of the periods, s.
        thresholds: Numbers of the method.
        alpha: Level of the test.
    """
    found: list[tuple[float, Pattern]] = []
    for quantity in quantities:
        cells = [day[quantity] for day in simulated]
        sets, counts = sets_of(layout, cells[0].shape[:-1]), quantity == "count"
        regression = Regression(sets, cells, thresholds, counts=counts)
        chance = list(_by_chance(sets, cells, len(measured), thresholds, counts=counts))
        moments = log_moments(chance, thresholds.least_log_spread)
        for term, p, again in _terms(
            regression,
            np.sum([day[quantity] for day in measured], axis=0),
            np.sum([day[quantity] for day in heldout], axis=0) if heldout else None,
            lambda gain, moments=moments: log_normal_tail(gain, *moments),
            functools.cache(
                functools.partial(
                    _spread, regression, cells, (len(measured), len(heldout)), thresholds
                )
            ),
            thresholds,
            alpha / len(quantities),
        ):
            found.append((term.gain, _pattern(quantity, regression, term, p, again, span, cells)))
    found.sort(key=lambda pair: -pair[0])
    return tuple(pattern for _, pattern in found[: thresholds.most_patterns])


def _terms(
    regression: Regression,
    measured: Array,
    heldout: Array | None,
    chance: Callable[[float], float],
    spread: Callable[[tuple[int, ...]], tuple[float, float]],
    thresholds: Thresholds,
    alpha: float,
) -> Iterator[tuple[PatternTerm, float, float | None]]:
    """Yield terms with their p value and their share on the held-out periods."""

    def judged(terms: Sequence[PatternTerm]) -> list[tuple[PatternTerm, float | None] | None]:
        """Return each with what the others leave, and with that on the held-out periods, if any.

        None for a term that is too small, or that the held-out periods do not have.
        """
        found: list[tuple[PatternTerm, float | None] | None] = []
        for place, term in enumerate(terms):
            others = [*terms[:place], *terms[place + 1 :]]
            share, error = regression.of(term, regression.without(measured, others))
            again, holds = None, abs(share) >= thresholds.least_share
            wide, wide_again = spread(term.chosen)
            error = max(error, wide)
            if heldout is not None:
                again, doubt = regression.of(term, regression.without(heldout, others))
                doubt = max(doubt, wide_again)
                holds &= again * math.copysign(1.0, share) >= thresholds.half_interval * doubt
            found.append((replace(term, share=share, error=error), again) if holds else None)
        return found

    terms: list[PatternTerm] = []
    kept: list[tuple[PatternTerm, float | None] | None] = []
    while len(terms) < thresholds.most_patterns:
        new = regression.best(*regression.pulls(regression.without(measured, terms)))
        if chance(new.gain) > alpha:
            break
        more = regression.together(measured, [*terms, new])
        found = judged(more)
        if found[-1] is None:
            break
        terms, kept = more, found
    for one in filter(None, kept):
        term, again = one
        yield term, chance(term.gain), again


def _spread(
    regression: Regression,
    cells: Sequence[Array],
    periods: tuple[int, int],
    thresholds: Thresholds,
    chosen: tuple[int, ...],
) -> tuple[float, float]:
    """Return the standard deviation of the share of a term over simulated data.

    Cells are no independent observations: several detectors count the same vehicles.

    Args:
        regression: Regression on the simulated days.
        cells: Cells of these days.
        periods: Numbers of the fitted and of the held-out periods.
        thresholds: Numbers of the method.
        chosen: Index of the term's set along every axis.

    Returns:
        The deviations for as many fitted and for as many held-out periods; 0 without any.
    """
    term = PatternTerm(chosen, 0.0, 0.0, 0.0)
    found: list[float] = []
    for size in periods:
        generator = np.random.default_rng(6)
        shares: list[float] = []
        for _ in range(2 * thresholds.pattern_draws if size else 0):
            days = drawn_days(generator, len(cells), size, thresholds)
            shares.append(regression.of(term, np.sum([cells[int(day)] for day in days], axis=0))[0])
        found.append(float(np.std(shares, ddof=1)) if len(shares) > 1 else 0.0)
    return found[0], found[1]


def _by_chance(
    sets: Sequence[AxisSets],
    cells: Sequence[Array],
    periods: int,
    thresholds: Thresholds,
    *,
    counts: bool,
) -> Iterator[float]:
    """Yield the largest gains of simulated days that are treated as data."""
    generator = np.random.default_rng(5)
    for half in (0, 1):
        model = Regression(sets, cells[half::2], thresholds, counts=counts)
        others = cells[1 - half :: 2]
        for _ in range(thresholds.pattern_draws):
            days = drawn_days(generator, len(others), periods, thresholds)
            drawn = np.sum([others[int(day)] for day in days], axis=0)
            yield model.best(*model.pulls(drawn)).gain


def _pattern(
    quantity: str,
    regression: Regression,
    term: PatternTerm,
    p: float,
    again: float | None,
    span: tuple[float, float],
    cells: Sequence[Array],
) -> Pattern:
    place, kind, position, age, window, length = regression.names(term)
    width = (span[1] - span[0]) / cells[0].shape[4]
    where, movement = place or ("", "")
    share, held = term.share, again
    error = term.error
    if quantity == "discharge":  # a gap longer by b lets 1 / (1 + b) as many vehicles cross
        share, error = 1.0 / (1.0 + share) - 1.0, error / (1.0 + share) ** 2
        held = None if held is None else 1.0 / (1.0 + held) - 1.0
    bounds = None if window is None else [span[0] + width * float(str(edge)) for edge in window]
    return Pattern(
        quantity=quantity,
        place=str(where) or None,
        movement=str(movement) or None,
        detectors=None if kind is None else str(kind[0]),
        vehicles=_limits(position),
        green_s=_limits(age),
        window=None if bounds is None else (bounds[0], bounds[1]),
        long_vehicles=length is not None,
        change=share,
        error=error,
        heldout_change=held,
        p=p,
    )


def _limits(name: tuple[object, ...] | None) -> tuple[float | None, float | None] | None:
    """Return the name of a set of `_sides` as numbers."""
    if name is None:
        return None
    first, last = (None if value is None else float(str(value)) for value in name)
    return first, last


# --- unnamed correction ---------------------------------------------------------------------------


def unnamed_effects(
    found: Sequence[Pattern], layout: DetectorLayout, origins: Collection[str], decision_s: float
) -> tuple[Effect, ...]:
    """Return changes of service and demand that imitate patterns, whatever their cause.

    Slower discharge becomes seconds of green that a lane does not use, in every decision or at the
    start of green. Counts of whole entries become demand. Patterns of some hours of the discharge,
    of long vehicles, of single kinds of detectors behind an entry, and of speeds are left out.

    Args:
        found: Patterns, see `patterns`.
        layout: Lanes and detectors.
        origins: Edges on which vehicles start.
        decision_s: Time between two decisions of a controller, s.
    """
    service: dict[str, tuple[float, float]] = {}  # seconds at the begin, and how much gaps grow
    counts: defaultdict[str, list[Pattern]] = defaultdict(list)
    for one in found:
        if one.quantity == "discharge" and one.window is None and not one.long_vehicles:
            until_s = _until_s(one)
            lost_s = 0.0 if until_s is None else -one.change * until_s
            growth = 1.0 / (1.0 + one.change) - 1.0 if until_s is None else 0.0
            for lane in _lanes_of(one, layout):
                before = service.get(lane, (0.0, 0.0))
                service[lane] = before[0] + lost_s, before[1] + growth
        elif (
            one.quantity == "count"
            and one.place
            and one.place in origins
            and one.movement is None
            and one.detectors != "stop"
        ):
            counts[one.place].append(one)
    demand = [effect for place, of_place in counts.items() for effect in _demand(place, of_place)]
    lost: list[Effect] = []
    for lane, (lost_s, growth) in service.items():
        begin, each = (
            round(min(max(seconds, 0.0), MOST_LOST_S), 1)
            for seconds in (lost_s, decision_s * (1.0 - 1.0 / (1.0 + max(growth, 0.0))))
        )
        if begin or each:
            lost.append(LaneService(lane, begin, each))
    return (*demand, *lost)


def _demand(place: str, found: Sequence[Pattern]) -> Iterator[Effect]:
    """Yield the effects of patterns in the counts of one road.

    Changes of patterns that overlap add up, but effects multiply. So each stretch of time between
    two edges of windows has one surge, on top of the level of the day.
    """
    factors = DemandLevel.ranges["factor"]
    level = factors.nearest(1.0 + sum(one.change for one in found if one.window is None))
    if any(one.window is None for one in found):
        yield DemandLevel(place, level)
    surges = [(one.window, one.change) for one in found if one.window is not None]
    edges = sorted({edge for window, _ in surges for edge in window})
    for begin_s, end_s in itertools.pairwise(edges):
        change = sum(c for (first_s, last_s), c in surges if first_s <= begin_s and end_s <= last_s)
        if change and level:  # of no vehicles there is no surge
            yield DemandSurge(place, begin_s, end_s, factors.nearest(1.0 + change / level))


def _until_s(pattern: Pattern) -> float | None:
    """Return the age of green, s, at which a pattern ends; None if it does not."""
    _, until_s = pattern.green_s or (None, None)
    _, until = pattern.vehicles or (None, None)
    return until * USUAL_GAP_S if until_s is None and until is not None else until_s


def _lanes_of(pattern: Pattern, layout: DetectorLayout) -> list[str]:
    """Return the incoming lanes of a pattern."""
    sets = place_sets(layout, len(layout.lanes))
    name = (
        None
        if not (pattern.place or pattern.movement)
        else (pattern.place or "", pattern.movement or "")
    )
    mask = sets.masks[sets.names.index(name)]
    return [lane.id for lane, used in zip(layout.lanes, mask, strict=True) if used]
