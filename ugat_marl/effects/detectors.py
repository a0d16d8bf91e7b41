"""Effects on the reports of detectors, not on traffic: clocks, misses, broken detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects.base import (
    EVERYWHERE,
    TIME_OF_EPISODE,
    Effect,
    ExaminedStrengths,
    NumberParameter,
    Owner,
    TextParameter,
    hashed_uniform,
    with_listed_effects,
)
from ugat_marl.effects.places import network_places
from ugat_marl.errors import UnknownNameError
from ugat_marl.scenarios import Detector, Passages, Period, Scenario

_CLOCK = TextParameter("traffic light", everywhere=True)


def _both_sides(*levels: float) -> tuple[float, ...]:
    """Return levels of both signs, because the effect of a clock is not linear in its error."""
    return (*(-level for level in reversed(levels)), *levels)


def detector_lights(scenario: Scenario, detectors: Sequence[Detector]) -> dict[str, str]:
    """Return the traffic light of every detector.

    An exit detector belongs to the light at the start of its lane, any other to the light at the
    end; if there is none, to the light at the other end. Detectors at no light are left out.
    """
    places = network_places(scenario)
    lights: dict[str, str] = {}
    for detector in detectors:
        first, second = (places.begins, places.ends)[:: 1 if detector.kind == "exit" else -1]
        light = first.get(detector.lane) or second.get(detector.lane)
        if light is not None:
            lights[detector.id] = light
    return lights


@dataclass(frozen=True)
class DetectorEffect(Effect):
    """Base of effects on the reports of detectors; the simulation does not change.

    No files change. The scenario lists the effect in its `effects`, so it is hashed, written and
    read with the scenario, and whoever measures the scenario applies it.
    """

    on_detectors: ClassVar[bool] = True

    def apply(self, scenario: Scenario) -> Scenario:
        """List the effect in the scenario, behind those listed before.

        Raises:
            UnknownNameError: No such traffic light.
        """
        for key, text in self.texts.items():
            name = getattr(self, key)
            if text.kind == "traffic light" and name != EVERYWHERE:
                places = network_places(scenario)
                places.check(self.name, text.kind, name, places.lights)
        listed = (*scenario.settings.effects, self.record())
        return with_listed_effects(scenario, self, listed)


@dataclass(frozen=True)
class Undercount(DetectorEffect):
    """A detector (``"*"``: all) misses this share of the vehicles."""

    name: ClassVar[str] = "undercount"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    texts: ClassVar[dict[str, TextParameter]] = {
        "place": TextParameter("detector", everywhere=True)
    }
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths((0.15,), 0.0, 0.02)
    place: str
    share: float

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Leave out passages, chosen by a hash of the detector and their number and time."""

        def thinned(name: str, passages: Passages) -> Passages:
            kept = [
                hashed_uniform("undercount", name, str(n), f"{time:.3f}") >= self.share
                for n, time in enumerate(passages.seen_s.tolist())
            ]
            return passages.at(np.array(kept, dtype=np.bool_))

        return edited(period, _named(self, self.place, detectors), thinned)


@dataclass(frozen=True)
class SignalClock(DetectorEffect):
    """Times of the detectors at a traffic light are `seconds` ahead of the clock of its signals."""

    name: ClassVar[str] = "signal_clock"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", -60.0, 60.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"place": _CLOCK}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths(
        _both_sides(0.7, 1.4, 2.2, 3.1, 4.3), 0.0, 0.2
    )
    place: str
    seconds: float

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Shift all times of the detectors."""
        shift = self.seconds
        return edited(period, _at(self.place, period, owner), lambda _, p: _moved(p, shift, shift))


@dataclass(frozen=True)
class ClockDrift(DetectorEffect):
    """The clock of the detectors at a traffic light gains `seconds_per_hour`."""

    name: ClassVar[str] = "clock_drift"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "seconds_per_hour": NumberParameter("s/h", -60.0, 60.0)
    }
    texts: ClassVar[dict[str, TextParameter]] = {"place": _CLOCK}
    examined: ClassVar[ExaminedStrengths] = ExaminedStrengths(
        _both_sides(1.5, 3.1, 5.2, 7.5), 0.0, 0.5
    )
    place: str
    seconds_per_hour: float

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Shift times in proportion to the time since the period began."""
        rate = self.seconds_per_hour / 3600.0

        def drifted(name: str, passages: Passages) -> Passages:
            on, off = passages.on_s - period.begin_s, passages.off_s - period.begin_s
            return _moved(passages, rate * on, rate * off)

        return edited(period, _at(self.place, period, owner), drifted)


@dataclass(frozen=True)
class Stuck(DetectorEffect):
    """A detector is always on between two times."""

    name: ClassVar[str] = "stuck"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "begin_s": TIME_OF_EPISODE,
        "end_s": TIME_OF_EPISODE,
    }
    texts: ClassVar[dict[str, TextParameter]] = {"detector": TextParameter("detector")}
    detector: str
    begin_s: float
    end_s: float

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Replace all passages between the times by one long passage without speed."""
        names = _named(self, self.detector, detectors)
        begin, end = max(self.begin_s, period.begin_s), min(self.end_s, period.end_s)
        if begin >= end:
            return period
        long = Passages(np.array([begin]), np.array([end]), np.array([np.nan]), np.array([np.nan]))

        def held(name: str, passages: Passages) -> Passages:
            return Passages.concatenated([passages.at(~_within(passages, begin, end)), long])

        return edited(period, names, held)


@dataclass(frozen=True)
class Dropout(DetectorEffect):
    """A detector reports nothing between two times."""

    name: ClassVar[str] = "dropout"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "begin_s": TIME_OF_EPISODE,
        "end_s": TIME_OF_EPISODE,
    }
    texts: ClassVar[dict[str, TextParameter]] = {"detector": TextParameter("detector")}
    detector: str
    begin_s: float
    end_s: float

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Leave out all passages that overlap the time.

        Of a passage that begins or ends in it, a log has half the events, which tell nothing.
        """

        def silent(name: str, passages: Passages) -> Passages:
            return passages.at(~_within(passages, self.begin_s, self.end_s))

        return edited(period, _named(self, self.detector, detectors), silent)


@dataclass(frozen=True)
class Swapped(DetectorEffect):
    """Two detectors are taken for each other."""

    name: ClassVar[str] = "swapped"
    texts: ClassVar[dict[str, TextParameter]] = {
        "detector": TextParameter("detector"),
        "other": TextParameter("detector"),
    }
    detector: str
    other: str

    def observe(self, period: Period, detectors: Sequence[Detector], owner: Owner) -> Period:
        """Exchange the passages of the two."""
        (first,), (second,) = (_named(self, x, detectors) for x in (self.detector, self.other))
        passages = {name: x for name, x in period.passages.items() if name not in (first, second)}
        for name, source in ((first, second), (second, first)):
            if source in period.passages:
                passages[name] = period.passages[source]
        return replace(period, passages=passages)


def apply_detector_effects(
    period: Period,
    effects: Sequence[Effect],
    detectors: Sequence[Detector],
    owner: Owner,
) -> Period:
    """Apply the effects on detectors among `effects`, one after the other."""
    for effect in effects:
        period = effect.observe(period, detectors, owner)
    return period


def installed_detectors(
    effects: Sequence[Effect], detectors: Sequence[Detector]
) -> tuple[Detector, ...]:
    """Return the detectors as they really are, with all effects on their places and zones."""
    true = tuple(detectors)
    for effect in effects:
        true = effect.installed(true)
    return true


def _named(effect: Effect, place: str, detectors: Sequence[Detector]) -> set[str]:
    known = {detector.id for detector in detectors}
    if place == EVERYWHERE:
        return known
    if place not in known:
        raise UnknownNameError("detector", place, known, f"Effect {effect.name!r} names it.")
    return {place}


def _at(place: str, period: Period, owner: Owner) -> set[str]:
    """Return the detectors recorded by one traffic light's controller, or by all."""
    return {x for x in period.passages if place in (EVERYWHERE, owner.get(x))}


def edited(
    period: Period, names: AbstractSet[str], change: Callable[[str, Passages], Passages]
) -> Period:
    """Return the period with other passages at some detectors; empty detectors are left out."""
    passages = dict(period.passages)
    for name in sorted(names):
        changed = change(name, period.of_detector(name))
        if len(changed):
            passages[name] = changed
        else:
            passages.pop(name, None)
    return replace(period, passages=passages)


def _moved(
    passages: Passages, on: float | NDArray[np.float64], off: float | NDArray[np.float64]
) -> Passages:
    return replace(passages, on_s=passages.on_s + on, off_s=passages.off_s + off)


def _within(passages: Passages, begin_s: float, end_s: float) -> NDArray[np.bool_]:
    """Return True for each passage that overlaps the window."""
    begin, end = passages.spans()
    return (begin < end_s) & (end > begin_s)
