"""In whose code a program spends its processor time, by samples."""

from __future__ import annotations

import importlib
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

INTERVAL_S = 0.001


class CpuShares:
    """Seconds of CPU of the main thread, by the package of the innermost Python function.

    A timer of the process's own time interrupts it; what has been used since the last sample is
    charged to the function that is on top then. A long call into C is interrupted when it returns,
    and charged whole to the function that made it: a package's compiled code counts as its own
    where one of its Python functions calls it, and as the caller's where it is called directly.

    Args:
        packages: Name of a share to the folder of the package it is of; the rest is "rest".

    Attributes:
        seconds: Of each share, so far.
    """

    def __init__(self, packages: Mapping[str, Path]) -> None:
        self._folders = {str(folder) + "/": name for name, folder in packages.items()}
        self._known: dict[str, str] = {}
        self._last = 0.0
        self._before: Any = None
        self.seconds = dict.fromkeys([*packages, "rest"], 0.0)

    def __enter__(self) -> CpuShares:
        self._before = signal.signal(signal.SIGPROF, self._sample)
        self._last = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, INTERVAL_S, INTERVAL_S)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        self._sample(signal.SIGPROF, sys._getframe())
        signal.signal(signal.SIGPROF, self._before)

    def _sample(self, _: int, frame: FrameType | None) -> None:
        now = time.process_time()
        file = frame.f_code.co_filename if frame is not None else ""
        self.seconds[self._share(file)] += now - self._last
        self._last = now

    def _share(self, file: str) -> str:
        if file not in self._known:
            owners = (name for folder, name in self._folders.items() if file.startswith(folder))
            self._known[file] = next(owners, "rest")
        return self._known[file]


def folder_of(package: str) -> Path:
    """Where an importable package lies."""
    module = importlib.import_module(package)
    assert module.__file__ is not None
    return Path(module.__file__).parent
