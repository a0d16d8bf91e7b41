"""Options that several commands share; their help says what the default means."""

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
"""Address of Ray: local (meant by a bare --ray), auto, host:port, ray://host:port."""

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
        workers: How many at a time on this machine.
        ray: Address of Ray, or None.
        option: What `workers` is called on the command line.

    Raises:
        OptionError: Both are given, or there is no Ray.
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
