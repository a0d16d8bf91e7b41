"""What interrupts work: a user, at a chosen step, and a system that has no more to give."""

from __future__ import annotations

import contextlib
import os
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ugat_marl.progress import Silent


def eventually(condition: Callable[[], object], within_s: float = 30.0) -> bool:
    """Wait until a condition holds; return False if it does not within some seconds."""
    deadline = time.monotonic() + within_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(condition())


class KillAt(Silent):
    """Raises when a task begins."""

    def __init__(self, name: str) -> None:
        self._name = name

    def task(self, name: str, total: int) -> Any:
        if name == self._name:
            raise KeyboardInterrupt
        return super().task(name, total)


class KillAfter(Silent):
    """Raises after some steps of one task."""

    def __init__(self, name: str, steps: int) -> None:
        self._name, self._left = name, steps

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Any:
        with super().task(name, total) as advance:

            def one(*args: Any, **note: Any) -> None:
                advance(*args, **note)
                self._left -= name == self._name
                if not self._left:
                    raise KeyboardInterrupt

            yield one


@contextlib.contextmanager
def few_descriptors(spare: int) -> Iterator[None]:
    """Leave this process only `spare` descriptors more than it has open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
    with contextlib.ExitStack() as held:
        held.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1 + spare, hard))
        # The limit is on numbers: those that are free below it are taken, too.
        with contextlib.suppress(OSError):
            while True:
                taken = os.open(os.devnull, os.O_RDONLY)
                if taken > highest:  # of the spare ones
                    os.close(taken)
                    break
                held.callback(os.close, taken)
        yield
