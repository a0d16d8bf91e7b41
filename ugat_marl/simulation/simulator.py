"""SUMO in this process: the only file that imports libsumo.

libsumo holds one simulation per process. A second start would silently replace the first one, so it
is refused here. `ugat_marl.simulation.process` has the same interface and runs SUMO in a separate
process.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import libsumo
import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import SimulatorBusy, SimulatorError
from ugat_marl.scenarios import UpstreamLanes
from ugat_marl.simulation.blockers import Blockers
from ugat_marl.simulation.crossings import Crossings
from ugat_marl.simulation.host import one_line_message, too_much_memory
from ugat_marl.simulation.launch import ERRORS, TRIPS, Launch, SignalPlans, VehiclePositions
from ugat_marl.simulation.mesoscopic import MesoscopicLanes
from ugat_marl.simulation.snapshots import HALTING_MPS, Snapshot, Trips, seconds_of
from ugat_marl.simulation.trips import read_trips
from ugat_marl.simulation.upstream import UpstreamQueues

_Floats = NDArray[np.float64]

_FAULTS = (libsumo.TraCIException, libsumo.FatalTraCIError, UnicodeDecodeError, MemoryError)
"""Errors of libsumo. A message of SUMO with one byte of a longer character cannot be decoded, and
with a full memory there may be no room for an error."""

_RESERVE_BYTES = 32 << 20
"""Memory that is kept for the message of a simulation that has filled its limit."""


class LibsumoSimulator:
    """SUMO inside this process.

    A second simulation in one process is not always equal bit for bit (seen on RESCO cologne1). Use
    `ugat_marl.simulation.process.ProcessSimulator` if that matters.
    """

    def __init__(self) -> None:
        self._launch: Launch | None = None
        self._reserve = bytearray()
        self._shown: dict[str, str] = {}
        self._time_s = 0.0
        self._limits = np.empty(0)
        self._has_behind = False
        self._zones: list[list[_ZonePart]] = []
        self._blockers: Blockers | None = None
        self._mesoscopic: MesoscopicLanes | None = None
        self._upstream: UpstreamQueues | None = None
        self._crossings: Crossings | None = None
        self._owner = 0

    def start(self, launch: Launch) -> Snapshot:
        """Start a simulation.

        Raises:
            SimulatorBusy: This process already runs a simulation of another object.
            SimulatorError: SUMO refuses; its own words are in the message.
        """
        self.close()
        if libsumo.simulation.isLoaded():
            raise SimulatorBusy(
                "this process already runs a SUMO simulation, and libsumo holds only one: close "
                'the other one, or use simulator="process", which runs any number'
            )
        if launch.gui and os.name == "posix" and not os.environ.get("DISPLAY"):
            raise SimulatorError(  # sumo-gui would end this whole process
                'render_mode "human" opens a window, but there is no display (DISPLAY is not set); '
                'use render_mode "rgb_array"'
            )
        launch.write()
        program = "sumo-gui" if launch.gui else "sumo"
        self._owner = os.getpid()
        self._launch = launch
        self._reserve = bytearray(_RESERVE_BYTES)
        try:
            libsumo.start([program, *launch.arguments, "--end", repr(launch.end_s)])
        except _FAULTS as error:
            self._fail("SUMO did not start", error)
        self._shown = {}
        self._time_s = launch.begin_s
        self._limits = np.array([libsumo.lane.getMaxSpeed(lane) for lane in launch.lanes])
        lanes, roads = launch.behind
        self._has_behind = any(lanes) or any(roads)
        self._zones = _zones(launch.lanes, launch.behind, launch.zone_m)
        self._blockers = None
        if launch.blockers:
            self._blockers = Blockers(libsumo, launch.lanes, launch.behind, launch.blockers)
        self._mesoscopic = None
        if launch.segment_m:
            self._mesoscopic = MesoscopicLanes(
                libsumo, launch.lanes, launch.segment_m, launch.behind
            )
        self._crossings = Crossings(libsumo, launch.lanes) if launch.crossings else None
        self._upstream = None
        if launch.turns:
            self._upstream = UpstreamQueues(
                libsumo, launch.lanes, launch.turns, launch.behind, launch.segment_m
            )
        return self._snapshot()

    def advance(
        self, seconds: float, plans: SignalPlans, meanwhile: Callable[[], object] | None = None
    ) -> Snapshot:
        """Simulate `seconds` and show the planned signal states; see `Simulator`.

        Raises:
            SimulatorError: SUMO failed; its own words are in the message.
        """
        assert self._launch is not None, "advance before start"
        if meanwhile is not None:
            meanwhile()
        changes: dict[float, list[tuple[str, str]]] = defaultdict(list)
        for tls, segments in plans.items():
            offset = 0.0
            for duration, state in segments:
                changes[offset].append((tls, state))
                offset += duration
        begin = self._time_s
        widths: dict[float, float] = {}  # of the seconds at whose ends crossings are counted
        if self._crossings is not None:
            ends = seconds_of(seconds)
            widths = dict(zip(ends.tolist(), np.diff(ends, prepend=0.0).tolist(), strict=True))
        step_s = libsumo.simulation.getDeltaT()
        left = np.zeros(len(self._launch.lanes))
        mean_left = left.copy()
        try:
            for offset in sorted({*changes, *widths}):
                # within a step nobody has moved yet, and SUMO would go on to its end
                steps = math.floor(round(offset / step_s, 6))
                if steps > 0:
                    libsumo.simulation.step(begin + steps * step_s)
                if self._crossings is not None and offset in widths:
                    self._crossings.add_to(left)
                    mean_left += left * widths[offset] / seconds
                for tls, state in changes.get(offset, ()):
                    if self._shown.get(tls) != state:
                        libsumo.trafficlight.setRedYellowGreenState(tls, state)
                        self._shown[tls] = state
            libsumo.simulation.step(begin + seconds)
        except _FAULTS as error:
            self._fail(f"SUMO failed after {begin:g} s", error)
        self._time_s = begin + seconds
        snapshot = self._snapshot()
        return replace(snapshot, mean_left=mean_left) if widths else snapshot

    def vehicles(self) -> VehiclePositions:
        """Return the positions of all vehicles now."""
        api = libsumo.vehicle
        names = api.getIDList()
        return VehiclePositions(
            np.array([api.getPosition(name) for name in names], dtype=np.float64).reshape(-1, 2),
            np.array([api.getAngle(name) for name in names], dtype=np.float64),
            np.array([api.getLength(name) for name in names], dtype=np.float64),
            np.array([api.getSpeed(name) for name in names], dtype=np.float64),
        )

    def signals(self) -> dict[str, str]:
        """Return the state of every traffic light now."""
        api = libsumo.trafficlight
        return {name: api.getRedYellowGreenState(name) for name in api.getIDList()}

    def finish(self) -> Trips:
        """End the simulation and read the trips of every vehicle due."""
        assert self._launch is not None, "finish before start"
        directory, persons = Path(self._launch.directory), dict(self._launch.persons)
        self.close()
        return read_trips(directory / TRIPS, self._time_s, persons)

    def close(self) -> None:
        """End the simulation of this object, if there is one."""
        if self._launch is not None:
            self._launch = None
            # A forked child shares the parent's open files, so only the owner may close them.
            if self._owner == os.getpid() and libsumo.simulation.isLoaded():
                libsumo.simulation.close()

    def _snapshot(self) -> Snapshot:
        assert self._launch is not None
        statistic = libsumo.simulation.getParameter
        departed = int(statistic("", "stats.vehicles.inserted"))
        backlog = int(statistic("", "stats.vehicles.waiting"))
        upstream = np.empty(0) if self._upstream is None else self._upstream.measure(backlog)
        if self._mesoscopic is not None:
            rows = self._mesoscopic.measure(self._time_s, self._limits)
            waiting = rows[3] if self._launch.waiting else np.empty(0)
            return Snapshot(
                self._time_s, rows[0], rows[1], rows[2], waiting, departed, backlog,
                queued_upstream=upstream,
            )  # fmt: skip
        lanes, api = self._launch.lanes, libsumo.lane
        vehicles = np.fromiter(map(api.getLastStepVehicleNumber, lanes), np.float64, len(lanes))
        taken = np.flatnonzero(vehicles)
        names = [lanes[index] for index in taken.tolist()]

        def measure(query: Callable[[str], float], empty: _Floats) -> _Floats:
            """Return values of all lanes, asking SUMO only about lanes with vehicles."""
            values = empty.copy()
            values[taken] = np.fromiter(map(query, names), np.float64, len(names))
            return values

        none = np.zeros(len(lanes))
        halting = measure(api.getLastStepHaltingNumber, none)
        speed_mps = measure(api.getLastStepMeanSpeed, self._limits)
        waiting_s = measure(api.getWaitingTime, none) if self._launch.waiting else np.empty(0)
        if self._has_behind:
            _add_those_behind(self._launch.behind, (vehicles, halting, speed_mps, waiting_s))
        near = detected = np.empty(0)
        if self._zones:
            near = _near_the_end(self._zones, np.flatnonzero(vehicles).tolist(), self._limits)
        if self._blockers is not None:
            self._blockers.look(self._time_s)
            departed -= self._blockers.departed
            backlog -= len(self._blockers.waiting)
            if self._blockers.standing or self._blockers.waiting:
                waiting = waiting_s if waiting_s.size else none
                detected = np.array([vehicles, halting, speed_mps, waiting])
                self._blockers.leave_out((vehicles, halting, speed_mps, waiting_s), self._limits)
        return Snapshot(
            time_s=self._time_s,
            vehicles=vehicles,
            halting=halting,
            mean_speed_mps=speed_mps,
            waiting_s=waiting_s,
            departed=departed,
            backlog=backlog,
            near=near,
            queued_upstream=upstream,
            detected=detected,
        )

    def _fail(self, action: str, error: Exception) -> None:
        assert self._launch is not None
        self._reserve = bytearray()
        words = str(error)
        if isinstance(error, UnicodeDecodeError):
            words = error.object.decode(errors="replace")
        said = _errors_of(Path(self._launch.directory)) or one_line_message(words)
        self.close()
        if isinstance(error, MemoryError) or "bad_alloc" in f"{said}{error}":
            said = too_much_memory()
        raise SimulatorError(f"{action}: {said}") from None


class _ZonePart(NamedTuple):
    """Part of the zone at the end of a lane.

    Attributes:
        lane: Lane on which it lies: the lane itself, or one that is counted with it.
        begin_m: Position on that lane from which it reaches to the end.
        share: Counted share of its vehicles.
    """

    lane: str
    begin_m: float
    share: float


def _zones(lanes: Sequence[str], behind: UpstreamLanes, zone_m: float) -> list[list[_ZonePart]]:
    """Return the parts of the zone at the end of each lane.

    Args:
        lanes: All lanes.
        behind: Upstream lanes counted with short ones.
        zone_m: Length of the zones in metres; with 0 there are none.
    """
    if not zone_m:
        return []
    length_m = libsumo.lane.getLength
    zones = [[_ZonePart(lane, length_m(lane) - zone_m, 1.0)] for lane in lanes]
    for zone, shares in zip(zones, behind.lanes, strict=False):
        ends_m: dict[str, float] = {zone[0].lane: 0.0}  # from the stop line, of the ends of lanes
        for _ in shares:  # each round finds a further lane, if one is left
            for name, _ in shares:
                for link in libsumo.lane.getLinks(name):
                    ahead = str(link[4] or link[0])
                    if ahead in ends_m:
                        end_m: float = ends_m[ahead] + length_m(ahead)
                        ends_m[name] = min(end_m, ends_m.get(name, end_m))
        zone += [
            _ZonePart(name, length_m(name) + ends_m[name] - zone_m, share)
            for name, share in shares
            if name in ends_m and ends_m[name] < zone_m
        ]
    return zones


def _near_the_end(
    zones: Sequence[Sequence[_ZonePart]], taken: Sequence[int], limits_mps: _Floats
) -> _Floats:
    """Return the vehicles in the zone at the end of each lane, as `Snapshot.near`, ``(4, lanes)``.

    Args:
        zones: Parts of each lane's zone.
        taken: Positions of the lanes with vehicles.
        limits_mps: Speed limit of each lane.
    """
    near = np.zeros((4, len(zones)))
    api = libsumo.vehicle
    for place in taken:
        for lane, begin_m, share in zones[place]:
            for name in libsumo.lane.getLastStepVehicleIDs(lane):
                if api.getLanePosition(name) >= begin_m:
                    speed_mps = api.getSpeed(name)
                    waiting_s, slower_mps = api.getWaitingTime(name), limits_mps[place] - speed_mps
                    seen = np.array([1.0, speed_mps < HALTING_MPS, waiting_s, slower_mps])
                    near[:, place] += share * seen
    near[3] /= np.where(near[0] > 0, near[0], 1.0)
    return near


def _add_those_behind(
    behind: UpstreamLanes,
    measured: tuple[
        NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]
    ],
) -> None:
    """Count vehicles upstream of short lanes as if they were on the short lanes.

    Vehicles that wait to enter the network count as halting, since the time they were due.

    Args:
        behind: Upstream lanes and roads, as in `ugat_marl.scenarios.lanes.LaneTable`.
        measured: Vehicles, halting vehicles, mean speed in m/s and waiting times in s (may be
            empty) per lane, each ``(lanes,)``; changed in place.
    """
    vehicles, halting, speed_mps, waiting_s = measured
    lanes, roads = behind
    for index, shares in enumerate(lanes):
        for lane, share in shares:
            count = share * libsumo.lane.getLastStepVehicleNumber(lane)
            if not count:
                continue
            total = vehicles[index] + count
            lane_speed = vehicles[index] * speed_mps[index] if vehicles[index] else 0.0
            speed_mps[index] = (
                lane_speed + count * libsumo.lane.getLastStepMeanSpeed(lane)
            ) / total
            vehicles[index] = total
            halting[index] += share * libsumo.lane.getLastStepHaltingNumber(lane)
            if waiting_s.size:
                waiting_s[index] += share * libsumo.lane.getWaitingTime(lane)
    for index, shares in enumerate(roads):
        for road, share in shares:
            outside = libsumo.edge.getPendingVehicles(road)
            if not outside:
                continue
            count = share * len(outside)
            speed_mps[index] *= vehicles[index] / (vehicles[index] + count)
            vehicles[index] += count
            halting[index] += count
            if waiting_s.size:
                waiting_s[index] += share * sum(map(libsumo.vehicle.getDepartDelay, outside))


def _errors_of(directory: Path) -> str:
    """Return SUMO's error log as one line."""
    path = directory / ERRORS
    return one_line_message(path.read_text(errors="replace")) if path.exists() else ""


def simulation_runs_here() -> bool:
    """Return True if libsumo runs a simulation in this process."""
    return bool(libsumo.simulation.isLoaded())
