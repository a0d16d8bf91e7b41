"""CityFlow's files against hand counts, and against SUMO's form of the same network."""

from __future__ import annotations

import copy
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.__main__ import main
from ugat_marl.effects import load_scenario
from ugat_marl.errors import ScenarioError
from ugat_marl.experiments import evaluation_of, rule_factory
from ugat_marl.files import xml_bytes
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Network, Scenario, read_scenario
from ugat_marl.scenarios.importers.cityflow import MOST_VEHICLES
from ugat_marl.scenarios.importers.long_files import objects


def point(x: float, y: float) -> dict[str, float]:
    return {"x": x, "y": y}


def road(name: str, a: tuple[str, float, float], b: tuple[str, float, float]) -> dict[str, Any]:
    """Two lanes, that at the middle of the road 3 m wide and the other 4 m."""
    return {
        "id": name,
        "points": [point(*a[1:]), point(*b[1:])],
        "lanes": [{"width": 3, "maxSpeed": 10}, {"width": 4, "maxSpeed": 12}],
        "startIntersection": a[0],
        "endIntersection": b[0],
    }


def link(kind: str, start: str, end: str, *lanes: tuple[int, int]) -> dict[str, Any]:
    ends = [{"startLaneIndex": a, "endLaneIndex": b, "points": []} for a, b in lanes]
    return {"type": kind, "startRoad": start, "endRoad": end, "direction": 0, "laneLinks": ends}


def end(name: str, x: float, y: float) -> dict[str, Any]:
    light = {"roadLinkIndices": [], "lightphases": []}
    return {"id": name, "point": point(x, y), "width": 0, "roads": [], "roadLinks": [],
            "trafficLight": light, "virtual": True}  # fmt: skip


def crossroads() -> dict[str, Any]:
    """Roads from west and south to east and north: straight on, and left from the south."""
    m, w, e, s, n = ("M", 0.0, 0.0), ("W", -200.0, 0.0), ("E", 200.0, 0.0), ("S", 0.0, -200.0), (
        "N", 0.0, 200.0,
    )  # fmt: skip
    roads = [
        road("wm", w, m),
        road("me", m, e),
        road("sm", s, m),
        road("mn", m, n),
        road("mw", m, w),
    ]
    links = [
        link("go_straight", "wm", "me", (0, 0), (1, 1)),
        link("go_straight", "sm", "mn", (1, 1)),
        link("turn_left", "sm", "mw", (0, 0)),
    ]
    phases = [
        {"time": 5, "availableRoadLinks": []},
        {"time": 30, "availableRoadLinks": [0]},
        {"time": 20, "availableRoadLinks": [1, 2]},
    ]
    middle = end("M", 0, 0) | {
        "width": 12, "virtual": False, "roadLinks": links,
        "trafficLight": {"roadLinkIndices": [0, 1, 2], "lightphases": phases},
    }  # fmt: skip
    ends = [end(*node) for node in (w, e, s, n)]
    return {"intersections": [middle, *ends], "roads": roads}


CAR = {
    "length": 4.5, "width": 1.9, "maxPosAcc": 3.0, "maxNegAcc": 6.0, "usualPosAcc": 2.0,
    "usualNegAcc": 4.0, "minGap": 2.0, "maxSpeed": 10.0, "headwayTime": 1.5,
}  # fmt: skip


def flow(
    route: list[str], start: float, last: float, interval: float = 5.0, **car: float
) -> dict[str, Any]:
    return {"vehicle": CAR | car, "route": route, "interval": interval, "startTime": start,
            "endTime": last}  # fmt: skip


FLOWS = [
    flow(["wm", "me"], 10, 20),
    flow(["sm", "mw"], 3, 3, length=12.0),
    flow(["sm", "mn"], 0, -1, 600),
]


def write(folder: Path, net: Any, flows: Any = None) -> list[str]:
    """The words that name the two files on the command line."""
    (folder / "roadnet.json").write_text(json.dumps(net, indent=1))
    (folder / "flow.json").write_text(json.dumps(FLOWS if flows is None else flows, indent=1))
    return ["--cityflow", str(folder / "roadnet.json"), str(folder / "flow.json")]


@pytest.fixture
def imported(tmp_path: Path) -> Scenario:
    words = write(tmp_path, crossroads())
    assert main(["scenario", "new", str(tmp_path / "city"), *words, "--duration-s", "1200"]) == 0
    return read_scenario(tmp_path / "city")


def test_lanes_keep_their_order_and_place(imported: Scenario) -> None:
    lanes = Network.read(imported).lanes
    assert set(lanes) == {f"{name}_{i}" for name in ("wm", "me", "sm", "mn", "mw") for i in (0, 1)}
    kerb, middle = (
        lanes["wm_0"],
        lanes["wm_1"],
    )  # SUMO counts from the kerb, CityFlow from the middle
    assert (kerb.speed_mps, middle.speed_mps) == (12, 10)
    assert kerb.shape[-1] == pytest.approx((-12, -5), abs=0.15)  # 3 m and half of 4 m to the right
    assert middle.shape[-1] == pytest.approx((-12, -1.5), abs=0.15)
    assert lanes["sm_1"].shape[-1] == pytest.approx((1.5, -12), abs=0.15)
    assert middle.length_m == pytest.approx(188, abs=0.5)


def test_turns_and_phases_mean_the_same(imported: Scenario) -> None:
    (item,) = Network.read(imported).intersections
    ways = [(link.from_lane, link.to_lane) for link in item.links]
    assert ways == [("wm_1", "me_1"), ("wm_0", "me_0"), ("sm_0", "mn_0"), ("sm_1", "mw_1")]
    assert item.phases == ("GGrr", "rrGG")
    assert item.programme == (
        (30, "GGrr"), (3, "yyrr"), (2, "rrrr"), (20, "rrGG"), (3, "rryy"), (2, "rrrr"),
    )  # fmt: skip


def test_vehicles_keep_their_nature(imported: Scenario) -> None:
    root = imported.routes[0].parse()
    types = {kind.get("id"): dict(kind.attrib) for kind in root.iter("vType")}
    vehicles = [
        (float(v.get("depart", "")), types[v.get("type")], v[0].get("edges"))
        for v in root.iter("vehicle")
    ]
    assert [depart for depart, *_ in vehicles] == [0, 3, 10, 15, 20, 600]  # -1: until the end
    assert [kind["length"] for _, kind, _ in vehicles] == ["4.5", "12", "4.5", "4.5", "4.5", "4.5"]
    assert vehicles[1][2] == "sm mw"
    car = vehicles[0][1]
    assert (car["accel"], car["decel"], car["maxSpeed"], car["minGap"]) == ("2", "4", "10", "2")
    assert not {"tau", "sigma", "speedFactor"} & set(car)


def test_drivers_of_cityflow_know_no_chance(tmp_path: Path) -> None:
    words = write(tmp_path, crossroads())
    assert main(["scenario", "new", str(tmp_path / "city"), *words, "--exact-drivers"]) == 0
    kind = next(read_scenario(tmp_path / "city").routes[0].parse().iter("vType"))
    assert (kind.get("sigma"), kind.get("speedDev"), kind.get("emergencyDecel")) == ("0", "0", "6")
    assert float(kind.get("tau", "")) == pytest.approx(1.5 - 2.0 / 10)  # the gap is headway x v


def test_left_turns_against_traffic_wait(tmp_path: Path) -> None:
    """Left and the opposite straight on in one phase: permitted, not protected."""
    net = crossroads()
    net["roads"] += [
        road("nm", ("N", 0, 200), ("M", 0, 0)),
        road("ms", ("M", 0, 0), ("S", 0, -200)),
    ]
    middle = net["intersections"][0]
    middle["roadLinks"].append(link("go_straight", "nm", "ms", (1, 1)))
    middle["trafficLight"]["lightphases"][2]["availableRoadLinks"] = [1, 2, 3]
    words = write(tmp_path, net)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert item.phases == ("GGrrr", "rrGgG")


def test_a_light_whose_phases_have_no_time_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    net = crossroads()
    for phase in net["intersections"][0]["trafficLight"]["lightphases"]:
        phase["time"] = 0
    assert main(["scenario", "new", str(tmp_path / "city"), *write(tmp_path, net)]) == 2
    assert "no light phase has a time above 0" in " ".join(capsys.readouterr().err.split())


def test_without_time_between_greens_some_is_put_in(tmp_path: Path) -> None:
    net = crossroads()
    del net["intersections"][0]["trafficLight"]["lightphases"][0]
    words = write(tmp_path, net)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert [seconds for seconds, _ in item.programme] == [30, 3, 2, 20, 3, 2]
    assert (
        "1 lights have no phase between two greens" in (tmp_path / "city" / "README.md").read_text()
    )


@pytest.mark.parametrize(
    ("phases", "seconds"),
    [
        ([(30, [0]), (3, []), (2, []), (30, [1, 2]), (3, []), (2, [])], [30, 3, 2, 30, 3, 2]),
        ([(30, [0]), (4, []), (30, [1, 2]), (6, [])], [30, 3, 1, 30, 3, 3]),
        ([(2, []), (30, [0]), (30, [1, 2]), (2, [])], [30, 3, 1, 30, 3, 1]),
        ([(8, [0]), (4, []), (8, [1, 2]), (4, [])], [8, 3, 1, 8, 3, 1]),
        # short greens without time between them
        ([(30, [0, 2]), (8, [0]), (10, [1])], [30, 3, 2, 8, 3, 2, 10, 3, 2]),
        ([(10, [1, 2])] * 3 + [(9, [0])], [10, 10, 10, 3, 2, 9, 3, 2]),
        # time between greens that begins before the end of the file
        ([(2, []), (30, [0]), (5, []), (30, [1, 2]), (1, []), (2, [])], [30, 3, 2, 30, 3, 2]),
        ([(30, [0, 2]), (2, [2]), (2, [2]), (30, [2]), (4, []), (30, [1])], [30, 3, 1] * 3),
    ],
)
def test_time_between_two_greens_is_that_of_the_phases_between_them(
    phases: list[tuple[float, list[int]]], seconds: list[float], tmp_path: Path
) -> None:
    net = crossroads()
    light = net["intersections"][0]["trafficLight"]
    light["lightphases"] = [{"time": s, "availableRoadLinks": links} for s, links in phases]
    assert main(["scenario", "new", str(tmp_path / "city"), *write(tmp_path, net)]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert [length for length, _ in item.programme] == seconds


@pytest.mark.parametrize("turned", [0, 1, 2])
def test_short_greens_are_found_wherever_the_cycle_begins(turned: int, tmp_path: Path) -> None:
    net = crossroads()
    phases = [(10, [0, 2]), (10, [0]), (10, [1])]
    net["intersections"][0]["trafficLight"]["lightphases"] = [
        {"time": seconds, "availableRoadLinks": links}
        for seconds, links in (*phases[turned:], *phases[:turned])
    ]
    assert main(["scenario", "new", str(tmp_path / "city"), *write(tmp_path, net)]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert sorted(item.phases) == ["GGrg", "GGrr", "rrGr"]


def test_links_with_green_on_both_sides_may_go_between_two_greens(tmp_path: Path) -> None:
    """The turn from the south has no green with the third phase, and so not always."""
    net = crossroads()
    light = net["intersections"][0]["trafficLight"]
    phases = [(30, [0, 2]), (5, [2]), (30, [1, 2]), (5, []), (30, [0]), (5, [])]
    light["lightphases"] = [{"time": s, "availableRoadLinks": links} for s, links in phases]
    assert main(["scenario", "new", str(tmp_path / "city"), *write(tmp_path, net)]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert [seconds for seconds, _ in item.programme] == [30, 3, 2, 30, 3, 2, 30]
    assert [item.programme[place][1][2:] for place in (2, 5)] == ["rs", "rr"]


@pytest.mark.parametrize(
    ("greens", "said"),
    [
        ([[0], [1, 2], [0], [1]], "the greens 0 and 2 of the file, from 0, are equal at 1 light"),
        ([[0], [1, 2], [0], [1, 2]], "the greens 0 and 2, 1 and 3 of the file, from 0, are equal"),
        ([[0], [1, 2], [1]], ""),
    ],
)
def test_equal_greens_of_a_light_are_told(
    greens: list[list[int]], said: str, tmp_path: Path
) -> None:
    net = crossroads()
    light = net["intersections"][0]["trafficLight"]
    light["lightphases"] = [{"time": 30, "availableRoadLinks": links} for links in greens]
    assert main(["scenario", "new", str(tmp_path / "city"), *write(tmp_path, net)]) == 0
    (item,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert len(item.phases) == len({*map(tuple, greens)})
    text = (tmp_path / "city" / "README.md").read_text()
    assert said in text and ("are equal at 1 light ('M')" in text) == bool(said)


def test_roads_between_anchors_are_found(tmp_path: Path) -> None:
    """CityFlow allows routes that name only some of their roads."""
    net = crossroads()
    net["roads"].append(road("ex", ("E", 200, 0), ("X", 400, 0)))
    net["intersections"].append(end("X", 400, 0))
    east = next(item for item in net["intersections"] if item["id"] == "E")
    east |= {"virtual": False, "roadLinks": [link("go_straight", "me", "ex", (0, 0), (1, 1))]}
    words = write(tmp_path, net, [flow(["wm", "ex"], 0, 0)])
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    root = read_scenario(tmp_path / "city").routes[0].parse()
    assert [route.get("edges") for route in root.iter("route")] == ["wm me ex"]


LIGHT = ("intersections", 0, "trafficLight", "lightphases")


def changed(*path: Any, to: Any) -> dict[str, Any]:
    net = copy.deepcopy(crossroads())
    place: Any = net
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return net


@pytest.mark.parametrize(
    ("net", "says"),
    [
        (changed("roads", 0, "endIntersection", to="Z"),
         "roadnet.json, line 148: road 'wm': its endIntersection 'Z' does not exist"),
        (changed("roads", 0, "lanes", to=[]), "road 'wm': needs at least two points and one lane"),
        (changed("roads", 0, "points", 0, "x", to=float("nan")), "road 'wm': x = nan must be"),
        (changed("roads", 1, "id", to="wm"), "two roads are called 'wm'"),
        (changed("intersections", 0, "roadLinks", 0, "startRoad", to="zz"),
         "roadLink 0: startRoad 'zz' does not exist"),
        (changed("intersections", 0, "roadLinks", 0, "endRoad", to="wm"), "do not meet there"),
        (changed("intersections", 0, "roadLinks", 1, "laneLinks", 0, "startLaneIndex", to=2),
         "roadLink 1 names lane 2 of 'sm' (2 lanes)"),
        (changed(*LIGHT, 1, "availableRoadLinks", to=[7]),
         "light phase 1 names road link 7, but there are 3"),
        (changed(*LIGHT, 1, "time", to="long"),
         "'time' is missing or not a number"),
        (changed("intersections", 0, "point", to=None), "a point is None, not an object"),
        (changed("intersections", 0, "trafficLight", to=1.5), "trafficLight is 1.5, not an object"),
        ([], "the file is [], not an object in braces"),
        ({"roads": []}, "'intersections' is missing or not a list"),
    ],
)  # fmt: skip
def test_a_roadnet_that_is_wrong(
    net: Any, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = write(tmp_path, net)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert not (tmp_path / "city").exists()


@pytest.mark.parametrize(
    ("flows", "says"),
    [
        ([flow(["wm", "zz"], 0, 0)], "flow.json, line 2: flow 0: road 'zz' does not exist"),
        ([FLOWS[0], flow(["wm", "mn"], 0, 0)], "flow 1: no road link leads from 'wm' on to 'mn'"),
        ([flow([], 0, 0)], "'route' is missing or not a list of roads"),
        ([flow(["wm"], 9, 3)], "endTime (3) is before startTime (9)"),
        ([flow(["wm"], 0, 9, 0)], "interval = 0 must be above 0"),
        ([flow(["wm"], 0, 9e9, 1)], f"more than {MOST_VEHICLES} vehicles"),
        ([flow(["wm"], 0, 9, 1e-308)], f"more than {MOST_VEHICLES} vehicles"),
        ([flow(["wm"], 0, 0, maxSpeed=0)], "maxSpeed = 0 must be above 0"),
        ([flow(["wm"], 0, -1), flow(["wm"], 0, 1e999)], "'endTime' is missing or not a number"),
        ([{"route": ["wm"]}], "'vehicle' is missing"),
        ([7], "an object in braces was expected"),
        ({}, "a list of vehicles begins with ["),
        ([], "no vehicle in it"),
    ],
)
def test_flows_that_are_wrong(
    flows: Any, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = write(tmp_path, crossroads(), flows)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "city").exists()


@pytest.mark.parametrize("name", ["roadnet.json", "flow.json"])
def test_files_cut_short(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write(tmp_path, crossroads())
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text[: len(text) // 2])
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    error = capsys.readouterr().err
    assert f"{name}, line " in error
    assert "not valid JSON" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flow.json", "roadnet.json"]


@pytest.mark.parametrize(
    ("text", "says", "roadnet_says"),
    [
        ("[" * 200_000, "line 1: nested too deeply", "more than 64 tables or lists inside"),
        ('[\n{"a": ' + "[" * 200_000, "line 2: nested too deeply", "more than 64 tables or lists"),
        ('[\n{"a": ' + "9" * 10_000 + "}]", "line 2: a number is far too long", "a number is far"),
    ],
)
def test_flows_no_reader_takes(
    text: str, says: str, roadnet_says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = write(tmp_path, crossroads())
    (tmp_path / "flow.json").write_text(text)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    assert f"flow.json, {says}" in capsys.readouterr().err
    (tmp_path / "roadnet.json").write_text(text.replace("\n", ""))
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    assert f"roadnet.json: {roadnet_says}" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flow.json", "roadnet.json"]


@pytest.mark.parametrize("piece", [1, 7, 1 << 20])
def test_flows_are_read_piece_by_piece(
    piece: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ugat_marl.files._PIECE", piece)
    path = tmp_path / "f.json"
    path.write_text(' \n[\n{"a": [1,\n"ü]}"]} ,\n\n{"b": -1.5e3}\n, {}]', encoding="utf-8")
    found = [({"a": [1, "ü]}"]}, 3), ({"b": -1500.0}, 6), ({}, 7)]
    assert list(objects(path, Silent())) == found
    path.write_text('[{"a": 1},\n{"b": \n2')
    with pytest.raises(ScenarioError, match=r"f\.json, line 3: not valid JSON"):
        list(objects(path, Silent()))


# --- Hangzhou in both forms -----------------------------------------------------------------------


def both(folder: Path, tmp_path: Path) -> tuple[Scenario, Scenario]:
    """The imported CityFlow form, and SUMO's."""
    target = tmp_path / "city"
    words = [str(folder / "roadnet.json"), str(folder / "flow.json")]
    assert main(["scenario", "new", str(target), "--cityflow", *words]) == 0
    (configuration,) = folder.glob("*.sumocfg")
    return read_scenario(target), load_scenario(str(configuration))


@pytest.mark.parametrize("name", ["hangzhou_1x1", "hangzhou_4x4"])
def test_hangzhou_lanes_and_phases_mean_the_same(name: str, hangzhou: Path, tmp_path: Path) -> None:
    ours, theirs = (Network.read(scenario) for scenario in both(hangzhou / name, tmp_path))
    assert set(ours.lanes) == set(theirs.lanes)
    for lane in ours.lanes:
        assert ours.lanes[lane].length_m == pytest.approx(theirs.lanes[lane].length_m, abs=4)
    for a, b in zip(ours.intersections, theirs.intersections, strict=True):
        assert a.id == b.id
        assert len(a.phases) == len(b.phases) == 8
        for mine, other in zip(a.phases, b.phases, strict=True):
            greens = [
                {(k.from_lane, k.to_lane) for k in item.links if phase[k.index] in "Gg"}
                for item, phase in ((a, mine), (b, other))
            ]
            assert greens[0] == greens[1]


def with_their_type(scenario: Scenario) -> Scenario:
    """SUMO's form, in which no vehicle has the type that its file defines, with that type."""
    (document,) = scenario.routes
    root = document.parse()
    (kind,) = root.iter("vType")
    for vehicle in root.iter("vehicle"):
        vehicle.set("type", kind.get("id", ""))
    return replace(scenario, routes=(document.edited(xml_bytes(root)),))


@pytest.mark.slow
def test_hangzhou_travel_times_agree(hangzhou: Path, tmp_path: Path) -> None:
    """Under the same fixed programme, within 3 %; both are far from free flow (54 s)."""
    ours, theirs = both(hangzhou / "hangzhou_1x1", tmp_path)
    att_s = [
        evaluation_of(form, {"fixed": rule_factory("fixed-time:30")}, ("sim",), (0, 1))
        .values("fixed", "sim", "att_s")
        .mean()
        for form in (ours, with_their_type(theirs))
    ]
    assert att_s[0] == pytest.approx(att_s[1], rel=0.03)
    assert att_s[0] > 100


def test_a_flow_without_an_end_lasts_as_long_as_the_episode_of_the_others(tmp_path: Path) -> None:
    flows = [flow(["wm", "me"], 0, 7000, 10.0), flow(["sm", "mn"], 0, -1, 10.0)]
    words = write(tmp_path, crossroads(), flows)
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    scenario = read_scenario(tmp_path / "city")
    assert scenario.settings.duration_s == 7200.0
    routes = ET.parse(tmp_path / "city" / "demand.rou.xml").getroot()
    last_s = {
        vehicle.get("id", "").split(".")[0]: float(vehicle.get("depart", "0"))
        for vehicle in routes.iter("vehicle")
    }
    assert last_s == {"0": 7000.0, "1": 6990.0}


def test_a_flow_without_an_end_lasts_to_the_end_of_a_later_episode(tmp_path: Path) -> None:
    words = write(tmp_path, crossroads(), [flow(["wm", "me"], 0, -1, 10.0)])
    for name, more, length_s in (("a", ("--duration-s", "600"), 600.0), ("b", (), 3600.0)):
        city = str(tmp_path / name)
        assert main(["scenario", "new", city, *words, "--begin-s", "1800", *more]) == 0
        scenario = read_scenario(city)
        assert scenario.settings.duration_s == length_s
        departs = [float(v.get("depart", "0")) for v in scenario.routes[0].parse().iter("vehicle")]
        assert max(departs) == 1800.0 + length_s - 10.0
