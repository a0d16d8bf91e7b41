"""Performs the jobs of a table: several at a time, each in a process of its own, resumable.

A job is described in its folder and leaves its results there, so that an executor whose workers are
elsewhere needs a file system they have in common.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass
from pathlib import Path

from ugat_marl.data import locked
from ugat_marl.errors import MeasurementError
from ugat_marl.experiments.paper.job import JOB, Job, Played, read_scores
from ugat_marl.files import require_writable, write_whole
from ugat_marl.parallel import Stop, Workers, executor_of
from ugat_marl.progress import Reporter

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
    plan: Sequence[Planned], folder: Path, workers: Workers, reporter: Reporter, title: str
) -> None:
    """Performs what is not done yet; a job waits for the one it starts from.

    Args:
        plan: Jobs; one that several rows share is performed once.
        folder: Where their folders lie.
        workers: Jobs at a time, or an executor.
        reporter: Shows progress.
        title: What to call the work there.

    Raises:
        MeasurementError: A job failed; its log says why. The others' results are kept.
        OptionError: Another process performs jobs in that folder.
    """
    plan = list({planned.name: planned for planned in plan}.values())
    left = [planned for planned in plan if done(planned, folder) is None]
    running: dict[Future[None], Planned] = {}
    require_writable(folder / LOG)
    lock, stop = locked(folder), Stop()
    with reporter.task(title, len(plan)) as advance, executor_of(workers) as pool:
        for _ in range(len(plan) - len(left)):
            advance()
        try:
            while left or running:
                waited_for = {planned.name for planned in (*left, *running.values())}
                for planned in [one for one in left if one.job.start not in waited_for]:
                    left.remove(planned)
                    own = folder.resolve() / planned.name
                    write_whole(own / JOB, json.dumps(asdict(planned.job), indent=1) + "\n")
                    running[pool.submit(_perform, str(own), stop)] = planned
                # Wakes up now and then, so that Ctrl-C is heard.
                finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in finished:
                    planned = running.pop(future)
                    future.result()
                    if done(planned, folder) is None:
                        raise MeasurementError(_failure(folder / planned.name))
                    advance(note=planned.short)
        finally:
            stop.set()
            for future in running:
                future.cancel()
            lock.close()


def _perform(folder: str, stop: Stop) -> None:
    """Performs the job in a folder, or its beginning, if nobody waits for it any more."""
    with Path(folder, LOG).open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "ugat_marl.experiments.paper.job", folder],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for this process; it ends the others itself
        )
    try:
        while process.poll() is None and not stop.wait(0.1):
            pass
    finally:
        _end(process)


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
