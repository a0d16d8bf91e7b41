"""Building blocks of all models: batched products, scaled inputs, a common base.

torch multiplies float32 with MKL. On an AMD EPYC it was half as fast as oneDNN: 109 against 227
GFLOP/s. torch contains oneDNN, but uses it for float32 only if less precision is allowed.
Processors without units for bfloat16 tiles then still compute in float32; other processors round.
So `full_width` tests oneDNN, and uses it only where nothing is rounded.
"""

from __future__ import annotations

import abc
import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.view import View

SMALLEST_SPREAD = 1e-3
"""Smallest standard deviation that is scaled to 1; scaling smaller ones would amplify noise."""

FARTHEST = 5.0
"""Limit of inputs in standard deviations; it keeps a rare lane from dominating."""

MANY = 16
"""Least number of networks for oneDNN; with fewer its overhead costs more than it saves."""

ROWS_AT_ONCE = 8192
"""Rows of all networks together whose hidden layers fit into a cache of a few MiB."""


def rows_at_once(networks: int) -> int:
    """Return the number of rows per network to answer in one product."""
    return min(2048, max(64, ROWS_AT_ONCE // networks))


@contextlib.contextmanager
def full_width(networks: int) -> Iterator[None]:
    """Multiply batches of this many networks with oneDNN, if it is as precise and faster."""
    setting: Any = getattr(torch.backends.mkldnn, "matmul", None)  # torch 2.9 has it, 2.4 does not
    asked_for = setting is not None and setting.fp32_precision != "none"  # the user's own choice
    if networks < MANY or setting is None or asked_for or not _is_exact(setting):
        yield
        return
    with _allowed(setting):
        yield


@contextlib.contextmanager
def _allowed(setting: Any) -> Iterator[None]:
    before = setting.fp32_precision
    setting.fp32_precision = "bf16"
    try:
        yield
    finally:
        setting.fp32_precision = before


@functools.cache
def _is_exact(setting: Any) -> bool:
    """Return True if products keep all bits of float32 with the lower precision allowed."""
    if not torch.backends.mkldnn.is_available():
        return False
    numbers, one = torch.full((2, 64, 64), 1.0 + 2.0**-23), torch.eye(64).repeat(2, 1, 1)
    with _allowed(setting):
        return torch.equal(torch.bmm(numbers, one), numbers)


def by_member(loss: Tensor) -> Tensor:
    """Return losses ``(agents,)`` or ``(agents, members)`` as one row, members first."""
    return loss if loss.dim() == 1 else loss.transpose(0, 1).reshape(-1)


def member_rows(inputs: Tensor, members: int) -> Tensor:
    """Return inputs for networks side by side, ``(members * agents, batch, width)``, members first.

    Args:
        inputs: ``(agents, batch, width)`` for all members; ``(agents, members, batch, width)`` if
            each has rows of its own.
        members: Number of networks of an agent.
    """
    if inputs.dim() == 3:
        inputs = inputs[:, None].expand(-1, members, -1, -1)
    return inputs.transpose(0, 1).flatten(0, 1)


class Standardiser(nn.Module):
    """Maps each agent's inputs to mean 0 and standard deviation 1 over the fitted data.

        (inputs - mean) / spread, limited to -FARTHEST to FARTHEST

    Args:
        agents: Number of agents.
        width: Padded size of the inputs. A padded input stays zero.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, agents: int, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(agents, 1, width))
        self.register_buffer("spread", torch.ones(agents, 1, width))

    def fit(self, inputs: Tensor, weight: Tensor) -> None:
        """Set mean and spread from ``(agents, n, width)`` rows with weights ``(agents, n)``."""
        share = (weight / weight.sum(1, keepdim=True))[..., None]
        mean = (share * inputs).sum(1, keepdim=True)
        spread = (share * (inputs - mean) ** 2).sum(1, keepdim=True).sqrt()
        self.mean.copy_(mean)
        self.spread.copy_(torch.where(spread > SMALLEST_SPREAD, spread, 1.0))

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(agents, batch, width)`` to the same shape, within ``FARTHEST`` of zero."""
        return ((inputs - self.mean) / self.spread).clamp(-FARTHEST, FARTHEST)


class TrainableModel(nn.Module, abc.ABC):
    """Base of models of all intersections; each part keeps its own best weights in training.

    Parts share no weight. Every parameter holds them in order, so ``parameter.view(parts, -1)`` has
    one row for each.

    Attributes:
        stack: The agents.
        view: Inputs of the model beside an agent's own state and action.
        fitted: Scalar bool, true once the model has been fitted.
    """

    fitted: Tensor

    def __init__(self, stack: Stack, view: View) -> None:
        super().__init__()
        self.stack = stack
        self.view = view
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    @property
    @abc.abstractmethod
    def members(self) -> int:
        """Number of networks side by side, each with its own order of the rows."""

    @property
    @abc.abstractmethod
    def parts(self) -> int:
        """Number of parts that share no weight."""

    @abc.abstractmethod
    def loss_by_part(self, loss: Tensor) -> Tensor:
        """Return the loss of every part, ``(parts,)``.

        Args:
            loss: ``(agents,)``, or ``(agents, members)`` with several members.
        """
