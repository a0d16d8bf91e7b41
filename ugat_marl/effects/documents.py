"""Editing a scenario's files: each is parsed once, and only if it can hold what is looked for."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import replace

from ugat_marl.files import xml_bytes
from ugat_marl.scenario import Document, Scenario
from ugat_marl.scenario_settings import seconds_of

DEFAULTS_FILE = "default-types.add.xml"
"""The types SUMO defines itself, written down so that effects can change them."""

DEFAULT_TYPES = (
    "DEFAULT_VEHTYPE", "DEFAULT_TAXITYPE", "DEFAULT_BIKETYPE", "DEFAULT_RAILTYPE",
)  # fmt: skip
"""Types SUMO defines itself. Only the first is used without being named."""

DEPARTING = frozenset({"vehicle", "trip", "flow"})
BLOCKERS = ("closure.", "parking.")
"""How the ids of vehicles begin that stand on the street and are no part of the demand."""

_SORTED = DEPARTING | {"person", "personFlow", "container", "containerFlow"}

Root = ET.Element


def mentions(document: Document, *texts: str) -> bool:
    """Whether any of the texts occurs; also True where that cannot be told without parsing."""
    content = document.read()
    if b"\0" in content[:4] or content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return True
    return any(text.encode() in content for text in texts)


def edit(
    documents: Iterable[Document], change: Callable[[Root], bool], *texts: str
) -> tuple[Document, ...]:
    """Applies `change` to every document that mentions one of `texts`.

    Args:
        documents: What may be edited.
        change: Edits a document in place and says whether it did.
        *texts: Documents without any of these are not even parsed.
    """
    edited: list[Document] = []
    for document in documents:
        if mentions(document, *texts):
            root = document.parse()
            if change(root):
                document = document.edited(xml_bytes(root))
        edited.append(document)
    return tuple(edited)


def edit_scenario(
    scenario: Scenario, change: Callable[[Root], bool], *texts: str, applied: str
) -> Scenario:
    """Applies `change` to additional files and routes, as `edit` does.

    Args:
        scenario: It does not change itself.
        change: Edits a document in place and says whether it did.
        *texts: Documents without any of these are not even parsed.
        applied: What to note as applied.
    """
    return replace(
        scenario,
        additional=edit(scenario.additional, change, *texts),
        routes=edit(scenario.routes, change, *texts),
        applied=(*scenario.applied, applied),
    )


def with_default_types(scenario: Scenario) -> Scenario:
    """The same scenario with the default types in use declared, in its first additional file."""
    if scenario.additional and scenario.additional[0].name == DEFAULTS_FILE:
        return scenario
    declared: set[str] = set()
    named: set[str] = {DEFAULT_TYPES[0]}
    for document in (*scenario.additional, *scenario.routes):
        if not mentions(document, "DEFAULT_"):
            continue
        for item in document.parse().iter():
            if item.tag == "vType":
                declared.add(item.get("id", ""))
            named |= {item.get("type", ""), *item.get("vTypes", "").split()}
    root = ET.Element("additional")
    for name in DEFAULT_TYPES:
        if name in named and name not in declared:
            vehicle_class = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi"}.get(name)
            attributes = {"id": name} | ({"vClass": vehicle_class} if vehicle_class else {})
            if name != "DEFAULT_RAILTYPE":
                ET.SubElement(root, "vType", attributes)
    document = Document(DEFAULTS_FILE, None, xml_bytes(root))
    return replace(scenario, additional=(document, *scenario.additional))


def is_demand(item: Root) -> bool:
    """Whether an element is a vehicle, trip or flow that wants to get somewhere."""
    return item.tag in DEPARTING and not item.get("id", "").startswith(BLOCKERS)


def depart_s(item: Root) -> float:
    """Departure of a vehicle or trip, or begin of a flow; NaN if something else triggers it."""
    text = item.get("begin", "0") if item.tag.lower().endswith("flow") else item.get("depart", "")
    try:
        return seconds_of(text)
    except ValueError:
        return math.nan


def sort_departures(root: Root) -> None:
    """Puts definitions first and then everything that departs, in order of time.

    SUMO leaves out vehicles that stand behind a later one. One whose departure is triggered stays
    behind its predecessor.
    """
    first: list[Root] = []
    timed: list[tuple[float, int, Root]] = []
    latest = -math.inf
    for place, item in enumerate(root):
        if item.tag not in _SORTED:
            first.append(item)
            continue
        time = depart_s(item)
        latest = latest if math.isnan(time) else time
        timed.append((latest, place, item))
    timed.sort(key=lambda entry: entry[:2])
    root[:] = [*first, *(item for _, _, item in timed)]


def seconds_text(value: float) -> str:
    """A time as it is written into files, to the millisecond, SUMO's own resolution."""
    return f"{value:.3f}".rstrip("0").rstrip(".")
