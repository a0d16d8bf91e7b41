"""Service of a vector of environments, in the worker processes of its host.

The host forks a process for every episode. That process resets the environment, repeats the actions
of a resumed episode, and then simulates decision by decision, with arrays in shared memory. The
host's parent process keeps each environment from its second use on, so forks need not make it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import random
import shutil
import sys
import tempfile
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.types import AnyParallelEnv
from ugat_marl.envs.unwrapping import as_traffic_env
from ugat_marl.envs.vector.arrays import Arrays, Shape
from ugat_marl.envs.vector.spec import Spec, agents_of
from ugat_marl.errors import EpisodeError, OptionError, ScenarioError
from ugat_marl.scenarios import confine, limit_memory
from ugat_marl.simulation import Message

_KEPT = 64
"""Number of environments that the parent keeps; the least recently used one is dropped."""


class Episodes:
    """Service of a vector: one episode in each worker.

    Making it loads libsumo: once, in the warm parent, for all workers.
    """

    def __init__(self) -> None:
        from ugat_marl.simulation import LibsumoSimulator  # its import loads libsumo

        del LibsumoSimulator
        self._kept: OrderedDict[str, tuple[str, AnyParallelEnv | None]] = OrderedDict()
        self._folders: set[str] = set()
        self._versions: dict[str, Sequence[int]] = {}
        self._ready: AnyParallelEnv | None = None

    def prepare(self, order: dict[str, Any]) -> None:
        """Make the environment in the parent at its second use.

        At the first use the worker makes it, because only a worker can report an error.
        """
        sys.path += [entry for entry in order["path"] if entry not in sys.path]
        folder = order["folder"]
        self._folders.add(folder)
        key = json.dumps([order["spec"], order["domain"]], sort_keys=True)
        if self._kept.get(key, (folder, None))[1] is None:
            self._forget_edited(order["spec"]["modules"])
        if key not in self._kept:
            self._kept[key] = folder, None
        elif self._kept[key][1] is None:
            with contextlib.suppress(Exception):
                self._kept[key] = folder, Spec(**order["spec"]).environment(order["domain"])
                gc.freeze()  # garbage collection in a child would copy every page
        self._kept.move_to_end(key)
        self._drop(list(self._kept)[:-_KEPT])
        self._ready = self._kept[key][1]

    def open(
        self, order: dict[str, Any], descriptors: Sequence[int]
    ) -> Callable[[Message], Message]:
        """Return the function that answers the messages of one episode."""
        tempfile.tempdir = order["directory"]
        Path(order["directory"]).mkdir(mode=0o700, exist_ok=True)
        (memory,) = descriptors
        return _EpisodeServer(memory, self._ready, order).answer

    def told(self, order: dict[str, Any]) -> None:
        """Forget the environments of a closed vector."""
        folder = order["forget"]
        self._folders.discard(folder)
        self._drop([key for key, (owner, _) in self._kept.items() if owner == folder])

    def _forget_edited(self, modules: Mapping[str, Sequence[int]]) -> None:
        """Forget modules that the user has edited since this process imported them."""
        for module, version in modules.items():
            if self._versions.setdefault(module, version) != version:
                self._versions[module] = version
                sys.modules.pop(module, None)
                importlib.invalidate_caches()

    def _drop(self, keys: Sequence[str]) -> None:
        dropped = [self._kept.pop(key) for key in keys]
        if any(env is not None for _, env in dropped):
            dropped.clear()
            gc.unfreeze()  # environments hold cycles, and what is frozen is never collected
            gc.collect()
            gc.freeze()

    def abandoned(self) -> None:
        """Remove the folders of vectors when their last worker has ended."""
        with contextlib.suppress(ChildProcessError):
            while True:
                os.wait()
        for folder in self._folders:
            shutil.rmtree(folder, ignore_errors=True)


class _EpisodeServer:
    """Server of one episode.

    Args:
        memory: Descriptor of the shared memory.
        env: The environment, if the parent has made it.
        order: Specification and domain, to make the environment otherwise.
    """

    def __init__(self, memory: int, env: AnyParallelEnv | None, order: dict[str, Any]) -> None:
        self._memory = memory
        self._env = env
        self._order = order
        self._warnings: list[str] = []
        warnings.showwarning = self._note

    def answer(self, question: Message) -> Message:
        """Begin the episode, or simulate a decision; errors are sent to the user."""
        if question.header["what"] == "begin":
            self._begin(question)
        else:
            self._step(self._arrays.actions[self._index])
        texts, self._warnings = self._warnings, []
        over = not self._running.agents
        return Message({"over": over, "scores": self._scores(), "warnings": texts}, [])

    def _begin(self, question: Message) -> None:
        header = question.header
        self._index: int = header["index"]
        if self._env is None:
            self._env = Spec(**self._order["spec"]).environment(self._order["domain"])
        if (agents := agents_of(self._env)) != header["agents"]:
            raise ScenarioError(
                f"domain {self._order['domain']} has other agents, observations or phases than the "
                f"first one of this vector_env: {agents}, not {header['agents']}"
            )
        self._running = self._env
        self._confine()
        self._agents = AgentSet.of(self._env)
        self._arrays = Arrays.over(self._memory, Shape(**header["shape"]))
        # Functions of the user may draw from these; a fork has the state of its parent.
        random.seed(header["seed"])
        np.random.seed(header["seed"] % 2**32)  # noqa: NPY002
        observations, infos = self._env.reset(seed=header["seed"])
        nothing = dict.fromkeys(self._agents.names, 0.0)
        none_shown = np.zeros(len(self._agents), dtype=np.int64)
        self._publish(observations, nothing, infos, none_shown)

    def _confine(self) -> None:
        """Confine this process to the files of its scenario, unless it runs functions of the user.

        Its memory is limited in any case. A user's reward, observation or wrapper may well write
        files of its own.
        """
        try:
            limit_memory()
        except ValueError as error:
            raise OptionError(str(error)) from None
        if not self._order["spec"]["modules"]:
            scenario = as_traffic_env(self._running).scenario
            files = [str(each.path) for each in scenario.documents if each.path is not None]
            confine([self._order["folder"], *files], [self._order["directory"]])

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
        """Return the measures of an ended episode; None if the environment has none."""
        base = as_traffic_env(self._running)
        if self._running.agents or not hasattr(base, "scores"):
            return None
        try:
            scores = base.scores()
        except EpisodeError:
            return None
        return asdict(scores)

    def _note(self, message: Warning | str, *_: Any, **__: Any) -> None:
        self._warnings.append(str(message))
