"""DQN against toy tasks whose optimum is known, and its state against an unbroken run."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch.utils._python_dispatch import TorchDispatchMode

from tests.runs import q_values
from ugat_marl.envs import AgentSet
from ugat_marl.errors import ActionError, CheckpointError, EpisodeError, OptionError
from ugat_marl.policies import DQN, Learner, NetworkPolicy, Policy
from ugat_marl.policies.learners.dqn import DQNConfig, StickyExploration
from ugat_marl.policies.learners.replay import ReplayBuffer

QUICK = DQNConfig(
    hidden=(16, 16),
    batch_size=16,
    replay_capacity=300,
    warmup_decisions=20,
    epsilon_decay_decisions=200,
    learning_rate=3e-3,
)


class CueEnv(ParallelEnv[str, Any, Any]):
    """Each agent sees which of its actions pays 1; the others pay 0. Agents are unequal.

    With `masked`, the first action of every agent is forbidden at even times.
    """

    metadata: ClassVar = {"name": "cue"}

    def __init__(
        self, actions: tuple[int, ...] = (2, 3, 4), length: int = 20, masked: bool = False
    ) -> None:
        self.possible_agents = [f"signal_{i}" for i in range(len(actions))]
        self.agents = []
        self.counts = dict(zip(self.possible_agents, actions, strict=True))
        self.length = length
        self.masked = masked
        self.reward_of_agent_0: float | None = None

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (self.counts[agent] + 1,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(self.counts[agent])

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        self.random = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.time = 0
        return self._observe(), self._infos()

    def step(self, actions: dict[str, int]):
        agents = list(self.agents)
        for agent in agents:
            if self.masked and not self._mask(agent)[actions[agent]]:
                raise AssertionError(f"{agent} took a masked action")
        rewards = {a: float(actions[a] == self.cue[a]) for a in agents}
        if self.reward_of_agent_0 is not None:
            rewards[agents[0]] = self.reward_of_agent_0
        self.time += 1
        over = self.time == self.length
        observations, infos = self._observe(), self._infos()
        if over:
            self.agents = []
        # infos name another action as executed: a learner must not learn from it
        ended = dict.fromkeys(agents, over)
        return observations, rewards, dict.fromkeys(agents, False), ended, infos

    def _mask(self, agent: str) -> np.ndarray[Any, np.dtype[np.int8]]:
        mask = np.ones(self.counts[agent], np.int8)
        if self.masked:
            mask[0] = self.time % 2
        return mask

    def _infos(self) -> dict[str, Any]:
        return {a: {"action_mask": self._mask(a), "executed_action": 0} for a in self.agents}

    def _observe(self) -> dict[str, Any]:
        self.cue = {a: int(self.random.integers(self.counts[a])) for a in self.agents}
        vectors = {a: np.zeros(self.counts[a] + 1, np.float32) for a in self.agents}
        for agent in self.agents:
            vectors[agent][self.cue[agent]] = 1
        return vectors


class LeverEnv(ParallelEnv[str, Any, Any]):
    """Action 1 moves right at a cost of 0.1, action 0 stays; the right end pays 1 per decision.

    Greedy for the next reward means to stay for ever (0); the optimum goes right and stays there.
    """

    metadata: ClassVar = {"name": "lever"}

    def __init__(self, terminates: bool = False) -> None:
        self.possible_agents = ["signal_0"]
        self.agents = []
        self.terminates = terminates

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (4,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        self.agents = ["signal_0"]
        self.at, self.time = int(np.random.default_rng(seed).integers(4)), 0
        return self._observe(), {"signal_0": {}}

    def step(self, actions: dict[str, int]):
        moves = actions["signal_0"] == 1
        self.at = min(3, self.at + moves)
        self.time += 1
        over = self.time == 10
        reward = float(self.at == 3) - 0.1 * moves
        terminal, truncated = over and self.terminates, over and not self.terminates
        observations = self._observe()
        if over:
            self.agents = []
        agent = "signal_0"
        return observations, {agent: reward}, {agent: terminal}, {agent: truncated}, {agent: {}}

    def _observe(self) -> dict[str, Any]:
        return {"signal_0": np.eye(4, dtype=np.float32)[self.at]}


def play(env: ParallelEnv[str, Any, Any], policy: Policy, seed: int) -> float:
    """Mean reward per agent and decision."""
    observations, infos = env.reset(seed=seed)
    policy.reset(seed)
    rewards: list[float] = []
    while env.agents:
        observations, reward, _, _, infos = env.step(policy.act(observations, infos))
        rewards.extend(reward.values())
    return float(np.mean(rewards))


def test_implements_the_protocols():
    learner = DQN.of(CueEnv(), QUICK)
    assert isinstance(learner, Learner)
    assert isinstance(learner.policy(), Policy)


def test_learns_which_action_pays_for_unequal_agents():
    learner = DQN.of(CueEnv(), QUICK)
    numbers: list[tuple[int, float]] = []
    policy = learner.learn(
        CueEnv(), 30, seed=1, on_episode=lambda e, n: numbers.append((e, n["return"]))
    )
    assert play(CueEnv(length=100), policy, seed=99) > 0.97
    assert [episode for episode, _ in numbers] == list(range(30))
    assert numbers[-1][1] > numbers[0][1] + 5  # returns rise, out of 20


def test_learns_what_pays_only_later():
    config = DQNConfig(
        hidden=(16,),
        batch_size=32,
        warmup_decisions=50,
        epsilon_decay_decisions=300,
        discount=0.9,
        learning_rate=3e-3,
        target_rate=0.05,
    )
    env = LeverEnv()
    policy = DQN.of(env, config).learn(env, 60, seed=0)
    for at in range(4):
        observation = {"signal_0": np.eye(4, dtype=np.float32)[at]}
        assert policy.act(observation, {}) == {"signal_0": int(at < 3)}


@pytest.mark.parametrize("terminates", [False, True])
def test_values_are_those_of_an_endless_or_an_ended_episode(terminates: bool):
    """Truncation is bootstrapped through, termination is worth nothing afterwards."""
    env = LeverEnv(terminates)
    config = DQNConfig(
        hidden=(16,),
        batch_size=32,
        warmup_decisions=10,
        epsilon_start=0.0,
        epsilon_end=0.0,
        discount=0.5,
        learning_rate=3e-3,
        target_rate=0.05,
        reward_scale=1.0,
    )
    learner = DQN.of(env, config)
    agents = learner.agents
    # one decision, known to the last digit: at the right end, staying pays 1 and ends, or not
    end = np.eye(4, dtype=np.float32)[3][None]
    for _ in range(64):
        learner._replay.add(
            end,
            np.array([0]),
            np.ones(1, np.float32),
            np.array([terminates]),
            end,
            np.array([[True, False]]),
        )
    generator = torch.Generator().manual_seed(0)
    for _ in range(800):
        learner.update(generator)
    value = q_values(learner.policy(), {agents.names[0]: end[0]})["signal_0"][0]
    assert value == pytest.approx(1.0 if terminates else 2.0, abs=0.05)  # 1, or 1 / (1 - 0.5)


def test_terminal_value_is_shifted_with_the_centre_of_the_rewards():
    """With r centred by c and scaled by k, an ended episode is worth -c k / (1 - gamma)."""
    learner = DQN.of(LeverEnv(), DQNConfig(hidden=(8,), discount=0.5, learning_rate=3e-3))
    learner._centre.fill_(-4.0)
    learner._scale.fill_(0.5)
    state = np.eye(4, dtype=np.float32)[:1]
    learner._replay.add(
        state,
        np.array([0]),
        np.array([-6.0], np.float32),
        np.array([True]),
        state,
        np.ones((1, 2), bool),
    )
    for _ in range(3000):
        learner.update(torch.Generator().manual_seed(0))
    value = q_values(learner.policy(), {"signal_0": state[0]})["signal_0"][0]
    assert value == pytest.approx((-6.0 + 4.0) * 0.5 + 0.5 * (4.0 * 0.5 / 0.5), abs=0.05)


def test_masked_actions_are_never_taken():
    env = CueEnv(masked=True)
    learner = DQN.of(env, QUICK)
    policy = learner.learn(env, 10, seed=3)  # the environment asserts at every step
    play(env, policy, seed=4)
    for masks in learner._replay.state()["next_allowed"]:
        assert masks[:, 0].any()
        assert not masks[:, 0].all()


def test_masked_actions_are_never_bootstrapped_from():
    """In one state, action 1 pays 5 and ends; action 0 pays 1 and leads to where 1 is masked."""
    config = DQNConfig(hidden=(8,), discount=0.5, learning_rate=1e-2, target_rate=0.1)
    learner = DQN.of(LeverEnv(), config)
    state = np.eye(4, dtype=np.float32)[:1]
    for action, reward in ((0, 1.0), (1, 5.0)):
        learner._replay.add(
            state,
            np.array([action]),
            np.array([reward], np.float32),
            np.array([action == 1]),
            state,
            np.array([[True, False]]),
        )
    generator = torch.Generator().manual_seed(0)
    for _ in range(500):
        learner.update(generator)
    values = q_values(learner.policy(), {"signal_0": state[0]})["signal_0"]
    assert values == pytest.approx([2.0, 5.0], abs=0.05)  # 1 / (1 - 0.5); with action 1 it is 3.5


def test_own_action_is_stored_not_the_executed_one():
    env = CueEnv()
    learner = DQN.of(env, QUICK)
    learner.learn(env, 1, seed=0)
    assert learner._replay.state()["action"].sum() > 0


def test_training_twice_gives_the_same_weights():
    weights = [DQN.of(CueEnv(), QUICK, seed=5).learn(CueEnv(), 6, seed=1).parameters for _ in "ab"]
    assert np.array_equal(weights[0], weights[1])
    other = DQN.of(CueEnv(), QUICK, seed=5).learn(CueEnv(), 6, seed=2).parameters
    assert not np.array_equal(weights[0], other)


def test_agents_learn_independently_of_how_many_there_are():
    """An agent's network gets the same gradient alone and beside others."""
    alone, beside = (DQN.of(CueEnv(actions), QUICK) for actions in ((3,), (3, 3)))
    weight = "layers.0.weight"
    for learner in (alone, beside):
        n = len(learner.agents)
        online = dict(learner._online.named_parameters())
        for parameter in online.values():
            parameter.data[:] = torch.linspace(-1, 1, parameter[0].numel()).view_as(parameter[0])
        row = np.ones((n, 4), np.float32)
        learner._replay.add(
            row,
            np.zeros(n, np.int64),
            np.ones(n, np.float32),
            np.zeros(n, bool),
            row,
            np.ones((n, 3), bool),
        )
        learner.update(torch.Generator().manual_seed(0))
    first = dict(alone._online.named_parameters())[weight]
    second = dict(beside._online.named_parameters())[weight]
    torch.testing.assert_close(first[0], second[0])


def test_resume_equals_an_unbroken_run(tmp_path: Path):
    unbroken = DQN.of(CueEnv(), QUICK, seed=5)
    history: list[dict[str, float]] = []
    unbroken.learn(CueEnv(), 22, seed=1, on_episode=lambda _, n: history.append(dict(n)))

    first = DQN.of(CueEnv(), QUICK, seed=5)
    first.learn(CueEnv(), 17, seed=1)  # past the capacity of the replay: the ring has turned
    first.save(tmp_path / "dqn.pt")
    second = DQN.of(CueEnv(), QUICK, seed=1234)
    second.load(tmp_path / "dqn.pt")
    resumed: list[dict[str, float]] = []
    second.learn(CueEnv(), 5, seed=1, on_episode=lambda _, n: resumed.append(dict(n)))

    assert resumed == history[17:]
    assert np.array_equal(second.policy().parameters, unbroken.policy().parameters)
    mine, theirs = (x._replay.state() for x in (second, unbroken))
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_resume_before_the_first_update_equals_an_unbroken_run(tmp_path: Path):
    unbroken = DQN.of(CueEnv(length=7), QUICK).learn(CueEnv(length=7), 6, seed=1)
    first = DQN.of(CueEnv(length=7), QUICK)
    first.learn(CueEnv(length=7), 1, seed=1)
    first.save(tmp_path / "dqn.pt")
    second = DQN.of(CueEnv(length=7), QUICK, seed=9)
    second.load(tmp_path / "dqn.pt")
    assert np.array_equal(second.learn(CueEnv(length=7), 5, seed=1).parameters, unbroken.parameters)


def test_policy_is_a_snapshot_and_survives_file_and_pickle(tmp_path: Path):
    env = CueEnv()
    learner = DQN.of(env, QUICK, env_options={"observation": "count"})
    policy = learner.learn(env, 3, seed=0)
    before = policy.parameters
    learner.learn(env, 3, seed=0)
    assert np.array_equal(policy.parameters, before)
    assert not np.array_equal(learner.policy().parameters, before)
    policy.save(tmp_path / "policy.pt")
    observations, infos = env.reset(seed=7)
    for copy in (NetworkPolicy.load(tmp_path / "policy.pt"), pickle.loads(pickle.dumps(policy))):  # noqa: S301
        assert np.array_equal(copy.parameters, before)
        assert copy.env_options == {"observation": "count"}
        assert copy.act(observations, infos) == policy.act(observations, infos)


def test_env_options_come_from_the_environment():
    env = CueEnv()
    assert DQN.of(env, QUICK).policy().env_options == {}
    env.env_options = {"observation": "queue"}
    assert DQN.of(env, QUICK).policy().env_options == {"observation": "queue"}


def test_damaged_and_foreign_checkpoints_are_refused_and_change_nothing(tmp_path: Path):
    path = tmp_path / "dqn.pt"
    learner = DQN.of(CueEnv(), QUICK)
    learner.learn(CueEnv(), 2, seed=0)
    learner.save(path)
    whole = path.read_bytes()

    target = DQN.of(CueEnv(), QUICK, seed=3)
    untouched = target.policy().parameters
    for content in (whole[: len(whole) // 2], b"", b"not a checkpoint", whole[:-40]):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match=r"dqn\.pt"):
            target.load(path)
    path.write_bytes(whole)
    for other in (DQN.of(CueEnv((2, 3)), QUICK), DQN.of(CueEnv((3, 3, 4)), QUICK)):
        with pytest.raises(CheckpointError, match="agents"):
            other.load(path)
    counts = DQN.of(CueEnv(), QUICK, env_options={"observation": "count"})
    counts.load(path)  # a file that does not tell its observation is taken
    counts.save(tmp_path / "counts.pt")
    for options in ({"observation": "queue"}, {"observation": "count", "neighbours": 1}):
        with pytest.raises(CheckpointError, match=r"counts\.pt: learned from observations with"):
            DQN.of(CueEnv(), QUICK, env_options=options).load(tmp_path / "counts.pt")
    with pytest.raises(CheckpointError, match="hidden"):
        DQN.of(CueEnv(), DQNConfig(hidden=(8,))).load(path)
    with pytest.raises(CheckpointError, match="shape"):
        DQN.of(CueEnv(), DQNConfig(hidden=(16, 16), replay_capacity=30, warmup_decisions=9)).load(
            path
        )
    with pytest.raises(CheckpointError, match="no such"):
        target.load(tmp_path / "nowhere.pt")
    with pytest.raises(CheckpointError, match="expected"):
        NetworkPolicy.load(path)
    assert np.array_equal(target.policy().parameters, untouched)


def _replace(*path: str, by: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = by

    return change


@pytest.mark.parametrize(
    "change",
    [
        _replace("adam", "exp_avg", by=torch.zeros(3)),
        _replace("adam", "exp_avg_sq", by=torch.zeros(1)),
        _replace("adam", "step", by=torch.zeros(2)),
        _replace("adam", by={"step": torch.zeros(())}),
        _replace("tensors", "centre", by=[0.0]),
        _replace("counters", "decisions", by=-5),
        _replace("counters", "added", by=-1),
        _replace("replay", "action", by=torch.full((3, 40), 7)),
        _replace("replay", "action", by=torch.full((3, 40), -1)),
        _replace("action_counts", by=[2]),
        _replace("hidden", by=[0]),
        _replace("hidden", by=[]),
    ],
    ids=lambda change: str(change.__closure__[1].cell_contents),
)
def test_a_crafted_checkpoint_is_refused_before_anything_reads_it(
    tmp_path: Path, change: Callable[[dict[str, Any]], None]
):
    learner = DQN.of(CueEnv(), QUICK)
    learner.learn(CueEnv(), 2, seed=0)
    learner.save(tmp_path / "dqn.pt")
    content = torch.load(tmp_path / "dqn.pt", weights_only=True)
    assert content["adam"] and tuple(content["replay"]["action"].shape) == (3, 40)
    DQN.of(CueEnv(), QUICK).load(tmp_path / "dqn.pt")
    change(content)
    torch.save(content, tmp_path / "dqn.pt")
    with pytest.raises(CheckpointError, match=r"dqn\.pt"):
        DQN.of(CueEnv(), QUICK, seed=3).load(tmp_path / "dqn.pt")


@pytest.mark.parametrize(
    "change", [("agents", ["a"]), ("observation_sizes", [0, 3]), ("hidden", [0])]
)
def test_a_crafted_policy_is_refused(tmp_path: Path, change: tuple[str, list[Any]]):
    DQN.of(CueEnv(), QUICK).policy().save(tmp_path / "policy.pt")
    content = torch.load(tmp_path / "policy.pt", weights_only=True)
    torch.save(content | dict([change]), tmp_path / "policy.pt")
    with pytest.raises(CheckpointError, match="no network's"):
        NetworkPolicy.load(tmp_path / "policy.pt")


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused_both_ways(tmp_path: Path, bad: float):
    path = tmp_path / "dqn.pt"
    learner = DQN.of(CueEnv(), QUICK)
    learner.save(path)
    good = path.read_bytes()
    content = torch.load(path, weights_only=True)
    content["tensors"]["weights"][3] = bad
    torch.save(content, tmp_path / "bad.pt")
    with pytest.raises(CheckpointError, match="NaN or infinity"):
        learner.load(tmp_path / "bad.pt")

    learner._weights.data[0] = bad
    with pytest.raises(CheckpointError, match="NaN or infinity"):
        learner.save(path)
    learner._target_weights.data[0] = bad
    with pytest.raises(CheckpointError, match="NaN or infinity"):
        learner.policy().save(path)
    assert path.read_bytes() == good
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.pt", "dqn.pt"]


def test_options_that_cannot_be_saved_are_named(tmp_path: Path):
    learner = DQN.of(CueEnv(), QUICK, env_options={"reward": print})
    with pytest.raises(CheckpointError, match="env_options"):
        learner.save(tmp_path / "dqn.pt")
    assert not list(tmp_path.iterdir())


def test_reward_that_is_not_finite_and_agents_that_leave_are_errors():
    env = CueEnv()
    env.reward_of_agent_0 = float("nan")
    with pytest.raises(EpisodeError, match="signal_0"):
        DQN.of(env, QUICK).learn(env, 1, seed=0)

    class Leaving(CueEnv):
        def step(self, actions: dict[str, int]):
            result = super().step(actions)
            self.agents = self.agents[1:]
            return result

    with pytest.raises(EpisodeError, match="signal_0 left"):
        DQN.of(Leaving(), QUICK).learn(Leaving(), 1, seed=0)


def test_other_agents_than_the_learners_are_refused():
    learner = DQN.of(CueEnv((2, 3)), QUICK)
    with pytest.raises(OptionError, match=r"DQN\.of"):
        learner.learn(CueEnv((2, 4)), 1, seed=0)
    observations, infos = CueEnv((2, 4)).reset(seed=0)
    with pytest.raises(OptionError, match="shape"):
        learner.policy().act(observations, infos)
    with pytest.raises(OptionError, match="acts for 2"):
        learner.policy().act({"signal_0": observations["signal_0"]}, infos)
    renamed = {"signal_0": observations["signal_0"], "left": observations["signal_1"]}
    with pytest.raises(OptionError, match="'signal_1' is missing"):
        learner.policy().act(renamed, infos)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_observations_that_are_no_numbers_are_refused(value: float) -> None:
    env = CueEnv((2, 3))
    observations, infos = env.reset(seed=0)
    observations["signal_1"][0] = value
    with pytest.raises(OptionError, match="'signal_1' holds NaN or infinity"):
        DQN.of(env, QUICK).policy().act(observations, infos)


def test_masks_that_allow_nothing_or_have_the_wrong_length_are_errors():
    agents = AgentSet(("a", "b"), (1, 1), (2, 3))
    with pytest.raises(ActionError, match="'b' allows no action"):
        agents.masks({"a": {}, "b": {"action_mask": np.zeros(3, np.int8)}})
    with pytest.raises(ActionError, match="2 entries, not 3"):
        agents.masks({"a": {}, "b": {"action_mask": np.ones(2, np.int8)}})
    assert agents.masks({"a": {}}).tolist() == [[True, True, False], [True, True, True]]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("hidden", (0,)),
        ("hidden", 64),
        ("learning_rate", 0.0),
        ("discount", 1.0),
        ("batch_size", 0),
        ("batch_size", 1.5),
        ("warmup_decisions", 20_000),
        ("target_rate", 1.5),
        ("epsilon_end", -0.1),
        ("sticky_decisions", 0),
        ("reward_scale", float("nan")),
        ("huber_delta", 0.0),
    ],
)
def test_impossible_settings_are_named(option: str, value: object):
    with pytest.raises(OptionError, match=rf"DQNConfig\.{option}"):
        DQNConfig(**{option: value})


def test_settings_read_from_json_are_the_same_settings():
    assert DQNConfig(**json.loads('{"hidden": [16, 16]}')) == DQNConfig(hidden=(16, 16))


@pytest.mark.parametrize("longest", [1, 2, 5])
@pytest.mark.parametrize("epsilon", [0.0, 0.1, 0.5, 1.0])
def test_exploration_keeps_its_share_and_persists(longest: int, epsilon: float):
    generator = np.random.default_rng(0)
    agents, decisions = 50, 2000
    explore = StickyExploration(agents, longest, generator)
    allowed = np.ones((agents, 8), bool)
    allowed[:, 0] = False  # the greedy action 0 marks decisions that are not exploratory
    greedy = np.zeros(agents, np.int64)
    allowed_greedy = allowed.copy()
    actions = np.stack([explore.choose(greedy, allowed_greedy, epsilon) for _ in range(decisions)])
    assert (actions > 0).mean() == pytest.approx(epsilon, abs=0.01)
    if epsilon == 0.1:
        repeats = (actions[1:] == actions[:-1])[actions[:-1] > 0].mean()
        # a bout of mean length m goes on with probability 1 - 1/m; a new one may repeat by chance
        assert repeats == pytest.approx(1 - 2 / (1 + longest), abs=0.05)


def test_exploration_drops_a_bout_that_is_no_longer_allowed():
    explore = StickyExploration(1, 50, np.random.default_rng(1))
    allowed = np.array([[True, True, True]])
    greedy = np.array([0])
    held = int(explore.choose(greedy, allowed, 1.0)[0])
    allowed[0, held] = False
    greedy[0] = (held + 1) % 3
    assert explore.choose(greedy, allowed, 0.0)[0] == greedy[0]


def test_replay_keeps_the_newest_and_draws_the_same_times_for_all():
    agents = AgentSet(("a", "b"), (1, 2), (2, 2))
    replay = ReplayBuffer(agents, 4)
    for i in range(6):
        row = np.full((2, 2), i, np.float32)
        number = np.full(2, i)
        replay.add(row, number, number.astype(np.float32), number > 9, row + 1, row > 9)
    assert len(replay) == 4
    batch = replay.sample(200, torch.Generator().manual_seed(0))
    assert set(batch.action[0].tolist()) == {2, 3, 4, 5}
    assert torch.equal(batch.action[0], batch.action[1])
    assert torch.equal(batch.next_observation, batch.observation + 1)


@pytest.mark.parametrize("steps", [1, 3])
def test_returns_of_several_decisions_stop_at_the_end_of_an_episode_and_at_the_newest(steps: int):
    """Decision i pays i + 1 and leads to i + 1; episodes end after 2 and 5; 9 fill a ring of 7."""
    replay, discount = ReplayBuffer(AgentSet(("a",), (1,), (2,)), 7), 0.5
    for i in range(9):
        row, one = np.full((1, 1), i, np.float32), np.zeros(1, np.int64)
        paid, mask = np.array([i + 1], np.float32), np.ones((1, 2), np.bool_)
        replay.add(row, one, paid, np.array([i == 5]), row + 1, mask, i in (2, 5))
    batch = replay.sample(200, torch.Generator().manual_seed(0), discount, steps)
    drawn = batch.observation[0, :, 0].int().tolist()
    assert set(drawn) == {2, 3, 4, 5, 6, 7, 8}
    for k, first in enumerate(drawn):
        end = next(i for i in (2, 5, 8) if i >= first)
        covered = range(first, min(first + steps - 1, end) + 1)
        powers = [discount**j for j in range(len(covered))]
        assert batch.reward[0, k] == sum(p * (i + 1) for p, i in zip(powers, covered, strict=True))
        assert batch.weight[k] == sum(powers)
        assert batch.discount[k] == discount ** len(covered)
        assert batch.next_observation[0, k, 0] == covered[-1] + 1
        assert batch.terminal[0, k] == (covered[-1] == 5)


class Operations(TorchDispatchMode):
    """Counts the operations that torch is asked for."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_an_update_of_sixteen_agents_is_no_loop_over_agents() -> None:
    def operations(n: int) -> int:
        learner = DQN.of(CueEnv((8,) * n), DQNConfig(warmup_decisions=10))
        row, ones = np.ones((n, 9), np.float32), np.ones((n, 8), bool)
        for _ in range(64):
            learner._replay.add(
                row, np.zeros(n, np.int64), np.ones(n, np.float32), np.zeros(n, bool), row, ones
            )
        generator = torch.Generator()
        learner.update(generator)  # the first one makes what later ones keep
        with Operations() as counted:
            learner.update(generator)
        return counted.count

    assert operations(16) == operations(1) > 0


class FaintCueEnv(CueEnv):
    """A cue as faint as a few vehicles on a long road."""

    def _observe(self) -> dict[str, Any]:
        return {agent: 0.02 * cue for agent, cue in super()._observe().items()}


@pytest.mark.parametrize("shared", [False, True])
def test_the_policy_is_the_learner_on_plain_observations(shared: bool) -> None:
    learner = DQN.of(FaintCueEnv(), replace(QUICK, shared=shared))
    policy = learner.learn(FaintCueEnv(), 4, seed=1)
    assert learner._inputs.max() > 10  # something is scaled
    observations, _ = FaintCueEnv().reset(seed=3)
    seen = torch.from_numpy(learner.agents.stack(observations))[:, None] * learner._inputs
    expected = learner._target(seen)[:, 0]
    for row, values in enumerate(q_values(policy, observations).values()):
        assert values == pytest.approx(expected[row, : len(values)].numpy(), abs=1e-4)


def test_faint_numbers_are_learnt_from_as_quickly_as_others() -> None:
    def won(scale_inputs: bool) -> float:
        config = replace(QUICK, scale_inputs=scale_inputs)
        policy = DQN.of(FaintCueEnv(), config).learn(FaintCueEnv(), 25, seed=1)
        return play(FaintCueEnv(length=100), policy, seed=99)

    assert won(scale_inputs=True) > 0.97
    assert won(scale_inputs=False) < 0.9  # what it is there for


def test_factors_are_measured_once_and_kept_in_checkpoints(tmp_path: Path) -> None:
    learner = DQN.of(FaintCueEnv(), QUICK)
    assert torch.equal(learner._inputs, torch.ones_like(learner._inputs))
    learner.learn(FaintCueEnv(), 2, seed=1)
    measured = learner._inputs.clone()
    learner.save(tmp_path / "learner.pt")
    learner.learn(CueEnv(), 2, seed=1)  # brighter: what was learnt must keep its meaning
    assert torch.equal(learner._inputs, measured)
    other = DQN.of(FaintCueEnv(), QUICK)
    other.load(tmp_path / "learner.pt")
    assert torch.equal(other._inputs, measured)
    assert np.array_equal(other.learn(CueEnv(), 2, seed=1).parameters, learner.policy().parameters)


def _constant(learner: DQN, online: list[float], target: list[float]) -> None:
    """Let both networks answer with constants: all weights are zero but the last biases."""
    for weights, network, values in (
        (learner._weights, learner._online, online),
        (learner._target_weights, learner._target, target),
    ):
        weights.data.zero_()
        last = [p for name, p in network.named_parameters() if name.endswith("bias")][-1]
        last.data.copy_(torch.tensor(values).view_as(last))


def test_the_online_networks_choose_and_the_target_networks_evaluate():
    """With Q = (0, 1) and Q' = (9, 2), y = 0.5 * Q'[argmax Q] = 1; plain Q-learning says 4.5."""
    config = DQNConfig(hidden=(8,), discount=0.5, reward_scale=1.0, huber_delta=100.0)
    learner = DQN.of(LeverEnv(), config)
    state = np.eye(4, dtype=np.float32)[:1]
    learner._replay.add(
        state,
        np.array([0]),
        np.zeros(1, np.float32),
        np.array([False]),
        state,
        np.ones((1, 2), bool),
    )
    _constant(learner, online=[0.0, 1.0], target=[9.0, 2.0])
    loss, q = learner.update(torch.Generator().manual_seed(0))
    assert q == 0.0
    assert loss == pytest.approx(0.5 * 1.0**2)


def test_the_policy_acts_by_the_target_networks():
    learner = DQN.of(LeverEnv(), DQNConfig(hidden=(8,)))
    _constant(learner, online=[0.0, 1.0], target=[9.0, 2.0])
    seen = {"signal_0": np.eye(4, dtype=np.float32)[0]}
    assert learner.policy().act(seen, {}) == {"signal_0": 0}


def test_returns_stop_where_an_episode_was_broken_off() -> None:
    """Else the rewards of the next episode would count for the decisions of the broken one."""

    class Breaking(CueEnv):
        steps = 0

        def step(self, actions: dict[str, int]):
            self.steps += 1
            if self.steps == 3:
                raise KeyboardInterrupt
            return super().step(actions)

    env = Breaking()
    learner = DQN.of(env, DQNConfig(steps=3, warmup_decisions=1_000))
    with pytest.raises(KeyboardInterrupt):
        learner.learn(env, 1, seed=0)
    learner.learn(env, 1, seed=0)
    assert learner._replay._last[0, : len(learner._replay)].tolist()[1] is True
