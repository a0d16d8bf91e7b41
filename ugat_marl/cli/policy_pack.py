"""``ugat-marl policy pack``: copy trained policies with their cards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.experiments import pack
from ugat_marl.progress import Bars


@dataclass(frozen=True)
class PolicyPack:
    """Copy the policies of finished trainings to a folder, each with a card.

    A card says how a policy was made and what it reached, so that others can use it.

    Examples:
        ugat-marl policy pack runs/first --out packed
        ugat-marl policy pack runs/paper --out packed --command "ugat-marl paper main"

    Attributes:
        training: Folder of a run, of the trainings of ugat-marl paper, or of one training.
        out: Folder to write to.
        command: Command that trained them, for the cards.
    """

    training: Annotated[Positional[Path], arg(metavar="FOLDER")]
    out: Path
    command: str = ""

    def run(self, console: Console) -> int:
        """Pack, and print the ids."""
        for card in pack(self.training, self.out, self.command, Bars(console)):
            console.print(f"{self.out / card.id}.pt", soft_wrap=True)
        return 0
