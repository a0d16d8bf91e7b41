"""Networks against their drawings: shipped ones, a hand-made one, and the field's own."""

from __future__ import annotations

import importlib.util
import itertools
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sumo

from ugat_marl.effects import load_scenario
from ugat_marl.errors import ScenarioError, UnknownNameError
from ugat_marl.scenarios import (
    GREEN,
    Intersection,
    Network,
    Scenario,
    check_demand,
    conflicting_greens,
    read_scenario,
    shipped_scenarios,
)
from ugat_marl.scenarios.junctions import foes_of, yields_of
from ugat_marl.scenarios.phases import RightOfWay

SHIPPED = dict(shipped_scenarios())
PHASES = {
    "single-v1": {"A1": 8},
    "grid2x2-v1": dict.fromkeys(("A1", "A2", "B1", "B2"), 8),
    "grid4x4-v1": {f"{column}{row}": 8 for column in "ABCD" for row in "1234"},
    "arterial1x5-v1": dict.fromkeys(("A1", "B1", "C1", "D1", "E1"), 8),
    "mixed-v1": {"P": 8, "Q": 3, "R": 6, "S": 2, "T": 2, "U": 4, "V": 3},
}


@pytest.fixture(scope="module")
def networks() -> dict[str, tuple[Scenario, Network]]:
    scenarios = {name: load_scenario(name) for name in SHIPPED}
    return {name: (scenario, Network.read(scenario)) for name, scenario in scenarios.items()}


Networks = dict[str, tuple[Scenario, Network]]


@pytest.mark.parametrize("name", PHASES)
def test_agents_and_phases_of_the_shipped_scenarios(name: str, networks: Networks) -> None:
    _, network = networks[name]
    found = {item.id: len(item.phases) for item in network.intersections}
    assert found == PHASES[name]
    assert list(found) == sorted(found)
    assert network.uncontrolled == ()


def test_every_shipped_scenario_is_counted() -> None:
    assert set(SHIPPED) == set(PHASES)


@pytest.mark.parametrize("name", ["grid2x2-v1", "grid4x4-v1", "arterial1x5-v1"])
def test_neighbours_are_one_block_away(name: str, networks: Networks) -> None:
    items = networks[name][1].intersections
    spacing = min(
        float(np.hypot(*np.subtract(a.position, b.position)))
        for a, b in itertools.combinations(items, 2)
    )
    for item in items:
        near = {
            other.id
            for other in items
            if other is not item
            and np.hypot(*np.subtract(item.position, other.position)) < 1.2 * spacing
        }
        assert set(item.neighbours) == near


def test_neighbours_of_mixed(networks: Networks) -> None:
    pairs = {"PQ", "QR", "RV", "PS", "QT", "RU", "ST", "TU"}
    for item in networks["mixed-v1"][1].intersections:
        expected = {pair.replace(item.id, "") for pair in pairs if item.id in pair}
        assert set(item.neighbours) == expected


# --- geometry: a witness that knows nothing of right-of-way matrices ------------------------------


def paths_across(scenario: Scenario) -> dict[tuple[str, str], np.ndarray]:
    """Centre lines over junctions by incoming and outgoing lane."""
    root = ET.fromstring(scenario.network.read())
    shape = {
        lane.get("id"): np.array([p.split(",")[:2] for p in lane.get("shape", "").split()], float)
        for lane in root.iter("lane")
    }
    via = {
        (f"{c.get('from')}_{c.get('fromLane')}", f"{c.get('to')}_{c.get('toLane')}"): c.get("via")
        for c in root.iter("connection")
    }
    paths: dict[tuple[str, str], np.ndarray] = {}
    for (start, end), inner in via.items():
        if start.startswith(":"):
            continue
        parts = []
        while inner:
            parts.append(shape[inner])
            inner = via.get((inner, end))
        paths[start, end] = np.concatenate(parts)
    return paths


def cross(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two polylines cross properly."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> float:
        u, v = q - p, r - p
        return float(u[0] * v[1] - u[1] * v[0])

    return any(
        side(p, q, r) * side(p, q, s) < 0 and side(r, s, p) * side(r, s, q) < 0
        for p, q in itertools.pairwise(a)
        for r, s in itertools.pairwise(b)
    )


@pytest.mark.parametrize("name", PHASES)
def test_protected_greens_do_not_cross_on_the_drawing(name: str, networks: Networks) -> None:
    scenario, network = networks[name]
    paths = paths_across(scenario)
    for item in network.intersections:
        for phase in item.phases:
            green = [link for link in item.links if phase[link.index] == "G"]
            for a, b in itertools.combinations(green, 2):
                if a.from_edge != b.from_edge:
                    crossing = cross(paths[a.from_lane, a.to_lane], paths[b.from_lane, b.to_lane])
                    assert not crossing, f"{item.id} {phase}: {a} and {b}"


@pytest.mark.parametrize("name", PHASES)
def test_every_link_is_green_in_some_phase(name: str, networks: Networks) -> None:
    for item in networks[name][1].intersections:
        for link in item.links:
            assert any(phase[link.index] in GREEN for phase in item.phases), f"{item.id} {link}"


@pytest.mark.parametrize("name", PHASES)
def test_rows_of_the_matrix_are_the_links(name: str, networks: Networks) -> None:
    """netconvert numbers the letters of a light as the rows of its junction's matrix."""
    for item in networks[name][1].intersections:
        assert [link.request for link in item.links] == [link.index for link in item.links]
        assert {link.junction for link in item.links} == {item.id}


@pytest.mark.parametrize("name", PHASES)
def test_shipped_programmes_are_sound(name: str, networks: Networks) -> None:
    """Yellow after every green that ends, and no two protected greens whose paths cross."""
    scenario, network = networks[name]
    paths = paths_across(scenario)
    for item in network.intersections:
        states = [state for _, state in item.programme]
        for before, after in zip(states, states[1:] + states[:1], strict=True):
            for a, b in zip(before, after, strict=True):
                assert not (a in GREEN and b not in GREEN | {"y"}), f"{item.id}: {before}->{after}"
        for state in states:
            green = [link for link in item.links if state[link.index] == "G"]
            for a, b in itertools.combinations(green, 2):
                assert a.from_edge == b.from_edge or not cross(
                    paths[a.from_lane, a.to_lane], paths[b.from_lane, b.to_lane]
                )


# --- the crossing drawn by hand -------------------------------------------------------------------


def test_the_crossing_as_drawn(crossing: Callable[..., Path]) -> None:
    network = Network.read(load_scenario(crossing()))
    (item,) = network.intersections
    assert item.id == "C"
    assert item.incoming_lanes == ("S_C_0", "W_C_0")
    assert item.outgoing_lanes == ("C_N_0", "C_E_0")
    assert item.phases == ("Gr", "rG")
    assert item.programme == ((40.0, "Gr"), (10.0, "rG"))
    assert item.neighbours == ()
    assert item.position == (500.0, 500.0)
    assert [(x.index, x.from_lane, x.to_lane, x.direction, x.request) for x in item.links] == [
        (0, "S_C_0", "C_N_0", "s", 0),
        (1, "W_C_0", "C_E_0", "s", 1),
    ]
    assert set(network.lanes) == {"S_C_0", "C_N_0", "W_C_0", "C_E_0"}
    lane = network.lanes["W_C_0"]
    assert (lane.edge, lane.length_m, lane.speed_mps) == ("W_C", 490.0, 10.0)
    assert lane.shape == ((0.0, 500.0), (490.0, 500.0))
    assert lane.storage_veh == pytest.approx(490 / 7.5)
    table = network.lane_table()
    assert table.ids == ("S_C_0", "W_C_0", "C_N_0", "C_E_0")
    assert table.indices(["C_E_0", "S_C_0"]).tolist() == [3, 0]
    np.testing.assert_allclose(table.storage_veh, 490 / 7.5)
    np.testing.assert_allclose(table.speed_mps, 10)


def test_a_short_lane_has_room_for_one(crossing: Callable[..., Path]) -> None:
    directory = crossing(edit=lambda text: text.replace('length="490.00"', 'length="4.00"'))
    assert Network.read(load_scenario(directory)).lanes["W_C_0"].storage_veh == 1.0


def test_derived_phases_are_the_programme_s(crossing: Callable[..., Path]) -> None:
    directory = crossing(toml=lambda text: text.replace('"programme"', '"conflict-free"'))
    assert Network.read(load_scenario(directory)).intersections[0].phases == ("Gr", "rG")


def test_one_light_may_differ_from_the_rest(crossing: Callable[..., Path]) -> None:
    directory = crossing(toml=lambda text: text + '[intersections.C]\nphases = ["rG", "gr"]\n')
    assert Network.read(load_scenario(directory)).intersections[0].phases == ("rG", "gr")


def test_the_programme_of_an_additional_file_counts(crossing: Callable[..., Path]) -> None:
    """SUMO runs the programme it read last."""
    directory = crossing(toml=lambda text: 'additional = ["lights.add.xml"]\n' + text)
    (directory / "lights.add.xml").write_text(
        '<additional><tlLogic id="C" type="static" programID="mine" offset="0">'
        '<phase duration="7" state="rG"/><phase duration="8" state="gr"/></tlLogic></additional>'
    )
    item = Network.read(load_scenario(directory)).intersections[0]
    assert item.programme == ((7.0, "rG"), (8.0, "gr"))
    assert item.phases == ("rG", "gr")


def test_times_of_phases_may_have_hours_and_minutes_and_a_wrong_one_is_named(
    crossing: Callable[..., Path],
) -> None:
    directory = crossing(toml=lambda text: 'additional = ["lights.add.xml"]\n' + text)
    lights = (
        '<additional><tlLogic id="C" type="static" programID="mine" offset="0">'
        '<phase duration="0:01:07" state="rG"/><phase duration="8" state="gr"/></tlLogic>'
        "</additional>"
    )
    (directory / "lights.add.xml").write_text(lights)
    item = Network.read(load_scenario(directory)).intersections[0]
    assert item.programme == ((67.0, "rG"), (8.0, "gr"))
    (directory / "lights.add.xml").write_text(lights.replace("0:01:07", "0:01"))
    with pytest.raises(
        ScenarioError, match=r"lights\.add\.xml: traffic light 'C' has a .* none \(0:01"
    ):
        Network.read(load_scenario(directory))


# --- networks from netconvert ---------------------------------------------------------------------


def netconvert(directory: Path, nodes: str, edges: str, *options: str) -> Path:
    """A scenario directory with a network and one vehicle; trip from edge "in" to edge "out"."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (directory / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    subprocess.run(
        [
            str(Path(sumo.SUMO_HOME) / "bin" / "netconvert"),
            "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml", "--no-turnarounds", *options,
        ],
        cwd=directory, check=True, capture_output=True,
    )  # fmt: skip
    (directory / "r.rou.xml").write_text("<routes/>")
    (directory / "scenario.toml").write_text('network = "n.net.xml"\nroutes = ["r.rou.xml"]\n')
    return directory


def node(name: str, x: float, y: float, kind: str = "priority") -> str:
    return f'<node id="{name}" x="{x}" y="{y}" type="{kind}"/>'


def roads(*pairs: str) -> str:
    """Edges in both directions between nodes named by one letter."""
    return "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1"/>'
        for pair in pairs
        for a, b in (pair, pair[::-1])
    )


def test_neighbours_are_found_beyond_plain_junctions(tmp_path: Path) -> None:
    lights = node("A", 0, 0, "traffic_light") + node("B", 400, 0, "traffic_light")
    plain = node("M", 200, 0) + node("S", 200, -100) + node("T", 200, -200, "traffic_light")
    ends = "".join(
        node(name, x, y)
        for name, x, y in (
            ("a", -200, 0), ("c", 0, 200), ("d", 0, -200), ("b", 600, 0), ("e", 400, 200),
            ("f", 400, -200), ("g", 0, -300), ("h", 400, -300),
        )
    )  # fmt: skip
    edges = roads("AM", "MB", "MS", "ST", "Aa", "Ac", "Ad", "Bb", "Be", "Bf", "Tg", "Th")
    network = Network.read(load_scenario(netconvert(tmp_path, lights + plain + ends, edges)))
    found = {item.id: item.neighbours for item in network.intersections}
    assert found == {"A": ("B", "T"), "B": ("A", "T"), "T": ("A", "B")}


def test_lights_without_a_choice_are_left_alone(tmp_path: Path) -> None:
    """A pedestrian light has one green phase: it runs its own programme."""
    nodes = node("A", 0, 0, "traffic_light") + node("P", 200, 0, "traffic_light")
    nodes += node("a", -200, 0) + node("c", 0, 200) + node("d", 0, -200) + node("b", 400, 0)
    network = Network.read(
        load_scenario(netconvert(tmp_path, nodes, roads("aA", "cA", "dA", "AP", "Pb")))
    )
    assert [item.id for item in network.intersections] == ["A"]
    assert network.uncontrolled == ("P",)
    assert network.intersections[0].neighbours == ()


def test_two_junctions_under_one_light(tmp_path: Path) -> None:
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="0" type="traffic_light" tl="both"/>'
        for name, x in (("A", 0), ("B", 60))
    )
    nodes += "".join(
        node(n, x, y) for n, x, y in (("a", -200, 0), ("c", 0, 200), ("d", 0, -200), ("b", 260, 0))
    )
    nodes += node("e", 60, 200) + node("f", 60, -200)
    edges = roads("aA", "cA", "dA", "AB", "Bb", "Be", "Bf")
    directory = netconvert(tmp_path, nodes, edges, "--offset.disable-normalization")
    (item,) = Network.read(load_scenario(directory)).intersections
    assert item.id == "both"
    assert item.position == pytest.approx((30, 0), abs=10)
    assert {link.junction for link in item.links} == {"A", "B"}
    derived = load_scenario(directory).with_control(phases="conflict-free")
    (item,) = Network.read(derived).intersections
    # Each junction has its own four (one approach) or pairs; together every combination is allowed.
    assert len(item.phases) >= 4
    assert all(len(phase) == len(item.links) for phase in item.phases)


def test_without_internal_lanes_the_programme_still_works(tmp_path: Path) -> None:
    nodes = node("A", 0, 0, "traffic_light") + node("a", -200, 0) + node("b", 200, 0)
    nodes += node("c", 0, 200) + node("d", 0, -200)
    edges = roads("aA", "bA", "cA", "dA")
    directory = netconvert(tmp_path, nodes, edges, "--no-internal-links")
    scenario = load_scenario(directory)
    assert len(Network.read(scenario).intersections[0].phases) == 2
    with pytest.raises(ScenarioError, match=r"traffic light 'A': .*use phases = \"programme\""):
        Network.read(scenario.with_control(phases="conflict-free"))


def test_a_way_through_with_two_lanes_has_two_rows(tmp_path: Path) -> None:
    nodes = node("A", 0, 0, "traffic_light") + node("a", -200, 0) + node("b", 200, 0)
    nodes += node("c", 0, 200) + node("d", 0, -200)
    edges = "".join(
        f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="{lanes}"/>'
        for name, lanes in (("aA", 2), ("Ab", 2), ("cA", 1), ("Ad", 1))
    )
    (item,) = Network.read(load_scenario(netconvert(tmp_path, nodes, edges))).intersections
    assert any(link.from_lane == "aA_1" for link in item.links)
    assert [link.request for link in item.links] == [link.index for link in item.links]


# --- networks that are not ours -------------------------------------------------------------------


def test_hangzhou_has_the_phases_its_authors_wrote_down(hangzhou: Path) -> None:
    """The conflicts alone give the same, but for opposing left turns drawn so tightly that they
    touch."""
    (file,) = (hangzhou / "hangzhou_1x1").glob("*.sumocfg")
    scenario = load_scenario(file)
    (written,) = Network.read(scenario).intersections
    (derived,) = Network.read(scenario.with_control(phases="conflict-free")).intersections
    assert len(written.phases) == 8
    left_pairs = [green for green in movements(written, GREEN) if {d for _, d in green} == {"l"}]
    assert len(left_pairs) == 2
    assert movements(derived, GREEN) == movements(written, GREEN) - set(left_pairs)


def test_hangzhou_4x4(hangzhou: Path) -> None:
    (file,) = (hangzhou / "hangzhou_4x4").glob("*.sumocfg")
    scenario = load_scenario(file)
    network = Network.read(scenario)
    assert [len(item.phases) for item in network.intersections] == [8] * 16
    assert sum(len(item.neighbours) for item in network.intersections) == 2 * 24
    assert check_demand(scenario, network).vehicles > 2000


needs_resco = pytest.mark.skipif(
    importlib.util.find_spec("sumo_rl") is None, reason="sumo-rl is not installed"
)


@needs_resco
@pytest.mark.parametrize(
    ("name", "phases"),
    [
        ("cologne1", [4]),
        ("cologne3", [3, 4, 4]),
        ("cologne8", [4, 2, 3, 4, 3, 2, 3, 4]),
        ("ingolstadt1", [3]),
        ("ingolstadt7", [2, 3, 3, 3, 3, 3, 3]),
        ("grid4x4", [8] * 16),
        ("arterial4x4", [5] * 16),
    ],
)
def test_resco_maps_load(name: str, phases: list[int]) -> None:
    scenario = load_scenario(f"resco:{name}")
    network = Network.read(scenario)
    assert [len(item.phases) for item in network.intersections] == phases
    assert check_demand(scenario, network).vehicles > 1000
    assert scenario.id == f"resco:{name}"


@needs_resco
def test_resco_grid_has_the_phases_that_follow_from_its_conflicts() -> None:
    scenario = load_scenario("resco:grid4x4")
    derived = Network.read(scenario.with_control(phases="conflict-free")).intersections
    for written, found in zip(Network.read(scenario).intersections, derived, strict=True):
        assert movements(written, GREEN) == movements(found, GREEN)


def movements(item: Intersection, letters: frozenset[str]) -> set[frozenset[tuple[str, str]]]:
    """Per phase the through and left movements that are green."""
    return {
        frozenset(
            (link.from_edge, link.direction)
            for link in item.links
            if phase[link.index] in letters and link.direction != "r"
        )
        for phase in item.phases
    }


@needs_resco
def test_an_unknown_resco_map_is_told_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="unknown RESCO map 'cologne2'. Did you mean"):
        load_scenario("resco:cologne2")


def test_conflicting_greens_are_found_in_real_matrices(networks: Networks) -> None:
    """All links green at once is caught at every junction of every shipped network."""
    for scenario, network in networks.values():
        root = ET.fromstring(scenario.network.read())
        foes = {
            junction.get("id", ""): [int(r.get("foes", "0"), 2) for r in junction.iter("request")]
            for junction in root.iter("junction")
        }
        for item in network.intersections:
            assert conflicting_greens("G" * len(item.phases[0]), item.links, foes)


def test_protected_greens_that_cross_are_mended_by_right_of_way(
    crossing: Callable[..., Path],
) -> None:
    """A programme that plain SUMO runs: both roads have G. The one that must yield gets g."""
    folder = crossing()
    scenario = read_scenario(folder)
    whole = Network.read(scenario)
    assert whole.notes == ()
    (light,) = whole.intersections
    every = "G" * len(light.programme[0][1])
    text = (folder / "network.net.xml").read_text()
    first = light.programme[0][1]
    (folder / "network.net.xml").write_text(text.replace(f'state="{first}"', f'state="{every}"'))
    network = Network.read(read_scenario(folder))
    (mended,) = network.intersections
    state = mended.programme[0][1]
    assert sorted(state) == ["G", "g"]
    root = read_scenario(folder).network.parse()
    rules = RightOfWay(foes_of(root), yields_of(root))
    yields = {link.index for link in light.links if state[link.index] == "g"}
    a = next(link for link in light.links if link.index in yields)
    b = next(link for link in light.links if link.index not in yields)
    assert rules.waits(a, b) or not rules.waits(b, a)
    (note,) = network.notes
    assert "protected greens of its programme cross" in note
    assert f"the links {min(yields)} have to yield and got g" in note
    toml = (folder / "scenario.toml").read_text()
    listed = f'phases = ["{every}", "{light.phases[1]}"]'
    (folder / "scenario.toml").write_text(toml.replace('phases = "programme"', listed))
    with pytest.raises(ScenarioError, match="gives protected green"):  # own lists are refused
        Network.read(read_scenario(folder))


def test_a_light_that_is_no_agent_has_a_reason() -> None:
    """A T whose programme has one green, as a map may have it."""
    scenario = load_scenario("mixed-v1").with_control(phases="programme")
    (light,) = [item for item in Network.read(scenario).intersections if item.id == "T"]
    text = scenario.network.read().decode()
    for _, state in light.programme[1:]:
        text = text.replace(f'state="{state}"', f'state="{light.programme[0][1]}"')
    poor = replace(scenario, network=scenario.network.edited(text.encode()))
    network = Network.read(poor)
    assert "T" in network.uncontrolled
    assert network.reasons["T"] == (
        'its programme has 1 green phase; phases = "conflict-free" or "permitted" may make more'
    )
    derived = Network.read(poor.with_control(phases="conflict-free"))
    assert "T" not in derived.uncontrolled


def test_lights_have_their_place_in_a_network_without_internal_lanes(tmp_path: Path) -> None:
    ends = (("a", -90, 0), ("b", 110, 0), ("c", 10, 90), ("d", 10, -90))
    nodes = '<node id="x" x="10" y="0" type="traffic_light"/>' + "".join(
        f'<node id="{name}" x="{x}" y="{y}"/>' for name, x, y in ends
    )
    edges = "".join(
        f'<edge id="{name}in" from="{name}" to="x"/><edge id="{name}out" from="x" to="{name}"/>'
        for name, _, _ in ends
    )
    places = []
    for name, options in (("with", ()), ("without", ("--no-internal-links",))):
        network = Network.read(
            read_scenario(
                netconvert(
                    tmp_path / name, nodes, edges, *options, "--offset.disable-normalization"
                )
            )
        )
        (light,) = network.intersections
        places.append(light.position)
        assert any("has no internal lanes at x" in note for note in network.notes) == bool(options)
    assert places[0] == places[1] == (10.0, 0.0)


def test_what_netconvert_writes_of_its_options_is_admitted(tmp_path: Path) -> None:
    nodes = (
        '<node id="a" x="0" y="0"/><node id="x" x="100" y="0" type="traffic_light"/>'
        '<node id="b" x="200" y="0"/><node id="c" x="100" y="90"/>'
    )
    edges = (
        '<edge id="in" from="a" to="x"/><edge id="out" from="x" to="b"/>'
        '<edge id="side" from="c" to="x"/>'
    )
    directory = netconvert(tmp_path / "a", nodes, edges, "--write-metadata")
    assert b"<metadata" in next(directory.glob("*.net.xml")).read_bytes()
    assert Network.read(read_scenario(directory)).intersections[0].id == "x"


def test_a_network_without_a_row_of_right_of_way_is_refused() -> None:
    scenario = load_scenario("single-v1").with_control(phases="programme")

    def drop(part: ET.Element) -> None:
        for junction in part.iter("junction"):
            if junction.get("id") == "A1":
                junction.remove(junction.findall("request")[-1])

    short = replace(scenario, network=scenario.network.changed(drop))
    with pytest.raises(ScenarioError, match=r"junction 'A1' has \d+ requests, and a connection"):
        Network.read(short)


@pytest.mark.parametrize("durations", [("0",), ("-5", "60")])
def test_programmes_that_take_no_time_are_refused(durations: tuple[str, ...]) -> None:
    scenario = load_scenario("single-v1")

    def stop(part: ET.Element) -> None:
        for number, phase in enumerate(part.iter("phase")):
            phase.set("duration", durations[number % len(durations)])

    still = replace(scenario, network=scenario.network.changed(stop))
    with pytest.raises(ScenarioError, match="write durations of at least 0 that are not all 0"):
        Network.read(still)
