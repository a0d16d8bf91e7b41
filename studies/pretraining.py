"""Pretrain one network "universal" on drawn road networks; its weights may start a training.

    python -m studies.pretraining OUT --networks 150 --episodes 800

Every road network has a learner with its own replay memory. All learners share their weights. A
few road networks are played at a time, and then updates follow, each from the memory of a drawn
one. So no network is forgotten while others are played (Oroojlooy et al. 2020 train one policy on
many intersections in the same way).

Road networks are drawn by seeds from `FIRST_SEED` on. Each episode takes the next one of a random
order, in a world drawn for it: the plain simulation, one of random vehicles and drivers, or one
with late commands. Every so many episodes the greedy policy plays road networks that it never
trained on, beside two rules. The table of these checks is written beside the weights.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.same_options import require_same
from ugat_marl.cli import guarded
from ugat_marl.effects import Domain
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import OutputError, require_least
from ugat_marl.experiments import drawn_effects, effect_ranges
from ugat_marl.files import write_whole
from ugat_marl.policies import (
    DQN,
    UNIVERSAL_NAME,
    DQNConfig,
    InitialWeights,
    NetworkPolicy,
    Policy,
    make_rule,
    observed_options,
    one_thread,
    roll_out,
)
from ugat_marl.scenarios import NetworkRanges, Scenario, draw_scenario, read_scenario
from ugat_marl.seeding import derive_seed, numpy_generator, torch_generator
from ugat_marl.simulation import kept_warm

FIRST_SEED = 100_000
"""Seed of the first road network of the training."""

FIRST_CHECK_SEED = 90_000
"""Seed of the first road network of the checks."""

CHECKED = 8
"""Number of road networks of a check."""

RULES = ("max-pressure:20", "largest-queue:30")
"""Rules that are played beside the policy in a check."""

OPTIONS = observed_options(UNIVERSAL_NAME)
"""Options of the environments of the network."""

RULE_OPTIONS = {"observation": "movements"}
"""Options of the environments of the rules."""

SETTINGS = DQNConfig(
    network="universal",
    hidden=(32, 32),
    steps=3,
    batch_size=64,
    replay_capacity=4_000,
    warmup_decisions=50,
    learning_rate=1e-3,
)

AT_A_TIME = 4
"""Road networks that are played at the same time."""

SHARES = (0.5, 0.3, 0.2)
"""Shares of episodes in the plain simulation, with random vehicles, and with late commands."""

NEVER = 10**9
"""Decisions between updates while an episode is played: all updates follow it."""


class Pretraining:
    """A network "universal" that learns on many road networks in turn.

    Args:
        config: Settings of the learners; ``batch_size`` counts transitions of all agents together,
            so that an update costs the same on every road network.
        seed: Root of every random choice.

    Attributes:
        learners: Learner of each road network that has been played, by its name.
        episodes: Episodes so far.
    """

    def __init__(self, config: DQNConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self.learners: dict[str, DQN] = {}
        self.episodes = 0

    def play(self, envs: Mapping[str, AnyParallelEnv], updates: int, epsilon: float) -> None:
        """Play an episode on each of some road networks, then update from the memories of all.

        The episodes run in threads, all with the same weights, so that the result does not depend
        on which one ends first.

        Args:
            envs: Name of each road network, and the network in any domain; its memory goes on.
            updates: Number of updates.
            epsilon: Share of exploratory decisions.
        """
        playing = {
            name: self.learners.get(name) or self._new(name, env) for name, env in envs.items()
        }
        for learner in playing.values():
            learner.config = replace(learner.config, epsilon_start=epsilon, epsilon_end=epsilon)
        with one_thread(), ThreadPoolExecutor(len(playing)) as threads:
            played = [
                threads.submit(learner.learn, envs[name], 1, self._seed_of(name))
                for name, learner in playing.items()
            ]
            for episode in played:
                episode.result()
            self._update(updates)
        self.episodes += len(playing)

    def start(self, origin: str) -> InitialWeights:
        """Return the weights so far.

        Args:
            origin: How they were learned.
        """
        learner = next(iter(self.learners.values()))
        return InitialWeights.of_policy(learner.policy(), origin)

    def policy(self, env: AnyParallelEnv) -> NetworkPolicy:
        """Return the greedy policy of the weights so far, for any road network."""
        learner = DQN.of(env, self._config, self._seed)
        if self.learners:
            learner.load_initial_weights(self.start(""))
        return learner.policy()

    def set_learning_rate(self, rate: float) -> None:
        """Change the step size of all learners."""
        for learner in self.learners.values():
            for group in learner._adam.param_groups:
                group["lr"] = rate

    def _seed_of(self, name: str) -> int:
        return derive_seed(self._seed, "pretraining", name)

    def _new(self, name: str, env: AnyParallelEnv) -> DQN:
        agents = len(env.possible_agents)
        config = replace(
            self._config,
            update_every=NEVER,
            batch_size=max(1, self._config.batch_size // agents),
        )
        learner = DQN.of(env, config, self._seed)
        if self.learners:
            learner.share_weights(next(iter(self.learners.values())))
        self.learners[name] = learner
        return learner

    def _update(self, updates: int) -> None:
        """Update from the memories of drawn road networks, one after the other."""
        known: Sequence[DQN] = list(self.learners.values())
        choose = numpy_generator(self._seed, "pretraining", "order", self.episodes)
        sample = torch_generator(self._seed, "pretraining", "sample", self.episodes)
        for place in choose.integers(len(known), size=updates):
            known[int(place)].update(sample)


@kept_warm()
def main(arguments: Sequence[str] | None = None) -> None:
    """Train and check.

    Raises:
        OptionError: There is no network or episode, no episode between checks, or fewer than no
            updates.
        OutputError: The folder holds weights already, or networks of another draw.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--networks", type=int, default=150)
    parser.add_argument("--largest", type=int, default=3, help="most intersections of a network")
    parser.add_argument("--episodes", type=int, default=560)
    parser.add_argument("--updates", type=int, default=160, help="updates after an episode")
    parser.add_argument("--every", type=int, default=140, help="episodes between checks")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so many minutes")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    require_least(1, networks=given.networks, episodes=given.episodes, every=given.every)
    require_least(0, updates=given.updates)
    if (weights := given.out / "start.pt").exists():
        raise OutputError(f"{weights}: holds weights already; give another folder")
    ranges = NetworkRanges(intersections=(1, given.largest))
    networks = drawn_networks(given.out / "networks", FIRST_SEED, given.networks, ranges)
    checked = drawn_networks(given.out / "checked", FIRST_CHECK_SEED, CHECKED, ranges)
    bars = {rule: played(checked, partial(make_rule, rule), RULE_OPTIONS) for rule in RULES}
    best = np.min(list(bars.values()), axis=0)
    lines = ["| episodes | minutes | ATT, s | over the better rule |", "|---:|---:|---:|---:|"]
    for rule, att_s in bars.items():
        lines.append(f"| `{rule}` | | {att_s.mean():.1f} | {np.mean(att_s / best):.3f} |")
    print("\n".join(lines), flush=True)
    pretraining = Pretraining(SETTINGS, given.seed)
    begin = time.monotonic()
    while pretraining.episodes < given.episodes:
        play(pretraining, networks, given)
        episode, minutes = pretraining.episodes, (time.monotonic() - begin) / 60
        ends = episode >= given.episodes or minutes > given.minutes
        if episode % given.every < AT_A_TIME or ends:
            att_s = played(checked, pretraining.policy, OPTIONS)
            lines.append(
                f"| {episode} | {minutes:.0f} | {att_s.mean():.1f} | {np.mean(att_s / best):.3f} |"
            )
            print(lines[-1], (att_s / best).round(2), flush=True)
            origin = f"{episode} episodes on {given.networks} networks, seed {given.seed}"
            pretraining.start(origin).save(weights)
            write_whole(given.out / "checks.md", "\n".join(lines) + "\n")
        if ends:
            break


def drawn_networks(
    folder: Path, first_seed: int, count: int, ranges: NetworkRanges
) -> list[Scenario]:
    """Return drawn road networks; those that a folder holds already are read.

    Raises:
        OutputError: The networks there are of another draw.
    """
    draw = {"first_seed": first_seed, "largest": ranges.intersections[1]}
    require_same(folder / "draw.json", draw, begun=any(folder.glob("d[0-9]*")))
    for seed in range(first_seed, first_seed + count):
        if not (folder / f"d{seed}").exists():
            draw_scenario(folder / f"d{seed}", seed, ranges)
    return [read_scenario(str(folder / f"d{first_seed + k}")) for k in range(count)]


def play(pretraining: Pretraining, networks: Sequence[Scenario], given: argparse.Namespace) -> None:
    """Play the next episodes, each in a world drawn for it, and update.

    A road network that comes twice among them waits for the next call.
    """
    first = pretraining.episodes
    progress = first / given.episodes
    rate = float(np.interp(progress, (0.4, 1), (1, 0.1)))
    pretraining.set_learning_rate(SETTINGS.learning_rate * rate)
    with contextlib.ExitStack() as stack:
        envs: dict[str, TrafficEnv] = {}
        for episode in range(first, first + AT_A_TIME):
            order = numpy_generator(given.seed, "order", episode // len(networks))
            network = networks[int(order.permutation(len(networks))[episode % len(networks)])]
            if network.id in envs:
                break
            domain = drawn_domain(network, derive_seed(given.seed, "domain", episode))
            env = parallel_env(network, domain, **OPTIONS)
            envs[network.id] = stack.enter_context(contextlib.closing(env))
        epsilon = float(np.interp(first, (0, 40, 0.5 * given.episodes), (1.0, 0.1, 0.05)))
        pretraining.play(envs, len(envs) * given.updates, epsilon)


def drawn_domain(scenario: Scenario, seed: int) -> Domain:
    """Draw the world of an episode."""
    generator = numpy_generator(seed, "pretraining")
    kind = generator.choice(3, p=SHARES)
    if kind == 0:
        return "sim"
    if kind == 1:
        return drawn_effects(effect_ranges(scenario), seed)
    decisions = int(generator.integers(1, 4))
    return f"execution_delay={decisions * scenario.control.decision_interval_s:g}"


def played(
    scenarios: Sequence[Scenario],
    policy_for: Callable[[TrafficEnv], Policy],
    options: Mapping[str, Any],
) -> NDArray[np.float64]:
    """Return the ATT of a policy on each road network, in s."""
    att_s: list[float] = []
    for scenario in scenarios:
        with contextlib.closing(parallel_env(scenario, "sim", **options)) as env:
            roll_out(env, policy_for(env), 1)
            att_s.append(env.scores().att_s)
    return np.array(att_s)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.pretraining", main))
