"""Control delay on every approach of a traffic light, measured by SUMO itself.

Control delay is the time that a vehicle loses because of a light: braking, waiting, moving up and
getting under way again. Here it is the time lost against free flow on the road that leads to the
light and inside the junction. Where a map cuts the road at nodes from which there is one way on,
the pieces upstream count too. Vehicles that wait outside the network are on no road and do not
count, and those that block lanes for effects are no traffic.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from ugat_marl.errors import SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import (
    Document,
    Network,
    Scenario,
    blocker_types,
    edge_of_lane,
    start_lane,
    turns_around,
)

ApproachDelays = Mapping[str, tuple[float, float]]
"""Approach (SUMO's edge at a light) to the number of vehicles that passed the light in an episode,
and their mean control delay, s."""

_FILE = "approaches.xml"
_BLOCKERS_FILE = "blockers.xml"


@contextlib.contextmanager
def measured_approaches(
    scenario: Scenario, network: Network
) -> Iterator[tuple[Scenario, Callable[[], ApproachDelays]]]:
    """Let simulations of a scenario measure the delay on the approaches of its agents.

    The traffic is the same bit for bit. Simulations must come one after the other.

    Args:
        scenario: The scenario.
        network: Its network.

    Yields:
        The scenario to simulate, and a function that returns the delays of the simulation that has
        ended last.
    """
    roads = approach_roads(scenario.network.parse(), network)
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        file = Path(name).resolve() / _FILE
        of_blockers = file.with_name(_BLOCKERS_FILE) if (kinds := blocker_types(scenario)) else None
        root = ET.Element("additional")
        wanted = {"id": "approaches", "withInternal": "true", "excludeEmpty": "true"}
        ET.SubElement(root, "edgeData", {**wanted, "file": str(file)})
        if of_blockers is not None:
            only = {"id": "blockers", "file": str(of_blockers), "vTypes": " ".join(kinds)}
            ET.SubElement(root, "edgeData", {**wanted, **only})
        extra = Document("approaches.add.xml", None, xml_bytes(root))
        measured = replace(
            scenario,
            additional=(*scenario.additional, extra),
            outputs=(*scenario.outputs, str(file.parent)),
        )
        yield measured, lambda: read_approach_delays(file, roads, of_blockers)


def read_approach_delays(
    file: Path, roads: Mapping[str, frozenset[str]], of_blockers: Path | None = None
) -> ApproachDelays:
    """Read SUMO's edge data.

    The delay is the time lost on the roads of an approach by all vehicles, divided by the number of
    vehicles that passed the light. In a queue that grows, vehicles that still wait count in the
    first and not in the second.

    Args:
        file: SUMO's output.
        roads: Approach to the roads whose lost time counts for it, as of `approach_roads`.
        of_blockers: SUMO's output of the vehicles that block lanes, which do not count.

    Raises:
        SimulatorError: The file is missing or incomplete.
    """
    lost_s: dict[str, float] = defaultdict(float)
    left: dict[str, float] = defaultdict(float)
    try:
        for path, sign in ((file, 1.0), (of_blockers, -1.0)):
            for _, element in ET.iterparse(path) if path is not None else ():
                if element.tag == "edge":
                    road = element.get("id", "")
                    lost_s[road] += sign * float(element.get("timeLoss", "0"))
                    left[road] += sign * float(element.get("left", "0"))
                element.clear()
    except (OSError, ET.ParseError, ValueError) as error:
        raise SimulatorError(f"SUMO's data on roads cannot be read ({error})") from None
    return {
        # fsum: a set has another order in every process, and a plain sum another last digit
        approach: (
            left[approach],
            math.fsum(map(lost_s.__getitem__, pieces)) / max(left[approach], 1.0),
        )
        for approach, pieces in roads.items()
    }


def approach_roads(root: ET.Element, network: Network) -> dict[str, frozenset[str]]:
    """Return, for each approach of an agent, the roads whose lost time counts for it.

    These are the approach itself, the ways across its junction, and the roads upstream of it from
    which all ways lead to it, up to the next light.

    Args:
        root: The ``<net>``.
        network: Its network.
    """
    onward: dict[str, set[str]] = defaultdict(set)
    before: dict[str, set[str]] = defaultdict(set)
    inside: dict[tuple[str, str], set[str]] = defaultdict(set)
    further = {
        start_lane(element): element.get("via", "")
        for element in root.iter("connection")
        if element.get("from", "").startswith(":")
    }
    for element in root.iter("connection"):
        start, end = element.get("from", ":"), element.get("to", ":")
        if turns_around(element) or start.startswith(":") or end.startswith(":"):
            continue
        onward[start].add(end)
        lane = element.get("via", "")
        while lane and edge_of_lane(lane) not in inside[start, end]:
            inside[start, end].add(edge_of_lane(lane))
            lane = further.get(lane, "")
        if element.get("tl") is None:
            before[end].add(start)
    approaches = {link.from_edge for light in network.intersections for link in light.links}
    roads: dict[str, frozenset[str]] = {}
    for approach in sorted(approaches):
        pieces = {approach}.union(*(inside[approach, end] for end in onward[approach]))
        waiting, seen = [approach], {approach}
        while waiting:
            here = waiting.pop()
            for upstream in before[here] - seen - approaches:
                if onward[upstream] == {here}:
                    seen.add(upstream)
                    pieces |= {upstream, *inside[upstream, here]}
                    waiting.append(upstream)
        roads[approach] = frozenset(pieces)
    return roads
