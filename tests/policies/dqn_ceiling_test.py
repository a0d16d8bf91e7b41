"""Policies that act in fuller streets than they know as in the fullest they know."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.policies.dqn_test import QUICK
from tests.runs import q_values
from ugat_marl.envs import AgentSet
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.policies import DQN, NetworkPolicy
from ugat_marl.policies.export import NumpyPolicy, portable_network
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.learners.replay import ReplayBuffer
from ugat_marl.policies.learners.scaling import ceilings
from ugat_marl.testing import ToyTraffic

AGENTS = AgentSet(("wide", "narrow"), (3, 2), (4, 2))
CEILING = np.float32([[0.5, 0.2, 1.0], [0.1, 0.4, 0.0]])
HELD = replace(QUICK, ceiling=0.9)


def policy_of(
    ceiling: Any = None, hidden: tuple[int, ...] = (16,), shared: bool = False, seed: int = 3
) -> NetworkPolicy:
    size = DQN(AGENTS, DQNConfig(hidden=hidden, shared=shared)).policy().parameters.size
    weights = np.random.default_rng(seed).normal(size=size).astype(np.float32)
    return NetworkPolicy(AGENTS, hidden, weights, {}, shared, None, ceiling)


def seen(wide: list[float], narrow: list[float]) -> dict[str, NDArray[np.float32]]:
    return {"wide": np.array(wide, np.float32), "narrow": np.array(narrow, np.float32)}


def test_beyond_the_ceiling_everything_looks_the_same() -> None:
    held, plain = policy_of(CEILING), policy_of()
    full, at_the_ceiling = seen([9, 7, 0.3], [5, 6]), seen([0.5, 0.2, 0.3], [0.1, 0.4])
    below = seen([0.4, -2, 0.9], [0.05, 0.3])
    for name in AGENTS.names:
        own = q_values(held, full)[name]
        assert np.array_equal(own, q_values(plain, at_the_ceiling)[name])
        assert not np.allclose(own, q_values(plain, full)[name])
        assert np.array_equal(q_values(held, below)[name], q_values(plain, below)[name])
    rng = np.random.default_rng(0)
    turned = 0
    for seed in range(100):
        held, plain = policy_of(CEILING, seed=seed), policy_of(seed=seed)
        observations = seen(rng.uniform(0, 3, 3).tolist(), rng.uniform(0, 3, 2).tolist())
        clipped = {
            name: np.minimum(numbers, CEILING[row, : numbers.size])
            for row, (name, numbers) in enumerate(observations.items())
        }
        actions = held.act(observations, {})
        assert actions == plain.act(clipped, {})
        turned += actions != plain.act(observations, {})
    assert turned > 10  # it is not that the ceiling decides nothing


def test_it_survives_file_and_pickle(tmp_path: Path) -> None:
    held = policy_of(CEILING)
    held.save(tmp_path / "policy.pt")
    for copy in (NetworkPolicy.load(tmp_path / "policy.pt"), pickle.loads(pickle.dumps(held))):  # noqa: S301
        assert copy.ceiling is not None and np.array_equal(copy.ceiling, CEILING)
    policy_of().save(tmp_path / "plain.pt")
    assert NetworkPolicy.load(tmp_path / "plain.pt").ceiling is None


def test_a_ceiling_of_other_agents_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="ceiling of shape"):
        policy_of(CEILING[:1])
    held = policy_of(CEILING)
    held._ceiling = torch.zeros(1, 3)
    held.save(tmp_path / "policy.pt")
    with pytest.raises(CheckpointError, match="ceiling of shape"):
        NetworkPolicy.load(tmp_path / "policy.pt")


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("hidden", [(16, 8), (8,), ()])
def test_exported_it_is_a_layer_more(hidden: tuple[int, ...], shared: bool) -> None:
    held = policy_of(CEILING, hidden, shared)
    exported = NumpyPolicy(AGENTS, portable_network(held), {})
    rng = np.random.default_rng(1)
    for _ in range(50):
        observations = seen(rng.uniform(-1, 3, 3).tolist(), rng.uniform(-1, 3, 2).tolist())
        values = exported.values(AGENTS.stack(observations))
        for row, own in zip(values, q_values(held, observations).values(), strict=True):
            np.testing.assert_allclose(row[: own.size], own, rtol=1e-4, atol=1e-4)


def test_ceilings_by_hand() -> None:
    """Agent by agent and place by place; what is hardly ever more than its least keeps its most."""
    counts = torch.arange(101.0)
    phase = (counts > 99.5).float()  # chosen once in 101 decisions
    never = torch.zeros(101)
    columns = torch.stack(
        [torch.stack([counts, phase, never], 1), torch.stack([2 * counts] * 3, 1)]
    )
    found = ceilings(columns, 0.9)
    assert found.dtype == torch.float32
    assert found.tolist() == [[90, 1, 0], [180, 180, 180]]
    assert ceilings(columns, 1.0).tolist() == [[100, 1, 0], [200, 200, 200]]


def test_recent_decisions_are_the_last_ones_of_the_ring() -> None:
    replay = ReplayBuffer(AgentSet(("a",), (1,), (2,)), 4)
    one = np.zeros(1, np.int64)
    for i in range(6):
        row = np.full((1, 1), i, np.float32)
        replay.add(row, one, row[0], one > 0, row, np.ones((1, 2), bool))
        if i == 1:
            assert replay.recent(3).flatten().tolist() == [0, 1]
    assert replay.recent(3).flatten().tolist() == [3, 4, 5]
    assert replay.recent(9).flatten().tolist() == [2, 3, 4, 5]


def test_a_learner_hands_out_what_it_has_seen() -> None:
    env = ToyTraffic(steps=30)
    learner = DQN.of(env, HELD)
    assert learner.policy().ceiling is None  # nothing is known yet
    policy = learner.learn(env, 3, seed=1)
    rows = learner._replay.observations()
    assert policy.ceiling is not None
    assert policy.ceiling == pytest.approx(ceilings(rows, 0.9).numpy())
    assert (torch.from_numpy(policy.ceiling) < rows.amax(dim=1)).any()
    plain = DQN.of(env, QUICK)
    trained = plain.learn(ToyTraffic(steps=30), 3, seed=1)
    assert trained.ceiling is None
    assert np.array_equal(trained.parameters, policy.parameters)  # training is not touched


def test_a_resumed_learner_has_the_same_ceiling(tmp_path: Path) -> None:
    env = ToyTraffic(steps=30)
    first = DQN.of(env, HELD)
    ceiling = first.learn(env, 3, seed=1).ceiling
    first.save(tmp_path / "learner.pt")
    second = DQN.of(env, HELD, seed=9)
    second.load(tmp_path / "learner.pt")
    own = second.policy().ceiling
    assert ceiling is not None and own is not None and np.array_equal(own, ceiling)


def test_impossible_ceilings_are_refused() -> None:
    for wrong in (0.0, 1.01, float("nan")):
        with pytest.raises(OptionError, match="ceiling"):
            DQNConfig(ceiling=wrong)
