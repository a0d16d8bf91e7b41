"""A scenario: road network, demand, timing and signal rules, as one immutable value.

On disk a scenario is a directory with a ``scenario.toml`` and SUMO files, or a plain ``.sumocfg``.
Effects (see `ugat_marl.effects`) map scenarios to scenarios. The new scenario holds its edited
files itself until it is written or simulated.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

from ugat_marl.errors import OutputError, ScenarioError, UnknownNameError, install_command
from ugat_marl.files import Document, read_toml, read_xml, with_home, write_whole
from ugat_marl.scenarios.admission import NO, OPTIONS, admitted
from ugat_marl.scenarios.settings import (
    ControlSettings,
    ScenarioFile,
    parse_time,
    usual_times,
    validate_settings,
)
from ugat_marl.scenarios.signals import SignalTiming

COUNT_SHEET = "counts.csv"
"""Name of the sheet of turning counts in the folder of a scenario."""
NETWORK = "network.net.xml"
"""Name of the network that the suite writes into a folder; ``.gz`` follows if it is packed."""


@dataclass(frozen=True)
class Scenario:
    """A road network with demand and rules, ready to be simulated.

    Attributes:
        id: Name; the name of a shipped scenario ends in ``-vN``.
        network: The ``.net.xml``.
        routes: Route files (vehicles, trips, flows).
        additional: SUMO's additional files.
        settings: All settings of ``scenario.toml``.
        applied: Descriptions of the effects that made this scenario out of another one.
        outputs: Folders into which measurements of the suite let SUMO write. No file can name one.
        sources: Files that it, or the scenario it was made of, was read from, without symbolic
            links; empty if it was made in memory.
    """

    id: str
    network: Document
    routes: tuple[Document, ...]
    additional: tuple[Document, ...]
    settings: ScenarioFile
    applied: tuple[str, ...] = field(default=())
    outputs: tuple[str, ...] = field(default=(), compare=False)
    sources: frozenset[Path] = field(default=frozenset(), compare=False)

    @property
    def control(self) -> ControlSettings:
        """Signal timing."""
        return self.settings.control

    @property
    def timing(self) -> SignalTiming:
        """Clearance and minimum green of every intersection."""
        control = self.control
        return SignalTiming(control.yellow_s, control.all_red_s, control.min_green_s)

    def late_green_s(self, light: str) -> float:
        """Return the late green of a traffic light, s: its own, else that of all."""
        own = self.settings.intersections.get(light)
        late_s = None if own is None else own.late_green_s
        return self.control.late_green_s if late_s is None else late_s

    @property
    def decisions(self) -> int:
        """Number of decisions in an episode of the scenario's full duration."""
        return int(self.settings.duration_s / self.control.decision_interval_s + 1e-9)

    @property
    def documents(self) -> tuple[Document, ...]:
        """All files: network, routes, additional."""
        return (self.network, *self.routes, *self.additional)

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 over all files and settings, as 64 hex digits.

        The description and the names of the files do not count.
        """
        digest = hashlib.sha256()
        settings = self.settings.model_dump(mode="json")
        for cosmetic in ("description", "network", "routes", "additional"):
            settings.pop(cosmetic)
        digest.update(json.dumps(settings, sort_keys=True).encode())
        for document in self.documents:
            length = sum(len(piece) for piece in document.pieces())
            digest.update(f"\0{length}\0".encode())
            for piece in document.pieces():
                digest.update(piece)
        return digest.hexdigest()

    def with_control(self, **changes: Any) -> Scenario:
        """Return the scenario with other signal timing (keywords of `ControlSettings`)."""
        control = {**self.control.model_dump(), **changes}
        settings = {**self.settings.model_dump(), "control": control}
        return replace(self, settings=validate_settings(settings, f"scenario {self.id!r}"))

    def with_duration(self, duration_s: float | None) -> Scenario:
        """Return the scenario with another duration, or itself without one."""
        if duration_s is None:
            return self
        settings = {**self.settings.model_dump(), "duration_s": duration_s}
        return replace(self, settings=validate_settings(settings, f"scenario {self.id!r}"))

    def write(self, directory: Path) -> Path:
        """Write a scenario directory that SUMO and `read_scenario` can use.

        A scenario that is there already is replaced; files that only it names stay.

        Returns:
            `directory`.

        Raises:
            OutputError: This scenario was read from one of the files that it would write.
            ScenarioError: Two of its files have one name.
        """
        names = [document.name for document in self.documents]
        for name in (*names, "scenario.toml"):
            if (directory / name).resolve() in self.sources:
                raise OutputError(
                    f"{directory / name}: scenario {self.id!r} was read from this file, and "
                    "writing it there would change it; give another directory"
                )
        if twice := [name for name in names if names.count(name) > 1]:
            raise ScenarioError(
                f"scenario {self.id!r}: two of its files are called {twice[0]!r}, which one "
                "directory cannot hold; rename one of them"
            )
        for document in self.documents:
            document.write(directory / document.name)
        settings = self.settings.model_dump(mode="json", exclude_defaults=True)
        settings |= {
            "network": self.network.name,
            "routes": [document.name for document in self.routes],
            "additional": [document.name for document in self.additional],
        }
        write_whole(directory / "scenario.toml", scenario_toml(settings, self.applied))
        return directory


def is_configuration(path: Path) -> bool:
    """Return True if a file's name is that of a SUMO configuration."""
    return path.name.endswith((".sumocfg", ".sumocfg.xml"))


def read_scenario(name: str | Path) -> Scenario:
    """Load a scenario.

    Effects listed in its ``scenario.toml`` stay in its settings. They are not applied here.

    Args:
        name: Id of a shipped scenario (``"grid4x4-v1"``), a directory with a ``scenario.toml``, a
            ``.sumocfg``, or ``"resco:<map>"`` for a network of an installed `sumo-rl` wheel.

    Raises:
        UnknownNameError: There is no such scenario.
        ScenarioError: A file is missing, or the ``scenario.toml`` is not valid.
    """
    text = str(name)
    if text.startswith("resco:"):
        return _load_sumocfg(_resco_configuration(text.removeprefix("resco:")), text)
    path = with_home(text)
    if is_configuration(path):
        return _load_sumocfg(path, path.name.split(".")[0])
    if _is_file(path / "scenario.toml"):
        return _load_directory(path)
    if path.name == "scenario.toml" and path.is_file():
        return _load_directory(path.parent)
    shipped = dict(shipped_scenarios())
    if text in shipped:
        return _load_directory(shipped[text])
    if text and _is_file(path / "periods.csv"):
        raise ScenarioError(
            f"{path}: is measured data, no scenario; give a directory with scenario.toml (commands "
            "that read both take the scenario first)"
        )
    if text and draft_network(path):
        raise ScenarioError(
            f"{path}: has roads and no vehicles yet; fill in {path / COUNT_SHEET}, and make it "
            "again with --counts, as its README.md says"
        )
    if text and _is_folder(path):
        raise ScenarioError(f"{path}: a directory without scenario.toml is not a scenario")
    if text and _is_file(path):
        raise ScenarioError(
            f"{path}: is no scenario; give a directory with scenario.toml, or a .sumocfg file"
        )
    raise UnknownNameError(
        "scenario", text, shipped, "A directory, a .sumocfg file and resco:<map> work as well."
    )


def draft_network(folder: Path) -> Path | None:
    """Return the network of a folder with roads and no vehicles; None if it is no such folder."""
    if not _is_file(folder / COUNT_SHEET) or _is_file(folder / "scenario.toml"):
        return None
    for path in (folder / NETWORK, folder / f"{NETWORK}.gz"):
        if _is_file(path) or path.is_symlink():  # also if what it links to is gone
            return path
    return None


def shipped_scenarios() -> Iterator[tuple[str, Path]]:
    """Yield ids and directories of the scenarios that come with the package."""
    package = Path(__file__).resolve().parents[1]
    for root in (package / "_scenarios", package.parent / "scenarios"):
        if root.is_dir():
            for file in sorted(root.glob("*/scenario.toml")):
                yield file.parent.name, file.parent
            return


def _load_directory(directory: Path) -> Scenario:
    file = directory / "scenario.toml"
    settings = validate_settings(read_toml(file, ScenarioError), str(file))
    lines = file.read_text(encoding="utf-8").splitlines()
    first = takewhile(lambda line: line.startswith(_MADE_BY), lines)

    def document(name: str, key: str) -> Document:
        path = directory / name
        if not _is_file(path):
            raise ScenarioError(f"{file}: {key} names {name!r}, but {path} does not exist")
        return admitted(Document(path.name, path.absolute()))  # users may change their folder

    scenario = Scenario(
        id=directory.resolve().name,
        network=document(settings.network, "network"),
        routes=tuple(document(name, "routes") for name in settings.routes),
        additional=tuple(document(name, "additional") for name in settings.additional),
        settings=settings,
        applied=tuple(line.removeprefix(_MADE_BY) for line in first),
    )
    return _with_sources(scenario, file)


def _with_sources(scenario: Scenario, file: Path) -> Scenario:
    """Return a scenario that was read from `file` and the documents it names."""
    paths = (file, *(document.path for document in scenario.documents))
    return replace(scenario, sources=frozenset(path.resolve() for path in paths if path))


_MADE_BY = "# made by applying "
"""Start of a comment in ``scenario.toml`` that names an effect."""

_SYNONYMS = {
    "net-file": ("net-file", "net", "n"),
    "route-files": ("route-files", "routes", "r"),
    "additional-files": ("additional-files", "additional", "a"),
    "begin": ("begin", "b"),
    "end": ("end", "e"),
    "step-length": ("step-length",),
}
"""Names that SUMO allows for the elements of a configuration."""


_FORMER_NAMES = {
    "abs-rand": "random",
    "carfollow.model": "default.carfollowmodel",
    "meso.ignore-lanes.by-vclass": "meso-ignore-lanes-by-vclass",
    "railsignal.moving-block": "railsignal-moving-block",
    "s": "route-steps",
    "srand": "seed",
    "taxi.vclasses": "device.taxi.vclasses",
    "with-taz": "device.rerouting.with-taz",
}
"""Former names of options that change traffic; SUMO still obeys them."""


def _present_name(option: str) -> str:
    name = option.replace("device.routing.", "device.rerouting.")
    return _FORMER_NAMES.get(name, re.sub(r"\.knownveh$", ".explicit", name))


_IGNORED = ("time-to-teleport", "max-depart-delay", "random", "seed")
"""Settings of SUMO that change traffic and are the same in all scenarios."""
_LACKING = re.compile(r"load-state.*|(lane-)?weight.*|w|x|measure|device\.(toc|stationfinder)\..*")
"""Settings of SUMO that change traffic and that no scenario has."""


class SumoConfiguration:
    """Values of a ``.sumocfg``, under any of the names that SUMO allows for them.

    Args:
        path: The file.

    Raises:
        ScenarioError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        root = read_xml(path)
        self.given = {
            _present_name(item.tag): item.get("value", item.get("v", "")) for item in root.iter()
        }

    def value(self, key: str, default: str = "") -> str:
        """Return the text of an element; `default` if it is missing."""
        return next((self.given[name] for name in _SYNONYMS[key] if name in self.given), default)

    def names(self, key: str) -> list[str]:
        """Return the names of files in an element."""
        return _names(self.value(key), self.path.parent)

    def seconds(self, key: str, default: str) -> float:
        """Return a time in s.

        Raises:
            ScenarioError: It is none.
        """
        text = self.value(key, default)
        try:
            return parse_time(text)
        except ValueError:
            raise ScenarioError(f"{self.path}: {key} = {text!r} is not a time in seconds") from None

    def times(self, begin_s: float | None = None) -> tuple[float, float]:
        """Return begin and duration of an episode, s; an hour if there is no end.

        Args:
            begin_s: Begin in place of the configuration's, whose end stays the end.

        Raises:
            ScenarioError: A time is none, or the end is not after the start.
        """
        begin = self.seconds("begin", "0") if begin_s is None else begin_s
        end = self.seconds("end", "-1")
        if 0 <= end <= begin:
            raise ScenarioError(f"{self.path}: end ({end:g} s) is not after begin ({begin:g} s)")
        return begin, end - begin if end >= 0 else 3600.0

    def physics(self) -> dict[str, Any]:
        """Return step length, options of SUMO and times of signals, as in ``scenario.toml``."""
        options = {option: self.given[option] for option in self.given if option in OPTIONS}
        if options.get("mesosim", "").lower() in NO:  # SUMO's own default
            del options["mesosim"]
        step_s = self.seconds("step-length", "1")
        times = usual_times(step_s) if step_s > 0 else {}
        settings: dict[str, Any] = {"step_length_s": step_s, "sumo": options}
        return {**settings, "control": times} if times else settings

    @property
    def has_end(self) -> bool:
        """True if it says when the simulation ends."""
        return self.seconds("end", "-1") >= 0

    def ignored(self) -> list[str]:
        """Return the settings that all scenarios have in common, as ``name = value``."""
        return [f"{name} = {self.given[name]}" for name in _IGNORED if self.given.get(name)]

    def lacking(self) -> list[str]:
        """Return the settings that change traffic and that no scenario has, as ``name = value``."""
        return [
            f"{name} = {value}"
            for name, value in self.given.items()
            if value and _LACKING.fullmatch(name) and name not in OPTIONS
        ]


def _load_sumocfg(path: Path, scenario_id: str) -> Scenario:
    configuration = SumoConfiguration(path)

    def documents(key: str, kind: str = "") -> tuple[Document, ...]:
        names = configuration.names(key)
        if kind and not names:
            raise ScenarioError(f"{path}: no <{key} value=...>; a scenario needs {kind}")
        for name in names:
            if not _is_file(path.parent / name):
                raise ScenarioError(
                    f"{path}: <{key}> names {name!r}, but {path.parent / name} does not exist"
                )
        files = [(path.parent / name).absolute() for name in names]
        return tuple(admitted(Document(file.name, file)) for file in files)

    begin_s, duration_s = configuration.times()
    network = documents("net-file", "a network")[0]
    routes, additional = documents("route-files", "vehicles"), documents("additional-files")
    settings = validate_settings(
        {
            "description": f"SUMO configuration {path.name}",
            "network": network.name,
            "routes": [document.name for document in routes],
            "additional": [document.name for document in additional],
            "begin_s": begin_s,
            "duration_s": duration_s,
            **configuration.physics(),
        },
        str(path),
    )
    return _with_sources(Scenario(scenario_id, network, routes, additional, settings), path)


def _is_file(path: Path) -> bool:
    """Return True for a file; a name that is too long or impossible is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _is_folder(path: Path) -> bool:
    """Return True for a folder; a name that is too long or impossible is none."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _names(text: str, directory: Path) -> list[str]:
    """Return file names; SUMO separates them by commas or blanks."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    return [
        part for name in names for part in ([name] if _is_file(directory / name) else name.split())
    ]


def resco_maps() -> dict[str, Path]:
    """Return the ``.sumocfg`` of each RESCO network of an installed sumo-rl.

    The package sumo-rl is located, but not imported.
    """
    spec = importlib.util.find_spec("sumo_rl")
    roots = list(spec.submodule_search_locations or []) if spec else []
    files = [file for root in roots for file in Path(root).glob("nets/RESCO/*/*.sumocfg")]
    return {file.parent.name: file for file in files}


def _resco_configuration(name: str) -> Path:
    maps = resco_maps()
    if not maps:
        raise ScenarioError(
            f"resco:{name} needs the RESCO networks of the sumo-rl wheel; "
            f"install them with: {install_command('resco')}"
        )
    if name not in maps:
        raise UnknownNameError("RESCO map", name, maps)
    return maps[name]


def _quoted(value: Any) -> str:
    """Return a value as TOML: JSON text, with the character DEL escaped."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def scenario_toml(settings: Mapping[str, Any], applied: Sequence[str] = ()) -> str:
    """Return the text of a ``scenario.toml``.

    Args:
        settings: Keys and values; nested mappings become tables.
        applied: Descriptions of the effects that made the scenario: comments at the beginning, from
            which `read_scenario` reads them.
    """
    lines = [f"{_MADE_BY}{text}" for text in applied]
    tables: list[str] = []
    for key, value in settings.items():
        if isinstance(value, dict):
            tables += _toml_table(key, value)
        elif key == "effects":
            for effect in value:
                tables += [
                    "",
                    "[[effects]]",
                    *(f"{k} = {_quoted(v)}" for k, v in effect.items()),
                ]
        else:
            lines.append(f"{key} = {_quoted(value)}")
    return "\n".join(lines + tables) + "\n"


def _toml_table(name: str, table: Mapping[str, Any]) -> list[str]:
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    lines = ["", f"[{name}]", *(f"{_key(k)} = {_quoted(v)}" for k, v in plain.items())]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += _toml_table(f"{name}.{_key(key)}", value)
    return lines
