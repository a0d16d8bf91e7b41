"""Sheets of turning counts: one to fill in for a network, and one that shows the fit of vehicles.

Both are CSV files for a spreadsheet, with the names of streets, directions and turns beside SUMO's
names of roads. `counts.read_rows` reads what was filled in.
"""

from __future__ import annotations

import csv
import io
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ugat_marl.errors import ScenarioError
from ugat_marl.files import write_whole
from ugat_marl.scenarios.csv_tables import as_text, columns_of, delimiter_of
from ugat_marl.scenarios.junctions import Link, links_of
from ugat_marl.scenarios.network import lanes_of, streets_of
from ugat_marl.scenarios.street_names import NamedTurn, intersection_name, named_turns

FIT_SHEET = "counts-fit.csv"
"""Name of the sheet with the fit in a scenario's folder."""

NAMES = ("light", "intersection", "street", "approach", "turn", "to_street")
"""Columns of a sheet that are for its reader alone."""


@dataclass(frozen=True)
class CountFit:
    """A count and the vehicles that were found for it.

    Attributes:
        intersection: Streets that meet there; empty if they have no names, or it has no light.
        turn: The counted turn with its names; None for a road, or a turn without a light.
        roads: SUMO ids of the counted road, or of the two roads of the turn.
        begin_s: Start of the part of the count's interval that lies within the episode, s.
        end_s: End of that part, s.
        counted: Number of vehicles counted in it: the part's share of the count.
        driven: Number of vehicles of the scenario that depart in it and pass here.
        geh: GEH of the two as hourly flows.
    """

    intersection: str
    turn: NamedTurn | None
    roads: tuple[str, ...]
    begin_s: float
    end_s: float
    counted: float
    driven: int
    geh: float


class NamedNetwork:
    """Turns of all lights of a ``<net>`` with their names, agents or not."""

    def __init__(self, root: ET.Element) -> None:
        lanes, streets = lanes_of(root), streets_of(root)
        self._names: dict[str, str] = {}
        self._turns: dict[tuple[str, str], NamedTurn] = {}
        self._choices: list[NamedTurn] = []
        for light, links in sorted(links_of(root).items()):
            turns = named_turns(light, links, lanes, streets)
            self._names[light] = intersection_name(links, streets)
            self._turns.update(((turn.from_edge, turn.to_edge), turn) for turn in turns)
            driven = [link for link in links if link.cars]  # counts of cars alone are asked for
            ways = {(link.from_edge, link.to_edge) for link in driven}
            if _has_choice(driven):
                self._choices += [turn for turn in turns if (turn.from_edge, turn.to_edge) in ways]

    def turn(self, roads: Sequence[str]) -> NamedTurn | None:
        """Return the turn from the first road to the second; None if it has no light."""
        return self._turns.get((roads[0], roads[-1]))

    def intersection(self, light: str) -> str:
        """Return the streets that meet at a light."""
        return self._names[light]

    def choices(self) -> Sequence[NamedTurn]:
        """Return the turns of all lights but those of crossings on plain roads."""
        return self._choices


def _has_choice(links: Iterable[Link]) -> bool:
    """Return True if some road of a light leads to several others."""
    ahead: dict[str, set[str]] = defaultdict(set)
    for link in links:
        ahead[link.from_edge].add(link.to_edge)
    return any(len(roads) > 1 for roads in ahead.values())


def write_template(path: Path, root: ET.Element) -> int:
    """Write a sheet with a row for every turn of every light, its count left blank.

    Args:
        path: The CSV file.
        root: The ``<net>``.

    Returns:
        Number of rows.
    """
    network = NamedNetwork(root)
    rows = [
        (*_names(turn, network), "", "", "", turn.from_edge, turn.to_edge)
        for turn in network.choices()
    ]
    _write(path, (*NAMES, "count", "begin_s", "end_s", "from", "to"), rows)
    return len(rows)


def is_filled(path: Path) -> bool:
    """Return False if no count of a sheet has been filled in; True if it is no such sheet."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        reader = csv.DictReader(io.StringIO(text), delimiter=delimiter_of(text))
        if "count" not in columns_of(reader, path):
            return True
        return any((row.get("count") or "").strip() for row in reader)
    except (OSError, ValueError, csv.Error, ScenarioError):
        return True


def write_fit(path: Path, fits: Iterable[CountFit], network: NamedNetwork) -> None:
    """Write a sheet with a row for every count: counted, driven, GEH."""
    rows = [
        (
            *(_names(fit.turn, network) if fit.turn else ("",) * len(NAMES)),
            f"{fit.counted:g}", fit.driven, f"{fit.geh:.2f}", f"{fit.begin_s:g}", f"{fit.end_s:g}",
            fit.roads[0], fit.roads[-1] if len(fit.roads) > 1 else "",
        )
        for fit in fits
    ]  # fmt: skip
    columns = ("counted", "driven", "geh", "begin_s", "end_s", "from", "to")
    _write(path, (*NAMES, *columns), rows)


def _names(turn: NamedTurn, network: NamedNetwork) -> tuple[str, ...]:
    streets = (network.intersection(turn.light), turn.street, turn.to_street)
    names, street, to_street = map(as_text, streets)
    return (turn.light, names, street, turn.approach, turn.turn, to_street)


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    # Spreadsheets take a file without the mark for one in the encoding of the system.
    write_whole(path, text.getvalue().encode("utf-8-sig"))
