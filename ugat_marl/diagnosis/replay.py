"""Simulated days under the measured signals, in plain SUMO.

The signals replay the measured states, so differences of the controller do not look like an effect.
Each day is simulated in its own process. The same day has the same vehicles under every model
(common random numbers).

Signals that follow the traffic gave green to the queues of the measured day. Other vehicles meet
these signals at wrong times, and all statistics differ although no effect is missing. So a
simulated day under such signals gets the arrivals that the advance detectors saw: the same number
of vehicles, at the same times, on lanes that allow the same next edges. Routes, types and speeds
are those of the model. The simulated counts then no longer show the model's demand. They are
replaced by counts that are read from the demand itself (`corrected`).
"""

from __future__ import annotations

import functools
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import passages_as_written
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
from ugat_marl.diagnosis.journeys import Crossings, matched
from ugat_marl.diagnosis.thresholds import DayThresholds
from ugat_marl.effects import (
    Effect,
    controller_effects,
    depart_s,
    detector_effects,
    installed_detectors,
    late_greens,
    service_of,
    shift_parking,
    sort_departures,
    withheld,
)
from ugat_marl.errors import MeasuredDataError, SimulatorCrashed, SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.parallel import retry_on_crash
from ugat_marl.scenarios import (
    Detector,
    Document,
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    Withheld,
    demand_as_vehicles,
    draw_day,
    finished,
    late_green_log,
    withheld_log,
)
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import (
    Way,
    delayed,
    detectors_document,
    lane_states_document,
    launch_of,
    one_line_message,
    places_document,
    read_between,
    read_lane_states,
    read_passages,
    read_trips,
)

_DAYS = 64
"""Largest number of days of vehicles that are kept in memory."""


@dataclass(frozen=True, eq=False)
class Day:
    """One simulated period.

    Attributes:
        period: The period with the passages that the detectors saw.
        travel_time_s: Mean time in the network of the vehicles due, with the wait to enter, s.
        due: Vehicles that the demand asked for; None if the day did not get measured arrivals.
        point_to_point: Times at the first place and travel times, s, ``(vehicles, 2)``, for each of
            the ways that are followed.
        lane_states: State of the watched lanes, see `read_lane_states`; None if there are none.
    """

    period: Period
    travel_time_s: float
    due: DemandBalance | None = None
    point_to_point: tuple[Array, ...] = ()
    lane_states: Array | None = None


class Replay:
    """Simulator of a scenario with effects under measured signals.

    Args:
        scenario: The scenario as it is, with the effects of its own file.
        network: The network of the scenario.
        detectors: Detectors that are compared.
        owner: Traffic light by detector.
        thresholds: Numbers of the method.
        answering: True if the signals followed the traffic; days then get the measured arrivals.
        detection: Errors of measurement of the detectors that saw the arrivals.
        day_to_day: Variation of the demand from day to day, see `draw_day`.
        followed: Ways on which vehicles are followed.
        watched: SUMO ids of lanes whose state is kept.
    """

    answering = False
    day_to_day = 0.0
    followed: tuple[Way, ...] = ()
    watched: tuple[str, ...] = ()

    def __init__(
        self,
        scenario: Scenario,
        network: Network,
        detectors: Sequence[Detector],
        owner: Mapping[str, str],
        thresholds: DayThresholds,
        *,
        answering: bool = False,
        detection: Sequence[Effect] = (),
        day_to_day: float = 0.0,
        followed: Sequence[Way] = (),
        watched: Sequence[str] = (),
    ) -> None:
        self._given = scenario, network, detectors, owner, thresholds
        self.answering = answering
        self._scenario = demand_as_vehicles(scenario)
        self._network = network
        self._detectors = tuple(detectors)
        self._owner = dict(owner)
        self._thresholds = thresholds
        self._detection = tuple(detection)
        self.day_to_day = day_to_day
        self.followed = tuple(followed)
        self.watched = tuple(watched)
        layout = DetectorLayout.of(network, installed_detectors(self._detection, detectors))
        self._arrivals = Arrivals(layout, network, thresholds) if answering else None
        self._own = detector_effects(scenario)
        self._days: OrderedDict[int, Scenario] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[functools.partial[Replay], tuple[Any, ...]]:
        """Pickle the arguments only, without the days in memory."""
        make = functools.partial(Replay, detection=self._detection, **self._options)
        return make, self._given

    def detecting(self, errors: Sequence[Effect]) -> Replay:
        """Return a simulator of the same days that knows errors of measurement."""
        return Replay(*self._given, detection=errors, **self._options)

    @property
    def _options(self) -> dict[str, Any]:
        """Options of every simulator of the same days."""
        return {
            "answering": self.answering,
            "day_to_day": self.day_to_day,
            "followed": self.followed,
            "watched": self.watched,
        }

    def simulate(self, effects: Sequence[Effect], period: Period, seed: int) -> Day:
        """Simulate one day.

        Args:
            effects: Effects, applied to the day in this order; faults of detectors are applied to
                the passages.
            period: Measured period: its start, end and signals, and its passages if the days get
                measured arrivals.
            seed: Number that selects the day; also SUMO's seed.

        Raises:
            SimulatorError: SUMO refused, or its process crashed repeatedly.
        """
        day = self._day(seed)
        scenario, due = Effect.apply_all(day, effects), None
        if self._arrivals is not None:
            others = [effect for effect in effects if not effect.on_departures]
            drivers = scenario if len(others) == len(effects) else Effect.apply_all(day, others)
            came = period
            for error in self._detection:
                came = error.undone(came, self._detectors)
            scenario, due = self._arrivals.given(scenario, drivers, self._as_sumo_stamps(came))
        scenario = shift_parking(scenario, derive_seed(seed, "parking"))
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            directory = Path(name)
            done = retry_on_crash(lambda: self._run(scenario, effects, period, seed, directory))
        seen = done.period
        for effect in (*self._own, *effects):
            seen = effect.observe(seen, self._detectors, self._owner)
        return replace(done, period=_logged(seen), due=due)

    def observed(self, effects: Sequence[Effect], period: Period) -> Period:
        """Return a simulated period as detectors with faults see it, without a new simulation."""
        for effect in effects:
            period = effect.observe(period, self._detectors, self._owner)
        return _logged(period)

    def shown(self, period: Period) -> Period:
        """Return a period whose lights change when those of its simulation do: with a step."""
        begin_s, step_s = self._begin_s(period), self._scenario.settings.step_length_s
        signals = {
            tls: tuple(
                (round(begin_s + step_s * tick, 6), state)
                for tick, state in _ticks(log, begin_s, step_s)
            )
            for tls, log in period.signals.items()
        }
        return replace(period, signals=signals)

    def _begin_s(self, period: Period) -> float:
        """Return the start of the simulation of a period, s: a step of the scenario."""
        settings = self._scenario.settings
        begin_s = max(settings.begin_s, period.begin_s - self._thresholds.warm_up_s)
        step_s = settings.step_length_s
        return settings.begin_s + step_s * round((begin_s - settings.begin_s) / step_s)

    def asked(self, effects: Sequence[Effect], period: Period, seed: int) -> Mapping[str, Array]:
        """Return the vehicles that a day of a model asks for, without a simulation.

        They are `DemandBalance.asked`.

        Raises:
            ValueError: The days get no measured arrivals.
        """
        if self._arrivals is None:
            raise ValueError("no arrivals are given in the place of those asked for")
        return self._arrivals.asked(Effect.apply_all(self._day(seed), effects), period)

    def _day(self, seed: int) -> Scenario:
        with self._lock:
            day = self._days.get(seed)
            if day is None:
                day = self._days[seed] = draw_day(self._scenario, seed, self.day_to_day)
                if len(self._days) > _DAYS:
                    self._days.popitem(last=False)
            return day

    def _as_sumo_stamps(self, period: Period) -> Period:
        """Return a period with the stamps that SUMO, which lets vehicles depart, would give."""
        step = self._scenario.settings.step_length_s
        early = {d.id: (1 - d.steps_early) * step for d in self._detectors}
        passages = {
            name: delayed(seen, -early.get(name, 0.0)) for name, seen in period.passages.items()
        }
        return replace(period, passages=passages)

    def _run(
        self,
        scenario: Scenario,
        effects: Sequence[Effect],
        period: Period,
        seed: int,
        directory: Path,
    ) -> Day:
        settings, begin = scenario.settings, self._begin_s(period)
        step = settings.step_length_s
        loops = directory / "loops.xml"
        true = installed_detectors((*self._own, *effects), self._detectors)
        red = withheld(self._network, service_of(controller_effects(scenario), ()))
        signals = replay_document(scenario, period, begin, red)
        detectors = detectors_document(true, self._network.lanes, loops)
        more = [signals, detectors]
        places = directory / "places.xml"
        if self.followed:
            more.append(places_document(self.followed, self._network.lanes, places))
        states = directory / "lanes.xml"
        if self.watched:
            more.append(lane_states_document(period.begin_s, period.end_s, states))
        scenario = replace(
            scenario,
            additional=(*scenario.additional, *more),
            settings=settings.model_copy(update={"begin_s": begin}),
        )
        launch = launch_of(scenario, seed, directory, ())
        launch.write()
        # The files are those of the scenario. Reading the schemas takes longer than a short day.
        unchecked = ("--xml-validation", "never", "--xml-validation.routes", "never")
        command = launch.command("--end", repr(period.end_s), *unchecked)
        done = finished("sumo", command)
        if done.returncode:
            said = one_line_message(done.stderr) or f"exit code {done.returncode}"
            # a negative exit code means that a signal of the system ended SUMO
            kind = SimulatorCrashed if done.returncode < 0 else SimulatorError
            raise kind(f"SUMO failed in a replay of period {period.id!r}: {said}")
        trips = read_trips(directory / "trips.xml")
        seen = read_passages(loops, true, period.begin_s, period.end_s, step)
        travel = float(np.mean(trips.travel_time_s)) if len(trips.travel_time_s) else np.nan
        point_to_point: tuple[Array, ...] = ()
        if self.followed:
            point_to_point = read_between(places, self.followed, period.begin_s, period.end_s)
        watched = read_lane_states(states, self.watched) if self.watched else None
        return Day(
            replace(period, passages=seen),
            travel,
            point_to_point=point_to_point,
            lane_states=watched,
        )


def _logged(period: Period) -> Period:
    """Return a period with passages as a signal controller would have logged them."""
    passages = {
        name: passages_as_written(seen, period.begin_s, period.end_s)
        for name, seen in period.passages.items()
    }
    return replace(period, passages=passages)


def replay_document(
    scenario: Scenario,
    period: Period,
    begin_s: float,
    red: Mapping[str, Withheld] | None = None,
) -> Document:
    """Write a signal programme with the measured states of every measured traffic light.

    The warm-up before the period shows the beginning of the measured log. If the scenario's
    settings have a lost time, it follows every start of green.

    Args:
        scenario: The scenario.
        period: The measured period.
        begin_s: Start of the simulation, s.
        red: Red of single links by traffic light, in decisions of the scenario's own length.

    Raises:
        MeasuredDataError: A traffic light has no signals.
    """
    root = ET.Element("additional")
    late_s = late_greens(scenario)
    step = scenario.settings.step_length_s
    for tls, log in sorted(period.signals.items()):
        if not log:
            raise MeasuredDataError(f"period {period.id!r}: no signals of traffic light {tls!r}")
        if red and tls in red:
            decision_s = scenario.control.decision_interval_s
            late = withheld_log(log, red[tls], late_s.get(tls, 0.0), step, decision_s, period.end_s)
        else:
            late = late_green_log(log, late_s.get(tls, 0.0), step)
        program = ET.SubElement(
            root,
            "tlLogic",
            {"id": tls, "type": "static", "programID": "replay", "offset": repr(begin_s)},
        )
        for duration, state in _durations(
            _from(late, period, begin_s), period.end_s, begin_s, step
        ):
            ET.SubElement(program, "phase", {"duration": repr(duration), "state": state})
    return Document("replay.add.xml", None, xml_bytes(root))


def _from(log: SignalLog, period: Period, begin_s: float) -> SignalLog:
    """Return the log from `begin_s` on; the time before the period repeats the log's beginning."""
    early = period.begin_s - begin_s
    if early <= 0:
        return log
    again = [(time - early, state) for time, state in log if time - early < period.begin_s]
    return (*again, *((max(time, period.begin_s), state) for time, state in log))


def _durations(
    log: SignalLog, end_s: float, begin_s: float, step_s: float
) -> list[tuple[float, str]]:
    """Return durations in s and states of phases, in whole steps, beyond the end of the period."""
    shown = _ticks(((max(time, begin_s), state) for time, state in log), begin_s, step_s)
    shown[0] = (0, shown[0][1])
    last = round((end_s - begin_s) / step_s) + 3600
    ticks = [tick for tick, _ in shown] + [max(last, shown[-1][0] + 1)]
    return [
        (round((after - tick) * step_s, 6), state)
        for (tick, state), after in zip(shown, ticks[1:], strict=True)
    ]


def _ticks(
    log: Iterable[tuple[float, str]], begin_s: float, step_s: float
) -> list[tuple[int, str]]:
    """Return the steps in which a log changes its state, counted from `begin_s`, and the states.

    Times are rounded instead of durations, so that errors do not add up.
    """
    shown: list[tuple[int, str]] = []
    for time, state in log:
        tick = round((time - begin_s) / step_s)
        if shown and shown[-1][0] == tick:
            shown[-1] = (tick, state)
        elif not shown or shown[-1][1] != state:
            shown.append((tick, state))
    return shown


# --- arrivals -------------------------------------------------------------------------------------


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
        asked: Vehicles of the demand that would reach the end of an edge in free flow, by edge,
            ``(bins,)``.
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
    """

    def __init__(self, layout: DetectorLayout, network: Network, thresholds: DayThresholds) -> None:
        self._thresholds = thresholds
        lanes = network.lanes.values()
        self._pace_s = {lane.edge: lane.length_m / lane.speed_mps for lane in lanes}
        self._ways: dict[str, _Way] = {}
        self._approaches = _approaches(layout, thresholds)
        self._counted = frozenset(edge for _, edge, _ in layout.places)

    def given(
        self, asked: Scenario, drivers: Scenario, period: Period
    ) -> tuple[Scenario, DemandBalance]:
        """Give a day the measured arrivals.

        Args:
            asked: The day of the model, with all its effects.
            drivers: The same day without effects on departures. Its vehicles are simulated, so
                effects on departures do not change the simulation.
            period: The measured period.

        Returns:
            The day to simulate, and the vehicles that were asked for and given. Some vehicles stay
            as they are: those without an approach with advance detectors, those with a stop on
            their way, and those that arrive before the period.
        """
        document = drivers.routes[0]
        root = document.parse()
        demand = root if asked is drivers else asked.routes[0].parse()
        due = self._by_edge(demand, period)
        pools: dict[str, list[_Coming]] = {edge: [] for edge in self._approaches}
        stay: list[ET.Element] = []
        for element in root:
            coming = self._coming(element, period) if element.tag == "vehicle" else None
            if coming is None:
                stay.append(element)
            else:
                pools[coming.approach].append(coming)
        for edge, pool in pools.items():
            stay += _filled(pool, self._came(edge, period), drivers.settings.begin_s, period)
        root[:] = stay
        sort_departures(root)
        changed = Document(document.name, None, xml_bytes(root))
        return (
            replace(drivers, routes=(changed, *drivers.routes[1:])),
            DemandBalance(due, self._by_edge(root, period)),
        )

    def asked(self, day: Scenario, period: Period) -> dict[str, Array]:
        """Return vehicles of a day that would reach the end of each counted edge, ``(bins,)``."""
        return self._by_edge(day.routes[0].parse(), period)

    def _coming(self, element: ET.Element, period: Period) -> _Coming | None:
        """Return where and when a vehicle is first detected; None if it must stay as it is."""
        way = self._way(_route(element))
        if way.approach is None or element.find("stop") is not None:
            return None
        way_s = way.approach_s / _factor(element)
        time = depart_s(element) + way_s
        if not time >= period.begin_s:
            return None
        return _Coming(way.approach, time, way_s, way.following, element)

    def _way(self, route: str) -> _Way:
        """Return a route at the speed limit; kept, since many vehicles share few routes."""
        way = self._ways.get(route)
        if way is not None:
            return way
        edges = route.split()
        ends = np.cumsum([0.0, *(self._pace_s[edge] for edge in edges)]).tolist()
        counted = tuple(
            (edge, end) for edge, end in zip(edges, ends[1:], strict=True) if edge in self._counted
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

    def _came(self, edge: str, period: Period) -> list[tuple[float, frozenset[str]]]:
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
        """Count vehicles that would reach the end of each counted edge, ``(bins,)``."""
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
        counted: Edges with detectors, each with the time from departure to its end, s.
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


def _filled(
    pool: Sequence[_Coming],
    came: Sequence[tuple[float, frozenset[str]]],
    earliest_s: float,
    period: Period,
) -> list[ET.Element]:
    """Return vehicles of the pool that arrive at the measured times.

    Vehicles are taken in their order in time, each on a lane that leads to its next edge. If the
    pool is too small, it starts again from its first vehicle.

    Args:
        pool: Vehicles of the model on their way to one approach.
        came: Measured arrival times, s, with the possible next edges.
        earliest_s: Earliest departure, s.
        period: The measured period.
    """
    queues: dict[str | None, deque[_Coming]] = {}
    for one in sorted(pool, key=lambda one: one.time_s):
        queues.setdefault(one.following, deque()).append(one)
    vehicles: list[ET.Element] = []
    turns: dict[str | None, int] = dict.fromkeys(queues, 0)
    sizes = {name: len(queue) for name, queue in queues.items()}
    for time, following in came:
        fitting = [name for name in queues if name is None or name in following] or list(queues)
        if not fitting:
            break  # the model has no vehicle on this approach

        def waiting(name: str | None) -> float:
            rounds = turns[name] // sizes[name]
            return queues[name][0].time_s + rounds * period.length_s

        name = min(fitting, key=waiting)
        queue = queues[name]
        coming = queue[0]
        queue.rotate(-1)
        vehicle = ET.Element(coming.element.tag, dict(coming.element.attrib))
        vehicle.extend(coming.element)
        if again := turns[name] // sizes[name]:
            vehicle.set("id", f"{vehicle.get('id')}+{again}")
        vehicle.set("depart", f"{max(time - coming.way_s, earliest_s):.2f}")
        turns[name] += 1
        vehicles.append(vehicle)
    return vehicles


def corrected(counted: Tally, layout: DetectorLayout, due: DemandBalance) -> Tally:
    """Return the tally of a day, with counts corrected to the model's demand.

    Corrected count = count + share * (asked - given), where the share of a lane is its part of the
    vehicles given to its edge.

    Args:
        counted: Tally of a day with measured arrivals.
        layout: Lanes and detectors.
        due: Vehicles asked for and given.

    Returns:
        The tally without platoon features, since these repeat the measured arrivals.
    """
    sums, bins = counted.sums.copy(), counted.bins.copy()
    lanes = Counter(edge for _, edge, _ in layout.places)
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
    return replace(counted, sums=sums, bins=np.maximum(bins, 0.0))


def _approaches(layout: DetectorLayout, thresholds: DayThresholds) -> dict[str, tuple[_Lane, ...]]:
    """Find edges with an advance detector on every lane in front of the traffic light."""
    zones = {detector.id: detector for detector in layout.detectors}
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
    seen: Passages, limit_mps: float, period: Period, thresholds: DayThresholds, zone_m: float = 0.0
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


# --- data that the detectors of the street do not measure -----------------------------------------


@dataclass(frozen=True)
class Unmeasured:
    """Detectors that saw vehicles but never measured their speeds or lengths.

    Attributes:
        speeds: Ids of detectors without speeds, sorted.
        lengths: Ids of detectors without lengths, sorted.
    """

    speeds: tuple[str, ...]
    lengths: tuple[str, ...]

    @classmethod
    def of(cls, periods: Sequence[Period]) -> Unmeasured:
        """Find the detectors without speeds or lengths in all measured periods."""
        seen: set[str] = set()
        speeds: set[str] = set()
        lengths: set[str] = set()
        for period in periods:
            for name, passages in period.passages.items():
                if len(passages):
                    seen.add(name)
                if np.isfinite(passages.speed_mps).any():
                    speeds.add(name)
                if np.isfinite(passages.length_m).any():
                    lengths.add(name)
        return cls(tuple(sorted(seen - speeds)), tuple(sorted(seen - lengths)))

    def __bool__(self) -> bool:
        return bool(self.speeds or self.lengths)

    def kept_from(self, period: Period) -> Period:
        """Return a simulated period without the speeds and lengths that the street lacks."""
        if not self:
            return period
        passages = {
            name: Passages(
                seen.on_s,
                seen.off_s,
                _blank(seen.speed_mps) if name in self.speeds else seen.speed_mps,
                _blank(seen.length_m) if name in self.lengths else seen.length_m,
            )
            for name, seen in period.passages.items()
        }
        return replace(period, passages=passages)


def _blank(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(values, np.nan)
