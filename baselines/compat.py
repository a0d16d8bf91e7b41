"""Matrix of learners and environments: equal and unequal intersections, masks, real roads.

Every learner trains a few episodes in each of the environments below. It has its own process: a
learner that hangs or dies does not stop the others. The matrix shows the version of each library
and the speed in decisions per second, training included, or the failure. Speeds are orders of
magnitude.

    python baselines/compat.py
    python baselines/compat.py --learners sb3-ppo maskable-ppo
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from ugat_marl.cli import guarded
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, UgatMarlError
from ugat_marl.policies import (
    BASELINES,
    learner_factory,
    learner_library,
    require_known_learner,
)
from ugat_marl.testing import ToyTraffic

EPISODES = 3
PATIENCE_S = 900.0


def environment(name: str) -> Any:
    """Return the environment of a column."""
    if name.endswith("-v1"):
        return parallel_env(name, duration_s=120)
    words = name.split()
    return ToyTraffic(30, equal="equal" in words, masked="masks" in words)


COLUMNS = ("equal", "unequal", "equal masks", "unequal masks", "grid2x2-v1", "mixed-v1")


def attempt(learner: str, column: str) -> str:
    """Train, play an episode, and return the speed of the training in decisions per second."""
    with contextlib.closing(environment(column)) as env:
        made = learner_factory(learner)(env, 0)
        lengths: list[int] = []
        step, steps = env.step, [0]

        def counted(actions: Any) -> Any:
            steps[0] += 1
            return step(actions)

        env.step = counted
        begin = time.perf_counter()
        policy = made.learn(env, EPISODES, 0, lambda _, told: lengths.append(int(told["return"])))
        took = time.perf_counter() - begin
        observations, infos = env.reset(seed=1)
        while env.agents:
            observations, *_, infos = env.step(policy.act(observations, infos))
    if len(lengths) != EPISODES:
        raise OptionError(f"{len(lengths)} episodes in the place of {EPISODES}")
    return f"{steps[0] / took:.0f}/s"


@dataclass(frozen=True)
class Compat:
    """Run the learners in all environments and print the matrix.

    Attributes:
        learners: Names of learners; default: all.
        only: For internal use: run one learner and print its results as JSON.
        need_all: Count a library that is not installed as a failure.
    """

    learners: tuple[str, ...] = ()
    only: str = ""
    need_all: bool = False

    def __post_init__(self) -> None:
        for name in self.learners:
            require_known_learner(name)  # an unknown name is an error before anything trains

    def run(self) -> int:
        """Run the command; return 1 if something failed."""
        if self.only:
            print(json.dumps({column: tried(self.only, column) for column in COLUMNS}))
            return 0
        table = Table(title=f"{EPISODES} episodes of training, in decisions/s")
        for heading in ("learner", "library", *COLUMNS):
            table.add_column(heading)
        failed = False
        errors: list[str] = []
        for name in self.learners or BASELINES:
            found = in_a_process(name)
            for column, text in found.items():
                missing = "is not installed" in text
                if not text.endswith("/s") and (self.need_all or not missing):
                    failed = True
                    errors.append(f"{name}, {column}: {text}")
            cells = [short(found[column]) for column in COLUMNS]
            table.add_row(name, learner_library(name), *cells)
        console = Console()
        console.width = max(console.width, 110)
        console.print(table)
        for line in errors:
            console.print(line, markup=False, soft_wrap=True)
        return int(failed)


def tried(learner: str, column: str) -> str:
    """Return the result of `attempt`, or the error in one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return attempt(learner, column)
    except UgatMarlError as error:
        return " ".join(str(error).split())
    except Exception as error:  # noqa: BLE001 - libraries raise what they like
        return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def in_a_process(learner: str) -> dict[str, str]:
    """Train a learner in each environment, in another process; return the results by column."""
    command = [sys.executable, "-P", __file__, "--only", learner]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            env=one_thread,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return dict.fromkeys(COLUMNS, f"no end within {PATIENCE_S:.0f} s")
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        last = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        return dict.fromkeys(COLUMNS, f"exit code {done.returncode}: {last[:300]}")
    return json.loads(lines[-1])


def short(text: str) -> str:
    """Return a result in the form of a table's cell."""
    if text.endswith("/s"):
        return text.removesuffix("/s")
    return "-" if "is not installed" in text else "fails"


if __name__ == "__main__":
    sys.exit(guarded("compat.py", lambda: tyro.cli(Compat).run()))
