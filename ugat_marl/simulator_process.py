"""The simulator in a process of its own, so that any number of simulations live at once.

A warm parent, started with the first simulation and gone with the last, has SUMO loaded and forks a
fresh worker for every episode: starting is cheap, and no episode sees what ran before. Where a
process cannot fork, every episode starts a new interpreter. Neither looks at the user's
``__main__``. Parent and workers end when their socket closes, however the user's process ends.

Messages are JSON with arrays behind it (see `ugat_marl.channel`), one round trip per decision.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np

from ugat_marl.channel import Channel, ChannelClosed, Message
from ugat_marl.errors import OptionError, SimulatorCrashed, SimulatorError
from ugat_marl.measurements import Snapshot, Trips
from ugat_marl.simulator import Launch, LibsumoSimulator, Plans, Simulator, VehiclePicture

StartMethod = Literal["forkserver", "spawn"]

_CAN_FORK = hasattr(os, "fork") and hasattr(socket, "send_fds")
_PATIENCE_S = 10.0


class ProcessSimulator:
    """SUMO in a worker process; a fresh one for every episode.

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
        self._worker: _Worker | None = None
        self._parent: _WarmParent | None = None

    def start(self, launch: Launch) -> Snapshot:
        """Starts a simulation in a fresh process; one that is under way is ended first.

        Raises:
            SimulatorError: SUMO refuses; its own words are in the message.
            SimulatorCrashed: The process died.
        """
        self._end_worker()
        if self._method == "forkserver":
            if self._parent is None:
                self._parent = _WarmParent.acquire()
            self._worker = self._parent.fork()
        else:
            self._worker = _Worker.spawn()
        return _snapshot(self._ask("start", launch=launch.as_dict()))

    def advance(self, seconds: float, plans: Plans) -> Snapshot:
        """Simulates `seconds` under the given signals, in one round trip."""
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
        (table,) = self._ask("finish").arrays
        self._end_worker()
        return Trips(table[0], table[1], table[2] > 0, table[3] > 0)

    def close(self) -> None:
        """Ends the simulation and its process; the warm parent goes with the last simulator."""
        self._end_worker()
        parent, self._parent = self._parent, None
        if parent is not None:
            parent.release()

    def __del__(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            self.close()

    def _end_worker(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()

    def _ask(self, what: str, **arguments: Any) -> Message:
        assert self._worker is not None, f"{what} before start"
        try:
            reply = self._worker.channel.ask({"what": what, **arguments})
        except (ChannelClosed, OSError):
            worker, self._worker = self._worker, None
            raise SimulatorCrashed(worker.obituary(what)) from None
        except BaseException:  # Ctrl-C between question and answer: the two no longer match
            self._end_worker()
            raise
        if error := reply.header.get("error"):
            raise SimulatorError(error)
        return reply


class _Worker:
    """The user's end of one worker process."""

    def __init__(self, channel: Channel, said: Any, pid: int, process: Any = None) -> None:
        self.channel = channel
        self._said = said
        self._pid = pid
        self._process: subprocess.Popen[bytes] | None = process

    @classmethod
    def spawn(cls) -> _Worker:
        """A new interpreter that serves one simulation on its standard streams."""
        said = tempfile.TemporaryFile()
        process = subprocess.Popen(
            _command("spawned"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=_environment(),
            **_own_session(),
        )
        assert process.stdin is not None
        assert process.stdout is not None
        channel = Channel(process.stdout, process.stdin, process.stdin.close)
        return cls(channel, said, process.pid, process)

    def end(self) -> None:
        """Closes the channel, upon which the process exits, and waits for that."""
        gone = self.channel.hang_up(_PATIENCE_S)
        if not gone:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
        if self._process is not None:
            self._process.wait()
        self._said.close()

    def obituary(self, doing: str) -> str:
        """What is known of a process that died."""
        status = ""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = f" with status {self._process.wait(timeout=_PATIENCE_S)}"
        self._said.seek(0)
        words = " ".join(self._said.read().decode(errors="replace").split())[-2000:]
        self.end()
        said = f"; it said: {words}" if words else "; it said nothing (killed, or out of memory?)"
        return (
            f"the simulator process {self._pid} died{status} during {doing!r}{said}. "
            "Other environments go on; reset() starts this one afresh"
        )


class _WarmParent:
    """The process that forks the workers; one for all simulators of a user's process."""

    _lock = threading.RLock()
    _current: _WarmParent | None = None

    def __init__(self) -> None:
        self._users = 0
        self._owner = os.getpid()
        mine, its = socket.socketpair()
        self._socket = mine
        with its:
            self._process = subprocess.Popen(
                _command("parent", str(its.fileno())),
                stdin=subprocess.DEVNULL,
                pass_fds=(its.fileno(),),
                env=_environment(),
                **_own_session(),
            )

    @classmethod
    def acquire(cls) -> _WarmParent:
        """The parent of this process, started if need be."""
        with cls._lock:
            parent = cls._current
            if parent is None or parent._owner != os.getpid() or parent._process.poll() is not None:
                parent = cls._current = cls()
            parent._users += 1
            return parent

    def release(self) -> None:
        """Gives the parent up; the last one to do so ends it."""
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._owner == os.getpid():
                self._end()

    def fork(self) -> _Worker:
        """A fresh worker.

        Raises:
            SimulatorCrashed: The parent is gone.
        """
        mine, its = socket.socketpair()
        said = tempfile.TemporaryFile()
        with its, self._lock:
            try:
                socket.send_fds(self._socket, [b"f"], [its.fileno(), said.fileno()])
                pid = int.from_bytes(self._socket.recv(8), "little")
            except OSError:
                pid = 0
        if not pid:
            mine.close()
            said.close()
            raise SimulatorCrashed(
                "the process that starts simulators is gone (killed, or out of memory?); "
                "close() the environment and make a new one"
            )
        reader, writer = mine.makefile("rb"), mine.makefile("wb")

        def hang_up() -> None:
            with contextlib.suppress(OSError):
                mine.shutdown(socket.SHUT_WR)
            mine.close()

        return _Worker(Channel(reader, writer, hang_up), said, pid)

    def _end(self) -> None:
        self._socket.close()
        try:
            self._process.wait(timeout=_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if _WarmParent._current is self:
            _WarmParent._current = None


def _end_parent_at_exit() -> None:
    parent = _WarmParent._current
    if parent is not None and parent._owner == os.getpid():
        parent._end()


atexit.register(_end_parent_at_exit)


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "ugat_marl.simulator_process", *arguments]


def _environment() -> dict[str, str]:
    """The environment, with this process's import path: a worker imports what its user imports."""
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def _own_session() -> dict[str, Any]:
    """Ctrl-C in a terminal reaches the user's process alone, which then ends the others."""
    return {"start_new_session": True} if os.name == "posix" else {}


def _snapshot(reply: Message) -> Snapshot:
    lanes, waiting = reply.arrays
    header = reply.header
    return Snapshot(
        header["time_s"],
        lanes[0],
        lanes[1],
        lanes[2],
        waiting,
        header["departed"],
        header["backlog"],
    )


# --- the worker's side -------------------------------------------------------------------------


def _answer(simulator: Simulator, header: dict[str, Any]) -> Message:
    what = header["what"]
    if what == "start":
        fields = header["launch"]
        launch = Launch(
            **{
                **fields,
                "arguments": tuple(fields["arguments"]),
                "lanes": tuple(fields["lanes"]),
            }
        )
        return _message(simulator.start(launch))
    if what == "advance":
        return _message(simulator.advance(header["seconds"], header["plans"]))
    if what == "vehicles":
        seen = simulator.vehicles()
        rows = [*seen.position.T, seen.angle_deg, seen.length_m, seen.speed_mps]
        return Message({}, [np.array(rows)])
    if what == "signals":
        return Message({"states": simulator.signals()}, [])
    assert what == "finish", what
    trips = simulator.finish()
    rows = [trips.travel_time_s, trips.delay_s, trips.finished, trips.entered]
    return Message({}, [np.array(rows, dtype=np.float64)])


def _message(snapshot: Snapshot) -> Message:
    header = {
        "time_s": snapshot.time_s,
        "departed": snapshot.departed,
        "backlog": snapshot.backlog,
    }
    lanes = np.array([snapshot.vehicles, snapshot.halting, snapshot.mean_speed_mps])
    return Message(header, [lanes, snapshot.waiting_s])


def _work(channel: Channel) -> NoReturn:
    """Serves one simulation until the channel closes, then removes SUMO's files and exits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    simulator = LibsumoSimulator()
    directory: str | None = None
    try:
        while True:
            question = channel.receive()
            if question.header["what"] == "start":
                directory = question.header["launch"]["directory"]
            try:
                answer = _answer(simulator, question.header)
            except SimulatorError as error:
                answer = Message({"error": str(error)}, [])
            channel.send(answer)
    except (ChannelClosed, OSError):
        pass
    if directory is not None:
        shutil.rmtree(directory, ignore_errors=True)
    os._exit(0)  # no destructors: libsumo's may take long on a large network


def _serve(descriptor: int) -> None:
    """The warm parent: forks a worker for every pair of file descriptors that arrives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers leave no zombies
    with socket.socket(fileno=descriptor) as control:
        while True:
            try:
                request, descriptors, _, _ = socket.recv_fds(control, 1, 2)
            except OSError:
                return
            if not request:
                return
            pid = os.fork()
            if pid == 0:
                control.close()
                os.dup2(descriptors[1], 1)
                os.dup2(descriptors[1], 2)
                line = socket.socket(fileno=descriptors[0])
                _work(Channel(line.makefile("rb"), line.makefile("wb"), line.close))
            for descriptor in descriptors:
                os.close(descriptor)
            control.sendall(pid.to_bytes(8, "little"))


def _spawned() -> None:
    """A worker of its own interpreter: SUMO may print, so the channel leaves standard output."""
    reader, writer = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    _work(Channel(reader, writer, writer.close))


if __name__ == "__main__":
    if sys.argv[1] == "parent":
        _serve(int(sys.argv[2]))
    else:
        _spawned()
