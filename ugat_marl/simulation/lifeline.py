"""How a process notices that nobody waits for it any more, and how it goes."""

from __future__ import annotations

import os
import shutil
import threading
import time
from typing import NoReturn

LOOK_EVERY_S = 1.0
"""How often a process looks whether the one it works for is still there."""


def abandoned(parent: int, user: int) -> bool:
    """Whether this process lost its parent because the user's process ended.

    A warm parent may be killed alone; then its workers go on.
    """
    if os.getppid() == parent:
        return False
    try:
        os.kill(user, 0)
    except (ProcessLookupError, PermissionError):  # gone, or its number is somebody else's by now
        return True
    return False


def end_with_input() -> None:
    """Ends this process, with exit code 1, once standard input ends: whoever started it is gone.

    It is read past `sys.stdin`, whose lock would be in the way of an orderly end.
    """

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class Lifeline:
    """Ends this process with the user's, and leaves no files behind.

    Args:
        parent: Number of the process that started this one.
        user: Number of the user's process.

    Attributes:
        directory: Folder to remove at the end, once there is one.
    """

    def __init__(self, parent: int, user: int) -> None:
        self.directory: str | None = None
        self._parent = parent
        self._user = user

    def watch(self) -> None:
        """Looks from now on, in a thread."""
        threading.Thread(target=self._watch, daemon=True).start()

    def leave(self) -> NoReturn:
        """Removes the folder and exits."""
        if self.directory is not None:
            shutil.rmtree(self.directory, ignore_errors=True)
        os._exit(0)  # no destructors: libsumo's may take long on a large network

    def _watch(self) -> None:
        while not abandoned(self._parent, self._user):
            time.sleep(LOOK_EVERY_S)
        self.leave()
