"""The learners of other libraries: each against tasks whose optimum is known, and itself.

A learner whose library is not installed is skipped; `make compat` installs them all.
"""

from __future__ import annotations

import importlib.util
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

from ugat_marl.envs import parallel_env
from ugat_marl.errors import ActionError, CheckpointError, EpisodeError, OptionError
from ugat_marl.experiments import policy_factory
from ugat_marl.grounding import GateConfig, GroundedEnv, PhaseTransform
from ugat_marl.policies import (
    BASELINES,
    Learner,
    NetworkPolicy,
    Policy,
    learner_factory,
    load_baseline,
)
from ugat_marl.policies.learners.catalogue import baselines_folder
from ugat_marl.testing import ToyTraffic, check_policy, failed_checks

if not baselines_folder().is_dir():
    pytest.skip("baselines/ is neither here nor in the package", allow_module_level=True)

LIBRARIES = {
    "sb3": "sb3_contrib",
    "torchrl": "torchrl",
    "skrl": "skrl",
    "benchmarl": "benchmarl",
    "rllib": "ray",
}
PPO = ("hidden=32,32", "learning_rate=3e-3", "epochs=4")
VALUES = ("hidden=32,32", "learning_rate=3e-3", "replay=2000", "explore=400", "target_rate=0.05")
SETTINGS = {
    "sb3-ppo": (*PPO, "update_every=20", "minibatch=10"),
    "maskable-ppo": (*PPO, "update_every=20", "minibatch=10"),
    "sb3-dqn": (*VALUES, "warmup=40", "batch=64"),
    "supersuit-ppo": (*PPO, "update_every=20", "minibatch=10"),
    "torchrl-mappo": (*PPO, "update_every=20", "minibatch=10"),
    "skrl-ippo": (*PPO, "update_every=20", "minibatches=2"),
    "skrl-mappo": (*PPO, "update_every=20", "minibatches=2"),
    "qmix": (*VALUES, "update_every=10", "updates=10", "batch=32"),
    "vdn": (*VALUES, "update_every=10", "updates=10", "batch=32"),
    "rllib-ppo": (*PPO, "minibatch=2"),
}
NAMES = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(
            importlib.util.find_spec(LIBRARIES[BASELINES[name].extra]) is None,
            reason=f"{LIBRARIES[BASELINES[name].extra]} is not installed",
        ),
    )
    for name in SETTINGS
    if name in BASELINES
]
CHANCE = np.random.default_rng(3)
every = pytest.mark.parametrize("name", NAMES)


class PaidEnv(ParallelEnv[str, Any, Any]):
    """Four decisions, each paid 1; agents see which is next, in a circle."""

    metadata: ClassVar = {"name": "paid", "is_parallelizable": True, "render_modes": []}
    render_mode = None

    def __init__(self, reward: float = 1.0, agents: int = 1) -> None:
        self.possible_agents, self.agents = [f"signal_{i}" for i in range(agents)], list[str]()
        self.reward = reward
        self.state_space = spaces.Box(0, 1, (4 * agents,), np.float32)
        self.observation_spaces = self._each(spaces.Box(0, 1, (4,), np.float32))
        self.action_spaces = self._each(spaces.Discrete(2))

    def observation_space(self, agent: str) -> Any:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.agents, self.time = list(self.possible_agents), 0
        return self._observe(), self._each({})

    def step(self, actions: dict[str, int]) -> Any:
        self.time += 1
        over = self.time == 4
        if over:
            self.agents = []
        ends = self._each(False), self._each(over)
        return self._observe(), self._each(self.reward), *ends, self._each({})

    def state(self) -> Any:
        return np.concatenate(list(self._observe().values()))

    def _observe(self) -> dict[str, Any]:
        return self._each(np.eye(4, dtype=np.float32)[self.time % 4])

    def _each(self, value: Any) -> dict[str, Any]:
        return dict.fromkeys(self.possible_agents, value)


def made(name: str, env: Any, *settings: str, seed: int = 0) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return learner_factory(name, (*SETTINGS[name], *settings))(env, seed)


def play(env: ToyTraffic, act: Callable[[Any, Any], dict[str, int]], episodes: int = 10) -> float:
    """Mean over episodes of the sum of rewards, mean over agents."""
    total = 0.0
    for seed in range(1000, 1000 + episodes):
        observations, infos = env.reset(seed=seed)
        while env.agents:
            observations, rewards, _, _, infos = env.step(act(observations, infos))
            total += sum(rewards.values()) / len(rewards)
    return total / episodes


def greedily(observations: Any, infos: Any) -> dict[str, int]:
    """The phase that lets most vehicles go, the longer queues where that is equal."""
    chosen: dict[str, int] = {}
    for agent, vector in observations.items():
        count = len(infos[agent]["action_mask"])
        queues = vector[: vector.size - count] * 20
        pairs = [queues[phase : phase + 2] for phase in range(count)]
        gains = [np.minimum(pair, 3).sum() + 1e-3 * pair.sum() for pair in pairs]
        chosen[agent] = int(np.argmax(gains))
    return chosen


def at_random(observations: Any, infos: Any) -> dict[str, int]:
    """Any phase."""
    return {agent: int(CHANCE.integers(len(infos[agent]["action_mask"]))) for agent in observations}


def same(one: Any, other: Any) -> bool:
    """Whether two states are the same, to the bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def state_of(learner: Any) -> dict[str, Any]:
    return {"networks": dict(learner._networks()), "rest": learner._rest()}


@pytest.mark.slow
@every
@pytest.mark.parametrize("equal", [True, False], ids=["equal", "unequal"])
def test_it_learns(name: str, equal: bool) -> None:
    env = ToyTraffic(steps=40, arrivals=0.7, equal=equal)
    policy = made(name, env).learn(env, 30, 1)
    random, greedy = play(env, at_random), play(env, greedily)
    assert play(env, policy.act) > greedy + 0.3 * (random - greedy)


@every
def test_masks_are_kept(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = ToyTraffic(steps=30, masked=True)
    step, steps = env.step, list[Any]()

    def counted(actions: Any) -> Any:
        found = step(actions)  # a forbidden phase is an error
        steps.append(actions)
        return found

    monkeypatch.setattr(env, "step", counted)
    policy = made(name, env).learn(env, 3, 1)
    assert len(steps) >= 90
    play(env, policy.act, 2)
    with pytest.raises(ActionError, match="forbidden"):
        play(env, at_random, 1)


@every
def test_two_calls_are_one_call_also_over_a_file(name: str, tmp_path: Path) -> None:
    env = ToyTraffic(steps=20, masked=True)
    whole, parts = (made(name, env) for _ in range(2))
    first: list[float] = []
    whole.learn(env, 4, 5, lambda _, told: first.append(told["return"]))
    second: list[tuple[int, float]] = []
    parts.learn(env, 2, 5, lambda number, told: second.append((number, told["return"])))
    parts.save(tmp_path / "learner.pt")
    resumed = made(name, env, seed=9)
    assert not np.array_equal(resumed.policy().parameters, parts.policy().parameters)
    resumed.load(tmp_path / "learner.pt")
    assert same(state_of(resumed), state_of(parts))
    torch.rand(3)  # what others draw does not matter
    resumed.learn(env, 2, 5, lambda number, told: second.append((number, told["return"])))
    assert second == list(enumerate(first))
    assert np.array_equal(whole.policy().parameters, resumed.policy().parameters)
    assert resumed.episodes == whole.episodes == 4
    assert np.array_equal(resumed.rewards.sums, whole.rewards.sums)
    other = made(name, env)
    other.learn(env, 4, 6)
    assert not np.array_equal(whole.policy().parameters, other.policy().parameters)


@every
def test_what_others_draw_is_left_as_it_was(name: str) -> None:
    env = ToyTraffic()
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    made(name, env).learn(env, 1, 1)
    assert torch.equal(torch.rand(2), expected)


@every
def test_training_leaves_no_temporary_files(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    env = ToyTraffic()
    made(name, env).learn(env, 1, 1)
    assert not [*tmp_path.iterdir()]


@every
def test_it_keeps_the_protocols_and_its_policies_conform(name: str, tmp_path: Path) -> None:
    env = ToyTraffic()
    learner = made(name, env)
    policy = learner.learn(env, 1, 1)
    assert isinstance(learner, Learner) and isinstance(policy, Policy)
    assert not failed_checks(check_policy(policy, ToyTraffic))
    before = policy.parameters
    learner.learn(env, 6, 1)
    assert np.array_equal(policy.parameters, before)
    assert not np.array_equal(learner.policy().parameters, before)
    policy.save(tmp_path / "policy.pt")
    assert np.array_equal(NetworkPolicy.load(tmp_path / "policy.pt").parameters, before)


@every
def test_it_trains_in_a_grounded_environment(name: str) -> None:
    env = ToyTraffic()
    transform = PhaseTransform(env.layouts, 0, gate=GateConfig(mode="infinite"))
    transform.forward.fitted.fill_(True)
    transform.inverse.fitted.fill_(True)
    learner = made(name, env)
    returns: list[float] = []
    learner.learn(env, 1, 1)
    learner.learn(GroundedEnv(env, transform), 2, 1, lambda _, told: returns.append(told["return"]))
    learner.learn(env, 1, 1)
    assert len(returns) == 2 and learner.episodes == 4 and np.isfinite(returns).all()


@every
def test_what_it_cannot_learn_in_is_refused(name: str, tmp_path: Path) -> None:
    learner = made(name, ToyTraffic())
    with pytest.raises(OptionError, match="this learner's"):
        learner.learn(ToyTraffic(equal=True), 1, 1)
    broken = PaidEnv(reward=float("nan"))
    with pytest.raises(EpisodeError, match="not finite"):
        made(name, broken).learn(broken, 1, 1)
    learner.save(tmp_path / "learner.pt")
    for changed in (made(name, ToyTraffic(equal=True)), made(name, ToyTraffic(), "hidden=8")):
        before = state_of(changed)
        with pytest.raises(CheckpointError, match=r"learner\.pt"):
            changed.load(tmp_path / "learner.pt")
        assert same(state_of(changed), before)
    with pytest.raises(OptionError, match="discount"):
        made(name, ToyTraffic(), "discount=1")


def value_of(name: str, learner: Any) -> list[float]:
    """What the learner holds the four observations of `PaidEnv` to be worth."""
    scale = learner.states if name == "torchrl-mappo" else learner.inputs
    eye, agent, mask = (
        torch.diag(torch.from_numpy(scale.factors)),
        torch.ones(4, 1),
        torch.ones(4, 2),
    )
    if name in ("sb3-ppo", "maskable-ppo", "supersuit-ppo"):
        seen = [eye, agent] if name == "maskable-ppo" else [eye, agent, mask]
        values = learner._model.policy.predict_values(torch.cat(seen, 1))
    elif name == "sb3-dqn":
        values = learner._model.q_net(torch.cat([eye, agent, mask], 1)).max(1).values
    elif name == "torchrl-mappo":
        values = learner._critic(eye)
    elif name.startswith("skrl"):
        critic = learner._models["signal"]["value"]
        state = torch.diag(torch.from_numpy(learner.states.factors))
        seen = [eye, mask, state] if name == "skrl-mappo" else [eye, mask]
        values = critic.network(torch.cat(seen, 1))
    elif name == "rllib-ppo":
        module = learner._learner.module["signal"].unwrapped()
        batch = {"obs": {"observations": torch.cat([eye, agent], 1), "action_mask": mask}}
        values = module.compute_values(batch)
    else:  # VDN's sum of one agent's values is its own
        ((first, *rest),) = learner._actors()
        values = first(torch.cat([eye, agent], 1))
        for layer in rest:
            values = layer(values.relu())
        values = values.max(1).values
    return values.flatten().tolist()


@pytest.mark.slow
@pytest.mark.parametrize("name", [item for item in NAMES if item.values[0] != "qmix"])
def test_values_bootstrap_where_an_episode_is_cut_off(name: str) -> None:
    env = PaidEnv()
    learner = made(
        name,
        env,
        "discount=0.5",
        *(["least_exploration=1"] if "explore=400" in SETTINGS[name] else []),
    )
    learner.rewards = lambda paid: paid.astype(float)  # as they are
    learner.learn(env, 150, 1)
    # paid for ever: 1 / (1 - 0.5); SuperSuit says that the end is the end
    wanted = [1.875, 1.75, 1.5, 1.0] if name == "supersuit-ppo" else [2.0, 2.0, 2.0, 2.0]
    assert value_of(name, learner) == pytest.approx(wanted, abs=0.2)


@pytest.mark.skipif(importlib.util.find_spec("benchmarl") is None, reason="no BenchMARL")
def test_qmix_begins_as_a_sum_over_its_agents() -> None:
    learner = made("qmix", PaidEnv(agents=16), "mixing=32")
    loss, draws = learner._loss, torch.Generator().manual_seed(0)
    values = torch.randn(200, 16, 1, generator=draws)
    states = torch.randn(200, 64, generator=draws)
    for parameters in (loss.mixer_network_params, loss.target_mixer_network_params):
        with torch.no_grad(), parameters.to_module(loss.mixer_network):
            mixed = loss.mixer_network.module(values, states).flatten()
        line = np.polyfit(values.sum((1, 2)).numpy(), mixed.numpy(), 1)
        assert line == pytest.approx([1.0, 0.0], abs=0.5), "slope and level"


# skrl updates agent by agent
@pytest.mark.parametrize("name", [item for item in NAMES if "skrl" not in str(item.values[0])])
def test_more_agents_are_no_more_gradient_steps(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    step, steps = torch.optim.Adam.step, list[int]()

    def counted(*args: Any, **options: Any) -> Any:
        steps[-1] += 1
        return step(*args, **options)

    monkeypatch.setattr(torch.optim.Adam, "step", counted)
    for agents in (1, 3):
        env = PaidEnv(agents=agents)
        learner = made(name, env)
        steps.append(0)
        learner.learn(env, 24, 1)  # more than the decisions for which DQN waits
    assert steps[0] == steps[1] > 0


@every
@pytest.mark.parametrize("scenario", ["grid2x2-v1", "mixed-v1"])
def test_it_trains_on_roads(name: str, scenario: str, tmp_path: Path) -> None:
    module: Any = load_baseline(name)
    settings = made(name, ToyTraffic()).config
    (field,) = {item.name for item in module.Args.__dataclass_fields__.values()} - set(
        module.BaselineArgs.__dataclass_fields__
    )
    args = module.Args(
        scenario=scenario, duration_s=60, episodes=2, evaluation_seeds=1, out=tmp_path,
        **{field: settings},
    )  # fmt: skip
    result = module.train(args)
    assert len(result.returns) == 2
    assert list(result.att_s) == [2] and np.isfinite(result.att_s[2]).all()
    assert {path.name for path in tmp_path.iterdir()} == {"policy.pt", "learner.pt", "result.json"}
    env = parallel_env(scenario)
    assert policy_factory(str(tmp_path / "policy.pt"))(env)
