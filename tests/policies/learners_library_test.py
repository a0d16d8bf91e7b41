"""What stands between a library and the suite: seeds, rewards, masks, policies."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tests.runs import q_values
from ugat_marl.envs import AgentSet, agent_indicator, appended_mask, pad_spaces, parallel_env
from ugat_marl.errors import ActionError, CheckpointError, EpisodeError, OptionError
from ugat_marl.policies import (
    InputScale,
    LibraryLearner,
    TrainingEnv,
    check_settings,
    decisions_per_episode,
    linear_layers,
    observation_mask,
    perceptron,
    preserve_random_state,
    roll_out_length,
    seed_generators,
)
from ugat_marl.policies.learners.library import policy_of
from ugat_marl.policies.learners.scaling import LEAST, RewardScale
from ugat_marl.seeding import derive_seed
from ugat_marl.testing import ToyTraffic


class Still(LibraryLearner):
    """Plays phase 0, or what it is told, and learns nothing."""

    def __init__(self, env: Any, action: int = 0) -> None:
        super().__init__(env, "test.still")
        self.action = action
        self.seen: list[Any] = []
        width = self.agents.widest_observation + len(self.agents)
        self.network = perceptron(width, (4,), self.agents.most_actions)

    def _train(self, env: TrainingEnv, episodes: int, seed: int) -> None:
        for _ in range(episodes):
            observations, _ = env.reset(seed=99)
            self.seen.append(observations)
            while env.agents:
                out = env.step(dict.fromkeys(self.agents.names, self.action))
                self.seen.append(out)

    def _actors(self) -> Any:
        return [linear_layers(self.network)]

    def _networks(self) -> Any:
        return self.network.state_dict()

    def _rest(self) -> dict[str, Any]:
        return {"action": self.action}

    def _restore(self, networks: Any, rest: Any) -> None:
        self.network.load_state_dict(networks)
        self.action = rest["action"]


class Leaving(ToyTraffic):
    """Loses an agent in its third step."""

    def step(self, actions: Any) -> Any:
        found = super().step(actions)
        self.agents = self.agents[: 3 if self._step < 3 else 1]
        return found


def test_a_shared_network_is_read_out_agent_by_agent() -> None:
    agents = AgentSet.of(ToyTraffic())
    network = perceptron(agents.widest_observation + len(agents), (8, 5), agents.most_actions)
    policy = policy_of(agents, [linear_layers(network)], {"observation": "queue"})
    assert policy.shared and policy.hidden == (8, 5)
    observations, _ = ToyTraffic().reset(seed=1)
    values = q_values(policy, {name: vector + 0.3 for name, vector in observations.items()})
    for row, (name, vector) in enumerate(observations.items()):
        seen = torch.zeros(agents.widest_observation + 3)
        seen[: vector.size] = torch.from_numpy(vector + 0.3)
        seen[agents.widest_observation + row] = 1
        expected = network(seen)[: values[name].size].detach().numpy()
        assert np.allclose(values[name], expected, atol=1e-6), name


@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("hidden", [(8, 5), ()])
def test_own_networks_are_read_out_too(padded: bool, hidden: tuple[int, ...]) -> None:
    agents = AgentSet.of(ToyTraffic())
    sizes = zip(agents.observation_sizes, agents.action_counts, strict=True)
    networks = [
        perceptron(agents.widest_observation if padded else n_in, hidden, n_out)
        for n_in, n_out in sizes
    ]
    policy = policy_of(agents, [linear_layers(network) for network in networks], {})
    assert not policy.shared
    observations, _ = ToyTraffic().reset(seed=1)
    values = q_values(policy, observations)
    for network, (name, vector) in zip(networks, observations.items(), strict=True):
        layer = linear_layers(network)[0]
        seen = nn.functional.pad(torch.from_numpy(vector), (0, layer.in_features - vector.size))
        assert np.allclose(values[name], network(seen).detach().numpy(), atol=1e-6), name


def test_networks_of_other_sizes_are_refused() -> None:
    agents = AgentSet.of(ToyTraffic())
    network = linear_layers(perceptron(agents.widest_observation, (4,), agents.most_actions))
    with pytest.raises(ValueError, match="2 networks for 3 agents"):
        policy_of(agents, [network, network], {})


def test_one_network_of_a_single_agent_is_its_own_or_told_whose_it_is() -> None:
    env = parallel_env("single-v1")
    agents = AgentSet.of(env)
    for extra, shared in ((0, False), (1, True)):
        network = perceptron(agents.widest_observation + extra, (4,), agents.most_actions)
        assert policy_of(agents, [linear_layers(network)], {}).shared is shared


def test_rewards_are_scaled_by_all_seen_so_far() -> None:
    scale = RewardScale(2)
    rewards = np.array([[-4.0, 1.0], [-2.0, 1.0], [0.0, 1.0], [-10.0, 1.0]], dtype=np.float32)
    found = [scale(row) for row in rewards]
    assert found[0].tolist() == [0.0, 0.0]
    assert found[-1] == pytest.approx([(-10 + 4) / np.std([-4, -2, 0, -10]), 0.0])
    assert scale.sums[0].tolist() == [4.0, 4.0]


def test_what_is_seen_is_divided_by_its_size_so_far() -> None:
    scale = InputScale(3)
    assert scale.factors.tolist() == [1, 1, 1]
    there = np.array([[True, True, True], [True, False, True]])
    scale.note(np.array([[3, 0.5, 0], [4, 9, 0]], dtype=np.float32), there)
    assert scale.sums.tolist() == [[2, 1, 2], [25, 0.25, 0]]
    assert scale.factors == pytest.approx([1 / np.sqrt(12.5), 2, 1 / LEAST])
    agents = AgentSet.of(ToyTraffic())
    assert observation_mask(agents).sum(1).tolist() == list(agents.observation_sizes)
    assert observation_mask(agents)[:, : min(agents.observation_sizes)].all()


def test_libraries_see_scaled_numbers_and_policies_plain_ones() -> None:
    env = ToyTraffic()
    learner = Still(env)
    learner.learn(env, 2, 5)
    factors = learner.inputs.factors
    assert factors.min() > 1 and factors.max() > 2
    world = TrainingEnv(env, learner, 5)
    seen, _ = world.reset()
    plain, _ = ToyTraffic().reset(seed=derive_seed(5, "learner", "episode", 2))
    for name, vector in plain.items():
        assert np.array_equal(seen[name], vector * factors[: vector.size])
    assert np.array_equal(world.state(), env.state() * learner.states.factors)
    # the network reads scaled numbers, the policy reads them as they are
    values = q_values(learner.policy(), plain)
    shown, _ = agent_indicator(pad_spaces(world)).reset()
    for name, vector in shown.items():
        wanted = learner.network(torch.from_numpy(vector)).detach().numpy()
        assert np.allclose(values[name], wanted[: len(values[name])], atol=1e-5)


def test_the_number_of_an_episode_decides_its_seed() -> None:
    one, other = Still(ToyTraffic()), Still(ToyTraffic())
    numbers: list[tuple[int, float]] = []
    one.learn(ToyTraffic(), 3, 5, lambda number, told: numbers.append((number, told["return"])))
    other.learn(ToyTraffic(), 1, 5)
    other.learn(ToyTraffic(), 2, 5)
    firsts = [[seen for seen in learner.seen if isinstance(seen, dict)] for learner in (one, other)]
    assert [n for n, _ in numbers] == [0, 1, 2] and len({told for _, told in numbers}) == 3
    rewards = [[out[1] for out in who.seen if isinstance(out, tuple)] for who in (one, other)]
    assert rewards[0] == rewards[1] and len(firsts[0]) == len(firsts[1]) == 3
    again = Still(ToyTraffic())
    again.learn(ToyTraffic(), 3, 6)
    assert [out[1] for out in again.seen if isinstance(out, tuple)] != rewards[0]


def test_returns_are_those_of_the_environment() -> None:
    env = ToyTraffic()
    paid: list[float] = []
    step = env.step

    def noting(actions: Any) -> Any:
        found = step(actions)
        paid.append(sum(found[1].values()) / 3)
        return found

    env.step = noting
    told: list[float] = []
    Still(env).learn(env, 1, 5, lambda _, numbers: told.append(numbers["return"]))
    assert told == [pytest.approx(sum(paid))] and told[0] < -1


@pytest.mark.parametrize(("action", "agent"), [(2, "tee_0"), (3, "cross_0"), (-1, "cross_0")])
def test_what_is_masked_or_does_not_exist_is_refused(action: int, agent: str) -> None:
    env = ToyTraffic()  # the tee has two phases
    with pytest.raises(ActionError, match=f"action {action} for {agent}"):
        Still(pad_spaces(env), action).learn(pad_spaces(env), 1, 1)


def test_agents_have_to_stay() -> None:
    with pytest.raises(EpisodeError, match="all agents have to stay"):
        Still(ToyTraffic()).learn(Leaving(), 1, 1)


def test_checkpoints_of_others_are_refused_and_change_nothing(tmp_path: Any) -> None:
    learner = Still(ToyTraffic(), 1)
    learner.learn(ToyTraffic(), 2, 1)
    learner.save(tmp_path / "learner.pt")
    fresh = Still(ToyTraffic())
    fresh.load(tmp_path / "learner.pt")
    assert (fresh.episodes, fresh.action) == (2, 1)
    assert np.array_equal(fresh.rewards.sums, learner.rewards.sums)
    assert np.array_equal(fresh.policy().parameters, learner.policy().parameters)
    single = Still(parallel_env("single-v1"))
    with pytest.raises(CheckpointError, match="agents"):
        single.load(tmp_path / "learner.pt")
    assert single.episodes == 0
    learner.policy().save(tmp_path / "policy.pt")
    with pytest.raises(CheckpointError, match="expected"):
        fresh.load(tmp_path / "policy.pt")


@pytest.mark.parametrize(
    ("decisions", "least", "wanted"),
    [(360, 120, 120), (40, 120, 40), (127, 120, 127), (100, 30, 50), (90, 1, 1), (7, 2, 7)],
)
def test_roll_outs_divide_an_episode(decisions: int, least: int, wanted: int) -> None:
    assert roll_out_length(decisions, least) == wanted


def test_decisions_are_known_or_counted() -> None:
    assert decisions_per_episode(ToyTraffic(steps=17)) == 17
    assert decisions_per_episode(parallel_env("single-v1", duration_s=120)) == 12


def test_global_generators_are_lent_only() -> None:
    def drawn() -> tuple[float, float, float]:
        return float(torch.rand(1)), float(np.random.random()), random.random()  # noqa: NPY002

    seed_generators(1, "a")
    first = drawn()
    seed_generators(1, "a")
    with preserve_random_state():
        assert drawn() == first
        seed_generators(1, "b")
        assert drawn() != first
    assert drawn() == first


@pytest.mark.parametrize(
    "wrong",
    [
        {"discount": 1.0},
        {"discount": 1.1},
        {"epochs": 0},
        {"hidden": (3, 0)},
        {"rate": -1.0},
        {"rate": float("inf")},
        {"learning_rate": 0.0},
    ],
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    class Settings:
        def __init__(self, **given: Any) -> None:
            sound = {
                "discount": 0.9,
                "epochs": 1,
                "hidden": (3,),
                "rate": 2.0,
                "learning_rate": 0.1,
                "kind": "a",
                "on": False,
            }
            vars(self).update(sound | given)

    check_settings(Settings())
    with pytest.raises(OptionError, match=next(iter(wrong))):
        check_settings(Settings(**wrong))
    with pytest.raises(OptionError, match="rate"):
        check_settings(Settings(), "rate")


def test_masks_are_appended_inside_their_bounds() -> None:
    env = appended_mask(pad_spaces(ToyTraffic()))
    observations, infos = env.reset(seed=1)
    for agent, vector in observations.items():
        assert env.observation_space(agent).contains(vector) and vector.dtype == np.float32
        assert vector[-3:].tolist() == infos[agent]["action_mask"].tolist()
    assert observations["tee_0"][-3:].tolist() == [1, 1, 0]
    assert env.observation_space("cross_0") is env.observation_space("tee_0")
    own = appended_mask(ToyTraffic())
    assert own.observation_space("tee_0").shape == (3 + 2 + 2,)
