"""Vehicles and their routes are those that SUMO drives."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import sumo

from ugat_marl.effects import load_scenario
from ugat_marl.files import Document, Tag
from ugat_marl.scenarios import Scenario, demand_as_vehicles
from ugat_marl.scenarios.routes import OwnEdges, departures, driven_routes, scaled_number

Crossing = Callable[..., Path]

DETOUR = ("west1_A1", "A1_A2", "A2_B2", "B2_B1", "B1_east1")

OWN = ("vehicle", "route")


def read(*names: str) -> OwnEdges:
    found = OwnEdges()
    for name in names:
        name, _, attribute = name.partition("@")
        found.read(Tag(name, {attribute: "x"} if attribute else {}, 1))
    return found


@pytest.mark.parametrize(
    ("names", "lost", "holds"),
    [
        ((), False, True),
        (OWN, False, True),
        ((*OWN, *OWN), False, True),
        (("vType", "vehicle", "param", "route"), False, True),
        (("vehicle",), False, False),
        (("vehicle", "vehicle", "route"), True, False),
        (("vehicle@route",), True, False),
        ((*OWN, "trip"), True, False),
        (("flow", *OWN), True, False),
        ((*OWN, "routeDistribution"), True, False),
    ],
)
def test_single_vehicles_with_their_own_edges(
    names: tuple[str, ...], lost: bool, holds: bool
) -> None:
    found = read(*names)
    assert found.lost is lost
    assert found.ended() is holds


def on_grid(demand: str) -> Scenario:
    """Return the grid of four lights with other vehicles."""
    scenario = load_scenario("grid2x2-v1")
    return replace(scenario, routes=(scenario.routes[0].edited(demand.encode()),))


def test_routes_of_the_file_are_kept_where_a_shorter_one_exists() -> None:
    detour = " ".join(DETOUR)
    scenario = on_grid(
        f'<routes><route id="round" edges="{detour}"/>'
        '<flow id="a" route="round" begin="0" end="100" number="20"/>'
        f'<vehicle id="b" depart="100"><route edges="{detour}"/></vehicle>'
        '<trip id="c" depart="200" from="west1_A1" to="B1_east1"/></routes>'
    )
    routes = Counter(tuple(edges) for _, _, edges in departures(scenario, routed=False))
    assert routes == {DETOUR: 21, ("west1_A1", "A1_B1", "B1_east1"): 1}


@pytest.mark.parametrize("named", [False, True])
def test_laps_of_a_repeated_route_count(named: bool) -> None:
    laps = "A1_A2 A2_B2 B2_B1 B1_A1"
    own = f'<route edges="{laps}" repeat="2"/>'
    vehicle = f'<vehicle id="a" depart="0">{own}</vehicle>'
    if named:
        route = own.replace("<route", '<route id="laps"')
        vehicle = f'{route}<vehicle id="a" depart="0" route="laps"/>'
    scenario = on_grid(f"<routes>{vehicle}</routes>")
    ((_, _, edges),) = departures(scenario, routed=not named)
    assert edges == 3 * laps.split()


@pytest.mark.parametrize("scale", [0.333, 0.5, 0.7, 1.3, 1.57, 2.0, 2.5])
@pytest.mark.parametrize("kind", ["vehicles", "flow"])
def test_copies_of_vehicles_are_those_of_sumo(
    kind: str, scale: float, crossing: Crossing, tmp_path: Path
) -> None:
    demand = "".join(
        f'<vehicle id="{n}" depart="{n}"><route edges="S_C C_N"/></vehicle>' for n in range(90)
    )
    if kind == "flow":
        demand = '<flow id="f" begin="0" end="90" period="1" from="S_C" to="C_N"/>'
    scenario = load_scenario(crossing(vehicles=demand))
    options = {"scale": str(scale)}
    settings = scenario.settings.model_copy(update={"sumo": options, "duration_s": 90.0})
    ours = demand_as_vehicles(replace(scenario, settings=settings))
    report = tmp_path / "vehicles.xml"
    subprocess.run(
        [
            str(Path(sumo.SUMO_HOME) / "bin" / "sumo"), "--no-step-log", "--no-warnings",
            "--net-file", str(scenario.network.path), "--route-files", str(scenario.routes[0].path),
            "--scale", str(scale), "--end", "2000", "--vehroute-output", str(report),
            "--vehroute-output.write-unfinished",
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    theirs = {vehicle.get("id") for vehicle in ET.parse(report).getroot().iter("vehicle")}
    root = ET.fromstring(ours.routes[0].read())
    found = {vehicle.get("id") for vehicle in root.iter("vehicle")}
    if kind == "flow":  # SUMO numbers the vehicles of flows anew
        assert len(found) == len(theirs)
    else:
        assert found == theirs and scaled_number(90, scale) == len(theirs)


def test_departures_with_a_sign_or_a_leading_point_are_times() -> None:
    scenario = on_grid(
        "<routes>"
        + "".join(
            f'<vehicle id="{n}" depart="{text}"><route edges="west1_A1 A1_B1"/></vehicle>'
            for n, text in enumerate((".5", "+1000", "+2000.5", "1:00:00"))
        )
        + "</routes>"
    )
    times = [depart for _, depart, _ in departures(scenario, routed=True)]
    assert times == [0.5, 1000.0, 2000.5]  # the last one is due when the episode ends


def test_only_vehicles_of_the_episode_drive_their_routes() -> None:
    edges = ("west1_A1 A1_B1", "A1_B1 B1_east1", "west1_A1 A1_A2", "A1_A2 A2_B2")
    vehicles = "".join(
        f'<vehicle id="{n}" depart="{99 + n}"><route edges="{way}"/></vehicle>'
        for n, way in enumerate(edges)
    )
    scenario = on_grid(f"<routes>{vehicles}</routes>")
    span = {"begin_s": 100.0, "duration_s": 2.0}
    scenario = replace(scenario, settings=scenario.settings.model_copy(update=span))
    assert list(driven_routes(scenario)) == [tuple(way.split()) for way in edges[1:3]]


def test_files_of_two_folders_may_have_one_name(tmp_path: Path) -> None:
    scenario = load_scenario("grid2x2-v1")
    documents: list[Document] = []
    for folder in ("a", "b"):
        text = f'<routes><trip id="{folder}" depart="1" from="west1_A1" to="A1_B1"/></routes>'
        path = tmp_path / folder / "r.rou.xml"
        path.parent.mkdir()
        path.write_text("<routes/>")
        documents.append(replace(Document("r.rou.xml", path), content=text.encode()))
    days = demand_as_vehicles(replace(scenario, routes=tuple(documents)))
    assert [name for name, *_ in departures(days, routed=True)] == ["a", "b"]
