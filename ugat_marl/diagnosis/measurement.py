"""The detectors as they are: errors of measurement, fitted before any effect on traffic.

Every estimate here rests on kinematics and not on the behaviour of drivers. A vehicle of length L
over a zone of length z at speed v needs the time ``d = (L + z) / v``, whoever drives it. The ratio
``G = d v / (L + z)`` is 1 for steady vehicles. A detector that stays on for e s longer adds
``e v / (L + z)``, and a longer zone adds its share of length. Where vehicles accelerate, G is above
1 if speeds are measured as the rear leaves, and below 1 if they are measured at the front. The
distance between two detectors is speed times travel time.

The same estimators are applied to simulated days, so that only the differences count. The days are
those of the scenario as it is. No hypothesis is simulated.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import DetectorLayout, Greens
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import (
    EVERYWHERE,
    DetectorExtension,
    DetectorOffset,
    DetectorPulse,
    DetectorSpeeds,
    DetectorSplash,
    DetectorZone,
    Effect,
    Overlap,
    detectors_at,
    group_name,
    next_detectors,
)
from ugat_marl.scenarios import Detector, Passages, Period, SpeedPoint, edge_of_lane

Array = NDArray[np.float64]

ALONE, SECOND, THIRD, FOURTH, SIXTH, BRAKING = range(6)
"""Regimes of a passage: alone in free flow; second, third, fourth to fifth, sixth to eighth of a
queue at a stop detector; braking alone for a red at an advance detector."""

GAP_S = np.append(0.0, np.arange(0.25, 5.25, 0.25))
"""Edges of the bins of the time between two passages, s."""

# --- what is seen of single vehicles ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sightings:
    """Passages and pairs of detections from which errors of measurement are estimated.

    Attributes:
        passages: Rows of index of the detector, regime, time over the zone in s, speed in m/s (NaN
            if not measured), length of vehicle and zone in m: ``(passages, 5)``.
        pairs: Rows of index of the advance detector, travel time to the stop detector in s, mean
            speed in m/s (NaN if not measured), mean ratio of length to time over the zones in m/s:
            ``(pairs, 4)``.
        gaps: Numbers of passages by the time without a vehicle after them, ``(detectors, bins)``:
            none at all, then bins of `GAP_S`.
        twins: Rows for every detector: lone passages with a twin on the next lane, and those with
            nothing else there: ``(detectors, 2)``.
    """

    passages: Array
    pairs: Array
    gaps: Array
    twins: Array

    @classmethod
    def of(
        cls,
        layout: DetectorLayout,
        period: Period,
        greens: Sequence[Greens],
        thresholds: Thresholds,
    ) -> Self:
        """Collect the sightings of one period.

        Args:
            layout: Lanes and detectors.
            period: The period.
            greens: Greens of every lane.
            thresholds: Numbers of the method.
        """
        number = {detector.id: index for index, detector in enumerate(layout.detectors)}
        tracks = {
            detector.id: _Track.of(
                period.passages.get(detector.id, Passages.none()), detector, thresholds
            )
            for detector in layout.detectors
        }
        rows: list[Array] = []
        pairs: list[Array] = []
        for lane, green in zip(layout.lanes, greens, strict=True):
            advance, stop = (lane.detectors.get(kind, ())[:1] for kind in ("advance", "stop"))
            for name in advance:
                track = tracks[name]
                rows.append(track.rows(number[name], _before_red(track, green, thresholds)))
            for name in stop:
                track = tracks[name]
                rows.append(track.rows(number[name], _queued(track, green, thresholds)))
            if advance and stop:
                pairs.append(
                    _pairs(
                        number[advance[0]],
                        tracks[advance[0]],
                        tracks[stop[0]],
                        green,
                        lane.speed_mps,
                        thresholds,
                    )
                )
        behind = [name for _, _, names in layout.exits for name in names[:1]]
        rows += [tracks[name].rows(number[name], tracks[name].alone_only()) for name in behind]
        beside = next_detectors(layout.detectors)
        return cls(
            np.concatenate([np.empty((0, 5)), *rows]),
            np.concatenate([np.empty((0, 4)), *pairs]),
            np.array([tracks[one.id].gaps for one in layout.detectors]),
            np.array(
                [
                    _twins(tracks[one.id], [tracks[name] for name in beside[one.id]], thresholds)
                    for one in layout.detectors
                ]
            ),
        )

    def __add__(self, other: Sightings) -> Sightings:
        return Sightings(
            np.concatenate([self.passages, other.passages]),
            np.concatenate([self.pairs, other.pairs]),
            self.gaps + other.gaps,
            self.twins + other.twins,
        )

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by name, as `from_arrays` takes them."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Self:
        """Make the sightings from the result of `arrays`."""
        return cls(**{item.name: np.asarray(arrays[item.name]) for item in fields(cls)})


def together(days: Sequence[Sightings]) -> Sightings:
    """Return the sightings of several days as one."""
    total = days[0]
    for day in days[1:]:
        total = total + day
    return total


@dataclass(frozen=True, eq=False)
class _Track:
    """Whole passages over one detector in time; all arrays ``(passages,)``.

    Attributes:
        on: Begin, s.
        over: Time over the zone, s.
        speed: Speed, m/s.
        reach: Length of the vehicle and of the zone, m.
        before: Time since the begin of the passage before, s.
        after: Time until the begin of the next passage, s.
        free: True if the passage ended before the next one began.
        gaps: Numbers of passages by the time without a vehicle after them, see `Sightings`.
    """

    on: Array
    over: Array
    speed: Array
    reach: Array
    before: Array
    after: Array
    free: NDArray[np.bool_]
    gaps: Array
    thresholds: Thresholds

    @classmethod
    def of(cls, passages: Passages, detector: Detector, thresholds: Thresholds) -> Self:
        seen = passages.at(np.isfinite(passages.on_s) & np.isfinite(passages.off_s))
        on, over = seen.on_s, seen.off_s - seen.on_s
        gaps = np.diff(on)
        before, after = np.append(np.inf, gaps), np.append(gaps, np.inf)
        free = after - over > thresholds.touching_s
        length = np.where(np.isfinite(seen.length_m), seen.length_m, thresholds.length_m)
        return cls(
            on,
            over,
            seen.speed_mps,
            length + detector.length_m,
            before,
            after,
            free,
            np.append(
                float((~free[:-1]).sum()), np.histogram((after - over)[:-1][free[:-1]], GAP_S)[0]
            ),
            thresholds,
        )

    def leading(self) -> NDArray[np.bool_]:
        """Mark moving vehicles without another one close ahead."""
        limit = self.thresholds
        moving = ~(self.speed <= limit.moving_mps) & (self.over < limit.longest_alone_s)
        return (self.before > limit.free_gap_s) & moving

    def alone(self) -> NDArray[np.bool_]:
        """Mark moving vehicles without another one close ahead or behind."""
        return self.leading() & (self.after > self.thresholds.free_gap_s)

    def alone_only(self) -> NDArray[np.int64]:
        """Return regimes with lone vehicles alone; -1 for all others."""
        return np.where(self.alone(), ALONE, -1)

    def rows(self, index: int, regime: NDArray[np.int64]) -> Array:
        """Return rows of `Sightings.passages` for the passages with a regime."""
        kept = (regime >= 0) & self.free
        columns = (np.full(len(regime), index), regime, self.over, self.speed, self.reach)
        return np.column_stack(columns)[kept]


def _cycles(times: Array, greens: Greens) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the index of the last green that began before each time, and True inside a green."""
    cycle = np.searchsorted(greens.start_s, times, "right") - 1
    if not len(greens.start_s):
        return np.zeros(len(times), np.int64), np.zeros(len(times), np.bool_)
    return np.maximum(cycle, 0), (cycle >= 0) & (times < greens.end_s[np.maximum(cycle, 0)])


def _before_red(track: _Track, greens: Greens, thresholds: Thresholds) -> NDArray[np.int64]:
    """Return the regimes of passages over an advance detector."""
    cycle, green = _cycles(track.on, greens)
    regime = np.full(len(track.on), -1)
    if not len(greens.start_s):
        return track.alone_only()
    settled = green & (track.on > greens.start_s[cycle] + thresholds.settled_green_s)
    regime[track.alone() & settled] = ALONE
    red = (track.on > greens.red_s[cycle]) & (
        track.on < greens.next_s[cycle] - thresholds.before_green_s
    )
    lone = (track.before > thresholds.lone_gap_s) & ~(track.speed <= thresholds.least_braking_mps)
    regime[red & lone & (track.over < thresholds.longest_alone_s)] = BRAKING
    return regime


def _queued(track: _Track, greens: Greens, thresholds: Thresholds) -> NDArray[np.int64]:
    """Return the regimes of passages over a stop detector."""
    regime = np.full(len(track.on), -1)
    if not len(greens.start_s) or not len(track.on):
        return regime
    cycle, green = _cycles(track.on + track.over, greens)
    settled = green & (track.on > greens.start_s[cycle] + thresholds.settled_green_s)
    first = np.searchsorted(cycle, cycle, "left")
    number = np.arange(len(cycle)) - first
    crossed = track.on + track.over
    gap = np.where(number == 0, 0.0, np.diff(crossed, prepend=crossed[0]))
    broken = np.cumsum(gap > thresholds.queue_break_s)
    waited = track.on[first] < greens.start_s[cycle[first]]
    moving = ~(track.speed <= thresholds.crawling_mps) & (track.over < thresholds.longest_alone_s)
    queue = green & waited & (broken == broken[first]) & moving
    regime[track.alone() & settled & ~queue] = ALONE
    for name, low, high in ((SECOND, 1, 1), (THIRD, 2, 2), (FOURTH, 3, 4), (SIXTH, 5, 7)):
        regime[queue & (number >= low) & (number <= high)] = name
    return regime


def _pairs(
    index: int,
    advance: _Track,
    stop: _Track,
    greens: Greens,
    limit_mps: float,
    thresholds: Thresholds,
) -> Array:
    """Match lone vehicles at an advance detector with those at the stop detector behind it."""
    cycle, green = _cycles(advance.on, greens)
    lone = np.flatnonzero(advance.leading() & green)
    if not len(lone) or not len(stop.on):
        return np.empty((0, 4))
    lone = lone[advance.on[lone] > greens.start_s[cycle[lone]] + thresholds.settled_green_s]
    after = np.searchsorted(stop.on, advance.on[lone] + thresholds.least_travel_s)
    known = after < len(stop.on)
    lone, after = lone[known], after[known]
    travel = stop.on[after] - advance.on[lone]
    alone = stop.leading()[after] & (stop.on[after] < greens.end_s[cycle[lone]])
    alone &= travel < thresholds.longest_travel_s
    lone, after, travel = lone[alone], after[alone], travel[alone]
    speed = 0.5 * (advance.speed[lone] + stop.speed[after])
    pace = [x.reach[i] / np.maximum(x.over[i], 1e-3) for x, i in ((advance, lone), (stop, after))]
    # A vehicle that changed its speed on the way tells little about the distance.
    change = np.abs(advance.speed[lone] - stop.speed[after])
    change = np.where(np.isfinite(change), change, np.abs(pace[0] - pace[1]))
    rows = np.column_stack((np.full(len(lone), index), travel, speed, 0.5 * (pace[0] + pace[1])))
    return rows[change < thresholds.steady_share * limit_mps]


def _twins(track: _Track, others: Sequence[_Track], thresholds: Thresholds) -> tuple[float, float]:
    """Count lone passages for which the next lane reports the same, and those where it could."""
    lone = np.flatnonzero(track.alone())
    on, over = track.on[lone], track.over[lone]
    twins = possible = 0.0
    for other in others:
        first = np.searchsorted(other.on, on - thresholds.free_gap_s)
        near = np.searchsorted(other.on, on + thresholds.free_gap_s) - first
        same = np.zeros(len(lone), np.bool_)
        only = np.flatnonzero(near == 1)
        same[only] = (np.abs(other.on[first[only]] - on[only]) < thresholds.twin_s) & (
            np.abs(other.over[first[only]] - over[only]) < thresholds.twin_s
        )
        twins += float(same.sum())
        possible += float(((near == 0) | same).sum())
    return twins, possible


# --- estimates ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error."""

    value: float
    error: float

    def differs(self, least: float, deviations: float) -> bool:
        """Return True if the value is away from 0 by at least `least`, and beyond chance."""
        return abs(self.value) >= least and abs(self.value) > deviations * self.error


def _median(values: Array) -> Estimate:
    """Return the median and its error, ``1.2533 * 1.4826 MAD / sqrt(n)``."""
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return Estimate(middle, 1.2533 * max(spread, 1e-3) / float(np.sqrt(len(values))))


def _grain_s(times: Array) -> float:
    """Return the grain of a clock that stamps in tenths of seconds or coarser, s; 0 if finer.

    Equal times are pulses, which say nothing about the clock.
    """
    if not len(times) or np.ptp(times) < 0.05:
        return 0.0
    for grain in (1.0, 0.5, 0.2, 0.1):
        steps = times / grain
        if bool((np.abs(steps - np.round(steps)) < 0.01).all()):
            return grain
    return 0.0


@dataclass(frozen=True)
class Equation:
    """One linear equation ``value = coefficients . parameters + bend * rear`` with its error.

    Attributes:
        value: Measured minus expected.
        coefficients: One for each parameter of a group of detectors.
        bend: Difference of accelerating vehicles from steady ones if speeds are those of the rear.
        error: Standard error of `value`.
    """

    value: float
    coefficients: tuple[float, ...]
    bend: float
    error: float


@dataclass(frozen=True)
class Solution:
    """Parameters of a group of detectors.

    Attributes:
        estimates: The parameters; those that are not needed are 0 without an error.
        cost: Squared standardised misfit, with the prior and a price for every parameter.
    """

    estimates: tuple[Estimate, ...]
    cost: float


def solved(
    equations: Sequence[Equation], rear: float, prior: Sequence[float], price: float
) -> Solution:
    """Solve by least squares, with as few parameters as the data ask for.

    Args:
        equations: The equations of a group.
        rear: Weight of the bends: 1 for speeds of the rear, -1 of the front, 0 of the mean.
        prior: Prior standard deviation of each parameter; the mean is 0.
        price: Price of a parameter that is not 0.
    """
    error = np.array([one.error for one in equations])
    value = np.array([one.value - rear * one.bend for one in equations]) / error
    design = np.array([one.coefficients for one in equations]) / error[:, None]
    scale = np.array(prior)
    best = Solution(tuple(Estimate(0.0, 0.0) for _ in prior), float(value @ value))
    for count in range(1, len(prior) + 1):
        for chosen in itertools.combinations(range(len(prior)), count):
            part, spread = design[:, chosen], scale[list(chosen)]
            covariance = np.linalg.inv(part.T @ part + np.diag(spread**-2.0))
            found = covariance @ (part.T @ value)
            left = value - part @ found
            cost = float(left @ left + ((found / spread) ** 2).sum() + price * count)
            if cost < best.cost:
                estimates = [Estimate(0.0, 0.0) for _ in prior]
                for index, number, own in zip(chosen, found, np.diag(covariance), strict=True):
                    estimates[index] = Estimate(float(number), float(np.sqrt(own)))
                best = Solution(tuple(estimates), cost)
    return best


Group = tuple[str, str]
"""Kind of detectors and edge."""


def by_place(
    equations: Mapping[Group, Sequence[Equation]],
    rear: float,
    prior: Sequence[float],
    price: float,
) -> tuple[dict[str, Solution], float]:
    """Solve for all detectors together, for kinds or for approaches, whichever costs least.

    Args:
        equations: Equations by group.
        rear: Weight of the bends, see `solved`.
        prior: Prior standard deviations of the parameters.
        price: Price of a parameter that is not 0.

    Returns:
        Solutions by place (see `ugat_marl.effects.detectors_at`), and their cost.
    """

    def of(groups: Sequence[Group]) -> Solution:
        rows = [one for group in groups for one in equations[group]]
        return solved(rows, rear, prior, price)

    parts: dict[str, Solution] = {}
    for kind in sorted({kind for kind, _ in equations}):
        groups = [group for group in equations if group[0] == kind]
        whole = {kind: of(groups)}
        apart = {group_name(*group): of([group]) for group in groups}
        parts |= min(whole, apart, key=_cost) if len(groups) > 1 else whole
    everything = {EVERYWHERE: of(list(equations))} if equations else {}
    best = everything if everything and _cost(everything) <= _cost(parts) else parts
    return best, _cost(best)


def _cost(solutions: Mapping[str, Solution]) -> float:
    return sum(solution.cost for solution in solutions.values())


@dataclass(frozen=True)
class DetectorError:
    """An error of measurement that the data show.

    Attributes:
        effect: The error.
        margin: Half the width of the 95 % interval of its number, in the unit of the number; None
            if it has none.
    """

    effect: Effect
    margin: float | None = None


class Measurement:
    """Errors of the detectors, from what they report of single vehicles.

    Args:
        detectors: The detectors as they are stated.
        measured: Sightings of the data.
        simulated: Sightings of simulated days.
        thresholds: Numbers of the method.
    """

    def __init__(
        self,
        detectors: Sequence[Detector],
        measured: Sightings,
        simulated: Sightings,
        thresholds: Thresholds,
    ) -> None:
        self._detectors = tuple(detectors)
        self._measured = measured
        self._simulated = simulated
        self._thresholds = thresholds
        self._grain_s = _grain_s(measured.passages[:, 2])
        self._groups: dict[Group, list[int]] = {}
        for index, detector in enumerate(detectors):
            group = (detector.kind, edge_of_lane(detector.lane))
            self._groups.setdefault(group, []).append(index)

    def errors(self, left_out: Collection[str] = ()) -> tuple[DetectorError, ...]:
        """Return the errors of measurement that are beyond chance and large enough to matter.

        Args:
            left_out: Names of effects that are not examined.
        """
        limit = self._thresholds
        if self._grain_s > limit.coarsest_clock_s:
            return ()
        pulses = self._pulses()
        found = [
            DetectorError(DetectorPulse(place, round(seconds, 2)))
            for place, seconds in pulses.items()
        ]
        point, zones = self._zones(pulses)
        if point is not None:
            found.append(DetectorError(DetectorSpeeds(EVERYWHERE, point)))
        for place, (extension, zone) in zones.items():
            if extension.differs(limit.least_extension_s, limit.named_deviations):
                seconds = round(extension.value, 2)
                longer = DetectorExtension(place, seconds, self._overlap(place, seconds))
                found.append(DetectorError(longer, limit.half_interval * extension.error))
            if zone.differs(limit.least_zone_m, limit.named_deviations):
                changed = DetectorZone(place, round(zone.value, 1))
                found.append(DetectorError(changed, limit.half_interval * zone.error))
        for place, (farther,) in self._distances(bool(found)).items():
            if farther.differs(limit.least_offset_m, limit.named_deviations):
                moved = DetectorOffset(place, -round(farther.value, 1))
                found.append(DetectorError(moved, limit.half_interval * farther.error))
        found += self._splashes()
        return tuple(error for error in found if error.effect.name not in left_out)

    # --- single kinds of errors -------------------------------------------------------------------

    def _pulses(self) -> dict[str, float]:
        """Return the length of pulses by place, s, where detectors report no presence."""
        pulses: dict[str, float] = {}
        for group, members in self._groups.items():
            data, model = (self._of(x.passages, members) for x in (self._measured, self._simulated))
            if min(len(data), len(model)) < self._thresholds.least_sightings:
                continue
            alike = [
                float(np.mean(np.abs(x[:, 2] - np.median(x[:, 2])) < self._thresholds.touching_s))
                for x in (data, model)
            ]
            # Times in tenths of seconds are alike too, but not far from those of simulated days.
            apart = abs(float(np.median(data[:, 2]) - np.median(model[:, 2])))
            same = alike[0] > self._thresholds.pulse_share > 2.0 * alike[1]
            if same and apart > self._thresholds.least_extension_s:
                pulses[group_name(*group)] = float(np.median(data[:, 2]))
        return pulses

    def _zones(
        self, pulses: Collection[str]
    ) -> tuple[SpeedPoint | None, dict[str, tuple[Estimate, ...]]]:
        """Return the point of speed measurement, and extension and zone by place.

        The point is None if it is stated, cannot be told, or is the one of simulated days.
        """
        stated = any(detector.speed_at is not None for detector in self._detectors)
        point, best = self._point(pulses, "rear", fixed=stated)
        zones = {place: solution.estimates for place, solution in best.items()}
        return (None if point == "rear" else point), zones

    def _point(
        self, pulses: Collection[str], usual: SpeedPoint, *, fixed: bool = False
    ) -> tuple[SpeedPoint, dict[str, Solution]]:
        """Return the point of speed measurement for which vehicles that accelerate speak.

        Args:
            pulses: Places that are left out.
            usual: Point of simulated days; another one needs `Thresholds.sure_of_a_point`.
            fixed: True to take `usual` as it is.

        Returns:
            The point, and extensions and zones by place.
        """
        limit = self._thresholds
        steady = self._steady()
        equations = {
            group: self._equations(members, steady)
            for group, members in self._groups.items()
            if group_name(*group) not in pulses
        }
        equations = {group: rows for group, rows in equations.items() if rows}
        prior = (limit.usual_extension_s, limit.usual_zone_m)
        best, least = by_place(equations, 1.0, prior, limit.price_of_an_error)
        point, first = usual, least
        # Bends are those of the point of simulated days, and opposite at the other end.
        others: dict[SpeedPoint, float] = {
            "front" if usual == "rear" else "rear": -1.0,
            "mean": 0.0,
        }
        for name, weight in [] if fixed else others.items():
            places, cost = by_place(equations, weight, prior, limit.price_of_an_error)
            if cost < min(least, first - limit.sure_of_a_point):
                point, best, least = name, places, cost
        return point, best

    def contradicted_point(self) -> tuple[SpeedPoint, SpeedPoint] | None:
        """Return the stated point of speed measurement, and the one for which vehicles speak.

        None if they agree, if not all detectors state the same end of a passage, or if nothing is
        stated. The mean of both ends says nothing about either.
        """
        points: set[SpeedPoint | None] = {detector.speed_at for detector in self._detectors}
        stated = points.pop() if len(points) == 1 else None
        if stated is None or stated == "mean" or self._grain_s > self._thresholds.coarsest_clock_s:
            return None
        seen, _ = self._point(self._pulses(), stated)
        return None if seen == stated else (stated, seen)

    def _steady(self) -> float:
        """Return the ratio G of steady vehicles on simulated days.

        It is 1 if lengths of vehicles are known, and else it corrects the assumed length.
        """
        kinds = [
            index for index, one in enumerate(self._detectors) if one.kind in ("advance", "exit")
        ]
        rows = self._of(self._simulated.passages, kinds)
        rows = rows[rows[:, 1] == ALONE]
        ratio = rows[:, 2] * rows[:, 3] / rows[:, 4]
        ratio = ratio[np.isfinite(ratio)]
        return float(np.median(ratio)) if len(ratio) >= self._thresholds.least_sightings else 1.0

    def _equations(self, members: Sequence[int], steady: float) -> list[Equation]:
        """Return the equations of a group for extension and zone.

        Lone vehicles at advance detectors make two of them, since the slow and the quick half tell
        both apart. At other detectors the slow ones turn and do not drive steadily.
        """
        data, model = (self._of(x.passages, members) for x in (self._measured, self._simulated))
        speeds = np.isfinite(data[:, 3]).mean() > 0.5 if len(data) else False
        if speeds:
            data, model = (x[np.isfinite(x[:, 3])] for x in (data, model))
        equations: list[Equation] = []
        for regime in np.unique(data[:, 1]).astype(int).tolist():
            pair = [x[x[:, 1] == regime] for x in (data, model)]
            parts = [pair]
            steadily = regime == ALONE and self._detectors[members[0]].kind == "advance"
            if speeds and steadily and all(map(len, pair)):
                quick = [x[:, 3] > np.median(x[:, 3]) for x in pair]
                parts = [
                    [x[q == half] for x, q in zip(pair, quick, strict=True)] for half in (0, 1)
                ]
            for seen, known in parts:
                if min(len(seen), len(known)) >= self._thresholds.least_sightings:
                    equations.append(
                        self._of_ratio(seen, known, steady)
                        if speeds
                        else self._of_time(seen, known, len(np.unique(data[:, 1])))
                    )
        return equations

    def _of_ratio(self, seen: Array, known: Array, steady: float) -> Equation:
        """Return the equation of a regime for the ratio G."""
        limit = self._thresholds
        found, usual = (_median(x[:, 2] * x[:, 3] / x[:, 4]) for x in (seen, known))
        bend = usual.value / steady - 1.0
        # The same drivers pass all groups of a kind, so more groups are not more exact.
        kind = self._detectors[int(seen[0, 0])].kind
        alike = sum(kind == other for other, _ in self._groups)
        doubt = limit.inexact * found.value + limit.bent * abs(bend) * np.sqrt(alike)
        doubt += 0.0 if seen[0, 1] == ALONE else limit.unlike
        pace = float(np.median(seen[:, 3] / seen[:, 4]))
        doubt += 0.5 * self._grain_s * pace
        error = float(np.sqrt(found.error**2 + usual.error**2 + doubt**2)) / steady
        coefficients = (pace / steady, 1.0 / float(np.median(seen[:, 4])) / steady)
        return Equation(found.value / steady - 1.0, coefficients, bend, error)

    def _of_time(self, seen: Array, known: Array, regimes: int) -> Equation:
        """Return the equation of a regime for the time over the zone, where speeds are missing."""
        limit = self._thresholds
        found, usual = _median(seen[:, 2]), _median(known[:, 2])
        kind = self._detectors[int(seen[0, 0])].kind
        steadily = seen[0, 1] == ALONE and kind == "advance"
        share = limit.speed_doubt if steadily else limit.queue_doubt
        # The same drivers pass all groups of a kind, so more groups are not more exact.
        alike = sum(kind == other for other, _ in self._groups) * (1 if steadily else regimes)
        doubt = share * usual.value * np.sqrt(alike) + 0.5 * self._grain_s
        error = float(np.hypot(found.error, doubt))
        slowness = usual.value / float(np.median(known[:, 4]))
        return Equation(found.value - usual.value, (1.0, slowness), 0.0, error)

    def _overlap(self, place: str, seconds: float) -> Overlap:
        """Return how close vehicles are reported, from the passages that touch the next one."""
        names = detectors_at(place, self._detectors)
        members = [index for index, one in enumerate(self._detectors) if one.id in names]
        data, model = (x.gaps[members].sum(axis=0) for x in (self._measured, self._simulated))
        expected = model[: 1 + int(np.searchsorted(GAP_S, seconds))].sum() / max(model.sum(), 1.0)
        touching = data[0] / max(data.sum(), 1.0)
        return "merged" if touching < self._thresholds.merged_share * expected else "split"

    def _distances(self, times_changed: bool) -> dict[str, tuple[Estimate, ...]]:
        """Return by how much advance and stop detectors are farther apart than stated, m."""
        limit = self._thresholds
        equations: dict[Group, list[Equation]] = {}
        for group, members in self._groups.items():
            data, model = (self._of(x.pairs, members) for x in (self._measured, self._simulated))
            speeds = bool(np.isfinite(data[:, 2]).all())
            least = limit.least_sightings * (1 if speeds else 2)
            if group[0] != "advance" or min(len(data), len(model)) < least:
                continue
            if not speeds and times_changed:
                continue  # times over the zones then say nothing about speeds
            found, usual = (_median(x[:, 1] * x[:, 2 if speeds else 3]) for x in (data, model))
            doubt = (limit.inexact if speeds else limit.pace_doubt) * usual.value
            error = float(np.sqrt(found.error**2 + usual.error**2 + doubt**2))
            equations[group] = [Equation(found.value - usual.value, (1.0,), 0.0, error)]
        places, _ = by_place(equations, 0.0, (limit.usual_offset_m,), limit.price_of_an_error)
        return {
            ("advance" if place == EVERYWHERE else place): solution.estimates
            for place, solution in places.items()
        }

    def _splashes(self) -> list[DetectorError]:
        """Return the kinds of detectors that report vehicles of the next lane.

        With s the share of reported vehicles, a share ``f = 2 s / (1 + s)`` of lone passages has a
        twin: both the vehicle and its splash have one.
        """
        limit = self._thresholds
        found: list[DetectorError] = []
        for kind in sorted({kind for kind, _ in self._groups}):
            members = [i for i, one in enumerate(self._detectors) if one.kind == kind]
            data, model = (x.twins[members].sum(axis=0) for x in (self._measured, self._simulated))
            if min(data[1], model[1]) < limit.least_sightings:
                continue
            share, usual = data[0] / data[1], model[0] / model[1]
            error = np.sqrt((share + 1.0 / data[1]) / data[1] + (usual + 1.0 / model[1]) / model[1])
            excess = Estimate(float(share - usual), float(error))
            if excess.differs(2.0 * limit.least_splash, limit.named_deviations):
                splash = excess.value / (2.0 - excess.value)
                margin = limit.half_interval * excess.error / (2.0 - excess.value)
                found.append(DetectorError(DetectorSplash(kind, round(splash, 3)), margin))
        return found

    @staticmethod
    def _of(rows: Array, members: Sequence[int]) -> Array:
        return rows[np.isin(rows[:, 0], members)]
