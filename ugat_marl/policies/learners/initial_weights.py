"""Weights that a training begins with: those of a network that was trained on other roads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from ugat_marl.data import checked_tensors, read_checkpoint, write_checkpoint
from ugat_marl.errors import CheckpointError, OptionError

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
        """Read a file of `save`.

        Raises:
            CheckpointError: The file is missing, cut short or not finite, or of another kind.
        """
        content = read_checkpoint(path, _KIND)
        try:
            weights, options = content["weights"], dict(content["env_options"])
            expected = {"weights": weights.new_zeros(weights.shape)}
            checked_tensors(path, {"weights": weights}, expected)
            return cls(weights, options, str(content["origin"]))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{path}: not initial weights ({error})") from None

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
