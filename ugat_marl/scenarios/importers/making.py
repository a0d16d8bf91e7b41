"""A scenario directory from sources of roads and vehicles, checked before it appears."""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ugat_marl.errors import OutputError, ScenarioError
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.demand import Demand, check_demand
from ugat_marl.scenarios.network import Network
from ugat_marl.scenarios.phases import suited
from ugat_marl.scenarios.scenario import Scenario, read_scenario, scenario_toml, shipped_scenarios

NETWORK, ROUTES = "network.net.xml", "demand.rou.xml"


@dataclass(frozen=True)
class RoadFiles:
    """Files that a source of roads has put into the folder.

    Attributes:
        description: Description in one line.
        origin: Origin of the files for the README, as sentences in Markdown.
        network: Name of the network file in the folder, or absolute path of a file outside.
        routes: Route files, named likewise; empty if the source has no vehicles.
        additional: Additional files, named likewise.
        settings: Further values of ``scenario.toml``.
        derive: True to choose the source of phases for each light (`phases.suited`).
        notes: Notes for the README and the user.
        copied: Copy in the folder to its original file.
    """

    description: str
    origin: str
    network: str = NETWORK
    routes: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    derive: bool = False
    notes: tuple[str, ...] = ()
    copied: Mapping[str, Path] = field(default_factory=dict[str, Path])


RoadSource = Callable[[Path, Reporter], RoadFiles]
"""Function that puts a network into a folder."""


@dataclass(frozen=True)
class VehicleFiles:
    """Files that a source of vehicles has put into the folder.

    Attributes:
        routes: Names of route files in the folder, or absolute paths of files outside.
        notes: Notes for the user.
        copied: Copy in the folder to its original file.
    """

    routes: tuple[str, ...]
    notes: tuple[str, ...] = ()
    copied: Mapping[str, Path] = field(default_factory=dict[str, Path])


VehicleSource = Callable[[Path, Path, Reporter], VehicleFiles]
"""Function that puts route files into a folder (first path) for a network (second path)."""


@dataclass(frozen=True)
class Made:
    """A scenario that was made.

    Attributes:
        scenario: The scenario, read from its directory.
        network: Its network.
        demand: Counts of its vehicles.
        notes: Notes for the user.
    """

    scenario: Scenario
    network: Network
    demand: Demand
    notes: tuple[str, ...]


def make_scenario(
    target: Path,
    roads: RoadSource,
    vehicles: VehicleSource | None,
    *,
    settings: Mapping[str, Any],
    command: str,
    force: bool,
    reporter: Reporter,
) -> Made:
    """Make a scenario directory, whole or not at all.

    Args:
        target: The directory to make.
        roads: Source of the roads.
        vehicles: Source of the vehicles; None if the source of roads brings vehicles.
        settings: Values for ``scenario.toml``; they override those of the source.
        command: Command that makes the scenario again, for the README.
        force: True to replace an existing scenario.
        reporter: Shows progress.

    Raises:
        OutputError: The directory exists, or cannot be written.
        ScenarioError: The result is not a valid scenario.
    """
    with new_folder(target, force=force) as folder:
        draft = roads(folder, reporter)
        copied = dict(draft.copied)
        with _errors_about(copied, folder):
            fleet = VehicleFiles(draft.routes)
            if vehicles:
                fleet = vehicles(folder, folder / draft.network, reporter)
                copied |= fleet.copied
            notes = _write_settings(folder, draft, fleet, settings)
            scenario = read_scenario(folder)
            network = Network.read(scenario)
            demand = check_demand(scenario, network, reporter)
        made = Made(scenario, network, demand, notes)
        write_whole(folder / "README.md", _readme(made, draft, command))
    return Made(read_scenario(target), network, demand, made.notes)


def _write_settings(
    folder: Path, draft: RoadFiles, fleet: VehicleFiles, settings: Mapping[str, Any]
) -> tuple[str, ...]:
    """Write ``scenario.toml`` and return all notes."""
    table = dict(draft.settings)
    notes = (*draft.notes, *fleet.notes)
    if draft.derive and "phases" not in settings.get("control", {}):
        kinds, more = suited(folder / draft.network)
        notes += tuple(more)
        table["intersections"] = {tls: {"phases": kind} for tls, kind in kinds.items()}
    control = {**table.pop("control", {}), **settings.get("control", {})}
    content: dict[str, Any] = {
        "description": draft.description,
        "network": draft.network,
        "routes": list(fleet.routes),
        "additional": list(draft.additional),
        **table,
        **{key: value for key, value in settings.items() if key != "control"},
        "control": control,
    }
    content = {key: value for key, value in content.items() if value not in ([], {})}
    write_whole(folder / "scenario.toml", scenario_toml(content))
    return notes


@contextlib.contextmanager
def _errors_about(copied: Mapping[str, Path], folder: Path) -> Iterator[None]:
    """Make errors name the user's files instead of the copies, which are removed on errors."""
    try:
        yield
    except ScenarioError as error:
        text = str(error)
        for name, source in copied.items():
            text = text.replace(str(folder / name), str(source))
        raise ScenarioError(text) from None


def _readme(made: Made, draft: RoadFiles, command: str) -> str:
    settings = made.scenario.settings
    phases = [len(intersection.phases) for intersection in made.network.intersections]
    spread = f"{min(phases)} to {max(phases)}" if len(set(phases)) > 1 else f"{phases[0]}"
    others = len(made.network.uncontrolled)
    more = f"; on their own programme: {others} more" if others else ""
    lines = [
        f"# {made.scenario.id}",
        "",
        f"{draft.description}.",
        "",
        f"- **Intersections:** {len(phases)} with {spread} green phases{more}",
        f"- **Vehicles:** {made.demand.vehicles}"
        + (f" and {made.demand.flows} flows" if made.demand.flows else "")
        + f" in {settings.duration_s:g} s",
        "",
        "## Origin",
        "",
        draft.origin,
        "",
        "Made with",
        "",
        "```sh",
        command,
        "```",
    ]
    if made.notes:
        lines += ["", "## Notes", "", *(f"- {note}" for note in made.notes)]
    return "\n".join(lines) + "\n"


@contextlib.contextmanager
def new_folder(target: Path, *, force: bool) -> Iterator[Path]:
    """Yield an empty folder beside `target` that becomes `target` if the block ends normally.

    Args:
        target: The directory to make.
        force: True to replace an existing scenario. Other files are never replaced.

    Raises:
        OutputError: `target` exists, cannot be written, or has the name of a shipped scenario.
    """
    require_free(target, force=force)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=target.parent, prefix=".new-scenario-"))
    except OSError as error:
        raise OutputError(
            f"{target}: cannot be written ({error.strerror}); give another place"
        ) from None
    made = folder / target.name
    try:
        with _stopped_in_order():
            made.mkdir()
            yield made
            require_free(target, force=force)  # it may have appeared meanwhile
            _put(made, target, folder / "before")
    except ScenarioError as error:
        # Files are checked in the temporary folder, but errors should name the final one.
        if str(made) not in str(error):
            raise
        raise ScenarioError(str(error).replace(str(made), str(target))) from None
    except OSError as error:
        where = str(error.filename2 or error.filename or made).replace(str(made), str(target))
        raise OutputError(
            f"{where}: cannot be written ({error.strerror}); make room, or give another place"
        ) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _stopped_in_order() -> Iterator[None]:
    """Turn SIGTERM into an exception, so that a terminated program removes its folder."""

    def stop(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _put(made: Path, target: Path, before: Path) -> None:
    if target.exists():
        target.rename(before)
    try:
        made.rename(target)
    except BaseException:
        if before.exists():
            before.rename(target)
        raise


def require_free(target: Path, *, force: bool) -> None:
    """Refuse a target that exists or has an impossible name.

    Raises:
        OutputError: As for `new_folder`.
    """
    if not target.name or target.name in (".", ".."):
        raise OutputError(f"{str(target)!r} is no name for a scenario; give one, as in my-city")
    if str(target) in dict(shipped_scenarios()):
        raise OutputError(
            f"{str(target)!r} is the name of a scenario of the suite; choose another one"
        )
    try:
        occupied = target.is_symlink() or (target.exists() and not target.is_dir())
    except OSError as error:  # such as a name that is too long
        raise OutputError(
            f"{target!s:.80}: cannot be written ({error.strerror}); give another place"
        ) from None
    if occupied:
        raise OutputError(f"{target} exists and is not a folder; choose another name")
    if not target.is_dir() or not any(target.iterdir()):
        return
    if not (target / "scenario.toml").is_file():
        raise OutputError(f"{target} exists and is not a scenario; choose another name")
    if not force:
        raise OutputError(f"scenario {str(target)!r} exists; --force replaces it")
