"""Networks, configurations and route files of SUMO, copied or linked."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import Tag, read_xml
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.demand import edges_used
from ugat_marl.scenarios.importers.long_files import scan
from ugat_marl.scenarios.importers.making import RoadFiles, RoadSource, VehicleFiles, VehicleSource
from ugat_marl.scenarios.scenario import (
    Document,
    SumoConfiguration,
    is_configuration,
    read_scenario,
)
from ugat_marl.scenarios.settings import ScenarioFile


def from_sumo(path: Path, *, link: bool, own_vehicles: bool) -> RoadSource:
    """Return a source of roads, and perhaps vehicles, from SUMO's own files.

    Args:
        path: A ``.sumocfg`` or a ``.net.xml``; the network may be packed (``.gz``).
        link: True to use the files by their absolute paths instead of copying them.
        own_vehicles: True to use the vehicles of a configuration.

    Raises:
        OptionError: By its name, the file is neither a configuration nor a network.
    """
    configuration = is_configuration(path)
    if not configuration and not path.name.removesuffix(".gz").endswith(".xml"):
        raise OptionError(f"--sumo {str(path)!r}: give a .sumocfg or a .net.xml")

    def roads(folder: Path, reporter: Reporter) -> RoadFiles:
        if not configuration:
            for _ in _rooted(path, ("net",), "SUMO network", reporter):
                pass
            name = _placed(path, folder, link)
            return RoadFiles(
                f"SUMO network {path.name}",
                _origin([path], link),
                network=name,
                copied={path.name: path},
            )
        return _configured(path, folder, link, own_vehicles, reporter)

    return roads


def episode_of(path: Path | None, begin_s: float | None = None) -> tuple[float, float]:
    """Return begin and duration of an episode, s: of a configuration, else 0 and an hour.

    Args:
        path: A ``.sumocfg``, another file, or None.
        begin_s: Begin in place of these; the end of a configuration stays the end.

    Raises:
        ScenarioError: The configuration cannot be read, or has impossible times.
    """
    if path is not None and is_configuration(path):
        return SumoConfiguration(path).times(begin_s)
    return begin_s or 0.0, 3600.0


def from_routes(paths: Sequence[Path], *, link: bool) -> VehicleSource:
    """Return a source of vehicles from the user's route files."""

    def vehicles(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
        leads = _leads(network)
        for path in paths:
            for tag in _rooted(path, ("routes", "additional"), "route file", reporter):
                if tag.name in ("vehicle", "trip", "flow", "route"):
                    _require_known(tag, leads, path)
                if tag.name == "route":
                    _require_connected(tag, leads, path, network)
        placed = tuple(_placed(path, folder, link) for path in paths)
        return VehicleFiles(placed, copied={path.name: path for path in paths})

    return vehicles


def _configured(
    path: Path, folder: Path, link: bool, own_vehicles: bool, reporter: Reporter
) -> RoadFiles:
    given = SumoConfiguration(path)
    for note in _differences(given):
        reporter.say(f"note: {path.name}: {note}")
    if own_vehicles:
        scenario = read_scenario(path)
        network, routes, additional = scenario.network, scenario.routes, scenario.additional
        settings = scenario.settings.model_dump(mode="json", exclude_defaults=True)
    else:
        network = _network_of(given)
        begin_s, duration_s = given.times()
        physics = given.physics()
        if (scale := physics["sumo"].pop("scale", None)) is not None:
            reporter.say(
                f"note: {path.name}: scale = {scale} left out: it is that of its own vehicles"
            )
        settings = {"begin_s": begin_s, "duration_s": duration_s, **physics}
        routes = additional = ()
        if left_out := given.names("additional-files"):
            reporter.say(
                f"note: {path.name}: its vehicles are replaced, so its additional files are left "
                f"out, too ({', '.join(left_out)}); add those without vehicles to scenario.toml"
            )
    usual = ScenarioFile.model_fields
    kept = {
        key: settings[key]
        for key in ("begin_s", "duration_s", "step_length_s", "sumo", "control")
        if key in settings and settings[key] != usual[key].default
    }

    def placed(documents: Sequence[Document]) -> tuple[str, ...]:
        return tuple(_put(document, folder, link) for document in documents)

    return RoadFiles(
        f"SUMO configuration {path.name}",
        _origin([path], link),
        network=placed([network])[0],
        routes=placed(routes),
        additional=placed(additional),
        settings=kept,
        copied={
            document.name: document.path
            for document in (network, *routes, *additional)
            if document.path is not None and document.home is None
        },
    )


def _differences(given: SumoConfiguration) -> Iterator[str]:
    """Yield what an episode does not take from a configuration."""
    if ignored := given.ignored():
        yield (
            f"{', '.join(ignored)} left out: vehicles are never teleported or given up, and the "
            "seed is that of the episode; traffic may differ from SUMO's own"
        )
    if lacking := given.lacking():
        yield (
            f"{', '.join(lacking)} left out: an episode begins in an empty network, and edges have "
            "no weights of their own; traffic differs from SUMO's own"
        )
    if times := given.physics().get("control"):
        longer = ", ".join(f"{name} = {value:g}" for name, value in times.items())
        yield f"its steps do not divide the usual times of signals; {longer} in their place"
    if not given.has_end:
        yield (
            "it has no end, so an episode is one hour; write duration_s into scenario.toml for "
            "another length"
        )


def _network_of(configuration: SumoConfiguration) -> Document:
    path, name = configuration.path, configuration.value("net-file")
    if not name:
        raise ScenarioError(f"{path}: no <net-file value=...>; a scenario needs a network")
    file = path.parent / name
    if not file.is_file():
        raise ScenarioError(f"{path}: <net-file> names {file}, which does not exist")
    return Document(file.name, file)


def _put(document: Document, folder: Path, link: bool) -> str:
    if document.path is not None and document.home is None:
        return _placed(document.path, folder, link)
    _require_new(folder / document.name)
    document.write(folder / document.name)  # edited: its outputs are discarded
    return document.name


def _placed(path: Path, folder: Path, link: bool) -> str:
    """Copy the file unless it is linked; return its name or path for ``scenario.toml``."""
    if link:
        return str(path.resolve())
    _require_new(folder / path.name)
    shutil.copyfile(path, folder / path.name)
    return path.name


def _require_new(path: Path) -> None:
    if path.exists():
        raise ScenarioError(
            f"two files are called {path.name!r}, which one directory cannot hold; rename one"
        )


def _leads(network: Path) -> dict[str, set[str]]:
    """Return, for each edge of a network, the edges it leads to."""
    root = read_xml(network)
    onward: dict[str, set[str]] = {edge.get("id", ""): set() for edge in root.iter("edge")}
    for element in root.iter("connection"):
        onward.setdefault(element.get("from", ""), set()).add(element.get("to", ""))
    return onward


def _require_known(tag: Tag, leads: Mapping[str, set[str]], path: Path) -> None:
    """Refuse edges that do not exist; the error names the user's file, not a copy."""
    used = edges_used(tag)
    if leads and not leads.keys() >= set(used):  # a network without roads has its own message
        edge = next(edge for edge in used if edge not in leads)
        raise ScenarioError(
            f"{path}, line {tag.line}: <{tag.name}> uses the edge {edge!r}, which the network does "
            "not have; were the routes made for another network?"
        )


def _require_connected(tag: Tag, leads: Mapping[str, set[str]], path: Path, network: Path) -> None:
    """Refuse a route with two edges in a row that no connection joins."""
    for a, b in pairwise(tag.attributes.get("edges", "").split()):
        if a in leads and b in leads and b not in leads[a]:
            raise ScenarioError(
                f"{path}, line {tag.line}: a route goes from edge {a!r} to {b!r}, but no "
                f"connection of {network} leads there; route the demand again (duarouter)"
            )


def _rooted(path: Path, tags: Sequence[str], kind: str, reporter: Reporter) -> Iterator[Tag]:
    """Yield all elements of a file; refuse a root that is not in `tags`."""
    for number, tag in enumerate(scan(path, reporter)):
        if not number and tag.name not in tags:
            raise ScenarioError(
                f"{path}, line {tag.line}: a {kind} begins with "
                f"{' or '.join(f'<{name}>' for name in tags)}, this with <{tag.name}>"
            )
        yield tag


def _origin(paths: Sequence[Path], link: bool) -> str:
    names = ", ".join(f"`{path.name}`" for path in paths)
    kept = "left where it lies and named by its path" if link else "copied as it was"
    return (
        f"{names}, {kept}. Who made it decides what may be done with it; keep its licence beside "
        "it when you pass it on."
    )
