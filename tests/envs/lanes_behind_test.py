"""Lanes at lights that are shorter than a vehicle: who waits behind them is seen."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ugat_marl
from tests.crossroads import crossroads_with
from ugat_marl.__main__ import main
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.experiments.training import simulated_worlds
from ugat_marl.field import LaneCount, Site
from ugat_marl.files import Document
from ugat_marl.grounding import UgatConfig
from ugat_marl.policies import ControlledNetwork, make_rule
from ugat_marl.scenarios import NO_UPSTREAM_LANES, Network, Scenario, survey
from ugat_marl.scenarios.junctions import Upstream, behind_of


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    """A crossroads whose western road has a node of the map 11 m before the middle."""
    return crossroads(tmp_path_factory.mktemp("split"), 11)


def crossroads(folder: Path, before_m: int) -> Scenario:
    cars = "".join(
        f'<vehicle id="{i}" depart="{2 * i}"><route edges="Ww wM ME"/></vehicle>' for i in range(8)
    )
    return crossroads_with(cars, folder, before_m, 200)


def test_a_short_lane_has_the_lane_behind(split: Scenario) -> None:
    network = Network.read(split)
    short = network.lanes["wM_0"]
    assert short.length_m < 7.5
    assert list(short.behind.lanes)[-1] == "Ww_0"
    assert set(short.behind.lanes.values()) == {1.0}
    assert short.room_m == pytest.approx(short.length_m + network.lanes["Ww_0"].length_m)
    assert short.storage_veh == pytest.approx(short.room_m / 7.5)
    assert network.lanes["NM_0"].behind == Upstream()
    (item,) = survey(split).intersections
    assert item.lanes_behind == ("wM_0",)
    assert network.straight == {"Ww": "wM"}  # all other roads end at the light or at the edge


def test_rules_measure_the_length_on_which_vehicles_are_counted(split: Scenario) -> None:
    """A stream of few vehicles on 6 m would hold each green to its end."""
    env = ugat_marl.parallel_env(split)
    rules, lane = ControlledNetwork.of(env), env.network.lanes["wM_0"]
    assert rules.free_flow_s["wM_0"] == pytest.approx(lane.room_m / 13)
    assert rules.free_flow_s["wM_0"] * 13 == pytest.approx(7.5 * rules.capacity["wM_0"])
    assert rules.road_s["wM"] == pytest.approx(lane.length_m / 13)
    env.close()


def test_who_waits_behind_is_counted(split: Scenario) -> None:
    """Eight cars and a red light: none has room on the lane itself."""
    env = ugat_marl.parallel_env(split, reward="waiting", observation="waiting")
    (item,) = env.network.intersections
    letter = next(link.index for link in item.links if link.from_lane == "wM_0")
    red = next(i for i, state in enumerate(item.phases) if state[letter] == "r")
    green = next(i for i, state in enumerate(item.phases) if state[letter] in "Gg")
    env.reset(seed=1)
    (agent,) = env.agents
    for _ in range(6):
        env.step({agent: red})
    lane = env.network.lane_table().ids.index("wM_0")
    assert env.snapshot.vehicles[lane] == env.snapshot.halting[lane] == 8
    assert env.snapshot.mean_speed_mps[lane] < 0.1
    assert env.snapshot.waiting_s[lane] > 8 * 20
    for _ in range(6):
        env.step({agent: green})
    assert env.snapshot.vehicles[lane] == 0
    assert env.snapshot.mean_speed_mps[lane] == pytest.approx(13)
    env.close()


def red_for_west(env: ugat_marl.envs.TrafficEnv) -> int:
    (item,) = env.network.intersections
    letter = next(link.index for link in item.links if link.from_lane == "wM_0")
    return next(i for i, state in enumerate(item.phases) if state[letter] == "r")


def test_the_queue_model_counts_them_as_car_following_does(split: Scenario) -> None:
    for domain in ("sim", "meso"):
        env = ugat_marl.parallel_env(split, domain)
        env.reset(seed=1)
        (agent,) = env.agents
        for _ in range(6):
            _, rewards, *_ = env.step({agent: red_for_west(env)})
        lane = env.network.lane_table().ids.index("wM_0")
        seen = env.snapshot
        assert (seen.vehicles[lane], seen.halting[lane], seen.queued_upstream[lane]) == (8, 8, 0)
        assert rewards[agent] == -8
        env.close()


@pytest.mark.parametrize("zone_m", [5, 9, 20, 50])
def test_a_detection_zone_goes_on_behind_a_short_lane(
    split: Scenario, zone_m: int, tmp_path: Path
) -> None:
    """As many are seen as on a road with a longer lane at the light."""
    seen: list[tuple[float, ...]] = []
    for scenario in (split, crossroads(tmp_path, 100)):
        env = ugat_marl.parallel_env(
            scenario, f"detection_zone={zone_m}", reward="waiting", observation="waiting"
        )
        env.reset(seed=1)
        (agent,) = env.agents
        for _ in range(7):
            env.step({agent: red_for_west(env)})
        lane = env.network.lane_table().ids.index("wM_0")
        near = env.seen
        assert near.mean_speed_mps[lane] == pytest.approx(0.0, abs=0.01)
        assert near.waiting_s[lane] > 20 * near.vehicles[lane]
        seen.append((near.vehicles[lane], near.halting[lane]))
        env.close()
    assert seen[0] == seen[1] and 1 <= seen[0][0] < 8


def test_the_field_loop_counts_them_as_the_environment_does(split: Scenario) -> None:
    site = Site.of(split, {"observation": "count"})
    assert {"wM_0", "Ww_0"} <= set(site.capacity)
    # each lane by itself, since a detector counts no other
    assert site.capacity["Ww_0"] == pytest.approx(site.network.lanes["Ww_0"].length_m / 7.5)
    assert site.capacity["wM_0"] == 1.0
    env = ugat_marl.parallel_env(split, observation="count")
    (item,) = env.network.intersections
    env.reset(seed=1)
    (agent,) = env.agents
    lane = env.network.lane_table().ids.index("wM_0")
    red = next(
        place
        for place, state in enumerate(item.phases)
        if all(state[link.index] == "r" for link in item.links if link.from_lane == "wM_0")
    )
    for _ in range(6):
        seen, *_ = env.step({agent: red})
    standing = env.snapshot.vehicles[lane]
    counts = {name: LaneCount(60.0, 0.0, 0.0) for name in site.capacity}
    counts["Ww_0"] = LaneCount(60.0, standing - 1, standing - 1)
    counts["wM_0"] = LaneCount(60.0, 1.0, 1.0)
    assert standing == 8
    assert site.observe(counts, 60.0, [red])[agent] == pytest.approx(seen[agent])
    env.close()


def test_the_field_loop_tells_who_halts_behind_from_who_drives(split: Scenario) -> None:
    site = Site.of(split, {"observation": "queue"})

    def seen(vehicles: float, halting: float) -> list[float]:
        counts = {name: LaneCount(60.0, 0.0, 0.0) for name in site.capacity}
        counts["Ww_0"] = LaneCount(60.0, vehicles, halting)
        (observed,) = site.observe(counts, 60.0, [0]).values()
        return observed.tolist()

    assert seen(7.0, 4.0) == seen(4.0, 4.0) != seen(7.0, 7.0)


def test_the_field_loop_counts_of_a_shared_lane_its_part(split: Scenario) -> None:
    site = Site.of(split, {"observation": "movements"})
    lanes = site.network.lanes
    half = replace(lanes["wM_0"], behind=Upstream(lanes={"Ww_0": 0.5}))
    shared = replace(site, network=replace(site.network, lanes={**lanes, "wM_0": half}))

    def seen(by: Site, vehicles: float, halting: float) -> list[float]:
        counts = {"Ww_0": LaneCount(60.0, vehicles, halting)}
        (observed,) = by.observe(counts, 60.0, [0]).values()
        return observed.tolist()

    assert seen(shared, 6.0, 4.0) == seen(site, 3.0, 2.0)


def test_a_rule_serves_them(split: Scenario) -> None:
    env = ugat_marl.parallel_env(split, observation="movements")
    rule = make_rule("largest-queue:10", env)
    observations, infos = env.reset(seed=1)
    while env.agents:
        observations, _, _, _, infos = env.step(rule.act(observations, infos))
    assert env.scores().throughput == 8
    env.close()


def net(*links: str) -> ET.Element:
    """``a0>b1`` is a way from lane 0 of road a to lane 1 of road b; with ``*`` it has a light."""
    parts = ""
    for text in links:
        start, end = text.rstrip("*").split(">")
        light = ' tl="T" linkIndex="0"' if text.endswith("*") else ""
        parts += (
            f'<connection from="{start[0]}" fromLane="{start[1]}" to="{end[0]}" toLane="{end[1]}" '
            f'via=":{start}{end}"{light}/>'
        )
    return ET.fromstring(f"<net>{parts}</net>")


LENGTHS_M = {"a_0": 3.0, "a_1": 3.0, "b_0": 50.0, "c_0": 2.0, "d_0": 50.0}


def lanes_behind(*links: str, reach_m: float = 7.5) -> dict[str, dict[str, float]]:
    return {
        name: own.lanes for name, own in behind_of(net(*links), LENGTHS_M, reach_m, {"T"}).items()
    }


def test_a_lane_that_leads_to_two_is_shared() -> None:
    assert lanes_behind("b0>a0", "b0>a1", "a0>z0*", "a1>z1*") == {
        "a_0": {":b0a0": 1.0, "b_0": 0.5},
        "a_1": {":b0a1": 1.0, "b_0": 0.5},
    }


def test_one_looks_back_until_the_reach() -> None:
    links = ("b0>c0", "c0>a0", "a0>z0*")
    assert list(lanes_behind(*links)["a_0"]) == [":c0a0", "c_0", ":b0c0", "b_0"]
    assert list(lanes_behind(*links, reach_m=5.0)["a_0"]) == [":c0a0", "c_0"]
    assert lanes_behind("d0>b0", "b0>z0*", reach_m=50.0) == {}
    assert lanes_behind("d0>b0", "b0>z0*", reach_m=50.5) == {"b_0": {":d0b0": 1.0, "d_0": 1.0}}


def test_some_of_those_who_may_go_elsewhere_are_counted() -> None:
    """Half of the vehicles on b go to d; c leads to b in two ways of three."""
    links = ("b0>a0", "b0>d0", "c0>b0", "c0>b1", "c0>d0", "a0>z0*")
    found = lanes_behind(*links, reach_m=60.0)["a_0"]
    assert found["b_0"] == 0.5
    assert found["c_0"] == pytest.approx(0.5 / 3)


def test_two_ways_to_the_same_lane_add_up() -> None:
    """From b by d and by c, and straight to the lane at the light: all of b's ways lead there."""
    links = ("c0>a0", "d0>a0", "b0>c0", "b0>d0", "a0>z0*")
    found = lanes_behind(*links, reach_m=55.0)["a_0"]
    assert found["b_0"] == 1.0


@pytest.mark.parametrize(
    "links",
    [
        ("b0>a0*", "a0>z0*"),  # who stands there waits for the other light
        ("b0>a0", "b0>d0*", "a0>z0*"),  # who stands there may wait for the other light
        ("b0>d0", "d0>z0*"),  # there is room
        ("a0>a0", "a0>z0*"),  # a circle
    ],
)
def test_what_is_not_behind(links: tuple[str, ...]) -> None:
    assert not any(lanes_behind(*links).values())


def test_a_lane_near_the_light_by_two_ways() -> None:
    """Straight to the lane at the light, and by c: both of b's ways lead there."""
    links = ("b0>a0", "b0>c0", "c0>a0", "a0>z0*")
    assert lanes_behind(*links)["a_0"]["b_0"] == 1.0


def test_in_a_roundabout_shares_are_those_of_all_rounds() -> None:
    """Of c half go to the light, half round by d and back: all come there in the end."""
    links = ("c0>a0", "c0>d0", "d0>c0", "a0>z0*")
    found = lanes_behind(*links, reach_m=200.0)["a_0"]
    assert found["c_0"] == pytest.approx(1.0)
    assert found["d_0"] == pytest.approx(1.0)


def test_a_chain_of_many_short_lanes() -> None:
    """A road cut at every other metre: more pieces than a roundabout has rounds."""
    pieces = [f"e{number}" for number in range(200)]
    root = ET.Element("net")
    for start, end in zip(pieces, [*pieces[1:], "z"], strict=True):
        ways = {"from": start, "fromLane": "0", "to": end, "toLane": "0"}
        light = {"tl": "T"} if end == "z" else {}
        ET.SubElement(root, "connection", {**ways, **light})
    lengths_m = {f"{piece}_0": 2.0 for piece in pieces}
    found = behind_of(root, lengths_m, 400.0, {"T"})["e199_0"].lanes
    assert len(found) == 199 and set(found.values()) == {1.0}


def test_both_parts_of_a_way_inside_a_junction() -> None:
    root = net("b0>a0", "a0>z0*")
    root.append(
        ET.fromstring('<connection from=":b0a" fromLane="0" to="a" toLane="0" via=":x_0"/>')
    )
    next(item for item in root if item.get("from") == "b").set("via", ":b0a_0")
    found = behind_of(root, LENGTHS_M, 7.5, {"T"})["a_0"].lanes
    assert found == {":b0a_0": 1.0, ":x_0": 1.0, "b_0": 1.0}


def test_a_light_without_an_agent_is_a_plain_node() -> None:
    root = net("b0>a0*", "a0>z0*")
    next(item for item in root if item.get("from") == "b").set("tl", "U")
    assert behind_of(root, LENGTHS_M, 7.5, {"T", "U"})["a_0"].lanes == {}
    assert behind_of(root, LENGTHS_M, 7.5, {"T"})["a_0"].lanes == {":b0a0": 1.0, "b_0": 1.0}


@pytest.mark.parametrize("turn", ["t", "T"])  # right-hand and left-hand traffic
def test_turning_around_is_no_way(turn: str) -> None:
    root = net("b0>a0", "a0>z0*")
    around = f'from="b" fromLane="0" to="y" toLane="0" via=":u" dir="{turn}"'
    root.append(ET.fromstring(f"<connection {around}/>"))
    assert behind_of(root, LENGTHS_M, 7.5, {"T"})["a_0"].lanes["b_0"] == 1.0


def test_whose_waiting_vehicles_are_counted() -> None:
    """Roads that begin nearer than the reach, each lane with its part of those who wait there."""
    links = ("b0>a0", "b0>a1", "a0>z0*", "a1>z1*")
    assert behind_of(net(*links), LENGTHS_M, 7.5, {"T"})["a_0"].roads == {"a": 0.5}
    with_pavement = {**LENGTHS_M, "a_2": 3.0}
    assert behind_of(net(*links), with_pavement, 7.5, {"T"})["a_0"].roads == {"a": 0.5}
    assert behind_of(net(*links), LENGTHS_M, 100.0, {"T"})["a_0"].roads == {"a": 0.5, "b": 0.5}


def test_other_networks_are_measured_as_before() -> None:
    table = Network.read(load_scenario("single-v1")).lane_table()
    assert table.behind == NO_UPSTREAM_LANES
    assert np.all(table.storage_veh > 1)


# --- a reach that is asked for


def test_who_waits_to_enter_is_counted_within_the_reach(split: Scenario) -> None:
    """Sixty cars for 200 m of road, in front of a red light: thirty of them find no room."""
    cars = "".join(
        f'<vehicle id="{i}" depart="{i}"><route edges="Ww wM ME"/></vehicle>' for i in range(60)
    )
    full = replace(
        split, routes=(Document("r.rou.xml", content=f"<routes>{cars}</routes>".encode()),)
    )
    counted: dict[float, tuple[float, float, float, float]] = {}
    for reach_m in (100.0, 300.0):
        world = scenario_in_domain(full, f"reach={reach_m:g}")
        env = ugat_marl.parallel_env(world, reward="waiting", observation="waiting")
        (item,) = env.network.intersections
        assert env.network.lanes["wM_0"].storage_veh >= reach_m / 7.5
        letter = next(link.index for link in item.links if link.from_lane == "wM_0")
        red = next(i for i, state in enumerate(item.phases) if state[letter] == "r")
        env.reset(seed=1)
        (agent,) = env.agents
        rewards = [env.step({agent: red})[1][agent] for _ in range(10)]
        lane = env.network.lane_table().ids.index("wM_0")
        seen = env.snapshot
        counted[reach_m] = (
            seen.vehicles[lane], seen.halting[lane], seen.waiting_s[lane], float(seen.backlog)
        )  # fmt: skip
        assert rewards[-1] < 0
        env.close()
    (near, near_halting, near_s, backlog), (far, far_halting, far_s, _) = counted.values()
    assert backlog > 25
    assert near == near_halting == 60 - backlog
    assert far == far_halting == 60
    # the last ones have been due for about 40 s, those before them for longer
    assert 40 * backlog < far_s - near_s < 100 * backlog


def test_the_queue_model_knows_no_reach(split: Scenario) -> None:
    for domain in ("queue_model=500+reach=100", "reach=100+queue_model=500"):
        with pytest.raises(ScenarioError, match="upstream of a lane"):
            scenario_in_domain(split, domain)


def test_a_detection_zone_and_a_reach_exclude_each_other(split: Scenario) -> None:
    for domain in ("reach=100+detection_zone=50", "detection_zone=50+reach=100"):
        with pytest.raises(OptionError, match="upstream"):
            scenario_in_domain(split, domain)


def test_both_worlds_have_the_same_reach(split: Scenario) -> None:
    for world in ("V1", "V1+reach=50"):
        with pytest.raises(OptionError, match="give both the same"):
            simulated_worlds(split, "reach=100", world, UgatConfig(), {})
    simulated_worlds(split, "reach=100", "V1+reach=100", UgatConfig(), {})


def test_a_table_and_a_training_say_so_before_they_begin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    for command in (
        ["paper", "gap", "--scenario", "single-v1", "--runs", str(runs), "--out", str(tmp_path)],
        ["train", "single-v1", "--real", "V1", "--out", str(runs)],
    ):
        assert main([*command, "--sim", "reach=400"]) == 2
        assert "give both the same reach" in capsys.readouterr().err
    assert not list(runs.rglob("*.pt"))


def test_the_field_loop_knows_no_reach(split: Scenario) -> None:
    with pytest.raises(OptionError, match="100 m upstream"):
        Site.of(scenario_in_domain(split, "reach=100"), {})


def test_a_scenario_may_say_how_far(split: Scenario, tmp_path: Path) -> None:
    folder = split.with_control(reach_m=50.0).write(tmp_path / "far")
    assert "reach_m = 50" in (folder / "scenario.toml").read_text()
    assert load_scenario(folder).control.reach_m == 50.0
    assert "reach_m" not in (split.write(tmp_path / "near") / "scenario.toml").read_text()
    (item,) = survey(load_scenario(folder)).intersections
    assert item.lanes_behind == ("wM_0",)


def test_short_lanes_are_told(
    split: Scenario, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (item,) = survey(split).intersections
    assert item.short_lanes == ()  # the one short lane is counted with those behind
    folder = tmp_path / "far"
    folder.mkdir()
    crossroads(folder, 40)
    for domain, told in (("sim", True), ("reach=100", False)):
        main(["scenario", "check", str(folder), "--no-simulate", "--domain", domain])
        said = capsys.readouterr().out
        assert ("shorter than 50 m: 1." in said) == told
