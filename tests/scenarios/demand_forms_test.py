"""Demand in forms that routing alone can lose: buses with a line, early flows, own speeds."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from contextlib import nullcontext

import pytest

from tests.effects.effects_demand_test import with_routes
from ugat_marl.effects import LateGreen, apply_effects, load_scenario, parse_domain
from ugat_marl.errors import ScenarioError, UnknownNameError
from ugat_marl.parallel import DEADLINE_VARIABLE
from ugat_marl.scenarios import (
    Network,
    Scenario,
    check_demand,
    degrees_of_saturation,
    demand_as_vehicles,
    draw_day,
    survey,
)
from ugat_marl.scenarios.importers.osm_crossings import has_light


def vehicles(scenario: Scenario) -> list[ET.Element]:
    return [item for document in scenario.routes for item in document.parse().iter("vehicle")]


def test_buses_with_a_line_stay_in_the_demand() -> None:
    flow = '<flow id="{0}" begin="0" end="600" number="60" from="west1_A1" to="A1_east1"{1}/>'
    scenario = with_routes(flow.format("bus", ' line="7"') + flow.format("car", ""))
    named = Counter(
        item.get("id", "").partition(".")[0] for item in vehicles(demand_as_vehicles(scenario))
    )
    assert named == {"bus": 60, "car": 60}


def test_a_flow_by_chance_may_begin_before_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEADLINE_VARIABLE, "60")
    scenario = with_routes(
        '<flow id="f" begin="0" end="7200" probability="0.05" from="west1_A1" to="A1_east1"/>',
        begin_s=3600.0,
    )
    departs = [float(item.get("depart", "")) for item in vehicles(demand_as_vehicles(scenario))]
    assert 120 < len(departs) < 250 and min(departs) >= 3600  # 180 of 3600 s


def test_a_flow_by_chance_that_ended_before_the_episode_is_left_out() -> None:
    scenario = with_routes(
        '<flow id="f" begin="0" end="50" probability="0.2" from="west1_A1" to="A1_east1"/>'
        '<trip id="t" depart="3700" from="west1_A1" to="A1_east1"/>',
        begin_s=3600.0,
    )
    assert [item.get("id") for item in vehicles(demand_as_vehicles(scenario))] == ["t"]


@pytest.mark.parametrize(
    ("text", "departs"),
    [
        ('<vehicle id="v" depart="begin"><route edges="west1_A1 A1_east1"/></vehicle>', [3600]),
        ('<trip id="t" depart="begin" from="west1_A1" to="A1_east1"/>', [3600]),
        (
            '<flow id="f" begin="begin" end="3640" number="4" from="west1_A1" to="A1_east1"/>',
            [3600, 3610, 3620, 3630],
        ),
    ],
)
def test_the_word_begin_is_that_of_the_episode(text: str, departs: list[float]) -> None:
    scenario = with_routes(text, begin_s=3600.0)
    found = [float(item.get("depart", "")) for item in vehicles(demand_as_vehicles(scenario))]
    assert found == departs
    drawn = [float(item.get("depart", "")) for item in vehicles(draw_day(scenario, 5))]
    assert all(3600 <= depart < 3640 for depart in drawn)


def test_of_districts_it_is_said_that_ways_differ() -> None:
    districts = "".join(
        f'<taz id="{name}" edges="{edges}"/>'
        for name, edges in (("a", "west1_A1 southA_A1"), ("b", "A1_east1 A1_northA"))
    )
    trip = '<trip id="{}" depart="10" {}/>'
    plain = trip.format("t", 'from="west1_A1" to="A1_east1"')
    assert survey(with_routes(plain)).notes == ()
    (note,) = survey(
        with_routes(districts + plain + trip.format("z", 'fromTaz="a" toTaz="b"'))
    ).notes
    assert note.startswith("'z' runs between districts")


@pytest.mark.parametrize(
    ("rate", "by_chance"),
    [('probability="0.1"', True), ('period="exp(0.1)"', True), ('vehsPerHour="360"', False)],
)
def test_of_random_flows_it_is_said_that_days_vary_one_draw(rate: str, by_chance: bool) -> None:
    scenario = with_routes(
        f'<flow id="f" begin="0" end="600" {rate} from="west1_A1" to="A1_east1"/>'
    )
    notes = [note.partition(":")[0] for note in survey(scenario).notes]
    assert notes == ["'f' departs at random"] * by_chance
    assert len({demand_as_vehicles(scenario).hash for _ in range(2)}) == 1


def test_a_day_with_many_vehicles_has_them_all() -> None:
    """On this day the demand is seven times the usual one, so some vehicles have nine copies."""
    route = '<route edges="west1_A1 A1_east1"/>'
    text = "".join(f'<vehicle id="v{n}" depart="{n}">{route}</vehicle>' for n in range(500))
    drawn = vehicles(draw_day(with_routes(text), 383, day_to_day=0.9))
    copies = Counter((item.get("id") or "").partition("~")[0] for item in drawn)
    assert len({item.get("id") for item in drawn}) == len(drawn) == 3457
    assert max(copies.values()) > 8


def test_a_vehicle_keeps_its_own_speed_factor_on_a_drawn_day() -> None:
    route = '<route edges="west1_A1 A1_east1"/>'
    text = "".join(
        f'<vehicle id="v{n}" depart="{n}" type="car"{own}>{route}</vehicle>'
        for n, own in enumerate([' speedFactor="0.4"', ""] * 50)
    )
    types = '<vType id="car" speedFactor="normc(1,0.1,0.2,2)"/>'
    drawn = vehicles(draw_day(with_routes(types + text), 1))
    factors = {
        item.get("id", "").partition("~")[0]: float(item.get("speedFactor", "")) for item in drawn
    }
    own = set(range(0, 100, 2))
    assert {f for n, f in factors.items() if int(n[1:]) in own} == {0.4}
    assert len({f for n, f in factors.items() if int(n[1:]) not in own}) > 10


def test_late_greens_count_in_the_degree_of_saturation() -> None:
    scenario = load_scenario("single-v1").with_control(phases="conflict-free")
    flows = {("southA_A1", "A1_northA"): 900.0, ("west1_A1", "A1_east1"): 600.0}
    late = apply_effects(scenario, [LateGreen("*", 5.0)])
    longer = scenario.with_control(all_red_s=scenario.control.all_red_s + 5.0)
    found = degrees_of_saturation(late, flows)
    assert found == degrees_of_saturation(longer, flows) != degrees_of_saturation(scenario, flows)


def test_service_is_that_of_a_lane_at_a_light() -> None:
    scenario = load_scenario("single-v1")
    apply_effects(scenario, parse_domain("lane_service=west1_A1_0,4,0"))
    with pytest.raises(UnknownNameError, match="lane"):
        apply_effects(scenario, parse_domain("lane_service=A1_east1_0,4,0"))


def test_a_crossing_without_signals_has_no_light() -> None:
    assert not has_light({"highway": "crossing", "crossing:signals": "no"})
    assert has_light({"highway": "crossing", "crossing:signals": "yes"})


def test_a_scale_of_a_type_is_refused() -> None:
    route = '<route edges="west1_A1 A1_east1"/>'
    for scale, refused in (("2", True), ("1", False), ("1.00", False), ("1.01", True)):
        text = (
            f'<vType id="t" scale="{scale}"/><vehicle id="v" type="t" depart="1">{route}</vehicle>'
        )
        scenario = with_routes(text)
        with pytest.raises(ScenarioError, match="scale of its own") if refused else nullcontext():
            check_demand(scenario, Network.read(scenario))


def test_a_turn_of_demand_between_districts_is_not_known() -> None:
    scenario = with_routes('<trip id="t" depart="1" fromTaz="a" toTaz="b"/>')
    with pytest.raises(ScenarioError, match="has fromTaz = 'a'"):
        apply_effects(scenario, parse_domain("turning=west1_A1,A1_northA,1"))
