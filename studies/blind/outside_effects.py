"""Effects outside the library: a diagnosis must not call their data explained."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass, replace
from typing import ClassVar

from studies.errors import BlindTestError
from ugat_marl.effects import (
    Effect,
    NumberParameter,
    TextParameter,
    edit_scenario,
    hashed_uniform,
    network_places,
)
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Document, Network, Scenario, seconds_text

STOP_BEFORE_LINE_M = 30.0
"""Metres before the stop line at which buses stop and cars turn off.

The place is between the advance and the stop detectors.
"""


@dataclass(frozen=True)
class BusStops(Effect):
    """Buses on the most usual route over an edge that stop there in their lane."""

    name: ClassVar[str] = "bus_stops"
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "per_hour": NumberParameter("1/h", 1.0, 60.0),
        "dwell_s": NumberParameter("s", 5.0, 300.0),
    }
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge")}
    edge: str
    per_hour: float
    dwell_s: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Add a bus type and its buses.

        Raises:
            BlindTestError: No vehicle drives over the edge and on.
        """
        way = _usual_way(scenario, self.edge)
        lane = _lane_towards(scenario, self.edge, way[way.index(self.edge) + 1])
        end = _before_line(scenario, lane)
        root = ET.Element("routes")
        bus = {
            "id": "line", "length": "12", "accel": "1.2", "decel": "4", "maxSpeed": "22",
            "sigma": "0.5", "guiShape": "bus",
        }  # fmt: skip
        ET.SubElement(root, "vType", bus)
        settings = scenario.settings
        interval = 3600.0 / self.per_hour
        for number in range(int(settings.duration_s / interval)):
            depart = settings.begin_s + (number + 0.5) * interval
            attributes = {"id": f"bus.{number}", "type": "line", "depart": seconds_text(depart)}
            item = ET.SubElement(root, "vehicle", {**attributes, "departLane": "best"})
            ET.SubElement(item, "route", {"edges": " ".join(way)})
            stop = {"lane": lane, "endPos": f"{end:.2f}", "duration": seconds_text(self.dwell_s)}
            ET.SubElement(item, "stop", stop)
        return replace(
            scenario,
            routes=(*scenario.routes, Document("buses.rou.xml", None, xml_bytes(root))),
            applied=(*scenario.applied, str(self)),
        )


@dataclass(frozen=True)
class Driveway(Effect):
    """Driveway before a stop line into which a share of the vehicles turns off."""

    name: ClassVar[str] = "driveway"
    ranges: ClassVar[dict[str, NumberParameter]] = {"share": NumberParameter("", 0.0, 1.0)}
    texts: ClassVar[dict[str, TextParameter]] = {"edge": TextParameter("edge")}
    edge: str
    share: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Cut the routes of vehicles chosen by a hash of their ids."""
        places = network_places(scenario)
        position = _before_line(scenario, places.edges[self.edge][0])

        def change(root: ET.Element) -> bool:
            found = False
            for item in root.iter("vehicle"):
                route = item.find("route")
                edges = [] if route is None else route.get("edges", "").split()
                if route is None or self.edge not in edges[:-1] or item.find("stop") is not None:
                    continue
                if hashed_uniform(self.name, item.get("id", "")) < self.share:
                    route.set("edges", " ".join(edges[: edges.index(self.edge) + 1]))
                    item.set("arrivalPos", f"{position:.2f}")
                    item.attrib.pop("arrivalLane", None)
                    found = True
            return found

        return edit_scenario(scenario, change, "<vehicle", applied=str(self))


def _usual_way(scenario: Scenario, edge: str) -> tuple[str, ...]:
    """Return the most frequent route over the edge among routes that continue after it."""
    ways: Counter[tuple[str, ...]] = Counter()
    for document in scenario.routes:
        for item in document.parse().iter("vehicle"):
            route = item.find("route")
            way = () if route is None else tuple(route.get("edges", "").split())
            if edge in way[:-1]:
                ways[way] += 1
    if not ways:
        raise BlindTestError(f"nobody drives over edge {edge!r} of scenario {scenario.id!r} and on")
    return min(ways, key=lambda way: (-ways[way], way))


def _lane_towards(scenario: Scenario, edge: str, other: str) -> str:
    """Return the rightmost lane of an edge that leads to another edge."""
    network = Network.read(scenario)
    links = [link for item in network.intersections for link in item.links]
    found = [
        link.from_lane
        for link in links
        if network.lanes[link.from_lane].edge == edge and network.lanes[link.to_lane].edge == other
    ]
    return min(found, default=f"{edge}_0")


def _before_line(scenario: Scenario, lane: str) -> float:
    length = network_places(scenario).lanes[lane].length_m
    return max(length - STOP_BEFORE_LINE_M, 0.5 * length)
