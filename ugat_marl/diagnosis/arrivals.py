"""Measured arrivals for the vehicles of a simulated day.

Signals that follow the traffic gave green to the queues of the measured day. Other vehicles meet
these signals at wrong times, and all statistics differ although no effect is missing. So a
simulated day under such signals gets the arrivals that the advance detectors saw: the same number
of vehicles, at the same times, on lanes that allow the same next edges. Routes, types and speeds
are those of the model. The simulated counts then no longer show the model's demand. They are
replaced by counts that are read from the demand itself (`corrected`).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    COUNT_FEATURES,
    INDEX,
    PLATOON_FEATURES,
    Array,
    DetectorLayout,
    Tally,
    bins_in,
)
from ugat_marl.diagnosis.intervals import overlap_s
from ugat_marl.diagnosis.journeys import Crossings, matched
from ugat_marl.diagnosis.supplementary_data import TURNING, Span
from ugat_marl.diagnosis.thresholds import DayThresholds
from ugat_marl.effects import (
    depart_s,
    sort_departures,
)
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import (
    Document,
    Network,
    Passages,
    Period,
    Scenario,
    edge_of_lane,
)

_Came = tuple[float, frozenset[str]]
"""Time of a measured arrival, s, and its possible next edges."""


@dataclass(frozen=True)
class _Lane:
    """A lane with an advance detector in front of a traffic light.

    Attributes:
        advance: Id of the advance detector.
        stop: Id of the stop detector; None if there is none.
        position_m: Start of the advance detector's zone on the lane, m.
        zone_m: Length of this zone, m.
        speed_mps: Speed limit, m/s.
        travel_s: Least time from the advance detector to the stop detector, s.
        following: Edges that the lane leads to.
    """

    advance: str
    stop: str | None
    position_m: float
    zone_m: float
    speed_mps: float
    travel_s: float
    following: frozenset[str]


@dataclass(frozen=True, eq=False)
class DemandBalance:
    """Vehicles that the model's demand asks for, and vehicles that the simulated day got.

    Attributes:
        asked: Vehicles of the demand that would reach the end of an edge in free flow, ``(bins,)``,
            by edge, and by edge and next edge with a space between.
        given: The same numbers for the vehicles that were simulated.
    """

    asked: Mapping[str, Array]
    given: Mapping[str, Array]


class Arrivals:
    """Measured arrivals for the vehicles of a simulated day.

    Args:
        layout: Lanes and detectors.
        network: The network.
        thresholds: Numbers of the method.
        turns: Pairs of edges whose turning vehicles are counted.
    """

    def __init__(
        self,
        layout: DetectorLayout,
        network: Network,
        thresholds: DayThresholds,
        turns: Iterable[tuple[str, str]] = (),
    ) -> None:
        self._thresholds = thresholds
        lanes = network.lanes.values()
        self._pace_s = {lane.edge: lane.length_m / lane.speed_mps for lane in lanes}
        self._ways: dict[str, _Way] = {}
        self._approaches = _approaches(layout, thresholds)
        self._counted = {edge for _, edge, _ in layout.places} | set(map(" ".join, turns))

    def given(
        self, asked: Scenario, drivers: Scenario, period: Period
    ) -> tuple[Scenario, DemandBalance, float]:
        """Give a day the measured arrivals.

        Args:
            asked: The day of the model, with all its effects.
            drivers: The same day without effects on departures. Its vehicles are simulated where
                arrivals are measured, so effects on departures do not change the simulation there.
            period: The measured period.

        Returns:
            The day to simulate, the vehicles that were asked for and given, and the earliest
            departure to a measured arrival, s; inf if there is none. Some vehicles stay as they
            are: those without an approach with advance detectors, which are those asked for, those
            with a stop on their way, which take the nearest measured arrivals, and those that
            arrive before the period.
        """
        document = drivers.routes[0]
        root = document.parse()
        demand = root if asked is drivers else asked.routes[0].parse()
        due = self._by_edge(demand, period)
        pools: dict[str, list[_Coming]] = {edge: [] for edge in self._approaches}
        stopping: dict[str, list[_Coming]] = {edge: [] for edge in self._approaches}
        stay = [element for element in demand if self._unmeasured(element)]
        for element in root:
            if self._unmeasured(element):
                continue
            coming = self._coming(element, period) if element.tag == "vehicle" else None
            if coming is None:
                stay.append(element)
            elif element.find("stop") is not None:
                stay.append(element)
                stopping[coming.approach].append(coming)
            else:
                pools[coming.approach].append(coming)
        filled: list[ET.Element] = []
        for edge, pool in pools.items():
            came = _left_by(stopping[edge], self._came(edge, period), period)
            filled += _filled(pool, came, drivers.settings.begin_s, self._thresholds)
        root[:] = [*stay, *filled]
        sort_departures(root)
        changed = Document(document.name, None, xml_bytes(root))
        return (
            replace(drivers, routes=(changed, *drivers.routes[1:])),
            DemandBalance(due, self._by_edge(root, period)),
            min(map(depart_s, filled), default=math.inf),
        )

    def asked(self, day: Scenario, drivers: Scenario, period: Period) -> dict[str, Array] | None:
        """Return `DemandBalance.asked` of a day.

        Args:
            day: The day of the model, with all its effects.
            drivers: The same day without effects on departures.
            period: The measured period.

        Returns:
            None if effects on departures change vehicles that `given` takes from the demand.
        """
        demand, others = (one.routes[0].parse() for one in (day, drivers))
        here, there = (
            [(one.get("id"), depart_s(one)) for one in root if self._unmeasured(one)]
            for root in (demand, others)
        )
        return self._by_edge(demand, period) if here == there else None

    def _unmeasured(self, element: ET.Element) -> bool:
        """Return True for a vehicle that is counted, but on no approach with advance detectors."""
        if element.tag != "vehicle":
            return False
        way = self._way(_route(element))
        return way.approach is None and bool(way.counted)

    def _coming(self, element: ET.Element, period: Period) -> _Coming | None:
        """Return where and when a vehicle is first detected; None if nowhere, or before then."""
        way = self._way(_route(element))
        if way.approach is None:
            return None
        way_s = way.approach_s / _factor(element) + self._stopped_s(element, way.approach)
        time = depart_s(element) + way_s
        if not time >= period.begin_s:
            return None
        return _Coming(way.approach, time, way_s, way.following, element)

    def _stopped_s(self, element: ET.Element, approach: str) -> float:
        """Return how long a vehicle stops on its way to the advance detector of an approach, s."""
        stops = element.findall("stop")
        if not stops:  # as nearly always
            return 0.0
        edges = _route(element).split()
        before = edges[: edges.index(approach)]
        detector_m = self._approaches[approach][0].position_m
        stopped_s = 0.0
        for stop in stops:
            edge = stop.get("edge") or edge_of_lane(stop.get("lane", ""))
            is_near = edge == approach and float(stop.get("endPos", "inf")) <= detector_m
            if edge in before or is_near:
                stopped_s += float(stop.get("duration", "0"))
        return stopped_s

    def _way(self, route: str) -> _Way:
        """Return a route at the speed limit; kept, since many vehicles share few routes."""
        way = self._ways.get(route)
        if way is not None:
            return way
        edges = route.split()
        ends = np.cumsum([0.0, *(self._pace_s[edge] for edge in edges)]).tolist()
        counted = tuple(
            (place, end)
            for edge, following, end in zip(edges, [*edges[1:], ""], ends[1:], strict=True)
            for place in (edge, f"{edge} {following}")
            if place in self._counted
        )
        way = _Way(counted)
        first = next((i for i, edge in enumerate(edges) if edge in self._approaches), None)
        if first is not None:
            lane = self._approaches[edges[first]][0]
            following = edges[first + 1] if first + 1 < len(edges) else None
            there = ends[first] + lane.position_m / lane.speed_mps
            way = _Way(counted, edges[first], there, following)
        self._ways[route] = way
        return way

    def _came(self, edge: str, period: Period) -> list[_Came]:
        """Return the arrival times at an approach, s, each with its possible next edges."""
        lanes = self._approaches[edge]
        seen = [period.of_detector(lane.advance) for lane in lanes]
        times = [
            unhindered(one, lane.speed_mps, period, self._thresholds, lane.zone_m)
            for one, lane in zip(seen, lanes, strict=True)
        ]
        crossed = [
            np.sort(seen_at_stop.off_s[np.isfinite(seen_at_stop.off_s)])
            for lane in lanes
            for seen_at_stop in [period.of_detector(lane.stop or "")]
        ]
        if any(lane.stop is None for lane in lanes):
            left = times
        else:
            more = missed(np.concatenate(times), np.concatenate(crossed), period, self._thresholds)
            spread = [more[index :: len(lanes)] for index in range(len(lanes))]
            times = [np.sort(np.concatenate(pair)) for pair in zip(times, spread, strict=True)]
            left = by_lane_left(times, crossed, [lane.travel_s for lane in lanes])
        arrivals = [
            (float(time), lane.following)
            for lane, times_of_lane in zip(lanes, left, strict=True)
            for time in times_of_lane
        ]
        return sorted(arrivals, key=lambda row: row[0])

    def _by_edge(self, vehicles: Iterable[ET.Element], period: Period) -> dict[str, Array]:
        """Count vehicles that would reach the end of each counted edge, see `DemandBalance`."""
        bins = bins_in(period.length_s, self._thresholds)
        times: dict[str, list[float]] = {edge: [] for edge in self._counted}
        for element in vehicles:
            if element.tag == "vehicle":
                depart, factor = depart_s(element), _factor(element)
                for edge, end_s in self._way(_route(element)).counted:
                    times[edge].append(depart + end_s / factor)
        span = period.begin_s, period.end_s
        return {
            edge: np.histogram(reached, bins, span)[0].astype(np.float64)
            for edge, reached in times.items()
        }


@dataclass(frozen=True)
class _Way:
    """A route at the speed limit.

    Attributes:
        counted: Counted edges and turns, each with the time from departure to the edge's end, s.
        approach: First edge of the route with advance detectors; None if there is none.
        approach_s: Time from departure to its advance detector, s.
        following: Next edge after `approach`; None at the end of the route.
    """

    counted: tuple[tuple[str, float], ...]
    approach: str | None = None
    approach_s: float = 0.0
    following: str | None = None


@dataclass(frozen=True, eq=False)
class _Coming:
    """A vehicle on its way to the first approach with advance detectors.

    Attributes:
        approach: Edge of this approach.
        time_s: Time at which the vehicle reaches the advance detector in free flow, s.
        way_s: Time from departure to there, s.
        following: Next edge after the approach; None at the end of the route.
        element: XML element of the vehicle.
    """

    approach: str
    time_s: float
    way_s: float
    following: str | None
    element: ET.Element

    def fits(self, edges: frozenset[str]) -> bool:
        """Return True if a lane that leads to these edges leads to the vehicle's next edge."""
        return self.following is None or self.following in edges


def _left_by(stopping: Sequence[_Coming], came: Sequence[_Came], period: Period) -> list[_Came]:
    """Return the measured arrivals that vehicles with a stop leave to others.

    Each of them takes the arrival that is nearest in time, of those whose lane leads to its next
    edge.

    Args:
        stopping: Vehicles with a stop, on their way to one approach.
        came: Measured arrivals there.
        period: The measured period; who comes after it takes none.
    """
    left = list(came)
    for one in stopping:
        fits = [place for place, (_, following) in enumerate(left) if one.fits(following)]
        if fits and one.time_s < period.end_s:
            del left[min(fits, key=lambda place: abs(left[place][0] - one.time_s))]
    return left


def _filled(
    pool: Sequence[_Coming],
    came: Sequence[_Came],
    earliest_s: float,
    thresholds: DayThresholds,
) -> list[ET.Element]:
    """Return vehicles of the pool that arrive at the measured times.

    Each arrival gets the vehicle that is nearest in time, of those whose next edge its lane leads
    to. So next edges stay at their time of day. A vehicle counts as a bin of time farther away for
    each time that it was taken, so that others come first.

    Args:
        pool: Vehicles of the model on their way to one approach.
        came: Measured arrival times, s, with the possible next edges.
        earliest_s: Earliest departure, s.
        thresholds: Numbers of the method.
    """
    if not pool:
        return []  # the model has no vehicle on this approach
    times = np.array([one.time_s for one in pool])
    taken = np.zeros(len(pool), np.int64)
    fits: dict[frozenset[str], NDArray[np.bool_]] = {}
    for edges in {edges for _, edges in came}:
        led = np.array([one.fits(edges) for one in pool])
        fits[edges] = led if led.any() else ~led
    vehicles: list[ET.Element] = []
    for time, following in came:
        away_s = np.abs(times - time) + thresholds.bin_s * taken
        nearest = int(np.argmin(np.where(fits[following], away_s, np.inf)))
        coming, again = pool[nearest], int(taken[nearest])
        vehicle = ET.Element(coming.element.tag, dict(coming.element.attrib))
        vehicle.extend(coming.element)
        if again:
            vehicle.set("id", f"{vehicle.get('id')}+{again}")
        vehicle.set("depart", f"{max(time - coming.way_s, earliest_s):.2f}")
        taken[nearest] += 1
        vehicles.append(vehicle)
    return vehicles


def corrected(
    counted: Tally,
    layout: DetectorLayout,
    due: DemandBalance,
    spans: Mapping[tuple[str, str], Sequence[Span]],
) -> Tally:
    """Return the tally of a day, with counts corrected to the model's demand.

    Corrected count = count + share * (asked - given), where the share of a lane is its part of the
    vehicles given to its edge. If none were given, the lanes of the edge share alike. The share of
    a turn is, for each bin of time, the part of it in which the turn was counted.

    Args:
        counted: Tally of a day with measured arrivals.
        layout: Lanes and detectors.
        due: Vehicles asked for and given.
        spans: Start and end of the counted intervals, s, by edge and next edge, for each member of
            the block of turning counts.

    Returns:
        The tally without platoon features, since these repeat the measured arrivals.
    """
    sums, bins = counted.sums.copy(), counted.bins.copy()
    # A lane between two lights is a place twice: in front of one of them, and behind the other.
    lanes = Counter(edge for edge, _ in {(edge, lane) for _, edge, lane in layout.places})
    for place, (_, edge, _) in enumerate(layout.places):
        more = due.asked[edge] - due.given[edge]
        given = float(due.given[edge].sum())
        for name in COUNT_FEATURES:
            row, line = INDEX[name], BIN_FEATURES.index(name)
            if sums[row, place, 1] > 0:
                share = sums[row, place, 0] / given if given else 1.0 / lanes[edge]
                sums[row, place, 0] = max(sums[row, place, 0] + share * more.sum(), 0.0)
                width = min(len(more), bins.shape[-1])
                bins[line, place, :width] += share * more[:width]
    sums[[INDEX[name] for name in PLATOON_FEATURES]] = 0.0
    supplementary = dict(counted.supplementary)
    if TURNING in supplementary and counted.window is not None:
        supplementary[TURNING] = turning = supplementary[TURNING].copy()
        for member, (turn, intervals) in enumerate(spans.items()):
            more = due.asked[" ".join(turn)] - due.given[" ".join(turn)]
            edges = np.linspace(*counted.window, len(more) + 1)
            begin_s, end_s = np.reshape(np.asarray(intervals, np.float64), (-1, 2)).T
            shares = overlap_s(begin_s, end_s, edges).sum(axis=0) / np.diff(edges)
            own = float(shares @ more)
            turning[member, 0, 0] = max(turning[member, 0, 0] + own, 0.0)
    return replace(counted, sums=sums, bins=np.maximum(bins, 0.0), supplementary=supplementary)


def _approaches(layout: DetectorLayout, thresholds: DayThresholds) -> dict[str, tuple[_Lane, ...]]:
    """Find edges with an advance detector on every lane in front of the traffic light."""
    zones = layout.by_id
    lanes: dict[str, list[_Lane] | None] = {}
    for lane in layout.lanes:
        advance = lane.detectors.get("advance")
        known = lanes.setdefault(lane.edge, [])
        if advance is None or known is None:
            lanes[lane.edge] = None
            continue
        stop = lane.detectors.get("stop")
        zone = zones[advance]
        begin = zone.position_m
        end = begin if stop is None else zones[stop].position_m
        travel = max(end - begin, 0.0) / (thresholds.fastest * lane.speed_mps)
        known.append(
            _Lane(
                advance,
                stop,
                begin,
                zone.length_m,
                lane.speed_mps,
                travel,
                lane.following,
            )
        )
    return {edge: tuple(known) for edge, known in lanes.items() if known}


def _route(vehicle: ET.Element) -> str:
    route = vehicle.find("route")
    return "" if route is None else route.get("edges", "")


def _factor(vehicle: ET.Element) -> float:
    return float(vehicle.get("speedFactor", "1"))


def unhindered(
    seen: Passages, limit_mps: float, period: Period, thresholds: DayThresholds, zone_m: float
) -> Array:
    """Return the arrival times of vehicles as if no queue had delayed them, s.

    A vehicle that crosses the detector in a queue had joined the queue earlier, at an unknown time.
    Such vehicles are spread evenly between the free vehicles before and after them. No vehicle is
    moved later than its measured time.

    Args:
        seen: Passages over an advance detector.
        limit_mps: Speed limit at the detector, m/s.
        period: The measured period.
        thresholds: Numbers of the method.
        zone_m: Length of the detection zone, m.
    """
    seen = seen.at(np.isfinite(seen.on_s))
    times = seen.on_s.copy()
    over = np.maximum(seen.off_s - seen.on_s, 1e-3)
    pace = (
        np.where(np.isfinite(seen.speed_mps), seen.speed_mps, (thresholds.length_m + zone_m) / over)
        / limit_mps
    )
    slow = pace < thresholds.held_up
    close = np.diff(times, prepend=-np.inf) < thresholds.close_s
    for place in np.flatnonzero(close & ~slow & (pace < thresholds.free)).tolist():
        slow[place] = slow[place - 1]  # a close follower stood farther back in the same queue
    edges = np.flatnonzero(np.diff(np.concatenate(([False], slow, [False]))))
    for first, behind in zip(edges[::2], edges[1::2], strict=True):
        before = times[first - 1] if first else period.begin_s
        after = times[behind] if behind < len(times) else period.end_s
        spread = np.linspace(before, after, behind - first + 2)[1:-1]
        times[first:behind] = np.minimum(times[first:behind], spread)
    return times


def by_lane_left(
    came: Sequence[Array], crossed: Sequence[Array], travel_s: Sequence[float]
) -> list[Array]:
    """Return the arrival times of vehicles, by the lane on which they leave the approach.

    Some vehicles change lanes between the detectors; see `matched`.

    Args:
        came: Times at the advance detectors in order, per lane, s.
        crossed: Times at the stop detectors in order, per lane, s.
        travel_s: Least time from the advance to the stop detector, per lane, s.

    Returns:
        Times per lane, s. Vehicles that never left stay on the lane of their arrival.
    """
    vehicles = [Crossings(times, np.zeros(len(times), np.bool_)) for times in crossed]
    pairs, waiting = matched(came, vehicles, travel_s)
    return [
        np.array(sorted([*(arrival for arrival, _ in of_lane), *left]))
        for of_lane, left in zip(pairs, waiting, strict=True)
    ]


def missed(times: Array, crossed: Array, period: Period, thresholds: DayThresholds) -> Array:
    """Return times for vehicles that the advance detectors missed, s, evenly spread by window.

    Vehicles are missed if the stop detectors saw many more.

    Args:
        times: Times at the advance detectors, s.
        crossed: Times at the stop detectors, s.
        period: The measured period.
        thresholds: Numbers of the method.
    """
    if len(crossed) - len(times) <= thresholds.missing + thresholds.missing_share * len(times):
        return np.empty(0)
    count = max(1, round(period.length_s / thresholds.missed_window_s))
    edges = np.linspace(period.begin_s, period.end_s, count + 1)
    lacking = np.histogram(crossed, edges)[0] - np.histogram(times, edges)[0]
    lacking = np.maximum(lacking, 0)
    share = (len(crossed) - len(times)) / max(int(lacking.sum()), 1)
    parts = [
        np.linspace(begin, end, n + 2)[1:-1]
        for begin, end, n in zip(
            edges[:-1], edges[1:], np.round(share * lacking).astype(int), strict=True
        )
    ]
    return np.concatenate(parts)
