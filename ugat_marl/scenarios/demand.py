"""Checks of route files: departure times, edges, and their order."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

from ugat_marl.errors import ScenarioError
from ugat_marl.files import Tag
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.network import Network
from ugat_marl.scenarios.routes import (
    TRAVELLERS,
    OwnEdges,
    demand_scale,
    departs,
    is_blocker,
    scaled_number,
)
from ugat_marl.scenarios.scenario import Document, Scenario
from ugat_marl.scenarios.settings import parse_time

_ROUTED = ("from", "to", "via", "edges")
_NO_TIME = frozenset({"triggered", "containerTriggered", "split", "now", "begin"})


SPARE_S = 600.0
"""Longest time, s, by which SUMO reads route files ahead."""


@dataclass(frozen=True)
class Demand:
    """A count of the vehicles written in a scenario's files.

    Attributes:
        vehicles: Number of single vehicles and trips that depart within the episode, times SUMO's
            option ``scale``.
        flows: Number of flows within the episode; each flow makes many vehicles.
        routed: True if the route files hold only single vehicles with their own edges, and the
            additional files hold no vehicles, and SUMO does not scale them.
    """

    vehicles: int
    flows: int
    routed: bool = field(default=True, compare=False)


def check_demand(
    scenario: Scenario,
    network: Network,
    reporter: Reporter | None = None,
    *,
    whole: bool = True,
) -> Demand:
    """Read all route files and check that SUMO can simulate them.

    Args:
        scenario: The scenario with the files.
        network: Its network.
        reporter: Shows progress if a file is long.
        whole: True to read on after the end of the episode. Vehicles are sorted by departure, so
            with False no vehicle of the episode is missed.

    Raises:
        ScenarioError: A route uses an edge the network does not have, vehicles are not in the order
            of their departures, or no vehicle departs within the episode.
    """
    edges = {lane.edge for lane in network.lanes.values()}
    begin = scenario.settings.begin_s
    end = begin + scenario.settings.duration_s
    vehicles = flows = 0
    routed = True
    for document in (*scenario.routes, *scenario.additional):
        latest, in_routes = -math.inf, document in scenario.routes
        singles = OwnEdges()
        for tag in document.scan(reporter):
            if in_routes:
                singles.read(tag)
            _refuse_undrivable(tag, document, edges, scenario)
            if not departs(tag) and not (in_routes and _travels(tag)):
                continue
            depart = _depart_s(tag, document, begin, max(begin, latest))
            if depart < latest and in_routes:
                raise _unsorted(document, tag, depart, latest)
            latest = max(latest, depart)
            if departs(tag):
                routed &= in_routes
                if tag.name == "flow":
                    flows += depart < end and begin < _end_s(tag, document)
                else:
                    blocks = is_blocker(
                        tag.attributes.get("id", ""), tag.attributes.get("type", "")
                    )
                    vehicles += begin <= depart < end and not blocks
                if in_routes and not whole and latest > end + SPARE_S:
                    routed &= not singles.lost
                    break
        else:
            routed &= singles.ended()
    scale = demand_scale(scenario)
    if not scaled_number(1, scale):
        raise ScenarioError(
            f'scenario {scenario.id!r}: [sumo] scale = "{scenario.settings.sumo["scale"]}" leaves '
            "out all vehicles; give 0.001 or more"
        )
    if not vehicles and not flows:
        files = ", ".join(document.source for document in scenario.routes)
        effects = f" after {', '.join(scenario.applied)}" if scenario.applied else ""
        raise ScenarioError(
            f"{files}: no vehicle departs between {begin:g} s and {end:g} s{effects}; "
            "check begin_s and duration_s against the departure times"
        )
    return Demand(scaled_number(vehicles, scale), flows, routed and scale == 1)


def edges_used(tag: Tag) -> list[str]:
    """Return the edges that a vehicle, trip, flow or route names."""
    given = tag.attributes
    return [edge for key in _ROUTED if key in given for edge in given[key].split()]


def _who(tag: Tag) -> str:
    name = tag.attributes.get("id", "")
    return f"<{tag.name}" + (f" id={name!r}" if name else "") + ">"


def _at(document: Document, tag: Tag) -> str:
    return f"{document.source}, line {tag.line}"


def _unknown_edge(document: Document, tag: Tag, edge: str, scenario: Scenario) -> ScenarioError:
    return ScenarioError(
        f"{_at(document, tag)}: {_who(tag)} uses the edge {edge!r}, which "
        f"{scenario.network.source} does not have; were the routes made for another network?"
    )


def _unsorted(document: Document, tag: Tag, depart: float, latest: float) -> ScenarioError:
    return ScenarioError(
        f"{_at(document, tag)}: {_who(tag)} departs at {depart:g} s but stands after one of "
        f"{latest:g} s, and SUMO would leave it out; sort the file by departure (SUMO's "
        "tools/route/sort_routes.py does)"
    )


_ONE = re.compile(r"\s*1(\.0*)?\s*")


def _travels(tag: Tag) -> bool:
    """Return True for people and containers, which SUMO wants in order among vehicles."""
    return tag.name in TRAVELLERS and tag.parent == "routes"


def _refuse_undrivable(tag: Tag, document: Document, edges: set[str], scenario: Scenario) -> None:
    """Refuse a type with a scale of its own, and a route over an edge that does not exist."""
    if tag.name == "vType" and not _ONE.fullmatch(tag.attributes.get("scale", "1")):
        raise ScenarioError(
            f"{_at(document, tag)}: {_who(tag)} has a scale of its own, which counts of "
            'the demand would miss; repeat its vehicles, or set "scale" under [sumo] in '
            "scenario.toml for all"
        )
    if tag.name in ("vehicle", "trip", "flow", "route"):
        used = edges_used(tag)
        if not edges.issuperset(used):
            edge = next(edge for edge in used if edge not in edges)
            raise _unknown_edge(document, tag, edge, scenario)


def _depart_s(tag: Tag, document: Document, begin_s: float, triggered_s: float) -> float:
    """Return the departure in s; `triggered_s` for one that something else triggers.

    A flow without a begin starts with the simulation, at `begin_s`.
    """
    is_flow = tag.name.lower().endswith("flow")
    key, default = ("begin", repr(begin_s)) if is_flow else ("depart", "")
    text = tag.attributes.get(key, default)
    return triggered_s if text in _NO_TIME else _seconds(text, key, tag, document)


def _end_s(tag: Tag, document: Document) -> float:
    text = tag.attributes.get("end")
    return math.inf if text is None else _seconds(text, "end", tag, document)


def _seconds(text: str, key: str, tag: Tag, document: Document) -> float:
    try:
        return parse_time(text)
    except ValueError:
        raise ScenarioError(
            f"{_at(document, tag)}: {key}={text!r} of {_who(tag)} is not a time; "
            "give seconds or h:m:s"
        ) from None
