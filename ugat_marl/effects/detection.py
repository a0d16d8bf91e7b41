"""Errors of measurement: where detectors really lie, and what they report of each vehicle.

They are properties of the detectors and say nothing about drivers. A diagnosis fits them before it
looks for effects on traffic (`ugat_marl.diagnosis.measurement`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects.base import (
    EVERYWHERE,
    NumberParameter,
    Owner,
    TextParameter,
    hashed_uniform,
)
from ugat_marl.effects.detectors import DetectorEffect, edited
from ugat_marl.errors import UnknownNameError
from ugat_marl.scenarios import (
    SPEED_POINTS,
    Detector,
    Passages,
    Period,
    SpeedPoint,
    edge_of_lane,
)

_PLACE = TextParameter("detectors", everywhere=True)

Overlap = Literal["split", "merged", "unknown"]
"""Report of vehicles that follow so closely that the detector never goes off between them:
``split`` ends the first at the arrival of the second, ``merged`` reports one long passage.
``unknown`` is simulated as ``split``: no vehicle follows so closely that it could be told.
`passages_as_written` cuts the first; until then passages overlap."""


def detectors_at(place: str, detectors: Sequence[Detector], effect: str = "") -> frozenset[str]:
    """Return the ids of the detectors at a place.

    Args:
        place: ``*`` for all, the id of a detector, a kind such as ``advance``, or ``<kind>@<edge>``
            for those of a kind on an edge.
        detectors: All detectors.
        effect: Name of the effect for the error.

    Raises:
        UnknownNameError: No detector is at the place.
    """
    groups: dict[str, set[str]] = {}
    for detector in detectors:
        kind, edge = detector.kind, edge_of_lane(detector.lane)
        for group in (EVERYWHERE, kind, group_name(kind, edge)):
            groups.setdefault(group, set()).add(detector.id)
    for detector in detectors:
        groups[detector.id] = {detector.id}  # an id comes before a kind of the same name
    if place not in groups:
        raise UnknownNameError("detectors", place, groups, f"Effect {effect!r} names them.")
    return frozenset(groups[place])


def _more(metres: float) -> str:
    return "longer" if metres > 0 else "shorter"


def group_name(kind: str, edge: str) -> str:
    """Return the place of all detectors of a kind on an edge."""
    return f"{kind}@{edge}"


@dataclass(frozen=True)
class _OfDetectors(DetectorEffect):
    """Base of effects on a group of detectors, see `detectors_at`."""

    place: str

    def _changed(
        self, detectors: Sequence[Detector], change: Callable[[Detector], Detector]
    ) -> tuple[Detector, ...]:
        names = detectors_at(self.place, detectors, self.name)
        return tuple(change(one) if one.id in names else one for one in detectors)

    def _edited(
        self,
        period: Period,
        detectors: Sequence[Detector],
        change: Callable[[str, Passages], Passages],
    ) -> Period:
        return edited(period, detectors_at(self.place, detectors, self.name), change)


@dataclass(frozen=True)
class _OfInstallation(_OfDetectors):
    """Base of effects on detectors that are installed otherwise than stated."""

    on_installation: ClassVar[bool] = True

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Check the place; the passages are recorded by the true installation already."""
        detectors_at(self.place, detectors, self.name)
        return period


@dataclass(frozen=True)
class DetectorOffset(_OfInstallation):
    """Detectors lie `metres` farther downstream than stated; negative means upstream."""

    name: ClassVar[str] = "detector_offset"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", -60.0, 60.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"place": _PLACE}
    metres: float

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        where = "upstream" if self.metres < 0 else "downstream"
        return f"lie {abs(self.metres):.3g} m farther {where} than stated"

    def installed(self, detectors: Sequence[Detector]) -> tuple[Detector, ...]:
        """Move the zones along their lanes, but not beyond the start of the lane."""
        return self._changed(
            detectors, lambda one: replace(one, position_m=max(one.position_m + self.metres, 0.0))
        )


@dataclass(frozen=True)
class DetectorZone(_OfInstallation):
    """Zones of detectors are `metres` longer than stated, at their downstream end."""

    name: ClassVar[str] = "detector_zone"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", -30.0, 30.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"place": _PLACE}
    metres: float

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        return f"have zones {abs(self.metres):.3g} m {_more(self.metres)} than stated"

    def installed(self, detectors: Sequence[Detector]) -> tuple[Detector, ...]:
        """Change the lengths of the zones, at least to 0."""
        return self._changed(
            detectors, lambda one: replace(one, length_m=max(one.length_m + self.metres, 0.0))
        )


@dataclass(frozen=True)
class DetectorSpeeds(_OfInstallation):
    """Detectors measure speeds at another point of the passage than stated."""

    name: ClassVar[str] = "detector_speeds"
    texts: ClassVar[dict[str, TextParameter]] = {
        "place": _PLACE,
        "point": TextParameter("point of a passage", allowed=SPEED_POINTS),
    }
    point: SpeedPoint

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        where = {"front": "when the front arrives", "rear": "when the rear leaves"}
        return f"measure speeds {where.get(self.point, 'in the mean of front and rear')}"

    def installed(self, detectors: Sequence[Detector]) -> tuple[Detector, ...]:
        """Set the point at which speeds are measured."""
        return self._changed(detectors, lambda one: replace(one, speed_at=self.point))


@dataclass(frozen=True)
class DetectorExtension(_OfDetectors):
    """Detectors stay on for `seconds` after the rear has left.

    A negative number is a delay: detectors go on only when a vehicle has been there that long.
    A vehicle that leaves earlier is not reported.

    Controllers and detector units can do both. NTCIP 1202, objects 2.3.2.6 (vehicleDetectorExtend,
    up to 25.5 s) and 2.3.2.5 (vehicleDetectorDelay).
    """

    name: ClassVar[str] = "detector_extension"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", -5.0, 10.0)}
    texts: ClassVar[dict[str, TextParameter]] = {
        "place": _PLACE,
        "overlap": TextParameter(
            "report of close vehicles", allowed=("split", "merged", "unknown")
        ),
    }
    seconds: float
    overlap: Overlap

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        if self.seconds < 0:
            return f"go on {-self.seconds:.3g} s after a vehicle arrives"
        return f"stay on {self.seconds:.3g} s after a vehicle has left"

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Move the ends, or for a delay the begins, of all passages."""

        def extended(name: str, passages: Passages) -> Passages:
            if self.seconds < 0:
                late = replace(passages, on_s=passages.on_s - self.seconds)
                return late.at(~(late.on_s >= late.off_s))
            longer = replace(passages, off_s=passages.off_s + self.seconds)
            return _merged(longer) if self.overlap == "merged" else longer

        return self._edited(period, detectors, extended)

    def undone(self, period: Period, detectors: Sequence[Detector]) -> Period:
        """Take the extension off the ends; a delay and merged vehicles stay as they are."""

        def shorter(name: str, passages: Passages) -> Passages:
            ends = passages.off_s - max(self.seconds, 0.0)
            return replace(passages, off_s=np.where(ends < passages.on_s, passages.on_s, ends))

        return self._edited(period, detectors, shorter)


def _merged(passages: Passages) -> Passages:
    """Return passages in which each group without an off in between is one passage.

    It has the speed and the length of its first vehicle.
    """
    if not len(passages):
        return passages
    begin, end = passages.spans()
    latest = np.maximum.accumulate(end)
    first = np.append(True, begin[1:] > latest[:-1])
    last = np.append(first[1:], True)
    alone = first & last
    ends = np.where(np.isfinite(latest), latest, np.nan)
    return replace(passages.at(first), off_s=np.where(alone, passages.off_s, ends)[last])


@dataclass(frozen=True)
class DetectorPulse(_OfDetectors):
    """Detectors report a pulse of `seconds` per vehicle instead of its presence."""

    name: ClassVar[str] = "detector_pulse"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 0.01, 2.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"place": _PLACE}
    seconds: float

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        return f"report pulses of {self.seconds:.3g} s instead of presence"

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """End all passages after the pulse; a vehicle that came before the period has none."""

        def pulsed(name: str, passages: Passages) -> Passages:
            known = passages.at(np.isfinite(passages.on_s))
            return replace(known, off_s=known.on_s + self.seconds)

        return self._edited(period, detectors, pulsed)


@dataclass(frozen=True)
class DetectorSplash(_OfDetectors):
    """Detectors also report this share of the vehicles over those of the next lanes."""

    name: ClassVar[str] = "detector_splash"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"place": _PLACE}
    share: float

    def in_words(self) -> str:
        """Return the error as a predicate of its detectors."""
        return f"also report {100 * self.share:.3g} % of the vehicles on the next lanes"

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Add passages of the next lanes, chosen by a hash of the detector, number and time.

        A second splash chooses independently of the first.
        """
        beside = next_detectors(detectors)

        def splashed(name: str, passages: Passages) -> Passages:
            parts = [passages]
            for other in beside.get(name, ()):
                seen = period.of_detector(other)
                parts.append(seen.at(self._chosen(name, other, seen, passages)))
            return Passages.concatenated(parts)

        return self._edited(period, detectors, splashed)

    def undone(self, period: Period, detectors: Sequence[Detector]) -> Period:
        """Take off as many twins of passages on the next lanes as there are by this share.

        With the counts c of the street and the pairs A of a detector and one beside it, detectors
        with the error report (1 + share A) c. Of a pair of twins one stays.
        """
        beside = next_detectors(detectors)
        index = {detector.id: number for number, detector in enumerate(detectors)}
        own = detectors_at(self.place, detectors, self.name)
        pairs = [(name, other) for name in own for other in beside[name]]
        shares = np.eye(len(index))
        for name, other in pairs:
            shares[index[name], index[other]] += self.share
        counts = np.array([len(period.of_detector(name)) for name in index], np.float64)
        street = np.maximum(np.linalg.lstsq(shares, counts)[0], 0.0)
        extra = {(name, other): self.share * float(street[index[other]]) for name, other in pairs}
        gone: dict[str, set[int]] = {name: set() for name in index}
        for _, one, first, other, second in sorted(_twins(period, extra)):
            if first in gone[one] or second in gone[other]:
                continue
            sides = (((one, other), first), ((other, one), second))
            side, place = max(sides, key=lambda each: extra.get(each[0], 0.0))
            if extra.get(side, 0.0) >= 0.5:
                extra[side] -= 1.0
                gone[side[0]].add(place)

        def thinned(name: str, passages: Passages) -> Passages:
            kept = np.ones(len(passages), np.bool_)
            kept[list(gone[name])] = False
            return passages.at(kept)

        return self._edited(period, detectors, thinned)

    def _chosen(
        self, name: str, other: str, seen: Passages, reported: Passages
    ) -> NDArray[np.bool_]:
        times = [set(zip(x.on_s.tolist(), x.off_s.tolist(), strict=True)) for x in (seen, reported)]
        earlier = len(times[0] & times[1])  # passages that an earlier splash has added
        names = (name, other, *([str(earlier)] if earlier else ()))
        return np.array(
            [
                hashed_uniform("splash", *names, str(n), f"{time:.3f}") < self.share
                for n, time in enumerate(seen.seen_s.tolist())
            ],
            dtype=np.bool_,
        )


TWIN_S = 0.5
"""Longest time between the begins of a passage and of its twin on the next lane, s."""


def _twins(
    period: Period, pairs: Iterable[tuple[str, str]]
) -> Iterator[tuple[float, str, int, str, int]]:
    """Yield the passages of neighbours that begin together: how far apart, then whose and which."""
    for one, other in {tuple(sorted(pair)) for pair in pairs}:
        first, second = period.of_detector(one), period.of_detector(other)
        begins = np.nan_to_num(second.on_s, nan=-np.inf)
        order = np.argsort(begins)
        low, high = (
            np.searchsorted(begins[order], first.on_s + shift).tolist()
            for shift in (-TWIN_S, TWIN_S)
        )
        for number, on_s in enumerate(first.on_s.tolist()):
            for place in order[low[number] : high[number]].tolist():
                apart_s = abs(second.on_s[place] - on_s)
                apart_s += abs(np.nan_to_num(second.off_s[place] - first.off_s[number]))
                yield float(apart_s), one, number, other, place


def next_detectors(detectors: Sequence[Detector]) -> dict[str, tuple[str, ...]]:
    """Return the nearest detector of the same kind on each lane beside, by detector.

    A lane whose id does not end in a number, as SUMO's do, has no lane beside.
    """
    by_place: dict[tuple[str, str], list[Detector]] = {}
    for detector in detectors:
        by_place.setdefault((detector.lane, detector.kind), []).append(detector)
    beside: dict[str, tuple[str, ...]] = {}
    for detector in detectors:

        def distance_m(other: Detector, here_m: float = detector.position_m) -> float:
            return abs(other.position_m - here_m)

        edge, _, number = detector.lane.rpartition("_")
        steps = (-1, 1) if number.isdigit() else ()
        lanes = (f"{edge}_{int(number) + step}" for step in steps)
        there = [
            by_place[lane, detector.kind] for lane in lanes if (lane, detector.kind) in by_place
        ]
        beside[detector.id] = tuple(min(others, key=distance_m).id for others in there)
    return beside
