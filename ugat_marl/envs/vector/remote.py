"""Environments of a vector in the user's process; each runs in its own worker process.

Domain, seed and actions determine an episode. A process that dies is therefore replaced by one that
repeats them, without a difference for the user.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Scores
from ugat_marl.effects import Domain, domain_label
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.vector.arrays import Arrays, Shape, shared_memory
from ugat_marl.envs.vector.spec import DomainOf, Spec, Wraps, sent
from ugat_marl.errors import EpisodeError, SimulatorCrashed
from ugat_marl.files import OwnDirectory
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import ChannelClosed, Host, Worker

SERVICE = "ugat_marl.envs.vector.worker:Episodes"

DEATHS = 3
"""Number of replaced processes at one decision after which an error is raised."""


@dataclass(frozen=True)
class Episode:
    """An episode; ``reset(seed=seed)`` of `parallel_env` in its domain repeats it.

    Attributes:
        number: Number of earlier episodes of the environment since it was given a seed.
        seed: Seed of traffic and simulation.
        domain: Name of the domain. For a list of effects it holds their numbers to 12 digits; only
            the list itself repeats the episode exactly.
    """

    number: int
    seed: int
    domain: str


@dataclass(frozen=True)
class Answer:
    """Answer of a process to a decision; observations and rewards are in the arrays.

    Attributes:
        over: True if the episode has ended.
        scores: Measures of an ended episode, else None.
        warnings: Texts of warnings.
    """

    over: bool
    scores: Scores | None
    warnings: tuple[str, ...]


def episode_seed(root: int, number: int) -> int:
    """Return the seed of an environment's episode; the first one has the user's seed."""
    return root if number == 0 else derive_seed(root, "vector", number)


class Shared:
    """Host, memory and folder that the environments of one vector share.

    Nothing is started or written before the first episode.

    Args:
        scenario: Scenario of the environments.
        options: Options of the environments.
        wraps: Wrappers of the environments.
        agents: Agents of each environment.
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
        self.host = Host(SERVICE, deadline_s=options.get("deadline_s"))
        self._scenario = scenario
        self._spec = Spec.of(scenario, options, wraps)
        self._folder: Path | None = None
        self._directory = OwnDirectory()
        self._memory = shared_memory(self.shape)
        self._owner = os.getpid()
        self.arrays = Arrays.over(self._memory, self.shape)

    def start(self, domain: Domain, index: int) -> Worker:
        """Start a fresh process for an episode of an environment.

        Raises:
            EpisodeError: The vector is closed, or belongs to another process.
            SimulatorCrashed: No process can be started.
        """
        self.require_own()
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

    def require_own(self) -> None:
        """Refuse a forked child, which would step and replace the simulations of its parent.

        Raises:
            EpisodeError: This vector belongs to another process.
        """
        if self._owner != os.getpid():
            raise EpisodeError(
                "this vector_env belongs to another process, of which this one is a fork; make "
                "another one here"
            )

    def close(self) -> None:
        """Release host, memory and folder, after the processes of all episodes have ended."""
        self.host.tell({"forget": str(self._folder)})
        self.host.close()
        memory, self._memory = self._memory, -1
        if memory >= 0:
            os.close(memory)
        self._directory.remove()

    def _own_folder(self) -> Path:
        if self._folder is None:
            self._folder = self._directory.fresh()
            self._folder.mkdir(mode=0o700)
            self._scenario.write(self._folder / self._scenario.id)
        return self._folder


class RemoteEnv:
    """Episodes of one environment, each in its own process.

    Args:
        shared: Host, memory and folder of the vector.
        index: Number of the environment.
        arrays: Its part of the shared memory, without the first axis.

    Attributes:
        episode: Current or last episode; None before the first.
        over: True if no episode is running.
        pending: True while an answer is missing.
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
        self._to_repeat: list[NDArray[np.int64]] = []  # by a process that replaces another one
        self._deaths = 0
        self._worker: Worker | None = None

    def begin(self, seed: int | None, domain_of: DomainOf) -> None:
        """Ask for an episode: the first one of a new seed, or the next one of the last seed."""
        if seed is not None or self._root is None:
            self._root = seed if seed is not None else int(np.random.default_rng().integers(2**31))
            number = 0
        else:
            number = 0 if self.episode is None else self.episode.number + 1
        self._domain = domain_of(self.index, number)
        self.episode = Episode(number, episode_seed(self._root, number), domain_label(self._domain))
        self._history = []
        self._deaths = 0
        self._start()

    def act(self, actions: NDArray[np.int64]) -> None:
        """Ask for a decision."""
        self._history.append(actions)
        self.pending = True
        self._ask(actions)

    def _ask(self, actions: NDArray[np.int64]) -> None:
        worker = self.worker
        self.arrays.actions[:] = actions
        with contextlib.suppress(ChannelClosed):  # `answer` replaces a dead process
            worker.ask("step")

    @property
    def worker(self) -> Worker:
        """The process of the running episode.

        Raises:
            EpisodeError: This vector belongs to another process.
        """
        self._shared.require_own()
        assert self._worker is not None
        return self._worker

    def answer(self) -> Answer:
        """Wait for the answer; a process that died is replaced.

        Raises:
            SimulatorError: SUMO failed; the message contains its output.
            SimulatorCrashed: Several processes in a row died.
            WorkerError: The reward or a wrapper raised an error.
        """
        while (answer := self.answer_or_replace()) is None:
            pass
        return answer

    def answer_or_replace(self) -> Answer | None:
        """Wait for the answer; None while another process repeats the episode of one that died.

        Raises:
            SimulatorError: SUMO failed; the message contains its output.
            SimulatorCrashed: Several processes in a row died.
            WorkerError: The reward or a wrapper raised an error.
        """
        try:
            reply = self.worker.answer().header
        except ChannelClosed:
            self._replace()
            return None
        except BaseException:  # an error of the episode, or Ctrl-C: the process has ended
            self.close()
            raise
        if self._to_repeat:
            self._ask(self._to_repeat.pop(0))
            return None
        self._deaths = 0
        self.pending = False
        self.over = reply["over"]
        scores = Scores(**reply["scores"]) if reply["scores"] is not None else None
        if self.over:
            self._end()
        return Answer(self.over, scores, tuple(reply["warnings"]))

    def close(self) -> None:
        """End the episode and its process; a second call does nothing."""
        self.over, self.pending = True, False
        self._history = []
        self._end()

    def require_running(self, number: int) -> None:
        """Refuse a decision without an episode, or while an answer is missing.

        Args:
            number: Number of the environment in the vector that asks, for messages.

        Raises:
            EpisodeError: No episode is running, or an answer is missing.
        """
        if self.pending:
            raise EpisodeError(
                f"environment {number} is in the middle of a step; call step_wait() or recv() first"
            )
        if self.over:
            raise EpisodeError(
                f"environment {number} has no episode under way; call reset(), or "
                f"reset(where=[{number}]) for it alone"
            )

    def _start(self) -> None:
        """Start a process for the episode, which repeats the decisions of the episode so far.

        Each decision is a question of its own, since the deadline is that of one decision.
        """
        assert self.episode is not None
        self._end()
        shared = self._shared
        self._worker = shared.start(self._domain, self.index)
        self.over, self.pending = False, True
        self._to_repeat = list(self._history)
        with contextlib.suppress(ChannelClosed):
            self._worker.ask(
                "begin",
                seed=self.episode.seed,
                index=self.index,
                shape=asdict(shared.shape),
                agents={name: list(each) for name, each in asdict(shared.agents).items()},
            )

    def _replace(self) -> None:
        assert self._worker is not None
        worker, self._worker = self._worker, None
        crash_message = worker.crash_message(f"decision {len(self._history)} of {self.episode}")
        self._deaths += 1
        if self._deaths > DEATHS:
            self.close()
            raise SimulatorCrashed(
                f"{crash_message}. It was replaced {DEATHS} times, and died each time"
            )
        try:
            self._start()
        except BaseException:  # there is no process to ask
            self.close()
            raise

    def _end(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()
