"""`scenario check` and `scenario draw`: hand counts, planted mistakes, what pictures show."""

from __future__ import annotations

import functools
import io
import json
import math
import re
import struct
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tests.crossroads import crossroads_with
from tests.effects.effects_demand_test import with_routes
from ugat_marl.__main__ import main
from ugat_marl.cli.scenario_check import show
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import (
    RuleEpisode,
    as_json,
    best_phases,
    left_outside,
    measure_headroom,
    problems,
    remarks,
)
from ugat_marl.files import xml_bytes
from ugat_marl.progress import Silent
from ugat_marl.reporting import plot_network
from ugat_marl.reporting.phase_diagrams import STYLES
from ugat_marl.scenarios import (
    Document,
    Network,
    Scenario,
    degrees_of_saturation,
    resco_maps,
    sumo_program,
    survey,
)
from ugat_marl.scenarios.capacity import discharge_vph
from ugat_marl.scenarios.inspection import (
    ApproachFacts,
    _green_s,
    _in_part,
    fullest,
)
from ugat_marl.scenarios.settings import validate_settings


@pytest.fixture(scope="module")
def single() -> Scenario:
    return load_scenario("single-v1")


def driven(scenario: Scenario, drives: Iterable[tuple[float, str]]) -> Scenario:
    """The scenario with vehicles that depart at a time, s, and take these edges, and no others."""
    vehicles = "".join(
        f'<vehicle id="{number}" depart="{depart_s:.1f}"><route edges="{edges}"/></vehicle>'
        for number, (depart_s, edges) in enumerate(drives)
    )
    routes = Document("r.rou.xml", None, f"<routes>{vehicles}</routes>".encode())
    return replace(scenario, routes=(routes,))


def test_an_intersection_is_counted(single: Scenario) -> None:
    """Four arms, two lanes for straight on, one for left: three movements each."""
    facts = survey(single)
    (item,) = facts.intersections
    assert (item.lanes, item.movements, len(item.phases)) == (12, 12, 8)
    assert item.unserved_lanes == item.unserved_links == ()
    assert item.junctions == ("A1",)
    assert (item.u_turns, item.crossings, item.uncontrolled, item.right_on_red) == (0, 0, 0, 0)
    both_through = item.phases[0]
    assert both_through.permitted == ()
    assert {name.split()[1] for name in both_through.protected} == {"s", "r"}
    assert facts.vehicles == 2000 or 1900 < facts.vehicles < 2100


def test_bus_lanes_add_no_capacity_for_cars(single: Scenario) -> None:
    """Of two lanes for straight on, one is closed to cars: the other carries all of them."""
    root = single.network.parse()
    lane = next(item for item in root.iter("lane") if item.get("id") == "northA_A1_0")
    way = next(
        item
        for item in root.iter("connection")
        if item.get("from") == "northA_A1" and item.get("to") == "A1_southA"
    )
    way.set("fromLane", "0")  # lane 1 leads straight on as well

    def written() -> Scenario:
        return replace(single, network=Document(single.network.name, None, xml_bytes(root)))

    both = written()
    lane.set("allow", "bus bicycle")
    closed = written()

    def lanes_of(scenario: Scenario) -> int:
        (item,) = survey(scenario).intersections
        return next(road.lanes for road in item.approaches if road.edge == "northA_A1")

    assert (lanes_of(both), lanes_of(closed)) == (3, 2)
    flows = {("northA_A1", "A1_southA"): 900.0}
    shared, alone = (degrees_of_saturation(scenario, flows)["A1"] for scenario in (both, closed))
    assert alone == pytest.approx(2 * shared)


@pytest.mark.parametrize(
    ("turns", "speed_mps", "vph"),
    [
        ("s", 8.0, 3600 / (1.45 + 8.5 / 8)),  # 2.5 s, as measured
        ("s", 17.0, 3600 / 1.95),
        ("l", 17.0, 1600),
        ("r", 17.0, 3600 / 2.6),
        ("lr", 17.0, 1600),  # the quicker of both
        ("rs", 17.0, 3600 / 1.95),
        ("s", 0.5, 600),
    ],
)
def test_lanes_discharge_what_their_turns_and_limits_let_them(
    turns: str, speed_mps: float, vph: float
) -> None:
    assert discharge_vph(turns, speed_mps) == pytest.approx(vph)


def test_traffic_is_counted_by_approach(single: Scenario) -> None:
    network = Network.read(single)
    item = network.intersections[0]
    lane = network.lanes[item.incoming_lanes[0]]
    leads = next(k.to_edge for k in item.links if k.from_edge == lane.edge)
    drives = [(100 + i, f"{lane.edge} {leads}") for i in range(360)]
    facts = survey(driven(single, drives).with_duration(1800))
    road = next(a for a in facts.intersections[0].approaches if a.edge == lane.edge)
    assert road.vph == 720
    assert road.worst_vph == 1440  # all of them within a quarter of an hour
    serving = {k.from_lane for k in item.links if k.from_edge == lane.edge and k.to_edge == leads}
    each_vph = discharge_vph("r", lane.speed_mps)
    assert road.flow_ratio == pytest.approx(1440 / (len(serving) * each_vph), abs=1e-3)
    assert (road.worst_from_s, facts.busiest_s, facts.busiest, facts.last_s) == (0, 0, 360, 459)
    assert road.first_s == pytest.approx(100 + lane.length_m / lane.speed_mps)
    others = [a for a in facts.intersections[0].approaches if a.edge != lane.edge]
    assert {(a.worst_vph, a.first_s) for a in others} == {(0.0, None)}
    (text,) = [text for text in remarks(facts, ()) if "no vehicle can be there" in text]
    assert all(a.edge in text for a in others) and lane.edge not in text
    assert road.saturation is not None
    assert road.saturation > road.flow_ratio
    assert facts.first_s == 100
    both = lane.length_m / lane.speed_mps * 2
    assert facts.fill_s == pytest.approx(both, rel=0.1)
    assert facts.shortest_episode_s >= 100 + 3 * facts.fill_s
    assert sum(a.vph for a in facts.intersections[0].approaches) == 720


@pytest.mark.parametrize(
    ("flows", "capacity", "share"),
    [
        ({"left": 20, "through": 1000, "right": 20}, (1800, 1800, 1800), 1000 / 1800),
        ({"left": 20, "through": 1000, "right": 20}, (800, 800, 200), 1000 / 800),
        ({"left": 0, "through": 300, "right": 300}, (400, 400, 400), 300 / 400),
        ({"left": 900}, (1000, 1000, 0), math.inf),
        ({}, (1000, 1000, 1000), 0.0),
    ],
)
def test_lanes_of_their_own_are_full_alone(
    flows: dict[str, float], capacity: tuple[float, ...], share: float
) -> None:
    lanes = {"right": {"0"}, "through": {"1"}, "left": {"2"}}
    assert fullest(flows, lanes, dict(zip("012", capacity, strict=True))) == pytest.approx(share)


def test_traffic_divides_among_lanes_that_it_shares() -> None:
    lanes = {"right": {"0"}, "through": {"0", "1"}, "left": {"1"}}
    capacity = {"0": 1000.0, "1": 500.0}
    assert fullest({"right": 300, "through": 600}, lanes, capacity) == pytest.approx(900 / 1500)
    assert fullest({"right": 900, "through": 300}, lanes, capacity) == pytest.approx(900 / 1000)
    assert fullest({"left": 400, "through": 600}, lanes, capacity) == pytest.approx(400 / 500)


@pytest.mark.parametrize(
    ("duration_s", "worst_vph", "from_s"),
    [
        (1200.0, 300.0, 0.0),  # the rest of five minutes belongs to the only quarter
        (1400.0, 720.0, 900.0),  # a quarter of 500 s
        (1800.0, 400.0, 900.0),
    ],
)
def test_a_last_quarter_that_is_shorter_has_its_own_length(
    single: Scenario, duration_s: float, worst_vph: float, from_s: float
) -> None:
    (item,) = Network.read(single).intersections
    start, goal = item.links[0].from_edge, item.links[0].to_edge
    drives = [(900 + 2 * i, f"{start} {goal}") for i in range(100)]
    facts = survey(driven(single, drives).with_duration(duration_s))
    (road,) = [a for a in facts.intersections[0].approaches if a.edge == start]
    assert (road.worst_vph, road.worst_from_s) == (pytest.approx(worst_vph, abs=0.1), from_s)
    assert (facts.busiest, facts.busiest_s) == (100, from_s)
    assert facts.busiest_length_s == (duration_s if not from_s else duration_s - 900)


def test_a_light_s_own_late_green_belongs_to_every_source_of_phases(single: Scenario) -> None:
    settings = single.settings.model_dump()
    settings["intersections"] = {"A1": {"late_green_s": 20.0}}
    late = replace(single, settings=validate_settings(settings, "test"))
    (before,), (after,) = survey(single).intersections, survey(late).intersections
    assert after.degrees["now"] == after.degrees["conflict-free"] != before.degrees["now"]
    assert set(after.degrees) == set(before.degrees)
    for source, degree in after.degrees.items():
        assert degree is not None and degree > (before.degrees[source] or 0.0), source


def test_nineteen_of_twenty_routes_are_no_longer_than_said(single: Scenario) -> None:
    link = Network.read(single).intersections[0].links[0]
    drives = [(0, link.from_edge), (1, f"{link.from_edge} {link.to_edge}")]
    short, both = (survey(driven(single, some)).fill_s for some in (drives[:1], drives))
    assert both > 1.5 * short  # of two routes, 95 % are both


def test_a_lane_whose_right_turn_may_go_on_red_is_not_served_in_part() -> None:
    light, lane = next(
        (light, lane)
        for light in Network.read(load_scenario("mixed-v1")).intersections
        for lane in light.incoming_lanes
        if {x.direction for x in light.links if x.from_lane == lane} == {"s", "r"}
    )
    letters = ["r"] * len(light.phases[0])
    for link in light.links:
        if link.from_lane == lane:
            letters[link.index] = "G" if link.direction == "s" else "s"
    assert not _in_part(lane, replace(light, phases=("".join(letters),)))
    shut = "".join(letters).replace("s", "r")
    assert _in_part(lane, replace(light, phases=(shut,)))


def test_an_approach_that_is_full_for_a_quarter_of_an_hour_is_shown_so(single: Scenario) -> None:
    """700 vehicles in the third quarter of an hour; the mean over the hour is a quarter of that."""
    (item,) = Network.read(single).intersections
    start, goal = item.links[0].from_edge, item.links[0].to_edge
    facts = survey(driven(single, ((1800 + i * 1.2, f"{start} {goal}") for i in range(700))))
    (road,) = [a for a in facts.intersections[0].approaches if a.edge == start]
    assert (road.vph, road.worst_vph, road.worst_from_s) == (700, 2800, 1800)
    assert road.saturation is not None
    (usual,) = [a for a in survey(single).intersections[0].approaches if a.edge == start]
    assert usual.saturation is not None  # the same share of green
    shares = [a.flow_ratio / (a.saturation or 1.0) for a in (road, usual)]
    assert shares[0] == pytest.approx(shares[1], rel=0.02)
    assert (facts.busiest_s, facts.busiest) == (1800, 700)
    assert facts.intersections[0].degrees["now"] is not None


def test_the_road_without_any_green_is_the_fullest() -> None:
    roads = [
        ApproachFacts("some", 1, 900.0, 900.0, 0.0, 0.5, 0.9, 0.0),
        ApproachFacts("none", 1, 90.0, 90.0, 0.0, 0.05, None, 0.0),  # no green for its traffic
        ApproachFacts("idle", 1, 0.0, 0.0, 0.0, 0.0, None, None),
    ]
    names = [road.edge for road in sorted(roads, key=lambda road: road.fullness, reverse=True)]
    assert names == ["none", "some", "idle"]


def test_what_goes_on_red_after_a_stop_has_capacity() -> None:
    light = next(
        light
        for light in Network.read(load_scenario("mixed-v1")).intersections
        if {x.direction for x in light.links if x.from_lane == light.incoming_lanes[0]}
        == {"s", "r"}
    )
    lane = light.incoming_lanes[0]
    letters = ["r"] * len(light.phases[0])
    for link in light.links:
        if link.from_lane == lane and link.direction == "r":
            letters[link.index] = "s"
    stops = replace(light, programme=((30.0, "".join(letters)), (10.0, "r" * len(letters))))
    to = {link.direction: link.to_edge for link in light.links if link.from_lane == lane}
    assert _green_s(stops, lane, {}, 2.0) == 15.0  # the mean of both links
    assert _green_s(stops, lane, {to["r"]: 90.0}, 2.0) == pytest.approx(30.0)
    assert _green_s(stops, lane, {to["r"]: 90.0, to["s"]: 10.0}, 2.0) == pytest.approx(0.0)


def test_a_turn_without_green_holds_up_the_lane_that_it_shares(tmp_path: Path) -> None:
    """Closed form: vehicles until the first that has to wait; and what SUMO lets through."""
    cars = "".join(
        f'<vehicle id="{i}" depart="{i * 2}" departSpeed="max">'
        f'<route edges="NM {"ME" if number < 0.5 else "MS"}"/></vehicle>'
        for i, number in enumerate(np.random.default_rng(0).random(1800))
    )
    crossing = crossroads_with(cars, tmp_path, 60, 3600)
    (light,) = Network.read(crossing).intersections
    index = {link.to_edge: link.index for link in light.links if link.from_edge == "NM"}
    letters = "r" * len(light.programme[0][1])

    def green(*roads: str) -> str:
        going = [index[road] for road in roads]
        return "".join("G" if i in going else letter for i, letter in enumerate(letters))

    def used_s(*programme: tuple[float, str], left: float = 50.0) -> float:
        shares = {"MS": 50.0, "ME": left}
        twice = [*light.links, *(link for link in light.links if link.to_edge == "MS")]
        used = (
            _green_s(replace(light, programme=programme, links=tuple(links)), "NM_0", shares, 2.0)
            for links in (light.links, twice)
        )
        once, again = used
        assert once == again, "links to one road are one road"
        return once

    assert used_s((30.0, green("MS", "ME")), (60.0, letters)) == pytest.approx(30)
    assert used_s((30.0, green("MS")), (60.0, letters)) == pytest.approx(0)  # a left turn is first
    assert used_s((30.0, green("MS")), (60.0, letters), left=1e-3) == 0  # sooner or later
    # Greens so long that each ends with a vehicle that waits for the other: 1 + 1/2 + 1/4 ... go.
    assert used_s((60.0, green("MS")), (60.0, green("ME"))) == pytest.approx(2 * 2 * 2)
    both = used_s((30.0, green("MS", "ME")), (3.0, green("ME")), (60.0, letters))
    assert both == pytest.approx(30 + 2 * (1 / 2 + 1 / 2 * 1 / 4))  # 1.5 vehicles' time

    programme = ((30.0, green("MS")), (10.0, green("ME")), (50.0, letters))
    shares = {"MS": 50.0, "ME": 50.0}
    headway_s = 3600 / discharge_vph("sl", 13.0)
    each = _green_s(replace(light, programme=programme), "NM_0", shares, headway_s) / headway_s
    phases = "".join(f'<phase duration="{s}" state="{state}"/>' for s, state in programme)
    (tmp_path / "p.add.xml").write_text(
        '<additional><tlLogic id="M" type="static" programID="1" offset="0">'
        f"{phases}</tlLogic></additional>"
    )
    subprocess.run(
        [str(sumo_program("sumo")), "-n", "n.net.xml", "-r", "r.rou.xml", "-a", "p.add.xml",
         "--end", "3600", "--tripinfo-output", "out.xml", "--time-to-teleport", "-1"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    through = len(ET.parse(tmp_path / "out.xml").findall("tripinfo"))
    assert through / (3600 / 90) == pytest.approx(each, rel=0.2)


def test_a_programme_that_follows_the_traffic_is_told(single: Scenario) -> None:
    facts = survey(single)
    assert not any("durations in the file" in text for text in remarks(facts, []))
    (light,) = facts.intersections
    vague = replace(light, times_vary="it follows the traffic (actuated)")
    (text,) = [x for x in remarks(replace(facts, intersections=(vague,)), []) if "durations" in x]
    assert text.startswith("traffic light 'A1': it follows the traffic (actuated), so what its own")


def test_a_better_source_of_phases_is_named() -> None:
    """Waiting left turns block lanes that also lead straight on, so permitted ones serve more."""
    scenario = load_scenario("mixed-v1").with_control(phases="conflict-free")
    vehicles = scenario.routes[0].read().count(b"<vehicle ")
    facts = survey(scenario)
    (light,) = [light for light in facts.intersections if light.id == "S"]
    degrees = degrees_of_saturation(scenario.with_control(phases="permitted"))
    assert best_phases(light)[0] in ("permitted", "programme")
    assert light.degrees["now"] == light.degrees["conflict-free"]
    assert (light.degrees["now"] or 0.0) > best_phases(light)[1]
    assert light.degrees["permitted"] == pytest.approx(degrees["S"], rel=0.5)
    assert problems(facts, ()) == []  # it is not full
    full = replace(light, degrees={"now": 1.3, "conflict-free": 1.3, "permitted": 0.8})
    over = replace(facts, intersections=(full,))
    assert problems(over, ()) == []  # advice, and nothing that has to be repaired
    (text,) = [note for note in remarks(over, ()) if "its demand is" in note]
    assert "its demand is 130% of what its phases can serve, and 80% with" in text
    assert 'phases = "permitted"; set it under [intersections.S]' in text
    near = replace(light, degrees={"now": 1.3, "permitted": 1.25})
    assert not [n for n in remarks(replace(facts, intersections=(near,)), ()) if "demand is" in n]
    assert vehicles


def test_the_worse_one_of_programme_and_rule_is_named(single: Scenario) -> None:
    facts = survey(single)
    runs = [
        RuleEpisode("programme", 300, 9, 9, 9, 0),
        RuleEpisode("largest-queue:20", 90, 9, 9, 9, 0),
    ]
    (text,) = [text for text in remarks(facts, runs) if "programme takes" in text]
    assert "its timing is the worse one, and the phases suit" in text
    full = replace(facts.intersections[0], degrees={"now": 1.3})
    over = replace(facts, intersections=(full,))
    (text,) = [text for text in remarks(over, runs) if "programme takes" in text]
    assert "though no timing of these phases serves all (demand: 130% of their capacity)" in text
    runs = [
        RuleEpisode("programme", 90, 9, 9, 9, 0),
        RuleEpisode("largest-queue:20", 300, 9, 9, 9, 0),
    ]
    (text,) = [text for text in remarks(facts, runs) if "programme takes" in text]
    assert "the rule does not suit these lights" in text
    runs = [
        RuleEpisode("programme", 90, 9, 9, 9, 0),
        RuleEpisode("largest-queue:20", 80, 9, 9, 9, 0),
    ]
    assert not [text for text in remarks(facts, runs) if "programme takes" in text]


def test_clearance_that_differs_from_the_file_is_told(single: Scenario) -> None:
    same = survey(single)
    assert not [text for text in remarks(same, ()) if "of yellow and" in text]
    (item,) = same.intersections
    assert (item.file_yellow_s, item.file_all_red_s) == ((3.0,), (2.0,))
    (text,) = [
        text
        for text in remarks(survey(single.with_control(yellow_s=4.0)), ())
        if "of yellow and" in text
    ]
    assert (
        "the file has 3 s of yellow and 2 s of red between greens; agents' greens get 4 s" in text
    )


def test_lights_with_the_same_clearance_share_a_note() -> None:
    facts = survey(load_scenario("grid2x2-v1").with_control(yellow_s=4.0))
    (text,) = [text for text in remarks(facts, ()) if "of yellow and" in text]
    assert text.startswith("traffic lights 'A1', 'A2', 'B1', 'B2': the file has")


def test_phases_are_told_by_the_greens_of_the_file(single: Scenario) -> None:
    """Listed in the other order, phase n is green 3 - n of the file."""
    (item,) = Network.read(single).intersections
    greens = [state for _, state in item.programme if set(state) & set("Gg") and "y" not in state]
    greens = list(dict.fromkeys(greens))
    facts = survey(spoilt(single, greens[::-1]))
    numbers = [phase.green_of_file for phase in facts.intersections[0].phases]
    assert numbers == list(range(len(greens)))[::-1]
    other = survey(spoilt(single, [greens[0].replace("G", "r", 1), greens[1]]))
    assert [phase.green_of_file for phase in other.intersections[0].phases] == [None, 1]


def test_flows_are_counted_too(single: Scenario) -> None:
    (item,) = Network.read(single).intersections
    start, goal = item.links[0].from_edge, item.links[0].to_edge
    flow = f'<flow id="f" begin="0" end="1800" number="90" from="{start}" to="{goal}"/>'
    routes = (Document("r.rou.xml", None, f"<routes>{flow}</routes>".encode()),)
    facts = survey(replace(single, routes=routes).with_duration(1800))
    assert (facts.vehicles, facts.flows) == (0, 1)
    road = next(a for a in facts.intersections[0].approaches if a.edge == start)
    assert road.vph == pytest.approx(180, abs=2)


def test_lanes_that_a_phase_serves_in_part_are_counted() -> None:
    """RESCO's arterial has left turns and straight on in one lane; single-v1 has lanes for each."""
    (item,) = survey(load_scenario("single-v1")).intersections
    assert item.partly_served == ()
    facts = survey(load_scenario("mixed-v1").with_control(phases="conflict-free"))
    shared = {item.id: len(item.partly_served) for item in facts.intersections}
    assert shared["P"] == 0
    assert shared["S"] == 4  # one lane for everything on each of its four arms


def spoilt(single: Scenario, phases: list[str]) -> Scenario:
    settings = single.settings.model_dump() | {"intersections": {"A1": {"phases": phases}}}
    return replace(single, settings=type(single.settings).model_validate(settings))


def test_what_no_phase_serves_is_named(single: Scenario) -> None:
    (item,) = Network.read(single).intersections
    facts = survey(spoilt(single, list(item.phases[:2])))
    assert facts.intersections[0].unserved_lanes
    (text,) = problems(facts, ())
    assert "no phase gives green to the lanes" in text
    for lane in facts.intersections[0].unserved_lanes:
        assert lane in text


def test_a_short_episode_and_a_full_road_are_named(single: Scenario) -> None:
    facts = survey(single.with_duration(60))
    assert "shorter than the shortest useful one" in problems(facts, ())[0]
    runs = [
        RuleEpisode("programme", 100, 1000, 800, 700, 200),
        RuleEpisode("rule", 90, 1000, 980, 900, 20),
    ]
    (text,) = problems(survey(single), runs)
    assert "20 of 1000 vehicles cannot enter even under rule" in text
    runs[1] = RuleEpisode("rule", 90, 1000, 995, 900, 5)
    assert problems(survey(single), runs) == []


def test_vehicles_due_in_the_last_seconds_make_no_road_full(single: Scenario) -> None:
    short = survey(single.with_duration(300))
    assert problems(short, [RuleEpisode("rule", 90, 133, 131, 90, 2)]) == []
    (text,) = problems(short, [RuleEpisode("rule", 90, 133, 120, 90, 13)])
    assert "13 of 133 vehicles cannot enter" in text


def test_phases_a_rule_cannot_work_with_are_named() -> None:
    mixed = load_scenario("mixed-v1")
    runs = [
        RuleEpisode("programme", 90, 1000, 1000, 900, 0),
        RuleEpisode("largest-queue:20", 270, 1000, 1000, 9, 0),
    ]
    (text,) = problems(survey(mixed.with_control(phases="conflict-free")), runs)
    assert "takes 270 s where the programme takes 90 s" in text
    assert 'phases = "permitted"' in text
    assert problems(survey(load_scenario("single-v1")), runs) == []  # it has lanes for every turn


def test_roads_where_vehicles_wait_outside_are_named(single: Scenario) -> None:
    """3 000 vehicles an hour want onto one road, a handful onto another."""
    (item,) = Network.read(single).intersections
    full, free, *_ = dict.fromkeys(link.from_edge for link in item.links)
    goal = {k.from_edge: k.to_edge for k in item.links if k.direction == "s"}
    roads = (free if i % 100 == 0 else full for i in range(1000))
    drives = ((i * 0.3, f"{road} {goal[road]}") for i, road in enumerate(roads))
    crowded = driven(single, drives).with_duration(300)
    outside = left_outside(crowded, 1)
    assert set(outside) == {full}
    assert outside[full] > 300
    runs = [RuleEpisode("programme", 100, 1000, 500, 100, 500)]
    (text,) = problems(survey(crowded), runs, outside)
    assert f"they wait at {full} ({outside[full]})" in text


def test_vehicles_of_an_early_flow_that_wait_outside_are_found(single: Scenario) -> None:
    """SUMO counts the vehicles of a flow from the episode's begin on."""
    flow = '<flow id="f" begin="0" end="{}" period="0.3" from="west1_A1" to="A1_east1"/>'
    early = with_routes(flow.format(7200), begin_s=3600.0).with_duration(300)
    assert left_outside(early, 1)["west1_A1"] > 300


def test_the_command_prints_tables(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["scenario", "check", "single-v1", "--duration-s", "600"]) == 0
    text = capsys.readouterr().out
    for word in ("1 agent, 8 green phases", "Saturation by approach", "largest-queue:20",
                 "left outside", "headroom: not measured", "nothing to fix"):  # fmt: skip
        assert word in text
    assert max(len(line) for line in text.splitlines()) <= 80


def test_departures_are_told_on_the_clock_of_the_scenario(single: Scenario) -> None:
    way = "northA_A1 A1_southA"
    days = driven(single, [(25203, way), (26100, way), (26110, way), (26999, way)])
    times = {"begin_s": 25200.0, "duration_s": 1800.0}
    later = replace(days, settings=days.settings.model_copy(update=times))
    said = io.StringIO()
    show(Console(file=said), survey(later), 25200.0, (), None, (), Network.read(later))
    text = said.getvalue()
    assert "4 vehicles, the first at 7:00:03 on the scenario's clock" in text
    assert "they depart until 7:29:59, most from 7:15:00 on: 3 within 15 min" in text


def test_turns_that_yield_are_said_to_count_whole(capsys: pytest.CaptureFixture[str]) -> None:
    said: list[bool] = []
    for scenario in ("single-v1", "mixed-v1"):  # of the two only the second has such turns
        assert main(["scenario", "check", scenario, "--no-simulate"]) == 0
        said.append("Permitted greens are counted in full" in capsys.readouterr().out)
    assert said == [False, True]


def test_the_command_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["scenario", "check", "mixed-v1", "--json", "--no-simulate"]
    assert main(words) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [len(item["phases"]) for item in facts["intersections"]] == [8, 3, 6, 2, 2, 4, 3]
    assert facts["headroom"] is None
    assert facts["problems"] == []


def test_an_approach_that_nobody_passed_has_no_delay_in_json(single: Scenario) -> None:
    delays = {"a": (3.0, 12.5), "b": (0.0, math.nan), "c": (0.0, math.inf)}
    run = RuleEpisode("programme", 90, 9, 9, 9, 0, delays)
    text = json.dumps(as_json(survey(single), [run], None, []), allow_nan=False)
    (told,) = json.loads(text)["runs"]
    assert told["approaches"] == {"a": [3.0, 12.5], "b": [0.0, None], "c": [0.0, None]}


def test_a_scenario_to_fix_is_an_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "check", "single-v1", "--no-simulate", "--duration-s", "60"]) == 1
    assert "to fix: an episode of 60 s" in capsys.readouterr().out


def test_headroom_is_measured_on_request(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    two = functools.partial(measure_headroom, domains=("sim", "V4"))
    monkeypatch.setattr("ugat_marl.cli.scenario_check.measure_headroom", two)
    words = ["scenario", "check", "single-v1", "--headroom", "1", "--duration-s", "200"]
    assert main([*words, "--no-simulate"]) == 0
    text = capsys.readouterr().out
    assert "Headroom" in text
    assert "V4" in text


@pytest.mark.parametrize("words", [["--json"], []])
def test_an_episode_in_which_nobody_is_due_has_no_headroom(
    single: Scenario,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
) -> None:
    rare = '<flow id="f" begin="0" end="10" probability="1e-9" from="southA_A1" to="A1_northA"/>'
    routes = Document("r.rou.xml", None, f"<routes>{rare}</routes>".encode())
    quiet = replace(single, routes=(routes,)).with_duration(10).write(tmp_path / "quiet")
    sim = functools.partial(measure_headroom, domains=("sim",))
    monkeypatch.setattr("ugat_marl.cli.scenario_check.measure_headroom", sim)
    assert main(["scenario", "check", str(quiet), "--headroom", "1", *words]) == 0
    shown = capsys.readouterr().out
    assert not re.search(r"\b(nan|NaN|Infinity)\b", shown)
    if words:
        (row,) = json.loads(shown)["headroom"]
        assert row["finished"] is row["lost"] is row["att_s"][0] is None
    else:
        assert re.search(r"^ sim( +-){7} *$", shown, re.MULTILINE)


def test_old_names_still_work(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios"]) == 0
    assert "grid4x4-v1" in capsys.readouterr().out
    assert main(["scenario", "--help"]) == 0
    text = capsys.readouterr().out
    for name in ("list", "new", "check", "draw"):
        assert f"  {name} " in text


needs_resco = pytest.mark.skipif(not resco_maps(), reason="sumo-rl is not installed")
MAPS = ("arterial4x4", "cologne1", "cologne3", "cologne8", "grid4x4", "ingolstadt1",
        "ingolstadt21", "ingolstadt7")  # fmt: skip


@needs_resco
@pytest.mark.parametrize("phases", ["programme", "conflict-free", "permitted"])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == "ingolstadt21" else ()) for name in MAPS],
)
def test_every_resco_map_goes_through(name: str, phases: str) -> None:
    assert name in resco_maps()
    facts = survey(load_scenario(f"resco:{name}").with_control(phases=phases))
    assert facts.intersections
    assert problems(facts, ()) == []
    assert all(not item.unserved_links for item in facts.intersections)


# --- pictures -------------------------------------------------------------------------------------

SVG = "{http://www.w3.org/2000/svg}"


def texts(path: Path) -> list[str]:
    return ["".join(item.itertext()) for item in ET.parse(path).iter(f"{SVG}text")]


def test_every_intersection_is_drawn_with_its_phases(tmp_path: Path) -> None:
    scenario = load_scenario("mixed-v1")
    files = plot_network(scenario, tmp_path, Silent())
    network = Network.read(scenario)
    names = {"network", *(item.id for item in network.intersections)}
    assert {path.name for path in files} == {f"{n}.{end}" for n in names for end in ("svg", "png")}
    for item in network.intersections:
        words = texts(tmp_path / f"{item.id}.svg")
        titles = [w.split(" (") for w in words if w.startswith("phase ")]
        assert [phase for phase, _ in titles] == [f"phase {i}" for i in range(len(item.phases))]
        assert all(re.fullmatch(r"not in the file\)|green \d of the file\)", g) for _, g in titles)
        assert any(item.id in word for word in words)
        for edge in {link.from_edge for link in item.links}:
            assert any(edge[:15] in word for word in words)
    width, height = struct.unpack(">II", (tmp_path / "network.png").read_bytes()[16:24])
    assert width >= 1000
    assert height >= 300


def test_green_is_drawn_in_the_colour_of_the_legend(tmp_path: Path) -> None:
    """As many strokes in the colour of protected green as there are links with it, and the key."""
    scenario = load_scenario("single-v1")
    plot_network(scenario, tmp_path, Silent())
    (item,) = Network.read(scenario).intersections
    green = sum(phase[link.index] == "G" for phase in item.phases for link in item.links)
    text = (tmp_path / "A1.svg").read_text()
    curves = text.count(f"stroke: {STYLES['G'][0].lower()}; stroke-width: 1.7")
    assert curves == green
    assert "stroke-dasharray" not in text.partition("<defs>")[0]


def test_the_same_drawing_is_the_same_file(tmp_path: Path) -> None:
    for name in "ab":
        plot_network(load_scenario("single-v1"), tmp_path / name, Silent())
    assert (tmp_path / "a" / "A1.svg").read_bytes() == (tmp_path / "b" / "A1.svg").read_bytes()


def test_many_phases_go_to_several_pages(tmp_path: Path, single: Scenario) -> None:
    (item,) = Network.read(single).intersections
    width = len(item.phases[0])
    phases = ["r" * i + "G" + "r" * (width - i - 1) for i in range(width)]
    phases += [p.replace("G", "g") for p in phases]
    plot_network(spoilt(single, phases), tmp_path, Silent())
    pages = sorted(path.name for path in tmp_path.glob("A1-*.png"))
    assert len(pages) == -(-len(phases) // 15)


def test_names_become_files_that_any_system_takes(tmp_path: Path) -> None:
    from ugat_marl.reporting.phase_diagrams import _file_name

    taken = {"network"}
    found = [_file_name(name, taken) for name in ("a/b", "A:B", "a b", "..", "network", "x" * 300)]
    assert len({name.lower() for name in found}) == len(found)
    assert all(name and len(name) < 100 and "/" not in name for name in found)
    assert tmp_path.is_dir()


def test_a_place_that_cannot_be_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "draw", "single-v1", "--out", "/dev/null/x"]) == 2
    assert "cannot be written" in capsys.readouterr().err
