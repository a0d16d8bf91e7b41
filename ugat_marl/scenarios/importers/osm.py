"""Streets from an OpenStreetMap extract of the user; nothing is downloaded.

netconvert converts the extract, with options for signals that a controller can use. Junctions
mapped as several nodes become one. Signals mapped before a junction belong to the junction. Lights
close to each other share one controller.
"""

from __future__ import annotations

import importlib
import math
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from ugat_marl.errors import OptionError, ScenarioError, counted, install_command
from ugat_marl.files import Tag, read_xml, scratch, write_whole
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.long_files import scan
from ugat_marl.scenarios.importers.making import NETWORK, RoadFiles, RoadSource
from ugat_marl.scenarios.importers.osm_crossings import LIT, crossings_for, has_light
from ugat_marl.scenarios.importers.osm_restrictions import (
    ForbiddenTurns,
    Restriction,
    deleted_connections,
    forbidden_turns,
    nodes_of,
    restriction_of,
)
from ugat_marl.scenarios.junctions import crossings_of, foes_of, links_of
from ugat_marl.scenarios.phases import are_foes
from ugat_marl.scenarios.settings import parse_decimal
from ugat_marl.scenarios.sumo_tools import netconvert, sumo_program

_ENDINGS = (".osm", ".osm.xml", ".osm.gz", ".osm.xml.gz", ".pbf")
_FOR_CARS = frozenset(
    {
        "motorway", "motorway_link", "trunk", "trunk_link", "primary", "primary_link", "secondary",
        "secondary_link", "tertiary", "tertiary_link", "unclassified", "residential",
        "living_street", "service", "road",
    }
)  # fmt: skip
_AGAIN = (
    "--tls.default-type", "static", "--tls.yellow.time", "3", "--tls.allred.time", "2",
    "--no-turnarounds", "--junctions.corner-detail", "5", "--output.street-names",
)  # fmt: skip
_OPTIONS = (
    "--geometry.remove", "--ramps.guess", "--roundabouts.guess",
    "--junctions.join", "--junctions.join-dist", "15",
    "--tls.guess-signals", "--tls.guess-signals.dist", "30",
    "--tls.join", "--tls.join-dist", "30",
    "--osm.turn-lanes", "--osm.lane-access",
    "--remove-edges.isolated", "--keep-edges.by-vclass", "passenger", *_AGAIN,
)  # fmt: skip


_ONE_WAY = frozenset({"oneway", "junction"})
"""Keys of ways that may lead in one direction only."""
_KINDS = frozenset({"highway", "railway"})
"""Keys of ways that SUMO's type map for OpenStreetMap contains."""


@dataclass(frozen=True)
class _Extract:
    """Facts about an extract that its conversion needs.

    Attributes:
        roads: Number of ways for cars.
        signals: Number of nodes with a traffic light.
        walks: Ids of nodes that are a traffic light at a pedestrian crossing.
        crossings: Longitude and latitude of crossings that may have a light, degrees.
        unlit: Number of crossings without a light.
        nodes: Ids of the nodes of roads and railways.
        no_speed: Class to the number of ways for cars without a speed limit.
        restrictions: Turn restrictions for cars.
        both_ways: Ids of the ways for cars that are not said to be one-way.
    """

    roads: int
    signals: int
    walks: frozenset[str]
    crossings: tuple[tuple[float, float], ...] = ()
    unlit: int = 0
    nodes: frozenset[str] = frozenset()
    no_speed: Counter[str] = field(default_factory=Counter)
    restrictions: tuple[Restriction, ...] = ()
    both_ways: frozenset[str] = frozenset()


def from_osm(path: Path, *, guess: bool, left_hand: bool = False) -> RoadSource:
    """Return a source of the streets of an extract.

    Args:
        path: The extract: ``.osm``, ``.osm.gz`` or ``.pbf``.
        guess: True if netconvert may add lights at large junctions without a light in the extract.
        left_hand: True if traffic keeps to the left.

    Raises:
        OptionError: The name of the file has another ending.
    """
    if not path.name.lower().endswith(_ENDINGS):
        raise OptionError(f"--osm {str(path)!r}: give a file that ends in {', '.join(_ENDINGS)}")

    def roads(folder: Path, reporter: Reporter) -> RoadFiles:
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            source = _as_xml(path, Path(name), reporter)
            extract = _look(source, path, reporter)
            if not extract.roads:
                raise ScenarioError(
                    f"{path}: no road for cars in it (no way with a highway=... tag)"
                )
            if not extract.signals and not guess:
                raise ScenarioError(
                    f"{path}: no traffic light in it (no node with highway=traffic_signals); "
                    "--guess-signals puts some at large junctions"
                )
            plain = Path(name) / "extract.osm"
            write_roads(source, path, extract.nodes, plain, reporter)
            try:
                more = (*(["--tls.guess"] * guess), *(["--lefthand"] * left_hand))
                notes = _convert(plain, extract, folder / NETWORK, Path(name), more)
            except ScenarioError as error:  # netconvert names no file
                raise ScenarioError(f"{path}: {error}") from None
            if not notes:
                raise ScenarioError(
                    f"{path}: none of its lights is within 30 m of a junction of roads for cars "
                    "(lights on plain roads are left out); --guess-signals puts some at large "
                    "junctions"
                )
        return RoadFiles(
            f"OpenStreetMap extract {path.name}",
            f"Converted from `{path.name}` by SUMO's netconvert. © OpenStreetMap contributors; the "
            "data are available under the Open Database Licence (openstreetmap.org/copyright).",
            settings={"control": {"phases": "conflict-free"}},
            derive=True,
            notes=tuple(notes),
            copied={NETWORK: path},
        )

    return roads


def _as_xml(path: Path, work: Path, reporter: Reporter) -> Path:
    """Return the path of the extract as XML."""
    if not path.name.lower().endswith(".pbf"):
        return path
    unpack(path, work / "unpacked.osm", reporter)
    return work / "unpacked.osm"


def _look(source: Path, path: Path, reporter: Reporter) -> _Extract:
    """Count roads and lights; refuse entities before any other program sees the file."""
    roads = signals = unlit = 0
    no_speed: Counter[str] = Counter()
    restrictions: list[Restriction] = []
    both_ways: set[str] = set()
    walks: set[str] = set()
    nodes: set[str] = set()
    crossings: list[tuple[float, float]] = []
    for element in items(source, path, reporter):
        tags = element.tags
        nodes.update(element.way_nodes)
        kind = tags.get("highway", "")
        if element.start.name == "way" and kind in _FOR_CARS:
            roads += 1
            no_speed[kind] += "maxspeed" not in tags
            if not _ONE_WAY & tags.keys() and not kind.startswith("motorway"):
                both_ways.add(element.start.attributes.get("id", ""))
        elif element.start.name == "relation":
            members = (tag for tag in element.inside if tag.name == "member")
            if restriction := restriction_of(tags, members):
                restrictions.append(restriction)
        if element.start.name != "node" or not tags:
            continue
        light = LIT in (tags.get("highway"), tags.get("crossing"))
        signals += light
        crossed = tags.get("crossing") not in (None, "no") or tags.get("highway") == "crossing"
        if light and crossed:
            walks.add(element.start.attributes.get("id", ""))
        if has_light(tags):
            crossings.append(place_of(element.start, path))
        else:
            unlit += tags.get("highway") == "crossing"
    return _Extract(
        roads,
        signals,
        frozenset(walks),
        tuple(crossings),
        unlit,
        frozenset(nodes),
        +no_speed,
        tuple(restrictions),
        frozenset(both_ways),
    )


def _convert(
    source: Path, extract: _Extract, out: Path, work: Path, more: Sequence[str]
) -> list[str]:
    types = sumo_program("netconvert").parent.parent / "data/typemap/osmNetconvert.typ.xml"
    arguments = ["--osm-files", str(source), "--type-files", str(types), *_OPTIONS, *more]
    if extract.crossings:
        arguments.append("--sidewalks.guess.from-permissions")
    made = work / "made.net.xml"
    netconvert(arguments, made)
    # Lights on plain roads, far from their junction, separate no conflicting streams and are
    # removed. Lights at crossings stay: they stop traffic for pedestrians.
    if idle := _idle_lights(made, extract.walks):
        netconvert([*arguments, "--tls.unset", ",".join(idle)], made)
    forbidden = ForbiddenTurns([], 0)
    if extract.restrictions:
        root = read_xml(made)
        forbidden = forbidden_turns(root, extract.restrictions)
    if forbidden.turns:
        _reconnect(deleted_connections(forbidden.turns), made, work)
    if extract.crossings:
        _add_crossings(extract, made, work)
    write_whole(out, made.read_bytes())
    root = read_xml(out)
    if not links_of(root):
        return []
    return [*_notes(extract, root, len(idle)), *_notes_on_ways(extract, root, types, forbidden)]


def _notes(extract: _Extract, root: ET.Element, idle: int) -> Iterator[str]:
    """Yield notes on the lights and crossings that were made, and on those that were left out."""
    yield (
        f"{extract.signals} lights in the extract make {len(links_of(root))} in the network, since "
        "those of one junction share a controller"
    )
    if idle:
        yield f"{idle} lights on plain roads were left out"
    walked = sum(len(crossings) for crossings in crossings_of(root).values())
    left = extract.unlit + max(0, len(extract.crossings) - walked)
    if walked:
        yield f"{walked} crossings for people on foot have a light; roads have sidewalks"
    if left:
        yield f"{left} crossings that have no light, or are at no road, were left out"


def _notes_on_ways(
    extract: _Extract, root: ET.Element, types: Path, forbidden: ForbiddenTurns
) -> Iterator[str]:
    """Yield notes on what the map does not say of its ways, and on what the network lacks of it."""
    if without := extract.no_speed.total():
        classes = read_xml(types).iter("type")
        limits = {kind.get("id"): float(kind.get("speed", "nan")) for kind in classes}
        kinds = ", ".join(
            f"{kind} {3.6 * limits.get(f'highway.{kind}', math.nan):.0f}"
            for kind, _ in extract.no_speed.most_common(3)
        )
        yield (
            f"{without} of {counted(extract.roads, 'road')} have no maxspeed on the map and get "
            f"SUMO's limits for their class, in km/h: {kinds}; set maxspeed in the extract where "
            "that is not so"
        )
    if turns := forbidden.turns:
        listed = ", ".join(f"{start} to {goal}" for start, goal in turns[:3])
        yield f"turns that the map forbids were taken out: {len(turns)} ({listed})"
    if forbidden.unplaced:
        yield (
            f"turn restrictions that were not taken over: {forbidden.unplaced}, within junctions "
            "joined from several nodes or over a way between two junctions; check the turns there"
        )
    ways = {edge.get("id", "").partition("#")[0] for edge in root.iter("edge")}
    if half := sorted(way for way in extract.both_ways if (way in ways) != (f"-{way}" in ways)):
        yield (
            f"roads with one direction for cars, though not mapped as one-way: {len(half)} "
            f"({', '.join(half[:3])}); look for lanes that are kept for buses"
        )


def _add_crossings(extract: _Extract, made: Path, work: Path) -> None:
    """Add crossings at lights, and rebuild programmes with green for them."""
    root = read_xml(made)
    if not (content := crossings_for(root, extract.crossings)):
        return
    _reconnect(content, made, work)


def _reconnect(connections: bytes, made: Path, work: Path) -> None:
    """Change the connections of a network, and rebuild its programmes."""
    listed, before = work / "changes.con.xml", work / "before.net.xml"
    listed.write_bytes(connections)
    made.replace(before)
    options = ("--sumo-net-file", str(before), "--connection-files", str(listed), "--tls.rebuild")
    netconvert([*options, *_AGAIN], made)


def _idle_lights(network: Path, walks: Iterable[str]) -> list[str]:
    """Return the junctions of lights without conflicting streams, except those with `walks`."""
    root = read_xml(network)
    foes = foes_of(root)
    kept = set(walks)
    idle: list[str] = []
    for links in links_of(root).values():
        junctions = {link.junction for link in links}
        contended = any(
            are_foes(a, b, foes) and a.from_edge != b.from_edge for a in links for b in links
        )
        nodes = {node for junction in junctions for node in nodes_of(junction)}
        if not contended and not nodes & kept:
            idle += sorted(junctions)
    return idle


class Item(NamedTuple):
    """A node, way or relation.

    Attributes:
        start: Opening tag of the item.
        inside: Its ``tag``, ``nd`` and ``member`` elements.
    """

    start: Tag
    inside: list[Tag]

    @property
    def tags(self) -> dict[str, str]:
        """Keys and values of its tags.

        A crossing that is now tagged ``crossing:signals=yes`` also has the former
        ``crossing=traffic_signals``, the only one that netconvert knows.
        """
        attributes = (tag.attributes for tag in self.inside if tag.name == "tag")
        tags = {tag.get("k", ""): tag.get("v", "") for tag in attributes}
        if tags.get("crossing:signals") == "yes" and tags.get("crossing") != "no":
            tags["crossing"] = LIT
        return tags

    @property
    def way_nodes(self) -> list[str]:
        """Ids of its nodes if it is a road or railway, else empty."""
        if self.start.name != "way" or not _KINDS & self.tags.keys():
            return []
        return [tag.attributes.get("ref", "") for tag in self.inside if tag.name == "nd"]


def unpack(path: Path, out: Path, reporter: Reporter) -> None:
    """Turn an extract in protocol buffers (``.osm.pbf``) into XML.

    Args:
        path: The ``.pbf``.
        out: The ``.osm`` to write.
        reporter: Shows progress.

    Raises:
        ScenarioError: pyosmium is not installed, or the file is missing or damaged.
        OutputError: There is no room for the result.
    """
    try:
        osmium: Any = importlib.import_module("osmium")
    except ImportError:
        raise ScenarioError(
            f"{path}: reading .osm.pbf needs pyosmium; run {install_command('osm')}, or give "
            "the extract as .osm or .osm.gz"
        ) from None
    try:
        with path.open("rb"), reporter.task(f"unpacking {path.name}", 1) as advance:
            source, target = osmium.io.File(str(path), "pbf"), osmium.io.File(str(out), "osm")
            with scratch(), osmium.SimpleWriter(target) as writer:
                osmium.apply(source, writer)
            advance()
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file") from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except RuntimeError as error:  # libosmium raises no other exception
        raise ScenarioError(
            f"{path}: not an OpenStreetMap .pbf, or damaged ({error}); copy it again, or convert "
            f"it with: osmium cat {path.name} -o extract.osm.gz"
        ) from None


def items(source: Path, path: Path, reporter: Reporter) -> Iterator[Item]:
    """Yield all items of an extract of any length.

    Args:
        source: The extract as XML, packed or not.
        path: Name of the extract in errors.
        reporter: Shows progress.

    Raises:
        ScenarioError: As for `scan`, or the file is not an OpenStreetMap extract.
    """
    current: Item | None = None
    try:
        for number, tag in enumerate(scan(source, reporter)):
            if not number and tag.name != "osm":
                raise ScenarioError(
                    f"{path}, line {tag.line}: an OpenStreetMap extract begins with <osm>, this "
                    f"with <{tag.name}>"
                )
            if tag.name in ("node", "way", "relation"):
                if current:
                    yield current
                current = Item(tag, [])
            elif current and tag.name in ("tag", "nd", "member"):
                current.inside.append(tag)
    except ScenarioError as error:
        raise ScenarioError(str(error).replace(str(source), str(path))) from None
    if current:
        yield current


def write_roads(
    source: Path, path: Path, nodes: Collection[str], out: Path, reporter: Reporter
) -> None:
    """Write the roads, railways and relations of an extract.

    netconvert would keep all other items, mostly buildings, in memory.

    Args:
        source: The extract as XML, packed or not.
        path: Name of the extract in errors.
        nodes: Ids of the nodes of its roads and railways, see `Item.way_nodes`.
        out: The file to write.
        reporter: Shows progress.

    Raises:
        OutputError: There is no room for the file.
        ScenarioError: A node of a road has no valid coordinates.
    """
    with scratch(), out.open("w", encoding="utf-8") as file:
        file.write("<?xml version='1.0' encoding='UTF-8'?>\n<osm version=\"0.6\">\n")
        for element in items(source, path, reporter):
            start = element.start
            corner = start.name == "node" and start.attributes.get("id") in nodes
            if corner:
                place_of(start, path)  # netconvert would complain without a line
            if corner or start.name == "relation" or element.way_nodes:
                kept = element.inside
                lit = (
                    f'<tag k="crossing" v="{LIT}"/>' if element.tags.get("crossing") == LIT else ""
                )
                if lit:
                    kept = [tag for tag in kept if tag.attributes.get("k") != "crossing"]
                inside = "".join(f"{_open(tag)}/>" for tag in kept)
                file.write(f"{_open(start)}>{inside}{lit}</{start.name}>\n")
        file.write("</osm>\n")


def _open(tag: Tag) -> str:
    values = "".join(f" {key}={quoteattr(value)}" for key, value in tag.attributes.items())
    return f"<{tag.name}{values}"


def place_of(node: Tag, path: Path) -> tuple[float, float]:
    """Return longitude and latitude of a node, degrees.

    Raises:
        ScenarioError: The node has no valid coordinates; the message names the line.
    """
    try:
        longitude, latitude = (parse_decimal(node.attributes[key]) for key in ("lon", "lat"))
    except (KeyError, ValueError):
        longitude = latitude = math.nan
    if not (abs(longitude) <= 180 and abs(latitude) <= 90):
        name = node.attributes.get("id", "")
        raise ScenarioError(
            f"{path}, line {node.line}: the node {name!r} has no lon and lat in degrees"
        )
    return longitude, latitude
