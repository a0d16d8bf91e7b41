"""Networks by name: one for each agent, or one that all agents share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.envs import AgentSet
from ugat_marl.policies.networks.batched import BatchedMLP, SharedMLP
from ugat_marl.policies.networks.colight import CoLight
from ugat_marl.policies.networks.frap import FRAP
from ugat_marl.policies.networks.structure import Structure
from ugat_marl.policies.networks.universal import UniversalNetwork


def q_network(
    agents: AgentSet,
    hidden: Sequence[int],
    shared: bool,
    generator: torch.Generator,
    structure: Structure | None = None,
) -> nn.Module:
    """Build the network from ``(agents, batch, widest_observation)`` to values of actions."""
    if structure is not None and structure.network == "colight":
        return CoLight(agents, structure.neighbours, hidden, generator)
    if structure is not None and structure.network == "universal":
        return UniversalNetwork(agents, structure.junctions, hidden, generator)
    if structure is not None:
        return FRAP(agents, structure.junctions, hidden, generator)
    if shared:
        n_in, n_out = agents.widest_observation, agents.most_actions
        return SharedMLP(len(agents), n_in, hidden, n_out, generator)
    return BatchedMLP(agents.observation_sizes, hidden, agents.most_actions, generator)


class Held(nn.Module):
    """A network whose inputs are cut to a ceiling: it reads ``min(observation, ceiling)``.

    Args:
        network: The network behind.
        ceiling: Largest value of each number, ``(agents, width)``.
    """

    ceiling: Tensor

    def __init__(self, network: nn.Module, ceiling: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("ceiling", ceiling.unsqueeze(1))

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values of observations ``(agents, batch, width)``."""
        return self.network(torch.minimum(observations, self.ceiling))


def greedy_actions(network: nn.Module, stacked: Tensor, allowed: Tensor) -> NDArray[np.int64]:
    """Return the allowed action of highest value for every agent, ``(agents,)``.

    Args:
        network: Network from observations to values of actions.
        stacked: One observation of every agent, ``(agents, widest_observation)``.
        allowed: Mask of allowed actions, ``(agents, most_actions)``.
    """
    with torch.no_grad():
        values = network(stacked.unsqueeze(1)).squeeze(1)
        return values.masked_fill(~allowed, -torch.inf).argmax(dim=1).numpy()


def flatten_parameters(module: nn.Module) -> nn.Parameter:
    """Move all parameters of `module`, and their gradients, into one vector each.

    The module then computes on views of the vector. So the step of the optimiser and the update of
    the target network are single operations over all agents and layers.
    """
    flat = nn.Parameter(nn.utils.parameters_to_vector(module.parameters()).detach().clone())
    flat.grad = torch.zeros_like(flat)
    bind_parameters(module, flat)
    return flat


def bind_parameters(module: nn.Module, flat: nn.Parameter) -> None:
    """Let all parameters of `module`, and their gradients, be views of one vector and its own.

    Args:
        module: The module; its numbers become those of the vector.
        flat: Vector with a gradient, of as many numbers as `module` has.
    """
    assert flat.grad is not None
    start = 0
    for parameter in module.parameters():
        end = start + parameter.numel()
        parameter.data = flat.data[start:end].view_as(parameter)
        parameter.grad = flat.grad[start:end].view_as(parameter)
        start = end


def parameters_for_unscaled(network: nn.Module, factors: Tensor) -> Tensor:
    """Return parameters with which the network reads unscaled observations.

    The new network computes for x what `network` computes for ``x * factors``.

    Args:
        network: A network whose first weights, ``(..., n_in, n_out)``, multiply the observation.
        factors: Scale of the observations: ``(widest_observation,)`` for a network that all agents
            share, otherwise ``(agents, widest_observation)``.

    Returns:
        All parameters as one vector, in the order of `flatten_parameters`.
    """
    named = list(network.named_parameters())
    first = next(name for name, _ in named if name.endswith("weight"))
    factor = factors.unsqueeze(-1)
    return nn.utils.parameters_to_vector(p * factor if name == first else p for name, p in named)
