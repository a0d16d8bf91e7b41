"""By what observations are divided, and networks that take them as they are."""

from __future__ import annotations

import pytest
import torch

from tests.runs import q_values
from ugat_marl.envs import AgentSet
from ugat_marl.policies import (
    DQN,
    BatchedMLP,
    DQNConfig,
    SharedMLP,
    parameters_for_unscaled,
)
from ugat_marl.policies.learners.scaling import LEAST, input_factors, observation_mask
from ugat_marl.policies.networks.structure import Structure


@pytest.fixture
def agents() -> AgentSet:
    return AgentSet(("a", "b"), (2, 3), (2, 2))


def test_each_number_is_divided_by_its_root_mean_square(agents: AgentSet) -> None:
    seen = torch.tensor([[[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], [[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]]])
    factors = input_factors(seen, agents, pooled=False)
    # a has not seen its second number, and has no third
    expected = [[1 / 12.5**0.5, 1.0, 1.0], [1.0, 0.5, 2.0]]
    assert torch.allclose(factors, torch.tensor(expected))


def test_a_number_that_was_hardly_seen_keeps_its_size(agents: AgentSet) -> None:
    """A large factor would let it rule the network when it appears."""
    seen = torch.ones(2, 100, 3)
    for size, factor in ((2 * LEAST, 0.5 / LEAST), (LEAST / 2, 1.0), (0.0, 1.0)):
        seen[:, :, 1] = size
        for pooled in (False, True):
            factors = input_factors(seen, agents, pooled)[:, 1]
            assert factors.tolist() == pytest.approx([factor, factor])


def test_pooled_agents_have_one_factor_for_what_they_have_in_common(agents: AgentSet) -> None:
    seen = torch.tensor([[[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], [[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]]])
    factors = input_factors(seen, agents, pooled=True)
    squares = (12.5 + 1.0) / 2, 4.0 / 2
    first, second = (1 / square**0.5 for square in squares)
    # the third number is b's alone; where a has none, its padding stays as it is
    assert torch.allclose(factors, torch.tensor([[first, second, 1.0], [first, second, 2.0]]))


@pytest.mark.parametrize(
    ("config", "structure"),
    [
        (DQNConfig(shared=True, hidden=(8,)), None),
        (
            DQNConfig(network="colight", hidden=(8, 8)),
            Structure("colight", neighbours=((1, 2), (0,), (0,))),
        ),
    ],
)
def test_a_policy_of_one_network_scales_what_the_first_agent_does_not_see(
    config: DQNConfig, structure: Structure | None
) -> None:
    agents = AgentSet(("narrow", "wide", "wider"), (3, 5, 7), (2, 3, 3))
    learner = DQN(agents, config, 1, structure=structure)
    there = torch.from_numpy(observation_mask(agents))[:, None]
    seen = torch.rand((3, 50, 7), generator=torch.Generator().manual_seed(2)) * 0.2 * there
    learner._inputs.copy_(input_factors(seen, agents, pooled=True)[:, None])
    expected = learner._target(seen[:, :1] * learner._inputs)[:, 0].numpy()
    plain = {
        name: seen[place, 0, :size].numpy()
        for place, (name, size) in enumerate(
            zip(agents.names, agents.observation_sizes, strict=True)
        )
    }
    for values, wanted in zip(q_values(learner.policy(), plain).values(), expected, strict=True):
        assert values == pytest.approx(wanted[: len(values)], abs=1e-5)


@pytest.mark.parametrize("shared", [False, True])
def test_a_network_read_out_takes_plain_numbers(shared: bool) -> None:
    def network(seed: int) -> torch.nn.Module:
        generator = torch.Generator().manual_seed(seed)
        if shared:
            return SharedMLP(3, 5, (8,), 2, generator)
        return BatchedMLP([5, 5, 5], (8,), 2, generator)

    inner, outer = network(1), network(2)
    factors = torch.rand((5,) if shared else (3, 5)) * 10
    torch.nn.utils.vector_to_parameters(parameters_for_unscaled(inner, factors), outer.parameters())
    plain = torch.rand(3, 7, 5)
    scaled = plain * (factors if shared else factors[:, None])
    assert torch.allclose(outer(plain), inner(scaled), atol=1e-5)
