"""Memory that a user's process and its simulations share.

The first axis is the environment, the second the agent, in the order of `possible_agents`. Unequal
agents are padded at the end: with zeros behind short observations, and zeros in masks for phases
that an agent does not have. The memory has no name, so it vanishes with the processes.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ALIGNED = 64
"""Alignment in bytes, so that no two arrays share a cache line."""


@dataclass(frozen=True)
class Shape:
    """Sizes of the arrays.

    Attributes:
        environments: Number of environments.
        agents: Number of agents of each environment.
        width: Length of the longest observation.
        actions: Largest number of phases of an agent.
    """

    environments: int
    agents: int
    width: int
    actions: int


@dataclass(frozen=True)
class Arrays:
    """Arrays that the user's process and the workers read and write.

    Attributes:
        observations: float32 ``(environments, agents, width)``.
        masks: int8 ``(environments, agents, actions)``; 1 where a phase may be chosen.
        rewards: float64 ``(environments, agents)``.
        actions: int64 ``(environments, agents)``; the phases that the user asks for.
        executed: int64 ``(environments, agents)``; the phases that were shown.
    """

    observations: NDArray[np.float32]
    masks: NDArray[np.int8]
    rewards: NDArray[np.float64]
    actions: NDArray[np.int64]
    executed: NDArray[np.int64]

    @classmethod
    def over(cls, descriptor: int, shape: Shape) -> Arrays:
        """Return the arrays in an open file of `shared_memory`; it may be closed afterwards."""
        memory = mmap.mmap(descriptor, _size(shape))
        arrays: dict[str, NDArray[Any]] = {}
        offset = 0
        for name, (dtype, sizes) in _layout(shape).items():
            count = int(np.prod(sizes))
            flat = np.frombuffer(memory, dtype=dtype, count=count, offset=offset)
            arrays[name] = flat.reshape(sizes)
            offset += _room(dtype, sizes)
        return cls(**arrays)

    def part(self, where: slice | int) -> Arrays:
        """Return some environments, or one without the first axis, in the same memory."""
        return Arrays(*(getattr(self, field.name)[where] for field in fields(self)))


def shared_memory(shape: Shape) -> int:
    """Return the descriptor of an open file without a name, of the size of the arrays."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("ugat_marl")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, _size(shape))
    return descriptor


def _layout(shape: Shape) -> dict[str, tuple[type[np.generic], tuple[int, ...]]]:
    each = (shape.environments, shape.agents)
    return {
        "observations": (np.float32, (*each, shape.width)),
        "masks": (np.int8, (*each, shape.actions)),
        "rewards": (np.float64, each),
        "actions": (np.int64, each),
        "executed": (np.int64, each),
    }


def _room(dtype: type[np.generic], sizes: tuple[int, ...]) -> int:
    """Return the number of bytes up to the next array."""
    size = np.dtype(dtype).itemsize * int(np.prod(sizes))
    return -(-size // _ALIGNED) * _ALIGNED


def _size(shape: Shape) -> int:
    return sum(_room(dtype, sizes) for dtype, sizes in _layout(shape).values())
