"""Streets from an OpenStreetMap extract the user has; nothing is downloaded.

netconvert does the work, with the options that give signals a controller can use: junctions that
are mapped as several nodes become one, signals mapped before a junction belong to it, and lights
close to each other share one controller.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import parse_xml, read_bytes, write_whole
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.days import sumo_program
from ugat_marl.scenarios.importers.making import NETWORK, Draft, Roads
from ugat_marl.scenarios.importers.osm_roads import items, place_of, unpack, write_roads
from ugat_marl.scenarios.importers.osm_walks import crossings_for, has_light
from ugat_marl.scenarios.importers.programs import netconvert
from ugat_marl.scenarios.junctions import crossings_of, foes_of, links_of
from ugat_marl.scenarios.phases import are_foes

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
    "--remove-edges.isolated", "--keep-edges.by-vclass", "passenger", *_AGAIN,
)  # fmt: skip


@dataclass(frozen=True)
class _Extract:
    """What an extract holds for us.

    Attributes:
        roads: Ways for cars.
        signals: Nodes with a traffic light.
        walks: Those of them that are a crossing for people on foot, by their ids.
        crossings: Longitude and latitude of crossings that may have a light.
        unlit: Crossings without one.
        nodes: Nodes of roads and railways.
    """

    roads: int
    signals: int
    walks: frozenset[str]
    crossings: tuple[tuple[float, float], ...] = ()
    unlit: int = 0
    nodes: frozenset[str] = frozenset()


def from_osm(path: Path, *, guess: bool) -> Roads:
    """The streets of an extract.

    Args:
        path: ``.osm``, ``.osm.gz`` or ``.pbf``.
        guess: Whether netconvert may put lights at large junctions that have none in the extract.

    Raises:
        OptionError: Another kind of file, by its name.
    """
    if not path.name.lower().endswith(_ENDINGS):
        raise OptionError(f"--osm {str(path)!r}: give a file that ends in {', '.join(_ENDINGS)}")

    def roads(folder: Path, reporter: Reporter) -> Draft:
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
                notes = _convert(plain, extract, folder / NETWORK, Path(name), guess=guess)
            except ScenarioError as error:  # netconvert names no file
                raise ScenarioError(f"{path}: {error}") from None
            if not notes:
                raise ScenarioError(
                    f"{path}: none of its lights is at a road for cars; --guess-signals puts some "
                    "at large junctions"
                )
        return Draft(
            f"OpenStreetMap extract {path.name}",
            f"Converted from `{path.name}` by SUMO's netconvert. © OpenStreetMap contributors; the "
            "data are available under the Open Database Licence (openstreetmap.org/copyright).",
            settings={"control": {"phases": "conflict-free"}},
            derive=True,
            notes=tuple(notes),
        )

    return roads


def _as_xml(path: Path, work: Path, reporter: Reporter) -> Path:
    """The extract as XML."""
    if not path.name.lower().endswith(".pbf"):
        return path
    unpack(path, work / "unpacked.osm", reporter)
    return work / "unpacked.osm"


def _look(source: Path, path: Path, reporter: Reporter) -> _Extract:
    """Counts roads and lights; refuses entities before any other program sees the file."""
    roads = signals = unlit = 0
    walks: set[str] = set()
    nodes: set[str] = set()
    crossings: list[tuple[float, float]] = []
    for item in items(source, path, reporter):
        tags = item.tags
        nodes.update(item.way_nodes)
        roads += item.start.name == "way" and tags.get("highway") in _FOR_CARS
        if item.start.name != "node" or not tags:
            continue
        light = "traffic_signals" in (tags.get("highway"), tags.get("crossing"))
        signals += light
        if light and ("crossing" in tags or tags.get("highway") == "crossing"):
            walks.add(item.start.attributes.get("id", ""))
        if has_light(tags):
            crossings.append(place_of(item.start, path))
        else:
            unlit += tags.get("highway") == "crossing"
    return _Extract(roads, signals, frozenset(walks), tuple(crossings), unlit, frozenset(nodes))


def _convert(source: Path, extract: _Extract, out: Path, work: Path, *, guess: bool) -> list[str]:
    types = sumo_program("netconvert").parent.parent / "data/typemap/osmNetconvert.typ.xml"
    arguments = ["--osm-files", str(source), "--type-files", str(types), *_OPTIONS]
    if guess:
        arguments.append("--tls.guess")
    if extract.crossings:
        arguments.append("--sidewalks.guess.from-permissions")
    made = work / "made.net.xml"
    netconvert(arguments, made)
    # What is left of lights on plain roads, far from the junction they belong to, stops nobody's
    # foes; those at crossings do stop the traffic for people on foot.
    if idle := _idle_lights(made, extract.walks):
        netconvert([*arguments, "--tls.unset", ",".join(idle)], made)
    if extract.crossings:
        _add_crossings(extract, made, work)
    write_whole(out, made.read_bytes())
    root = parse_xml(read_bytes(out), str(out))
    lights = len(links_of(root))
    if not lights:
        return []
    notes = [
        f"{extract.signals} lights in the extract make {lights} in the network, since those of one "
        "junction share a controller"
    ]
    if idle:
        notes.append(f"{len(idle)} lights on plain roads were left out")
    walked = sum(len(own) for own in crossings_of(root).values())
    left = extract.unlit + max(0, len(extract.crossings) - walked)
    if walked:
        notes.append(f"{walked} crossings for people on foot have a light; roads have sidewalks")
    if left:
        notes.append(f"{left} crossings that have no light, or are at no road, were left out")
    return notes


def _add_crossings(extract: _Extract, made: Path, work: Path) -> None:
    """Crossings at lights, and programmes that have green for them."""
    root = parse_xml(read_bytes(made), str(made))
    if not (content := crossings_for(root, extract.crossings)):
        return
    listed, before = work / "crossings.con.xml", work / "before.net.xml"
    listed.write_bytes(content)
    made.replace(before)
    options = ("--sumo-net-file", str(before), "--connection-files", str(listed), "--tls.rebuild")
    netconvert([*options, *_AGAIN], made)


def _idle_lights(network: Path, walks: Iterable[str]) -> list[str]:
    """Junctions of lights that no two streams contend for, without those at crossings."""
    root = parse_xml(read_bytes(network), str(network))
    foes = foes_of(root)
    kept = set(walks)
    found: list[str] = []
    for links in links_of(root).values():
        junctions = {link.junction for link in links}
        contended = any(
            are_foes(a, b, foes) and a.from_edge != b.from_edge for a in links for b in links
        )
        if not contended and not junctions & kept:
            found += sorted(junctions)
    return found
