"""Pretraining: one network learns on many road networks, and its weights may start a training.

Every road network has a learner with its own replay memory. All learners share their weights. A
few road networks are played at a time, and then updates follow, each from the memory of a drawn
one. So no network is forgotten while others are played (Oroojlooy et al. 2020 train one policy on
many intersections in the same way).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from ugat_marl.envs import AnyParallelEnv
from ugat_marl.policies.learners.dqn import DQN
from ugat_marl.policies.learners.dqn_config import DQNConfig
from ugat_marl.policies.learners.initial_weights import InitialWeights
from ugat_marl.policies.network_policy import NetworkPolicy
from ugat_marl.policies.networks.batched import one_thread
from ugat_marl.seeding import derive_seed, numpy_generator, torch_generator

NEVER = 10**9
"""Decisions between updates while an episode is played: all updates follow it."""


class Pretraining:
    """A network "universal" that learns on many road networks in turn.

    Args:
        config: Settings of the learners; ``batch_size`` counts transitions of all agents together,
            so that an update costs the same on every road network.
        seed: Root of every random choice.

    Attributes:
        learners: Learner of each road network that has been played, by its name.
        episodes: Episodes so far.
    """

    def __init__(self, config: DQNConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self.learners: dict[str, DQN] = {}
        self.episodes = 0

    def play(self, envs: Mapping[str, AnyParallelEnv], updates: int, epsilon: float) -> None:
        """Play an episode on each of some road networks, then update from the memories of all.

        The episodes run in threads, all with the same weights, so that the result does not depend
        on which one ends first.

        Args:
            envs: Name of each road network, and the network in any domain; its memory goes on.
            updates: Number of updates.
            epsilon: Share of exploratory decisions.
        """
        playing = {
            name: self.learners.get(name) or self._new(name, env) for name, env in envs.items()
        }
        for learner in playing.values():
            learner.config = replace(learner.config, epsilon_start=epsilon, epsilon_end=epsilon)
        with one_thread(), ThreadPoolExecutor(len(playing)) as threads:
            played = [
                threads.submit(learner.learn, envs[name], 1, self._seed_of(name))
                for name, learner in playing.items()
            ]
            for episode in played:
                episode.result()
            self._update(updates)
        self.episodes += len(playing)

    def start(self, origin: str) -> InitialWeights:
        """Return the weights so far.

        Args:
            origin: How they were learned.
        """
        learner = next(iter(self.learners.values()))
        return InitialWeights(learner.running_weights, learner.env_options, origin)

    def policy(self, env: AnyParallelEnv) -> NetworkPolicy:
        """Return the greedy policy of the weights so far, for any road network."""
        learner = DQN.of(env, self._config, self._seed)
        if self.learners:
            learner.load_initial_weights(self.start(""))
        return learner.policy()

    def set_learning_rate(self, rate: float) -> None:
        """Change the step size of all learners."""
        for learner in self.learners.values():
            learner.set_learning_rate(rate)

    def _seed_of(self, name: str) -> int:
        return derive_seed(self._seed, "pretraining", name)

    def _new(self, name: str, env: AnyParallelEnv) -> DQN:
        agents = len(env.possible_agents)
        config = replace(
            self._config,
            update_every=NEVER,
            batch_size=max(1, self._config.batch_size // agents),
        )
        learner = DQN.of(env, config, self._seed)
        if self.learners:
            learner.share_weights(next(iter(self.learners.values())))
        self.learners[name] = learner
        return learner

    def _update(self, updates: int) -> None:
        """Update from the memories of drawn road networks, one after the other."""
        known: Sequence[DQN] = list(self.learners.values())
        choose = numpy_generator(self._seed, "pretraining", "order", self.episodes)
        sample = torch_generator(self._seed, "pretraining", "sample", self.episodes)
        for place in choose.integers(len(known), size=updates):
            known[int(place)].update(sample)
