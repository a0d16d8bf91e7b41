"""Worker processes: a warm parent that forks them, and the connection to each of them.

A `Host` starts workers of one `Service`. The warm parent starts with the first worker and ends with
the last host, or at the end of `kept_warm`. It has loaded the service and forks a fresh process for
each worker. Starting a worker is therefore cheap, and workers share no state. Where processes
cannot fork, every worker is a new interpreter. Neither kind imports the user's ``__main__``. Parent
and workers end with the user's process, even if that is killed; `ugat_marl.simulation.worker` is
their side.

Messages are JSON, followed by float64 arrays. Nothing is unpickled, so messages cannot run code.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO, Any, ClassVar, Literal, Protocol

from numpy.typing import NDArray

from ugat_marl import errors
from ugat_marl.errors import OptionError, SimulatorCrashed, UgatMarlError, WorkerError
from ugat_marl.parallel import DEADLINE_VARIABLE, import_path, require_deadline, usual_deadline_s
from ugat_marl.scenarios import MEMORY_VARIABLE, most_memory
from ugat_marl.simulation.channel import Channel, ChannelClosed, Message

StartMethod = Literal["forkserver", "spawn"]
Order = Mapping[str, Any]
"""Task of a worker, as plain values for JSON. The worker removes the folder named by the key
``"directory"``, if there is one, when it ends."""

LENGTH = struct.Struct("<I")
"""Prefix of an order: its number of bytes."""

PATIENCE_S = 10.0
"""Seconds that a process has to end after a request; then it is killed."""

_FULL_MEMORY = re.compile("allocate memory|bad_alloc|MemoryError")
"""Words of a process that has filled its limit of memory."""

_END_S = 0.05
"""Seconds between two looks for the end of a process that was killed."""

_CAN_FORK = hasattr(os, "fork") and hasattr(socket, "send_fds")
_PROGRAM = "ugat_marl.simulation.worker"


class Service(Protocol):
    """Work of the workers of a host: a class without arguments, named ``"module:Class"``.

    The warm parent makes one object. Its workers inherit the state of that object when they fork.
    """

    def prepare(self, order: dict[str, Any]) -> None:
        """Prepare for a worker; runs in the warm parent before it forks."""
        ...

    def open(
        self, order: dict[str, Any], descriptors: Sequence[int]
    ) -> Callable[[Message], Message]:
        """Return a function that answers the questions to a worker; runs in the worker.

        Args:
            order: The order given to `Host.start`.
            descriptors: Open files given with the order.
        """
        ...

    def told(self, order: dict[str, Any]) -> None:
        """Receive a message of `Host.tell`; runs in the warm parent."""
        ...

    def abandoned(self) -> None:
        """Clean up after the user's process has died; runs in the warm parent."""
        ...


@contextlib.contextmanager
def kept_warm() -> Iterator[None]:
    """Keep warm parents while no host uses them, so that the next host need not load SUMO again.

    Functions that make one environment after another are decorated with it. Parents without a host
    end with the outermost block.
    """
    _WarmParent.keep()
    try:
        yield
    finally:
        _WarmParent.keep_no_longer()


class Host:
    """Start workers of a service.

    Args:
        service: ``"module:Class"`` of the `Service`.
        start_method: ``"forkserver"`` (the default where processes can fork) or ``"spawn"``.
        defaults: Environment variables of the processes, unless the user has set them.
        deadline_s: Seconds within which a process has to answer; None for the variable
            ``UGAT_MARL_DEADLINE_S``, or 900.

    Raises:
        OptionError: The method is unknown, this system does not have it, or the deadline is not a
            number of seconds.
    """

    def __init__(
        self,
        service: str,
        start_method: StartMethod | None = None,
        defaults: Mapping[str, str] | None = None,
        deadline_s: float | None = None,
    ) -> None:
        method = start_method or ("forkserver" if _CAN_FORK else "spawn")
        if method not in ("forkserver", "spawn"):
            raise OptionError(f"start_method = {method!r}; allowed: 'forkserver', 'spawn'")
        if method == "forkserver" and not _CAN_FORK:
            raise OptionError("start_method = 'forkserver' needs a system that can fork")
        self._service = service
        self._method: StartMethod = method
        self._defaults = dict(defaults or {})
        require_deadline(deadline_s)
        self._deadline_s = usual_deadline_s() if deadline_s is None else deadline_s
        self._parent: _WarmParent | None = None

    def start(self, order: Order, descriptors: Sequence[int] = ()) -> Worker:
        """Start a worker; replace the warm parent if it was killed.

        Args:
            order: The order for the service.
            descriptors: Open files the worker inherits; only with ``"forkserver"``.

        Raises:
            SimulatorCrashed: No process can be started.
        """
        # a warm parent has the variables of the time at which it started
        order = {**order, "memory": os.environ.get(MEMORY_VARIABLE, "")}
        if self._method == "spawn":
            return Worker.spawn(self._service, order, self._defaults, self._deadline_s)
        for _ in range(2):
            parent = self.warm()
            worker = parent.fork(order, descriptors, self._deadline_s)
            if worker is not None:
                return worker
            parent.end()
        raise SimulatorCrashed(
            "the process that starts simulations cannot be started or was killed twice (out of "
            "memory?); its own words are above, if it had any"
        )

    def warm(self) -> _WarmParent:
        """Start the warm parent, if there is none. `start` calls this itself."""
        if self._parent is None or not self._parent.alive:
            self._parent = _WarmParent.acquire(self._service, self._defaults)
        return self._parent

    def tell(self, order: Order) -> None:
        """Send a message to the warm parent, if there is one."""
        if self._parent is not None:
            self._parent.tell({"what": "tell", "order": order})

    def close(self) -> None:
        """Release the warm parent, which ends with its last host. Workers continue."""
        parent, self._parent = self._parent, None
        if parent is not None:
            parent.release()


class Worker:
    """The user's end of one worker process.

    Args:
        channel: The connection to the worker.
        output: File with everything the worker prints.
        pid: Process number of the worker.
        deadline_s: Seconds within which the worker has to answer.
        process: The process, if it is a child of this one.
    """

    def __init__(
        self,
        channel: Channel,
        output: IO[bytes],
        pid: int,
        deadline_s: float,
        process: subprocess.Popen[bytes] | None = None,
    ) -> None:
        self._channel = channel
        self._output = output
        self._pid = pid
        self._deadline_s = deadline_s
        self._late = False
        self._asked_s = time.monotonic()
        self._process = process
        self._owner = os.getpid()
        self._ended = False

    @classmethod
    def spawn(
        cls, service: str, order: Order, defaults: Mapping[str, str], deadline_s: float
    ) -> Worker:
        """Start a new interpreter; messages use its standard input and output.

        The order is the first message. A command line may be too short for it.
        """
        output = tempfile.TemporaryFile()  # noqa: SIM115 - stays open as long as the worker
        command = _command("spawned", service, str(os.getpid()))
        variables = _environment(defaults)
        process: subprocess.Popen[bytes]
        if os.name == "nt":  # pipes, and no deadline
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
                env=variables,
            )
            assert process.stdin is not None
            assert process.stdout is not None
            channel = Channel(process.stdout, process.stdin, process.stdin.close)
            return cls(channel, output, process.pid, deadline_s, process)._ordered(order)
        mine, its = socket.socketpair()
        with its:
            process = subprocess.Popen(
                command,
                stdin=its.fileno(),
                stdout=its.fileno(),
                stderr=output,
                env=variables,
                start_new_session=True,  # so Ctrl-C reaches only the user's process
            )
        channel = _channel_of(mine, deadline_s)
        return cls(channel, output, process.pid, deadline_s, process)._ordered(order)

    def _ordered(self, order: Order) -> Worker:
        try:
            self._channel.send(Message({"order": dict(order)}, []))
        except OSError:  # the first question finds that it has died
            pass
        except BaseException:  # Ctrl-C in the middle of the order
            self.end(patience_s=0.0)
            raise
        return self

    @property
    def running(self) -> bool:
        """True until the worker is ended; always False in a fork of the process that started it."""
        return self._owner == os.getpid() and not self._ended

    def ask(self, request: str, arrays: Sequence[NDArray[Any]] = (), **arguments: Any) -> None:
        """Send a question; `answer` waits for its answer.

        Raises:
            ChannelClosed: The process died or does not read, see `crash_message`.
        """
        self._asked_s = time.monotonic()
        try:
            self._channel.send(Message({"what": request, **arguments}, list(arrays)))
        except TimeoutError:
            self._kill_late()
            raise ChannelClosed from None
        except OSError:
            raise ChannelClosed from None
        except BaseException:  # Ctrl-C in the middle of a message
            self.end(patience_s=0.0)
            raise

    def answer(self) -> Message:
        """Wait for the answer to a question, until the deadline.

        Raises:
            ChannelClosed: The process died or did not answer in time, see `crash_message`.
            UgatMarlError: The service raised this error; the process has been ended.
            WorkerError: The service raised another exception; the process has been ended.
        """
        try:
            reply = self._channel.receive()
        except TimeoutError:
            self._kill_late()
            raise ChannelClosed from None
        except (ChannelClosed, OSError):
            raise ChannelClosed from None
        except BaseException:  # Ctrl-C here: the next question would get the answer to this one
            self.end(patience_s=0.0)
            raise
        if "error" in reply.header:
            error = self._raised(reply.header)
            self.end()
            raise error
        return reply

    def has_answered(self, patience_s: float) -> bool:
        """Return True if an answer waits, or the process has died, within `patience_s` seconds.

        Not on Windows.
        """
        return self._channel.is_readable(patience_s)

    @staticmethod
    def first_answered(workers: Sequence[Worker]) -> list[int]:
        """Wait until a worker has answered or died; return the places of all that have.

        Workers past their deadline are killed. Not on Windows.

        Args:
            workers: At least one worker; each was asked a question.
        """
        descriptors = select.poll()
        places: dict[int, int] = {}
        for place, worker in enumerate(workers):
            number = worker._channel.fileno()
            descriptors.register(number, select.POLLIN)
            places[number] = place
        while True:
            left_s = [one._asked_s + one._deadline_s - time.monotonic() for one in workers]
            if ready := descriptors.poll(1000 * max(min(left_s), _END_S)):
                return sorted(places[number] for number, _ in ready)
            for worker, left in zip(workers, left_s, strict=True):
                if left <= 0:
                    worker._kill_late()

    def _kill_late(self) -> None:
        """Kill a process that is past its deadline; it may be stopped and would not end itself."""
        self._late = True
        self._kill()

    def _kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)

    def end(self, patience_s: float = PATIENCE_S) -> None:
        """Close the connection and wait until the process exits. A second call does nothing.

        Args:
            patience_s: Seconds after which the process is killed.
        """
        if not self.running:
            return
        self._ended = True
        with contextlib.suppress(OSError, ValueError):
            self._channel.send(Message({"what": "close"}, []))
        if not self._channel.hang_up(patience_s):
            self._kill()
            self._channel.hang_up(PATIENCE_S)  # until it is dead
        if self._process is not None:
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._output.close()

    def crash_message(self, doing: str) -> str:
        """Return a message about a process that died, and release its resources.

        Args:
            doing: The question during which it died.
        """
        status = ""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = f" with status {self._process.wait(timeout=PATIENCE_S)}"
        words = self._output_tail()
        self.end()
        if self._late:
            return (
                f"the simulator process {self._pid} did not answer {doing!r} within "
                f"{self._deadline_s:g} s and was killed (stopped, or too little for this network: "
                f"set deadline_s or {DEADLINE_VARIABLE}). reset() starts this environment afresh"
            )
        if _FULL_MEMORY.search(words):
            return f"the simulator process {self._pid} died during {doing!r}: {too_much_memory()}"
        doubt = f"killed, or out of memory? {MEMORY_VARIABLE} sets the limit"
        said = f"it said: {words}" if words else f"it said nothing ({doubt})"
        return (
            f"the simulator process {self._pid} died{status} during {doing!r}; {said}. "
            "Other environments go on; reset() starts this one afresh"
        )

    def _raised(self, reply: dict[str, Any]) -> UgatMarlError:
        """Return the exception a process reports, as the nearest class that takes a message."""
        for name in reply["kinds"]:
            kind = getattr(errors, name, None)
            if kind is not None and name != "UnknownNameError":
                # SUMO's error log may hold only the end of SUMO's output.
                words, error = self._output_tail(), reply["error"]
                if _FULL_MEMORY.search(words) and too_much_memory() not in error:
                    return kind(f"{error.partition(':')[0]}: {too_much_memory()}")
                return kind(error if words in error else f"{error} {words}")
        return WorkerError(
            "an exception that is not the suite's own was raised in the process of a simulation, "
            f"by the reward or the wrapper if there is one:\n{reply['error']}"
        )

    def _output_tail(self) -> str:
        self._output.seek(0)
        return one_line_message(self._output.read().decode(errors="replace"))[-2000:]


class _WarmParent:
    """Process that forks the workers of a service; all hosts of a user's process share it."""

    _lock: ClassVar[threading.RLock] = threading.RLock()
    _current: ClassVar[dict[str, _WarmParent]] = {}
    _told_of_forks: ClassVar[bool] = False
    _blocks: ClassVar[int] = 0
    """Number of `kept_warm` blocks being executed."""

    def __init__(self, service: str, defaults: Mapping[str, str]) -> None:
        self._service = service
        self._users = 0
        self._owner = os.getpid()
        self._socket, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                _command("parent", service, str(self._owner), str(its.fileno())),
                stdin=subprocess.DEVNULL,
                pass_fds=(its.fileno(),),
                env=_environment(defaults),
                start_new_session=True,
            )
        atexit.register(self.end)

    @classmethod
    def acquire(cls, service: str, defaults: Mapping[str, str]) -> _WarmParent:
        """Return the warm parent of this process; start one if there is none."""
        if not cls._told_of_forks:
            os.register_at_fork(after_in_child=cls._forget)
            cls._told_of_forks = True
        with cls._lock:
            parent = cls._current.get(service)
            if parent is not None and not parent.alive:
                parent.end()
                parent = None
            if parent is None:
                parent = cls._current[service] = cls(service, defaults)
            parent._users += 1
            return parent

    @classmethod
    def _forget(cls) -> None:
        """Forget the parents in a forked child.

        The lock is new too: a thread that does not exist in the child may hold the old one.
        """
        cls._lock = threading.RLock()
        cls._current = {}

    @property
    def alive(self) -> bool:
        """True if the parent belongs to this process and runs."""
        return self._owner == os.getpid() and self._process.poll() is None

    def release(self) -> None:
        """Release the parent; the last release ends it, unless it is kept."""
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._blocks == 0:
                self.end()

    @classmethod
    def keep(cls) -> None:
        """Enter a block of `kept_warm`."""
        with cls._lock:
            cls._blocks += 1

    @classmethod
    def keep_no_longer(cls) -> None:
        """Leave a block of `kept_warm`; the last one to be left ends the parents without users."""
        with cls._lock:
            cls._blocks -= 1
            if cls._blocks == 0:
                for parent in [parent for parent in cls._current.values() if parent._users == 0]:
                    parent.end()

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message that has no answer."""
        if self._owner == os.getpid():
            with self._lock, contextlib.suppress(OSError):
                self._socket.sendall(b"f" + _framed(message))

    def fork(self, order: Order, descriptors: Sequence[int], deadline_s: float) -> Worker | None:
        """Return a fresh worker, or None if the parent has ended or does not answer in time."""
        mine, its = socket.socketpair()
        output = tempfile.TemporaryFile()  # noqa: SIM115 - stays open as long as the worker
        pid = b""
        with its, self._lock:
            self._socket.settimeout(deadline_s)
            try:
                socket.send_fds(self._socket, [b"f"], [its.fileno(), output.fileno(), *descriptors])
                self._socket.sendall(_framed({"what": "fork", "order": order}))
                pid = self._socket.recv(8)
            except OSError:
                pass
            except BaseException:  # Ctrl-C: the next call would read the answer to this one
                self.end()
                raise
        if not pid:
            mine.close()
            output.close()
            return None
        number = int.from_bytes(pid, "little")
        return Worker(_channel_of(mine, deadline_s), output, number, deadline_s)

    def end(self) -> None:
        """End the process; its workers continue. A second call does nothing."""
        if self._owner != os.getpid():
            return
        self.tell({"what": "bye"})
        with self._lock:
            atexit.unregister(self.end)
            with contextlib.suppress(OSError):  # a forked child may hold the socket as well
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            try:
                self._process.wait(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._current.get(self._service) is self:
                del self._current[self._service]


def _channel_of(mine: socket.socket, deadline_s: float) -> Channel:
    """Return the user's end of a connection, which waits `deadline_s` for each part of a message.

    Parts count, not whole messages: a process that stops in the middle of one is noticed too.
    """
    mine.settimeout(deadline_s)

    def hang_up() -> None:
        with contextlib.suppress(OSError):
            mine.shutdown(socket.SHUT_WR)
        mine.close()

    return Channel(mine.makefile("rb"), mine.makefile("wb"), hang_up)


def one_line_message(text: str) -> str:
    """Return SUMO's output as one line, without its standard phrases."""
    lines = [line.strip().removeprefix("Error: ") for line in text.splitlines()]
    return " ".join(line for line in lines if line and line != "Quitting (on error).")


def too_much_memory() -> str:
    """Return the words for a simulation that has filled its limit of memory."""
    return (
        f"it needs more memory than a simulation may use ({most_memory() / 1e9:.3g} GB); is a "
        f"number in its files far too large? {MEMORY_VARIABLE} sets another limit"
    )


def _framed(message: dict[str, Any]) -> bytes:
    text = json.dumps(message).encode()
    return LENGTH.pack(len(text)) + text


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", _PROGRAM, *arguments]


def _environment(defaults: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables, with this process's import path for the user's modules."""
    return {**defaults, **os.environ, "PYTHONPATH": import_path(), "PYTHONSAFEPATH": "1"}
