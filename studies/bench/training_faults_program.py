"""Measured program: short trainings with one fault each, resumed, against an unbroken one.

Each training is a forked copy of this process, so that libraries are loaded once. This process
itself uses none of them, since a fork would copy their locks but not their threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import mmap
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from studies.bench.memory_program import family, processes
from ugat_marl.errors import UgatMarlError
from ugat_marl.experiments import TransferConfig, transfer
from ugat_marl.grounding import FitConfig, UgatConfig
from ugat_marl.policies import DQNConfig
from ugat_marl.progress import Silent
from ugat_marl.simulation.host import DEADLINE_VARIABLE

KINDS = (
    "kill -9", "interrupt", "stopped", "simulation killed", "simulation stopped", "full disk",
    "few descriptors",
)  # fmt: skip
_DEADLINE_S = 5.0
"""Time after which a stopped simulation counts as dead, s."""
_PATIENCE_S = 300.0


class Steps(Silent):
    """Reporter that counts steps where another process can read them."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, 8)

    @property
    def count(self) -> int:
        """Number of steps so far."""
        return int.from_bytes(self._memory[:8], "little")

    def clear(self) -> None:
        """Begin at 0."""
        self._memory[:8] = bytes(8)

    def _add(self) -> None:
        self._memory[:8] = (self.count + 1).to_bytes(8, "little")

    @contextlib.contextmanager
    def task(self, name: str, total: int) -> Iterator[Any]:
        """Count the start of a task and its steps."""
        self._add()
        yield lambda note="": self._add()


def short_training() -> TransferConfig:
    """Return a training of two seconds."""
    return TransferConfig(
        scenario="single-v1",
        real="V4",
        duration_s=60,
        evaluation_seeds=1,
        tuning_seeds=1,
        control=False,
        learner="dqn",
        ugat=UgatConfig(
            grounding="phase",
            pretrain_episodes=11,
            iterations=1,
            grounded_episodes=2,
            sim_rollouts=1,
            real_rollouts=1,
            least_accuracy=None,
            fit=FitConfig(epochs=2),
        ),
        dqn=DQNConfig(warmup_decisions=5, epsilon_decay_decisions=50),
    )


def digests(folder: Path) -> dict[str, str]:
    """Return file to a hash of its content."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and path.name != ".lock":
            content = path.read_bytes()
            if path.suffix == ".pt":  # torch writes the name of the temporary file into it
                content = repr(_plain(torch.load(path, weights_only=True))).encode()
            found[name] = hashlib.sha256(content).hexdigest()
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return str(value.dtype), tuple(value.shape), value.numpy().tobytes()
    if isinstance(value, dict):
        return [(repr(key), _plain(item)) for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


class Trainings:
    """Trainings in forked processes.

    Args:
        folder: Folder for the runs.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.steps = Steps()

    def run(self, place: Path, fault: Callable[[int], None] | None = None) -> str:
        """Train, or resume what is there; return how it ended.

        Args:
            place: Folder of the run.
            fault: Function that disturbs the process with this number; it is called once.
        """
        said = self._folder / "said.json"
        said.unlink(missing_ok=True)
        self.steps.clear()
        pid = os.fork()
        if pid == 0:
            self._train(place, said)
        if fault is not None:
            fault(pid)
        status = self._waited(pid)
        if status is None:
            return "hang"
        if os.WIFSIGNALED(status):
            return f"signal {os.WTERMSIG(status)}"
        told = json.loads(said.read_text()) if said.exists() else {"error": "nothing said"}
        return told["error"]

    def _train(self, place: Path, said: Path) -> None:
        os.setsid()
        error, found = "", {}
        try:
            transfer(short_training(), place, resume=place.exists(), reporter=self.steps)
            found = digests(place)
        except (UgatMarlError, OSError, KeyboardInterrupt) as raised:
            error = f"{type(raised).__name__}: {raised}"
        except BaseException:  # noqa: BLE001 - a fault of the suite
            error = "traceback: " + traceback.format_exc(limit=-3)
        _unlimited(os.getpid())
        said.write_text(json.dumps({"error": error or "done"}))
        if found:
            (self._folder / "digests.json").write_text(json.dumps(found))
        os._exit(0)

    @staticmethod
    def _waited(pid: int) -> int | None:
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                return status
            time.sleep(0.01)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return None


def inject(kind: str, pid: int, rng: random.Random) -> int:
    """Do what a fault says to a process; return the number of a process that stays stopped."""
    if kind == "kill -9":
        os.kill(pid, signal.SIGKILL)
    elif kind == "interrupt":
        os.kill(pid, signal.SIGINT)
    elif kind == "stopped":
        os.kill(pid, signal.SIGSTOP)
        time.sleep(rng.uniform(0.2, 2.0))
        os.kill(pid, signal.SIGCONT)
    elif kind.startswith("simulation"):
        children = sorted(set(family(processes(), pid)) - {pid})
        if children:
            chosen = rng.choice(children)
            stop = kind == "simulation stopped"
            os.kill(chosen, signal.SIGSTOP if stop else signal.SIGKILL)
            return chosen if stop else 0
    elif kind == "full disk":
        most = rng.choice([0, 1000, 10_000, 30_000])
        _limit(pid, resource.RLIMIT_FSIZE, most)
    elif kind == "few descriptors":
        taken = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        _limit(pid, resource.RLIMIT_NOFILE, taken + rng.randint(0, 3))
    return 0


def _limit(pid: int, what: int, most: int) -> None:
    _, hard = resource.prlimit(pid, what)
    resource.prlimit(pid, what, (most, hard))


def _unlimited(pid: int) -> None:
    for what in (resource.RLIMIT_FSIZE, resource.RLIMIT_NOFILE):
        _limit(pid, what, resource.prlimit(pid, what)[1])


def disturbed(trainings: Trainings, place: Path, kind: str, at: int, rng: random.Random) -> str:
    """Train with one fault at a step; return how that ended."""
    stopped: list[int] = []

    def fault(pid: int) -> None:
        until = time.monotonic() + _PATIENCE_S
        while trainings.steps.count < at and time.monotonic() < until:
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return  # it ended before
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.05))
        with contextlib.suppress(ProcessLookupError, FileNotFoundError):
            stopped.append(inject(kind, pid, rng))

    ended = trainings.run(place, fault)
    for pid in filter(None, stopped):  # so that it can end, if the training did not kill it
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    return ended


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Train once without and `faults` times with a fault; compare all files."""
    os.environ[DEADLINE_VARIABLE] = str(_DEADLINE_S)
    folder = Path(tempfile.mkdtemp(prefix="training-faults-"))
    trainings = Trainings(folder)
    if (ended := trainings.run(folder / "unbroken")) != "done":
        raise RuntimeError(f"the unbroken training ended: {ended}")
    expected = json.loads((folder / "digests.json").read_text())
    steps = trainings.steps.count
    rows: list[dict[str, Any]] = []
    until = time.monotonic() + request["most_s"]
    for number in range(request["faults"]):
        if time.monotonic() > until:
            break
        rng = random.Random(f"{request['seed']} {number}")
        kind, at = KINDS[number % len(KINDS)], rng.randint(0, steps)
        place = folder / f"run{number}"
        first = disturbed(trainings, place, kind, at, rng)
        (folder / "digests.json").unlink(missing_ok=True)
        resumed = trainings.run(place)
        found = {}
        if resumed == "done":
            found = json.loads((folder / "digests.json").read_text())
        wrong = sorted(
            name for name in {*found, *expected} if found.get(name) != expected.get(name)
        )
        shutil.rmtree(place, ignore_errors=True)
        rows.append({"kind": kind, "at": at, "first": first, "resumed": resumed, "wrong": wrong})
    shutil.rmtree(folder)
    return {"steps": steps, "files": len(expected), "rows": rows}


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(measure(json.loads(Path(sys.argv[1]).read_text()))))
