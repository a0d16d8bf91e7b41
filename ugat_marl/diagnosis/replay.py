"""Simulated days under the measured signals, in plain SUMO.

The signals replay the measured states, so differences of the controller do not look like an effect.
Each day is simulated in its own process. The same day has the same vehicles under every model
(common random numbers).

Under signals that follow the traffic, days get the measured arrivals (`arrivals`).
"""

from __future__ import annotations

import functools
import math
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ugat_marl.data import passages_as_written
from ugat_marl.diagnosis.arrivals import Arrivals, DemandBalance
from ugat_marl.diagnosis.features import (
    Array,
    DetectorLayout,
)
from ugat_marl.diagnosis.thresholds import DayThresholds
from ugat_marl.effects import (
    Effect,
    apply_detector_effects,
    controller_effects,
    detector_effects,
    installed_detectors,
    late_greens,
    service_of,
    shift_parking,
    withheld,
)
from ugat_marl.errors import MeasuredDataError, SimulatorCrashed, SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.parallel import retry_on_crash
from ugat_marl.scenarios import (
    Detector,
    Document,
    Network,
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
        self._scenario = demand_as_vehicles(scenario)
        # with routes: a copy of this simulator need not find them again
        self._given = self._scenario, network, detectors, owner, thresholds
        self.answering = answering
        self._network = network
        self._detectors = tuple(detectors)
        self._owner = dict(owner)
        self._thresholds = thresholds
        self._detection = tuple(detection)
        self.day_to_day = day_to_day
        self.followed = tuple(followed)
        self.watched = tuple(watched)
        layout = DetectorLayout.of(network, installed_detectors(self._detection, detectors))
        turns = [(first.edge, last.edge) for first, last in self.followed]
        self._arrivals = Arrivals(layout, network, thresholds, turns) if answering else None
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
        (scenario, drivers), due, earliest_s = self._models(effects, seed), None, math.inf
        if self._arrivals is not None:
            came = period
            for error in reversed(self._detection):
                came = error.undone(came, self._detectors)
            came = self._as_sumo_stamps(came)
            scenario, due, earliest_s = self._arrivals.given(scenario, drivers, came)
        begin_s = self._begin_s(period, earliest_s)
        scenario = shift_parking(scenario, derive_seed(seed, "parking"))
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            directory = Path(name)
            done = retry_on_crash(
                lambda: self._run(scenario, effects, period, begin_s, seed, directory)
            )
        return replace(done, period=self.observed((*self._own, *effects), done.period), due=due)

    def observed(self, effects: Sequence[Effect], period: Period) -> Period:
        """Return a simulated period as detectors with faults see it, without a new simulation."""
        return _logged(apply_detector_effects(period, effects, self._detectors, self._owner))

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

    def _begin_s(self, period: Period, earliest_s: float = math.inf) -> float:
        """Return the start of the simulation of a period, s: a step of the scenario.

        Args:
            period: The measured period.
            earliest_s: Departure that must not be missed, s; not before the scenario begins.
        """
        settings = self._scenario.settings
        begin_s = max(settings.begin_s, period.begin_s - self._thresholds.warm_up_s)
        step_s = settings.step_length_s
        steps = round((begin_s - settings.begin_s) / step_s)
        earliest = round((earliest_s - settings.begin_s) / step_s, 6)
        if earliest < steps:
            steps = max(math.floor(earliest), 0)
        return settings.begin_s + step_s * steps

    def asked(
        self, effects: Sequence[Effect], period: Period, seed: int
    ) -> Mapping[str, Array] | None:
        """Return the vehicles that a day of a model asks for, without a simulation.

        Returns:
            `DemandBalance.asked`; None if effects on departures change the simulation, as they do
            where approaches have no advance detectors.

        Raises:
            ValueError: The days get no measured arrivals.
        """
        if self._arrivals is None:
            raise ValueError("no arrivals are given in the place of those asked for")
        return self._arrivals.asked(*self._models(effects, seed), period)

    def _models(self, effects: Sequence[Effect], seed: int) -> tuple[Scenario, Scenario]:
        """Return a day with effects, and the same day without those on departures."""
        day = self._day(seed)
        others = [effect for effect in effects if not effect.on_departures]
        scenario = Effect.apply_all(day, effects)
        alike = self._arrivals is None or len(others) == len(effects)
        return scenario, scenario if alike else Effect.apply_all(day, others)

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
        begin_s: float,
        seed: int,
        directory: Path,
    ) -> Day:
        settings = scenario.settings
        step = settings.step_length_s
        loops = directory / "loops.xml"
        true = installed_detectors((*self._own, *effects), self._detectors)
        red = withheld(self._network, service_of(controller_effects(scenario), ()))
        signals = replay_document(scenario, period, begin_s, red)
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
            settings=settings.model_copy(update={"begin_s": begin_s}),
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
        trips = read_trips(directory / "trips.xml", period.end_s)
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
    """Return the log from `begin_s` on; the time before the period repeats the log's beginning.

    A period shorter than this time is repeated as often as needed.
    """
    early = period.begin_s - begin_s
    if early <= 0:
        return log
    again = [
        (shown, state)
        for turn in range(math.ceil(early / period.length_s))
        for time, state in log
        if (shown := (max(time, period.begin_s) if turn else time) - early + turn * period.length_s)
        < period.begin_s
        and time < period.end_s
    ]
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
        tick = math.floor((time - begin_s) / step_s + 0.5)  # half up, whatever the begin
        if shown and shown[-1][0] == tick:
            shown[-1] = (tick, state)
        elif not shown or shown[-1][1] != state:
            shown.append((tick, state))
    return shown
