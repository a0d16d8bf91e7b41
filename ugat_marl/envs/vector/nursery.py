"""The user's end of the processes of a vector of environments.

A warm parent has the environments ready and forks a fresh process for every episode, which
simulates within itself: one process per simulation, and no episode sees what ran before.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import struct
import sys
import tempfile
import weakref
from pathlib import Path
from typing import Any, ClassVar

from ugat_marl.effects import Domain
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.vector.arrays import Arrays, Shape, shared_memory
from ugat_marl.envs.vector.spec import Spec, Wraps, sent
from ugat_marl.errors import EpisodeError, SimulatorCrashed
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import WarmParent, Worker

LENGTH = struct.Struct("<I")
"""Precedes what the parent is told in JSON."""


class Nursery(WarmParent):
    """The process that forks environments; one for all vectors of a user's process."""

    program: ClassVar[str] = "ugat_marl.envs.vector.worker"
    _current: ClassVar[Any] = None
    _told_of_forks: ClassVar[bool] = False

    def hatch(self, order: dict[str, Any], memory: int) -> Worker | None:
        """A process for an episode, or None if the parent is gone."""
        return self.fork((memory,), _framed({"what": "fork", **order}))

    def forget(self, folder: str) -> None:
        """What was kept for a vector that is closed."""
        self._tell({"what": "forget", "folder": folder})

    def end(self) -> None:
        """Ends the process; its workers go on. May be called again."""
        self._tell({"what": "bye"})
        super().end()

    def _tell(self, order: dict[str, Any]) -> None:
        if self._owner == os.getpid():
            with self._lock, contextlib.suppress(OSError):
                self._socket.sendall(b"f" + _framed(order))


class Home:
    """What the environments of one vector share: a parent, memory, a folder.

    Nothing is started or written before the first episode.

    Args:
        scenario: The scenario of all of them.
        options: Their options.
        wraps: Their wrappers.
        agents: Their agents.
        n: How many there are.
    """

    def __init__(
        self,
        scenario: Scenario,
        options: dict[str, Any],
        wraps: Wraps,
        agents: AgentSet,
        n: int,
    ) -> None:
        self.agents = agents
        self.shape = Shape(n, len(agents), agents.widest_observation, agents.most_actions)
        self._scenario = scenario
        self._spec = Spec.of(scenario, options, wraps)
        self._folder: Path | None = None
        self._remove: weakref.finalize[..., Home] | None = None
        self._memory = shared_memory(self.shape)
        self.arrays = Arrays.over(self._memory, self.shape)
        self._parent: Nursery | None = None

    def fork(self, domain: Domain, lane: int) -> tuple[Worker, str]:
        """A fresh process for an episode, and the folder for its files.

        Raises:
            EpisodeError: The vector is closed.
            SimulatorCrashed: No process can be started.
        """
        if self._memory < 0:
            raise EpisodeError("this vector_env is closed; make another one")
        folder = self._own_folder()
        spec = {**self._spec.as_dict(), "scenario": str(folder / self._scenario.id)}
        order = {"spec": spec, "domain": sent(domain), "folder": str(folder), "path": sys.path}
        for attempts_left in (1, 0):
            if self._parent is None or not self._parent.alive:
                self._parent = Nursery.acquire()
            worker = self._parent.hatch(order, self._memory)
            if worker is not None:
                own = folder / f"lane-{lane}"
                shutil.rmtree(own, ignore_errors=True)  # of one that was killed
                return worker, str(own)
            self._parent.end()
            if not attempts_left:
                break
        raise SimulatorCrashed(
            "the process that starts the environments of a vector_env cannot be started or was "
            "killed twice (out of memory?); its own words are above, if it had any"
        )

    def close(self) -> None:
        """Gives everything up, once the processes of all episodes have ended."""
        parent, self._parent = self._parent, None
        if parent is not None:
            parent.forget(str(self._folder))
            parent.release()
        memory, self._memory = self._memory, -1
        if memory >= 0:
            os.close(memory)
        if self._remove is not None:
            self._remove()

    def _own_folder(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="ugat_marl-"))
            self._remove = weakref.finalize(self, _remove_tree, self._folder, os.getpid())
            self._scenario.write(self._folder / self._scenario.id)
        return self._folder


def _framed(order: dict[str, Any]) -> bytes:
    text = json.dumps(order).encode()
    return LENGTH.pack(len(text)) + text


def _remove_tree(directory: Path, owner: int) -> None:
    """Removes a folder; not in a forked child, however."""
    if os.getpid() == owner:
        shutil.rmtree(directory, ignore_errors=True)
