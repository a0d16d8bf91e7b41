"""Deep Q-learning for all intersections at once: a network for each, or one that they share.

The learner follows Mnih et al. 2015, with double Q-learning (van Hasselt et al. 2016), a softly
updated target network and exploration in bouts. It is stronger than the DQN of the UGAT paper,
because a policy of a weak learner loses travel time that looks like a gap between domains.

SUMO simulates the next decision while an update runs. The action of that decision therefore still
uses the weights from before the update.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import checked_tensors, read_checkpoint, write_checkpoint
from ugat_marl.envs import ActionMask, AgentSet, AnyParallelEnv, step_meanwhile
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError
from ugat_marl.files import MALFORMED
from ugat_marl.policies.devices import CPU
from ugat_marl.policies.learners.dqn_config import CEILING_DECISIONS, DQNConfig
from ugat_marl.policies.learners.initial_weights import InitialWeights
from ugat_marl.policies.learners.lessons import BEST, OnPlay, find_teacher, plays
from ugat_marl.policies.learners.replay import ReplayBuffer
from ugat_marl.policies.learners.scaling import ceilings, input_factors
from ugat_marl.policies.network_policy import (
    NetworkPolicy,
    checkpoint_header,
    parse_header,
)
from ugat_marl.policies.networks.batched import one_thread, size_mask
from ugat_marl.policies.networks.q_network import (
    bind_parameters,
    flatten_parameters,
    greedy_actions,
    parameters_for_unscaled,
    q_network,
)
from ugat_marl.policies.networks.structure import Structure, structure_in
from ugat_marl.policies.networks.universal import SECONDS
from ugat_marl.policies.protocols import EpisodeCallback, Policy
from ugat_marl.policies.saved_options import other_observation
from ugat_marl.seeding import derive_seed, numpy_generator, torch_generator

_KIND = "ugat_marl.dqn"
_COUNTERS = ("episodes", "decisions", "updates", "taught")
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
UNIVERSAL_SCALE = 0.05
"""Factor on rewards for the network "universal": 20 halting vehicles are 1."""

_SCALED = ("mlp", "colight")
"""Networks whose first weights multiply the observation, so that they can absorb its scale."""


@dataclass
class _Tally:
    """Sums over the decisions and updates of one episode."""

    reward: float = 0.0
    loss: float = 0.0
    q: float = 0.0
    decisions: int = 0
    updates: int = 0

    def add(self, loss: float, q: float) -> None:
        """Add the mean loss and the mean Q of an update."""
        self.loss += loss
        self.q += q
        self.updates += 1


class StickyExploration:
    """Mix bouts of one exploratory action into greedy actions, independently for every agent.

    A phase of 10 s tells little: most of it is yellow, all-red and starting up. The worth of a
    phase shows in a longer green, so an agent repeats its exploratory action.

    A bout lasts 1 to `longest` decisions (uniform), on average m = (1 + longest) / 2. An agent
    without a bout begins one with chance ``epsilon / (epsilon + m (1 - epsilon))``. So `epsilon` is
    the share of exploratory *decisions* for every `longest`.

    Args:
        agents: Number of agents.
        longest: Longest bout, in decisions; 1 is plain epsilon-greedy.
        generator: Source of all random choices.
    """

    def __init__(self, agents: int, longest: int, generator: np.random.Generator) -> None:
        self._longest = longest
        self._generator = generator
        self._action = np.zeros(agents, dtype=np.int64)
        self._left = np.zeros(agents, dtype=np.int64)

    def choose(
        self, greedy: NDArray[np.int64], allowed: ActionMask, epsilon: float
    ) -> NDArray[np.int64]:
        """Replace some greedy actions by exploratory ones.

        Args:
            greedy: Greedy action of every agent, ``(agents,)``.
            allowed: Allowed actions, ``(agents, actions)``.
            epsilon: Share of exploratory decisions, 0 to 1.

        Returns:
            Action of every agent, ``(agents,)``.
        """
        agents, actions = allowed.shape
        mean_length = (1 + self._longest) / 2
        rate = epsilon / (epsilon + mean_length * (1 - epsilon))
        begins = (self._left == 0) & (self._generator.random(agents) < rate)
        drawn = np.where(allowed, self._generator.random((agents, actions)), -1.0).argmax(axis=1)
        length = self._generator.integers(1, self._longest + 1, agents)
        self._action = np.where(begins, drawn, self._action)
        self._left = np.where(begins, length, self._left)
        # a bout ends early when the environment no longer allows its action
        self._left *= allowed[np.arange(agents), self._action]
        chosen = np.where(self._left > 0, self._action, greedy)
        self._left = np.maximum(self._left - 1, 0)
        return chosen


class Acting:
    """Networks that choose the actions of a training, always on the CPU.

    If the learning networks are on the CPU, they also choose. If they are on a GPU, a copy on the
    CPU chooses, which takes over their weights before every decision.

    Args:
        online: The learning networks.
        weights: Parameters of these networks, as `flatten_parameters` returned them.
    """

    def __init__(self, online: nn.Module, weights: nn.Parameter) -> None:
        self._network, self._weights, self._online_weights = online, weights, weights
        if weights.device != CPU:
            self._network = copy.deepcopy(online).to(CPU)
            self._weights = flatten_parameters(self._network)

    def network(self) -> nn.Module:
        """Return networks with the weights that the learning networks have now."""
        if self._weights is not self._online_weights:
            self._weights.data.copy_(self._online_weights.data)
        return self._network


class DQN:
    """Learn one Q-network per agent of a parallel environment, or one for all of them.

    It works for every `ParallelEnv` with Box vectors and Discrete actions if all agents stay to the
    end. Spaces may differ between agents. The value after the last decision counts if an episode
    ends by truncation. A terminated agent has rewards of zero from then on.

    Args:
        agents: Names and sizes of the agents; `DQN.of(env)` reads them from an environment.
        config: Settings; None for the defaults.
        seed: Seed of the initial weights.
        env_options: Options of the environment that the learned policy relies on.
        structure: Movements or neighbours for a network other than "mlp"; `DQN.of` reads them.
        device: Device of the updates. Choice of actions and replay memory stay on the CPU.

    Raises:
        OptionError: `config` and `structure` name different networks.
    """

    def __init__(
        self,
        agents: AgentSet,
        config: DQNConfig | None = None,
        seed: int = 0,
        env_options: Mapping[str, Any] | None = None,
        structure: Structure | None = None,
        device: torch.device = CPU,
    ) -> None:
        self.agents = agents
        self.config = config if config is not None else DQNConfig()
        self.structure = structure
        if self.config.network != _network_of(structure):
            raise OptionError(
                f"network = {self.config.network!r} with the structure of "
                f"{_network_of(structure)!r}; DQN.of(env, config) reads the right one"
            )
        self.env_options: Mapping[str, Any] = dict(env_options or {})
        self.episodes = 0
        self.decisions = 0
        self.updates = 0
        self.taught = 0
        hidden, shared = self.config.hidden, self.config.shared
        weights = torch_generator(seed, "dqn", "weights")
        self.device = device
        self._online = q_network(agents, hidden, shared, weights, structure).to(device)
        self._target = q_network(agents, hidden, shared, torch.Generator(), structure).to(device)
        self._weights = flatten_parameters(self._online)
        self._target_weights = flatten_parameters(self._target)
        self._target_weights.data.copy_(self._weights.data)
        self._target.requires_grad_(False)
        self._adam = torch.optim.Adam([self._weights], lr=self.config.learning_rate, fused=True)
        self._replay = ReplayBuffer(agents, self.config.replay_capacity)
        self._centre = torch.zeros(len(agents), 1, device=device)
        scale = self.config.reward_scale or (UNIVERSAL_SCALE if self._is_universal else 1.0)
        self._scale = torch.full((len(agents), 1), scale, device=device)
        self._inputs = torch.ones(len(agents), 1, agents.widest_observation)
        self._actions = size_mask(agents.action_counts).unsqueeze(1).to(device)
        tens = _tens_of_seconds(structure)
        self._discount = self.config.discount**tens
        self._steps = max(1, round(self.config.steps / tens))
        self._acting = Acting(self._online, self._weights)
        self.begins_taught = False
        """True if the weights are those of an earlier policy: then there are no first lessons, and
        exploration is as low as after lessons."""
        if self.config.start is not None:
            initial = InitialWeights.load(Path(self.config.start))
            if self.env_options.get("commands") and not initial.env_options.get("commands"):
                warnings.warn(
                    f"{self.config.start} has not seen commands under way, which policies see "
                    "here; the training begins without it",
                    stacklevel=2,
                )
            else:
                self.load_initial_weights(initial)
                self.begins_taught = True

    @classmethod
    def of(
        cls,
        env: AnyParallelEnv,
        config: DQNConfig | None = None,
        seed: int = 0,
        env_options: Mapping[str, Any] | None = None,
        device: torch.device = CPU,
    ) -> DQN:
        """Make a learner for the agents of `env`; without `env_options`, take those of `env`.

        Raises:
            OptionError: `env` has a space that this learner cannot use, or lacks the road network
                that "frap", "colight" or "universal" needs.
        """
        if env_options is None:
            env_options = getattr(env.unwrapped, "env_options", {})
        network = config.network if config is not None else "mlp"
        structure = Structure.of(env, network)
        return cls(AgentSet.of(env), config, seed, env_options, structure, device)

    def learn(
        self,
        env: AnyParallelEnv,
        episodes: int,
        seed: int,
        on_episode: EpisodeCallback | None = None,
    ) -> NetworkPolicy:
        """Train for `episodes` more episodes; continue after the last call.

        Random choices depend only on `seed` and the number of episodes so far. So one call for four
        episodes equals two calls for two.

        Args:
            env: An environment with the agents of this learner; it is reset.
            episodes: Number of episodes.
            seed: Root of the seeds of environment, exploration and replay.
            on_episode: Called after each episode with its number (from 0, over all calls) and
                ``return`` (sum of the reward, mean over agents), ``loss``, ``q``, ``epsilon``.

        Returns:
            The greedy policy at the end.

        Raises:
            OptionError: `env` has other agents or spaces than this learner.
            EpisodeError: An agent left before the others, or a reward is not finite.
        """
        if AgentSet.of(env) != self.agents:
            raise OptionError(
                f"the environment's agents are {AgentSet.of(env)}, this learner's {self.agents}; "
                "make a new learner with DQN.of(env)"
            )
        first = self.episodes == self.taught == 0 and not self.begins_taught
        if self.config.teacher and first:
            self.attend(env, seed)
        with one_thread():
            for _ in range(episodes):
                numbers = self._episode(env, seed)
                if on_episode is not None:
                    on_episode(self.episodes - 1, numbers)
        return self.policy()

    def attend(
        self,
        env: AnyParallelEnv,
        seed: int,
        on_play: OnPlay | None = None,
        best: str | None = None,
    ) -> str | None:
        """Learn from the teacher in an environment; earlier teachers are no longer examples.

        `learn` calls it before the first episode. Call it again in an environment of other
        dynamics, where another rule may be the best one.

        Args:
            env: An environment with the agents of this learner; it is reset.
            seed: Root of the seeds of the episodes and of the replay.
            on_play: Called after every episode with the rule that played it, `plays` times.
            best: Spelling of the rule that is best in the environment, if that is known; then the
                teacher "best" need not be looked for.

        Returns:
            Spelling of the teacher; None without one.

        Raises:
            UnknownNameError: No rule has the teacher's name.
            OptionError: The teacher reads other observations than the environment's, or "best" was
                asked for and no standard rule reads them.
        """
        if not self.config.teacher:
            return None
        root = derive_seed(seed, "dqn", "lessons", self.taught)
        if (found := find_teacher(env, self._teacher(best), root, on_play)) is None:
            return self._without_teacher()
        name, teacher = found
        self._replay.forget_teacher()
        for lesson in range(self.config.lessons):
            self._watch(env, teacher, derive_seed(root, "shown", lesson))
            if on_play is not None:
                on_play(name)
        if not self.taught and self.decisions < self.config.warmup_decisions:
            self._measure()  # updates in other units would be lost at the end of the warm-up
        sampling = torch_generator(root, "replay")
        with one_thread():
            for _ in range(self.config.lesson_updates):
                self.update(sampling)
        self.taught += 1
        return name

    def plays(self, env: AnyParallelEnv, best: str | None = None) -> int:
        """Return the number of episodes that `attend` plays.

        Raises:
            OptionError: The teacher "best" was asked for, and no standard rule reads the
                environment's observations.
        """
        if not (teacher := self._teacher(best)):
            return 0
        number = plays(teacher, self.config.lessons, env)
        if not number:
            self._without_teacher()
        return number

    def _without_teacher(self) -> None:
        """Accept that no rule can teach, with "universal", whose default the teacher "best" is.

        Raises:
            OptionError: The network is another one, so that "best" was asked for.
        """
        if not self._is_universal:
            raise OptionError(
                f"teacher {BEST}: no standard rule reads the observations of the environment; "
                "train with --observation movements, not stacked, or leave the teacher out"
            )

    def _teacher(self, best: str | None) -> str:
        """Return the teacher's spelling, or `BEST` if it has to be looked for."""
        teacher = self.config.teacher or ""
        return best if teacher == BEST and best is not None else teacher

    def _epsilon(self) -> float:
        """Return the share of exploratory decisions now."""
        return self.config.epsilon(self.decisions, taught=self.begins_taught or self.taught > 0)

    def _watch(self, env: AnyParallelEnv, teacher: Policy, seed: int) -> None:
        """Let the teacher play an episode, and store its decisions."""
        self._replay.end()
        observations, infos = env.reset(seed=seed)
        teacher.reset(seed)
        now = self.agents.stack(observations)
        while env.agents:
            actions = teacher.act(observations, infos)
            observations, rewards, terminated, _, infos = env.step(actions)
            self._require_all_or_none(env)
            then, allowed = self.agents.stack(observations), self.agents.masks(infos)
            self._replay.add(
                now,
                self.agents.values(actions).astype(np.int64),
                self._finite(self.agents.values(rewards)),
                self.agents.values(terminated).astype(np.bool_),
                then,
                allowed,
                last=not env.agents,
                shown=True,
            )
            now = then

    def policy(self) -> NetworkPolicy:
        """Return the current greedy policy; later learning does not change it.

        The policy uses the target networks, a running mean of the learned ones, because policies of
        the learned networks vary more from episode to episode. On Hangzhou, after 20 to 60 episodes
        with one seed, the travel time of the learned networks was 6 to 26 s worse.
        """
        hidden, shared = self.config.hidden, self.config.shared
        weights, options = self._target_weights, self.env_options
        if self.config.network in _SCALED:
            # Only the widest observation has a factor for every place of a network of all agents.
            widest = int(np.argmax(self.agents.observation_sizes))
            factors = self._inputs[widest, 0] if self._is_one_network else self._inputs[:, 0]
            weights = parameters_for_unscaled(self._target, factors.to(self.device))
        ceiling = None
        if self.config.ceiling is not None and self._replay.added:
            ceiling = ceilings(self._replay.recent(CEILING_DECISIONS), self.config.ceiling)
        return NetworkPolicy(self.agents, hidden, weights, options, shared, self.structure, ceiling)

    def _episode(self, env: AnyParallelEnv, seed: int) -> dict[str, float]:
        number = self.episodes
        explore = StickyExploration(
            len(self.agents),
            self.config.sticky_decisions,
            numpy_generator(seed, "dqn", "explore", number),
        )
        sampling = torch_generator(seed, "dqn", "replay", number)
        tally = _Tally()
        is_due = False

        def learn() -> None:
            if is_due:
                tally.add(*self.update(sampling))

        self._replay.end()
        observations, infos = env.reset(seed=derive_seed(seed, "dqn", "episode", number))
        now, allowed = self.agents.stack(observations), self.agents.masks(infos)
        while env.agents:
            epsilon = self._epsilon()
            acting = self._acting.network()
            seen = torch.from_numpy(now) * self._inputs[:, 0]
            greedy = greedy_actions(acting, seen, torch.from_numpy(allowed))
            actions = explore.choose(greedy, allowed, epsilon)
            asked = self.agents.actions(actions)
            observations, rewards, terminated, _, infos = step_meanwhile(env, asked, learn)
            self._require_all_or_none(env)
            then, allowed = self.agents.stack(observations), self.agents.masks(infos)
            reward = self._finite(self.agents.values(rewards))
            terminal = self.agents.values(terminated).astype(np.bool_)
            self._replay.add(now, actions, reward, terminal, then, allowed, not env.agents)
            now = then
            self.decisions += 1
            tally.decisions += 1
            tally.reward += float(reward.mean())
            is_due = self._is_time_to_update()
        learn()
        self.episodes += 1
        updates = max(1, tally.updates)
        return {
            "return": tally.reward,
            "loss": tally.loss / updates,
            "q": tally.q / updates,
            "epsilon": self._epsilon(),
        }

    def _is_time_to_update(self) -> bool:
        if self.decisions == self.config.warmup_decisions and not self.taught:
            self._measure()
        return (
            self.decisions >= self.config.warmup_decisions
            and self.decisions % self.config.update_every == 0
        )

    @property
    def _is_universal(self) -> bool:
        return self.config.network == "universal"

    @property
    def _is_one_network(self) -> bool:
        return self.config.shared or self.config.network != "mlp"

    def _measure(self) -> None:
        """Set the scales of rewards and observations from the decisions so far."""
        config = self.config
        if config.scale_inputs and config.network in _SCALED:
            seen = self._replay.observations()
            factors = input_factors(seen, self.agents, pooled=self._is_one_network)
            self._inputs.copy_(factors.unsqueeze(1))
        if config.reward_scale is not None or self._is_universal:
            return
        deviation, mean = torch.std_mean(self._replay.rewards(), dim=1, keepdim=True, correction=0)
        scale = torch.where(deviation > 1e-6, 1.0 / deviation.clamp_min(1e-6), 1.0)
        self._centre, self._scale = mean.to(self.device), scale.to(self.device)

    def update(self, generator: torch.Generator) -> tuple[float, float]:
        """Make one gradient step for all agents; return mean loss and mean Q before it.

        The loss is Huber's of Q(s, a) - y with ``y = r + discount * Q'(s', argmax_a' Q(s', a'))``,
        where Q' is the target network and r the scaled reward. With `steps` = n, r is the
        discounted sum over n decisions and s' the state after them. A teacher's decisions add the
        loss of `margin`.

        Args:
            generator: Source of the sample.
        """
        config = self.config
        batch = self._replay.sample(config.batch_size, generator, self._discount, self._steps)
        batch = batch.scaled(self._inputs).to(self.device)
        with torch.no_grad():
            # double Q-learning: the online networks choose, the target networks evaluate
            best = self._online(batch.next_observation)
            best = best.masked_fill_(~batch.next_allowed, -torch.inf).argmax(-1, keepdim=True)
            future = self._target(batch.next_observation).gather(-1, best).squeeze(-1)
            # sum of discount^t (0 - centre) scale: rewards of zero for ever, centred and scaled
            nothing = -self._centre * self._scale / (1 - self._discount)
            future = torch.where(batch.terminal, nothing, future)
            reward = (batch.reward - self._centre * batch.weight) * self._scale
            wanted = reward + batch.discount * future
        values = self._online(batch.observation)
        chosen = values.gather(-1, batch.action.unsqueeze(-1)).squeeze(-1)
        losses = nn.functional.huber_loss(
            chosen, wanted, reduction="none", delta=self.config.huber_delta
        )
        if config.teacher:
            losses = losses + self._margin_losses(values, batch.action, chosen) * batch.shown
        # a mean over agents would make the step of each network depend on the number of agents
        losses.mean(dim=1).sum().backward()
        self._adam.step()
        assert self._weights.grad is not None
        self._weights.grad.zero_()
        self._target_weights.data.lerp_(self._weights.data, self.config.target_rate)
        self.updates += 1
        return float(losses.detach().mean()), float(chosen.detach().mean())

    def _margin_losses(self, values: Tensor, action: Tensor, chosen: Tensor) -> Tensor:
        """Return ``max_a (Q(s, a) + margin [a != a_t]) - Q(s, a_t)`` for teachers' actions a_t.

        Hester et al. 2018, eq. 1. The shape is that of `action`, ``(agents, batch)``.
        """
        raised = (values + self.config.margin).masked_fill(~self._actions, -torch.inf)
        raised = raised.scatter(-1, action.unsqueeze(-1), chosen.unsqueeze(-1))
        return raised.amax(-1) - chosen

    def _require_all_or_none(self, env: AnyParallelEnv) -> None:
        if env.agents and len(env.agents) != len(self.agents):
            gone = sorted(set(self.agents.names) - set(env.agents))
            raise EpisodeError(
                f"agents {', '.join(gone)} left before the others; this learner needs all agents "
                "to stay to the end of the episode"
            )

    def _finite(self, reward: NDArray[np.float32]) -> NDArray[np.float32]:
        if not np.isfinite(reward).all():
            name = self.agents.names[int(np.isfinite(reward).argmin())]
            raise EpisodeError(
                f"the reward of agent {name!r} is not finite at decision {self.decisions}; "
                "correct the reward function"
            )
        return reward

    def load_initial_weights(self, initial: InitialWeights) -> None:
        """Take weights that were learned elsewhere.

        Raises:
            OptionError: The network is not "universal", or has another number of weights. Or they
                were learned from another observation.
        """
        if not self._is_universal:
            raise OptionError('only a network "universal" begins with the weights of another')
        if other := other_observation(initial.env_options, self.env_options):
            raise OptionError(
                f"the start was learned from observations with {other}; make the environment with "
                "the same, or leave out the start"
            )
        weights = initial.weights_for(self._online)
        self._weights.data.copy_(weights)
        self._target_weights.data.copy_(weights)

    def share_weights(self, other: DQN) -> None:
        """Learn the weights of another learner from now on; both update the same ones.

        Args:
            other: Learner with a network "universal" of the same size; its agents may differ.

        Raises:
            OptionError: The networks have other sizes, or weights that belong to intersections.
        """
        if not (self._is_universal and other._is_universal):
            raise OptionError('only learners with network = "universal" share weights')
        if self._weights.shape != other._weights.shape:
            raise OptionError(
                f"a network of {self._weights.numel()} weights cannot share the "
                f"{other._weights.numel()} of another; give both the same options"
            )
        bind_parameters(self._online, other._weights)
        bind_parameters(self._target, other._target_weights)
        self._weights, self._target_weights = other._weights, other._target_weights
        self._adam = other._adam
        self._acting = Acting(self._online, self._weights)

    def save(self, path: Path) -> None:
        """Write the whole state; a learner that loads it continues exactly as this one.

        Raises:
            CheckpointError: The networks have diverged (NaN). An old file at `path` is kept.
        """
        config = self.config
        content = {
            **checkpoint_header(
                self.agents, config.hidden, self.env_options, config.shared, self.structure
            ),
            "counters": {name: getattr(self, name) for name in _COUNTERS}
            | {"added": self._replay.added},
            "tensors": {name: x.to(CPU, copy=True) for name, x in self._tensors().items()},
            "adam": {
                name: x.to(CPU) for name, x in self._adam.state.get(self._weights, {}).items()
            },
            "replay": self._replay.state(),
        }
        write_checkpoint(path, _KIND, content)

    def load(self, path: Path) -> None:
        """Restore a saved state; this learner keeps its own settings.

        Raises:
            CheckpointError: The file is missing, cut short, not finite, or belongs to another
                network, another observation or other agents. The learner does not change then.
        """
        content = read_checkpoint(path, _KIND)
        try:
            agents, hidden, env_options, shared = parse_header(content)
            _require_same(path, "agents", agents, self.agents)
            if other := other_observation(env_options, self.env_options):
                raise CheckpointError(f"{path}: learned from observations with {other}")
            _require_same(path, "hidden sizes", hidden, self.config.hidden)
            _require_same(path, "settings 'shared'", shared, self.config.shared)
            structure = structure_in(content, agents)
            _require_same(path, "network", _network_of(structure), self.config.network)
            if structure != self.structure:
                raise CheckpointError(
                    f"{path}: its intersections have other movements, phases or neighbours than "
                    "this learner's; give the checkpoint of this scenario, or train a new one"
                )
            counters = {name: int(content["counters"][name]) for name in (*_COUNTERS, "added")}
            tensors = checked_tensors(path, content["tensors"], self._tensors())
            stored = checked_tensors(path, content["replay"], self._replay.rows(counters["added"]))
            moments = checked_tensors(
                path, content["adam"], self._moments() if content["adam"] else {}
            )
            if min(counters.values()) < 0 or not self._are_actions(stored["action"]):
                raise ValueError("counters below 0, or actions that no agent has")
        except MALFORMED as error:
            raise CheckpointError(f"{path}: not a whole checkpoint ({error!r})") from None
        self.env_options = env_options or self.env_options
        for name in _COUNTERS:
            setattr(self, name, counters[name])
        for name, tensor in self._tensors().items():
            tensor.copy_(tensors[name])
        self._replay.restore(stored, counters["added"])
        self._adam.state.clear()
        if moments:  # Adam reads them on the device of the weights, contiguous
            placed = {name: moments[name].contiguous().to(self.device) for name in _MOMENTS}
            self._adam.state[self._weights] = placed

    def _moments(self) -> dict[str, Tensor]:
        weights = self._weights.data
        return dict(zip(_MOMENTS, (weights.new_zeros(()), weights, weights), strict=True))

    def _are_actions(self, actions: Tensor) -> bool:
        counts = torch.tensor(self.agents.action_counts).unsqueeze(1)
        return bool(((actions >= 0) & (actions < counts)).all())

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "weights": self._weights.data,
            "target_weights": self._target_weights.data,
            "centre": self._centre,
            "scale": self._scale,
            "inputs": self._inputs,
        }


def _network_of(structure: Structure | None) -> str:
    return "mlp" if structure is None else structure.network


def _tens_of_seconds(structure: Structure | None) -> float:
    """Return the decision interval as a multiple of 10 s for "universal"; 1 for other networks."""
    if structure is None or structure.network != "universal":
        return 1.0
    return (structure.junctions[0].interval_s or SECONDS) / SECONDS


def _require_same(path: Path, attribute: str, saved: object, expected: object) -> None:
    if saved != expected:
        raise CheckpointError(
            f"{path}: its {attribute} are {saved}, this learner's {expected}; give the checkpoint "
            "of this scenario and these settings, or train a new one"
        )
