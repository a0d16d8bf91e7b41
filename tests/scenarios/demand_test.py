"""Demand: what departs in an episode is counted, and what cannot be driven is refused."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import libsumo
import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import (
    Demand,
    Document,
    Network,
    check_demand,
    demand_as_vehicles,
    draw_day,
    driven_routes,
    shipped_scenarios,
    survey,
)
from ugat_marl.scenarios.capacity import counted_flows_vph
from ugat_marl.scenarios.routes import departures

Crossing = Callable[..., Path]


def check(directory: Path) -> Demand:
    scenario = load_scenario(directory)
    return check_demand(scenario, Network.read(scenario))


def car(name: str, depart: object) -> str:
    return f'<vehicle id="{name}" type="car" route="east" depart="{depart}"/>'


def test_vehicles_trips_and_flows_are_counted(crossing: Crossing) -> None:
    vehicles = (
        car("a", 0)
        + '<trip id="b" depart="10" from="W_C" to="C_E"/>'
        + '<vehicle id="c" depart="0:00:20"><route edges="S_C C_N"/></vehicle>'
        + '<flow id="d" begin="30" end="60" period="5" from="S_C" to="C_N" via="S_C C_N"/>'
        + '<flow id="e" begin="1:00:00" end="2:00:00" period="5" route="east"/>'
    )
    assert check(crossing(vehicles=vehicles)) == Demand(vehicles=3, flows=1)


def test_only_the_episode_counts(crossing: Crossing) -> None:
    vehicles = "".join(car(f"v{depart}", depart) for depart in (99, 100, 299.9, 300, 5000))
    vehicles = '<flow id="f" begin="0" end="99" period="9" route="east"/>' + vehicles
    directory = crossing(
        vehicles=vehicles, toml=lambda text: text.replace("duration_s", "begin_s = 100\nduration_s")
    )
    assert check(directory) == Demand(vehicles=2, flows=0)


def test_triggered_departures_are_no_times(crossing: Crossing) -> None:
    vehicles = car("a", 50) + car("b", "triggered") + car("c", 60)
    assert check(crossing(vehicles=vehicles)) == Demand(vehicles=3, flows=0)


@pytest.mark.parametrize(
    ("vehicles", "routed"),
    [
        ('<vehicle id="a" depart="0"><route edges="S_C C_N"/></vehicle>' * 2, True),
        (car("a", 0), False),
        ('<trip id="b" depart="10" from="W_C" to="C_E"/>', False),
        ('<flow id="d" begin="30" end="60" period="5" from="S_C" to="C_N"/>', False),
    ],
)
def test_what_needs_no_router_is_known(vehicles: str, routed: bool, crossing: Crossing) -> None:
    directory = crossing(vehicles=vehicles)
    assert check(directory).routed is routed
    assert (demand_as_vehicles(load_scenario(directory)).routes[0].path is not None) is routed


def test_vehicles_that_no_score_would_hold_are_refused(crossing: Crossing) -> None:
    unseen = '<vType id="t"><param key="has.tripinfo.device" value="false"/></vType>' + car("a", 0)
    with pytest.raises(ScenarioError, match="scores .* need the device tripinfo of every vehicle"):
        load_scenario(crossing(vehicles=unseen))


@pytest.mark.parametrize(("scale", "refused"), [("0", True), ("0.0001", True), ("0.001", False)])
def test_a_scale_that_leaves_out_all_vehicles_is_refused(
    scale: str, refused: bool, crossing: Crossing
) -> None:
    directory = crossing(toml=lambda text: f'{text}[sumo]\nscale = "{scale}"\n')
    with pytest.raises(ScenarioError, match="leaves out all") if refused else nullcontext():
        check(directory)


@pytest.mark.parametrize("kind", ["vehicles", "flow"])
def test_the_scale_of_the_demand_counts(kind: str, crossing: Crossing) -> None:
    demand = {
        "vehicles": "".join(
            f'<vehicle id="v{n}" depart="{n}"><route edges="S_C C_N"/></vehicle>' for n in range(40)
        ),
        "flow": '<flow id="f" begin="0" end="160" period="4" from="S_C" to="C_N"/>',
    }[kind]
    plain = load_scenario(crossing(vehicles=demand))
    sheet = crossing(vehicles=demand, toml=lambda text: text + '[sumo]\nscale = "1.5"\n')
    scaled = load_scenario(sheet)
    found = demand_as_vehicles(scaled)
    assert "scale" not in found.settings.sumo
    number = 61 if kind == "vehicles" else 60  # SUMO makes 61 and 60, too
    assert sum(found.routes[0].read().count(x) for x in (b"<vehicle ", b"<flow ")) == number
    names = [tag.attributes["id"] for tag in found.routes[0].scan() if tag.name == "vehicle"]
    assert len(set(names)) == number
    assert len(list(driven_routes(scaled))) == number
    flows = counted_flows_vph(plain)
    more = number / 40
    assert counted_flows_vph(scaled) == pytest.approx({turn: more * x for turn, x in flows.items()})
    assert check(sheet).vehicles == (number if kind == "vehicles" else 0)
    busiest = (survey(plain).busiest, survey(scaled).busiest)
    assert busiest == (40, number)
    days = [draw_day(scaled, seed).routes[0].read().count(b"<vehicle ") for seed in range(30)]
    assert sum(days) / 30 == pytest.approx(60, abs=3 * (60 / 30) ** 0.5)


def test_an_episode_need_not_know_what_comes_long_after_it(crossing: Crossing) -> None:
    """A mistake a day later: `scenario check` says so, an environment drives until then."""
    late = '<vehicle id="late" depart="86400"><route edges="W_C C_X"/></vehicle>'
    soon = car("a", 10) + car("b", 2000)
    scenario = load_scenario(crossing(vehicles=soon + late))
    network = Network.read(scenario)
    assert check_demand(scenario, network, whole=False).vehicles == 1
    with pytest.raises(ScenarioError, match="C_X"):
        check_demand(scenario, network)
    scenario = load_scenario(crossing(vehicles=car("a", 10) + late.replace("86400", "500")))
    with pytest.raises(ScenarioError, match="C_X"):  # SUMO reads so far ahead
        check_demand(scenario, network, whole=False)


@pytest.mark.slow
def test_a_long_file_is_never_in_memory(crossing: Crossing) -> None:
    """20 MB of vehicles: counted, looked at and hashed in a few MB."""
    line = '<vehicle id="v{0}" depart="{1:.3f}"><route edges="W_C C_E"/></vehicle>' + " " * 900
    vehicles = "\n".join(line.format(i, i / 100) for i in range(20_000))
    directory = crossing(vehicles=vehicles)
    size = load_scenario(directory).routes[0].read()
    assert len(size) > 19_000_000
    del size
    scenario = load_scenario(directory)
    tracemalloc.start()
    try:
        survey(scenario)
        assert scenario.hash
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8_000_000


@pytest.mark.parametrize(
    ("vehicles", "message"),
    [
        (
            '<vehicle id="v" depart="0"><route edges="W_C C_X"/></vehicle>',
            r"<route> uses the edge 'C_X', which .*network\.net\.xml does not have; were the rout",
        ),
        ('<trip id="v" depart="0" from="W_C" to="C_X"/>', "<trip id='v'> uses the edge 'C_X'"),
        ('<trip id="v" depart="0" from="X" to="C_E"/>', "<trip id='v'> uses the edge 'X'"),
        ('<route id="r" edges="W_C C_E X"/>', "<route id='r'> uses the edge 'X'"),
        (
            '<flow id="v" begin="0" end="9" number="2" from="W_C" to="C_E" via="X"/>',
            "<flow id='v'> uses the edge 'X'",
        ),
        (car("v", "soon"), "depart='soon' of <vehicle id='v'> is not a time; give seconds or h:m"),
        ('<vehicle id="v" route="east"/>', "depart='' of <vehicle id='v'> is not a time"),
        ('<flow id="v" begin="x" route="east"/>', "begin='x' of <flow id='v'> is not a time"),
        ("", r"no vehicle departs between 0 s and 200 s; check begin_s and duration_s"),
        (car("v", 200), "no vehicle departs between 0 s and 200 s"),
        (
            car("a", 50) + car("b", 20),
            "<vehicle id='b'> departs at 20 s but stands after one of 50 s, and SUMO would leave",
        ),
        (
            car("a", 50) + '<flow id="b" begin="0" end="90" period="5" route="east"/>',
            "<flow id='b'> departs at 0 s but stands after one of 50 s",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused(vehicles: str, message: str, crossing: Crossing) -> None:
    with pytest.raises(ScenarioError, match=rf"demand\.rou\.xml(, line \d+)?: {message}"):
        check(crossing(vehicles=vehicles))


def test_sumo_does_leave_out_what_is_not_sorted(crossing: Crossing) -> None:
    """The reason for the rule: SUMO warns, and the suite runs it without warnings."""
    directory = crossing(vehicles=car("a", 50) + car("b", 20) + car("c", 60))
    files = ["-n", str(directory / "network.net.xml"), "-r", str(directory / "demand.rou.xml")]
    libsumo.start(["sumo", *files, "--no-warnings", "--no-step-log"])
    try:
        libsumo.simulation.step(100)
        assert set(libsumo.vehicle.getIDList()) == {"a", "c"}
    finally:
        libsumo.close()


@pytest.mark.parametrize(
    "earlier",
    [
        '<person id="p" depart="100"><walk edges="S_C C_N"/></person>',
        '<personFlow id="p" begin="100" end="101" number="1"><walk edges="S_C C_N"/></personFlow>',
        '<container id="c" depart="100"><transport to="C_N" lines="x"/></container>',
    ],
)
def test_people_stand_in_the_order_of_vehicles(earlier: str, crossing: Crossing) -> None:
    """SUMO leaves out vehicles behind a later person, as it does behind a later vehicle."""
    scenario = load_scenario(crossing(vehicles=car("a", 0) + earlier + car("b", 50)))
    with pytest.raises(ScenarioError, match=r"'b'> departs at 50 s but stands after one of 100"):
        check_demand(scenario, Network.read(scenario))
    scenario = load_scenario(crossing(vehicles=car("a", 0) + earlier + car("b", 150)))
    assert check_demand(scenario, Network.read(scenario)).vehicles == 2


def test_a_route_of_a_vehicle_may_have_an_id(crossing: Crossing) -> None:
    named = car("a", 10).replace("<route ", '<route id="own" ')
    scenario = load_scenario(crossing(vehicles=named))
    demand = check_demand(scenario, Network.read(scenario))
    assert demand.vehicles == len(list(departures(scenario, routed=demand.routed))) == 1


def test_trips_between_junctions_are_routed_where_sumo_drives_them(crossing: Crossing) -> None:
    trips = "".join(
        f'<trip id="t{n}" depart="{n}" fromJunction="S" toJunction="N"/>' for n in range(5)
    )
    scenario = load_scenario(
        crossing(vehicles=trips, toml=lambda text: text + '[sumo]\njunction-taz = "true"\n')
    )
    assert len(list(departures(scenario, routed=False))) == 5


def test_additional_files_are_read_whole_and_need_no_order(crossing: Crossing) -> None:
    directory = crossing(vehicles="", toml=lambda text: 'additional = ["more.add.xml"]\n' + text)
    more = '<additional><route id="r" edges="W_C C_E"/>{}</additional>'
    cars = (car("a", 50) + car("b", 20)).replace(' type="car"', "").replace("east", "r")
    (directory / "more.add.xml").write_text(more.format(cars))
    assert check(directory) == Demand(vehicles=2, flows=0)


@pytest.mark.parametrize("name", [name for name, _ in shipped_scenarios()])
def test_shipped_demand_can_be_driven(name: str) -> None:
    scenario = load_scenario(name)
    demand = check_demand(scenario, Network.read(scenario))
    assert demand.flows == 0  # written out vehicle by vehicle
    assert demand.vehicles > 1500


def test_flows_of_calibrators_are_no_demand() -> None:
    scenario = load_scenario("single-v1")
    calibrator = (
        '<additional><calibrator id="c" lane="east1_A1_0" pos="10"><flow begin="0" end="3600" '
        'vehsPerHour="200" route="r" type="car"/></calibrator></additional>'
    )
    more = replace(scenario, additional=(Document("c.add.xml", None, calibrator.encode()),))
    network = Network.read(scenario)
    assert check_demand(more, network) == check_demand(scenario, network)
