"""Scenarios from boxes of an OpenStreetMap extract, chosen by a seed.

``python -m studies.osm_extracts city.osm.pbf --seed 1 --out towns`` cuts boxes around signals drawn
at random, and makes a scenario of each that has 3 to 10 intersections, overlaps no other one and
passes the check. The demand is scaled to a drawn load (`degrees_of_saturation`). Boxes that do not
fit are named with the reason, but for those that overlap another. It needs the extra ``osm``; no
data come with the suite.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import osmium
from osmium import osm

from ugat_marl.cli import guarded
from ugat_marl.errors import OutputError, ScenarioError, require_least
from ugat_marl.experiments import problems
from ugat_marl.progress import Silent
from ugat_marl.scenarios import (
    Scenario,
    degrees_of_saturation,
    from_osm,
    from_turning_shares,
    make_scenario,
    survey,
)
from ugat_marl.seeding import derive_seed, numpy_generator

METRES_PER_DEGREE = 111_320.0
"""Length of a degree of latitude, m."""
SIDES_M = (200.0, 600.0)
"""Least and largest side of a box, m."""
INTERSECTIONS = (3, 10)
"""Least and largest number of agents in a box."""
LOAD = (0.3, 1.1)
TURNS = (0.2, 0.6, 0.2)
"""Shares of left turns, straight on and right turns."""
DURATION_S = 1800.0
REFERENCE_VPH = 300.0
REFERENCE_S = 14400.0
"""Demand and time of the draft from which the load is scaled: long, so that chance averages out."""
MOST_BOXES = 200
"""Most boxes tried."""


@dataclass(frozen=True)
class Box:
    """Bounds in degrees."""

    west: float
    south: float
    east: float
    north: float

    @classmethod
    def around(cls, place: tuple[float, float], side_m: float) -> Box:
        """Return a square around (longitude, latitude)."""
        longitude, latitude = place
        high = side_m / METRES_PER_DEGREE / 2
        wide = high / math.cos(math.radians(latitude))
        return cls(longitude - wide, latitude - high, longitude + wide, latitude + high)

    def holds(self, place: tuple[float, float]) -> bool:
        """Return True if a place (longitude, latitude) is inside."""
        return self.west <= place[0] <= self.east and self.south <= place[1] <= self.north

    def overlaps(self, other: Box) -> bool:
        """Return True if the boxes share an area."""
        return (
            self.west < other.east
            and other.west < self.east
            and self.south < other.north
            and other.south < self.north
        )


@dataclass(frozen=True)
class Extract:
    """Places in an extract.

    Attributes:
        path: The file.
        places: Node to longitude and latitude.
        signals: Places of nodes with a traffic light, in the order of the file.
        largest_way: Largest id of a way.
    """

    path: Path
    places: dict[int, tuple[float, float]]
    signals: tuple[tuple[float, float], ...]
    largest_way: int


def read_extract(path: Path) -> Extract:
    """Read the places of an extract.

    Raises:
        ScenarioError: The file is missing or damaged, or no node is a traffic light.
    """
    places: dict[int, tuple[float, float]] = {}
    signals: list[tuple[float, float]] = []
    largest = 0
    try:
        for item in osmium.FileProcessor(str(path)):
            if isinstance(item, osm.Node):
                places[item.id] = (item.location.lon, item.location.lat)
                if item.tags.get("highway") == "traffic_signals":
                    signals.append(places[item.id])
            elif isinstance(item, osm.Way):
                largest = max(largest, item.id)
    except (RuntimeError, osmium.InvalidLocationError) as error:
        raise ScenarioError(
            f"{path}: not an OpenStreetMap extract, or damaged ({error}); give an .osm.pbf or .osm"
        ) from None
    if not signals:
        raise ScenarioError(f"{path}: no node is a traffic light (highway=traffic_signals)")
    return Extract(path, places, tuple(signals), largest)


def cut(extract: Extract, box: Box, out: Path) -> None:
    """Write the part of an extract inside a box.

    A way that leaves the box is cut at its last node inside; each further part is a way of its own.
    Turn restrictions stay if all their members are inside.
    """
    inside = {node for node, place in extract.places.items() if box.holds(place)}
    kept = {"n": inside, "w": set[int]()}
    number = extract.largest_way
    with osmium.SimpleWriter(str(out), overwrite=True) as writer:
        for item in osmium.FileProcessor(str(extract.path)):
            if isinstance(item, osm.Node) and item.id in inside:
                writer.add_node(item)
            elif isinstance(item, osm.Way):
                way = item.id
                for part in _parts([node.ref for node in item.nodes], inside):
                    writer.add_way(item.replace(id=way, nodes=part))
                    kept["w"].add(way)
                    number += 1
                    way = number
            elif (
                isinstance(item, osm.Relation)
                and item.tags.get("type") == "restriction"
                and all(member.ref in kept.get(member.type, ()) for member in item.members)
            ):
                writer.add_relation(item)


def _parts(nodes: Sequence[int], inside: set[int]) -> Iterator[list[int]]:
    """Yield the runs of two or more nodes that are inside."""
    part: list[int] = []
    for node in (*nodes, None):
        if node in inside:
            part.append(node)
            continue
        if len(part) > 1:
            yield part
        part = []


def make(
    cut_out: Path, target: Path, vph: float, duration_s: float, seed: int, command: str
) -> Scenario:
    """Make a scenario of the streets in a cut.

    Args:
        cut_out: The cut.
        target: The directory to make.
        vph: Vehicles per hour at each entry.
        duration_s: Length of an episode, s.
        seed: Seed of the vehicles.
        command: Command that makes the scenario again, for the README.
    """
    made = make_scenario(
        target,
        from_osm(cut_out, guess=False),
        from_turning_shares(vph, TURNS, 0.0, duration_s, seed),
        settings={"duration_s": duration_s},
        command=command,
        force=False,
        reporter=Silent(),
    )
    return made.scenario


def try_box(extract: Extract, box: Box, load: float, target: Path, seed: int, command: str) -> str:
    """Make a scenario of a box.

    Args:
        extract: The extract.
        box: The box.
        load: Degree of saturation of the busiest intersection.
        target: The directory to make.
        seed: Seed of the vehicles.
        command: Command that makes the scenario again, for the README.

    Returns:
        The reason if the box does not fit; else an empty text.
    """
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        cut_out = Path(name) / f"{target.name}.osm"
        cut(extract, box, cut_out)
        try:
            draft = make(cut_out, Path(name) / "draft", REFERENCE_VPH, REFERENCE_S, seed, "")
            facts = survey(draft)
            if not INTERSECTIONS[0] <= len(facts.intersections) <= INTERSECTIONS[1]:
                return f"{len(facts.intersections)} intersections"
            if faults := problems(facts, ()):
                return faults[0]
            busiest = max(degrees_of_saturation(draft).values())
            if not 0 < busiest < math.inf:
                return "an intersection has traffic that no phase serves"
            vph = REFERENCE_VPH * load / busiest
            scenario = make(cut_out, target, vph, DURATION_S, seed, command)
        except ScenarioError as error:
            return str(error).replace(str(cut_out), "its part of the extract")
    print(
        f"{target}: {len(facts.intersections)} intersections, load {load:.2f}, "
        f"{vph:.0f} vehicles an hour at each entry, {scenario.hash[:8]}"
    )
    return ""


def make_all(extract: Extract, seed: int, out: Path, count: int) -> int:
    """Make the scenarios and return how many there are.

    Raises:
        OutputError: The folder holds something.
    """
    if out.is_dir() and any(out.iterdir()):
        raise OutputError(f"{out}: holds something already; give another folder, or empty it")
    path = extract.path
    random = numpy_generator(seed, "osm extracts")
    words = ["python", "-m", "studies.osm_extracts", path.name, "--seed", str(seed)]
    command = shlex.join([*words, "--out", out.name, "--count", str(count)])
    chosen: list[Box] = []
    for number in range(MOST_BOXES):
        place = extract.signals[int(random.integers(len(extract.signals)))]
        box = Box.around(place, float(random.uniform(*SIDES_M)))
        load = float(random.uniform(*LOAD))
        if any(box.overlaps(other) for other in chosen):
            continue
        target = out / f"{path.name.split('.')[0].lower()}-{len(chosen) + 1}"
        box_seed = derive_seed(seed, "box", number)
        if reason := try_box(extract, box, load, target, box_seed, command):
            print(f"box {number} is left out: {reason}")
            continue
        chosen.append(box)
        if len(chosen) == count:
            break
    return len(chosen)


def main(words: Sequence[str] | None = None) -> int:
    """Run the script; see its docstring."""
    parser = argparse.ArgumentParser(prog="python -m studies.osm_extracts", description=__doc__)
    parser.add_argument("file", type=Path, help="the extract, .osm.pbf or .osm")
    parser.add_argument("--seed", type=int, required=True, help="seed of boxes, loads, vehicles")
    parser.add_argument("--out", type=Path, required=True, help="folder for the scenarios")
    parser.add_argument("--count", type=int, default=3, help="number of scenarios (3)")
    given = parser.parse_args(words)
    require_least(1, count=given.count)
    made = make_all(read_extract(given.file), given.seed, given.out, given.count)
    if made < given.count:
        print(f"only {made} of {given.count} boxes were found", file=sys.stderr)
    return int(made < given.count)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.osm_extracts", main))
