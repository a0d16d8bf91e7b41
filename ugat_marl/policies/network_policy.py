"""Greedy policies of trained networks, for every learner: act, save, load, send to processes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.envs import Actions, AgentSet, AnyParallelEnv, Infos, Observations
from ugat_marl.errors import CheckpointError, first_line
from ugat_marl.files import MALFORMED, parse_json
from ugat_marl.policies.devices import CPU
from ugat_marl.policies.networks.q_network import Held, greedy_actions, q_network
from ugat_marl.policies.networks.structure import Structure, structure_in
from ugat_marl.policies.saved_options import plain_options

KIND = "ugat_marl.network_policy"
"""Kind of its checkpoints."""


class NetworkPolicy:
    """Take every agent's allowed action of highest value: Q for DQN, the logit for an actor.

    Args:
        agents: The agents it acts for.
        hidden: Sizes of the hidden layers of each network.
        parameters: All parameters as one vector, in the order of `flatten_parameters`; they are
            copied to the CPU.
        env_options: Options of the environment that the policy relies on.
        shared: True if all agents share one network.
        structure: Facts about the intersections for a network other than "mlp".
        ceiling: Largest value of each number of an observation, ``(agents, widest_observation)``;
            larger numbers are cut to it. None cuts nothing. See `DQNConfig.ceiling`.

    Raises:
        ValueError: `parameters` or `ceiling` belong to other networks.
    """

    def __init__(
        self,
        agents: AgentSet,
        hidden: tuple[int, ...],
        parameters: Tensor | NDArray[np.float32],
        env_options: Mapping[str, Any],
        shared: bool = False,
        structure: Structure | None = None,
        ceiling: Tensor | NDArray[np.float32] | None = None,
    ) -> None:
        self.agents = agents
        self.hidden = hidden
        self.shared = shared
        self.structure = structure
        self.env_options: Mapping[str, Any] = dict(env_options)
        self._network = q_network(agents, hidden, shared, torch.Generator(), structure)
        vector = torch.as_tensor(parameters).detach().to(CPU, copy=True)
        needed = sum(parameter.numel() for parameter in self._network.parameters())
        if vector.shape != (needed,):
            raise ValueError(f"parameters of shape {tuple(vector.shape)}, needed: ({needed},)")
        nn.utils.vector_to_parameters(vector, self._network.parameters())
        self._network.requires_grad_(False)
        self._ceiling = None
        if ceiling is not None:
            self._ceiling = torch.as_tensor(ceiling, dtype=torch.float32).to(CPU, copy=True)
            wanted = (len(agents), agents.widest_observation)
            if self._ceiling.shape != wanted:
                raise ValueError(f"a ceiling of shape {tuple(self._ceiling.shape)}, not {wanted}")
            self._network = Held(self._network, self._ceiling)

    @property
    def parameters(self) -> NDArray[np.float32]:
        """All parameters as one vector (a copy)."""
        return nn.utils.parameters_to_vector(self._network.parameters()).numpy().copy()

    @property
    def ceiling(self) -> NDArray[np.float32] | None:
        """Largest numbers the network reads, ``(agents, widest_observation)`` (a copy)."""
        return None if self._ceiling is None else self._ceiling.numpy().copy()

    @property
    def decision_interval_s(self) -> float | None:
        """Seconds between the decisions that it was trained for; None if its network reads none."""
        junctions = () if self.structure is None else self.structure.junctions
        return next((each.interval_s for each in junctions if each.interval_s > 0), None)

    def misfit(self, env: AnyParallelEnv) -> str:
        """Return why the intersections of an environment are others; "" if they are the policy's.

        Raises:
            OptionError: The network reads the road network, and `env` has none.
        """
        if (agents := AgentSet.of(env)) != self.agents:
            return f"its agents are {self.agents}, here {agents}"
        if self.structure is not None:
            here = Structure.of(env, self.structure.network)
            assert here is not None
            if here.places != self.structure.places:
                return "its movements, phases or neighbours are others"
        return ""

    def reset(self, seed: int) -> None:
        """Do nothing: the policy is deterministic and has no memory."""

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the greedy action of every agent.

        Raises:
            OptionError: The observations belong to other agents than those the policy was trained
                for, or are not finite.
        """
        stacked = torch.from_numpy(self.agents.stack(observations))
        allowed = torch.from_numpy(self.agents.masks(infos))
        return self.agents.actions(greedy_actions(self._network, stacked, allowed))

    def save(self, path: str | Path) -> None:
        """Write the policy to one file; `load` reads it."""
        content = checkpoint_header(
            self.agents, self.hidden, self.env_options, self.shared, self.structure
        )
        content["parameters"] = torch.from_numpy(self.parameters)
        if self._ceiling is not None:
            content["ceiling"] = self._ceiling
        write_checkpoint(Path(path), KIND, content)

    @classmethod
    def load(cls, path: str | Path) -> NetworkPolicy:
        """Read a saved policy.

        Raises:
            CheckpointError: The file is missing, cut short, not finite, or not a policy.
        """
        content = read_checkpoint(Path(path), KIND)
        try:
            agents, hidden, env_options, shared = parse_header(content)
            structure = structure_in(content, agents)
            parameters = content["parameters"]
            if getattr(parameters, "dtype", None) != torch.float32:
                raise TypeError("its parameters are no tensor of float32")
            arguments = (agents, hidden, parameters, env_options, shared, structure)
            return cls(*arguments, content.get("ceiling"))
        except (RuntimeError, *MALFORMED) as error:
            raise CheckpointError(
                f"{path}: not a whole policy ({first_line(error)}); save it again"
            ) from None

    def __reduce__(self) -> tuple[type[NetworkPolicy], tuple[Any, ...]]:
        # numpy, since torch would send tensors between processes through shared memory
        arguments = (self.agents, self.hidden, self.parameters, self.env_options, self.shared)
        return NetworkPolicy, (*arguments, self.structure, self.ceiling)


def checkpoint_header(
    agents: AgentSet,
    hidden: tuple[int, ...],
    env_options: Mapping[str, Any],
    shared: bool,
    structure: Structure | None = None,
) -> dict[str, Any]:
    """Return the description of agents and network that every checkpoint holds.

    Raises:
        CheckpointError: An option of the environment is not plain data (for example a callable).
    """
    return {
        "agents": list(agents.names),
        "observation_sizes": list(agents.observation_sizes),
        "action_counts": list(agents.action_counts),
        "hidden": list(hidden),
        "env_options": plain_options(env_options),
        "shared": shared,
        **({} if structure is None else {"structure": structure.written()}),
    }


def parse_header(
    content: Mapping[str, Any],
) -> tuple[AgentSet, tuple[int, ...], dict[str, Any], bool]:
    """Read agents, hidden sizes, environment options and `shared` from a checkpoint."""
    agents = AgentSet(
        tuple(content["agents"]),
        tuple(content["observation_sizes"]),
        tuple(content["action_counts"]),
    )
    sizes = agents.observation_sizes, agents.action_counts
    hidden = tuple(int(width) for width in content["hidden"])
    if {len(agents)} != {len(each) for each in sizes} or min(*sizes[0], *sizes[1], *hidden) < 1:
        raise ValueError("its agents or the sizes of its layers are no network's")
    try:
        options = parse_json(content["env_options"], "env_options", CheckpointError)
    except CheckpointError as error:  # the caller knows the file
        raise ValueError(str(error)) from None
    if not isinstance(options, dict):
        raise TypeError(f"env_options = {options!r} is not an object")
    shared = content["shared"]
    if not isinstance(shared, bool):
        raise TypeError(f"shared = {shared!r} is not a bool")
    return agents, hidden, options, shared
