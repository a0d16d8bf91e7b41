"""Stable-Baselines3's PPO through SuperSuit, as many pages on PettingZoo show it.

It works, and it is here because it is so common. `sb3.py` is the same learner without these faults
of SuperSuit 3.11:

- Its vector environment never reports a truncation. PPO takes the end of an episode for a
  termination and learns the value 0 there, although traffic continues.
- It has no `seed`: `PPO(seed=...)` fails. Here the inner `TrainingEnv` seeds every episode.
- `concat_vec_envs_v1` copies the environment and never closes the copies. With worker processes it
  loses their records of rewards. It is not used here.
- `pad_action_space_v0` silently turns an action that does not exist into action 0. Here
  `ugat_marl.envs.wrappers.pad_spaces` raises an error instead, and masks exclude such actions.
- `agent_indicator_v0` converts every step to PettingZoo's other interface and back, and steps a
  `GroundedEnv` after the end of its episode. `ugat_marl.envs.wrappers.agent_indicator` does not.
- It has no action masks. Here the observation ends with the mask.

    python baselines/supersuit_ppo.py --scenario grid2x2-v1 --episodes 100 --out runs/supersuit
"""
# pyright: reportMissingImports=false

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro
from supersuit.vector import MarkovVectorEnv
from supersuit.vector.sb3_vector_wrapper import SB3VecEnvWrapper

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_indicator, appended_mask, pad_spaces
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import EpisodeCallback, load_baseline

_sb3: Any = load_baseline("sb3-ppo")


@dataclass(frozen=True)
class SuperSuitConfig(_sb3.SB3Config):
    """Settings of the learner, as for PPO in `sb3.py`."""

    algorithm: Literal["ppo"] = "ppo"


class SuperSuitPPO(_sb3.SB3):
    """Learner by PPO in SuperSuit's environment; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: SuperSuitConfig | None = None, seed: int = 0
    ) -> None:
        super().__init__(env, config or SuperSuitConfig(), seed)
        self._kind = "baselines.supersuit.ppo"

    def _wrapped(self, env: AnyParallelEnv) -> Any:
        return SB3VecEnvWrapper(MarkovVectorEnv(appended_mask(agent_indicator(pad_spaces(env)))))


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train PPO of Stable-Baselines3 through SuperSuit on one scenario."""

    sb3: Annotated[SuperSuitConfig, tyro.conf.arg(name="")] = SuperSuitConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: SuperSuitPPO(env, args.sb3, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
