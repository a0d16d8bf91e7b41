"""Days with the arrivals of a measured day, for signals that answered them.

Lights that follow the traffic gave green where that day's vehicles stood. Under the same signals
and with other vehicles a queue finds red that was never shown to it, and everything differs though
nothing is missing. So a simulated day under such signals is given the arrivals its advance
detectors saw: as many vehicles, then, and on lanes from where they can go on as they did. Their
routes, types and speeds are still those of the model.

How many vehicles were to be expected is then no longer in what is simulated; it is asked of the
demand itself and put in the place of the counts.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    COUNT_FEATURES,
    INDEX,
    PLATOON_FEATURES,
    Tally,
    bins_of,
)
from ugat_marl.diagnosis.inflow import by_lane_left, missed, unhindered
from ugat_marl.diagnosis.site import Site
from ugat_marl.effects import depart_s, sort_departures
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Document, Network, Passages, Period, Scenario

Array = NDArray[np.float64]

_FASTEST = 1.3
"""Multiple of the limit at which nobody drives from one detector to the next."""


@dataclass(frozen=True)
class _Lane:
    """A lane on which vehicles are seen to come."""

    advance: str
    stop: str | None
    position_m: float
    zone_m: float
    speed_mps: float
    travel_s: float
    following: frozenset[str]


@dataclass(frozen=True, eq=False)
class Due:
    """Vehicles a day of the model asks for, and those it was given; by edge and bin of time.

    Attributes:
        asked: Edge to vehicles that would come by its end if nobody stood anywhere, ``(bins,)``.
        given: The same of the vehicles that were simulated.
    """

    asked: Mapping[str, Array]
    given: Mapping[str, Array]


class Arrivals:
    """Reads when vehicles came, and makes a simulated day's vehicles come then.

    Args:
        site: Lanes and detectors.
        network: The network.
    """

    def __init__(self, site: Site, network: Network) -> None:
        lanes = network.lanes.values()
        self._pace_s = {lane.edge: lane.length_m / lane.speed_mps for lane in lanes}
        self._ways: dict[str, _Way] = {}
        self._approaches = _approaches(site)
        self._counted = frozenset(edge for _, edge, _ in site.places)

    def given(self, asked: Scenario, drivers: Scenario, period: Period) -> tuple[Scenario, Due]:
        """The day with the measured arrivals.

        Args:
            asked: The day as the model has it, with all its effects.
            drivers: The same without effects on how many vehicles depart, and when: vehicles are
                taken from here, so that such effects leave what is simulated alone.
            period: The measured one.

        Returns:
            What is to be simulated, and what was asked for beside it. Vehicles that come by no
            approach with advance detectors, or stop on their way, or come before the period, stay
            as they are.
        """
        document = drivers.routes[0]
        root = document.parse()
        demand = root if asked is drivers else asked.routes[0].parse()
        due = self._by_edge(demand, period)
        pools: dict[str, list[_Coming]] = {edge: [] for edge in self._approaches}
        stay: list[ET.Element] = []
        for item in root:
            coming = self._coming(item, period) if item.tag == "vehicle" else None
            if coming is None:
                stay.append(item)
            else:
                pools[coming.approach].append(coming)
        for edge, pool in pools.items():
            stay += _filled(pool, self._came(edge, period), drivers.settings.begin_s, period)
        root[:] = stay
        sort_departures(root)
        changed = Document(document.name, None, xml_bytes(root))
        return (
            replace(drivers, routes=(changed, *drivers.routes[1:])),
            Due(due, self._by_edge(root, period)),
        )

    def asked(self, day: Scenario, period: Period) -> dict[str, Array]:
        """Vehicles of a day that would come by the end of each counted edge, by bin of time."""
        return self._by_edge(day.routes[0].parse(), period)

    def _coming(self, item: ET.Element, period: Period) -> _Coming | None:
        """Where a vehicle is seen first, and when; None if it has to be left alone."""
        way = self._way(_route(item))
        if way.approach is None or item.find("stop") is not None:
            return None
        way_s = way.approach_s / _factor(item)
        time = depart_s(item) + way_s
        if not time >= period.begin_s:
            return None
        return _Coming(way.approach, time, way_s, way.following, item)

    def _way(self, route: str) -> _Way:
        """A route at the speed limit; remembered, since thousands drive the same few."""
        found = self._ways.get(route)
        if found is not None:
            return found
        edges = route.split()
        ends = np.cumsum([0.0, *(self._pace_s[edge] for edge in edges)]).tolist()
        counted = tuple(
            (edge, end) for edge, end in zip(edges, ends[1:], strict=True) if edge in self._counted
        )
        found = _Way(counted)
        first = next((i for i, edge in enumerate(edges) if edge in self._approaches), None)
        if first is not None:
            lane = self._approaches[edges[first]][0]
            following = edges[first + 1] if first + 1 < len(edges) else None
            there = ends[first] + lane.position_m / lane.speed_mps
            found = _Way(counted, edges[first], there, following)
        self._ways[route] = found
        return found

    def _came(self, edge: str, period: Period) -> list[tuple[float, frozenset[str]]]:
        """When vehicles would have come by an approach's advance detectors, and where they went."""
        lanes = self._approaches[edge]
        seen = [period.passages.get(lane.advance, Passages.none()) for lane in lanes]
        times = [
            unhindered(one, lane.speed_mps, period, lane.zone_m)
            for one, lane in zip(seen, lanes, strict=True)
        ]
        crossed = [
            np.sort(found.off_s[np.isfinite(found.off_s)])
            for lane in lanes
            for found in [period.passages.get(lane.stop or "", Passages.none())]
        ]
        if any(lane.stop is None for lane in lanes):
            left = times
        else:
            more = missed(np.concatenate(times), np.concatenate(crossed), period)
            spread = [more[index :: len(lanes)] for index in range(len(lanes))]
            times = [np.sort(np.concatenate(pair)) for pair in zip(times, spread, strict=True)]
            left = by_lane_left(times, crossed, [lane.travel_s for lane in lanes])
        found = [
            (float(time), lane.following)
            for lane, own in zip(lanes, left, strict=True)
            for time in own
        ]
        return sorted(found, key=lambda row: row[0])

    def _by_edge(self, vehicles: Iterable[ET.Element], period: Period) -> dict[str, Array]:
        """Vehicles that would come by the end of each counted edge, by bin of time."""
        bins = bins_of(period)
        times: dict[str, list[float]] = {edge: [] for edge in self._counted}
        for item in vehicles:
            if item.tag == "vehicle":
                depart, factor = depart_s(item), _factor(item)
                for edge, end_s in self._way(_route(item)).counted:
                    times[edge].append(depart + end_s / factor)
        span = period.begin_s, period.end_s
        return {
            edge: np.histogram(found, bins, span)[0].astype(np.float64)
            for edge, found in times.items()
        }


@dataclass(frozen=True)
class _Way:
    """A route at the speed limit.

    Attributes:
        counted: Edges with detectors, and when their ends are reached, s.
        approach: The first one on which vehicles are seen to come.
        approach_s: When its advance detector is reached, s.
        following: The edge behind it.
    """

    counted: tuple[tuple[str, float], ...]
    approach: str | None = None
    approach_s: float = 0.0
    following: str | None = None


@dataclass(frozen=True, eq=False)
class _Coming:
    """A vehicle on its way to the first approach where it is seen."""

    approach: str
    time_s: float
    way_s: float
    following: str | None
    item: ET.Element


def _filled(
    pool: Sequence[_Coming],
    came: Sequence[tuple[float, frozenset[str]]],
    earliest_s: float,
    period: Period,
) -> list[ET.Element]:
    """Vehicles of the pool at the times of those that came; again from the first if too few.

    In their own order, each where it can go on as it means to.
    """
    queues: dict[str | None, deque[_Coming]] = {}
    for item in sorted(pool, key=lambda item: item.time_s):
        queues.setdefault(item.following, deque()).append(item)
    found: list[ET.Element] = []
    turns: dict[str | None, int] = dict.fromkeys(queues, 0)
    sizes = {name: len(queue) for name, queue in queues.items()}
    for time, following in came:
        fitting = [name for name in queues if name is None or name in following] or list(queues)
        if not fitting:
            break  # the model has nobody who comes this way

        def waiting(name: str | None) -> float:
            rounds = turns[name] // sizes[name]
            return queues[name][0].time_s + rounds * (period.end_s - period.begin_s)

        name = min(fitting, key=waiting)
        queue = queues[name]
        coming = queue[0]
        queue.rotate(-1)
        item = ET.Element(coming.item.tag, dict(coming.item.attrib))
        item.extend(coming.item)
        if again := turns[name] // sizes[name]:
            item.set("id", f"{item.get('id')}+{again}")
        item.set("depart", f"{max(time - coming.way_s, earliest_s):.2f}")
        turns[name] += 1
        found.append(item)
    return found


def corrected(counted: Tally, site: Site, due: Due) -> Tally:
    """The tally with the counts the demand asks for, in the place of those that were given.

    Args:
        counted: Of a day with measured arrivals.
        site: Lanes and detectors.
        due: What was asked for beside what was given.

    Returns:
        Its gaps in moving platoons are left out: they are what was put in.
    """
    sums, bins = counted.sums.copy(), counted.bins.copy()
    lanes = Counter(edge for _, edge, _ in site.places)
    for place, (_, edge, _) in enumerate(site.places):
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
    return replace(counted, sums=sums, bins=np.maximum(bins, 0.0))


def _approaches(site: Site) -> dict[str, tuple[_Lane, ...]]:
    """Edges all of whose lanes in front of the traffic light have an advance detector."""
    zones = {item.id: item for item in site.detectors}
    lanes: dict[str, list[_Lane] | None] = {}
    for lane in site.lanes:
        advance = lane.detectors.get("advance")
        known = lanes.setdefault(lane.edge, [])
        if advance is None or known is None:
            lanes[lane.edge] = None
            continue
        stop = lane.detectors.get("stop", (None,))[0]
        zone = zones[advance[0]]
        begin = zone.position_m
        end = begin if stop is None else zones[stop].position_m
        travel = max(end - begin, 0.0) / (_FASTEST * lane.speed_mps)
        known.append(
            _Lane(
                advance[0],
                stop,
                begin,
                zone.length_m,
                lane.speed_mps,
                travel,
                lane.following,
            )
        )
    return {edge: tuple(known) for edge, known in lanes.items() if known}


def _route(item: ET.Element) -> str:
    route = item.find("route")
    return "" if route is None else route.get("edges", "")


def _factor(item: ET.Element) -> float:
    return float(item.get("speedFactor", "1"))
