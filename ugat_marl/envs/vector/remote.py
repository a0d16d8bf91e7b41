"""Environments of a vector, as the user's process sees them: each in a process of its own.

An episode is its domain, its seed and its actions. A process that dies is therefore replaced by one
that is given the three, and the user does not notice.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import weakref
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Scores
from ugat_marl.effects import Domain, describe
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.vector.arrays import Arrays, Shape, shared_memory
from ugat_marl.envs.vector.spec import DomainOf, Spec, Wraps, sent
from ugat_marl.errors import EpisodeError, SimulatorCrashed
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import ChannelClosed, Host, Worker

SERVICE = "ugat_marl.envs.vector.worker:Episodes"

DEATHS = 3
"""Times a process may die at the same decision before the user is told."""


@dataclass(frozen=True)
class Episode:
    """An episode, which `parallel_env` plays again: ``reset(seed=seed)`` in the domain.

    Attributes:
        number: Number of episodes the environment has begun before, since it was given a seed.
        seed: Of traffic and simulation.
        domain: Name of the domain.
    """

    number: int
    seed: int
    domain: str


@dataclass(frozen=True)
class Answer:
    """Answer of a process to a decision; the rest is in the arrays.

    Attributes:
        over: True if the episode has ended.
        scores: Its measures, if so.
        warnings: Texts of warnings.
    """

    over: bool
    scores: Scores | None
    warnings: tuple[str, ...]


def episode_seed(root: int, number: int) -> int:
    """Return the seed of an environment's episode; the first one has the seed the user gave."""
    return root if number == 0 else derive_seed(root, "vector", number)


class Shared:
    """Host, memory and folder that the environments of one vector share.

    Nothing is started or written before the first episode.

    Args:
        scenario: The scenario of all of them.
        options: Their options.
        wraps: Their wrappers.
        agents: Their agents.
        n: Number of environments.
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
        self.host = Host(SERVICE)
        self._scenario = scenario
        self._spec = Spec.of(scenario, options, wraps)
        self._folder: Path | None = None
        self._remove: weakref.finalize[..., Shared] | None = None
        self._memory = shared_memory(self.shape)
        self.arrays = Arrays.over(self._memory, self.shape)

    def start(self, domain: Domain, index: int) -> Worker:
        """Start a fresh process for an episode of an environment.

        Raises:
            EpisodeError: The vector is closed.
            SimulatorCrashed: No process can be started.
        """
        if self._memory < 0:
            raise EpisodeError("this vector_env is closed; make another one")
        folder = self._own_folder()
        directory = folder / f"environment-{index}"
        shutil.rmtree(directory, ignore_errors=True)  # of a process that was killed
        spec = {**self._spec.as_dict(), "scenario": str(folder / self._scenario.id)}
        order = {
            "spec": spec,
            "domain": sent(domain),
            "folder": str(folder),
            "directory": str(directory),
            "path": sys.path,
        }
        return self.host.start(order, (self._memory,))

    def close(self) -> None:
        """Give everything up, once the processes of all episodes have ended."""
        self.host.tell({"forget": str(self._folder)})
        self.host.close()
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


class RemoteEnv:
    """The episodes of one environment, each in a process of its own.

    Args:
        shared: The part it shares with the others.
        index: Its number among them.
        arrays: Its own part of the shared memory, without the first axis.

    Attributes:
        episode: The episode it is in, or was in; None before the first.
        over: True if there is none under way.
        pending: True if an answer is awaited.
    """

    def __init__(self, shared: Shared, index: int, arrays: Arrays) -> None:
        self.index = index
        self.arrays = arrays
        self.episode: Episode | None = None
        self.over = True
        self.pending = False
        self._shared = shared
        self._root: int | None = None
        self._domain: Domain = "sim"
        self._history: list[NDArray[np.int64]] = []
        self._deaths = 0
        self._worker: Worker | None = None

    def begin(self, seed: int | None, domain_of: DomainOf) -> None:
        """Ask for an episode: the first one under a seed, or the next one under the last seed."""
        if seed is not None or self._root is None:
            self._root = seed if seed is not None else int(np.random.default_rng().integers(2**31))
            number = 0
        else:
            number = 0 if self.episode is None else self.episode.number + 1
        self._domain = domain_of(self.index, number)
        self.episode = Episode(number, episode_seed(self._root, number), describe(self._domain))
        self._history = []
        self._deaths = 0
        self._start()

    def act(self, actions: NDArray[np.int64]) -> None:
        """Ask for a decision."""
        assert self._worker is not None
        self._history.append(actions)
        self.arrays.actions[:] = actions
        self.pending = True
        with contextlib.suppress(ChannelClosed):  # it is dead; `answer` will notice
            self._worker.ask("step")

    def answer(self) -> Answer:
        """Wait for the answer; a process that died is replaced.

        Raises:
            SimulatorError: SUMO failed; its own words are in the message.
            SimulatorCrashed: The processes die one after the other.
            WorkerError: The reward or the wrapper raised something.
        """
        while True:
            assert self._worker is not None
            try:
                reply = self._worker.answer().header
                break
            except ChannelClosed:
                self._replace()
            except BaseException:  # an error of the episode, or Ctrl-C: the process has ended
                self.close()
                raise
        self._deaths = 0
        self.pending = False
        self.over = reply["over"]
        scores = Scores(**reply["scores"]) if reply["scores"] is not None else None
        if self.over:
            self._end()
        return Answer(self.over, scores, tuple(reply["warnings"]))

    def close(self) -> None:
        """End the episode and its process; may be called again."""
        self.over, self.pending = True, False
        self._history = []
        self._end()

    def require_running(self) -> None:
        """Refuse a decision without an episode, or while an answer is awaited.

        Raises:
            EpisodeError: It is so.
        """
        if self.pending:
            raise EpisodeError(
                f"environment {self.index} is in the middle of a step; call step_wait() first"
            )
        if self.over:
            raise EpisodeError(
                f"environment {self.index} has no episode under way; call reset(), or "
                f"reset(where=[{self.index}]) for it alone"
            )

    def _start(self) -> None:
        """Start a process for the episode, which repeats the actions of the episode so far."""
        assert self.episode is not None
        self._end()
        shared = self._shared
        self._worker = shared.start(self._domain, self.index)
        self.over, self.pending = False, True
        size = len(self._history), len(shared.agents)
        history = np.array(self._history, dtype=np.float64).reshape(size)
        with contextlib.suppress(ChannelClosed):
            self._worker.ask(
                "begin",
                [history],
                seed=self.episode.seed,
                index=self.index,
                shape=asdict(shared.shape),
                agents={name: list(each) for name, each in asdict(shared.agents).items()},
            )

    def _replace(self) -> None:
        assert self._worker is not None
        worker, self._worker = self._worker, None
        obituary = worker.obituary(f"decision {len(self._history)} of {self.episode}")
        self._deaths += 1
        if self._deaths > DEATHS:
            self.close()
            raise SimulatorCrashed(
                f"{obituary}. It was replaced {DEATHS} times, and died each time"
            )
        self._start()

    def _end(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()


def _remove_tree(directory: Path, owner: int) -> None:
    """Remove a folder; not in a forked child, however."""
    if os.getpid() == owner:
        shutil.rmtree(directory, ignore_errors=True)
