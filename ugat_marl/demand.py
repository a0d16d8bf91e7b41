"""What route files ask for: who departs when, over which edges; and whether it can be driven."""

from __future__ import annotations

from dataclasses import dataclass

from ugat_marl.errors import ScenarioError
from ugat_marl.network import Network
from ugat_marl.scenario import Document, Scenario
from ugat_marl.scenario_settings import seconds_of

_ROUTED = ("from", "to", "via", "edges")
_NO_TIME = frozenset({"triggered", "containerTriggered", "split", "now", "begin"})


@dataclass(frozen=True)
class Demand:
    """A count of the vehicles written in a scenario's files.

    Attributes:
        vehicles: Single vehicles and trips that depart within the episode.
        flows: Flows, each of which makes many vehicles.
    """

    vehicles: int
    flows: int


def check_demand(scenario: Scenario, network: Network) -> Demand:
    """Reads all route files and checks that their edges exist.

    Raises:
        ScenarioError: A route uses an edge the network does not have, or no vehicle departs within
            the episode.
    """
    edges = {lane.edge for lane in network.lanes.values()}
    begin = scenario.settings.begin_s
    end = begin + scenario.settings.duration_s
    vehicles = flows = 0
    for document in (*scenario.routes, *scenario.additional):
        for item in document.parse().iter():
            if item.tag in ("vehicle", "trip", "flow", "route"):
                used = " ".join(item.get(key, "") for key in _ROUTED).split()
                for edge in used:
                    if edge not in edges:
                        raise _unknown_edge(document, item.tag, item.get("id", ""), edge, scenario)
            if item.tag == "flow":
                flows += 1
            elif item.tag in ("vehicle", "trip"):
                vehicles += begin <= _depart_s(item.get("depart", ""), document, begin) < end
    if not vehicles and not flows:
        files = ", ".join(document.source for document in scenario.routes)
        raise ScenarioError(
            f"{files}: no vehicle departs between {begin:g} s and {end:g} s; "
            "check begin_s and duration_s against the departure times"
        )
    return Demand(vehicles, flows)


def _unknown_edge(
    document: Document, tag: str, name: str, edge: str, scenario: Scenario
) -> ScenarioError:
    who = f"<{tag}" + (f" id={name!r}" if name else "") + ">"
    return ScenarioError(
        f"{document.source}: {who} uses the edge {edge!r}, which {scenario.network.source} does "
        "not have; were the routes made for another network?"
    )


def _depart_s(text: str, document: Document, begin_s: float) -> float:
    """Seconds; a triggered departure counts as one at the beginning."""
    if text in _NO_TIME:
        return begin_s
    try:
        return seconds_of(text)
    except ValueError:
        raise ScenarioError(
            f"{document.source}: depart={text!r} is not a time; give seconds or h:m:s"
        ) from None
