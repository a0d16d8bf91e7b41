"""Effects on roads and signals, at work in the running simulation."""

from __future__ import annotations

import re
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import libsumo
import numpy as np
import pytest
import sumo

from ugat_marl import parallel_env
from ugat_marl.effects import (
    AllRedTime,
    Effect,
    LaneClosure,
    LaneService,
    LateGreen,
    LocalSpeed,
    Parking,
    YellowTime,
    apply_effects,
    known_effects,
    late_greens,
    load_scenario,
    parse_domain,
    refuse_service,
    scenario_in_domain,
    shift_parking,
    with_late_green_programmes,
)
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.scenarios import Network, Scenario, Withheld, check_demand, driven_routes
from ugat_marl.simulation import LibsumoSimulator, launch_of

Crossing = Callable[..., Path]

EDGE, LANE = "east1_A1", "east1_A1_1"
MIDDLE_M = 286.4 - 30


@pytest.fixture
def simulator() -> Iterator[LibsumoSimulator]:
    made = LibsumoSimulator()
    yield made
    made.close()


def run(scenario: Scenario, own: Path, *options: str) -> Path:
    """The scenario in plain sumo; returns its folder."""
    launch = launch_of(scenario, 1, own, ())
    launch.write()
    program = Path(sumo.SUMO_HOME) / "bin" / "sumo"
    subprocess.run(
        [program, *launch.arguments, *options], check=True, capture_output=True, timeout=100
    )
    return own


# --- lanes


def passing(
    simulator: LibsumoSimulator, scenario: Scenario, own: Path, until: int
) -> tuple[dict[str, list[int]], dict[str, tuple[int, int]]]:
    """Seconds at which MIDDLE_M is passed on each lane of EDGE, and when blockers stand."""
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ()))
    last: dict[str, tuple[str, float]] = {}
    passed: dict[str, list[int]] = {f"{EDGE}_{n}": [] for n in range(3)}
    stood: dict[str, tuple[int, int]] = {}
    api = libsumo.vehicle
    for second in range(until):
        simulator.advance(1, {})
        assert not libsumo.simulation.getStartingTeleportIDList()
        assert not libsumo.simulation.getCollidingVehiclesIDList()
        for name in libsumo.edge.getLastStepVehicleIDs(EDGE):
            lane, position = api.getLaneID(name), api.getLanePosition(name)
            if name.startswith(("closure.", "parking.")):
                if api.getStopState(name) & 1:
                    assert position == pytest.approx(MIDDLE_M, abs=0.01)
                    assert api.getLength(name) == 5
                    stood[name] = (stood.get(name, (second, 0))[0], second)
                continue
            before = last.get(name)
            if before is not None and before[0] == lane and before[1] < MIDDLE_M <= position:
                passed[lane].append(second)
            last[name] = (lane, position)
    return passed, stood


def test_a_closed_lane_is_blocked_then_and_free_before_and_after(
    simulator: LibsumoSimulator, tmp_path: Path
) -> None:
    scenario = load_scenario("single-v1")
    plain, _ = passing(simulator, scenario, tmp_path / "plain", 1500)
    closed = apply_effects(scenario, [LaneClosure(LANE, 600, 1000)])
    check_demand(closed, Network.read(closed))
    passed, stood = passing(simulator, closed, tmp_path / "closed", 1500)

    def inside(times: list[int], begin: int, end: int) -> int:
        return sum(begin <= time < end for time in times)

    ((begin, end),) = stood.values()
    assert 601 <= begin <= 615  # as soon as the queue leaves room
    assert end == 999
    assert inside(plain[LANE], 602, 1000) > 10
    assert inside(passed[LANE], begin + 1, 1000) == 0
    assert inside(passed[LANE], 0, 595) == inside(plain[LANE], 0, 595)
    assert inside(passed[LANE], 1000, 1500) > 10
    others = [lane for lane in passed if lane != LANE]
    assert sum(inside(passed[lane], 620, 1000) for lane in others) > 20


@pytest.mark.parametrize("scale", ["0.5", "2"])
def test_an_option_that_scales_the_demand_leaves_blockers_as_they_are(
    simulator: LibsumoSimulator, tmp_path: Path, scale: str
) -> None:
    plain = load_scenario("single-v1")
    settings = plain.settings.model_copy(update={"sumo": {"scale": scale}})
    closed = apply_effects(replace(plain, settings=settings), [LaneClosure(LANE, 300, 600)])
    passed, stood = passing(simulator, closed, tmp_path / "own", 650)
    ((begin, end),) = stood.values()
    assert begin < 400 and end == 599
    vehicles = sum(map(len, passed.values()))
    unscaled, _ = passing(simulator, plain, tmp_path / "plain", 650)
    assert vehicles == pytest.approx(float(scale) * sum(map(len, unscaled.values())), rel=0.35)


def test_parking_blocks_a_lane_again_and_again(simulator: LibsumoSimulator, tmp_path: Path) -> None:
    scenario = apply_effects(load_scenario("single-v1"), [Parking(LANE, 30, 40)])
    check_demand(scenario, Network.read(scenario))
    passed, stood = passing(simulator, scenario, tmp_path / "own", 1200)
    assert len(stood) == pytest.approx(10, abs=1)  # one in every two minutes
    for begin, end in stood.values():
        assert end - begin == pytest.approx(40, abs=1)
        assert not [time for time in passed[LANE] if begin < time <= end]
    starts = sorted(begin for begin, _ in stood.values())
    assert all(120 * n <= begin < 120 * (n + 1) + 40 for n, begin in enumerate(starts))
    assert len(passed[LANE]) > 20


def test_blocked_lanes_can_be_blocked_twice_and_be_written(tmp_path: Path) -> None:
    scenario = load_scenario("single-v1").with_duration(900)
    effects = [
        LaneClosure(LANE, 100, 200), LaneClosure(LANE, 300, 400), Parking(LANE, 20, 30),
        Parking(LANE, 20, 30), LaneClosure(LANE, 2000, 3000), Parking(LANE, 0, 30),
    ]  # fmt: skip
    once = apply_effects(scenario, effects[:3])
    again = load_scenario(once.write(tmp_path / "written"))
    assert again.hash == once.hash
    twice = apply_effects(again, effects[3:])
    assert (
        len(twice.write(tmp_path / "again").parts)
        and load_scenario(tmp_path / "again").hash == twice.hash
    )
    report = run(twice, tmp_path / "own", "--end", "900") / "trips.xml"
    names = {item.get("id", "") for item in ET.parse(report).iter("tripinfo")}
    assert len([name for name in names if name.startswith("closure.")]) == 2
    assert len([name for name in names if name.startswith("parking.")]) == 10


def departures(scenario: Scenario) -> dict[str, float]:
    """Of every vehicle, in the order of the files."""
    return {
        item.get("id", ""): float(item.get("depart", "nan"))
        for document in scenario.routes
        for item in document.parse().iter("vehicle")
    }


def parked(scenario: Scenario) -> list[float]:
    return [time for name, time in departures(scenario).items() if name.startswith("parking.")]


@pytest.mark.parametrize("begin_s", [0.0, 25200.0])
def test_parking_at_other_times_is_as_frequent_and_as_long(
    crossing: Crossing, begin_s: float
) -> None:
    toml = lambda text: text.replace("duration_s", f"begin_s = {begin_s:g}\nduration_s")  # noqa: E731
    directory = crossing(vehicles="", toml=toml if begin_s else None)
    scenario = apply_effects(load_scenario(directory), [Parking("S_C_0", 180, 5)])
    one, again, other = (shift_parking(scenario, seed) for seed in (1, 1, 2))
    assert len(parked(scenario)) == 10  # 200 s of 180 an hour
    parts = (np.array(parked(scenario)) - begin_s) // 20.0
    assert parts.tolist() == [*range(10)], "one in each 20 s"
    for day in (one, other):
        assert len(parked(day)) == 10
        assert all(begin_s <= time < begin_s + 200.0 for time in parked(day))
        assert parked(day) == sorted(parked(day)), "SUMO wants departures in order"
        assert sorted(departures(day)) == sorted(departures(scenario))
    assert parked(one) == parked(again)
    assert parked(one) != parked(other)
    assert not set(parked(one)) & set(parked(scenario))
    # Turned about the day: what lies between two of them, round the clock, stays.
    rows = [np.array(parked(item)) for item in (scenario, one)]
    gaps = [np.sort(np.diff([*row, row[0] + 200.0])) for row in rows]
    assert gaps[1] == pytest.approx(gaps[0], abs=0.03)


def test_only_parking_is_moved_to_other_times(crossing: Crossing) -> None:
    plain = load_scenario(crossing())
    assert shift_parking(plain, 1).hash == plain.hash
    closed = apply_effects(plain, [LaneClosure("S_C_0", 60, 90)])
    assert shift_parking(closed, 1).hash == closed.hash
    both = apply_effects(closed, [Parking("W_C_0", 180, 5)])
    moved = shift_parking(both, 1)
    others = [
        {name: time for name, time in departures(item).items() if not name.startswith("parking.")}
        for item in (both, moved)
    ]
    assert others[0] == others[1]
    assert parked(both) != parked(moved)


def test_a_lane_too_short_to_stand_on(crossing: Crossing) -> None:
    short = lambda text: text.replace('length="490.00" shape="0.00', 'length="9" shape="0.00')  # noqa: E731
    with pytest.raises(OptionError, match="lane 'W_C_0' is 9 m long, too short for a vehicle"):
        LaneClosure("W_C_0", 0, 10).apply(load_scenario(crossing(edit=short)))


def test_traffic_on_an_edge_is_slower(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    car = (
        '<vehicle id="v" type="car" route="north" depart="0" departSpeed="max"/>'
        '<vehicle id="w" type="car" route="east" depart="0" departSpeed="max"/>'
    )
    scenario = load_scenario(crossing(vehicles=car))

    def speeds(effects: Sequence[Effect], name: str) -> tuple[float, float]:
        own = tmp_path / name
        own.mkdir()
        simulator.start(launch_of(apply_effects(scenario, effects), 1, own, ()))
        simulator.advance(20, {})
        return libsumo.vehicle.getSpeed("v"), libsumo.vehicle.getSpeed("w")

    assert speeds([], "plain") == (10, 10)
    assert speeds([LocalSpeed("S_C", 0.6)], "slow") == pytest.approx((6, 10))
    both = [LocalSpeed("S_C", 0.6), LocalSpeed("W_C", 0.9), LocalSpeed("S_C", 0.5)]
    assert speeds(both, "twice") == pytest.approx((3, 9))


def test_a_speed_sign_of_the_scenario_is_not_overruled_in_silence(crossing: Crossing) -> None:
    toml = lambda text: 'additional = ["signs.add.xml"]\n' + text  # noqa: E731
    directory = crossing(toml=toml)
    (directory / "signs.add.xml").write_text(
        '<additional><variableSpeedSign id="s" lanes="W_C_0 N_C_0"><step time="50" speed="8"/>'
        "</variableSpeedSign></additional>"
    )
    scenario = load_scenario(directory)
    with pytest.raises(ScenarioError, match=r"local_speed=W_C,0.5: .* signs.add.xml .* 'W_C_0'"):
        apply_effects(scenario, [LocalSpeed("W_C", 0.5)])
    assert apply_effects(scenario, [LocalSpeed("S_C", 0.5)]).applied


def test_edges_that_differ_in_a_special_character_have_signs_of_their_own(
    crossing: Crossing,
) -> None:
    network = lambda text: text.replace("S_C", "a@C").replace("W_C", "a~C")  # noqa: E731
    scenario = load_scenario(crossing(vehicles="", edit=network))
    slow = apply_effects(scenario, [LocalSpeed("a@C", 0.6), LocalSpeed("a~C", 0.9)])
    signs = {
        sign.get("lanes"): [float(step.get("speed", "")) for step in sign]
        for document in slow.additional
        for sign in document.parse().iter("variableSpeedSign")
    }
    assert signs == {"a@C_0": [6], "a~C_0": [9]}
    assert len({document.name for document in slow.additional}) == len(slow.additional)


# --- signals

STANDING = '<vehicle id="v" type="car" route="east" depart="0" departPos="490" departSpeed="0"/>'


def crossed_at(directory: Path, effects: Sequence[Effect], **options: str) -> tuple[int, list[int]]:
    """Second in which the car crosses a light that turns green in second 40, and what is seen."""
    env = parallel_env(load_scenario(directory), effects, simulator="inprocess", **options)
    env.reset(seed=1)
    seen: list[int] = []
    for second in range(100):
        observations, *_ = env.step({"signal_0": int(second >= 40)})
        seen.append(int(observations["signal_0"][-1]))
        if libsumo.vehicle.getRoadID("v") != "W_C":
            env.close()
            return second, seen
    raise AssertionError("it never crossed")


@pytest.mark.parametrize("signals", ["actions", "programme"])
def test_the_first_crossing_is_later_by_the_late_green(signals: str, crossing: Crossing) -> None:
    fast = lambda text: text.replace("decision_interval_s = 10", "decision_interval_s = 1")  # noqa: E731
    directory = crossing(vehicles=STANDING, toml=fast)
    at_once, observed = crossed_at(directory, [], signals=signals)
    for place in ("*", "C"):
        for late in (1, 2, 5):
            effects = [LateGreen(place, late)]
            second, seen = crossed_at(directory, effects, signals=signals)
            assert second == at_once + late
            asked = signals == "actions"  # then an agent sees the green it asked for
            assert seen.index(1) == observed.index(1) + (0 if asked else late)
    assert crossed_at(directory, [LateGreen("*", 0)], signals=signals)[0] == at_once


def test_late_green_is_a_setting(crossing: Crossing, tmp_path: Path) -> None:
    plain = load_scenario(crossing())
    scenario = apply_effects(plain, [LateGreen("*", 2)])
    assert late_greens(plain) == {}
    assert with_late_green_programmes(plain) is plain
    assert late_greens(scenario) == {"C": 2}
    own = apply_effects(scenario, [LateGreen("C", 3.5)])
    assert late_greens(own) == {"C": 3.5}
    assert late_greens(apply_effects(own, [LateGreen("C", 0)])) == {}
    assert late_greens(apply_effects(own, [LateGreen("*", 1)])) == {"C": 1}
    for item in (scenario, own):
        again = load_scenario(item.write(tmp_path / f"{late_greens(item)['C']:g}"))
        assert again.hash == item.hash != plain.hash
        assert late_greens(again) == late_greens(item)
        assert Network.read(again).intersections == Network.read(plain).intersections


def test_a_programme_that_is_late(crossing: Crossing) -> None:
    def states(scenario: Scenario) -> list[tuple[float, str]]:
        logic = next(iter(with_late_green_programmes(scenario).network.parse().iter("tlLogic")))
        return [(float(x.get("duration", "")), x.get("state", "")) for x in logic]

    scenario = load_scenario(crossing())
    assert states(scenario) == [(40, "Gr"), (10, "rG")]
    late = apply_effects(scenario, [LateGreen("C", 3)])
    assert states(late) == [(3, "rr"), (37, "Gr"), (3, "rr"), (7, "rG")]
    jumping = lambda text: text.replace('state="Gr"/>', 'state="Gr" next="1"/>')  # noqa: E731
    with pytest.raises(ScenarioError, match="phases name their successors"):
        states(apply_effects(load_scenario(crossing(edit=jumping)), [LateGreen("C", 3)]))


def test_lanes_that_are_not_served_are_red_in_programmes_too(crossing: Crossing) -> None:
    """A cycle of 40 and 10 s; link 0 loses 2 s at its begin and 1 s in each further decision."""
    scenario = load_scenario(crossing())
    red = {"C": Withheld((2.0, 0.0), (1.0, 0.0))}

    def states(scenario: Scenario) -> list[tuple[float, str]]:
        changed = with_late_green_programmes(scenario, red).network
        logic = next(iter(changed.parse().iter("tlLogic")))
        return [(float(x.get("duration", "")), x.get("state", "")) for x in logic]

    assert states(scenario) == [(2, "rr"), (8, "Gr"), *3 * [(1, "rr"), (9, "Gr")], (10, "rG")]
    late = states(apply_effects(scenario, [LateGreen("C", 1)]))
    assert (late[0], late[-2:]) == ((3, "rr"), [(1, "rr"), (9, "rG")])
    actuated = crossing(edit=lambda text: text.replace('type="static"', 'type="actuated"'))
    assert states(load_scenario(actuated)) == [(2, "rr"), (38, "Gr"), (10, "rG")]
    jumping = crossing(edit=lambda text: text.replace('state="Gr"/>', 'state="Gr" next="1"/>'))
    assert states(load_scenario(jumping)) == [(40, "Gr"), (10, "rG")]


def test_a_programme_serves_a_lane_as_little_as_agents_do(crossing: Crossing) -> None:
    path, travel_s = crossing(), list[float]()
    for effects in ([], [LaneService("W_C_0", 8.0, 0.0)]):
        env = parallel_env(path, effects, signals="programme")
        env.reset(seed=1)
        while env.agents:
            env.step(dict.fromkeys(env.agents, 0))
        travel_s.append(env.scores().att_s)
        env.close()
    assert travel_s[1] > travel_s[0] + 1.0


def test_service_of_a_lane_that_no_agent_controls_is_refused(crossing: Crossing) -> None:
    network = Network.read(load_scenario(crossing()))
    refuse_service(network, [LaneService("W_C_0", 8.0, 0.0)])
    with pytest.raises(OptionError, match="'C_N_0' leads to no light of an agent"):
        refuse_service(network, [LaneService("C_N_0", 8.0, 0.0)])


def test_clearance_times() -> None:
    scenario = apply_effects(load_scenario("single-v1"), [YellowTime(4.2), AllRedTime(1)])
    assert (scenario.control.yellow_s, scenario.control.all_red_s) == (4, 1)
    assert scenario.applied == ("yellow_time=4.2", "all_red_time=1")
    halves = apply_effects(load_scenario("single-v1"), [YellowTime(2.5), AllRedTime(0.5)])
    assert (halves.control.yellow_s, halves.control.all_red_s) == (3, 1)


# --- all of them

EXAMPLES = (
    "acceleration=1", "deceleration=3", "emergency_deceleration=6", "startup_delay=0.5",
    "headway=1.3", "min_gap=3", "imperfection=0.7", "reaction_step=2", "desired_speed=0.9",
    "speed_spread=0.15", "yellow_running=1", "red_running=1", "gap_acceptance=2",
    "lane_discipline=0.5", "heavy_share=0.15", "driver_model=EIDM", "late_green=A1,1.5",
    "yellow_time=4", "all_red_time=1", "demand_level=east1_A1,1.2",
    "demand_surge=west1_A1,100,300,1.7", "demand_timing=southA_A1,60",
    "turning=east1_A1,A1_northA,0.2", "lane_closure=west1_A1_0,100,200",
    "parking=east1_A1_0,30,20", "local_speed=northA_A1,0.8", "undercount=*,0.1",
    "signal_clock=A1,-1.25", "clock_drift=*,2", "stuck=d1,10,20", "dropout=d1,10,20",
    "swapped=d1,d2",
)  # fmt: skip


def test_every_effect_has_an_example() -> None:
    assert [text.partition("=")[0] for text in EXAMPLES] == list(known_effects())


@pytest.mark.parametrize("order", [1, -1])
def test_all_effects_compose_in_any_order_and_survive_writing(order: int, tmp_path: Path) -> None:
    scenario = load_scenario("single-v1").with_duration(400)
    changed = apply_effects(scenario, parse_domain("+".join(EXAMPLES[::order])))
    assert changed.applied == EXAMPLES[::order]
    check_demand(changed, Network.read(changed))
    again = load_scenario(changed.write(tmp_path / "written"))
    assert again.hash == changed.hash
    report = run(again, tmp_path / "own", "--end", "400") / "trips.xml"
    kinds = {item.get("vType") for item in ET.parse(report).iter("tripinfo")}
    assert {"car", "heavy.car"} <= kinds
    assert len(list(ET.parse(report).iter("tripinfo"))) > 100


@pytest.mark.parametrize("text", EXAMPLES)
def test_an_effect_in_a_scenario_file(text: str, tmp_path: Path) -> None:
    scenario = load_scenario("single-v1")
    (effect,) = parse_domain(text)
    record = effect.record()
    settings = scenario.settings.model_copy(update={"effects": (record,)})
    written = replace(scenario, settings=settings).write(tmp_path / "written")
    assert load_scenario(written).applied == (text,)
    assert load_scenario(written).hash == effect.apply(scenario).hash


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lane_closure=east1_A1,0,10", r"unknown lane 'east1_A1'\. Did you mean 'east1_A1_[012]'"),
        ("parking=x,1,1", r"unknown lane 'x'.*'parking' names it"),
        ("local_speed=x,1", "unknown edge 'x'"),
        ("late_green=x,1", r"unknown traffic light 'x'\. Known: A1"),
        ("signal_clock=x,1", r"unknown traffic light 'x'\. Known: A1"),
        ("clock_drift=x,1", r"unknown traffic light 'x'\. Known: A1"),
    ],
)
def test_unknown_places(text: str, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        apply_effects(load_scenario("single-v1"), parse_domain(text))


def test_a_closure_of_an_unknown_lane_is_refused_even_if_it_is_over(crossing: Crossing) -> None:
    later = load_scenario(crossing(toml=lambda text: "begin_s = 100\n" + text))
    assert LaneClosure("W_C_0", 0, 10).apply(later).routes == later.routes
    with pytest.raises(UnknownNameError, match="unknown lane 'x'"):
        LaneClosure("x", 0, 10).apply(later)


@pytest.mark.parametrize(
    "domain",
    [
        "lane_closure=northA_A1_0,{0},{1}",
        "demand_surge=*,{0},{1},2",
        "incident={0},60",
    ],
)
def test_an_effect_outside_of_the_episode_is_refused(domain: str) -> None:
    scenario = load_scenario("single-v1")  # 0 s to 3600 s
    scenario_in_domain(scenario, domain.format(3590, 3700))  # an overlap is enough
    late = domain.format(3600, 3700)
    with pytest.raises(OptionError, match=r"from 3600 s to 3\d+ s.*'single-v1' from 0 s to 3600 s"):
        scenario_in_domain(scenario, late)
    early = domain.format(600, 700)
    with pytest.raises(OptionError, match=r"from 600 s to \d+ s.* from 0 s to 300 s"):
        parallel_env("single-v1", early, duration_s=300.0)
    effects = tuple(effect.record() for effect in parse_domain(late))
    listed = scenario.settings.model_copy(update={"effects": effects})
    with pytest.raises(OptionError, match="longer duration_s"):
        load_scenario(replace(scenario, settings=listed))


@pytest.mark.parametrize(
    ("domain", "least", "message"),
    [
        ("parking=east1_A1_0,{},60", (2.99, 3), r"give at least 3 per_hour, or a longer"),
        ("execution_delay={}", (4.9, 5), "give at least 5 s"),
        ("observation_delay={}", (4.9, 5), "give at least 5 s"),
    ],
)
def test_an_effect_that_is_rounded_to_nothing_is_refused(
    domain: str, least: tuple[float, float], message: str
) -> None:
    scenario = load_scenario("single-v1").with_duration(600)  # decisions of 10 s
    below, enough = (domain.format(value) for value in least)
    with pytest.raises(OptionError, match=f"to none, so it would change nothing; {message}"):
        scenario_in_domain(scenario, below)
    for accepted in (enough, domain.format(0)):
        assert scenario_in_domain(scenario, accepted).applied


def test_a_detector_that_errs_outside_of_the_record_is_refused() -> None:
    scenario = load_scenario("single-v1")  # 0 s to 3600 s
    scenario_in_domain(scenario, "stuck=northA_A1_0,3590,3700", recorded=True)
    with pytest.raises(OptionError, match=r"from 3600 s to 3700 s.*'single-v1' from 0 s to 3600"):
        scenario_in_domain(scenario, "stuck=northA_A1_0,3600,3700", recorded=True)


def test_vehicles_that_block_a_lane_are_no_travellers(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    plain = load_scenario(crossing())
    network = Network.read(plain)
    blocked = apply_effects(plain, [LaneClosure("S_C_0", 20, 60), Parking("W_C_0", 180, 20)])
    named = (
        plain.routes[0].read().replace(b'flow id="north"', b'flow id="parking.north"')
    )  # somebody's own name
    own = replace(plain, routes=(plain.routes[0].edited(named),))
    alike = named.replace(b"parking.north", b"parking").replace(b'type="car"', b'type="parking"')
    alike = alike.replace(b'vType id="car"', b'vType id="parking"')
    like = replace(plain, routes=(plain.routes[0].edited(alike),))  # somebody's own flow and type
    counts: list[tuple[int, int, int]] = []
    for number, scenario in enumerate((plain, blocked, own, like)):
        launch = launch_of(scenario, 1, tmp_path / str(number), list(network.lanes))
        simulator.start(launch)
        simulator.advance(200.0, {})
        trips = simulator.finish()
        drives = sum(1 for _ in driven_routes(scenario))
        counts.append((len(trips.finished), check_demand(scenario, network).vehicles, drives))
    assert counts[0][0] > 0 and set(counts) == {counts[0]}


def test_only_the_vehicles_of_the_effect_park_at_other_times() -> None:
    own = '<vehicle id="parking.7" depart="100"><route edges="east1_A1 A1_west1"/></vehicle>'
    scenario = load_scenario("single-v1")
    document = scenario.routes[0].edited(f"<routes>{own}</routes>".encode())
    (shifted,) = shift_parking(replace(scenario, routes=(document,)), 3).routes
    (vehicle,) = shifted.parse().iter("vehicle")
    assert vehicle.get("depart") == "100"


@pytest.mark.parametrize(
    "effect", ["lane_closure=west1_A1_0,100,200", "parking=east1_A1_0,30,20", "incident=100,60"]
)
def test_nobody_stands_on_lanes_that_are_queues(effect: str) -> None:
    blocks = effect.replace("incident=100,60", "lane_closure=")  # the closure that was made of it
    for domain, says in ((f"meso+{effect}", effect), (f"{effect}+meso", blocks)):
        with pytest.raises(ScenarioError, match=rf"^{re.escape(says)}.*mesoscopic.* leave out one"):
            scenario_in_domain(load_scenario("single-v1"), domain)
