"""Phases derived from networks with crossings, shared lanes and right turns on red."""

from __future__ import annotations

import subprocess
from itertools import combinations, product
from pathlib import Path

import pytest

from ugat_marl import parallel_env
from ugat_marl.effects import load_scenario, network_places
from ugat_marl.errors import ScenarioError
from ugat_marl.files import parse_xml
from ugat_marl.policies import ControlledNetwork
from ugat_marl.policies.rules.green_wave import main_roads
from ugat_marl.scenarios import (
    Intersection,
    Link,
    Network,
    Scenario,
    SignalTiming,
    degrees_of_saturation,
    kerb_turn_of,
    sumo_program,
    turn_of,
)
from ugat_marl.scenarios.junctions import crossings_of, foes_of, has_bit, links_of, yields_of
from ugat_marl.scenarios.phases import RightOfWay, are_foes, conflict_free_phases, suited

ARMS = {"N": (0, 200), "E": (200, 0), "S": (0, -200), "W": (-200, 0)}


def junction(
    folder: Path, *options: str, arms: str = "NESW", kind: str = "traffic_light", lanes: int = 1
) -> Scenario:
    """A light in the middle of straight roads, with the phases of its own programme."""
    nodes = f'<node id="M" x="0" y="0" type="{kind}"/>' + "".join(
        f'<node id="{a}" x="{ARMS[a][0]}" y="{ARMS[a][1]}"/>' for a in arms
    )
    edges = "".join(
        f'<edge id="{x}{y}" from="{x}" to="{y}" numLanes="{lanes}" speed="13"/>'
        for a in arms
        for x, y in ((a, "M"), ("M", a))
    )
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml",
         "--no-turnarounds", *options],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    (folder / "r.rou.xml").write_text("<routes/>")
    (folder / "scenario.toml").write_text('network = "n.net.xml"\nroutes = ["r.rou.xml"]\n')
    return load_scenario(folder)


def derived(scenario: Scenario, phases: str) -> tuple[Intersection, RightOfWay]:
    root = scenario.network.parse()
    (item,) = Network.read(scenario.with_control(phases=phases)).intersections
    return item, RightOfWay(foes_of(root), yields_of(root))


def green(item: Intersection, state: str, letters: str = "Gg") -> list[Link]:
    return [link for link in (*item.links, *item.crossings) if state[link.index] in letters]


def check_rules(item: Intersection, rules: RightOfWay) -> None:
    """Nobody has protected green in somebody's way; whoever has permitted green waits for one."""
    for state in item.phases:
        for a, b in combinations(green(item, state, "G"), 2):
            assert a.from_edge == b.from_edge or not are_foes(a, b, rules.foes), (state, a, b)
        for link in green(item, state, "g"):
            assert any(has_bit(link, b, rules.yields) for b in green(item, state)), (state, link)
    for link in (*item.links, *item.crossings):
        assert any(state[link.index] in "Gg" for state in item.phases), f"{link} is never green"


WALKS = ("--sidewalks.guess", "--crossings.guess")


@pytest.mark.parametrize("phases", ["conflict-free", "permitted"])
@pytest.mark.parametrize("lanes", [1, 2])
def test_people_cross_while_turning_traffic_waits(phases: str, lanes: int, tmp_path: Path) -> None:
    item, rules = derived(junction(tmp_path, *WALKS, lanes=lanes), phases)
    assert len(item.crossings) == 4
    check_rules(item, rules)
    for state in item.phases:
        walks = [crossing for crossing in item.crossings if state[crossing.index] in "Gg"]
        for crossing, link in product(walks, item.links):
            if state[link.index] in "Gg" and are_foes(crossing, link, rules.foes):
                assert turn_of(link) in "rl", "through traffic meets people on foot"
                assert state[link.index] == "g"


def test_crossings_are_found_where_the_matrix_has_them(tmp_path: Path) -> None:
    """A crossing conflicts with every link that begins or ends at its arm, and with no other."""
    scenario = junction(tmp_path, *WALKS)
    root = scenario.network.parse()
    foes = foes_of(root)
    arms = {
        f":M_c{n}": set((edge.get("crossingEdges") or "").split())
        for n, edge in enumerate(e for e in root.iter("edge") if e.get("function") == "crossing")
    }
    assert len(arms) == 4
    for crossing in crossings_of(root)["M"]:
        edges = arms[crossing.to_lane.rsplit("_", 1)[0]]
        for link in links_of(root)["M"]:
            touches = link.from_edge in edges or link.to_edge in edges
            assert are_foes(crossing, link, foes) == touches, (crossing, link)


def test_a_light_for_a_crossing_alone_is_an_agent_only_if_its_phases_are_listed(
    tmp_path: Path,
) -> None:
    nodes = '<node id="M" x="0" y="0" type="traffic_light"/><node id="E" x="200" y="0"/>'
    (tmp_path / "n.nod.xml").write_text(f'<nodes>{nodes}<node id="W" x="-200" y="0"/></nodes>')
    edges = "".join(f'<edge id="{n}" from="{n[0]}" to="{n[1]}"/>' for n in ("WM", "MW", "ME", "EM"))
    (tmp_path / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    (tmp_path / "n.con.xml").write_text(
        '<connections><crossing node="M" edges="WM MW"/></connections>'
    )
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-x", "n.con.xml",
         "-o", "n.net.xml", "--no-turnarounds", "--sidewalks.guess"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    (tmp_path / "r.rou.xml").write_text("<routes/>")
    (tmp_path / "scenario.toml").write_text('network = "n.net.xml"\nroutes = ["r.rou.xml"]\n')
    with pytest.raises(ScenarioError, match="fewer than two green phases"):
        derived(load_scenario(tmp_path), "conflict-free")
    with (tmp_path / "scenario.toml").open("a") as file:
        file.write('[intersections.M]\nphases = ["GGr", "rrG"]\n')
    item, rules = derived(load_scenario(tmp_path), "conflict-free")
    assert len(item.crossings) == 1
    assert item.phases == ("GGr", "rrG")
    check_rules(item, rules)


def test_permitted_left_turns_wait_for_the_traffic_opposite(tmp_path: Path) -> None:
    """On four arms with one lane each, two phases serve all, and nobody blocks a lane."""
    item, rules = derived(junction(tmp_path), "permitted")
    check_rules(item, rules)
    assert len(item.phases) == 2
    for state in item.phases:
        shown = green(item, state)
        assert sorted(map(turn_of, shown)) == ["l", "l", "r", "r", "s", "s"]
        assert {turn_of(link) for link in shown if state[link.index] == "g"} == {"l"}
    protected, _ = derived(junction(tmp_path), "conflict-free")
    assert all("g" not in state for state in protected.phases)
    assert len(protected.phases) > 2


def test_at_a_t_junction_only_the_main_road_has_traffic_opposite(tmp_path: Path) -> None:
    item, rules = derived(junction(tmp_path, arms="ESW"), "permitted")
    check_rules(item, rules)
    (main, stem) = sorted(item.phases, key=lambda state: -state.count("G") - state.count("g"))
    assert {link.from_edge for link in green(item, main)} >= {"EM", "WM"}
    assert {link.from_edge for link in green(item, stem)} >= {"SM"}
    assert [turn_of(link) for link in green(item, main, "g")] == ["l"]


def test_right_turns_on_red_are_kept(tmp_path: Path) -> None:
    scenario = junction(tmp_path, kind="traffic_light_right_on_red", lanes=2)
    item, _ = derived(scenario, "conflict-free")
    rights = {link.index for link in item.links if turn_of(link) == "r"}
    for state in item.phases:
        assert all(state[index] in "Ggs" for index in rights)
        assert all(letter != "s" for i, letter in enumerate(state) if i not in rights)


def test_unserved_movements_of_a_hand_made_matrix() -> None:
    """Two crossings and a left turn that crosses both, straight on that crosses one."""
    left, ahead = (Link(i, f"a{i}_0", f"b{i}_0", d, "J", i) for i, d in enumerate("ls"))
    walks = [Link(2 + i, f":J_w{i}_0", f":J_c{i}_0", "c", "J", 2 + i) for i in range(2)]
    foes = {"J": [0b1110, 0b0101, 0b0011, 0b0001]}
    yields = {"J": [0b1110, 0, 0b0010, 0]}
    rules = RightOfWay(foes, yields)
    states = conflict_free_phases([left, ahead], rules, 4, "here", crossings=walks)
    # Crossing 3 goes with straight on; crossing 2 only with the left turn, which waits for it.
    assert states == ("rGrG", "grGr")


def test_crossings_of_a_network_without_any() -> None:
    root = parse_xml(b"<net><edge id='a'/><junction id='J'/></net>", "net")
    assert crossings_of(root) == {}


@pytest.mark.parametrize("lanes", [1, 2])
def test_permitted_phases_are_those_netconvert_draws_up(lanes: int, tmp_path: Path) -> None:
    """Letter by letter: who is protected, who waits, and which crossings go along."""
    scenario = junction(tmp_path, *WALKS, lanes=lanes)
    own = {state for _, state in Network.read(scenario).intersections[0].programme}
    item, _ = derived(scenario, "permitted")
    assert len(item.phases) == 2
    assert set(item.phases) <= own


MIRRORED = {"N": "N", "E": "W", "S": "S", "W": "E"}


def signs(item: Intersection, left_hand: bool) -> set[frozenset[tuple[str, str, str]]]:
    """Return the greens of each phase by arm, turn and letter; mirrored for left-hand traffic."""
    assert {link.left_hand for link in item.links} == {left_hand}
    return {
        frozenset(
            (
                MIRRORED[link.from_edge[0]] if left_hand else link.from_edge[0],
                kerb_turn_of(link),
                state[link.index],
            )
            for link in item.links
            if state[link.index] != "r"
        )
        for state in item.phases
    }


@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("kind", ["traffic_light", "traffic_light_right_on_red"])
@pytest.mark.parametrize("phases", ["conflict-free", "permitted"])
def test_left_hand_traffic_is_the_mirror_image(
    tmp_path: Path, lanes: int, kind: str, phases: str
) -> None:
    both = []
    for left_hand in (False, True):
        folder = tmp_path / str(left_hand)
        folder.mkdir()
        options = ["--lefthand"] if left_hand else []
        scenario = junction(folder, *options, kind=kind, lanes=lanes)
        item, _ = derived(scenario, phases)
        flows = {(link.from_edge, link.to_edge): 200.0 for link in item.links}
        loaded = degrees_of_saturation(scenario.with_control(phases=phases), flows)
        both.append((signs(item, left_hand), loaded, suited(folder / "n.net.xml")))
    assert both[0] == both[1]


def test_turns_of_left_hand_traffic_keep_their_names(tmp_path: Path) -> None:
    item, _ = derived(junction(tmp_path, "--lefthand"), "conflict-free")
    turns = {(link.from_edge, link.to_edge): turn_of(link) for link in item.links}
    assert turns["SM", "MW"] == "l"  # northbound
    assert turns["SM", "ME"] == "r"
    giving_way = {
        turns[link.from_edge, link.to_edge]
        for state in item.phases
        for link in green(item, state, "g")
    }
    assert "l" not in giving_way


def railway(folder: Path) -> Scenario:
    """Lights A and B on a street that crosses a railway between them, with a rail signal at R."""
    places = {
        "W": (-400, 0, ""), "A": (-200, 0, "traffic_light"), "X": (0, 0, "rail_crossing"),
        "B": (200, 0, "traffic_light"), "E": (400, 0, ""), "P": (-200, 200, ""),
        "Q": (200, 200, ""), "R": (0, 150, "rail_signal"), "T": (0, 300, ""),
        "U": (60, 300, ""), "V": (0, -200, ""),
    }  # fmt: skip
    streets = [x + y for a, b in ("WA", "AX", "XB", "BE", "PA", "QB") for x, y in (a + b, b + a)]
    rails = ["TR", "UR", "RX", "XV"]
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="{y}"' + (f' type="{kind}"/>' if kind else "/>")
        for name, (x, y, kind) in places.items()
    )
    edges = "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" speed="13"{allowed}/>'
        for ways, allowed in ((streets, ""), (rails, ' allow="rail"'))
        for a, b in ways
    )
    ways = (("AX", "XB"), ("BX", "XA"), ("RX", "XV"))
    links = "".join(f'<connection from="{a}" to="{b}"/>' for a, b in ways)
    for kind, root, text in (
        ("nod", "nodes", nodes), ("edg", "edges", edges), ("con", "connections", links),
    ):  # fmt: skip
        (folder / f"n.{kind}.xml").write_text(f"<{root}>{text}</{root}>")
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-x", "n.con.xml",
         "-o", "n.net.xml", "--no-turnarounds"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    (folder / "r.rou.xml").write_text(
        '<routes><vType id="train" vClass="rail"/>'
        '<flow id="cars" begin="0" end="300" period="5"><route edges="WA AX XB BE"/></flow>'
        '<flow id="trains" type="train" begin="0" end="300" period="100">'
        '<route edges="TR RX XV"/></flow></routes>'
    )
    (folder / "scenario.toml").write_text(
        'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = 300\n'
    )
    return load_scenario(folder)


@pytest.mark.parametrize("phases", ["programme", "conflict-free", "permitted"])
def test_signals_of_railways_are_no_traffic_lights(phases: str, tmp_path: Path) -> None:
    scenario = railway(tmp_path).with_control(phases=phases)
    controlled = {x.get("tl") for x in scenario.network.parse().iter("connection")} - {None}
    assert controlled == {"A", "B", "X", "R"}
    network = Network.read(scenario)
    a, b = network.intersections
    assert (a.id, b.id, a.neighbours, b.neighbours) == ("A", "B", ("B",), ("A",))
    assert network.uncontrolled == ()
    assert {*a.incoming_lanes, *b.incoming_lanes} == {
        f"{e}_0" for e in ("WA", "XA", "PA", "XB", "EB", "QB")
    }
    assert network_places(scenario).lights == ("A", "B")
    env = parallel_env(scenario, "late_green=*,2")
    env.reset(seed=1)
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
    assert env.scores().departed > 5
    env.close()


@pytest.mark.parametrize("between", ["priority", "traffic_light"])
@pytest.mark.parametrize("sidewalks", ["false", "true"])
def test_agents_are_beside_each_other_across_what_is_no_agent(
    tmp_path: Path, between: str, sidewalks: str
) -> None:
    """A node of a map, or a light of pedestrians, between two agents, with sidewalks or without."""
    places = {"W": (-300, 0), "A": (0, 0), "P": (150, 0), "B": (300, 0), "E": (600, 0)}
    places |= {f"{a}{b}": (300 * (a == "B"), 200 if b == "n" else -200) for a in "AB" for b in "ns"}
    kinds = {"A": "traffic_light", "B": "traffic_light", "P": between}
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="{y}" type="{kinds.get(name, "priority")}"/>'
        for name, (x, y) in places.items()
    )
    ways = [("W", "A"), ("A", "P"), ("P", "B"), ("B", "E")]
    ways += [(light, f"{light}{end}") for light in "AB" for end in "ns"]
    edges = "".join(
        f'<edge id="{a}-{b}" from="{a}" to="{b}" speed="10"/>'
        for way in ways
        for a, b in (way, way[::-1])
    )
    (tmp_path / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (tmp_path / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml",
         "--sidewalks.guess", sidewalks, "--crossings.guess", sidewalks],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vehicle id="v" depart="0"><route edges="W-A A-P"/></vehicle></routes>'
    )
    (tmp_path / "scenario.toml").write_text(
        'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = 100\n'
    )
    network = Network.read(load_scenario(tmp_path))
    assert [(x.id, x.neighbours) for x in network.intersections] == [("A", ("B",)), ("B", ("A",))]
    assert network.straight == {"A-P": "P-B", "B-P": "P-A"}
    items = {f"signal_{k}": item for k, item in enumerate(network.intersections)}
    (road,) = main_roads(
        ControlledNetwork.of_network(network, items, 10.0, SignalTiming(3.0, 2.0, 5.0))
    )
    assert road.agents == ("signal_0", "signal_1")
    assert road.arrival_s[1] == pytest.approx(30.0, abs=4.0)
