"""Sightings of single vehicles at the detectors, from which errors of measurement are estimated.

Sightings of measured and of simulated days are collected in the same way, so that only their
differences count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import DetectorLayout, Greens
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import next_detectors
from ugat_marl.scenarios import Detector, Passages, Period

Array = NDArray[np.float64]

ALONE, SECOND, THIRD, FOURTH, SIXTH, BRAKING, QUEUED = range(7)
"""Regimes of a passage: alone in free flow; second, third, fourth to fifth, sixth to eighth of a
queue at a stop detector; braking alone for a red at an advance detector, and any other moving one
there."""

GAP_EDGES_S = 0.05 * np.arange(101)
"""Edges of the bins of the time between two passages, s."""


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
            none at all, then bins of `GAP_EDGES_S`.
        twins: Rows for every detector, of moments at which nothing else passes beside it:
            passages with twins on the next lanes, counted at the first of their detectors, and
            passages alone: ``(detectors, 2)``.
        coincidences: Rows for every detector, of pairs of passages over it and over the next one to
            the left that last alike: those that begin together, and by chance as many, from those
            that begin a little apart: ``(detectors, 2)``.
        counts: Number of passages over each detector, ``(detectors,)``.
    """

    passages: Array
    pairs: Array
    gaps: Array
    twins: Array
    coincidences: Array
    counts: Array

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
            detector.id: _Track.of(period.of_detector(detector.id), detector, thresholds)
            for detector in layout.detectors
        }
        rows: list[Array] = []
        pairs: list[Array] = []
        for lane, green in zip(layout.lanes, greens, strict=True):
            advance, stop = lane.detectors.get("advance"), lane.detectors.get("stop")
            if advance:
                track = tracks[advance]
                regimes = _regimes_at_advance(track, green, thresholds)
                rows.append(track.rows(number[advance], regimes))
            if stop:
                track = tracks[stop]
                rows.append(track.rows(number[stop], _regimes_at_stop(track, green, thresholds)))
            if advance and stop:
                pairs.append(
                    _pairs(
                        number[advance],
                        tracks[advance],
                        tracks[stop],
                        green,
                        lane.speed_mps,
                        thresholds,
                    )
                )
        for _, _, name in layout.exits:
            rows.append(tracks[name].rows(number[name], tracks[name].alone_only()))
        return cls(
            np.concatenate([np.empty((0, 5)), *rows]),
            np.concatenate([np.empty((0, 4)), *pairs]),
            np.array([tracks[one.id].gaps for one in layout.detectors]),
            _twins(layout.detectors, tracks, thresholds),
            _coincidences(layout.detectors, tracks, thresholds),
            np.array([float(len(period.of_detector(one.id))) for one in layout.detectors]),
        )

    def __add__(self, other: Sightings) -> Sightings:
        return Sightings(
            np.concatenate([self.passages, other.passages]),
            np.concatenate([self.pairs, other.pairs]),
            self.gaps + other.gaps,
            self.twins + other.twins,
            self.coincidences + other.coincidences,
            self.counts + other.counts,
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
        before: Time since the start of the passage before, s.
        after: Time until the start of the next passage, s.
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
        apart = (after - over)[:-1] > thresholds.no_gap_s
        length = np.where(np.isfinite(seen.length_m), seen.length_m, thresholds.length_m)
        counts = np.histogram((after - over)[:-1][apart], GAP_EDGES_S)[0]
        return cls(
            on,
            over,
            seen.speed_mps,
            length + detector.length_m,
            before,
            after,
            free,
            np.append(float((~apart).sum()), counts),
            thresholds,
        )

    def leading(self) -> NDArray[np.bool_]:
        """Mark moving vehicles without another one close ahead."""
        limit = self.thresholds
        # The negations are True for unknown speeds (NaN), here and below.
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
    cycle, begun = greens.last_begun(times)
    return cycle, begun & (times < greens.end_s[cycle]) if len(greens.start_s) else begun


def _regimes_at_advance(track: _Track, greens: Greens, thresholds: Thresholds) -> NDArray[np.int64]:
    """Return the regimes of passages over an advance detector."""
    cycle, green = _cycles(track.on, greens)
    regime = np.full(len(track.on), -1)
    if not len(greens.start_s):
        return track.alone_only()
    moving = (track.speed > thresholds.crawling_mps) & (track.over < thresholds.longest_alone_s)
    regime[moving] = QUEUED
    settled = green & (track.on > greens.start_s[cycle] + thresholds.settled_green_s)
    regime[track.alone() & settled] = ALONE
    red = (track.on > greens.red_s[cycle]) & (
        track.on < greens.next_s[cycle] - thresholds.before_green_s
    )
    lone = (track.before > thresholds.lone_gap_s) & ~(track.speed <= thresholds.least_braking_mps)
    regime[red & lone & (track.over < thresholds.longest_alone_s)] = BRAKING
    return regime


def _regimes_at_stop(track: _Track, greens: Greens, thresholds: Thresholds) -> NDArray[np.int64]:
    """Return the regimes of passages over a stop detector."""
    regime = np.full(len(track.on), -1)
    if not len(greens.start_s) or not len(track.on):
        return regime
    cycle, green = _cycles(track.on + track.over, greens)
    settled = green & (track.on > greens.start_s[cycle] + thresholds.settled_green_s)
    crossed = track.on + track.over
    begun = np.searchsorted(greens.start_s, crossed, "right")  # 0 before the first whole green
    first = np.searchsorted(begun, begun, "left")
    number = np.arange(len(cycle)) - first
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


def _twins(
    detectors: Sequence[Detector], tracks: Mapping[str, _Track], thresholds: Thresholds
) -> Array:
    """Count passages with twins on the next lanes, and passages alone: ``(detectors, 2)``.

    Only moments count at which nothing else passes on the lanes side by side. Otherwise the splash
    of a platoon would look like a lone vehicle without a twin on its other side. These moments last
    for a free gap: within less, leaders of queues that start side by side look like twins.
    """
    counts = np.zeros((len(detectors), 2))
    neighbours = beside(detectors)
    for members in _side_by_side(neighbours):
        parts = [tracks[detectors[index].id] for index in members]
        on, over = (np.concatenate(x) for x in ([t.on for t in parts], [t.over for t in parts]))
        index = np.repeat(members, [len(t.on) for t in parts])
        order = np.argsort(on, kind="stable")
        on, over, index = on[order], over[order], index[order]
        starts = np.flatnonzero(np.diff(on, prepend=-np.inf) > thresholds.free_gap_s)
        if not len(starts):
            continue
        ends = np.append(starts[1:], len(on))
        alone = index[starts[ends == starts + 1]]
        counts[:, 1] += np.bincount(alone, minlength=len(counts))
        spread = [
            np.maximum.reduceat(x, starts) - np.minimum.reduceat(x, starts) for x in (on, over)
        ]
        alike = (ends > starts + 1) & (np.maximum(*spread) < thresholds.twin_s)
        for start, end in zip(starts[alike].tolist(), ends[alike].tolist(), strict=True):
            passed = set(index[start:end].tolist())
            beside_one = any(all(x in {one, *neighbours[one]} for x in passed) for one in passed)
            if len(passed) == end - start and beside_one:
                counts[min(passed), 0] += 1.0
    return counts


def _coincidences(
    detectors: Sequence[Detector], tracks: Mapping[str, _Track], thresholds: Thresholds
) -> Array:
    """Count pairs of passages on adjacent lanes that last alike, see `Sightings`."""
    counts = np.zeros((len(detectors), 2))
    for one, others in beside(detectors).items():
        for other in others:
            if other > one:
                first, second = tracks[detectors[one].id], tracks[detectors[other].id]
                counts[one] += _coinciding(first, second, thresholds.twin_s)
    return counts


def _coinciding(first: _Track, second: _Track, twin_s: float) -> tuple[float, float]:
    """Return the number of pairs that begin together, and of those expected by chance."""
    farthest = 3.0 * twin_s  # those apart have twice the time of those together
    together, apart = 0, 0
    index = np.searchsorted(second.on, first.on - farthest)
    rows = np.arange(len(first.on))
    while len(rows):
        known = index < len(second.on)
        rows, index = rows[known], index[known]
        later = second.on[index] - first.on[rows]
        known = later < farthest
        rows, index, later = rows[known], index[known], later[known]
        alike = np.abs(second.over[index] - first.over[rows]) < twin_s
        near = np.abs(later) < twin_s
        together += int((alike & near).sum())
        apart += int((alike & ~near).sum())
        index = index + 1
    return float(together), 0.5 * apart


def beside(detectors: Sequence[Detector]) -> dict[int, frozenset[int]]:
    """Return the indices of the next detectors of each one, as `next_detectors` names them."""
    number = {one.id: index for index, one in enumerate(detectors)}
    return {
        number[name]: frozenset(number[other] for other in others)
        for name, others in next_detectors(detectors).items()
    }


def _side_by_side(beside: Mapping[int, frozenset[int]]) -> list[list[int]]:
    """Return the detectors that lie side by side, directly or over others; none that lie alone."""
    groups: list[set[int]] = []
    for one, others in beside.items():
        if others:
            group = {one, *others}
            apart = [known for known in groups if known.isdisjoint(group)]
            groups = [*apart, group.union(*(x for x in groups if not x.isdisjoint(group)))]
    return [sorted(group) for group in groups]
