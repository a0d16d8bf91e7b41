"""Performs the jobs of a table: several at a time, each in a process of its own, resumable."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ugat_marl.errors import MeasurementError
from ugat_marl.files import require_writable, write_whole
from ugat_marl.paper.job import JOB, Job, Played, read_scores
from ugat_marl.progress import Reporter
from ugat_marl.training import locked

LOG = "job.log"
_TAIL = 400
"""Letters of a failed job's log that are shown."""


@dataclass(frozen=True)
class Planned:
    """A job and the folder it has among the others.

    Attributes:
        job: What to do.
        name: Of its folder: readable, and its digest, so that other settings have another folder.
    """

    job: Job
    name: str

    @property
    def short(self) -> str:
        """What a progress bar has room for."""
        job = self.job
        kind = job.ugat.grounding if job.ugat else job.kind
        return " ".join(
            filter(None, (kind, job.target, "" if job.seed is None else f"s{job.seed}"))
        )

    @classmethod
    def of(cls, job: Job) -> Planned:
        """The folder's name says what people look for, and ends in the digest."""
        kind = job.ugat.grounding if job.ugat else job.kind
        where = Path(job.scenario).name, kind, job.world or "", job.target or ""
        parts = [*where, "" if job.seed is None else f"s{job.seed}", job.digest]
        words = (re.sub(r"[^\w=+.]+", "-", part).strip("-.") for part in parts)
        return cls(job, "-".join(word for word in words if word))


def done(planned: Planned, folder: Path) -> Played | None:
    """The scores of a job, if it has all that it was to be played for."""
    scores = read_scores(folder / planned.name)
    job = planned.job
    wanted = [(domain, seed) for domain in job.domains for seed in job.evaluation_seeds]
    return scores if all(one in scores for one in wanted) else None


def perform_all(
    plan: Sequence[Planned], folder: Path, processes: int, reporter: Reporter, title: str
) -> None:
    """Performs what is not done yet; a job waits for the one it starts from.

    Args:
        plan: Jobs; one that several rows share is performed once.
        folder: Where their folders lie.
        processes: Jobs at a time.
        reporter: Shows progress.
        title: What to call the work there.

    Raises:
        MeasurementError: A job failed; its log says why. The others' results are kept.
        OptionError: Another process performs jobs in that folder.
    """
    plan = list({planned.name: planned for planned in plan}.values())
    left = [planned for planned in plan if done(planned, folder) is None]
    running: dict[str, tuple[Planned, subprocess.Popen[bytes]]] = {}
    require_writable(folder / LOG)
    lock = locked(folder)
    with reporter.task(title, len(plan)) as advance:
        for _ in range(len(plan) - len(left)):
            advance()
        try:
            while left or running:
                waited_for = {planned.name for planned in left} | set(running)
                free = [planned for planned in left if planned.job.start not in waited_for]
                for planned in free[: processes - len(running)]:
                    left.remove(planned)
                    running[planned.name] = planned, _begin(planned, folder)
                time.sleep(0.1)
                for name in [
                    n for n, (_, process) in running.items() if process.poll() is not None
                ]:
                    planned, _ = running.pop(name)
                    if done(planned, folder) is None:
                        raise MeasurementError(_failure(folder / name))
                    advance(note=planned.short)
        finally:
            for _, process in running.values():
                _end(process)
            lock.close()


def _begin(planned: Planned, folder: Path) -> subprocess.Popen[bytes]:
    own = folder / planned.name
    own.mkdir(parents=True, exist_ok=True)
    write_whole(own / JOB, json.dumps(asdict(planned.job), indent=1) + "\n")
    with (own / LOG).open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "ugat_marl.paper.job", str(own)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for this process; it ends the others itself
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    """A job whose input ends ends itself, with its simulations."""
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _failure(folder: Path) -> str:
    text = (folder / LOG).read_text(errors="replace").strip()
    return f"{folder.name} failed: {text[-_TAIL:]} (whole log: {folder / LOG})"
