"""Interface of a street: counts with their time, lights to set, a clock.

`TraciStreet` uses a SUMO that runs elsewhere as the street, `SimulatedStreet` one of its own. A
real street is a class with the five methods of `Street`; docs/how-to/field.md shows one.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal, NamedTuple, Protocol

import traci
import traci.constants as tc
from traci.exceptions import FatalTraCIError, TraCIException

from ugat_marl.effects import controller_effects, late_greens
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.files import OwnDirectory
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import ProcessSimulator, Trips, launch_of

CountSource = Literal["lanes", "areas"]
"""Source of SUMO's counts: whole lanes, or its lane-area detectors."""

_RETRY_S = 0.05


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
        """Return the street's clock, s.

        It runs on evenly and is never set, like `time.monotonic`: the loop times yellow by it.
        """
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
        patience_s: Time for which to wait for SUMO to listen, s.
        answer_s: Time within which SUMO has to answer, s; then the street counts as gone.

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
        patience_s: float = 10.0,
        answer_s: float = 60.0,
    ) -> None:
        self._where = f"{host}:{port}"
        self._connection = _connected(port, host, patience_s)
        self._connection._socket.settimeout(answer_s)
        self._answer_s = answer_s
        self._time_s, self._amid = 0.0, False
        try:
            self._subscribe(lanes, detectors)
        except BaseException:
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
                if not self._lane_of:
                    raise OptionError(
                        f"the simulation at {self._where} has no lane-area detector (E2) on any of "
                        f"the {len(lanes)} lanes; add them, or count on whole lanes"
                    )
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
            raise SimulatorError(
                f"{action} ({self._where}): {error} (or there was no answer for "
                f"{self._answer_s:g} s)"
            ) from None


_COUNTED = (tc.LAST_STEP_VEHICLE_NUMBER, tc.LAST_STEP_VEHICLE_HALTING_NUMBER)


def _connected(port: int, host: str, patience_s: float) -> Any:
    """Return a connection that is not in traci's pool, because the pool belongs to the user."""
    connect: Callable[..., Any] = traci.connect
    until = time.monotonic() + patience_s
    while True:
        try:
            with _new_sockets(max(until - time.monotonic(), 1.0)):
                return connect(port, 0, host)
        except (TraCIException, FatalTraCIError, OSError) as error:
            if time.monotonic() > until:
                raise SimulatorError(
                    f"no connection to SUMO at {host}:{port}, nobody listened for {patience_s:g} s "
                    f"({error}); start it with --remote-port {port}, or use --start"
                ) from None
            time.sleep(_RETRY_S)


@contextlib.contextmanager
def _new_sockets(timeout_s: float) -> Iterator[None]:
    """Give new sockets a timeout: traci connects without one, minutes to a host that is off."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(timeout_s)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


class SimulatedStreet:
    """Scenario in a SUMO of its own, as the street, for as long as the ``with`` block.

    SUMO runs in a confined process (`ugat_marl.simulation.ProcessSimulator`) and opens no port.

    Args:
        scenario: The scenario, in its domain.
        seed: SUMO's seed.
        lanes: Lanes to count on.

    Raises:
        OptionError: The scenario has late greens or effects on controllers, which SUMO does not
            simulate by itself.
    """

    def __init__(self, scenario: Scenario, seed: int, lanes: Sequence[str]) -> None:
        if late := late_greens(scenario):
            raise OptionError(
                f"scenario {scenario.id!r}: traffic light {next(iter(late))!r} turns green late, "
                "which only the environments do; start SUMO in another domain"
            )
        if effects := controller_effects(scenario):
            raise OptionError(
                f"scenario {scenario.id!r}: effect {effects[0]} acts on counts, commands or the "
                "cost of controllers, which only the environments do; start SUMO in a domain "
                "without it (`ugat-marl evaluate` plays this one)"
            )
        self._scenario, self._seed, self._lanes = scenario, seed, tuple(lanes)

    def __enter__(self) -> SimulatedStreet:
        self._directory = OwnDirectory()
        launch = launch_of(self._scenario, self._seed, self._directory.fresh(), self._lanes)
        self._simulator = ProcessSimulator()
        self._asked: dict[str, str] = {}
        try:
            self._snapshot = self._simulator.start(launch)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def _end(self) -> None:
        self._simulator.close()
        self._directory.remove()

    def now_s(self) -> float:
        """Return the simulation's time, s."""
        return self._snapshot.time_s

    def shown(self) -> dict[str, str]:
        """Return traffic light to its state; SUMO's lights show at once what they are asked for."""
        return self._simulator.signals() | self._asked

    def read(self) -> dict[str, LaneCount]:
        """Return the counts at the end of the last step."""
        seen = self._snapshot.with_blockers()
        rows = zip(self._lanes, seen.vehicles.tolist(), seen.halting.tolist(), strict=True)
        return {lane: LaneCount(seen.time_s, *row) for lane, *row in rows}

    def show(self, states: Mapping[str, str]) -> None:
        """Set the lights from the start of the next step."""
        self._asked |= states

    def wait(self, until_s: float) -> None:
        """Simulate until `until_s`."""
        seconds = until_s - self.now_s()
        if seconds > 0:
            plans = {light: [(seconds, state)] for light, state in self._asked.items()}
            self._snapshot = self._simulator.advance(seconds, plans)
            self._asked = {}

    def trips(self) -> Trips:
        """End the simulation; return the trips of every vehicle due."""
        return self._simulator.finish()
