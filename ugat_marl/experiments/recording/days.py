"""Recording of a domain over several days, with the detectors of a real street.

Every period is a day with newly drawn vehicles. The effects of the domain change the simulation of
the day; effects on detectors change its data. The signal log holds the commands of the controller.
The lights on the street may differ from them, as with late greens; only the vehicles show that.
"""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

from ugat_marl.data import (
    MeasuredData,
    passages_as_written,
    split_periods,
    traffic_of_lanes,
)
from ugat_marl.effects import (
    Domain,
    Effect,
    apply_detector_effects,
    apply_effects,
    detector_effects,
    detector_lights,
    domain_path,
    installed_detectors,
    parse_domain,
    scenario_in_domain,
    shift_parking,
)
from ugat_marl.errors import OptionError, listed, require_least
from ugat_marl.experiments.recording.controller import (
    own_programmes,
    play,
    switch_document,
    switches,
)
from ugat_marl.experiments.recording.tracks import tracks
from ugat_marl.parallel import Stop, in_order, parts_at_a_time
from ugat_marl.policies import PolicyFactory
from ugat_marl.progress import Advance, Reporter, Silent
from ugat_marl.scenarios import (
    Detector,
    Document,
    Lane,
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    Split,
    demand_as_vehicles,
    draw_day,
)
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import (
    detectors_document,
    kept_warm,
    read_passages,
    refuse_in_queues,
    standard_detectors,
)


@dataclass(frozen=True)
class _Street:
    """Parts of a recording that are the same on every day.

    Attributes:
        base: The scenario without the effects.
        effects: Effects of the domain.
        detectors: Detection zones as they are stated.
        installed: The same zones as they really are.
        lanes_by_id: Lanes of the network.
        programmes: Signals of the traffic lights that follow a fixed programme, by id.
        watched: Ids of the traffic lights whose programme depends on the traffic.
        policy: Maker of the controller.
        seed: Root of the seeds of all days.
        same_demand: True if every day has the scenario's own vehicles.
        day_to_day: Variation of the demand from day to day, see `draw_day`.
        speeds: True if the detectors measure speeds and lengths.
        lanes: True to keep data per lane and second.
        trajectories: True to keep the positions of all vehicles.
    """

    base: Scenario
    effects: tuple[Effect, ...]
    detectors: tuple[Detector, ...]
    installed: tuple[Detector, ...]
    lanes_by_id: Mapping[str, Lane]
    programmes: Mapping[str, SignalLog]
    watched: tuple[str, ...]
    policy: PolicyFactory
    seed: int
    same_demand: bool
    day_to_day: float
    speeds: bool
    lanes: bool
    trajectories: bool


@dataclass(frozen=True)
class _Day:
    """One period and, on request, data per lane and second and the tracks of its vehicles."""

    period: Period
    lanes: pl.DataFrame | None
    trajectories: pl.DataFrame | None


@kept_warm()
def record(
    scenario: Scenario,
    domain: Domain,
    policy: PolicyFactory,
    *,
    periods: int = 5,
    seed: int = 0,
    duration_s: float | None = None,
    same_demand: bool = False,
    day_to_day: float = 0.0,
    detector_length_m: float = 0.0,
    speeds: bool = True,
    lanes: bool = False,
    trajectories: bool = False,
    workers: int | None = None,
    reporter: Reporter | None = None,
) -> MeasuredData:
    """Measure a domain like a real street. The same arguments give the same data.

    Args:
        scenario: The simulation.
        domain: The domain to measure.
        policy: Maker of the controller of the signals.
        periods: Number of days; the last 40 % are held out.
        seed: Root of the seeds of all days.
        duration_s: Length of a day in s; None for the scenario's own.
        same_demand: True to use the scenario's own vehicles every day, False to draw new ones.
        day_to_day: Standard deviation of the whole demand of a day, as a share of its mean.
        detector_length_m: Length of the detection zones in m, less near the start of a lane; 0 for
            points.
        speeds: True if the detectors measure speeds and lengths.
        lanes: True to keep vehicles, halting vehicles and mean speed per lane and second.
        trajectories: True to keep the position of every vehicle at every second.
        workers: Simulations at a time; None for the number of cores.
        reporter: Shows progress.

    Raises:
        OptionError: A number of periods or workers, a seed or a length is impossible, or the domain
            is in SUMO's mesoscopic model, whose vehicles have no position on a lane.
        UnknownNameError: A domain, effect or detector does not exist.
        ScenarioError: The scenario cannot be simulated.
        SimulatorError: SUMO failed.
    """
    require_least(1, periods=periods, workers=workers)
    require_least(0, seed=seed)
    _require_possible(scenario, duration_s, detector_length_m, day_to_day, same_demand=same_demand)
    scenario = demand_as_vehicles(scenario.with_duration(duration_s))
    base, effects = _world(scenario, domain, duration_s)
    network = Network.read(base)
    detectors = tuple(
        _zone(detector, detector_length_m) for detector in standard_detectors(network)
    )
    empty = Period("", 0.0, 1.0, "fit", {}, {})
    apply_detector_effects(
        empty, effects, detectors, detector_lights(base, detectors)
    )  # a wrong detector is an error now
    fixed, watched = own_programmes(base, network, policy)
    installed = installed_detectors(effects, detectors)
    _warn_of_cut_zones(detectors, installed, network.lanes)
    street = _Street(
        base=base,
        effects=effects,
        detectors=detectors,
        installed=installed,
        lanes_by_id=network.lanes,
        programmes=fixed,
        watched=watched,
        policy=policy,
        seed=seed,
        same_demand=same_demand,
        day_to_day=day_to_day,
        speeds=speeds,
        lanes=lanes,
        trajectories=trajectories,
    )
    with (reporter or Silent()).task("measuring", periods) as advance:
        days = _all_days(street, periods, parts_at_a_time(workers), advance)
    return MeasuredData(
        street.detectors,
        tuple(day.period for day in days),
        lanes=_together(day.lanes for day in days) if lanes else None,
        trajectories=_together(day.trajectories for day in days) if trajectories else None,
    )


def _require_possible(
    scenario: Scenario,
    duration_s: float | None,
    detector_length_m: float,
    day_to_day: float,
    *,
    same_demand: bool,
) -> None:
    """Refuse impossible lengths of a day and of detectors, and demands that contradict each other.

    Raises:
        OptionError: An option is impossible.
    """
    if duration_s is not None and duration_s > scenario.settings.duration_s:
        raise OptionError(
            f"duration_s = {duration_s:g}: scenario {scenario.id!r} lasts "
            f"{scenario.settings.duration_s:g} s, and data of longer days would not fit it"
        )
    if not 0 <= detector_length_m < math.inf:
        raise OptionError(
            f"detector_length_m = {detector_length_m:g}: must be 0 or more, and finite"
        )
    if same_demand and day_to_day:
        raise OptionError("same_demand keeps the demand of every day; leave day_to_day out")
    if not 0 <= day_to_day < 1:
        raise OptionError(f"day_to_day = {day_to_day:g} must be from 0 to below 1")


def _world(
    scenario: Scenario, domain: Domain, duration_s: float | None
) -> tuple[Scenario, tuple[Effect, ...]]:
    """Return the scenario from which days are drawn, and the effects to add to each day.

    Both scenarios have single vehicles. A scenario's documents hold the effects of its file
    already, except those on detectors.
    """
    # a wrong name is an error now
    changed = scenario_in_domain(scenario, domain, recorded=True, duration_s=duration_s)
    refuse_in_queues(changed, detectors=True)
    if domain_path(domain) is not None:
        return demand_as_vehicles(changed), detector_effects(changed)
    return scenario, (*detector_effects(scenario), *parse_domain(domain))


def _warn_of_cut_zones(
    stated: Sequence[Detector], installed: Sequence[Detector], lanes: Mapping[str, Lane]
) -> None:
    """Warn of effects that would put detectors beyond the end of their lane, where none can be."""
    beyond = {
        other.id: other.position_m + other.length_m - lanes[other.lane].length_m
        for one, other in zip(stated, installed, strict=True)
        if one != other
    }
    cut = [name for name, metres in beyond.items() if metres > 0.0]
    if cut:
        warnings.warn(
            f"{listed(cut, 'detector')} would reach up to {max(beyond.values()):.1f} m beyond the "
            "end of the lane, and end there; a smaller effect has its full size",
            stacklevel=3,
        )


def _zone(detector: Detector, length_m: float) -> Detector:
    """Return a detection zone that ends at the detector's point; it begins at 0 m or later.

    Like a street's controller, it stamps vehicles by the clock of the signals.
    """
    begin = max(detector.position_m - length_m, 0.0)
    length = round(detector.position_m - begin, 2)
    return replace(detector, position_m=round(begin, 2), length_m=length, clock="signals")


def _all_days(street: _Street, periods: int, workers: int, advance: Advance) -> list[_Day]:
    """Record all days. Threads suffice: each simulation runs in its own process."""
    stop = Stop()
    parts = [(street, i, split, stop) for i, split in enumerate(split_periods(periods))]
    return in_order(workers, _day, parts, stop, lambda _: advance())


def _day(street: _Street, index: int, split: Split, stop: Stop) -> _Day:
    """Record one day, from its vehicles to the measured data."""
    scenario = street.base
    if not street.same_demand:
        scenario = draw_day(
            scenario, derive_seed(street.seed, "record", index, "demand"), street.day_to_day
        )
        scenario = _renamed(scenario, derive_seed(street.seed, "record", index, "names"))
    scenario = apply_effects(scenario, street.effects)
    if not street.same_demand:
        scenario = shift_parking(scenario, derive_seed(street.seed, "record", index, "parking"))
    begin = scenario.settings.begin_s
    end = begin + scenario.decisions * scenario.control.decision_interval_s
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name)
        watched = _with_outputs(scenario, street, directory)
        commanded = play(
            watched, street.policy, derive_seed(street.seed, "record", index, "simulation"), stop
        )
        step = scenario.settings.step_length_s
        passages = read_passages(directory / "loops.xml", street.installed, begin, end, step)
        shown = switches(directory / "signals.xml", end) if street.watched else {}
        vehicles = None
        if street.lanes or street.trajectories:
            vehicles = tracks(directory / "vehicles.xml", f"day{index + 1}", end, step)
    period = Period(
        f"day{index + 1}",
        begin,
        end,
        split,
        {**street.programmes, **shown, **commanded},
        passages if street.speeds else {k: _without_speed(v) for k, v in passages.items()},
    )
    owner = detector_lights(street.base, street.detectors)
    period = _logged(apply_detector_effects(period, street.effects, street.detectors, owner))
    lanes = None
    if vehicles is not None and street.lanes:
        named = {detector.lane for detector in street.detectors}
        seconds = np.arange(np.ceil(begin), end)  # also those without vehicles
        steps = (seconds - begin) / step
        seen = seconds[np.abs(steps - np.round(steps)) < 1e-6]
        lanes = traffic_of_lanes(vehicles, sorted(named), period, seen)
    return _Day(period, lanes, vehicles if street.trajectories else None)


def _renamed(scenario: Scenario, seed: int) -> Scenario:
    """Rename the vehicles of a newly drawn day, which stand in its first route file.

    Effects choose vehicles by name. With new names they choose other vehicles every day, as on a
    street, where the trucks of two days differ.
    """

    def renamed(document: Document) -> Document:
        content = document.read()
        for quote in (b'"', b"'"):
            start = b"<vehicle id=" + quote
            content = content.replace(start, start + b"%08x." % seed)
        return document.edited(content)

    drawn, *others = scenario.routes
    return replace(scenario, routes=(renamed(drawn), *others))


def _with_outputs(scenario: Scenario, street: _Street, directory: Path) -> Scenario:
    """Return the scenario with detectors, and with the other outputs that a recording needs."""
    extra = [detectors_document(street.installed, street.lanes_by_id, directory / "loops.xml")]
    if street.watched:
        extra.append(switch_document(street.watched, directory / "signals.xml"))
    settings = scenario.settings
    if street.lanes or street.trajectories:
        # Readers of scenario files refuse outputs of SUMO; this one goes to our own folder.
        output = {
            "fcd-output": str(directory / "vehicles.xml"),
            "fcd-output.attributes": "id,lane,pos,speed",
        }
        settings = settings.model_copy(update={"sumo": {**settings.sumo, **output}})
    return replace(
        scenario,
        additional=(*scenario.additional, *extra),
        settings=settings,
        outputs=(str(directory),),
    )


def _logged(period: Period) -> Period:
    """Return a period as the detectors' electronics log it, without empty detectors."""
    passages = {
        name: passages_as_written(passages, period.begin_s, period.end_s)
        for name, passages in period.passages.items()
    }
    return replace(period, passages={name: x for name, x in passages.items() if len(x)})


def _without_speed(passages: Passages) -> Passages:
    unknown = np.full(len(passages), np.nan)
    return Passages(passages.on_s, passages.off_s, unknown, unknown)


def _together(frames: Iterable[pl.DataFrame | None]) -> pl.DataFrame:
    return pl.concat([frame for frame in frames if frame is not None])
