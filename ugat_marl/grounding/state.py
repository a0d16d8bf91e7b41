"""State of a run of Algorithm 1, and its checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from ugat_marl.data import Run, TransitionLog
from ugat_marl.errors import OptionError
from ugat_marl.policies import Learner, Policy


class Savable(Protocol):
    """Models or other fitted numbers that a checkpoint holds."""

    def save(self, path: Path) -> None:
        """Write everything to a file atomically."""
        ...

    def load(self, path: Path) -> None:
        """Restore a file of `save`."""
        ...


Saved = TypeVar("Saved", bound=Savable)


def is_kept(learner_or_policy: Any) -> bool:
    """Return True if a learner or policy can be saved; those of users may lack the methods."""
    return getattr(learner_or_policy, "savable", True)


_POLICIES = ("direct", "best")
"""Policies of a state; each has a file in a checkpoint."""
_COUNTERS = ("pretrained", "iteration", "earlier")
"""Counters of a state, in a checkpoint."""


@dataclass
class RunState(Generic[Saved]):
    """Complete state of a run, as stored in a checkpoint.

    Attributes:
        learner: Learner of the policy.
        transform: What is fitted: f, h and gate, or a street.
        direct: Policy after plain training, for direct transfer.
        best: Best policy so far in the fitted street; None where policies are not compared.
        simulated: Logs of D_sim.
        real: Logs of D_real.
        pretrained: Number of episodes of plain training so far.
        iteration: Number of completed iterations.
        earlier: Episodes of learners that the present one replaced, for the numbers in the metrics.
    """

    learner: Learner
    transform: Saved
    direct: Policy | None = None
    best: Policy | None = None
    simulated: list[TransitionLog] = field(default_factory=list)
    real: list[TransitionLog] = field(default_factory=list)
    pretrained: int = 0
    iteration: int = 0
    earlier: int = 0

    def policy(self) -> Policy:
        """Return the result so far: the best policy, or that of the learner."""
        return self.best or self.learner.policy()

    def save(self, run: Run) -> None:
        """Write a checkpoint into the run's folder; without a learner to keep, only the metrics.

        Raises:
            OptionError: The learner's policy has no method to save it.
        """
        if not is_kept(self.learner):
            run.write_metrics()
            return

        def write(folder: Path) -> None:
            self.learner.save(folder / "learner.pt")
            self.transform.save(folder / "grounding.pt")
            for name in _POLICIES:
                if (policy := getattr(self, name)) is not None:
                    _save_policy(policy, folder / f"{name}.pt")
            for name, logs in (("sim", self.simulated), ("real", self.real)):
                for number, log in enumerate(logs):
                    log.write(folder / f"{name}-{number:03}.parquet")

        run.save({name: getattr(self, name) for name in _COUNTERS}, write)

    def restore(
        self,
        run: Run,
        load_policy: Callable[[Path], Policy],
        prepare: Callable[[RunState[Saved]], object] = lambda _: None,
    ) -> None:
        """Restore the run's checkpoint into a fresh state; without one, nothing changes.

        Args:
            run: Folder of the run.
            load_policy: Reads direct transfer and the best policy.
            prepare: Called after the transform is restored and before the learner is, which it may
                replace by one that fits.

        Raises:
            CheckpointError: The checkpoint cannot be used.
            LogError: One of its logs cannot be used.
        """
        if not run.resumable:
            return

        def read(folder: Path) -> None:
            self.transform.load(folder / "grounding.pt")
            prepare(self)
            self.learner.load(folder / "learner.pt")
            for name in _POLICIES:
                if (folder / f"{name}.pt").exists():
                    setattr(self, name, load_policy(folder / f"{name}.pt"))
            self.simulated = _read_logs(folder, "sim")
            self.real = _read_logs(folder, "real")

        counters = run.restore(read)
        for name in _COUNTERS:
            setattr(self, name, int(counters[name]))


def _read_logs(folder: Path, name: str) -> list[TransitionLog]:
    return [TransitionLog.read(path) for path in sorted(folder.glob(f"{name}-*.parquet"))]


def _save_policy(policy: Any, path: Path) -> None:
    if not hasattr(policy, "save"):
        raise OptionError(
            f"a checkpoint needs policies that can be saved: give {type(policy).__name__} a method "
            "save(path)"
        )
    policy.save(path)
