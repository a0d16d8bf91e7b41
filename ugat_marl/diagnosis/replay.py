"""Simulated days under the measured signals, in plain SUMO.

The measured states drive the simulation, so that the controller is not mistaken for physics. One
process per day; the same day has the same vehicles under every model (common random numbers).
"""

from __future__ import annotations

import functools
import subprocess
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ugat_marl.data import as_logged
from ugat_marl.diagnosis.arrivals import Array, Arrivals, Due
from ugat_marl.diagnosis.site import Site
from ugat_marl.effects import (
    Effect,
    detector_effects,
    late_greens,
    parked_at_other_times,
)
from ugat_marl.errors import MeasuredDataError, SimulatorCrashed, SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.parallel import persistently
from ugat_marl.scenarios import (
    Detector,
    Document,
    Network,
    Period,
    Scenario,
    SignalLog,
    another_day,
    as_vehicles,
    delayed_log,
    sumo_program,
)
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import launch_of, loops_document, one_line, read_loops, read_trips

WARM_UP_S = 600.0
"""Simulated before a period that does not begin with the scenario, under its own first signals."""

_DAYS = 64


@dataclass(frozen=True, eq=False)
class Day:
    """One simulated period.

    Attributes:
        period: What the detectors saw.
        travel_time_s: Mean time in the network of the vehicles due, waiting to enter included.
        due: What the demand asked for, if the day had measured arrivals instead.
    """

    period: Period
    travel_time_s: float
    due: Due | None = None


class Replay:
    """Simulates a scenario with effects under measured signals.

    Args:
        scenario: The scenario as it is, with the effects of its own file.
        network: Its network.
        detectors: What is measured.
        owner: Detector to its traffic light.
        answering: Whether the signals answered the traffic, so that days need its arrivals.
    """

    answering = False

    def __init__(
        self,
        scenario: Scenario,
        network: Network,
        detectors: Sequence[Detector],
        owner: Mapping[str, str],
        *,
        answering: bool = False,
    ) -> None:
        self._given = scenario, network, detectors, owner
        self.answering = answering
        self._scenario = as_vehicles(scenario)
        self._network = network
        self._detectors = tuple(detectors)
        self._owner = dict(owner)
        self._arrivals = Arrivals(Site.of(network, detectors), network) if answering else None
        self._own = detector_effects(scenario)
        self._days: OrderedDict[int, Scenario] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[functools.partial[Replay], tuple[Any, ...]]:
        """For executors elsewhere: the days it remembers stay here."""
        return functools.partial(Replay, answering=self.answering), self._given

    def simulate(self, effects: Sequence[Effect], period: Period, seed: int) -> Day:
        """Simulates one day.

        Args:
            effects: Applied to the day one after the other; those of detectors to what they see.
            period: Begin, end and signals; what was detected, if the signals answered it.
            seed: Which day, and SUMO's own seed.

        Raises:
            SimulatorError: SUMO refused, or its process died again and again.
        """
        day = self._day(seed)
        scenario, due = _with(day, effects), None
        if self._arrivals is not None:
            others = [item for item in effects if not item.on_departures]
            drivers = scenario if len(others) == len(effects) else _with(day, others)
            scenario, due = self._arrivals.given(scenario, drivers, period)
        scenario = parked_at_other_times(scenario, derive_seed(seed, "parking"))
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            directory = Path(name)
            done = persistently(lambda: self._run(scenario, period, seed, directory))
        seen = done.period
        for effect in (*self._own, *effects):
            seen = effect.observe(seen, self._detectors, self._owner)
        return Day(_logged(seen), done.travel_time_s, due)

    def observed(self, effects: Sequence[Effect], period: Period) -> Period:
        """A simulated period as other detectors would have seen it; costs no simulation."""
        for effect in effects:
            period = effect.observe(period, self._detectors, self._owner)
        return _logged(period)

    def asked(self, effects: Sequence[Effect], period: Period, seed: int) -> Mapping[str, Array]:
        """What a day of a model asks for, see `Due`; costs no simulation.

        Raises:
            ValueError: The signals answered nobody.
        """
        if self._arrivals is None:
            raise ValueError("no arrivals are given in the place of those asked for")
        return self._arrivals.asked(_with(self._day(seed), effects), period)

    def _day(self, seed: int) -> Scenario:
        with self._lock:
            found = self._days.get(seed)
            if found is None:
                found = self._days[seed] = another_day(self._scenario, seed)
                if len(self._days) > _DAYS:
                    self._days.popitem(last=False)
            return found

    def _run(self, scenario: Scenario, period: Period, seed: int, directory: Path) -> Day:
        settings = scenario.settings
        step = settings.step_length_s
        begin = max(settings.begin_s, period.begin_s - WARM_UP_S)
        begin = settings.begin_s + step * round((begin - settings.begin_s) / step)
        loops = directory / "loops.xml"
        signals = replay_document(scenario, period, begin)
        detectors = loops_document(self._detectors, dict(self._network.lanes), loops)
        scenario = replace(
            scenario,
            additional=(*scenario.additional, signals, detectors),
            settings=settings.model_copy(update={"begin_s": begin}),
        )
        launch = launch_of(scenario, seed, directory, ())
        launch.write()
        command = [str(sumo_program("sumo")), *launch.arguments, "--end", repr(period.end_s)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = one_line(done.stderr) or f"exit code {done.returncode}"
            kind = SimulatorCrashed if done.returncode < 0 else SimulatorError  # by a signal
            raise kind(f"SUMO failed in a replay of period {period.id!r}: {said}")
        trips = read_trips(directory / "trips.xml")
        seen = read_loops(loops, self._detectors, period.begin_s, period.end_s)
        travel = float(np.mean(trips.travel_time_s)) if len(trips.travel_time_s) else np.nan
        return Day(replace(period, passages=seen), travel)


def _with(scenario: Scenario, effects: Sequence[Effect]) -> Scenario:
    for effect in effects:
        scenario = effect.apply(scenario)
    return scenario


def _logged(period: Period) -> Period:
    """What the electronics of a street would have kept of it."""
    passages = {
        name: as_logged(item, period.begin_s, period.end_s)
        for name, item in period.passages.items()
    }
    return replace(period, passages=passages)


def replay_document(scenario: Scenario, period: Period, begin_s: float) -> Document:
    """A programme for every measured traffic light that shows what was measured.

    Before the period the light shows the beginning of its own log once more. A lost time of the
    scenario's settings is put behind every start of green.

    Raises:
        MeasuredDataError: A traffic light has no signals.
    """
    root = ET.Element("additional")
    late_s = late_greens(scenario)
    step = scenario.settings.step_length_s
    for tls, log in sorted(period.signals.items()):
        if not log:
            raise MeasuredDataError(f"period {period.id!r}: no signals of traffic light {tls!r}")
        late = delayed_log(log, late_s.get(tls, 0.0), step)
        item = ET.SubElement(
            root,
            "tlLogic",
            {"id": tls, "type": "static", "programID": "replay", "offset": repr(begin_s)},
        )
        for duration, state in _durations(
            _from(late, period, begin_s), period.end_s, begin_s, step
        ):
            ET.SubElement(item, "phase", {"duration": repr(duration), "state": state})
    return Document("replay.add.xml", None, xml_bytes(root))


def _from(log: SignalLog, period: Period, begin_s: float) -> SignalLog:
    """The log from `begin_s` on, with its own beginning repeated before the period."""
    early = period.begin_s - begin_s
    if early <= 0:
        return log
    again = [(time - early, state) for time, state in log if time - early < period.begin_s]
    return (*again, *((max(time, period.begin_s), state) for time, state in log))


def _durations(
    log: SignalLog, end_s: float, begin_s: float, step_s: float
) -> list[tuple[float, str]]:
    """Phases in whole steps, at least to the end; times are rounded, not durations."""
    shown: list[tuple[int, str]] = []
    for time, state in log:
        tick = max(round((time - begin_s) / step_s), 0)
        if shown and shown[-1][0] == tick:
            shown[-1] = (tick, state)
        elif not shown or shown[-1][1] != state:
            shown.append((tick, state))
    shown[0] = (0, shown[0][1])
    last = round((end_s - begin_s) / step_s) + 3600
    ticks = [tick for tick, _ in shown] + [max(last, shown[-1][0] + 1)]
    return [
        (round((after - tick) * step_s, 6), state)
        for (tick, state), after in zip(shown, ticks[1:], strict=True)
    ]
