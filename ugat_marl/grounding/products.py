"""How products of many intersections are taken: at the processor's full width, and in its cache.

torch multiplies float32 with MKL, which on an AMD EPYC was half as fast as oneDNN: 109 against 227
GFLOP/s, as if half of each vector lay idle. torch brings oneDNN as well, but only asks it for
products of float32 where less precision is allowed. Processors without units for bfloat16 tiles
then get plain float32 all the same, only faster; on others numbers would really be rounded. So it
is tried out, and only taken where nothing is rounded.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import torch

MANY = 16
"""Networks side by side from which on this pays: fewer lose more by oneDNN's overhead."""

ROWS_AT_ONCE = 8192
"""Rows, of all networks together, whose hidden layers still fit into a cache of a few MiB."""


def rows_at_once(networks: int) -> int:
    """Rows of each of that many networks to be answered in one product."""
    return min(2048, max(64, ROWS_AT_ONCE // networks))


@contextlib.contextmanager
def full_width(networks: int) -> Iterator[None]:
    """Multiplies batches of that many networks by oneDNN, where that is as precise and pays."""
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
    """Whether products keep the last bits of float32 although they need not."""
    if not torch.backends.mkldnn.is_available():
        return False
    numbers, one = torch.full((2, 64, 64), 1.0 + 2.0**-23), torch.eye(64).repeat(2, 1, 1)
    with _allowed(setting):
        return torch.equal(torch.bmm(numbers, one), numbers)
