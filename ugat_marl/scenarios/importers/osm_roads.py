"""An OpenStreetMap extract read item by item, and the part of it that roads are made of."""

from __future__ import annotations

import importlib
import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from ugat_marl.errors import ScenarioError
from ugat_marl.files import Tag, scratch
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.reading import scan

_KINDS = frozenset({"highway", "railway"})
"""Keys of the ways that SUMO's table of OpenStreetMap's types knows."""


class Item(NamedTuple):
    """A node, way or relation.

    Attributes:
        start: Its own tag.
        inside: What it holds: ``tag``, ``nd`` and ``member`` elements.
    """

    start: Tag
    inside: list[Tag]

    @property
    def tags(self) -> dict[str, str]:
        """Its keys and values."""
        found = (tag.attributes for tag in self.inside if tag.name == "tag")
        return {tag.get("k", ""): tag.get("v", "") for tag in found}

    @property
    def way_nodes(self) -> list[str]:
        """The nodes of a road or railway; none of anything else."""
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
        ScenarioError: pyosmium is not installed, or the file is missing, cut short, damaged or
            compressed in another way than zlib.
        OutputError: No room for the result.
    """
    try:
        osmium: Any = importlib.import_module("osmium")
    except ImportError:
        raise ScenarioError(
            f"{path}: reading .osm.pbf needs pyosmium; run pip install 'ugat-marl[osm]', or give "
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
    except RuntimeError as error:  # all that libosmium raises
        raise ScenarioError(
            f"{path}: not an OpenStreetMap .pbf, or damaged ({error}); copy it again, or convert "
            f"it with: osmium cat {path.name} -o extract.osm.gz"
        ) from None


def items(source: Path, path: Path, reporter: Reporter) -> Iterator[Item]:
    """All items of an extract of any length.

    Args:
        source: The extract as XML, packed or not.
        path: What to call it in errors.
        reporter: Shows progress.

    Raises:
        ScenarioError: As for `scan`, or another kind of XML.
    """
    item: Item | None = None
    try:
        for number, tag in enumerate(scan(source, reporter)):
            if not number and tag.name != "osm":
                raise ScenarioError(
                    f"{path}, line {tag.line}: an OpenStreetMap extract begins with <osm>, this "
                    f"with <{tag.name}>"
                )
            if tag.name in ("node", "way", "relation"):
                if item:
                    yield item
                item = Item(tag, [])
            elif item and tag.name in ("tag", "nd", "member"):
                item.inside.append(tag)
    except ScenarioError as error:
        raise ScenarioError(str(error).replace(str(source), str(path))) from None
    if item:
        yield item


def write_roads(
    source: Path, path: Path, nodes: Collection[str], out: Path, reporter: Reporter
) -> None:
    """Writes what netconvert looks at; it holds all it is given in memory, most of it buildings.

    Args:
        source: The extract as XML, packed or not.
        path: What to call it in errors.
        nodes: The nodes of its roads and railways, see `Item.way_nodes`.
        out: The file to write.
        reporter: Shows progress.

    Raises:
        OutputError: No room for it.
        ScenarioError: A node of a road is nowhere on earth.
    """
    with scratch(), out.open("w", encoding="utf-8") as file:
        file.write("<?xml version='1.0' encoding='UTF-8'?>\n<osm version=\"0.6\">\n")
        for item in items(source, path, reporter):
            start = item.start
            corner = start.name == "node" and start.attributes.get("id") in nodes
            if corner:
                place_of(start, path)  # netconvert would complain without a line
            if corner or start.name == "relation" or item.way_nodes:
                inside = "".join(f"{_open(tag)}/>" for tag in item.inside)
                file.write(f"{_open(start)}>{inside}</{start.name}>\n")
        file.write("</osm>\n")


def _open(tag: Tag) -> str:
    values = "".join(f" {key}={quoteattr(value)}" for key, value in tag.attributes.items())
    return f"<{tag.name}{values}"


def place_of(node: Tag, path: Path) -> tuple[float, float]:
    """Longitude and latitude of a node, degrees.

    Raises:
        ScenarioError: It has none; names the line.
    """
    try:
        longitude, latitude = (float(node.attributes[key]) for key in ("lon", "lat"))
    except (KeyError, ValueError):
        longitude = latitude = math.nan
    if not (abs(longitude) <= 180 and abs(latitude) <= 90):
        name = node.attributes.get("id", "")
        raise ScenarioError(
            f"{path}, line {node.line}: the node {name!r} has no lon and lat in degrees"
        )
    return longitude, latitude
