"""PPO of RLlib with several policies: one for each kind of intersection.

Agents of one group (`<group>_<n>`: the same phases, the same lanes) share a policy, which gets a
one-hot of the agent. Each group has its own policy, so nothing is padded. RLlib's environment
runner plays whole episodes; its learner updates. Observations hold masks as ``action_mask``. All
runs in this process, without Ray.

    python baselines/rllib_ppo.py --scenario grid2x2-v1 --episodes 100 --out runs/rllib
    ugat-marl train mixed-v1 --learner rllib-ppo
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import logging
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from torch import Tensor, nn

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_groups, agent_indicator, masked_observation
from ugat_marl.errors import UgatMarlError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    decisions_per_episode,
    linear_from_weights,
    linear_layers,
    preserve_random_state,
    seed_generators,
)
from ugat_marl.seeding import derive_seed


@dataclass(frozen=True)
class RLlibConfig:
    """Settings of the learner."""

    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers of actor and critic
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.95  # weight of the next decision's value (gamma)
    gae_lambda: float = 0.95  # from one-step (0) to Monte Carlo (1) advantages
    clip: float = 0.2  # share by which the probability of an action may move in an update
    entropy_weight: float = 0.01  # weight of the entropy bonus
    value_weight: float = 0.5  # weight of the critic's squared error
    max_gradient: float = 0.5  # longer gradients are scaled down to this norm
    epochs: int = 8  # passes over each episode
    minibatch: int = 30  # decisions (of the largest group of agents) in a gradient step

    def __post_init__(self) -> None:
        check_settings(self)


class Spaces:
    """Stand-in for an environment that only knows its spaces; RLlib asks it before training."""

    def __init__(self, env: AnyParallelEnv) -> None:
        self.agents = list(env.possible_agents)
        self.observations = {agent: env.observation_space(agent) for agent in self.agents}
        self.actions = {agent: env.action_space(agent) for agent in self.agents}

    def reset(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def observation_space(self, agent: str) -> Any:
        """Return the observation space of an agent."""
        return self.observations[agent]

    def action_space(self, agent: str) -> Any:
        """Return the action space of an agent."""
        return self.actions[agent]


class Seat(ParallelPettingZooEnv):
    """Environment in the form of RLlib's runner; each `learn` sets another `par_env`."""

    def __init__(self, context: Mapping[str, Any]) -> None:
        super().__init__(context["spaces"])

    def step(self, action_dict: dict[str, Any]) -> Any:
        """Take a step; report only the truncation of all agents together.

        If every agent is truncated by itself, RLlib 2.60 takes that for a termination, and
        `MultiAgentEpisode` counts the future as worth 0.
        """
        observations, rewards, _, truncated, infos = self.par_env.step(action_dict)
        over = {"__all__": all(truncated.values())}
        return observations, rewards, {"__all__": False}, over, infos


class RLlib(LibraryLearner):
    """Learner by RLlib's PPO; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: RLlibConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config or RLlibConfig()
        super().__init__(env, "baselines.rllib.ppo")
        self._groups = agent_groups(self.agents)
        self._decisions = decisions_per_episode(env)
        # RLlib logs errors that it raises as well.
        logging.getLogger("ray.rllib").setLevel(logging.CRITICAL)
        with preserve_random_state(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            config_of_library = self._library_config(env, derive_seed(seed, "rllib", "weights"))
            seed_generators(seed, "rllib", "weights")
            self._runner: Any = MultiAgentEnvRunner(config=config_of_library)
            self._learner: Any = config_of_library.build_learner(spaces=self._runner.get_spaces())
        self._give_weights()

    def _library_config(self, env: AnyParallelEnv, seed: int) -> Any:
        given, groups = self.config, dict(self._groups)
        largest = max(Counter(groups.values()).values())  # RLlib counts each agent's decisions
        spaces = Spaces(self._wrapped(env))
        network = {
            "fcnet_hiddens": list(given.hidden),
            "fcnet_activation": "relu",
            "vf_share_layers": False,
        }
        modules = {
            group: RLModuleSpec(
                module_class=ActionMaskingTorchRLModule,
                observation_space=spaces.observations[agent],
                action_space=spaces.actions[agent],
                model_config=network,
            )
            for agent, group in reversed(groups.items())
        }
        return (
            PPOConfig()
            .environment(Seat, env_config={"spaces": spaces}, disable_env_checking=True)
            .env_runners(num_env_runners=0, batch_mode="complete_episodes")
            .learners(num_learners=0, num_gpus_per_learner=0)
            .multi_agent(
                policies=set(modules), policy_mapping_fn=lambda agent, *_, **__: groups[agent]
            )
            .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=modules))
            .training(
                lr=given.learning_rate,
                gamma=given.discount,
                lambda_=given.gae_lambda,
                clip_param=given.clip,
                entropy_coeff=given.entropy_weight,
                vf_loss_coeff=given.value_weight,
                vf_clip_param=float("inf"),
                use_kl_loss=False,
                grad_clip=given.max_gradient,
                grad_clip_by="global_norm",
                train_batch_size_per_learner=self._decisions,
                minibatch_size=min(self._decisions, given.minibatch) * largest,
                num_epochs=given.epochs,
                shuffle_batch_per_epoch=True,
            )
            .debugging(seed=seed, log_level="ERROR")
        )

    def _wrapped(self, env: AnyParallelEnv) -> AnyParallelEnv:
        return masked_observation(agent_indicator(env))

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        seat = self._runner.env.envs[0].unwrapped
        stand_in, seat.par_env = seat.par_env, self._wrapped(env)
        try:
            for _ in range(episodes):
                seed_generators(seed, "rllib", "episode", self.episodes)
                played = self._runner.sample(num_episodes=1)
                self._update(played)
        except RuntimeError as error:
            if isinstance(error.__cause__, UgatMarlError):  # the environment's own error message
                raise error.__cause__ from None
            raise
        finally:
            seat.par_env = stand_in

    def _update(self, played: Any) -> None:
        config = self._learner.config
        self._learner.update(
            episodes=played,
            timesteps={"num_env_steps_sampled_lifetime": self.episodes * self._decisions},
            num_epochs=config.num_epochs,
            minibatch_size=config.minibatch_size,
            shuffle_batch_per_epoch=config.shuffle_batch_per_epoch,
        )
        self._give_weights()

    def _give_weights(self) -> None:
        """Copy the weights of the learning modules into the playing ones."""
        with torch.no_grad():
            for group in set(self._groups.values()):
                learned = self._learner.module[group].unwrapped().state_dict()
                self._runner.module[group].load_state_dict(learned, strict=False)

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        return [self._layers_of(row) for row in range(len(self.agents))]

    def _layers_of(self, row: int) -> list[nn.Linear]:
        """Return an agent's network: that of its group, with the one-hot added to the first bias.

        W [x; e_i] + b = W_x x + (b + column i of W_e).
        """
        module = self._learner.module[self._groups[self.agents.names[row]]].unwrapped()
        first, *rest = [*linear_layers(module.encoder.actor_encoder), *linear_layers(module.pi)]
        size = self.agents.observation_sizes[row]
        own = linear_from_weights(first.weight[:, :size], first.bias + first.weight[:, size + row])
        return [own, *rest]

    def _networks(self) -> Mapping[str, Tensor]:
        return {
            f"{group}/{name}": tensor
            for group in sorted(set(self._groups.values()))
            for name, tensor in self._learner.module[group].unwrapped().state_dict().items()
        }

    def _rest(self) -> dict[str, Any]:
        optimisers = {group: self._optimiser(group) for group in set(self._groups.values())}
        return {"adam": {group: made.state_dict() for group, made in optimisers.items()}}

    def _optimiser(self, group: str) -> Any:
        (found,) = self._learner.get_optimizers_for_module(group)
        return found[1]

    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        for name, tensor in self._networks().items():
            tensor.copy_(networks[name])
        for group, state in rest["adam"].items():
            self._optimiser(group).load_state_dict(state)
        self._give_weights()


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train PPO of RLlib on one scenario, with one policy per group of agents."""

    ppo: Annotated[RLlibConfig, tyro.conf.arg(name="")] = RLlibConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: RLlib(env, args.ppo, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
