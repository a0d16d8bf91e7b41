"""Demand from counts on roads and turns, or from origins and destinations."""

from __future__ import annotations

import csv
import functools
import math
import re
import tempfile
import xml.etree.ElementTree as ET
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import ScenarioError, first_names, listed, nearest
from ugat_marl.files import chunks_of, parse_xml, read_bytes, read_xml, write_whole, xml_bytes
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.csv_tables import columns_of, delimiter_of, number_in, rows_of
from ugat_marl.scenarios.importers.count_sheet import (
    FIT_SHEET,
    NAMES,
    CountFit,
    NamedNetwork,
    write_fit,
)
from ugat_marl.scenarios.importers.long_files import lines
from ugat_marl.scenarios.importers.making import ROUTES, VehicleFiles, VehicleSource
from ugat_marl.scenarios.importers.streets import Streets, neighbours
from ugat_marl.scenarios.importers.turning_shares import (
    CAR,
    MOST_VEHICLES,
    Drive,
    walked,
    write_drives,
)
from ugat_marl.scenarios.network import free_flow_s, lanes_of
from ugat_marl.scenarios.scenario import COUNT_SHEET
from ugat_marl.scenarios.settings import parse_decimal
from ugat_marl.scenarios.sumo_tools import convert
from ugat_marl.seeding import numpy_generator

_CANDIDATES_VPH = 400.0
"""Random candidate routes drawn at each entry; routeSampler chooses among them."""
GOOD_GEH = 5.0
"""GEH below which a count is met (UK TAG unit M3.1)."""
_ASK_FOR_SHEET = "scenario new without vehicles writes a sheet with all turns at lights"
_MOST_ROWS = 1_000_000
"""Most rows of a table: about a thousand roads, ten days, intervals of 15 minutes."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table of demand.

    Attributes:
        roads: One road for a count, or two roads: a turn, or origin and destination.
        count: Number of vehicles.
        begin_s: Start of the interval of the count.
        end_s: End of the interval of the count.
        line: Line in the file.
        begin: Column and start as in the file, such as ``begin = 7:15``, for messages.
        end: The same of the end.
    """

    roads: tuple[str, ...]
    count: float
    begin_s: float
    end_s: float
    line: int
    begin: str = ""
    end: str = ""


_DAY_S = 86_400.0
_TIMES = {"begin": "begin_s", "end": "end_s"}
"""Columns of times of day, and those of seconds in whose place they stand."""
_INTERVAL = {*_TIMES, *_TIMES.values()}
_READ = ("edge", "from", "to", "count")
_LIKE_TIMES = re.compile(
    r"(begin|start|end|stop)[ _]?(s|sec|seconds|time|at)?|time([ _].*)?|interval|"
    r"(from|to)[ _](s|sec|time)"
)
"""Names under which other programs write the times of an interval, and mistyped ones."""


def read_rows(
    path: Path, begin_s: float, end_s: float, reporter: Reporter, *, pairs: bool
) -> list[Row]:
    """Read a CSV file with the column ``count`` and either ``edge`` or ``from`` and ``to``.

    The columns ``begin_s`` and ``end_s`` are optional. Without them a row covers the whole episode.
    They are on the scenario's clock, on which the episode starts at its own ``begin_s``. A time of
    day such as 07:15, perhaps with a date, counts from midnight; ``begin`` and ``end`` hold these.
    A row whose count is blank is left out: nothing was counted there.

    Args:
        path: The file.
        begin_s: Start of the episode, s.
        end_s: End of the episode, s.
        reporter: Shows progress if the file is long.
        pairs: True to require the columns ``from`` and ``to``.

    Raises:
        ScenarioError: A column is missing or a value is impossible; the message names the line.
    """
    texts = lines(path, reporter)
    first = next(texts, "")
    reader = csv.DictReader(chain((first,), texts), delimiter=delimiter_of(first))
    columns = columns_of(reader, path)
    turns = {"from", "to"} <= set(columns)
    _check_columns(columns, path, pairs=pairs)
    if others := [name for name in columns if name not in {*_INTERVAL, *_READ, *NAMES}]:
        reporter.say(f"note: {path.name}: {listed(others, 'column')} not read")
    rows_read: list[Row] = []
    written: dict[int, str] = {}
    total = 0.0
    date: str | None = None
    for values in rows_of(reader, path):
        counted = values.get("count")
        if counted is not None and not counted.strip():
            continue
        date = _one_date(values, date, f"{path}, line {reader.line_num}")
        row = _row(values, turns, (begin_s, end_s), reader.line_num, path)
        rows_read.append(row)
        if counted is not None and not counted.strip().isdigit():
            written[row.line] = counted.strip()
        total += row.count
        if len(rows_read) > _MOST_ROWS or total > MOST_VEHICLES:
            raise ScenarioError(
                f"{path}, line {row.line}: more than "
                + (f"{MOST_VEHICLES} vehicles" if total > MOST_VEHICLES else f"{_MOST_ROWS} rows")
                + "; keep those of the episode, or sum them up"
            )
    if not total:
        raise ScenarioError(f"{path}: no row counts a vehicle; fill in the column count")
    if not pairs:
        _refuse_thousands(written, path)
    timeless = [name for name, seconds in _TIMES.items() if not {name, seconds} & {*columns}]
    if pairs and len(timeless) != 1:
        for note in _notes_of_pairs(rows_read, written):
            reporter.say(f"note: {path.name}: {note}")
    else:
        _refuse_overlaps(rows_read, path, timeless, others)
    _refuse_all_outside(rows_read, path, begin_s, end_s)
    return rows_read


def _check_columns(columns: Sequence[str], path: Path, *, pairs: bool) -> None:
    """Refuse a table without a needed column, or with an interval that cannot be read.

    Args:
        columns: Names in the first line.
        path: The table.
        pairs: True to require the columns ``from`` and ``to``.
    """
    turns = {"from", "to"} <= set(columns)
    if times := [name for name in columns if name not in _INTERVAL and _LIKE_TIMES.fullmatch(name)]:
        raise ScenarioError(
            f"{path}, line 1: column {times[0]!r} is not known; the interval of a row is begin_s "
            "to end_s, in seconds, or begin to end, in times of day"
        )
    for name, seconds in _TIMES.items():
        if {name, seconds} <= set(columns):
            raise ScenarioError(f"{path}, line 1: has {name} and {seconds}; keep one of them")
    if "count" not in columns or not (turns or ("edge" in columns and not pairs)):
        wanted = "from, to and count" if pairs else "count and edge, or count, from and to"
        raise ScenarioError(
            f"{path}, line 1: the columns {wanted} are needed in the first line; there "
            f"are: {', '.join(columns)}"
        )


def _row(
    values: Mapping[str, str | None],
    turns: bool,
    episode: tuple[float, float],
    line: int,
    path: Path,
) -> Row:
    """Return a row of the table.

    Args:
        values: Column to cell.
        turns: True if the columns ``from`` and ``to`` name the roads.
        episode: Start and end of the episode, s, for rows without times.
        line: Line in the file.
        path: The file.
    """
    where = f"{path}, line {line}"
    roads = tuple((values[key] or "").strip() for key in (("from", "to") if turns else ("edge",)))
    if not all(roads):
        raise ScenarioError(
            f"{where}: a count without its road; fill it in, or delete the row if it is a total"
        )
    begin_s, end_s = (
        _time_s(values, key, usual, where) for key, usual in zip(_TIMES, episode, strict=True)
    )
    clock = ":" in f"{values.get('end')}{values.get('end_s')}"
    if clock and end_s <= begin_s and end_s + _DAY_S - begin_s <= _DAY_S / 2:
        end_s += _DAY_S  # until midnight, or past it
    begin, end = _written(values, "begin", begin_s), _written(values, "end", end_s)
    if end_s <= begin_s:
        raise ScenarioError(f"{where}: {end} is not after {begin}")
    count = _number(values.get("count"), "count", where)
    return Row(roads, count, begin_s, end_s, line, begin, end)


_GROUPED = re.compile(r"[1-9]\d{0,2}[.,]\d{3}", re.ASCII)
"""A number such as 1.250: a thousand and more, or a little more than one?"""


def _are_grouped(written: Mapping[int, str]) -> bool:
    """Return True if all counts that are no whole numbers may have a separator of thousands."""
    return bool(written) and all(map(_GROUPED.fullmatch, written.values()))


def _refuse_thousands(written: Mapping[int, str], path: Path) -> None:
    """Refuse counts with a separator of thousands, which reads as a decimal point.

    Args:
        written: Line to count, of those that are no whole numbers.
        path: The table.
    """
    if _are_grouped(written):
        line, text = next(iter(written.items()))
        raise ScenarioError(
            f"{path}, line {line}: count = {text!r} can be {re.sub('[.,]', '', text)} or a little "
            f"more than {re.split('[.,]', text)[0]}; write whole vehicles without a separator"
        )


def _refuse_all_outside(rows: Sequence[Row], path: Path, begin_s: float, end_s: float) -> None:
    """Refuse a table on another clock than the episode's."""
    if all(row.end_s <= begin_s or row.begin_s >= end_s for row in rows):
        first = min(rows, key=lambda row: row.begin_s)
        raise ScenarioError(
            f"{path}: all intervals lie outside of the episode ({begin_s:g} to {end_s:g} s), the "
            f"first begins at {first.begin_s:g} s (line {first.line}); --begin-s "
            f"{first.begin_s:g} lets the episode begin there"
        )


_CLOCK = re.compile(
    r"(?:(\d+[-./]\d+[-./]\d+)[ T]+)?(\d{1,2}):([0-5]\d)(?::([0-5]\d)(?:\.0*)?)?(?: ?([AP]M))?",
    re.ASCII | re.IGNORECASE,
)
"""A time of day such as 7:00, 07:00:00 or 7:00 AM, with a date before it or without."""


def _one_date(values: Mapping[str, str | None], before: str | None, where: str) -> str | None:
    """Return the date of the rows so far, None without any; refuse a second one."""
    for key in ("begin", "begin_s"):  # an interval may end at midnight, on the next date
        clock = _CLOCK.fullmatch((values.get(key) or "").strip())
        date = clock and clock[1]
        if date and before and date != before:
            raise ScenarioError(
                f"{where}: {key} is on {date}, and rows before it on {before}; a scenario has the "
                "vehicles of one day: keep the rows of one, or the means of all"
            )
        before = date or before
    return before


def _cell(values: Mapping[str, str | None], name: str) -> tuple[str, str]:
    """Return column and cell of a time of an interval, whose column of times of day is `name`."""
    of_day = (values.get(name) or "").strip()
    return (name, of_day) if of_day else (_TIMES[name], (values.get(_TIMES[name]) or "").strip())


def _written(values: Mapping[str, str | None], name: str, seconds: float) -> str:
    """Return column and time as in the file; its `seconds` where that is no time of day."""
    column, cell = _cell(values, name)
    return f"{column} = {cell if ':' in cell else f'{seconds:g}'}"


def _time_s(values: Mapping[str, str | None], name: str, usual: float, where: str) -> float:
    """Return a time of an interval, in s.

    Args:
        values: Column to cell.
        name: Name of the column of times of day, "begin" or "end".
        usual: The time of a blank cell, in s.
        where: File and line.
    """
    column, text = _cell(values, name)
    if clock := _CLOCK.fullmatch(text):
        hours, minutes, seconds = (int(part or 0) for part in clock.groups()[1:4])
        half = (clock[5] or "").upper()
        hour = hours % 12 + 12 * (half == "PM") if half else hours
        of_midnight = 3600 * hour + 60 * minutes + seconds
        if of_midnight <= _DAY_S and (not half or 1 <= hours <= 12):
            return float(of_midnight)
    if column == name:
        raise ScenarioError(
            f"{where}: {name} = {text!r} is not a time of day such as 07:15; seconds belong into "
            f"the column {_TIMES[name]}"
        )
    return _number(text, _TIMES[name], where) if text else usual


def _number(text: str | None, key: str, where: str) -> float:
    value = number_in(text)
    if not value >= 0:
        way_out = ""
        if key == "count":
            way_out = (
                "; leave it blank where nobody counted, and write thousands without a separator"
            )
        elif ":" in (text or ""):
            way_out = "; write seconds, or a time of day such as 07:15"
        raise ScenarioError(f"{where}: {key} = {text!r} is not a number of at least 0{way_out}")
    return value


def from_counts(path: Path, begin_s: float, length_s: float, seed: int) -> VehicleSource:
    """Return a source of vehicles that meet counts, with SUMO's routeSampler.

    routeSampler chooses among random routes through the network, and the shortest ones by counted
    roads and turns on none of them.

    Args:
        path: CSV file with the counts.
        begin_s: Start of the episode, s.
        length_s: Length of the episode, s.
        seed: Seed of the random routes and of routeSampler.
    """

    def vehicles(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
        rows = read_rows(path, begin_s, begin_s + length_s, reporter, pairs=False)
        root = read_xml(network)
        streets = Streets.of(root)
        _require_roads(rows, streets, path, network)
        _require_turns(rows, streets, path)
        with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
            work = Path(name)
            drives = walked(streets, _CANDIDATES_VPH, (1.0, 1.0, 1.0), 3600.0, seed)
            drives += list(_not_drawn(rows, drives, streets))
            _require_reached(rows, drives, path)
            write_drives(work / "candidates.rou.xml", drives)
            given, rows = rows, _closed(rows)
            filling = _filling(rows, begin_s)
            every = [*filling, *rows]
            grid_s = _grid_s(every, path)
            options = _counts_for_sumo(every, grid_s, work, seed)
            out = work / "sampled.rou.xml"
            begin, end = min(row.begin_s for row in every), max(row.end_s for row in every)
            convert(
                "routeSampler.py",
                ["-r", str(work / "candidates.rou.xml"), *options, "-o", str(out),
                 "--begin", str(begin), "--end", str(end), "--interval", f"{grid_s}",
                 "--seed", str(seed & 0x7FFFFFFF)],
                work,
            )  # fmt: skip
            sampled = list(_sampled(out))
        if not sampled:
            raise ScenarioError(f"{path}: SUMO's routeSampler found no vehicle for these counts")
        write_drives(folder / ROUTES, sorted(sampled, key=lambda d: (d.depart_s, d.id)))
        names = NamedNetwork(root)
        end_s = begin_s + length_s
        fits = _fits(rows, begin_s, end_s, sampled, names)
        write_fit(folder / FIT_SHEET, fits, names)
        write_whole(folder / COUNT_SHEET, b"".join(chunks_of(path)))
        notes = (
            _summary(fits, path),
            *_about_uncounted(rows, names, path),
            *_on_the_way(rows, sampled, root),
            *_about_ends(given, rows),
            *_about_times(rows, filling, path, begin_s, end_s),
        )
        return VehicleFiles((ROUTES,), notes, fits=fits)

    return vehicles


def _require_roads(rows: Iterable[Row], streets: Streets, path: Path, network: Path) -> None:
    for row in rows:
        for road in row.roads:
            if road not in streets.start:
                guess = nearest(road, streets.start)
                hint = f"did you mean {guess!r}?" if guess else _ASK_FOR_SHEET
                raise ScenarioError(
                    f"{path}, line {row.line}: {road!r} is not a road for cars of {network}; {hint}"
                )


def _require_turns(rows: Iterable[Row], streets: Streets, path: Path) -> None:
    """Refuse counts from a road to one that is not ahead of it."""
    for row in rows:
        for here, there in pairwise(row.roads):
            ahead = streets.ahead.get(here, {}).values()
            if not any(there in roads for roads in ahead):
                raise ScenarioError(
                    f"{path}, line {row.line}: no turn leads from {here} to {there}; --counts "
                    "takes turns at intersections, and --od counts between any two roads"
                )


def _refuse_overlaps(
    rows: Iterable[Row], path: Path, missing: Sequence[str], unread: Sequence[str]
) -> None:
    """Refuse counts that begin before an earlier one has ended: vehicles would count twice.

    Args:
        rows: Rows of the table.
        path: The table.
        missing: Times of an interval, "begin" or "end", without a column.
        unread: Columns that are not read; one of them may hold a missing time.
    """
    if not (found := next(_overlaps(rows), None)):
        return
    before, row = found
    where, roads = f"{path}, line {row.line}", " -> ".join(row.roads)
    if missing:
        guess = f" (is it {first_names([*map(repr, unread)])}?)" if unread else ""
        raise ScenarioError(
            f"{where}: {roads} is counted in line {before.line} as well, and there is no "
            f"column {missing[0]}{guess}; name the interval's columns begin and end for "
            "times of day, or begin_s and end_s for seconds"
        )
    raise ScenarioError(
        f"{where}: {row.begin} is before the end of an earlier interval of {roads}, "
        f"{before.end} (line {before.line}); write intervals that do not overlap, and no "
        "totals of several of them"
    )


def _overlaps(rows: Iterable[Row]) -> Iterator[tuple[Row, Row]]:
    """Yield rows that begin before an earlier one of their roads has ended, each behind that one.

    Of several earlier ones it is that which ends last.
    """
    latest: dict[tuple[str, ...], Row] = {}
    for row in sorted(rows, key=lambda row: (row.begin_s, row.line)):
        before = latest.get(row.roads)
        if before and row.begin_s < before.end_s - 1e-3:  # files hold milliseconds
            yield before, row
        if before is None or row.end_s > before.end_s:
            latest[row.roads] = row


def _notes_of_pairs(rows: Iterable[Row], written: Mapping[int, str]) -> Iterator[str]:
    """Yield notes on what is ambiguous in a table of origins and destinations, and may be meant.

    Args:
        rows: Rows of the table.
        written: Line to count, of those that are no whole numbers.
    """
    if _are_grouped(written):
        text = next(iter(written.values()))
        yield f"counts such as {text} were read as {parse_decimal(text):g} vehicles"
    if overlapping := list(_overlaps(rows)):
        before, row = overlapping[0]
        yield (
            "rows that overlap an earlier one of the same origin and destination, and add up: "
            f"{len(overlapping)} (the first: line {row.line}, with line {before.line})"
        )


def _not_drawn(rows: Iterable[Row], drives: Sequence[Drive], streets: Streets) -> Iterator[Drive]:
    """Yield the shortest way by each counted road or turn by which none of `drives` comes.

    Random drives never turn back, and in a large network miss some turns by chance.
    """
    onward, behind = neighbours(streets.ahead)
    drawn = _passages(drives)
    for row in rows:
        if row.count and row.roads not in drawn:
            before = _way(behind, row.roads[0], streets.entries)
            after = _way(onward, row.roads[-1], streets.exits)
            if before and after:
                joined = after[1:] if len(row.roads) == 1 else after
                yield Drive(f"by{row.line}", 0.0, (*before[::-1], *joined))


def _way(
    following: Mapping[str, Iterable[str]], start: str, goals: Collection[str]
) -> tuple[str, ...]:
    """Return the fewest roads from one to any of `goals`, with both ends; empty without a way."""
    reached = _reached(start, lambda road: following.get(road, ()))
    road = next((road for road in reached if road in goals), None)
    way: list[str] = []
    while road is not None:
        way.append(road)
        road = reached[road]
    return tuple(way[::-1])


def _reached(start: str, following: Callable[[str], Iterable[str]]) -> dict[str, str | None]:
    """Return the roads that are reached from one, the nearest first, with the road before each.

    Args:
        start: The first road; there is none before it.
        following: Function that returns the roads next to one.
    """
    reached: dict[str, str | None] = {start: None}
    waiting = deque([start])
    while waiting:
        here = waiting.popleft()
        for road in following(here):
            if road not in reached:
                reached[road] = here
                waiting.append(road)
    return reached


def _require_reached(rows: Iterable[Row], drives: Sequence[Drive], path: Path) -> None:
    reached = _passages(drives)
    for row in rows:
        if row.count and row.roads not in reached:
            raise ScenarioError(
                f"{path}, line {row.line}: no way through the network comes by "
                f"{' -> '.join(row.roads)}; leave the row out, or give routes (--routes)"
            )


_MINUTES_S = (300.0, 600.0, 900.0, 1800.0, 3600.0)
"""Usual lengths of intervals that are written in minutes, s."""


def _closed(rows: Sequence[Row]) -> list[Row]:
    """Return rows whose inclusive ends are moved to the begin of the next interval.

    Inclusive ends are one second before that begin (0 to 899, 900 to 1799), or one minute (7:00 to
    7:14, 7:15 to 7:29). A minute may also be a real gap. It is closed only between times of day,
    and if all intervals have one of `_MINUTES_S` with it. A gap of a second would be an interval of
    its own for routeSampler, which would not end. A minute would stay empty.
    """
    begins = sorted({row.begin_s for row in rows})
    gaps = {
        begins[place] - row.end_s
        for row in rows
        if (place := bisect_left(begins, row.end_s)) < len(begins)
    }
    every = {row.end_s - row.begin_s for row in rows}
    usual = len(every) == 1 and every.pop() + 60.0 in _MINUTES_S
    of_day = all(":" in row.end for row in rows)
    if gaps != {1.0} and not (gaps == {60.0} and usual and of_day):
        return list(rows)
    (gap_s,) = gaps
    lengths = {row.end_s - row.begin_s for row in rows if row.end_s + gap_s in begins}
    return [
        replace(row, end_s=row.end_s + gap_s) if row.end_s - row.begin_s in lengths else row
        for row in rows
    ]


_MOST_FILLING_S = 1800.0
"""Longest time before the first interval, s, that gets vehicles by itself: roads are full then."""


def _filling(rows: Sequence[Row], begin_s: float) -> list[Row]:
    """Return rows with the flow of the first interval for the whole minutes before it.

    They fill the roads. There are none where the episode begins with the first interval, or long
    before it.

    Args:
        rows: The counted rows.
        begin_s: Start of the episode, s.
    """
    first_s = min(row.begin_s for row in rows)
    before_s = (first_s - begin_s) // 60.0 * 60.0
    if not 0 < before_s <= _MOST_FILLING_S:
        return []
    return [
        replace(
            row,
            count=row.count * before_s / (row.end_s - row.begin_s),
            begin_s=first_s - before_s,
            end_s=first_s,
            line=-row.line,  # no two vehicles have one name
        )
        for row in rows
        if row.begin_s == first_s
    ]


_FINEST_S = 5.0
"""Shortest interval, s, into which counts are divided: routeSampler takes hours for less."""


def _grid_s(rows: Sequence[Row], path: Path) -> float:
    """Return the longest interval, in s, into which all intervals of rows divide.

    By itself routeSampler takes the shortest interval, and loses what does not divide into it.

    Raises:
        ScenarioError: It is shorter than `_FINEST_S`.
    """
    begin_s = min(row.begin_s for row in rows)
    times = {round(1000 * (time - begin_s)) for row in rows for time in (row.begin_s, row.end_s)}
    grid_s = math.gcd(*times) / 1000
    if grid_s < _FINEST_S:
        step = round(1000 * _FINEST_S)
        odd = next(
            row
            for row in rows
            if any(round(1000 * (time - begin_s)) % step for time in (row.begin_s, row.end_s))
        )
        raise ScenarioError(
            f"{path}, line {odd.line}: the interval {odd.begin_s:g} to {odd.end_s:g} s and the "
            f"others have no common step longer than {grid_s:g} s, and {_FINEST_S:g} s are the "
            "least; write begin_s and end_s in seconds, as 25200 for 7:00, and in whole minutes"
        )
    return grid_s


def _counts_for_sumo(rows: Sequence[Row], grid_s: float, work: Path, seed: int) -> list[str]:
    """Write the counts in routeSampler's format, as whole vehicles, and return its options.

    A row is parted into intervals of `grid_s` here: routeSampler would round each part down. Where
    the parts of a row are rounded up is drawn for each row: the sums of many small rows would come
    late in their interval otherwise.
    """
    turns = any(len(row.roads) > 1 for row in rows)
    by_time: dict[tuple[float, float], list[tuple[Row, int]]] = defaultdict(list)
    for row in rows:
        random = numpy_generator(seed, "counts", *row.roads, row.line)
        whole = _whole(row, random)
        parts = round((row.end_s - row.begin_s) / grid_s)
        offset = int(random.integers(parts))
        edges = [row.begin_s + part * grid_s for part in range(parts)] + [row.end_s]
        for part, span in enumerate(pairwise(edges)):
            before, by_then = ((n * whole + offset) // parts for n in (part, part + 1))
            by_time[span].append((row, by_then - before))
    root = ET.Element("data")
    for (begin, end), interval_rows in sorted(by_time.items()):
        interval = ET.SubElement(root, "interval", id="counts", begin=f"{begin}", end=f"{end}")
        for row, in_part in interval_rows:
            count = str(in_part)
            first, last = row.roads[0], row.roads[-1]
            if turns:
                ends = {"from": first, "to": last, "count": count}
                ET.SubElement(interval, "edgeRelation", ends)
            else:
                ET.SubElement(interval, "edge", id=first, entered=count)
    write_whole(work / "counts.xml", xml_bytes(root))
    if turns:
        return ["--turn-files", str(work / "counts.xml")]
    return ["--edgedata-files", str(work / "counts.xml"), "--edgedata-attribute", "entered"]


def _sampled(path: Path) -> Iterator[Drive]:
    for number, element in enumerate(read_xml(path).iter("vehicle")):
        route = element.find("route")
        if route is not None:
            edges = tuple(route.get("edges", "").split())
            yield Drive(f"{edges[0]}_{number}", float(element.get("depart", "0")), edges)


def _clipped(rows: Iterable[Row], begin_s: float, end_s: float) -> Iterator[Row]:
    """Yield the parts of rows within the episode, each with its share of the count.

    Args:
        rows: Rows of the table.
        begin_s: Start of the episode, s.
        end_s: End of the episode, s.
    """
    for row in rows:
        first_s, last_s = max(row.begin_s, begin_s), min(row.end_s, end_s)
        if first_s < last_s:
            share = (last_s - first_s) / (row.end_s - row.begin_s)
            yield replace(row, count=row.count * share, begin_s=first_s, end_s=last_s)


def _fits(
    rows: Iterable[Row],
    begin_s: float,
    end_s: float,
    drives: Sequence[Drive],
    names: NamedNetwork,
) -> tuple[CountFit, ...]:
    """Return the fit of the parts of rows within the episode.

    A part is left out if it is shorter than half of its interval and than half of `_USUAL_S`: in
    so short a time, a few vehicles more or less make a large GEH.

    Args:
        rows: Rows of the table.
        begin_s: Start of the episode, s.
        end_s: End of the episode, s.
        drives: Vehicles of the scenario.
        names: Names of the turns.
    """
    least_s = {row.line: min(row.end_s - row.begin_s, _USUAL_S) / 2 for row in rows}
    passed = _passages(drives)
    fits: list[CountFit] = []
    for row in _clipped(rows, begin_s, end_s):
        if row.end_s - row.begin_s < least_s[row.line]:
            continue
        departs = passed.get(row.roads, [])
        driven = bisect_left(departs, row.end_s) - bisect_left(departs, row.begin_s)
        hours = (row.end_s - row.begin_s) / 3600
        turn = names.turn(row.roads) if len(row.roads) > 1 else None
        fits.append(
            CountFit(
                names.intersection(turn.light) if turn else "",
                turn, row.roads, row.begin_s, row.end_s, row.count, driven,
                float(geh_of(np.array(row.count / hours), np.array(driven / hours))),
            )
        )  # fmt: skip
    return tuple(fits)


def geh_of(
    counted_vph: NDArray[np.float64], driven_vph: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``GEH = sqrt(2 (m - c)^2 / (m + c))`` of hourly flows; 0 where both are 0.

    Args:
        counted_vph: Flows c that were counted, vehicles per hour.
        driven_vph: Flows m of the model, vehicles per hour, of the same shape.

    Source:
        UK Department for Transport, Transport Analysis Guidance, unit M3.1.
    """
    total = counted_vph + driven_vph
    return np.sqrt(2 * (driven_vph - counted_vph) ** 2 / np.where(total > 0, total, 1.0))


def _summary(fits: Sequence[CountFit], path: Path) -> str:
    if not fits:
        return f"too little of every interval of {path.name} is within the episode for a GEH"
    good = sum(fit.geh < GOOD_GEH for fit in fits)
    return (
        f"{good} of {len(fits)} counts of {path.name} are met within a GEH of {GOOD_GEH:g}; "
        f"{FIT_SHEET} has them one by one"
    )


def _about_uncounted(rows: Iterable[Row], names: NamedNetwork, path: Path) -> list[str]:
    """Tell how many turns at lights have no count, where others have one."""
    turns = {(turn.from_edge, turn.to_edge) for turn in names.choices()}
    missing = turns - {pair for row in rows for pair in pairwise(row.roads)}
    if not missing or missing == turns:
        return []
    return [
        f"{len(missing)} of {len(turns)} turns at lights have no count in {path.name}; how many "
        "vehicles turn there is left to chance"
    ]


_LATE = 0.1
"""Share of the shortest interval above which the way from the entry to a count is told."""


def _on_the_way(rows: Sequence[Row], drives: Sequence[Drive], root: ET.Element) -> Iterator[str]:
    """Yield a note if vehicles reach counted places long after they depart.

    Counts are of vehicles that depart in the interval; a detector counts those that come by.
    """
    seconds = free_flow_s(lanes_of(root).values())
    counted_roads = {row.roads[0] for row in rows if row.count}
    longest_s = 0.0
    for drive in drives:
        at_s = 0.0
        for road in drive.route:
            at_s += seconds.get(road, 0.0)
            if road in counted_roads:
                longest_s = max(longest_s, at_s)
    if longest_s > _LATE * min(row.end_s - row.begin_s for row in rows):
        yield (
            f"intervals are of departures at the edge of the network: vehicles reach the end of "
            f"a counted road up to {longest_s:.0f} s later, even without traffic"
        )


def _passages(drives: Sequence[Drive]) -> dict[tuple[str, ...], list[float]]:
    """Map each road, and each turn between two roads, to the sorted departures of its vehicles."""
    passages: dict[tuple[str, ...], list[float]] = defaultdict(list)
    for drive in sorted(drives, key=lambda drive: drive.depart_s):
        for passed in chain(zip(drive.route, strict=True), pairwise(drive.route)):
            passages[passed].append(drive.depart_s)
    return passages


def from_od(path: Path, begin_s: float, length_s: float, seed: int) -> VehicleSource:
    """Return a source of vehicles from origins to destinations, on the fastest routes when empty.

    Args:
        path: CSV file with origins, destinations and counts.
        begin_s: Start of the episode, s.
        length_s: Length of the episode, s.
        seed: Seed of the departures and of duarouter.
    """

    def vehicles(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
        rows = read_rows(path, begin_s, begin_s + length_s, reporter, pairs=True)
        streets = Streets.of(read_xml(network))
        _require_roads(rows, streets, path, network)
        reachable = functools.cache(partial(_reachable, streets))
        for row in rows:
            if row.roads[1] not in reachable(row.roads[0]):
                raise ScenarioError(
                    f"{path}, line {row.line}: there is no way from {row.roads[0]!r} to "
                    f"{row.roads[1]!r}"
                )
        filling = _filling(rows, begin_s)
        _route(_trips([*filling, *rows], seed), network, folder / ROUTES, seed)
        notes = _about_times(rows, filling, path, begin_s, begin_s + length_s)
        return VehicleFiles((ROUTES,), tuple(notes))

    return vehicles


_USUAL_S = 900.0
"""Counts are of multiples of this time, s."""


def _about_ends(given: Sequence[Row], closed: Sequence[Row]) -> Iterator[str]:
    """Yield a note if `_closed` moved ends by a minute, which may have been without counts."""
    moved = [old for old, new in zip(given, closed, strict=True) if new.end_s - old.end_s > 1.0]
    if moved:
        yield (
            f"{len(moved)} intervals end a minute before the next one begins (the first: "
            f"{moved[0].end}); that minute is taken for theirs. If it was not counted, give their "
            "ends in seconds"
        )


def _about_times(
    rows: Sequence[Row], filling: Sequence[Row], path: Path, begin_s: float, end_s: float
) -> Iterator[str]:
    """Yield notes on vehicles before the first interval, outside, and spread over an odd time.

    Args:
        rows: Rows of the table.
        filling: Rows that `_filling` adds to them.
        path: The table.
        begin_s: Start of the episode, s.
        end_s: End of the episode, s.
    """
    first_s = min(row.begin_s for row in rows)
    if filling:
        yield (
            f"vehicles with the flow of the first interval fill the roads from "
            f"{filling[0].begin_s:g} to {first_s:g} s; they are not among the counts"
        )
    elif first_s - begin_s > _MOST_FILLING_S:
        yield (
            f"no vehicle drives before {first_s:g} s, where the first interval begins; with "
            f"--begin-s {first_s - 600:g} vehicles fill the roads for ten minutes before it"
        )
    spread = [row for row in rows if (row.begin_s, row.end_s) == (begin_s, end_s)]
    if spread and (end_s - begin_s) % _USUAL_S:
        yield (
            f"{path.name}: rows without begin_s and end_s are of the whole episode, "
            f"{end_s - begin_s:g} s; fill in both if their counts are of another time, as an hour"
        )
    yield from _outside(rows, path, begin_s, end_s)


def _outside(rows: Sequence[Row], path: Path, begin_s: float, end_s: float) -> Iterator[str]:
    """Yield a note if intervals lie outside of the episode, since their vehicles never drive.

    Args:
        rows: Rows of the table.
        path: The table.
        begin_s: Start of the episode, s.
        end_s: End of the episode, s.
    """
    total = sum(row.count for row in rows)
    lost = total - sum(row.count for row in _clipped(rows, begin_s, end_s))
    if lost >= 0.5:
        yield (
            f"{lost:.0f} of the {total:.0f} vehicles of {path.name} are outside of the episode "
            f"({begin_s:g} to {end_s:g} s) and never drive; begin_s and end_s of the rows are on "
            "the clock of --begin-s, and --duration-s makes the episode longer"
        )


def _whole(row: Row, random: np.random.Generator) -> int:
    """Round a count up or down at random, so that its expectation is the count."""
    return int(row.count) + int(random.random() < row.count % 1)


def _trips(rows: Iterable[Row], seed: int) -> bytes:
    trips: list[tuple[float, str, tuple[str, ...]]] = []
    for row in rows:
        random = numpy_generator(seed, "od", *row.roads, row.line)
        whole = _whole(row, random)
        departs = np.sort(row.begin_s + random.random(whole) * (row.end_s - row.begin_s))
        name = "_".join(row.roads)
        trips += [(float(t), f"{name}_{row.line}.{i}", row.roads) for i, t in enumerate(departs)]
    root = ET.Element("routes")
    ET.SubElement(root, "vType", CAR)
    for depart, name, (start, goal) in sorted(trips):
        ends = {"from": start, "to": goal, "departLane": "best", "departSpeed": "max"}
        ET.SubElement(root, "trip", {"id": name, "type": "car", "depart": f"{depart:.2f}"} | ends)
    return xml_bytes(root)


def _route(trips: bytes, network: Path, out: Path, seed: int) -> None:
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        work = Path(name)
        write_whole(work / "trips.xml", trips)
        (work / "network.net.xml").write_bytes(read_bytes(network))
        convert(
            "duarouter",
            ["--net-file", str(work / "network.net.xml"),
             "--route-files", str(work / "trips.xml"), "--output-file", str(work / "out.rou.xml"),
             "--no-step-log", "true", "--seed", str(seed & 0x7FFFFFFF)],
            work,
        )  # fmt: skip
        root = parse_xml(read_bytes(work / "out.rou.xml"), "duarouter")
        write_whole(out, xml_bytes(root))


def _reachable(streets: Streets, start: str) -> Collection[str]:
    return _reached(start, lambda road: chain(*streets.ahead.get(road, {}).values()))
