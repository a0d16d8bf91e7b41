"""Stable-Baselines3's PPO and DQN, and MaskablePPO of sb3-contrib, with one network for all agents.

`ugat_marl.envs.adapters.sb3.AgentsVecEnv` makes each intersection one environment; observations are
padded and carry a one-hot of the agent. MaskablePPO asks this environment for action masks. PPO and
DQN of the library have no masks: here the observation ends with the mask. The policies below remove
it, and give forbidden actions the probability 0, or the lowest value. DQN explores only among
allowed actions.

    python baselines/sb3.py --scenario grid2x2-v1 --episodes 100 --out runs/sb3
    python baselines/sb3.py --scenario mixed-v1 --algorithm dqn
    ugat-marl train grid2x2-v1 --learner sb3-ppo
"""
# pyright: reportMissingImports=false, reportUnknownVariableType=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.dqn.policies import DQNPolicy as LibraryPolicy
from stable_baselines3.dqn.policies import QNetwork
from torch import Tensor, nn

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_indicator, pad_spaces
from ugat_marl.envs.adapters.sb3 import AgentsVecEnv
from ugat_marl.errors import EpisodeError, UnknownNameError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    decisions_per_episode,
    linear_layers,
    preserve_random_state,
    roll_out_length,
    seed_generators,
)

ALGORITHMS = ("ppo", "maskable-ppo", "dqn")
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_FORBIDDEN = -1e8  # logit or Q of forbidden actions; finite, because -inf makes gradients nan


@dataclass(frozen=True)
class SB3Config:
    """Settings of the learner; one decision covers all agents."""

    algorithm: Literal["ppo", "maskable-ppo", "dqn"] = "maskable-ppo"
    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.95  # weight of the next decision's value (gamma)
    max_gradient: float = 0.5  # longer gradients are scaled down to this norm
    # PPO
    update_every: int = 120  # least decisions in a roll-out; the next divisor of an episode counts
    epochs: int = 8  # passes over each roll-out
    minibatch: int = 30  # decisions in a gradient step
    gae_lambda: float = 0.95  # from one-step (0) to Monte Carlo (1) advantages
    clip: float = 0.2  # share by which the probability of an action may move in an update
    entropy_weight: float = 0.01  # weight of the entropy bonus
    value_weight: float = 0.5  # weight of the critic's squared error
    # DQN
    replay: int = 20_000  # decisions it stores
    batch: int = 512  # transitions, each of one agent, in a gradient step
    warmup: int = 100  # decisions before it learns
    explore: int = 2_400  # decisions over which the share of random actions falls
    least_exploration: float = 0.03  # final share of random actions
    target_rate: float = 0.01  # step of the target network to the network in each update

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise UnknownNameError("algorithm", self.algorithm, ALGORITHMS)
        check_settings(self, "least_exploration", "target_rate")


def _allowed(observations: Any, actions: Any) -> Any:
    """Return the mask at the end of observations, ``(batch, actions)``, of an action space."""
    return observations[:, -int(actions.n) :] > 0.5


class WithoutMask(BaseFeaturesExtractor):
    """Feature extractor: the observation without the mask at its end."""

    def __init__(self, observation_space: spaces.Box, actions: int) -> None:
        super().__init__(observation_space, observation_space.shape[0] - actions)
        self.actions = actions

    def forward(self, observations: Tensor) -> Tensor:
        """Return ``(batch, size)`` of ``(batch, size + actions)``."""
        return observations[:, : -self.actions]


class MaskedActorCritic(ActorCriticPolicy):
    """PPO's policy; actions that the mask at the observation's end forbids have probability 0."""

    def extract_features(
        self, obs: Any, features_extractor: BaseFeaturesExtractor | None = None
    ) -> Any:
        """Return the features and keep the mask; the library then makes the distribution."""
        self._allowed = _allowed(obs, self.action_space)
        return super().extract_features(obs, features_extractor)

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Any:
        logits = self.action_net(latent_pi).masked_fill(~self._allowed, _FORBIDDEN)
        return self.action_dist.proba_distribution(action_logits=logits)


class MaskedQNetwork(QNetwork):
    """Q-network; actions that the mask at the observation's end forbids have the lowest Q."""

    def forward(self, obs: Any) -> Tensor:
        """Return Q, ``(batch, actions)``, of ``(batch, size + actions)``."""
        return super().forward(obs).masked_fill(~_allowed(obs, self.action_space), _FORBIDDEN)


class MaskedDQNPolicy(LibraryPolicy):
    """DQN's policy with masked Q-networks."""

    def make_q_net(self) -> QNetwork:
        """Return a masked Q-network; the library asks for the acting one and the target."""
        arguments = self._update_features_extractor(self.net_args, features_extractor=None)
        return MaskedQNetwork(**arguments).to(self.device)


class MaskedDQN(DQN):
    """DQN that explores among allowed actions; each agent explores independently."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return actions, ``(agents,)``: random for a share of the agents, greedy for the others.

        The library itself lets all agents explore at a step, or none.
        """
        greedy, state = self.policy.predict(observation, state, episode_start, deterministic=True)
        if deterministic:
            return greedy, state
        allowed = _allowed(observation, self.action_space)
        drawn = (np.random.random(allowed.shape) * allowed).argmax(1)  # noqa: NPY002 - as SB3 does
        explores = np.random.random(len(drawn)) < self.exploration_rate  # noqa: NPY002
        return np.where(explores, drawn, greedy), state

    def _sample_action(
        self, learning_starts: int, action_noise: Any = None, n_envs: int = 1
    ) -> tuple[Any, Any]:
        action, _ = self.predict(self._last_obs)  # before learning starts the rate is 1
        return action, action


class Seeds(BaseCallback):
    """Callback that seeds the library's generators by the number of steps, for exact resumes."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._seed = seed

    def _on_rollout_start(self) -> None:
        seed_generators(self._seed, "sb3", self.model.num_timesteps)

    def _on_step(self) -> bool:
        return True


class SB3(LibraryLearner):
    """Learner by one of the library's algorithms; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(self, env: AnyParallelEnv, config: SB3Config | None = None, seed: int = 0) -> None:
        self.config = config or SB3Config()
        super().__init__(env, f"baselines.sb3.{self.config.algorithm}")
        self._decisions = decisions_per_episode(env)
        with preserve_random_state():
            seed_generators(seed, "sb3", "weights")
            self._model: Any = self._made(env)
        # Nothing is logged; the library's own logger leaves a folder for each call of `learn`.
        self._model.set_logger(Logger(folder=None, output_formats=[]))

    def _made(self, env: AnyParallelEnv) -> Any:
        config, agents = self.config, len(self.agents)
        network: dict[str, Any] = {"net_arch": list(config.hidden), "activation_fn": nn.ReLU}
        common: dict[str, Any] = {
            "env": self._wrapped(env),
            "learning_rate": config.learning_rate,
            "gamma": config.discount,
            "max_grad_norm": config.max_gradient,
            "policy_kwargs": network,
            "device": "cpu",
        }
        if config.algorithm != "maskable-ppo":
            network["features_extractor_class"] = WithoutMask
            network["features_extractor_kwargs"] = {"actions": self.agents.most_actions}
        if config.algorithm == "dqn":
            model = MaskedDQN(
                MaskedDQNPolicy,
                **common,
                buffer_size=config.replay * agents,
                batch_size=config.batch,
                learning_starts=config.warmup * agents,
                train_freq=1,
                tau=config.target_rate,
                target_update_interval=agents,
            )
            model.exploration_schedule = lambda _: self._exploration()
            model.exploration_rate = 1.0
            return model
        steps = roll_out_length(self._decisions, config.update_every)
        kind, policy = (
            (PPO, MaskedActorCritic) if config.algorithm == "ppo" else (MaskablePPO, "MlpPolicy")
        )
        return kind(
            policy,
            **common,
            n_steps=steps,
            batch_size=min(steps, config.minibatch) * agents,
            n_epochs=config.epochs,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip,
            ent_coef=config.entropy_weight,
            vf_coef=config.value_weight,
        )

    def _wrapped(self, env: AnyParallelEnv) -> VecEnv:
        by_itself = self.config.algorithm == "maskable-ppo"
        return AgentsVecEnv([agent_indicator(pad_spaces(env))], masks_in_observation=not by_itself)

    def _exploration(self) -> float:
        """Return the share of random actions.

        The library's own schedule depends on the calls of `learn`, so it would change on a resume.
        """
        config = self.config
        done = self._model.num_timesteps / len(self.agents) - config.warmup
        return max(config.least_exploration, 1 - max(done, 0) / config.explore)

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        self._model.set_env(self._wrapped(env))
        steps = episodes * self._decisions * len(self.agents)
        until = self.episodes + episodes
        self._model.learn(steps, Seeds(seed), log_interval=None, reset_num_timesteps=False)
        if self.episodes != until:
            raise EpisodeError(
                f"episodes of {self._decisions} decisions were expected, but {steps} steps of "
                f"{len(self.agents)} agents made other ones; this learner needs equal episodes"
            )

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        policy = self._model.policy
        if self.config.algorithm == "dqn":  # the target is a running mean of the network: steadier
            return [linear_layers(policy.q_net_target)]
        return [[*linear_layers(policy.mlp_extractor.policy_net), policy.action_net]]

    def _networks(self) -> Mapping[str, Tensor]:
        return self._model.policy.state_dict()

    def _rest(self) -> dict[str, Any]:
        model = self._model
        kept = {
            "adam": model.policy.optimizer.state_dict(),
            "counters": [model.num_timesteps, model._n_updates],
        }
        if self.config.algorithm == "dqn":
            buffer = model.replay_buffer
            kept["position"] = [buffer.pos, buffer.full]
            kept["replay"] = {
                name: torch.from_numpy(getattr(buffer, name)[: buffer.size()].copy())
                for name in _REPLAY
            }
        return kept

    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        model = self._model
        if self.config.algorithm == "dqn":
            buffer, (position, full) = model.replay_buffer, rest["position"]
            for name in _REPLAY:
                stored = rest["replay"][name].numpy()
                if full and len(stored) != buffer.buffer_size:
                    raise ValueError(
                        f"a replay of {len(stored)} decisions, not {self.config.replay}"
                    )
                getattr(buffer, name)[: len(stored)] = stored
            buffer.pos, buffer.full = position, full
        model.policy.load_state_dict(networks)
        model.policy.optimizer.load_state_dict(rest["adam"])
        model.num_timesteps, model._n_updates = rest["counters"]
        if self.config.algorithm == "dqn":
            model.exploration_rate = self._exploration()


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train PPO, MaskablePPO or DQN of Stable-Baselines3 on one scenario."""

    sb3: Annotated[SB3Config, tyro.conf.arg(name="")] = SB3Config()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: SB3(env, args.sb3, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
