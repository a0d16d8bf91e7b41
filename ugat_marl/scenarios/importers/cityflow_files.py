"""CityFlow's two files as a source of roads with vehicles."""

from __future__ import annotations

import math
from pathlib import Path

from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.cityflow import read_roadnet
from ugat_marl.scenarios.importers.cityflow_flow import write_routes
from ugat_marl.scenarios.importers.cityflow_net import write_network
from ugat_marl.scenarios.importers.making import NETWORK, ROUTES, Draft, Roads


def from_cityflow(
    roadnet: Path, flow: Path, duration_s: float | None, *, own_vehicles: bool, exact: bool
) -> Roads:
    """A ``roadnet.json`` with its ``flow.json``.

    Args:
        roadnet: The roads.
        flow: The vehicles.
        duration_s: Length of an episode; None for whole ten minutes that hold all departures, at
            least an hour.
        own_vehicles: Whether the vehicles are wanted.
        exact: Whether headways are CityFlow's too, and nothing is left to chance.
    """

    def roads(folder: Path, reporter: Reporter) -> Draft:
        net = read_roadnet(roadnet)
        notes = write_network(net, folder / NETWORK)
        length_s, routes = duration_s or 3600.0, ()
        if own_vehicles:
            found = write_routes(flow, net, folder / ROUTES, duration_s, reporter, exact=exact)
            routes = (ROUTES,)
            length_s = duration_s or max(3600.0, 600.0 * (math.floor(found.last_s / 600) + 1))
        return Draft(
            f"CityFlow network {roadnet.name}",
            f"Turned from CityFlow's `{roadnet.name}` and `{flow.name}`: lanes, stop lines, turns "
            "and light phases are theirs, phase n being the n-th green one of the file. Who made "
            "them decides what may be done with them; keep their licence beside them.",
            routes=routes,
            settings={"duration_s": length_s, "control": {"phases": "programme"}},
            notes=tuple(notes),
        )

    return roads
