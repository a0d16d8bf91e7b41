"""``ugat-marl scenario list``: list the named scenarios and domains."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from ugat_marl.effects import DOMAIN_ALIASES, PAPER_WORLDS, load_scenario
from ugat_marl.errors import ScenarioError, install_command
from ugat_marl.reporting import titled_table
from ugat_marl.scenarios import Network, check_demand, resco_maps, shipped_scenarios


@dataclass(frozen=True)
class ScenarioList:
    """List the scenarios and domains that have a name.

    Examples:
        ugat-marl scenario list
    """

    def run(self, console: Console) -> int:
        """Print the lists."""
        table = titled_table("")
        table.add_column("scenario")
        for heading in ("agents", "phases", "vehicles"):
            table.add_column(heading, justify="right")
        table.add_column("description")
        maps = [f"resco:{name}" for name in sorted(resco_maps())]
        for name in (*(name for name, _ in shipped_scenarios()), *maps):
            table.add_row(name, *_facts(name))
        console.print(table)
        if not maps:
            console.print(f"RESCO networks: {install_command('resco')}")
        aliases = {setting: alias for alias, setting in DOMAIN_ALIASES.items()}
        for setting, effects in PAPER_WORLDS.items():
            values = ", ".join(map(str, effects))
            console.print(f"domain {setting} ({aliases[setting]}): {values}")
        return 0


def _facts(name: str) -> list[str]:
    try:
        scenario = load_scenario(name)
        network = Network.read(scenario)
        demand = check_demand(scenario, network)
    except ScenarioError as error:
        return ["", "", "", str(error)]
    phases = [len(light.phases) for light in network.intersections]
    spread = str(phases[0]) if len(set(phases)) == 1 else f"{min(phases)}-{max(phases)}"
    vehicles = f"{demand.vehicles}{'+' if demand.flows else ''}"
    return [str(len(phases)), spread, vehicles, scenario.settings.description]
