"""Places of the agents of a training: its network, and the traffic light of each agent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.errors import UgatMarlError
from ugat_marl.files import MALFORMED
from ugat_marl.reporting.light_names import LightNames
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.scenarios import Network, Scenario


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
        seconds = options.get("duration_s")
        derived = scenario_in_domain(
            load_scenario(record.scenario, seconds), record.sim, duration_s=seconds
        )
        network, own_hash = _network_of(derived), derived.hash
        agents = LightNames.of(network).agents
    except (UgatMarlError, OSError, *MALFORMED) as error:
        reason = " ".join(str(error).split())
        return None, f"no map: scenario {record.scenario!r} cannot be read here ({reason[:200]})"
    # the hashes of a job are named by domain, those of a run sim and real
    recorded = record.hashes.get(record.sim if record.job else "sim")
    changed = recorded not in (None, own_hash)
    note = "The scenario has changed since; the map shows it as it is now." if changed else ""
    return AgentPlaces(network, {agent: light for light, agent in agents.items()}), note


_NETWORKS: dict[str, Network] = {}


def _network_of(scenario: Scenario) -> Network:
    """Return the network of a scenario; those of one page are mostly the same."""
    if scenario.hash not in _NETWORKS:
        _NETWORKS.clear()
        _NETWORKS[scenario.hash] = Network.read(scenario)
    return _NETWORKS[scenario.hash]
