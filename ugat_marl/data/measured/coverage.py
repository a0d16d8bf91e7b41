"""Findings on measured data: gaps, with the effects that they rule out, and likely mistakes."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.plausibility import implausible
from ugat_marl.data.measured.values import Finding, MeasuredData
from ugat_marl.effects import known_effects
from ugat_marl.errors import listed
from ugat_marl.scenarios import (
    GREEN,
    YELLOW,
    Detector,
    DetectorKind,
    Network,
    Period,
    Scenario,
    edge_of_lane,
)

SHORT_S = 300.0
"""Least length of a period with enough signal cycles."""
SILENT_S = 1800.0
"""A detector that is silent for longer, while others on its road count, is probably off."""
ALL_SILENT_S = 600.0
"""If all detectors are silent for longer, the recording was probably interrupted."""
HOLE_S = 180.0
"""The same limit for a busy recording; it is longer than a signal cycle."""
BUSY = 20
"""Least number of vehicles that counts as busy, such as at a neighbour during a silence."""
EXPECTED = 10.0
"""Least number of vehicles expected during a silence for a report."""
MANY_LENGTHS = 3
"""Number of different lengths of one green, in whole s, from which a programme is not fixed."""
RUN_OF_STATES, CHANGING_ORDER = 16, 0.03
"""Number of states that tell the next one in a fixed programme, and share of the places at which
they do not, above which a programme is not fixed."""
FEW_CHANGES, CHANGING_SHARE = 4, 0.05
"""Number and share of consecutive greens of different lengths above which a programme is not fixed.
Fixed plans have few: two where the plan changes, and two where rows were lost. Greens that follow
the traffic may nearly all be of the shortest length, or of the longest."""

COUNTABLE = (
    "demand_level",
    "demand_surge",
    "demand_timing",
    "turning",
    "undercount",
    "swapped",
)
"""Effects that counts alone can show."""
SUMMED = (
    "acceleration",
    "deceleration",
    "startup_delay",
    "headway",
    "min_gap",
    "imperfection",
    "desired_speed",
    "heavy_share",
    "driver_model",
    "late_green",
    "local_speed",
    "lane_closure",
    "parking",
)
"""Effects that occupancies, mean speeds or travel times show too, though they are sums."""
NEEDS_SIGNALS = (
    "late_green",
    "yellow_time",
    "all_red_time",
    "startup_delay",
    "acceleration",
    "yellow_running",
    "red_running",
    "gap_acceptance",
    "signal_clock",
    "clock_drift",
)
"""Effects that are visible only relative to the signals."""
NEEDS_STOP = (
    "startup_delay",
    "acceleration",
    "imperfection",
    "late_green",
    "yellow_running",
    "red_running",
    "gap_acceptance",
    "lane_discipline",
    "signal_clock",
    "clock_drift",
)
"""Effects that are visible in the start of a queue at the stop line."""
NEEDS_ADVANCE = ("deceleration", "emergency_deceleration", "min_gap")
"""Effects that are visible in the approach to red and in the length of queues."""
NEEDS_YELLOW = ("yellow_running", "yellow_time")
NEEDS_SPEEDS = ("speed_spread",)
NEEDS_TWO_KINDS = ("undercount",)
"""Effects that need two kinds of detectors: missed vehicles show in the next detector's count."""


def coverage(measured: MeasuredData, scenario: Scenario, network: Network) -> list[Finding]:
    """Return findings on mistaken and on missing data, most important first."""
    return [
        *implausible(measured, network),
        *_of_periods(measured),
        *_of_signals(measured, scenario, network),
        *_of_kinds(measured, network),
        *_of_clocks(measured),
        *_of_places(measured.detectors, network),
        *_of_silence(measured),
    ]


def _of_periods(measured: MeasuredData) -> Iterator[Finding]:
    periods = measured.periods
    if not measured.of("heldout"):
        why = "only one period" if len(periods) == 1 else "every period is to be fitted"
        yield Finding(
            f"periods.csv: {why}, so none is held out: a verdict can only be judged on the data "
            "that were fitted"
        )
    short = [period.id for period in periods if period.length_s < SHORT_S]
    if short:
        yield Finding(
            f"periods.csv: {listed(short, 'period')} shorter than {SHORT_S:g} s; a few signal "
            "cycles tell little"
        )


def _of_signals(measured: MeasuredData, scenario: Scenario, network: Network) -> Iterator[Finding]:
    periods = measured.periods
    if not any(period.signals for period in periods):
        yield Finding(
            "no signals: the network's own programme is taken for what the street's signals did",
            NEEDS_SIGNALS,
        )
        return
    controlled = [intersection.id for intersection in network.intersections]
    never = [tls for tls in controlled if not any(tls in period.signals for period in periods)]
    if never:
        yield Finding(
            f"signals: nothing of {listed(never, 'traffic light')}, of {len(controlled)}; "
            "in the simulation they run the network's programme"
        )
    for period in periods:
        gone = [tls for tls in controlled if tls not in period.signals and tls not in never]
        if gone:
            yield Finding(
                f"signals: nothing of {listed(gone, 'traffic light')} in period {period.id!r}"
            )
    if scenario.control.yellow_s > 0:
        bare = [tls for tls in controlled if tls not in never and not _has_yellow(periods, tls)]
        if bare:
            yield Finding(
                f"signals: {listed(bare, 'traffic light')} never yellow, though the scenario has "
                f"{scenario.control.yellow_s:g} s of it; was the yellow left out of the log?",
                NEEDS_YELLOW if len(bare) == len(controlled) - len(never) else (),
            )

    adaptive = [tls for tls in controlled if is_actuated(periods, tls)]
    if adaptive:
        yield Finding(
            f"signals: {listed(adaptive, 'traffic light')} with greens of many lengths or in an "
            "order that changes, as if they followed the traffic: "
            + (
                "simulated days get the arrivals they answered, as the advance detectors saw them; "
                "where an approach has none, doubt the verdict unknown"
                if measured.has_events
                else "without detections the arrivals they answered are not known, so simulated "
                "queues may differ though no effect is missing; doubt every verdict"
            )
        )


def is_actuated(periods: Sequence[Period], tls: str) -> bool:
    """Return True if greens have other lengths, or another order, than a fixed programme gives.

    Both are compared within a period, since plans of the day differ. A change of plan and rows
    that were lost give a few odd lengths, but lengths that follow the traffic change all the time.
    In heavy traffic a controller may give all greens one length, and choose only which comes next.
    """
    for period in periods:
        lengths: dict[str, list[float]] = {}
        changes = period.signals.get(tls, ())
        # The begin of a log and the end of the period cut the first and the last state short.
        for (begin_s, state), (end_s, _) in itertools.pairwise(changes[1:]):
            if set(state) & GREEN and end_s > period.begin_s:
                lengths.setdefault(state, []).append(round(end_s - begin_s))
        for of_state in lengths.values():
            changed = sum(abs(one - other) > 1 for one, other in itertools.pairwise(of_state))
            often = changed > max(FEW_CHANGES, CHANGING_SHARE * (len(of_state) - 1))
            if len({*of_state}) >= MANY_LENGTHS and often:
                return True
        if _order_changes([state for _, state in changes]):
            return True
    return False


def _order_changes(states: Sequence[str]) -> bool:
    """Return True if the successor of a run of states often is not its most frequent successor.

    If it is the state that is due one step later, it does not count: a row of the log was lost.
    """
    followed: defaultdict[tuple[str, ...], Counter[str]] = defaultdict(Counter)
    for place in range(RUN_OF_STATES, len(states)):
        followed[tuple(states[place - RUN_OF_STATES : place])][states[place]] += 1
    usual = {run: counts.most_common(1)[0][0] for run, counts in followed.items()}
    known = changed = 0
    for run, counts in followed.items():
        after_next = usual.get((*run[1:], usual[run]))
        known += counts.total() - 1
        changed += sum(n for state, n in counts.items() if state not in (usual[run], after_next))
    return changed > max(FEW_CHANGES, CHANGING_ORDER * known)


def _has_yellow(periods: Sequence[Period], tls: str) -> bool:
    """Return True if a log has yellow, or no green that could end in yellow."""
    shown = {state for period in periods for _, state in period.signals.get(tls, ())}
    letters = set("".join(shown))
    return bool(letters & YELLOW) or not letters & GREEN or len(shown) < 2


def _of_kinds(measured: MeasuredData, network: Network) -> Iterator[Finding]:
    if not measured.has_events:
        yield from _of_counts(measured, network)
        return
    seen = {name for period in measured.periods for name in period.passages}
    silent = [detector.id for detector in measured.detectors if detector.id not in seen]
    if silent:
        many = 2 * len(silent) >= len(measured.detectors)
        yield Finding(
            f"detections: nothing of {listed(silent, 'detector')}, of {len(measured.detectors)}"
            + (
                "; they are not used, and what happens there stays unknown"
                if many
                else "; that is compared like a count of 0: leave their rows in detectors.csv out "
                "if they are broken, or check their lanes"
            ),
            ("dropout", "swapped", "undercount") if many else (),
        )
    yield from _of_each_kind(measured, network, seen)
    yield from _of_speeds(measured)


def _of_counts(measured: MeasuredData, network: Network) -> Iterator[Finding]:
    """Yield findings on data without single vehicles, and what one more kind would show."""
    counts = measured.counts
    columns = () if counts is None else [name for name in counts.columns if counts[name].count()]
    more = {"occupancy": "occupancy", "mean speed": "mean_speed_mps"}
    missing = [name for name, column in more.items() if column not in columns]
    others = _has_rows(measured.travel_times) or _has_rows(measured.lanes)
    summed = len(missing) < len(more) or others
    shown = {*COUNTABLE, *(SUMMED if summed else ())}
    unlogged: set[str] = set()
    has_signals = any(period.signals for period in measured.periods)
    if has_signals:
        shown |= {"yellow_time", "all_red_time"}  # they are read off the signals
    else:
        unlogged = shown & {*NEEDS_SIGNALS}
        shown -= unlogged
    hidden = tuple(sorted(set(known_effects()) - shown - unlogged))
    names = ", ".join(sorted(unlogged))
    with_signals = f"; a log of signals would show {names} too" if unlogged else ""
    if not summed:
        further = [name for name in SUMMED if has_signals or name not in NEEDS_SIGNALS]
        yield Finding(
            "counts only, no detections of single vehicles: only "
            f"{', '.join(sorted(shown))} can be examined; with occupancy or mean_speed_mps in "
            f"counts.csv also {', '.join(further)}",
            hidden,
        )
    else:
        yield Finding(
            "no detections of single vehicles, but sums of intervals: examined are "
            f"{', '.join(sorted(shown))}; detections would show {', '.join(hidden)} too"
            f"{with_signals}",
            hidden,
        )
    if counts is None:
        return
    yield from _of_silent_counts(counts, measured.detectors)
    whole_s = sum(period.length_s for period in measured.periods)
    length = pl.col("end_s") - pl.col("begin_s")
    covered_s = counts.group_by("detector_id").agg(length.sum().alias("covered_s"))["covered_s"]
    if len(covered_s) and np.median(covered_s.to_numpy()) < whole_s / 2:
        yield Finding(
            "counts.csv: at most detectors the intervals cover less than half of the periods; what "
            "happens between them is not compared"
        )
    yield from _of_each_kind(measured, network, set(counts["detector_id"]))
    if summed and missing:
        yield Finding(
            f"counts.csv: no {missing[0]}; several effects change one of occupancy and mean speed "
            "alike, and both together tell them apart"
        )


def _of_silent_counts(counts: pl.DataFrame, detectors: Sequence[Detector]) -> Iterator[Finding]:
    """Yield findings on detectors that have no row, or never counted a vehicle."""
    of_each = counts.group_by("detector_id")
    most = dict(of_each.agg(pl.col("count").max()).iter_rows())
    least_occupancy: dict[str, float | None] = {}
    if "occupancy" in counts.columns:
        least_occupancy = dict(of_each.agg(pl.col("occupancy").min()).iter_rows())
    names = [detector.id for detector in detectors]
    silent = [name for name in names if most.get(name) == 0]
    stuck = [name for name in silent if least_occupancy.get(name) == 1]
    for found, what, treated, otherwise in (
        (
            [name for name in names if name not in most],
            "nothing of",
            "nothing is compared there",
            "write their counts",
        ),
        (
            [name for name in silent if name not in stuck],
            "no vehicle at",
            "that is compared as a count of 0",
            "check their lanes",
        ),
        (
            stuck,
            "no vehicle, and an occupancy of 1 throughout, at",
            "that is compared as it is",
            "check the columns",
        ),
    ):
        if found:
            yield Finding(
                f"counts.csv: {what} {listed(found, 'detector')}, of {len(names)}; {treated}: "
                f"leave their rows out, in detectors.csv too, if they are broken, or {otherwise}"
            )


def _has_rows(table: pl.DataFrame | None) -> bool:
    return table is not None and not table.is_empty()


def _of_each_kind(
    measured: MeasuredData, network: Network, seen: Collection[str]
) -> Iterator[Finding]:
    """Yield findings on kinds of detectors of which none is among those that saw vehicles."""
    kinds = {detector.kind for detector in measured.detectors if detector.id in seen}
    turns = _has_rows(measured.turning)
    shared = any(
        len({link.to_edge for link in intersection.links if link.from_lane == lane}) > 1
        for intersection in network.intersections
        for lane in intersection.incoming_lanes
    )
    needs: dict[DetectorKind, tuple[str, tuple[str, ...]]] = {
        "stop": ("how queues leave the stop line stays unseen", NEEDS_STOP),
        "advance": ("the approach to red and the reach of queues stay unseen", NEEDS_ADVANCE),
        "exit": (
            "where vehicles turn "
            + ("on shared lanes stays unseen" if shared and not turns else "shows by lane"),
            ("turning",) if shared and not turns else (),
        ),
    }
    for kind, (kind_name, effects) in needs.items():
        if kind not in kinds:
            yield Finding(f"no {kind} detector counts: {kind_name}", effects)
    if len(kinds) < 2:
        yield Finding(
            "all detectors are of one kind: one that misses vehicles looks like less demand",
            NEEDS_TWO_KINDS,
        )


def _of_speeds(measured: MeasuredData) -> Iterator[Finding]:
    passages = [
        detector_passages
        for period in measured.periods
        for detector_passages in period.passages.values()
    ]
    total = sum(map(len, passages))
    known = sum(
        int(np.isfinite(detector_passages.speed_mps).sum()) for detector_passages in passages
    )
    if known == 0:
        yield Finding(
            "no speeds: a small change of desired_speed stays unseen, and heavy_share shows only "
            "in how long detectors are occupied",
            NEEDS_SPEEDS,
        )
    elif known < total:
        yield Finding(f"detections: no speed for {total - known} of {total} passages")
    times = np.concatenate([detector_passages.on_s for detector_passages in passages])
    times = times[np.isfinite(times)]
    if len(times) >= BUSY and not (times % 1).any():
        yield Finding(
            "detections: all times are whole seconds; effects of less than a second are hard to "
            "see (controllers log tenths)"
        )


def _of_clocks(measured: MeasuredData) -> Iterator[Finding]:
    silent = [detector.id for detector in measured.detectors if detector.clock is None]
    if silent and measured.has_events:
        yield Finding(
            f"detectors.csv: no clock stated for {listed(silent, 'detector')}; the stamps are "
            "taken for those of SUMO's output, one simulation step ahead of the signals. For a "
            "street, add the column clock with signals in every row"
        )


def _of_places(detectors: Sequence[Detector], network: Network) -> Iterator[Finding]:
    into = {lane for intersection in network.intersections for lane in intersection.incoming_lanes}
    out = {lane for intersection in network.intersections for lane in intersection.outgoing_lanes}
    wrong = [
        detector.id
        for detector in detectors
        if not set(detector.lanes) <= (out if detector.kind == "exit" else into)
    ]
    if wrong:
        yield Finding(
            f"detectors.csv: {listed(wrong, 'detector')} not on a lane of that kind (advance and "
            "stop: leading to an intersection with signals, exit: leading away); not used"
        )
    seen = {lane for detector in detectors if detector.kind != "exit" for lane in detector.lanes}
    bare = sorted(into - seen)
    if bare:
        yield Finding(
            f"detectors.csv: no detector on {listed(bare, 'incoming lane')}, of {len(into)}; "
            "what differs there stays unknown"
        )


@dataclass(frozen=True)
class _Silence:
    """Time in which a detector reports no event while a neighbour counts vehicles.

    Attributes:
        period: Id of the period.
        begin_s: Start of the silence.
        length_s: Length of the silence.
        meanwhile: Number of vehicles at the busiest neighbour.
    """

    period: str
    begin_s: float
    length_s: float
    meanwhile: int


def _of_silence(measured: MeasuredData) -> Iterator[Finding]:
    roads: dict[str, list[Detector]] = {}
    for silent in measured.detectors:
        roads.setdefault(edge_of_lane(silent.lane), []).append(silent)
    usual = _usual_rates(measured)
    silences: dict[tuple[str, str], list[_Silence]] = {}
    for period in measured.periods:
        if not period.passages:
            if measured.has_events:
                yield Finding(f"detections: nothing in period {period.id!r}")
            continue
        times = {name: _times(period, name) for name in period.passages}
        together = np.concatenate(list(times.values()))
        silent = [
            (hole, "A diagnosis leaves this time out of all periods")
            for hole in recording_holes([period])
        ]
        begin, length = _longest_gap(together, period)
        known = [span for span, _ in silent]
        long = length > ALL_SILENT_S or _is_hole(together, begin, length, period)
        if long and (begin, begin + length) not in known:
            way_out = (
                "begin the period after" if begin <= period.begin_s else "end the period before"
            )
            silent.append(((begin, begin + length), f"If it was, {way_out} it, in periods.csv"))
        for (begin, end), what_then in silent:
            yield Finding(
                f"detections: no detector says anything for {(end - begin) / 60:.0f} min from "
                f"{begin:g} s on in period {period.id!r}; was the recording interrupted, or a "
                f"clock set ahead? {what_then}"
            )
        if silent:
            continue
        for group in roads.values():
            for name, behaviour, silence in _silent(group, times, period, usual):
                silences.setdefault((name, behaviour), []).append(silence)
    for (name, behaviour), silent_spans in silences.items():
        minutes = sorted(round(silent.length_s / 60) for silent in silent_spans)
        span = f"{minutes[0]}" if minutes[0] == minutes[-1] else f"{minutes[0]} to {minutes[-1]}"
        where = f"in {listed([silent.period for silent in silent_spans], 'period')}"
        if len(silent_spans) == 1:
            where = f"from {silent_spans[0].begin_s:g} s on in period {silent_spans[0].period!r}"
        yield Finding(
            f"detections: {name!r} {behaviour} for {span} min {where}, while a "
            f"neighbour counts {max(silent.meanwhile for silent in silent_spans)} vehicles"
        )


def recording_holes(periods: Sequence[Period]) -> tuple[tuple[float, float], ...]:
    """Return begin and end of the times, in s, in which a recording of events was interrupted.

    All detectors say nothing for longer than a cycle, or to the end of the period, they are busy
    before and after it, and the lights go on changing. The times of all periods are put together,
    in order and apart.
    """
    found: list[tuple[float, float]] = []
    for period in periods:
        times = np.sort(
            np.concatenate([np.empty(0), *(_times(period, x) for x in period.passages)])
        )
        marks = np.append(times, period.end_s)
        for place in np.flatnonzero(np.diff(marks) > HOLE_S):
            begin, end = marks[place : place + 2].tolist()
            hole = _is_hole(times, begin, end - begin, period)
            if hole and _lights_change(period, begin, end):
                found.append((begin, end))
    apart: list[tuple[float, float]] = []
    for begin, end in sorted(found):
        if apart and begin <= apart[-1][1]:
            begin, end = apart[-1][0], max(end, apart.pop()[1])
        apart.append((begin, end))
    return tuple(apart)


def _lights_change(period: Period, begin_s: float, end_s: float) -> bool:
    """Return True if a light changes its state between two times."""
    return any(begin_s < time < end_s for log in period.signals.values() for time, _ in log)


def _is_hole(times: NDArray[np.float64], begin_s: float, length_s: float, period: Period) -> bool:
    """Return True for a silence longer than a cycle with busy times before and after it."""
    end_s = begin_s + length_s
    before = int(((times > begin_s - length_s) & (times <= begin_s)).sum()) // 2
    after = int(((times >= end_s) & (times < end_s + length_s)).sum()) // 2
    busy_after = after >= BUSY or end_s >= period.end_s
    return length_s > HOLE_S and before >= BUSY and busy_after


def _usual_rates(measured: MeasuredData) -> dict[str, float]:
    """Return the vehicles per second at each detector over all periods."""
    counts: dict[str, float] = {}
    seconds = sum(period.length_s for period in measured.periods)
    for period in measured.periods:
        for name in period.passages:
            counts[name] = counts.get(name, 0.0) + len(_times(period, name)) / 2
    return {name: count / seconds for name, count in counts.items()}


def _silent(
    group: Sequence[Detector],
    times: dict[str, NDArray[np.float64]],
    period: Period,
    usual: Mapping[str, float],
) -> Iterator[tuple[str, str, _Silence]]:
    """Yield id, words for its state, and silence of detectors silent while their road is busy."""
    for detector in group:
        begin, length = _longest_gap(times.get(detector.id, np.empty(0)), period)
        if usual.get(detector.id, 0.0) * length < EXPECTED:
            continue  # few vehicles use this lane
        if length <= min(SILENT_S, period.length_s - 1e-6):
            continue
        others = [times[other.id] for other in group if other.id in times and other is not detector]
        busy = max(
            (int(((t > begin) & (t < begin + length)).sum()) // 2 for t in others), default=0
        )
        if busy >= BUSY:
            behaviour = "is on" if _is_on(period, detector.id, begin) else "says nothing"
            yield detector.id, behaviour, _Silence(period.id, begin, length, busy)


def _times(period: Period, detector: str) -> NDArray[np.float64]:
    passages = period.passages[detector]
    both = np.concatenate([passages.on_s, passages.off_s])
    return both[np.isfinite(both)]


def _is_on(period: Period, detector: str, time_s: float) -> bool:
    """Return True if a vehicle reaches the detector at this time."""
    return detector in period.passages and bool((period.passages[detector].on_s == time_s).any())


def _longest_gap(times: NDArray[np.float64], period: Period) -> tuple[float, float]:
    """Return begin and length of the longest time without an event, s."""
    marks = np.concatenate([[period.begin_s], np.sort(times), [period.end_s]])
    gaps = np.diff(marks)
    longest = int(gaps.argmax())
    return float(marks[longest]), float(gaps[longest])
