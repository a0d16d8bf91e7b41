"""Are short zones of detectors found, and is none found where there is none?

    python -m studies.short_zones single-v1 out/networks/drawn-0 out/towns/helsinki-1

Two episodes of a rule in the simulation are compared with two on each street, as a fitted street
does before it simulates worlds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from ugat_marl.cli import guarded
from ugat_marl.data import TransitionLog
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import policy_factory
from ugat_marl.grounding.eyes import fit_eyes
from ugat_marl.grounding.summaries import LaneView
from ugat_marl.grounding.worlds import RollOutSettings, roll_outs
from ugat_marl.scenarios import Network, Scenario

DOMAINS = (
    "V1", "V4", "demand_level=*,0.5", "demand_level=*,0.75", "late_green=*,4",
    "detection_zone=20", "detection_zone=50",
)  # fmt: skip
EPSILON = 0.3
"""Chance of a random phase, as in the roll-outs of a training."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Play, and print the zone that is found on each street."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--domains", nargs="+", default=DOMAINS)
    parser.add_argument("--policy", default="largest-queue:20")
    given = parser.parse_args(arguments)
    table = Table("scenario", "street", "zone found, m", box=None)
    for name in given.scenarios:
        scenario = load_scenario(name)
        view = LaneView.of(Network.read(scenario), "movements")
        simulated = played(scenario, "sim", given.policy, (1, 2))
        for domain in given.domains:
            eyes = fit_eyes(played(scenario, domain, given.policy, (11, 12)), simulated, view)
            low, high = eyes.zone_m
            table.add_row(scenario.id, domain, f"{low:g} to {high:g}" if high else "none")
    Console().print(table)


def played(scenario: Scenario, domain: str, policy: str, seeds: Sequence[int]) -> TransitionLog:
    """Return the transitions of an episode for each seed."""
    options = {"crossings": True}
    each = RollOutSettings(scenario, domain, options, policy_factory(policy), EPSILON, "movements")
    return roll_outs(each, seeds)[0]


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.short_zones", main))
