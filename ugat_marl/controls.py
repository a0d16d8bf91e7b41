"""Policies to set beside UGAT's: where each is trained, from what, and for how many episodes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ugat_marl.learners.dqn import DQN
from ugat_marl.learners.dqn_config import DQNConfig
from ugat_marl.policy import AnyParallelEnv, Policy
from ugat_marl.training import Run


@dataclass(frozen=True)
class Control:
    """A policy to be trained without any grounding.

    Attributes:
        name: What the table calls it.
        env: Where it is trained.
        episodes: Of its life, those of direct transfer included where it goes on from there.
        from_direct: Whether it goes on from direct transfer, or begins from scratch.
        file: Where its learner is kept, in the folder of the run; "" for a name like its own.
        title: What its progress is called; "" for its name.
    """

    name: str
    env: AnyParallelEnv
    episodes: int
    from_direct: bool = True
    file: str = ""
    title: str = ""

    def learner_path(self, run: Run) -> Path:
        """Where its learner is saved every few episodes."""
        return run.directory / (self.file or f"{file_name(self.name)}-learner.pt")


def train_control(
    control: Control, config: DQNConfig, seed: int, run: Run, direct: Path, chunk: int
) -> Policy:
    """Trains until the learner has its episodes; where it was interrupted, it goes on.

    Args:
        control: What to train.
        config: Settings of the learner.
        seed: Root of every random choice.
        run: Where it is saved.
        direct: The learner of direct transfer.
        chunk: Episodes between two times it is saved.
    """
    learner = DQN.of(control.env, config, seed)
    progress = control.learner_path(run)
    if progress.exists():
        learner.load(progress)
    elif control.from_direct:
        learner.load(direct)
    left = control.episodes - learner.episodes
    with run.reporter.task(control.title or control.name, max(left, 0)) as advance:
        while left > 0:
            episodes = min(chunk, left)
            learner.learn(control.env, episodes, seed, lambda _number, _numbers: advance())
            learner.save(progress)
            left -= episodes
    return learner.policy()


def file_name(name: str) -> str:
    """The name of a policy as the name of a file."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")
