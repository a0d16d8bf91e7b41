"""Parallel work, on this machine's cores or with any standard executor.

Functions that run many episodes take ``workers``: a number, None for one per usable core, or a
`concurrent.futures.Executor` that the caller makes and closes. With a number, each part is a thread
that controls simulations in separate processes. Arguments and results of a part can be pickled, so
pools of processes and clusters work as well. `RayExecutor` makes Ray a standard executor.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
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
from multiprocessing.reduction import ForkingPickler
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ugat_marl.errors import (
    JobError,
    OptionError,
    SimulatorCrashed,
    first_line,
    install_command,
)
from ugat_marl.files import files_sent_whole

Workers = int | Executor | None
"""Number of parts at a time, None for the number of usable cores, or an executor."""

DEADLINE_S = 900.0
"""Seconds within which a process has to answer; then it counts as dead. Loading a city takes
minutes, so half of it would kill honest simulations on slow machines."""
DEADLINE_VARIABLE = "UGAT_MARL_DEADLINE_S"
"""Environment variable that replaces `DEADLINE_S`."""
LONGEST_DEADLINE_S = 2e6
"""Largest deadline, s: 23 days. The system waits for a connection for 2^31 ms at most."""

_BEAT_S = 1.0
"""Seconds between two signs of life of a process."""
_PATIENCE_S = 10.0
"""Seconds to wait for the process of Ray that counts signs; the next beat asks again."""

Done = TypeVar("Done")

RETRIES = 3
"""Number of times work is repeated if its process died."""


def retry_on_crash(work: Callable[[], Done], crash: type[Exception] = SimulatorCrashed) -> Done:
    """Call a function, and repeat the call if a process it needs died.

    Args:
        work: The function, such as one episode.
        crash: Exception that means the process died. It is raised if every call fails so.
    """
    for _ in range(RETRIES):
        with contextlib.suppress(crash):
            return work()
    return work()


class Stop(threading.Event):
    """Flag that no one waits for the work any more. A copy in another process is never set."""

    def __reduce__(self) -> tuple[type[Stop], tuple[()]]:
        return Stop, ()


def usual_deadline_s() -> float:
    """Return the seconds within which a process has to answer.

    Raises:
        OptionError: The variable `DEADLINE_VARIABLE` is not a number of seconds above 0, up to
            `LONGEST_DEADLINE_S`.
    """
    text = os.environ.get(DEADLINE_VARIABLE, "")
    if not text:
        return DEADLINE_S
    return deadline_of(f"{DEADLINE_VARIABLE} = {text!r}", text)


def deadline_of(place: str, text: str) -> float:
    """Return the seconds of a text.

    Args:
        place: Start of the message, which names the text.
        text: The text.

    Raises:
        OptionError: It is not a number of seconds above 0, up to `LONGEST_DEADLINE_S`.
    """
    seconds = None
    with contextlib.suppress(ValueError):  # Python reads 1_000 and digits of other scripts, too
        seconds = float(text) if text.isascii() and "_" not in text else None
    return _seconds(seconds, place)


def require_deadline(deadline_s: Any) -> None:
    """Refuse a deadline that is not a number of seconds above 0, up to `LONGEST_DEADLINE_S`.

    Args:
        deadline_s: Seconds, or None for `usual_deadline_s`.

    Raises:
        OptionError: It is something else.
    """
    if deadline_s is not None:
        _seconds(deadline_s, f"deadline_s = {deadline_s!r}")


def _seconds(value: Any, place: str) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0 < value <= LONGEST_DEADLINE_S:
        raise OptionError(
            f"{place}: give a number of seconds above 0, up to {LONGEST_DEADLINE_S:,.0f}"
        )
    return value


def send_heartbeats(sign: Callable[[], object]) -> None:
    """Give a sign of life every second, in a thread, as long as this process runs on.

    A process that is stopped gives none, and one that is busy does: its thread needs the
    interpreter for some microseconds only.
    """

    def beat() -> None:
        while True:
            with contextlib.suppress(OSError):
                sign()
            time.sleep(_BEAT_S)

    threading.Thread(target=beat, daemon=True).start()


class Heartbeat:
    """The signs of life of a process, as its starter sees them.

    No limit of time could tell a long piece of work from one that never ends; a process that does
    not run on can be told.

    Args:
        sign: Returns a number that differs after every sign of `send_heartbeats`.

    Attributes:
        deadline_s: Seconds without a sign after which the process counts as dead. Seconds in which
            its starter did not run on either do not count.
    """

    def __init__(self, sign: Callable[[], int]) -> None:
        self.deadline_s = usual_deadline_s()
        self._sign = sign
        self._last = sign()
        self._silent_s = 0.0
        self._asked_s = time.monotonic()

    def is_lost(self) -> bool:
        """Return True if the process has given no sign for too long; ask about every second."""
        now_s = time.monotonic()
        # while the starter itself was stopped, as by Ctrl-Z, it could see no sign
        self._silent_s += min(now_s - self._asked_s, 2 * _BEAT_S)
        self._asked_s = now_s
        if (sign := self._sign()) != self._last:
            self._last, self._silent_s = sign, 0.0
        return self._silent_s > self.deadline_s


def usable_cores() -> int:
    """Return the number of cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parts_at_a_time(workers: Workers) -> int:
    """Return the number of parts done at once; for unknown executors the usable cores.

    Raises:
        OptionError: The number is below 1.
    """
    if isinstance(workers, Executor):
        return getattr(workers, "parts_at_a_time", None) or getattr(
            workers, "_max_workers", usable_cores()
        )
    number: Any = workers
    if number is not None and not (isinstance(number, Integral) and int(number) >= 1):
        raise OptionError(
            f"workers = {workers!r}: must be a whole number from 1 on, or None for all cores"
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
    another process repeats its part. A pool of the standard library would stay broken. A process
    that gives no sign of life for the time of `usual_deadline_s`, because it is stopped, is killed.

    Args:
        workers: Number of processes; None for one per usable core.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.parts_at_a_time = parts_at_a_time(workers)
        self._threads = ThreadPoolExecutor(self.parts_at_a_time)  # each waits for one process
        self._idle: list[_Process] = []
        self._is_open = True

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand a part to a process.

        The part raises `BrokenProcessPool` if its process died each time.
        """
        part = functools.partial(fn, *args, **kwargs)
        return self._threads.submit(retry_on_crash, lambda: self._done(part), BrokenProcessPool)

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
            process = _Process()
        is_alive = True
        try:
            return process.done(part)
        except BrokenProcessPool:
            is_alive = False
            raise
        finally:
            if is_alive and self._is_open:
                self._idle.append(process)
            else:
                process.shutdown(wait=False)


class _Process(ProcessPoolExecutor):
    """One interpreter, which is killed if it is stopped."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._beats = context.Value("Q", 0, lock=False)
        super().__init__(1, context, _beat, (self._beats,))

    def done(self, part: Callable[[], Any]) -> Any:
        """Do a part and return its result.

        Raises:
            BrokenProcessPool: The process died, or was stopped and killed.
            JobError: The part or its result cannot be made again from what pickle sends.
        """
        future = self.submit(_carried, _packed(part))
        heartbeat = Heartbeat(lambda: self._beats.value)
        while not wait([future], timeout=_BEAT_S).done:
            if heartbeat.is_lost():
                for each in [*self._processes.values()]:  # the pool has no method for it
                    each.kill()
        packed = future.result()
        try:
            return _unpacked(packed)
        except Exception as error:  # noqa: BLE001 - whatever its classes do when made again
            raise JobError(_unsendable("the result of a part", error)) from None


def _carried(packed: bytes) -> bytes:
    """Do a part; replace an error that pickle does not bring back, which would look like a death.

    Parts and results are packed here, because a pool takes what cannot be unpacked for a death.

    Raises:
        JobError: The part raised such an error, or cannot be unpacked.
    """
    try:
        part = _unpacked(packed)
    except Exception as error:  # noqa: BLE001 - as above
        raise JobError(_unsendable("a part", error)) from None
    try:
        return _packed(part())
    except Exception as error:
        try:
            _unpacked(_packed(error))
        except Exception:  # noqa: BLE001 - whatever its class does when it is made again
            raise JobError(f"{type(error).__name__}: {first_line(error)}") from None
        raise


def _packed(value: Any) -> bytes:
    return bytes(ForkingPickler.dumps(value))


def _unpacked(packed: bytes) -> Any:
    # the bytes are our own: nothing foreign is unpickled
    return ForkingPickler.loads(packed)  # pyright: ignore[reportAttributeAccessIssue]


def _unsendable(what: str, error: Exception) -> str:
    return f"{what} cannot be sent between processes ({type(error).__name__}: {first_line(error)})"


def _beat(beats: Any) -> None:
    def add() -> None:
        beats.value += 1

    send_heartbeats(add)


class RayExecutor(Executor):
    """Ray as a standard executor; every part is a task on one core.

    Ray repeats a task if its process or machine died. A repeated task gives the same result,
    because results depend only on the arguments. A process that gives no sign of life for the time
    of `usual_deadline_s`, because it is stopped, is killed. The suite must be installed on all
    machines.

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
            own = {k: v for k, v in os.environ.items() if k.startswith("UGAT_MARL_")}  # limits
            variables = {**own, "OMP_NUM_THREADS": "1", "PYTHONPATH": import_path()}
            known: dict[str, Any] = {} if address != "local" else {"include_dashboard": False}
            try:
                ray.init(
                    address=address,
                    runtime_env={"env_vars": variables},
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    **known,
                )
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise OptionError(
                    f"--ray {address}: cannot be reached ({' '.join(str(error).split())}); give "
                    "local, auto, host:port or ray://host:port"
                ) from None
        self._task: Any = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)
        self._signs: Any = ray.remote(num_cpus=0, max_restarts=-1)(_Signs).remote()
        self._running: dict[Future[Any], Any] = {}
        self._lock = threading.Lock()
        self._is_open = True
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    @property
    def parts_at_a_time(self) -> int:
        """Number of cores in the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand a part to the cluster."""
        if not self._is_open:
            raise RuntimeError("cannot schedule new futures after shutdown")
        future: Future[Any] = Future()
        with files_sent_whole():
            reference = self._task.remote(self._signs, fn, args, kwargs)
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
        self._closed.set()
        self._watcher.join()  # a call of it after the end would start a Ray of its own
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

    def _watch(self) -> None:
        """Kill processes that run a part and give no sign of life, until no part is left to run.

        Ray itself notices machines and processes that are gone, and none that are stopped.
        """
        from ray.util.scheduling_strategies import (  # pyright: ignore[reportMissingImports]
            NodeAffinitySchedulingStrategy,
        )

        kill = self._ray.remote(num_cpus=0, max_retries=0)(_kill)
        counts: dict[_Place, int] = {}
        heartbeats: dict[_Place, Heartbeat] = {}
        while not self._closed.wait(_BEAT_S) and self._ray.is_initialized():
            with self._lock:
                parts = {reference.task_id().hex() for reference in self._running.values()}
            try:
                now = self._ray.get(self._signs.of.remote(parts), timeout=_PATIENCE_S)
            except self._ray.exceptions.RayError:  # the machine of the signs is lost for a while
                continue
            counts.clear()
            counts.update(now)
            heartbeats = {
                place: heartbeats.get(place)
                or Heartbeat(functools.partial(counts.__getitem__, place))
                for place in counts
            }
            for place, heartbeat in heartbeats.items():
                if heartbeat.is_lost():
                    there = NodeAffinitySchedulingStrategy(place.node, soft=False)
                    kill.options(scheduling_strategy=there).remote(place.process)
                    self._signs.forget.remote(place.part)


class _Place(NamedTuple):
    """Machine and process of a running part."""

    part: str
    node: str
    process: int


class _Signs:
    """Signs of life of the processes that run parts, counted in a process of Ray."""

    def __init__(self) -> None:
        self._counts: dict[str, tuple[_Place, int]] = {}

    def add(self, place: _Place) -> None:
        """Count a sign of the process that runs a part."""
        last, count = self._counts.get(place.part, (place, 0))
        self._counts[place.part] = (place, count + 1 if last == place else 1)

    def forget(self, part: str) -> None:
        """Leave a part out until its next sign."""
        self._counts.pop(part, None)

    def of(self, parts: set[str]) -> dict[_Place, int]:
        """Return the number of signs for each of these parts that has begun; forget all others."""
        self._counts = {part: sign for part, sign in self._counts.items() if part in parts}
        return dict(self._counts.values())


class _RayHeartbeat:
    """Part of this process of Ray, and the counter of its signs of life."""

    signs: Any = None
    place: _Place

    @classmethod
    def send(cls) -> None:
        """Give a sign of life."""
        cls.signs.add.remote(cls.place)


def _call(signs: Any, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    import ray  # pyright: ignore[reportMissingImports]

    here: Any = ray.get_runtime_context()
    is_first = _RayHeartbeat.signs is None
    _RayHeartbeat.place = _Place(here.get_task_id(), here.get_node_id(), os.getpid())
    _RayHeartbeat.signs = signs
    if is_first:
        send_heartbeats(_RayHeartbeat.send)
    failures: Any = ray.exceptions  # pyright: ignore[reportAttributeAccessIssue]
    with contextlib.suppress(failures.RayError):  # a part without a sign is never missed
        ray.get(signs.add.remote(_RayHeartbeat.place), timeout=_PATIENCE_S)
    return fn(*args, **kwargs)


def _kill(process: int) -> None:
    """Kill a process of Ray on this machine; another one may have its number by now."""
    name = Path(f"/proc/{process}/cmdline")
    if not name.parent.parent.exists() or b"ray" in name.read_bytes():
        os.kill(process, signal.SIGKILL)


def import_path() -> str:
    """Return PYTHONPATH for a process that is to import the same modules as this one."""
    return os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
