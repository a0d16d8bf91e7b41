"""OpenStreetMap extracts: a town written by hand, as XML, packed, and as protocol buffers."""

from __future__ import annotations

import gzip
import math
import re
import struct
import sys
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import pytest

from ugat_marl.__main__ import main
from ugat_marl.experiments import problems
from ugat_marl.files import parse_xml
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Network, Scenario, read_scenario, shipped_scenarios, survey
from ugat_marl.scenarios.importers.osm import items, unpack, write_roads
from ugat_marl.scenarios.importers.osm_crossings import utm
from ugat_marl.scenarios.importers.osm_restrictions import Restriction, forbidden_turns
from ugat_marl.scenarios.junctions import foes_of
from ugat_marl.scenarios.phases import RightOfWay, are_foes, suited

TOWN = Path(__file__).parents[1] / "fixtures" / "town.osm"


def made(target: Path, osm: Path, *words: str) -> int:
    call = ["scenario", "new", str(target), "--osm", str(osm), "--vph", "200", *words]
    return main([*call, "--duration-s", "600"])


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    target = tmp_path_factory.mktemp("osm") / "town"
    assert made(target, TOWN) == 0
    return read_scenario(target)


def test_the_dual_carriageway_has_one_light(town: Scenario) -> None:
    """Its crossroads is mapped as two signalled nodes, 16 m apart."""
    network = Network.read(town)
    assert [item.id for item in network.intersections] == ["9", "cluster_2_5"]
    cluster = network.intersection("cluster_2_5")
    assert {link.junction for link in cluster.links} == {"cluster_2_5"}
    assert len({link.from_edge for link in cluster.links}) == 4
    assert len(cluster.incoming_lanes) == 6


def test_traffic_keeps_to_the_left_on_request(tmp_path: Path, town: Scenario) -> None:
    assert made(tmp_path / "left", TOWN, "--left-hand") == 0
    left = Network.read(read_scenario(tmp_path / "left"))
    assert all(link.left_hand for item in left.intersections for link in item.links)
    assert not any(x.left_hand for item in Network.read(town).intersections for x in item.links)


def test_a_light_at_a_crossing_is_no_agent(town: Scenario) -> None:
    assert Network.read(town).uncontrolled == ("8",)


@pytest.mark.parametrize(
    ("tags", "others"),
    [
        ({"highway": "crossing", "crossing": "marked", "crossing:signals": "yes"}, ("8",)),
        ({"highway": "traffic_signals", "crossing": "no"}, ()),
    ],
)
def test_lights_at_crossings_in_other_words(
    tags: dict[str, str], others: tuple[str, ...], tmp_path: Path
) -> None:
    """A light on a plain road where nobody crosses stops traffic for nothing."""
    text = TOWN.read_text()
    former = '<tag k="highway" v="crossing"/><tag k="crossing" v="traffic_signals"/>'
    assert text.count(former) == 1
    now = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
    (tmp_path / "x.osm").write_text(text.replace(former, now))
    assert made(tmp_path / "a", tmp_path / "x.osm") == 0
    assert Network.read(read_scenario(tmp_path / "a")).uncontrolled == others


def test_the_roundabout_is_one(town: Scenario) -> None:
    roundabouts = list(town.network.parse().iter("roundabout"))
    assert len(roundabouts) == 1
    assert len(roundabouts[0].get("edges", "").split()) == 5


def test_a_footbridge_is_no_junction(town: Scenario) -> None:
    root = town.network.parse()
    west = [edge for edge in root.iter("edge") if (edge.get("id") or "").startswith("1001#")]
    assert len(west) == 2  # the carriageway is cut at the crossroads alone
    kinds = {edge.get("type") for edge in root.iter("edge")} - {None}
    assert kinds == {"highway.primary", "highway.secondary"}


def test_phases_serve_everybody(town: Scenario) -> None:
    facts = survey(town)
    assert all(not item.unserved_links for item in facts.intersections)


def test_left_turns_from_shared_lanes_are_permitted(town: Scenario, tmp_path: Path) -> None:
    """Waiting for a phase of their own they block the lane: 273 s of travel in place of 79."""
    sources = {tls: own.phases for tls, own in town.settings.intersections.items()}
    assert sources == {"9": "permitted", "cluster_2_5": "permitted"}
    for item in Network.read(town).intersections:
        assert len(item.phases) == 2
        assert all("g" in state for state in item.phases)
    assert made(tmp_path / "a", TOWN, "--phases", "conflict-free") == 0
    network = Network.read(read_scenario(tmp_path / "a"))
    assert [len(item.phases) for item in network.intersections] == [6, 8]


def test_lights_without_phases_to_derive_keep_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ugat_marl.scenarios.phases.MOST_PHASES", 1)
    assert made(tmp_path / "a", TOWN) == 0
    scenario = read_scenario(tmp_path / "a")
    assert {own.phases for own in scenario.settings.intersections.values()} == {"programme"}
    assert "2 lights have no phases that can be derived" in (tmp_path / "a/README.md").read_text()


def test_lanes_for_one_turn_need_no_permission() -> None:
    folder = dict(shipped_scenarios())["grid2x2-v1"]
    assert suited(folder / "network.net.xml") == ({}, [])


def test_the_licence_is_named(town: Scenario) -> None:
    assert town.network.path is not None
    text = (town.network.path.parent / "README.md").read_text()
    assert "OpenStreetMap contributors" in text
    assert "4 lights in the extract make 3 in the network" in text


def test_a_comma_in_a_name_is_no_end(town: Scenario, tmp_path: Path) -> None:
    plain = tmp_path / "Stadt, süd.osm"
    plain.write_bytes(TOWN.read_bytes())
    assert made(tmp_path / "a", plain) == 0
    assert read_scenario(tmp_path / "a").network.read() == town.network.read()


def test_packed_extracts_make_the_same_network(town: Scenario, tmp_path: Path) -> None:
    packed = tmp_path / "Stadt, süd.osm.gz"
    packed.write_bytes(gzip.compress(TOWN.read_bytes()))
    assert made(tmp_path / "a", packed) == 0
    assert read_scenario(tmp_path / "a").network.read() == town.network.read()


def with_buildings(folder: Path, count: int) -> Path:
    """The town, most of its extract being buildings, as of any town."""
    nodes = "".join(
        f'<node id="{90_000 + i}" lat="48.0{i:05d}" lon="11.0{i:05d}"/>\n' for i in range(4 * count)
    )
    ways = "".join(
        f'<way id="{90_000 + i}"><nd ref="{90_000 + 4 * i}"/><nd ref="{90_001 + 4 * i}"/>'
        f'<tag k="building" v="yes"/><tag k="name" v="&lt;Café &quot;{i}&quot;&gt;"/></way>\n'
        for i in range(count)
    )
    head, ways_of_town = TOWN.read_text().split("<way", 1)
    path = folder / "built.osm"
    path.write_text(f"{head}{nodes}<way{ways_of_town}".replace("</osm>", f"{ways}</osm>"))
    return path


def test_buildings_are_neither_in_memory_nor_in_the_way(
    town: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = with_buildings(tmp_path, 3000), tmp_path / "roads.osm"
    assert made(tmp_path / "a", path) == 0
    assert read_scenario(tmp_path / "a").network.read() == town.network.read()
    monkeypatch.setattr("ugat_marl.files._PIECE", 1 << 14)
    tracemalloc.start()
    try:
        nodes = {node for item in items(path, path, Silent()) for node in item.way_nodes}
        write_roads(path, path, nodes, out, Silent())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < path.stat().st_size / 2
    assert out.stat().st_size < 2 * TOWN.stat().st_size
    assert "building" not in out.read_text()


@pytest.mark.parametrize(("key", "left"), [("railway", (1, 2)), ("building", ())])
def test_what_roads_are_made_of_stays_as_it_is(
    key: str, left: tuple[int, ...], tmp_path: Path
) -> None:
    source, out = tmp_path / "a.osm", tmp_path / "b.osm"
    tag = f'<tag k="{key}" v="Ł &lt;&amp;"/>'
    way = f'<way id="7" version="2"><nd ref="1"/><nd ref="2"/>{tag}</way>\n'
    rest = '<relation id="9"><member type="way" ref="7" role="from"/></relation>\n'
    nodes = [f'<node id="{i}" lat="4{i}.5" lon="-1.25">{tag}</node>\n' for i in range(4)]
    text = f"<osm>{way}<bounds/>{rest}{''.join(nodes)}</osm>"
    source.write_text(text, encoding="utf-8")
    refs = {node for item in items(source, source, Silent()) for node in item.way_nodes}
    write_roads(source, source, refs, out, Silent())
    kept = (way if left else "") + rest + "".join(nodes[i] for i in left)
    head = "<?xml version='1.0' encoding='UTF-8'?>\n<osm version=\"0.6\">\n"
    assert out.read_text(encoding="utf-8") == f"{head}{kept}</osm>\n"


# --- protocol buffers -----------------------------------------------------------------------------


def varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def zigzag(value: int) -> int:
    return value << 1 if value >= 0 else (-value << 1) - 1


def steps(values: list[int]) -> bytes:
    return b"".join(varint(zigzag(b - a)) for a, b in zip([0, *values], values, strict=False))


def blob(kind: bytes, content: bytes) -> bytes:
    packed = field(2, len(content)) + field(3, zlib.compress(content))
    header = field(1, kind) + field(3, len(packed))
    return struct.pack(">I", len(header)) + header + packed


def as_pbf(osm: Path, *, dense: bool) -> bytes:
    """An extract packed as the wiki describes the format."""
    root = parse_xml(osm.read_bytes(), "osm")
    texts: list[str] = [""]

    def number(text: str) -> int:
        if text not in texts:
            texts.append(text)
        return texts.index(text)

    def tags(item: object) -> list[tuple[int, int]]:
        return [(number(tag.get("k")), number(tag.get("v"))) for tag in item.iter("tag")]  # type: ignore[attr-defined]

    def place(text: str | None) -> int:
        return round(float(text or 0) * 1e7)

    nodes = list(root.iter("node"))
    if dense:
        keys = b"".join(
            b"".join(varint(k) + varint(v) for k, v in tags(node)) + b"\0" for node in nodes
        )
        columns = [steps([int(node.get("id", "")) for node in nodes])]
        columns += [steps([place(node.get(key)) for node in nodes]) for key in ("lat", "lon")]
        fields = zip((1, 8, 9, 10), [*columns, keys], strict=True)
        group = field(2, b"".join(field(n, content) for n, content in fields))
    else:
        group = b""
        for node in nodes:
            pairs = tags(node)
            content = field(1, zigzag(int(node.get("id", ""))))
            content += field(2, b"".join(varint(k) for k, _ in pairs))
            content += field(3, b"".join(varint(v) for _, v in pairs))
            content += field(8, zigzag(place(node.get("lat"))))
            group += field(1, content + field(9, zigzag(place(node.get("lon")))))
    ways = b""
    for way in root.iter("way"):
        pairs = tags(way)
        content = field(1, int(way.get("id", ""))) + field(2, b"".join(varint(k) for k, _ in pairs))
        content += field(3, b"".join(varint(v) for _, v in pairs))
        ways += field(
            3, content + field(8, steps([int(nd.get("ref", "")) for nd in way.iter("nd")]))
        )
    table = b"".join(field(1, text.encode()) for text in texts)
    block = field(1, table) + field(2, group) + field(2, ways)
    return HEADER + blob(b"OSMData", block)


HEADER = blob(b"OSMHeader", field(4, b"OsmSchema-V0.6"))


@pytest.mark.parametrize("dense", [True, False])
def test_protocol_buffers_make_the_same_network(
    dense: bool, town: Scenario, tmp_path: Path
) -> None:
    (tmp_path / "town.osm.pbf").write_bytes(as_pbf(TOWN, dense=dense))
    assert made(tmp_path / "a", tmp_path / "town.osm.pbf") == 0
    assert read_scenario(tmp_path / "a").network.read() == town.network.read()


def restriction() -> bytes:
    """A block with one relation."""
    table = b"".join(field(1, text) for text in (b"", b"via", b"type", b"restriction <&>"))
    content = field(1, 5) + field(2, varint(2)) + field(3, varint(3)) + field(8, varint(1) * 2)
    content += field(9, steps([7, 4])) + field(10, varint(0) + varint(1))
    return blob(b"OSMData", field(1, table) + field(2, field(4, content)))


def test_relations_are_unpacked(tmp_path: Path) -> None:
    (tmp_path / "x.pbf").write_bytes(HEADER + restriction())
    unpack(tmp_path / "x.pbf", tmp_path / "x.osm", Silent())
    (relation,) = parse_xml((tmp_path / "x.osm").read_bytes(), "x").iter("relation")
    assert [dict(item.attrib) for item in relation] == [
        {"type": "node", "ref": "7", "role": "via"},
        {"type": "way", "ref": "4", "role": "via"},
        {"k": "type", "v": "restriction <&>"},
    ]


def other_packing() -> bytes:
    packed = field(2, 4) + field(4, b"lzma")
    header = field(1, b"OSMData") + field(3, len(packed))
    return HEADER + struct.pack(">I", len(header)) + header + packed


def bomb() -> bytes:
    return HEADER + blob(b"OSMData", bytes(40 << 20))


def test_without_pyosmium_the_way_out_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "osmium", None)
    (tmp_path / "town.osm.pbf").write_bytes(as_pbf(TOWN, dense=True))
    assert made(tmp_path / "a", tmp_path / "town.osm.pbf") == 2
    assert "needs pyosmium; run pip install 'osmium>=4'" in capsys.readouterr().err
    assert made(tmp_path / "b", TOWN) == 0


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (as_pbf(TOWN, dense=True)[:-30], "damaged (PBF error: unexpected EOF)"),
        (b"<osm/>" * 9, "not an OpenStreetMap .pbf"),
        (other_packing(), "osmium cat bad.pbf -o extract.osm.gz"),
        (bomb(), "not an OpenStreetMap .pbf, or damaged (PBF error"),
    ],
    ids=["cut", "no pbf", "other packing", "bomb"],
)
def test_protocol_buffers_that_are_wrong(
    content: bytes, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.pbf").write_bytes(content)
    assert made(tmp_path / "a", tmp_path / "bad.pbf") == 2
    assert says in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["bad.pbf"]


# --- bad input ------------------------------------------------------------------------------------

NO_LIGHTS = TOWN.read_text().replace("traffic_signals", "none")
NO_ROADS = TOWN.read_text().replace('k="highway" v="primary"', 'k="x" v="y"').replace(
    'k="highway" v="secondary"', 'k="x" v="y"'
)  # fmt: skip


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (NO_LIGHTS, "bad.osm: no traffic light in it (no node with highway=traffic_signals)"),
        (NO_ROADS, "bad.osm: no road for cars in it"),
        ("<net>\n</net>", "line 1: an OpenStreetMap extract begins with <osm>, this with <net>"),
        (TOWN.read_text()[:900], "bad.osm: not well-formed XML"),
        ('<!DOCTYPE osm [<!ENTITY a "b">]><osm>&a;</osm>', "document types and entities"),
        ('<!DOCTYPE osm SYSTEM "http://localhost/x"><osm/>', "document types and entities"),
    ],
    ids=["no lights", "no roads", "net", "cut", "entity", "external"],
)
def test_extracts_that_are_wrong(
    content: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.osm").write_text(content)
    assert made(tmp_path / "a", tmp_path / "bad.osm") == 2
    assert says in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["bad.osm"]


def joined_crossroads(*relations: str, first: str = "") -> str:
    """A crossroads whose lights are mapped at the stop lines, so that its nodes are joined."""
    arms = {1000: (0.0, -0.004), 1001: (0.0, 0.004), 1002: (-0.0027, 0.0), 1003: (0.0027, 0.0)}
    light = '<tag k="highway" v="traffic_signals"/>'
    nodes, ways = ['<node id="1" lat="48" lon="11"/>'], list[str]()
    for number, (way, (north, east)) in enumerate(arms.items(), 2):
        for node, share, tag in ((number, 1.0, ""), (number + 10, 0.0335, light)):
            place = f'lat="{48 + share * north:.8f}" lon="{11 + share * east:.8f}"'
            nodes.append(f'<node id="{node}" {place}>{tag}</node>')
        order = (number, number + 10, 1) if way % 2 == 0 else (1, number + 10, number)
        along = "".join(f'<nd ref="{node}"/>' for node in order)
        tags = first if way == 1000 else '<tag k="maxspeed" v="50"/>'
        ways.append(f'<way id="{way}">{along}<tag k="highway" v="primary"/>{tags}</way>')
    return f'<osm version="0.6">{"".join((*nodes, *ways, *relations))}</osm>'


def restriction_xml(kind: str, start: int, goal: int, via: str = "1", more: str = "") -> str:
    kind_of_via = "way" if len(via) > 2 else "node"
    return (
        f'<relation id="9"><member type="way" ref="{start}" role="from"/>'
        f'<member type="{kind_of_via}" ref="{via}" role="via"/>'
        f'<member type="way" ref="{goal}" role="to"/><tag k="type" v="restriction"/>'
        f'<tag k="restriction" v="{kind}"/>{more}</relation>'
    )


@pytest.mark.parametrize(
    ("relation", "forbidden"),
    [
        ("", set()),
        (restriction_xml("no_left_turn", 1000, 1003), {1003}),
        (restriction_xml("only_straight_on", 1000, 1001), {1002, 1003}),
        (restriction_xml("no_left_turn", 1000, 1003, more='<tag k="except" v="motorcar"/>'), set()),
        # netconvert does not name the fifth node of a junction, nor a way that is within one
        (restriction_xml("no_left_turn", 1000, 1003, via="99"), {1003}),
        (restriction_xml("only_straight_on", 1000, 1001, via="555"), {1002, 1003}),
    ],
)
def test_turns_that_the_map_forbids_at_a_joined_junction_are_taken_out(
    relation: str, forbidden: set[int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    crossroads = joined_crossroads(relation)
    if 'ref="99"' in relation:
        crossroads = crossroads.replace('"1"', '"99"')
    (tmp_path / "x.osm").write_text(crossroads)
    assert made(tmp_path / "city", tmp_path / "x.osm") == 0
    (light,) = Network.read(read_scenario(tmp_path / "city")).intersections
    assert light.id.startswith("cluster")

    def way(edge: str) -> int:
        return int(edge.removeprefix("-").partition("#")[0])

    turns = {way(k.to_edge) for k in light.links if way(k.from_edge) == 1000}
    assert turns == {1001, 1002, 1003} - forbidden
    said = capsys.readouterr().out
    assert (f"turns that the map forbids were taken out: {len(forbidden)}" in said) == bool(
        forbidden
    )
    assert "1 of 4 roads have no maxspeed on the map" in said and "primary 100" in said


def test_a_restriction_of_a_way_inside_a_joined_junction_is_noted() -> None:
    inside = Restriction("1000", "", "77", only=False)
    network = """<net><edge id="1000" from="a" to="cluster_1_2"/><edge id="5" from="cluster_1_2"
        to="b"/><junction id="cluster_1_2"/><connection from="1000" to="5"/></net>"""
    root = parse_xml(network.encode(), "n")
    assert forbidden_turns(root, [inside, Restriction("77", "2", "78", only=False)]) == ([], 2)
    assert forbidden_turns(root, [Restriction("8", "9", "78", only=False)]) == ([], 0)
    # from one junction over a way to another, which SUMO has no word for
    assert forbidden_turns(root, [Restriction("5", "", "1000", only=False)]) == ([], 1)
    # an edge keeps its last way on
    assert forbidden_turns(root, [Restriction("1000", "1", "5", only=False)]) == ([], 0)


def test_bus_lanes_are_not_for_cars(tmp_path: Path) -> None:
    tags = (
        '<tag k="maxspeed" v="50"/><tag k="lanes" v="3"/><tag k="lanes:forward" v="2"/>'
        '<tag k="lanes:backward" v="1"/><tag k="bus:lanes:forward" v="|designated"/>'
        '<tag k="vehicle:lanes:forward" v="|no"/>'
    )
    (tmp_path / "x.osm").write_text(joined_crossroads(first=tags))
    assert made(tmp_path / "city", tmp_path / "x.osm") == 0
    facts = survey(read_scenario(tmp_path / "city"))
    lanes = {road.edge.partition("#")[0]: road.lanes for road in facts.intersections[0].approaches}
    assert lanes["1000"] == 1


def test_a_direction_that_is_lost_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tags = '<tag k="maxspeed" v="50"/><tag k="lanes" v="2"/><tag k="busway:right" v="lane"/>'
    for name, first, told in (("a", tags, True), ("b", '<tag k="maxspeed" v="50"/>', False)):
        (tmp_path / "x.osm").write_text(joined_crossroads(first=first))
        assert made(tmp_path / name, tmp_path / "x.osm") == 0
        said = capsys.readouterr().out
        assert ("though not mapped as one-way: 1 (1000)" in said) == told


def test_lights_can_be_guessed(tmp_path: Path) -> None:
    (tmp_path / "dark.osm").write_text(NO_LIGHTS)
    assert made(tmp_path / "a", tmp_path / "dark.osm", "--guess-signals") == 0
    assert Network.read(read_scenario(tmp_path / "a")).intersections


def test_other_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert made(tmp_path / "a", tmp_path / "city.shp") == 2
    assert "give a file that ends in .osm" in capsys.readouterr().err


# --- crossings ------------------------------------------------------------------------------------


def crossroads(kind: str = "traffic_signals", **more: str) -> str:
    """A signalled crossroads with crossings 13 m from it in the west, east and north.

    150 m to the west people cross without a light.
    """

    def node(name: int, x: float, y: float, **tags: str) -> str:
        lat, lon = 48 + y / 111195, 11 + x / (111195 * math.cos(math.radians(48)))
        inner = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
        return f'<node id="{name}" lat="{lat:.7f}" lon="{lon:.7f}">{inner}</node>'

    def way(name: int, *refs: int, **tags: str) -> str:
        inner = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        inner += "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
        return f'<way id="{name}">{inner}</way>'

    road = {"highway": "secondary", "lanes": "2", "maxspeed": "50"}
    walk = {"highway": "crossing", "crossing": kind, **more}
    parts = [
        node(1, 0, 0, highway="traffic_signals"),
        *(node(2 + i, 300 * x, 300 * y) for i, (x, y) in enumerate(COMPASS)),
        *(node(6 + i, 13 * x, 13 * y, **walk) for i, (x, y) in enumerate(COMPASS[:3])),
        node(9, -150, 0, highway="crossing", crossing="uncontrolled"),
        way(100, 2, 9, 6, 1, **road), way(101, 1, 7, 3, **road), way(102, 1, 8, 4, **road),
        way(103, 5, 1, **road),
    ]  # fmt: skip
    return f'<osm version="0.6">{"".join(parts)}</osm>'


COMPASS = ((-1, 0), (1, 0), (0, 1), (0, -1))


@pytest.mark.parametrize("kind", ["traffic_signals", "marked"])
def test_crossings_are_where_the_extract_has_them(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = {"crossing:signals": "yes"} if kind == "marked" else {}
    (tmp_path / "x.osm").write_text(crossroads(kind, **more))
    assert made(tmp_path / "a", tmp_path / "x.osm") == 0
    said = capsys.readouterr().out
    assert "3 crossings for people on foot have a light" in said
    assert "1 crossings that have no light" in said
    scenario = read_scenario(tmp_path / "a")
    root = scenario.network.parse()
    crossed = {e.get("crossingEdges") for e in root.iter("edge") if e.get("function") == "crossing"}
    assert {frozenset(re.findall(r"10\d", edges or "")) for edges in crossed} == {
        frozenset({"100"}), frozenset({"101"}), frozenset({"102"})
    }  # fmt: skip
    (item,) = Network.read(scenario).intersections
    rules = RightOfWay(foes_of(root), {})
    assert len(item.crossings) == 3
    for walk in item.crossings:
        shown = [phase for phase in item.phases if phase[walk.index] == "G"]
        assert shown
        for phase in shown:
            crossing = {phase[k.index] for k in item.links if are_foes(k, walk, rules.foes)}
            assert crossing <= {"r", "g"}


def test_lit_crossings_that_are_joined_keep_their_light(tmp_path: Path) -> None:
    """Two carriageways cross 10 m apart, and netconvert joins their nodes."""
    text = crossroads()
    middle = text[text.index('<node id="9"') :].partition("</node>")[0] + "</node>"
    lat, lon = (float(re.findall(rf'{key}="([\d.]+)"', middle)[0]) for key in ("lat", "lon"))
    lit = '<tag k="highway" v="crossing"/><tag k="crossing" v="traffic_signals"/>'
    nodes = "".join(
        f'<node id="{name}" lat="{lat}" lon="{lon + metres / 74400:.7f}">{lit}</node>'
        for name, metres in ((9, 0), (10, 10))
    )
    text = text.replace(middle, nodes).replace('<nd ref="9"/>', '<nd ref="9"/><nd ref="10"/>')
    (tmp_path / "x.osm").write_text(text)
    assert made(tmp_path / "a", tmp_path / "x.osm") == 0
    network = Network.read(read_scenario(tmp_path / "a"))
    assert len(network.intersections) == 1
    assert network.uncontrolled == ("cluster_10_9",)


def test_crossings_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.osm").write_text(crossroads())
    made(tmp_path / "a", tmp_path / "x.osm")
    (item,) = survey(read_scenario(tmp_path / "a")).intersections
    assert (item.crossings, item.unserved_crossings, item.foot_phases) == (3, 0, 0)
    assert (item.clashes, item.uncontrolled) == ((), 0)
    capsys.readouterr()
    main(["scenario", "check", str(tmp_path / "a"), "--no-simulate"])
    assert "crossings" in capsys.readouterr().out


def test_a_green_across_a_crossing_is_a_finding(tmp_path: Path) -> None:
    """All links of a phase protected, all crossings green: through traffic runs people over."""
    (tmp_path / "x.osm").write_text(crossroads())
    made(tmp_path / "a", tmp_path / "x.osm")
    scenario = read_scenario(tmp_path / "a")
    (item,) = Network.read(scenario).intersections
    width = len(item.phases[0])
    walks = {walk.index for walk in item.crossings}
    start = item.links[0].from_edge
    own = {link.index for link in item.links if link.from_edge == start}
    bad = "".join("G" if i in walks | own else "r" for i in range(width))
    rest = "".join("g" if i not in walks | own else "r" for i in range(width))
    settings = scenario.settings.model_dump()
    settings |= {"intersections": {item.id: {"phases": [bad, rest]}}}
    spoilt = replace(scenario, settings=type(scenario.settings).model_validate(settings))
    facts = survey(spoilt)
    assert facts.intersections[0].clashes
    assert all(text.startswith(f"phase 0: {start} ") for text in facts.intersections[0].clashes)
    assert any("people on foot have green while vehicles" in text for text in problems(facts, ()))


def test_crossings_without_lights_stay_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.osm").write_text(crossroads("uncontrolled"))
    assert made(tmp_path / "a", tmp_path / "x.osm") == 0
    assert "4 crossings that have no light" in capsys.readouterr().out
    (item,) = Network.read(read_scenario(tmp_path / "a")).intersections
    assert item.crossings == ()
    assert len(item.incoming_lanes) == 4


def test_a_light_for_a_crossing_alone_may_be_told_what_to_show(town: Scenario) -> None:
    """Derived, its phases leave no choice to who sees vehicles; listed, they are what was asked."""
    settings = town.settings.model_dump()
    settings["intersections"]["8"] = {"phases": ["GGr", "rrG"]}
    told = replace(town, settings=type(town.settings).model_validate(settings))
    assert "8" in {item.id for item in Network.read(told).intersections}
    assert survey(told).intersections[0].foot_phases == 1


def test_metres_of_a_place_are_those_of_utm() -> None:
    """The middle of a zone at the equator, and a published point: the CN Tower."""
    assert utm(9.0, 0.0, 32) == pytest.approx((5e5, 0.0), abs=1e-6)
    assert utm(-(79 + 23 / 60 + 13.7 / 3600), 43 + 38 / 60 + 33.24 / 3600, 17) == pytest.approx(
        (630084, 4833439), abs=1.0
    )


def test_a_node_without_a_place_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.osm").write_text(re.sub(r'(<node id="6") lat="[^"]*"', r"\1", crossroads()))
    assert made(tmp_path / "a", tmp_path / "bad.osm") == 2
    assert "line 1: the node '6' has no lon and lat" in capsys.readouterr().err
    for lat in ("999", "north", "nan"):  # of a node that is not a crossing, only part of a road
        text = re.sub(r'(<node id="4") lat="[^"]*"', rf'\1 lat="{lat}"', TOWN.read_text())
        (tmp_path / "bad.osm").write_text(text)
        assert made(tmp_path / "a", tmp_path / "bad.osm") == 2
        assert "bad.osm, line 8: the node '4' has no lon and lat" in capsys.readouterr().err
    (tmp_path / "bad.osm").write_text(TOWN.read_text().replace('<way id="', '<way id="x'))
    assert made(tmp_path / "a", tmp_path / "bad.osm") == 2
    assert "bad.osm: netconvert: Error: Attribute 'id'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["bad.osm"]
