"""Fixed-time plans from files in UTDF, the exchange format of Synchro (combined CSV, version 8).

Read are ``[Lanes]`` (the phases of every movement), ``[Timeplans]`` (cycle and offset) and
``[Phases]`` (rings, barriers and times in seconds). A split is MaxGreen + Yellow + AllRed.

Source: Trafficware, Synchro Studio User Guide, chapter on UTDF.
"""

from __future__ import annotations

import csv
import io
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios.csv_tables import delimiter_of, with_point
from ugat_marl.scenarios.network import Intersection, Network
from ugat_marl.scenarios.settings import parse_decimal
from ugat_marl.scenarios.signal_plans import (
    LONGEST_S,
    PlanPhase,
    SignalPlan,
    check_plan,
    movement_codes,
    phase_times,
    text_of_table,
)

_SECTIONS = ("lanes", "timeplans", "phases")
_PHASE_RECORDS = tuple(f"{kind}{n}" for kind in ("Phase", "PermPhase") for n in (1, 2, 3, 4))
_JOINED = {"R": "TL", "L": "TR", "T": "LR", "U": "LTR"}
"""Turn without a phase of its own to the turns of its approach whose phases it uses."""

Cell = tuple[str, int]
"""Text of a value and its line."""


@dataclass(frozen=True)
class _Node:
    """Records of one intersection: record to column to value."""

    lanes: dict[str, dict[str, Cell]] = field(default_factory=dict[str, dict[str, Cell]])
    timing: dict[str, dict[str, Cell]] = field(default_factory=dict[str, dict[str, Cell]])
    phases: dict[str, dict[str, Cell]] = field(default_factory=dict[str, dict[str, Cell]])


def is_utdf(path: Path) -> bool:
    """Return True if a table has the sections of UTDF."""
    return any(line.strip(' ,;\t"').startswith("[") for line in text_of_table(path).splitlines())


def read_utdf(
    path: Path, network: Network, lights: Mapping[str, str]
) -> tuple[tuple[SignalPlan, ...], tuple[str, ...]]:
    """Read the plans of all intersections that have a light in the network.

    Args:
        path: The file.
        network: The network.
        lights: Intersection of the file (INTID) to SUMO's id of its light. Other intersections are
            the lights of the same id. Empty also if there is one of each.

    Returns:
        The plans, and notes for the user.

    Raises:
        ScenarioError: The file is not UTDF or a value in it is impossible; the message names the
            line. Or it is not known which light an intersection is.
    """
    nodes = _nodes(path)
    known = {light.id: light for light in network.intersections}
    matched = _matched(nodes, known, lights, path)
    plans: list[SignalPlan] = []
    notes: list[str] = []
    for name, light in matched.items():
        plan, more = _plan(nodes[name], known[light], network, f"{path}: intersection {name}")
        check_plan(plan, str(path))
        plans.append(plan)
        notes += more
    if left := [name for name in nodes if name not in matched]:
        notes.append(f"intersections {', '.join(left)} of {path.name} have no light here")
    return tuple(plans), tuple(notes)


def _nodes(path: Path) -> dict[str, _Node]:
    nodes: dict[str, _Node] = defaultdict(_Node)
    section, columns = "", list[str]()
    text = text_of_table(path)
    lines = text.splitlines()
    heads = (line for line in lines if line.strip(' "').upper().startswith("RECORDNAME"))
    delimiter = delimiter_of(next(heads, ""))
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if delimiter != ",":
                cells = [with_point(cell) for cell in cells]
            if not any(cells):
                continue
            if cells[0].startswith("["):
                section, columns = cells[0].strip("[]").lower(), []
            elif cells[0].upper() == "RECORDNAME":
                columns = [cell.upper() for cell in cells]
            elif section in _SECTIONS and columns:
                values = dict(zip(columns, ((c, reader.line_num) for c in cells), strict=False))
                name = values.get("INTID", ("", 0))[0]
                node = nodes[name]
                records = {"lanes": node.lanes, "timeplans": node.timing, "phases": node.phases}
                record = cells[0].lower()
                _refuse_other_plan(records[section].get(record), values, name, path)
                records[section][record] = values
    except csv.Error as error:
        raise ScenarioError(f"{path}, line {reader.line_num + 1}: not CSV ({error})") from None
    timed = {name: node for name, node in nodes.items() if "brp" in node.phases}
    if not timed:
        raise ScenarioError(
            f"{path}: not a file of UTDF with signal plans (no record BRP in a section [Phases]); "
            "export it from Synchro as combined UTDF, or write the table of ugat-marl plan"
        )
    return timed


def _refuse_other_plan(
    before: Mapping[str, tuple[str, int]] | None,
    now: Mapping[str, tuple[str, int]],
    name: str,
    path: Path,
) -> None:
    """Refuse a record that is there twice with other values: the file holds several plans."""
    for column, (text, line) in now.items():
        earlier, its_line = (before or {}).get(column, (text, 0))
        if earlier != text:
            raise ScenarioError(
                f"{path}, line {line}: {column} of {now['RECORDNAME'][0]} at intersection {name} "
                f"is {text!r} here and {earlier!r} in line {its_line}; a file holds one plan for "
                "an intersection: export each plan by itself"
            )


def _matched(
    nodes: Mapping[str, _Node],
    known: Mapping[str, Intersection],
    lights: Mapping[str, str],
    path: Path,
) -> dict[str, str]:
    """Return the intersections of the file that have a light, each with its light."""
    for name, light in lights.items():
        if name not in nodes:
            raise ScenarioError(
                f"--lights {name}={light}: {path} has no plan for an intersection {name!r}; it has "
                f"{', '.join(nodes)}"
            )
        if light not in known:
            raise ScenarioError(
                f"--lights {name}={light}: {light!r} is not an agent of the scenario; its agents "
                f"are {', '.join(known)}"
            )
    taken = set(lights.values())
    same = {
        name: name for name in nodes if name in known and name not in lights and name not in taken
    }
    if lights:
        return {**same, **lights}
    if not same and len(nodes) == len(known) == 1:
        same = dict(zip(nodes, known, strict=True))
    if not same:
        raise ScenarioError(
            f"{path}: which intersection is which light? Give --lights, as in "
            f"{next(iter(nodes))}={next(iter(known))}; the file has {', '.join(nodes)}, the "
            f"scenario {', '.join(known)}"
        )
    return same


def _plan(
    node: _Node, light: Intersection, network: Network, where: str
) -> tuple[SignalPlan, list[str]]:
    codes = set(movement_codes(light, network).values())
    served = _movements(node, where)
    notes = [
        f"light {light.id!r}: {code} has a phase in the file and no way in the network; left out"
        for code in sorted(set(served) - codes)
    ]
    by_phase: dict[int, list[str]] = defaultdict(list)
    for code in sorted(codes):
        own = served.get(code) or _borrowed(code, served)
        if own and code not in served and code[2] != "R":
            listed = " and ".join(map(str, own))
            notes.append(
                f"light {light.id!r}: {code} has no phase in the file; it goes with another turn "
                f"of its approach, in phase {listed}"
            )
        if not own:
            raise ScenarioError(
                f"{where}: {code} has no phase in the file, nor has another turn of its approach; "
                f"light {light.id!r} has this movement"
            )
        for number in own:
            by_phase[number].append(code)
    phases: list[tuple[int, int, PlanPhase]] = []
    for column, (text, line) in node.phases["brp"].items():
        if not re.fullmatch(r"D[0-9]+", column) or not text:
            continue
        place = _whole(_number(text, "BRP", where, line), "BRP", where)
        if place and not (111 <= place <= 999 and place // 10 % 10):
            raise ScenarioError(
                f"{where}, line {line}: BRP {place} of phase {column[1:]} is not barrier, ring and "
                "position, one digit each from 1"
            )
        number = int(column[1:])
        times = [_time(node, record, column, where) for record in ("maxgreen", "yellow", "allred")]
        if place and times[0]:
            movements = tuple(by_phase.pop(number, ()))
            phase = PlanPhase(place // 10 % 10, place // 100, movements, sum(times), *times[1:])
            phases.append((place, number, phase))
    if missing := sorted(by_phase):
        raise ScenarioError(
            f"{where}: {' '.join(by_phase[missing[0]])} belongs to phase {missing[0]}, which has "
            "no BRP or no MaxGreen in [Phases]"
        )
    phases.sort(key=lambda item: item[0])
    cycle_s = _setting(node, "cycle length", where)
    plan = SignalPlan(light.id, cycle_s, 0.0, tuple(phase for *_, phase in phases))
    check_plan(plan, where)
    offset_s = _setting(node, "offset", where) - _reference_s(node, plan, phases, where)
    return replace(plan, offset_s=offset_s % cycle_s), notes


def _movements(node: _Node, where: str) -> dict[str, list[int]]:
    """Return the phases of each movement with a phase of its own."""
    served: dict[str, list[int]] = defaultdict(list)
    for record in _PHASE_RECORDS:
        for column, (text, line) in node.lanes.get(record.lower(), {}).items():
            code = column.rstrip("2")
            if len(code) == 3 and code[2] in "LTRU" and text:
                number = _whole(_number(text, record, where, line), record, where)
                if number > 0 and number not in served[code]:
                    served[code].append(number)
    return {code: phases for code, phases in served.items() if phases}


def _borrowed(code: str, served: Mapping[str, Sequence[int]]) -> Sequence[int]:
    """Return the phases that a turn without one shares with its approach."""
    others = (served.get(code[:2] + turn, ()) for turn in _JOINED[code[2]])
    return next((phases for phases in others if phases), ())


def _reference_s(
    node: _Node, plan: SignalPlan, phases: Iterable[tuple[int, int, PlanPhase]], where: str
) -> float:
    """Return the time in the cycle to which the offset refers, s."""
    kind = _whole(_setting(node, "referenced to", where, 0.0), "Referenced To", where)
    number = _whole(_setting(node, "reference phase", where, 0.0), "Reference Phase", where)
    wanted = {number % 100, number // 100} - {0}
    if wanted and not wanted & {own for _, own, _ in phases}:
        raise ScenarioError(
            f"{where}: Reference Phase = {number}: the plan has no such phase, so that its offset "
            "cannot be known; choose one of its phases in Synchro"
        )
    times = {own: span for (_, own, _), span in zip(phases, phase_times(plan), strict=True)}
    spans = [span for own, span in times.items() if own in wanted] or [next(iter(times.values()))]
    if kind == 0:
        return max(begin for begin, _, _ in spans)
    if kind in (1, 2, 3):
        return min(span[{1: 1, 2: 2, 3: 0}[kind]] for span in spans)
    raise ScenarioError(
        f"{where}: Referenced To = {kind}: offsets are read that refer to the start of green (0, "
        "3), yellow (1) or red (2); choose one of these in Synchro"
    )


def _setting(node: _Node, record: str, where: str, default: float | None = None) -> float:
    text, line = node.timing.get(record, {}).get("DATA", ("", 0))
    if not text and default is not None:
        return default
    return _number(text, record.title(), where, line)


def _time(node: _Node, record: str, column: str, where: str) -> float:
    text, line = node.phases.get(record, {}).get(column, ("", 0))
    value = _number(text, record, where, line) if text else 0.0
    if not 0 <= value <= LONGEST_S:
        raise ScenarioError(
            f"{where}, line {line}: {record} = {text!r} is not a time of 0 to {LONGEST_S:g} s"
        )
    return value


def _whole(value: float, record: str, where: str) -> int:
    if value != int(value):
        raise ScenarioError(f"{where}: {record} = {value:g} is not a whole number")
    return int(value)


def _number(text: str, record: str, where: str, line: int) -> float:
    try:
        return parse_decimal(text)
    except ValueError:
        place = f", line {line}" if line else ""
        raise ScenarioError(
            f"{where}{place}: {record} = {text!r} is not a number"
            + ("" if text else "; the record is missing")
        ) from None
