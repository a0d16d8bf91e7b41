"""Networks nobody has seen: a frozen method on road networks that are drawn after it.

    python -m studies.unseen OUT --seed 20261123
    python -m studies.unseen OUT --seed 20261123 --pbf helsinki.osm.pbf

The seed draws the road networks, nine from `NetworkRanges` and three from an OSM extract. Each is a
table of ``paper main`` with the same rows. The summary names every road network and domain, the
ones on which the method does worst first, and leaves none out. A domain without headroom, in which
no row is 5 % better than direct transfer, is marked and counts in no mean.

An interrupted run goes on with the same command. With ``--only`` some of the networks are run, and
the summary has their names.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from studies.osm_extracts import make_all, read_extract
from studies.same_options import require_same
from ugat_marl.cli import guarded
from ugat_marl.data import write_csv
from ugat_marl.errors import ScenarioError, UnknownNameError, require_least
from ugat_marl.experiments import (
    DIRECT,
    RULE,
    STREET,
    Comparison,
    PaperConfig,
    all_standings,
    compare,
)
from ugat_marl.files import write_whole
from ugat_marl.grounding import RIVALS, StreetConfig
from ugat_marl.progress import Bars
from ugat_marl.scenarios import NetworkRanges, draw_scenario
from ugat_marl.seeding import derive_seed

DOMAINS = ("V4", "V1", "delay-20", "zone-20")
CONSTANTS = (3, 5)
ROWS = (STREET, *(f"constant delay {s} s" for s in CONSTANTS), RULE)

HEADROOM = 0.05
"""Least share of direct transfer's ATT that the best row must win for a domain to count."""

HARM = 0.03
"""Share of direct transfer's ATT above which a loss is called harm."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of the method on a road network in a domain.

    Attributes:
        network: Name of the road network.
        domain: The domain.
        att_s: ATT of each row in the domain, in s.
        sim_s: ATT of each row in the simulation, in s.
    """

    network: str
    domain: str
    att_s: dict[str, float]
    sim_s: dict[str, float]

    @property
    def headroom(self) -> float:
        """Share of direct transfer's ATT that the best row wins."""
        return 1 - min(self.att_s.values()) / self.att_s[DIRECT]

    @property
    def counts(self) -> bool:
        """True if there is something to win."""
        return self.headroom >= HEADROOM

    def won_back(self, row: str) -> float:
        """Share of the regret of direct transfer that a row wins; the best row has 1."""
        regret_s = self.att_s[DIRECT] - min(self.att_s.values())
        return (self.att_s[DIRECT] - self.att_s[row]) / regret_s if regret_s > 0 else math.nan

    @property
    def change(self) -> float:
        """Change of the ATT by the method, as a share of direct transfer's; negative is better."""
        return self.att_s[STREET] / self.att_s[DIRECT] - 1

    @property
    def is_trained(self) -> bool:
        """True if direct transfer is at or below the best tuned rule in the simulation."""
        return self.sim_s[DIRECT] <= self.sim_s[RULE]


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, train, judge and summarise.

    Raises:
        OptionError: There is no road network, or another number is too small.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, required=True, help="seed of the road networks")
    parser.add_argument("--networks", type=int, default=9)
    parser.add_argument("--pbf", type=Path, help="an .osm.pbf from which extracts are cut")
    parser.add_argument("--extracts", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each row")
    parser.add_argument("--domains", nargs="+", default=DOMAINS)
    parser.add_argument("--largest", type=int, default=9, help="most intersections of a network")
    parser.add_argument(
        "--load",
        type=float,
        nargs=2,
        default=NetworkRanges.load,
        metavar=("LEAST", "MOST"),
        help="degree of saturation of the busiest intersection",
    )
    parser.add_argument("--simulations", type=int, default=StreetConfig.simulations)
    parser.add_argument(
        "--evaluation-seeds", type=int, default=10, help="episodes of each row in each domain"
    )
    parser.add_argument("--rule-budget", type=int, default=6)
    parser.add_argument(
        "--street-rules", type=int, help="episodes of each rule in the fitted street; 0 for none"
    )
    parser.add_argument("--rival", choices=RIVALS, default=StreetConfig.rival)
    parser.add_argument("--only", nargs="+", help="names of the networks to run; all are drawn")
    parser.add_argument("--jobs", type=int)
    given = parser.parse_args(arguments)
    require_least(0 if given.pbf else 1, networks=given.networks)
    require_least(
        1, extracts=given.extracts, seeds=given.seeds, evaluation_seeds=given.evaluation_seeds
    )
    config = PaperConfig(
        domains=tuple(given.domains),
        seeds=given.seeds,
        episodes=20,
        iterations=1,
        grounded_episodes=15,
        groundings=("street",),
        constants=CONSTANTS,
        rows=ROWS,
        evaluation_seeds=given.evaluation_seeds,
        rule_budget=given.rule_budget,
        street=StreetConfig(
            simulations=given.simulations, rule_budget=given.street_rules, rival=given.rival
        ),
    )
    console, outcomes = Console(width=100), list[Outcome]()
    page = "-".join(["summary", *sorted(set(given.only or ()))])
    for scenario in scenarios(given):
        table = compare(
            "main", str(scenario), config, given.out / "runs", given.jobs, Bars(console)
        )
        folder = given.out / scenario.name
        write_csv(folder / "seeds.csv", all_standings(table).write_csv())
        outcomes += outcomes_of(scenario.name, table)
        write_whole(given.out / f"{page}.md", summary(outcomes))
    console.print(summary(outcomes))


def scenarios(given: argparse.Namespace) -> list[Path]:
    """Return the folders of the drawn road networks; those that exist are kept.

    Raises:
        OutputError: The networks there are of another draw.
        ScenarioError: The extract cannot be read, or has too few places.
        UnknownNameError: No network has a name in `given.only`.
    """
    folders: list[Path] = []
    ranges = NetworkRanges(intersections=(1, given.largest), load=tuple(given.load))
    networks, towns = given.out / "networks", given.out / "towns"
    pbf: Path | None = None if towns.exists() else given.pbf
    extract = None if pbf is None else read_extract(pbf)
    draw = {"seed": given.seed, "largest": given.largest, "load": list(given.load)}
    require_same(networks / "draw.json", draw, begun=any(networks.glob("drawn-*")))
    for k in range(given.networks):
        folder = networks / f"drawn-{k}"
        if not folder.exists():
            draw_scenario(folder, derive_seed(given.seed, "unseen", k), ranges)
        folders.append(folder)
    if given.pbf is not None:
        cut = {"pbf": given.pbf.name, "seed": given.seed, "extracts": given.extracts}
        require_same(given.out / "towns.json", cut, begun=towns.exists())
        if extract is not None:
            half = given.out / "towns-half-made"
            shutil.rmtree(half, ignore_errors=True)
            made = make_all(extract, given.seed, half / towns.name, given.extracts)
            if made < given.extracts:
                raise ScenarioError(
                    f"{given.pbf}: has {made} places that fit, not {given.extracts}; ask for fewer "
                    "with --extracts"
                )
            (half / towns.name).rename(towns)
            half.rmdir()
        folders += sorted(path for path in towns.iterdir() if path.is_dir())
    known = [folder.name for folder in folders]
    for name in given.only or ():
        if name not in known:
            raise UnknownNameError("network", name, known)
    return [folder for folder in folders if not given.only or folder.name in given.only]


def outcomes_of(network: str, table: Comparison) -> list[Outcome]:
    """Return the outcome in each domain of a table."""

    def means(target: str, domain: str) -> dict[str, float]:
        rows = (row for row in table.settings if table.has(row, target))
        return {row: float(table.values(row, target, "att_s", domain).mean()) for row in rows}

    return [Outcome(network, t, means(t, t), means(t, table.sim)) for t in table.targets]


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the summary as Markdown, the worst outcome first."""
    told = sorted(outcomes, key=lambda x: (not x.counts, -x.change))
    counted = [x for x in told if x.counts]
    rows = [row for row in told[0].att_s if row != DIRECT]
    lines = [
        f"Road networks and domains: {len(told)}, with headroom: {len(counted)}.",
        "",
        "| network | domain | direct transfer, s | "
        + " | ".join(rows)
        + " | change by the fitted street | regret won back | trained in sim |",
        "|---|---|---:|" + "---:|" * (len(rows) + 2) + "---|",
    ]
    for x in told:
        won = f"{x.won_back(STREET):.2f}" if x.counts else "no headroom"
        trained = "yes" if x.is_trained else "not trained yet"
        times = " | ".join(f"{x.att_s[row]:.1f}" for row in rows)
        lines.append(
            f"| {x.network} | {x.domain} | {x.att_s[DIRECT]:.1f} | {times} | {x.change:+.1%} | "
            f"{won} | {trained} |"
        )
    harmed = [x for x in told if x.change > HARM]
    lines += ["", f"Harmed by more than {HARM:.0%}: {len(harmed)} of {len(told)}."]
    for row in rows if counted else []:
        won = float(np.mean([x.won_back(row) for x in counted]))
        lines.append(f"Regret won back by {row}, mean: {won:.2f}.")
    in_sim: dict[str, bool] = {}
    for x in told:  # a rule tuned in any of the domains counts
        in_sim[x.network] = in_sim.get(x.network, True) and x.is_trained
    lines.append(
        f"Direct transfer at or below the best tuned rule in sim: {sum(in_sim.values())} of "
        f"{len(in_sim)} networks."
    )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.unseen", main))
