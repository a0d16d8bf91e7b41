"""``ugat-marl rollout``: record transitions of any policy in any domain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.effects import load
from ugat_marl.errors import OptionError
from ugat_marl.evaluation import policy_factory
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars
from ugat_marl.rollout import Exploring, observer_of, roll_out
from ugat_marl.seeding import derive_seed
from ugat_marl.traffic_env import parallel_env
from ugat_marl.transitions import TransitionLog


@dataclass(frozen=True)
class Rollout:
    """Records transitions, for `train --real-log` or for study.

    Examples:
        ugat-marl rollout single-v1 --domain V4 --policy largest-queue:20 --out v4.parquet

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        out: Parquet file to write.
        policy: A rule or the file of a trained policy.
        domain: Domain to record in.
        episodes: Number of episodes.
        seed: Root of the episodes' seeds.
        epsilon: Chance of a random phase, so that the log holds actions the policy does not take.
        observation: What to record: count, queue, pressure, waiting, density, movements.
        neighbours: How many roads away intersections are recorded too.
        duration_s: Length of an episode in s; default: the scenario's own.
        crossings: Also record when vehicles cross the stop lines: timed grounding reads it.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    out: Path
    policy: str = "largest-queue:20"
    domain: str = "sim"
    episodes: int = 3
    seed: int = 0
    epsilon: float = 0.3
    observation: str = "count"
    neighbours: int = 0
    duration_s: float | None = None
    crossings: bool = False

    def run(self, console: Console) -> int:
        """Records and writes."""
        if self.episodes < 1 or not 0 <= self.epsilon <= 1:
            raise OptionError("--episodes must be at least 1 and --epsilon from 0 to 1")
        require_writable(self.out)
        scenario = load(self.scenario)
        probe = parallel_env(scenario, self.domain, duration_s=self.duration_s)
        policy = policy_factory(self.policy)(probe)
        observer = observer_of(probe, self.observation, self.neighbours)
        options = {"duration_s": self.duration_s, "crossings": self.crossings}
        env = parallel_env(scenario, self.domain, **options, **policy.env_options)
        logs: list[TransitionLog] = []
        try:
            with Bars(console).task(f"{self.policy} in {env.domain}", self.episodes) as advance:
                for episode in range(self.episodes):
                    seed = derive_seed(self.seed, "rollout", episode)
                    played = roll_out(env, Exploring(policy, self.epsilon), seed, record=observer)
                    assert played.log is not None
                    logs.append(played.log)
                    advance(note=f"ATT {env.scores().att_s:.0f} s")
        finally:
            env.close()
        log = TransitionLog.concatenate(logs)
        log.write(self.out)
        console.print(f"{len(log)} transitions: {self.out}", soft_wrap=True)
        return 0
