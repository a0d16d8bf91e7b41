"""Checks of an environment's life: making, sending to a process, resetting, closing."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

from ugat_marl.envs import AnyParallelEnv
from ugat_marl.simulation import simulates_here
from ugat_marl.testing.episodes import EnvironmentCase, random_actions
from ugat_marl.testing.results import ConformanceError, Listening, require, said

_PATIENCE_S = 5.0


def nothing_starts_before_reset(case: EnvironmentCase) -> None:
    """Making an environment starts neither SUMO nor a process."""
    before, simulated = descendants(), simulates_here()
    case.make()
    require(
        simulates_here() == simulated and descendants() <= before,
        "making the environment started a simulation or a process; start it in reset(), since "
        "environments are made to look at their spaces, and copied to other processes",
    )


def environments_can_be_sent(case: EnvironmentCase) -> None:
    """Before `reset` an environment can be pickled, and its copy works."""
    case.need_episode()
    env = case.make()
    # What a worker process does. The bytes were made one line before: nothing foreign is unpickled.
    copy: AnyParallelEnv | None = None
    with Listening() as heard:
        copy = ForkingPickler.loads(ForkingPickler.dumps(env))  # pyright: ignore[reportAttributeAccessIssue]
    if heard.error is not None:
        raise ConformanceError(
            f"the environment cannot be pickled before reset() ({said(heard.error)}), so no vector "
            "environment can send it to a process; make files, sockets and lambdas in reset()"
        )
    assert copy is not None
    try:
        require(
            copy.possible_agents == env.possible_agents,
            f"the pickled copy has the agents {copy.possible_agents}; pickle the whole environment",
        )
        _attempt("reset() of a pickled copy", lambda: _a_step(copy, case.seed))
    finally:
        copy.close()


def reset_and_close_repeat(case: EnvironmentCase) -> None:
    """`reset` and `close` may be called at any time and any number of times."""
    case.need_episode()
    env = case.make()
    _attempt("close() before reset()", env.close)
    _attempt("reset() after close()", lambda: _a_step(env, case.seed))
    _attempt("reset() during an episode", lambda: env.reset(seed=case.seed))
    _attempt("reset() directly after reset()", lambda: _a_step(env, None))
    _attempt("close() during an episode", env.close)
    _attempt("close() after close()", env.close)
    _attempt("reset() after a second close()", lambda: _a_step(env, case.seed))
    env.close()


def _attempt(what: str, action: Callable[[], object]) -> None:
    with Listening() as heard:
        action()
    if heard.error is not None:
        raise ConformanceError(
            f"{what} fails: {said(heard.error)}; RLlib and TorchRL do that, so let it work"
        )


def _a_step(env: AnyParallelEnv, seed: int | None) -> None:
    _, infos = env.reset(seed=seed)
    env.step(random_actions(0)(0, env, infos))


def reset_takes_seed_and_options(case: EnvironmentCase) -> None:
    """`reset` takes the keywords `seed` and `options`, whatever is in the latter."""
    case.need_episode()
    env = case.make()
    with Listening() as heard:
        env.reset(seed=case.seed, options={"unknown": 1})
    if heard.error is not None:
        raise ConformanceError(
            f"reset(seed=..., options={{...}}) fails: {said(heard.error)}; accept both keywords "
            "and ignore options you do not know"
        )


def close_ends_processes(case: EnvironmentCase) -> None:
    """After `close` no process is left that `reset` started."""
    case.need_episode()
    before = descendants()
    env = case.make()
    env.reset(seed=case.seed)
    env.close()
    deadline = time.monotonic() + _PATIENCE_S
    while left := descendants() - before:
        if time.monotonic() > deadline:
            raise ConformanceError(
                f"{len(left)} process(es) {sorted(left)} still run {_PATIENCE_S:g} s after "
                "close(); end them there"
            )
        time.sleep(0.05)


def descendants() -> set[int]:
    """Processes below this one that are not zombies; none where the system does not tell."""
    found: set[int] = set()
    unseen = [os.getpid()]
    while unseen:
        process = unseen.pop()
        tasks: list[Path] = []
        with Listening():  # the process, or one of its tasks, may have ended meanwhile
            tasks += Path(f"/proc/{process}/task").glob("*/children")
        for task in tasks:
            with Listening():
                children = {int(child) for child in task.read_text().split()}
                unseen += children - found
                found |= children
    return {process for process in found if not _zombie(process)}


def _zombie(process: int) -> bool:
    with Listening():
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    return True


LIFE = (
    nothing_starts_before_reset,
    environments_can_be_sent,
    reset_takes_seed_and_options,
    reset_and_close_repeat,
    close_ends_processes,
)
