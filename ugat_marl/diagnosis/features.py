"""Measured lanes with their signals and detectors, and the features of one period there.

Every feature is a mean, kept as a sum and a number of observations. So lanes add up to
intersections and to the network, and periods add up to data sets. Queue discharge is counted from
the start of green. A vehicle crosses when its rear leaves the stop detector, since a vehicle may
wait anywhere on the detector.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.journeys import JOURNEYS, Crossings, journey_sums, matched
from ugat_marl.diagnosis.thresholds import DayThresholds
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import (
    GREEN,
    YELLOW,
    Detector,
    DetectorKind,
    Network,
    Passages,
    Period,
    SignalLog,
    deciding_letter,
    edge_of_lane,
)

Array = NDArray[np.float64]

# --- measured lanes -------------------------------------------------------------------------------


@dataclass(frozen=True)
class IncomingLane:
    """A lane in front of a traffic light.

    Attributes:
        id: SUMO id of the lane.
        edge: SUMO id of its edge.
        intersection: Index of its intersection in `DetectorLayout.intersections`.
        links: Indices of its letters in the signal state.
        speed_mps: Speed limit, m/s.
        detectors: Ids of the detectors on it, by kind.
        following: Ids of the edges that it leads to.
        directions: SUMO's letters of its movements in lower case: s straight, l left, r right.
    """

    id: str
    edge: str
    intersection: int
    links: tuple[int, ...]
    speed_mps: float
    detectors: Mapping[DetectorKind, str]
    following: frozenset[str] = frozenset()
    directions: frozenset[str] = frozenset()

    def passages(self, period: Period, kind: DetectorKind) -> Passages | None:
        """Return the passages over the detector of a kind; None if the lane has no such one."""
        name = self.detectors.get(kind)
        return None if name is None else period.of_detector(name)


@dataclass(frozen=True)
class Greens:
    """The greens of one lane in one period; all arrays ``(greens,)``, times in s.

    Attributes:
        start_s: Start of green.
        end_s: End of green and start of yellow.
        red_s: Start of red.
        next_s: Start of the next green, or end of the period.
        protected: True if the green gives right of way when it begins.
    """

    start_s: NDArray[np.float64]
    end_s: NDArray[np.float64]
    red_s: NDArray[np.float64]
    next_s: NDArray[np.float64]
    protected: NDArray[np.bool_]

    def last_begun(self, times: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the index of the last green that has begun at each time, and if any has.

        Where none has, the index is 0.
        """
        index = np.searchsorted(self.start_s, times, "right") - 1
        return np.maximum(index, 0), index >= 0


@dataclass(frozen=True)
class DetectorLayout:
    """Detectors of a street with their lanes and traffic lights, in a fixed order.

    Attributes:
        intersections: SUMO ids of the traffic lights.
        lanes: Incoming lanes.
        exits: Outgoing lanes with an exit detector: index of the intersection, lane, detector.
        detectors: All detectors.
        owner: SUMO id of the traffic light, by detector.
        begin_s: Begin of the scenario, s, at which no vehicle waits; inf if it is not known.
    """

    intersections: tuple[str, ...]
    lanes: tuple[IncomingLane, ...]
    exits: tuple[tuple[int, str, str], ...]
    detectors: tuple[Detector, ...]
    owner: Mapping[str, str]
    begin_s: float = math.inf

    @classmethod
    def of(
        cls, network: Network, detectors: Sequence[Detector], begin_s: float = math.inf
    ) -> DetectorLayout:
        """Find the traffic light and the lane of every detector.

        Args:
            network: The network.
            detectors: The detectors.
            begin_s: Begin of the scenario, s.

        Raises:
            MeasuredDataError: No detector is at an intersection with signals.
        """
        by_lane: dict[str, dict[DetectorKind, str]] = {}
        for detector in detectors:
            by_lane.setdefault(detector.lane, {}).setdefault(detector.kind, detector.id)
        lanes: list[IncomingLane] = []
        exits: list[tuple[int, str, str]] = []
        owner: dict[str, str] = {}
        for index, intersection in enumerate(network.intersections):
            for lane in intersection.incoming_lanes:
                links = [link for link in intersection.links if link.from_lane == lane]
                of_lane = by_lane.get(lane, {})
                kinds: dict[DetectorKind, str] = {
                    kind: name for kind, name in of_lane.items() if kind != "exit"
                }
                lanes.append(
                    IncomingLane(
                        lane,
                        network.lanes[lane].edge,
                        index,
                        tuple(sorted({link.index for link in links})),
                        network.lanes[lane].speed_mps,
                        kinds,
                        frozenset(link.to_edge for link in links),
                        frozenset({link.direction.lower() for link in links} - {"t"}),
                    )
                )
                owner |= dict.fromkeys(kinds.values(), intersection.id)
            for lane in intersection.outgoing_lanes:
                if name := by_lane.get(lane, {}).get("exit"):
                    exits.append((index, lane, name))
                    owner[name] = intersection.id
        if not owner:
            raise MeasuredDataError(
                "no detector lies on a lane that leads to or from a traffic light of the network; "
                "check lane_id in detectors.csv"
            )
        names = tuple(intersection.id for intersection in network.intersections)
        return cls(names, tuple(lanes), tuple(exits), tuple(detectors), owner, begin_s)

    @functools.cached_property
    def by_id(self) -> Mapping[str, Detector]:
        """All detectors by their id."""
        return {detector.id: detector for detector in self.detectors}

    def zone_m(self, lane: IncomingLane, kind: DetectorKind) -> float:
        """Return the length of a lane's detector of a kind, m."""
        return self.by_id[lane.detectors[kind]].length_m

    @functools.cached_property
    def places(self) -> tuple[tuple[int, str, str], ...]:
        """Index of the intersection, edge and lane of every place: incoming lanes, then exits."""
        incoming = [(lane.intersection, lane.edge, lane.id) for lane in self.lanes]
        outgoing = [(owner, edge_of_lane(name), name) for owner, name, _ in self.exits]
        return (*incoming, *outgoing)

    @functools.cached_property
    def counted(self) -> Mapping[str, tuple[str, int]]:
        """Feature and place by detector."""
        rows: dict[str, tuple[str, int]] = {}
        for index, lane in enumerate(self.lanes):
            rows |= {name: (f"count_{kind}", index) for kind, name in lane.detectors.items()}
        for index, (_, _, name) in enumerate(self.exits):
            rows[name] = ("count_exit", len(self.lanes) + index)
        return rows

    @functools.cached_property
    def places_of_edge(self) -> Mapping[str, tuple[int, ...]]:
        """Indices of the places on each edge."""
        by_edge: dict[str, list[int]] = {}
        for index, (_, edge, _) in enumerate(self.places):
            by_edge.setdefault(edge, []).append(index)
        return {edge: tuple(members) for edge, members in by_edge.items()}

    @functools.cached_property
    def lanes_with_both(self) -> Mapping[str, tuple[int, ...]]:
        """Indices of the lanes of each edge that have an advance and a stop detector."""
        by_edge: dict[str, list[int]] = {}
        for index, lane in enumerate(self.lanes):
            if "advance" in lane.detectors and "stop" in lane.detectors:
                by_edge.setdefault(lane.edge, []).append(index)
        return {edge: tuple(lanes) for edge, lanes in by_edge.items()}

    @functools.cached_property
    def approaches(self) -> tuple[tuple[int, ...], ...]:
        """The lanes of `lanes_with_both` by edge, for each edge without a zone on several lanes.

        Vehicles on the other edges cannot be followed by lane.
        """
        wide = {edge_of_lane(detector.lane) for detector in self.detectors if detector.beside}
        return tuple(lanes for edge, lanes in self.lanes_with_both.items() if edge not in wide)

    def ride_s(self, lane: int) -> float:
        """Return the time from the advance to the stop detector of a lane at its limit, s."""
        of_lane = self.lanes[lane]
        begin, end = (self.by_id[of_lane.detectors[kind]] for kind in ("advance", "stop"))
        metres = end.position_m + end.length_m - begin.position_m
        return max(metres, 0.0) / of_lane.speed_mps

    def greens(self, period: Period) -> tuple[Greens, ...]:
        """Return the greens of every lane that begin and end inside the period.

        A green at its very begin may have begun before. It counts only at the begin of the
        scenario, where nobody waits.
        """
        greens_of_lanes: list[Greens] = []
        for lane in self.lanes:
            log = period.signals.get(self.intersections[lane.intersection], ())
            at_begin = period.begin_s <= self.begin_s
            greens_of_lanes.append(_greens(log, lane.links, period, at_begin=at_begin))
        return tuple(greens_of_lanes)


def _greens(log: SignalLog, links: tuple[int, ...], period: Period, *, at_begin: bool) -> Greens:
    """Return the greens of a lane from the letters of its links in the signal log.

    Args:
        log: The log.
        links: Indices of the links.
        period: The period.
        at_begin: True if a green at the very begin of the period counts.
    """
    seen: dict[str, str] = {}
    changes: list[tuple[float, str]] = []
    for time, state in log:
        shown = seen.get(state)
        if shown is None:
            shown = seen[state] = deciding_letter([state[index] for index in links])
        if not changes or _kind(changes[-1][1]) != _kind(shown):
            changes.append((time, shown))
    rows: list[tuple[float, float, float, bool]] = []
    for (start, shown), (end, after), (later, _) in zip(
        changes, changes[1:], [*changes[2:], (period.end_s, "r")], strict=False
    ):
        begun = start > period.begin_s or (at_begin and start == period.begin_s)
        if shown in GREEN and begun and end < period.end_s:
            red = min(later, period.end_s) if after in YELLOW else end
            rows.append((start, end, red, shown == "G"))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    starts = np.array([*(time for time, shown in changes if shown in GREEN), np.inf])
    after = starts[np.searchsorted(starts, table[:, 0], "right")]  # a green cut by the end as well
    following = np.minimum(after, period.end_s)
    return Greens(table[:, 0], table[:, 1], table[:, 2], following, table[:, 3] > 0)


def _kind(shown: str) -> str:
    return "G" if shown in GREEN else "y" if shown in YELLOW else "r"


# --- features of single vehicles ------------------------------------------------------------------

FEATURES: tuple[tuple[str, str, str], ...] = (
    ("lost", "discharge", "s"),
    ("lost_trend", "discharge", "s"),
    ("gap2", "discharge", "s"),
    ("gap3", "discharge", "s"),
    ("gap4-5", "discharge", "s"),
    ("gap6-8", "discharge", "s"),
    ("gap9+", "discharge", "s"),
    ("gap_spread", "discharge", "s"),
    ("gap_short", "discharge", ""),
    ("gap_long", "discharge", ""),
    ("gap_permitted", "discharge", "s"),
    ("speed1", "discharge", "m/s"),
    ("speed2", "discharge", "m/s"),
    ("speed3", "discharge", "m/s"),
    ("speed4-5", "discharge", "m/s"),
    ("speed6-8", "discharge", "m/s"),
    ("over1", "discharge", "s"),
    ("over2-3", "discharge", "s"),
    ("over4+", "discharge", "s"),
    ("queued", "discharge", ""),
    ("discharged", "discharge", ""),
    ("platoon_gap", "free flow", "s"),
    ("platoon_short", "free flow", ""),
    ("platoon_middle", "free flow", ""),
    ("platoon_time", "free flow", "s"),
    ("free_speed", "free flow", "m/s"),
    ("free_speed_spread", "free flow", "m/s"),
    ("free_fast", "free flow", ""),
    ("free_time", "free flow", "s"),
    ("red_speed", "approach to red", "m/s"),
    ("red_slow", "approach to red", ""),
    ("red_time", "approach to red", "s"),
    ("yellow_crossings", "yellow", ""),
    ("late_crossings", "yellow", ""),
    ("red_crossings", "yellow", ""),
    ("last_crossing", "yellow", "s"),
    ("vehicle_length", "vehicles", "m"),
    ("long_vehicles", "vehicles", ""),
    ("occupied_in_red", "storage", ""),
    ("occupied_in_green", "storage", ""),
    ("queue_over", "storage", ""),
    ("count_advance", "volume", "1/min"),
    ("count_stop", "volume", "1/min"),
    ("count_exit", "volume", "1/min"),
    ("kept_to_stop", "volume", ""),
    ("kept_to_exit", "volume", ""),
)
"""Name, regime and unit of every feature."""

INTERVAL_FEATURES: tuple[tuple[str, str, str], ...] = tuple(
    (f"{name}_{kind}", regime, unit)
    for kind in ("advance", "stop", "exit")
    for name, regime, unit in (
        ("over", "occupancy", "s"),
        ("mean_speed", "mean speed", "m/s"),
        ("busy_count", "occupancy", ""),
        ("busy_speed", "mean speed", "m/s"),
        ("bunching", "occupancy", ""),
    )
)
"""Name, regime and unit of the features of intervals, see `intervals`. They stand behind `FEATURES`
in the tallies of counts that have occupancies or mean speeds."""
ALL_FEATURES = (*FEATURES, *INTERVAL_FEATURES)

INDEX = {name: index for index, (name, _, _) in enumerate(ALL_FEATURES)}
"""Index of a feature in `ALL_FEATURES`, by name."""
SATURATION_GAPS = tuple(INDEX[name] for name in ("gap4-5", "gap6-8", "gap9+"))
"""Indices of the gaps of queued vehicles from the fourth on: those of saturation flow."""
SERVICE_COUNTS = ("count_stop", "count_exit")
"""Names of the counts of vehicles that have crossed the stop line."""
OF_SEVERAL_LANES = frozenset({"kept_to_stop", "kept_to_exit"})
"""Features of an approach or a light, which are kept with the first of its lanes."""
SPEED_FEATURES = frozenset(
    {
        "speed1", "speed2", "speed3", "speed4-5", "speed6-8", "free_speed", "free_speed_spread",
        "free_fast", "red_speed", "red_slow", "vehicle_length", "long_vehicles",
    }
)  # fmt: skip
"""Features that need measured speeds."""
EVENT_FEATURES = frozenset(
    {
        "gap_short", "gap_long", "platoon_short", "platoon_middle", "free_fast", "red_slow",
        "yellow_crossings", "late_crossings", "red_crossings", "long_vehicles", "queue_over",
    }
)  # fmt: skip
"""Features that count events, some of which are very rare."""
COUNT_FEATURES = ("count_advance", "count_stop", "count_exit")
"""Features that count vehicles."""
PLATOON_FEATURES = ("platoon_gap", "platoon_short", "platoon_middle", "platoon_time")
"""Features of moving platoons at the advance detectors."""
BIN_FEATURES = (*COUNT_FEATURES, "occupied")
"""Quantities that are kept in bins of time: counts in vehicles, occupied time in s."""


@dataclass(frozen=True, eq=False)
class Tally:
    """The features of one period.

    Attributes:
        sums: Sums and numbers of observations, ``(features, places, 2)``. Features are `FEATURES`,
            or `ALL_FEATURES` where intervals are compared. Places are the incoming lanes, followed
            by the outgoing lanes.
        bins: Counts and occupied seconds in time, ``(bin features, places, bins)``.
        days: Number of periods that were added up.
        known: Number of periods in which each bin was counted, shape of `bins`; None if all were.
        journeys: Sums and numbers of observations of `JOURNEYS`, ``(measures, places, 2)``. No
            distance uses them. None without single vehicles.
        supplementary: Turning counts, travel times between places and states of lanes: sums and
            numbers of observations, ``(members, measures, 2)``, by block; see `supplementary_data`.
        window: Begin and end of the period, s; None if unknown, or for sums of different ones.
        period: Id of the measured period, of simulated days that whose signals ran; None likewise.
    """

    sums: Array
    bins: Array
    days: int = 1
    known: Array | None = None
    journeys: Array | None = None
    supplementary: Mapping[str, Array] = field(default_factory=dict)
    window: tuple[float, float] | None = None
    period: str | None = None

    @property
    def counted(self) -> Array:
        """Number of periods in which each bin was counted."""
        return np.full_like(self.bins, self.days) if self.known is None else self.known

    def gathered(self, together: int) -> tuple[Array, Array]:
        """Join bins to groups, and count the periods in which each group was counted.

        Args:
            together: Number of bins in a group; leftover bins at the end are not used.

        Returns:
            Sums of the groups and numbers of periods, both ``(bin features, places, groups)``; sums
            of groups that were never counted whole are 0.
        """
        width = min(together, self.bins.shape[-1])
        groups = self.bins.shape[-1] // width
        shape = (*self.bins.shape[:2], groups, width)
        bins, counted = (
            values[..., : groups * width].reshape(shape) for values in (self.bins, self.counted)
        )
        times = counted.min(axis=-1)
        return np.where(times > 0, bins.sum(axis=-1), 0.0), times

    def __add__(self, other: Tally) -> Tally:
        bins = min(self.bins.shape[-1], other.bins.shape[-1])
        every = self.known is None and other.known is None
        mine, others = self.journeys, other.journeys
        return Tally(
            self.sums + other.sums,
            self.bins[..., :bins] + other.bins[..., :bins],
            self.days + other.days,
            None if every else self.counted[..., :bins] + other.counted[..., :bins],
            None if mine is None or others is None else mine + others,
            {name: sums + other.supplementary[name] for name, sums in self.supplementary.items()},
            self.window if self.window == other.window else None,
            self.period if self.period == other.period else None,
        )


def bins_in(length_s: float, thresholds: DayThresholds) -> int:
    """Return the number of bins of time in a period of some length in s."""
    return max(1, round(length_s / thresholds.bin_s))


def tally(
    layout: DetectorLayout, period: Period, greens: Sequence[Greens], thresholds: DayThresholds
) -> Tally:
    """Reduce a period to its features.

    Args:
        layout: Lanes and detectors.
        period: Period with passages.
        greens: Greens of every lane, ``layout.greens(period)``; simulated days use those of the
            measured period.
        thresholds: Numbers of the method.
    """
    places = len(layout.lanes) + len(layout.exits)
    bins = bins_in(period.length_s, thresholds)
    counter = _Counter(
        np.zeros((len(FEATURES), places, 2)),
        np.zeros((len(BIN_FEATURES), places, bins)),
        period,
        thresholds,
    )
    stops = np.zeros(len(layout.lanes))
    advances = np.zeros(len(layout.lanes))
    for index, (lane, green) in enumerate(zip(layout.lanes, greens, strict=True)):
        counter.place = index
        stop, advance = lane.passages(period, "stop"), lane.passages(period, "advance")
        if stop is not None:
            stops[index] = counter.volume("count_stop", stop)
            _discharge(counter, stop, green)
            _clearance(counter, stop, green)
            _lengths(counter, stop, layout.zone_m(lane, "stop"))
        if advance is not None:
            advances[index] = counter.volume("count_advance", advance)
            _approach(counter, advance, green, lane.speed_mps)
            _storage(counter, advance, green)
            if stop is None:
                _lengths(counter, advance, layout.zone_m(lane, "advance"))
    exits = np.zeros(len(layout.exits))
    for index, (_, _, name) in enumerate(layout.exits):
        counter.place = len(layout.lanes) + index
        exits[index] = counter.volume("count_exit", period.of_detector(name))
    _conserved(counter, layout, advances, stops, exits)
    journeys = _journeys(layout, period, greens, thresholds)
    return Tally(
        counter.sums, counter.bins, journeys=journeys, window=period.window, period=period.id
    )


@dataclass
class _Counter:
    """Sums of features, filled one place after the other.

    Attributes:
        sums: Sums and numbers of observations, ``(features, places, 2)``.
        bins: Counts and occupied seconds, ``(bin features, places, bins)``.
        period: Period that is counted.
        thresholds: Numbers of the method.
        place: Index of the place that is being filled.
    """

    sums: Array
    bins: Array
    period: Period
    thresholds: DayThresholds
    place: int = 0

    def add(self, name: str, values: Array) -> None:
        values = values[np.isfinite(values)]
        self.sums[INDEX[name], self.place] += (values.sum(), len(values))

    def ratio(self, name: str, total: float, weight: float) -> None:
        self.sums[INDEX[name], self.place] += (total, weight)

    def volume(self, name: str, passages: Passages) -> float:
        times = passages.counted_s
        self.ratio(name, len(times), self.period.length_s / 60.0)
        counts, _ = np.histogram(times, self.bins.shape[2], self.period.window)
        self.bins[COUNT_FEATURES.index(name), self.place] += counts
        return float(len(times))


@dataclass(frozen=True, eq=False)
class Discharge:
    """Vehicles that cross a stop line in their green, in order; all arrays ``(vehicles,)``.

    Attributes:
        stop: Their passages over the stop detector.
        number: Place in their green, 0 for the first.
        start_s: Start of their green, s.
        gap_s: Time since the vehicle before, or since green began for the first, s.
        alive: True for those of the queue at the start of green, before its first long gap.
        protected: The same, where green gives right of way.
    """

    stop: Passages
    number: NDArray[np.int64]
    start_s: Array
    gap_s: Array
    alive: NDArray[np.bool_]
    protected: NDArray[np.bool_]

    @classmethod
    def of(cls, stop: Passages, greens: Greens, thresholds: DayThresholds) -> Discharge | None:
        """Find these vehicles; None without any."""
        order = np.argsort(stop.off_s, kind="stable")  # crossings in time, by the vehicle's rear
        stop = stop.at(order[np.isfinite(stop.off_s[order])])
        if not len(stop) or not len(greens.start_s):
            return None
        crossed = stop.off_s
        cycle, begun = greens.last_begun(crossed)
        inside = begun & (crossed <= greens.red_s[cycle])
        stop, crossed, cycle = stop.at(inside), crossed[inside], cycle[inside]
        if not len(stop):
            return None
        first = np.searchsorted(cycle, cycle, "left")
        number = np.arange(len(cycle)) - first
        start = greens.start_s[cycle]
        came = np.where(np.isfinite(stop.on_s), stop.on_s, -np.inf)
        queue = came[first] < start
        # the gap of the first queued vehicle runs from the start of green
        before = np.where(number == 0, start, np.roll(crossed, 1))
        gap = crossed - before
        broken = np.cumsum(
            gap > np.where(number == 0, thresholds.first_gap_s, thresholds.queue_break_s)
        )
        # vehicles before the first long gap of their green
        alive = queue & (broken - broken[first] + (gap[first] > thresholds.first_gap_s) == 0)
        return cls(stop, number, start, gap, alive, alive & greens.protected[cycle])


def _discharge(counter: _Counter, stop: Passages, greens: Greens) -> None:
    """Add gaps, speeds and times over the detector of vehicles queued at the start of green."""
    cycles = float(len(greens.start_s))
    counter.ratio("queued", 0.0, cycles)
    counter.ratio("discharged", 0.0, cycles)
    thresholds = counter.thresholds
    found = Discharge.of(stop, greens, thresholds)
    if found is None:
        return
    stop, number, start, gap = found.stop, found.number, found.start_s, found.gap_s
    alive, protected = found.alive, found.protected
    counter.add("gap_permitted", gap[alive & ~protected & (number >= 1)])
    lost = gap[protected & (number == 0)]
    counter.add("lost", lost)
    # trend = mean of lost * t, with t from -1 at the start of the period to 1 at its end
    middle = 0.5 * (counter.period.begin_s + counter.period.end_s)
    half = 0.5 * counter.period.length_s
    counter.add("lost_trend", lost * (start[protected & (number == 0)] - middle) / half)
    for name, low, high in (
        ("gap2", 1, 1), ("gap3", 2, 2), ("gap4-5", 3, 4), ("gap6-8", 5, 7), ("gap9+", 8, 14),
    ):  # fmt: skip
        counter.add(name, gap[protected & (number >= low) & (number <= high)])
    steady = gap[protected & (number >= 3)]
    counter.add("gap_spread", np.abs(steady - thresholds.usual_gap_s))
    counter.add("gap_short", (steady < thresholds.short_gap_s).astype(np.float64))
    counter.add("gap_long", (steady > thresholds.long_gap_s).astype(np.float64))
    for name, low, high in (
        ("speed1", 0, 0), ("speed2", 1, 1), ("speed3", 2, 2), ("speed4-5", 3, 4),
        ("speed6-8", 5, 7),
    ):  # fmt: skip
        counter.add(name, stop.speed_mps[protected & (number >= low) & (number <= high)])
    over = stop.off_s - np.where(number == 0, start, stop.on_s)
    for name, low, high in (("over1", 0, 0), ("over2-3", 1, 2), ("over4+", 3, 9)):
        counter.add(name, over[protected & (number >= low) & (number <= high)])
    counter.ratio("queued", float((alive & (number == 0)).sum()), 0.0)
    counter.ratio("discharged", float(alive.sum()), 0.0)


def _clearance(counter: _Counter, stop: Passages, greens: Greens) -> None:
    """Count crossings in yellow and at the beginning of red, per change of signal."""
    thresholds = counter.thresholds
    cycles = float(len(greens.start_s))
    crossed = stop.off_s[np.isfinite(stop.off_s)]
    if not cycles:
        return
    cycle = np.searchsorted(greens.end_s, crossed, "right") - 1
    crossed, cycle = crossed[cycle >= 0], cycle[cycle >= 0]
    after = crossed - greens.end_s[cycle]
    red = crossed - greens.red_s[cycle]
    counted = crossed < greens.next_s[cycle]
    counter.ratio("yellow_crossings", float((counted & (red <= 0)).sum()), cycles)
    counter.ratio(
        "late_crossings",
        float((counted & (red > 0) & (red <= thresholds.late_red_s)).sum()),
        cycles,
    )
    counter.ratio(
        "red_crossings",
        float((counted & (red > thresholds.late_red_s) & (red <= thresholds.after_red_s)).sum()),
        cycles,
    )
    counter.add("last_crossing", after[counted & (red <= thresholds.last_crossing_s)])


def _lengths(counter: _Counter, passages: Passages, zone_m: float) -> None:
    """Add lengths of vehicles: measured, else speed times time over the zone, less the zone."""
    quick = (passages.speed_mps > counter.thresholds.measurable_mps) & np.isfinite(passages.on_s)
    length = np.where(quick, passages.speed_mps * (passages.off_s - passages.on_s) - zone_m, np.nan)
    length = np.where(np.isfinite(passages.length_m), passages.length_m, length)
    counter.add("vehicle_length", length)
    counter.add("long_vehicles", _share(length, counter.thresholds.long_vehicle_m))


def free_vehicles(
    advance: Passages, greens: Greens, thresholds: DayThresholds
) -> NDArray[np.bool_]:
    """Mark vehicles over an advance detector that drive freely towards a settled green."""
    on = advance.on_s
    cycle, begun = greens.last_begun(on)
    green = begun & (on < greens.end_s[cycle])
    apart = np.append(np.inf, np.diff(on)) > thresholds.free_gap_s
    return green & apart & (on - greens.start_s[cycle] > thresholds.settled_green_s)


def _approach(counter: _Counter, advance: Passages, greens: Greens, limit_mps: float) -> None:
    """Add gaps and speeds of moving platoons, free vehicles, and vehicles that approach red."""
    thresholds = counter.thresholds
    known = np.isfinite(advance.on_s)
    advance = advance.at(known)
    if len(advance) < 2:
        return
    on, speed = advance.on_s, advance.speed_mps
    over = advance.off_s - on
    gap = np.append(np.inf, np.diff(on))
    moving = np.where(
        np.isfinite(speed), speed > thresholds.moving_mps, over < thresholds.moving_over_s
    )
    platoon = moving & np.append(False, moving[:-1]) & (gap < thresholds.platoon_gap_s)
    counter.add("platoon_gap", gap[platoon])
    counter.add("platoon_short", (gap[platoon] < thresholds.short_platoon_gap_s).astype(np.float64))
    counter.add(
        "platoon_middle", (gap[platoon] < thresholds.middle_platoon_gap_s).astype(np.float64)
    )
    counter.add("platoon_time", over[platoon])
    if not len(greens.start_s):
        return
    cycle, begun = greens.last_begun(on)
    red = (
        begun & (on > greens.red_s[cycle]) & (on < greens.next_s[cycle] - thresholds.before_green_s)
    )
    free = free_vehicles(advance, greens, thresholds)
    counter.add("free_speed", speed[free])
    counter.add("free_speed_spread", np.abs(speed[free] - limit_mps))
    counter.add("free_fast", _share(speed[free], thresholds.fast_share * limit_mps))
    counter.add("free_time", over[free & (over < thresholds.free_over_s)])
    alone = red & (gap > thresholds.lone_gap_s)
    counter.add("red_speed", speed[alone])
    counter.add("red_slow", 1.0 - _share(speed[alone], thresholds.slow_mps))
    counter.add("red_time", over[alone & (over < thresholds.red_over_s)])


def _share(values: Array, limit: float) -> Array:
    values = values[np.isfinite(values)]
    return (values > limit).astype(np.float64)


def occupations(seen: Passages, period: Period, thresholds: DayThresholds) -> tuple[Array, Array]:
    """Return begins and ends of the occupations of a detector in a period, s.

    Vehicles that were there before it begins, or after it ends, occupy the detector from its begin
    or to its end. One that was there before and stays long is a fault, and is left out.
    """
    on = np.where(np.isfinite(seen.on_s), seen.on_s, period.begin_s)
    off = np.where(np.isfinite(seen.off_s), seen.off_s, period.end_s)
    known = np.isfinite(seen.on_s) | (off - period.begin_s < thresholds.cut_occupation_s)
    return on[known], np.maximum(off, on)[known]


def _storage(counter: _Counter, advance: Passages, greens: Greens) -> None:
    """Add occupied seconds of the advance detector in green and red, and queues on it."""
    period = counter.period
    on, off = occupations(advance, period, counter.thresholds)
    times = np.concatenate(([period.begin_s], np.sort(on), np.sort(off), [period.end_s]))
    steps = np.concatenate(([0.0], np.ones(len(on)), -np.ones(len(off)), [0.0]))
    order = np.argsort(times, kind="stable")
    times, present = times[order], np.minimum(np.cumsum(steps[order]), 1.0)
    # occupied seconds from the start of the period up to each time
    filled = np.append(0.0, np.cumsum(np.diff(times) * present[:-1]))

    def occupied(when: Array) -> Array:
        return np.interp(when, times, filled)

    edges = np.linspace(period.begin_s, period.end_s, counter.bins.shape[2] + 1)
    counter.bins[BIN_FEATURES.index("occupied"), counter.place] += np.diff(occupied(edges))
    if not len(greens.start_s):
        return
    green = occupied(greens.end_s) - occupied(greens.start_s)
    red = occupied(greens.next_s) - occupied(greens.red_s)
    counter.ratio("occupied_in_green", green.sum(), (greens.end_s - greens.start_s).sum())
    counter.ratio("occupied_in_red", red.sum(), (greens.next_s - greens.red_s).sum())
    standing = (
        occupied(greens.start_s + 1.0) - occupied(greens.start_s - 1.0)
        > counter.thresholds.standing_s
    )
    counter.add("queue_over", standing.astype(np.float64))


def _conserved(
    counter: _Counter, layout: DetectorLayout, advances: Array, stops: Array, exits: Array
) -> None:
    """Add the ratios of counts: stop to advance by approach, exit to stop by intersection."""
    for members in map(list, layout.lanes_with_both.values()):
        counter.place = members[0]
        counter.ratio("kept_to_stop", stops[members].sum(), advances[members].sum())
    for number in range(len(layout.intersections)):
        incoming = [i for i, lane in enumerate(layout.lanes) if lane.intersection == number]
        outgoing = [i for i, (owner, _, _) in enumerate(layout.exits) if owner == number]
        if incoming and outgoing:
            counter.place = incoming[0]
            counter.ratio("kept_to_exit", exits[outgoing].sum(), stops[incoming].sum())


def _journeys(
    layout: DetectorLayout, period: Period, greens: Sequence[Greens], thresholds: DayThresholds
) -> Array:
    """Return sums of `JOURNEYS` at all places; nothing at lanes without both detectors."""
    sums = np.zeros((len(JOURNEYS), len(layout.lanes) + len(layout.exits), 2))
    for lanes in layout.approaches:
        came: list[Array] = []
        crossed: list[Crossings] = []
        for lane in (layout.lanes[index] for index in lanes):
            advance, stop = lane.passages(period, "advance"), lane.passages(period, "stop")
            assert advance is not None and stop is not None
            came.append(np.sort(advance.on_s[np.isfinite(advance.on_s)]))
            starts = greens[lanes[len(came) - 1]].start_s
            zone_m = layout.zone_m(lane, "stop")
            pace_mps, gap_s = thresholds.free * lane.speed_mps, thresholds.settled_green_s
            crossed.append(Crossings.of(stop, starts, zone_m, pace_mps, gap_s))
        rides = [layout.ride_s(index) for index in lanes]
        pairs, _ = matched(
            came,
            crossed,
            [ride / thresholds.fastest for ride in rides],
            [ride / thresholds.free + thresholds.slack_s for ride in rides],
        )
        for index, of_lane, ride in zip(lanes, pairs, rides, strict=True):
            sums[:, index] = journey_sums(of_lane, ride, greens[index].start_s)
    return sums
