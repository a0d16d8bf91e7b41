"""The program of a host's processes: the warm parent, its workers, and how they end.

``parent`` has loaded its service and forks a worker for every order. ``spawned`` is a worker in a
new interpreter, with a guard that kills it where it cannot end itself. All of them end when their
connection closes or when the user's process has ended. The second check is needed because a child
of the user's process may hold the connection open.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shutil
import signal
import socket
import stat
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ugat_marl.errors import SimulatorError, UgatMarlError
from ugat_marl.scenarios import MEMORY_VARIABLE
from ugat_marl.simulation.channel import Channel, ChannelClosed, Message
from ugat_marl.simulation.host import LENGTH, too_much_memory

if TYPE_CHECKING:
    from ugat_marl.simulation.host import Service

LOOK_EVERY_S = 1.0
"""Seconds between two checks of the user's process."""

_GRACE_S = 4.0
"""Seconds in which a worker ends itself; it looks every second and removes its folder."""

_MOST_DESCRIPTORS = 8
"""Largest number of open files with an order."""


def exit_when_input_ends() -> None:
    """End this process with exit code 1 when standard input ends, because its starter has ended.

    Starters give a pipe. Other inputs, such as that of a command under ``nohup``, are not watched.

    The thread reads the descriptor, not `sys.stdin`: the lock of `sys.stdin` could block the exit.
    """
    try:
        kind = os.fstat(0).st_mode
    except OSError:  # it is closed
        return
    if not stat.S_ISFIFO(kind) and not stat.S_ISSOCK(kind):
        return

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _abandoned(parent: int, user: int) -> bool:
    """Return True if this process lost its parent because the user's process ended.

    If only the warm parent was killed, its workers continue.
    """
    if os.getppid() == parent:
        return False
    try:
        os.kill(user, 0)
    except (ProcessLookupError, PermissionError):  # it ended; its number may have a new owner
        return True
    try:  # it may have ended without its parent having noticed, which waits for our output
        state = Path(f"/proc/{user}/stat").read_bytes().rpartition(b")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state == b"Z"


class _Life:
    """Watch that ends a worker with the user's process and removes its folder.

    Its thread begins before the worker is confined, so that it may remove the folder.

    Args:
        parent: Number of the process that started this one.
        user: Number of the user's process.
        directory: Folder to remove at the end, or None.
        guard: Number of the process of `_guard`, or None.
    """

    def __init__(
        self, parent: int, user: int, directory: str | None, guard: int | None = None
    ) -> None:
        self._parent = parent
        self._user = user
        self._directory = directory
        self._guard = guard
        self._over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def leave(self) -> NoReturn:
        """Remove the folder and exit."""
        self._over.set()
        while True:
            time.sleep(LOOK_EVERY_S)

    def _watch(self) -> None:
        while not self._over.wait(LOOK_EVERY_S) and not _abandoned(self._parent, self._user):
            pass
        if self._directory is not None:
            shutil.rmtree(self._directory, ignore_errors=True)
        if self._guard is not None:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(self._guard, signal.SIGKILL)
                os.waitpid(self._guard, 0)
        os._exit(0)  # no destructors: libsumo's may take long on a large network


def _work(
    service: Service,
    channel: Channel,
    order: dict[str, Any],
    descriptors: list[int],
    parent: int,
    user: int,
    guard: int | None = None,
) -> NoReturn:
    """Answer questions until the connection closes, then exit."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ[MEMORY_VARIABLE] = order["memory"]
    life = _Life(parent, user, order.get("directory"), guard)
    answer = service.open(order, descriptors)
    with contextlib.suppress(ChannelClosed, OSError):
        while (question := channel.receive()).header["what"] != "close":
            channel.send(_answered(answer, question))
    life.leave()


def _answered(answer: Callable[[Message], Message], question: Message) -> Message:
    try:
        return answer(question)
    except UgatMarlError as error:
        kinds = [kind.__name__ for kind in type(error).__mro__]
        return Message({"error": str(error), "kinds": kinds}, [])
    except MemoryError:
        return Message({"error": too_much_memory(), "kinds": [SimulatorError.__name__]}, [])
    except (Exception, SystemExit):  # noqa: BLE001 - the user's reward or wrapper may raise them
        return Message({"error": traceback.format_exc(limit=-5), "kinds": []}, [])


def _serve(service: Service, user: int, descriptor: int) -> None:
    """Fork a worker for every order, until the host says goodbye or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers leave no zombies
    here, workers = os.getpid(), dict[int, str | None]()
    with socket.socket(fileno=descriptor) as control, contextlib.suppress(ConnectionError):
        while (request := _next(control, user)) is not None:
            message, descriptors = request
            if message["what"] == "bye":
                return
            if message["what"] == "tell":
                service.told(message["order"])
                continue
            order = message["order"]
            service.prepare(order)
            pid = os.fork()
            if pid == 0:
                control.close()
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                number, said, *others = descriptors
                os.dup2(said, 1)
                os.dup2(said, 2)
                line = socket.socket(fileno=number)
                channel = Channel(line.makefile("rb"), line.makefile("wb"), line.close)
                _work(service, channel, order, others, here, user)
            for number in descriptors:
                os.close(number)
            control.sendall(pid.to_bytes(8, "little"))
            workers = {each: folder for each, folder in workers.items() if _runs(each)}
            workers[pid] = order.get("directory")
    _end_workers(workers, user)
    service.abandoned()


def _runs(worker: int) -> bool:
    """Return True if a worker of this process runs."""
    try:
        return os.waitpid(worker, os.WNOHANG) == (0, 0)
    except ChildProcessError:
        return False


def _end_workers(workers: dict[int, str | None], user: int) -> None:
    """Kill the workers that cannot end themselves after the user's process has ended.

    A worker inside a long call of SUMO does not come to its own watch: the call keeps the lock of
    the interpreter.

    Args:
        workers: Number of each worker, and its folder, which is removed.
        user: Number of the user's process.
    """
    until = time.monotonic() + _GRACE_S
    while (running := [*filter(_runs, workers)]) and time.monotonic() < until:
        time.sleep(LOOK_EVERY_S / 4)
    if not running or not _abandoned(user, user):
        return
    for worker in running:
        os.kill(worker, signal.SIGKILL)
        if (folder := workers[worker]) is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _guard(user: int, folder: str | None, streams: Iterable[int]) -> int | None:
    """Start a process that does for this worker what `_end_workers` does for forked ones.

    Args:
        user: Number of the user's process.
        folder: Folder of the worker, which is removed if the worker is killed.
        streams: Descriptors that lead to the user's process.

    Returns:
        Number of the process; None where processes cannot fork.
    """
    if not hasattr(os, "fork"):
        return None
    worker = os.getpid()
    if guard := os.fork():
        return guard
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in streams:  # the user's process waits until all copies of them are closed
        os.dup2(nothing, stream)
    while os.getppid() == worker and not _abandoned(0, user):
        time.sleep(LOOK_EVERY_S)
    until = time.monotonic() + _GRACE_S
    while os.getppid() == worker and time.monotonic() < until:
        time.sleep(LOOK_EVERY_S / 4)
    if os.getppid() == worker:
        os.kill(worker, signal.SIGKILL)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def _next(control: socket.socket, user: int) -> tuple[dict[str, Any], list[int]] | None:
    """Return the next message and its open files; None if the user's process has ended."""
    control.settimeout(LOOK_EVERY_S)
    while True:
        try:
            first, descriptors, _, _ = socket.recv_fds(control, 1, _MOST_DESCRIPTORS)
            break
        except TimeoutError:
            if _abandoned(user, user):
                return None
    control.settimeout(None)
    if not first:
        return None
    (length,) = LENGTH.unpack(_exactly(control, LENGTH.size))
    return json.loads(_exactly(control, length)), descriptors


def _exactly(control: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = control.recv(count - len(data))
        if not more:
            raise ConnectionError
        data += more
    return data


def _spawned(name: str, user: int) -> None:
    """Work in a new interpreter on the order that is the first message.

    Messages move to copies of the standard streams, because SUMO may print to standard output.
    """
    reader, writer = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    channel = Channel(reader, writer, writer.close)
    try:
        order = channel.receive().header["order"]
    except ChannelClosed:
        return
    streams = (0, 1, 2, reader.fileno(), writer.fileno())
    guard = _guard(user, order.get("directory"), streams)  # before a library starts a thread
    os.dup2(2, 1)
    service = _service(name)
    service.prepare(order)
    _work(service, channel, order, [], user, user, guard)


def _main(kind: str, name: str, user: str, control: str = "") -> None:
    if kind == "parent":
        _serve(_service(name), int(user), int(control))
        os._exit(0)  # unloading SUMO or torch takes long
    else:
        _spawned(name, int(user))


def _service(name: str) -> Service:
    module, _, member = name.partition(":")
    return getattr(importlib.import_module(module), member)()


if __name__ == "__main__":
    _main(*sys.argv[1:])
