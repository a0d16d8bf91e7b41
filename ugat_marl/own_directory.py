"""A folder for one simulation at a time, gone with whoever it belongs to."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
import weakref
from pathlib import Path


class OwnDirectory:
    """Names a fresh folder for every simulation, and removes the one before.

    The last one goes with this object; not when a forked child lets go of its copy, however.
    """

    def __init__(self) -> None:
        self._remove: weakref.finalize[..., OwnDirectory] | None = None

    def fresh(self) -> Path:
        """The path of another folder; whoever uses it makes it."""
        self.remove()
        directory = Path(tempfile.gettempdir()) / f"ugat_marl-{secrets.token_hex(8)}"
        self._remove = weakref.finalize(self, _remove_tree, directory, os.getpid())
        return directory

    def remove(self) -> None:
        """Removes the folder, if there is one."""
        remove, self._remove = self._remove, None
        if remove is not None:
            remove()


def _remove_tree(directory: Path, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(directory, ignore_errors=True)
