"""Options that several commands share; their help explains the default."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Annotated

from tyro.conf import arg

from ugat_marl import parallel
from ugat_marl.errors import OptionError

Workers = Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: one per core)")]
"""Simulations at a time."""

RayAddress = Annotated[
    str | None, arg(metavar="[ADDRESS]", help_behavior_hint="(default: not used)")
]
"""Address of Ray: local (--ray without an address), auto, host:port, ray://host:port."""

LengthS = Annotated[
    float | None, arg(metavar="FLOAT", help_behavior_hint="(default: the scenario's own)")
]
"""Length of a day or an episode, s."""


@contextlib.contextmanager
def workers_of(
    workers: int | None, ray: str | None, option: str = "--workers"
) -> Iterator[parallel.Workers]:
    """Yield the workers for the parts of a command: processes of this machine, or Ray.

    Args:
        workers: Number of processes on this machine; None for one per core.
        ray: Address of Ray; None for processes of this machine.
        option: Name of the option `workers` on the command line.

    Raises:
        OptionError: `workers` and `ray` are both given, or Ray is not available.
    """
    if ray is None:
        yield workers
        return
    if workers is not None:
        raise OptionError(
            f"{option} is for this machine; with --ray its cores decide: leave it out"
        )
    with parallel.RayExecutor(ray) as executor:
        yield executor
