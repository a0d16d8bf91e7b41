"""One network for all agents: what it shares and tells apart, what it learns, what is saved."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

from tests.runs import q_values
from ugat_marl.envs import AgentSet
from ugat_marl.errors import CheckpointError
from ugat_marl.policies import DQN, BatchedMLP, NetworkPolicy, Policy
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.networks.batched import SharedMLP
from ugat_marl.policies.networks.q_network import q_network
from ugat_marl.testing import ToyTraffic

QUICK = DQNConfig(
    hidden=(16, 16),
    batch_size=16,
    replay_capacity=600,
    warmup_decisions=20,
    epsilon_decay_decisions=200,
    learning_rate=3e-3,
    shared=True,
)


class ParityEnv(ParallelEnv[str, Any, Any]):
    """All agents see the same coin; the first is paid for naming it, the others for its reverse."""

    metadata: ClassVar = {"name": "parity"}

    def __init__(self, agents: int = 3, length: int = 20) -> None:
        self.possible_agents = [f"signal_{i}" for i in range(agents)]
        self.agents = []
        self.length = length

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (2,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        self.random = np.random.default_rng(seed)
        self.agents, self.time = list(self.possible_agents), 0
        return self._observe(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]):
        agents = list(self.agents)
        paid = {
            agent: float((actions[agent] == self.coin) == (agent == "signal_0")) for agent in agents
        }
        self.time += 1
        over = self.time == self.length
        observations = self._observe()
        if over:
            self.agents = []
        ended = dict.fromkeys(agents, over)
        return observations, paid, dict.fromkeys(agents, False), ended, {a: {} for a in agents}

    def _observe(self) -> dict[str, Any]:
        self.coin = int(self.random.integers(2))
        return {agent: np.eye(2, dtype=np.float32)[self.coin] for agent in self.agents}


def play(env: ParallelEnv[str, Any, Any], policy: Policy, seed: int) -> float:
    """Mean reward per decision and agent."""
    observations, infos = env.reset(seed=seed)
    rewards: list[float] = []
    while env.agents:
        actions = policy.act(observations, infos)
        observations, reward, _, _, infos = env.step(actions)
        rewards += reward.values()
    return float(np.mean(rewards))


class MostServed:
    """In `ToyTraffic` the phase whose two lanes let the most vehicles leave."""

    def __init__(self, env: ToyTraffic) -> None:
        self._env = env
        self.env_options: Mapping[str, Any] = {}

    def reset(self, seed: int) -> None:
        del seed

    def act(self, observations: Any, infos: Any) -> dict[str, int]:
        chosen: dict[str, int] = {}
        for agent, layout in self._env.layouts.items():
            queue = observations[agent][: layout.features]
            served = np.minimum(queue, 3 / 20)
            gain = served[:-1] + served[1:] + 1e-3 * (queue[:-1] + queue[1:])
            chosen[agent] = int(gain[: layout.phases].argmax())
        return chosen


def agents_of(count: int, n_in: int = 5, actions: int = 3) -> AgentSet:
    return AgentSet(tuple(f"s{i}" for i in range(count)), (n_in,) * count, (actions,) * count)


def size(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def network(count: int, *, shared: bool, hidden: tuple[int, ...] = (16, 8)) -> torch.nn.Module:
    return q_network(agents_of(count), hidden, shared, torch.Generator().manual_seed(0))


def test_a_further_agent_adds_its_entry_of_the_one_hot_and_nothing_else():
    one = (5 + 1) * 16 + (16 + 1) * 8 + (8 + 1) * 3
    assert size(network(1, shared=True)) == size(network(1, shared=False)) == one
    for count in (2, 7):
        assert size(network(count, shared=True)) == one + (count - 1) * 16
        assert size(network(count, shared=False)) == count * one


def test_agents_that_see_the_same_differ_by_their_indicator_alone():
    net = network(3, shared=True)
    assert isinstance(net, SharedMLP)
    seen = torch.randn(1, 4, 5).expand(3, -1, -1)
    assert torch.equal(net(seen)[0], net(seen)[2])  # before anything is learned
    net.agent_bias.data[2] += 1.0
    assert torch.equal(net(seen)[0], net(seen)[1])
    assert not torch.allclose(net(seen)[0], net(seen)[2])
    net.agent_bias.data[2] -= 1.0
    torch.testing.assert_close(net(seen)[0], net(seen)[2])


@pytest.mark.parametrize("hidden", [(), (16,), (16, 8)])
def test_it_is_a_network_of_its_own_whose_input_ends_with_a_one_hot(hidden: tuple[int, ...]):
    """Against the textbook form: linear layers on (observation, one-hot of the agent)."""
    net = network(3, shared=True, hidden=hidden)
    for parameter in net.parameters():
        parameter.data.normal_()
    weight, bias, *rest = [parameter.detach().squeeze() for parameter in net.parameters()]
    seen = torch.randn(3, 4, 5)
    for agent in range(3):
        one_hot = torch.eye(3)[agent].expand(4, -1)
        values = torch.cat((seen[agent], one_hot), dim=1) @ torch.cat((weight, bias))
        for w, b in zip(rest[::2], rest[1::2], strict=True):
            values = values.relu() @ w + b
        torch.testing.assert_close(net(seen)[agent], values)


def test_independent_networks_are_made_as_before():
    made = network(3, shared=False)
    before = BatchedMLP((5,) * 3, (16, 8), 3, torch.Generator().manual_seed(0))
    assert not DQNConfig().shared
    for ours, theirs in zip(made.parameters(), before.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_what_one_agent_lives_through_the_others_learn():
    """Agent 0 acts, agent 1 sees nothing but zeros: only a shared network knows better for it."""
    state = np.eye(4, dtype=np.float32)[1]
    values: dict[bool, np.ndarray[Any, Any]] = {}
    for shared in (False, True):
        config = DQNConfig(hidden=(16,), learning_rate=3e-3, reward_scale=1.0, shared=shared)
        learner = DQN(agents_of(2, 4, 2), config, seed=1)
        for action in (0, 1):
            learner._replay.add(
                np.stack([state, np.zeros(4, np.float32)]),
                np.array([action, 0]),
                np.array([5.0 * action, 0.0], np.float32),
                np.ones(2, bool),
                np.zeros((2, 4), np.float32),
                np.ones((2, 2), bool),
            )
        generator = torch.Generator().manual_seed(0)
        for _ in range(600):
            learner.update(generator)
        values[shared] = q_values(learner.policy(), {"s0": state, "s1": state})["s1"]
    assert values[True][1] - values[True][0] > 2.5
    assert abs(values[False][1] - values[False][0]) < 1.0


def test_reaches_the_optimum_where_equal_sights_ask_for_different_actions():
    policy = DQN.of(ParityEnv(), QUICK).learn(ParityEnv(), 30, seed=1)
    assert play(ParityEnv(length=100), policy, seed=99) == 1.0


@pytest.mark.slow
def test_unequal_agents_come_close_to_the_rule_that_knows_toy_traffic():
    env = ToyTraffic(steps=40)
    config = DQNConfig(hidden=(32, 32), epsilon_decay_decisions=800, shared=True)
    policy = DQN.of(env, config).learn(env, 60, seed=0)
    rule = MostServed(env)
    learned, known = (
        np.mean([play(env, who, seed) for seed in range(900, 920)]) for who in (policy, rule)
    )
    assert learned > 1.1 * known  # rewards are negative; random phases get 3.3 times as little


def test_training_twice_gives_the_same_weights_and_resuming_too(tmp_path: Path):
    once, again = (
        DQN.of(ParityEnv(), QUICK, seed=5).learn(ParityEnv(), 8, seed=1).parameters for _ in "ab"
    )
    assert np.array_equal(once, again)
    first = DQN.of(ParityEnv(), QUICK, seed=5)
    first.learn(ParityEnv(), 5, seed=1)
    first.save(tmp_path / "dqn.pt")
    second = DQN.of(ParityEnv(), QUICK, seed=77)
    second.load(tmp_path / "dqn.pt")
    assert np.array_equal(second.learn(ParityEnv(), 3, seed=1).parameters, once)


def test_a_policy_survives_file_and_pickle(tmp_path: Path):
    env = ToyTraffic()
    policy = DQN.of(env, QUICK).learn(env, 5, seed=0)
    policy.save(tmp_path / "policy.pt")
    observations, _ = env.reset(seed=7)
    for copy in (NetworkPolicy.load(tmp_path / "policy.pt"), pickle.loads(pickle.dumps(policy))):  # noqa: S301
        assert copy.shared
        assert np.array_equal(copy.parameters, policy.parameters)
        for agent, values in q_values(policy, observations).items():
            assert np.array_equal(q_values(copy, observations)[agent], values)


@pytest.mark.parametrize("shared", [False, True])
def test_checkpoints_of_the_other_kind_are_refused_and_change_nothing(tmp_path: Path, shared: bool):
    mine, other = (
        DQN(agents_of(2), DQNConfig(hidden=(8,), shared=kind)) for kind in (shared, not shared)
    )
    mine.save(tmp_path / "dqn.pt")
    untouched = other.policy().parameters
    with pytest.raises(CheckpointError, match=rf"'shared' are {shared}, this learner's"):
        other.load(tmp_path / "dqn.pt")
    assert np.array_equal(other.policy().parameters, untouched)


def test_a_policy_file_whose_kind_and_parameters_disagree_is_refused(tmp_path: Path):
    """More numbers than a network has would otherwise be cut off without a word."""
    path = tmp_path / "policy.pt"
    DQN(agents_of(2), DQNConfig(hidden=(8,))).policy().save(path)
    content = torch.load(path, weights_only=True)
    for claim in (True, "yes"):
        content["shared"] = claim
        torch.save(content, path)
        with pytest.raises(CheckpointError, match=r"policy\.pt: not a whole policy"):
            NetworkPolicy.load(path)
