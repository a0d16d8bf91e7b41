"""Vehicles that pass two places one after the other: when, and how long they take."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Document, Lane
from ugat_marl.simulation.detectors import LANE_END_M, add_loop, events_in

_EVENT = re.compile(rb'id="place(\d+):[^"]*" time="([\d.]+)" state="[^"]*" vehID="([^"]*)"')


@dataclass(frozen=True)
class Place:
    """A line across all lanes of a road.

    Attributes:
        edge: SUMO id of the edge.
        position_m: Distance from the start of the edge, m; infinite for its end.
    """

    edge: str
    position_m: float


Way = tuple[Place, Place]
"""Two places, in the order in which vehicles pass them."""


def places_document(ways: Sequence[Way], lanes: Mapping[str, Lane], file: Path) -> Document:
    """Return an additional file with loops at the places, on every lane, which write to `file`."""
    root = ET.Element("additional")
    for number, place in enumerate(_places(ways)):
        for lane in lanes.values():
            if lane.edge == place.edge:
                position = max(min(place.position_m, lane.length_m - LANE_END_M), LANE_END_M)
                add_loop(root, f"place{number}:{lane.id}", lane.id, position, file)
    return Document("places.add.xml", None, xml_bytes(root))


def read_between(
    file: Path, ways: Sequence[Way], begin_s: float, end_s: float
) -> tuple[NDArray[np.float64], ...]:
    """Read when vehicles pass the first place of each way, and their time to the second one.

    Only vehicles that pass both places between the two times are read.

    Args:
        file: SUMO's output for `places_document`.
        ways: The ways of `places_document`.
        begin_s: Begin, on the scenario's clock.
        end_s: End, on the scenario's clock.

    Returns:
        For each way, an array ``(vehicles, 2)`` of times at the first place and travel times, s.

    Raises:
        SimulatorError: SUMO did not write the file.
    """
    content = events_in(file, "places")
    places = _places(ways)
    seen: list[dict[bytes, list[float]]] = [defaultdict(list) for _ in places]
    for number, time, vehicle in _EVENT.findall(content):
        seen[int(number)][vehicle].append(float(time))
    found: list[NDArray[np.float64]] = []
    for first, last in ways:
        here, there = (seen[places.index(place)] for place in (first, last))
        rows = [
            (began, ended - began)
            for vehicle in here.keys() & there.keys()
            for began, ended in _trips(_visits(here[vehicle]), _visits(there[vehicle]))
            if began >= begin_s and ended < end_s
        ]
        found.append(np.array(sorted(rows), dtype=np.float64).reshape(-1, 2))
    return tuple(found)


def _places(ways: Sequence[Way]) -> list[Place]:
    return list(dict.fromkeys(place for way in ways for place in way))


_SAME_VISIT_S = 60.0
"""Largest time between two events of one vehicle at one place that belong to one visit, s."""


def _visits(times: list[float]) -> list[float]:
    """Return the first event of each visit: a vehicle reports its front, its stand and its rear."""
    visits: list[float] = []
    last = -np.inf
    for time in sorted(times):
        if time - last > _SAME_VISIT_S:
            visits.append(time)
        last = time
    return visits


def _trips(here: list[float], there: list[float]) -> list[tuple[float, float]]:
    """Return pairs of visits with no other visit of the first place between them."""
    trips: list[tuple[float, float]] = []
    for index, began in enumerate(here):
        until = here[index + 1] if index + 1 < len(here) else np.inf
        ended = next((time for time in there if began < time <= until), None)
        if ended is not None:
            trips.append((began, ended))
    return trips
