"""State of a run of Algorithm 1, and its checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ugat_marl.data import Run, TransitionLog
from ugat_marl.errors import OptionError
from ugat_marl.grounding.transform import Transform
from ugat_marl.policies import Learner, Policy


@dataclass
class State:
    """Everything of a run that a checkpoint holds.

    Attributes:
        learner: The policy in training.
        transform: f, h and gate.
        direct: The policy after plain training: direct transfer.
        simulated: D_sim.
        real: D_real.
        pretrained: Episodes of plain training so far.
        iteration: Iterations completed.
    """

    learner: Learner
    transform: Transform
    direct: Policy | None = None
    simulated: list[TransitionLog] = field(default_factory=list)
    real: list[TransitionLog] = field(default_factory=list)
    pretrained: int = 0
    iteration: int = 0

    def save(self, run: Run) -> None:
        """Write a checkpoint into the run's folder.

        Raises:
            OptionError: The learner's policy has no method to save it.
        """

        def write(folder: Path) -> None:
            self.learner.save(folder / "learner.pt")
            self.transform.save(folder / "grounding.pt")
            if self.direct is not None:
                _save_policy(self.direct, folder / "direct.pt")
            for name, logs in (("sim", self.simulated), ("real", self.real)):
                for number, log in enumerate(logs):
                    log.write(folder / f"{name}-{number:03}.parquet")

        run.save({"pretrained": self.pretrained, "iteration": self.iteration}, write)

    def restore(self, run: Run, load_policy: Callable[[Path], Policy]) -> None:
        """Bring a fresh state to where the run's checkpoint stands, if there is one.

        Raises:
            CheckpointError: The checkpoint cannot be used.
            LogError: One of its logs cannot.
        """
        if not run.resumable:
            return

        def read(folder: Path) -> None:
            self.learner.load(folder / "learner.pt")
            self.transform.load(folder / "grounding.pt")
            if (folder / "direct.pt").exists():
                self.direct = load_policy(folder / "direct.pt")
            self.simulated = _read_logs(folder, "sim")
            self.real = _read_logs(folder, "real")

        counters = run.restore(read)
        self.pretrained = int(counters["pretrained"])
        self.iteration = int(counters["iteration"])


def _read_logs(folder: Path, name: str) -> list[TransitionLog]:
    return [TransitionLog.read(path) for path in sorted(folder.glob(f"{name}-*.parquet"))]


def _save_policy(policy: Any, path: Path) -> None:
    if not hasattr(policy, "save"):
        raise OptionError(
            f"a checkpoint needs policies that can be saved: give {type(policy).__name__} a method "
            "save(path)"
        )
    policy.save(path)
