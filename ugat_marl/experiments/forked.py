"""Jobs in processes forked from a warm parent, which has loaded what every job needs.

Loading torch takes a new interpreter seconds, and a forked process nothing. The warm parent runs no
thread, because a forked process would lack it. It therefore does not load polars, which starts some
as it is imported.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from ugat_marl.parallel import DEADLINE_VARIABLE, Heartbeat, Stop, send_heartbeats
from ugat_marl.simulation import ChannelClosed, Host, Message

PRELOADED = ("torch", "torch._dynamo", "scipy.stats", "libsumo", "pydantic", "rich.progress")
"""Slow imports of a job that start no thread. The optimisers of torch import ``torch._dynamo``."""

ONE_CORE = {"OMP_NUM_THREADS": "1"}
"""Environment variables of a job, unless the user has set them."""

SERVICE = "ugat_marl.experiments.forked:Jobs"


def jobs_fork_on(device: str) -> bool:
    """Return True if jobs on a device can be forked here.

    Only Linux can: on macOS, torch's libraries do not survive a fork. Devices other than the
    processor get a new interpreter, because their drivers do not survive one either.
    """
    return sys.platform == "linux" and device == "cpu"


def perform_forked(folder: Path, log: IO[bytes], stop: Stop) -> bool:
    """Perform the job in a folder in a forked process; end it when `stop` is set.

    Return False if the process was stopped and has been killed, see `heartbeat_of`.

    Args:
        folder: Folder of the job.
        log: Open file for everything that the job prints.
        stop: Flag that no one waits for the job any more.
    """
    with contextlib.closing(Host(SERVICE, "forkserver", ONE_CORE)) as host:
        worker = host.start({"folder": str(folder)}, [log.fileno()])
        patience_s = 0.0  # a job that is stopped would train on
        try:
            worker.ask("perform")
            heartbeat = heartbeat_of(log)
            while not (answered := worker.has_answered(0.1)) and not stop.is_set():
                if heartbeat.is_lost():
                    say_stopped(log, heartbeat)
                    return False
            if answered:
                worker.answer()
                patience_s = 10.0
        except ChannelClosed:
            pass  # it died; its record lacks evaluations
        finally:
            worker.end(patience_s)
    return True


def heartbeat_of(log: IO[bytes]) -> Heartbeat:
    """Return the signs of life of the process of a job, which sets the time of its log anew.

    A job may take days, so it has no deadline of its own. The simulations for which it waits have.
    """
    return Heartbeat(lambda: os.fstat(log.fileno()).st_mtime_ns)


def say_stopped(log: IO[bytes], heartbeat: Heartbeat) -> None:
    """Write into the log of a job that its process was stopped."""
    log.write(
        f"\nthe process of this job did not run on for {heartbeat.deadline_s:g} s (stopped?) and "
        f"was killed; {DEADLINE_VARIABLE} sets other seconds\n".encode()
    )
    log.flush()


class Jobs:
    """Service that performs one job in each worker."""

    def prepare(self, order: dict[str, Any]) -> None:
        """Load what every job needs."""
        for name in PRELOADED:
            importlib.import_module(name)

    def open(
        self, order: dict[str, Any], descriptors: Sequence[int]
    ) -> Callable[[Message], Message]:
        """Return a function that performs the job; everything it prints goes to its log."""
        folder, (log,) = Path(order["folder"]), descriptors
        os.dup2(log, 1)
        os.dup2(log, 2)
        send_heartbeats(lambda: os.utime(log))  # see `heartbeat_of`

        def perform(_: Message) -> Message:
            try:
                from ugat_marl.experiments.jobs import perform_described

                perform_described(folder)
            except Exception:  # noqa: BLE001 - the log says why; the record lacks evaluations
                traceback.print_exc()
            sys.stdout.flush()  # the process exits without it
            return Message({}, [])

        return perform

    def told(self, order: dict[str, Any]) -> None:
        """Do nothing: no messages are sent here."""

    def abandoned(self) -> None:
        """Do nothing: what a killed job was writing is cleared when it is taken up again."""
