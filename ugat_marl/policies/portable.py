"""Networks as arrays by name and a few operations, so that they run without torch.

A portable network says once how observations become values of actions, in terms of `Operations`.
numpy carries these operations out (`NumpyOperations`). An exporter can translate them instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import AgentSet

Array = NDArray[np.float32]
Arrays = Mapping[str, Array]

Layer = tuple[Array, Array]
"""Weights ``(agents or 1, n_in, n_out)`` and biases ``(agents or 1, 1, n_out)``."""

T = TypeVar("T")


class Operations(Protocol[T]):
    """Operations on arrays of three axes, or on what stands for them; they broadcast as numpy."""

    def matmul(self, left: T, right: T) -> T:
        """Return the products of matrices in the last two axes."""
        ...

    def add(self, left: T, right: T) -> T:
        """Return the sum."""
        ...

    def multiply(self, left: T, right: T) -> T:
        """Return the product of each pair of numbers."""
        ...

    def minimum(self, left: T, right: T) -> T:
        """Return the smaller of each pair of numbers."""
        ...

    def relu(self, array: T) -> T:
        """Return positive numbers as they are, and 0 for the others."""
        ...

    def concat(self, arrays: Sequence[T]) -> T:
        """Join arrays along the last axis."""
        ...

    def last(self, array: T) -> T:
        """Return the last place of the last axis, which keeps the size 1."""
        ...

    def reshape(self, array: T, shape: tuple[int, ...]) -> T:
        """Return the same numbers in another shape; -1 stands for the size that fits."""
        ...


class NumpyOperations:
    """The operations, carried out by numpy."""

    def matmul(self, left: Array, right: Array) -> Array:
        """Return the products of matrices in the last two axes."""
        return left @ right

    def add(self, left: Array, right: Array) -> Array:
        """Return the sum."""
        return left + right

    def multiply(self, left: Array, right: Array) -> Array:
        """Return the product of each pair of numbers."""
        return left * right

    def minimum(self, left: Array, right: Array) -> Array:
        """Return the smaller of each pair of numbers."""
        return np.minimum(left, right)

    def relu(self, array: Array) -> Array:
        """Return positive numbers as they are, and 0 for the others."""
        return np.maximum(array, np.float32(0))

    def concat(self, arrays: Sequence[Array]) -> Array:
        """Join arrays along the last axis."""
        return np.concatenate(arrays, axis=-1)

    def last(self, array: Array) -> Array:
        """Return the last place of the last axis, which keeps the size 1."""
        return array[..., -1:]

    def reshape(self, array: Array, shape: tuple[int, ...]) -> Array:
        """Return the same numbers in another shape; -1 stands for the size that fits."""
        return array.reshape(shape)


class PortableNetwork(Protocol):
    """A network from observations to values of actions, as arrays and operations."""

    @property
    def arrays(self) -> Arrays:
        """Weights and facts by name."""
        ...

    def require_fitting(self, agents: AgentSet) -> None:
        """Check names and shapes of the arrays.

        Raises:
            ValueError: They do not fit each other or the agents, or a number is not finite.
        """
        ...

    def values(self, do: Operations[T], arrays: Mapping[str, T], observations: T) -> T:
        """Return the values of actions, ``(agents, 1, most_actions)``.

        Args:
            do: The operations.
            arrays: `arrays`, or what stands for them.
            observations: Observations padded with zeros, ``(agents, 1, widest_observation)``.
        """
        ...


@dataclass(frozen=True, eq=False)
class PortableLayers:
    """Affine maps with ReLU between them: ``weight_0``, ``bias_0``, ``weight_1`` and so on.

    Attributes:
        arrays: Weights and biases, shaped as in `Layer`.
    """

    arrays: Arrays

    @classmethod
    def of(cls, layers: Sequence[Layer]) -> PortableLayers:
        """Name the weights and biases of layers."""
        arrays: dict[str, Array] = {}
        for place, (weight, bias) in enumerate(layers):
            arrays |= {f"weight_{place}": weight, f"bias_{place}": bias}
        return cls(arrays)

    def require_fitting(self, agents: AgentSet) -> None:
        """Check names and shapes of the arrays; see `PortableNetwork`."""
        count, width = len(agents), agents.widest_observation
        layers = (len(self.arrays) + 1) // 2
        names = {f"{kind}_{place}" for place in range(layers) for kind in ("weight", "bias")}
        _require_numbers(self.arrays, names)
        for place in range(layers):
            weight, bias = self.arrays[f"weight_{place}"], self.arrays[f"bias_{place}"]
            shapes = weight.shape, bias.shape
            fits = len(shapes[0]) == len(shapes[1]) == 3 and shapes[0][1] == width
            fits = fits and {shapes[0][0], shapes[1][0]} <= {1, count}
            if not fits or shapes[1][1:] != (1, shapes[0][2]):
                raise ValueError(f"a layer of shapes {shapes} for {count} agents, {width} inputs")
            width = shapes[0][2]
        if width != agents.most_actions or not layers:
            raise ValueError(f"{width} outputs for {agents.most_actions} actions")

    def values(self, do: Operations[T], arrays: Mapping[str, T], observations: T) -> T:
        """Return the values of actions; see `PortableNetwork`."""
        hidden = observations
        for place in range(len(arrays) // 2):
            hidden = do.relu(hidden) if place else hidden
            hidden = do.add(do.matmul(hidden, arrays[f"weight_{place}"]), arrays[f"bias_{place}"])
        return hidden


@dataclass(frozen=True, eq=False)
class PortableUniversal:
    """The network "universal"; `UniversalNetwork` defines it and names the arrays.

    Attributes:
        arrays: Its weights and facts, and ``ceiling``, ``(agents, 1, widest_observation)``, if its
            observations are cut to one.
    """

    arrays: Arrays

    SHAPES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "inputs": ("agents", "width", "reads"),
        "ages": ("agents", "width", "one"),
        "facts": ("agents", "movements", "facts"),
        "present": ("agents", "movements"),
        "greens": ("agents", "phases", "movements"),
        "movement.layers.0.weight": ("one", "numbers", "embedding"),
        "movement.layers.0.bias": ("one", "one", "embedding"),
        "movement.layers.2.weight": ("one", "embedding", "embedding"),
        "movement.layers.2.bias": ("one", "one", "embedding"),
        "own.weight": ("one", "embedding", "hidden"),
        "own.bias": ("one", "one", "hidden"),
        "whole.weight": ("one", "embedding", "hidden"),
        "whole.bias": ("one", "one", "hidden"),
        "readout.layers.0.weight": ("one", "hidden", "hidden"),
        "readout.layers.0.bias": ("one", "one", "hidden"),
        "readout.layers.2.weight": ("one", "hidden", "one"),
        "readout.layers.2.bias": ("one", "one", "one"),
        "value.layers.0.weight": ("one", "embedding", "hidden"),
        "value.layers.0.bias": ("one", "one", "hidden"),
        "value.layers.2.weight": ("one", "hidden", "one"),
        "value.layers.2.bias": ("one", "one", "one"),
    }
    """Names of the arrays and of the sizes of their axes."""

    CEILING: ClassVar[Mapping[str, tuple[str, ...]]] = {"ceiling": ("agents", "one", "width")}

    def require_fitting(self, agents: AgentSet) -> None:
        """Check names and shapes of the arrays; see `PortableNetwork`."""
        shapes = {**self.SHAPES, **(self.CEILING if "ceiling" in self.arrays else {})}
        _require_numbers(self.arrays, {*shapes})
        sizes = {
            "agents": len(agents),
            "width": agents.widest_observation,
            "phases": agents.most_actions,
            "one": 1,
        }
        for name, axes in shapes.items():
            shape = self.arrays[name].shape
            fits = len(shape) == len(axes) and all(
                sizes.setdefault(axis, size) == size > 0
                for axis, size in zip(axes, shape, strict=True)
            )
            if not fits:
                wanted = ", ".join(f"{axis} {sizes.get(axis, '')}".strip() for axis in axes)
                raise ValueError(f"{name} of shape {shape}, not ({wanted})")
        # a movement is read as what `inputs` select, the age of its green, and its facts
        if sizes["reads"] != sizes["movements"] * (sizes["numbers"] - 1 - sizes["facts"]):
            raise ValueError(f"{sizes['numbers']} numbers of a movement, which inputs do not give")

    def values(self, do: Operations[T], arrays: Mapping[str, T], observations: T) -> T:
        """Return the values of actions; see `PortableNetwork`."""
        agents, phases, movements = self.arrays["greens"].shape

        def affine(name: str, array: T) -> T:
            return do.add(do.matmul(array, arrays[f"{name}.weight"]), arrays[f"{name}.bias"])

        def perceptron(name: str, array: T) -> T:
            return affine(f"{name}.layers.2", do.relu(affine(f"{name}.layers.0", array)))

        if "ceiling" in arrays:
            observations = do.minimum(observations, arrays["ceiling"])
        read = do.matmul(observations, arrays["inputs"])
        read = do.reshape(read, (agents, movements, -1))
        age = do.multiply(do.matmul(observations, arrays["ages"]), do.last(read))
        numbers = do.concat((read, age, arrays["facts"]))
        embedded = do.relu(perceptron("movement", numbers))
        # padded movements are in no phase, so only the sum over all movements must leave them out
        present = do.reshape(arrays["present"], (agents, 1, movements))
        total = do.matmul(present, embedded)
        own = affine("own", do.matmul(arrays["greens"], embedded))
        joint = do.relu(do.add(own, affine("whole", total)))
        scores = do.add(perceptron("readout", joint), perceptron("value", total))
        return do.reshape(scores, (agents, 1, phases))


def _require_numbers(arrays: Arrays, names: set[str]) -> None:
    """Refuse arrays of other names or types, and numbers that are not finite."""
    if {*arrays} != names:
        odd = ", ".join(sorted({*arrays} ^ names)[:3])
        raise ValueError(f"arrays are lacking or too many: {odd}")
    for name, array in arrays.items():
        if array.dtype != np.float32:
            raise ValueError(f"{name} holds {array.dtype}, not float32")
        if not np.isfinite(array).all():
            raise ValueError(f"a number of {name} is NaN or infinite")


PORTABLE: Mapping[str, type[PortableLayers] | type[PortableUniversal]] = {
    "mlp": PortableLayers,
    "universal": PortableUniversal,
}
"""Name of a network to its portable form."""
