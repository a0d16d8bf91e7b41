"""Edits of a scenario's files, part by part; files without a searched text are not parsed."""

from __future__ import annotations

import heapq
import json
import math
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain, count, islice
from typing import IO

from ugat_marl.files import DocumentDraft, Rows, child_texts, scratch, xml_bytes
from ugat_marl.scenarios import (
    DEPARTING,
    TRAVELLERS,
    Document,
    Scenario,
    departure_s,
    is_blocker,
    seconds_text,
)

DEFAULTS_FILE = "default-types.add.xml"
"""File with SUMO's default vehicle types, so that effects can change them."""

DEFAULT_TYPES = (
    "DEFAULT_VEHTYPE", "DEFAULT_TAXITYPE", "DEFAULT_BIKETYPE", "DEFAULT_RAILTYPE",
)  # fmt: skip
"""SUMO's default vehicle types. Vehicles without a type use the first one."""

FLOWS = ("<flow", "<personFlow", "<containerFlow")
"""Beginnings of flows."""

_SORTED = DEPARTING | TRAVELLERS
_OVERLAP = 256
"""Largest length of a searched text, in bytes."""
_RUN = 16 << 20
"""Number of characters to sort in memory at a time."""
_AT_ONCE = 1000

Root = ET.Element
Change = Callable[[Root], bool]
"""Function that edits a part of a document's elements, below their root; True if it did."""

FLOW_RATES = ("vehsPerHour", "perHour", "period", "probability")
"""Attributes that say how often a vehicle of a flow departs."""


def windows(document: Document) -> Iterator[bytes]:
    """Yield the bytes piece by piece, each with the end of the piece before it."""
    window = b""
    for piece in document.pieces():
        window = window[-_OVERLAP:] + piece
        yield window


def mentions(document: Document, *texts: str) -> bool:
    """Return True if any of the texts occurs, or if the encoding prevents a search."""
    wanted = [text.encode() for text in texts]
    return any(
        window[:2] in (b"\xff\xfe", b"\xfe\xff")
        or b"\0" in window[:4]
        or any(text in window for text in wanted)
        for window in windows(document)
    )


def free_suffix(scenario: Scenario, suffix: str) -> str:
    """Return a suffix for ids, with a number behind it where an id of the demand has it already."""
    documents = (*scenario.additional, *scenario.routes)
    candidates = chain([suffix], (f"{suffix}~{number}" for number in count(2)))
    return next(x for x in candidates if not any(mentions(each, x) for each in documents))


def parts_with(document: Document, *texts: str) -> Iterator[Root]:
    """Yield the document as trees, as `Document.parts` does.

    Children in which none of the texts occurs may be left out.
    """
    if not mentions(document, *texts):
        return
    rows = document.rows()
    if rows is None:
        yield from document.parts()
    else:
        yield rows.parse(rows.with_any(texts))


def edit(
    documents: Iterable[Document],
    change: Change,
    *texts: str,
    in_order: bool = False,
    in_place: bool = False,
) -> tuple[Document, ...]:
    """Apply `change` to every document that mentions one of `texts`.

    Args:
        documents: Documents of any length.
        change: Function called with parts of the elements, below their root.
        *texts: Searched texts; documents without any of them are not parsed.
        in_order: True to sort vehicles by departure after the change, because SUMO drops vehicles
            that come after a later one.
        in_place: True if the change neither adds, removes nor moves elements, and needs only those
            with one of the texts: the others are then left alone, which takes little time.
    """

    def edited(document: Document) -> Document:
        if not mentions(document, *texts):
            return document
        rows = document.rows() if in_place else None
        if rows is not None:
            return _edited_in_place(document, rows, change, texts)
        return _edited(document, change, in_order)

    return tuple(map(edited, documents))


def _edited_in_place(
    document: Document, rows: Rows, change: Change, texts: Iterable[str]
) -> Document:
    # `edit_scenario` completes the flows of each document that it changes.
    chosen = rows.with_any((*texts, *FLOWS))
    part = rows.parse(chosen)
    if not change(part):
        return document
    return rows.replaced(dict(zip(chosen, child_texts(part), strict=True)))


def _edited(document: Document, change: Change, in_order: bool) -> Document:
    draft, changed = None, False
    departure, rows = _clock(), _Sorted()
    for part in document.parts():
        draft = draft or DocumentDraft(document.name.removesuffix(".gz"), part)
        changed |= change(part)
        if in_order:
            rows.add(zip(map(departure, part), child_texts(part), strict=True))
        else:
            draft.add(*child_texts(part))
    assert draft is not None
    if not changed:
        return document
    texts = iter(rows)
    while some := tuple(islice(texts, _AT_ONCE)):
        draft.add(*some)
    return draft.document()


def edit_scenario(
    scenario: Scenario,
    change: Change,
    *texts: str,
    applied: str,
    in_order: bool = False,
    in_place: bool = False,
) -> Scenario:
    """Apply `change` to additional files and routes, as `edit` does.

    Vehicles that depart at ``begin``, and flows, have their times in s when `change` sees them.

    Args:
        scenario: The scenario; it does not change itself.
        change: Function that edits elements, as for `edit`.
        *texts: Searched texts; documents without any of them are not parsed.
        applied: Effect in text form, to add to `applied`.
        in_order: True to sort vehicles by departure, as for `edit`.
        in_place: True if the change is one in place, as for `edit`.
    """
    begin_s = scenario.settings.begin_s
    end_s = begin_s + scenario.settings.duration_s

    def complete_and_change(root: Root) -> bool:
        for element in root:
            if element.get("depart") == "begin":
                element.set("depart", seconds_text(begin_s))
            if element.tag.lower().endswith("flow"):
                _complete_flow(element, begin_s, end_s)
        return change(root)

    def edited(documents: tuple[Document, ...]) -> tuple[Document, ...]:
        return edit(documents, complete_and_change, *texts, in_order=in_order, in_place=in_place)

    return replace(
        scenario,
        additional=edited(scenario.additional),
        routes=edited(scenario.routes),
        applied=(*scenario.applied, applied),
    )


def _complete_flow(flow: ET.Element, begin_s: float, end_s: float) -> None:
    """Write the times that SUMO takes from its own begin and end into a flow without them."""
    if flow.get("begin", "begin") == "begin":
        flow.set("begin", seconds_text(begin_s))
    if "number" in flow.attrib and not {"end", *FLOW_RATES} & flow.attrib.keys():
        flow.set("end", seconds_text(end_s))


def with_default_types(scenario: Scenario) -> Scenario:
    """Return the scenario with a first additional file that declares the default types in use."""
    if scenario.additional and scenario.additional[0].name == DEFAULTS_FILE:
        return scenario
    declared: set[str] = set()
    named: set[str] = {DEFAULT_TYPES[0]}
    for document in (*scenario.additional, *scenario.routes):
        if not mentions(document, "DEFAULT_"):
            continue
        for tag in document.scan():
            if tag.name in ("vType", "vTypeDistribution"):
                declared.add(tag.attributes.get("id", ""))
            named.add(tag.attributes.get("type", ""))
            named.update(tag.attributes.get("vTypes", "").split())
    root = ET.Element("additional")
    for name in DEFAULT_TYPES:
        if name in named and name not in declared:
            vehicle_class = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi"}.get(name)
            attributes = {"id": name} | ({"vClass": vehicle_class} if vehicle_class else {})
            if name != "DEFAULT_RAILTYPE":
                ET.SubElement(root, "vType", attributes)
    document = Document(DEFAULTS_FILE, None, xml_bytes(root))
    return replace(scenario, additional=(document, *scenario.additional))


def is_demand(element: Root) -> bool:
    """Return True if an element is a vehicle, trip or flow of the demand."""
    blocks = is_blocker(element.get("id", ""), element.get("type", ""))
    return element.tag in DEPARTING and not blocks


def depart_s(element: Root) -> float:
    """Return the departure of a vehicle or trip, or the start of a flow, in s; NaN for a word."""
    text = (
        element.get("begin", "0")
        if element.tag.lower().endswith("flow")
        else element.get("depart", "")
    )
    return departure_s(text)


def sort_departures(root: Root) -> None:
    """Sort the elements: definitions first, then everything that departs, by time.

    An element with a triggered departure stays behind its predecessor.
    """
    root[:] = sorted(root, key=_clock())


def _clock() -> Callable[[Root], float]:
    """Return a function that gives the departure of each element in turn; -inf if it has none."""
    latest = -sys.float_info.max

    def departure(element: Root) -> float:
        nonlocal latest
        if element.tag not in _SORTED:
            return -math.inf
        time = depart_s(element)
        latest = latest if math.isnan(time) else time
        return latest

    return departure


class _Sorted:
    """Texts sorted by time; files hold sorted runs if they do not fit into memory."""

    def __init__(self) -> None:
        self._run: list[tuple[float, int, str]] = []
        self._runs: list[IO[str]] = []
        self._count = self._length = 0

    def add(self, rows: Iterable[tuple[float, str]]) -> None:
        """Add times and texts; texts of equal time keep their order."""
        for time, text in rows:
            self._run.append((time, self._count, text))
            self._count += 1
            self._length += len(text)
        if self._length > _RUN:
            with scratch():
                file = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - read later
                file.writelines(f"{json.dumps(row)}\n" for row in sorted(self._run))
                file.seek(0)
            self._runs.append(file)
            self._run, self._length = [], 0

    def __iter__(self) -> Iterator[str]:
        runs = [map(tuple[float, int, str], map(json.loads, file)) for file in self._runs]
        return (text for _, _, text in heapq.merge(*runs, sorted(self._run)))
