"""Named domains: the table, and every effect of each read back from the running environment."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

import ugat_marl
from ugat_marl.__main__ import main
from ugat_marl.cli.evaluate import Evaluate
from ugat_marl.effects import (
    DOMAIN_ALIASES,
    GAP_KINDS,
    NAMED_DOMAINS,
    OBJECTIVES,
    PAPER_WORLDS,
    Effect,
    StartupDelay,
    domain_label,
    expand_domains,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.effects.actuators import successors
from ugat_marl.effects.objectives import NORMS
from ugat_marl.effects.sensors import DeadDetectors
from ugat_marl.effects.table import ON_CONTROLLERS
from ugat_marl.envs import OBJECTIVE_MEASURES, TrafficEnv
from ugat_marl.envs.sensors import Sensors
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Scenario, signals
from ugat_marl.simulation import Snapshot
from ugat_marl.testing import check_determinism, check_environment

THEIRS = (  # scripts/run_nonrl_gap_evals.sh of the benchmark
    *(f"noise{n}" for n in (3, 5, 10, 20)), *(f"dz{n}" for n in (10, 20, 50, 100)),
    *(f"sensor{n}" for n in (5, 20, 50, 70)), *(f"combine{n}" for n in (1, 2, 3, 4)),
    *(f"transition setting{n}" for n in (1, 2, 3, 4)), *(f"delay setting{n}" for n in (1, 2, 3, 4)),
    "cyclic", "flexible", "barrier_leading_fixed", "barrier_lagging_fixed",
    "barrier_leading_lagging_fixed", "efficiency_aligned", "emission_heavy", "fairness_heavy",
    "physical_safety_heavy",
)  # fmt: skip


# --- the table


def test_every_setting_of_the_benchmark_has_its_counterpart() -> None:
    assert len(THEIRS) == 33
    found = [item.counterpart for item in NAMED_DOMAINS.values() if item.counterpart]
    assert sorted(found) == sorted(THEIRS)


def test_names_are_spelled_as_one_likes() -> None:
    for name, item in NAMED_DOMAINS.items():
        assert item.gap in GAP_KINDS
        assert parse_domain(name.upper()) == parse_domain(f" {name} ") == parse_domain(item.effects)
        assert domain_label(name.upper()) == name
        assert name not in DOMAIN_ALIASES and parse_domain(f"{name}+V1")[-4:] == PAPER_WORLDS["V1"]
    for name, effects in PAPER_WORLDS.items():
        assert parse_domain(NAMED_DOMAINS[name].effects) == effects
    assert len(
        {scenario_in_domain(load_scenario("single-v1"), name).hash for name in NAMED_DOMAINS}
    ) == len(NAMED_DOMAINS)
    assert domain_label("rain+ zone-50") == domain_label("V3+zone-50") == "V3+zone-50"
    assert domain_label("sim") == "sim" and domain_label("startup_delay=1") == "startup_delay=1"


def test_a_folder_of_the_name_of_a_domain_takes_its_place_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, crossing: Callable[..., Path]
) -> None:
    scenario = load_scenario("single-v1")
    known = {name: scenario_in_domain(scenario, name).hash for name in ("sim", "V4", "Snow")}
    monkeypatch.chdir(tmp_path)
    for name in ("sim", "V4", "Snow"):
        crossing().rename(tmp_path / name)
        assert scenario_in_domain(scenario, name).hash == known[name]
        with pytest.raises(ScenarioError, match="has other roads"):
            scenario_in_domain(scenario, f"./{name}")


def test_domains_that_do_not_fit_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    reached = load_scenario("single-v1").with_control(reach_m=100.0)
    names = Evaluate("single-v1", domains=("observation",))._domains(reached, Console(width=200))
    assert "zone-50 is left out" in capsys.readouterr().out
    assert names and not [name for name in names if "detection_zone" in NAMED_DOMAINS[name].effects]


def test_no_name_is_that_of_an_effect_or_of_a_gap() -> None:
    assert not set(NAMED_DOMAINS) & {*ON_CONTROLLERS, *GAP_KINDS, "all", "sim"}


def test_an_unknown_name_gets_the_nearest_of_all() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'zone-50'.*ugat-marl domains lists"):
        parse_domain("zones-50")


def test_gaps_are_spelled_out() -> None:
    assert expand_domains(["all"]) == ["sim", *(name for name in NAMED_DOMAINS if name != "meso")]
    assert expand_domains(["sim", "V4", "Transition", "V4"])[:4] == ["sim", "V4", "V1", "V2"]
    assert {NAMED_DOMAINS[name].gap for name in expand_domains(["action"])} == {"action"}


@pytest.mark.parametrize("arguments", [[], ["action"], ["reward", "--json"]])
def test_the_command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["domains", *arguments]) == 0
    shown = capsys.readouterr().out
    listed = [item for item in NAMED_DOMAINS.values() if not arguments or item.gap == arguments[0]]
    assert all(item.name in shown for item in listed)
    if not arguments:
        assert f"{len(NAMED_DOMAINS)} domains, 33 with a counterpart" in shown


def test_a_gap_that_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["domains", "actions"]) == 2
    assert "unknown gap 'actions'. Did you mean 'action'?" in capsys.readouterr().err


# --- read back


LANES = "laneChangeModel.lcStrategic"


class Trace:
    """What one episode of a domain showed; the simulation runs in this process."""

    def __init__(self, domain: str, duration_s: float) -> None:
        self.env: TrafficEnv = ugat_marl.parallel_env(
            "single-v1", domain, duration_s=duration_s, simulator="inprocess"
        )
        env = self.env
        self.item = env.network.intersections[0]
        self.lanes = env.network.lane_table().ids
        self.incoming = [self.lanes.index(lane) for lane in self.item.incoming_lanes]
        self.commands: list[int] = []
        self.shown: list[int] = []
        self.plan: list[str] = []
        self.snapshots: list[Snapshot] = []
        self.seen: list[Snapshot] = []
        self.near: list[list[int]] = []
        self.vehicles: dict[str, dict[str, Any]] = {}
        self.first_s: float | None = None
        self.closed_s: list[float] = []  # times at which a vehicle blocks a lane
        self.positions: set[float] = set()
        self.queues = "mesosim" in env.scenario.settings.sumo  # there are no lanes to change
        generator = np.random.default_rng(1)
        _, infos = env.reset(seed=1)
        simulator: Any = env._simulator
        advance = simulator.advance

        def recording(seconds: float, plans: Mapping[str, Any], meanwhile: Any) -> Snapshot:
            for length, state in plans["A1"]:
                self.plan += [state] * round(length)
            return advance(seconds, plans, meanwhile)

        simulator.advance = recording
        try:
            self.look()
            while env.agents:
                mask, shown = infos["signal_0"]["action_mask"], env.phases[0]
                stays = mask[shown] and generator.random() < 0.6
                choice = shown if stays else generator.choice(np.flatnonzero(mask))
                self.commands.append(int(choice))
                *_, infos = env.step({"signal_0": self.commands[-1]})
                self.shown.append(env.phases[0])
                self.look()
            self.scores = env.scores()
        finally:
            env.close()

    def look(self) -> None:
        env, api = self.env, libsumo.vehicle
        self.snapshots.append(env.snapshot)
        self.seen.append(env.seen)
        if not env.agents:
            return
        if self.plan and self.plan[-1] in self.item.phases:
            assert libsumo.trafficlight.getRedYellowGreenState("A1") == self.plan[-1]
        names = api.getIDList()
        if any(name.startswith("closure.") for name in names):
            self.closed_s.append(env.snapshot.time_s)
        for name in names:
            self.positions.add(round(api.getLanePosition(name), 3))
            if name not in self.vehicles:
                self.first_s = self.first_s or env.snapshot.time_s
                self.vehicles[name] = {
                    "type": api.getTypeID(name),
                    "acceleration": api.getAccel(name),
                    "deceleration": api.getDecel(name),
                    "emergency_deceleration": api.getEmergencyDecel(name),
                    "headway": api.getTau(name),
                    "imperfection": api.getImperfection(name),
                    "speed": api.getSpeedFactor(name),
                    "strategic": None if self.queues else api.getParameter(name, LANES),
                }
        zone = next((e.metres for e in self.effects if e.name == "detection_zone"), None)
        self.near.append(
            [
                sum(
                    zone is None or api.getLanePosition(v) >= libsumo.lane.getLength(lane) - zone
                    for v in libsumo.lane.getLastStepVehicleIDs(lane)
                )
                for lane in self.item.incoming_lanes
            ]
        )

    @property
    def effects(self) -> list[Any]:
        """The effects of the domain that the scenario lists."""
        return [ugat_marl.effects.effect_from_record(r) for r in self.env.scenario.settings.effects]

    @property
    def truth(self) -> NDArray[np.float64]:
        """Vehicles before the stop line, in the zone if there is one, ``(decisions, lanes)``."""
        return np.array(self.near, dtype=float)

    @property
    def counted(self) -> NDArray[np.float64]:
        """The same as it is seen."""
        return np.array([x.vehicles[self.incoming] for x in self.seen])[: len(self.near)]

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Which of these lanes have a detector that works."""
        assert self.env._sensors is not None
        dead = [x.dead for x in self.env._sensors.chain if isinstance(x, DeadDetectors)]
        return ~dead[0][self.incoming] if dead else np.ones(len(self.incoming), dtype=np.bool_)

    def cars(self, what: str) -> set[Any]:
        """Values of all vehicles that are no trucks and do not block a lane."""
        return {
            values[what]
            for name, values in self.vehicles.items()
            if values["type"] == "car" and not name.startswith("closure.")
        }

    def types(self, attribute: str) -> set[str | None]:
        """Values of an attribute in the vehicle types SUMO was given."""
        documents = (*self.env.scenario.additional, *self.env.scenario.routes)
        return {t.get(attribute) for d in documents for t in d.parse().iter("vType")} - {None}

    def greens(self) -> list[int]:
        """Seconds of each whole green phase."""
        runs: list[tuple[str, int]] = []
        for state in self.plan:
            if runs and runs[-1][0] == state:
                runs[-1] = (state, runs[-1][1] + 1)
            else:
                runs.append((state, 1))
        return [seconds for state, seconds in runs[1:-1] if state in self.item.phases]


def about(value: float, expected: float, tolerance: float) -> None:
    assert value == pytest.approx(expected, abs=tolerance)


def check_noise(trace: Trace, share: float) -> None:
    there = trace.truth > 0
    about(float((trace.counted[there] / trace.truth[there]).std()), share, 0.2 * share)


def check_error(trace: Trace, vehicles: float) -> None:
    error = (trace.counted - trace.truth)[:, trace.alive]
    above = error[error > 0]  # a half of a normal distribution, wherever others are cut off at 0
    about(float(np.sqrt((above**2).mean())), vehicles, 0.2 * vehicles)


def check_failure(trace: Trace, share: float) -> None:
    assert not trace.counted[:, ~trace.alive].any()
    drawn: list[float] = []
    sensors = trace.env._sensors
    assert isinstance(sensors, Sensors)
    (detectors,) = (x for x in sensors.chain if isinstance(x, DeadDetectors))
    for seed in range(300):
        sensors.reset(seed)
        drawn.append(float(detectors.dead.mean()))
    about(float(np.mean(drawn)), share, 0.02)
    trace.env._sensors = sensors


def check_zone(trace: Trace, metres: float) -> None:
    del metres  # the trace has counted by it
    near = np.array([x.near[0][trace.incoming] for x in trace.snapshots])[: len(trace.near)]
    assert np.array_equal(near, trace.truth)
    whole = np.array([x.vehicles[trace.incoming] for x in trace.snapshots])[: len(trace.near)]
    assert (near <= whole).all() and near.sum() < whole.sum()
    if len(trace.effects) == 1:
        assert np.array_equal(trace.counted, near)


def check_late(trace: Trace, seconds: float) -> None:
    late = round(seconds / 10)
    assert np.array_equal(trace.counted[late:], trace.truth[:-late])
    assert not trace.counted[:late].any()


def check_lost_readings(trace: Trace, share: float) -> None:
    steps = np.diff(trace.counted, axis=0)
    arrives = trace.counted[1:] == trace.truth[1:]
    assert ((steps == 0) | arrives).all()
    changed = trace.truth[1:] != trace.counted[:-1]
    about(float((steps[changed] == 0).mean()), share, 0.08)


def check_coarse(trace: Trace, vehicles: float) -> None:
    assert not (trace.counted % vehicles).any() and trace.counted.any()


def check_delay(trace: Trace, seconds: float) -> None:
    late = round(seconds / 10)
    assert trace.shown[late:] == trace.commands[:-late]
    assert trace.shown[:late] == [0] * late


def check_lost_commands(trace: Trace, share: float) -> None:
    assert any(c != s for c, s in zip(trace.commands, trace.shown, strict=True)) or share < 0.2
    actuators = trace.env._actuators
    assert actuators is not None
    state = signals.SignalState(0, 0, 100.0)
    obeyed = np.mean([actuators.obey([3], [state])[0] == 3 for _ in range(3000)])
    about(float(obeyed), 1.0 - share, 0.02)


def check_order(trace: Trace, rule: str) -> None:
    following = successors(trace.item, rule)
    changes = [(a, b) for a, b in zip([0, *trace.shown], trace.shown, strict=False) if a != b]
    assert len(changes) > 5
    assert all(b in following[a] for a, b in changes)


def check_min_green(trace: Trace, seconds: float) -> None:
    assert trace.greens() and min(trace.greens()) >= seconds


def check_max_green(trace: Trace, seconds: float) -> None:
    assert seconds - 10 < max(trace.greens()) <= seconds


def check_vehicles(name: str) -> Callable[[Trace, float], None]:
    def check(trace: Trace, value: float) -> None:
        assert trace.cars(name) == {value}

    return check


def check_trucks(trace: Trace, share: float) -> None:
    kinds = [values["type"].startswith("heavy.") for values in trace.vehicles.values()]
    about(float(np.mean(kinds)), share, 0.03 + 0.1 * share)


def check_driver_model(trace: Trace, model: str) -> None:
    assert trace.types("carFollowModel") == {model}


def check_late_green(trace: Trace, place: str, seconds: float) -> None:
    assert place == "*"
    clearance_ended, waited = 0, list[int]()
    for second, (before, now) in enumerate(zip(trace.plan, trace.plan[1:], strict=False), start=1):
        if "y" in before:
            clearance_ended = second
        if any(a == "r" and b == "G" for a, b in zip(before, now, strict=True)):
            waited.append(second - clearance_ended)
    assert set(waited) == {trace.env.scenario.control.all_red_s + seconds}


def check_demand(trace: Trace, edge: str, factor: float) -> None:
    assert edge == "*"
    plain = Trace("sim", 300).scores.due
    about(trace.scores.due / plain, factor, 0.05)


def check_later(trace: Trace, edge: str, seconds: float) -> None:
    assert edge == "*" and trace.first_s is not None
    about(trace.first_s, (Trace("sim", 30).first_s or 0.0) + seconds, 1e-9)


def check_spread(trace: Trace, deviation: float) -> None:
    about(float(np.std([v["speed"] for v in trace.vehicles.values()])), deviation, 0.06)


def check_speed(trace: Trace, factor: float) -> None:
    about(float(np.mean([v["speed"] for v in trace.vehicles.values()])), factor, 0.05)


def check_incident(trace: Trace, after_s: float, lasts_s: float) -> None:
    blocker = trace.env.scenario.routes[-1].parse()[-1]
    assert float(blocker.get("depart", "nan")) == after_s
    assert after_s <= trace.closed_s[0] < after_s + lasts_s  # as soon as there is room
    about(trace.closed_s[-1], after_s + lasts_s, 20)


def check_queue_model(trace: Trace, metres: float) -> None:
    assert trace.env.scenario.settings.sumo.get("meso-edgelength") == f"{metres:g}"
    assert 0 < len(trace.positions) < 20, "vehicles are where segments begin, and nowhere else"


def check_objective(trace: Trace, wanted: str) -> None:
    hidden = trace.scores.hidden
    assert set(hidden) == set(OBJECTIVE_MEASURES)
    measures = {"queue": trace.scores.queue, "delay": trace.scores.delay, **hidden}
    shares = [weight * measures[m] / NORMS[m] for m, weight in OBJECTIVES[wanted].items()]
    assert hidden["cost"] == pytest.approx(sum(shares))
    assert hidden["cost"] > 0


CHECKS: dict[str, Callable[..., Any]] = {
    "counting_noise": check_noise,
    "counting_error": check_error,
    "detector_failure": check_failure,
    "detection_zone": check_zone,
    "observation_delay": check_late,
    "lost_readings": check_lost_readings,
    "quantised_counts": check_coarse,
    "execution_delay": check_delay,
    "lost_commands": check_lost_commands,
    "phase_order": check_order,
    "min_green": check_min_green,
    "max_green": check_max_green,
    "acceleration": check_vehicles("acceleration"),
    "deceleration": check_vehicles("deceleration"),
    "emergency_deceleration": check_vehicles("emergency_deceleration"),
    "startup_delay": lambda trace, value: about(float(*trace.types("startupDelay")), value, 1e-9),
    "headway": check_vehicles("headway"),
    "imperfection": check_vehicles("imperfection"),
    "speed_spread": check_spread,
    "desired_speed": check_speed,
    "lane_discipline": lambda trace, v: about(float(*trace.cars("strategic")), v, 1e-9),
    "heavy_share": check_trucks,
    "driver_model": check_driver_model,
    "late_green": check_late_green,
    "demand_level": check_demand,
    "demand_timing": check_later,
    "incident": check_incident,
    "queue_model": check_queue_model,
    "objective": check_objective,
}


def values_of(effect: Effect) -> list[Any]:
    return [getattr(effect, item.name) for item in fields(effect)]


@pytest.mark.filterwarnings("ignore:.*no vehicle has entered")
@pytest.mark.parametrize("name", NAMED_DOMAINS)
def test_a_named_domain_is_read_back_from_the_running_environment(name: str) -> None:
    effects = {effect.name: effect for effect in parse_domain(name)}  # the last of equals counts
    trace = Trace(
        name, 1600 if "incident" in effects else 400 if "demand_timing" in effects else 300
    )
    for effect in effects.values():
        CHECKS[effect.name](trace, *values_of(effect))


@pytest.mark.filterwarnings("ignore:Mean of empty", "ignore:invalid value", "ignore:Degrees of")
def test_the_checks_can_fail() -> None:
    """A street without the effects fails every check."""
    trace = Trace("detector_failure=0+lost_commands=0", 300)
    for effect in {effect for name in NAMED_DOMAINS for effect in parse_domain(name)}:
        if effect.name not in ("max_green", "objective"):  # no green is long, costs are measured
            with pytest.raises(
                (AssertionError, ValueError, TypeError, IndexError, ArithmeticError)
            ):
                CHECKS[effect.name](trace, *values_of(effect))


def test_an_incident_leaves_a_lane_for_cars() -> None:
    scenario = load_scenario("grid2x2-v1")

    def closed(scenario: Scenario) -> str:
        (text,) = scenario_in_domain(scenario, "incident").applied
        return text.partition("=")[2].partition(",")[0]

    edge = closed(scenario).rpartition("_")[0]
    network = scenario.network.parse()
    for lane in network.iter("lane"):
        if lane.get("id") == f"{edge}_1":
            lane.set("allow", "pedestrian")
    changed = replace(scenario, network=scenario.network.edited(xml_bytes(network)))
    assert closed(changed).rpartition("_")[0] != edge


@pytest.mark.parametrize("block", ["lane_closure=east1_A1_1,250,300", "parking=east1_A1_1,12,30"])
def test_a_blocked_lane_changes_no_traffic_before(block: str) -> None:
    """A parked vehicle comes in the middle of each 300 s."""
    seen: list[list[Any]] = []
    for domain in ("sim", block):
        env = ugat_marl.parallel_env("single-v1", domain, duration_s=300)
        env.reset(seed=1)
        rows = [env.step(dict.fromkeys(env.agents, n // 3 % 4)) for n in range(14)]
        seen.append([(observations, rewards) for observations, rewards, *_ in rows])
        env.close()
    assert str(seen[0]) == str(seen[1])


def test_an_incident_needs_a_lane_that_is_long_enough() -> None:
    scenario = load_scenario("single-v1")
    short = re.sub(rb' length="[^"]*"', b' length="9.00"', scenario.network.read())
    changed = replace(scenario, network=scenario.network.edited(short))
    with pytest.raises(ScenarioError, match="no lane of 60 m"):
        scenario_in_domain(changed, "incident")


@pytest.mark.parametrize(
    "domain",
    ["combined-2+lost_readings=0.2+observation_delay=20+execution_delay=20+lost_commands=0.2"
     "+phase_order=cyclic+max_green=30+objective=safety", "meso+barrier-both+noise-3-percent"],
)  # fmt: skip
def test_an_environment_with_gaps_is_conformant(domain: str) -> None:
    def make() -> TrafficEnv:
        return ugat_marl.parallel_env("mixed-v1", domain, duration_s=60)

    assert all(found.passed for found in [*check_environment(make), *check_determinism(make)])


@pytest.mark.parametrize("domain", [StartupDelay(0.5), None, 3])
def test_a_domain_that_is_neither_text_nor_list(domain: Any) -> None:
    with pytest.raises(OptionError, match="give a name such as 'V1', or a list of effects"):
        ugat_marl.parallel_env("single-v1", domain)


def test_times_of_effects_lie_in_the_episode_that_is_asked_for() -> None:
    with pytest.raises(OptionError, match="incident"):
        ugat_marl.parallel_env("grid2x2-v1", "incident=4000,900")
    env = ugat_marl.parallel_env("grid2x2-v1", "incident=4000,900", duration_s=7200)
    assert env.scenario.settings.duration_s == 7200
    parked = ugat_marl.parallel_env("single-v1", "parking=northA_A1_0,60,30", duration_s=7200)
    last = parked.scenario.routes[-1].parse()[-1]
    assert float(last.get("depart", "0")) > 7000


def test_a_domain_that_could_be_read_only_once_is_refused() -> None:
    with pytest.raises(OptionError, match="give a name such as 'V1', or a list of effects"):
        parse_domain(iter([StartupDelay(0.5)]))  # type: ignore[arg-type]


def test_a_misspelt_name_behind_an_effect_with_a_fixed_choice_is_told_as_a_domain() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown domain 'snoww'.* Did you mean 'snow'"):
        parse_domain("objective=fairness+snoww")
