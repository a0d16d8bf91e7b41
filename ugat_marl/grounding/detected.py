"""Vehicles on lanes, from detections: when each came, when it left, and how sure that is.

A lane holds at time t the vehicles that came by then and have not left,

    N(t) = #{j : come_j <= t < leave_j}.

A stop detector gives `leave` of every vehicle. The lane's reference detector, `advance` if there is
one and else `stop`, gives `come`: a vehicle that drives freely came on the lane a free ride before.
Where a queue stands on the reference detector, vehicles pass it late. The n vehicles of such a jam
came between the last free one before it and the first free one after it, in order, and each of them
at least a free ride before it passed the detector. Their times are those of a Poisson process under
these conditions (`staircase`), by the seconds or, with exit detectors at the lane's begin, by the
vehicles that came on the road.
The break between a jam and free traffic is a gap in the flow (Liu, Wu, Ma, Hu 2009, "Real-time
queue length estimation for congested signalized intersections"). In a jam that does not end within
the period nobody was seen to come. There vehicles come at the rate of free times, as far as the
lane has room, and the deviation says how little is known.

Passages of the two detectors are matched by an alignment that keeps their order. A passage without
a partner is a change of lanes or a missed vehicle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.special import gammaln, ndtr

from ugat_marl.errors import OptionError, require_kinds, require_ranges
from ugat_marl.scenarios import GREEN, Detector, Lane, Passages, Period, deciding_letter
from ugat_marl.simulation import seconds_of

Floats = NDArray[np.float64]

FAR = 8.0
"""Standard deviations from which the normal distribution has no mass left to divide by."""
GRID = 129
"""Times at which the distribution of the vehicles of a jam is computed."""
STAIRS = 0.1
"""Least distance of the latest times of two vehicles of a jam, in mean distances. A span may begin
late, by the error of a free ride, and would then leave no time for them."""
MOST_LATENCY_S = 60.0
"""Longest delay of stamps; a longer one is a clock that was set wrong."""
LONG_S = 300.0
"""Length from which an open jam is not a queue of the last cycle."""


@dataclass(frozen=True)
class DetectionConfig:
    """Numbers of the estimate.

    Attributes:
        latency_s: Delay of the detectors' stamps behind their clock, in s; it is taken off them.
        vehicle_m: Length of a vehicle whose length was not measured, in m.
        space_m: Length of a queued vehicle with its gap, in m.
        jam: Share of the free speed below which a vehicle at a detector is in a jam.
        gap_s: Time between two vehicles at a detector from which a jam is over, in s. Liu et al.
            (2009) take 2.5 s; slow starts in bad weather need more. Halved, jams end in the middle
            of a queue, and queues are too short.
        least_free: Fewest free vehicles in a row between two jams. With fewer, the gap was a slow
            start in the middle of a queue.
        start_mps: Speed at which a vehicle that stood on a detector leaves it, in m/s, where speeds
            are not measured.
        least_mps: Smallest speed at which a front is taken to cross the stop line, in m/s.
        wave_s: Time from the start of a queued vehicle to the start of the one behind it, in s: a
            queue dissolves at about 6 m/s.
        brake_mps2: Deceleration at the back of a queue, in m/s². It decides since when a vehicle
            stands.
        late_s: Delay from which a vehicle counts as one that halted, in s.
        speed_spread: Standard deviation of free speeds, as a share of their median.
        fastest: Fastest ride between two detectors, as a share of the speed limit.
        unmatched: Cost of a passage without a partner, in standard deviations of a free ride.
        missed: Share of the vehicles of a road that its detectors may miss or count twice.
        longest_s: Longest ride between two detectors of a lane, in s.
    """

    latency_s: float = 0.0
    vehicle_m: float = 5.0
    space_m: float = 7.5
    jam: float = 0.5
    gap_s: float = 3.0
    least_free: int = 3
    start_mps: float = 2.5
    least_mps: float = 1.0
    wave_s: float = 1.2
    brake_mps2: float = 3.0
    late_s: float = 4.0
    speed_spread: float = 0.1
    fastest: float = 1.3
    unmatched: float = 3.0
    missed: float = 0.05
    longest_s: float = 900.0

    def __post_init__(self) -> None:
        require_kinds(self, "detection")
        others = {"latency_s", "late_s", "missed"}
        require_ranges(
            self,
            "detection",
            positive=[name for name in vars(self) if name not in others],
            non_negative=("late_s",),
            below_one=("missed",),
        )
        if not abs(self.latency_s) <= MOST_LATENCY_S:
            raise OptionError(
                f"latency_s = {self.latency_s:g}: must be from -{MOST_LATENCY_S:g} to "
                f"{MOST_LATENCY_S:g} s"
            )


@dataclass(frozen=True)
class Jam:
    """A span of time in which a queue stood on a reference detector.

    Attributes:
        begin_s: Time at which the last free vehicle before it came on the lane.
        end_s: The same for the first free vehicle after it; the end of the period without one.
        count: Vehicles of the jam, with those that an open one is estimated to have had beyond.
        open: True if it did not end within the period.
        error: Relative error of the rate at which vehicles come in an open jam.
        share: Share of a Poisson variance that the number of these vehicles has. Below 1, exit
            detectors counted the vehicles of the road, and only their lane is unsure.
        at_s: Times of `variance`, ``(times,)``; both are empty if an open jam was filled by a rate.
        variance: Variance of the vehicles of a closed jam that came by then, ``(times,)``.
    """

    begin_s: float
    end_s: float
    count: int
    open: bool = False
    error: float = 0.0
    share: float = 1.0
    at_s: Floats = field(default_factory=lambda: np.empty(0))
    variance: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def long(self) -> bool:
        """True for an open jam that is longer than a cycle or two, `LONG_S`."""
        return self.open and self.end_s - self.begin_s > LONG_S


@dataclass(frozen=True, eq=False)
class LaneCourse:
    """Vehicles of one lane in one period, in the order in which they leave; arrays ``(n,)``.

    Attributes:
        come_s: Time at which a vehicle came on the lane.
        leave_s: Time at which its front crossed the end of the lane; infinite if after the period.
        arrive_s: Time at which it would have crossed without a queue or a red light.
        sigma_s: Standard deviation of `come_s` of a vehicle outside of jams, in s; 0 in jams.
        jams: Spans with a queue on the reference detector.
        free_mps: Median free speed.
        capacity: Vehicles that fit on the lane.
        unmatched: Passages of one detector without a partner at the other one.
        blind_s: Time from the lane's begin to the reference detector. Who came later than this
            before the end of the period was not seen.
        merging_s: Spans in which a vehicle that changed lanes behind the reference detector may
            have waited for a gap beside it, ``(spans, 2)``. Half of them is taken as its stay.
    """

    come_s: Floats
    leave_s: Floats
    arrive_s: Floats
    sigma_s: Floats
    jams: tuple[Jam, ...]
    free_mps: float
    capacity: float
    unmatched: int = 0
    blind_s: float = 0.0
    merging_s: Floats = field(default_factory=lambda: np.empty((0, 2)))

    def vehicles(self, times_s: Floats) -> Floats:
        """Return the vehicles on the lane at each time, ``(times,)``."""
        return _passed(self.come_s, times_s) - _passed(self.leave_s, times_s)

    def mean_left(self, times_s: Floats, interval_s: float) -> Floats:
        """Return the vehicles that left after each time, averaged over an interval, ``(times,)``.

        The mean is over the seconds of the interval, as in `Snapshot.mean_left`.
        """
        seconds = seconds_of(interval_s)
        after = np.stack([_passed(self.leave_s, times_s + second) for second in seconds])
        widths = np.diff(seconds, prepend=0.0)[:, None]
        return (after * widths).sum(0) / interval_s - _passed(self.leave_s, times_s)

    def deviation(self, times_s: Floats) -> Floats:
        """Return the standard deviation of `vehicles`, ``(times,)``.

        The vehicles of a jam came as in `staircase`. In an open jam the number that came is that of
        a Poisson process of unsure rate, within what the lane holds. A free vehicle came at its
        time with an error of `sigma_s`.
        """
        variance = np.zeros(len(times_s))
        for jam in self.jams:
            if jam.open:
                share = (times_s - jam.begin_s) / max(jam.end_s - jam.begin_s, 1e-9)
                share = np.clip(share, 0.0, 1.0)
                came = jam.count * share
                spread = jam.share * came + (came * jam.error) ** 2
                variance += np.minimum(spread, self.capacity**2 / 12.0)
            else:
                variance += np.interp(times_s, jam.at_s, jam.variance, 0.0, 0.0)
        free = self.sigma_s > 0
        for come, sigma in zip(self.come_s[free], self.sigma_s[free], strict=True):
            near = np.abs(times_s - come) < 4.0 * sigma
            chance = ndtr((times_s[near] - come) / sigma)
            variance[near] += chance * (1.0 - chance)
        begin_s, end_s = self.merging_s.T
        variance += 0.25 * (_passed(begin_s, times_s) - _passed(end_s, times_s))
        return np.sqrt(np.maximum(variance, 0.0))

    def halting(
        self, times_s: Floats, greens: Sequence[tuple[float, float]], config: DetectionConfig
    ) -> Floats:
        """Return the vehicles that stand in the queue at each time, ``(times,)``.

        A delayed vehicle stands from its arrival at the back of the queue until the wave of starts
        of a green reaches it.

        Args:
            times_s: Times, ascending.
            greens: Begin and end of the lane's greens, ascending.
            config: Numbers of the estimate.
        """
        late = self.leave_s - self.arrive_s > config.late_s
        begins = np.array([begin for begin, _ in greens])
        ends = np.array([end for _, end in greens])
        braking_s = self.free_mps / (2.0 * config.brake_mps2)
        standing = np.zeros(len(times_s))
        for k, time in enumerate(times_s.tolist()):
            there = np.flatnonzero((self.come_s <= time) & (self.leave_s > time))
            place = np.arange(len(there))
            back_s = place * config.space_m / self.free_mps
            at_back = self.arrive_s[there] - back_s + braking_s <= time
            moves = np.zeros(len(there), dtype=np.bool_)
            last = int(np.searchsorted(begins, time)) - 1  # a green of this moment moved nobody
            if last >= 0 and time < ends[last]:
                gone = int(((self.leave_s > begins[last]) & (self.leave_s <= time)).sum())
                moves = config.wave_s * (gone + place) <= time - begins[last]
            standing[k] = float((late[there] & at_back & ~moves).sum())
        return standing


def _passed(events_s: Floats, times_s: Floats) -> Floats:
    """Return the number of events up to each time."""
    return np.searchsorted(np.sort(events_s), times_s, side="right").astype(np.float64)


@dataclass(frozen=True)
class LaneDetectors:
    """The detectors of a lane that the estimate reads.

    Attributes:
        stop: At the stop line; None without.
        advance: Upstream of it; None without.
        exit: At the start of a lane that leads away from a light; None without.
    """

    stop: Detector | None = None
    advance: Detector | None = None
    exit: Detector | None = None

    @classmethod
    def of(cls, detectors: Sequence[Detector], lane: str) -> LaneDetectors:
        """Choose the last stop, the first advance and the first exit detector of a lane.

        Zones on several lanes do not tell on which of them a vehicle was.
        """
        alone = [d for d in detectors if d.lanes == (lane,)]
        own = sorted(alone, key=lambda d: d.position_m)
        kinds = {
            kind: [detector for detector in own if detector.kind == kind]
            for kind in ("stop", "advance", "exit")
        }
        return cls(
            kinds["stop"][-1] if kinds["stop"] else None,
            kinds["advance"][0] if kinds["advance"] else None,
            kinds["exit"][0] if kinds["exit"] else None,
        )

    @property
    def seen(self) -> tuple[Detector, ...]:
        """The detectors that are there."""
        return tuple(d for d in (self.stop, self.advance, self.exit) if d is not None)


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Passages of a detector with nothing missing; arrays ``(n,)``, sorted by `on_s`."""

    on_s: Floats
    off_s: Floats
    speed_mps: Floats
    length_m: Floats

    @classmethod
    def of(
        cls, passages: Passages | None, zone_m: float, later_s: float, config: DetectionConfig
    ) -> _Crossings:
        """Fill in unknown times, speeds and lengths, and add `later_s` to the times."""
        if passages is None:
            return cls(*(np.empty(0) for _ in range(4)))
        length_m = np.where(np.isnan(passages.length_m), config.vehicle_m, passages.length_m)
        way_m = length_m + zone_m
        stay_s = passages.off_s - passages.on_s
        mean = np.maximum(way_m / np.maximum(stay_s, 0.05), config.start_mps)
        speed = np.where(np.isnan(passages.speed_mps), mean, passages.speed_mps)
        speed = np.where(np.isnan(speed), config.start_mps, speed)
        on = np.where(np.isnan(passages.on_s), passages.off_s - way_m / config.start_mps,
                      passages.on_s)  # fmt: skip
        off = np.where(np.isnan(passages.off_s), np.inf, passages.off_s)
        order = np.argsort(on, kind="stable")
        on, off = on + later_s, off + later_s
        return cls(on[order], off[order], speed[order], length_m[order])

    def __len__(self) -> int:
        return len(self.on_s)


@dataclass(frozen=True)
class _Rate:
    """Vehicles that came in free times, by a lane's clock (`_Clock`)."""

    count: float = 0.0
    span: float = 0.0

    @property
    def value(self) -> float:
        """Vehicles per unit of the clock; 0 if nothing is known."""
        return self.count / self.span if self.span > 0 else 0.0

    @property
    def error(self) -> float:
        """Relative standard error, that of a Poisson count."""
        return 1.0 / math.sqrt(max(self.count, 1.0))

    def above(self, least: float) -> float:
        """Return the mean rate, given that it is not below `least`: a queue that never ends.

        It is the mean of a truncated normal distribution.
        """
        sigma = self.value * self.error
        short = (least - self.value) / sigma
        if short > FAR:
            return least
        density = math.exp(-0.5 * short**2) / math.sqrt(2.0 * math.pi)
        return self.value + sigma * density / float(ndtr(-short))


@dataclass(frozen=True, eq=False)
class _Clock:
    """Clock by which vehicles of a lane come evenly: seconds, or vehicles that came on its road.

    Attributes:
        at_s: Times, ascending.
        reads: What the clock reads at them, strictly ascending.
    """

    at_s: Floats
    reads: Floats

    @classmethod
    def of(cls, period: Period, entries: Floats | None) -> _Clock:
        """Return the clock of a road; without `entries`, that of seconds."""
        ends = np.array([period.begin_s - 600.0, period.end_s])
        if entries is None or len(entries) < 2:
            return cls(ends, ends)
        inside = entries[(entries > ends[0]) & (entries < ends[1])]
        stamps, vehicles = np.unique(inside, return_counts=True)  # lanes may share a stamp
        at_s = np.concatenate([ends[:1], stamps, ends[1:]])
        reads = np.concatenate([[0], np.cumsum(vehicles), [len(inside) + 1]])
        # a little of every second, so that the clock never stands
        return cls(at_s, reads + 1e-6 * (at_s - ends[0]))

    def read(self, times_s: Floats | float) -> Floats:
        """Return what the clock reads at some times."""
        return np.asarray(np.interp(times_s, self.at_s, self.reads))

    def when(self, reads: Floats) -> Floats:
        """Return the times of some readings; infinite behind the last one."""
        times = np.interp(reads, self.reads, self.at_s)
        return np.where(reads > self.reads[-1], np.inf, times)


@dataclass(frozen=True)
class _Rest:
    """Vehicles that came on a road and were seen on none of its lanes, as one lane's share.

    Attributes:
        clock: Clock that reads the vehicles of the lane.
        unsure: Share of a Poisson variance of their number: they may be on another jammed lane.
        error: Relative error of their number.
    """

    clock: _Clock
    unsure: float
    error: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """Passages of a lane's reference detector, as if the lane had no queue.

    Attributes:
        crossings: The passages.
        come_s: Time at which each came on the lane if nothing delayed it.
        pace_mps: Its free speed.
        free: True where no queue delayed it.
        upstream_m: Length of the lane upstream of the detector.
        free_mps: Median free speed.
        clock: The lane's clock.
    """

    crossings: _Crossings
    come_s: Floats
    pace_mps: Floats
    free: NDArray[np.bool_]
    upstream_m: float
    free_mps: float
    clock: _Clock

    def jams(self) -> list[tuple[int, int]]:
        """Return start and end of each jam, as positions in the arrays."""
        edges = np.diff(np.concatenate([[True], self.free, [True]]).astype(np.int64))
        return list(
            zip(
                np.flatnonzero(edges == -1).tolist(),
                np.flatnonzero(edges == 1).tolist(),
                strict=True,
            )
        )

    def rate(self, period: Period) -> _Rate:
        """Return the vehicles that came in free times."""
        span = float(self.clock.read(period.end_s) - self.clock.read(period.begin_s))
        count = len(self.come_s)
        for begin, end in self.jams():
            first, last = self._ends(begin, end, period)
            span -= float(self.clock.read(last) - self.clock.read(first))
            count -= end - begin
        return _Rate(float(max(count, 0)), max(span, 0.0))

    def open_since(self, period: Period) -> float:
        """Return the start of a long jam that does not end within the period; infinite without."""
        jams = self.jams()
        if jams and jams[-1][1] == len(self.come_s):
            first, last = self._ends(*jams[-1], period)
            if last - first > LONG_S:
                return first
        return math.inf

    def spread(
        self, period: Period, rate: _Rate, rest: _Rest | None = None
    ) -> tuple[Floats, Floats, tuple[Jam, ...]]:
        """Spread the vehicles of each jam between the free vehicles around it.

        Args:
            period: Period of the passages.
            rate: Rate of free times, for a jam that does not end.
            rest: Vehicles that came on the road meanwhile, if exit detectors counted them.

        Returns:
            Times at which the vehicles came, ``(n,)``. Times of further vehicles that came but were
            not seen before the end of the period. The jams.
        """
        come, beyond = self.come_s.copy(), np.empty(0)
        found: list[Jam] = []
        for begin, end in self.jams():
            first_s, last_s = self._ends(begin, end, period)
            first, last = self.clock.read(first_s), self.clock.read(last_s)
            at_s, variance = np.empty(0), np.empty(0)
            open_end = end == len(come)
            error, share = rate.error, 1.0
            if open_end and (rest is not None or rate.value > 0):
                if rest is not None:
                    error, share, clock = rest.error, rest.unsure, rest.clock
                    first, last, pace = rest.clock.read(first_s), rest.clock.reads[-1], 1.0
                else:
                    clock = self.clock
                    pace = rate.above((end - begin) / max(float(last - first), 1e-9))
                number = max(int(pace * float(last - first)), end - begin)
                times = clock.when(first + np.arange(1, number + 1) / pace)
                beyond = times[end - begin :]
                beyond = beyond[beyond < period.end_s]
                even = times[: end - begin]
            else:
                span = max(float(last - first), 1e-9)
                latest = (self.clock.read(come[begin:end]) - first) / span
                mean, at, variance = staircase(latest)
                even, at_s = (
                    self.clock.when(first + mean * span),
                    self.clock.when(first + at * span),
                )
            come[begin:end] = np.minimum(even, come[begin:end])
            count = end - begin + len(beyond) * open_end
            found.append(Jam(first_s, last_s, count, open_end, error, share, at_s, variance))
        return come, beyond, tuple(found)

    def _ends(self, begin: int, end: int, period: Period) -> tuple[float, float]:
        """Return the times at which the free vehicles around a jam came."""
        first = float(self.come_s[begin - 1]) if begin else period.begin_s
        last = float(self.come_s[end]) if end < len(self.come_s) else period.end_s
        return first, max(last, first)


def staircase(latest: Floats) -> tuple[Floats, Floats, Floats]:
    """Return when vehicles of a Poisson process came, given the latest time for each.

    The i-th of n vehicles came by ``latest[i]``, so that N(t), uniform order statistics without
    this condition, is at least the number of those that are due:

        P(N(0) = 0, N(1) = n; N(t) >= #{i : latest[i] <= t} for all t).

    The distribution is found on a grid of times, forward and backward.

    Args:
        latest: Latest times, ascending, as shares of the span; those above 1 are no condition.

    Returns:
        Mean time of each vehicle, ``(n,)``; the grid, from 0 to 1, ``(times,)``; and the variance
        of N on it, ``(times,)``.
    """
    n = len(latest)
    latest = np.clip(latest, STAIRS * np.arange(1, n + 1) / (n + 1), 1.0)
    grid = np.unique(np.concatenate([np.linspace(0.0, 1.0, GRID), latest]))
    due = np.searchsorted(latest, grid[:-1], side="right")
    more = np.arange(n + 1)
    # Early latest times make every allowed course of N all but impossible, and its chance 0 in
    # floating point. So N gets the rate of the straightest allowed course, and each change of the
    # rate a weight that makes up for it.
    course = _straightest(grid, np.append(due, n))
    rate = np.maximum(np.diff(course), 1e-3 * n * np.diff(grid))
    change = np.diff(np.log(rate / np.diff(grid)))[:, None]
    weight = np.exp(np.clip(change * (more - course[1:-1, None]), -700.0, 700.0))
    # chances of so many arrivals in each step; a matrix for each would not fit for a long jam
    arrive = np.exp(more * np.log(rate)[:, None] - rate[:, None] - gammaln(more + 1.0))
    forward = np.zeros((len(grid), n + 1))
    backward = np.zeros((len(grid), n + 1))
    forward[0, 0] = backward[-1, n] = 1.0
    allowed = more[None, :] >= np.append(due, n)[:, None]
    weight = np.concatenate((weight, np.ones((1, n + 1))))
    for k, chances in enumerate(arrive):
        ahead = np.convolve(chances, forward[k])[: n + 1] * allowed[k + 1] * weight[k]
        forward[k + 1] = ahead / ahead.sum()
    for k in range(len(arrive) - 1, -1, -1):
        after = (backward[k + 1] * weight[k])[::-1]
        back = np.convolve(arrive[k], after)[n::-1] * allowed[k]
        backward[k] = back / back.sum()
    chance = forward * backward
    chance /= chance.sum(1, keepdims=True)
    count = chance @ more
    variance = chance @ more**2 - count**2
    # E t_i is the integral of P(N(t) < i), here by the trapezoidal rule
    mean = trapezoid(chance.cumsum(1)[:, :-1], grid, axis=0)
    return mean, grid, np.maximum(variance, 0.0)


def _straightest(grid: Floats, least: NDArray[np.int64]) -> Floats:
    """Return the least concave course from 0 that is nowhere below `least`, ``(times,)``."""
    kept = [0]
    for k in range(1, len(grid)):
        while len(kept) > 1:
            i, j = kept[-2:]
            if (least[j] - least[i]) * (grid[k] - grid[i]) > (least[k] - least[i]) * (
                grid[j] - grid[i]
            ):
                break
            kept.pop()
        kept.append(k)
    return np.interp(grid, grid[kept], least[kept].astype(np.float64))


@dataclass(frozen=True)
class LaneEstimate:
    """Estimate of the courses of lanes.

    Attributes:
        periods: Signals and passages.
        lanes: Lanes of the network, by id.
        detectors: All detectors.
        config: Numbers of the estimate.
        step_s: Length of a simulation step, in s. Detectors with the clock of SUMO's output are
            ahead of the signals by it (`Detector.clock`), and it is added to their stamps.
    """

    periods: Sequence[Period]
    lanes: Mapping[str, Lane]
    detectors: Sequence[Detector]
    config: DetectionConfig = field(default_factory=DetectionConfig)
    step_s: float = 1.0
    _known: dict[str, tuple[list[_Seen], _Rate]] = field(
        default_factory=dict[str, tuple[list[_Seen], _Rate]], compare=False, repr=False
    )

    def incoming(self, name: str) -> list[LaneCourse]:
        """Return the courses of a lane that ends at a light and has a stop detector, by period."""
        lane, own = self.lanes[name], LaneDetectors.of(self.detectors, name)
        seen, rate = self._all_seen(lane)
        return [
            self._course(
                period, lane, own, one.spread(period, rate, self._rest(place, lane, one)), one
            )
            for place, (period, one) in enumerate(zip(self.periods, seen, strict=True))
        ]

    def _all_seen(self, lane: Lane) -> tuple[list[_Seen], _Rate]:
        """Return what the first detector of a lane saw, by period, and the rate of free times."""
        if lane.id not in self._known:  # lanes with open jams ask for it in every period
            self._known[lane.id] = self._seen_anew(lane)
        return self._known[lane.id]

    def _seen_anew(self, lane: Lane) -> tuple[list[_Seen], _Rate]:
        own = LaneDetectors.of(self.detectors, lane.id)
        seen = [self._seen(period, lane, own) for period in self.periods]
        rates = [one.rate(period) for one, period in zip(seen, self.periods, strict=True)]
        return seen, _Rate(sum(one.count for one in rates), sum(one.span for one in rates))

    def _rest(self, place: int, lane: Lane, own: _Seen) -> _Rest | None:
        """Return the vehicles of a lane's open jam, from what came on its road.

        Vehicles that came on the road, and were not seen on a lane without a jam, came on a jammed
        one. Two jammed lanes share them as they share the vehicles that leave.
        """
        period = self.periods[place]
        entries = self._entries(period, lane)
        if entries is None or math.isinf(own.open_since(period)):
            return None
        known: list[Floats] = []
        since: list[float] = []
        flows: list[float] = []
        mine = 0
        for name, other in self.lanes.items():
            if other.edge != lane.edge:
                continue
            if LaneDetectors.of(self.detectors, name).stop is None:
                return None  # who leaves by that lane is not seen
            seen, rate = self._all_seen(other)
            one, jammed_s = seen[place], seen[place].open_since(period)
            come, _, _ = one.spread(period, rate)
            known.append(come[come <= jammed_s])
            if not math.isinf(jammed_s):
                since.append(jammed_s)
                flows.append(float((one.come_s > jammed_s).sum()) / (period.end_s - jammed_s))
                mine = len(since) - 1 if name == lane.id else mine
        begin = min(since)
        ticks = _unseen(entries, np.concatenate(known), begin)
        ticks = ticks[ticks > begin]
        jammed = ticks[:, None] >= np.array(since)[None, :]
        flow = jammed * np.array(flows)
        weights = flow[:, mine] / np.maximum(flow.sum(1), 1e-9)
        at_s = np.concatenate([[begin], ticks, [period.end_s]])
        reads = np.concatenate([[0.0], weights.cumsum(), [weights.sum()]])
        clock = _Clock(at_s, reads + 1e-6 * (at_s - begin))
        unsure = 1.0 - float(weights.sum()) / max(float((weights > 0).sum()), 1.0)
        return _Rest(clock, unsure, self.config.missed)

    def _seen(self, period: Period, lane: Lane, own: LaneDetectors) -> _Seen:
        reference = own.advance or own.stop
        assert reference is not None
        first = self._crossings(period, reference)
        free_mps = self._free_speed(first, lane.speed_mps)
        upstream_m = reference.position_m + lane.counted_m - lane.length_m
        pace = np.where(first.speed_mps >= 0.8 * free_mps, first.speed_mps, free_mps)
        pace = np.minimum(pace, self.config.fastest * lane.speed_mps)
        come = np.maximum.accumulate(first.on_s - upstream_m / pace)
        clock = _Clock.of(period, self._entries(period, lane))
        return _Seen(first, come, pace, self._free(first, free_mps), upstream_m, free_mps, clock)

    def _course(
        self,
        period: Period,
        lane: Lane,
        own: LaneDetectors,
        spread: tuple[Floats, Floats, tuple[Jam, ...]],
        seen: _Seen,
    ) -> LaneCourse:
        """Join what the reference and the stop detector saw."""
        come, beyond, jams = spread
        stops = seen.crossings if own.advance is None else self._crossings(period, own.stop)
        assert own.stop is not None
        pace, ahead_m = seen.pace_mps, lane.counted_m
        sigma = np.where(seen.free, self.config.speed_spread * seen.upstream_m / pace, 0.0)
        arrive = come + ahead_m / pace
        leave = self._left(stops, own.stop, lane.length_m)
        unmatched, merging_s = 0, np.empty((0, 2))
        if own.advance is not None:
            way_m = own.stop.position_m - own.advance.position_m
            fastest_s = way_m / (self.config.fastest * lane.speed_mps)
            pairs = _aligned(seen.crossings, stops, way_m, fastest_s, seen.free_mps, self.config)
            begun = int(pairs[:, 0].max()) + 1 if len(pairs) else 0
            stays = np.arange(begun, len(come))  # on the lane at the end of the period
            changed = np.setdiff1d(np.arange(begun), pairs[:, 0])
            lone = np.setdiff1d(np.arange(len(stops)), pairs[:, 1])
            unmatched = len(lone) + len(changed)
            ride_s = way_m / seen.free_mps
            of_first = np.concatenate([pairs[:, 0], stays, changed])
            half = np.full(len(lone), ride_s / 2)
            come = np.concatenate([come[of_first], leave[lone] - ride_s])
            arrive = np.concatenate([arrive[of_first], leave[lone]])
            sigma = np.concatenate([sigma[of_first], half])
            # One that changed lanes was gone when the next vehicle behind it reached the stop line.
            off_s = seen.crossings.off_s[changed]
            behind = pairs[np.searchsorted(pairs[:, 0], changed), 1]
            gone_s = np.maximum(off_s, leave[behind] - ride_s)
            merging_s = np.stack([off_s, gone_s], 1)
            merging_s = merging_s[np.isfinite(merging_s).all(1)]
            waited_s = np.where(np.isfinite(gone_s), 0.5 * (off_s + gone_s), off_s)
            gone = (leave[pairs[:, 1]], np.full(len(stays), np.inf), waited_s)
            leave = np.concatenate([*gone, leave[lone]])
        come = np.concatenate([come, beyond])
        arrive = np.concatenate([arrive, beyond + ahead_m / seen.free_mps])
        leave = np.concatenate([leave, np.full(len(beyond), np.inf)])
        sigma = np.concatenate([sigma, np.zeros(len(beyond))])
        order = np.lexsort((come, leave))
        come, leave, arrive, sigma = (x[order] for x in (come, leave, arrive, sigma))
        come = _within(np.minimum(come, leave), leave, lane.storage_veh)
        there = np.isfinite(come)
        come, leave, arrive, sigma = (x[there] for x in (come, leave, arrive, sigma))
        blind_s = seen.upstream_m / seen.free_mps
        return LaneCourse(
            come, leave, arrive, sigma, jams, seen.free_mps, lane.storage_veh, unmatched, blind_s,
            merging_s,
        )  # fmt: skip

    def outgoing(self, name: str) -> list[LaneCourse]:
        """Return the courses of a lane that leads away from a light and ends at none, by period."""
        return [self._away(period, self.lanes[name]) for period in self.periods]

    def _away(self, period: Period, lane: Lane) -> LaneCourse:
        own = LaneDetectors.of(self.detectors, lane.id)
        assert own.exit is not None
        seen = self._crossings(period, own.exit)
        free_mps = self._free_speed(seen, lane.speed_mps)
        come = seen.on_s - own.exit.position_m / np.maximum(seen.speed_mps, 0.5 * free_mps)
        leave = seen.on_s + (lane.length_m - own.exit.position_m) / free_mps
        spread = self.config.speed_spread * lane.length_m / free_mps
        return LaneCourse(
            come, leave, leave, np.full(len(come), spread), (), free_mps, lane.storage_veh
        )

    def _crossings(self, period: Period, detector: Detector | None) -> _Crossings:
        assert detector is not None
        passages = period.passages.get(detector.id)
        later_s = detector.steps_early * self.step_s - self.config.latency_s
        return _Crossings.of(passages, detector.length_m, later_s, self.config)

    def _free_speed(self, seen: _Crossings, limit_mps: float) -> float:
        """Return the median speed of vehicles far from others; the limit without enough of them."""
        if len(seen) < 2:
            return limit_mps
        ahead = np.diff(seen.on_s, prepend=-np.inf) > self.config.gap_s
        fast = seen.speed_mps[ahead & (seen.speed_mps > self.config.jam * limit_mps)]
        fast = fast[fast < self.config.fastest * limit_mps]
        return float(np.median(fast)) if len(fast) >= 5 else limit_mps

    def _free(self, seen: _Crossings, free_mps: float) -> NDArray[np.bool_]:
        """Return True for passages without a queue on the detector.

        The first vehicle of a jam stopped because of it; its front came on time.
        """
        slow = seen.speed_mps < self.config.jam * free_mps
        gap = seen.on_s - np.concatenate([[-np.inf], seen.off_s[:-1]])[: len(seen)]
        free = np.ones(len(seen), dtype=np.bool_)
        jammed = False
        for k in range(len(seen)):
            jammed = jammed and not (not slow[k] and gap[k] > self.config.gap_s)
            free[k] = not jammed
            jammed = jammed or bool(slow[k])
        runs = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int64)))
        for begin, end in runs.reshape(-1, 2).tolist():
            inside = begin > 0 and end < len(free)
            if inside and end - begin < self.config.least_free:
                free[begin:end] = False  # a slow start in the middle of a queue
        return free

    def _entries(self, period: Period, lane: Lane) -> Floats | None:
        """Return the times at which vehicles came on the lane's road; None if nothing saw them."""
        road = [name for name, other in self.lanes.items() if other.edge == lane.edge]
        found = [LaneDetectors.of(self.detectors, name).exit for name in road]
        if any(detector is None for detector in found):
            return None
        return np.sort(np.concatenate([self._crossings(period, x).on_s for x in found]))

    def _left(self, stops: _Crossings, stop: Detector, length_m: float) -> Floats:
        """Return the times at which fronts crossed the end of the lane, just before `off`."""
        beyond_m = stop.position_m + stop.length_m + stops.length_m - length_m
        speed = np.maximum(stops.speed_mps, self.config.least_mps)
        return np.maximum(stops.off_s - beyond_m / speed, stops.on_s)


def _unseen(entries: Floats, known: Floats, begin_s: float) -> Floats:
    """Return the times from `begin_s` on at which more vehicles came than are known, sorted."""
    entries, known = entries[entries >= begin_s], known[known >= begin_s]
    times = np.concatenate([entries, known])
    steps = np.concatenate([np.ones(len(entries)), -np.ones(len(known))])
    order = np.lexsort((steps, times))  # a known vehicle takes its own entry away
    surplus = steps[order].cumsum()
    most = np.maximum.accumulate(np.maximum(surplus, 0.0))
    return times[order][np.diff(most, prepend=0.0) > 0]


def greens_of(period: Period, tls: str, links: Sequence[int]) -> list[tuple[float, float]]:
    """Return starts and ends of the greens of a lane's links."""
    spans: list[tuple[float, float]] = []
    log = (*period.signals.get(tls, ()), (period.end_s, ""))
    for (begin, state), (end, _) in itertools.pairwise(log):
        if deciding_letter([state[i] for i in links]) in GREEN:
            if spans and spans[-1][1] == begin:
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((begin, end))
    return spans


def _within(come: Floats, leave: Floats, capacity: float) -> Floats:
    """Return `come` such that the lane never holds more vehicles than fit on it."""
    fits = max(int(capacity), 1)
    come = come.copy()
    if len(come) > fits:
        come[fits:] = np.maximum(come[fits:], leave[:-fits])
    return np.minimum(come, leave)


@dataclass(frozen=True)
class _Costs:
    """Least costs of matching the first 0, 1, ... vehicles of one detector with some of another.

    Attributes:
        start: Number of vehicles of the first of `values`.
        values: Costs from there on.
        gap: Cost of each vehicle beyond them.
    """

    start: int
    values: Floats
    gap: float

    def at(self, number: int) -> float:
        """Return the cost of some vehicles, not fewer than `start`."""
        beyond = max(number - self.start - len(self.values) + 1, 0)
        return float(self.values[number - self.start - beyond]) + beyond * self.gap

    def between(self, low: int, high: int) -> Floats:
        """Return the costs of `low` to `high` vehicles."""
        number = np.arange(low, high + 1) - self.start
        beyond = np.maximum(number - len(self.values) + 1, 0)
        return self.values[number - beyond] + beyond * self.gap


def _aligned(
    first: _Crossings,
    last: _Crossings,
    way_m: float,
    fastest_s: float,
    free_mps: float,
    config: DetectionConfig,
) -> NDArray[np.int64]:
    """Match passages of two detectors of a lane, in order, at the least total cost.

    A free ride costs its deviation from the expected one, in standard deviations, at most
    2 * `unmatched`; a vehicle that was slow at one of the detectors may have taken any time.

    Returns:
        Pairs of positions in `first` and `last`, ascending, ``(pairs, 2)``.
    """
    n, m = len(first), len(last)
    if not n or not m:
        return np.empty((0, 2), dtype=np.int64)
    gap = config.unmatched
    # Rows of the table of least costs hold only the vehicles that can have been each one: beyond
    # them each further vehicle costs a gap. A whole table of a day needs gigabytes.
    low = np.searchsorted(first.on_s, last.on_s - config.longest_s - 1e-6, side="left")
    high = np.searchsorted(first.on_s, last.on_s - fastest_s + 1e-6, side="right")
    costs: list[Floats] = []
    totals = [_Costs(0, np.zeros(1), gap)]
    for j in range(m):
        near = slice(int(low[j]), int(high[j]))
        ride_s, speeds = last.on_s[j] - first.on_s[near], (first.speed_mps[near], last.speed_mps[j])
        cost = _ride_costs(ride_s, speeds, way_m, free_mps, config)
        cost += np.where(np.abs(first.length_m[near] - last.length_m[j]) > 0.5, 2.0, 0.0)
        cost[(ride_s < fastest_s) | (ride_s > config.longest_s)] = np.inf
        costs.append(cost)
        before = totals[-1].between(near.start, near.stop)
        best = before + gap
        best[1:] = np.minimum(best[1:], before[:-1] + cost)
        skipped = gap * np.arange(near.start, near.stop + 1)
        least: Floats = np.minimum.accumulate(best - skipped).astype(np.float64) + skipped
        totals.append(_Costs(near.start, least, gap))
    return _traced_back(n, costs, totals, gap)


def _ride_costs(
    ride_s: Floats,
    speeds_mps: tuple[Floats, float],
    way_m: float,
    free_mps: float,
    config: DetectionConfig,
) -> Floats:
    """Return what rides between two detectors of a lane cost, ``(n,)``; 0 for a slow vehicle.

    Args:
        ride_s: Times of the rides, ``(n,)``.
        speeds_mps: Speeds at the first detector, ``(n,)``, and at the last.
        way_m: Distance of the detectors.
        free_mps: Speed of free vehicles.
        config: Settings.
    """
    first_mps, last_mps = speeds_mps
    free = np.minimum(first_mps, last_mps) >= 0.7 * free_mps
    expected_s = way_m / np.maximum(0.5 * (first_mps + last_mps), 1.0)
    off = np.abs(ride_s - expected_s) / (0.5 + 2.0 * config.speed_spread * expected_s)
    return np.where(free, np.minimum(off, 2.0 * config.unmatched), 0.0)


def _traced_back(
    count: int, costs: Sequence[Floats], totals: Sequence[_Costs], gap: float
) -> NDArray[np.int64]:
    """Return the pairs whose total cost is the least, ascending, ``(pairs, 2)``.

    Args:
        count: Number of vehicles of the first detector.
        costs: Vehicle of the last detector to its costs of each that it can have been.
        totals: Number of vehicles of the last detector to the least costs; one more than `costs`.
        gap: Cost of a vehicle without a partner.
    """
    pairs: list[tuple[int, int]] = []
    i, j = count, len(costs)
    while i and j:
        here, before, near = totals[j], totals[j - 1], costs[j - 1]
        if i <= here.start:
            j -= 1
            continue
        total, place = here.at(i), i - 1 - here.start
        if place < len(near) and np.isclose(total, before.at(i - 1) + near[place]):
            i, j = i - 1, j - 1
            pairs.append((i, j))
        elif np.isclose(total, before.at(i) + gap):
            j -= 1
        else:
            i -= 1
    return np.array(pairs[::-1], dtype=np.int64).reshape(-1, 2)
