"""The other end of `ugat_marl.simulation.process`: what runs in the processes it starts.

``parent`` is warm: SUMO is loaded, and it forks a worker for every pair of file descriptors that
arrives. ``spawned`` is a worker in an interpreter of its own. All of them end when their line
closes, or when the user's process is gone though a child it forked still holds the line open.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from typing import Any, NoReturn

import numpy as np

from ugat_marl.errors import SimulatorError
from ugat_marl.simulation.channel import Channel, ChannelClosed, Message
from ugat_marl.simulation.lifeline import LOOK_EVERY_S, Lifeline, abandoned
from ugat_marl.simulation.simulator import Launch, LibsumoSimulator, Simulator
from ugat_marl.simulation.snapshots import Snapshot


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
    told = [np.array(rows, dtype=np.float64)]
    hidden = [trips.co2_g, trips.persons, trips.dangers] if len(trips.dangers) else []
    return Message({}, told + hidden)


def _message(snapshot: Snapshot) -> Message:
    header = {
        "time_s": snapshot.time_s,
        "departed": snapshot.departed,
        "backlog": snapshot.backlog,
    }
    lanes = np.array([snapshot.vehicles, snapshot.halting, snapshot.mean_speed_mps])
    measured = [lanes, snapshot.waiting_s, snapshot.mean_left]
    return Message(header, [*measured, snapshot.near] if len(snapshot.near) else measured)


class _Worker:
    """Serves one simulation until the channel closes.

    Args:
        channel: The line to the user's process.
        parent: Number of the process that started this one.
        user: Number of the user's process.
    """

    def __init__(self, channel: Channel, parent: int, user: int) -> None:
        self._channel = channel
        self._life = Lifeline(parent, user)

    def run(self) -> NoReturn:
        """Answers questions, then removes SUMO's files and exits."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._life.watch()
        simulator = LibsumoSimulator()
        with contextlib.suppress(ChannelClosed):
            while (question := self._hear()).header["what"] != "close":
                if question.header["what"] == "own":
                    self._life.directory = question.header["directory"]
                    continue
                try:
                    answer = _answer(simulator, question.header)
                except SimulatorError as error:
                    answer = Message({"error": str(error)}, [])
                self._tell(answer)
        self._life.leave()

    def _hear(self) -> Message:
        try:
            return self._channel.receive()
        except OSError:
            raise ChannelClosed from None

    def _tell(self, answer: Message) -> None:
        try:
            self._channel.send(answer)
        except OSError:
            raise ChannelClosed from None


def _serve(descriptor: int, user: int) -> None:
    """The warm parent: forks a worker for every pair of file descriptors that arrives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers leave no zombies
    here = os.getpid()
    with socket.socket(fileno=descriptor) as control, contextlib.suppress(ConnectionError):
        control.settimeout(LOOK_EVERY_S)
        while True:
            try:
                request, descriptors, _, _ = socket.recv_fds(control, 1, 2)
            except TimeoutError:
                if abandoned(user, user):
                    return
                continue
            if not request:
                return
            pid = os.fork()
            if pid == 0:
                control.close()
                os.dup2(descriptors[1], 1)
                os.dup2(descriptors[1], 2)
                line = socket.socket(fileno=descriptors[0])
                channel = Channel(line.makefile("rb"), line.makefile("wb"), line.close)
                _Worker(channel, here, user).run()
            for descriptor in descriptors:
                os.close(descriptor)
            control.sendall(pid.to_bytes(8, "little"))


def _spawned(user: int) -> None:
    """A worker of its own interpreter: SUMO may print, so the channel leaves standard output."""
    reader, writer = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    _Worker(Channel(reader, writer, writer.close), user, user).run()


if __name__ == "__main__":
    if sys.argv[1] == "parent":
        _serve(int(sys.argv[2]), int(sys.argv[3]))
    else:
        _spawned(int(sys.argv[2]))
