"""Edits of a scenario's files, part by part, in those files alone that an effect may concern."""

from __future__ import annotations

import heapq
import json
import math
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import IO

from ugat_marl.files import Draft, child_texts, scratch, xml_bytes
from ugat_marl.scenarios import Document, Scenario, seconds_of

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
_OVERLAP = 256
"""Bytes no text that is looked for is longer than."""
_RUN = 16 << 20
"""Characters of vehicles that are sorted in memory."""
_AT_ONCE = 1000

Root = ET.Element
Change = Callable[[Root], bool]
"""Edits some of a document's elements, below a root like its own, and says whether it did."""


def windows(document: Document) -> Iterator[bytes]:
    """Yield the bytes piece by piece, each with the end of the one before it."""
    window = b""
    for piece in document.pieces():
        window = window[-_OVERLAP:] + piece
        yield window


def mentions(document: Document, *texts: str) -> bool:
    """Return True if any of the texts occurs, or if only parsing could tell."""
    wanted = [text.encode() for text in texts]
    return any(
        window[:2] in (b"\xff\xfe", b"\xfe\xff")
        or b"\0" in window[:4]
        or any(text in window for text in wanted)
        for window in windows(document)
    )


def edit(
    documents: Iterable[Document], change: Change, *texts: str, in_order: bool = False
) -> tuple[Document, ...]:
    """Apply `change` to every document that mentions one of `texts`.

    Args:
        documents: What may be edited, however long.
        change: Called with the elements below the root, a part of them at a time.
        *texts: Documents without any of these are not even parsed.
        in_order: Whether vehicles may depart at other times now, and have to be sorted: SUMO leaves
            out those that stand behind a later one.
    """
    return tuple(
        _edited(document, change, in_order) if mentions(document, *texts) else document
        for document in documents
    )


def _edited(document: Document, change: Change, in_order: bool) -> Document:
    draft, changed = None, False
    departure, rows = _clock(), _Sorted()
    for part in document.parts():
        draft = draft or Draft(document.name.removesuffix(".gz"), part)
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
    scenario: Scenario, change: Change, *texts: str, applied: str, in_order: bool = False
) -> Scenario:
    """Apply `change` to additional files and routes, as `edit` does.

    Args:
        scenario: It does not change itself.
        change: As for `edit`.
        *texts: Documents without any of these are not even parsed.
        applied: What to note as applied.
        in_order: As for `edit`.
    """
    return replace(
        scenario,
        additional=edit(scenario.additional, change, *texts, in_order=in_order),
        routes=edit(scenario.routes, change, *texts, in_order=in_order),
        applied=(*scenario.applied, applied),
    )


def with_default_types(scenario: Scenario) -> Scenario:
    """Return the scenario with the default types in use declared, in its first additional file."""
    if scenario.additional and scenario.additional[0].name == DEFAULTS_FILE:
        return scenario
    declared: set[str] = set()
    named: set[str] = {DEFAULT_TYPES[0]}
    for document in (*scenario.additional, *scenario.routes):
        if not mentions(document, "DEFAULT_"):
            continue
        for item in document.scan():
            if item.name == "vType":
                declared.add(item.attributes.get("id", ""))
            named.add(item.attributes.get("type", ""))
            named.update(item.attributes.get("vTypes", "").split())
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
    """Return True if an element is a vehicle, trip or flow of the demand."""
    return item.tag in DEPARTING and not item.get("id", "").startswith(BLOCKERS)


def depart_s(item: Root) -> float:
    """Departure of a vehicle or trip, or begin of a flow; NaN if something else triggers it."""
    text = item.get("begin", "0") if item.tag.lower().endswith("flow") else item.get("depart", "")
    try:
        return seconds_of(text)
    except ValueError:
        return math.nan


def sort_departures(root: Root) -> None:
    """Put definitions first and then everything that departs, in order of time.

    One whose departure is triggered stays behind its predecessor.
    """
    root[:] = sorted(root, key=_clock())


def _clock() -> Callable[[Root], float]:
    """Return a function that gives the departure of each element in turn; -inf if it has none."""
    latest = -sys.float_info.max

    def departure(item: Root) -> float:
        nonlocal latest
        if item.tag not in _SORTED:
            return -math.inf
        time = depart_s(item)
        latest = latest if math.isnan(time) else time
        return latest

    return departure


class _Sorted:
    """Texts in the order of their times, however many: in runs that are kept in files."""

    def __init__(self) -> None:
        self._run: list[tuple[float, int, str]] = []
        self._runs: list[IO[str]] = []
        self._count = self._length = 0

    def add(self, rows: Iterable[tuple[float, str]]) -> None:
        """Take times and texts; of those of one time, the first stays first."""
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


def seconds_text(value: float) -> str:
    """Return a time as text for a file, to the millisecond, SUMO's own resolution."""
    return f"{value:.3f}".rstrip("0").rstrip(".")
