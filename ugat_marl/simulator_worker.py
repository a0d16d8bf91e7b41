"""The other end of `ugat_marl.simulator_process`: what runs in the processes it starts.

``parent`` is warm: SUMO is loaded, and it forks a worker for every pair of file descriptors that
arrives. ``spawned`` is a worker in an interpreter of its own. Both end when their socket closes.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import sys
from typing import Any, NoReturn

import numpy as np

from ugat_marl.channel import Channel, ChannelClosed, Message
from ugat_marl.errors import SimulatorError
from ugat_marl.measurements import Snapshot
from ugat_marl.simulator import Launch, LibsumoSimulator, Simulator


def _answer(simulator: Simulator, header: dict[str, Any]) -> Message:
    what = header["what"]
    if what == "start":
        fields: dict[str, Any] = dict(header["launch"])
        for name in ("arguments", "lanes"):
            fields[name] = tuple(fields[name])
        return _message(simulator.start(Launch(**fields)))
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
    with contextlib.suppress(ChannelClosed):
        while (question := _hear(channel)).header["what"] != "close":
            if question.header["what"] == "own":
                directory = question.header["directory"]
                continue
            try:
                answer = _answer(simulator, question.header)
            except SimulatorError as error:
                answer = Message({"error": str(error)}, [])
            _tell(channel, answer)
    if directory is not None:
        shutil.rmtree(directory, ignore_errors=True)
    os._exit(0)  # no destructors: libsumo's may take long on a large network


def _hear(channel: Channel) -> Message:
    try:
        return channel.receive()
    except OSError:
        raise ChannelClosed from None


def _tell(channel: Channel, answer: Message) -> None:
    try:
        channel.send(answer)
    except OSError:
        raise ChannelClosed from None


def _serve(descriptor: int) -> None:
    """The warm parent: forks a worker for every pair of file descriptors that arrives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers leave no zombies
    with socket.socket(fileno=descriptor) as control, contextlib.suppress(ConnectionError):
        while True:
            request, descriptors, _, _ = socket.recv_fds(control, 1, 2)
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
