"""By what observations are divided, and networks that take them as they are."""

from __future__ import annotations

import pytest
import torch

from ugat_marl.envs import AgentSet
from ugat_marl.policies import BatchedMLP, SharedMLP, parameters_for_unscaled
from ugat_marl.policies.learners.scaling import LEAST, input_factors


@pytest.fixture
def agents() -> AgentSet:
    return AgentSet(("a", "b"), (2, 3), (2, 2))


def test_each_number_is_divided_by_its_root_mean_square(agents: AgentSet) -> None:
    seen = torch.tensor([[[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], [[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]]])
    factors = input_factors(seen, agents, pooled=False)
    expected = [[1 / 12.5**0.5, 1 / LEAST, 1.0], [1.0, 0.5, 2.0]]
    assert torch.allclose(factors, torch.tensor(expected))


def test_pooled_agents_have_one_factor_for_what_they_have_in_common(agents: AgentSet) -> None:
    seen = torch.tensor([[[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], [[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]]])
    factors = input_factors(seen, agents, pooled=True)
    squares = (12.5 + 1.0) / 2, 4.0 / 2
    first, second = (1 / square**0.5 for square in squares)
    # the third number is b's alone; where a has none, its padding stays as it is
    assert torch.allclose(factors, torch.tensor([[first, second, 1.0], [first, second, 2.0]]))


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
