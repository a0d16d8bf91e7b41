"""Start of a simulation: what SUMO is told, and the interface of everything that runs it.

The module does not load libsumo, so that a process whose simulations run elsewhere need not.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError
from ugat_marl.files import write_whole
from ugat_marl.scenarios import (
    NO_UPSTREAM_LANES,
    Document,
    Scenario,
    Segment,
    Turns,
    UpstreamLanes,
    blocker_departures,
    confine,
    confined_command,
    limit_memory,
    sumo_program,
)
from ugat_marl.simulation.mesoscopic import refuse_in_queues
from ugat_marl.simulation.snapshots import Snapshot, Trips
from ugat_marl.simulation.trips import measuring_options

SignalPlans = Mapping[str, Sequence[Segment]]
"""Traffic light to its states for the coming seconds. Lights left out continue as before."""

TRIPS, ERRORS = "trips.xml", "errors.log"
"""Files of a simulation in its folder: the trips of its vehicles, and SUMO's error log."""

_EDITED = "scenario"
"""Folder in it for the scenario's edited files, whose names may be those of SUMO's outputs."""
_READ_OTHERWISE = re.compile(r"[,;$]")
"""Characters in the name of a file that mean something to SUMO."""


@dataclass(frozen=True)
class Launch:
    """Options of one simulation, as plain values that can be sent to a process.

    Attributes:
        arguments: Options of SUMO, without the name of the program.
        directory: Folder for this simulation's own files. The runner of the simulation may remove
            it afterwards.
        begin_s: Start of the simulation on the scenario's clock.
        end_s: End of the episode on the same clock; flows without an end of their own end here.
        lanes: Lanes to measure.
        waiting: True to measure waiting times as well.
        crossings: True to look every second for vehicles that left a lane's road.
        gui: True to open a window.
        files: Names and content of the scenario's edited files.
        zone_m: Length of a zone at the end of each lane that is measured separately; 0 for none.
        persons: Vehicle types with the persons in each vehicle. If given, the hidden measures of
            `Trips` (CO2, persons, dangers) are taken.
        behind: Upstream lanes and roads, as in `ugat_marl.scenarios.lanes.LaneTable`.
        turns: Ways across the agents' lights, to measure queues upstream of `lanes`; empty to leave
            them out.
        blockers: Vehicles that block lanes for effects, with their departures in s.
        reads: Files of the scenario that SUMO reads where they lie.
        outputs: Folders, besides its own, into which SUMO writes.
    """

    arguments: tuple[str, ...]
    directory: str
    begin_s: float
    end_s: float
    lanes: tuple[str, ...]
    waiting: bool = False
    crossings: bool = False
    gui: bool = False
    files: tuple[tuple[str, bytes], ...] = ()
    zone_m: float = 0.0
    persons: tuple[tuple[str, float], ...] = ()
    behind: UpstreamLanes = NO_UPSTREAM_LANES
    turns: Turns = ()
    blockers: tuple[tuple[str, float], ...] = ()
    reads: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    @property
    def segment_m(self) -> float:
        """Length of a segment of the mesoscopic model, m; 0 with car following."""
        if "--mesosim" not in self.arguments:
            return 0.0
        return float(self.arguments[self.arguments.index("--meso-edgelength") + 1])

    def write(self) -> None:
        """Create the folder and write the files into it."""
        Path(self.directory).mkdir(mode=0o700, exist_ok=True)
        for name, content in self.files:
            write_whole(Path(self.directory) / name, content)

    def command(self, *options: str) -> list[str]:
        """Return a command line for the program ``sumo``, confined as in `confine`.

        Args:
            options: Further options of SUMO.
        """
        command = [str(sumo_program("sumo")), *self.arguments, *options]
        return confined_command(command, self.reads, self._writable)

    def confine(self) -> None:
        """Confine this thread to the files of this simulation, where the system can do that.

        The memory of the process is limited too. A simulation with a window stays free, because it
        needs the display.

        Raises:
            OptionError: The limit of the memory that the user gave is not a number.
        """
        if not self.gui:
            try:
                limit_memory()
            except ValueError as error:
                raise OptionError(str(error)) from None
            confine(self.reads, self._writable)

    @property
    def _writable(self) -> tuple[str, ...]:
        return (self.directory, *self.outputs)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON. The files are left out because `write` has stored them."""
        return {**asdict(replace(self, files=())), "files": ()}


@dataclass(frozen=True)
class VehiclePositions:
    """Positions of the vehicles, for drawing.

    Attributes:
        position: Coordinates of the front bumpers, m, ``(vehicles, 2)``.
        angle_deg: Headings, 0 is north, clockwise, ``(vehicles,)``.
        length_m: Lengths, ``(vehicles,)``.
        speed_mps: Speeds, ``(vehicles,)``.
    """

    position: NDArray[np.float64]
    angle_deg: NDArray[np.float64]
    length_m: NDArray[np.float64]
    speed_mps: NDArray[np.float64]


class Simulator(Protocol):
    """One simulation at a time; start, advance repeatedly, finish."""

    def start(self, launch: Launch) -> Snapshot:
        """Start a simulation; end a running one first."""
        ...

    def advance(
        self, seconds: float, plans: SignalPlans, meanwhile: Callable[[], object] | None = None
    ) -> Snapshot:
        """Simulate `seconds` under the given signals.

        Args:
            seconds: Length of the interval, in s.
            plans: Segments of each light.
            meanwhile: Called once; at the same time, where the simulation has its own process.
        """
        ...

    def vehicles(self) -> VehiclePositions:
        """Return the positions of all vehicles now."""
        ...

    def signals(self) -> dict[str, str]:
        """Return the state of every traffic light now, uncontrolled ones included."""
        ...

    def finish(self) -> Trips:
        """End the simulation; return the trips of every vehicle due."""
        ...

    def close(self) -> None:
        """End the simulation, if there is one. A second call does nothing."""
        ...


def launch_of(
    scenario: Scenario,
    seed: int,
    directory: Path,
    lanes: Sequence[str],
    *,
    waiting: bool = False,
    crossings: bool = False,
    gui: bool = False,
    pictures: bool = False,
    zone_m: float = 0.0,
    persons: Mapping[str, float] | None = None,
    behind: UpstreamLanes = NO_UPSTREAM_LANES,
    turns: Turns = (),
) -> Launch:
    """Collect SUMO's options and the files it needs; write nothing.

    Args:
        scenario: The scenario to simulate.
        seed: SUMO's seed; its lowest 31 bits are used.
        directory: Folder for this simulation alone. It is created when the simulation starts.
        lanes: Lanes to measure.
        waiting: True to measure waiting times.
        crossings: True to look every second for vehicles that left a lane's road.
        gui: True to open a window.
        pictures: True if pictures of the vehicles are drawn.
        zone_m: Length of a zone at the end of each lane that is measured separately; 0 for none.
        persons: Vehicle type to the persons in each vehicle, "" for all other types. If given, the
            hidden measures of `Trips` (CO2, persons, dangers) are taken.
        behind: Upstream lanes and roads, as in `ugat_marl.scenarios.lanes.LaneTable`.
        turns: Ways across the agents' lights, to measure queues upstream of `lanes`; empty to leave
            them out.
    """
    settings = scenario.settings
    refuse_in_queues(scenario, crossings=crossings, zone=bool(zone_m), pictures=gui or pictures)
    files = {
        "--net-file": [scenario.network],
        "--route-files": list(scenario.routes),
        "--additional-files": list(scenario.additional),
    }
    arguments: list[str] = []
    written: dict[str, bytes] = {}
    reads: list[str] = []
    for option, documents in files.items():
        if documents:
            paths = [_on_disk(document, directory, written) for document in documents]
            reads += paths
            arguments += [option, ",".join(paths)]
    measuring = [] if persons is None else measuring_options(directory)
    for option, value in settings.sumo.items():
        if f"--{option}" not in measuring:  # SUMO refuses an option that is given twice
            arguments += [f"--{option}", value]
    arguments += [
        "--begin", repr(settings.begin_s),
        "--step-length", repr(settings.step_length_s),
        "--seed", str(seed & 0x7FFFFFFF),
        "--time-to-teleport", "-1",
        "--tripinfo-output", str(directory / TRIPS),
        "--tripinfo-output.write-unfinished", "true",
        "--tripinfo-output.write-undeparted", "true",
        "--error-log", str(directory / ERRORS),
        "--no-step-log", "true",
        "--duration-log.disable", "true",
        "--no-warnings", "true",
    ]  # fmt: skip
    arguments += measuring
    if gui:
        arguments += ["--start", "true", "--quit-on-end", "true"]
    return Launch(
        arguments=tuple(arguments),
        directory=str(directory),
        begin_s=settings.begin_s,
        end_s=settings.begin_s + settings.duration_s,
        lanes=tuple(lanes),
        waiting=waiting,
        crossings=crossings,
        gui=gui,
        files=tuple(written.items()),
        zone_m=zone_m,
        persons=tuple((persons or {}).items()),
        behind=behind,
        turns=turns,
        blockers=blocker_departures(scenario),
        reads=tuple(reads),
        outputs=scenario.outputs,
    )


def _on_disk(document: Document, directory: Path, written: dict[str, bytes]) -> str:
    """Return a path SUMO can open.

    Edited documents, and those whose path SUMO would read as another one, get an entry in
    `written`. SUMO ends a name at a comma and puts the environment variable ``NAME`` in the place
    of ``${NAME}``: it would open a file that nobody has looked through.
    """
    if document.path is not None and not _READ_OTHERWISE.search(str(document.path.resolve())):
        return str(document.path.resolve())
    name = f"{_EDITED}/{_READ_OTHERWISE.sub('_', document.name.removesuffix('.gz'))}"
    while name in written:
        name = name.replace("/", "/_", 1)
    written[name] = document.read()
    return str(directory / name)
