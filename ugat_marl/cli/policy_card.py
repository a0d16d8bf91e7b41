"""``ugat-marl policy card``: print how a shipped policy was made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.policies import policy_card
from ugat_marl.reporting import number_text


@dataclass(frozen=True)
class PolicyCardCommand:
    """Print the card of a shipped policy: its training, its scores, the hashes.

    Examples:
        ugat-marl policy card single-v1/direct-transfer-s0

    Attributes:
        policy: Id of the policy; ugat-marl policy list has them all.
    """

    policy: Annotated[Positional[str], arg(metavar="ID")]

    def run(self, console: Console) -> int:
        """Print the card."""
        card = policy_card(self.policy)
        rows = {
            "setting": card.setting,
            "scenario": card.scenario,
            "trained in": card.sim,
            "trained for": card.real or "no real domain",
            "learner": card.learner,
            "training seed": str(card.training_seed),
            "training episodes": str(card.episodes),
            "command": card.command or "not known; the card holds all settings",
            **{
                f"travel time in {domain}, s": f"{number_text(own.att_s)} "
                f"({number_text(own.low_s)}–{number_text(own.high_s)}; {own.episodes} episodes)"
                for domain, own in card.scores.items()
            },
            **{f"hash in {domain}": text for domain, text in card.scenario_hashes.items()},
            "versions": ", ".join(f"{name} {text}" for name, text in card.versions.items()),
            "SHA-256": card.sha256,
        }
        for name, text in rows.items():
            console.print(f"{name}: {text}", soft_wrap=True)
        return 0
