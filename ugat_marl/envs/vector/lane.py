"""One environment of a vector, as the user's process sees it.

An episode is its domain, its seed and its actions. A process that dies is therefore replaced by one
that is given the three, and the user does not notice.
"""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl import errors
from ugat_marl.data import Scores
from ugat_marl.effects import Domain, describe
from ugat_marl.envs.vector.arrays import Arrays
from ugat_marl.envs.vector.nursery import Home
from ugat_marl.envs.vector.spec import DomainOf
from ugat_marl.errors import EpisodeError, SimulatorCrashed, UgatMarlError, WorkerError
from ugat_marl.seeding import derive_seed
from ugat_marl.simulation import PATIENCE_S, ChannelClosed, Message, Worker

DEATHS = 3
"""So often a process may die at the same decision before the user is told."""


@dataclass(frozen=True)
class Episode:
    """An episode, which `parallel_env` plays again: ``reset(seed=seed)`` in the domain.

    Attributes:
        number: How many the environment has begun since it was last given a seed, less one.
        seed: Of traffic and simulation.
        domain: Name of the domain.
    """

    number: int
    seed: int
    domain: str


@dataclass(frozen=True)
class Answer:
    """What a process says of a decision; the rest is in the arrays.

    Attributes:
        over: Whether the episode is.
        scores: Its measures, if so.
        warnings: What was warned of.
    """

    over: bool
    scores: Scores | None
    warnings: tuple[str, ...]


def episode_seed(root: int, number: int) -> int:
    """The seed of an environment's episode; the first one has the seed the user gave."""
    return root if number == 0 else derive_seed(root, "vector", number)


class Lane:
    """The episodes of one environment, each in a process of its own.

    Args:
        home: What it shares with the others.
        index: Its number among them.
        arrays: Its own part of the shared memory, without the first axis.

    Attributes:
        episode: The episode it is in, or was in; None before the first.
        over: Whether there is none under way.
        asked: Whether an answer is awaited.
    """

    def __init__(self, home: Home, index: int, arrays: Arrays) -> None:
        self.index = index
        self.arrays = arrays
        self.episode: Episode | None = None
        self.over = True
        self.asked = False
        self._home = home
        self._root: int | None = None
        self._domain: Domain = "sim"
        self._history: list[NDArray[np.int64]] = []
        self._deaths = 0
        self._worker: Worker | None = None

    def begin(self, seed: int | None, domain_of: DomainOf) -> None:
        """Asks for an episode: the first one under a seed, or the next one under the last seed."""
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
        """Asks for a decision."""
        assert self._worker is not None
        self._history.append(actions)
        self.arrays.actions[:] = actions
        self.asked = True
        with contextlib.suppress(OSError):  # it is dead; `answer` will notice
            self._worker.channel.send(Message({"what": "step"}, []))

    def answer(self) -> Answer:
        """Waits for what was asked for; a process that died is replaced.

        Raises:
            SimulatorError: SUMO failed; its own words are in the message.
            SimulatorCrashed: The processes die one after the other.
            WorkerError: The reward or the wrapper raised something.
        """
        while True:
            assert self._worker is not None
            try:
                said = self._worker.channel.receive().header
                break
            except (ChannelClosed, OSError):
                self._replace()
            except BaseException:  # Ctrl-C between question and answer: the two no longer match
                self.close(0.0)
                raise
        self._deaths = 0
        self.asked = False
        if "error" in said:
            error = _raised(said, self._worker)
            self.close()
            raise error
        self.over = said["over"]
        scores = Scores(**said["scores"]) if said["scores"] is not None else None
        if self.over:
            self._end()
        return Answer(self.over, scores, tuple(said["warnings"]))

    def close(self, patience_s: float = PATIENCE_S) -> None:
        """Ends the episode and its process; may be called again."""
        self.over, self.asked = True, False
        self._history = []
        self._end(patience_s)

    def require_running(self) -> None:
        """Refuses a decision where there is no episode, or where an answer is awaited.

        Raises:
            EpisodeError: It is so.
        """
        if self.asked:
            raise EpisodeError(
                f"environment {self.index} is in the middle of a step; call step_wait() first"
            )
        if self.over:
            raise EpisodeError(
                f"environment {self.index} has no episode under way; call reset(), or "
                f"reset(where=[{self.index}]) for it alone"
            )

    def _start(self) -> None:
        """A fresh process for the episode, which repeats what was done in it so far."""
        assert self.episode is not None
        self._end()
        worker, directory = self._home.fork(self._domain, self.index)
        self._worker = worker
        self.over, self.asked = False, True
        question: dict[str, Any] = {
            "what": "begin",
            "seed": self.episode.seed,
            "index": self.index,
            "shape": asdict(self._home.shape),
            "agents": {name: list(each) for name, each in asdict(self._home.agents).items()},
            "directory": directory,
        }
        shape = len(self._history), len(self._home.agents)
        history = np.array(self._history, dtype=np.float64).reshape(shape)
        with contextlib.suppress(OSError):
            worker.channel.send(Message(question, [history]))

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

    def _end(self, patience_s: float = PATIENCE_S) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end(patience_s)


def _raised(said: dict[str, Any], worker: Worker) -> UgatMarlError:
    """The exception a process reports, of the nearest kind that takes a message."""
    for name in said["kinds"]:
        kind = getattr(errors, name, None)
        if kind is not None and name != "UnknownNameError":
            return kind(worker.in_full(said["error"]))
    return WorkerError(
        "an exception that is not the suite's own was raised in the process of a simulation, by "
        f"the reward or the wrapper:\n{said['error']}"
    )
