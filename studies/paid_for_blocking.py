"""Is a policy paid for blocking? Return against travel time, under two rewards.

    python -m studies.paid_for_blocking single-v1 --domain 'demand_level=*,2'
    python -m studies.paid_for_blocking resco:ingolstadt7 --seeds 3

Policies of all qualities play the same episodes: rules, and policies that never serve one of the
phases of each intersection. Each episode is paid by `queue` and by `total-queue`. A reward is wrong
about two policies if it pays more to the one whose vehicles, over all that are due, travel longer.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import rankdata

from ugat_marl import parallel_env
from ugat_marl.cli import guarded
from ugat_marl.effects import Domain
from ugat_marl.envs import Rewarder, TrafficEnv
from ugat_marl.errors import require_least
from ugat_marl.policies import Policy, make_rule, roll_out
from ugat_marl.scenarios import Scenario

REWARDS = ("queue", "total-queue")
RULES = (
    "random", "fixed-time:10", "fixed-time:30", "fixed-time:90",
    "largest-queue:20", "largest-queue:40", "max-pressure:20", "max-pressure:40",
)  # fmt: skip
STARVED = (0, 1, 2)
"""Phases that the blocking policies never show."""
MARGIN = 0.02
"""Share by which travel times must differ before a reward can be wrong about them. Means over the
same three seeds differ by 1 % by chance."""


@dataclass
class Starving:
    """Policy that shows all phases in turn, 30 s each, except one.

    Args:
        env: The environment.
        phase: The phase left out, counted round where an intersection has fewer.
    """

    env: TrafficEnv
    phase: int
    env_options: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        counts = {agent: int(space.n) for agent, space in self.env.action_spaces.items()}
        self._phases = {
            agent: [phase for phase in range(count) if phase != self.phase % count]
            for agent, count in counts.items()
        }
        self._decision = 0

    def reset(self, seed: int) -> None:
        """Begin with the first phase again."""
        self._decision = 0

    def act(self, observations: Mapping[str, Any], infos: Any) -> dict[str, int]:
        """Return the phase whose turn it is."""
        turn = int(self._decision * self.env.decision_interval_s // 30)
        self._decision += 1
        return {agent: phases[turn % len(phases)] for agent, phases in self._phases.items()}


@dataclass(frozen=True)
class Paid:
    """Means over the episodes of one policy.

    Attributes:
        policy: Name of the policy.
        att_s: Average travel time over all vehicles due, s.
        backlog: Vehicles that wait to enter the network, mean over time.
        reward: Reward to its mean over decisions and agents.
    """

    policy: str
    att_s: float
    backlog: float
    reward: dict[str, float]


def play(
    scenario: str | Scenario,
    domain: Domain,
    policy: str,
    seeds: Sequence[int],
    duration_s: float | None = None,
) -> Paid:
    """Play episodes of one policy and pay each by both rewards.

    Args:
        scenario: The scenario.
        domain: The domain.
        policy: A rule, or ``"starving:2"`` for the policy that never shows phase 2.
        seeds: Seeds of the episodes.
        duration_s: Length of an episode, s; None for the scenario's own.
    """
    env = parallel_env(scenario, domain, duration_s=duration_s)
    actor = _made(policy, env)
    if actor.env_options:
        env.close()
        env = parallel_env(scenario, domain, duration_s=duration_s, **actor.env_options)
        actor = _made(policy, env)
    payers = [Rewarder(env.network, name) for name in REWARDS]
    rows: list[list[float]] = []
    for seed in seeds:
        moments: list[list[float]] = []

        def pay(_step: int, moments: list[list[float]] = moments) -> None:
            seen = env.snapshot
            paid = [float(np.mean(payer.rewards(seen, seen))) for payer in payers]
            moments.append([*paid, float(seen.backlog)])

        roll_out(env, actor, seed, on_step=pay)
        rows.append([env.scores().att_s, *np.mean(moments, axis=0)])
    env.close()
    att_s, *paid, backlog = np.mean(rows, axis=0).tolist()
    return Paid(policy, att_s, backlog, dict(zip(REWARDS, paid, strict=True)))


def _made(policy: str, env: TrafficEnv) -> Policy:
    name, _, phase = policy.partition(":")
    return Starving(env, int(phase)) if name == "starving" else make_rule(policy, env)


def wrong_pairs(
    rows: Sequence[Paid], reward: str, margin: float = MARGIN
) -> list[tuple[str, str, float]]:
    """Return the pairs of policies of which a reward pays the worse one more.

    Args:
        rows: Policies in the same episodes.
        reward: Name of the reward.
        margin: Share by which travel times must differ.

    Returns:
        The policy paid more, the one paid less, and the share by which vehicles of the first travel
        longer.
    """
    return [
        (worse.policy, better.policy, worse.att_s / better.att_s - 1.0)
        for worse in rows
        for better in rows
        if worse.att_s > (1.0 + margin) * better.att_s
        and worse.reward[reward] > better.reward[reward]
    ]


def rank_correlation(rows: Sequence[Paid], reward: str) -> float:
    """Return Spearman's correlation of the return with minus the travel time."""
    paid = [row.reward[reward] for row in rows]
    return float(np.corrcoef(rankdata(paid), rankdata([-row.att_s for row in rows]))[0, 1])


def main() -> None:
    """Play all policies and print a table and the wrong pairs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("scenario")
    parser.add_argument("--domain", default="sim")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--duration-s", type=float)
    given = parser.parse_args()
    require_least(1, seeds=given.seeds)
    names = [*RULES, *(f"starving:{phase}" for phase in STARVED)]
    rows: list[Paid] = []
    print(f"{'policy':20}{'ATT s':>9}{'backlog':>9}" + "".join(f"{name:>13}" for name in REWARDS))
    for name in names:
        row = play(given.scenario, given.domain, name, range(1, 1 + given.seeds), given.duration_s)
        paid = "".join(f"{row.reward[reward]:13.1f}" for reward in REWARDS)
        print(f"{name:20}{row.att_s:9.1f}{row.backlog:9.1f}{paid}", flush=True)
        rows.append(row)
    pairs = len(rows) * (len(rows) - 1) // 2
    for reward in REWARDS:
        wrong = wrong_pairs(rows, reward)
        print(
            f"{reward}: rank correlation with travel time {rank_correlation(rows, reward):.2f}; "
            f"wrong about {len(wrong)} of {pairs} pairs"
        )
        for more, less, longer in sorted(wrong, key=lambda pair: -pair[2])[:3]:
            print(f"    {more} is paid more than {less}, where vehicles travel {longer:.0%} longer")


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.paid_for_blocking", main))
