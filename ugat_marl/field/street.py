"""Interface of a street: counts with their time, lights to set, a clock.

`TraciStreet` puts a SUMO that runs elsewhere in its place, `StartedSumo` a SUMO of this process.
Another street is a class with the five methods of `Street` (docs/how-to/field.md has one).
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
from ugat_marl.scenarios import Scenario, sumo_program
from ugat_marl.simulation import Trips, launch_of, read_trips

CountSource = Literal["lanes", "areas"]
"""Where SUMO counts: on whole lanes, or on its lane-area detectors."""

_RETRY_S = 0.05

_PATIENCE_S = 10.0
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>


class LaneCount(NamedTuple):
    """Count of one lane.

    Attributes:
        time_s: When it was counted, on the street's clock.
        vehicles: Vehicles on the lane; an estimate need not be whole.
        halting: Standing vehicles among them; NaN where that is not measured.
    """

    time_s: float
    vehicles: float
    halting: float = math.nan


class Street(Protocol):
    """Interface of a street. Only `read` may fail without ending the loop."""

    def now_s(self) -> float:
        """Return the street's clock, s."""
        ...

    def shown(self) -> Mapping[str, str]:
        """Traffic light to the state it shows now, one letter of SUMO's per link."""
        ...

    def read(self) -> Mapping[str, LaneCount]:
        """Lane to its last count, without waiting for a new one; lanes may be left out."""
        ...

    def show(self, states: Mapping[str, str]) -> None:
        """Set lights, which stay so until the next call; those left out are not touched."""
        ...

    def wait(self, until_s: float) -> None:
        """Return when the clock shows at least `until_s`."""
        ...


class TraciStreet:
    """Running ``sumo --remote-port PORT`` in place of the street.

    Counts are subscribed to, so that they come with every step, as detectors send them, and
    `read` costs no round trip. The simulation goes on when the loop waits, and only then.

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
                found = {name: self._counter.getLaneID(name) for name in self._counter.getIDList()}
                self._lane_of = {name: lane for name, lane in found.items() if lane in set(lanes)}
            for name in self._lane_of:
                self._counter.subscribe(name, _COUNTED)
            self._time_s = float(self._connection.simulation.getTime())

    def now_s(self) -> float:
        """Return the simulation's time, s."""
        return self._time_s

    def shown(self) -> dict[str, str]:
        """State of every traffic light of the simulation."""
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
        """Simulate until then."""
        if until_s > self._time_s:
            with self._told(f"the street is gone after {self._time_s:g} s"):
                self._connection.simulationStep(until_s)
                self._time_s = float(self._connection.simulation.getTime())

    def close(self) -> None:
        """Hang up, upon which SUMO ends; may be called again."""
        with contextlib.suppress(TraCIException, FatalTraCIError, OSError):
            if self._amid and self._connection._socket is not None:
                self._connection._socket.close()  # goodbye would be answered by what is under way
                self._connection._socket = None
            self._connection.close(False)

    @contextlib.contextmanager
    def _told(self, what: str) -> Iterator[None]:
        self._amid = True  # and stays so after Ctrl-C
        try:
            yield
            self._amid = False
        except (TraCIException, FatalTraCIError, OSError) as error:
            self.close()
            raise SimulatorError(f"{what} ({self._where}): {error}") from None


_COUNTED = (tc.LAST_STEP_VEHICLE_NUMBER, tc.LAST_STEP_VEHICLE_HALTING_NUMBER)


def _connected(
    port: int, host: str, process: subprocess.Popen[bytes] | None, patience_s: float
) -> Any:
    """Return a connection outside of traci's pool, which belongs to the user."""
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
    """Scenario in a ``sumo --remote-port`` that runs while its block does.

    SUMO ends when its one client hangs up, or (under Linux) when this process dies before.

    Args:
        scenario: The scenario, in its domain.
        seed: SUMO's seed.
        port: Port to listen on; None for a free one.

    Attributes:
        port: Its port.
        process: Its process.

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
            [str(sumo_program("sumo")), *launch.arguments, "--remote-port", str(self.port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which ends the other by itself
            preexec_fn=_tied_to(os.getpid()) if sys.platform == "linux" else None,
        )
        return self

    def trips(self) -> Trips:
        """Return the trips of every vehicle due, once the client has hung up.

        Raises:
            SimulatorError: SUMO has not written it.
        """
        self._wait()
        return read_trips(self._trips)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()  # its files go with it
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
    """Return a function for the child: it is killed when `parent` dies."""
    prctl: Any = ctypes.CDLL(None).prctl  # loaded before the fork, where little is allowed

    def tie() -> None:
        prctl(_DIE_WITH_PARENT, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)

    return tie
