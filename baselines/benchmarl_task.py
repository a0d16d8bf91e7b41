"""QMIX and VDN of BenchMARL, which learn one value for all intersections together.

`TrafficTask` turns an environment of the suite into a task of BenchMARL; BenchMARL's own
experiments run on it, too. The learner below takes algorithm, losses, replay and optimisers from
such an experiment. It plays the episodes itself, so it can be interrupted and resumed. All agents
share one network: observations are padded and carry a one-hot of the agent. Infos hold the action
masks.

    python baselines/benchmarl_task.py --scenario grid2x2-v1 --episodes 100 --out runs/qmix
    python baselines/benchmarl_task.py --scenario mixed-v1 --algorithm vdn
    ugat-marl train grid2x2-v1 --learner qmix
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from benchmarl.algorithms import QmixConfig, VdnConfig
from benchmarl.environments.common import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ugat_marl.cli import baseline_command
from ugat_marl.envs import AnyParallelEnv, agent_indicator, pad_spaces
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    linear_from_weights,
    preserve_random_state,
    seed_generators,
)
from ugat_marl.seeding import derive_seed

ALGORITHMS = ("qmix", "vdn")
_GROUP = "agents"
_STATE_DEPENDENCE = 0.1
"""Factor on the initial weights from the state to QMIX's mixing weights."""
_LINEAR_DOWN_TO = 3.0
"""Initial bias of the mixing network's units; their ELU is linear above 0 and saturates below."""


@dataclass(frozen=True)
class BenchMARLConfig:
    """Settings of the learner; one decision covers all agents."""

    algorithm: Literal["qmix", "vdn"] = "qmix"
    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers
    mixing: int = 32  # size of QMIX's mixing network
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.8  # weight of the next decision's value (gamma)
    max_gradient: float = 5.0  # longer gradients are scaled down to this norm
    replay: int = 2_000  # decisions it stores; few, or the first jams outweigh later decisions
    batch: int = 64  # decisions in a gradient step
    update_every: int = 20  # decisions played between updates; the end of an episode ends one too
    updates: int = 10  # gradient steps of one update
    explore: int = 2_400  # decisions over which the share of random actions falls
    least_exploration: float = 0.05  # final share of random actions
    target_rate: float = 0.01  # step of the target network to the network in each gradient step

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise UnknownNameError("algorithm", self.algorithm, ALGORITHMS)
        check_settings(self, "least_exploration", "target_rate")


class World(PettingZooWrapper):
    """TorchRL's wrapper with all agents, also at the end of an episode.

    TorchRL drops the masks of agents that are no longer in `env.agents`.
    """

    @property
    def agents(self) -> list[str]:
        """All agents. At the end, too: the value of the last state needs their masks."""
        return self._env.possible_agents


def world_of(env: AnyParallelEnv) -> World:
    """Return the environment as TorchRL's, all agents in one group; this resets it."""
    with warnings.catch_warnings():  # each call warns: "tested using PettingZoo 1.24.3"
        warnings.simplefilter("ignore")
        groups = {_GROUP: list(env.possible_agents)}
        return World(agent_indicator(pad_spaces(env)), return_state=True, group_map=groups)


class TrafficTask(TaskClass):
    """A task of BenchMARL: ``Experiment(task=TrafficTask(make, decisions), ...)``.

    Args:
        make: Makes an environment of the suite with each call. BenchMARL pickles it, so it must be
            a function of a module, or a `functools.partial` of one.
        decisions: Number of decisions in an episode.
    """

    def __init__(self, make: Callable[[], AnyParallelEnv], decisions: int = 360) -> None:
        super().__init__("traffic", {})
        self._make = make
        self._decisions = decisions

    @staticmethod
    def env_name() -> str:
        """Return the name of this package."""
        return "ugat_marl"

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], Any]:
        """Return a function that makes the environment on a device."""
        return lambda: world_of(self._make()).to(device)

    def supports_continuous_actions(self) -> bool:
        """Return False: actions are phases."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Return True: actions are phases."""
        return True

    def has_render(self, env: Any) -> bool:
        """Return False, so that BenchMARL records no videos."""
        return False

    def max_steps(self, env: Any) -> int:
        """Return the number of decisions in an episode."""
        return self._decisions

    def group_map(self, env: Any) -> dict[str, list[str]]:
        """Return the agents of the only group, by its name."""
        return env.group_map

    def state_spec(self, env: Any) -> Any:
        """Return the space of the state of the whole network."""
        return Composite({"state": env.observation_spec["state"].clone()})

    def observation_spec(self, env: Any) -> Any:
        """Return the spaces of observations."""
        return self._only(env, "observation")

    def action_mask_spec(self, env: Any) -> Any:
        """Return the spaces of action masks."""
        return self._only(env, "action_mask")

    def info_spec(self, env: Any) -> Any:
        """Return None: the learners do not use infos."""
        return None

    def action_spec(self, env: Any) -> Any:
        """Return the spaces of actions: one phase for each agent."""
        return env.full_action_spec

    def _only(self, env: Any, name: str) -> Any:
        spec = env.observation_spec[_GROUP][name].clone()
        agents = len(env.group_map[_GROUP])
        return Composite({_GROUP: Composite({name: spec}, shape=(agents,))})


class Unwritten(Experiment):
    """An experiment that writes no folder of pickled settings."""

    def _setup_name(self) -> None:
        self.name = self.environment_name = self.task_name = "traffic"
        self.algorithm_name = self.model_name = self.critic_model_name = ""
        self.folder_name = Path()
        self._checkpointed_files: deque[Any] = deque()

    def _setup_logger(self) -> None:
        pass


class BenchMARL(LibraryLearner):
    """Learner by QMIX or VDN; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: BenchMARLConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config = config or BenchMARLConfig()
        super().__init__(env, f"baselines.benchmarl.{config.algorithm}")
        if getattr(env, "state_space", None) is None:
            raise OptionError("a value of the whole network needs env.state_space and env.state()")
        with preserve_random_state():
            self._experiment = self._made(env, derive_seed(seed, "benchmarl", "weights"))
        self._loss: Any = self._experiment.losses[_GROUP]
        self._buffer: Any = self._experiment.replay_buffers[_GROUP]
        self._decisions = 0
        if config.algorithm == "qmix":
            self._begin_as_a_sum()

    def _begin_as_a_sum(self) -> None:
        """Start QMIX with a total value that is nearly the sum of its agents' values, as in VDN.

        Default initial weights multiply the sum by four or more. The agents' values would then be a
        quarter as large, with the same noise.
        """
        weight = self.config.mixing**-0.5
        with torch.no_grad():
            for name, tensor in self._networks().items():
                layer = name.partition("mixer_network_params.module.")[2]
                if layer.startswith("hyper"):
                    tensor.mul_(_STATE_DEPENDENCE)
                if layer in ("hyper_w_1.bias", "hyper_w_final.bias"):
                    tensor.add_(weight)
                elif layer == "hyper_b_1.bias":
                    tensor.add_(_LINEAR_DOWN_TO)
                elif layer == "V.2.bias":
                    tensor.sub_(_LINEAR_DOWN_TO / weight)

    def _made(self, env: AnyParallelEnv, seed: int) -> Any:
        given = self.config
        config = ExperimentConfig.get_from_yaml()
        config.loggers, config.create_json, config.evaluation = [], False, False
        config.collect_with_grad = True  # BenchMARL then makes no collector; `_train` plays
        config.max_n_frames, config.exploration_anneal_frames = 10**9, given.explore
        config.lr, config.gamma, config.clip_grad_val = (
            given.learning_rate,
            given.discount,
            given.max_gradient,
        )
        config.polyak_tau, config.exploration_eps_init = given.target_rate, 1.0
        config.exploration_eps_end = given.least_exploration
        config.off_policy_n_envs_per_worker = 1
        config.off_policy_collected_frames_per_batch = given.update_every
        config.off_policy_train_batch_size = given.batch
        config.off_policy_memory_size = given.replay
        made = {"delay_value": True, "loss_function": "l2"}
        if given.algorithm == "vdn":
            algorithm: Any = VdnConfig(**made)
        else:
            algorithm = QmixConfig(mixing_embed_dim=given.mixing, **made)
        return Unwritten(
            TrafficTask(lambda: env),
            algorithm,
            MlpConfig(
                num_cells=list(given.hidden), layer_class=nn.Linear, activation_class=nn.ReLU
            ),
            seed,
            config,
        )

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        world, policy = world_of(env), self._experiment.policy
        until = self.episodes + episodes
        while self.episodes < until:
            now = world.reset()
            while not now["done"].item():
                seed_generators(seed, "benchmarl", "decision", self._decisions)
                with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                    played = world.rollout(
                        self.config.update_every, policy, auto_reset=False, tensordict=now
                    )
                now = played[-1]["next"].select(*now.keys(True, True), strict=False)
                self._decisions += len(played)
                self._update(played)

    def _update(self, played: Any) -> None:
        experiment = self._experiment
        kept = played.exclude(*experiment._get_excluded_keys(_GROUP))
        # r = Σ_i r_i, not BenchMARL's mean: each agent's share of the value is then of order one.
        kept.set(("next", "reward"), kept["next", _GROUP, "reward"].sum(-2))
        self._buffer.extend(experiment.algorithm.process_batch(_GROUP, kept))
        for _ in range(self.config.updates):
            experiment._optimizer_loop(_GROUP)
        self._explorer().step(len(played))

    def _explorer(self) -> Any:
        """Return the module that replaces some greedy actions by random ones."""
        return self._experiment.group_policies[_GROUP][-1]

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        weights: Any = self._loss.target_local_value_network_params
        found = weights.flatten_keys(".")
        names = [str(key).removesuffix(".weight") for key in found.sorted_keys if ".weight" in key]
        ordered = sorted(names, key=lambda name: int(name.rpartition(".")[2]))
        layers = [
            linear_from_weights(found[f"{name}.weight"], found[f"{name}.bias"]) for name in ordered
        ]
        return [layers]

    def _networks(self) -> Mapping[str, Tensor]:
        tensors = (*self._loss.named_parameters(), *self._loss.named_buffers())
        return {name: tensor.data for name, tensor in tensors}

    def _rest(self) -> dict[str, Any]:
        size = len(self._buffer)
        stored = self._buffer.storage[:size].flatten_keys("/") if size else TensorDict()
        return {
            "adam": self._experiment.optimizers[_GROUP]["loss"].state_dict(),
            "decisions": self._decisions,
            "exploration": self._explorer().eps.clone(),
            "cursor": self._buffer._writer._cursor,
            "replay": {name: stored[name].clone() for name in stored.sorted_keys},
        }

    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        for name, tensor in self._networks().items():
            tensor.copy_(networks[name])
        self._experiment.optimizers[_GROUP]["loss"].load_state_dict(rest["adam"])
        self._explorer().eps.copy_(rest["exploration"])
        self._decisions = rest["decisions"]
        self._buffer.empty()
        if rest["replay"]:
            size = len(next(iter(rest["replay"].values())))
            self._buffer.extend(TensorDict(dict(rest["replay"]), [size]).unflatten_keys("/"))
            self._buffer._writer._cursor = rest["cursor"]


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train QMIX or VDN of BenchMARL on one scenario."""

    benchmarl: Annotated[BenchMARLConfig, tyro.conf.arg(name="")] = BenchMARLConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: BenchMARL(env, args.benchmarl, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
