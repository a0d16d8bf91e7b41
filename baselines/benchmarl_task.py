"""QMIX and VDN of BenchMARL, which learn one value for all intersections together.

`TrafficTask` makes any environment of the suite a task of BenchMARL, with which its own experiments
run as well. The learner below takes algorithm, losses, replay and optimisers from such an
experiment, and plays the episodes itself, so that it can be stopped and taken up again. Agents are
padded and told whose observation they see, share one network, and are masked by their infos.

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

from ugat_marl.envs import AnyParallelEnv, agent_indicator, pad
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import BaselineArgs, Result, baseline_command, train_baseline
from ugat_marl.policies import (
    EpisodeCallback,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    kept_generators,
    linear,
    seed_generators,
)
from ugat_marl.seeding import derive_seed

ALGORITHMS = ("qmix", "vdn")
_GROUP = "agents"
_STATE_DEPENDENCE = 0.1
"""What is left of the drawn weights by which QMIX's mixing follows the state."""
_LINEAR_DOWN_TO = 3.0
"""Input of the mixing network's units where agents' values are 0; below 0 their ELU saturates."""


@dataclass(frozen=True)
class BenchMARLConfig:
    """Settings of the learner; a decision is one of all agents together."""

    algorithm: Literal["qmix", "vdn"] = "qmix"
    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers
    mixing: int = 32  # size of QMIX's mixing network
    learning_rate: float = 1e-3  # step size of Adam
    discount: float = 0.8  # weight of the next decision's value (gamma)
    max_gradient: float = 5.0  # longer gradients are scaled down to this norm
    replay: int = 2_000  # decisions it remembers: the jams of the beginning drown what comes later
    batch: int = 64  # decisions in a gradient step
    update_every: int = 20  # decisions played between updates; the end of an episode ends one too
    updates: int = 10  # gradient steps then
    explore: int = 2_400  # decisions over which random actions get rare
    least_exploration: float = 0.05  # share of random actions that stays
    target_rate: float = 0.01  # share by which the target network follows at each gradient step

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise UnknownNameError("algorithm", self.algorithm, ALGORITHMS)
        check_settings(self, "least_exploration", "target_rate")


class World(PettingZooWrapper):
    """TorchRL's wrapper, which forgets the masks of agents that an episode's end has retired."""

    @property
    def agents(self) -> list[str]:
        """All of them, at the end too, where masks decide what the last state is worth."""
        return self._env.possible_agents


def world_of(env: AnyParallelEnv) -> World:
    """The environment as TorchRL's, its agents one group of equals; it is reset."""
    with warnings.catch_warnings():  # "tested using PettingZoo 1.24.3", at each call
        warnings.simplefilter("ignore")
        groups = {_GROUP: list(env.possible_agents)}
        return World(agent_indicator(pad(env)), return_state=True, group_map=groups)


class TrafficTask(TaskClass):
    """A task of BenchMARL: ``Experiment(task=TrafficTask(make, decisions), ...)``.

    Args:
        make: Makes an environment of the suite, one for each call. BenchMARL pickles it: a function
            of a module, or a `functools.partial` of one.
        decisions: In an episode.
    """

    def __init__(self, make: Callable[[], AnyParallelEnv], decisions: int = 360) -> None:
        super().__init__("traffic", {})
        self._make = make
        self._decisions = decisions

    @staticmethod
    def env_name() -> str:
        """Return the name of the package the task comes from."""
        return "ugat_marl"

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], Any]:
        """Makes the environment where it is needed."""
        return lambda: world_of(self._make()).to(device)

    def supports_continuous_actions(self) -> bool:
        """Phases are no numbers."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Phases are chosen."""
        return True

    def has_render(self, env: Any) -> bool:
        """BenchMARL makes videos of its own, which are not needed here."""
        return False

    def max_steps(self, env: Any) -> int:
        """Decisions in an episode."""
        return self._decisions

    def group_map(self, env: Any) -> dict[str, list[str]]:
        """One group."""
        return env.group_map

    def state_spec(self, env: Any) -> Any:
        """All observations, once."""
        return Composite({"state": env.observation_spec["state"].clone()})

    def observation_spec(self, env: Any) -> Any:
        """Return the spaces of observations."""
        return self._only(env, "observation")

    def action_mask_spec(self, env: Any) -> Any:
        """Return the spaces of action masks."""
        return self._only(env, "action_mask")

    def info_spec(self, env: Any) -> Any:
        """Return None: nothing here learns from infos."""
        return None

    def action_spec(self, env: Any) -> Any:
        """A phase for each agent."""
        return env.full_action_spec

    def _only(self, env: Any, name: str) -> Any:
        spec = env.observation_spec[_GROUP][name].clone()
        agents = len(env.group_map[_GROUP])
        return Composite({_GROUP: Composite({name: spec}, shape=(agents,))})


class Unwritten(Experiment):
    """An experiment that leaves no folder of pickled settings behind."""

    def _setup_name(self) -> None:
        self.name = self.environment_name = self.task_name = "traffic"
        self.algorithm_name = self.model_name = self.critic_model_name = ""
        self.folder_name = Path()
        self._checkpointed_files: deque[Any] = deque()

    def _setup_logger(self) -> None:
        pass


class BenchMARL(LibraryLearner):
    """Learns by QMIX or VDN; a `ugat_marl.policies.protocols.Learner`."""

    def __init__(
        self, env: AnyParallelEnv, config: BenchMARLConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config = config or BenchMARLConfig()
        super().__init__(env, f"baselines.benchmarl.{config.algorithm}")
        if getattr(env, "state_space", None) is None:
            raise OptionError("a value of the whole network needs env.state_space and env.state()")
        with kept_generators():
            self._experiment = self._made(env, derive_seed(seed, "benchmarl", "weights"))
        self._loss: Any = self._experiment.losses[_GROUP]
        self._buffer: Any = self._experiment.replay_buffers[_GROUP]
        self._decisions = 0
        if config.algorithm == "qmix":
            self._begin_as_a_sum()

    def _begin_as_a_sum(self) -> None:
        """Makes QMIX's first value the sum of its agents' values, as VDN's is, or nearly so.

        As layers are drawn, the mixing network multiplies it by four or more: agents' networks then
        have to learn what is a quarter as large, in the same noise.
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
        config.collect_with_grad = True  # no collector: `_train` plays
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
        # the sum, not BenchMARL's mean: each agent's part of the value is then of order one
        kept.set(("next", "reward"), kept["next", _GROUP, "reward"].sum(-2))
        self._buffer.extend(experiment.algorithm.process_batch(_GROUP, kept))
        for _ in range(self.config.updates):
            experiment._optimizer_loop(_GROUP)
        self._explorer().step(len(played))

    def _explorer(self) -> Any:
        """Return the module that replaces greedy actions by random ones."""
        return self._experiment.group_policies[_GROUP][-1]

    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        weights: Any = self._loss.target_local_value_network_params
        found = weights.flatten_keys(".")
        names = [str(key).removesuffix(".weight") for key in found.sorted_keys if ".weight" in key]
        ordered = sorted(names, key=lambda name: int(name.rpartition(".")[2]))
        layers = [linear(found[f"{name}.weight"], found[f"{name}.bias"]) for name in ordered]
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
    """Trains QMIX or VDN of BenchMARL on one scenario."""

    benchmarl: Annotated[BenchMARLConfig, tyro.conf.arg(name="")] = BenchMARLConfig()


def train(args: Args, on_episode: EpisodeCallback | None = None) -> Result:
    """Trains and evaluates; writes the results if `args.out` is given."""
    return train_baseline(args, lambda env: BenchMARL(env, args.benchmarl, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
