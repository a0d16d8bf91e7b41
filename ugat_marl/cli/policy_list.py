"""``ugat-marl policy list``: list the policies that come with the package."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from ugat_marl.errors import UnknownNameError
from ugat_marl.policies import policy_card, shipped_policies
from ugat_marl.reporting import number_text, titled_table


@dataclass(frozen=True)
class PolicyList:
    """List the trained policies that come with the package, with their travel times.

    An id stands for its policy in other commands, and in ugat_marl.load_policy(ID).

    Examples:
        ugat-marl policy list
        ugat-marl policy list --scenario single-v1

    Attributes:
        scenario: Only policies of this scenario.
    """

    scenario: str | None = None

    def run(self, console: Console) -> int:
        """Print the list."""
        scenarios = sorted({name.partition("/")[0] for name in shipped_policies()})
        if self.scenario is not None and self.scenario not in scenarios:
            raise UnknownNameError(
                "scenario", self.scenario, scenarios, "Policies of these come with the package."
            )
        table = titled_table("")
        for heading in ("id", "setting", "travel time, s"):
            table.add_column(heading, overflow="fold")
        for name in shipped_policies():
            if self.scenario in (None, name.partition("/")[0]):
                card = policy_card(name)
                times = (f"{d} {number_text(s.att_s)}" for d, s in card.scores.items())
                table.add_row(name, card.setting, ", ".join(times))
        console.print(table)
        return 0
