"""Interface of a street: counts with their time, lights to set, a clock.

`TraciStreet` uses a running SUMO as the street. `StartedSumo` starts such a SUMO. A real street is
a class with the five methods of `Street`; docs/how-to/field.md shows one.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Protocol

import traci
import traci.constants as tc
from traci.exceptions import FatalTraCIError, TraCIException

from ugat_marl.effects import late_greens
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import Trips, launch_of, read_trips

CountSource = Literal["lanes", "areas"]
"""Source of SUMO's counts: whole lanes, or its lane-area detectors."""

_RETRY_S = 0.05

_PATIENCE_S = 10.0
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>


class LaneCount(NamedTuple):
    """Count of one lane.

    Attributes:
        time_s: Time of the count on the street's clock, s.
        vehicles: Number of vehicles on the lane; an estimate need not be whole.
        halting: Number of standing vehicles among them; NaN if it is not measured.
    """

    time_s: float
    vehicles: float
    halting: float = math.nan


class Street(Protocol):
    """Interface of a street. The loop survives an error of `read`, but of no other method."""

    def now_s(self) -> float:
        """Return the street's clock, s."""
        ...

    def shown(self) -> Mapping[str, str]:
        """Return traffic light to the state that it shows now, one letter of SUMO per link."""
        ...

    def read(self) -> Mapping[str, LaneCount]:
        """Return lane to its last count, without waiting for a new one; lanes may be missing."""
        ...

    def show(self, states: Mapping[str, str]) -> None:
        """Set lights. They keep their state until a later call sets them again."""
        ...

    def wait(self, until_s: float) -> None:
        """Wait until the clock shows at least `until_s`."""
        ...


class TraciStreet:
    """Running ``sumo --remote-port PORT`` in place of the street.

    The counts are subscribed to: they come with every step, and `read` costs no round trip. The
    simulation advances only in `wait`.

    Args:
        lanes: Lanes to count on.
        port: Port of SUMO.
        host: The machine it runs on.
        detectors: Whether to count on whole lanes, as the environments do, or on the simulation's
            lane-area detectors (E2), several on a lane added up; lanes without one are not counted.
        process: SUMO's process, if it is a child of this one, so that its end is noticed.
        patience_s: How long to wait for SUMO to listen.

    Raises:
        SimulatorError: No SUMO listens, or it runs another network.
    """

    def __init__(
        self,
        lanes: Sequence[str],
        port: int,
        host: str = "localhost",
        *,
        detectors: CountSource = "lanes",
        process: subprocess.Popen[bytes] | None = None,
        patience_s: float = 10.0,
    ) -> None:
        self._where = f"{host}:{port}"
        self._connection = _connected(port, host, process, patience_s)
        self._time_s, self._amid = 0.0, False
        try:
            self._subscribe(lanes, detectors)
        except SimulatorError:
            self.close()
            raise

    def _subscribe(self, lanes: Sequence[str], detectors: CountSource) -> None:
        with self._told("SUMO refuses to say what it counts"):
            known = set(self._connection.lane.getIDList())
            if strange := sorted(set(lanes) - known):
                raise SimulatorError(
                    f"the simulation at {self._where} has no lane {strange[0]!r} (and lacks "
                    f"{len(strange)} of {len(lanes)}); it must run the scenario's own network"
                )
            self._lane_of = {lane: lane for lane in lanes}
            self._counter: Any = self._connection.lane
            if detectors == "areas":
                self._counter = self._connection.lanearea
                lane_of = {
                    name: self._counter.getLaneID(name) for name in self._counter.getIDList()
                }
                self._lane_of = {name: lane for name, lane in lane_of.items() if lane in set(lanes)}
            for name in self._lane_of:
                self._counter.subscribe(name, _COUNTED)
            self._time_s = float(self._connection.simulation.getTime())

    def now_s(self) -> float:
        """Return the simulation's time, s."""
        return self._time_s

    def shown(self) -> dict[str, str]:
        """Return traffic light to its state, for all lights of the simulation."""
        with self._told("SUMO does not say what its lights show"):
            api = self._connection.trafficlight
            return {name: api.getRedYellowGreenState(name) for name in api.getIDList()}

    def read(self) -> dict[str, LaneCount]:
        """Return the counts at the end of the last step."""
        sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for name, values in self._counter.getAllSubscriptionResults().items():
            row = sums[self._lane_of[name]]
            row[0] += values[_COUNTED[0]]
            row[1] += values[_COUNTED[1]]
        return {lane: LaneCount(self._time_s, *row) for lane, row in sums.items()}

    def show(self, states: Mapping[str, str]) -> None:
        """Set the lights of the simulation."""
        with self._told("SUMO does not set a light"):
            for light, state in states.items():
                self._connection.trafficlight.setRedYellowGreenState(light, state)

    def wait(self, until_s: float) -> None:
        """Simulate until `until_s`."""
        if until_s > self._time_s:
            with self._told(f"the street is gone after {self._time_s:g} s"):
                self._connection.simulationStep(until_s)
                self._time_s = float(self._connection.simulation.getTime())

    def close(self) -> None:
        """Close the connection, which ends SUMO; further calls do nothing."""
        with contextlib.suppress(TraCIException, FatalTraCIError, OSError):
            if self._amid and self._connection._socket is not None:
                # In the middle of a command, SUMO's next answer belongs to that command.
                self._connection._socket.close()
                self._connection._socket = None
            self._connection.close(False)

    @contextlib.contextmanager
    def _told(self, action: str) -> Iterator[None]:
        self._amid = True  # stays True if Ctrl-C interrupts the command
        try:
            yield
            self._amid = False
        except (TraCIException, FatalTraCIError, OSError) as error:
            self.close()
            raise SimulatorError(f"{action} ({self._where}): {error}") from None


_COUNTED = (tc.LAST_STEP_VEHICLE_NUMBER, tc.LAST_STEP_VEHICLE_HALTING_NUMBER)


def _connected(
    port: int, host: str, process: subprocess.Popen[bytes] | None, patience_s: float
) -> Any:
    """Return a connection that is not in traci's pool, because the pool belongs to the user."""
    connect: Callable[..., Any] = traci.connect
    until = time.monotonic() + patience_s
    while True:
        try:
            return connect(port, 0, host)
        except (TraCIException, FatalTraCIError, OSError) as error:
            ended = process is not None and process.poll() is not None
            if ended or time.monotonic() > until:
                why = "it has ended" if ended else f"nobody listened for {patience_s:g} s"
                raise SimulatorError(
                    f"no connection to SUMO at {host}:{port}, {why} ({error}); start it with "
                    f"--remote-port {port}, or let --start do so"
                ) from None
            time.sleep(_RETRY_S)


class StartedSumo:
    """Scenario in a ``sumo --remote-port`` that runs as long as the ``with`` block.

    SUMO ends when its one client closes the connection. Under Linux it also ends when this process
    dies.

    Args:
        scenario: The scenario, in its domain.
        seed: SUMO's seed.
        port: Port to listen on; None for a free one.

    Attributes:
        port: Port on which SUMO listens.
        process: SUMO's process.

    Raises:
        OptionError: The scenario's lights turn green late, which SUMO does not do by itself.
    """

    def __init__(self, scenario: Scenario, seed: int, port: int | None = None) -> None:
        if late := late_greens(scenario):
            raise OptionError(
                f"scenario {scenario.id!r}: traffic light {next(iter(late))!r} turns green late, "
                "which only the environments do; start SUMO in another domain"
            )
        self.port = port or _free_port()
        self._scenario, self._seed = scenario, seed

    def __enter__(self) -> StartedSumo:
        self._directory = tempfile.TemporaryDirectory(prefix="ugat_marl-field-")
        place = Path(self._directory.name)
        launch = launch_of(self._scenario, self._seed, place, ())
        launch.write()
        self._trips = place / Path(_value_of("--tripinfo-output", launch.arguments)).name
        self.process: subprocess.Popen[bytes] = subprocess.Popen(
            launch.command(port=self.port),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches only this process, which then ends SUMO
            preexec_fn=_tied_to(os.getpid()) if sys.platform == "linux" else None,
        )
        return self

    def trips(self) -> Trips:
        """Return the trips of every vehicle due; the client must have closed the connection.

        Raises:
            SimulatorError: SUMO has not written the trips.
        """
        self._wait()
        return read_trips(self._trips)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()  # its files are deleted below, so it need not write them
        self._wait()
        self._directory.cleanup()

    def _wait(self) -> None:
        try:
            self.process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _value_of(option: str, arguments: tuple[str, ...]) -> str:
    return arguments[arguments.index(option) + 1]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])


def _tied_to(parent: int) -> Callable[[], None]:
    """Return a function to run in the child process: the child is killed when `parent` dies."""
    prctl: Any = ctypes.CDLL(None).prctl  # loaded here, since little is allowed after the fork

    def tie() -> None:
        prctl(_DIE_WITH_PARENT, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)

    return tie
