"""Base of the learners that use other libraries: environment, policies, checkpoints.

The libraries do not know the episodes, seeds and files of this package. `LibraryLearner` saves and
loads their state. `TrainingEnv` seeds each episode by its number, scales observations and rewards,
refuses forbidden actions and reports returns. `policy_of` makes a policy from their networks.
"""

from __future__ import annotations

import abc
import contextlib
import itertools
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper
from torch import Tensor, nn

from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.envs import AgentSet, AnyParallelEnv, ResetResult, StepResult
from ugat_marl.errors import ActionError, CheckpointError, EpisodeError, OptionError
from ugat_marl.files import MALFORMED
from ugat_marl.policies.learners.scaling import InputScale, RewardScale, observation_mask
from ugat_marl.policies.network_policy import (
    NetworkPolicy,
    checkpoint_header,
    parse_header,
)
from ugat_marl.policies.networks.batched import one_thread
from ugat_marl.policies.protocols import EpisodeCallback
from ugat_marl.policies.saved_options import other_observation
from ugat_marl.seeding import derive_seed, numpy_generator


class LibraryLearner(abc.ABC):
    """A learner that uses a library; a subclass adds the library's objects and states.

    Args:
        env: Environment with the agents of the learner; it is not reset.
        kind: Kind that is written into a checkpoint and compared at loading.
    """

    def __init__(self, env: AnyParallelEnv, kind: str) -> None:
        self.agents = AgentSet.of(env)
        self.env_options = dict(getattr(env.unwrapped, "env_options", {}))
        self.episodes = 0
        self.rewards = RewardScale(len(self.agents))
        self.inputs = InputScale(self.agents.widest_observation)
        self.states = InputScale(_state_size(env))
        self._kind = kind

    def learn(
        self,
        env: AnyParallelEnv,
        episodes: int,
        seed: int,
        on_episode: EpisodeCallback | None = None,
    ) -> NetworkPolicy:
        """Train for `episodes` more episodes.

        Random choices depend only on `seed` and the number of episodes so far.

        Raises:
            OptionError: `env` has other agents or spaces than this learner.
            EpisodeError: An agent left before the others, or a reward is not finite.
            ActionError: The library chose an action that the mask forbids.
        """
        if AgentSet.of(env) != self.agents:
            raise OptionError(
                f"the environment's agents are {AgentSet.of(env)}, this learner's {self.agents}; "
                "make a new learner for it"
            )
        with one_thread(), preserve_random_state():
            if episodes > 0:
                self._train(TrainingEnv(env, self, seed, on_episode), episodes, seed)
        return self.policy()

    def policy(self) -> NetworkPolicy:
        """Return the current greedy policy, a snapshot; its values are logits."""
        return policy_of(self.agents, self._actors(), self.env_options, self.inputs.factors)

    def save(self, path: Path) -> None:
        """Write the whole state; a learner that loads it continues exactly as this one."""
        policy = self.policy()
        content = {
            **checkpoint_header(self.agents, policy.hidden, self.env_options, policy.shared),
            "episodes": self.episodes,
            "sums": [torch.from_numpy(one.sums.copy()) for one in self._scales],
            "networks": {name: tensor.clone() for name, tensor in self._networks().items()},
            "rest": self._rest(),
        }
        write_checkpoint(path, self._kind, content)

    def load(self, path: Path) -> None:
        """Restore the state from a file that `save` wrote.

        Raises:
            CheckpointError: The file is broken, or belongs to another learner.
        """
        content = read_checkpoint(path, self._kind)
        try:
            agents, _, env_options, _ = parse_header(content)
            if agents != self.agents:
                raise CheckpointError(f"{path}: its agents are {agents}, not {self.agents}")
            if other := other_observation(env_options, self.env_options):
                raise CheckpointError(f"{path}: learned from observations with {other}")
            _require_like(path, content["networks"], self._networks())
            episodes, sums = int(content["episodes"]), [one.numpy() for one in content["sums"]]
            if [one.shape for one in sums] != [one.sums.shape for one in self._scales]:
                raise CheckpointError(f"{path}: its sums have shapes of another learner")
            self._restore(content["networks"], content["rest"])
        except (RuntimeError, *MALFORMED) as error:
            raise CheckpointError(f"{path}: not a whole checkpoint ({error!r})") from None
        self.episodes = episodes
        for one, scale in zip(sums, self._scales, strict=True):
            scale.sums[:] = one

    @property
    def _scales(self) -> tuple[RewardScale | InputScale, ...]:
        return self.rewards, self.inputs, self.states

    @abc.abstractmethod
    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        """Play exactly `episodes` episodes of `env` and learn from them."""

    @abc.abstractmethod
    def _actors(self) -> Sequence[Sequence[nn.Linear]]:
        """Return the layers of the acting networks, in the form `policy_of` takes."""

    @abc.abstractmethod
    def _networks(self) -> Mapping[str, Tensor]:
        """Return all weights by name."""

    @abc.abstractmethod
    def _rest(self) -> dict[str, Any]:
        """Return the rest of the state: tensors and plain values."""

    @abc.abstractmethod
    def _restore(self, networks: Mapping[str, Tensor], rest: Mapping[str, Any]) -> None:
        """Restore a state that `_networks` and `_rest` returned; the shapes are checked before."""


class TrainingEnv(BaseParallelWrapper[str, Any, Any]):
    """Environment for a library that calls `reset` without a seed.

    Observations and rewards are scaled, so observations may leave the bounds of their space.

    Args:
        env: The environment.
        learner: Learner whose count of episodes, and whose scales of rewards, observations and
            states, are updated.
        seed: Root of the seeds of all episodes.
        on_episode: Called after each episode with its number and ``return`` (sum of the unscaled
            reward, mean over agents).
    """

    def __init__(
        self,
        env: AnyParallelEnv,
        learner: LibraryLearner,
        seed: int,
        on_episode: EpisodeCallback | None = None,
    ) -> None:
        super().__init__(env)
        self._learner = learner
        self._agents = learner.agents
        self._seed = seed
        self._on_episode = on_episode
        self._places = observation_mask(self._agents)
        self._allowed: NDArray[np.bool_] | None = None

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start the next episode; its number decides the seed, and the argument is ignored."""
        seed = derive_seed(self._seed, "learner", "episode", self._learner.episodes)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._allowed = self._agents.masks(infos)
        self._return = 0.0
        return self._seen(observations), infos

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Execute actions; return scaled observations, and rewards centred and scaled."""
        if not self.env.agents or self._allowed is None:  # it raises its own error
            return self.env.step(actions)
        for agent, allowed in zip(self._agents.names, self._allowed, strict=True):
            action = int(actions[agent])
            if not (0 <= action < len(allowed) and allowed[action]):
                raise ActionError(
                    f"the library chose action {action} for {agent}, which its action mask "
                    "forbids; nothing was executed: give the library the masks, as baselines/ do"
                )
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if len(self.env.agents) not in (0, len(self._agents)):
            raise EpisodeError(f"only {self.env.agents} are left; all agents have to stay")
        paid = self._agents.values(rewards)
        if not np.isfinite(paid).all():
            raise EpisodeError(f"a reward is not finite: {rewards}; correct the reward")
        self._return += float(paid.mean())
        scaled = dict(zip(self._agents.names, self._learner.rewards(paid).tolist(), strict=True))
        self._allowed = self._agents.masks(infos)
        if not self.env.agents:
            number = self._learner.episodes
            self._learner.episodes += 1
            if self._on_episode is not None:
                self._on_episode(number, {"return": self._return})
        self._note(observations)
        return self._seen(observations), scaled, terminated, truncated, infos

    def state(self) -> NDArray[np.float32]:
        """Return the state of the environment, scaled."""
        return self.env.state() * self._learner.states.factors

    def _note(self, observations: dict[str, Any]) -> None:
        """Add observations to the scales.

        Those of `reset` are left out, because libraries differ in how often they call it.
        """
        learner = self._learner
        learner.inputs.note(self._agents.stack(observations), self._places)
        if learner.states.sums.size:
            learner.states.note(self.env.state()[None])

    def _seen(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Return the observations scaled."""
        rows = self._agents.stack(observations) * self._learner.inputs.factors
        sizes = zip(self._agents.names, self._agents.observation_sizes, strict=True)
        return {name: rows[row, :size] for row, (name, size) in enumerate(sizes)}


def policy_of(
    agents: AgentSet,
    actors: Sequence[Sequence[nn.Linear]],
    env_options: Mapping[str, Any],
    factors: NDArray[np.float32] | None = None,
) -> NetworkPolicy:
    """Make a policy that takes the allowed action of highest output.

    Args:
        agents: The agents it acts for.
        actors: Layers of perceptrons with ReLU. Either one perceptron for each agent, which reads
            its observation, padded with zeros or not; or one for all, which reads an observation
            padded to the widest, then a one-hot of the agent.
        env_options: Options of the environment that the policy relies on.
        factors: Scale of the observations that the perceptrons read, ``(widest_observation,)``.
            The policy reads unscaled observations.

    Raises:
        ValueError: The layers have other sizes.
    """
    width = agents.widest_observation
    shared = len(actors) == 1 and actors[0][0].in_features == width + len(agents)
    hidden = tuple(layer.out_features for layer in actors[0][:-1])
    with torch.no_grad():
        parts = _shared_parts(agents, actors[0]) if shared else _own_parts(agents, actors)
        if factors is not None:  # W (x * factors) = (W * factors) x; W is (..., n_in, n_out)
            parts[0] = parts[0] * torch.from_numpy(factors)[:, None]
        parameters = torch.cat([part.reshape(-1) for part in parts])
    return NetworkPolicy(agents, hidden, parameters, env_options, shared)


def _shared_parts(agents: AgentSet, layers: Sequence[nn.Linear]) -> list[Tensor]:
    """Order parameters as `SharedMLP`: the weights of the one-hot become biases of the agents."""
    width = agents.widest_observation
    first, *rest = layers
    parts = [first.weight[:, :width].T, first.weight[:, width:].T + first.bias]
    for layer in rest:
        parts += [layer.weight.T, layer.bias]
    return parts


def _own_parts(agents: AgentSet, actors: Sequence[Sequence[nn.Linear]]) -> list[Tensor]:
    """Order parameters as `BatchedMLP`: all agents' weights of a layer, then their biases."""
    if len(actors) != len(agents):
        raise ValueError(f"{len(actors)} networks for {len(agents)} agents")
    parts: list[Tensor] = []
    sizes = (agents.widest_observation, *(layer.out_features for layer in actors[0][:-1]))
    for number, n_in in enumerate(sizes):
        last = number == len(sizes) - 1
        layers = [actor[number] for actor in actors]
        n_out = agents.most_actions if last else layers[0].out_features
        weights, biases = torch.zeros(len(agents), n_in, n_out), torch.zeros(len(agents), 1, n_out)
        for row, layer in enumerate(layers):
            weights[row, : layer.in_features, : layer.out_features] = layer.weight.T
            biases[row, 0, : layer.out_features] = layer.bias
        parts += [weights, biases]
    return parts


def perceptron(n_in: int, hidden: Sequence[int], n_out: int) -> nn.Sequential:
    """Make affine layers with ReLU between them."""
    sizes = (n_in, *hidden, n_out)
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def linear_from_weights(weight: Tensor, bias: Tensor) -> nn.Linear:
    """Make a layer with copies of weights ``(n_out, n_in)`` and bias; draw no random number."""
    layer: Any = nn.utils.skip_init(nn.Linear, weight.shape[1], weight.shape[0])
    layer.weight.data.copy_(weight.detach())
    layer.bias.data.copy_(bias.detach())
    return layer


def linear_layers(network: nn.Module) -> list[nn.Linear]:
    """Return the affine layers of a network, in their order."""
    return [layer for layer in network.modules() if isinstance(layer, nn.Linear)]


def check_settings(config: Any, *shares: str) -> None:
    """Refuse impossible settings.

    Whole numbers and tuples begin at 1, other numbers at 0, which ``learning_rate`` exceeds. Shares
    are at most 1, and ``discount`` is below 1.

    Args:
        config: A dataclass; settings that are true, false or text are not checked.
        shares: Names of settings that are at most 1, besides ``discount`` and ``gae_lambda``.

    Raises:
        OptionError: A setting is out of its range; the message names the first.
    """
    for name, value in vars(config).items():
        if isinstance(value, bool | str):
            continue
        least = 1 if isinstance(value, int | tuple) else 0
        most = 1 if name in ("discount", "gae_lambda", *shares) else math.inf
        for number in value if isinstance(value, tuple) else (value,):
            if not least <= number <= most or number == math.inf:
                raise OptionError(f"{name} = {value}: must be from {least} to {most}")
    if config.discount == 1:
        raise OptionError("discount = 1: must be below 1, since traffic has no end")
    if config.learning_rate == 0:
        raise OptionError("learning_rate = 0: must be above 0, or nothing is learnt")


def decisions_per_episode(env: AnyParallelEnv) -> int:
    """Return the number of decisions of an episode.

    The scenario gives it; without a scenario, one episode of random actions is counted. Libraries
    that learn from roll-outs of fixed length need it before training.
    """
    scenario = getattr(env, "scenario", None)
    if scenario is not None:
        return int(scenario.decisions)
    agents, generator = AgentSet.of(env), numpy_generator(0, "decisions")
    _, infos = env.reset(seed=0)
    count = 0
    while env.agents:
        chances = agents.masks(infos) * generator.random((len(agents), agents.most_actions))
        *_, infos = env.step(agents.actions(chances.argmax(1)))
        count += 1
    return count


def roll_out_length(decisions: int, least: int) -> int:
    """Return the shortest roll-out of at least `least` decisions that divides an episode."""
    return next(n for n in range(min(least, decisions), decisions + 1) if decisions % n == 0)


@contextlib.contextmanager
def preserve_random_state() -> Iterator[None]:
    """Restore the global random generators at the end, because libraries draw from them."""
    before = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        yield
    finally:
        torch.set_rng_state(before[0])
        np.random.set_state(before[1])  # noqa: NPY002 - libraries draw from it
        random.setstate(before[2])


def seed_generators(seed: int, *path: int | str) -> None:
    """Seed the global random generators for the stream `path` below `seed`."""
    derived = derive_seed(seed, *path)
    torch.manual_seed(derived)
    np.random.seed(derived)  # noqa: NPY002 - libraries draw from it
    random.seed(derived)


def _state_size(env: AnyParallelEnv) -> int:
    """Return the length of `state()`; 0 for an environment without it."""
    space: Any = getattr(env, "state_space", None)
    return 0 if space is None else int(space.shape[0])


def _require_like(path: Path, read: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse weights of other names or shapes, before anything is overwritten."""
    shapes = [
        {name: tuple(tensor.shape) for name, tensor in one.items()} for one in (read, expected)
    ]
    if shapes[0] != shapes[1]:
        differing = sorted(
            k for k in {*shapes[0], *shapes[1]} if shapes[0].get(k) != shapes[1].get(k)
        )
        name = differing[0]
        raise CheckpointError(
            f"{path}: its weights {name} have shape {shapes[0].get(name)}, this learner's "
            f"{shapes[1].get(name)}; use the settings it was saved with"
        )
