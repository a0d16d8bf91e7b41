"""The simulator in a process of its own, so that any number of simulations live at once.

A warm parent, started with the first simulation and gone with the last, has SUMO loaded and forks a
fresh worker for every episode: starting is cheap, and no episode sees what ran before. Where a
process cannot fork, every episode starts a new interpreter. Neither looks at the user's
``__main__``. Parent and workers end with the user's process, however that ends.

Messages are JSON with arrays behind it (see `ugat_marl.simulation.channel`), one round trip per
decision; the other end is `ugat_marl.simulation.worker`.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, ClassVar, Literal, Self

from ugat_marl.errors import OptionError, SimulatorCrashed, SimulatorError
from ugat_marl.simulation.channel import Channel, ChannelClosed, Message
from ugat_marl.simulation.simulator import (
    Launch,
    LibsumoSimulator,
    Plans,
    Simulator,
    VehiclePicture,
    one_line,
)
from ugat_marl.simulation.snapshots import Snapshot, Trips

StartMethod = Literal["forkserver", "spawn"]

_CAN_FORK = hasattr(os, "fork") and hasattr(socket, "send_fds")
PATIENCE_S = 10.0
_PROGRAM = "ugat_marl.simulation.worker"


class ProcessSimulator:
    """SUMO in a worker process; a fresh one for every episode.

    A process that is forked while a simulation is under way does not own it: there the simulator
    begins anew with the next `start`, and the simulation of the first process goes on.

    Args:
        start_method: ``"forkserver"`` (the default where processes can fork) or ``"spawn"``.
    """

    def __init__(self, start_method: StartMethod | None = None) -> None:
        method = start_method or ("forkserver" if _CAN_FORK else "spawn")
        if method not in ("forkserver", "spawn"):
            raise OptionError(f"start_method = {method!r}; allowed: 'forkserver', 'spawn'")
        if method == "forkserver" and not _CAN_FORK:
            raise OptionError("start_method = 'forkserver' needs a system that can fork")
        self._method: StartMethod = method
        self._worker: Worker | None = None
        self._parent: WarmParent | None = None

    def start(self, launch: Launch) -> Snapshot:
        """Starts a simulation in a fresh process; one that is under way is ended first.

        Raises:
            SimulatorError: SUMO refuses; its own words are in the message.
            SimulatorCrashed: The process died.
        """
        self._end_worker()
        self._worker = self._fork() if self._method == "forkserver" else Worker.spawn()
        # The worker removes the folder when it ends, so it knows of it before there is one.
        self._tell("own", directory=launch.directory)
        launch.write()
        return _snapshot(self._ask("start", launch=launch.as_dict()))

    def advance(self, seconds: float, plans: Plans) -> Snapshot:
        """Simulates `seconds` under the given signals, in one round trip.

        Raises:
            SimulatorError: SUMO failed; its own words are in the message.
            SimulatorCrashed: The process died.
        """
        return _snapshot(self._ask("advance", seconds=seconds, plans=plans))

    def vehicles(self) -> VehiclePicture:
        """Positions of all vehicles now."""
        (table,) = self._ask("vehicles").arrays
        return VehiclePicture(table[:2].T, table[2], table[3], table[4])

    def signals(self) -> dict[str, str]:
        """State of every traffic light now."""
        return self._ask("signals").header["states"]

    def finish(self) -> Trips:
        """Ends the simulation and its process; returns what became of every vehicle due."""
        table, *hidden = self._ask("finish").arrays
        self._end_worker()
        return Trips(table[0], table[1], table[2] > 0, table[3] > 0, *hidden)

    def close(self) -> None:
        """Ends the simulation and its process; the warm parent goes with the last simulator."""
        self._end_worker()
        parent, self._parent = self._parent, None
        if parent is not None:
            parent.release()

    def __del__(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            self.close()

    def _fork(self) -> Worker:
        """A worker from the warm parent, from a new one if somebody killed it."""
        for attempts_left in (1, 0):
            if self._parent is None or not self._parent.alive:
                self._parent = WarmParent.acquire()
            worker = self._parent.fork()
            if worker is not None:
                return worker
            self._parent.end()
            if not attempts_left:
                break
        raise SimulatorCrashed(
            "the process that starts simulators cannot be started or was killed twice (out of "
            "memory?); its own words are above, if it had any"
        )

    def _end_worker(self, patience_s: float = PATIENCE_S) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end(patience_s)

    def _tell(self, what: str, **arguments: Any) -> Worker:
        """Sends a message to the worker that runs a simulation for this process."""
        worker = self._worker
        if worker is None or not worker.mine:
            raise SimulatorError(f"{what}: no simulation is under way in this process; start one")
        try:
            worker.channel.send(Message({"what": what, **arguments}, []))
        except OSError:
            self._worker = None
            raise SimulatorCrashed(worker.obituary(what)) from None
        except BaseException:  # Ctrl-C in the middle of a message
            self._end_worker(patience_s=0.0)
            raise
        return worker

    def _ask(self, what: str, **arguments: Any) -> Message:
        worker = self._tell(what, **arguments)
        try:
            reply = worker.channel.receive()
        except (ChannelClosed, OSError):
            self._worker = None
            raise SimulatorCrashed(worker.obituary(what)) from None
        except BaseException:  # Ctrl-C between question and answer: the two no longer match
            self._end_worker(patience_s=0.0)
            raise
        if error := reply.header.get("error"):
            error = worker.in_full(error)
            self._end_worker()
            raise SimulatorError(error)
        return reply


def simulator_of(option: str) -> Simulator:
    """A simulator by the name that `EnvOptions` has for its kind."""
    if option == "inprocess":
        return LibsumoSimulator()
    return ProcessSimulator("spawn" if option == "spawn" else None)


class Worker:
    """The user's end of one worker process.

    Args:
        channel: The line to it.
        said: What it prints.
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
        self.channel = channel
        self._said = said
        self._pid = pid
        self._process = process
        self._owner = os.getpid()

    @property
    def mine(self) -> bool:
        """Whether this process started it, and not one that this one was forked from."""
        return self._owner == os.getpid()

    @classmethod
    def spawn(cls) -> Worker:
        """A new interpreter that serves one simulation on its standard streams."""
        said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the worker
        process: subprocess.Popen[bytes] = subprocess.Popen(
            _command(_PROGRAM, "spawned", str(os.getpid())),
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

    def end(self, patience_s: float = PATIENCE_S) -> None:
        """Closes the channel, upon which the process exits, and waits for that.

        Args:
            patience_s: After this many seconds the process is killed.
        """
        if not self.mine:
            return
        with contextlib.suppress(OSError, ValueError):
            self.channel.send(Message({"what": "close"}, []))
        if not self.channel.hang_up(patience_s):
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
        """What is known of a process that died."""
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

    def in_full(self, error: str) -> str:
        """An error with what SUMO printed beside it: its error log may have only the end."""
        words = self._words()
        return error if words in error else f"{error} {words}"

    def _words(self) -> str:
        self._said.seek(0)
        return one_line(self._said.read().decode(errors="replace"))[-2000:]


class WarmParent:
    """The process that forks the workers; one for all simulators of a user's process."""

    program: ClassVar[str] = _PROGRAM
    _lock: ClassVar[threading.RLock] = threading.RLock()
    _current: ClassVar[Any] = None
    _told_of_forks: ClassVar[bool] = False

    def __init__(self) -> None:
        self._users = 0
        self._owner = os.getpid()
        self._socket, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                _command(self.program, "parent", str(its.fileno()), str(self._owner)),
                stdin=subprocess.DEVNULL,
                pass_fds=(its.fileno(),),
                env=_environment(),
                start_new_session=True,
            )
        atexit.register(self.end)

    @classmethod
    def acquire(cls) -> Self:
        """The parent of this process, started if need be."""
        if not cls._told_of_forks:
            os.register_at_fork(after_in_child=cls._forget)
            cls._told_of_forks = True
        with cls._lock:
            if cls._current is None or not cls._current.alive:
                cls._current = cls()
            cls._current._users += 1
            return cls._current

    @classmethod
    def _forget(cls) -> None:
        """In a forked child: the lock may be held by a thread that does not exist here."""
        cls._lock = threading.RLock()
        cls._current = None

    @property
    def alive(self) -> bool:
        """Whether it belongs to this process and runs."""
        return self._owner == os.getpid() and self._process.poll() is None

    def release(self) -> None:
        """Gives the parent up; the last one to do so ends it."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self.end()

    def fork(self, descriptors: Sequence[int] = (), order: bytes = b"") -> Worker | None:
        """A fresh worker, or None if the parent is gone.

        Args:
            descriptors: Open files the worker gets beside its line and what it prints to.
            order: What the parent reads before it forks.
        """
        mine, its = socket.socketpair()
        said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the worker
        pid = b""
        with its, self._lock:
            try:
                socket.send_fds(self._socket, [b"f"], [its.fileno(), said.fileno(), *descriptors])
                self._socket.sendall(order)
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
        """Ends the process; its workers go on. May be called again."""
        if self._owner != os.getpid():
            return
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
            if type(self)._current is self:
                type(self)._current = None


def _command(program: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", program, *arguments]


def _environment() -> dict[str, str]:
    """The environment, with this process's import path: a worker imports what its user imports."""
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def _snapshot(reply: Message) -> Snapshot:
    lanes, waiting, mean_left, *near = reply.arrays
    header = reply.header
    return Snapshot(
        header["time_s"],
        lanes[0],
        lanes[1],
        lanes[2],
        waiting,
        header["departed"],
        header["backlog"],
        mean_left,
        *near,
    )
