"""The detectors as they are: errors of measurement, fitted before any effect on traffic.

Every estimate here rests on kinematics and not on the behaviour of drivers. A vehicle of length L
over a zone of length z at speed v needs the time ``d = (L + z) / v``, whoever drives it. The ratio
``G = d v / (L + z)`` is 1 for steady vehicles. A detector that stays on for e s longer adds
``e v / (L + z)``, and a longer zone adds its share of length. Where vehicles accelerate, G is above
1 if speeds are measured as the rear leaves, and below 1 if they are measured at the front. The
distance between two detectors is speed times travel time.

The same estimators are applied to simulated days, so that only the differences count. The days are
those of the scenario as it is, and later those of effects that a search has found: slow drivers
hide where speeds are measured.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.error_places import (
    Choice,
    Equation,
    ErrorPlaces,
    Group,
    Number,
    ValueWithError,
)
from ugat_marl.diagnosis.sightings import ALONE, GAP_EDGES_S, QUEUED, Sightings
from ugat_marl.diagnosis.splash import Splash
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
)
from ugat_marl.scenarios import Detector, SpeedPoint, edge_of_lane

Array = NDArray[np.float64]

Form = Literal["excess", "ratio"]
"""What is compared of vehicles with speeds: the excess time over the zone, or the ratio G."""
FORMS: tuple[Form, ...] = ("excess", "ratio")

_EXTENSION = 0
"""Index of the extension in the numbers of a place; the other one is the length of the zone."""


@dataclass(frozen=True)
class _Median(ValueWithError):
    """A median with its error, and the robust spread of single values."""

    spread: float


def _median(values: Array) -> _Median:
    """Return the median and its error, ``1.2533 * 1.4826 MAD / sqrt(n)``."""
    middle = float(np.median(values))
    spread = max(1.4826 * float(np.median(np.abs(values - middle))), 1e-3)
    return _Median(middle, 1.2533 * spread / float(np.sqrt(len(values))), spread)


def _grain_s(times: Array) -> float:
    """Return the grain of a clock that stamps in tenths of seconds or coarser, s; 0 if finer.

    Equal times are pulses, which say nothing about the clock.
    """
    if not len(times) or np.ptp(times) < 0.05:
        return 0.0
    known = np.unique(np.round(times, 3))
    grain = float(np.diff(known, prepend=0.0)[known > 0].min())  # no difference is smaller
    steps = times / grain
    is_grain = grain >= 0.1 - 1e-6 and bool((np.abs(steps - np.round(steps)) < 0.01).all())
    return round(grain, 3) if is_grain else 0.0


@dataclass(frozen=True)
class DetectorError:
    """An error of measurement that the data show.

    Attributes:
        effect: The error.
        margin: Half the width of the 95 % interval of its number, in the unit of the number; None
            if it has none.
        rival: Another error at the same place that explains the data as well; None if none does.
    """

    effect: Effect
    margin: float | None = None
    rival: Effect | None = None

    @property
    def ends(self) -> list[Effect]:
        """The error at both ends of its interval, within its range; none without a number."""
        if not self.margin:
            return []
        ((name, plausible),) = self.effect.ranges.items()
        value = getattr(self.effect, name)
        return [
            replace(self.effect, **{name: plausible.nearest(value + sign * self.margin)})
            for sign in (-1.0, 1.0)
        ]

    @property
    def kind_and_place(self) -> tuple[str | None, ...]:
        """Name and place of the error, and the point of measurement of speeds."""
        return (self.effect.name, *(getattr(self.effect, key, None) for key in ("place", "point")))


@dataclass(frozen=True)
class _Zones:
    """Points of speed measurement, extensions, and lengths of zones.

    Attributes:
        points: Places where speeds are measured at another point than usual.
        estimates: Extensions and lengths of zones.
        rivals: For some of them, the other number at the same place, if it alone explains the data
            hardly worse.
    """

    points: Mapping[str, SpeedPoint]
    estimates: Mapping[Number, ValueWithError]
    rivals: Mapping[Number, ValueWithError]

    def without(
        self, left_out: Collection[str]
    ) -> Iterator[tuple[Number, ValueWithError, ValueWithError | None]]:
        """Yield the numbers and their rivals; a rival takes the place of one that is left out."""
        names = DetectorExtension.name, DetectorZone.name
        for number, estimate in self.estimates.items():
            place, index = number
            other = self.rivals.get(number)
            if names[index] in left_out and other is not None:
                number, estimate, other = (place, 1 - index), other, None
            elif names[1 - index] in left_out:
                other = None
            yield number, estimate, other


def _changed(measured: Array, simulated: Array) -> float:
    """Return the share by which vehicles pass at another speed than simulated, from 0 to 1.

    A changed reported speed may come from another measuring point, a changed time over the zone
    from an extension. Only what both show counts: the smaller change, or 0 if they disagree in
    sign.
    """
    reported, timed = (
        np.log(np.median(street) / np.median(model))
        for street, model in (
            (measured[:, 3], simulated[:, 3]),
            (_paces(measured), _paces(simulated)),
        )
    )
    if reported * timed <= 0.0:
        return 0.0
    return float(-np.expm1(-min(abs(reported), abs(timed))))


def _paces(passages: Array) -> Array:
    """Return lengths by times over the zone, m/s."""
    return passages[:, 4] / np.maximum(passages[:, 2], 1e-3)


def _cheapest(
    searches: Sequence[ErrorPlaces], elsewhere: Mapping[str, float] | None = None
) -> Choice:
    """Return the cheapest choice of several searches.

    All are repeated from the best choice of the first pass.
    """
    best = Choice({}, 0.0)
    for _ in range(2):
        choices = [search.choose(elsewhere, [*best.estimates]) for search in searches]
        best = min(choices, key=lambda choice: choice.cost, default=best)
    return best


def _solved(
    searches: Sequence[ErrorPlaces], numbers: Collection[Number], elsewhere: Mapping[str, float]
) -> Choice:
    """Return the cheapest values of given numbers in several searches."""
    return min((one.solved(numbers, elsewhere) for one in searches), key=lambda one: one.cost)


class Measurement:
    """Errors of the detectors, from what they report of single vehicles.

    Args:
        detectors: The detectors as they are stated.
        measured: Sightings of the data.
        simulated: Sightings of simulated days.
        thresholds: Numbers of the method.

    Attributes:
        grain_s: Grain of the stamps of the data, s; 0 if it is finer than tenths of seconds.
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
        self.grain_s = _grain_s(measured.passages[:, 2])
        self._kinds = frozenset(detector.kind for detector in detectors)
        self._groups: dict[Group, list[int]] = {}
        for index, detector in enumerate(detectors):
            group = (detector.kind, edge_of_lane(detector.lane))
            self._groups.setdefault(group, []).append(index)

    @property
    def too_coarse(self) -> bool:
        """True if the stamps are too coarse to show errors of detectors."""
        return self.grain_s > self._thresholds.coarsest_clock_s

    def errors(self, left_out: Collection[str] = ()) -> tuple[DetectorError, ...]:
        """Return the errors of measurement that are beyond chance and large enough to matter.

        There are none if the stamps are `too_coarse`.

        Args:
            left_out: Names of effects that are not examined.
        """
        limit = self._thresholds
        if self.too_coarse:
            return ()
        pulses = self._pulses
        found = [DetectorError(DetectorPulse(place, seconds)) for place, seconds in pulses.items()]
        offsets = self._offsets if self._pairs_have_speeds else {}
        stated = any(detector.speed_at is not None for detector in self._detectors)
        zones = self._points_and_zones(pulses, "rear", self._indices(offsets), fixed=stated)
        found += [DetectorError(DetectorSpeeds(at, point)) for at, point in zones.points.items()]
        for number, estimate, other in zones.without(left_out):
            if self._matters(number, estimate):
                place, index = number
                rival = None if other is None else self._of_zone(place, 1 - index, other)
                margin = limit.half_interval * estimate.error
                found.append(DetectorError(self._of_zone(*number, estimate), margin, rival))
        # Without speeds, distances come from times over the zones, which any other error falsifies.
        if not self._pairs_have_speeds and not found:
            offsets = self._offsets
        for place, farther in offsets.items():
            wrong = DetectorOffset(place, -round(farther.value, 1))
            found.append(DetectorError(wrong, limit.half_interval * farther.error))
        found += self._splashes
        return tuple(error for error in found if error.effect.name not in left_out)

    @property
    def _pairs_have_speeds(self) -> bool:
        """True if most pairs of passages have speeds, or there is none."""
        known = np.isfinite(self._measured.pairs[:, 2])
        return not len(known) or bool(known.mean() > 0.5)

    def _indices(self, places: Collection[str]) -> frozenset[int]:
        """Return the indices of all detectors at some places."""
        return frozenset(index for place in places for index in self._members(place))

    @staticmethod
    def _possible(index: int, estimate: ValueWithError) -> bool:
        """Return True if an extension or zone is within the range of its effect."""
        ranges = (DetectorExtension.ranges["seconds"], DetectorZone.ranges["metres"])
        return ranges[index].holds(estimate.value)

    def _matters(self, number: Number, estimate: ValueWithError, times: float = 1.0) -> bool:
        """Return True if an extension or zone is possible, large enough, and beyond chance."""
        limit, (_, index) = self._thresholds, number
        least = times * (limit.least_extension_s, limit.least_zone_m)[index]
        differs = estimate.differs(least, limit.named_deviations)
        return differs and self._possible(index, estimate)

    def _of_zone(self, place: str, index: int, estimate: ValueWithError) -> Effect:
        """Return the effect of an extension or of the length of a zone."""
        if index == _EXTENSION:
            seconds = round(estimate.value, 2)
            return DetectorExtension(place, seconds, self._overlap(place, seconds))
        return DetectorZone(place, round(estimate.value, 1))

    # --- single kinds of errors -------------------------------------------------------------------

    @functools.cached_property
    def _pulses(self) -> dict[str, float]:
        """Length of pulses by place, s, where detectors report no presence."""
        return self._together(self._pulses_of_groups())

    def _pulses_of_groups(self) -> dict[Group, float]:
        """Return the length of pulses by group, s, where detectors report no presence."""
        pulses: dict[Group, float] = {}
        for group, members in self._groups.items():
            measured, simulated = (
                self._of(x.passages, members) for x in (self._measured, self._simulated)
            )
            if min(len(measured), len(simulated)) < self._thresholds.least_sightings:
                continue
            alike = [
                float(np.mean(np.abs(x[:, 2] - np.median(x[:, 2])) < self._thresholds.touching_s))
                for x in (measured, simulated)
            ]
            # Times in tenths of seconds are alike too, but not far from those of simulated days.
            apart = abs(float(np.median(measured[:, 2]) - np.median(simulated[:, 2])))
            same = alike[0] > self._thresholds.pulse_share > 2.0 * alike[1]
            if same and apart > max(self.grain_s, self._thresholds.touching_s):
                seconds = round(float(np.median(measured[:, 2])), 2)
                pulses[group] = DetectorPulse.ranges["seconds"].nearest(seconds)
        return pulses

    def _together(self, pulses: Mapping[Group, float]) -> dict[str, float]:
        """Return the pulses by place, with all groups of a kind as the kind if they are alike."""
        places: dict[str, float] = {}
        for kind in sorted({kind for kind, _ in pulses}):
            own = {group: seconds for group, seconds in pulses.items() if group[0] == kind}
            seconds = next(iter(own.values()))
            times = [
                self._of(self._measured.passages, members)[:, 2]
                for (other, _), members in self._groups.items()
                if other == kind
            ]
            same = [np.abs(x - seconds) < self._thresholds.touching_s for x in times if len(x)]
            if all(x.mean() > self._thresholds.pulse_share for x in same):
                places[kind] = seconds
            else:
                places |= {group_name(*group): seconds for group, seconds in own.items()}
        whole = {kind for kind, _ in self._groups}
        if len(whole) > 1 and set(places) == whole and len(set(places.values())) == 1:
            return {EVERYWHERE: next(iter(places.values()))}
        return places

    def _points_and_zones(
        self,
        pulses: Collection[str],
        usual: SpeedPoint,
        moved: Collection[int] = (),
        *,
        fixed: bool = False,
    ) -> _Zones:
        """Return where speeds are measured, by place, and extensions and zones.

        Vehicles that accelerate tell the points apart.

        Args:
            pulses: Places that are left out.
            usual: Point of simulated days; another one needs `Thresholds.sure_of_a_point`.
            moved: Indices of detectors that stand elsewhere.
            fixed: True to take `usual` as it is.
        """
        limit = self._thresholds
        searches = self._searches(pulses, moved)
        best = _cheapest(searches)
        points: dict[str, SpeedPoint] = {}
        there: dict[str, float] = {}
        if searches and not fixed:
            numbers, places = [*best.estimates], searches[0].places
            other: SpeedPoint = "front" if usual == "rear" else "rear"
            shares: dict[SpeedPoint, float] = {other: 1.0, "mean": 0.5}
            least = best.cost - limit.sure_of_a_point
            # a smaller place has to be better than a larger one
            for place, (point, share) in product(places, shares.items()):
                here = {place: share}
                if place in (EVERYWHERE, *self._kinds):
                    choice = _cheapest(searches, here)
                else:
                    tried = (_solved(searches, some, here) for some in ((), numbers))
                    choice = min(tried, key=lambda one: one.cost)
                cost = choice.cost + searches[0].multiplicity[place]
                if cost < least - (limit.narrower_place if points else 0.0):
                    least, best = cost, choice
                    points, there = {place: point}, here
        best = self._without_opposites(searches, best, there)
        return _Zones(points, best.estimates, self._rivals(searches, best, there))

    def _without_opposites(
        self, searches: Sequence[ErrorPlaces], best: Choice, elsewhere: Mapping[str, float]
    ) -> Choice:
        """Remove pairs of a longer zone and a delayed onset, or the opposites, at one place.

        Their effects cancel except for slow vehicles, where they look like other drivers. A pair is
        kept only if both numbers are large and either of them would matter alone. Else the better
        one is kept, if it matters alone.
        """
        for place in dict.fromkeys(place for place, _ in best.estimates):
            pair = [(place, 0), (place, 1)]
            values = [best.estimates[one].value for one in pair if one in best.estimates]
            if len(values) < len(pair) or math.prod(values) > 0.0:
                continue
            others = [one for one in best.estimates if one not in pair]
            single = {one: _solved(searches, [*others, one], elsewhere) for one in pair}
            alone = [single[one] for one in pair if self._matters(one, single[one].estimates[one])]
            large = all(self._matters(one, best.estimates[one], 2.0) for one in pair)
            if not (alone and large):
                none = _solved(searches, others, elsewhere)
                best = min(alone, key=lambda one: one.cost, default=none)
        return best

    def _rivals(
        self, searches: Sequence[ErrorPlaces], best: Choice, elsewhere: Mapping[str, float]
    ) -> dict[Number, ValueWithError]:
        """Return extensions that explain the data as well as a zone does, and the reverse."""
        rivals: dict[Number, ValueWithError] = {}
        for number in best.estimates:
            place, index = number
            other = (place, 1 - index)
            if other in best.estimates:
                continue
            numbers = [other if one == number else one for one in best.estimates]
            instead = _solved(searches, numbers, elsewhere)
            estimate = instead.estimates[other]
            near = instead.cost < best.cost + self._thresholds.told_apart
            if near and self._possible(1 - index, estimate):
                rivals[number] = estimate
        return rivals

    def _searches(self, pulses: Collection[str], moved: Collection[int]) -> tuple[ErrorPlaces, ...]:
        """Return the searches for extensions and zones: one for each form of the equations.

        An extension adds the same to all excess times, and a zone the same to all ratios. Where
        vehicles are not alike, the other form is less exact.
        """
        limit, steady = self._thresholds, self._steady()
        short = {index for place in pulses for index in self._members(place)}
        searches: list[ErrorPlaces] = []
        for form in FORMS:
            equations = {
                group: rows
                for group, members in self._groups.items()
                if short.isdisjoint(members)
                and (rows := self._equations(members, steady, form, set(members) <= set(moved)))
            }
            priors = (limit.usual_extension_s, limit.usual_zone_m)
            if equations:
                searches.append(ErrorPlaces(equations, priors, limit.price_of_an_error))
        return tuple(searches)

    def contradicted_point(self) -> tuple[SpeedPoint, SpeedPoint] | None:
        """Return the stated point of speed measurement, and the one that the vehicles show.

        None if they agree, if not all detectors state the same end of a passage, or if nothing is
        stated. The mean of both ends says nothing about either.
        """
        points: set[SpeedPoint | None] = {detector.speed_at for detector in self._detectors}
        stated = points.pop() if len(points) == 1 else None
        if stated is None or stated == "mean" or self.too_coarse:
            return None
        offsets = self._offsets if self._pairs_have_speeds else {}
        shown = self._points_and_zones(self._pulses, stated, self._indices(offsets)).points
        return next(((stated, point) for point in shown.values()), None)

    def _steady(self) -> float:
        """Return the ratio G of steady vehicles on simulated days.

        It is near 1 if lengths of vehicles are known, and else it corrects the assumed length. With
        too few vehicles it is 1.
        """
        indices = [
            index for index, one in enumerate(self._detectors) if one.kind in ("advance", "exit")
        ]
        rows = self._of(self._simulated.passages, indices)
        rows = rows[rows[:, 1] == ALONE]
        ratio = rows[:, 2] * rows[:, 3] / rows[:, 4]
        ratio = ratio[np.isfinite(ratio)]
        return float(np.median(ratio)) if len(ratio) >= self._thresholds.least_sightings else 1.0

    def _equations(
        self, members: Sequence[int], steady: float, form: Form, moved: bool
    ) -> list[Equation]:
        """Return the equations of a group for extension and zone.

        Free vehicles give two equations, for the slower and the faster half, which separates
        extension from zone length. At stop lines they give one, since they may wait there. At
        detectors in another position than stated only the faster half is used: braking there is
        not simulated.
        """
        measured, simulated = (
            self._of(x.passages, members) for x in (self._measured, self._simulated)
        )
        speeds = np.isfinite(measured[:, 3]).mean() > 0.5 if len(measured) else False
        if speeds:
            measured, simulated = (x[np.isfinite(x[:, 3])] for x in (measured, simulated))
        equations: list[Equation] = []
        for regime in np.unique(measured[:, 1]).astype(int).tolist():
            if regime == QUEUED and equations:
                continue  # drivers differ more in a queue: it counts where there is nothing else
            pair = [x[x[:, 1] == regime] for x in (measured, simulated)]
            parts = {} if moved else {"": pair}
            steadily = regime == ALONE and self._detectors[members[0]].kind != "stop"
            if speeds and steadily and all(map(len, pair)):
                quick = [x[:, 3] > np.median(x[:, 3]) for x in pair]
                parts = {
                    name: [x[q == half] for x, q in zip(pair, quick, strict=True)]
                    for half, name in enumerate(("slow", "quick"))
                    if not moved or name == "quick"
                }
            for name, (of_street, of_model) in parts.items():
                if min(len(of_street), len(of_model)) < self._thresholds.least_sightings:
                    continue
                if not speeds or _changed(of_street, of_model) <= self._thresholds.like_speeds:
                    equations.append(
                        self._of_speeds(of_street, of_model, steady, form, name)
                        if speeds
                        else self._of_time(of_street, of_model)
                    )
        return equations

    def _of_speeds(
        self, measured: Array, simulated: Array, steady: float, form: Form, half: str
    ) -> Equation:
        """Return the equation of a regime with speeds, in s.

        The value is ``d - (L + z) / v``, or ``(G - 1) (L + z) / v`` with the median of G. Both are
        the same for one vehicle. Vehicles that accelerate by a add ``a d^2 / (2 v)``. Where speeds
        are not those of the simulated days, a need not be theirs either.
        """
        limit, one = self._thresholds, self._detectors[int(measured[0, 0])]
        over_here, speed, reach = (float(np.median(measured[:, column])) for column in (2, 3, 4))
        if form == "excess":
            found, usual = (
                _median(x[:, 2] - steady * x[:, 4] / x[:, 3]) for x in (measured, simulated)
            )
        else:
            found, usual = (
                _median((x[:, 2] * x[:, 3] / x[:, 4] - steady) * reach / speed)
                for x in (measured, simulated)
            )
        over = float(np.median(simulated[:, 2]))
        bend = max(abs(usual.value), usual.spread)
        if int(measured[0, 1]) == ALONE:  # queues spread if speeds are measured elsewhere, too
            bend = max(bend, found.spread)
        doubt = limit.inexact * over + limit.bent_here * bend + 0.5 * self.grain_s
        alike = limit.bent_alone * bend
        kind, regime = one.kind, int(measured[0, 1])
        if regime != ALONE:
            alike += limit.unlike * over
        changed = _changed(measured, simulated)
        driven = limit.hard_mps2 * over_here**2 / (2.0 * speed)
        return Equation(
            found.value - usual.value,
            (1.0, 1.0 / speed),
            float(np.sqrt(found.error**2 + usual.error**2 + doubt**2)),
            shared={
                kind: limit.bent * usual.value,
                f"{kind} {regime} {half}": alike,
                f"speeds of {kind}@{edge_of_lane(one.lane)}": changed * driven,
            },
            other_end=-2.0 * usual.value,
        )

    def _of_time(self, measured: Array, simulated: Array) -> Equation:
        """Return the equation of a regime for the time over the zone, where speeds are missing."""
        limit = self._thresholds
        found, usual = _median(measured[:, 2]), _median(simulated[:, 2])
        kind = self._detectors[int(measured[0, 0])].kind
        steadily = measured[0, 1] == ALONE and kind == "advance"
        doubt = usual.value * (limit.speed_doubt if steadily else limit.queue_doubt)
        slowness = usual.value / float(np.median(simulated[:, 4]))
        return Equation(
            found.value - usual.value,
            (1.0, slowness),
            math.hypot(found.error, usual.error, doubt + 0.5 * self.grain_s),
            shared={f"{kind} {steadily}": doubt},
        )

    def _overlap(self, place: str, seconds: float) -> Overlap:
        """Return how close vehicles are reported, from the passages that touch the next one."""
        limit, members = self._thresholds, self._members(place)
        measured, simulated = (
            x.gaps[members].sum(axis=0) for x in (self._measured, self._simulated)
        )
        closer = simulated[: int(np.searchsorted(GAP_EDGES_S, seconds + 1e-9, "right"))].sum()
        share = closer / max(simulated.sum(), 1.0)
        expected = float(share * measured.sum())
        if expected < limit.least_touching:
            return "unknown"
        # Some gaps are too small for the clock, and no sign of vehicles apart.
        chance = measured[1] * max(self.grain_s, limit.no_gap_s) / GAP_EDGES_S[1]
        return "split" if measured[0] - chance > limit.merged_share * expected else "merged"

    def _members(self, place: str) -> list[int]:
        names = detectors_at(place, self._detectors)
        return [index for index, one in enumerate(self._detectors) if one.id in names]

    @functools.cached_property
    def _offsets(self) -> dict[str, ValueWithError]:
        """By how much advance and stop detectors are farther apart than stated, m.

        Approaches with splash are left out: what crosses both detectors need not be one vehicle.
        """
        limit = self._thresholds
        splashed = {
            edge_of_lane(self._detectors[index].lane)
            for error in self._splashes
            for index in self._members(str(error.effect.record()["place"]))
        }
        speeds = self._pairs_have_speeds
        least = limit.least_pairs if speeds else 2 * limit.least_sightings
        distances: dict[Group, tuple[Array, Array]] = {}
        for group, members in self._groups.items():
            measured, simulated = (
                self._of(x.pairs, members) for x in (self._measured, self._simulated)
            )
            if group[0] != "advance" or group[1] in splashed:
                continue
            if speeds:
                measured, simulated = (x[np.isfinite(x[:, 2])] for x in (measured, simulated))
            if len(measured) >= least and 2 * len(simulated) >= least:
                travel = [x[:, 1] * x[:, 2 if speeds else 3] for x in (measured, simulated)]
                here_m, there_m = (float(np.median(x)) for x in travel)
                before_m = min(self._detectors[index].position_m for index in members)
                # On very short roads, what crosses both need not be one vehicle either: then the
                # stated distance is not found on simulated days, or the lane is too short for it.
                stated_m = self._stated_m(np.unique(measured[:, 0]).astype(int).tolist())
                astray_m = max(abs(there_m - stated_m), here_m - there_m - before_m)
                if not astray_m > limit.most_astray_m:
                    distances[group] = travel[0], travel[1]
        # The spread of a few may be small by chance.
        spread = float(
            np.median([_median(simulated).spread for _, simulated in distances.values()] or [0])
        )
        equations: dict[Group, list[Equation]] = {}
        for group, pair in distances.items():
            found, usual = map(_median, pair)
            chance = [
                max(one.error, 1.2533 * spread / np.sqrt(len(x)))
                for one, x in zip((found, usual), pair, strict=True)
            ]
            doubt = (limit.inexact if speeds else limit.pace_doubt) * usual.value
            error = math.hypot(doubt, *chance)
            equations[group] = [Equation(found.value - usual.value, (1.0,), error)]
        search = ErrorPlaces(equations, (limit.usual_offset_m,), limit.price_of_an_error)
        return {
            place: farther
            for (place, _), farther in search.choose().estimates.items()
            if farther.differs(limit.least_offset_m, limit.named_deviations)
            and DetectorOffset.ranges["metres"].holds(-farther.value)
        }

    def _stated_m(self, members: Sequence[int]) -> float:
        """Return the stated distance of advance detectors from those at the stop line, m."""
        stops: dict[str, float] = {}
        for one in self._detectors:
            if one.kind == "stop":
                stops.setdefault(one.lane, one.position_m)
        advance = [self._detectors[index] for index in members]
        return float(np.median([stops[x.lane] - x.position_m for x in advance if x.lane in stops]))

    @functools.cached_property
    def _splashes(self) -> list[DetectorError]:
        """Places of detectors that report vehicles of the next lane."""
        limit = self._thresholds
        shares = Splash(
            self._detectors, self._groups, self._measured, self._simulated, limit, self.grain_s
        ).shares()
        equations = {
            group: [Equation(share.value, (1.0,), share.error)] for group, share in shares.items()
        }
        search = ErrorPlaces(equations, (limit.usual_splash,), limit.price_of_an_error)
        found: list[DetectorError] = []
        for (place, _), share in search.choose().estimates.items():
            known = share.differs(limit.least_splash, limit.named_deviations)
            if known and DetectorSplash.ranges["share"].holds(share.value):
                members = set(self._members(place))
                here = [one for one in shares if members & set(self._groups[one])]
                sure = all(shares[one].counted for one in here)
                doubt = 0.0 if sure else limit.splash_doubt * share.value
                margin = limit.half_interval * math.hypot(share.error, doubt)
                found.append(DetectorError(DetectorSplash(place, round(share.value, 3)), margin))
        return found

    @staticmethod
    def _of(rows: Array, members: Sequence[int]) -> Array:
        return rows[np.isin(rows[:, 0], members)]
