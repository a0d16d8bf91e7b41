"""IPPO and MAPPO against hand-computed numbers, tasks whose optimum is known, and themselves."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

import ugat_marl
from ugat_marl.envs import agent_indicator, pad_spaces
from ugat_marl.errors import ActionError, CheckpointError, EpisodeError, OptionError
from ugat_marl.grounding import GateConfig, GroundedEnv, PhaseTransform
from ugat_marl.policies import Learner, NetworkPolicy, Policy, load_baseline
from ugat_marl.testing import ToyTraffic, check_policy, failed_checks

FILE = Path(__file__).resolve().parents[2] / "baselines" / "ippo.py"
if not FILE.is_file():
    pytest.skip("baselines/ is part of a checkout only", allow_module_level=True)


ippo: Any = load_baseline("ippo")
IPPO, Config = ippo.IPPO, ippo.IPPOConfig
QUICK: dict[str, Any] = {
    "hidden": (32, 32),
    "learning_rate": 3e-3,
    "epochs": 4,
    "minibatch": 10,
    "update_every": 20,
}


class PaidEnv(ParallelEnv[str, Any, Any]):
    """Three decisions, each paid 1; the agent sees which is next, in a circle."""

    metadata: ClassVar = {"name": "paid"}

    def __init__(self, terminates: bool = False, reward: float = 1.0) -> None:
        self.possible_agents, self.agents = ["signal_0"], list[str]()
        self.terminates, self.reward = terminates, reward

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (3,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        self.agents, self.time = ["signal_0"], 0
        return self._observe(), {"signal_0": {}}

    def step(self, actions: dict[str, int]):
        self.time += 1
        over, one = self.time == 3, "signal_0"
        if over:
            self.agents = []
        ends = {one: over and self.terminates}, {one: over and not self.terminates}
        return self._observe(), {one: self.reward}, *ends, {one: {}}

    def _observe(self) -> dict[str, Any]:
        return {"signal_0": np.eye(3, dtype=np.float32)[self.time % 3]}


class LargestQueue:
    """The phase that lets most vehicles go, in the toy environment."""

    env_options: ClassVar[dict[str, Any]] = {}

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observations: Any, infos: Any) -> dict[str, int]:
        """Greedy for the next decision, the longer queues where that is equal."""
        chosen: dict[str, int] = {}
        for agent, vector in observations.items():
            count = len(infos[agent]["action_mask"])
            queues = vector[: vector.size - count] * 20
            pairs = [queues[phase : phase + 2] for phase in range(count)]
            gains = [np.minimum(pair, 3).sum() + 1e-3 * pair.sum() for pair in pairs]
            chosen[agent] = int(np.argmax(gains))
        return chosen


class AtRandom(LargestQueue):
    """Any phase."""

    def reset(self, seed: int) -> None:
        """Seeds what is drawn."""
        self.random = np.random.default_rng(seed)

    def act(self, observations: Any, infos: Any) -> dict[str, int]:
        """Uniform."""
        return {a: int(self.random.integers(len(infos[a]["action_mask"]))) for a in observations}


def play(env: ToyTraffic, policy: Policy, episodes: int = 10) -> float:
    """Mean over episodes of the sum of rewards, mean over agents."""
    total = 0.0
    for seed in range(1000, 1000 + episodes):
        observations, infos = env.reset(seed=seed)
        policy.reset(seed)
        while env.agents:
            observations, rewards, _, _, infos = env.step(policy.act(observations, infos))
            total += sum(rewards.values()) / len(rewards)
    return total / episodes


def states_equal(one: Any, other: Any) -> bool:
    """Whether two learners would save the same, to the bit."""
    a, b = one._content(), other._content()
    return a.keys() == b.keys() and all(
        torch.equal(a[key], b[key]) if isinstance(a[key], torch.Tensor) else a[key] == b[key]
        for key in a
    )


def test_advantages_by_hand() -> None:
    rewards = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    values = torch.tensor([[0.5, 1.0, 1.5, 2.0], [0.0, 0.0, 0.0, 8.0]])
    # errors: 1 + 0.5 - 0.5, 2 + 0.75 - 1, 3 + 1 - 1.5; the second agent has its bootstrap alone
    wanted = torch.tensor([[1 + 0.25 * 2.375, 1.75 + 0.25 * 2.5, 2.5], [0.25, 1.0, 4.0]])
    assert torch.allclose(ippo.gae(rewards, values, 0.5, 0.5), wanted)
    # with lambda = 1 it is the discounted sum, the value after the last decision included
    whole = ippo.gae(rewards, values, 0.5, 1.0)[0, 0] + values[0, 0]
    assert whole == 1 + 0.5 * 2 + 0.25 * 3 + 0.125 * 2


@pytest.mark.parametrize(
    ("terminates", "scale", "wanted"),
    [
        (False, 1.0, [2.0, 2.0, 2.0]),  # truncated: paid for ever, 1 / (1 - 0.5)
        (False, 0.5, [1.0, 1.0, 1.0]),
        (True, 1.0, [1.75, 1.5, 1.0]),
        (False, None, [0.0, 0.0, 0.0]),  # centred: every reward is the mean
        (True, None, [-0.25, -0.5, -1.0]),  # and no reward for ever is worth -1 / (1 - 0.5)
    ],
)
def test_values_bootstrap_at_truncation_only(
    terminates: bool, scale: float | None, wanted: list[float]
) -> None:
    env = PaidEnv(terminates)
    # two decisions in a roll-out, then one: cut off in the middle, and ended
    config = Config(
        discount=0.5, reward_scale=scale, update_every=2, learning_rate=0.02, hidden=(16,)
    )
    learner = IPPO(env, config)
    learner.learn(env, 60, 1)
    shown = torch.diag(torch.from_numpy(learner._seen.factors))
    values = learner._critic(shown[None]).flatten().tolist()
    assert values == pytest.approx(wanted, abs=0.05)


@pytest.mark.parametrize("centralised", [False, True], ids=["IPPO", "MAPPO"])
@pytest.mark.parametrize(("equal", "shared"), [(True, True), (False, True), (False, False)])
def test_it_learns(equal: bool, shared: bool, centralised: bool) -> None:
    env = ToyTraffic(steps=40, arrivals=0.7, equal=equal)
    learner = IPPO(env, Config(**QUICK, centralised=centralised, shared=shared))
    policy = learner.learn(env, 30, 1)
    random, greedy = play(env, AtRandom()), play(env, LargestQueue())
    assert play(env, policy) > greedy + 0.15 * (random - greedy)


@pytest.mark.parametrize("shared", [True, False])
def test_masks_are_kept(shared: bool) -> None:
    env = ToyTraffic(steps=30, masked=True)
    policy = IPPO(env, Config(**QUICK, shared=shared)).learn(env, 3, 1)
    play(env, policy, 3)
    with pytest.raises(ActionError, match="forbidden"):
        play(env, AtRandom(), 1)


def test_what_is_forbidden_has_no_probability() -> None:
    learner = IPPO(ToyTraffic(), Config(**QUICK))
    allowed = torch.tensor([[True, False, True], [False, True, False], [True, True, True]])
    seen = torch.rand(3, 1, learner.agents.widest_observation)
    chances = learner._log_probabilities(seen, allowed[:, None]).exp().squeeze(1)
    assert torch.equal(chances > 0, allowed)
    drawn = [
        learner._draw(seen[:, 0], allowed, torch.Generator().manual_seed(k)) for k in range(99)
    ]
    for agent, own in enumerate(allowed):
        assert {int(action[agent]) for action, _ in drawn} == set(own.nonzero().flatten().tolist())
    actions, logs = drawn[0]
    assert torch.allclose(logs.exp(), chances.gather(1, actions[:, None]).squeeze(1))


def moved(learner: Any, apart: float, advantages: torch.Tensor) -> tuple[bool, list[float]]:
    """Whether a gradient step moves the actor, and its entropy before and after.

    Actions of positive advantage have become e^apart times as probable since they were drawn, the
    others e^-apart times.
    """
    torch.manual_seed(0)
    torch.nn.init.normal_(list(learner._actor.parameters())[-1])
    decisions = advantages.shape[1]
    seen = torch.rand(3, decisions, learner.agents.widest_observation)
    allowed = torch.ones(3, decisions, learner.agents.most_actions, dtype=torch.bool)
    action = torch.zeros(3, decisions, dtype=torch.long)
    with torch.no_grad():
        drawn = learner._log_probabilities(seen, allowed)[..., 0] - apart * advantages.sign()
    part = ippo.Decision(seen, seen, allowed, action, drawn, torch.zeros(3, decisions))
    before = learner.policy().parameters
    values = torch.zeros(3, decisions)
    entropies = [learner._descend(part, values, values + advantages)[2] for _ in range(2)]
    return not np.array_equal(before, learner.policy().parameters), entropies


def test_an_action_that_has_moved_far_enough_is_left_alone() -> None:
    advantages = torch.tensor([[1.0, -1.0]]).repeat(3, 10)
    for apart, moves in ((0.5, False), (0.1, True), (-0.5, True)):  # a ratio of 1.2 is e^0.18
        learner = IPPO(ToyTraffic(), Config(**QUICK, entropy_weight=0.0))
        assert moved(learner, apart, advantages)[0] == moves


def test_entropy_is_rewarded() -> None:
    nothing = torch.zeros(3, 20)
    moves, (before, after) = moved(IPPO(ToyTraffic(), Config(**QUICK)), 0.0, nothing)
    assert moves and after > before
    assert not moved(IPPO(ToyTraffic(), Config(**QUICK, entropy_weight=0.0)), 0.0, nothing)[0]


def test_a_central_critic_sees_the_state_and_others_their_observation() -> None:
    env = ToyTraffic()
    vectors, _ = env.reset(seed=1)
    for _ in range(3):
        vectors = env.step(dict.fromkeys(env.agents, 0))[0]
    own = IPPO(env, Config(**QUICK)).agents.stack(vectors)
    for centralised, wanted in ((False, own), (True, np.stack([env.state()] * 3))):
        learner = IPPO(env, Config(**QUICK, centralised=centralised))
        seen, viewed = learner._look(env, vectors)
        scale = learner._stated if centralised else learner._seen
        assert np.array_equal(seen, own * learner._seen.factors)
        assert np.array_equal(viewed, wanted * scale.factors) and scale.factors.max() > 1.5


def test_it_is_padded_and_told_the_agent_as_by_the_wrappers() -> None:
    env = ToyTraffic()
    learner = IPPO(env, Config(**QUICK))
    wrapped = agent_indicator(pad_spaces(env))
    vectors, _ = wrapped.reset(seed=1)
    network = learner._actor
    torch.nn.init.normal_(network.agent_bias)
    first = torch.cat((network.weight, network.agent_bias[:, 0]))
    seen = torch.from_numpy(np.stack([vectors[agent] for agent in env.possible_agents]))
    own = torch.from_numpy(learner.agents.stack(ToyTraffic().reset(seed=1)[0]))
    told = network.rest((seen @ first)[None]).squeeze(0)
    assert torch.allclose(network(own[:, None]).squeeze(1), told, atol=1e-6)


@pytest.mark.parametrize("centralised", [False, True])
def test_two_and_two_episodes_are_four(centralised: bool, tmp_path: Path) -> None:
    env, config = ToyTraffic(steps=30), Config(**QUICK, centralised=centralised)
    whole, begun, resumed = IPPO(env, config), IPPO(env, config), IPPO(env, config, seed=5)
    whole.learn(env, 4, 1)
    begun.learn(env, 2, 1)
    begun.save(tmp_path / "learner.pt")
    begun.learn(env, 2, 1)
    resumed.load(tmp_path / "learner.pt")
    seen: list[int] = []
    resumed.learn(ToyTraffic(steps=30), 2, 1, lambda episode, _: seen.append(episode))
    assert seen == [2, 3]
    assert states_equal(whole, begun) and states_equal(whole, resumed)
    other = IPPO(env, config)
    other.learn(env, 4, 2)
    assert not states_equal(whole, other)


def test_a_learner_that_has_not_learned_is_saved_too(tmp_path: Path) -> None:
    env = ToyTraffic(steps=30)
    fresh, loaded = IPPO(env, Config(**QUICK)), IPPO(env, Config(**QUICK), seed=5)
    fresh.save(tmp_path / "learner.pt")
    loaded.load(tmp_path / "learner.pt")
    for learner in (fresh, loaded):
        learner.learn(env, 1, 1)
    assert states_equal(fresh, loaded)


@pytest.mark.parametrize(
    ("equal", "changes", "word"),
    [
        (True, {}, "agents"),
        (False, {"hidden": (8,)}, "hidden"),
        (False, {"shared": False}, "shared"),
        (False, {"centralised": True}, "centralised"),
    ],
)
def test_a_checkpoint_of_another_learner_is_refused(
    equal: bool, changes: dict[str, Any], word: str, tmp_path: Path
) -> None:
    IPPO(ToyTraffic(), Config(**QUICK)).save(tmp_path / "learner.pt")
    learner, same = (IPPO(ToyTraffic(equal=equal), Config(**QUICK | changes)) for _ in range(2))
    with pytest.raises(CheckpointError, match=f"{word} is"):
        learner.load(tmp_path / "learner.pt")
    assert states_equal(learner, same)
    learner.policy().save(tmp_path / "policy.pt")
    with pytest.raises(CheckpointError, match="expected"):
        learner.load(tmp_path / "policy.pt")


@pytest.mark.parametrize(
    ("name", "value"),
    [("weights", None), ("rewards", None), ("episodes", torch.zeros(900))],
)
def test_the_refusal_of_a_damaged_checkpoint_is_one_line(
    name: str, value: Any, tmp_path: Path
) -> None:
    file = tmp_path / "learner.pt"
    learner = IPPO(ToyTraffic(), Config(hidden=(4,)))  # few enough to be printed whole
    learner.save(file)
    torch.save(torch.load(file, weights_only=True) | {name: value}, file)
    with pytest.raises(CheckpointError, match=f"{name} is") as refusal:
        learner.load(file)
    assert len(str(refusal.value)) < 300 and "\n" not in str(refusal.value)


def test_it_keeps_the_protocols_and_its_policies_conform(tmp_path: Path) -> None:
    env = ToyTraffic()
    learner = IPPO(env, Config(**QUICK))
    policy = learner.learn(env, 1, 1)
    assert isinstance(learner, Learner) and isinstance(policy, Policy)
    assert not failed_checks(check_policy(policy, ToyTraffic))
    before = policy.parameters
    learner.learn(env, 1, 1)
    assert np.array_equal(policy.parameters, before)
    assert not np.array_equal(learner.policy().parameters, before)


@pytest.mark.parametrize("centralised", [False, True])
def test_it_trains_in_a_grounded_environment(centralised: bool) -> None:
    env = ToyTraffic()
    transform = PhaseTransform(env.layouts, 0, gate=GateConfig(mode="infinite"))
    transform.forward.fitted.fill_(True)
    transform.inverse.fitted.fill_(True)
    learner = IPPO(env, Config(**QUICK, centralised=centralised))
    returns: list[float] = []
    learner.learn(GroundedEnv(env, transform), 2, 1, lambda _, told: returns.append(told["return"]))
    assert learner.episodes == len(returns) == 2 and np.isfinite(returns).all()


def test_rewards_are_scaled_by_all_seen_so_far() -> None:
    learner = IPPO(ToyTraffic(equal=True), Config(**QUICK))
    rewards = torch.tensor([[-4.0, -2.0, 0.0, -10.0], [1.0, 1.0, 1.0, 1.0]])
    learner._reward_scale(rewards[:, :3])
    centre, scale = learner._reward_scale(rewards[:, 3:])
    assert centre.flatten().tolist() == [-4.0, 1.0]
    assert scale.flatten().tolist() == pytest.approx([1 / np.std([-4, -2, 0, -10]), 1.0])


def test_the_step_size_anneals_to_nothing() -> None:
    env = ToyTraffic()
    learner = IPPO(env, Config(**QUICK, anneal_episodes=2))
    weights: list[torch.Tensor] = []
    for _ in range(3):
        learner.learn(env, 1, 1)
        weights.append(learner._weights.detach().clone())
    assert not torch.equal(weights[0], weights[1])
    assert torch.equal(weights[1], weights[2])


@pytest.mark.parametrize(
    "wrong",
    [
        {"discount": 1.0},
        {"gae_lambda": 1.1},
        {"clip": -0.2},
        {"epochs": 0},
        {"hidden": (8, 0)},
        {"clip": float("inf")},
        {"reward_scale": 0.0},
        {"learning_rate": 0.0},
    ],
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=f"{next(iter(wrong))} = "):
        Config(**wrong)


def test_what_it_cannot_learn_in_is_refused() -> None:
    with pytest.raises(OptionError, match="state_space"):
        IPPO(PaidEnv(), Config(centralised=True))
    with pytest.raises(OptionError, match="this learner's"):
        IPPO(ToyTraffic(), Config()).learn(ToyTraffic(equal=True), 1, 1)
    broken = PaidEnv(reward=float("nan"))
    with pytest.raises(EpisodeError, match="not finite"):
        IPPO(broken, Config()).learn(broken, 1, 1)


@pytest.mark.parametrize(("scenario", "centralised"), [("grid2x2-v1", False), ("mixed-v1", True)])
def test_it_trains_on_roads(scenario: str, centralised: bool, tmp_path: Path) -> None:
    config = Config(**QUICK, centralised=centralised)
    args = ippo.Args(
        ppo=config,
        scenario=scenario,
        duration_s=60,
        episodes=2,
        evaluate_every=1,
        evaluation_seeds=1,
        out=tmp_path,
    )
    result = ippo.train(args)
    assert len(result.returns) == 2
    assert list(result.att_s) == [1, 2]
    assert all(0 < value < 120 for values in result.att_s.values() for value in values)
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["returns"] == result.returns and told["args"]["scenario"] == scenario
    policy = NetworkPolicy.load(tmp_path / "policy.pt")
    assert np.array_equal(policy.parameters, result.policy.parameters)
    env = ugat_marl.parallel_env(scenario, duration_s=60, **policy.env_options)
    learner = IPPO(env, config)
    learner.load(tmp_path / "learner.pt")
    assert learner.episodes == 2


def test_the_command_says_what_is_wrong_in_a_line(python: list[str]) -> None:
    command = [*python, str(FILE), "--scenario", "grid9x9-v1", "--centralised"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode and not done.stdout
    assert done.stderr.startswith("ippo.py: error: ") and done.stderr.count("\n") == 1


def test_a_baseline_is_a_file_to_be_read_in_one_sitting() -> None:
    for path in FILE.parent.glob("*.py"):
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 350, path.name
        assert f"`{path.name}`" in (FILE.parent / "README.md").read_text(encoding="utf-8")
