"""MAPPO of TorchRL: PPO for all intersections, with a critic that sees the whole network.

The wrapper of PettingZoo environments, masked distributions, generalised advantages and clipped
loss are TorchRL's. All agents share one actor: observations are padded and carry a one-hot of the
agent. The critic sees `env.state()` and the one-hot. Infos hold the action masks.

    python baselines/torchrl_mappo.py --scenario grid2x2-v1 --episodes 100 --out runs/torchrl
    ugat-marl train grid2x2-v1 --learner torchrl-mappo
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_indicator, pad_spaces
from ugat_marl.errors import OptionError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    linear_layers,
    perceptron,
    preserve_random_state,
    seed_generators,
)

_GROUP = "agents"


@dataclass(frozen=True)
class TorchRLConfig:
    """Settings of the learner; one decision covers all agents."""

    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers of actor and critic
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.95  # weight of the next decision's value (gamma)
    gae_lambda: float = 0.95  # from one-step (0) to Monte Carlo (1) advantages
    clip: float = 0.2  # share by which the probability of an action may move in an update
    entropy_weight: float = 0.01  # weight of the entropy bonus
    value_weight: float = 0.5  # weight of the critic's error
    max_gradient: float = 0.5  # longer gradients are scaled down to this norm
    update_every: int = 120  # decisions in a roll-out; the end of an episode ends one too
    epochs: int = 8  # passes over each roll-out
    minibatch: int = 30  # decisions in a gradient step

    def __post_init__(self) -> None:
        check_settings(self)


class Critic(nn.Module):
    """Critic: value of a state for each agent, by one network with a one-hot of the agent."""

    def __init__(self, agents: int, state: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self._agents = agents
        self.network = perceptron(state + agents, hidden, 1)

    def forward(self, state: Tensor) -> Tensor:
        """Return values, ``(..., agents, 1)``, of states, ``(..., state)``."""
        agents = self._agents
        seen = state.unsqueeze(-2).expand(*state.shape[:-1], agents, -1)
        whose = torch.eye(agents).expand(*state.shape[:-1], agents, agents)
        return self.network(torch.cat((seen, whose), dim=-1))


class TorchRLMAPPO(LibraryLearner):
    """Learner by TorchRL's PPO; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: TorchRLConfig | None = None, seed: int = 0
    ) -> None:
        super().__init__(env, "baselines.torchrl_mappo")
        self.config = config = config or TorchRLConfig()
        state: Any = getattr(env, "state_space", None)
        if state is None:
            raise OptionError("a centralised critic needs env.state_space and env.state()")
        agents, hidden = self.agents, config.hidden
        with preserve_random_state():
            seed_generators(seed, "torchrl", "weights")
            width = agents.widest_observation + len(agents)
            self._actor = perceptron(width, hidden, agents.most_actions)
            self._critic = Critic(len(agents), int(state.shape[0]), hidden)
        self._policy, self._loss = self._parts()
        self._adam = torch.optim.Adam(self._loss.parameters(), lr=config.learning_rate, eps=1e-5)

    def _parts(self) -> tuple[Any, Any]:
        """Return the acting module and the loss."""
        config, logits = self.config, (_GROUP, "logits")
        policy = ProbabilisticActor(
            TensorDictModule(self._actor, [(_GROUP, "observation")], [logits]),
            in_keys={"logits": logits, "mask": (_GROUP, "action_mask")},
            out_keys=[(_GROUP, "action")],
            distribution_class=MaskedCategorical,
            return_log_prob=True,
            log_prob_key=(_GROUP, "log_prob"),
        )
        critic = TensorDictModule(self._critic, ["state"], [(_GROUP, "state_value")])
        loss = ClipPPOLoss(
            policy,
            critic,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy_weight,
            critic_coeff=config.value_weight,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        keys = ("reward", "action", "done", "terminated", "advantage", "value_target")
        loss.set_keys(
            **{name: (_GROUP, name) for name in keys},
            value=(_GROUP, "state_value"),
            sample_log_prob=(_GROUP, "log_prob"),
        )
        loss.make_value_estimator(
            ValueEstimators.GAE, gamma=config.discount, lmbda=config.gae_lambda
        )
        return policy, loss

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        with (
            warnings.catch_warnings()
        ):  # TorchRL warns of PettingZoo's version and of advantages over all agents
            warnings.simplefilter("ignore")
            world = PettingZooWrapper(
                agent_indicator(pad_spaces(env)),
                return_state=True,
                group_map={_GROUP: list(self.agents.names)},
            )
            until = self.episodes + episodes
            while self.episodes < until:
                seed_generators(seed, "torchrl", "episode", self.episodes)
                self._episode(world)

    def _episode(self, world: Any) -> None:
        now = world.reset()
        while not now["done"].item():
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                rollout = world.rollout(
                    self.config.update_every, self._policy, auto_reset=False, tensordict=now
                )
            self._update(rollout)
            now = rollout[-1]["next"].select(*now.keys(True, True), strict=False)

    def _update(self, rollout: Any) -> None:
        with torch.no_grad():
            self._loss.value_estimator(
                rollout,
                params=self._loss.critic_network_params,
                target_params=self._loss.target_critic_network_params,
            )
        for _ in range(self.config.epochs):
            for some in torch.randperm(len(rollout)).split(self.config.minibatch):
                losses = self._loss(rollout[some])
                total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                self._adam.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(self._loss.parameters(), self.config.max_gradient)
                self._adam.step()

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        return [linear_layers(self._actor)]

    def _networks(self) -> Mapping[str, Tensor]:
        return nn.ModuleDict({"actor": self._actor, "critic": self._critic}).state_dict()

    def _rest(self) -> dict[str, Any]:
        return {"adam": self._adam.state_dict()}

    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        nn.ModuleDict({"actor": self._actor, "critic": self._critic}).load_state_dict(networks)
        self._adam.load_state_dict(rest["adam"])


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train MAPPO of TorchRL on one scenario."""

    mappo: Annotated[TorchRLConfig, tyro.conf.arg(name="")] = TorchRLConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: TorchRLMAPPO(env, args.mappo, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
