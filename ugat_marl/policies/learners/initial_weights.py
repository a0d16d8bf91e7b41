"""Weights that a training begins with: those of a network that was trained before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.files import MALFORMED
from ugat_marl.policies.network_policy import KIND as POLICY
from ugat_marl.policies.network_policy import NetworkPolicy

_KIND = "ugat_marl.start"


@dataclass(frozen=True)
class InitialWeights:
    """Weights of a network "universal", and where they come from.

    Attributes:
        weights: All parameters as one vector, in the order of `flatten_parameters`.
        env_options: Options of the environments in which they were learned; the observations of
            another environment must be of the same kind.
        origin: How they were learned, for the reader.
    """

    weights: Tensor
    env_options: Mapping[str, Any] = field(default_factory=dict)
    origin: str = ""

    @classmethod
    def load(cls, path: Path) -> InitialWeights:
        """Read a file of `save`, or the weights of a saved policy.

        Raises:
            CheckpointError: The file is missing, cut short or not finite, or of another kind.
            OptionError: The policy has another network than "universal".
        """
        content = read_checkpoint(path, _KIND, POLICY)
        if content["kind"] == POLICY:
            return cls.of_policy(NetworkPolicy.load(path), str(path))
        try:
            weights, options = content["weights"], dict(content["env_options"])
            if weights.dtype != torch.float32 or weights.ndim != 1:
                raise TypeError("weights are no row of float32")
            return cls(weights, options, str(content["origin"]))
        except MALFORMED as error:
            raise CheckpointError(f"{path}: not initial weights ({error})") from None

    @classmethod
    def of_policy(cls, policy: NetworkPolicy, origin: str) -> InitialWeights:
        """Return the weights of a policy.

        Args:
            policy: A policy with a network "universal".
            origin: Where it comes from.

        Raises:
            OptionError: Its network is of another kind.
        """
        if policy.structure is None or policy.structure.network != "universal":
            raise OptionError(
                f'{origin}: a training begins with the weights of a network "universal", and this '
                "policy has another one; train the policy with --learner universal"
            )
        return cls(torch.from_numpy(policy.parameters), policy.env_options, origin)

    def save(self, path: Path) -> None:
        """Write the weights to a file atomically."""
        content = {
            "weights": self.weights.detach().clone(),
            "env_options": dict(self.env_options),
            "origin": self.origin,
        }
        write_checkpoint(path, _KIND, content)

    def weights_for(self, network: nn.Module) -> Tensor:
        """Return the weights, for a network that is to begin with them.

        Raises:
            OptionError: The network has another number of weights.
        """
        needed = sum(parameter.numel() for parameter in network.parameters())
        if self.weights.shape != (needed,):
            options = " ".join(f"{name}={value}" for name, value in self.env_options.items())
            raise OptionError(
                f"the start holds {self.weights.numel()} weights, this network has {needed}; the "
                f"start was learned with {options}: use the same observation and sizes, or "
                "leave out the start"
            )
        return self.weights
