"""Crossings at lights of an OpenStreetMap extract, for a network made by netconvert.

Crossings are nodes of the roads they cross. netconvert leaves them out unless footways are mapped
without gaps. This file finds them by their coordinates and lists them for netconvert.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.files import xml_bytes

_NEAR_M = 8.0
"""Greatest distance of a crossing from the road it crosses."""
_REACH_M = 40.0
"""Greatest distance along the road between a crossing and the junction of its light."""
_BESIDE_M = 2.0
"""Roads that are farther apart at a crossing are separate carriageways with separate nodes."""
_SAME_ARM_DEG = 25.0
_WITHOUT_LIGHT = frozenset({"uncontrolled", "zebra", "unmarked", "marked", "no"})

Point = NDArray[np.float64]


LIT = "traffic_signals"
"""Value of ``highway`` and ``crossing`` of a node with lights."""


@dataclass(frozen=True)
class _Arm:
    """Roads that leave or reach a junction in one direction.

    Attributes:
        bearing_deg: Direction away from the junction, anticlockwise from east.
        roads: Name and first metres of each road, seen from the junction.
    """

    bearing_deg: float
    roads: list[tuple[str, Point]]


def has_light(tags: Mapping[str, str]) -> bool:
    """Return True for a node that is a crossing and may belong to a traffic light.

    Args:
        tags: Tags of the node.
    """
    highway, kind = tags.get("highway"), tags.get("crossing")
    if tags.get("crossing:signals") == "no":
        return False
    if kind == LIT:
        return True
    if highway == LIT:
        return kind not in (None, "no")
    return highway == "crossing" and kind not in _WITHOUT_LIGHT


def crossings_for(root: ET.Element, places: Iterable[tuple[float, float]]) -> bytes | None:
    """Return the crossings at lights as a connection file of netconvert.

    Args:
        root: A network with sidewalks.
        places: Longitude and latitude of crossings, degrees.

    Returns:
        The file, or None if there is no crossing at any light.
    """
    project = _projection(root)
    if project is None:
        return None
    arms = _arms_at_lights(root)
    crossings: dict[tuple[str, tuple[str, ...]], None] = {}
    for longitude, latitude in places:
        if crossed := _crossed(project(longitude, latitude), arms):
            crossings[crossed] = None
    if not crossings:
        return None
    top = ET.Element("connections")
    for junction, roads in crossings:
        ET.SubElement(top, "crossing", node=junction, edges=" ".join(roads), priority="true")
    return xml_bytes(top)


def _crossed(
    place: Point, arms: Mapping[str, Sequence[_Arm]]
) -> tuple[str, tuple[str, ...]] | None:
    """Return the junction of a crossing and the roads that it crosses, or None."""
    best_m, best = math.inf, None
    for junction, around in arms.items():
        for arm in around:
            if float(np.max(np.abs(arm.roads[0][1][0] - place))) > 2 * _REACH_M:
                continue
            apart = [_distance_m(place, line) for _, line in arm.roads]
            nearest = min(apart)
            # Two junctions may share a road: the small extra term prefers the nearer junction.
            far_m = nearest + 0.05 * min(
                float(np.linalg.norm(line[0] - place)) for _, line in arm.roads
            )
            if nearest <= _NEAR_M and far_m < best_m - 1e-6:
                names = [
                    name
                    for (name, _), side in zip(arm.roads, apart, strict=True)
                    if side <= nearest + _BESIDE_M
                ]
                best_m, best = far_m, (junction, tuple(names))
    return best


def _arms_at_lights(root: ET.Element) -> dict[str, list[_Arm]]:
    lights = {
        element.get("id", "")
        for element in root.iter("junction")
        if element.get("type", "").startswith("traffic_light")
    }
    middles = {
        element.get("id", ""): np.array(
            [float(element.get("x", "0")), float(element.get("y", "0"))]
        )
        for element in root.iter("junction")
        if element.get("type") != "internal"
    }
    arms: dict[str, list[_Arm]] = defaultdict(list)
    for edge in root.iter("edge"):
        start, end, name = edge.get("from", ""), edge.get("to", ""), edge.get("id", "")
        if edge.get("function") or not {start, end} & lights:
            continue
        line = _line(edge.get("shape", ""))
        if line is None:
            line = np.array([middles[start], middles[end]])
        if end in lights:
            _join(arms[end], name, _first_metres(line[::-1]))
        if start in lights:
            _join(arms[start], name, _first_metres(line))
    return arms


def _join(arms: list[_Arm], name: str, line: Point) -> None:
    """Add a road to the arm of its direction; its line starts at the junction."""
    away = line[-1] - line[0]
    bearing = math.degrees(math.atan2(away[1], away[0]))
    for arm in arms:
        if abs((arm.bearing_deg - bearing + 180) % 360 - 180) < _SAME_ARM_DEG:
            arm.roads.append((name, line))
            return
    arms.append(_Arm(bearing, [(name, line)]))


def _line(shape: str) -> Point | None:
    points = [[float(value) for value in point.split(",")[:2]] for point in shape.split()]
    return np.array(points) if len(points) > 1 else None


def _first_metres(line: Point) -> Point:
    """Return the first `_REACH_M` metres of a line."""
    kept = [line[0]]
    left = _REACH_M
    for a, b in zip(line, line[1:], strict=False):
        length = float(np.linalg.norm(b - a))
        if length >= left:
            kept.append(a + (b - a) * left / length)
            break
        kept.append(b)
        left -= length
    return np.array(kept)


def _distance_m(place: Point, line: Point) -> float:
    starts, ways = line[:-1], np.diff(line, axis=0)
    lengths = np.maximum((ways**2).sum(axis=1), 1e-9)
    along = np.clip(((place - starts) * ways).sum(axis=1) / lengths, 0.0, 1.0)
    return float(np.min(np.linalg.norm(starts + along[:, None] * ways - place, axis=1)))


def _projection(root: ET.Element) -> Callable[[float, float], Point] | None:
    """Return the function from degrees to a network's metres if it uses UTM, else None."""
    place = root.find("location")
    words = (place.get("projParameter", "") if place is not None else "").split()
    zone = next((word.removeprefix("+zone=") for word in words if word.startswith("+zone=")), "")
    if place is None or "+proj=utm" not in words or not zone.isdigit():
        return None
    x, y = (float(value) for value in place.get("netOffset", "0,0").split(","))
    south = 1e7 if "+south" in words else 0.0

    def project(longitude: float, latitude: float) -> Point:
        east, north = utm(longitude, latitude, int(zone))
        return np.array([east + x, north + south + y])

    return project


def utm(longitude: float, latitude: float, zone: int) -> tuple[float, float]:
    """Return easting and northing in m, north of the equator, exact to 1 mm.

    Krüger's series on WGS84, with xi' and eta' the coordinates of the transverse sphere:

        easting  = 500 km + 0.9996 A (eta' + sum_j alpha_j cos(2 j xi') sinh(2 j eta'))
        northing = 0.9996 A (xi' + sum_j alpha_j sin(2 j xi') cosh(2 j eta'))

    Args:
        longitude: Degrees.
        latitude: Degrees.
        zone: UTM zone, 1 to 60.
    """
    n = 1 / (2 / 0.0033528106647474805 - 1)  # third flattening n = f / (2 - f) of WGS84
    radius = 6378137.0 / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3,
        13 / 48 * n**2 - 3 / 5 * n**3,
        61 / 240 * n**3,
    )
    phi, away = math.radians(latitude), math.radians(longitude - (6 * zone - 183))
    e = 2 * math.sqrt(n) / (1 + n)
    t = math.sinh(math.atanh(math.sin(phi)) - e * math.atanh(e * math.sin(phi)))
    xi, eta = math.atan2(t, math.cos(away)), math.atanh(math.sin(away) / math.hypot(1, t))
    east, north = eta, xi
    for j, a in enumerate(alpha, 1):
        east += a * math.cos(2 * j * xi) * math.sinh(2 * j * eta)
        north += a * math.sin(2 * j * xi) * math.cosh(2 * j * eta)
    return 5e5 + 0.9996 * radius * east, 0.9996 * radius * north
