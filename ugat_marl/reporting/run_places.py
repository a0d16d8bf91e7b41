"""Where the agents of a training are: its network, as far as it can still be read."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ugat_marl.effects import in_domain, load_scenario
from ugat_marl.envs import Observer
from ugat_marl.errors import UgatMarlError
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.scenarios import Network


@dataclass(frozen=True)
class Places:
    """A network and who acts where in it.

    Attributes:
        network: The network.
        intersection_of: Agent to SUMO's id of its traffic light.
        note: What a reader must know of it; "" for nothing.
    """

    network: Network
    intersection_of: Mapping[str, str]
    note: str


def places_of(record: RunRecord) -> Places | str:
    """The places, or why they are not known."""
    if not record.scenario:
        return "no map: the scenario is not on record"
    options: Any = record.settings.get("options") if record.job else record.settings
    options = options if isinstance(options, Mapping) else {}
    try:
        # A job notes the scenario itself, a training the one it drove, with its own duration.
        duration_s = None if record.job else options.get("duration_s")
        network, own_hash = _network(record.scenario, record.sim, duration_s)
        neighbours = int(options.get("neighbours") or 0)
        agents = Observer(network, str(options.get("observation") or "count"), neighbours).agents
    except (UgatMarlError, OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        return f"no map: scenario {record.scenario!r} cannot be read here ({reason[:200]})"
    tls = [item.id for item in network.intersections]
    recorded = record.hashes.get("sim") or record.hashes.get(record.sim)
    changed = recorded not in (None, own_hash)
    note = "The scenario has changed since; the map shows it as it is now." if changed else ""
    return Places(network, dict(zip(agents, tls, strict=True)), note)


@functools.lru_cache(maxsize=8)
def _network(scenario: str, sim: str, duration_s: float | None) -> tuple[Network, str]:
    found = in_domain(load_scenario(scenario), sim)
    if duration_s is not None:
        found = found.with_duration(duration_s)
    return Network.read(found), found.hash
