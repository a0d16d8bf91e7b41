"""`scenario new`: grids, arterials and SUMO's files, whole or not at all."""

from __future__ import annotations

import gzip
import os
import re
import shlex
import signal
import subprocess
import tracemalloc
import xml.etree.ElementTree as ET
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

import ugat_marl
from ugat_marl.__main__ import main
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import parse_xml
from ugat_marl.progress import Advance, Reporter, Silent
from ugat_marl.scenarios import (
    Network,
    check_demand,
    grid_roads,
    make_scenario,
    read_scenario,
    shipped_scenarios,
)
from ugat_marl.scenarios.importers.long_files import scan
from ugat_marl.scenarios.importers.making import VehicleFiles, new_folder
from ugat_marl.scenarios.importers.streets import Streets
from ugat_marl.scenarios.importers.turning_shares import Drive, walked, write_drives

SINGLE = dict(shipped_scenarios())["single-v1"]


def made(*words: str | Path) -> int:
    return main(["scenario", "new", *map(str, words)])


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert made(*words) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert len(err.strip().splitlines()) == 1
    return err


def left_over(folder: Path) -> list[str]:
    """What lies in a folder, hidden files too."""
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("words", "agents", "lanes"),
    [
        (["--grid", "2x3"], 6, 8),
        (["--grid", "1x1"], 1, 8),
        (["--arterial", "3"], 3, 10),
    ],
)
def test_regular_networks(words: list[str], agents: int, lanes: int, tmp_path: Path) -> None:
    target = tmp_path / "city"
    assert made(target, *words, "--vph", "200", "--duration-s", "600") == 0
    scenario = read_scenario(target)
    network = Network.read(scenario)
    assert [len(item.phases) for item in network.intersections] == [8] * agents
    assert {len(item.incoming_lanes) for item in network.intersections} == {lanes}
    assert scenario.settings.duration_s == 600
    assert left_over(tmp_path) == ["city"]
    text = (target / "README.md").read_text()
    assert shlex.join(["ugat-marl", "scenario", "new", str(target), *words]) in text
    assert "## Origin" in text


def test_rows_and_columns_are_told_apart(tmp_path: Path) -> None:
    assert made(tmp_path / "a", "--grid", "2x3", "--vph", "100") == 0
    names = {item.id for item in Network.read(read_scenario(tmp_path / "a")).intersections}
    assert names == {"A1", "B1", "C1", "A2", "B2", "C2"}  # letters from west to east


def test_the_same_seed_makes_the_same_scenario(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert made(tmp_path / name, "--grid", "1x2", "--vph", "300", "--seed", seed) == 0
    a, b, c = (read_scenario(tmp_path / name) for name in "abc")
    assert a.hash == b.hash != c.hash


def cross(shares: tuple[float, float, float], vph: float, hours: float = 1.0) -> list[Drive]:
    root = parse_xml((SINGLE / "network.net.xml").read_bytes(), "net")
    return walked(Streets.of(root), vph, shares, 3600 * hours, 1)


def test_rates_and_shares_are_those_asked_for() -> None:
    drives = cross((0.2, 0.5, 0.3), 900, 4)
    streets = Streets.of(parse_xml((SINGLE / "network.net.xml").read_bytes(), "net"))
    assert (
        set(streets.entries) == {"north_A1", "east1_A1", "west1_A1", "south_A1"}
        or len(streets.entries) == 4
    )
    turns = Counter(
        next(t for t, roads in streets.ahead[d.route[0]].items() if d.route[1] in roads)
        for d in drives
    )
    total = sum(turns.values())
    assert total == pytest.approx(4 * 4 * 900, rel=0.03)
    assert turns["l"] / total == pytest.approx(0.2, abs=0.01)
    assert turns["r"] / total == pytest.approx(0.3, abs=0.01)
    assert [d.depart_s for d in drives] == sorted(d.depart_s for d in drives)


def test_an_entry_that_leads_out_only_past_a_junction_twice_has_vehicles() -> None:
    """From `in`, nobody may turn into `out` but on the way back from a loop."""
    streets = Streets(
        {"in": "a", "there": "b", "back": "c", "out": "b", "on": "d", "off": "e"},
        {"in": "b", "there": "c", "back": "b", "out": "x", "on": "e", "off": "y"},
        {"in": {"s": ("there",)}, "there": {"r": ("back",)}, "back": {"r": ("out",)},
         "on": {"s": ("off",)}},
        ("in", "on"), frozenset({"out", "off"}),
    )  # fmt: skip
    routes = {drive.route for drive in walked(streets, 300, (0.4, 0.2, 0.4), 600, 5)}
    assert routes == {("in", "there", "back", "out"), ("on", "off")}


def test_walks_leave_the_network_and_pass_no_junction_twice(tmp_path: Path) -> None:
    assert made(tmp_path / "a", "--grid", "3x3", "--vph", "300", "--duration-s", "600") == 0
    root = parse_xml((tmp_path / "a" / "network.net.xml").read_bytes(), "net")
    streets = Streets.of(root)
    for drive in walked(streets, 300, (0.4, 0.2, 0.4), 600, 5):
        assert drive.route[-1] in streets.exits
        passed = [streets.end[road] for road in drive.route]
        assert len(set(passed)) == len(passed)
        for a, b in zip(drive.route, drive.route[1:], strict=False):
            assert any(b in roads for roads in streets.ahead[a].values())


@pytest.mark.parametrize(
    ("closed", "ahead"),
    [
        ("", {"in": {"s": ("on",)}}),
        ("from", {}),
        ("to", {}),
        ("connection", {}),
    ],
)
def test_cars_need_both_lanes_and_the_connection(
    closed: str, ahead: dict[str, dict[str, tuple[str, ...]]]
) -> None:
    shut = dict.fromkeys((closed,), ' disallow="passenger"')
    root = ET.fromstring(
        '<net><edge id="in" from="x" to="y">'
        f'<lane id="in_0"{shut.get("from", "")}/><lane id="in_1"/></edge>'
        '<edge id="on" from="y" to="z">'
        f'<lane id="on_0"/><lane id="on_1"{shut.get("to", "")}/></edge>'
        '<connection from="in" to="on" fromLane="0" toLane="1" dir="s"'
        f"{shut.get('connection', '')}/></net>"
    )
    streets = Streets.of(root)
    assert set(streets.start) == {"in", "on"}
    assert streets.ahead == ahead
    assert streets.entries == (("in",) if ahead else ())


def test_vehicles_enter_and_leave_by_roads_in_several_pieces() -> None:
    """At the dead end N, SUMO lets vehicles turn back from `out` to the first piece, `in1`."""
    root = ET.fromstring(
        '<net><edge id="in1" from="N" to="M"><lane id="in1_0"/></edge>'
        '<edge id="in2" from="M" to="C"><lane id="in2_0"/></edge>'
        '<edge id="out" from="C" to="N"><lane id="out_0"/></edge>'
        '<edge id="on" from="C" to="S"><lane id="on_0"/></edge>'
        '<connection from="in1" to="in2" fromLane="0" toLane="0" dir="s"/>'
        '<connection from="in2" to="on" fromLane="0" toLane="0" dir="s"/>'
        '<connection from="in2" to="out" fromLane="0" toLane="0" dir="t"/>'
        '<connection from="out" to="in1" fromLane="0" toLane="0" dir="t"/></net>'
    )
    streets = Streets.of(root)
    assert streets.entries == ("in1",)
    assert streets.exits == {"out", "on"}


def test_a_hairpin_does_not_end_a_network() -> None:
    root = ET.fromstring(
        '<net><edge id="wc" from="w" to="c"><lane id="wc_0"/></edge>'
        '<edge id="cx" from="c" to="x"><lane id="cx_0"/></edge>'
        '<edge id="xb" from="x" to="b"><lane id="xb_0"/></edge>'
        '<edge id="bv" from="b" to="v"><lane id="bv_0"/></edge>'
        '<connection from="wc" to="cx" fromLane="0" toLane="0" dir="s"/>'
        '<connection from="cx" to="xb" fromLane="0" toLane="0" dir="t"/>'
        '<connection from="xb" to="bv" fromLane="0" toLane="0" dir="s"/></net>'
    )
    streets = Streets.of(root)
    assert streets.entries == ("wc",)
    assert streets.exits == {"bv"}


def test_roads_may_say_that_they_are_normal() -> None:
    root = ET.fromstring(
        '<net><edge id="in" from="x" to="y" function="normal"><lane id="in_0"/></edge>'
        '<edge id="on" from="y" to="z"><lane id="on_0"/></edge>'
        '<edge id=":y_0" function="internal"><lane id=":y_0_0"/></edge>'
        '<connection from="in" to="on" fromLane="0" toLane="0" dir="s"/></net>'
    )
    streets = Streets.of(root)
    assert set(streets.start) == {"in", "on"}
    assert streets.ahead == {"in": {"s": ("on",)}}
    assert streets.entries == ("in",)


def test_turns_nobody_asked_for_are_taken_where_there_is_no_other_way() -> None:
    streets = Streets({"a": "x", "b": "y"}, {"a": "y", "b": "z"}, {"a": {"r": ("b",)}}, ("a",),
                      frozenset({"b"}))  # fmt: skip
    (first, *_) = walked(streets, 600, (0.5, 0.5, 0.0), 600, 1)
    assert first.route == ("a", "b")


@pytest.mark.parametrize(
    ("vph", "shares"),
    [(0, (1, 1, 1)), (-1, (1, 1, 1)), (float("nan"), (1, 1, 1)), (9, (0, 0, 0)), (9, (-1, 1, 1))],
)
def test_impossible_rates_and_shares(vph: float, shares: tuple[float, float, float]) -> None:
    with pytest.raises(OptionError, match=r"--vph|--turns"):
        cross(shares, vph)


def test_a_ring_has_no_entry() -> None:
    ring = Streets({"a": "x", "b": "y"}, {"a": "y", "b": "x"}, {}, (), frozenset())
    with pytest.raises(ScenarioError, match="no road leads into the network"):
        walked(ring, 100, (1, 1, 1), 600, 1)


def test_names_are_quoted_in_route_files(tmp_path: Path) -> None:
    write_drives(tmp_path / "routes", [Drive('a"<&', 1.0, ("ü", "b"))])
    vehicle = parse_xml((tmp_path / "routes").read_bytes(), "routes").find("vehicle")
    assert vehicle is not None
    assert vehicle.get("id") == 'a"<&'
    assert ET.tostring(vehicle).count(b"route") == 1


# --- SUMO's files ---------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A network, routes and a configuration under names that need care."""
    folder = tmp_path / "Straßen, alt & neu"
    folder.mkdir()
    (folder / "Netz 1.net.xml").write_bytes((SINGLE / "network.net.xml").read_bytes())
    (folder / "cars.rou.xml").write_bytes((SINGLE / "demand.rou.xml").read_bytes())
    (folder / "loops.add.xml").write_text(
        '<additional><edgeData id="e" file="out.xml" freq="60"/></additional>'
    )
    (folder / "city.sumocfg").write_text(
        '<configuration><net-file value="Netz 1.net.xml"/><route-files value="cars.rou.xml"/>'
        '<additional-files value="loops.add.xml"/><begin value="60"/><end value="960"/>'
        '<processing><lateral-resolution value="0.8"/></processing></configuration>'
    )
    return folder


@pytest.mark.parametrize("word", ["--sumo", "--routes"])
def test_a_scenario_is_not_linked_to_files_of_the_folder_it_replaces(
    word: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a"
    assert made(folder, "--sumo", files / "city.sumocfg") == 0
    network, routes = folder / "Netz 1.net.xml", folder / "cars.rou.xml"
    sources = {"--sumo": files / "Netz 1.net.xml", "--routes": files / "cars.rou.xml"}
    sources[word] = {"--sumo": network, "--routes": routes}[word]
    words = [x for pair in sources.items() for x in pair]
    capsys.readouterr()
    assert made(folder, *words, "--link", "--force") == 2
    assert "leave out --link, or write to another folder" in capsys.readouterr().err
    assert network.is_file() and routes.is_file()


@pytest.mark.parametrize("link", [False, True])
def test_a_configuration_becomes_a_scenario(link: bool, files: Path, tmp_path: Path) -> None:
    target = tmp_path / "Łódź, Śródmieście 2"
    words = ["--link"] if link else []
    assert made(target, "--sumo", files / "city.sumocfg", *words) == 0
    scenario, origin = read_scenario(target), read_scenario(files / "city.sumocfg")
    assert scenario.hash == origin.hash
    assert scenario.settings.begin_s == 60
    assert scenario.settings.duration_s == 900
    assert scenario.settings.sumo == {"lateral-resolution": "0.8"}
    copied = {path.name for path in target.iterdir()} - {"scenario.toml", "README.md"}
    assert copied == (
        {"loops.add.xml"} if link else {"Netz 1.net.xml", "cars.rou.xml", "loops.add.xml"}
    )
    check_demand(scenario, Network.read(scenario))


@pytest.mark.parametrize(
    ("words", "episode"),
    [
        (["--begin-s", "300"], (300, 660)),
        (["--begin-s", "300", "--duration-s", "900"], (300, 900)),
        (["--begin-s", "300", "--vph", "120"], (300, 660)),
    ],
)
def test_a_configuration_keeps_its_end_under_another_begin(
    words: list[str], episode: tuple[float, float], files: Path, tmp_path: Path
) -> None:
    assert made(tmp_path / "a", "--sumo", files / "city.sumocfg", *words) == 0
    settings = read_scenario(tmp_path / "a").settings
    assert (settings.begin_s, settings.duration_s) == episode


def test_roads_of_a_grid_may_be_fast(tmp_path: Path) -> None:
    words = ["--grid", "1x2", "--vph", "100", "--speed-mps", "60"]
    assert made(tmp_path / "a", *words) == 0
    lanes = Network.read(read_scenario(tmp_path / "a")).lanes
    assert {lane.speed_mps for lane in lanes.values()} == {60.0}


def test_what_a_scenario_cannot_have_is_said(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (files / "state.xml").write_text("<snapshot/>")
    configuration = files / "city.sumocfg"
    text = configuration.read_text().replace(
        '<end value="960"/>', '<load-state value="state.xml"/>'
    )
    configuration.write_text(text.replace("<begin", '<max-num-vehicles value="10"/><begin'))
    assert made(tmp_path / "a", "--sumo", configuration) == 0
    said = " ".join("".join(capsys.readouterr()).split())
    assert "note: city.sumocfg: load-state = state.xml left out: an episode begins" in said
    assert "note: city.sumocfg: it has no end, so an episode is one hour" in said
    assert "max-num-vehicles" not in said, "it is kept"
    assert read_scenario(tmp_path / "a").settings.sumo["max-num-vehicles"] == "10"


def test_usual_times_of_signals_are_whole_steps(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration = files / "city.sumocfg"
    text = configuration.read_text().replace("<begin", '<step-length value="0.4"/><begin')
    configuration.write_text(text)
    assert made(tmp_path / "a", "--sumo", configuration) == 0
    control = read_scenario(tmp_path / "a").control
    assert (control.yellow_s, control.min_green_s) == (3.2, 5.2)
    assert (control.all_red_s, control.decision_interval_s) == (2.0, 10.0)
    assert read_scenario(configuration).control == control
    said = " ".join("".join(capsys.readouterr()).split())
    assert "do not divide the usual times of signals; yellow_s = 3.2, min_green_s = 5.2" in said


def test_such_a_scenario_is_driven(files: Path, tmp_path: Path) -> None:
    target = tmp_path / "Łódź, Śródmieście 2"
    assert made(target, "--sumo", files / "city.sumocfg") == 0
    env = ugat_marl.parallel_env(target, duration_s=60)
    observations, _ = env.reset(seed=1)
    assert set(observations) == set(env.possible_agents)
    env.close()


def test_a_network_with_routes(files: Path, tmp_path: Path) -> None:
    packed = files / "net.net.xml.gz"
    packed.write_bytes(gzip.compress((files / "Netz 1.net.xml").read_bytes()))
    words = ["--sumo", packed, "--routes", files / "cars.rou.xml", "--duration-s", "900"]
    assert made(tmp_path / "a", *words, "--phases", "conflict-free") == 0
    scenario = read_scenario(tmp_path / "a")
    assert scenario.control.phases == "conflict-free"
    assert check_demand(scenario, Network.read(scenario)).vehicles > 100


def test_other_vehicles_for_a_configuration(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration = files / "city.sumocfg"
    text = configuration.read_text().replace("<begin", '<scale value="3"/><begin')
    configuration.write_text(text)
    assert made(tmp_path / "a", "--sumo", configuration, "--vph", "120") == 0
    said = " ".join("".join(capsys.readouterr()).split())
    assert "scale = 3 left out: it is that of its own vehicles" in said
    assert "note: city.sumocfg: its vehicles are replaced, so its additional files are left" in said
    scenario = read_scenario(tmp_path / "a")
    assert scenario.additional == ()
    assert [d.name for d in scenario.routes] == ["demand.rou.xml"]
    assert scenario.settings.sumo == {"lateral-resolution": "0.8"}  # SUMO drives as it did


@pytest.mark.parametrize(
    ("words", "begin_s", "duration_s"),
    [((), 60, 900), (("--begin-s", "0"), 0, 960), (("--duration-s", "600"), 60, 600)],
)
def test_other_vehicles_drive_at_the_times_of_the_configuration(
    words: tuple[str, ...], begin_s: float, duration_s: float, files: Path, tmp_path: Path
) -> None:
    table = tmp_path / "od.csv"
    table.write_text("from,to,count\nwest1_A1,A1_east1,200\n")
    assert made(tmp_path / "a", "--sumo", files / "city.sumocfg", "--od", table, *words) == 0
    scenario = read_scenario(tmp_path / "a")
    assert (scenario.settings.begin_s, scenario.settings.duration_s) == (begin_s, duration_s)
    departs = [float(v.get("depart", "")) for v in scenario.routes[0].parse().iter("vehicle")]
    assert len(departs) == 200
    assert begin_s <= min(departs) < begin_s + 60
    assert begin_s + duration_s - 60 < max(departs) < begin_s + duration_s


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "one source of roads, not 0"),
        (["--grid", "2x2", "--arterial", "3", "--vph", "100"], "one source of roads, not 2"),
        (["--grid", "2x2", "--vph", "100", "--routes", "x.rou.xml"], "vehicles, not 2"),
        (["--grid", "2by2", "--vph", "100"], "as in 4x4"),
        (["--grid", "0x2", "--vph", "100"], "as in 4x4"),
        (["--grid", "999x999", "--vph", "100"], "at most 2500"),
        (["--arterial", "0", "--vph", "100"], "--arterial 0"),
        (["--grid", "1x1", "--vph", "100", "--spacing-m", "5"], "50 to 5000 m"),
        (["--grid", "1x1", "--vph", "100", "--speed-mps", "nan"], "1 to 60 m/s"),
        (["--grid", "1x1", "--vph", "1e9"], "above 0, up to 100000"),
        (["--grid", "1x1", "--vph", "0.001", "--duration-s", "60"], "nobody enters"),
        (
            ["--grid", "1x1", "--vph", "9999", "--duration-s", "5"],
            "--duration-s 5: an episode has",
        ),
        (["--sumo", "gone.net.xml", "--vph", "100"], "gone.net.xml: no such file"),
        (["--sumo", "gone.sumocfg"], "gone.sumocfg: no such file"),
        (["--sumo", "city.shp", "--vph", "100"], "give a .sumocfg or a .net.xml"),
        (["--grid", "1x1", "--routes", "gone.rou.xml"], "gone.rou.xml: no such file"),
    ],
)
def test_a_wrong_call_leaves_nothing(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in refused(capsys, tmp_path / "city", *words)
    assert left_over(tmp_path) == []


BOMB = (
    '<?xml version="1.0"?>\n<!DOCTYPE net [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>\n<net>&b;</net>'
)
OUTSIDE = '<!DOCTYPE net [<!ENTITY e SYSTEM "file:///etc/passwd">]><net>&e;</net>'


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (BOMB, "document types and entities are not accepted; remove them (line 2)"),
        (OUTSIDE, "document types and entities are not accepted"),
        ("<net>\n<edge id='a'", "not well-formed XML"),
        ("<routes/>", "line 1: a SUMO network begins with <net>, this with <routes>"),
        ("<net/>", "no traffic light"),
    ],
)
def test_a_network_that_is_none(
    content: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.net.xml").write_text(content)
    words = ["--sumo", tmp_path / "bad.net.xml", "--routes", SINGLE / "demand.rou.xml"]
    assert says in refused(capsys, tmp_path / "city", *words)
    assert left_over(tmp_path) == ["bad.net.xml"]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (
            '<routes>\n<trip id="t" depart="0" from="a" to="b"/></routes>',
            "cars.rou.xml, line 2: <trip",
        ),
        (
            '<routes><vehicle id="v" depart="0">\n'
            '<route edges="A1_east1 A1_west1"/></vehicle></routes>',
            "cars.rou.xml, line 2: a route goes from edge 'A1_east1' to 'A1_west1', but no conn",
        ),
        ("<routes/>", "no vehicle departs between 0 s and 3600 s"),
        ("<net/>", "a route file begins with <routes> or <additional>, this with <net>"),
        (BOMB.replace("net", "routes"), "document types and entities"),
    ],
)
def test_routes_that_cannot_be_driven(
    content: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cars.rou.xml").write_text(content)
    words = ["--sumo", SINGLE / "network.net.xml", "--routes", tmp_path / "cars.rou.xml"]
    error = refused(capsys, tmp_path / "city", *words)
    assert says in error
    assert ".new-scenario" not in error
    if "line" in says:  # the user's file, not the copy that is gone
        assert f"{tmp_path / 'cars.rou.xml'}, line 2" in error
    assert left_over(tmp_path) == ["cars.rou.xml"]


def test_errors_name_the_files_a_configuration_names(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    routes, network = files / "cars.rou.xml", files / "Netz 1.net.xml"
    sound = routes.read_text()
    routes.write_text(sound.replace("A1_east1", "A1_gone", 1))
    words = ["--sumo", files / "city.sumocfg"]
    error = refused(capsys, tmp_path / "a", *words)
    assert f"{routes}, line " in error
    assert f"which {network} does not have" in error
    routes.write_text(sound)
    network.write_text(BOMB)
    error = refused(capsys, tmp_path / "a", *words)
    assert f"{network}: document types and entities" in error
    error = refused(capsys, tmp_path / "a", *words, "--vph", "100")
    assert f"{network}: document types and entities" in error
    assert left_over(tmp_path) == [files.name]


def test_errors_name_these_files_for_a_name_without_a_folder_too(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    routes = files / "cars.rou.xml"
    routes.write_text(routes.read_text().replace("A1_east1", "A1_gone", 1))
    monkeypatch.chdir(tmp_path)
    error = refused(capsys, Path("a"), "--sumo", files / "city.sumocfg")
    assert error.startswith(f"ugat-marl: error: {routes}, line ")


def test_nothing_is_overwritten_by_accident(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--grid", "1x1", "--vph", "100", "--duration-s", "600"]
    assert made(tmp_path / "a", *words) == 0
    before = read_scenario(tmp_path / "a").hash
    assert "--force replaces it" in refused(capsys, tmp_path / "a", *words, "--seed", "9")
    assert read_scenario(tmp_path / "a").hash == before
    assert made(tmp_path / "a", *words, "--seed", "9", "--force") == 0
    assert read_scenario(tmp_path / "a").hash != before
    (tmp_path / "a" / "report.html").touch()
    error = refused(capsys, tmp_path / "a", *words, "--force")
    assert "report.html was not made with the scenario, and would be lost" in error
    (tmp_path / "a" / "report.html").unlink()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").touch()
    error = refused(capsys, tmp_path / "photos", *words, "--force")
    assert "exists and is not a scenario" in error
    assert left_over(tmp_path / "photos") == ["one.jpg"]
    assert "is the name of a scenario of the suite" in refused(capsys, "single-v1", *words)
    assert "is not a name for a scenario" in refused(capsys, "..", *words)
    assert left_over(tmp_path) == ["a", "photos"]


ONE_LIGHT = ["--grid", "1x1", "--vph", "100", "--duration-s", "600"]


def in_folders(target: Path) -> None:
    """Make a scenario with drawings, and with its network in a folder of its own."""
    assert made(target, *ONE_LIGHT) == 0
    toml = (target / "scenario.toml").read_text()
    toml = toml.replace('"network.net.xml"', '"net/network.net.xml"')
    toml = toml.replace('"demand.rou.xml"', '"./demand.rou.xml"')
    (target / "scenario.toml").write_text(toml)
    (target / "net").mkdir()
    (target / "network.net.xml").rename(target / "net" / "network.net.xml")
    (target / "pictures").mkdir()
    for drawing in ("network.svg", "A1.png", "A1-2.svg", "A1_.png"):
        (target / "pictures" / drawing).touch()


@pytest.mark.parametrize(
    "name",
    ["net/survey.xlsx", "net/network.net.xml.bak", ".notes.md", ".git/HEAD", "network.net.xml",
     "pictures/A1.jpg", "pictures/A2.png", "pictures/network-1.png"],
)  # fmt: skip
def test_files_beside_a_scenario_are_never_lost(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_folders(tmp_path / "a")
    file = tmp_path / "a" / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("other work")
    error = refused(capsys, tmp_path / "a", *ONE_LIGHT, "--force")
    said = "was not made with the scenario, and would be lost; move it away first"
    assert f"{file} {said}" in error or f"{file.parent} {said}" in error
    assert file.read_text() == "other work"


def test_all_files_of_a_scenario_are_replaced(tmp_path: Path) -> None:
    in_folders(tmp_path / "a")
    assert made(tmp_path / "a", *ONE_LIGHT, "--force") == 0
    assert left_over(tmp_path / "a") == [
        "README.md", "demand.rou.xml", "network.net.xml", "pictures", "scenario.toml",
    ]  # fmt: skip


def test_a_damaged_scenario_has_files_of_the_usual_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made(tmp_path / "a", *ONE_LIGHT) == 0
    (tmp_path / "a" / "scenario.toml").write_text("routes = 1")
    (tmp_path / "a" / "notes.md").touch()
    error = refused(capsys, tmp_path / "a", *ONE_LIGHT, "--force")
    assert "notes.md was not made with the scenario" in error
    (tmp_path / "a" / "notes.md").unlink()
    assert made(tmp_path / "a", *ONE_LIGHT, "--force") == 0


def stop_with(error: BaseException, target: Path) -> None:
    with new_folder(target, force=True) as folder:
        (folder / "half").touch()
        raise error


def test_a_failed_replacement_leaves_the_old_one(tmp_path: Path) -> None:
    assert made(tmp_path / "a", "--grid", "1x1", "--vph", "100", "--duration-s", "600") == 0
    before = read_scenario(tmp_path / "a").hash
    with pytest.raises(ScenarioError, match="stopped"):
        stop_with(ScenarioError("stopped"), tmp_path / "a")
    with pytest.raises(KeyboardInterrupt):
        stop_with(KeyboardInterrupt(), tmp_path / "b")
    assert read_scenario(tmp_path / "a").hash == before
    assert left_over(tmp_path) == ["a"]


def run_apart(
    python: list[str], tmp_path: Path, code: str, *words: str | Path
) -> subprocess.Popen[str]:
    """`scenario new` in a process of its own, after some code."""
    line = f"import sys; {code}; from ugat_marl.__main__ import main; sys.exit(main())"
    return subprocess.Popen(
        [*python, "-c", line, "scenario", "new", *map(str, words)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_full_disk_is_said_in_words(python: list[str], tmp_path: Path) -> None:
    limit = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (40000, 40000))"
    words = ["--sumo", SINGLE / "network.net.xml", "--routes", SINGLE / "demand.rou.xml"]
    process = run_apart(python, tmp_path, limit, "city", *words)
    _, err = process.communicate()
    assert process.returncode == 2
    assert re.search(r"city/\S+: cannot be written \(File too large\); make room", err), err
    assert "Traceback" not in err
    assert left_over(tmp_path) == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_whoever_stops_it_finds_nothing_left(
    number: int, code: int, python: list[str], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "cars.rou.xml")  # reading waits until somebody writes
    pipes_too = "import ugat_marl.files as f; f.refuse_endless = lambda *_: None"
    words = ["--sumo", SINGLE / "network.net.xml", "--routes", "cars.rou.xml"]
    process = run_apart(python, tmp_path, pipes_too, "city", *words)
    with (tmp_path / "cars.rou.xml").open("w") as pipe:
        pipe.write("<routes>")
        pipe.flush()
        assert len(left_over(tmp_path)) == 2, "a folder that is being filled"
        process.send_signal(number)
    _, err = process.communicate()
    assert process.returncode == code
    assert "Traceback" not in err
    assert left_over(tmp_path) == ["cars.rou.xml"]


def test_a_name_no_folder_can_have(capsys: pytest.CaptureFixture[str]) -> None:
    error = refused(capsys, "x" * 300, "--grid", "1x1", "--vph", "100")
    assert "x: cannot be written (File name too long); give another place" in error


@pytest.mark.parametrize("place", ["/proc/nowhere/city", "/dev/null/city"])
def test_a_place_that_cannot_be_written(place: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--grid", "1x1", "--vph", "100"]
    assert f"{place}: cannot be written" in refused(capsys, place, *words)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to this user")
def test_a_folder_without_permission(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tmp_path.chmod(0o555)
    try:
        error = refused(capsys, tmp_path / "a", "--grid", "1x1", "--vph", "100")
    finally:
        tmp_path.chmod(0o755)
    assert "cannot be written (Permission denied); give another place" in error


class Listening(Silent):
    """Remembers the tasks."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def task(self, name: str, total: int) -> AbstractContextManager[Advance]:
        self.heard.append(name)
        return super().task(name, total)


def test_long_files_are_read_with_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ugat_marl.progress._PATIENCE_S", -1)
    reporter = Listening()
    assert next(tag.name for tag in list(scan(SINGLE / "network.net.xml", reporter))) == "net"
    assert not reporter.heard, "less than a MiB is not long"
    (tmp_path / "long.net.xml").write_text(f"<net>{' ' * (1 << 20)}</net>")
    assert [tag.name for tag in scan(tmp_path / "long.net.xml", reporter)] == ["net"]
    assert reporter.heard == ["MiB of long.net.xml"]


def nobody(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
    (folder / "none.rou.xml").write_text("<routes/>")
    return VehicleFiles(("none.rou.xml",))


def test_a_long_additional_file_is_never_in_memory(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its outputs are cut out piece by piece, and what is left is copied even with --link."""
    for limit in ("files._PIECE", "files._KEPT"):
        monkeypatch.setattr(f"ugat_marl.{limit}", 1 << 14)
    loops = "".join(
        f'<inductionLoop id="d{i}" lane="A1_east1_0" pos="{i % 50}" freq="9" file="{i}.xml"/>\n'
        for i in range(6000)
    )
    (files / "loops.add.xml").write_text(f"<additional>\n{loops}</additional>")
    size = (files / "loops.add.xml").stat().st_size
    tracemalloc.start()
    try:
        scenario = read_scenario(files / "city.sumocfg")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < size
    assert any(document.home for document in scenario.additional)
    assert made(tmp_path / "a", "--sumo", files / "city.sumocfg", "--link") == 0
    (written,) = (tmp_path / "a").glob("*.add.xml")
    root = parse_xml(written.read_bytes(), "additional")
    assert [item.get("file") for item in root] == ["NUL"] * 6000
    assert not {item.name for item in read_scenario(tmp_path / "a").additional} - {written.name}


def test_roads_of_any_source_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no vehicle departs"):
        make_scenario(
            tmp_path / "a",
            grid_roads("1x1", 300, 13.9),
            nobody,
            settings={},
            command="",
            force=False,
            reporter=Silent(),
        )
    assert left_over(tmp_path) == []
