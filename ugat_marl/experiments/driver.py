"""Driver: performs many jobs, several at a time, and resumes them.

Jobs are forked from a warm parent where that is possible. Where it is not, and with an executor,
each job gets a new interpreter. The jobs of one run are performed in this process, and others
beside it as far as cores are left.

A job's folder holds its description and its results. Workers on other machines therefore need a
shared file system.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import IO

from ugat_marl.data import LogCallback, lock_folder
from ugat_marl.errors import JobError
from ugat_marl.experiments.forked import (
    ONE_CORE,
    heartbeat_of,
    jobs_fork_on,
    perform_forked,
    say_stopped,
)
from ugat_marl.experiments.jobs import Job, JobRecord, perform
from ugat_marl.files import require_writable
from ugat_marl.parallel import (
    RETRIES,
    Stop,
    Workers,
    executor_of,
    in_this_process,
    parts_at_a_time,
)
from ugat_marl.progress import Reporter
from ugat_marl.simulation import kept_warm

LOG = "job.log"
OTHER_PARTS = "other parts"
"""Title of the progress bar of jobs beside others."""

_TAIL = 400
"""Number of characters shown from the end of a failed job's log."""


def record_of(job: Job, folder: Path) -> JobRecord | None:
    """Return the record of a job; None if an evaluation is missing.

    Args:
        job: The job.
        folder: Folder that holds the jobs' folders.
    """
    record = JobRecord.read(folder / job.name)
    return record if record.is_whole(job) else None


@kept_warm()
def perform_all(
    plan: Sequence[Job],
    folder: Path,
    *,
    workers: Workers,
    reporter: Reporter,
    title: str,
    keep_going: bool = False,
) -> dict[str, str]:
    """Perform the unfinished jobs, each in its own process.

    Args:
        plan: Jobs; equal jobs are performed once. A job waits for the job it starts from.
        folder: Folder that holds the jobs' folders.
        workers: Jobs at a time, or an executor.
        reporter: Shows progress.
        title: Title of the progress bar.
        keep_going: Perform the other jobs if one fails.

    Returns:
        Reason of failure by name of the job; empty unless `keep_going`.

    Raises:
        JobError: A job failed; its log holds the reason. Results of other jobs are kept.
        OptionError: Another process performs jobs in that folder.
    """
    jobs = list({job.name: job for job in plan}.values())
    left = [job for job in jobs if record_of(job, folder) is None]
    running: dict[Future[None], Job] = {}
    failures: dict[str, str] = {}
    require_writable(folder / LOG)
    stop = Stop()
    with (  # the lock is held until the last job has ended
        contextlib.closing(lock_folder(folder)),
        reporter.task(title, len(jobs)) as advance,
        executor_of(workers) as pool,
    ):
        for _ in range(len(jobs) - len(left)):
            advance()
        try:
            while left or running:
                waited_for = {job.name for job in (*left, *running.values())}
                for job in [job for job in left if job.after not in waited_for]:
                    left.remove(job)
                    place = folder.resolve() / job.name
                    job.write(place)
                    forked = in_this_process(workers) and jobs_fork_on(job.device)
                    running[pool.submit(_perform_apart, str(place), stop, forked)] = job
                # The timeout lets Ctrl-C interrupt the wait.
                finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = running.pop(future)
                    future.result()
                    if record_of(job, folder) is None:
                        failures[job.name] = _failure(folder / job.name)
                        if not keep_going:
                            raise JobError(failures[job.name])
                    advance(note=job.short)
        finally:
            stop.set()
            for future in running:
                future.cancel()
    return failures


def perform_here(
    plan: Sequence[Job],
    folder: Path,
    *,
    workers: Workers = 1,
    reporter: Reporter,
    on_log: LogCallback | None = None,
    beside: Sequence[Job] = (),
) -> list[JobRecord]:
    """Perform jobs one after another in this process and return their records.

    Args:
        plan: Jobs; a job comes after the job it starts from.
        folder: Folder that holds the jobs' folders.
        workers: Simulations at a time, or an executor, see `perform`.
        reporter: Shows progress.
        on_log: See `perform`.
        beside: Jobs of the plan that may be performed meanwhile, each in a process and on a core
            of its own, at most ``workers - 1`` at a time. What they say is in their logs. A learner
            that they start from must be written once, as that of plain training before grounding.

    Raises:
        OptionError: Another process performs jobs in that folder.
    """
    records: list[JobRecord] = []
    require_writable(folder / LOG)
    with (  # the lock is held until the last job has ended
        contextlib.closing(lock_folder(folder)),
        _performed_beside(beside, folder, workers, reporter) as settle,
    ):
        for job in plan:
            settle(job)
            place = folder / job.name
            job.write(place)
            records.append(perform(job, place, reporter, workers, on_log))
    return records


@contextlib.contextmanager
def _performed_beside(
    jobs: Sequence[Job], folder: Path, workers: Workers, reporter: Reporter
) -> Iterator[Callable[[Job], None]]:
    """Perform jobs in processes of their own inside the block, the last ones first.

    Yield a function ``settle(job)``. It waits for a job that is running, and cancels one that is
    not. `perform` then returns at once for a finished job, and raises the error of a failed one.
    """
    if not jobs:
        yield lambda job: None
        return
    last_first = jobs[::-1]
    stop, order = Stop(), sorted(last_first, key=lambda job: job.start is not None)
    running: dict[str, tuple[Future[None], threading.Event]] = {}
    with (
        reporter.task(OTHER_PARTS, len(jobs)) as advance,
        ThreadPoolExecutor(max(1, parts_at_a_time(workers) - 1)) as pool,
    ):

        def settle(job: Job) -> None:
            if job.name not in running:
                return
            future, wanted = running[job.name]
            wanted.set()
            if not future.cancel():
                while not future.done():  # the timeout lets Ctrl-C interrupt the wait
                    wait([future], timeout=0.2)

        def perform_it(job: Job, wanted: threading.Event) -> None:
            if _is_ready(job, folder, stop, wanted):
                place = folder.resolve() / job.name
                job.write(place)
                _perform_apart(str(place), stop, forked=True)
                if record_of(job, folder) is not None:
                    advance(note=job.short)
                elif not stop.is_set():
                    reporter.say(f"note: {_failure(place)}")

        try:
            for job in order:
                wanted = threading.Event()
                running[job.name] = pool.submit(perform_it, job, wanted), wanted
            yield settle
        finally:
            stop.set()
            for future, _ in running.values():
                future.cancel()


def _is_ready(job: Job, folder: Path, stop: Stop, wanted: threading.Event) -> bool:
    """Wait for the learner that a job starts from; False if somebody wants the job before."""
    start = None if job.start is None else folder / job.start
    while start is not None and not start.exists():
        if wanted.is_set():
            return start.exists()  # it may have ended since the last look
        if stop.wait(0.5):
            return False
    return True


def _perform_apart(folder: str, stop: Stop, forked: bool) -> None:
    """Perform the job in a folder in another process; end it when `stop` is set.

    A job that was stopped and killed is taken up again at its last checkpoint.
    """
    for attempt in range(1 + RETRIES):
        with Path(folder, LOG).open("ab" if attempt else "wb") as log:
            job = perform_forked if forked else _perform_in_new_interpreter
            if job(Path(folder), log, stop):
                return


def _perform_in_new_interpreter(folder: Path, log: IO[bytes], stop: Stop) -> bool:
    """Do the same as `perform_forked` where a process cannot be forked."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ugat_marl.experiments.jobs", str(folder)],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**ONE_CORE, **os.environ},
        start_new_session=True,  # Ctrl-C reaches this process only; it ends the jobs itself
    )
    try:
        heartbeat = heartbeat_of(log)
        while process.poll() is None and not stop.wait(0.1):
            if heartbeat.is_lost():
                say_stopped(log, heartbeat)
                process.kill()
                return False
        return True
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close the input of a job, which then ends itself and its simulations."""
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _failure(folder: Path) -> str:
    text = (folder / LOG).read_text(errors="replace").strip()
    said = text[-_TAIL:] or (
        "its process ended without a word, as when memory runs out, of which one job at a time "
        "needs less; the same command goes on"
    )
    return f"{folder.name} failed: {said} (whole log: {folder / LOG})"
