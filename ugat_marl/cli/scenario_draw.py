"""``ugat-marl scenario draw``: draw every intersection with its phases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.effects import load_scenario
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars
from ugat_marl.reporting import plot_network


@dataclass(frozen=True)
class ScenarioDraw:
    """Draw the network and every intersection with its phases, as SVG and PNG.

    Examples:
        ugat-marl scenario draw mixed-v1 --out pictures

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        out: Folder to write to.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    out: Path

    def run(self, console: Console) -> int:
        """Draw and print the folder."""
        scenario = load_scenario(self.scenario)
        require_writable(self.out / "network.svg")
        files = plot_network(scenario, self.out, Bars(console))
        console.print(f"{len(files)} pictures: {self.out}", soft_wrap=True)
        return 0
