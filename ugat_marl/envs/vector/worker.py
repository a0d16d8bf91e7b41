"""The other end of `ugat_marl.envs.vector.nursery`: what runs in the processes it starts.

The parent makes an environment that is asked for a second time once and for all, and forks a
process for every episode. That process resets the environment, repeats the actions of an episode
that is taken up again, and then plays decision by decision, with its arrays in shared memory.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import traceback
import warnings
from collections import OrderedDict
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Scores
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.types import AnyParallelEnv
from ugat_marl.envs.vector.arrays import Arrays, Shape
from ugat_marl.envs.vector.nursery import LENGTH
from ugat_marl.envs.vector.spec import Spec, agents_of
from ugat_marl.errors import EpisodeError, ScenarioError, UgatMarlError
from ugat_marl.simulation import LOOK_EVERY_S, Channel, ChannelClosed, Lifeline, Message, abandoned

_KEPT = 64
"""Environments the parent keeps; one is remade if so many others were asked for since."""


class _Kept:
    """Environments that are ready to be forked; one is kept when it is asked for again."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, tuple[str, AnyParallelEnv | None]] = OrderedDict()
        self.folders: set[str] = set()

    def get(self, order: dict[str, Any]) -> AnyParallelEnv | None:
        """The environment, or None if the child is to make it, the better to be told its errors."""
        folder = order["folder"]
        self.folders.add(folder)
        key = json.dumps([order["spec"], order["domain"]], sort_keys=True)
        if key not in self._kept:
            self._kept[key] = folder, None
        elif self._kept[key][1] is None:
            with contextlib.suppress(Exception):
                self._kept[key] = folder, Spec(**order["spec"]).environment(order["domain"])
                gc.freeze()  # collecting garbage in a child would copy every page
        self._kept.move_to_end(key)
        while len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return self._kept[key][1]

    def forget(self, folder: str) -> None:
        """What belongs to a vector that is closed."""
        self.folders.discard(folder)
        for key in [key for key, (own, _) in self._kept.items() if own == folder]:
            del self._kept[key]
        gc.collect()


class _EpisodeServer:
    """Serves one episode until its line closes.

    Args:
        channel: The line to the user's process.
        memory: Descriptor of the shared memory.
        env: The environment, if the parent has it ready.
        order: What to make it of, if not.
        parent: Number of the parent.
        user: Number of the user's process.
    """

    def __init__(
        self,
        channel: Channel,
        memory: int,
        env: AnyParallelEnv | None,
        order: dict[str, Any],
        parent: int,
        user: int,
    ) -> None:
        self._channel = channel
        self._memory = memory
        self._env = env
        self._order = order
        self._life = Lifeline(parent, user)
        self._warnings: list[str] = []

    def run(self) -> NoReturn:
        """Answers questions, then removes the simulation's files and exits."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        self._life.watch()
        warnings.showwarning = self._note
        with contextlib.suppress(ChannelClosed, OSError):
            while (question := self._channel.receive()).header["what"] != "close":
                self._channel.send(Message(self._answer(question), []))
        self._life.leave()

    def _answer(self, question: Message) -> dict[str, Any]:
        try:
            if question.header["what"] == "begin":
                self._begin(question)
            else:
                self._step(self._arrays.actions[self._index])
            told, self._warnings = self._warnings, []
            return {"over": not self._running.agents, "scores": self._scores(), "warnings": told}
        except UgatMarlError as error:
            kinds = [kind.__name__ for kind in type(error).__mro__]
            return {"error": str(error), "kinds": kinds}
        except Exception:  # noqa: BLE001 - the user's reward or wrapper; the user is told all
            return {"error": traceback.format_exc(limit=-5), "kinds": []}

    def _begin(self, question: Message) -> None:
        asked = question.header
        self._index: int = asked["index"]
        self._life.directory = tempfile.tempdir = asked["directory"]
        Path(asked["directory"]).mkdir(mode=0o700, exist_ok=True)
        if self._env is None:
            self._env = Spec(**self._order["spec"]).environment(self._order["domain"])
        if (found := agents_of(self._env)) != asked["agents"]:
            raise ScenarioError(
                f"domain {self._order['domain']} has other agents, observations or phases than the "
                f"first one of this vector_env: {found}, not {asked['agents']}"
            )
        self._running = self._env
        self._agents = AgentSet.of(self._env)
        self._arrays = Arrays.over(self._memory, Shape(**asked["shape"]))
        observations, infos = self._env.reset(seed=asked["seed"])
        nothing = dict.fromkeys(self._agents.names, 0.0)
        none_shown = np.zeros(len(self._agents), dtype=np.int64)
        self._publish(observations, nothing, infos, none_shown)
        (history,) = question.arrays
        for row in history.astype(np.int64):
            self._step(row)

    def _step(self, actions: NDArray[np.int64]) -> None:
        observations, rewards, _, _, infos = self._running.step(self._agents.actions(actions))
        self._publish(observations, rewards, infos, actions)

    def _publish(
        self, observations: Any, rewards: Any, infos: Any, actions: NDArray[np.int64]
    ) -> None:
        arrays, row, names = self._arrays, self._index, self._agents.names
        arrays.observations[row] = self._agents.stack(observations)
        arrays.masks[row] = self._agents.masks(infos)
        arrays.rewards[row] = [rewards[name] for name in names]
        arrays.executed[row] = [
            infos[name].get("executed_action", action)
            for name, action in zip(names, actions, strict=True)
        ]

    def _scores(self) -> dict[str, float] | None:
        """The measures of an episode that has ended, if the environment has such."""
        base: Any = self._running.unwrapped
        if self._running.agents or not hasattr(base, "scores"):
            return None
        try:
            scores: Scores = base.scores()
        except EpisodeError:
            return None
        return asdict(scores)

    def _note(self, message: Warning | str, *_: Any, **__: Any) -> None:
        self._warnings.append(str(message))


def _serve(descriptor: int, user: int) -> None:
    """The parent: forks a process for every order that arrives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers leave no zombies
    here, kept = os.getpid(), _Kept()
    with socket.socket(fileno=descriptor) as control, contextlib.suppress(ConnectionError):
        while (request := _next(control, user)) is not None:
            order, descriptors = request
            if order["what"] == "bye":
                return
            if order["what"] == "forget":
                kept.forget(order["folder"])
                continue
            sys.path += [entry for entry in order["path"] if entry not in sys.path]
            env = kept.get(order)
            pid = os.fork()
            if pid == 0:
                control.close()
                line, said, memory = descriptors
                os.dup2(said, 1)
                os.dup2(said, 2)
                end = socket.socket(fileno=line)
                channel = Channel(end.makefile("rb"), end.makefile("wb"), end.close)
                _EpisodeServer(channel, memory, env, order, here, user).run()
            for number in descriptors:
                os.close(number)
            control.sendall(pid.to_bytes(8, "little"))
    _tidy(kept.folders)


def _next(control: socket.socket, user: int) -> tuple[dict[str, Any], list[int]] | None:
    """The next order and the open files that came with it; None if the user's process is gone."""
    control.settimeout(LOOK_EVERY_S)
    while True:
        try:
            first, descriptors, _, _ = socket.recv_fds(control, 1, 3)
            break
        except TimeoutError:
            if abandoned(user, user):
                return None
    control.settimeout(None)
    if not first:
        return None
    length = _exactly(control, LENGTH.size)
    return json.loads(_exactly(control, LENGTH.unpack(length)[0])), descriptors


def _exactly(control: socket.socket, count: int) -> bytes:
    found = b""
    while len(found) < count:
        more = control.recv(count - len(found))
        if not more:
            raise ConnectionError
        found += more
    return found


def _tidy(folders: set[str]) -> None:
    """The user's process was killed: what it would have removed goes when the last child has."""
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    _serve(int(sys.argv[2]), int(sys.argv[3]))
