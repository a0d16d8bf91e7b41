"""Vehicles of a demand with their routes, read from route files or computed by duarouter."""

from __future__ import annotations

import functools
import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from ugat_marl.errors import ScenarioError
from ugat_marl.files import DocumentDraft, Tag, child_texts, replacing
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.scenario import Document, Scenario
from ugat_marl.scenarios.settings import parse_time, seconds_text
from ugat_marl.scenarios.sumo_tools import convert

BLOCKERS = ("closure.", "parking.")
"""Beginnings of the ids of vehicles that effects add to block a lane."""
DEPARTING = frozenset({"vehicle", "trip", "flow"})
"""Elements of demand."""
DEFINITIONS = frozenset({"vType", "vTypeDistribution", "route"})
"""Elements of a route file that other elements name, apart from distributions of routes."""
TRAVELLERS = frozenset({"person", "personFlow", "container", "containerFlow"})
"""Elements of a route file that depart and are no vehicles."""

STOP_TIMES = ("until", "arrival", "started", "ended")
"""Attributes of a stop that are times, and no durations."""

_ROUTED = "routed.rou.xml"


def is_blocker(vehicle: str, vehicle_type: str) -> bool:
    """Return True for a vehicle that blocks a lane and is not part of the demand.

    Args:
        vehicle: Id of the vehicle.
        vehicle_type: Its type. Blockers have a type of their own, and its name begins their ids.
    """
    return vehicle_type.startswith(BLOCKERS) and vehicle.rpartition(".")[0] == vehicle_type


def blocker_types(scenario: Scenario) -> tuple[str, ...]:
    """Return the types of the vehicles that effects have added to block lanes."""
    return tuple(dict.fromkeys(vehicle.get("type", "") for vehicle in _blockers(scenario)))


def blocker_departures(scenario: Scenario) -> tuple[tuple[str, float], ...]:
    """Return the vehicles that effects have added to block lanes, with their departures in s."""
    return tuple(
        (vehicle.get("id", ""), parse_time(vehicle.get("depart", "")))
        for vehicle in _blockers(scenario)
    )


def _blockers(scenario: Scenario) -> Iterator[ET.Element]:
    for document in scenario.routes:
        if document.name.startswith(BLOCKERS):
            for vehicle in document.parse().iter("vehicle"):
                if is_blocker(vehicle.get("id", ""), vehicle.get("type", "")):
                    yield vehicle


class OwnEdges:
    """Test of a route file: does it hold only single vehicles with their own edges?"""

    def __init__(self) -> None:
        self._holds = True
        self._waiting = False  # True between a <vehicle> and its <route>

    @property
    def lost(self) -> bool:
        """True once another kind of demand was read; this is final."""
        return not self._holds

    def read(self, tag: Tag) -> None:
        """Read the next opening tag."""
        if tag.name in ("vehicle", "trip", "flow", "route", "routeDistribution"):
            single = tag.name == "vehicle" and "route" not in tag.attributes
            self._holds &= tag.name == "route" or (single and not self._waiting)
            self._waiting = single

    def ended(self) -> bool:
        """Return True if the whole file held only such vehicles; call this after the last tag."""
        return self._holds and not self._waiting


def demand_as_vehicles(scenario: Scenario) -> Scenario:
    """Return the same demand as single vehicles with routes; duarouter resolves trips and flows.

    Demand in additional files moves to the route files. Vehicle types, named routes, persons and
    containers stay what they are. SUMO's option ``scale`` is carried out and left out. Vehicles
    between districts take the quickest free-flow route, see `between_districts`. Random departures
    are drawn once, with a fixed seed, see `random_flow`.

    Raises:
        ScenarioError: duarouter refuses; the message quotes it.
    """
    scale = demand_scale(scenario)
    if scale != 1:
        documents = (*scenario.routes, *scenario.additional)
        flows = {
            tag.attributes.get("id", "")
            for document in documents
            for tag in document.scan()
            if tag.name == "flow"
        }
        return _scaled(demand_as_vehicles(_without_scale(scenario)), _Copies(scale, flows))
    beside = [_test_file(document, _holds_demand) for document in scenario.additional]
    if not any(beside) and all(_test_file(x, _holds_single_vehicles) for x in scenario.routes):
        return scenario
    additional = tuple(
        _without_demand(document) if holds_demand else document
        for document, holds_demand in zip(scenario.additional, beside, strict=True)
    )
    return replace(scenario, routes=_routed_by_duarouter(scenario), additional=additional)


def between_districts(scenario: Scenario) -> str:
    """Return the id of a trip or flow from district to district; empty if there is none.

    SUMO chooses where such vehicles begin and end by the travel times of the moment, and duarouter
    by those of free flow. So the demand differs.
    """
    for document in (*scenario.routes, *scenario.additional):
        for tag in document.scan():
            if tag.name in DEPARTING and {"fromTaz", "toTaz"} & tag.attributes.keys():
                return tag.attributes.get("id", "")
    return ""


def random_flow(scenario: Scenario) -> str:
    """Return the id of a flow with random departures; empty if there is none.

    SUMO draws the departures of each episode. duarouter draws them once, and always the same.
    """
    for document in (*scenario.routes, *scenario.additional):
        for tag in document.scan():
            given = tag.attributes
            by_chance = "probability" in given or given.get("period", "").strip().startswith("exp(")
            if tag.name == "flow" and departs(tag) and by_chance:
                return given.get("id", "")
    return ""


def demand_scale(scenario: Scenario) -> float:
    """Return SUMO's option ``scale``: the number of vehicles per vehicle of the files."""
    return float(scenario.settings.sumo.get("scale", "1"))


def scaled_number(vehicles: int, scale: float) -> int:
    """Return the number of vehicles that SUMO makes of `vehicles` with its option ``scale``."""
    if scale == 1:
        return vehicles
    copies = _Copies(scale)
    return sum(copies.of("") for _ in range(vehicles))


class _Copies:
    """Numbers of vehicles that SUMO makes of each vehicle, as `MSVehicleControl::getQuota` does.

    Args:
        scale: SUMO's option ``scale``.
        flows: Ids of the flows, which number their vehicles themselves.
    """

    def __init__(self, scale: float, flows: Collection[str] = ()) -> None:
        self._scale, self._flows = scale, flows
        self._thousandths = int(scale % 1 * 1000 + 0.5)
        self._loaded = 0  # copies count, too

    def of(self, vehicle: str) -> int:
        """Return the number for the next vehicle of the files, by its id."""
        flow, _, place = vehicle.rpartition(".")
        if flow in self._flows and place.isdecimal():
            number = int(place)
        else:
            number = int((self._loaded + 1) / self._scale) if self._scale > 1 else self._loaded
        more = number % 1000 * self._thousandths % 1000 < self._thousandths
        copies = int(self._scale) + int(more)
        self._loaded += max(copies, 1)
        return copies


def _without_scale(scenario: Scenario) -> Scenario:
    options = {key: value for key, value in scenario.settings.sumo.items() if key != "scale"}
    return replace(scenario, settings=scenario.settings.model_copy(update={"sumo": options}))


def _scaled(scenario: Scenario, copies: _Copies) -> Scenario:
    """Return the scenario with copies of each vehicle, named as SUMO names those of its files.

    Vehicles that block a lane stay single.
    """

    def copied(document: Document) -> Document:
        draft = None
        for part in document.parts():
            draft = draft or DocumentDraft(document.name.removesuffix(".gz"), part)
            kept: list[ET.Element] = []
            for element in part:
                vehicle = element.get("id", "")
                if element.tag != "vehicle" or is_blocker(vehicle, element.get("type", "")):
                    kept.append(element)
                    continue
                for number in range(copies.of(vehicle)):
                    copy = ET.Element(element.tag, element.attrib)
                    copy[:] = element[:]
                    if number:
                        copy.set("id", f"{vehicle}.{number}")
                    kept.append(copy)
            part[:] = kept
            draft.add(*(child_texts(part) if kept else ()))
        assert draft is not None
        return draft.document()

    return replace(scenario, routes=tuple(map(copied, scenario.routes)))


def driven_routes(scenario: Scenario) -> Iterator[tuple[str, ...]]:
    """Yield the edges of every vehicle that departs within the scenario's time.

    Args:
        scenario: Any scenario; `demand_as_vehicles` turns its trips and flows into vehicles.
    """
    for _, _, edges in departures(scenario, routed=False):
        if edges:
            yield tuple(edges)


def departures(
    scenario: Scenario, *, routed: bool, reporter: Reporter | None = None
) -> Iterator[tuple[str, float, list[str]]]:
    """Yield name, departure in s, and roads of every vehicle that departs within the episode.

    Vehicles that block a lane for an effect are left out.

    Args:
        scenario: Scenario that has passed `check_demand`.
        routed: True if its route files hold only single vehicles with their own edges. Otherwise
            `demand_as_vehicles` routes them first.
        reporter: Shows progress if a file is long.
    """
    begin = scenario.settings.begin_s
    end = begin + scenario.settings.duration_s
    for document in scenario.routes if routed else demand_as_vehicles(scenario).routes:
        name, depart, left_out = "", 0.0, False
        for tag in document.scan(reporter):
            if tag.name == "vehicle":
                name, text = tag.attributes.get("id", ""), tag.attributes.get("depart", "0")
                depart = departure_s(text)
                depart = begin if math.isnan(depart) else depart
                left_out = depart < begin or is_blocker(name, tag.attributes.get("type", ""))
                if depart >= end:  # vehicles are sorted by departure
                    break
            elif tag.name == "route" and tag.parent == "vehicle" and not left_out:
                edges = tag.attributes.get("edges", "").split()
                yield name, depart, laps_of(tag.attributes) * edges


def laps_of(route: Mapping[str, str]) -> int:
    """Return how often the edges of a route with these attributes are driven."""
    again = route.get("repeat", "")
    return 1 + int(again) if again.isdecimal() else 1


def own_stops(element: ET.Element) -> list[ET.Element]:
    """Return the stops of a vehicle or flow itself, and of the route inside of it."""
    children = (child if child.tag == "route" else [child] for child in element)
    return [stop for part in children for stop in part if stop.tag == "stop"]


def move_stops(stops: Iterable[ET.Element], seconds: float) -> None:
    """Move the times of a vehicle's stops by the time by which its departure moves.

    Those of a flow with regular departures count from its begin. Those of a flow with random
    departures are times of the clock, and those of named routes are relative to the departure.
    """
    if math.isnan(seconds):  # it waits for a person or container
        return
    for stop in stops:
        for key in STOP_TIMES:
            if text := stop.get(key):
                stop.set(key, seconds_text(parse_time(text) + seconds))


def departure_s(text: str) -> float:
    """Return the time of a departure, s; NaN for a word such as "triggered"."""
    try:
        return parse_time(text)
    except ValueError:
        return math.nan


def _test_file(document: Document, test: Callable[[Document], bool]) -> bool:
    """Return the result of a test of a whole file; a file that has not changed is read once."""
    if document.path is None or document.content is not None:
        return _test_content(document, test, 0, 0)
    state = document.path.stat()
    return _test_content(replace(document, home=None), test, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=32)
def _test_content(
    document: Document, test: Callable[[Document], bool], size: int, changed_ns: int
) -> bool:
    """Test the file; the size and time of change make the cache forget a changed file."""
    return test(document)


def _holds_single_vehicles(document: Document) -> bool:
    """Return True if the file holds nothing but single vehicles with their own edges and times."""
    singles = OwnEdges()
    for tag in document.scan():
        singles.read(tag)
        if singles.lost or _begins_with_episode(tag.attributes):
            return False
    return singles.ended()


def _holds_demand(document: Document) -> bool:
    """Return True if the file holds vehicles, trips or flows other than those of calibrators."""
    return any(map(departs, document.scan()))


def departs(tag: Tag) -> bool:
    """Return True for vehicles, trips and flows, but not for the flows of calibrators."""
    return tag.name in DEPARTING and tag.parent != "calibrator"


def _without_demand(document: Document) -> Document:
    """Return an additional file without its vehicles, trips and flows."""

    def drop(part: ET.Element) -> None:
        part[:] = [element for element in part if element.tag not in DEPARTING]

    return document.changed(drop)


def _routed_by_duarouter(scenario: Scenario) -> tuple[Document, ...]:
    """Route all demand of the scenario with duarouter.

    Returns:
        The vehicles behind the definitions of the route files, and a second document with persons
        and containers if there are any.
    """
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name)
        out = directory / _ROUTED
        reads: list[Path] = []

        def files(documents: tuple[Document, ...]) -> str:
            paths = [_for_sumo(document, directory) for document in documents]
            reads.extend(paths)
            return ",".join(map(str, paths))

        settings = scenario.settings
        arguments = [
            "--net-file", files((scenario.network,)),
            "--route-files", files(_from_begin(scenario.routes, settings.begin_s)),
            "--output-file", str(out),
            "--vtype-output", str(directory / "types.xml"),
            "--begin", repr(settings.begin_s),
            "--end", repr(settings.begin_s + settings.duration_s),
            "--skip-new-routes", "true",  # else it replaces routes of the files by shorter ones
            "--ptline-routing", "true",  # else vehicles with a line, such as buses, are left out
            "--ignore-errors", "true",
            "--no-warnings", "true",
            "--no-step-log", "true",
            "--seed", "1",
        ]  # fmt: skip
        if "junction-taz" in settings.sumo:  # trips may name junctions
            arguments += ["--junction-taz", settings.sumo["junction-taz"]]
        if scenario.additional:
            beside = _from_begin(scenario.additional, settings.begin_s)
            arguments += ["--additional-files", files(beside)]
        try:
            convert("duarouter", arguments, directory, reads)
            if not out.exists():
                raise ScenarioError("duarouter: wrote no routes")
        except ScenarioError as error:
            raise ScenarioError(
                f"scenario {scenario.id!r}: its trips or flows cannot be turned into routes: "
                f"{error}"
            ) from None
        routed = DocumentDraft(_ROUTED, ET.Element("routes"))
        for document in scenario.routes:
            for texts in _children(document, DEFINITIONS):
                routed.add(*texts)
        for texts in _children(Document(_ROUTED, out), frozenset({"vehicle"})):
            routed.add(*texts)
    travellers = [_travellers(document, i) for i, document in enumerate(scenario.routes)]
    return (routed.document(), *(document for document in travellers if document is not None))


def _travellers(document: Document, index: int) -> Document | None:
    """Return the persons and containers of a route file; None if there are none."""
    drafted, some = DocumentDraft(f"others{index or ''}.rou.xml", ET.Element("routes")), False
    for texts in _children(document, TRAVELLERS):
        drafted.add(*texts)
        some |= bool(texts)
    return drafted.document() if some else None


def _children(document: Document, tags: frozenset[str]) -> Iterator[list[str]]:
    """Yield the children of a document with one of the tags, as texts, part by part."""
    for part in document.parts():
        part[:] = [element for element in part if element.tag in tags]
        yield child_texts(part) if len(part) else []


def _from_begin(documents: Iterable[Document], begin_s: float) -> tuple[Document, ...]:
    """Return the files with the begin of the episode where duarouter needs it.

    duarouter lets every vehicle of a flow depart at "begin", so the word is replaced by its time.
    And it hangs on a flow with a probability that begins before the episode, so its begin is moved
    to the episode's. That changes nothing in the episode, since departures in each second are
    independent. A flow that also ends before the episode is left out.
    """

    def delay(part: ET.Element) -> None:
        for element in list(part):
            for key in _begins_with_episode(element.attrib):
                element.set(key, f"{begin_s:.3f}")
            if _is_early(element.tag, element.attrib, begin_s):
                element.set("begin", f"{begin_s:.3f}")
                if "end" in element.attrib and parse_time(element.attrib["end"]) < begin_s:
                    part.remove(element)

    return tuple(
        document.changed(delay)
        if any(
            _begins_with_episode(tag.attributes) or _is_early(tag.name, tag.attributes, begin_s)
            for tag in document.scan()
        )
        else document
        for document in documents
    )


def _begins_with_episode(attributes: Mapping[str, str]) -> list[str]:
    """Return the attributes of a vehicle or flow that hold the word "begin" for a time."""
    return [key for key in ("depart", "begin") if attributes.get(key) == "begin"]


def _is_early(name: str, attributes: Mapping[str, str], begin_s: float) -> bool:
    if name != "flow" or "probability" not in attributes:
        return False
    return departure_s(attributes.get("begin", "0")) < begin_s  # not if another vehicle begins it


def _for_sumo(document: Document, directory: Path) -> Path:
    """Return a path SUMO can read: the file itself if it is plain, else a copy in `directory`."""
    path = document.path
    plain = path is not None and document.content is None and path.suffix != ".gz"
    if path is not None and plain and "," not in str(path.resolve()):  # SUMO splits names at ","
        return path.resolve()
    # a folder for each copy: files of two folders may have one name
    place = Path(tempfile.mkdtemp(dir=directory))
    copy = place / document.name.removesuffix(".gz").replace(",", "_")
    with replacing(copy) as temporary, temporary.open("wb") as file:
        file.writelines(document.pieces())
    return copy
