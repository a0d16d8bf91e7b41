"""Plays a policy in a domain, day after day, and keeps what the detectors of a street would see.

Every period is another day: the vehicles are drawn again, the effects of the domain are added to
that day, and the effects on detectors to what was seen of it. The signals that are logged are the
ones the controller commands, as its cabinet logs them; what the lights on the street make of it
shows only in the vehicles.
"""

from __future__ import annotations

import concurrent.futures
import os
import re
import subprocess
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import unescape

import numpy as np
import polars as pl

from ugat_marl import signals
from ugat_marl.effects import Domain, Effect, apply_effects, in_domain, parse_domain
from ugat_marl.effects.detectors import observed, owners
from ugat_marl.effects.documents import sort_departures
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.evaluation import PolicyFactory
from ugat_marl.files import parse_xml, xml_bytes
from ugat_marl.loops import loops_document, read_loops, standard_detectors
from ugat_marl.measured.data import (
    Detector,
    Measured,
    Passages,
    Period,
    SignalLog,
    Split,
    split_periods,
)
from ugat_marl.network import Network
from ugat_marl.options import EnvOptions
from ugat_marl.progress import Advance, Reporter, Silent
from ugat_marl.redraw import explicit, redrawn, sumo_program
from ugat_marl.rollout import roll_out, until
from ugat_marl.scenario import Document, Scenario
from ugat_marl.seeding import derive_seed, numpy_generator
from ugat_marl.simulator import launch_of
from ugat_marl.traffic_env import TrafficEnv, parallel_env

PARKED = b"parking."
"""How the ids of vehicles begin that the effect `parking` adds."""

HALTING_MPS = 0.1
"""Below this speed SUMO calls a vehicle halting."""

_STATE = re.compile(r'<tlsState time="([\d.]+)" id="([^"]*)" [^>]*?state="([^"]*)"')
_FCD = re.compile(r'<timestep time="([\d.]+)"|<vehicle ([^>]*)/>')
_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')


@dataclass(frozen=True)
class _Street:
    """What is the same on every day.

    Attributes:
        base: The scenario without the effects.
        effects: What makes the domain out of it.
        detectors: Detection zones.
        programmes: Traffic lights that follow a fixed programme of their own, and what they show.
        watched: Traffic lights whose own programme depends on the traffic.
    """

    base: Scenario
    effects: tuple[Effect, ...]
    detectors: tuple[Detector, ...]
    programmes: Mapping[str, SignalLog]
    watched: tuple[str, ...]
    policy: PolicyFactory
    seed: int
    same_demand: bool
    speeds: bool
    lanes: bool
    trajectories: bool


@dataclass(frozen=True)
class _Day:
    """One period and, where asked for, its vehicles second by second."""

    period: Period
    lanes: pl.DataFrame | None
    trajectories: pl.DataFrame | None


def record(
    scenario: Scenario,
    domain: Domain,
    policy: PolicyFactory,
    *,
    periods: int = 5,
    seed: int = 0,
    duration_s: float | None = None,
    same_demand: bool = False,
    detector_length_m: float = 0.0,
    speeds: bool = True,
    lanes: bool = False,
    trajectories: bool = False,
    workers: int | None = None,
    reporter: Reporter | None = None,
) -> Measured:
    """Measures a domain as a street is measured. The same arguments give the same data.

    Args:
        scenario: The simulation.
        domain: The world to measure.
        policy: Who controls the signals there.
        periods: Number of days; the last 40 % are held out.
        seed: Root of the seeds of all days.
        duration_s: Length of a day in s; None for the scenario's own.
        same_demand: Whether every day has the scenario's own vehicles, not vehicles drawn again.
        detector_length_m: Length of the detection zones; 0 for points.
        speeds: Whether the detectors measure speeds and lengths.
        lanes: Whether to keep vehicles, halting and mean speed per lane and second.
        trajectories: Whether to keep the position of every vehicle at every second.
        workers: Simulations at a time; None for the number of cores.
        reporter: Shows progress.

    Raises:
        OptionError: Not a number of periods, or an impossible length.
        ScenarioError: The scenario cannot be simulated.
        SimulatorError: SUMO failed.
    """
    if periods < 1 or detector_length_m < 0 or seed < 0:
        raise OptionError(
            f"periods = {periods} must be at least 1, detector_length_m = {detector_length_m:g} "
            f"and seed = {seed} must not be negative"
        )
    base, effects = _world(scenario, domain)
    if duration_s is not None:
        base = base.with_duration(duration_s)
    network = Network.read(base)
    fixed, watched = _own_programmes(base, network, policy)
    street = _Street(
        explicit(base),
        effects,
        tuple(_zone(item, detector_length_m) for item in standard_detectors(network)),
        fixed,
        watched,
        policy,
        seed,
        same_demand,
        speeds,
        lanes,
        trajectories,
    )
    with (reporter or Silent()).task("measuring", periods) as advance:
        days = _all_days(street, periods, workers or os.cpu_count() or 1, advance)
    return Measured(
        street.detectors,
        tuple(day.period for day in days),
        lanes=_together(day.lanes for day in days) if lanes else None,
        trajectories=_together(day.trajectories for day in days) if trajectories else None,
    )


def _world(scenario: Scenario, domain: Domain) -> tuple[Scenario, tuple[Effect, ...]]:
    """What days are drawn from, and what is added to each of them."""
    changed = in_domain(scenario, domain)  # a wrong name is an error now
    if isinstance(domain, str) and "=" not in domain and Path(domain).expanduser().exists():
        return changed, ()
    return scenario, parse_domain(domain)


def _zone(detector: Detector, length_m: float) -> Detector:
    """A zone that ends where the point was, and begins on the lane."""
    begin = max(detector.position_m - length_m, 0.0)
    return replace(
        detector, position_m=round(begin, 2), length_m=round(detector.position_m - begin, 2)
    )


def _all_days(street: _Street, periods: int, workers: int, advance: Advance) -> list[_Day]:
    """Threads suffice: the simulations run in processes of their own."""
    stop = threading.Event()
    pool = concurrent.futures.ThreadPoolExecutor(workers)
    splits = split_periods(periods)
    try:
        days = [pool.submit(_day, street, i, split, stop) for i, split in enumerate(splits)]
        left = set(days)
        while left:  # wakes up now and then, so that Ctrl-C is heard
            done, left = concurrent.futures.wait(
                left, timeout=0.2, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for day in done:
                day.result()
                advance()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
    return [day.result() for day in days]


def _day(street: _Street, index: int, split: Split, stop: threading.Event) -> _Day:
    """One day, from its vehicles to what was seen of them."""
    scenario = street.base
    if not street.same_demand:
        scenario = redrawn(scenario, derive_seed(street.seed, "record", index, "demand"))
        scenario = _renamed(scenario, derive_seed(street.seed, "record", index, "names"))
    scenario = apply_effects(scenario, street.effects)
    if not street.same_demand:
        scenario = _parked_later(scenario, derive_seed(street.seed, "record", index, "parking"))
    begin = scenario.settings.begin_s
    end = begin + scenario.decisions * scenario.control.decision_interval_s
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name)
        watched = _with_outputs(scenario, street, directory)
        commanded = _play(
            watched, street.policy, derive_seed(street.seed, "record", index, "simulation"), stop
        )
        passages = read_loops(directory / "loops.xml", street.detectors, begin, end)
        shown = _switches(directory / "signals.xml", end) if street.watched else {}
        vehicles = None
        if street.lanes or street.trajectories:
            vehicles = _vehicles(directory / "vehicles.xml", f"day{index + 1}", begin, end)
    period = Period(
        f"day{index + 1}",
        begin,
        end,
        split,
        {**street.programmes, **shown, **commanded},
        passages if street.speeds else {k: _without_speed(v) for k, v in passages.items()},
    )
    owner = owners(street.base, street.detectors)
    period = observed(period, street.effects, street.detectors, owner)
    lanes = None
    if vehicles is not None and street.lanes:
        lanes = _per_lane(vehicles, street.detectors, period)
    return _Day(period, lanes, vehicles if street.trajectories else None)


def _renamed(scenario: Scenario, seed: int) -> Scenario:
    """Other names for the vehicles of a day that was drawn again.

    Effects choose vehicles by their names; on a street the trucks of two days are not the same
    ones, and no model knows which they are.
    """

    def renamed(document: Document) -> Document:
        content = document.read()
        for quote in (b'"', b"'"):
            start = b"<vehicle id=" + quote
            content = content.replace(start, start + b"%08x." % seed)
        return document.edited(content)

    return replace(scenario, routes=tuple(map(renamed, scenario.routes)))


def _parked_later(scenario: Scenario, seed: int) -> Scenario:
    """Vehicles that park do so at other times every day: their times are turned about the day."""
    begin, duration = scenario.settings.begin_s, scenario.settings.duration_s
    shift = numpy_generator(seed).uniform(0, duration)

    def later(document: Document) -> Document:
        if PARKED not in document.read():
            return document
        root = document.parse()
        parked = [x for x in root.iter("vehicle") if x.get("id", "").startswith(PARKED.decode())]
        for item in parked:
            time = (float(item.get("depart", "0")) - begin + shift) % duration
            item.set("depart", f"{begin + time:.2f}")
        sort_departures(root)
        return document.edited(xml_bytes(root))

    return replace(scenario, routes=tuple(map(later, scenario.routes)))


def _with_outputs(scenario: Scenario, street: _Street, directory: Path) -> Scenario:
    """The scenario with detectors, and with whatever else has to be watched."""
    extra = [loops_document(street.detectors, None, directory / "loops.xml")]
    if street.watched:
        extra.append(_switch_document(street.watched, directory / "signals.xml"))
    settings = scenario.settings
    if street.lanes or street.trajectories:
        # A scenario file must not name outputs of SUMO; here one is wanted, in our own folder.
        output = {
            "fcd-output": str(directory / "vehicles.xml"),
            "fcd-output.attributes": "id,lane,pos,speed",
        }
        settings = settings.model_copy(update={"sumo": {**settings.sumo, **output}})
    return replace(scenario, additional=(*scenario.additional, *extra), settings=settings)


def _without_speed(passages: Passages) -> Passages:
    unknown = np.full(len(passages), np.nan)
    return Passages(passages.on_s, passages.off_s, unknown, unknown)


# --- signals --------------------------------------------------------------------------------------


class _LoggingEnv(TrafficEnv):
    """Keeps what its controller commands.

    The plan is made by the same machine as the environment's own, and before anything on the
    street may delay a green.
    """

    commanded: dict[str, list[tuple[float, str]]]

    def _advance(self, requested: list[int]) -> None:
        if self.options.signals == "actions":
            for item, state, phase in zip(
                self.network.intersections, self._states, requested, strict=True
            ):
                _, segments = signals.advance(
                    item.phases, state, phase, self.decision_interval_s, self._timing
                )
                log = self.commanded[item.id]
                since = self._snapshot.time_s
                for duration, shown in segments:
                    if not log or log[-1][1] != shown:
                        log.append((round(since, 3), shown))
                    since += duration
        super()._advance(requested)


def _play(
    scenario: Scenario, make: PolicyFactory, seed: int, stop: threading.Event
) -> dict[str, SignalLog]:
    """One episode; returns what was commanded."""
    policy = make(parallel_env(scenario))
    env = _LoggingEnv(scenario, "sim", EnvOptions.of(policy.env_options))
    env.commanded = defaultdict(list)
    try:
        roll_out(env, policy, seed, on_step=until(stop))
    finally:
        env.close()
    return {tls: tuple(log) for tls, log in env.commanded.items()}


def _own_programmes(
    scenario: Scenario, network: Network, make: PolicyFactory
) -> tuple[dict[str, SignalLog], tuple[str, ...]]:
    """What the lights nobody commands show where that is fixed, and those where it is not.

    SUMO itself says what a programme shows, without vehicles and without the effects of a domain.
    """
    policy = make(parallel_env(scenario))
    own = set(network.uncontrolled)
    if policy.env_options.get("signals") == "programme":
        own |= {item.id for item in network.intersections}
    if not own:
        return {}, ()
    kinds: dict[str, str] = {}
    for document in (scenario.network, *scenario.additional):
        for logic in parse_xml(document.read(), document.source).iter("tlLogic"):
            kinds[logic.get("id", "")] = logic.get("type", "static")
    fixed = sorted(tls for tls in own if kinds.get(tls, "static") == "static")
    watched = tuple(sorted(own - set(fixed)))
    if not fixed:
        return {}, watched
    begin, end = scenario.settings.begin_s, scenario.settings.duration_s
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name)
        switches = _switch_document(fixed, directory / "signals.xml")
        empty = replace(scenario, routes=(), additional=(*scenario.additional, switches))
        launch = launch_of(empty, 0, directory / "sumo", ())
        launch.write()
        command = [str(sumo_program("sumo")), *launch.arguments, "--end", repr(begin + end)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = " ".join(done.stderr.split())
            raise SimulatorError(f"SUMO cannot run the signals of {scenario.id!r}: {said}")
        return _switches(directory / "signals.xml", begin + end), watched


def _switch_document(lights: Sequence[str], file: Path) -> Document:
    root = ET.Element("additional")
    for tls in lights:
        options = {"type": "SaveTLSSwitchStates", "source": tls, "dest": str(file)}
        ET.SubElement(root, "timedEvent", options)
    return Document("switches.add.xml", None, xml_bytes(root))


def _switches(file: Path, end_s: float) -> dict[str, SignalLog]:
    """What lights showed, in SUMO's own words."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise SimulatorError(f"SUMO's signal states cannot be read ({error.strerror})") from None
    logs: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for time, tls, state in _STATE.findall(text):
        log = logs[unescape(tls)]
        if float(time) < end_s and (not log or log[-1][1] != state):
            log.append((float(time), state))
    return {tls: tuple(log) for tls, log in logs.items()}


# --- vehicles second by second --------------------------------------------------------------------


def _vehicles(file: Path, period: str, begin_s: float, end_s: float) -> pl.DataFrame:
    """Where every vehicle was at every whole second, junctions included."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("vehicle_id", "time_s", "lane_id", "position_m", "speed_mps")
    }
    time = begin_s
    for match in _FCD.finditer(file.read_text(encoding="utf-8")):
        if match[1]:
            time = float(match[1])
        elif time < end_s and abs(time - round(time)) < 1e-6:
            given = dict(_ATTRIBUTE.findall(match[2]))
            values = (
                unescape(given["id"]),
                time,
                given["lane"],
                float(given["pos"]),
                float(given["speed"]),
            )
            for column, value in zip(columns.values(), values, strict=True):
                column.append(value)
    kinds = {name: pl.String if name.endswith("_id") else pl.Float64 for name in columns}
    frame = pl.DataFrame(columns, schema=kinds)
    return frame.select(pl.lit(period).alias("period_id"), *columns)


def _per_lane(
    vehicles: pl.DataFrame, detectors: Sequence[Detector], period: Period
) -> pl.DataFrame:
    """Vehicles, halting and mean speed of every lane with a detector, empty lanes included."""
    names = sorted({item.lane for item in detectors})
    seconds = pl.DataFrame({"time_s": np.arange(np.ceil(period.begin_s), period.end_s)})
    grid = seconds.join(pl.DataFrame({"lane_id": names}), how="cross")
    found = vehicles.group_by("time_s", "lane_id").agg(
        pl.len().cast(pl.Float64).alias("vehicles"),
        (pl.col("speed_mps") < HALTING_MPS).sum().cast(pl.Float64).alias("halting"),
        pl.col("speed_mps").mean().round(3).alias("mean_speed_mps"),
    )
    joined = grid.join(found, on=["time_s", "lane_id"], how="left", maintain_order="left")
    return joined.select(
        pl.lit(period.id).alias("period_id"),
        "time_s",
        "lane_id",
        pl.col("vehicles", "halting").fill_null(0.0),
        "mean_speed_mps",
    )


def _together(frames: Iterable[pl.DataFrame | None]) -> pl.DataFrame:
    return pl.concat([frame for frame in frames if frame is not None])
