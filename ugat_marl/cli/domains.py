"""``ugat-marl domains``: list the named domains, grouped by their gap."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Annotated

from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional, arg

from ugat_marl.effects import DOMAIN_ALIASES, GAP_KINDS, NAMED_DOMAINS, NamedDomain
from ugat_marl.errors import UnknownNameError
from ugat_marl.reporting import titled_table

_TITLES = {
    "observation": "observation gap: controllers see something else",
    "action": "action gap: commands are executed differently",
    "transition": "transition gap: traffic behaves differently",
    "reward": "reward gap: the objective is another one",
}


@dataclass(frozen=True)
class Domains:
    """List the named domains: their gap, effects, and counterpart in Sim2Signal.

    Domains and effects can be combined: V4+zone-50+counting_noise=0.1.

    Examples:
        ugat-marl domains
        ugat-marl domains action
        ugat-marl evaluate single-v1 --domains sim action --seeds 2

    Attributes:
        gap: Gap to list: observation, action, transition or reward.
        json: Print JSON instead of tables.
    """

    gap: Annotated[
        Positional[str | None], arg(metavar="[GAP]", help_behavior_hint="(default: all four)")
    ] = None
    json: bool = False

    def run(self, console: Console) -> int:
        """Print the lists."""
        if self.gap is not None and self.gap not in GAP_KINDS:
            raise UnknownNameError("gap", self.gap, GAP_KINDS)
        listed = [domain for domain in NAMED_DOMAINS.values() if self.gap in (None, domain.gap)]
        if self.json:
            console.print_json(json.dumps([asdict(domain) for domain in listed]))
            return 0
        for gap in GAP_KINDS:
            of_gap = [domain for domain in listed if domain.gap == gap]
            if of_gap:
                console.print(_table(_TITLES[gap], of_gap))
                for line in _notes(of_gap):
                    console.print(Text(line, style="dim"))
                console.print()
        theirs = sum(bool(domain.counterpart) for domain in listed)
        console.print(
            f"{len(listed)} domains, {theirs} with a counterpart in Sim2Signal (arXiv:2609.01676). "
            "Effects and their units: docs/reference/effects.md, docs/reference/domains.md",
        )
        return 0


def _table(title: str, domains: list[NamedDomain]) -> Table:
    table = titled_table(title)
    table.add_column("domain", no_wrap=True)
    table.add_column("effects", overflow="fold")
    table.add_column("Sim2Signal", max_width=21, overflow="fold")
    aliases = {name: alias for alias, name in DOMAIN_ALIASES.items()}
    for domain in domains:
        alias = f" ({aliases[domain.name]})" if domain.name in aliases else ""
        effects = domain.effects.replace("+", " + ")
        table.add_row(Text(domain.name + alias), Text(effects), Text(domain.counterpart))
    return table


def _notes(domains: list[NamedDomain]) -> list[str]:
    """Return the notes on the listed domains, each note once."""
    said: dict[str, list[str]] = {}
    for domain in domains:
        if domain.note:
            said.setdefault(domain.note, []).append(domain.name)
    return [
        f"{names[0]}{f' to {names[-1]}' if len(names) > 1 else ''}: {note}"
        for note, names in said.items()
    ]
