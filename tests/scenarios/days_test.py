"""Days that are drawn from a demand: equal for a seed, and varied from day to day on request."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.errors import ScenarioError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Document, Scenario, demand_as_vehicles, draw_day, read_scenario
from ugat_marl.scenarios.speed_factors import SpeedFactors


def vehicles(share: float, seed: int) -> int:
    day = draw_day(load_scenario("single-v1").with_duration(600), seed, share)
    return day.routes[0].read().count(b"<vehicle ")


def test_a_day_without_variation_is_the_day_it_was() -> None:
    scenario = load_scenario("single-v1").with_duration(600)
    assert draw_day(scenario, 3).routes[0].read() == draw_day(scenario, 3, 0.0).routes[0].read()


def test_days_vary_by_the_share_that_is_asked_for() -> None:
    steady = np.array([vehicles(0.0, seed) for seed in range(40)], np.float64)
    varied = np.array([vehicles(0.2, seed) for seed in range(40)], np.float64)
    mean = steady.mean()
    assert steady.var() == pytest.approx(mean, rel=0.7)
    # the standard error of a standard deviation of 40 days is 11 %
    assert (varied.var() - mean) ** 0.5 / mean == pytest.approx(0.2, rel=0.35)
    assert varied.mean() == pytest.approx(mean, rel=0.1)


def departures(scenario: Scenario) -> np.ndarray:
    text = b"".join(document.read() for document in scenario.routes)
    return np.array([float(time) for time in re.findall(rb' depart="([\d.]+)"', text)])


def with_vehicles(scenario: Scenario, kept: np.ndarray) -> Scenario:
    """Return the scenario with those of its vehicles that are chosen."""
    root = scenario.routes[0].parse()
    for vehicle, keep in zip(root.findall("vehicle"), kept.tolist(), strict=True):
        if not keep:
            root.remove(vehicle)
    return replace(scenario, routes=(Document("chosen.rou.xml", None, xml_bytes(root)),))


def test_vehicles_that_depart_before_the_begin_are_in_no_day() -> None:
    whole = load_scenario("single-v1")
    settings = whole.settings.model_copy(update={"begin_s": 1800.0, "duration_s": 1800.0})
    scenario = replace(whole, settings=settings)
    depart = departures(scenario)
    expected = np.count_nonzero(depart >= 1800)
    assert 100 < expected < len(depart) - 100
    days = [departures(draw_day(scenario, seed)) for seed in range(16)]
    assert min(day.min() for day in days) >= 1800
    mean = np.mean([np.count_nonzero(day < 3600) for day in days])
    assert abs(mean - expected) < 3 * (expected / len(days)) ** 0.5  # Poisson


def test_vehicles_that_depart_after_the_end_come_into_no_day() -> None:
    whole = load_scenario("single-v1")
    scenario = whole.with_duration(600)  # the demand goes on, and it rises
    depart = departures(scenario)
    expected = np.count_nonzero(depart < 600)
    days = [departures(draw_day(scenario, seed)) for seed in range(40)]
    mean = np.mean([np.count_nonzero(day < 600) for day in days])
    assert abs(mean - expected) < 2 * (expected / len(days)) ** 0.5  # Poisson
    after = np.mean([np.count_nonzero(day >= 600) for day in days])
    assert after == pytest.approx(np.count_nonzero(depart >= 600), rel=0.02)


def test_shifts_are_mirrored_at_the_begin_and_the_end() -> None:
    whole = load_scenario("single-v1")
    due = departures(whole)
    settings = whole.settings.model_copy(update={"begin_s": 600.0, "duration_s": 120.0})
    after_begin = with_vehicles(replace(whole, settings=settings), (due >= 600) & (due < 720))
    before_end = with_vehicles(whole.with_duration(600), (due >= 480) & (due < 600))
    for seed in range(40):
        departs = departures(draw_day(after_begin, seed))
        assert departs.min() >= 600
        assert np.count_nonzero(departs == 600) <= 1
        assert departures(draw_day(before_end, seed)).max() < 600


PERSONS = """
    <person id="one" depart="15"><walk edges="S_C"/></person>
    <personFlow id="many" begin="20" end="100" number="4"><walk edges="S_C"/></personFlow>
"""
CAR = '<vehicle id="v{}" depart="{}" type="{}"><route edges="S_C C_N"/></vehicle>'


def with_additional(crossing: Callable[..., Path], additional: str, vehicles: str) -> Scenario:
    path = crossing(vehicles=vehicles, toml=lambda text: f'additional = ["x.add.xml"]\n{text}')
    (path / "x.add.xml").write_text(f"<additional>{additional}</additional>")
    return read_scenario(path)


def tags(scenario: Scenario) -> list[str]:
    """Return elements that are not vehicles, with their ids, in all files but the network."""
    return sorted(
        f"{tag.name} {tag.attributes.get('id', '')}"
        for document in (*scenario.routes, *scenario.additional)
        for tag in document.scan()
        if tag.parent and tag.name not in ("vehicle", "trip", "flow", "walk")
        and (tag.name != "route" or "id" in tag.attributes)
    )  # fmt: skip


def vehicle_ids(scenario: Scenario) -> list[str]:
    """Return the ids of all vehicles in the route files."""
    return [x.get("id", "") for file in scenario.routes for x in file.parse().iter("vehicle")]


@pytest.mark.parametrize(
    "demand",
    [
        "".join(CAR.format(n, 10 * n, "mix") for n in range(9)),
        '<flow id="f" begin="0" end="100" number="5" type="mix" from="S_C" to="C_N"/>',
        '<trip id="t" depart="3" type="car" from="S_C" to="C_N"/>',
    ],
    ids=["vehicles", "flow", "trip"],
)
def test_a_drawn_day_keeps_all_that_is_not_a_vehicle(
    crossing: Callable[..., Path], demand: str
) -> None:
    types = """
        <vType id="slow" maxSpeed="5"/>
        <vTypeDistribution id="mix"><vType id="a" probability="0.5"/>
            <vType id="b" probability="0.5"/></vTypeDistribution>
        <rerouter id="closed" edges="S_C"><interval begin="0" end="9">
            <closingLaneReroute id="S_C_0" disallow="bus"/></interval></rerouter>
    """
    scenario = with_additional(crossing, types, demand + PERSONS)
    for derived in (demand_as_vehicles(scenario), draw_day(scenario, 1), draw_day(scenario, 2)):
        assert tags(derived) == tags(scenario)


@pytest.mark.slow
def test_demand_in_additional_files_is_drawn_and_counted_once(
    crossing: Callable[..., Path],
) -> None:
    beside = '<flow id="h" begin="0" end="180" number="20" from="S_C" to="C_N"/>'
    single = CAR.format(0, 10, "car")
    for demand, expected in ((single, 21), ('<flow id="f" route="north" number="5"/>', 25)):
        demand = demand.replace('number="5"', 'begin="0" end="100" number="5"')
        scenario = with_additional(crossing, beside, demand)
        routed = demand_as_vehicles(scenario)
        files = (*routed.routes, *routed.additional)
        texts = b"".join(document.read() for document in files)
        assert texts.count(b"<vehicle ") == expected
        assert b"<flow " not in texts
        days = [draw_day(scenario, seed) for seed in range(30)]
        assert all(b"<flow" not in x.read() for day in days for x in day.additional)
        mean = np.mean([day.routes[0].read().count(b"<vehicle ") for day in days])
        assert abs(mean - expected) < 3 * (expected / len(days)) ** 0.5


def test_vehicles_that_block_a_lane_are_the_same_on_every_day(
    crossing: Callable[..., Path],
) -> None:
    blocker = CAR.format(0, 10, "closure.S_C_0").replace('"v0"', '"closure.S_C_0.0"')
    scenario = with_additional(crossing, "", blocker + CAR.format(1, 20, "car"))
    days = [draw_day(scenario, seed) for seed in range(8)]
    blocked = [b"".join(x.read() for x in day.routes) for day in days]
    assert all(text.count(b'"closure.S_C_0.0" depart="10"') == 1 for text in blocked)


def test_stops_move_with_the_departure(crossing: Callable[..., Path]) -> None:
    bus = CAR.format(0, 60, "car").replace(
        "/></vehicle>", '/><stop lane="S_C_0" endPos="100" duration="9" until="150"/></vehicle>'
    )
    scenario = with_additional(crossing, "", bus)
    buses = [x for seed in range(9) for x in draw_day(scenario, seed).routes[0].parse()]
    assert len(buses) >= 3
    for drawn in buses:
        (stop,) = drawn.findall("stop")
        waits = float(stop.get("until", "")) - float(drawn.get("depart", ""))
        assert waits == pytest.approx(90, abs=0.011)  # departures are rounded
        assert stop.get("duration") == "9"
    assert len({drawn.get("depart") for drawn in buses}) == len(buses)
    wrong = with_additional(crossing, "", bus.replace("150", "soon"))
    with pytest.raises(ScenarioError, match="vehicle 'v0': 'soon' of a stop is not a time"):
        [draw_day(wrong, seed) for seed in range(9)]


@pytest.mark.parametrize("beside", [False, True], ids=["routes", "additional"])
@pytest.mark.parametrize("lines", ["v0", "7 8"])
def test_vehicles_that_a_ride_names_keep_their_names(
    lines: str, beside: bool, crossing: Callable[..., Path]
) -> None:
    """A ride names vehicles or their lines."""
    rider = f'<person id="p" depart="0"><ride from="S_C" to="C_N" lines="{lines}"/></person>'
    cars = CAR.format(0, 10, 'car" line="8') + CAR.format(1, 20, 'car" line="9')
    scenario = with_additional(crossing, rider * beside, rider * (not beside) + cars)
    for seed in range(8):
        names = [name for name in vehicle_ids(draw_day(scenario, seed)) if "~" not in name]
        assert names == ["v0"]


def test_additional_files_are_looked_through_once_for_all_days(
    crossing: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = with_additional(
        crossing, '<vType id="slow" maxSpeed="5"/>', CAR.format(0, 10, "car")
    )
    draw_day(scenario, 0)
    monkeypatch.delattr(Document, "scan")
    draw_day(scenario, 1)


def test_drivers_without_a_type_follow_a_default_type_of_an_additional_file(
    crossing: Callable[..., Path],
) -> None:
    default = '<vType id="DEFAULT_VEHTYPE" speedFactor="0.5" speedDev="0"/>'
    cars = "".join(CAR.format(n, n, "car").replace(' type="car"', "") for n in range(9))
    day = draw_day(with_additional(crossing, default, cars), 1)
    factors = re.findall(rb'speedFactor="([\d.]+)"', day.routes[0].read())
    assert factors
    assert {float(factor) for factor in factors} == {0.5}


SPEEDS = {
    'speedFactor="1.2"': (1.2, 0.1),
    'speedFactor="1.2" vClass="truck"': (1.2, 0.05),
    'vClass="bus"': (1.0, 0.0),
    'speedFactor="normc(1,0.3)"': (1.0, 0.3),
    'speedFactor="normc(1,0.6)"': (1.0627, 0.5416),  # drawn again below 0
    'speedFactor="normc(1,0.6,0.5)"': (1.2120, 0.4573),  # drawn again below the only limit
    'speedFactor="normc(1,0.5,0.9,1.1)"': (1.0, 0.0573),  # drawn again beyond a limit
    'speedFactor="normc(1.1,0.2,0.5,1.5)" speedDev="0.03"': (1.1, 0.03),
}


@pytest.mark.parametrize("option", [None, 0.2])
@pytest.mark.parametrize("text", SPEEDS)
def test_drivers_are_drawn_from_the_distribution_that_sumo_reads(
    text: str, option: float | None, crossing: Callable[..., Path]
) -> None:
    cars = "".join(CAR.format(n, n / 10, "own") for n in range(2000))
    settings = f'[sumo]\n"default.speeddev" = "{option}"\n'
    scenario = load_scenario(
        crossing(
            vehicles=cars,
            types=f'<vType id="own" {text}/>',
            toml=(lambda toml: toml + settings) if option is not None else None,
        )
    )
    day = draw_day(scenario, 1).routes[0].read()
    factors = np.array([float(x) for x in re.findall(rb'speedFactor="([\d.]+)"', day)])
    mean, deviation = SPEEDS[text]
    if option is not None and "norm" not in text:
        deviation = option
    assert len(factors) > 1500
    assert factors.min() > 0
    assert factors.mean() == pytest.approx(mean, abs=0.03)
    assert factors.std() == pytest.approx(deviation, rel=0.08)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("normc(1,0.1)", "normc(1,0.1)"),
        ("normc(1,0.1,0.5)", "normc(1,0.1,0.5)"),
        ("normc(1,0.1,0.5,1.5)", "normc(1,0.1,0.5,1.5)"),
        ("normc(1,0.1,-inf,1.5)", "normc(1,0.1,0,1.5)"),
    ],
)
def test_a_distribution_of_speeds_is_written_as_it_was_read(text: str, written: str) -> None:
    assert SpeedFactors.of({"speedFactor": text}, {}).text == written
