"""Traffic demand written out vehicle by vehicle from rates, a time profile and turning shares.

Arrivals at each entry are a Poisson process whose rate is constant within a bin. A vehicle walks
from junction to junction with the turning shares of each approach until it leaves the network;
a walk that would pass a junction twice is drawn again.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np

from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Road, RoadPlan, poisson_arrivals, weighted_choice
from ugat_marl.seeding import numpy_generator


def draw_demand(
    plan: RoadPlan, demand: Mapping[str, Any], vehicles: Mapping[str, Any], duration_s: float
) -> bytes:
    """The route file for table ``demand`` of a `source.toml`.

    Only uniform numbers are drawn, and times are rounded, so that the file does not depend on
    the version of numpy.

    Args:
        plan: The roads.
        demand: ``seed``, ``profiles``, ``entries``, ``turns``, ``types`` and perhaps ``mixes``.
        vehicles: Attributes of each vehicle type that ``types`` and ``mixes`` may name.
        duration_s: Length of every profile.
    """
    seed = int(demand["seed"])
    trips: list[tuple[float, str, list[str], str]] = []
    for entry, flow in demand["entries"].items():
        random = numpy_generator(seed, "entry", entry)
        profile = demand["profiles"][flow.get("profile", "default")]
        bin_s = duration_s / len(profile)
        first = next(road for road in plan.roads.values() if road.start == entry)
        number = 0
        for part, factor in enumerate(profile):
            for moment in poisson_arrivals(random, flow["vph"] * factor / 3600, bin_s):
                route = _walk(plan, first, demand["turns"], random)
                kind = weighted_choice(demand["types"], random)
                trips.append((part * bin_s + moment, f"{entry}_{number}", route, kind))
                number += 1
    root = ET.Element("routes")
    root.extend(_vehicle_types(demand, vehicles))
    for depart, id_, route, kind in sorted(trips, key=lambda trip: trip[:2]):
        attributes = {"id": id_, "depart": f"{depart:.2f}"}
        if kind != "none":
            attributes["type"] = kind
        attributes |= {"departLane": "best", "departSpeed": "max"}
        vehicle = ET.SubElement(root, "vehicle", attributes)
        ET.SubElement(vehicle, "route", edges=" ".join(route))
    return xml_bytes(root)


def _walk(
    plan: RoadPlan, first: Road, turns: Mapping[str, Any], random: np.random.Generator
) -> list[str]:
    """Edge ids from an entry to an exit, passing no junction twice."""
    while True:
        road, route, passed = first, [first.id], {first.start}
        while road.end not in passed and plan.nodes[road.end].signal:
            passed.add(road.end)
            served = {turn for lane in road.lanes for turn in lane}
            shares = turns.get(road.id, turns["default"])
            exits = plan.exits(road)
            turn = weighted_choice({t: shares[t] for t in ("l", "s", "r") if t in served}, random)
            road = exits[turn]
            route.append(road.id)
        if road.end not in passed:
            return route


def _vehicle_types(demand: Mapping[str, Any], vehicles: Mapping[str, Any]) -> list[ET.Element]:
    """``vType`` elements of the types in use, then the distributions over them."""
    mixes: Mapping[str, Mapping[str, float]] = demand.get("mixes", {})
    used = {*demand["types"], *(kind for members in mixes.values() for kind in members)}
    elements: list[ET.Element] = []
    for id_, values in vehicles.items():
        if id_ in used:
            attributes = {name: str(value) for name, value in values.items()}
            elements.append(ET.Element("vType", {"id": id_} | attributes))
    for id_, members in mixes.items():
        mix = ET.Element("vTypeDistribution", id=id_, vTypes=" ".join(members))
        mix.set("probabilities", " ".join(str(share) for share in members.values()))
        elements.append(mix)
    return elements
