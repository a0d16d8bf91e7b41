"""Control delay by approach: one car by hand, the roads that count, the same traffic to the bit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.crossroads import build_crossroads
from ugat_marl.data import level_of_service, mean_delay_s
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import SimulatorError
from ugat_marl.experiments import Evaluation, evaluation_of, rule_factory
from ugat_marl.files import parse_xml
from ugat_marl.scenarios import Document, Network, read_scenario
from ugat_marl.simulation import measured_approaches
from ugat_marl.simulation.approach_delays import approach_roads, read_approach_delays

CARS = (
    '<vehicle id="e" type="car" route="east" depart="0" departSpeed="max"/>'
    '<vehicle id="n" type="car" route="north" depart="0" departSpeed="max"/>'
)


def test_the_delay_of_one_car_at_a_red_light(crossing: Callable[..., Path]) -> None:
    """The light serves the road with one car for a minute; the other car waits at red."""
    scenario = load_scenario(crossing(vehicles=CARS)).with_duration(120)
    (light,) = Network.read(scenario).intersections
    (east,) = (
        number
        for number, phase in enumerate(light.phases)
        if any(phase[link.index] in "Gg" for link in light.links if link.from_edge == "W_C")
    )
    with measured_approaches(scenario, Network.read(scenario)) as (measured, read):
        env = parallel_env(measured)
        env.reset(seed=1)
        while env.agents:
            begins = env.snapshot.time_s - scenario.settings.begin_s
            wanted = east if begins >= 60 else 1 - east
            env.step(dict.fromkeys(env.agents, wanted))
        lost_s = 2 * env.scores().delay_s  # the loss of both cars, by SUMO's report on trips
        env.close()
        delays = read()
    assert delays["S_C"][0] == delays["W_C"][0] == 1
    assert delays["S_C"][1] < 1.0
    waited_s = delays["W_C"][1]
    lane = Network.read(scenario).lanes["W_C_0"]
    red_s = 60 - lane.length_m / lane.speed_mps  # a car without a light is at the line before
    assert red_s > 5
    assert red_s < waited_s < red_s + lane.speed_mps * (0.5 / 2.5 + 0.5 / 4.5) + 2
    # Nothing else is lost on these roads; SUMO adds up steps of a second in two ways.
    assert waited_s + delays["S_C"][1] == pytest.approx(lost_s, abs=1.5)


def test_vehicles_that_block_a_lane_are_no_traffic() -> None:
    """One parks on an empty road for most of the time; the only traveller comes from the south."""
    scenario = load_scenario("single-v1").with_duration(300)
    trip = b'<routes><trip id="t" depart="1" from="southA_A1" to="A1_northA"/></routes>'
    alone = replace(scenario, routes=(Document("one.rou.xml", None, trip),))
    parked = scenario_in_domain(alone, "parking=northA_A1_0,12,240")
    network = Network.read(scenario)
    with measured_approaches(parked, network) as (measured, read):
        env = parallel_env(measured)
        env.reset(seed=1)
        while env.agents:
            env.step(dict.fromkeys(env.agents, 0))
        env.close()
        assert read()["northA_A1"] == (0.0, pytest.approx(0.0, abs=0.01))


def test_measuring_changes_no_traffic() -> None:
    scenario = load_scenario("single-v1").with_duration(300)
    found = [
        evaluation_of(
            scenario, {"rule": rule_factory("largest-queue:20")}, ("sim",), (3,), workers=1,
            approaches=measured,
        )
        for measured in (False, True)
    ]  # fmt: skip
    plain, measured = (one.results[0].scores for one in found)
    assert plain.approaches == {}
    assert set(measured.approaches) == {"northA_A1", "east1_A1", "west1_A1", "southA_A1"}
    assert (plain.att_s, plain.reward, plain.delay_s) == (
        measured.att_s, measured.reward, measured.delay_s,
    )  # fmt: skip


def test_the_pieces_of_a_road_cut_by_a_map_count(tmp_path: Path) -> None:
    """The western road is cut at "w", from where there is one way on: to the light at "M"."""
    build_crossroads(tmp_path, 20)
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vehicle id="a" depart="0"><route edges="Ww wM ME"/></vehicle></routes>'
    )
    (tmp_path / "x.sumocfg").write_text(
        '<configuration><input><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
        '</input><time><end value="100"/></time></configuration>'
    )
    scenario = read_scenario(tmp_path / "x.sumocfg")
    roads = approach_roads(scenario.network.parse(), Network.read(scenario))
    assert set(roads) == {"wM", "NM", "SM"}
    assert {road for road in roads["wM"] if not road.startswith(":")} == {"wM", "Ww"}
    assert {road for road in roads["NM"] if not road.startswith(":")} == {"NM"}
    assert all(any(road.startswith(":M_") for road in pieces) for pieces in roads.values())


def test_a_road_that_also_leads_elsewhere_does_not_count() -> None:
    lanes = {"a": "x y", "b": "y z", "c": "y q", "l": "z o"}
    root = parse_xml(
        (
            "<net>"
            + "".join(f'<edge id="{e}"/>' for e in lanes)
            + '<connection from="a" to="b" fromLane="0" toLane="0" dir="s"/>'
            + '<connection from="a" to="c" fromLane="0" toLane="0" dir="r"/>'
            + '<connection from="b" to="l" fromLane="0" toLane="0" dir="s" tl="z" linkIndex="0"'
            + ' via=":z_0_0"/><connection from=":z_0" to="l" fromLane="0" toLane="0" via=":z_4_0"/>'
            + "</net>"
        ).encode(),
        "net",
    )

    class Light:
        links = (type("L", (), {"from_edge": "b"})(),)

    network = type("N", (), {"intersections": (Light(),)})()
    assert approach_roads(root, network) == {"b": frozenset({"b", ":z_0", ":z_4"})}


def test_the_numbers_of_sumo_are_added_up(tmp_path: Path) -> None:
    file = tmp_path / "a.xml"
    file.write_text(
        '<meandata><interval><edge id="a" timeLoss="30" left="4"/><edge id=":j_0" timeLoss="10" '
        'left="4"/><edge id="up" timeLoss="8" left="9"/></interval></meandata>'
    )
    roads = {"a": frozenset({"a", ":j_0", "up"}), "b": frozenset({"b"})}
    assert read_approach_delays(file, roads) == {"a": (4.0, 12.0), "b": (0.0, 0.0)}
    blockers = tmp_path / "b.xml"
    blockers.write_text('<meandata><edge id="a" timeLoss="12" left="1"/></meandata>')
    assert read_approach_delays(file, roads, blockers)["a"] == (3.0, 12.0)
    file.write_text("<meandata><interval>")
    with pytest.raises(SimulatorError, match="data on roads cannot be read"):
        read_approach_delays(file, roads)


@pytest.mark.parametrize(
    ("delay_s", "level"),
    [(0, "A"), (10, "A"), (10.1, "B"), (20, "B"), (35, "C"), (35.5, "D"), (55, "D"), (80, "E"),
     (80.1, "F"), (900, "F"), (float("nan"), "")],
)  # fmt: skip
def test_levels_are_those_of_the_manual(delay_s: float, level: str) -> None:
    assert level_of_service(delay_s) == level


def test_delays_are_weighed_by_vehicles(tmp_path: Path) -> None:
    assert mean_delay_s([(300, 10.0), (100, 50.0)]) == 20.0
    assert mean_delay_s([(300, 10.0), (0, math.nan)]) == 10.0, "an approach that nobody passed"
    scenario = load_scenario("single-v1").with_duration(100)
    found = evaluation_of(
        scenario, {"p": rule_factory("programme")}, ("sim",), (1, 2), workers=1, approaches=True
    )
    first, second = (result.scores.approaches for result in found.results)
    for road, (vehicles, delay_s) in found.approaches("p", "sim").items():
        total = first[road][0] + second[road][0]
        assert vehicles == total / 2
        lost_s = sum(count * own_s for count, own_s in (first[road], second[road]))
        assert delay_s == pytest.approx(lost_s / total) or not total
    found.write(tmp_path / "e.json")
    assert Evaluation.read(tmp_path / "e.json").approaches("p", "sim") == found.approaches(
        "p", "sim"
    )
