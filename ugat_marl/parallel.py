"""Parallel work, on this machine's cores or with any standard executor.

Functions that run many episodes take ``workers``: a number, None for one per usable core, or a
`concurrent.futures.Executor` that the caller makes and closes. With a number, each part is a thread
that controls simulations in separate processes. Arguments and results of a part can be pickled, so
pools of processes and clusters work as well. `RayExecutor` makes Ray a standard executor.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

from ugat_marl.errors import OptionError, SimulatorCrashed, install_command

Workers = int | Executor | None
"""Number of parts at a time, None for the number of usable cores, or an executor."""

Done = TypeVar("Done")

RETRIES = 3
"""Number of times work is repeated if its process died."""


def persistently(work: Callable[[], Done], death: type[Exception] = SimulatorCrashed) -> Done:
    """Call a function, and repeat the call if a process it needs died.

    Args:
        work: The function, such as one episode.
        death: Exception that means the process died. It is raised if every call fails so.
    """
    for _ in range(RETRIES):
        with contextlib.suppress(death):
            return work()
    return work()


class Stop(threading.Event):
    """Flag that no one waits for the work any more. A copy in another process is never set."""

    def __reduce__(self) -> tuple[type[Stop], tuple[()]]:
        return Stop, ()


def usable_cores() -> int:
    """Return the number of cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parts_at_a_time(workers: Workers) -> int:
    """Return the number of parts done at once; for unknown executors the usable cores."""
    if isinstance(workers, Executor):
        return getattr(workers, "parts_at_a_time", None) or getattr(
            workers, "_max_workers", usable_cores()
        )
    return workers or usable_cores()


def in_this_process(workers: Workers) -> bool:
    """Return True if the parts can call functions of the process that made them."""
    return not isinstance(workers, Executor) or isinstance(workers, ThreadPoolExecutor)


@contextlib.contextmanager
def executor_of(workers: Workers) -> Iterator[Executor]:
    """Yield the executor. One made here is closed afterwards; one that was given stays open."""
    if isinstance(workers, Executor):
        yield workers
        return
    with ThreadPoolExecutor(parts_at_a_time(workers)) as pool:
        yield pool


def as_done(
    workers: Workers,
    work: Callable[..., Done],
    parts: Iterable[tuple[Any, ...]],
    stop: Stop,
) -> Iterator[tuple[int, Done]]:
    """Do all parts; yield the number and the result of each part in the order they finish.

    The first failure is raised. At the end, or if the loop stops early, `stop` is set and parts
    that have not begun are cancelled.

    Args:
        workers: Number of workers, or the executor.
        work: Function that does one part, called with the values of the part.
        parts: Values of each part.
        stop: Flag that the parts may check to end early.
    """
    with executor_of(workers) as pool:
        numbers: dict[Future[Done], int] = {}
        try:
            for number, part in enumerate(parts):
                numbers[pool.submit(work, *part)] = number
            left = set(numbers)
            while left:  # the timeout lets Ctrl-C through
                done, left = wait(left, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    yield numbers[future], future.result()
        finally:
            stop.set()
            for future in numbers:
                future.cancel()


def in_order(
    workers: Workers,
    work: Callable[..., Done],
    parts: Sequence[tuple[Any, ...]],
    stop: Stop,
    on_done: Callable[[Done], object],
) -> list[Done]:
    """Run parts as `as_done` does, and return their results in the order of the parts.

    Args:
        workers: Parts at a time, or an executor, as for `as_done`.
        work: Function of one part.
        parts: Arguments of each part.
        stop: Flag for parts that run when the iteration ends.
        on_done: Called with each result when it is there.
    """
    results: dict[int, Done] = {}
    for number, result in as_done(workers, work, parts, stop):
        results[number] = result
        on_done(result)
    return [results[number] for number in range(len(parts))]


class LocalProcesses(Executor):
    """Executor with one interpreter per worker, for more cores than one interpreter can use.

    Each interpreter takes seconds to start and needs the memory of the suite with torch. A script
    that uses this class guards its code with ``if __name__ == "__main__":``. If a process dies,
    another process repeats its part. A pool of the standard library would stay broken.

    Args:
        workers: Number of processes; None for one per usable core.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.parts_at_a_time = parts_at_a_time(workers)
        self._threads = ThreadPoolExecutor(self.parts_at_a_time)  # each waits for one process
        self._idle: list[ProcessPoolExecutor] = []
        self._is_open = True

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand a part to a process.

        The part raises `BrokenProcessPool` if its process died each time.
        """
        part = functools.partial(fn, *args, **kwargs)
        return self._threads.submit(persistently, lambda: self._done(part), BrokenProcessPool)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after the submitted parts, or after the running ones if cancelled."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        self._is_open = False
        while self._idle:
            self._idle.pop().shutdown(wait)

    def _done(self, part: Callable[[], Any]) -> Any:
        try:
            process = self._idle.pop()
        except IndexError:
            process = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
        is_alive = True
        try:
            return process.submit(part).result()
        except BrokenProcessPool:
            is_alive = False
            raise
        finally:
            if is_alive and self._is_open:
                self._idle.append(process)
            else:
                process.shutdown(wait=False)


class RayExecutor(Executor):
    """Ray as a standard executor; every part is a task on one core.

    Ray repeats a task if its process or machine died. A repeated task gives the same result,
    because results depend only on the arguments. The suite must be installed on all machines.

    Args:
        address: ``"local"`` starts Ray on this machine; ``"auto"``, ``"host:port"`` or
            ``"ray://host:port"`` joins a cluster. If this process has joined a Ray already, that
            one is used.

    Raises:
        OptionError: Ray is not installed, or does not answer at the address.
    """

    def __init__(self, address: str = "local") -> None:
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise OptionError(
                f"--ray needs Ray, which is not installed: {install_command('ray')}"
            ) from None
        self._ray: Any = ray
        self._owns = not ray.is_initialized()
        if self._owns:
            variables = {"OMP_NUM_THREADS": "1", "PYTHONPATH": _import_path()}
            known: dict[str, Any] = {} if address != "local" else {"include_dashboard": False}
            try:
                ray.init(
                    address=address,
                    runtime_env={"env_vars": variables},
                    log_to_driver=False,
                    logging_level="error",
                    **known,
                )
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise OptionError(
                    f"--ray {address}: cannot be reached ({' '.join(str(error).split())}); give "
                    "local, auto, host:port or ray://host:port"
                ) from None
        self._task: Any = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)
        self._running: dict[Future[Any], Any] = {}
        self._lock = threading.Lock()
        self._is_open = True

    @property
    def parts_at_a_time(self) -> int:
        """Number of cores in the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand a part to the cluster."""
        if not self._is_open:
            raise RuntimeError("cannot schedule new futures after shutdown")
        future: Future[Any] = Future()
        reference = self._task.remote(fn, args, kwargs)
        with self._lock:
            self._running[future] = reference
        reference.future().add_done_callback(lambda found: self._settle(future, found))
        future.add_done_callback(self._withdraw)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for or cancel the submitted parts, and end the Ray that was started here."""
        self._is_open = False
        with self._lock:
            running = list(self._running)
        for future in running:
            if cancel_futures:
                future.cancel()
            elif wait:
                future.exception()
        if self._owns and self._ray.is_initialized():
            self._ray.shutdown()

    def _settle(self, future: Future[Any], outcome: Future[Any]) -> None:
        """Pass a result or an error on. Ray wraps the part's own error, so unwrap it."""
        with self._lock:
            self._running.pop(future, None)
        if not future.set_running_or_notify_cancel():
            return
        error = outcome.exception()
        if error is not None:
            future.set_exception(getattr(error, "cause", None) or error)
        else:
            future.set_result(outcome.result())

    def _withdraw(self, future: Future[Any]) -> None:
        with self._lock:
            reference = self._running.pop(future, None)
        if reference is not None and future.cancelled():
            self._ray.cancel(reference, force=True)


def _call(fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return fn(*args, **kwargs)


def _import_path() -> str:
    """Return this process's import path, so that workers can import the same modules."""
    return os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
