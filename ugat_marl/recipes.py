"""Ways to train a policy: plainly, on in another world, or grounded; each can be taken up again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ugat_marl.effects import Domain
from ugat_marl.learners.dqn import DQN
from ugat_marl.policy import AnyParallelEnv
from ugat_marl.progress import Reporter
from ugat_marl.scenario import Scenario
from ugat_marl.traffic_env import TrafficEnv, parallel_env
from ugat_marl.ugat import CHUNK, UgatConfig
from ugat_marl.worlds import SimulatedWorld


def train_until(
    learner: DQN,
    env: AnyParallelEnv,
    episodes: int,
    seed: int,
    progress: Path,
    reporter: Reporter,
    title: str,
) -> None:
    """Trains a learner until it has had so many episodes in its life.

    Args:
        learner: Fresh, or as it was saved.
        env: Where.
        episodes: In all, those it has had already included.
        seed: Root of every random choice.
        progress: File it is saved to every few episodes, where an interrupted training goes on.
        reporter: Shows progress.
        title: What to call the work there.
    """
    left = episodes - learner.episodes
    with reporter.task(title, max(left, 0)) as advance:
        while left > 0:
            chunk = min(CHUNK, left)
            learner.learn(env, chunk, seed, lambda _number, _numbers: advance())
            learner.save(progress)
            left -= chunk


def simulated_worlds(
    scenario: Scenario,
    sim: Domain,
    real: Domain,
    ugat: UgatConfig,
    options: Mapping[str, Any],
) -> tuple[SimulatedWorld, SimulatedWorld]:
    """Where D_sim and D_real come from if both worlds can be played.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        ugat: How often is rolled out, and whether greens are delayed by chance.
        options: Of both environments.
    """

    def world(domain: Domain, name: str, episodes: int, most_delay_s: int = 0) -> SimulatedWorld:
        def make() -> TrafficEnv:
            crossings = ugat.most_delay_s > 0  # they tell best when a green began
            return parallel_env(scenario, domain, crossings=crossings, **options)

        return SimulatedWorld(make, name, episodes, ugat.rollout_epsilon, most_delay_s)

    return (
        world(sim, "sim", ugat.sim_rollouts, ugat.most_delay_s),
        world(real, "real", ugat.real_rollouts),
    )
