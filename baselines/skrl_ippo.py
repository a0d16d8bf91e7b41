"""IPPO and MAPPO of skrl: PPO with an update for each intersection.

Wrapper, trainer and memories are skrl's. skrl has no action masks: here the observation ends with
the mask. The policy below removes it and gives forbidden actions the probability 0. Critics see
the same observation (IPPO), and `env.state()` with it (MAPPO).

skrl updates agent after agent. Agents of one group (`<group>_<n>`: the same phases, the same lanes)
share their networks and Adam, so each learns from the data of all. With `--no-shared` each agent
has its own networks, as usual in skrl; training then needs many times as many episodes.

    python baselines/skrl_ippo.py --scenario grid2x2-v1 --episodes 100 --out runs/skrl
    python baselines/skrl_ippo.py --scenario mixed-v1 --centralised
    ugat-marl train grid2x2-v1 --learner skrl-ippo
"""
# pyright: reportMissingImports=false, reportMissingSuperCall=false

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.multi_agents.torch.ippo import IPPO, IPPO_CFG
from skrl.multi_agents.torch.mappo import MAPPO, MAPPO_CFG
from skrl.trainers.torch import SequentialTrainer
from torch import Tensor, nn

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_groups, appended_mask
from ugat_marl.errors import OptionError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    decisions_per_episode,
    linear_layers,
    perceptron,
    preserve_random_state,
    roll_out_length,
    seed_generators,
)

_PREPROCESSED = ("observation", "state", "value")
_FORBIDDEN = -1e8  # logit of forbidden actions; finite, because -inf makes the entropy nan


@dataclass(frozen=True)
class SkrlConfig:
    """Settings of the learner."""

    centralised: bool = False  # the critics see env.state(), too (MAPPO)
    shared: bool = True  # one network pair for each group of equal agents; or one for each agent
    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.95  # weight of the next decision's value (gamma)
    gae_lambda: float = 0.95  # from one-step (0) to Monte Carlo (1) advantages
    clip: float = 0.2  # share by which the probability of an action may move in an update
    entropy_weight: float = 0.01  # weight of the entropy bonus
    value_weight: float = 0.5  # weight of the critic's squared error
    max_gradient: float = 0.5  # longer gradients are scaled down to this norm
    update_every: int = 120  # least decisions in a roll-out; the next divisor of an episode counts
    epochs: int = 8  # passes over a roll-out; divided among agents that share networks, at least 2
    minibatches: int = 4  # parts of a roll-out, one for each gradient step

    def __post_init__(self) -> None:
        check_settings(self)


class Actor(CategoricalMixin, Model):
    """Actor: from an observation, without the mask at its end, to the logits of the actions."""

    def __init__(self, spaces: Mapping[str, Any], hidden: Sequence[int]) -> None:
        Model.__init__(self, **spaces, device="cpu")
        CategoricalMixin.__init__(self)
        self.network = perceptron(
            self.num_observations - self.num_actions, hidden, self.num_actions
        )

    def compute(self, inputs: Mapping[str, Any], role: str) -> tuple[Tensor, dict[str, Any]]:
        """Return masked logits; skrl makes the distribution from them."""
        seen = inputs["observations"]
        allowed = seen[:, -self.num_actions :] > 0.5
        logits = self.network(seen[:, : -self.num_actions])
        return logits.masked_fill(~allowed, _FORBIDDEN), {}


class Critic(DeterministicMixin, Model):
    """Critic: from an observation, with --centralised also `env.state()`, to its value."""

    def __init__(self, spaces: Mapping[str, Any], hidden: Sequence[int], centralised: bool) -> None:
        Model.__init__(self, **spaces, device="cpu")
        DeterministicMixin.__init__(self)
        self._keys = ("observations", "states") if centralised else ("observations",)
        size = self.num_observations + (self.num_states if centralised else 0)
        self.network = perceptron(size, hidden, 1)

    def compute(self, inputs: Mapping[str, Any], role: str) -> tuple[Tensor, dict[str, Any]]:
        """Return the values."""
        return self.network(torch.cat([inputs[key] for key in self._keys], dim=-1)), {}


class Skrl(LibraryLearner):
    """Learner by skrl's IPPO or MAPPO; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: SkrlConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config = config or SkrlConfig()
        super().__init__(env, f"baselines.skrl.{'mappo' if config.centralised else 'ippo'}")
        if getattr(env, "state_space", None) is None:
            raise OptionError("skrl asks environments for their state; this one has none")
        self._decisions = decisions_per_episode(env)
        masked = appended_mask(env)
        state: Any = getattr(env, "state_space")  # noqa: B009 - not every environment has one
        spaces = {
            agent: {
                "observation_space": masked.observation_space(agent),
                "state_space": state,
                "action_space": masked.action_space(agent),
            }
            for agent in self.agents.names
        }
        self._groups = agent_groups(self.agents) if config.shared else {a: a for a in spaces}
        self._models: dict[str, dict[str, Any]] = {}  # actor and critic by group
        with preserve_random_state():
            seed_generators(seed, "skrl", "weights")
            for agent, own in spaces.items():
                if self._groups[agent] not in self._models:
                    critic = Critic(own, config.hidden, config.centralised)
                    made = {"policy": Actor(own, config.hidden), "value": critic}
                    self._models[self._groups[agent]] = made
            self._learning = self._made(spaces)
        self._adams: dict[str, Any] = {}  # optimiser by group
        for agent, group in self._groups.items():
            own = self._adams.setdefault(group, self._learning.optimizers[agent])
            self._learning.optimizers[agent] = own

    def _made(self, spaces: Mapping[str, Mapping[str, Any]]) -> Any:
        config = self.config
        steps = roll_out_length(self._decisions, config.update_every)
        names, members = list(self.agents.names), Counter(self._groups.values())
        settings: dict[str, Any] = {
            "rollouts": steps,
            "learning_epochs": {
                name: max(config.epochs // members[self._groups[name]], min(2, config.epochs))
                for name in names
            },
            "mini_batches": min(config.minibatches, steps),
            "discount_factor": config.discount,
            "gae_lambda": config.gae_lambda,
            "learning_rate": config.learning_rate,
            "grad_norm_clip": config.max_gradient,
            "ratio_clip": config.clip,
            "value_clip": 0.0,
            "entropy_loss_scale": config.entropy_weight,
            "value_loss_scale": config.value_weight,
            "time_limit_bootstrap": True,
            "experiment": {"write_interval": 0, "checkpoint_interval": 0},
        }
        unused = ("learning_rate_scheduler", *(f"{x}_preprocessor" for x in _PREPROCESSED))
        settings |= {f"{name}_kwargs": {agent: {} for agent in names} for name in unused}
        kind, kind_of_settings = (MAPPO, MAPPO_CFG) if config.centralised else (IPPO, IPPO_CFG)
        return kind(
            possible_agents=names,
            models={name: self._models[self._groups[name]] for name in names},
            memories={name: RandomMemory(memory_size=steps, device="cpu") for name in names},
            cfg=kind_of_settings(**settings),
            device="cpu",
            **{
                f"{key}s": {name: spaces[name][key] for name in names}
                for key in ("observation_space", "state_space", "action_space")
            },
        )

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        world = wrap_env(appended_mask(env), wrapper="pettingzoo", verbose=False)
        for _ in range(episodes):  # a trainer per episode, so each episode can have its own seed
            seed_generators(seed, "skrl", "episode", self.episodes)
            trainer = SequentialTrainer(
                env=world,
                agents=self._learning,
                cfg={
                    "timesteps": self._decisions,
                    "headless": True,
                    "disable_progressbar": True,
                    "close_environment_at_exit": False,
                },
            )
            trainer.train()
            self._learning.tracking_data.clear()  # never written here, so it would grow for ever

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        own = [self._models[self._groups[agent]]["policy"] for agent in self.agents.names]
        return [linear_layers(policy.network) for policy in own]

    def _networks(self) -> Mapping[str, Tensor]:
        return {
            f"{group}.{role}.{name}": tensor
            for group, models in self._models.items()
            for role, model in models.items()
            for name, tensor in model.state_dict().items()
        }

    def _rest(self) -> dict[str, Any]:
        return {"adam": {group: made.state_dict() for group, made in self._adams.items()}}

    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        for name, tensor in self._networks().items():
            tensor.copy_(networks[name])
        for group, state in rest["adam"].items():
            self._adams[group].load_state_dict(state)


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train IPPO, or with --centralised MAPPO, of skrl on one scenario."""

    ppo: Annotated[SkrlConfig, tyro.conf.arg(name="")] = SkrlConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: Skrl(env, args.ppo, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
