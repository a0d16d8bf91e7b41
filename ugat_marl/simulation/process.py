"""A simulator in a separate process, so that many simulations can run at once.

This file holds both ends: `ProcessSimulator` in the user's process and `Simulations` in the
workers. Each decision takes one round trip.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ugat_marl.errors import SimulatorCrashed, SimulatorError
from ugat_marl.scenarios import Segment, UpstreamLanes
from ugat_marl.simulation.channel import ChannelClosed, Message
from ugat_marl.simulation.host import Host, StartMethod, Worker
from ugat_marl.simulation.launch import Launch, SignalPlans, Simulator, VehiclePositions
from ugat_marl.simulation.snapshots import Snapshot, Trips

SERVICE = "ugat_marl.simulation.process:Simulations"


class ProcessSimulator:
    """SUMO in a worker process, a fresh one for every episode.

    A process forked during a simulation does not own that simulation. Its copy of this object needs
    a new `start`, and the simulation of the first process continues.

    Args:
        start_method: ``"forkserver"`` (the default where processes can fork) or ``"spawn"``.
        deadline_s: Seconds within which SUMO has to answer, as in `Host`; then its process counts
            as dead.

    Raises:
        OptionError: The method is unknown, or this system does not have it.
    """

    def __init__(
        self, start_method: StartMethod | None = None, deadline_s: float | None = None
    ) -> None:
        self._host = Host(SERVICE, start_method, deadline_s=deadline_s)
        self._worker: Worker | None = None
        self._shown: dict[str, str] = {}
        self._busy = False

    def start(self, launch: Launch) -> Snapshot:
        """Start a simulation in a fresh process; end a running one first.

        Raises:
            SimulatorError: SUMO refuses; its own words are in the message.
            SimulatorCrashed: The process died.
        """
        self._end_worker()
        self._shown = {}
        # Tell the worker the folder before it exists, so that the worker removes it in any case.
        self._worker = self._host.start({"directory": launch.directory})
        launch.write()
        return _snapshot(self._ask("start", launch=launch.as_dict()))

    def advance(
        self, seconds: float, plans: SignalPlans, meanwhile: Callable[[], object] | None = None
    ) -> Snapshot:
        """Simulate `seconds` under the given signals, in one round trip; see `Simulator`.

        Raises:
            SimulatorError: SUMO failed; its own words are in the message.
            SimulatorCrashed: The process died.
        """
        changes: dict[str, Sequence[Segment]] = {}  # most lights go on with what they show
        for light, plan in plans.items():
            if any(state != self._shown.get(light) for _, state in plan):
                changes[light] = plan
                self._shown[light] = plan[-1][1]
        return _snapshot(self._ask("advance", meanwhile, seconds=seconds, plans=changes))

    def vehicles(self) -> VehiclePositions:
        """Return the positions of all vehicles now."""
        (table,) = self._ask("vehicles").arrays
        return VehiclePositions(table[:2].T, table[2], table[3], table[4])

    def signals(self) -> dict[str, str]:
        """Return the state of every traffic light now."""
        return self._ask("signals").header["states"]

    def finish(self) -> Trips:
        """End the simulation and its process; return the trips of every vehicle due."""
        table, *hidden = self._ask("finish").arrays
        self._end_worker()
        return Trips(table[0], table[1], table[2] > 0, table[3] > 0, *hidden)

    def close(self) -> None:
        """End the simulation and its process. The warm parent ends with the last simulator."""
        self._end_worker()
        self._host.close()

    def __del__(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            self.close()

    def _end_worker(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()

    def _ask(
        self, request: str, meanwhile: Callable[[], object] | None = None, **arguments: Any
    ) -> Message:
        worker = self._worker
        if self._busy:
            raise SimulatorError(
                f"{request}: the simulation is in the middle of a step; work that is done "
                "meanwhile cannot ask it"
            )
        if worker is None or not worker.running:
            raise SimulatorError(
                f"{request}: no simulation is under way in this process; start one"
            )
        try:
            worker.ask(request, **arguments)
            if meanwhile is not None:
                self._do(meanwhile, worker)
            return worker.answer()
        except ChannelClosed:
            self._worker = None
            raise SimulatorCrashed(worker.crash_message(request)) from None

    def _do(self, work: Callable[[], object], asked: Worker) -> None:
        """Do the work; if it fails, end the worker, whose answer nobody would read."""
        self._busy = True
        try:
            work()
        except BaseException:
            asked.end(patience_s=0.0)
            raise
        finally:
            self._busy = False


def simulator_of(option: str, deadline_s: float | None = None) -> Simulator:
    """Return the simulator for an option of `EnvOptions`.

    Args:
        option: ``"inprocess"``, ``"spawn"`` or another name.
        deadline_s: Seconds within which its process has to answer, as in `Host`.
    """
    if option == "inprocess":
        from ugat_marl.simulation.simulator import LibsumoSimulator  # loads libsumo

        return LibsumoSimulator()
    return ProcessSimulator("spawn" if option == "spawn" else None, deadline_s)


def _snapshot(reply: Message) -> Snapshot:
    lanes, waiting, mean_left, near, queued_upstream, detected = reply.arrays
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
        near,
        queued_upstream,
        detected,
    )


class Simulations:
    """Service that runs one simulator in each worker.

    Making it loads libsumo: once, in the warm parent, for all workers.
    """

    def __init__(self) -> None:
        from ugat_marl.simulation.simulator import LibsumoSimulator

        self._simulator: Callable[[], Simulator] = LibsumoSimulator

    def prepare(self, order: dict[str, Any]) -> None:
        """Do nothing: SUMO is loaded already."""

    def open(
        self, order: dict[str, Any], descriptors: Sequence[int]
    ) -> Callable[[Message], Message]:
        """Return a function that answers questions to a fresh simulator."""
        simulator = self._simulator()
        return lambda question: _answer(simulator, question.header)

    def told(self, order: dict[str, Any]) -> None:
        """Do nothing: hosts of simulations send no messages here."""

    def abandoned(self) -> None:
        """Do nothing: workers remove their own folders."""


def _answer(simulator: Simulator, question: dict[str, Any]) -> Message:
    request = question["what"]
    if request == "start":
        fields: dict[str, Any] = dict(question["launch"])
        for name in ("arguments", "lanes", "reads", "outputs"):
            fields[name] = tuple(fields[name])
        fields["behind"] = UpstreamLanes(*fields["behind"])
        launch = Launch(**fields)
        launch.confine()
        return _message(simulator.start(launch))
    if request == "advance":
        return _message(simulator.advance(question["seconds"], question["plans"]))
    if request == "vehicles":
        seen = simulator.vehicles()
        rows = [*seen.position.T, seen.angle_deg, seen.length_m, seen.speed_mps]
        return Message({}, [np.array(rows)])
    if request == "signals":
        return Message({"states": simulator.signals()}, [])
    assert request == "finish", request
    trips = simulator.finish()
    rows = [trips.travel_time_s, trips.delay_s, trips.finished, trips.entered]
    table = [np.array(rows, dtype=np.float64)]
    hidden = [trips.co2_g, trips.persons, trips.dangers] if len(trips.dangers) else []
    return Message({}, table + hidden)


def _message(snapshot: Snapshot) -> Message:
    header = {
        "time_s": snapshot.time_s,
        "departed": snapshot.departed,
        "backlog": snapshot.backlog,
    }
    lanes = np.array([snapshot.vehicles, snapshot.halting, snapshot.mean_speed_mps])
    others = [snapshot.waiting_s, snapshot.mean_left, snapshot.near, snapshot.queued_upstream]
    return Message(header, [lanes, *others, snapshot.detected])
