"""Processes that work for this one: a warm parent that forks workers, and the line to each worker.

A `Host` starts workers of one `Service`. The warm parent, started with the first worker and gone
with the last host, has loaded the service and forks a fresh process each time: starting is cheap,
and no worker sees what another one did. Where processes cannot fork, every worker is a new
interpreter. Neither looks at the user's ``__main__``. Parent and workers end with the user's
process, however that ends; see `ugat_marl.simulation.worker` for their side.

Messages are JSON with float64 arrays behind it. There is no pickle: what arrives is data.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, ClassVar, Literal, Protocol

from numpy.typing import NDArray

from ugat_marl import errors
from ugat_marl.errors import OptionError, SimulatorCrashed, UgatMarlError, WorkerError
from ugat_marl.simulation.channel import Channel, ChannelClosed, Message

StartMethod = Literal["forkserver", "spawn"]
Order = Mapping[str, Any]
"""Plain values for JSON that say what a worker is for. The folder of its key ``"directory"``, if
there is one, is removed when the worker ends."""

LENGTH = struct.Struct("<I")
"""Number of bytes of an order, before the order."""

PATIENCE_S = 10.0
"""Seconds in which a process that is asked to end has to do so; then it is killed."""

_CAN_FORK = hasattr(os, "fork") and hasattr(socket, "send_fds")
_PROGRAM = "ugat_marl.simulation.worker"


class Service(Protocol):
    """Work of the workers of a host: a class without arguments, named ``"module:Class"``.

    The warm parent makes one object, whose state its workers inherit when they are forked.
    """

    def prepare(self, order: dict[str, Any]) -> None:
        """Get ready for a worker; in the warm parent, before it forks."""
        ...

    def open(
        self, order: dict[str, Any], descriptors: Sequence[int]
    ) -> Callable[[Message], Message]:
        """Return what answers the questions to a worker; in the worker.

        Args:
            order: As given to `Host.start`.
            descriptors: Open files that were given with it.
        """
        ...

    def told(self, order: dict[str, Any]) -> None:
        """Take note of what `Host.tell` was given; in the warm parent."""
        ...

    def abandoned(self) -> None:
        """Tidy up; in the warm parent, when the user's process has died."""
        ...


class Host:
    """Start workers of a service.

    Args:
        service: ``"module:Class"`` of the `Service`.
        start_method: ``"forkserver"`` (the default where processes can fork) or ``"spawn"``.

    Raises:
        OptionError: Another method, or one that this system does not have.
    """

    def __init__(self, service: str, start_method: StartMethod | None = None) -> None:
        method = start_method or ("forkserver" if _CAN_FORK else "spawn")
        if method not in ("forkserver", "spawn"):
            raise OptionError(f"start_method = {method!r}; allowed: 'forkserver', 'spawn'")
        if method == "forkserver" and not _CAN_FORK:
            raise OptionError("start_method = 'forkserver' needs a system that can fork")
        self._service = service
        self._method: StartMethod = method
        self._parent: _WarmParent | None = None

    def start(self, order: Order, descriptors: Sequence[int] = ()) -> Worker:
        """Start a worker; a warm parent that was killed is replaced.

        Args:
            order: Passed to the service.
            descriptors: Open files the worker inherits; only with ``"forkserver"``.

        Raises:
            SimulatorCrashed: No process can be started.
        """
        if self._method == "spawn":
            return Worker.spawn(self._service, order)
        for _ in range(2):
            parent = self.warm()
            worker = parent.fork(order, descriptors)
            if worker is not None:
                return worker
            parent.end()
        raise SimulatorCrashed(
            "the process that starts simulations cannot be started or was killed twice (out of "
            "memory?); its own words are above, if it had any"
        )

    def warm(self) -> _WarmParent:
        """Start the warm parent, if there is none; `start` does so itself."""
        if self._parent is None or not self._parent.alive:
            self._parent = _WarmParent.acquire(self._service)
        return self._parent

    def tell(self, order: Order) -> None:
        """Tell the warm parent something, if there is one."""
        if self._parent is not None:
            self._parent.tell({"what": "tell", "order": order})

    def close(self) -> None:
        """Give the warm parent up, which ends with its last host; workers go on."""
        parent, self._parent = self._parent, None
        if parent is not None:
            parent.release()


class Worker:
    """The user's end of one worker process.

    Args:
        channel: The line to it.
        said: File with everything it prints.
        pid: Its number.
        process: The process, if it is a child of this one.
    """

    def __init__(
        self,
        channel: Channel,
        said: IO[bytes],
        pid: int,
        process: subprocess.Popen[bytes] | None = None,
    ) -> None:
        self._channel = channel
        self._said = said
        self._pid = pid
        self._process = process
        self._owner = os.getpid()
        self._ended = False

    @classmethod
    def spawn(cls, service: str, order: Order) -> Worker:
        """Start a new interpreter that is served on its standard streams."""
        said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the worker
        process: subprocess.Popen[bytes] = subprocess.Popen(
            _command("spawned", service, str(os.getpid()), json.dumps(order)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=_environment(),
            start_new_session=True,  # Ctrl-C reaches the user's process alone, which ends this one
        )
        assert process.stdin is not None
        assert process.stdout is not None
        channel = Channel(process.stdout, process.stdin, process.stdin.close)
        return cls(channel, said, process.pid, process)

    @property
    def running(self) -> bool:
        """True until it is ended, in the process that started it; False in one forked from that."""
        return self._owner == os.getpid() and not self._ended

    def ask(self, what: str, arrays: Sequence[NDArray[Any]] = (), **arguments: Any) -> None:
        """Send a question; `answer` waits for its answer.

        Raises:
            ChannelClosed: The process died, see `obituary`.
        """
        try:
            self._channel.send(Message({"what": what, **arguments}, list(arrays)))
        except OSError:
            raise ChannelClosed from None
        except BaseException:  # Ctrl-C in the middle of a message
            self.end(patience_s=0.0)
            raise

    def answer(self) -> Message:
        """Wait for the answer to a question.

        Raises:
            ChannelClosed: The process died, see `obituary`.
            UgatMarlError: The service raised it; the process has been ended.
            WorkerError: The service raised something else; the process has been ended.
        """
        try:
            reply = self._channel.receive()
        except (ChannelClosed, OSError):
            raise ChannelClosed from None
        except BaseException:  # Ctrl-C between question and answer: the two no longer match
            self.end(patience_s=0.0)
            raise
        if "error" in reply.header:
            error = self._raised(reply.header)
            self.end()
            raise error
        return reply

    def end(self, patience_s: float = PATIENCE_S) -> None:
        """Close the line, so that the process exits, and wait for that; may be called again.

        Args:
            patience_s: After this many seconds the process is killed.
        """
        if not self.running:
            return
        self._ended = True
        with contextlib.suppress(OSError, ValueError):
            self._channel.send(Message({"what": "close"}, []))
        if not self._channel.hang_up(patience_s):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
        if self._process is not None:
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._said.close()

    def obituary(self, doing: str) -> str:
        """Return what is known of a process that died, and end what is left of it."""
        status = ""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = f" with status {self._process.wait(timeout=PATIENCE_S)}"
        words = self._words()
        self.end()
        said = f"it said: {words}" if words else "it said nothing (killed, or out of memory?)"
        return (
            f"the simulator process {self._pid} died{status} during {doing!r}; {said}. "
            "Other environments go on; reset() starts this one afresh"
        )

    def _raised(self, reply: dict[str, Any]) -> UgatMarlError:
        """Return the exception a process reports, of the nearest kind that takes a message."""
        for name in reply["kinds"]:
            kind = getattr(errors, name, None)
            if kind is not None and name != "UnknownNameError":
                # SUMO's error log may have only the end of what it printed.
                words, error = self._words(), reply["error"]
                return kind(error if words in error else f"{error} {words}")
        return WorkerError(
            "an exception that is not the suite's own was raised in the process of a simulation, "
            f"by the reward or the wrapper if there is one:\n{reply['error']}"
        )

    def _words(self) -> str:
        self._said.seek(0)
        return one_line(self._said.read().decode(errors="replace"))[-2000:]


class _WarmParent:
    """The process that forks the workers of a service; one for all hosts of a user's process."""

    _lock: ClassVar[threading.RLock] = threading.RLock()
    _current: ClassVar[dict[str, _WarmParent]] = {}
    _told_of_forks: ClassVar[bool] = False

    def __init__(self, service: str) -> None:
        self._service = service
        self._users = 0
        self._owner = os.getpid()
        self._socket, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                _command("parent", service, str(self._owner), str(its.fileno())),
                stdin=subprocess.DEVNULL,
                pass_fds=(its.fileno(),),
                env=_environment(),
                start_new_session=True,
            )
        atexit.register(self.end)

    @classmethod
    def acquire(cls, service: str) -> _WarmParent:
        """Return the parent of this process, started if need be."""
        if not cls._told_of_forks:
            os.register_at_fork(after_in_child=cls._forget)
            cls._told_of_forks = True
        with cls._lock:
            parent = cls._current.get(service)
            if parent is None or not parent.alive:
                parent = cls._current[service] = cls(service)
            parent._users += 1
            return parent

    @classmethod
    def _forget(cls) -> None:
        """Forget the parents in a forked child; a thread that is not in it may hold the lock."""
        cls._lock = threading.RLock()
        cls._current = {}

    @property
    def alive(self) -> bool:
        """True if it belongs to this process and runs."""
        return self._owner == os.getpid() and self._process.poll() is None

    def release(self) -> None:
        """Give the parent up; the last one to do so ends it."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self.end()

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message that has no answer."""
        if self._owner == os.getpid():
            with self._lock, contextlib.suppress(OSError):
                self._socket.sendall(b"f" + _framed(message))

    def fork(self, order: Order, descriptors: Sequence[int]) -> Worker | None:
        """Return a fresh worker, or None if the parent is gone."""
        mine, its = socket.socketpair()
        said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the worker
        pid = b""
        with its, self._lock:
            try:
                socket.send_fds(self._socket, [b"f"], [its.fileno(), said.fileno(), *descriptors])
                self._socket.sendall(_framed({"what": "fork", "order": order}))
                pid = self._socket.recv(8)
            except OSError:
                pass
            except BaseException:  # Ctrl-C: the answer to come would be taken for the next one's
                self.end()
                raise
        if not pid:
            mine.close()
            said.close()
            return None
        reader, writer = mine.makefile("rb"), mine.makefile("wb")

        def hang_up() -> None:
            with contextlib.suppress(OSError):
                mine.shutdown(socket.SHUT_WR)
            mine.close()

        return Worker(Channel(reader, writer, hang_up), said, int.from_bytes(pid, "little"))

    def end(self) -> None:
        """End the process; its workers go on. May be called again."""
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


def one_line(text: str) -> str:
    """Return what SUMO printed as one line, without its formulas."""
    lines = [line.strip().removeprefix("Error: ") for line in text.splitlines()]
    return " ".join(line for line in lines if line and line != "Quitting (on error).")


def _framed(message: dict[str, Any]) -> bytes:
    text = json.dumps(message).encode()
    return LENGTH.pack(len(text)) + text


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", _PROGRAM, *arguments]


def _environment() -> dict[str, str]:
    """Return the environment, with this process's import path for what its user imports."""
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
