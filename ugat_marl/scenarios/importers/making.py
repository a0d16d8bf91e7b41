"""A scenario directory from sources of roads and vehicles, checked before it appears."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

from ugat_marl.errors import OutputError, ScenarioError, counted, terminated_as
from ugat_marl.files import make_folder, put_folder, read_toml, write_whole
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.admission import admitted
from ugat_marl.scenarios.demand import Demand, check_demand
from ugat_marl.scenarios.importers.count_sheet import (
    FIT_SHEET,
    CountFit,
    is_filled,
    write_template,
)
from ugat_marl.scenarios.naming import drawing_name
from ugat_marl.scenarios.network import Network
from ugat_marl.scenarios.phases import suited
from ugat_marl.scenarios.scenario import (
    COUNT_SHEET,
    NETWORK,
    Document,
    Scenario,
    draft_network,
    read_scenario,
    scenario_toml,
    shipped_scenarios,
)
from ugat_marl.scenarios.settings import validate_settings

ROUTES = "demand.rou.xml"
PICTURES = "pictures"
"""Folder with drawings of the lights, in a folder without vehicles."""
KEPT_SHEETS = "counts-before-*.csv"
"""Names of sheets of counts that another one has replaced, each with a number."""


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
        fits: Counts and the vehicles found for them, if the source has counts.
    """

    routes: tuple[str, ...]
    notes: tuple[str, ...] = ()
    copied: Mapping[str, Path] = field(default_factory=dict[str, Path])
    fits: tuple[CountFit, ...] = ()


VehicleSource = Callable[[Path, Path, Reporter], VehicleFiles]
"""Function that puts route files into a folder (first path) for a network (second path)."""

Draw = Callable[[Scenario, Path, Reporter], object]
"""Function that draws the lights of a scenario, which may have no vehicles, into a folder."""


@dataclass(frozen=True)
class Made:
    """A scenario that was made.

    Attributes:
        scenario: The scenario, read from its directory.
        network: Its network.
        demand: Counts of its vehicles.
        notes: Notes for the user.
        fits: Counts and the vehicles found for them, if the source has counts.
    """

    scenario: Scenario
    network: Network
    demand: Demand
    notes: tuple[str, ...]
    fits: tuple[CountFit, ...]


@dataclass(frozen=True)
class Draft:
    """A folder with roads and lights that has no vehicles yet.

    Attributes:
        network: Its network.
        sheet: Sheet of counts to fill in.
        turns: Number of rows of the sheet.
        notes: Notes for the user.
    """

    network: Network
    sheet: Path
    turns: int
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
    draw: Draw | None = None,
) -> Made:
    """Make a scenario directory atomically.

    Args:
        target: The directory to make.
        roads: Source of the roads.
        vehicles: Source of the vehicles; None if the source of roads brings vehicles.
        settings: Values for ``scenario.toml``; they override those of the source.
        command: Command that makes the scenario again, for the README.
        force: True to replace an existing scenario.
        reporter: Shows progress.
        draw: Draws the lights anew if the folder that is replaced has drawings of them. None to
            leave drawings out.

    Raises:
        OutputError: The directory exists, or cannot be written.
        ScenarioError: The result is not a valid scenario.
    """
    with new_folder(target, force=force) as folder:
        draft = roads(folder, reporter)
        copied = dict(draft.copied)
        with _errors_about(copied, folder, draft.network):
            fleet = VehicleFiles(draft.routes)
            admitted(Document(NETWORK, folder / draft.network))  # before its values are read
            if vehicles:
                fleet = vehicles(folder, folder / draft.network, reporter)
                copied |= fleet.copied
            content, notes = _settings(folder, draft, fleet.routes, settings)
            _require_links_outside(target, content)
            notes += fleet.notes
            write_whole(folder / "scenario.toml", scenario_toml(content))
            scenario = read_scenario(folder)
            network = Network.read(scenario)
            notes += network.notes
            demand = check_demand(scenario, network, reporter)
        made = Made(scenario, network, demand, notes, fleet.fits)
        write_whole(folder / "README.md", _readme(made, draft, command))
        if draw and (target / PICTURES).is_dir():
            draw(scenario, folder / PICTURES, reporter)
    return Made(read_scenario(target), network, demand, made.notes, made.fits)


def make_draft(
    target: Path,
    roads: RoadSource,
    *,
    settings: Mapping[str, Any],
    command: str,
    force: bool,
    draw: Draw,
    reporter: Reporter,
) -> Draft:
    """Make a folder with roads, drawn lights and a sheet of turning counts atomically.

    The folder becomes a scenario by `make_scenario` with the counts that were filled in.

    Args:
        target: The folder to make.
        roads: Source of the roads.
        settings: Values for ``scenario.toml``; they override those of the source.
        command: Command that makes the folder again, for the README.
        force: True to replace an existing scenario.
        draw: Draws the lights.
        reporter: Shows progress.

    Raises:
        OutputError: The folder exists, or cannot be written.
        ScenarioError: The network cannot be controlled.
    """
    with new_folder(target, force=force) as folder:
        source = _under_usual_name(roads(folder, reporter), folder)
        with _errors_about(source.copied, folder, source.network):
            content, notes = _settings(folder, source, ("none",), settings)
            _require_links_outside(target, content)
            document = admitted(Document(NETWORK, folder / source.network))
            scenario = Scenario(
                target.name, document, (), (), validate_settings(content, str(target))
            )
            network = Network.read(scenario)
            notes += network.notes
            turns = write_template(folder / COUNT_SHEET, document.parse())
            draw(scenario, folder / PICTURES, reporter)
        lines = _draft_readme(target, source, command, network, notes)
        write_whole(folder / "README.md", "\n".join(lines) + "\n")
    return Draft(network, target / COUNT_SHEET, turns, notes)


def _require_links_outside(target: Path, content: Mapping[str, Any]) -> None:
    """Refuse links to files in the folder that the new scenario replaces."""
    names = (content["network"], *content.get("routes", ()), *content.get("additional", ()))
    for name in filter(os.path.isabs, names):
        if target.resolve() in Path(name).resolve().parents:
            raise OutputError(
                f"{name}: lies in {target}, which would be replaced, and a link to it would lead "
                "nowhere; leave out --link, or write to another folder"
            )


def _under_usual_name(source: RoadFiles, folder: Path) -> RoadFiles:
    """Give the network of a draft the name by which a draft is known."""
    name = NETWORK + ".gz" * source.network.endswith(".gz")
    if Path(source.network).is_absolute():
        (folder / name).symlink_to(source.network)  # the draft goes on to use the linked file
        return source
    (folder / source.network).rename(folder / name)
    copied = {name if old == source.network else old: path for old, path in source.copied.items()}
    return replace(source, network=name, copied=copied)


def _settings(
    folder: Path, draft: RoadFiles, routes: Sequence[str], settings: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the content of ``scenario.toml`` and the notes on the roads."""
    table = dict(draft.settings)
    notes = draft.notes
    if draft.derive and "phases" not in settings.get("control", {}):
        kinds, more = suited(folder / draft.network)
        notes += tuple(more)
        table["intersections"] = {tls: {"phases": kind} for tls, kind in kinds.items()}
    control = {**table.pop("control", {}), **settings.get("control", {})}
    content: dict[str, Any] = {
        "description": draft.description,
        "network": draft.network,
        "routes": list(routes),
        "additional": list(draft.additional),
        **table,
        **{key: value for key, value in settings.items() if key != "control"},
        "control": control,
    }
    content = {key: value for key, value in content.items() if value not in ([], {})}
    return content, notes


@contextlib.contextmanager
def _errors_about(copied: Mapping[str, Path], folder: Path, network: str) -> Iterator[None]:
    """Make errors name the user's files instead of those in the folder, which is removed then."""
    try:
        yield
    except ScenarioError as error:
        text = str(error)
        for name, source in copied.items():
            text = text.replace(str(folder / name), str(source))
        if not Path(network).is_absolute():
            text = text.replace(str(folder / network), "this network")
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
        + (f" and {counted(made.demand.flows, 'flow')}" if made.demand.flows else "")
        + f" in {settings.duration_s:g} s",
        "",
        *_origin(draft.origin, command, made.notes),
    ]
    return "\n".join(lines) + "\n"


def _origin(origin: str, command: str, notes: Sequence[str]) -> list[str]:
    """Return the end of a README: where the roads are from, the command, what to know."""
    lines = ["## Origin", "", origin, "", "Made with", "", "```sh", command, "```"]
    return lines + (["", "## Notes", "", *(f"- {note}" for note in notes)] if notes else [])


def _draft_readme(
    target: Path, source: RoadFiles, command: str, network: Network, notes: Sequence[str]
) -> list[str]:
    others = len(network.uncontrolled)
    more = f" and {others} more that are no agents" if others else ""
    return [
        f"# {target.name}",
        "",
        f"{source.description}: roads and lights, no vehicles yet.",
        "",
        f"- **Intersections:** {len(network.intersections)}{more}; `{PICTURES}/` shows them",
        f"- **Vehicles:** fill in the column `count` of `{COUNT_SHEET}`, a row for every turn at a "
        "light. A row that stays blank was not counted. For quarters of an hour, copy the rows and "
        "give each its `begin_s` and `end_s`. Then add the counts to the command below:",
        f"  `{command} --counts {shlex.quote(str(target / COUNT_SHEET))}`",
        "",
        *_origin(source.origin, command, notes),
    ]


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
        make_folder(target.parent)
        folder = Path(tempfile.mkdtemp(dir=target.parent.resolve(), prefix=".new-scenario-"))
    except OSError as error:
        raise OutputError(
            f"{target}: cannot be written ({error.strerror}); give another place"
        ) from None
    made = folder / target.name
    try:
        with terminated_as(SystemExit(128 + signal.SIGTERM)):
            made.mkdir()
            yield made
            require_free(target, force=force)  # it may have appeared meanwhile
            _require_counts_kept(made, target)
            put_folder(made, target, folder / "before")
    except ScenarioError as error:
        # Files are checked in the temporary folder, but errors should name the final one.
        if str(made) not in str(error):
            raise
        raise ScenarioError(str(error).replace(str(made), str(target))) from None
    except OutputError:  # an OSError as well, with a message of its own
        raise
    except OSError as error:
        where = str(error.filename2 or error.filename or made).replace(str(made), str(target))
        raise OutputError(
            f"{where}: cannot be written ({error.strerror}); make room, or give another place"
        ) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def copy_papers(source: Path, folder: Path, name: str, note: str, command: str) -> None:
    """Copy what says where a scenario is from: its README and its sheets of counts.

    The command follows those of the README, so that all in their order make the scenario again.

    Args:
        source: Folder of the scenario; nothing is copied from a place that is none.
        folder: Folder of a scenario that is made from it.
        name: Name of the new scenario.
        note: What was changed, as a sentence in Markdown.
        command: Command line that changed it.
    """
    for sheet in (COUNT_SHEET, FIT_SHEET):
        if (source / sheet).is_file():
            shutil.copy2(source / sheet, folder)
    readme = source / "README.md"
    if readme.is_file():
        text = readme.read_text(encoding="utf-8", errors="replace")
        rest = text.partition("\n")[2] if text.startswith("# ") else f"\n{text}"
        then = f"## Changed with\n\n```sh\n{command}\n```\n"
        write_whole(folder / readme.name, f"# {name}\n\n{note}\n{rest.rstrip()}\n\n{then}")


def _require_counts_kept(made: Path, target: Path) -> None:
    """Keep a sheet that was filled in: under another name beside a new one, else refuse."""
    for kept in target.glob(KEPT_SHEETS):
        shutil.copy2(kept, made)
    old, new = target / COUNT_SHEET, made / COUNT_SHEET
    if not old.is_file() or not is_filled(old):
        return
    if new.is_file() and new.read_bytes() == old.read_bytes():
        return
    if new.is_file() and is_filled(new) and (target / "scenario.toml").is_file():
        names = (KEPT_SHEETS.replace("*", str(number)) for number in count(1))
        shutil.copy2(old, next(made / name for name in names if not (made / name).exists()))
    else:
        raise OutputError(
            f"{old} would be lost; move it away first, write to another folder, or give it with "
            "--counts where a scenario is made from roads"
        )


def _named_files(folder: Path) -> tuple[Path, ...]:
    """Return the network of a folder, then the other files that its ``scenario.toml`` names."""
    toml = folder / "scenario.toml"
    if network := draft_network(folder):
        return (network,)
    try:
        settings = validate_settings(read_toml(toml, ScenarioError), str(toml))
    except ScenarioError:  # a damaged one names no files, so they have the usual names
        return folder / NETWORK, folder / ROUTES
    names = (settings.network, *settings.routes, *settings.additional)
    return tuple(folder / name for name in names)


def require_free(target: Path, *, force: bool) -> None:
    """Refuse a target that exists or has an impossible name.

    Raises:
        OutputError: As for `new_folder`.
    """
    if not target.name or target.name in (".", ".."):
        raise OutputError(f"{str(target)!r} is not a name for a scenario; give one, as in my-city")
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
    if draft_network(target):
        _require_nothing_else(target, {COUNT_SHEET}, "the sheet of counts")
        return
    if not (target / "scenario.toml").is_file():
        raise OutputError(f"{target} exists and is not a scenario; choose another name")
    if not force:
        raise OutputError(f"scenario {str(target)!r} exists; --force replaces it")
    _require_nothing_else(target, {"scenario.toml", COUNT_SHEET, FIT_SHEET}, "the scenario")


def _require_nothing_else(target: Path, made: Set[str], what: str) -> None:
    """Refuse to replace a folder that holds files of the user, beside those made with it."""
    named = _named_files(target)
    known = {target / "README.md", *(target / name for name in made)}
    known |= {target / os.path.relpath(path, target) for path in named}
    folders = {target / PICTURES, *(folder for path in known for folder in path.parents)}
    drawings = _drawing_names(named[0]) if (target / PICTURES).is_dir() else frozenset()

    def is_ours(path: Path) -> bool:
        if path in known or path.name == ".DS_Store" or (path in folders and path.is_dir()):
            return True
        if path.parent == target:
            return path.match(KEPT_SHEETS) and path.is_file()  # these are kept
        return path.parent == target / PICTURES and _is_drawing(path, drawings)

    for path in sorted(target.rglob("*")):
        if not is_ours(path):
            raise OutputError(
                f"{path} was not made with {what}, and would be lost; move it away first"
            )


def _drawing_names(network: Path) -> frozenset[str]:
    """Return the names of the drawings of a network's lights; none if it cannot be read."""
    try:
        tags = Document(network.name, network).scan()
        lights = {tag.attributes.get("tl", "") for tag in tags if tag.name == "connection"}
    except ScenarioError:
        return frozenset()
    return frozenset(drawing_name(light).rstrip("_") for light in lights - {""})


def _is_drawing(path: Path, lights: Set[str]) -> bool:
    """Return True for a drawing of the network or of a light, perhaps a numbered page of it.

    Lights whose names are alike have underscores behind them.
    """
    name = path.stem.rstrip("_")
    drawn = path.stem == "network" or name in lights or re.sub(r"-\d+$", "", name) in lights
    return drawn and path.suffix in (".svg", ".png")
