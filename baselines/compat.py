"""Matrix of learners and environments: equal and unequal intersections, masks, real roads.

Every learner trains a little in each of the environments below, in a process of its own, so that
one that hangs or dies says so and harms no other. The matrix has what was found, the versions it
was found with, and how many decisions a second that is (training included; orders of magnitude).

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

from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, UgatMarlError
from ugat_marl.policies import BASELINES, learner_factory, library_of
from ugat_marl.testing import ToyTraffic

EPISODES = 3
PATIENCE_S = 900.0


def environment(name: str) -> Any:
    """The environment of a column."""
    if name.endswith("-v1"):
        return parallel_env(name, duration_s=120)
    words = name.split()
    return ToyTraffic(30, equal="equal" in words, masked="masks" in words)


COLUMNS = ("equal", "unequal", "equal masks", "unequal masks", "grid2x2-v1", "mixed-v1")


def attempt(learner: str, column: str) -> str:
    """Trains, plays an episode, and says how fast the training was."""
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
    """Runs the learners in all environments and prints the matrix.

    Attributes:
        learners: Names; all that are known, if none is given.
        only: Used by the command itself: one learner, its results as JSON.
        need_all: Count a library that is not installed as a failure.
    """

    learners: tuple[str, ...] = ()
    only: str = ""
    need_all: bool = False

    def run(self) -> int:
        """Returns 1 if something failed."""
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
            table.add_row(name, library_of(name), *cells)
        console = Console()
        console.width = max(console.width, 110)
        console.print(table)
        for line in errors:
            console.print(line, markup=False, soft_wrap=True)
        return int(failed)


def tried(learner: str, column: str) -> str:
    """The speed, or the error in one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return attempt(learner, column)
    except UgatMarlError as error:
        return " ".join(str(error).split())
    except Exception as error:  # noqa: BLE001 - libraries raise what they like
        return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def in_a_process(learner: str) -> dict[str, str]:
    """Train a learner in each environment and return what came of it."""
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
    """A cell."""
    if text.endswith("/s"):
        return text.removesuffix("/s")
    return "-" if "is not installed" in text else "fails"


if __name__ == "__main__":
    sys.exit(tyro.cli(Compat).run())
