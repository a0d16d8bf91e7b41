"""Coverage of the posterior over worlds, in simulated streets whose values are hidden from it.

    python -m studies.posterior_coverage single-v1 mixed-v1 --streets 60 --jobs 2

Streets are drawn and simulated. Then each is fitted as a training does it, and the posterior is
asked for its values. Worlds of the prior are simulated once and serve all streets; worlds that are
aimed at a street are its own. A third of the streets comes from the prior of the worlds. Of the
others the prior is wrong: each effect is there with a chance of a half (``alone``), or those of
vehicles change together, by one number (``together``), and a third of the lanes loses green at its
beginning.

A value is covered if the 90 % interval of its draws holds it. A value at the end of its range is
covered by an interval that ends there.

The statistics of all episodes are kept in the folder ``--out`` and read again by the same command,
unless the network, its effects, the episodes, the source of worlds and statistics, or the installed
versions have changed. After other changes of the suite's source, give another folder.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import inspect
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.stats import binomtest

from ugat_marl import parallel_env
from ugat_marl.cli import guarded
from ugat_marl.data import TransitionLog, installed_versions
from ugat_marl.effects import load_scenario
from ugat_marl.errors import require_least
from ugat_marl.experiments import file_stem, policy_factory
from ugat_marl.files import file_hash, replacing
from ugat_marl.grounding import (
    FittedService,
    LaneView,
    Posterior,
    SimulatedLog,
    Simulation,
    StreetConfig,
    StreetWorld,
    WorldPrior,
    WorldValues,
    street_prior,
)
from ugat_marl.grounding.street import LEARNT, FitHistory
from ugat_marl.grounding.summaries import Summary
from ugat_marl.grounding.worlds import explored
from ugat_marl.policies import Policy
from ugat_marl.progress import Bars
from ugat_marl.seeding import derive_seed, numpy_generator

Floats = NDArray[np.float64]

KINDS = ("prior", "alone", "together")
"""Distributions from which streets are drawn."""

INTERVAL = (0.05, 0.95)
EPSILON = 0.1
"""Chance of a random phase in all roll-outs."""
DURATION_S = 1800.0
"""Length of an episode, s."""
SOURCES = tuple(
    Path(inspect.getfile(kind)) for kind in (Summary, WorldPrior, StreetWorld, explored)
)
"""Files that draw worlds, play them and make their statistics."""
PACKAGES = ("ugat-marl", "eclipse-sumo", "libsumo", "numpy", "polars")
"""Packages whose versions decide the statistics."""


@dataclass(frozen=True)
class Asked:
    """A hidden value and the posterior's answer.

    Attributes:
        kind: One of `KINDS`.
        name: Name of the effect, or of the kind of service.
        truth: The hidden value, in the effect's unit.
        low: Lower end of the 90 % interval.
        middle: Median.
        high: Upper end of the interval.
        blind: Median of the prior.
        width: Width of the prior's 90 % interval.
    """

    kind: str
    name: str
    truth: float
    low: float
    middle: float
    high: float
    blind: float
    width: float

    @property
    def covered(self) -> bool:
        """True if the interval holds the value."""
        return self.low - 1e-9 <= self.truth <= self.high + 1e-9


VEHICLES = ("acceleration", "deceleration", "emergency_deceleration", "startup_delay")
"""Effects that a wet or an icy road changes together."""


def draw_other(worlds: WorldPrior, kind: str, seed: int) -> WorldValues:
    """Draw a street from a distribution that is not the prior.

    Args:
        worlds: The prior; its ranges are kept.
        kind: ``"alone"`` or ``"together"``.
        seed: Seed of the street.
    """
    generator = numpy_generator(seed, "posterior coverage", kind)
    low, nominal, high = worlds.ends
    there = generator.random(len(nominal)) < 0.5
    effects = np.where(there, generator.uniform(low, high), nominal)
    if kind == "together":
        slower = np.array([x.name in VEHICLES for x in worlds.library])
        farthest = np.where(nominal - low > high - nominal, low, high)
        road = nominal + generator.uniform() * (farthest - nominal)
        effects = np.where(slower, road, effects)
    service_s = np.zeros((len(worlds.lanes), 2))
    late = generator.random(len(worlds.lanes)) < 1 / 3
    service_s[late, 0] = generator.uniform(1.0, 6.0, int(late.sum()))
    return worlds.clipped(WorldValues(effects, service_s))


def streets_of(worlds: WorldPrior, number: int, seed: int) -> list[tuple[str, WorldValues]]:
    """Return the streets, by turns from each distribution."""
    drawn: list[tuple[str, WorldValues]] = []
    for k in range(number):
        one, kind = derive_seed(seed, "street", k), KINDS[k % len(KINDS)]
        drawn.append((kind, worlds.draw(one) if kind == "prior" else draw_other(worlds, kind, one)))
    return drawn


def answers(
    posterior: Posterior, kind: str, truth: WorldValues, prior: tuple[Floats, Floats]
) -> list[Asked]:
    """Return the posterior's answers for a street.

    Args:
        posterior: The posterior for the log of the street.
        kind: Distribution of the street.
        truth: Its values.
        prior: Draws of the prior: effects ``(n, effects)``, and service ``(n, lanes, 2)``.
    """
    effects, service_s = posterior.sample(400)
    names = [item.name for item in posterior.worlds.library]
    columns = [
        (names[i], truth.effects[i], effects[:, i], prior[0][:, i]) for i in range(len(names))
    ]
    for j, name in enumerate(("green unused at first, s", "green unused later, s")):
        mean_s = truth.service_s[:, j].mean()
        columns.append(
            (f"mean {name}", mean_s, service_s[:, :, j].mean(1), prior[1][:, :, j].mean(1))
        )
        for lane in range(len(posterior.worlds.lanes)):
            value = truth.service_s[lane, j]
            columns.append((f"lanes: {name}", value, service_s[:, lane, j], prior[1][:, lane, j]))
    asked: list[Asked] = []
    for name, value, sample, blind in columns:
        low, middle, high = (float(q) for q in np.quantile(sample, (INTERVAL[0], 0.5, INTERVAL[1])))
        least, usual, most = np.quantile(blind, (INTERVAL[0], 0.5, INTERVAL[1]))
        width = float(most - least)
        asked.append(Asked(kind, name, float(value), low, middle, high, float(usual), width))
    return asked


def study(network: Network, number: int, simulations: int, seed: int, folder: Path) -> list[Asked]:
    """Simulate worlds and streets of a network; return all answers.

    Args:
        network: The network, and who acts on it.
        number: Number of streets.
        simulations: Number of worlds for each posterior; those of the prior serve all streets.
        seed: Root of all random choices.
        folder: Folder of the statistics of all episodes.
    """
    worlds = network.worlds
    ((prior, _), (_, aimed)) = FitHistory().rounds(StreetConfig(simulations=simulations))
    streets = streets_of(worlds, number, seed)
    values = [worlds.draw(derive_seed(seed, "world", k), LEARNT) for k in range(prior)]
    known = network.simulated(values, seed, folder, "prior")
    hidden = [value for _, value in streets]
    apart = derive_seed(seed, "streets")  # not the vehicles of the worlds
    seen = network.summaries(hidden, apart, folder, "streets", episodes=2)
    several = [worlds.draw(derive_seed(seed, "blind", k)) for k in range(400)]
    blind = (
        np.stack([value.effects for value in several]),
        np.stack([value.service_s for value in several]),
    )
    asked: list[Asked] = []
    for k, ((kind, truth), summary) in enumerate(zip(streets, seen, strict=True)):
        posterior = Posterior.fit(worlds, known, summary)
        aimed_at = [derive_seed(seed, "aimed", k, j) for j in range(aimed)]
        values = [posterior.draw(one, LEARNT) for one in aimed_at]
        near = network.simulated(values, derive_seed(seed, k), folder, f"aimed at {k + 1}")
        asked += answers(Posterior.fit(worlds, [*known, *near], summary), kind, truth, blind)
    return asked


def _digest(network: Network, values: Sequence[WorldValues], seed: int, episodes: int) -> str:
    """Return a digest of what decides the statistics of worlds."""
    simulation = network.simulation
    told = [
        simulation.scenario.hash,
        dict(simulation.options),
        simulation.epsilon,
        network.policy,
        [item.name for item in network.worlds.library],
        [file_hash(source) for source in SOURCES],
        installed_versions(*PACKAGES),
        DURATION_S,
        seed,
        episodes,
    ]
    digest = hashlib.sha256(json.dumps(told).encode())
    for value in values:
        digest.update(value.effects.tobytes() + value.service_s.tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True)
class Network:
    """A network, its prior, and who acts on it.

    Attributes:
        name: The scenario.
        worlds: Prior of the worlds.
        view: Lanes of the network.
        policy: Spelling of the rule that acts in worlds and streets.
        acting: The rule.
        simulation: The simulation.
    """

    name: str
    worlds: WorldPrior
    view: LaneView
    policy: str
    acting: Policy
    simulation: Simulation

    @classmethod
    def of(cls, name: str, policy: str, jobs: int | None) -> Network:
        """Return a scenario on which a rule acts, with so many simulations at a time."""
        scenario = load_scenario(name)
        with contextlib.closing(parallel_env(scenario, observation="movements")) as env:
            worlds = street_prior(env, StreetConfig(parts=("service", "effects")))
            view, acting = LaneView.of(env.network, "movements"), policy_factory(policy)(env)
        simulation = Simulation(scenario, {"observation": "movements"}, EPSILON, jobs)
        return cls(name, worlds, view, policy, acting, simulation)

    def simulated(
        self, values: Sequence[WorldValues], seed: int, folder: Path, title: str
    ) -> list[SimulatedLog]:
        """Return the worlds of some values with the statistics of half an hour in each."""
        summaries = self.summaries(values, seed, folder, title)
        return [SimulatedLog(*pair) for pair in zip(values, summaries, strict=True)]

    def summaries(
        self, values: Sequence[WorldValues], seed: int, folder: Path, title: str, episodes: int = 1
    ) -> list[Summary]:
        """Return the statistics of each world; those that are kept in a folder are read.

        Args:
            values: Values of the worlds.
            seed: Root of the seeds of the episodes.
            folder: The folder.
            title: Name of the progress bar.
            episodes: Half hours in each world.
        """
        kept = folder / f"{file_stem(self.name)}-{_digest(self, values, seed, episodes)}.npz"
        if not kept.exists():
            logs = self._play([value for value in values for _ in range(episodes)], seed, title)
            parts = range(0, len(logs), episodes)
            logs = [TransitionLog.concatenate(logs[k : k + episodes]) for k in parts]
            played = [self.view.summary(log) for log in logs]
            values_of = np.stack([x.values for x in played])
            rows_of = np.stack([x.rows for x in played])
            with replacing(kept) as part, part.open("wb") as file:
                np.savez(file, values=values_of, rows=rows_of)
        with np.load(kept, allow_pickle=False) as file:
            read = [file[name] for name in ("values", "rows")]
        return [Summary(*one) for one in zip(*read, strict=True)]

    def _play(self, values: Sequence[WorldValues], seed: int, title: str) -> list[TransitionLog]:
        """Return the log of half an hour in each world."""
        lanes = self.worlds.lanes
        drawn = [
            StreetWorld(self.worlds.effects(v), (FittedService(lanes, v.service_s),))
            for v in values
        ]
        seeds = [derive_seed(seed, "episode", k) for k in range(len(drawn))]
        with Bars(Console(stderr=True)).task(f"{self.name}, {title}", len(drawn)) as advance:
            return self.simulation.logs(drawn, self.acting, seeds, DURATION_S, advance)


def table(asked: Sequence[Asked]) -> str:
    """Return coverage, width and error by value, as Markdown; the worst coverage first."""
    groups: dict[tuple[str, str], list[Asked]] = {}
    for one in asked:
        groups.setdefault((one.kind, one.name), []).append(one)
        if "green" not in one.name:
            groups.setdefault((one.kind, "all effects"), []).append(one)
    lines = [
        "| streets from | value | cases | covered by 90 % | 95 % interval of that | "
        "width, share of the prior's | error, share of the prior's |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]

    def rate(group: Sequence[Asked]) -> float:
        return float(np.mean([one.covered for one in group]))

    for (kind, name), group in sorted(groups.items(), key=lambda item: rate(item[1])):
        hits = sum(one.covered for one in group)
        ends = binomtest(hits, len(group)).proportion_ci(method="wilson")
        width = np.mean([(one.high - one.low) / one.width for one in group])
        error = _size([one.middle - one.truth for one in group])
        blind = _size([one.blind - one.truth for one in group])
        told = f"{error / blind:.2f}" if blind else "–"
        lines.append(
            f"| {kind} | {name} | {len(group)} | {rate(group):.2f} | "
            f"{ends.low:.2f}–{ends.high:.2f} | {width:.2f} | {told} |"
        )
    lines += ["", "Intervals are of all cases, also where several of them are of one street."]
    return "\n".join(lines)


def _size(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def main() -> None:
    """Simulate, ask, and print a table for each network."""
    summary = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(
        prog="python -m studies.posterior_coverage", description=summary
    )
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--streets", type=int, default=60)
    parser.add_argument("--simulations", type=int, default=160)
    parser.add_argument("--policy", default="max-pressure:10")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--out", type=Path, default=Path("runs/posterior-coverage"))
    given = parser.parse_args()
    require_least(1, streets=given.streets)
    for place, name in enumerate(given.scenarios):
        # Networks of one prior would have the same streets, whose luck would count several times.
        seed = derive_seed(given.seed, "network", place) if place else given.seed
        given.out.mkdir(parents=True, exist_ok=True)
        network = Network.of(name, given.policy, given.jobs)
        asked = study(network, given.streets, given.simulations, seed, given.out)
        print(f"## {name}\n\n{table(asked)}\n", flush=True)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.posterior_coverage", main))
