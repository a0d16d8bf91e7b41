"""Import of high-resolution logs of signal controllers (ATSPM) as measured data.

The event codes are those of the "Indiana Traffic Signal Hi Resolution Data Logger Enumerations"
(Purdue University, https://docs.lib.purdue.edu/jtrpdata/4/). UDOT's ATSPM lists them in
``Atspm/Data/Enums/IndianaEnumerations.cs`` (github.com/utahudot/udot-atspm). ODOT's package `atspm`
uses them in ``src/atspm/queries/timeline.sql`` (github.com/ShawnStrasser/atspm).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.atspm_mapping import AtspmMapping, Device, Span, read_mapping
from ugat_marl.data.measured.coverage import coverage
from ugat_marl.data.measured.local_time import LocalClock, local_times
from ugat_marl.data.measured.passages import passages_of
from ugat_marl.data.measured.reading import detectors_of, periods_of, signals_of
from ugat_marl.data.measured.tables import (
    CLOCK_JUMP_S,
    DETECTORS,
    PERIODS,
    ROW,
    clock_steps,
    frame_of,
    in_order,
    read_raw,
    refuse,
    refuse_set_back,
    to_numbers,
    to_texts,
    with_period,
)
from ugat_marl.data.measured.values import Finding, MeasuredData, first_row
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import (
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    deciding_letter,
    signal_widths,
)

GREEN, YELLOW, RED = "G", "y", "r"

PHASE_EVENTS = {1: GREEN, 8: YELLOW, 9: RED, 10: RED, 11: RED, 12: RED}
"""Begin green, begin yellow, end yellow, begin and end red clearance, phase inactive. A red
clearance is logged only if it is served, so the end of yellow counts as red."""
OVERLAP_EVENTS = {61: GREEN, 62: GREEN, 63: YELLOW, 64: RED, 65: RED, 66: RED}
"""Begin green, begin trailing green, begin yellow, begin red clearance, off, dark."""
ARROW_EVENTS = {32: GREEN, 33: RED}
"""Begin and end of a flashing yellow arrow. Vehicles may turn on it but must yield."""
BEFORE = {
    1: RED,
    8: GREEN,
    9: YELLOW,
    10: YELLOW,
    61: RED,
    62: GREEN,
    63: GREEN,
    64: YELLOW,
    32: RED,
    33: GREEN,
}
"""Colour shown before an event, if it is certain."""
DETECTOR_OFF, DETECTOR_ON = 81, 82
"""The parameter is the detector channel. Times include the controller's delay and extension."""
DETECTOR_FAULTS = (84, 85, 86, 87, 88)
CLOCK_UPDATED = 181

# Column names of ODOT's package atspm and of UDOT's Controller_Event_Log.
_NAMES = {
    "timestamp": "time",
    "deviceid": "device",
    "signalid": "device",
    "locationidentifier": "device",
    "eventid": "event",
    "eventcode": "event",
    "parameter": "parameter",
    "eventparam": "parameter",
    "eventparameter": "parameter",
}

ZONE = "the mapping, as time_zone"
"""Place at which the street's time zone is given, for messages."""
LOOK_BACK_S = 3600.0
"""Time before a period from which events are read, to know the signal state at its start."""

Source = tuple[str, int]
"""``("phase", 2)``, ``("overlap", 1)`` or ``("arrow", 5)``."""

_CODES = {"phase": PHASE_EVENTS, "overlap": OVERLAP_EVENTS, "arrow": ARROW_EVENTS}
_KIND = {code: kind for kind, codes in _CODES.items() for code in codes}
_COLOUR = PHASE_EVENTS | OVERLAP_EVENTS | ARROW_EVENTS
# Among events at one moment, the end of the old colour comes before the start of the new one.
_RANK = {RED: 0, GREEN: 1, YELLOW: 2}


@dataclass(frozen=True)
class _Event:
    """Change of colour of a phase, overlap or arrow."""

    time_s: float
    source: Source
    code: int

    @property
    def colour(self) -> str:
        return _COLOUR[self.code]


def import_atspm(events: Path, mapping: Path, scenario: Scenario, network: Network) -> MeasuredData:
    """Read a controllers' log as measured data.

    Args:
        events: CSV or Parquet file with TimeStamp, DeviceId, EventId and Parameter.
        mapping: TOML file that maps devices to traffic lights, phases and overlaps to links,
            channels to detectors, and local time to the scenario's clock
            (``docs/reference/measured-data.md``).
        scenario: Scenario with the clock of the data.
        network: Network of the scenario.

    Raises:
        MeasuredDataError: The log or the mapping cannot be read, they contradict each other, or
            they do not fit the network.
    """
    events, mapping = Path(events), Path(mapping)
    findings: list[Finding] = []
    widths = signal_widths(scenario)
    driven = {
        intersection.id: {link.index for link in intersection.links}
        for intersection in network.intersections
    }
    table = read_mapping(mapping, widths, driven)
    spans = table.spans()
    periods = _periods(mapping, spans, scenario)
    names = pl.Series([period.id for period in periods])
    zeros = pl.Series("zero", [str(span.zero) for span in spans])
    begins_s = pl.Series([period.begin_s for period in periods])
    clock = LocalClock.of(mapping, names, begins_s, zeros, table.time_zone, ZONE)
    detectors = detectors_of(mapping, _zones(table), network)
    log = read_log(events, table.time_zone, findings)
    _refuse_overlap(mapping, periods, clock.zeros_of(log["time"]))
    known = log.filter(pl.col("device").is_in([device.id for device in table.devices]))
    if known.is_empty():
        raise MeasuredDataError(
            f"{events}: no event of a device in {mapping.name}; the log is of "
            f"{', '.join(map(repr, log['device'].unique().sort().to_list()[:8]))}"
        )
    latencies = [zone.latency_s for device in table.devices for zone in device.detectors]
    stamped = _in_periods(events, known, clock, periods, max(latencies, default=0.0))
    rows = stamped.filter(pl.col("time_s") <= pl.col("end_s"))
    _report(events, rows, table, findings)
    signals = _signals(events, rows, table, periods, network, widths, findings)
    stamps = _detections(stamped, table)
    if stamps.is_empty():
        raise MeasuredDataError(
            f"{events}: no detector event (81, 82) of a channel in {mapping.name}; check the "
            "channels"
        )
    passages, broken = passages_of(
        events, with_period(events, stamps, periods, findings), periods, detectors, findings
    )
    _require_each(events, mapping, periods, signals, passages)
    measured = MeasuredData(
        tuple(detector for detector in detectors if detector.id not in broken),
        tuple(
            replace(period, signals=shown, passages=seen)
            for period, shown, seen in zip(periods, signals, passages, strict=True)
        ),
    )
    findings += coverage(measured, scenario, network)
    return replace(measured, findings=tuple(findings))


def _require_each(
    events: Path,
    mapping: Path,
    periods: Sequence[Period],
    signals: Sequence[Mapping[str, SignalLog]],
    passages: Sequence[Mapping[str, Passages]],
) -> None:
    """Refuse a period of which the log has nothing, as reading the result would.

    Raises:
        MeasuredDataError: A period has no detections, or no signals where others have some.
    """
    for what, parts in (("detector", passages), ("signal", signals)):
        for period, part in zip(periods, parts, strict=True):
            if not part and any(parts):
                raise MeasuredDataError(
                    f"{events}: no {what} event in period {period.id!r}; leave this period out of "
                    f"{mapping.name}"
                )


def _periods(path: Path, spans: Sequence[Span], scenario: Scenario) -> tuple[Period, ...]:
    begin = scenario.settings.begin_s
    end = begin + scenario.settings.duration_s
    rows = [
        (
            span.id,
            begin if span.begin_s is None else span.begin_s,
            end if span.end_s is None else span.end_s,
            span.split,
        )
        for span in spans
    ]
    return periods_of(path, _numbered(frame_of(PERIODS, rows)), scenario)


def _refuse_overlap(path: Path, periods: Sequence[Period], zeros: Mapping[str, datetime]) -> None:
    """Refuse periods that have some time in common.

    Args:
        path: The mapping.
        periods: The periods.
        zeros: Time at which the scenario's clock is 0 in each.

    Raises:
        MeasuredDataError: Two periods overlap.
    """
    first = zeros[periods[0].id]
    later = [(zeros[period.id] - first).total_seconds() for period in periods]
    real = sorted(
        (zero + p.begin_s, zero + p.end_s, p.id) for zero, p in zip(later, periods, strict=True)
    )
    for (_, ends, one), (begins, _, other) in zip(real, real[1:], strict=False):
        if begins < ends:
            raise MeasuredDataError(
                f"{path}: the periods {one!r} and {other!r} overlap by {ends - begins:g} s; the "
                "same vehicles would count twice"
            )


def _zones(table: AtspmMapping) -> pl.DataFrame:
    rows = [
        (
            detector.id or f"{device.id}:{detector.channel}",
            detector.lane,
            detector.position_m,
            detector.length_m,
            detector.kind,
            None,  # controllers log no speeds
            "signals",
        )
        for device in table.devices
        for detector in device.detectors
    ]
    return _numbered(frame_of(DETECTORS, rows))


def _numbered(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.int_range(1, pl.len() + 1, dtype=pl.Int64).alias(ROW))


def _in_periods(
    path: Path,
    log: pl.DataFrame,
    clock: LocalClock,
    periods: Sequence[Period],
    late_s: float,
) -> pl.DataFrame:
    """Return the events in and shortly before each period.

    Args:
        path: The log.
        log: Its events.
        clock: Times at which the scenario's clock is 0 in each period.
        periods: The periods.
        late_s: Greatest delay of a stamp, s; events that much after a period are kept.

    Returns:
        The events with ``period_id``, ``begin_s`` and ``end_s`` of the period, and ``time_s``.
    """
    parts: list[pl.DataFrame] = []
    for period in periods:
        names = pl.repeat(period.id, log.height, eager=True)
        part = log.with_columns(
            pl.lit(period.id).alias("period_id"),
            pl.lit(period.begin_s).alias("begin_s"),
            pl.lit(period.end_s).alias("end_s"),
            clock.seconds(path, log["time"], names, first_row(path)),
        ).filter(pl.col("time_s").is_between(period.begin_s - LOOK_BACK_S, period.end_s + late_s))
        if part.filter(pl.col("time_s").is_between(period.begin_s, period.end_s)).is_empty():
            raise MeasuredDataError(
                f"{path}: no event in period {period.id!r}, of which second 0 is "
                f"{clock.zeros[period.id]}; the log goes from {log['time'].min()} to "
                f"{log['time'].max()}"
            )
        parts.append(part)
    return pl.concat(parts)


def _report(path: Path, rows: pl.DataFrame, table: AtspmMapping, findings: list[Finding]) -> None:
    """Add findings on faults that the log reports: clocks that were set, and broken detectors."""
    rows = rows.filter(pl.col("begin_s") <= pl.col("time_s"))  # not of the hour before
    updates = rows.filter(pl.col("event") == CLOCK_UPDATED)
    if updates.height:
        names = ", ".join(map(repr, updates["device"].unique().sort().to_list()[:6]))
        times = "once" if updates.height == 1 else f"{updates.height} times"
        findings.append(
            Finding(
                f"{path.name}: the clock of {names} was set {times} (event 181); times around it "
                "may jump by seconds"
            )
        )
    faults = rows.filter(pl.col("event").is_in(DETECTOR_FAULTS))
    for device in table.devices:
        faulty = faults.filter(pl.col("device") == device.id)["parameter"].to_list()
        broken = sorted({detector.channel for detector in device.detectors} & set(faulty))
        if broken:
            findings.append(
                Finding(
                    f"{path.name}: device {device.id!r} reports faults (events 84 to 88) of its "
                    f"channels {', '.join(map(str, broken))}"
                )
            )


def _detections(rows: pl.DataFrame, table: AtspmMapping) -> pl.DataFrame:
    """Return detector events as rows of ``detections``.

    An event belongs to the period in which it happened, which may end before its stamp.
    """
    zones = pl.DataFrame(
        [
            (
                device.id,
                detector.channel,
                detector.id or f"{device.id}:{detector.channel}",
                detector.latency_s,
            )
            for device in table.devices
            for detector in device.detectors
        ],
        schema={
            "device": pl.String,
            "parameter": pl.Int64,
            "detector_id": pl.String,
            "latency_s": pl.Float64,
        },
        orient="row",
    )
    passed = rows.filter(pl.col("event").is_in([DETECTOR_OFF, DETECTOR_ON]))
    passed = passed.join(zones, on=["device", "parameter"], maintain_order="left")
    passed = passed.with_columns((pl.col("time_s") - pl.col("latency_s")).round(3))
    return passed.filter(pl.col("time_s").is_between("begin_s", "end_s")).select(
        ROW,
        "period_id",
        "time_s",
        "detector_id",
        pl.when(pl.col("event") == DETECTOR_ON)
        .then(pl.lit("on"))
        .otherwise(pl.lit("off"))
        .alias("event"),
        pl.lit(None, pl.Float64).alias("speed_mps"),
        pl.lit(None, pl.Float64).alias("length_m"),
    )


def _signals(
    path: Path,
    rows: pl.DataFrame,
    table: AtspmMapping,
    periods: Sequence[Period],
    network: Network,
    widths: Mapping[str, int],
    findings: list[Finding],
) -> tuple[dict[str, SignalLog], ...]:
    shown: list[tuple[str, float, str, str]] = []
    programmes = {intersection.id: intersection.programme for intersection in network.intersections}
    for device in table.devices:
        links = _links(device, widths[device.tls], programmes.get(device.tls, ()))
        sources = {source for link_sources in links for source, _ in link_sources}
        silent = set(sources)
        for period in periods:
            events = _events(path, rows, device, period, sources, findings)
            silent -= {event.source for event in events}
            if not any(event.time_s >= period.begin_s for event in events):
                findings.append(
                    Finding(
                        f"{path.name}: device {device.id!r} logs no signals in period {period.id!r}"
                    )
                )
                continue
            states = _states(events, links, device, period)
            shown += [(period.id, time, device.tls, state) for time, state in states]
        findings += [
            Finding(f"{path.name}: {kind} {number} of device {device.id!r} is never logged: red")
            for kind, number in sorted(silent)
        ]
    if not shown:
        raise MeasuredDataError(
            f"{path}: no phase event (1, 8, 10 ...) of a mapped phase; check the phases"
        )
    frame = pl.DataFrame(shown, schema=["period_id", "time_s", "tls_id", "state"], orient="row")
    frame = with_period(path, _numbered(frame), periods, findings, early=True)
    return signals_of(path, frame, periods, widths, findings)


def _links(
    device: Device, width: int, programme: Sequence[tuple[float, str]]
) -> list[list[tuple[Source, str]]]:
    """Return, for each link, its sources and the letter it shows while the source is green."""
    follows: list[list[tuple[Source, str]]] = [[] for _ in range(width)]
    for kind, mapped in (("phase", device.phases), ("overlap", device.overlaps)):
        for number, links in mapped.items():
            for link in links.green:
                follows[link].append(((kind, number), _green(link, links.green, programme)))
            for link in links.permissive:
                follows[link].append(((kind, number), "g"))
            for link in links.flashing:
                follows[link].append((("arrow", number), "g"))
    return follows


def _green(link: int, together: Sequence[int], programme: Sequence[tuple[float, str]]) -> str:
    """Return a link's letter in the network's programme when its phase is green."""
    states = [state for _, state in programme]
    alike = [state for state in states if all(state[other] in "Gg" for other in together)]
    shown = [state[link] for state in alike or states]
    return "G" if "G" in shown or not shown else "g"


def _events(
    path: Path,
    rows: pl.DataFrame,
    device: Device,
    period: Period,
    sources: set[Source],
    findings: list[Finding],
) -> list[_Event]:
    """Return the changes of colour of a device up to the end of a period, in order."""
    device_rows = rows.filter(
        (pl.col("device") == device.id)
        & (pl.col("period_id") == period.id)
        & pl.col("event").is_in(list(_KIND))
    )
    if device_rows.is_empty():
        return []
    device_rows = device_rows[_first_of_clock(device_rows["time_s"].to_numpy(), period) :]
    key, time = np.zeros(device_rows.height, np.int64), device_rows["time_s"].to_numpy()
    # A log whose newest piece comes first ends where it began; all others of a period go on in it.
    early = time[0] >= period.begin_s and time[0] - time[-1] > CLOCK_JUMP_S
    begin_s = np.full(len(time), period.begin_s) if early else None
    name = f"device {device.id!r}"
    refuse_set_back(path, key, time, device_rows[ROW].to_numpy(), lambda _: name, begin_s)
    order = in_order(path, key, time, findings)
    device_rows = device_rows[order]
    events = [
        _Event(time, (_KIND[code], number), code)
        for time, code, number in device_rows.select("time_s", "event", "parameter").iter_rows()
        if (_KIND[code], number) in sources
    ]
    return sorted(events, key=lambda event: (event.time_s, _RANK[event.colour]))


def _first_of_clock(time: NDArray[np.float64], period: Period) -> int:
    """Return the first row behind the last time that the clock was set back before a period.

    Rows before it only tell the state at the start of the period, by another clock.
    """
    inside = time >= period.begin_s
    before = time[: int(inside.argmax()) if inside.any() else None]
    steps = clock_steps(before).tolist()
    # in swapped pieces no time occurs twice
    twice = [step for step in steps if before[step:].max() >= before[:step].min()]
    return twice[-1] if twice else 0


def _states(
    events: Sequence[_Event],
    links: Sequence[Sequence[tuple[Source, str]]],
    device: Device,
    period: Period,
) -> SignalLog:
    """Return the state at the start of the period and at every change in it."""
    colours = {source: RED for link_sources in links for source, _ in link_sources}
    later: list[_Event] = []
    seen: set[Source] = set()
    since = period.begin_s
    for event in events:
        if event.time_s <= period.begin_s:
            colours[event.source] = event.colour
            since = event.time_s
            continue
        if event.source not in seen:
            # The log may have a gap before the period. This event shows the colour until now.
            colours[event.source] = BEFORE.get(event.code, colours[event.source])
            seen.add(event.source)
        later.append(event)

    def state() -> str:
        letters = [
            device.constant.get(link)
            or deciding_letter(
                [green if colours[s] == GREEN else colours[s] for s, green in link_sources]
            )
            for link, link_sources in enumerate(links)
        ]
        for link in device.on_red:
            letters[link] = letters[link].replace("r", "s")
        return "".join(letters)

    log = [(since, state())]
    for index, event in enumerate(later):
        colours[event.source] = event.colour
        if index + 1 < len(later) and later[index + 1].time_s == event.time_s:
            continue
        now = state()
        if now != log[-1][1]:
            log.append((event.time_s, now))
    return tuple(log)


def read_log(path: Path, time_zone: str, findings: list[Finding]) -> pl.DataFrame:
    """Read the events of a log.

    Args:
        path: CSV or Parquet file with TimeStamp, DeviceId, EventId and Parameter, or other names
            of these columns.
        time_zone: Time zone of the street; required if the times have a time zone.
        findings: Findings; rows that are left out are added to them.

    Returns:
        Columns ``ROW``, ``time`` (see `local_times`), ``device`` (text), ``event`` and
        ``parameter``, in the order of the file. Rows with empty cells are left out.

    Raises:
        MeasuredDataError: The file is unreadable, a column is missing, or times have an unknown
            form.
    """
    if path.suffix.lower() not in (".csv", ".parquet"):
        raise MeasuredDataError(f"{path}: a log is a .csv or a .parquet file")
    raw = read_raw(path, findings)
    names: dict[str, str] = {}
    for column in raw.columns:
        meaning = _NAMES.get("".join(x for x in column if x not in " _").lower())
        if meaning and meaning not in names.values():
            names[column] = meaning
    if missing := sorted({"time", "device", "event", "parameter"} - set(names.values())):
        raise MeasuredDataError(
            f"{path}: no column for {', '.join(missing)}; it has {', '.join(raw.columns[:12])}, "
            "and needs TimeStamp, DeviceId, EventId, Parameter"
        )
    raw = raw.select(*names).rename(names)
    if raw.is_empty():
        raise MeasuredDataError(f"{path}: no events")
    start = first_row(path)
    frame = pl.DataFrame(
        [
            pl.int_range(start, raw.height + start, dtype=pl.Int64, eager=True).alias(ROW),
            local_times(path, raw["time"].alias("TimeStamp"), time_zone, start, ZONE).alias("time"),
            to_texts(path, raw["device"]),
            to_numbers(path, raw["event"]),
            to_numbers(path, raw["parameter"]),
        ]
    )
    whole = frame.drop_nulls()
    if whole.height < frame.height:
        findings.append(
            Finding(f"{path.name}: {frame.height - whole.height} rows with empty cells left out")
        )
    for column in ("event", "parameter"):
        refuse(
            path,
            whole.filter(pl.col(column) % 1 != 0),
            column,
            "is not a whole number",
            "export the log again, or leave the row out",
        )
        refuse(
            path,
            whole.filter(pl.col(column).abs() > 2**31),
            column,
            "is no number of a controller",
            "export the log again, or leave the row out",
        )
    return whole.with_columns(pl.col("event").cast(pl.Int64), pl.col("parameter").cast(pl.Int64))
