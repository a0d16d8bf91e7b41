"""Places of the agents of a training: its network, and the traffic light of each agent."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import Observer
from ugat_marl.errors import UgatMarlError
from ugat_marl.files import MALFORMED
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.scenarios import Network


@dataclass(frozen=True)
class AgentPlaces:
    """A network and the traffic lights of its agents.

    Attributes:
        network: The network.
        intersection_of: Agent to SUMO's id of its traffic light.
    """

    network: Network
    intersection_of: Mapping[str, str]


def places_of(record: RunRecord) -> tuple[AgentPlaces | None, str]:
    """Return the places of a training's agents, None if not known, and a remark for the reader.

    The remark is "" if there is nothing to say.
    """
    if not record.scenario:
        return None, "no map: the scenario is not on record"
    options: Any = record.settings.get("options") if record.job else record.settings
    options = options if isinstance(options, Mapping) else {}
    try:
        # A job records the hash of the scenario itself. A training records the hash of the scenario
        # with the training's own duration.
        duration_s = None if record.job else options.get("duration_s")
        network, own_hash = _network(record.scenario, record.sim, duration_s)
        neighbours = int(options.get("neighbours") or 0)
        agents = Observer(network, str(options.get("observation") or "count"), neighbours).agents
    except (UgatMarlError, OSError, *MALFORMED) as error:
        reason = " ".join(str(error).split())
        return None, f"no map: scenario {record.scenario!r} cannot be read here ({reason[:200]})"
    tls = [each.id for each in network.intersections]
    recorded = record.hashes.get("sim") or record.hashes.get(record.sim)
    changed = recorded not in (None, own_hash)
    note = "The scenario has changed since; the map shows it as it is now." if changed else ""
    return AgentPlaces(network, dict(zip(agents, tls, strict=True))), note


@functools.lru_cache(maxsize=8)
def _network(scenario: str, sim: str, duration_s: float | None) -> tuple[Network, str]:
    derived = scenario_in_domain(load_scenario(scenario, duration_s), sim, duration_s=duration_s)
    return Network.read(derived), derived.hash
